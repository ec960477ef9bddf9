"""``robot-ik servo move``: move joints to angles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import ServoReport, driving, load_arm, open_arm_on
from robot_ik.commands.options import ExitPolicy, JsonOption, MovingBusOptions, Speed
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import OptionError, distinct_texts

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.servo import Joint

ROUNDING = 1e-9
"""An angle may be this much outside a limit, in rad or m: decimal degrees are rounded."""


@dataclass(frozen=True)
class ServoMove(MovingBusOptions, JsonOption):
    """Move joints to angles in degrees (slides: mm), slowly and within the limits of the arm file.

        robot-ik servo move joint1=30 joint3=-45 --bus /dev/ttyUSB0
        robot-ik servo move 0 90 -90 0 0 0 --bus /dev/ttyUSB0

    The second form names all joints in order. If the arm file has a table [collisions], all joints
    move together on a straight path, and a path that would touch is refused. At the end, and on
    Ctrl-C, --on-exit applies: with torque_off the arm falls.

    Exit code 1: a joint did not arrive, or the path is blocked.
    """

    to: Annotated[tuple[str, ...], Parameter(name="JOINT=DEG …", required=True)]
    """Targets by joint, or one number for every joint."""
    relative: bool = field(default=False, kw_only=True)
    """The angles are relative to the present pose."""
    speed: Speed = field(default=0.25, kw_only=True)
    on_exit: ExitPolicy = field(default=None, kw_only=True)

    def run(self, terminal: Terminal = QUIET) -> ServoMoveReport:
        """Enable the arm, move it, and leave it by its exit policy.

        Raises:
            RobotIkError: The input is wrong, or the arm cannot be connected. Nothing moved.
        """
        from robot_ik.workcell.arm_guard import guard_of  # MuJoCo, if the arm file has a scene

        config = load_arm(self.arm).slowed(self.speed)
        angles = parse_angles(self.to, config)
        if not self.relative:
            require_inside(angles, config)
        guard = guard_of(config)
        arm = open_arm_on(self.bus, config, self.on_exit)
        report = ServoMoveReport(config)
        with driving(arm, report, terminal):
            if guard is None:
                arm.enable()
            arm.read()
            report.start = arm.positions()
            offset = report.start if self.relative else dict.fromkeys(angles, 0.0)
            goal = {name: q + offset[name] for name, q in angles.items()}
            require_inside(goal, config)
            report.goal = goal
            if guard is not None:
                from robot_ik.workcell.replay import move_straight

                move_straight(arm, goal, guard, terminal.busy)
            with terminal.busy("moving", report.duration):
                arm.move_to(goal)
            arm.read()
            report.end = arm.positions()
        return report


@dataclass(eq=False)
class ServoMoveReport(ServoReport):
    """Joint values before and after the motion, rad (slides: m).

    Attributes:
        config: Arm file.
        start: Joint -> value before the motion.
        goal: Joint -> requested value.
        end: Joint -> value after the motion. Empty if the motion did not end.
    """

    config: ArmConfig
    start: Mapping[str, float] = field(default_factory=dict)
    goal: Mapping[str, float] = field(default_factory=dict)
    end: Mapping[str, float] = field(default_factory=dict)

    @property
    def duration(self) -> float:
        """Shortest possible duration of the motion, s."""
        speeds = {name: self.config.joint(name).velocity for name in self.goal}
        times = [abs(q - self.start[name]) / speeds[name] for name, q in self.goal.items()]
        return max(times, default=0.0)

    def tables(self) -> Iterable[Table]:
        if not self.end:
            return
        rows = []
        for name, q in self.end.items():
            goal = self._text(name, self.goal[name]) if name in self.goal else "-"
            rows.append((name, self._text(name, self.start[name]), goal, self._text(name, q)))
        yield table("joint", "start", "goal", "end", rows=rows)

    def facts(self) -> dict[str, Any]:
        return {"start": self.start, "goal": self.goal, "end": self.end}

    def _text(self, name: str, q: float) -> str:
        return joint_text(self.config.joint(name), q)


def joint_text(joint: Joint, q: float) -> str:
    """Return a joint value as text: degrees, or mm of a slide."""
    return f"{q / joint.per_unit:z.2f} mm" if joint.slides else f"{math.degrees(q):z.2f}°"


def parse_angles(arguments: Iterable[str], config: ArmConfig) -> dict[str, float]:
    """Return joint -> rad (m) from ``joint1=30``, or from one number for every joint.

    Raises:
        OptionError: The arguments have neither form, or a number is not finite.
        UnknownJointError: A joint does not exist.
    """
    from robot_ik.config import is_number  # pydantic

    arguments = list(arguments)
    named = [argument for argument in arguments if "=" in argument]
    if named and len(named) == len(arguments):
        pairs = [(name, text) for name, _, text in (item.partition("=") for item in named)]
    elif not named and len(arguments) == len(config.names):
        pairs = list(zip(config.names, arguments, strict=True))
    else:
        count = f"{len(config.names)} numbers for {', '.join(config.names)}"
        given = " ".join(arguments) or "no joint is given"
        raise OptionError("JOINT=DEG", given, f"JOINT=DEG (slides: MM), or {count}")
    angles: dict[str, float] = {}
    for name, text in pairs:
        joint = config.joint(name)
        value = float(text) if is_number(text) else math.nan
        if not math.isfinite(value):
            raise OptionError(name, f"{text!r} is not a number", f"{joint.unit}, for example 30")
        if name in angles:
            raise OptionError(name, "given twice", "each joint once")
        angles[name] = value * joint.per_unit
    return angles


def require_inside(angles: Mapping[str, float], config: ArmConfig) -> None:
    """Refuse values (rad, m) outside the limits of the arm file and the servo mode.

    Raises:
        OptionError: A value is outside.
    """
    for name, q in angles.items():
        joint = config.joint(name)
        lower, upper = joint.limits
        if not lower - ROUNDING <= q <= upper + ROUNDING:
            values = (value / joint.per_unit for value in (q, lower, upper))
            given, low, high = distinct_texts(*values)
            unit = joint.unit
            raise OptionError(
                name, f"{given} {unit} is outside its limits", f"{low} to {high} {unit}"
            )
