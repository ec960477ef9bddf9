"""Motions that an arm repeats: recordings, and straight paths that are checked for collisions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from robot_ik.errors import HardwareError
from robot_ik.execution import execute
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.servo import Joint
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array, JointSink
from robot_ik.workcell.arm_guard import ArmGuard
from robot_ik.workcell.guided_motion import APPROACH, approach

ARRIVED = math.radians(2.0)
"""rad between the end of a recording and the arm up to which it counts as replayed."""

START_SETTLE = 0.2
"""s that the arm has to come to rest at the start of a recording."""

END_SETTLE = 0.4
"""s that the arm has to come to rest at the end."""

Busy = Callable[[str, float], AbstractContextManager[None]]
"""Shows a phase with its duration, s, for the time of a ``with`` block."""


@dataclass(frozen=True)
class ReplayResult:
    """Errors of a replay. The travel of a slide is compared as the rotation of its pinion.

    Attributes:
        lagging_joint: Joint with the largest tracking error.
        tracking_error: That error, rad (slides: m).
        farthest_joint: Joint that ended farthest from its goal.
        final_error: That distance, rad (slides: m).
    """

    lagging_joint: Joint
    tracking_error: float
    farthest_joint: Joint
    final_error: float

    def require_arrived(self) -> None:
        """Check that every joint arrived.

        Raises:
            HardwareError: A joint did not get to the end of the recording.
        """
        if self.final_error > ARRIVED * self.farthest_joint.lever:
            error = self.farthest_joint.text(self.final_error)
            raise HardwareError(
                f"{self.farthest_joint.name!r} ended {error} from its goal",
                hint="check whether an obstacle blocks it, or reduce its load",
            )


def replay(
    arm: Arm,
    motion: Trajectory,
    sinks: Sequence[JointSink],
    busy: Busy,
    guard: ArmGuard | None = None,
) -> ReplayResult:
    """Move slowly to the start of a motion and replay it. Torque is switched on.

    Args:
        arm: Connected.
        motion: A motion of ``load_playable``.
        sinks: Get every command too.
        busy: Shows the phases.
        guard: Refuses a motion that would touch, before torque comes on.

    Raises:
        HardwareError: A servo failed.
        MotionBlockedError: The motion, or the path to its start, would touch.
    """
    part = ArmPart(arm, motion.joints)
    if guard is not None:
        _checked_approach(arm, part, motion.q[0], guard)
        guard.checked(motion, arm.positions())
    arm.enable()
    targets: list[JointSink] = [part, *sinks]
    path = _checked_approach(arm, part, motion.q[0], guard)
    with busy("moving to the start", path.duration):
        execute(path, targets, source=part, clock=arm.clock, settle=START_SETTLE)
    # A recorder needs increasing times, so the replay begins one cycle later.
    arm.clock.sleep_until(arm.clock.now() + 1.0 / arm.config.rate_hz)
    with busy("replaying", motion.duration):
        execution = execute(motion, targets, source=part, clock=arm.clock, settle=END_SETTLE)
    if execution.final_error is None or execution.tracking_error is None:
        raise RuntimeError("the motion was not measured")
    joints = part.config.joints
    # An object may hold fingers that press.
    free = [not joint.servo.presses for joint in joints]
    share = np.array(free) / [joint.lever for joint in joints]
    error = np.abs(execution.final_error)
    lagging = int(np.argmax(share * execution.tracking_error))
    farthest = int(np.argmax(share * error))
    final_error = float(free[farthest] * error[farthest])
    tracking_error = float(execution.tracking_error[lagging])
    return ReplayResult(joints[lagging], tracking_error, joints[farthest], final_error)


def move_straight(arm: Arm, goal: Mapping[str, float], guard: ArmGuard, busy: Busy) -> None:
    """Move all joints together on a straight path at the caps. Torque is switched on.

    Args:
        arm: Connected.
        goal: Joint -> rad (slides: m). The other joints stay.
        guard: Refuses a path that would touch, before torque comes on.
        busy: Shows the phase.

    Raises:
        HardwareError: A servo failed.
        MotionBlockedError: The path would touch.
    """
    part = ArmPart(arm, list(goal))
    end = np.array(list(goal.values()))
    _checked_approach(arm, part, end, guard, share=1.0)
    arm.enable()
    path = _checked_approach(arm, part, end, guard, share=1.0)
    with busy("moving", path.duration):
        execute(path, [part], source=part, clock=arm.clock)


def _checked_approach(
    arm: Arm, part: ArmPart, end: Array, guard: ArmGuard | None, share: float = APPROACH
) -> Trajectory:
    """Return the straight motion of a part of an arm to ``end`` (n,), if it is allowed."""
    path = approach(part.read().q, end, part.config, share)
    return path if guard is None else guard.checked(path, arm.positions())
