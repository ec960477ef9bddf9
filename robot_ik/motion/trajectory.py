"""``Trajectory``: joint angles over time, and ``joint_move``, the straight move in joint space."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.config import shown
from robot_ik.errors import ConfigError, TrajectoryError, UnsupportedJointError, distinct_texts
from robot_ik.files import write_atomically
from robot_ik.geometry import Array, is_real, numbers
from robot_ik.motion.joint_table import COMMANDED, TIME, csv_text, read_positions
from robot_ik.motion.timing import PROFILES
from robot_ik.robot import Robot, require_robot

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

LIMIT_ROUNDING = 1e-9
"""rad or m. By rounding, a solution at a limit may be this far beyond it."""

MAX_SAMPLES = 10_000_000
"""Largest number of samples of a move: more than a day at 100 Hz."""

COUNT_ROUNDING = 1e-12
"""Relative rounding error of a duration, which must not add a sample."""


def sample_count(duration: float, rate: float) -> int:
    """Return the number of periods at ``rate`` Hz that cover ``duration`` seconds."""
    return math.ceil(duration * rate * (1.0 - COUNT_ROUNDING))


def joint_vector(robot: Robot, q: ArrayLike, what: str) -> Array:
    """Return ``q`` as a new array (nq,).

    Args:
        robot: The robot.
        q: Joint angles (nq,), rad or m.
        what: Name of the vector, for the message.

    Raises:
        TrajectoryError: Wrong length or a number that is not finite. The message names the joint.
        UnsupportedJointError: The robot has ball or free joints.
    """
    require_robot(robot)
    if robot.nq != robot.nv:
        raise UnsupportedJointError(
            f"robot {robot.name!r} has ball or free joints; moves need hinges and slides",
            hint="keep only hinge and slide joints: load_robot(…, joints=[…])",
        )
    vector = numbers(q, f"the {what}", f"{robot.nq} numbers", TrajectoryError)
    if vector.shape != (robot.nq,):
        raise TrajectoryError(
            f"the {what} has shape {vector.shape}; {robot.name!r} has {robot.nq} joints",
            hint=f"give one number each for {', '.join(robot.joints)}",
        )
    finite = np.isfinite(vector)
    if not finite.all():
        k = int(np.argmin(finite))
        raise TrajectoryError(
            f"the {what} has {vector[k]} for joint {robot.joints[k]!r}",
            hint="give finite numbers, rad or m",
        )
    return vector


def motion_limits(
    robot: Robot,
    speed: float,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Return the velocity and acceleration limits (nv,) for planning.

    They are ``speed`` times the lower of the robot's limits and the given limits.

    Raises:
        TrajectoryError: ``speed`` is outside (0, 1], or a limit is missing, zero, infinite or not a
            number.
    """
    if not is_real(speed, math.ulp(0.0), 1.0):
        raise TrajectoryError(
            f"speed is {speed!r}", hint="give a share of the limits: above 0, at most 1"
        )
    return (
        speed * _lower_limits(robot, "velocity_limits", velocity_limits),
        speed * _lower_limits(robot, "acceleration_limits", acceleration_limits),
    )


def _lower_limits(robot: Robot, what: str, caps: ArrayLike | None) -> Array:
    """Return the lower (nv,) of the limits of the robot and of the caller."""
    limits = getattr(robot, what)
    if caps is not None:
        try:
            limits = np.minimum(limits, np.asarray(caps, dtype=float))
        except (TypeError, ValueError, OverflowError) as error:
            problem = f"{what} must be {robot.nv} numbers or one number, not {shown(caps)}"
            raise TrajectoryError(problem) from error
    if limits.shape != (robot.nv,) or not (np.isfinite(limits) & (limits > 0.0)).all():
        raise TrajectoryError(
            f"the {what} of {robot.name!r} are {np.asarray(limits).tolist()}",
            hint="each joint needs one finite limit above zero: [motion] in robot.toml",
        )
    return np.asarray(limits)


def require_positive(what: str, value: float, unit: str) -> None:
    """Raise ``TrajectoryError`` unless a value is finite and above zero."""
    if not is_real(value, math.ulp(0.0)):
        raise TrajectoryError(f"{what} is {value!r} {unit}", hint=f"{what} must be above zero")


def checked_samples(
    what: str, times: ArrayLike, q: ArrayLike, width: int, shortest: float = math.ulp(0.0)
) -> tuple[Array, Array]:
    """Return times and joint angles as new arrays.

    Args:
        what: Name of the samples, for the message.
        times: Seconds (n,), n >= 1.
        q: Joint angles (n, ``width``).
        width: Numbers in a row of ``q``.
        shortest: Shortest allowed time between two samples, s.

    Raises:
        TrajectoryError: Another shape, a number that is not finite, or times that do not increase.
    """
    t = numbers(times, f"times of {what}", error=TrajectoryError)
    rows = numbers(q, f"q of {what}", error=TrajectoryError)
    if t.ndim != 1 or len(t) < 1 or rows.shape != (len(t), width):
        raise TrajectoryError(
            f"{what} got times {t.shape} and q {rows.shape}",
            hint=f"times must be (n,) with n >= 1 and q (n, {width})",
        )
    if not (np.isfinite(t).all() and np.isfinite(rows).all()):
        raise TrajectoryError(f"{what} got a number that is not finite", hint="look for NaN in q")
    too_short = np.diff(t) < shortest
    if too_short.any():
        k = int(np.argmax(too_short))
        raise TrajectoryError(
            f"times must increase, but row {k + 1} at {t[k + 1]:.6g} s follows {t[k]:.6g} s",
            hint="sort the rows and drop rows of equal time",
        )
    return t, rows


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint vectors at increasing times, with straight lines between the samples.

    Straight lines stay inside joint limits and never exceed the largest velocity. A coarse sampling
    has sharp corners, so plan at the rate at which you send.

    Attributes:
        times: Seconds (n,), strictly increasing, n >= 1. Read-only.
        q: Joint angles (n, nq), rad or m for slides. Read-only.
        joints: Names of the nq columns.
        certified: Whether the motion is proven free of collisions, also between the samples.
        clearance: Distance that is proven for the whole motion, m. None if it is not certified.

    Raises:
        TrajectoryError: Shapes do not fit, times do not increase, or a number is not finite.
    """

    times: Array
    q: Array
    joints: tuple[str, ...]
    certified: bool
    clearance: float | None

    def __init__(
        self,
        times: ArrayLike,
        q: ArrayLike,
        joints: Iterable[str],
        *,
        clearance: float | None = None,
    ) -> None:
        given: object = joints
        is_list = isinstance(given, Iterable) and not isinstance(given, str)
        names = tuple(joints) if is_list else (joints,)
        if not all(isinstance(name, str) for name in names):
            hint = 'joints=["joint1", "joint2"]'
            raise TrajectoryError(f"joints are names, not {joints!r}", hint=hint)
        what = f"a trajectory of {len(names)} joints"
        checked_times, checked_q = checked_samples(what, times, q, len(names))
        checked_times.flags.writeable = False
        checked_q.flags.writeable = False
        object.__setattr__(self, "times", checked_times)
        object.__setattr__(self, "q", checked_q)
        object.__setattr__(self, "joints", names)
        object.__setattr__(self, "certified", clearance is not None)
        object.__setattr__(self, "clearance", clearance)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        names = ", ".join(self.joints)
        return f"Trajectory({len(self)} samples, {self.duration:.3f} s, joints {names})"

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.times[-1] - self.times[0])

    def at(self, t: float) -> Array:
        """Return ``q`` (nq,) at ``t`` seconds.

        The result is exact at samples. Before the first and after the last sample it is constant.
        """
        if not is_real(t):
            raise TrajectoryError(f"the time is {t!r}", hint="give a finite time in seconds")
        k = int(np.searchsorted(self.times, t, side="right")) - 1
        if k < 0:
            return np.array(self.q[0])
        if k >= len(self) - 1 or self.times[k] == t:
            return np.array(self.q[k])
        share = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        return np.asarray(self.q[k] * (1.0 - share) + self.q[k + 1] * share)

    def resampled(self, rate: float) -> Trajectory:
        """Return the same motion at ``rate`` Hz from time 0.

        The last sample is kept, so the last gap may be shorter than the others.
        """
        require_positive("rate", rate, "Hz")
        count = sample_count(self.duration, rate)
        times = np.minimum(np.arange(count + 1) / rate, self.duration)
        times[-1] = self.duration
        rows = [self.at(self.times[0] + t) for t in times[:-1]]
        return Trajectory(times, [*rows, self.q[-1]], self.joints)

    @property
    def peak_velocity(self) -> Array:
        """Largest speed (nq,) of each joint between two samples, rad/s or m/s."""
        return np.asarray(np.abs(self._slopes()).max(axis=0, initial=0.0))

    @property
    def peak_acceleration(self) -> Array:
        """Largest acceleration (nq,) of each joint, from rest to rest, rad/s² or m/s²."""
        if len(self) < 2:
            return np.zeros(len(self.joints))
        gaps = np.diff(self.times)
        gap_before = np.concatenate([gaps[:1], gaps])
        gap_after = np.concatenate([gaps, gaps[-1:]])
        rest = np.zeros((1, len(self.joints)))
        change = np.diff(np.concatenate([rest, self._slopes(), rest]), axis=0)
        acceleration = change / (0.5 * (gap_before + gap_after))[:, None]
        return np.asarray(np.abs(acceleration).max(axis=0, initial=0.0))

    def _slopes(self) -> Array:
        return np.asarray(np.diff(self.q, axis=0) / np.diff(self.times)[:, None])

    def save_csv(self, path: Path | str) -> None:
        """Write a row for each sample, in full precision. The positions are commanded ones.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        write_atomically(Path(path), self.csv_text())

    def csv_text(self) -> str:
        """Return the text that ``save_csv`` writes."""
        header = [TIME, *(COMMANDED + joint for joint in self.joints)]
        return csv_text(header, np.column_stack([self.times, self.q]).tolist())

    @classmethod
    def load_csv(cls, path: Path | str, joints: Sequence[str] = ()) -> Trajectory:
        """Read any recording: the commanded positions, or the measured ones if there are no others.

        Args:
            path: The file.
            joints: Names of the joints to read, in this order. Empty for all.

        Raises:
            ConfigError: The file is missing or is not such a table. The message names the line.
        """
        source = Path(path)
        positions = read_positions(source, joints)
        try:
            return cls(positions.times, positions.q, positions.joints)
        except TrajectoryError as error:
            raise ConfigError(str(error), file=source) from error


def joint_move(
    robot: Robot,
    start: ArrayLike,
    goal_q: ArrayLike,
    *,
    speed: float = 1.0,
    rate: float = 100.0,
    profile: str = "trapezoid",
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    collisions: CollisionAvoidance | None = None,
) -> Trajectory:
    """Return a straight line in joint space on which all joints start and stop together.

    The slowest joint decides the time. ``start`` may be outside the limits.

    Args:
        robot: The robot, whose limits count.
        start: Joint angles (nq,), rad or m for slides.
        goal_q: Joint angles (nq,), rad or m for slides.
        speed: Share of the velocity and acceleration limits to use, above 0 and up to 1.
        rate: Samples a second, Hz. The duration is rounded up to whole periods.
        profile: "trapezoid" (time-optimal) or "quintic" (continuous acceleration).
        velocity_limits: Further limits (nq,), such as those of an arm file, rad/s or m/s. The lower
            limit counts.
        acceleration_limits: Further limits (nq,), rad/s² or m/s².
        collisions: Condition that the whole motion must keep. ``trajectory.certified`` is
            True if that is proven.

    Raises:
        TrajectoryError: Wrong length, a number that is not finite, or a goal outside the limits.
        MotionBlockedError: Parts would touch. The error has the time, the pair and the depth.
        UnsupportedJointError: The robot has ball or free joints.
    """
    first = joint_vector(robot, start, "start")
    last = joint_vector(robot, goal_q, "goal")
    require_inside(robot, last)
    limits = motion_limits(robot, speed, velocity_limits, acceleration_limits)
    require_positive("rate", rate, "Hz")
    if str(profile) not in PROFILES:
        raise TrajectoryError(f"unknown profile {profile!r}", hint=f"known: {', '.join(PROFILES)}")
    distance = np.abs(last - first)
    moving = distance > 0.0
    if not moving.any():
        return certified_trajectory(Trajectory([0.0], [first], robot.joints), robot, collisions)
    with np.errstate(over="ignore"):  # for a distance of 1e-300 rad the bounds are infinite
        velocity, acceleration = (np.min(side[moving] / distance[moving]) for side in limits)
    if not np.isfinite(acceleration):
        still = Trajectory([0.0, 1.0 / rate], [first, last], robot.joints)
        return certified_trajectory(still, robot, collisions)
    plan = PROFILES[profile](float(velocity), float(acceleration))
    if not plan.duration * rate <= MAX_SAMPLES:
        samples = plan.duration * rate
        raise TrajectoryError(
            f"the move takes {plan.duration:.3g} s, which are {samples:.3g} samples at {rate:g} Hz",
            hint="give a higher speed, higher velocity_limits or a lower rate",
        )
    count = max(1, sample_count(plan.duration, rate))
    progress = plan.progress(np.arange(count + 1) / count)[:, None]
    q = first * (1.0 - progress) + last * progress
    trajectory = Trajectory(np.arange(count + 1) / rate, q, robot.joints)
    return certified_trajectory(trajectory, robot, collisions)


def certified_trajectory(
    trajectory: Trajectory, robot: Robot, collisions: CollisionAvoidance | None
) -> Trajectory:
    """Return a trajectory with its certificate; without a condition the same trajectory.

    Raises:
        MotionBlockedError: Parts would touch.
        OptionError: The condition is for another robot.
    """
    if collisions is None:
        return trajectory
    # Imported here, because they load the kernels of collision checks: 50 ms.
    from robot_ik.collision.avoidance import require_same_robot
    from robot_ik.motion.certificate import certify

    require_same_robot(robot, collisions)
    certificate = certify(trajectory.q, collisions, trajectory.times)
    if not certificate.certified:
        return trajectory
    return Trajectory(
        trajectory.times, trajectory.q, trajectory.joints, clearance=certificate.clearance
    )


def require_inside(robot: Robot, q: Array) -> None:
    """Raise ``TrajectoryError`` for a goal (nq,) outside the joint limits."""
    outside = np.maximum(robot.lower - q, q - robot.upper)
    k = int(np.argmax(outside))
    if outside[k] > LIMIT_ROUNDING:
        values = (q[k], robot.lower[k], robot.upper[k])
        given, lower, upper = distinct_texts(*values, digits=6, form="g")
        raise TrajectoryError(
            f"the goal has {given} for joint {robot.joints[k]!r}; "
            f"allowed: {lower} to {upper} (rad, m for slides)",
            hint="solve within the limits, or widen them with robot.with_limits",
        )


class RecorderSink:
    """A ``JointSink`` that records every vector (nq,) of the named joints with its time."""

    def __init__(self, joints: Iterable[str]) -> None:
        self.joints = tuple(joints)
        self._times: list[float] = []
        self._q: list[Array] = []

    def __len__(self) -> int:
        return len(self._times)

    def send(self, q: Array, now: float) -> None:
        """Record a copy of ``q`` (nq,) for the time ``now`` in seconds.

        A second vector for the same time replaces the first.

        Raises:
            TrajectoryError: ``now`` is earlier than the last time, or ``q`` has another length.
        """
        if np.shape(q) != (len(self.joints),):
            raise TrajectoryError(
                f"recorder of {len(self.joints)} joints got q of shape {np.shape(q)}",
                hint=f"send one number each for {', '.join(self.joints)}",
            )
        if self._times and now < self._times[-1]:
            raise TrajectoryError(
                f"recorder got {now:.6g} s after {self._times[-1]:.6g} s",
                hint="clear() it before a new run",
            )
        sample = np.array(q, dtype=float)
        if self._times and now == self._times[-1]:
            self._q[-1] = sample
        else:
            self._times.append(float(now))
            self._q.append(sample)

    def clear(self) -> None:
        """Delete all samples."""
        self._times.clear()
        self._q.clear()

    def trajectory(self) -> Trajectory:
        """Return the samples, with times counted from the first.

        Raises:
            TrajectoryError: Nothing was recorded.
        """
        if not self._times:
            hint = "pass the recorder to execute() or follow()"
            raise TrajectoryError("nothing was recorded", hint=hint)
        times = np.array(self._times)
        return Trajectory(times - times[0], np.stack(self._q), self.joints)
