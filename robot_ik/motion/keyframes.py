"""Keyframes: a smooth motion through joint vectors, replayed without inverse kinematics.

Thesis A00 records start and end poses of a walk and interpolates joint angles between them. Here
the path between two keys is a cubic in the tangent of the first key, q(t) = q_i ⊕ h(s). For hinges
and slides it is the monotone spline of Fritsch & Butland (SIAM J. Sci. Stat. Comput. 5(2), 1984),
which stays between its keys. Balls and the free base move along the geodesic (slerp) if the motion
is at rest at both keys, and rotate smoothly from one key to the next otherwise.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import TrajectoryError, distinct_texts
from robot_ik.geometry import Array
from robot_ik.kernels import kinematics
from robot_ik.kernels.tree import BALL, FREE, SLIDE
from robot_ik.motion.timing import minimum_jerk
from robot_ik.motion.trajectory import (
    Trajectory,
    checked_samples,
    require_positive,
    sample_count,
)
from robot_ik.robot import Robot

LIMIT_SLACK = 1e-6
"""rad or m. A key may be this far beyond a limit, or the last key of a loop from the first."""

OVER_SPEED = 1e-9
"""Share by which a joint may exceed its speed limit, by rounding."""

SHORTEST_SEGMENT = 1e-3
"""Seconds between two keys of ``Keyframes.through``."""

SHORTEST_STEP = 1e-6
"""Seconds between two keys of ``Keyframes``. Nearer keys have no speed between them."""

TIMING_ROUNDS = 60
"""Rounds that lengthen the segments that are too fast. Then all segments are lengthened equally."""

CONE_ROUNDS = 4
"""Rounds in which balls that leave their cone come to rest at more keys."""

CONE_POINTS = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 33))
"""Points of a segment, 0 to 1, at which a ball joint is compared with its cone."""

UNIT_LENGTH = 1e-12
"""A quaternion whose length differs from 1 by less is not normalised, so its bits are kept."""

SHORTEST_QUATERNION = 1e-9
"""A shorter quaternion has no orientation."""


def column_names(robot: Robot) -> tuple[str, ...]:
    """Return names of the nq numbers of q: the name of the joint, with _x … _qz for its parts."""
    wxyz = ("_qw", "_qx", "_qy", "_qz")
    ends = {FREE: ("_x", "_y", "_z", *wxyz), BALL: wxyz}
    names: list[str] = []
    for joint, kind in zip(robot.joints, robot.tree.kind, strict=True):
        names += [joint + end for end in ends.get(int(kind), ("",))]
    return tuple(names)


def sign_continuous(robot: Robot, q: ArrayLike) -> Array:
    """Return the same poses (n, nq) with unit quaternions whose signs change the least."""
    rows = np.array(q, dtype=float)
    for first in _rotations(robot, robot.tree.qadr):
        wxyz = rows[:, first : first + 4]
        length = np.linalg.norm(wxyz, axis=1, keepdims=True)
        if not (length > SHORTEST_QUATERNION).all():
            problem = f"key {int(np.argmin(length))} has a zero quaternion"
            raise TrajectoryError(problem, hint="quaternions are w, x, y, z")
        wxyz /= np.where(np.abs(length - 1.0) > UNIT_LENGTH, length, 1.0)
        flips = np.cumprod(np.where(np.sum(wxyz[1:] * wxyz[:-1], axis=1) < 0.0, -1.0, 1.0))
        wxyz[1:] *= flips[:, None]
    return rows


def _rotations(robot: Robot, addresses: NDArray[np.int64]) -> list[int]:
    """Return the addresses of quaternions in q, or of rotation vectors in dq.

    Args:
        robot: The robot.
        addresses: ``tree.qadr`` or ``tree.vadr``.
    """
    kinds = zip(robot.tree.kind, addresses, strict=True)
    return [int(a) + (3 if kind == FREE else 0) for kind, a in kinds if kind in (BALL, FREE)]


@dataclass(frozen=True, eq=False)
class Displacement:
    """A rotation about the vertical and a shift in the plane, which a loop adds to the free base.

    Attributes:
        x: Metres, after the rotation about the origin of the world.
        y: Metres, after the rotation about the origin of the world.
        heading: Radians about z.
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0

    @classmethod
    def between(cls, first: Array, last: Array) -> Displacement:
        """Return the displacement from a pose of a free joint (7,) to the place of another."""
        heading = _heading(last[3:]) - _heading(first[3:])
        x, y = cls(heading=heading)._displaced(float(first[0]), float(first[1]))
        return cls(float(last[0]) - x, float(last[1]) - y, heading)

    def times(self, count: int) -> Displacement:
        """Return this displacement repeated ``count`` times."""
        total = Displacement()
        for _ in range(count):
            total = Displacement(*self._displaced(total.x, total.y), total.heading + self.heading)
        return total

    def _displaced(self, x: float, y: float) -> tuple[float, float]:
        """Return a point after the displacement."""
        c = math.cos(self.heading)
        s = math.sin(self.heading)
        return c * x - s * y + self.x, s * x + c * y + self.y

    def move(self, q: Array) -> None:
        """Change the pose (7,) of a free joint in place."""
        x, y, _, qw, qx, qy, qz = q.tolist()
        q[:2] = self._displaced(x, y)
        c = math.cos(0.5 * self.heading)
        s = math.sin(0.5 * self.heading)
        q[3:] = c * qw - s * qz, c * qx - s * qy, c * qy + s * qx, c * qz + s * qw


def _heading(wxyz: Array) -> float:
    """Return the angle of the rotation about z in a quaternion (its twist)."""
    return 2.0 * math.atan2(float(wxyz[3]), float(wxyz[0]))


class Keyframes:
    """A smooth motion through joint vectors at given times, without solving between them.

    It starts and ends at rest, or runs as a loop. Hinges and slides stay between the keys before
    and after them, and balls stay in their cone. If the last key of a loop differs from the first
    in position and heading of the free base, each round starts at the end of the last round, as in
    a walk.

    Attributes:
        robot: The robot.
        times: Seconds (n,), increasing by a microsecond at least, the first 0. Read-only.
        q: Keys (n, nq) with sign-continuous quaternions. Read-only.
        loop: Whether the motion is a loop.
    """

    def __init__(self, robot: Robot, times: ArrayLike, q: ArrayLike, *, loop: bool = False) -> None:
        """Check and keep the keys.

        Args:
            robot: The robot, whose joint limits count.
            times: Seconds (n,), strictly increasing, n >= 1.
            q: Keys (n, nq), rad or m for slides.
            loop: Whether the motion is a loop. The last key must equal the first, except for
                position and heading of the free base.

        Raises:
            TrajectoryError: Wrong shapes or times, a key outside the limits, or an open loop.
        """
        self.robot = robot
        self.loop = bool(loop)
        self.times, self.q = _checked_keys(robot, times, q, self.loop)
        self._base = self._stride() if self.loop else None
        self._fit()

    @classmethod
    def through(
        cls,
        robot: Robot,
        poses: Sequence[ArrayLike],
        *,
        durations: ArrayLike = 0.0,
        speed: float = 1.0,
        velocity_limits: ArrayLike | None = None,
        loop: bool = False,
    ) -> Keyframes:
        """Return the fastest motion through poses that the speed limits allow.

        Args:
            robot: The robot, whose limits count.
            poses: Joint vectors (nq,).
            durations: Smallest seconds of each segment, one number for all or one for each.
            speed: Share of the speed limits to use, above 0 and up to 1.
            velocity_limits: Speed limits (nv,) in place of those of the robot, rad/s or m/s.
            loop: Whether the motion returns to the first pose, which is added at the end if needed.

        Raises:
            TrajectoryError: As for the constructor.
        """
        if not 0.0 < speed <= 1.0:
            hint = "give a share of the limits: above 0, at most 1"
            raise TrajectoryError(f"speed is {speed}", hint=hint)
        keys = [robot.check_q(pose, f"pose {k}") for k, pose in enumerate(poses)]
        if loop and keys and not _closed(robot, keys[0], keys[-1]):
            keys.append(keys[0])
        limits = robot.velocity_limits
        if velocity_limits is not None:
            limits = np.asarray(velocity_limits, dtype=float)
        top = speed * np.broadcast_to(limits, robot.nv)
        requested = np.broadcast_to(np.asarray(durations, dtype=float), max(len(keys) - 1, 0))
        gaps = np.maximum(requested, SHORTEST_SEGMENT)
        motion = cls(robot, np.append(0.0, np.cumsum(gaps)), keys, loop=loop)
        for _ in range(TIMING_ROUNDS):
            excess = (motion.peak_velocity_of_segments() / top).max(axis=1, initial=0.0)
            if not (excess > 1.0 + OVER_SPEED).any():
                return motion
            gaps = gaps * np.maximum(excess, 1.0)
            motion = cls(robot, np.append(0.0, np.cumsum(gaps)), keys, loop=loop)
        largest = float((motion.peak_velocity_of_segments() / top).max(initial=1.0))
        return cls(robot, motion.times * largest, keys, loop=loop)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        kind = ", a loop" if self.loop else ""
        return f"Keyframes({self.robot.name!r}, {len(self)} keys, {self.duration:.3f} s{kind})"

    @property
    def duration(self) -> float:
        """Seconds from the first key to the last; of one round for a loop."""
        return float(self.times[-1])

    def at(self, t: float) -> Array:
        """Return ``q`` (nq,) at ``t`` seconds.

        The result is exact at keys. Before the first and after the last key it is constant.
        """
        if not math.isfinite(t):
            raise TrajectoryError(f"the time is {t}", hint="give a finite time in seconds")
        rounds = 0
        end = self._starts[-1]
        if self.loop and t >= end > 0.0:
            rounds, t = divmod(t, end)
        i = bisect_right(self._starts, t) - 1
        if i < 0 or i >= len(self._starts) - 1:
            return np.array(self.q[min(max(i, 0), len(self.q) - 1)])
        s = (t - self._starts[i]) * self._inverse[i]
        third, second, first = self._cubic[i]
        q = self.q[i].copy()
        change = ((third * s + second) * s + first) * s
        kinematics.tree_integrate(self._tree_address, self._nodes, q, change)
        if rounds and self._base is not None:
            base, stride = self._base
            stride.times(int(rounds)).move(q[base])
        return q

    def sampled(self, rate: float, seconds: float | None = None) -> Trajectory:
        """Return the motion at ``rate`` Hz for ``execute``, a recorder or a file.

        Args:
            rate: Samples a second, Hz.
            seconds: Length of the result, s. None for one pass.

        Raises:
            TrajectoryError: ``rate`` or ``seconds`` is not above zero.
        """
        require_positive("rate", rate, "Hz")
        span = self.duration if seconds is None else seconds
        if seconds is not None:
            require_positive("time", seconds, "s")
        count = sample_count(span, rate)
        times = np.minimum(np.arange(count + 1) / rate, span)
        rows = [self.at(t) for t in times.tolist()]
        if seconds is None and len(rows):  # a loop ends at its last key, not at its first
            rows[-1] = self.q[-1]
        return Trajectory(times, sign_continuous(self.robot, rows), column_names(self.robot))

    def peak_velocity_of_segments(self) -> Array:
        """Return the largest speed (n - 1, nv) in each segment, rad/s or m/s.

        For a rotation it is the bound |J_r(h) h'| <= |h'| for all three numbers together.
        """
        third = self._cubic[:, 0]
        second = self._cubic[:, 1]
        first = self._cubic[:, 2]
        ends = np.maximum(np.abs(first), np.abs(first + 2.0 * second + 3.0 * third))
        with np.errstate(divide="ignore", invalid="ignore"):
            where = -second / (3.0 * third)
            middle = np.abs(first - second * second / (3.0 * third))
        peak = np.maximum(ends, np.where((where > 0.0) & (where < 1.0), middle, 0.0))
        for v in _rotations(self.robot, self.robot.tree.vadr):
            peak[:, v : v + 3] = np.linalg.norm(peak[:, v : v + 3], axis=1, keepdims=True)
        return np.asarray(peak / np.diff(self.times)[:, None])

    def blended(self, other: Keyframes, seconds: float, *, rate: float = 60.0) -> Keyframes:
        """Return this motion followed by another, with a smooth transition.

        The free base of ``other`` is moved to the position and heading of this motion at the start
        of the transition.

        Args:
            other: A motion of the same robot.
            seconds: Length of the transition, at most the shorter motion, s.
            rate: Keys a second of the result.

        Raises:
            TrajectoryError: The motion is of another robot, or shorter than the transition.
        """
        if other.robot is not self.robot:
            raise TrajectoryError(
                "the two motions are of different robots", hint="load the robot once"
            )
        if not 0.0 <= seconds <= min(self.duration, other.duration):
            hint = f"give 0 to {min(self.duration, other.duration):.3f} s"
            raise TrajectoryError(f"the transition is {seconds} s", hint=hint)
        begin = self.duration - seconds
        where = free_base(self.robot)
        move = Displacement()
        if where is not None:
            move = Displacement.between(other.at(0.0)[where], self.at(begin)[where])
        total = begin + other.duration
        grid = np.arange(0.0, total, 1.0 / rate)
        times = np.append(grid[grid < total - SHORTEST_STEP], total)
        rows = []
        for t in times.tolist():
            x = (t - begin) / seconds if seconds > 0.0 else float(t >= begin) * 2.0 - 1.0
            share = float(minimum_jerk(x))
            q = self._held(t)
            if share > 0.0:
                next_q = other._held(t - begin)
                if where is not None:
                    move.move(next_q[where])
                q = self.robot.integrate(q, share * self.robot.difference(q, next_q))
            rows.append(self.robot.clip(q))
        return Keyframes(self.robot, times, rows)

    def save_csv(self, path: Path | str) -> None:
        """Write a row for each key, as ``Trajectory.save_csv`` does.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        Trajectory(self.times, self.q, column_names(self.robot)).save_csv(path)

    @classmethod
    def load_csv(cls, path: Path | str, robot: Robot, *, loop: bool = False) -> Keyframes:
        """Read any recording of the robot. Each row is a key.

        Raises:
            ConfigError: The file is not such a table, a joint has no column, or a cell is not a
                number. The message names the line.
            TrajectoryError: As for the constructor.
        """
        samples = Trajectory.load_csv(path, column_names(robot))
        return cls(robot, samples.times, samples.q, loop=loop)

    def _held(self, t: float) -> Array:
        """Return ``at(t)``, or the last key after the end also for a loop."""
        return np.array(self.q[-1]) if t >= self.duration else self.at(t)

    def _stride(self) -> tuple[slice, Displacement] | None:
        """Return the free base in q, and the displacement that a round adds to it."""
        where = free_base(self.robot)
        if where is None or len(self.q) < 2:
            return None
        return where, Displacement.between(self.q[0, where], self.q[-1, where])

    def _fit(self) -> None:
        """Compute the cubic of every segment."""
        tree = self.robot.tree
        self._tree_address = tree.block.address
        self._nodes = np.arange(tree.size)
        self._starts = self.times.tolist()
        gaps = np.diff(self.times)
        self._inverse = (1.0 / gaps).tolist()
        pairs = zip(self.q[:-1], self.q[1:], strict=True)
        changes = np.array([self.robot.difference(a, b) for a, b in pairs])
        changes = changes.reshape(len(gaps), self.robot.nv)
        slopes = self._slopes(changes / gaps[:, None], gaps)
        for v, angle in self._ball_angles():  # a ball at its limit is at rest there
            slopes[angle > self.robot.upper[v] - LIMIT_SLACK, v : v + 3] = 0.0
        self._cubic = self._coefficients(changes, gaps, slopes)
        for _ in range(CONE_ROUNDS):
            outside = self._out_of_cone()
            if not outside:
                return
            for (
                i,
                v,
            ) in outside:  # with rest at both keys the segment is the geodesic, which stays inside
                slopes[i : i + 2, v : v + 3] = 0.0
            self._cubic = self._coefficients(changes, gaps, slopes)

    def _slopes(self, speeds: Array, gaps: Array) -> Array:
        """Return the speed (n, nv) at every key: 0 at the ends and where a joint reverses."""
        slopes = np.zeros((len(gaps) + 1, self.robot.nv))
        slopes[1:-1] = monotone_slope(speeds[:-1], speeds[1:], gaps[:-1, None], gaps[1:, None])
        if self.loop and len(gaps):
            before = speeds[-1].copy()
            v = None
            rotation = np.eye(2)
            if self._base is not None:  # the base continues in the direction of the first segment
                v = int(self.robot.tree.vadr[list(self.robot.tree.kind).index(FREE)])
                c = math.cos(self._base[1].heading)
                s = math.sin(self._base[1].heading)
                rotation = np.array([[c, -s], [s, c]])
                before[v : v + 2] = rotation.T @ before[v : v + 2]
            slopes[0] = monotone_slope(before, speeds[0], gaps[-1], gaps[0])
            slopes[-1] = slopes[0]
            if v is not None:
                slopes[-1, v : v + 2] = rotation @ slopes[0, v : v + 2]
        return slopes

    def _coefficients(self, changes: Array, gaps: Array, slopes: Array) -> Array:
        """Return the coefficients (n - 1, 3, nv) of s³, s², s."""
        begin = slopes[:-1] * gaps[:, None]
        end = slopes[1:] * gaps[:, None]
        for v in _rotations(self.robot, self.robot.tree.vadr):
            end[:, v : v + 3] = _inverse_right_jacobian(changes[:, v : v + 3], end[:, v : v + 3])
        third = begin + end - 2.0 * changes
        second = 3.0 * changes - 2.0 * begin - end
        return np.stack([third, second, begin], axis=1)

    def _out_of_cone(self) -> list[tuple[int, int]]:
        """Return the segments and balls (index in dq) that leave their cone between two keys."""
        outside = []
        for v, angle in self._ball_angles():
            a = int(self.robot.tree.qadr[self.robot.tree.dof_node[v]])
            span = np.linalg.norm(self._cubic[:, :, v : v + 3], axis=2).sum(axis=1)
            for i in np.flatnonzero(angle[:-1] + span > self.robot.upper[v]).tolist():
                third, second, first = self._cubic[i]
                for s in CONE_POINTS.tolist():
                    q = self.robot.integrate(self.q[i], ((third * s + second) * s + first) * s)
                    if np.abs(self.robot.clip(q) - q)[a : a + 4].max() > 0.01 * LIMIT_SLACK:
                        outside.append((i, v))
                        break
        return outside

    def _ball_angles(self) -> Iterator[tuple[int, Array]]:
        """Yield index in dq and angles (n,) from the axis, rad, of each ball with a cone."""
        tree = self.robot.tree
        for kind, a, v in zip(tree.kind, tree.qadr, tree.vadr, strict=True):
            if kind == BALL and np.isfinite(self.robot.upper[v]):
                sine = np.linalg.norm(self.q[:, a + 1 : a + 4], axis=1)
                yield int(v), 2.0 * np.arctan2(sine, np.abs(self.q[:, a]))


def free_base(robot: Robot) -> slice | None:
    """Return the slice of q with the free joint that carries the robot, None without one."""
    for kind, parent, qadr in zip(robot.tree.kind, robot.tree.parent, robot.tree.qadr, strict=True):
        if kind == FREE and parent < 0:
            return slice(int(qadr), int(qadr) + 7)
    return None


def _checked_keys(robot: Robot, times: ArrayLike, q: ArrayLike, loop: bool) -> tuple[Array, Array]:
    """Return times from 0 and keys as read-only arrays, or raise ``TrajectoryError``."""
    t, rows = checked_samples(f"keys of {robot.name!r}", times, q, robot.nq, SHORTEST_STEP)
    rows = sign_continuous(robot, rows)
    for k, row in enumerate(rows):
        outside = robot.outside(row, LIMIT_SLACK)
        if outside:
            key = f"key {k}: " if len(rows) > 1 else ""
            problems = "; ".join(_outside_text(robot, row, joint) for joint in outside)
            raise TrajectoryError(key + problems)
    if loop and not _closed(robot, rows[0], rows[-1]):
        raise TrajectoryError(
            "the last key of a loop must equal the first, except position and heading of a base",
            hint="repeat the first key at the end, or use Keyframes.through(…, loop=True)",
        )
    t = t - t[0]
    t.flags.writeable = False
    rows.flags.writeable = False
    return t, rows


def _outside_text(robot: Robot, q: Array, joint: str) -> str:
    """Return the message for a joint outside its limits. A ball has the angle of its cone."""
    k = robot.joints.index(joint)
    a = int(robot.tree.qadr[k])
    v = int(robot.tree.vadr[k])
    kind = int(robot.tree.kind[k])
    value = float(q[a])
    lower = float(robot.lower[v])
    upper = float(robot.upper[v])
    if kind == BALL:
        value = 2.0 * math.atan2(float(np.linalg.norm(q[a + 1 : a + 4])), abs(value))
        lower = 0.0
    unit = "m"
    values = np.array([value, lower, upper])
    if kind != SLIDE:
        unit = "deg"
        values = np.degrees(values)
    given, lower_text, upper_text = distinct_texts(*values.tolist(), digits=6, form="g")
    allowed = f"allowed: {lower_text} to {upper_text} {unit}"
    return f"joint {joint!r} at {given} {unit} is outside its limits; {allowed}"


def _closed(robot: Robot, first: Array, last: Array) -> bool:
    """Return whether two keys are equal, except for position and heading of the free base."""
    moved = np.array(first)
    base = free_base(robot)
    if base is not None:
        Displacement.between(first[base], last[base]).move(moved[base])
    return bool(np.abs(robot.difference(moved, last)).max(initial=0.0) < LIMIT_SLACK)


def monotone_slope(slope_before: Array, slope_after: Array, before: Array, after: Array) -> Array:
    """Return the slope at a key: the weighted harmonic mean of the slopes beside it.

    It is 0 if they differ in sign (Fritsch & Butland 1984).

    Args:
        slope_before: Slopes before the key.
        slope_after: Slopes after the key.
        before: Length of the gap before the key, s.
        after: Length of the gap after the key, s.
    """
    weight_before = 2.0 * after + before
    weight_after = after + 2.0 * before
    # Almost no speed on one side overflows; the mean is then 0.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = (weight_before + weight_after) / (
            weight_before / slope_before + weight_after / slope_after
        )
    return np.where(slope_before * slope_after > 0.0, mean, 0.0)


def _inverse_right_jacobian(rotation_vector: Array, rate: Array) -> Array:
    """Return J_r⁻¹(φ) ω for rows (n, 3): the rate of φ at angular velocity ω (Solà, eq. 144)."""
    square = np.sum(rotation_vector * rotation_vector, axis=1, keepdims=True)
    half = 0.5 * np.sqrt(square)
    with np.errstate(divide="ignore", invalid="ignore"):
        k = np.where(square < 1e-6, 1.0 / 12.0, (1.0 - half / np.tan(half)) / square)
    once = np.cross(rotation_vector, rate)
    return np.asarray(rate + 0.5 * once + k * np.cross(rotation_vector, once))
