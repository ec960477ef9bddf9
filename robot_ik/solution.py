"""``Solution``: the result of a solve."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.compiled_problem import moved_goal
from robot_ik.errors import NotConvergedError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.kernels import workspace

if TYPE_CHECKING:
    from robot_ik.robot import Robot

Array = NDArray[np.float64]


class Status(enum.IntEnum):
    """How a solve ended; only CONVERGED means that every goal that is needed is within tolerance."""

    CONVERGED = workspace.CONVERGED
    STALLED = workspace.STALLED
    ITERATION_LIMIT = workspace.ITERATION_LIMIT
    TIME_LIMIT = workspace.TIME_LIMIT
    UNREACHABLE = workspace.UNREACHABLE
    BLOCKED_BY_LIMITS = workspace.BLOCKED
    NUMERICAL = workspace.NUMERICAL

    @property
    def meaning(self) -> str:
        """One sentence for people."""
        return _MEANING[self]


def short_numbers(q: Array) -> str:
    """Joint angles (nq,) for people, on one line: of many the first."""
    more = f" … {len(q) - 8} more" if len(q) > 8 else ""
    return np.array2string(q[:8], precision=4, max_line_width=200)[:-1] + more + "]"


# By number, which is quicker than asking the enumeration.
STATUS_OF = {int(status): status for status in Status}

_MEANING = {
    Status.CONVERGED: "every goal that is needed is within tolerance",
    Status.STALLED: "no step improves it any more; the nearest point found is kept",
    Status.ITERATION_LIMIT: "the iteration budget ran out; the nearest point found is kept",
    Status.TIME_LIMIT: "the time budget ran out; the nearest point found is kept",
    Status.UNREACHABLE: "proven out of reach; the nearest point found is kept",
    Status.BLOCKED_BY_LIMITS: "joint limits hold it back; the nearest point found is kept",
    Status.NUMERICAL: "numbers left the finite range; the nearest point found is kept",
}


@dataclass(frozen=True)
class Miss:
    """Honest distance to the goals, unweighted: the largest of all that are not soft.

    Attributes:
        position: Metres; 0 when no goal asks for a position.
        angle: Radians; 0 when no goal asks for an orientation.
    """

    position: float
    angle: float


@dataclass(frozen=True)
class Step:
    """One trace row: state after one step of the solver."""

    iteration: int
    restart: int
    cost: float
    position: float
    angle: float
    damping: float
    step: float


@dataclass(eq=False)
class Solution:
    """Joint angles found for goals.

    Attributes:
        q: (nq,) the best found, inside the limits, never wrapped.
        status: How the solve ended.
        iterations, restarts: Steps of all tries; random restarts used.
        seconds: Wall-clock time of the solve.
        solver: Name of the method that found q.
        given, targets: The goals as they were given to the problem, and the rows (g, 12) that they were moved
            to since; ``goals`` puts the two together.
    """

    q: Array
    status: Status
    iterations: int
    restarts: int
    seconds: float
    solver: str
    robot: Robot
    given: tuple[Goal, ...]
    targets: Array
    trace_rows: Array | None = None

    @property
    def converged(self) -> bool:
        """Whether every goal that is needed is within tolerance."""
        return self.status is Status.CONVERGED

    @cached_property
    def goals(self) -> tuple[Goal, ...]:
        """The goals that were solved for, with the targets they had then."""
        return tuple(moved_goal(goal, row) for goal, row in zip(self.given, self.targets, strict=True))

    @cached_property
    def misses(self) -> tuple[Miss, ...]:
        """Miss of each goal, measured by MuJoCo's own forward pass on first access."""
        return tuple(self._measure(goal, row) for goal, row in zip(self.given, self.targets, strict=True))

    @property
    def miss(self) -> Miss:
        """The largest miss over all goals that are needed, by MuJoCo's own forward pass on first access."""
        needed = [miss for goal, miss in zip(self.goals, self.misses, strict=True) if not goal.soft]
        return Miss(max([0.0, *(m.position for m in needed)]), max([0.0, *(m.angle for m in needed)]))

    @cached_property
    def trace(self) -> tuple[Step, ...]:
        """One row for each step, when a trace was asked for."""
        rows = self.trace_rows if self.trace_rows is not None else np.empty((0, 7))
        return tuple(Step(int(r[0]), int(r[1]), *(float(v) for v in r[2:])) for r in rows)

    def require(self) -> Solution:
        """This solution if it converged.

        Raises:
            NotConvergedError: Carries the solution; says how far off it is and why.
        """
        if self.converged:
            return self
        miss = self.miss
        raise NotConvergedError(
            f"{self.solver} did not reach the goal ({self.status.name}: {self.status.meaning}); nearest: "
            f"{1000 * miss.position:.2f} mm, {np.degrees(miss.angle):.3f}° off after {self.iterations} steps",
            self,
        )

    def _measure(self, goal: Goal, row: Array) -> Miss:
        whole = goal.rows.whole  # the targets of others are in the goals themselves
        target = Pose.from_rotation(row[3:].reshape(3, 3), row[:3]) if whole else goal.target
        return Miss(*goal.miss(self.robot, self.q, target))

    def __repr__(self) -> str:
        return (
            f"Solution({self.status.name}, q={short_numbers(self.q)}, solver={self.solver!r}, "
            f"iterations={self.iterations}, restarts={self.restarts}, seconds={self.seconds:.2g})"
        )
