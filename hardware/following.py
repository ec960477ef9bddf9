"""Whether the shafts follow their goals while a program streams commands.

A servo without the force for its load lets the joint fall and reports nothing: it has torque, its
goal is right and no error is latched.  Only the distance between goal and shaft shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from robot_ik.errors import MotorFaultError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import family_of
from robot_ik.hardware.servo import GRIPPER, Drive

BEHIND_TICKS = 160
"""Ticks (14 degrees of the servo) up to which a shaft may be behind its goal, whatever its gain."""

GROWTH_TICKS = 32
"""Ticks by which the distance must also have grown.

If a hand or a wall keeps the joint at a constant distance, the servo's own overload protection
decides, as for an arm that is held.
"""

SUSTAINED = 0.5
"""Seconds for which the shaft must be behind. A knock or a lost cycle is shorter."""


@dataclass
class _Behind:
    """A servo that is behind: since when (s), the distance then and the largest since (ticks)."""

    since: float
    first: int
    largest: int


class Following:
    """The distance between goals and shafts of an arm, from command to command.

    Joints that press on something by design are left out: those of a gripper, and all joints in
    current-based position mode.

    Args:
        config: The arm file.
        longest_tick: Longest time that one command moves a goal, s. The goal is ahead by that
            much just after it was sent.
        pause: Time without a command after which the distances are forgotten, s, because the arm
            was held meanwhile.
    """

    def __init__(self, config: ArmConfig, *, longest_tick: float, pause: float) -> None:
        self._pause = pause
        self._allowed = [
            (drive, _allowed(drive, longest_tick))
            for drive in config.drives
            if drive.joint.group != GRIPPER and not drive.servo.presses
        ]
        self._behind: dict[int, _Behind] = {}
        self._last = -math.inf

    def check(self, goals: Mapping[int, int], shafts: Mapping[int, int], now: float) -> None:
        """Raise if a joint falls ever further behind. Called after each command.

        Args:
            goals: Servo id -> ticks.
            shafts: The same of the last samples.
            now: Time of the samples, s.

        Raises:
            MotorFaultError: A joint does not follow.
        """
        if now - self._last > self._pause:
            self._behind.clear()
        self._last = now
        for drive, allowed in self._allowed:
            id = drive.id
            distance = abs(goals[id] - shafts.get(id, goals[id]))
            if distance <= allowed:
                self._behind.pop(id, None)
                continue
            behind = self._behind.get(id)
            if behind is None or distance < behind.largest - GROWTH_TICKS:  # it comes back
                behind = self._behind[id] = _Behind(now, distance, distance)
            behind.largest = max(behind.largest, distance)
            if now - behind.since >= SUSTAINED and distance >= behind.first + GROWTH_TICKS:
                raise _not_following(drive, goals[id], shafts[id])


def _not_following(drive: Drive, goal: int, shaft: int) -> MotorFaultError:
    behind = drive.joint.text(abs(drive.value(goal) - drive.value(shaft)), 0)
    return MotorFaultError(
        drive.name,
        ("not_following",),
        hint=f"{drive.name} does not follow: {behind} behind; all joints hold. Check for an "
        "obstacle, a heavy load, a weak supply or a low Goal PWM. Then run "
        "robot-ik servo reset-fault, or call Arm.reset_fault()",
    )


def _allowed(drive: Drive, longest_tick: float) -> float:
    """Return how far a healthy servo may be behind: load, step and profile lag, in ticks."""
    joint, servo = drive
    gain = servo.gains.position_p or servo.table["position_p_gain"].initial
    load = family_of(servo.table.family).load_lag(gain or 0)
    speed = joint.velocity * joint.ticks_per_unit
    lag = longest_tick * speed
    if joint.profile_acceleration is not None:
        lag += speed * joint.velocity / (2.0 * joint.profile_acceleration)
    return max(BEHIND_TICKS, load) + lag
