"""``robot-ik teleop``: lead an arm by another arm, a gamepad, or the keys of the terminal."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.arms import ServoReport, driving, load_arm, port_name, single_keys
from robot_ik.commands.options import BUS_HELP, BUS_METAVAR, ExitPolicy, JsonOption, Seconds
from robot_ik.commands.tables import plural
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import OptionError
from robot_ik.hardware import bus_row

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.workcell.jog import Jog
    from robot_ik.workcell.operator import Operator
    from robot_ik.workcell.teleop import TeleopReport

KEYS = "keys"
"""Value of ``--leader``: the keys of the terminal instead of an arm."""

GAMEPAD = "gamepad"
"""Value of ``--leader``: the first gamepad instead of an arm."""

READ_BYTES = 64
"""Bytes read from standard input at once."""

MIN_SCALE = 0.01
"""Smallest motion of the follower for that of the leader."""

MAX_SCALE = 100.0
"""Largest motion of the follower for that of the leader."""


@dataclass(frozen=True, kw_only=True)
class Teleop(JsonOption):
    """Lead an arm by another arm that a person guides, by a gamepad, or by keys of the terminal.

        robot-ik teleop --leader l.toml --leader-bus PORT --follower-bus PORT
        robot-ik teleop --follower tabletop_puma --follower-bus pty

    The follower moves slowly to the pose of the leader, then follows within its limits and caps.
    While the leader is lost no command is sent: the follower holds, then `on_stale` of its arm
    file applies. When the leader is back the follower moves slowly to its pose again. With
    [collisions] in its arm file the follower stops before it would touch. Ctrl-C ends it. The
    leader is always left without torque. Time is virtual if both arms are on `sim`, else real.

    Exit code 1: an arm failed, or the leader did not come back.
    """

    leader: Annotated[str, Parameter(metavar="FILE|NAME|keys|gamepad")] = KEYS
    """Arm file of the leader, `keys`, or `gamepad` (extra `gamepad`)."""
    follower: Annotated[str, Parameter(metavar="FILE|NAME")] = "tabletop_puma"
    """Arm file of the follower, or a robot that has one."""
    leader_bus: Annotated[
        str, Parameter(metavar=BUS_METAVAR, help=f"Servo bus of the leader. {BUS_HELP}.")
    ] = ""
    follower_bus: Annotated[str, Parameter(metavar=BUS_METAVAR, help="Servo bus of the follower.")]
    mode: Literal["joints", "tool"] = "joints"
    """joints: joints of the same name, range onto range. tool: the tool, so the arms may differ."""
    scale: Annotated[
        float, Parameter(metavar="FACTOR", validator=Number(gte=MIN_SCALE, lte=MAX_SCALE))
    ] = 1.0
    """Scale factor. With --mode tool: metres of the follower for one metre of the leader."""
    seconds: Seconds | None = None
    """Duration, in s. Default: until Ctrl-C."""
    on_exit: ExitPolicy = None

    def run(self, terminal: Terminal = QUIET) -> TeleopRun:
        """Connect both arms and lead the follower."""
        from robot_ik.workcell.arm_guard import guard_of
        from robot_ik.workcell.leader_arm import LeaderArm
        from robot_ik.workcell.teleop import open_pair, teleoperate

        leads_by_arm = self.leader not in (KEYS, GAMEPAD)
        if leads_by_arm:
            self._require_two_ports()
        config = load_arm(self.follower)
        guard = guard_of(config)
        leader_config = load_arm(self.leader) if leads_by_arm else None
        leader_port = port_name(self.leader_bus, "--leader-bus") if leads_by_arm else ""
        follower_port = port_name(self.follower_bus, "--follower-bus")
        leader, follower = open_pair(
            leader_config, config, leader_port, follower_port, self.on_exit or ""
        )
        report = TeleopRun()
        terminal.end_progress()
        operator: Operator
        with contextlib.ExitStack() as stack:
            if leader is not None:
                stack.enter_context(leader)
                operator = LeaderArm(leader, config, self.mode, self.scale)
            elif self.leader == KEYS:
                operator = self._keyboard(stack, follower, config, terminal)
            else:
                operator = self._gamepad(stack, follower, config, terminal)
            # If the keys of the terminal lead, they have another reader.
            stack.enter_context(driving(follower, report, terminal, space=self.leader != KEYS))

            def finish(result: TeleopReport) -> None:
                report.result = result

            try:
                teleoperate(
                    operator,
                    follower,
                    seconds=self.seconds,
                    over=lambda: operator.over,
                    done=finish,
                    guard=guard,
                )
            except (KeyboardInterrupt, SystemExit):
                terminal.show(report)
                raise
        return report

    def _require_two_ports(self) -> None:
        """Check that leader and follower are on two ports.

        Raises:
            OptionError: They share a port.
        """
        port = self.leader_bus
        if not port:
            raise OptionError("--leader-bus", "no port is given", BUS_METAVAR)
        if not bus_row(port).virtual and port == self.follower_bus:
            raise OptionError("--leader-bus", f"{port} is the follower's, too", "two ports")

    def _keyboard(
        self, stack: contextlib.ExitStack, follower: Arm, config: ArmConfig, terminal: Terminal
    ) -> Jog:
        """Return the keys as an operator, and print their meaning."""
        from robot_ik.workcell.jog import JOINT_KEYS, KeyboardJog

        read = stack.enter_context(_typed_keys(endless=self.seconds is not None))
        keys = KeyboardJog(config, read, stop=follower.request_stop, moves_tool=self.mode == "tool")
        pairs = zip(keys.joints, JOINT_KEYS, strict=False)
        joints = ", ".join(f"{pair[0]}/{pair[1]} {joint.name}" for joint, pair in pairs)
        terminal.say(f"joints: {joints}", "dim")
        terminal.say("tool: w/s x, a/d y, r/f z; i/k, j/l, u/o turn about x, y, z", "dim")
        terminal.say(
            f"Tab: {_other_mode(keys)}; - finer, + coarser; space: stop and hold; Esc ends", "dim"
        )
        return keys

    def _gamepad(
        self, stack: contextlib.ExitStack, follower: Arm, config: ArmConfig, terminal: Terminal
    ) -> Jog:
        """Return the gamepad as an operator, and print the meaning of its buttons."""
        from robot_ik.workcell.gamepad import Gamepad, PadDevice

        device = stack.enter_context(PadDevice())
        pad = Gamepad(
            config,
            device.read,
            recover=device.recover,
            stop=follower.request_stop,
            moves_tool=self.mode == "tool",
        )
        sticks = "left stick x, y; triggers z; right stick and shoulders turn"
        terminal.say(f"{device.name}: {sticks}", "dim")
        terminal.say(
            "in joint mode each of these six moves one joint; up and down: the gripper; "
            f"Y: {_other_mode(pad)}; B: stop and hold; Start ends",
            "dim",
        )
        return pad


@dataclass(eq=False)
class TeleopRun(ServoReport):
    """How the follower was led.

    Attributes:
        result: Counts and times. None: the arms were not connected.
    """

    result: TeleopReport | None = None

    def tables(self) -> Iterable[str]:
        result = self.result
        if result is None:
            return
        lost = f", the leader lost {plural(result.lost, 'time')}" if result.lost else ""
        blocked = ""
        if result.blocked:
            blocked = f", held back {plural(result.blocked, 'time')} by a collision"
        yield (
            f"{result.end} after {result.seconds:.1f} s: {result.ticks} commands, "
            f"engaged {plural(result.engaged, 'time')}{lost}{blocked}; "
            f"{1e3 * result.delay:.1f} ms from the leader to the packet"
        )

    def facts(self) -> dict[str, Any]:
        return {} if self.result is None else asdict(self.result)


def _other_mode(jog: Jog) -> str:
    """Return the mode after a change."""
    return "joints" if jog.moves_tool else "tool"


@contextlib.contextmanager
def _typed_keys(*, endless: bool) -> Iterator[Callable[[], str]]:
    """Yield a function that returns what was typed since the last call.

    Without a terminal it returns what comes on standard input.

    Args:
        endless: Go on if the input has ended. Otherwise its end is that of the command, because no
            key can end it.

    Raises:
        OptionError: Standard input is closed.
    """
    from robot_ik.workcell.jog import QUIT

    if sys.stdin is None:
        allowed = "a terminal, or a pipe that sends keys"
        raise OptionError("--leader keys", "standard input is closed", allowed)
    file = sys.stdin.fileno()

    def read() -> str:
        text = b""
        while select.select([file], [], [], 0.0)[0]:
            try:
                data = os.read(file, READ_BYTES)
            except OSError:  # the terminal has hung up
                data = b""
            if not data:
                return text.decode(errors="ignore") + ("" if endless else QUIT)
            text += data
        return text.decode(errors="ignore")

    with single_keys():
        yield read
