"""A hand shows a motion, the arm repeats it within its limits; between the two it is a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.execution import execute
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.bus import shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import OperatingMode
from robot_ik.hardware.joint_map import JointMap
from robot_ik.jobs.hand_calibration import require_limp
from robot_ik.motion.trajectory import Trajectory, approach, playable
from robot_ik.ports import JointSink

ALLOWED_OUTSIDE = math.radians(1.0)
"""rad by which a recording may pass a limit, as a soft stop gives; it is played at the limit."""

ARRIVED = math.radians(2.0)
"""rad between the end of a recording and the arm, up to which it counts as played."""


class TaughtMotion:
    """Positions of an arm that a hand guides, sample by sample; what was read stays after Ctrl-C.

    As ``require_limp`` where torque is on.
    """

    def __init__(self, arm: Arm) -> None:
        require_limp(arm)
        self._arm = arm
        self._present = shared_register(arm.config, "present_position")
        self._begin = arm.clock.now()
        self._times: list[float] = []
        self._poses: list[list[float]] = []

    def sample(self) -> None:
        """Reads all joints; a sample in which one is missing is left out."""
        config = self._arm.config
        replies = self._arm.bus.sync_read(config.ids, self._present)
        ticks = [replies[id].data for id in config.ids]
        time = self._arm.clock.now() - self._begin
        if None not in ticks and (not self._times or time > self._times[-1]):
            pairs = zip(config.joints, ticks, strict=True)
            self._poses.append([joint.to_radians(t) for joint, t in pairs if t is not None])
            self._times.append(time)

    def motion(self) -> Trajectory | None:
        """What was shown, from time 0 on; None where no position could be read."""
        if not self._times:
            return None
        return Trajectory(np.array(self._times) - self._times[0], self._poses, self._arm.config.names)


def outside(motion: Trajectory, config: ArmConfig) -> list[tuple[JointMap, float]]:
    """Joints that leave their limits by more than ``ALLOWED_OUTSIDE``, and by how much at most, rad (m)."""
    beyond = np.maximum(config.lower - motion.q, motion.q - config.upper).max(axis=0)
    pairs = zip(config.joints, beyond.tolist(), strict=True)
    return [(joint, excess) for joint, excess in pairs if excess > ALLOWED_OUTSIDE * joint.lever]


def load_motion(path: Path, joints: Sequence[str], some: Sequence[str] = ()) -> Trajectory:
    """A motion in the order of ``joints``, as ``Trajectory.load_csv`` reads it.

    ``some``: it may be of these alone, in their order.

    Raises:
        ConfigError: It cannot be read, its numbers are no motion, or it is of other joints.
    """
    motion = Trajectory.load_csv(path)
    if sorted(motion.joints) == sorted(some):
        joints = some
    if sorted(motion.joints) != sorted(joints):
        raise ConfigError(
            f"it is a motion of {', '.join(motion.joints)}", file=path, allowed=f"of {', '.join(joints)}",
            hint="the gripper's joints may be missing, no others; ar --motion draws any motion of the robot",
        )  # fmt: skip
    order = [motion.joints.index(name) for name in joints]
    return Trajectory(motion.times, motion.q[:, order], joints)


def load_playable(path: Path, arm: ArmConfig, speed: float) -> tuple[ArmConfig, Trajectory, float]:
    """The arm with the joints of a recording, which it can repeat, and how much longer that takes.

    Of ``arm`` all joints are moved, or those of its q where the recording has no others: then it holds its
    gripper where it is.  ``speed`` is a share of the recorded one, above 0 and up to 1.

    Raises:
        ConfigError: It cannot be read, is of other joints, or leaves the limits.
    """
    motion = load_motion(path, arm.whole.names, arm.names)
    config = arm if motion.joints == arm.names else arm.whole
    for joint, excess in outside(motion, config):
        low, high = joint.limits
        raise ConfigError(
            f"it leaves the limits by {joint.text(excess)}; nothing was moved",
            file=path,
            key=joint.name,
            allowed=f"{low / joint.per_unit:.1f} to {joint.text(high)}",
        )
    return config, *playable(motion, config, speed)


@dataclass(frozen=True)
class PlayReport:
    """How a recording was repeated; a slide's travel is compared as its pinion's rotation.

    The joint with the largest tracking error, and the one that ended farthest from where it was sent, with
    both errors, rad (m of a slide).
    """

    late: JointMap
    tracking_error: float
    worst: JointMap
    final_error: float

    def require_arrived(self) -> None:
        """Raises ``HardwareError`` where a joint did not get to the end of the recording."""
        if self.final_error > ARRIVED * self.worst.lever:
            raise HardwareError(
                f"{self.worst.name!r} ended {self.worst.text(self.final_error)} from where it was sent",
                hint="is something in its way, or is it too weak?",
            )


def play_motion(
    arm: Arm,
    motion: Trajectory,
    sinks: Sequence[JointSink],
    busy: Callable[[str, float], AbstractContextManager[None]],
) -> PlayReport:
    """Goes slowly to where a motion of ``load_playable`` begins, then plays it; torque is switched on.

    ``sinks`` get every command as well; ``busy`` shows what goes on, and for how many seconds, while inside.

    Raises:
        HardwareError: A servo failed.
    """
    arm.enable()
    targets: list[JointSink] = [arm, *sinks]
    first = approach(arm.read().q, motion.q[0], arm.config)
    with busy("going to where it begins", first.duration):
        execute(first, targets, source=arm, clock=arm.clock, settle=0.2)
    arm.clock.sleep_until(arm.clock.now() + 1.0 / arm.config.rate_hz)  # a recording has each time once
    with busy("playing", motion.duration):
        done = execute(motion, targets, source=arm, clock=arm.clock, settle=0.4)
    assert done.final_error is not None and done.tracking_error is not None  # there was a source
    joints = arm.config.joints
    # Fingers that press may be held by something.
    free = [joint.mode != OperatingMode.CURRENT_BASED_POSITION for joint in joints]
    share = np.array(free) / [joint.lever for joint in joints]
    error = np.abs(done.final_error)
    late, worst = int(np.argmax(share * done.tracking_error)), int(np.argmax(share * error))
    final_error = float(free[worst] * error[worst])
    return PlayReport(joints[late], float(done.tracking_error[late]), joints[worst], final_error)
