"""An arm without torque that a person guides: a hand shows ranges, zeros and directions, or a motion.

A motion is a file, which the arm repeats within its limits.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from robot_ik.errors import ArmStateError, ConfigError, HardwareError
from robot_ik.execution import execute
from robot_ik.hardware.arm import Arm
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.arm_registers import read_all, shared_register
from robot_ik.hardware.calibration import (
    ASKED_WIGGLE,
    STILL_TICKS,
    OperatorError,
    Sweep,
    calibrated,
    check_calibration,
    check_sweep,
    counting_directions,
    measured_calibration,
)
from robot_ik.hardware.calibration_file import Calibration, calibration_beside
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import save_lerobot
from robot_ik.hardware.servo import Joint, Sign
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array, JointSink
from robot_ik.workcell.arm_guard import ArmGuard
from robot_ik.workcell.guided_motion import APPROACH, approach, playable

STILL_SAMPLES = 10
"""At 20 Hz: a hand that only passes through the pose is noticed."""

Found = TypeVar("Found")

Limits = Mapping[str, tuple[float, float]]
"""Joint -> limits, rad (m of a slide)."""


class Person(Protocol):
    """Somebody who moves the arm as asked."""

    def step(self, text: str, sample: Callable[[], object]) -> None:
        """Asks for a step, calls ``sample`` while it is done, and once more at its end."""

    def note(self, text: str) -> None:
        """Shows what a step has given."""

    def again(self, error: OperatorError) -> bool:
        """Shows why a step was not done as asked; whether it is to be asked for once more."""


def require_limp(arm: Arm) -> None:
    """Raises ``ArmStateError`` where torque is on: the arm cannot be moved by hand."""
    torque = read_all(arm.bus, arm.config, "torque_enable")
    if on := [drive.name for drive in arm.config.drives if torque.get(drive.id)]:
        raise ArmStateError(
            f"torque of {', '.join(on)} is on: the arm cannot be moved by hand",
            hint="support the arm, then: robot-ik servo torque off",
        )


def calibrate_by_hand(arm: Arm, person: Person, pose: Mapping[str, float], limits: Limits) -> Calibration:
    """Ranges, zeros and directions of an arm without torque, as a person shows them.

    The arm is connected, torque off.  ``pose``: joint -> rad (m of a slide) at which the zeros are taken;
    ``limits``: joint -> limits of the model, rad (m).

    Raises:
        OperatorError: A step was not done as asked, and is not to be repeated.
        HardwareError: A servo did not answer, or what it shows cannot be used.
    """
    config, bus = arm.config, arm.bus
    present = shared_register(config, "present_position")
    if config.family.capabilities.half_turn_homing:
        text = "0. middle: put every joint into the middle of its range and hold it"
        person.step(text, lambda: None)
        config.family.home_half_turn(bus, config)
    sweep = Sweep(config, read_all(bus, config, "present_position"))

    def sample() -> None:
        sweep.take({id: status.data for id, status in bus.sync_read(config.servo_ids, present).items()})

    swept = functools.partial(check_sweep, config, sweep)
    _step(person, "1. sweep: move every joint from one stop to the other", sample, swept)
    for drive in config.drives:
        ticks = f"ticks {sweep.low[drive.id]} to {sweep.high[drive.id]}"
        travel = drive.joint.text(sweep.travel(drive), 0)
        person.note(f"   {drive.name}: id {drive.id}, {ticks}, {travel}")
    where = ", ".join(f"{name} {config.joint(name).text(q)}" for name, q in pose.items())
    text = f"2. zero: put the arm into the pose {where} and hold it"
    zero = _step(person, text, sample, lambda: _held(arm, sweep, sample))
    swept()  # that pose may lie beyond what was swept
    directions: dict[int, Sign] = {}
    for k, joint in enumerate(config.joints, 1):
        about = joint.text(ASKED_WIGGLE * joint.lever, 0)
        text = f"3.{k} direction: move {joint.name} alone by about {about} in its positive direction"
        judge = functools.partial(counting_directions, config, joint, dict(sweep.now), sweep.now)
        directions |= _step(person, text, sample, judge)
    return measured_calibration(bus, config, sweep, zero, pose, directions, limits)


def save_calibrated(arm: Arm, found: Calibration, out: Path, lerobot: Path | None = None) -> ArmConfig:
    """The calibrated arm, in the arm file ``out``; what was measured goes into a file beside it.

    It is compared with the servos of the connected arm before anything is written, and the arm file is
    written last: it is the one that is used.  ``lerobot``: where LeRobot's calibration goes.

    Raises:
        HardwareError: Calibration and servos do not agree.
        OutputError: A file cannot be written.
    """
    found = replace(found, file=calibration_beside(out))
    config = calibrated(arm.config, found)
    check_calibration(arm.bus, config, found)
    if lerobot is not None:
        save_lerobot(lerobot, found)
    found.save(calibration_beside(out))
    config.save(out)
    return config


def _step(person: Person, text: str, sample: Callable[[], None], judge: Callable[[], Found]) -> Found:
    """What a step shows; it is repeated until it was done as asked, where the person can do that."""
    while True:
        person.step(text, sample)
        try:
            return judge()
        except OperatorError as error:
            if not person.again(error):
                raise


def _held(arm: Arm, sweep: Sweep, sample: Callable[[], None]) -> dict[int, int]:
    """Servo id -> ticks of an arm that is held still, which is checked."""
    zero = dict(sweep.now)
    for _ in range(STILL_SAMPLES):
        arm.clock.sleep_until(arm.clock.now() + 0.05)
        sample()
        for drive in arm.config.drives:
            if abs(sweep.now[drive.id] - zero[drive.id]) > STILL_TICKS:
                raise OperatorError(
                    f"joint {drive.name!r} moved while its zero was taken", hint="hold it still"
                )
    return zero


# ------------------------------------------------------------------------------------------
# A hand shows a motion, and the arm repeats it.


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
        ids = [joint.servo.id for joint in config.joints]
        replies = self._arm.bus.sync_read(ids, self._present)
        ticks = [replies[id].data for id in ids]
        time = self._arm.clock.now() - self._begin
        if None not in ticks and (not self._times or time > self._times[-1]):
            pairs = zip(config.joints, ticks, strict=True)
            self._poses.append([joint.value(t) for joint, t in pairs if t is not None])
            self._times.append(time)

    def motion(self) -> Trajectory | None:
        """What was shown, from time 0 on; None where no position could be read."""
        if not self._times:
            return None
        return Trajectory(np.array(self._times) - self._times[0], self._poses, self._arm.config.names)


def outside(motion: Trajectory, config: ArmConfig) -> list[tuple[Joint, float]]:
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
    """The joints that a recording moves, the motion that the arm can repeat, and how much longer it takes.

    A recording without the gripper's joints leaves the gripper where it is.  ``speed`` is a share of the
    recorded one, above 0 and up to 1.

    Raises:
        ConfigError: It cannot be read, is of other joints, or leaves the limits.
    """
    motion = load_motion(path, arm.names, arm.chain.names)
    config = arm.only(motion.joints)
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

    late: Joint
    tracking_error: float
    worst: Joint
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
    guard: ArmGuard | None = None,
) -> PlayReport:
    """Goes slowly to where a motion of ``load_playable`` begins, then plays it; torque is switched on.

    ``sinks`` get every command as well; ``busy`` shows what goes on, and for how many seconds, while inside.
    ``guard`` refuses a motion that would touch before torque comes on.

    Raises:
        HardwareError: A servo failed.
        MotionBlockedError: The motion, or the way to its start, would touch.
    """
    part = ArmPart(arm, motion.joints)
    if guard is not None:
        _checked_approach(arm, part, motion.q[0], guard)
        guard.checked(motion, arm.positions())
    arm.enable()
    targets: list[JointSink] = [part, *sinks]
    first = _checked_approach(arm, part, motion.q[0], guard)
    with busy("going to where it begins", first.duration):
        execute(first, targets, source=part, clock=arm.clock, settle=0.2)
    arm.clock.sleep_until(arm.clock.now() + 1.0 / arm.config.rate_hz)  # a recording has each time once
    with busy("playing", motion.duration):
        done = execute(motion, targets, source=part, clock=arm.clock, settle=0.4)
    if done.final_error is None or done.tracking_error is None:
        raise RuntimeError("the motion was not measured")
    joints = part.config.joints
    # Fingers that press may be held by something.
    free = [not joint.servo.presses for joint in joints]
    share = np.array(free) / [joint.lever for joint in joints]
    error = np.abs(done.final_error)
    late, worst = int(np.argmax(share * done.tracking_error)), int(np.argmax(share * error))
    final_error = float(free[worst] * error[worst])
    return PlayReport(joints[late], float(done.tracking_error[late]), joints[worst], final_error)


def play_straight(
    arm: Arm,
    goal: Mapping[str, float],
    guard: ArmGuard,
    busy: Callable[[str, float], AbstractContextManager[None]],
) -> None:
    """Move all joints together on a straight path at the caps. Torque is switched on.

    Args:
        arm: Connected.
        goal: Joint -> rad (m of a slide). The other joints stay.
        guard: Refuses a path that would touch before torque comes on.
        busy: Shows what goes on, and for how many seconds.

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
