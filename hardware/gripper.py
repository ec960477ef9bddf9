"""Grips: how an arm closes its gripper and reports what it holds."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass

from robot_ik.errors import HardwareError, UnsafeCommandError, distinct_texts
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.servo import GRIPPER, Joint

REST = 0.15
"""s in which a finger that moves by less than ``STILL_TICKS`` is at rest."""
STILL_TICKS = 1.5
"""Servo ticks by which a finger at rest moves at most."""
HELD_TICKS = 6.0
"""Servo ticks from its goal beyond which a finger at rest is held by an object."""


@dataclass(frozen=True)
class Grip:
    """How a joint of a gripper came to rest.

    Attributes:
        joint: Name of the joint.
        asked: Goal, m (rad of a hinge).
        q: Joint value at rest, m (rad of a hinge).
        held: An object keeps the joint from its goal.
        current: Motor current, mA; None if the servo does not measure it.
    """

    joint: str
    asked: float
    q: float
    held: bool
    current: float | None


class Fingers:
    """Joints on their way to a grip.

    Args:
        config: Arm.
        q: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> m.

    Attributes:
        goals: Joint -> goal within its range.

    Raises:
        UnknownJointError: No such joint.
        UnsafeCommandError: The arm has no gripper, or a goal is outside the joint's range.
    """

    def __init__(self, config: ArmConfig, q: float | Mapping[str, float]) -> None:
        if not isinstance(q, Mapping):
            fingers = config.group(GRIPPER)
            if not fingers:
                raise UnsafeCommandError(
                    f"a grip by {config.name!r}", "an arm file with joints of the group gripper"
                )
            q = {finger.name: q for finger in fingers}
        self.goals: dict[str, float] = {}
        for name, to in q.items():
            joint = config.joint(name)
            lower, upper = joint.limits
            if finite(to) is None:
                raise UnsafeCommandError(
                    f"{name!r} at {reprlib.repr(to)}", f"a number, {joint.unit}"
                )
            if not lower <= to <= upper:
                goal, low, high = distinct_texts(
                    *(value / joint.per_unit for value in (to, lower, upper))
                )
                unit = joint.unit
                raise UnsafeCommandError(
                    f"{name!r} at {goal} {unit}", f"{low} {unit} to {high} {unit}"
                )
            self.goals[name] = float(to)
        self._names = config.names
        self._joints = [config.joint(name) for name in self.goals]
        self._last = dict.fromkeys(self.goals, math.inf)
        self._since = -math.inf

    def at_rest(self, now: float, cycle: Cycle) -> bool:
        """Return whether the fingers are at rest and all their goals were sent.

        Called once a cycle.

        Args:
            now: Time of the cycle, s.
            cycle: Control cycle of the arm.
        """
        at = cycle.positions()
        sent = dict(zip(self._names, cycle.limits.q, strict=True))
        pairs = ((at, self._last), (sent, self.goals))
        if any(
            j.ticks_between(a[j.name], b[j.name]) > STILL_TICKS
            for a, b in pairs
            for j in self._joints
        ):
            self._last = at
            self._since = now
        return now - self._since >= REST

    def report(self, bus: ServoBus, cycle: Cycle) -> tuple[Grip, ...]:
        """Return how every finger came to rest."""
        grips = []
        at = cycle.positions()
        for joint in self._joints:
            goal = self.goals[joint.name]
            q = at[joint.name]
            held = joint.ticks_between(q, goal) > HELD_TICKS
            grips.append(Grip(joint.name, goal, q, held, _current(bus, joint)))
        return tuple(grips)


def _current(bus: ServoBus, joint: Joint) -> float | None:
    """Return the motor current in mA; None if the servo does not measure it."""
    table = joint.servo.table
    if "present_current" not in table:
        return None
    try:
        counts = bus.read(joint.servo.id, table["present_current"]).data
    except HardwareError:
        return None  # the next cycle reports the error
    return None if counts is None else abs(counts) * table.current_unit
