"""Sources of goals without a camera, for ``follow``.

A source counts time from its first ``poll``, so it can be created long before the loop starts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Array, Pose, rotation_z_to
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.robot import Robot

SHORTEST_NORMAL = 1e-12
"""A shorter normal of a plane has no direction."""

Goals = Goal | Sequence[Goal]
"""One goal or several, as ``solve`` takes them."""


class ManualSource:
    """The goal that was set last. Any thread may set it.

    Setting only stores the goal, so front ends and callbacks never wait for the loop.

    Args:
        goal: First goal. None means: keep the position.
    """

    def __init__(self, goal: Goals | None = None) -> None:
        self._goal = goal

    def set(self, goal: Goals | None) -> None:
        """Set a new goal. None means: keep the position."""
        self._goal = goal

    def poll(self, now: float) -> Goals | None:  # noqa: ARG002  # the interface of all sources
        """Return the latest goal, None before the first goal."""
        return self._goal


class ScriptSource:
    """Goals at given times.

    Args:
        steps: Pairs of time and goal in any order. Times are seconds since the first poll. A goal
            of None means: keep the position, as before the first time. The last goal stays.

    Raises:
        InvalidGoalError: There are no steps, or a time is negative, not finite or repeated.
    """

    def __init__(self, steps: Iterable[tuple[float, Goals | None]]) -> None:
        ordered = sorted(((float(time), goal) for time, goal in steps), key=lambda step: step[0])
        self._times = np.array([time for time, _ in ordered])
        self._goals = [goal for _, goal in ordered]
        if not ordered or not np.isfinite(self._times).all() or (self._times < 0.0).any():
            raise InvalidGoalError(
                f"a script of {len(ordered)} steps at {self._times.tolist()} s",
                hint="give at least one (time, goal) with a finite time of 0 s or later",
            )
        if (np.diff(self._times) == 0.0).any():
            raise InvalidGoalError("a script has two goals for one time", hint="keep one of them")
        self._begin: float | None = None

    def poll(self, now: float) -> Goals | None:
        """Return the goal of the latest step at or before ``now``."""
        if self._begin is None:
            self._begin = now
        k = int(np.searchsorted(self._times, now - self._begin, side="right")) - 1
        return self._goals[k] if k >= 0 else None


class CurveSource:
    """A goal that moves along a curve.

    Args:
        frame: The frame that follows, such as "gripper".
        curve: Maps seconds since the first poll to a ``Pose`` in the world, or to a position (3,)
            in metres if the orientation is free.
    """

    def __init__(self, frame: str, curve: Callable[[float], Pose | ArrayLike]) -> None:
        self.frame = frame
        self.curve = curve
        self._begin: float | None = None

    @classmethod
    def circle(
        cls,
        frame: str,
        center: ArrayLike,
        radius: float,
        period: float,
        *,
        normal: ArrayLike = (0.0, 0.0, 1.0),
        wxyz: ArrayLike | None = None,
    ) -> CurveSource:
        """Return a circle, counter-clockwise about its normal.

        Args:
            frame: The frame that follows.
            center: Centre (3,), m.
            radius: Radius, m.
            period: Seconds of one turn.
            normal: Normal (3,) of the plane.
            wxyz: Orientation (4,). None leaves it free.

        Raises:
            InvalidGoalError: A vector or number is not finite, or not positive where it must be.
        """
        plane = _Plane(center, radius, period, normal)

        def position(t: float) -> Array:
            angle = plane.angle(t)
            return plane.point(np.cos(angle), np.sin(angle))

        return cls(frame, _with_orientation(position, wxyz))

    @classmethod
    def lemniscate(
        cls,
        frame: str,
        center: ArrayLike,
        radius: float,
        period: float,
        *,
        normal: ArrayLike = (0.0, 0.0, 1.0),
        wxyz: ArrayLike | None = None,
    ) -> CurveSource:
        """Return a figure of eight (lemniscate of Gerono).

        Args:
            frame: The frame that follows.
            center: Centre (3,), m.
            radius: Half of the length, m. The width is half of the length.
            period: Seconds of one turn.
            normal: Normal (3,) of the plane.
            wxyz: Orientation (4,). None leaves it free.

        Raises:
            InvalidGoalError: A vector or number is not finite, or not positive where it must be.
        """
        plane = _Plane(center, radius, period, normal)

        def position(t: float) -> Array:
            angle = plane.angle(t)
            return plane.point(np.sin(angle), np.sin(angle) * np.cos(angle))

        return cls(frame, _with_orientation(position, wxyz))

    def poll(self, now: float) -> PoseGoal | PositionGoal:
        """Return the goal at the point of the curve for ``now``."""
        if self._begin is None:
            self._begin = now
        return _goal(self.frame, self.curve(now - self._begin))


class RandomSource:
    """Reachable poses in sequence: the poses of random joint angles inside the limits.

    Args:
        robot: The robot.
        frame: The frame. None for the default tool of the robot.
        seed: Seed of the random numbers.
        period: Seconds for which each goal stays.
        free_orientation: Whether the goals are positions instead of poses.

    Raises:
        InvalidGoalError: The period is not positive and finite.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str | None = None,
        *,
        seed: int = 0,
        period: float = 2.0,
        free_orientation: bool = False,
    ) -> None:
        if not (np.isfinite(period) and period > 0.0):
            hint = "the period must be above zero"
            raise InvalidGoalError(f"a new goal every {period} s", hint=hint)
        self.robot = robot
        self.frame = robot.tool if frame is None else frame
        self.period = period
        self.free_orientation = free_orientation
        self._rng = np.random.default_rng(seed)
        self._begin: float | None = None
        self._count = 0
        self._goal: PoseGoal | PositionGoal | None = None

    def poll(self, now: float) -> PoseGoal | PositionGoal:
        """Return the goal of the current period."""
        if self._begin is None:
            self._begin = now
        due = int((now - self._begin) / self.period) + 1
        while self._goal is None or self._count < due:  # skipped goals are drawn too, for the seed
            pose = self.robot.forward(self.robot.sample(self._rng), self.frame)
            self._goal = _goal(self.frame, pose.position if self.free_orientation else pose)
            self._count += 1
        return self._goal


def _goal(frame: str, target: Pose | ArrayLike) -> PoseGoal | PositionGoal:
    if isinstance(target, Pose):
        return PoseGoal.at(frame, target)
    return PositionGoal(frame, position=np.asarray(target, dtype=float))


class _Plane:
    """The plane of a closed curve with its size and period."""

    def __init__(self, center: ArrayLike, radius: float, period: float, normal: ArrayLike) -> None:
        self._center = np.asarray(center, dtype=float)
        axis = np.asarray(normal, dtype=float)
        numbers = np.concatenate([self._center.ravel(), axis.ravel(), [radius, period]])
        length = float(np.linalg.norm(axis))
        is_vector = self._center.shape == (3,) and axis.shape == (3,)
        if not is_vector or not np.isfinite(numbers).all() or length < SHORTEST_NORMAL:
            raise InvalidGoalError(
                f"a curve around {self._center.tolist()} with the normal {axis.tolist()}",
                hint="both are three finite numbers, and the normal is not zero",
            )
        if radius <= 0.0 or period <= 0.0:
            raise InvalidGoalError(
                f"a curve of radius {radius} m and period {period} s",
                hint="both must be above zero",
            )
        self._period = period
        self._axes = radius * rotation_z_to(axis / length)[:, :2].T  # right-handed with the normal

    def angle(self, t: float) -> float:
        """Return the angle at ``t`` seconds."""
        return float(2.0 * np.pi * t / self._period)

    def point(self, x: float, y: float) -> Array:
        """Return a point (3,) by its coordinates, in radii from the centre."""
        return self._center + np.array((x, y)) @ self._axes


def _with_orientation(
    position: Callable[[float], Array], wxyz: ArrayLike | None
) -> Callable[[float], Pose | ArrayLike]:
    """Return a curve of positions, or of poses with one orientation."""
    if wxyz is None:
        return position
    rotation = Pose(wxyz=wxyz)
    return lambda t: Pose(position(t), rotation.wxyz)
