"""Where goals come from when there is no camera: `GoalSource` implementations for `follow`.

A source counts time from its first `poll`, so that it can be made long before the loop starts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose, rotation_z_to
from robot_ik.goals import Goal, PoseGoal, PositionGoal

if TYPE_CHECKING:
    from robot_ik.robot import Robot

Goals = Goal | Sequence[Goal]
"""One goal or several at once, as ``solve`` takes them; a source does not inspect them."""


class ManualSource:
    """The goal that was set last; may be set from any thread.

    Setting only stores, so front ends and callbacks never wait for the loop.

    Args:
        goal: First goal; None means hold.
    """

    def __init__(self, goal: Goals | None = None) -> None:
        self._goal = goal

    def set(self, goal: Goals | None) -> None:
        """Takes a new goal; None means hold."""
        self._goal = goal

    def poll(self, now: float) -> Goals | None:
        """The newest goal, None before the first."""
        return self._goal


class ScriptSource:
    """Goals at given times.

    Args:
        steps: (time, goal) with times in seconds from the first poll, in any order; a goal of None
            means hold.  Before the first time: hold.  After the last: its goal for ever.

    Raises:
        InvalidGoalError: No steps, a time that is negative or not finite, or one that comes twice.
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
        """The goal of the newest step at or before ``now``."""
        self._begin = now if self._begin is None else self._begin
        k = int(np.searchsorted(self._times, now - self._begin, side="right")) - 1
        return self._goals[k] if k >= 0 else None


class CurveSource:
    """A goal that runs along a curve.

    Args:
        frame: The frame that follows, such as "gripper".
        curve: Seconds since the first poll to a `Pose` in the world, or to a position (3,) in metres
            when the orientation is free.
    """

    def __init__(self, frame: str, curve: Callable[[float], Pose | ArrayLike]) -> None:
        self.frame = frame
        self.curve = curve
        self._begin: float | None = None

    @classmethod
    def circle(
        cls, frame: str, center: ArrayLike, radius: float, period: float, *,
        normal: ArrayLike = (0.0, 0.0, 1.0), wxyz: ArrayLike | None = None,
    ) -> CurveSource:  # fmt: skip
        """A circle of ``radius`` m around ``center`` (3,), once in ``period`` s.

        It runs counter-clockwise about ``normal``; ``wxyz`` (4,) fixes the orientation, None leaves it free.
        """
        shape = lambda angle: (np.cos(angle), np.sin(angle))  # noqa: E731
        return cls(frame, _in_plane(center, radius, period, normal, wxyz, shape))

    @classmethod
    def lemniscate(
        cls, frame: str, center: ArrayLike, radius: float, period: float, *,
        normal: ArrayLike = (0.0, 0.0, 1.0), wxyz: ArrayLike | None = None,
    ) -> CurveSource:  # fmt: skip
        """A figure of eight (lemniscate of Gerono) in the plane of ``normal``.

        ``radius`` m to each side of ``center`` (3,) and half that across, once in ``period`` s;
        ``wxyz`` (4,) fixes the orientation, None leaves it free.
        """
        shape = lambda angle: (np.sin(angle), np.sin(angle) * np.cos(angle))  # noqa: E731
        return cls(frame, _in_plane(center, radius, period, normal, wxyz, shape))

    def poll(self, now: float) -> PoseGoal | PositionGoal:
        """Where the curve is at ``now``."""
        self._begin = now if self._begin is None else self._begin
        return _goal(self.frame, self.curve(now - self._begin))


class RandomSource:
    """Poses that the robot can reach, one after the other: those of random joint angles inside the limits.

    Args:
        robot: Whose poses.
        frame: The frame; None means the robot's default tool.
        seed: Same seed, same goals.
        period: Seconds that each goal lasts.
        free_orientation: Give positions instead of poses.
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
            raise InvalidGoalError(f"a new goal every {period} s", hint="the period must be above zero")
        self.robot = robot
        self.frame = robot.tool if frame is None else frame
        self.period = period
        self.free_orientation = free_orientation
        self._rng = np.random.default_rng(seed)
        self._begin: float | None = None
        self._count = 0
        self._goal: PoseGoal | PositionGoal | None = None

    def poll(self, now: float) -> PoseGoal | PositionGoal:
        """The goal of the running period."""
        self._begin = now if self._begin is None else self._begin
        due = int((now - self._begin) / self.period) + 1
        while self._goal is None or self._count < due:  # skipped ones are drawn too: the seed decides
            pose = self.robot.forward(self.robot.sample(self._rng), self.frame)
            self._goal = _goal(self.frame, pose.position if self.free_orientation else pose)
            self._count += 1
        return self._goal


def _goal(frame: str, where: Pose | ArrayLike) -> PoseGoal | PositionGoal:
    if isinstance(where, Pose):
        return PoseGoal.at(frame, where)
    return PositionGoal(frame, position=np.asarray(where, dtype=float))


def _in_plane(
    center: ArrayLike, radius: float, period: float, normal: ArrayLike, wxyz: ArrayLike | None,
    shape: Callable[[float], tuple[float, float]],
) -> Callable[[float], Pose | ArrayLike]:  # fmt: skip
    """A curve of seconds in a plane; ``shape``: both coordinates over ``radius`` of an angle."""
    middle, axis = np.asarray(center, dtype=float), np.asarray(normal, dtype=float)
    numbers = np.concatenate([middle.ravel(), axis.ravel(), [radius, period]])
    length = float(np.linalg.norm(axis))
    if middle.shape != (3,) or axis.shape != (3,) or not np.isfinite(numbers).all() or length < 1e-12:
        raise InvalidGoalError(
            f"a curve around {middle.tolist()} with the normal {axis.tolist()}",
            hint="both are three finite numbers, and the normal is not zero",
        )
    if radius <= 0.0 or period <= 0.0:
        raise InvalidGoalError(
            f"a curve of radius {radius} m and period {period} s", hint="both must be above zero"
        )
    plane = radius * rotation_z_to(axis / length)[:, :2].T  # right-handed with the normal
    position = lambda t: middle + np.array(shape(2.0 * np.pi * t / period)) @ plane  # noqa: E731
    rotation = None if wxyz is None else Pose(wxyz=wxyz)
    return position if rotation is None else lambda t: Pose(position(t), rotation.wxyz)
