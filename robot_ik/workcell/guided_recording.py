"""Recordings of an arm that a person guides by hand, and motions that an arm can repeat."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robot_ik.errors import ConfigError
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_registers import shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import Joint
from robot_ik.motion.joint_table import Moment, table_text
from robot_ik.motion.trajectory import Trajectory
from robot_ik.workcell.guided_motion import playable
from robot_ik.workcell.hand_calibration import require_limp

ALLOWED_OUTSIDE = math.radians(1.0)
"""rad by which a recording may exceed a limit, because stops are soft.

It is replayed at the limit.
"""


class GuidedRecording:
    """Records the positions of an arm that a person guides. The samples are kept after Ctrl-C.

    Raises:
        ArmStateError: A servo has torque.
    """

    def __init__(self, arm: Arm) -> None:
        require_limp(arm)
        self._arm = arm
        self._present = shared_register(arm.config, "present_position")
        self._begin = arm.clock.now()
        self._times: list[float] = []
        self._poses: list[list[float]] = []

    def sample(self) -> None:
        """Read all joints. A sample in which a joint is missing is left out."""
        config = self._arm.config
        ids = [joint.servo.id for joint in config.joints]
        replies = self._arm.bus.sync_read(ids, self._present)
        ticks = [replies[id].data for id in ids]
        time = self._arm.clock.now() - self._begin
        if None not in ticks and (not self._times or time > self._times[-1]):
            pairs = zip(config.joints, ticks, strict=True)
            self._poses.append([joint.value(t) for joint, t in pairs if t is not None])
            self._times.append(time)

    def motion(self) -> Trajectory | None:
        """Return the samples, from time 0 on. None: no position could be read."""
        if not self._times:
            return None
        times = np.array(self._times) - self._times[0]
        return Trajectory(times, self._poses, self._arm.config.names)


def outside(motion: Trajectory, config: ArmConfig) -> list[tuple[Joint, float]]:
    """Return joints that leave their limits by more than ``ALLOWED_OUTSIDE``.

    Returns:
        Joint and the largest distance from its limits, rad (slides: m).
    """
    beyond = np.maximum(config.lower - motion.q, motion.q - config.upper).max(axis=0)
    pairs = zip(config.joints, beyond.tolist(), strict=True)
    return [(joint, excess) for joint, excess in pairs if excess > ALLOWED_OUTSIDE * joint.lever]


def measured_table(motion: Trajectory) -> str:
    """Return the CSV table of positions that were measured while a person guided the arm."""
    samples = zip(motion.times.tolist(), motion.q, strict=True)
    return table_text(motion.joints, (Moment(now, measured=q) for now, q in samples))


def load_motion(path: Path, joints: Sequence[str], arm_joints: Sequence[str] = ()) -> Trajectory:
    """Load a motion in the order of ``joints``, as ``Trajectory.load_csv`` reads it.

    Args:
        path: CSV file.
        joints: Joints of the motion.
        arm_joints: The joints without those of the gripper. The file may have only these.

    Raises:
        ConfigError: The file cannot be read, or has other joints.
    """
    motion = Trajectory.load_csv(path)
    if sorted(motion.joints) == sorted(arm_joints):
        joints = arm_joints
    if sorted(motion.joints) != sorted(joints):
        raise ConfigError(
            f"the motion has the joints {', '.join(motion.joints)}",
            file=path,
            allowed=", ".join(joints),
            hint="only joints of the gripper may be missing; "
            "ar --motion draws any motion of the robot",
        )
    order = [motion.joints.index(name) for name in joints]
    return Trajectory(motion.times, motion.q[:, order], joints)


def load_playable(path: Path, arm: ArmConfig, speed: float) -> tuple[ArmConfig, Trajectory, float]:
    """Load a recording and prepare it for an arm.

    A recording without the gripper's joints leaves the gripper at its present value.

    Args:
        path: CSV file.
        arm: Arm file.
        speed: Share of the recorded speed, above 0 and at most 1.

    Returns:
        The arm file of the recorded joints, the motion within limits and caps, and its duration
        over that of the recording.

    Raises:
        ConfigError: The file cannot be read, has other joints, or leaves the limits.
    """
    motion = load_motion(path, arm.names, arm.chain.names)
    config = arm.only(motion.joints)
    for joint, excess in outside(motion, config):
        low, high = joint.limits
        raise ConfigError(
            f"the motion leaves the limits by {joint.text(excess)}; nothing was moved",
            file=path,
            key=joint.name,
            allowed=f"{low / joint.per_unit:.1f} to {joint.text(high)}",
        )
    return config, *playable(motion, config, speed)
