"""`Trajectory`: joint angles over time, and `joint_move`, the straight line between two of them."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.config import LARGEST_NUMBER, read_csv, shown
from robot_ik.errors import ConfigError, TrajectoryError, UnsupportedJointError, distinct_texts
from robot_ik.files import write_atomically
from robot_ik.geometry import is_real, numbers
from robot_ik.motion.timing import PROFILES
from robot_ik.ports import Array
from robot_ik.robot import Robot, require_robot

# ------------------------------------------------------------------------------------------
# What a move may ask of a robot: the checks that every planner shares.


# A goal that a solver put onto a limit may miss it by rounding: rad or m.
_LIMIT_ROUNDING = 1e-9
# Of a move: a day at 100 Hz.
_MOST_SAMPLES = 10_000_000


def joint_vector(robot: Robot, q: ArrayLike, what: str) -> Array:
    """``q`` as a fresh (nq,) array.

    Raises:
        TrajectoryError: Wrong length or a number that is not finite; names the joint.
        UnsupportedJointError: The robot has ball or free joints.
    """
    require_robot(robot)
    if robot.nq != robot.nv:
        raise UnsupportedJointError(
            f"robot {robot.name!r} has ball or free joints; moves are planned for hinges and slides",
            hint="keep only hinge and slide joints: load_robot(…, joints=[…])",
        )
    vector = numbers(q, f"the {what}", f"{robot.nq} numbers", TrajectoryError)
    if vector.shape != (robot.nq,):
        raise TrajectoryError(
            f"the {what} has shape {vector.shape}; {robot.name!r} has {robot.nq} joints",
            hint=f"give one number each for {', '.join(robot.joints)}",
        )
    if not np.isfinite(vector).all():
        k = int(np.argmin(np.isfinite(vector)))
        raise TrajectoryError(
            f"the {what} asks {vector[k]} of joint {robot.joints[k]!r}", hint="give finite numbers, rad or m"
        )
    return vector


def motion_limits(
    robot: Robot, speed: float, velocity: ArrayLike | None = None, acceleration: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Velocity and acceleration (nq,) to plan with.

    ``speed`` times the lower of the robot's own limits and the given caps.

    Raises:
        TrajectoryError: ``speed`` outside (0, 1], or a limit that is missing, zero, infinite or no number.
    """
    if not is_real(speed, math.ulp(0.0), 1.0):
        raise TrajectoryError(f"asked for speed {speed!r}", hint="a part of the limits: above 0, at most 1")
    limits = []
    for what, own, cap in (
        ("velocity", robot.velocity, velocity),
        ("acceleration", robot.acceleration, acceleration),
    ):
        try:
            lowest = np.minimum(own, np.inf if cap is None else np.asarray(cap, dtype=float))
        except (TypeError, ValueError, OverflowError) as error:
            raise TrajectoryError(f"{what} is to be {robot.nv} numbers, or one, not {shown(cap)}") from error
        if lowest.shape != (robot.nv,) or not (np.isfinite(lowest) & (lowest > 0.0)).all():
            raise TrajectoryError(
                f"the {what} limits of {robot.name!r} are {np.asarray(lowest).tolist()}",
                hint="each joint needs one finite limit above zero: [motion] in robot.toml",
            )
        limits.append(speed * lowest)
    return limits[0], limits[1]


def require_positive(what: str, value: float, unit: str) -> None:
    """Raises `TrajectoryError` unless ``value`` is finite and above zero."""
    if not is_real(value, math.ulp(0.0)):
        raise TrajectoryError(f"asked for a {what} of {value!r} {unit}", hint=f"{what} must be above zero")


def checked_samples(
    what: str, times: ArrayLike, q: ArrayLike, width: int, least: float = math.ulp(0.0)
) -> tuple[Array, Array]:
    """``times`` (n,), each ``least`` after the one before, and ``q`` (n, ``width``) as new arrays.

    Raises:
        TrajectoryError: They are not; ``what`` is for its message.
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
    if (np.diff(t) < least).any():
        k = int(np.argmax(np.diff(t) < least))
        raise TrajectoryError(
            f"times must increase, but row {k + 1} at {t[k + 1]:.6g} s follows {t[k]:.6g} s",
            hint="sort the rows and drop those of equal time",
        )
    return t, rows


_TIME_COLUMNS, _ROBOT_COLUMN = ("time_s", "t"), "robot"
_COMMANDED = re.compile(r"commanded\.(.+)$|(.+)_commanded$")
"""A column of what ``jobs.recording`` and ``jobs.reach_files`` write, beside what was measured."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint vectors at increasing times; straight between the samples.

    Straight lines keep what the samples have: they stay inside joint limits and never exceed the
    largest velocity.  Their corners are as sharp as the sampling is coarse, so plan at the rate at
    which you send.

    Attributes:
        times: (n,) seconds, strictly increasing, n >= 1; read-only.
        q: (n, nq) rad, m for slides; read-only.
        joints: nq column names.

    Raises:
        TrajectoryError: Shapes that do not fit, times that do not increase, or numbers that are not finite.
    """

    times: Array
    q: Array
    joints: tuple[str, ...]

    def __init__(self, times: ArrayLike, q: ArrayLike, joints: Iterable[str]) -> None:
        given: object = joints
        names = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
        if not all(isinstance(name, str) for name in names):
            raise TrajectoryError(f"joints are names, not {joints!r}", hint='joints=["joint1", "joint2"]')
        t, samples = checked_samples(f"a trajectory of {len(names)} joints", times, q, len(names))
        t.flags.writeable = samples.flags.writeable = False
        for name, value in (("times", t), ("q", samples), ("joints", names)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} samples, {self.duration:.3f} s, joints {', '.join(self.joints)})"

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.times[-1] - self.times[0])

    def at(self, t: float) -> Array:
        """``q`` (nq,) at ``t`` in seconds; exact at samples, held before the first and after the last."""
        if not is_real(t):
            raise TrajectoryError(f"asked for the time {t!r}", hint="ask for a finite time in seconds")
        k = int(np.searchsorted(self.times, t, side="right")) - 1
        if k < 0:
            return np.array(self.q[0])
        if k >= len(self) - 1 or self.times[k] == t:
            return np.array(self.q[k])
        part = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        return np.asarray(self.q[k] * (1.0 - part) + self.q[k + 1] * part)

    def resampled(self, rate: float) -> Trajectory:
        """The same motion at ``rate`` Hz from time 0; the last sample is kept (the last gap may be short)."""
        require_positive("rate", rate, "Hz")
        count = int(np.ceil(self.duration * rate * (1.0 - 1e-12)))
        times = np.minimum(np.arange(count + 1) / rate, self.duration)
        times[-1] = self.duration
        return Trajectory(times, [self.at(self.times[0] + t) for t in times[:-1]] + [self.q[-1]], self.joints)

    @property
    def peak_velocity(self) -> Array:
        """(nq,) largest speed of each joint between two samples, rad/s or m/s."""
        return np.asarray(np.abs(self._slopes()).max(axis=0, initial=0.0))

    @property
    def peak_acceleration(self) -> Array:
        """(nq,) largest acceleration of each joint, rad/s^2 or m/s^2, from rest before and to rest after."""
        if len(self) < 2:
            return np.zeros(len(self.joints))
        gaps = np.diff(self.times)
        between = 0.5 * (np.concatenate([gaps[:1], gaps]) + np.concatenate([gaps, gaps[-1:]]))
        rest = np.zeros((1, len(self.joints)))
        change = np.diff(np.concatenate([rest, self._slopes(), rest]), axis=0)
        return np.asarray(np.abs(change / between[:, None]).max(axis=0, initial=0.0))

    def _slopes(self) -> Array:
        return np.asarray(np.diff(self.q, axis=0) / np.diff(self.times)[:, None])

    def save_csv(self, path: Path | str) -> None:
        """Writes a header (time_s, joint names) and one row a sample, in full precision; whole or not at all.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        write_atomically(Path(path), self.csv_text())

    def csv_text(self) -> str:
        """What ``save_csv`` writes."""
        return csv_table([_TIME_COLUMNS[0], *self.joints], np.column_stack([self.times, self.q]).tolist())

    @classmethod
    def load_csv(cls, path: Path | str, joints: Sequence[str] = ()) -> Trajectory:
        """Reads what `save_csv` wrote; lines that begin with # are passed over.

        Of a recording, or of the table of a reach, what was commanded (``commanded.JOINT``,
        ``JOINT_commanded``), without the rows in which nothing was.

        Args:
            path: Of the file.
            joints: Names of columns, in the wanted order, if there are others, too.

        Raises:
            ConfigError: The file is missing or is not such a table; names the line.
        """
        source = Path(path)
        rows = [(k, row) for k, row in enumerate(read_csv(source, "the motion"), 1) if row]
        rows = [(k, row) for k, row in rows if not row[0].startswith("#")]
        head = [cell.strip() for cell in rows[0][1]] if rows else []
        if not head or head[0] not in _TIME_COLUMNS or len(head) < 2:
            raise ConfigError("is not a trajectory", file=source, key="line 1", allowed="time_s,joint names")
        names = {k: found[1] or found[2] for k, name in enumerate(head) if (found := _COMMANDED.match(name))}
        width, columns = len(head), names or dict(enumerate(head[1:], 1))
        if joints:
            if missing := [name for name in joints if name not in head]:
                more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
                raise ConfigError(f"no column {missing[0]!r}{more}", file=source, key="line 1")
            names, columns = {}, {head.index(name): name for name in joints}
        kept = [
            (k, row) for k, row in rows[1:]
            if not names or len(row) != width or any(row[c] for c in names)
        ]  # fmt: skip
        samples = [_numbers(row, [0, *columns], width, source, k) for k, row in kept]
        if not samples:
            raise ConfigError("has no samples", file=source, key="line 2", allowed="a row of numbers")
        if names and head[1] == _ROBOT_COLUMN and len({row[1] for _, row in kept}) > 1:
            raise ConfigError("is of several robots", file=source, key=_ROBOT_COLUMN, allowed="of one robot")
        table = np.array(samples)
        try:
            return cls(table[:, 0], table[:, 1:], columns.values())
        except TrajectoryError as error:
            raise ConfigError(str(error), file=source) from error


def csv_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A header and rows of text and numbers, these in full precision, as CSV."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([head, *rows])
    return stream.getvalue()


def _numbers(row: list[str], columns: Sequence[int], width: int, file: Path, line: int) -> list[float]:
    """The numbers in columns of a row that shall be so wide, or ``ConfigError``."""
    with contextlib.suppress(ValueError):
        numbers = [float(row[k]) for k in columns] if len(row) == width else None
        if numbers and all(abs(number) <= LARGEST_NUMBER for number in numbers):  # NaN is not
            return numbers
    allowed = f"{width} cells, joints as numbers up to {LARGEST_NUMBER:g}"
    got = f"got {shown(','.join(row))}"
    raise ConfigError(got, file=file, key=f"line {line}", allowed=allowed)


# ------------------------------------------------------------------------------ joint move


def joint_move(
    robot: Robot,
    start: ArrayLike,
    goal_q: ArrayLike,
    *,
    speed: float = 1.0,
    rate: float = 100.0,
    profile: str = "trapezoid",
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
) -> Trajectory:
    """Straight line in joint space; all joints start together and stop together.

    The slowest joint sets the time.  ``start`` may lie outside the limits (the arm walks in).

    Args:
        robot: Its limits count.
        start: (nq,) rad, m for slides.
        goal_q: (nq,) rad, m for slides.
        speed: Part of the robot's velocity and acceleration limits to use, above 0 and up to 1.
        rate: Samples a second, Hz; the duration is rounded up to whole periods.
        profile: "trapezoid" (time-optimal) or "quintic" (smooth: no step of acceleration).
        velocity: (nq,) further cap in rad/s, such as that of the arm file; the lower one counts.
        acceleration: (nq,) likewise, rad/s^2.

    Raises:
        TrajectoryError: Wrong length, a number that is not finite, or a goal outside the limits.
        UnsupportedJointError: The robot has ball or free joints.
    """
    first, last = joint_vector(robot, start, "start"), joint_vector(robot, goal_q, "goal")
    outside = np.maximum(robot.lower - last, last - robot.upper)
    k = int(np.argmax(outside))
    if outside[k] > _LIMIT_ROUNDING:
        asked, low, high = distinct_texts(last[k], robot.lower[k], robot.upper[k], digits=6, form="g")
        raise TrajectoryError(
            f"the goal asks {asked} of joint {robot.joints[k]!r}; "
            f"allowed: {low} to {high} (rad, m for slides)",
            hint="solve within the limits, or widen them with robot.with_limits",
        )
    top, push = motion_limits(robot, speed, velocity, acceleration)
    require_positive("rate", rate, "Hz")
    if str(profile) not in PROFILES:
        raise TrajectoryError(f"unknown profile {profile!r}", hint=f"known: {', '.join(PROFILES)}")
    distance = np.abs(last - first)
    if not distance.any():
        return Trajectory([0.0], [first], robot.joints)
    moving = distance > 0.0
    with np.errstate(over="ignore"):  # a distance of 1e-300 rad: the bounds are infinite, which is right
        bounds = np.min(top[moving] / distance[moving]), np.min(push[moving] / distance[moving])
    if np.isfinite(bounds[1]):
        plan = PROFILES[profile](float(bounds[0]), float(bounds[1]))
        samples = np.ceil(plan.duration * rate * (1.0 - 1e-12))
        if samples > _MOST_SAMPLES:
            raise TrajectoryError(
                f"the move takes {plan.duration:.3g} s, which are {samples:.3g} samples at {rate:g} Hz",
                hint="a higher speed or velocity, or a lower rate",
            )
        count = max(1, int(samples))
        progress = plan.progress(np.arange(count + 1) / count)[:, None]
        q = first * (1.0 - progress) + last * progress
    else:
        count, q = 1, np.stack([first, last])
    return Trajectory(np.arange(count + 1) / rate, q, robot.joints)


class RecorderSink:
    """A `JointSink` that remembers every vector (nq,) of the named joints, and its time."""

    def __init__(self, joints: Iterable[str]) -> None:
        self.joints = tuple(joints)
        self._times: list[float] = []
        self._q: list[Array] = []

    def __len__(self) -> int:
        return len(self._times)

    def send(self, q: Array, now: float) -> None:
        """Keeps a copy of ``q`` (nq,) for ``now`` in seconds; a second one for that time replaces it.

        Raises:
            TrajectoryError: ``now`` is earlier than the last one, or ``q`` has the wrong length.
        """
        if np.shape(q) != (len(self.joints),):
            raise TrajectoryError(
                f"recorder of {len(self.joints)} joints got q of shape {np.shape(q)}",
                hint=f"send one number each for {', '.join(self.joints)}",
            )
        if self._times and now < self._times[-1]:
            raise TrajectoryError(
                f"recorder got {now:.6g} s after {self._times[-1]:.6g} s", hint="clear() it before a new run"
            )
        if not self._times or now != self._times[-1]:
            self._times.append(float(now))
            self._q.append(np.empty(0))
        self._q[-1] = np.array(q, dtype=float)

    def clear(self) -> None:
        """Forgets everything."""
        self._times.clear()
        self._q.clear()

    def trajectory(self) -> Trajectory:
        """What was recorded, with times counted from the first sample.

        Raises:
            TrajectoryError: Nothing was recorded.
        """
        if not self._times:
            raise TrajectoryError("nothing was recorded", hint="pass the recorder to execute() or follow()")
        times = np.array(self._times)
        return Trajectory(times - times[0], np.stack(self._q), self.joints)
