"""``robot-ik stop``: stop arms that other programs drive."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from cyclopts import Parameter

from robot_ik.commands.options import JsonOption
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import HardwareError, OptionError, RobotIkError


@dataclass(frozen=True, kw_only=True)
class Stop(JsonOption):
    """Make arms that other programs drive hold their pose, with torque on.

    Needs neither the port nor the program's terminal. Without an answer for 3 s the request stays:
    the arm stops when its program continues. This does not replace a switch in the supply of the
    servos.

    Exit code 1: an arm did not confirm it, or no arm runs.
    """

    bus: Annotated[str, Parameter(alias="--port", metavar="PORT")] = ""
    """Servo bus. A port. Default: every arm of this user."""
    torque_off: bool = False
    """Switch torque off instead, after a confirmation: the arm may fall."""
    yes: bool = False
    """Skip the confirmation. Only with --torque-off."""

    def run(self, terminal: Terminal = QUIET) -> StopReport:
        """Send the request to each arm and wait for its answer."""
        from robot_ik.hardware.stop_file import running_arms

        arms = running_arms(os.path.expanduser(self.bus) or None)
        if arms and self.torque_off and not self.yes:
            if not sys.stdin.isatty():
                problem = "there is no terminal for the confirmation"
                raise OptionError("--torque-off", problem, "--torque-off --yes")
            names = ", ".join(arm.name for arm in arms)
            question = f"{names}: without torque an arm falls. Support it. Torque off?"
            if not terminal.confirm(question):
                return StopReport(self.bus, self.torque_off, (), declined=True)
        answers = []
        for arm in arms:
            ok, text = arm.stop("torque_off" if self.torque_off else "hold")
            answers.append(Answer(arm.name, arm.port, arm.pid, ok, text))
        return StopReport(self.bus, self.torque_off, answers)


class Answer(NamedTuple):
    """Answer of an arm to a request to stop.

    Attributes:
        name: Name of the arm.
        port: Port of its servos.
        pid: Process that drives it.
        ok: Every servo confirmed it.
        text: What happened.
    """

    name: str
    port: str
    pid: int
    ok: bool
    text: str


@dataclass(frozen=True, eq=False)
class StopReport(Report):
    """The answers of the arms.

    Attributes:
        bus: Port of the request. Empty: all.
        torque_off: Torque off was requested.
        answers: One for each arm.
        declined: The user did not confirm.
    """

    bus: str
    torque_off: bool
    answers: Sequence[Answer]
    declined: bool = False

    @property
    def ok(self) -> bool:
        return bool(self.answers) and all(answer.ok for answer in self.answers)

    @property
    def failure(self) -> RobotIkError | None:
        if self.answers or self.declined:
            return None
        where = f" on {self.bus}" if self.bus else ""
        hint = ""
        if self.torque_off:
            command = f"robot-ik servo torque off --bus {self.bus or 'PORT'}"
            hint = f"servos may hold without a program: {command}"
        return HardwareError(f"no arm runs{where}", hint=hint)

    def tables(self) -> Iterable[str]:
        if self.declined:
            yield "nothing was done"
        for answer in self.answers:
            yield f"{answer.name} on {answer.port} (process {answer.pid}): {answer.text}"

    def facts(self) -> dict[str, Any]:
        return {"arms": [answer._asdict() for answer in self.answers]}
