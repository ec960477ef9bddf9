"""Goals one after the other, each solved from the solution to the last: the loop of both experiments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.problem import Problem

#: Version of the experiments' JSON files; raised when a field changes its meaning.
SCHEMA = 1

# Updates the progress bar this often, frames: an update costs more than a solve.
_LOOK = 25


@dataclass(frozen=True)
class Track:
    """How one method fared on one row of goals.

    Attributes:
        frames, solved: How many goals there were, and were met, by MuJoCo's forward pass.
        lost: The first frame that was not met; None when all were.
        milliseconds, iterations: Mean of one solve; ``restarts``: in all.
        refused: The method does not serve this kind of goal or robot; all else is zero.
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
        return self.solved / self.frames

    @property
    def passed(self) -> bool:
        return self.solved == self.frames


def track(
    problem: Problem,
    targets: Sequence[Pose],
    start: Array,
    show: Callable[[float], None] = lambda share: None,
) -> Track:
    """Follows ``targets`` from ``start`` (nq,) on; ``show`` is called with the share that is done."""
    count = len(targets)
    show(0.0)
    problem.solve(start, target=targets[0])  # warm caches: not counted
    allowed = problem.tolerance
    q, solved, lost, seconds, iterations, restarts = start, 0, None, 0.0, 0, 0
    for k, target in enumerate(targets):
        solution = problem.solve(q, target=target)
        q = solution.q
        seconds += solution.seconds
        iterations += solution.iterations
        restarts += solution.restarts
        metres, radians = solution.goals[0].error(problem.robot, q)  # by MuJoCo
        if metres <= allowed.position and radians <= allowed.angle:
            solved += 1
        elif lost is None:
            lost = k
        if (k + 1) % _LOOK == 0:
            show((k + 1) / count)
    show(1.0)
    return Track(count, solved, lost, 1e3 * seconds / count, iterations / count, restarts)
