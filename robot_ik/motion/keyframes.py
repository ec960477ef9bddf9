"""Keyframes: a smooth motion through joint vectors, and its replay without inverse kinematics.

A00 records start and end poses of a walk and replays them by interpolating joint angles.  Here the path
between two keys is a cubic in the tangent of the first, q(t) = q_i ⊕ h(s): for hinges and slides the monotone
spline of Fritsch & Butland (SIAM J. Sci. Stat. Comput. 5(2), 1984), which never leaves the span of its
keys; for balls and the free base it runs along the geodesic (slerp) where the motion comes to rest at both
keys, and turns smoothly from one to the next where it does not.
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
from robot_ik.files import write_atomically
from robot_ik.kernels import kinematics
from robot_ik.kernels.tree import BALL, FREE, SLIDE
from robot_ik.motion.timing import minimum_jerk
from robot_ik.motion.trajectory import Trajectory, checked_samples, csv_table, require_positive
from robot_ik.ports import Array
from robot_ik.robot import Robot

# rad or m: so far a key may lie beyond a limit, or the last key of a loop beside the first.
_SLACK = 1e-6
# Part by which a joint may exceed its speed limit: rounding.
_OVER_SPEED = 1e-9
# s: the shortest segment between two keys.
_SHORTEST = 1e-3
# Rounds that lengthen the segments that are too fast; what is left is taken from all alike.
_TIMING_ROUNDS = 60
# Rounds in which balls that leave their cone come to rest at more keys.
_CONE_ROUNDS = 4
# Points of a segment at which a ball joint is held against its cone.
_CONE_POINTS = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 33))


def column_names(robot: Robot) -> tuple[str, ...]:
    """Names of the nq numbers of q: the joint's; of balls and free joints with _x … _qz behind it."""
    wxyz = ("_qw", "_qx", "_qy", "_qz")
    ends = {FREE: ("_x", "_y", "_z", *wxyz), BALL: wxyz}
    names: list[str] = []
    for joint, kind in zip(robot.joints, robot.tree.kind, strict=True):
        names += [joint + end for end in ends.get(int(kind), ("",))]
    return tuple(names)


def sign_continuous(robot: Robot, q: ArrayLike) -> Array:
    """(n, nq) the same poses; each quaternion has length one and the sign nearer to the row before."""
    rows = np.array(q, dtype=float)
    for first in _rotations(robot, robot.tree.qadr):
        wxyz = rows[:, first : first + 4]
        size = np.linalg.norm(wxyz, axis=1, keepdims=True)
        if not (size > 1e-9).all():
            raise TrajectoryError(
                f"key {int(np.argmin(size))} has a zero quaternion", hint="quaternions are w, x, y, z"
            )
        off = np.abs(size - 1.0) > 1e-12  # what is of length one stays as it is, to the bit
        wxyz /= np.where(off, size, 1.0)
        flips = np.cumprod(np.where(np.sum(wxyz[1:] * wxyz[:-1], axis=1) < 0.0, -1.0, 1.0))
        wxyz[1:] *= flips[:, None]
    return rows


def _rotations(robot: Robot, addresses: NDArray[np.int64]) -> list[int]:
    """Where quaternions begin in q (``tree.qadr``), or rotation vectors in dq (``tree.vadr``)."""
    kinds = zip(robot.tree.kind, addresses, strict=True)
    return [int(a) + (3 if kind == FREE else 0) for kind, a in kinds if kind in (BALL, FREE)]


# ------------------------------------------------------------------------------ the motion


# Keys nearer than this, s, have no speed between them.
_LEAST_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Displacement:
    """A rotation about the vertical and a shift in the plane: what a loop adds to the free base each time.

    Attributes:
        x, y: Metres, after the rotation about the world's origin.
        heading: Radians about z.
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0

    @classmethod
    def between(cls, first: Array, last: Array) -> Displacement:
        """What takes a free joint's numbers (7,) ``first`` to the position and heading of ``last``."""
        heading = _heading(last[3:]) - _heading(first[3:])
        x, y = cls(heading=heading)._moved(float(first[0]), float(first[1]))
        return cls(float(last[0]) - x, float(last[1]) - y, heading)

    def times(self, count: int) -> Displacement:
        """The same, ``count`` times over."""
        total = Displacement()
        for _ in range(count):
            total = Displacement(*self._moved(total.x, total.y), total.heading + self.heading)
        return total

    def _moved(self, x: float, y: float) -> tuple[float, float]:
        c, s = math.cos(self.heading), math.sin(self.heading)
        return c * x - s * y + self.x, s * x + c * y + self.y

    def move(self, q: Array) -> None:
        """Moves the numbers (7,) of a free joint in place."""
        x, y, _, qw, qx, qy, qz = q.tolist()
        q[0], q[1] = self._moved(x, y)
        c, s = math.cos(0.5 * self.heading), math.sin(0.5 * self.heading)
        q[3:] = c * qw - s * qz, c * qx - s * qy, c * qy + s * qx, c * qz + s * qw


def _heading(wxyz: Array) -> float:
    """The rotation about z that is in a quaternion (its twist)."""
    return 2.0 * math.atan2(float(wxyz[3]), float(wxyz[0]))


class Keyframes:
    """A smooth motion through joint vectors at given times; between them nothing is solved.

    It starts and ends at rest, or runs round as a loop.  Hinges and slides never leave the span of the two
    keys beside them, balls never their cone.  A loop whose last key differs from the first in position and
    heading of the free base goes on from there each time: a walk.

    Attributes:
        robot: Whose joints.
        times: (n,) seconds, increasing by a microsecond at least, the first 0; read-only.
        q: (n, nq) the keys, quaternions sign-continuous; read-only.
        loop: Whether it runs round.
    """

    def __init__(self, robot: Robot, times: ArrayLike, q: ArrayLike, *, loop: bool = False) -> None:
        """Takes the keys.

        Args:
            robot: Its joint limits count.
            times: (n,) seconds, strictly increasing, n >= 1.
            q: (n, nq) rad, m for slides.
            loop: The last key is the first again (but for the position and heading of the free base).

        Raises:
            TrajectoryError: Shapes, times, keys outside the limits, an open loop: with the joint, what was
                asked and what is possible.
        """
        self.robot, self.loop = robot, bool(loop)
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
        """The motion through ``poses`` that is as fast as the joints' speed limits allow.

        Args:
            robot: Its limits count.
            poses: (nq,) each.
            durations: Seconds that each segment shall take at least: one number, or one for each.
            speed: Part of the speed limits to use, above 0 and up to 1.
            velocity_limits: (nv,) speed limits in place of the robot's, rad/s or m/s.
            loop: Come back to the first pose, which is added behind the last unless it stands there.

        Raises:
            TrajectoryError: As the constructor.
        """
        if not 0.0 < speed <= 1.0:
            raise TrajectoryError(f"asked for speed {speed}", hint="a part of the limits: above 0, at most 1")
        keys = [robot.check_q(pose, f"pose {k}") for k, pose in enumerate(poses)]
        if loop and keys and not _closed(robot, keys[0], keys[-1]):
            keys.append(keys[0])
        limits = robot.velocity_limits if velocity_limits is None else np.asarray(velocity_limits, dtype=float)
        top = speed * np.broadcast_to(limits, robot.nv)
        wanted = np.broadcast_to(np.asarray(durations, dtype=float), max(len(keys) - 1, 0))
        least = np.maximum(wanted, _SHORTEST)
        motion = cls(robot, np.append(0.0, np.cumsum(least)), keys, loop=loop)
        for _ in range(_TIMING_ROUNDS):
            over = motion.peak_velocity_of_segments() / top
            worst = over.max(axis=1, initial=0.0)
            if not (worst > 1.0 + _OVER_SPEED).any():
                return motion
            least = least * np.maximum(worst, 1.0)
            motion = cls(robot, np.append(0.0, np.cumsum(least)), keys, loop=loop)
        longest = float((motion.peak_velocity_of_segments() / top).max(initial=1.0))
        return cls(robot, motion.times * longest, keys, loop=loop)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        kind = ", a loop" if self.loop else ""
        return f"Keyframes({self.robot.name!r}, {len(self)} keys, {self.duration:.3f} s{kind})"

    @property
    def duration(self) -> float:
        """Seconds from the first key to the last; of a loop, once round."""
        return float(self.times[-1])

    def at(self, t: float) -> Array:
        """``q`` (nq,) at ``t`` seconds: exact at keys, held before the first and after the last."""
        if not math.isfinite(t):
            raise TrajectoryError(f"asked for the time {t}", hint="ask for a finite time in seconds")
        rounds, end = 0, self._starts[-1]
        if self.loop and t >= end > 0.0:
            rounds, t = divmod(t, end)
        i = bisect_right(self._starts, t) - 1
        if i < 0 or i >= len(self._starts) - 1:
            return np.array(self.q[min(max(i, 0), len(self.q) - 1)])
        s = (t - self._starts[i]) * self._inverse[i]
        third, second, first = self._cubic[i]
        q = self.q[i].copy()
        kinematics.tree_integrate(self._tree_address, self._nodes, q, ((third * s + second) * s + first) * s)
        if rounds and self._base is not None:
            where, stride = self._base
            stride.times(int(rounds)).move(q[where])
        return q

    def sampled(self, rate: float, seconds: float | None = None) -> Trajectory:
        """The motion at ``rate`` Hz as joint vectors for ``execute``, a recorder or a file.

        Args:
            rate: Samples a second.
            seconds: How long; None: once through.

        Raises:
            TrajectoryError: ``rate`` or ``seconds`` is not above zero.
        """
        require_positive("rate", rate, "Hz")
        span = self.duration if seconds is None else seconds
        if seconds is not None:
            require_positive("time", seconds, "s")
        count = math.ceil(span * rate * (1.0 - 1e-12))
        times = np.minimum(np.arange(count + 1) / rate, span)
        rows = [self.at(t) for t in times.tolist()]
        if seconds is None and len(rows):  # of a loop, too, the last key and not the first
            rows[-1] = self.q[-1]
        return Trajectory(times, sign_continuous(self.robot, rows), column_names(self.robot))

    def peak_velocity_of_segments(self) -> Array:
        """(n - 1, nv) largest speed of each degree of freedom on the segment from key to key, rad/s or m/s.

        Of a rotation it is the bound |J_r(h) h'| <= |h'| for all three numbers together.
        """
        third, second, first = self._cubic[:, 0], self._cubic[:, 1], self._cubic[:, 2]
        ends = np.maximum(np.abs(first), np.abs(first + 2.0 * second + 3.0 * third))
        with np.errstate(divide="ignore", invalid="ignore"):
            where = -second / (3.0 * third)
            middle = np.abs(first - second * second / (3.0 * third))
        peak = np.maximum(ends, np.where((where > 0.0) & (where < 1.0), middle, 0.0))
        for v in _rotations(self.robot, self.robot.tree.vadr):
            peak[:, v : v + 3] = np.linalg.norm(peak[:, v : v + 3], axis=1, keepdims=True)
        return np.asarray(peak / np.diff(self.times)[:, None])

    def blended(self, other: Keyframes, seconds: float, *, rate: float = 60.0) -> Keyframes:
        """This motion, whose last ``seconds`` pass smoothly into the first of ``other``.

        The free base of ``other`` is moved to the position and heading that this motion has by then.

        Args:
            other: A motion of the same robot.
            seconds: How long both count; at most the shorter of the two.
            rate: Keys a second of the result.

        Raises:
            TrajectoryError: Another robot, or more seconds than a motion has.
        """
        if other.robot is not self.robot:
            raise TrajectoryError("the two motions are of different robots", hint="load the robot once")
        if not 0.0 <= seconds <= min(self.duration, other.duration):
            raise TrajectoryError(
                f"asked for a blend of {seconds} s", hint=f"0 to {min(self.duration, other.duration):.3f} s"
            )
        begin = self.duration - seconds
        where = free_base(self.robot)
        move = Displacement()
        if where is not None:
            move = Displacement.between(other.at(0.0)[where], self.at(begin)[where])
        total = begin + other.duration
        grid = np.arange(0.0, total, 1.0 / rate)
        times = np.append(grid[grid < total - _LEAST_STEP], total)
        rows = []
        for t in times.tolist():
            x = (t - begin) / seconds if seconds > 0.0 else float(t >= begin) * 2.0 - 1.0
            share = float(minimum_jerk(x))
            one = self._held(t)
            if share > 0.0:
                two = other._held(t - begin)
                if where is not None:
                    move.move(two[where])
                one = self.robot.integrate(one, share * self.robot.difference(one, two))
            rows.append(self.robot.clip(one))
        return Keyframes(self.robot, times, rows)

    def save_csv(self, path: Path | str) -> None:
        """Writes the keys: a header (t, a column for each number of q), one row a key, in full precision.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        rows = np.column_stack([self.times, self.q]).tolist()
        text = csv_table(["t", *column_names(self.robot)], rows)
        write_atomically(Path(path), text)

    @classmethod
    def load_csv(cls, path: Path | str, robot: Robot, *, loop: bool = False) -> Keyframes:
        """Reads what ``save_csv`` or ``Trajectory.save_csv`` wrote, or frames of ``robot-ik figure``.

        Lines that begin with # and columns that are no joints are passed over.

        Raises:
            ConfigError: No such table, a joint without column, or cells that are no numbers; names the line.
            TrajectoryError: As the constructor.
        """
        found = Trajectory.load_csv(path, column_names(robot))
        return cls(robot, found.times, found.q, loop=loop)

    # --------------------------------------------------------------------------- fitting

    def _held(self, t: float) -> Array:
        """As ``at``, but a loop ends, too."""
        return np.array(self.q[-1]) if t >= self.duration else self.at(t)

    def _stride(self) -> tuple[slice, Displacement] | None:
        """Where the free base stands in q, and what a round adds to it."""
        where = free_base(self.robot)
        if where is None or len(self.q) < 2:
            return None
        return where, Displacement.between(self.q[0, where], self.q[-1, where])

    def _fit(self) -> None:
        """The cubic of every segment."""
        tree = self.robot.tree
        self._tree_address = tree.block.address
        self._nodes = np.arange(tree.size)
        self._starts = self.times.tolist()
        gaps = np.diff(self.times)
        self._inverse = (1.0 / gaps).tolist()
        ways = np.array([self.robot.difference(a, b) for a, b in zip(self.q[:-1], self.q[1:], strict=True)])
        ways = ways.reshape(len(gaps), self.robot.nv)
        slopes = self._slopes(ways / gaps[:, None], gaps)
        for v, angle in self._ball_angles():  # a ball at its limit does not run along it
            slopes[angle > self.robot.upper[v] - _SLACK, v : v + 3] = 0.0
        self._cubic = self._coefficients(ways, gaps, slopes)
        for _ in range(_CONE_ROUNDS):
            loose = self._out_of_cone()
            if not loose:
                return
            for i, v in loose:  # at rest at both keys the segment is the geodesic, which stays inside
                slopes[i : i + 2, v : v + 3] = 0.0
            self._cubic = self._coefficients(ways, gaps, slopes)

    def _slopes(self, speeds: Array, gaps: Array) -> Array:
        """(n, nv) speed at every key: none at the ends, and where a degree of freedom turns back."""
        slopes = np.zeros((len(gaps) + 1, self.robot.nv))
        slopes[1:-1] = monotone_slope(speeds[:-1], speeds[1:], gaps[:-1, None], gaps[1:, None])
        if self.loop and len(gaps):
            before = speeds[-1].copy()
            v, rotation = None, np.eye(2)
            if self._base is not None:  # the base goes on in the direction in which the first step leads
                v = int(self.robot.tree.vadr[list(self.robot.tree.kind).index(FREE)])
                c, s = math.cos(self._base[1].heading), math.sin(self._base[1].heading)
                rotation = np.array([[c, -s], [s, c]])
                before[v : v + 2] = rotation.T @ before[v : v + 2]
            slopes[0] = slopes[-1] = monotone_slope(before, speeds[0], gaps[-1], gaps[0])
            if v is not None:
                slopes[-1, v : v + 2] = rotation @ slopes[0, v : v + 2]
        return slopes

    def _coefficients(self, ways: Array, gaps: Array, slopes: Array) -> Array:
        """(n - 1, 3, nv) of s³, s², s."""
        begin, end = slopes[:-1] * gaps[:, None], slopes[1:] * gaps[:, None]
        for v in _rotations(self.robot, self.robot.tree.vadr):
            end[:, v : v + 3] = _inverse_right_jacobian(ways[:, v : v + 3], end[:, v : v + 3])
        return np.stack([begin + end - 2.0 * ways, 3.0 * ways - 2.0 * begin - end, begin], axis=1)

    def _out_of_cone(self) -> list[tuple[int, int]]:
        """Segments and balls (their index in dq) that leave their cone between keys that are inside."""
        found = []
        for v, angle in self._ball_angles():
            a = int(self.robot.tree.qadr[self.robot.tree.dof_node[v]])
            span = np.linalg.norm(self._cubic[:, :, v : v + 3], axis=2).sum(axis=1)
            for i in np.flatnonzero(angle[:-1] + span > self.robot.upper[v]).tolist():
                third, second, first = self._cubic[i]
                for s in _CONE_POINTS.tolist():
                    q = self.robot.integrate(self.q[i], ((third * s + second) * s + first) * s)
                    if np.abs(self.robot.clip(q) - q)[a : a + 4].max() > 0.01 * _SLACK:
                        found.append((i, v))
                        break
        return found

    def _ball_angles(self) -> Iterator[tuple[int, Array]]:
        """Of every ball with a cone its index in dq and (n,) how far from the middle it stands, radians."""
        tree = self.robot.tree
        for kind, a, v in zip(tree.kind, tree.qadr, tree.vadr, strict=True):
            if kind == BALL and np.isfinite(self.robot.upper[v]):
                sine = np.linalg.norm(self.q[:, a + 1 : a + 4], axis=1)
                yield int(v), 2.0 * np.arctan2(sine, np.abs(self.q[:, a]))


def free_base(robot: Robot) -> slice | None:
    """Where the seven numbers of the free joint that carries the robot stand in q; None: it has none."""
    for kind, parent, qadr in zip(robot.tree.kind, robot.tree.parent, robot.tree.qadr, strict=True):
        if kind == FREE and parent < 0:
            return slice(int(qadr), int(qadr) + 7)
    return None


def _checked_keys(robot: Robot, times: ArrayLike, q: ArrayLike, loop: bool) -> tuple[Array, Array]:
    t, rows = checked_samples(f"keys of {robot.name!r}", times, q, robot.nq, _LEAST_STEP)
    rows = sign_continuous(robot, rows)
    for k, row in enumerate(rows):
        if outside := robot.outside(row, _SLACK):
            key = f"key {k}: " if len(rows) > 1 else ""
            raise TrajectoryError(key + "; ".join(_outside_text(robot, row, joint) for joint in outside))
    if loop and not _closed(robot, rows[0], rows[-1]):
        raise TrajectoryError(
            "the last key of a loop must be the first again (but for position and heading of a free base)",
            hint="repeat the first key at the end, or take Keyframes.through(…, loop=True), which does",
        )
    t = t - t[0]
    t.flags.writeable = rows.flags.writeable = False
    return t, rows


def _outside_text(robot: Robot, q: Array, joint: str) -> str:
    """That a joint stands outside its limits: where, and what they are; of a ball the angle of its cone."""
    k = robot.joints.index(joint)
    a, v, kind = int(robot.tree.qadr[k]), int(robot.tree.vadr[k]), int(robot.tree.kind[k])
    at, low = float(q[a]), float(robot.lower[v])
    if kind == BALL:
        at, low = 2.0 * math.atan2(float(np.linalg.norm(q[a + 1 : a + 4])), abs(at)), 0.0
    unit, one = ("m", 1.0) if kind == SLIDE else ("deg", math.pi / 180.0)
    values = (value / one for value in (at, low, float(robot.upper[v])))
    asked, lower, upper = distinct_texts(*values, digits=6, form="g")
    return f"joint {joint!r} at {asked} {unit} is outside its limits; allowed: {lower} to {upper} {unit}"


def _closed(robot: Robot, first: Array, last: Array) -> bool:
    """Whether two keys are one pose, wherever the free base stands and faces."""
    moved = np.array(first)
    where = free_base(robot)
    if where is not None:
        Displacement.between(first[where], last[where]).move(moved[where])
    return bool(np.abs(robot.difference(moved, last)).max(initial=0.0) < _SLACK)


def monotone_slope(one: Array, two: Array, before: Array, after: Array) -> Array:
    """The slope at a key between slopes ``one`` and ``two`` of the gaps ``before`` and ``after`` it.

    Their weighted harmonic mean, 0 where they differ in sign (Fritsch & Butland, as above).
    """
    left, right = 2.0 * after + before, after + 2.0 * before
    # Next to no speed on one side: their harmonic mean is none.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = (left + right) / (left / one + right / two)
    return np.where(one * two > 0.0, mean, 0.0)


def _inverse_right_jacobian(rotation_vector: Array, rate: Array) -> Array:
    """J_r⁻¹(φ) ω of rows (n, 3): the h' of angular velocity ω at exp(φ) (Solà et al. 2018, eq. 144)."""
    square = np.sum(rotation_vector * rotation_vector, axis=1, keepdims=True)
    half = 0.5 * np.sqrt(square)
    with np.errstate(divide="ignore", invalid="ignore"):
        k = np.where(square < 1e-6, 1.0 / 12.0, (1.0 - half / np.tan(half)) / square)
    once = np.cross(rotation_vector, rate)
    return np.asarray(rate + 0.5 * once + k * np.cross(rotation_vector, once))
