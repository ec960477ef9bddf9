"""What an arm does with joints that are no part of its q: a gripper's, held until they get another goal."""

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
"""s in which a finger that has not moved by ``STILL_TICKS`` stands: at its goal, or at something."""
STILL_TICKS = 1.5
HELD_TICKS = 6.0
"""Servo ticks from its goal at which a finger that stands is held by something."""


@dataclass(frozen=True)
class Grip:
    """How a joint of a gripper came to rest.

    Attributes:
        asked, q: Where it was sent and where it stands, m (rad of a hinge).
        held: Something keeps it from where it was sent.
        current: How hard the motor presses, mA; None where the servo does not say.
    """

    joint: str
    asked: float
    q: float
    held: bool
    current: float | None


class Fingers:
    """Joints on their way to a grip.

    ``q``: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> m.

    Attributes:
        goals: Joint -> where it is sent, within its range.

    Raises:
        UnknownJointError, UnsafeCommandError: No gripper, no such joint, or outside its range.
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
                raise UnsafeCommandError(f"{name!r} at {reprlib.repr(to)}", f"a number, {joint.unit}")
            if not lower <= to <= upper:
                asked, low, high = distinct_texts(*(value / joint.per_unit for value in (to, lower, upper)))
                unit = joint.unit
                raise UnsafeCommandError(f"{name!r} at {asked} {unit}", f"{low} {unit} to {high} {unit}")
            self.goals[name] = float(to)
        self._names = config.names
        self._joints = [config.joint(name) for name in self.goals]
        self._last = dict.fromkeys(self.goals, math.inf)
        self._since = -math.inf

    def at_rest(self, now: float, cycle: Cycle) -> bool:
        """Asked once a cycle: whether the fingers stand, their goals having come to where they were sent."""
        at, sent = cycle.positions(), dict(zip(self._names, cycle.limits.q, strict=True))
        pairs = ((at, self._last), (sent, self.goals))
        if any(j.ticks_between(a[j.name], b[j.name]) > STILL_TICKS for a, b in pairs for j in self._joints):
            self._last, self._since = at, now
        return now - self._since >= REST

    def report(self, bus: ServoBus, cycle: Cycle) -> tuple[Grip, ...]:
        grips, at = [], cycle.positions()
        for joint in self._joints:
            asked, q = self.goals[joint.name], at[joint.name]
            held = joint.ticks_between(q, asked) > HELD_TICKS
            grips.append(Grip(joint.name, asked, q, held, _current(bus, joint)))
        return tuple(grips)


def _current(bus: ServoBus, joint: Joint) -> float | None:
    table = joint.servo.table
    if "present_current" not in table:
        return None
    try:
        counts = bus.read(joint.servo.id, table["present_current"]).data
    except HardwareError:
        return None  # the next cycle says what is wrong
    return None if counts is None else abs(counts) * table.current_unit
