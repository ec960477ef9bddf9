"""``waypoint_move``: a timed motion through the corners of a path, with certified round corners.

Between the corners the joints move straight. Each corner is cut by a parabola that is tangent to
both edges, if the cut is proven free. Otherwise the motion stops at the corner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.errors import MotionBlockedError, TrajectoryError
from robot_ik.geometry import Array
from robot_ik.motion.timing import (
    MAX_SLOWDOWNS,
    SLOWDOWN_MARGIN,
    Profile,
    fastest_timing,
    trapezoid,
)
from robot_ik.motion.trajectory import (
    MAX_SAMPLES,
    Trajectory,
    certified_trajectory,
    sample_count,
)
from robot_ik.robot import Robot

SAME_CORNER = 1e-9
"""rad or m. Corners that differ by less in each joint are the same corner."""

LONGEST_CUT = 0.5
"""rad or m. Longest part of an edge that a cut replaces. A longer cut saves little time."""

CUTS = 7
"""Number of lengths of a cut that are tried, each half of the length before."""

CUT_POINTS = 9
"""Number of points of a cut that are checked before the whole motion is proven."""

EDGE_KNOTS = 24
"""Knots of the timing on a straight part: with fewer the speed is far below its bound."""

CUT_KNOTS = 12
"""Knots of the timing on a cut."""

MAX_CUT_HALVINGS = 3
"""Times that all cuts are halved, before the motion stops at each corner."""


def waypoint_move(
    robot: Robot,
    corners: Array,
    collisions: CollisionAvoidance,
    limits: tuple[Array, Array],
    rate: float,
) -> Trajectory:
    """Return a motion along a path, from rest to rest, with its certificate.

    Args:
        robot: The robot.
        corners: (k, nq) postures whose straight connections are free.
        collisions: The condition.
        limits: Velocity and acceleration limits (nv,), rad/s and rad/s².
        rate: Samples a second, Hz.

    Raises:
        MotionBlockedError: An edge of the path is not free.
        TrajectoryError: The motion has too many samples.
    """
    corners = _without_repetition(corners)
    if len(corners) == 1:
        still = Trajectory([0.0], corners, robot.joints)
        return certified_trajectory(still, robot, collisions)
    cuts = _free_cuts(corners, collisions)
    for _ in range(MAX_CUT_HALVINGS):
        if not cuts.any():
            break
        trajectory = _timed(corners, cuts, limits, rate, robot.joints)
        try:
            trajectory = certified_trajectory(trajectory, robot, collisions)
        except MotionBlockedError:
            cuts = 0.5 * cuts
            continue
        if trajectory.certified:
            return trajectory
        cuts = 0.5 * cuts
    stops = np.zeros(len(corners))
    stopping = _timed(corners, stops, limits, rate, robot.joints)
    return certified_trajectory(stopping, robot, collisions)


def joined(parts: Sequence[Trajectory], certified: bool) -> Trajectory:
    """Return one trajectory from several; each begins at the end of the one before.

    Args:
        parts: Trajectories of the same joints, from rest to rest.
        certified: Whether all of them are certified, each for its own condition.
    """
    times = [parts[0].times]
    rows = [parts[0].q]
    for part in parts[1:]:
        times.append(times[-1][-1] + part.times[1:])
        rows.append(part.q[1:])
    clearance = min(part.clearance or 0.0 for part in parts) if certified else None
    return Trajectory(
        np.concatenate(times), np.concatenate(rows), parts[0].joints, clearance=clearance
    )


def _without_repetition(corners: Array) -> Array:
    """Return the corners (k, nq) without repetitions of the corner before."""
    kept = np.concatenate([[True], np.abs(np.diff(corners, axis=0)).max(axis=1) > SAME_CORNER])
    if not kept[-1]:
        # The goal is exact: it replaces the corner before it, but not the start.
        kept[np.flatnonzero(kept)[1:][-1:]] = False
        kept[-1] = bool((corners[-1] != corners[0]).any())
    return corners[kept]


def _free_cuts(corners: Array, collisions: CollisionAvoidance) -> Array:
    """Return for each corner (k,) the longest cut that is free at its points; 0 for a stop.

    A cut has the same length on both edges. The ends have none.
    """
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    cuts = np.zeros(len(corners))
    if len(corners) < 3:
        return cuts
    longest = np.minimum(LONGEST_CUT, 0.5 * np.minimum(lengths[:-1], lengths[1:]))
    lengths_of_cuts = longest[:, None] * 0.5 ** np.arange(CUTS)
    shares = np.linspace(0.0, 1.0, CUT_POINTS)
    rows = [
        _Cut.at(corners, k + 1, cut).points(shares)
        for k, cuts_of_corner in enumerate(lengths_of_cuts)
        for cut in cuts_of_corner
    ]
    free = collisions.free(np.concatenate(rows)).reshape(len(longest), CUTS, CUT_POINTS)
    is_free = np.asarray(free.all(axis=2))
    first = np.argmax(is_free, axis=1)
    chosen = lengths_of_cuts[np.arange(len(longest)), first]
    cuts[1:-1] = np.where(is_free.any(axis=1), chosen, 0.0)
    return cuts


@dataclass(frozen=True, eq=False)
class _Cut:
    """A parabola from one edge to the next.

    Attributes:
        begin: (nq,) on the first edge.
        corner: (nq,) where the edges meet.
        end: (nq,) on the second edge.
    """

    begin: Array
    corner: Array
    end: Array

    @classmethod
    def at(cls, corners: Array, k: int, cut: float) -> _Cut:
        """Return the cut of this length on both edges of corner ``k``."""
        before = corners[k - 1] - corners[k]
        after = corners[k + 1] - corners[k]
        begin = corners[k] + cut / np.linalg.norm(before) * before
        end = corners[k] + cut / np.linalg.norm(after) * after
        return cls(begin, corners[k], end)

    def points(self, shares: Array) -> Array:
        """Return points (n, nq) at shares (n,) from 0 to 1."""
        t = shares[:, None]
        return np.asarray(
            (1.0 - t) ** 2 * self.begin + 2.0 * t * (1.0 - t) * self.corner + t**2 * self.end
        )


@dataclass(frozen=True, eq=False)
class _Line:
    """A straight part of a path."""

    begin: Array
    end: Array

    def points(self, shares: Array) -> Array:
        """Return points (n, nq) at shares (n,) from 0 to 1."""
        return np.asarray(self.begin + shares[:, None] * (self.end - self.begin))


@dataclass(frozen=True, eq=False)
class _SmoothPath:
    """Straight parts and cuts in turn, from one stop to the next.

    Attributes:
        parts: The parts.
        edges: (p + 1,) length along the path at which each part begins, and the whole length. A cut
            counts with the length of the two edges that it replaces, so that the speed is
            continuous.
    """

    parts: tuple[_Line | _Cut, ...]
    edges: Array

    @classmethod
    def through(cls, corners: Array, cuts: Array) -> _SmoothPath:
        """Return the path through corners (k, nq) with cuts (k,), those of the ends 0."""
        parts: list[_Line | _Cut] = []
        lengths: list[float] = []
        begin = corners[0]
        for k in range(1, len(corners)):
            cut = _Cut.at(corners, k, cuts[k]) if cuts[k] > 0.0 else None
            line = _Line(begin, corners[k] if cut is None else cut.begin)
            length = float(np.linalg.norm(line.end - line.begin))
            if length > SAME_CORNER:
                parts.append(line)
                lengths.append(length)
            if cut is not None:
                parts.append(cut)
                lengths.append(2.0 * float(cuts[k]))
                begin = cut.end
        return cls(tuple(parts), np.concatenate([[0.0], np.cumsum(lengths)]))

    def knots(self) -> Array:
        """Return increasing values (n,) of the path parameter from 0 to 1 for the timing."""
        values = [
            np.linspace(a, b, CUT_KNOTS if isinstance(part, _Cut) else EDGE_KNOTS, endpoint=False)
            for part, a, b in zip(self.parts, self.edges[:-1], self.edges[1:], strict=True)
        ]
        return np.concatenate([*values, self.edges[-1:]]) / self.edges[-1]

    def points(self, s: Array) -> Array:
        """Return the path (n, nq) at values (n,) of its parameter from 0 to 1."""
        along = s * self.edges[-1]
        index = np.clip(
            np.searchsorted(self.edges, along, side="right") - 1, 0, len(self.parts) - 1
        )
        widths = np.diff(self.edges)
        shares = np.clip((along - self.edges[index]) / widths[index], 0.0, 1.0)
        rows = np.empty((len(s), len(self.parts[0].begin)))
        for k, part in enumerate(self.parts):
            chosen = index == k
            rows[chosen] = part.points(shares[chosen])
        return rows


def _timed(
    corners: Array,
    cuts: Array,
    limits: tuple[Array, Array],
    rate: float,
    joints: Iterable[str],
) -> Trajectory:
    """Return the motion along a path with cuts (k,); it stops at corners whose cut is 0."""
    names = tuple(joints)
    stops = np.flatnonzero(cuts == 0.0)
    parts = [
        _timed_between_stops(corners[a : b + 1], cuts[a : b + 1], limits, rate, names)
        for a, b in zip(stops[:-1].tolist(), stops[1:].tolist(), strict=True)
    ]
    return joined(parts, certified=False)


def _timed_between_stops(
    corners: Array,
    cuts: Array,
    limits: tuple[Array, Array],
    rate: float,
    joints: tuple[str, ...],
) -> Trajectory:
    """Return the motion from the first corner to the last, slowed down until all limits hold."""
    path = _SmoothPath.through(corners, cuts)
    profile = _profile_of(path, limits)
    duration = profile.duration
    if not duration * rate <= MAX_SAMPLES:
        raise TrajectoryError(
            f"the motion takes {duration:.3g} s, which are {duration * rate:.3g} samples at "
            f"{rate:g} Hz (at most {MAX_SAMPLES:.0e})",
            hint="give a higher speed, higher velocity_limits or a lower rate",
        )
    for _ in range(MAX_SLOWDOWNS):
        count = max(1, sample_count(duration, rate))
        rows = path.points(profile.progress(np.arange(count + 1) / count))
        rows[0] = corners[0]
        rows[-1] = corners[-1]
        trajectory = Trajectory(np.arange(count + 1) / rate, rows, joints)
        excess = max(
            float(np.max(trajectory.peak_velocity / limits[0])),
            float(np.sqrt(np.max(trajectory.peak_acceleration / limits[1]))),
        )
        if excess <= 1.0:
            return trajectory
        duration = max(count + 1, count * excess * SLOWDOWN_MARGIN) / rate
    raise TrajectoryError(
        f"no timing of the path keeps the limits (exceeded {excess:.2f} times)",
        hint="give a lower speed or a higher rate",
    )


def _profile_of(path: _SmoothPath, limits: tuple[Array, Array]) -> Profile:
    """Return the fastest progress along a path within the limits, from rest to rest."""
    if len(path.parts) == 1:
        part = path.parts[0]
        distance = np.abs(part.end - part.begin)
        moving = distance > 0.0
        with np.errstate(over="ignore"):  # for a distance of 1e-300 rad the bounds are infinite
            bounds = [float(np.min(limit[moving] / distance[moving])) for limit in limits]
        if not np.isfinite(bounds).all():
            return Profile(0.0, np.asarray)
        return trapezoid(*bounds)
    knots = path.knots()
    timing = fastest_timing(knots, path.points(knots), *limits, np.inf)
    return Profile(timing.duration, lambda phase: timing.progress(phase * timing.duration))
