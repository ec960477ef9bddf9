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
from robot_ik.hardware.control_table import OperatingMode
from robot_ik.hardware.joint_map import GRIPPER, JointMap

BEHIND_TICKS = 160
"""Ticks (14 degrees of the servo) up to which a shaft may be behind its goal, whatever its gain."""

FULL_EFFORT = 128 * 885
"""Ticks behind times Position P Gain at which a servo gives all its PWM.

The gain is the register over 128 (ROBOTIS e-manual, X series, Position PID Gain). A load keeps the
shaft behind by a part of that distance. A shaft that is further behind is overpowered.
"""

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
            (servo, _allowed(servo, longest_tick))
            for servo in config.servos
            if servo.group != GRIPPER and servo.mode != OperatingMode.CURRENT_BASED_POSITION
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
        for servo, allowed in self._allowed:
            id = servo.id
            distance = abs(goals[id] - shafts.get(id, goals[id]))
            if distance <= allowed:
                self._behind.pop(id, None)
                continue
            behind = self._behind.get(id)
            if behind is None or distance < behind.largest - GROWTH_TICKS:  # it comes back
                behind = self._behind[id] = _Behind(now, distance, distance)
            behind.largest = max(behind.largest, distance)
            if now - behind.since >= SUSTAINED and distance >= behind.first + GROWTH_TICKS:
                raise _not_following(servo, goals[id], shafts[id])


def _not_following(servo: JointMap, goal: int, shaft: int) -> MotorFaultError:
    behind = servo.text(abs(servo.to_radians(goal) - servo.to_radians(shaft)), 0)
    return MotorFaultError(
        servo.name,
        ("not_following",),
        hint=f"{servo.name} does not follow: {behind} behind; all joints hold. Check for an "
        "obstacle, a heavy load, a weak supply or a low Goal PWM. Then run "
        "robot-ik servo reset-fault, or call Arm.reset_fault()",
    )


def _allowed(servo: JointMap, longest_tick: float) -> float:
    """Return how far a healthy servo may be behind: load, step and profile lag, in ticks."""
    gain = servo.gains.position_p or servo.table["position_p_gain"].initial
    load = FULL_EFFORT / gain if gain else 0.0
    speed = servo.velocity * servo.ticks_per_unit
    lag = longest_tick * speed
    if servo.profile_acceleration is not None:
        lag += speed * servo.velocity / (2.0 * servo.profile_acceleration)
    return max(BEHIND_TICKS, load) + lag
