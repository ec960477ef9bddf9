"""What an arm does with joints that are no part of its q: a gripper's, held until they are told otherwise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from robot_ik.errors import HardwareError, UnsafeCommandError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.config_check import current_unit
from robot_ik.hardware.cycle import Cycle

GRIPPER = "gripper"
"""Group of the joints that grip."""

REST = 0.15
"""s in which a finger that has not moved by ``STILL_TICKS`` stands: at its goal, or at something."""
STILL_TICKS = 1.5
HELD_TICKS = 6.0
"""Servo ticks from its goal at which a finger that stands is held by something."""


@dataclass(frozen=True)
class Grip:
    """How a joint of a gripper came to rest.

    Attributes:
        joint: Its name.
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

    Args:
        config: The arm.
        q: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> m.

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
            if not lower <= to <= upper:
                raise UnsafeCommandError(
                    f"{name!r} at {joint.text(to)}", f"{joint.text(lower)} to {joint.text(upper)}"
                )
            self.goals[name] = float(to)
        self._config = config
        self._names = config.whole.names
        self._still = {name: STILL_TICKS * config.joint(name).resolution for name in self.goals}
        self._last = dict.fromkeys(self.goals, math.inf)
        self._since = -math.inf

    def at_rest(self, now: float, cycle: Cycle) -> bool:
        """Asked once a cycle: whether the fingers stand, their goals having come to where they were sent."""
        at = dict(zip(self._names, cycle.samples.q.tolist(), strict=True))
        sent = dict(zip(self._names, cycle.limits.q, strict=True))
        moving = any(abs(at[name] - self._last[name]) > self._still[name] for name in self.goals)
        if moving or any(abs(sent[name] - to) > self._still[name] for name, to in self.goals.items()):
            self._last, self._since = at, now
        return now - self._since >= REST

    def report(self, bus: ServoBus, cycle: Cycle) -> tuple[Grip, ...]:
        """How each of them came to rest."""
        at = dict(zip(self._names, cycle.samples.q.tolist(), strict=True))
        joints = [self._config.joint(name) for name in self.goals]
        return tuple(
            Grip(
                joint.name,
                asked,
                at[joint.name],
                abs(at[joint.name] - asked) > HELD_TICKS * joint.resolution,
                _current(bus, joint),
            )
            for joint, asked in zip(joints, self.goals.values(), strict=True)
        )


def _current(bus: ServoBus, joint: JointMap) -> float | None:
    if "present_current" not in joint.table:
        return None
    try:
        counts = bus.read(joint.id, joint.table["present_current"]).data
    except HardwareError:
        return None  # the next cycle says what is wrong
    return None if counts is None else abs(counts) * current_unit(joint.table)
