"""The run of a test course of thesis A00: its goal makes one step in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.theses.courses import THESIS_RESULTS, Course

_ROUNDING = 1e-9
"""Frames. The sum of small steps can be slightly below a whole number."""


@dataclass(frozen=True)
class CourseView:
    """A course at one tick.

    Attributes:
        number: Its number in the thesis.
        moves: What the goal does.
        thesis: What the thesis reports of its own solver.
        frame: Frames that the goal has moved.
        frames: Frames of the course.
        place: How far the goal has moved, such as ``20.1°``.
        met: Share of the frames so far in which each instance met the goal, 0 to 1.
        lost: Where each instance first lost the goal. Empty: it has not lost the goal.
    """

    number: int
    moves: str
    thesis: str
    frame: int
    frames: int
    place: str
    met: tuple[float, ...]
    lost: tuple[str, ...]


class CourseRun:
    """Moves the ball along a course and notes which instances meet it.

    Args:
        course: The course.
    """

    def __init__(self, course: Course) -> None:
        self._course = course
        self.begin()

    def begin(self) -> None:
        """Start the course at its first frame."""
        self._passed = 0.0
        self._frame = -1
        self._judged = -1
        self._met: dict[int, int] = {}
        self._lost: dict[int, int] = {}

    def path(self) -> Array:
        """Return positions (n, 3) of the goal along the course."""
        return np.array([target.position for target in self._course.targets])

    def step(self, speed: float) -> Pose:
        """Return the goal of the next frame. A speed above 1 counts as 1: no frame is skipped."""
        last = len(self._course.targets) - 1
        if self._frame >= 0:
            self._passed += min(speed, 1.0)
        self._frame = min(int(self._passed + _ROUNDING), last)
        return self._course.targets[self._frame]

    def judge(self, met: Sequence[bool]) -> None:
        """Note whether each instance meets the goal of a frame. A frame is judged once."""
        if self._frame == self._judged:
            return
        self._judged = self._frame
        for k, is_met in enumerate(met):
            if is_met:
                self._met[k] = self._met.get(k, 0) + 1
            else:
                self._lost.setdefault(k, self._frame)

    def view(self, count: int) -> CourseView:
        """Return what a front end shows of ``count`` instances."""
        course = self._course
        frame = max(self._frame, 0)
        judged = max(self._judged + 1, 1)
        lost = [self._lost.get(k) for k in range(count)]
        return CourseView(
            number=course.number,
            moves=course.moves,
            thesis=THESIS_RESULTS[course.number],
            frame=frame + 1,
            frames=len(course.targets),
            place=course.place(frame),
            met=tuple(self._met.get(k, 0) / judged for k in range(count)),
            lost=tuple("" if at is None else course.place(at) for at in lost),
        )
