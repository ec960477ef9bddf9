"""What an arm does with joints that are no part of its q: a gripper's, held until they are told otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robot_ik.errors import HardwareError, UnsafeCommandError
from robot_ik.hardware.arm_base import MOVABLE, ArmBase
from robot_ik.hardware.config import JointMap
from robot_ik.hardware.config_check import current_unit
from robot_ik.hardware.currents import set_currents
from robot_ik.hardware.state import ArmState

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


class Gripping(ArmBase):
    """An arm with joints aside."""

    def positions(self) -> dict[str, float]:
        """Joint -> last measured rad (m of a slide), those aside too; NaN before the first sample."""
        with self._lock:
            names = self.config.whole.names
            return dict(zip(names, self._cycle.samples.q.tolist(), strict=True))

    def grip(
        self, q: float | Mapping[str, float], *, current: float | None = None, timeout: float | None = None
    ) -> tuple[Grip, ...]:
        """Moves the fingers until they are there or something stops them; the other joints are held.

        Fingers in current-based position mode press on from here, no harder than ``current``, whatever the
        arm does meanwhile; others push with all they have, and what they cannot close on is an overload.

        Args:
            q: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> m.
            current: mA, at most the arm file's ``current_ma``; None: as it was.
            timeout: s; by default what the caps ask for and 2 s.

        Raises:
            UnknownJointError, UnsafeCommandError: No gripper, no such joint or current; nothing was sent.
            ArmStateError, MotorFaultError, bus errors: As ``send``.
        """
        with self._lock:
            self._require("grip", *MOVABLE)
            goals = self._fingers(q)
            if current is not None:
                set_currents(self.bus, self.config, dict.fromkeys(goals, current))
            self._streaming = False
            self._go(goals, timeout, self._come_to_rest(goals))
            self.state = ArmState.ENABLED
            return tuple(self._report(self.config.joint(name), to) for name, to in goals.items())

    def _fingers(self, q: float | Mapping[str, float]) -> dict[str, float]:
        """Joint -> where it is sent, within its range."""
        if not isinstance(q, Mapping):
            fingers = self.config.group(GRIPPER)
            if not fingers:
                raise UnsafeCommandError(
                    f"a grip by {self.config.name!r}", "an arm file with joints of the group gripper"
                )
            q = {finger.name: q for finger in fingers}
        goals = {}
        for name, to in q.items():
            lower, upper = self.config.joint(name).limits
            if not lower <= to <= upper:
                joint = self.config.joint(name)
                raise UnsafeCommandError(
                    f"{name!r} at {joint.text(to)}", f"{joint.text(lower)} to {joint.text(upper)}"
                )
            goals[name] = float(to)
        return goals

    def _come_to_rest(self, goals: Mapping[str, float]) -> Callable[[], bool]:
        """Asked once a cycle: whether the fingers stand, their goals having come to where they were sent."""
        joints = [self.config.joint(name) for name in goals]
        last, since = dict.fromkeys(goals, math.inf), self.clock.now()

        def at_rest() -> bool:
            nonlocal last, since
            now, at = self.clock.now(), self.positions()
            sent = dict(zip(self.config.whole.names, self._cycle.limits.q, strict=True))
            moving = any(not j.ticks_between(at[j.name], last[j.name]) <= STILL_TICKS for j in joints)
            if moving or any(j.ticks_between(sent[j.name], goals[j.name]) > STILL_TICKS for j in joints):
                last, since = at, now
            return now - since >= REST

        return at_rest

    def _report(self, joint: JointMap, asked: float) -> Grip:
        q = self.positions()[joint.name]
        return Grip(joint.name, asked, q, joint.ticks_between(q, asked) > HELD_TICKS, self._current(joint))

    def _current(self, joint: JointMap) -> float | None:
        if "present_current" not in joint.table:
            return None
        try:
            counts = self.bus.read(joint.id, joint.table["present_current"]).data
        except HardwareError:
            return None  # the next cycle says what is wrong
        return None if counts is None else abs(counts) * current_unit(joint.table)
