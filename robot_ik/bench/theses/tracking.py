"""The loop of both experiments: goals in sequence, each solved from the last solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.problem import Problem

SCHEMA = 1
"""Version of the experiments' JSON files. It is raised when a field changes its meaning."""

_FRAMES_PER_UPDATE = 25
"""Frames between two updates of the progress bar. An update takes longer than a solve."""


@dataclass(frozen=True)
class Track:
    """The results of one method on one sequence of goals.

    Attributes:
        frames: Number of goals.
        solved: Number of goals that were met, by MuJoCo's forward pass.
        lost: The first frame that was not met. None if all were met.
        milliseconds: Mean time of a solve.
        iterations: Mean iterations of a solve.
        restarts: Restarts of all solves.
        refused: Whether the method does not support this goal or robot. All numbers are then zero.
    """

    frames: int
    solved: int = 0
    lost: int | None = None
    milliseconds: float = 0.0
    iterations: float = 0.0
    restarts: int = 0
    refused: bool = False

    @property
    def share(self) -> float:
        """Share of the goals that were met."""
        return self.solved / self.frames

    @property
    def passed(self) -> bool:
        """Whether all goals were met."""
        return self.solved == self.frames


def no_progress(_share: float) -> None:
    """Show no progress."""


def track(
    problem: Problem,
    targets: Sequence[Pose],
    start: Array,
    show: Callable[[float], None] = no_progress,
) -> Track:
    """Follow targets.

    Args:
        problem: The prepared problem.
        targets: The targets, in order.
        start: (nq,) start of the first solve.
        show: Called with the share that is done.
    """
    count = len(targets)
    show(0.0)
    problem.solve(start, target=targets[0])  # fills the caches and is not counted
    tolerance = problem.tolerance
    q = start
    solved = 0
    lost = None
    seconds = 0.0
    iterations = 0
    restarts = 0
    for k, target in enumerate(targets):
        solution = problem.solve(q, target=target)
        q = solution.q
        seconds += solution.seconds
        iterations += solution.iterations
        restarts += solution.restarts
        distance, angle = solution.goals[0].error(problem.robot, q)
        if distance <= tolerance.position and angle <= tolerance.angle:
            solved += 1
        elif lost is None:
            lost = k
        if (k + 1) % _FRAMES_PER_UPDATE == 0:
            show((k + 1) / count)
    show(1.0)
    return Track(count, solved, lost, 1e3 * seconds / count, iterations / count, restarts)
