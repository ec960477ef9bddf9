"""Where a run stands: the arm, what was sent to it last, and what the last step left behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik import errors
from robot_ik.errors import RobotIkError, distinct_texts
from robot_ik.execution import START_TOLERANCE, execute
from robot_ik.hardware import virtual_servos
from robot_ik.jobs.robot_setup import RobotSetup
from robot_ik.motion.trajectory import Trajectory

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.jobs.script.file import Script
    from robot_ik.jobs.vision import Vision
    from robot_ik.ports import Array
    from robot_ik.robot import Robot


GRACE = 2.0
"""s beyond the planned time in which servos must have arrived where a step names no time limit."""


PASSED, FAILED, NOT_RUN = "passed", "failed", "not run"


class StepFailed(Exception):
    """A step did not do what it should; the message says what was found."""


def error_classes() -> Mapping[str, type[RobotIkError]]:
    """Name -> class of every error that ``raises`` and ``error`` may name."""
    return {
        name: kind
        for name, kind in vars(errors).items()
        if name[0] != "_" and isinstance(kind, type) and issubclass(kind, errors.RobotIkError)
    }


@dataclass
class StepResult:
    """One step, as it went.

    Attributes:
        outcome: ``passed``, ``failed`` or ``not run``.
        seconds: On the run's clock.
        found: One line: what was measured, or what went wrong; ``numbers``: the same for programs.
        trajectory: What was planned; None where nothing was.
    """

    name: str
    do: str
    outcome: str = NOT_RUN
    seconds: float = 0.0
    found: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)
    trajectory: Trajectory | None = field(default=None, repr=False)


@dataclass
class RunState:
    """Where a run stands.

    Attributes:
        vision: None where no step looks.
        error: The last error of a step; ``status``: of the last solve; ``seconds``: of the last action.
        begin: When the run began, on its clock.
    """

    script: Script
    setup: RobotSetup
    solver: str
    seed: int
    vision: Vision | None = None
    error: RobotIkError | None = None
    status: str = ""
    seconds: float = 0.0
    begin: float = 0.0

    @property
    def robot(self) -> Robot:
        """Inside the limits of model and arm file together."""
        return self.setup.robot

    @property
    def arm(self) -> Arm:
        """The servos; a script never runs without."""
        if self.setup.arm is None:
            raise RuntimeError("a script runs with an arm")
        return self.setup.arm

    @property
    def simulated(self) -> bool:
        """Whether its servos are; else they are behind a real port."""
        return not self.arm.bus.real

    @property
    def servos(self) -> VirtualBus:
        """The simulated servos; no step that wants them runs on a real port."""
        servos = virtual_servos(self.arm.bus)
        if servos is None:
            raise RuntimeError("this step needs simulated servos")
        return servos

    @property
    def config(self) -> ArmConfig:
        return self.arm.config

    def now(self) -> float:
        """Seconds since the run began."""
        return self.setup.clock.now() - self.begin

    def start(self) -> Array:
        """(nq,) where the next move begins: at the last command, or where the arm is if that is far off.

        From the last command, so that ticks of the servos and the time they take change no plan.
        """
        measured, commanded = self.setup.q, self.setup.commanded
        near = np.abs(measured - commanded).max() <= START_TOLERANCE
        return (commanded if near else measured).copy()

    def play(
        self, trajectory: Trajectory, limit: float | None, arrived: Callable[[], bool], result: StepResult
    ) -> None:
        """Sends a trajectory, then waits at its end until ``arrived`` or the time is over.

        Both may take ``limit`` seconds; None: as planned and ``GRACE``.  ``result`` keeps the trajectory.

        Raises:
            StepFailed: Planned or took longer than ``limit``.
            RobotIkError: Of the arm.
        """
        result.trajectory = trajectory
        result.numbers["planned_s"] = round(trajectory.duration, 6)
        if limit is not None and trajectory.duration > limit:
            planned, permitted = distinct_texts(trajectory.duration, limit, digits=2)
            raise StepFailed(f"planned {planned} s, allowed {permitted} s; nothing was sent")
        allowed = trajectory.duration + GRACE if limit is None else limit
        end = self.setup.clock.now() + allowed

        def in_time(tick: object) -> None:
            if self.setup.clock.now() > end + 0.5 * self.arm.config.rate_hz**-1:
                raise StepFailed(f"not there after {allowed:.2f} s")

        execute(
            trajectory, self.setup.sinks, source=self.setup.opened, clock=self.setup.clock, on_tick=in_time
        )
        if not arrived():
            self.setup.repeat(end - self.setup.clock.now(), arrived)
