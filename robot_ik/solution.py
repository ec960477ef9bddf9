"""``Solution``: the result of a solve."""

from __future__ import annotations

import enum
import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.errors import NotConvergedError
from robot_ik.geometry import Array
from robot_ik.goals import Goal, at_matrix
from robot_ik.kernels import search

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.collision.scene import Clearance
    from robot_ik.robot import Robot


class Status(enum.IntEnum):
    """How a solve ended. Only CONVERGED means that all hard goals are within tolerance."""

    CONVERGED = search.CONVERGED
    STALLED = search.STALLED
    ITERATION_LIMIT = search.ITERATION_LIMIT
    TIME_LIMIT = search.TIME_LIMIT
    UNREACHABLE = search.UNREACHABLE
    BLOCKED_BY_LIMITS = search.BLOCKED
    NUMERICAL = search.NUMERICAL
    BLOCKED_BY_COLLISION = search.BLOCKED_BY_COLLISION
    NO_FREE_BRANCH = search.NO_FREE_BRANCH

    @property
    def meaning(self) -> str:
        """The meaning in one sentence."""
        if self is Status.CONVERGED:
            return "every goal that is needed is within tolerance"
        return f"{_CAUSE[self]}; the nearest point found is kept"


# m. A position with a smaller error is reached.
_POSITION_REACHED = 1e-6


def short_numbers(q: Array) -> str:
    """Return joint angles (nq,) on one line: at most the first eight."""
    more = f" … {len(q) - 8} more" if len(q) > 8 else ""
    return np.array2string(q[:8], precision=4, max_line_width=200)[:-1] + more + "]"


# By number. A lookup is faster than a call of the enumeration.
STATUS_OF = {int(status): status for status in Status}
_CAUSE = {
    Status.STALLED: "no step reduces the error any more",
    Status.ITERATION_LIMIT: "the iteration budget ran out",
    Status.TIME_LIMIT: "the time budget ran out",
    Status.UNREACHABLE: "proven out of reach",
    Status.BLOCKED_BY_LIMITS: "joint limits hold it back",
    Status.NUMERICAL: "numbers left the finite range",
    Status.BLOCKED_BY_COLLISION: "collisions are in the way of every solution that was found",
    Status.NO_FREE_BRANCH: "proven: every branch of the closed form collides",
}
COLLIDING = (Status.BLOCKED_BY_COLLISION, Status.NO_FREE_BRANCH)


@dataclass(frozen=True)
class Deviation:
    """Unweighted distance from a goal, or the largest of several.

    Attributes:
        position: Metres. 0 for a goal without a position.
        angle: Radians. 0 for a goal without an orientation.
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
        q: (nq,) joint angles nearest to the goals, inside the limits, never wrapped.
        status: How the solve ended.
        iterations: Steps of all tries.
        restarts: Random restarts.
        seconds: Wall-clock time of the solve.
        solver: Name of the method that found q.
        given: The goals as given to the problem.
        targets: The matrices (g, 4, 4) of their parts in this solve. ``goals`` joins the two.
        avoidance: The condition on collisions. None without one.
        nearest_free: If collisions prevent a solution: of the free configurations that limited
            steps found, the nearest to the goals. None if they found none.
        angle_bound: Radians, or None if nothing is proven. No configuration inside the limits with
            the position of this one has a smaller angle to the wanted orientation.
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
    avoidance: CollisionAvoidance | None = None
    angle_bound: float | None = None
    # Not an argument: it costs nothing for solutions without a collision.
    nearest_free: Solution | None = field(default=None, init=False)

    def at(self, q: Array, status: Status) -> Solution:
        """Return a solution of the same solve with other joint angles (nq,) and status."""
        return replace(self, q=q, status=status, trace_rows=None)

    @property
    def converged(self) -> bool:
        """Whether every goal that is needed is within tolerance."""
        return self.status is Status.CONVERGED

    @cached_property
    def goals(self) -> tuple[Goal, ...]:
        """The goals with the targets they had in this solve."""
        first = itertools.accumulate((len(goal.parts) for goal in self.given), initial=0)
        return tuple(
            at_matrix(goal, goal.rows(self.robot), self.targets[k])
            for goal, k in zip(self.given, first, strict=False)
        )

    @cached_property
    def errors(self) -> tuple[Deviation, ...]:
        """Error of each goal, measured by MuJoCo's forward kinematics on first access."""
        return tuple(Deviation(*goal.error(self.robot, self.q)) for goal in self.goals)

    @property
    def error(self) -> Deviation:
        """Largest error of the goals that are not soft, measured by MuJoCo on first access."""
        needed = [
            error for goal, error in zip(self.given, self.errors, strict=True) if not goal.soft
        ]
        return Deviation(
            position=max((error.position for error in needed), default=0.0),
            angle=max((error.angle for error in needed), default=0.0),
        )

    @cached_property
    def clearance(self) -> Clearance:
        """The nearest pair of parts at q, measured by MuJoCo on first access.

        Without a condition on collisions these are the robot's own parts, and the geoms that its
        model fixes to the world.
        """
        if self.avoidance is not None:
            return self.avoidance.clearance(self.q)
        # Imported here, because it loads the kernels of collision checks: 50 ms.
        from robot_ik.collision.scene import Scene

        return Scene(self.robot).clearance(self.q)

    @cached_property
    def trace(self) -> tuple[Step, ...]:
        """Trace of the solve, one row for each step. Empty without ``trace=True``."""
        rows = [] if self.trace_rows is None else self.trace_rows.tolist()
        return tuple(
            Step(int(iteration), int(restart), *rest) for iteration, restart, *rest in rows
        )

    @property
    def meaning(self) -> str:
        """Sentence with the meaning of the status, or with the orientation error."""
        if self.status is not Status.UNREACHABLE or self.angle_bound is None:
            return self.status.meaning
        angle_deg = math.degrees(self.error.angle)
        if self.error.position <= _POSITION_REACHED:
            return (
                f"position reached; the orientation error of {angle_deg:.1f}° "
                "is the smallest possible for this arm"
            )
        return (
            "position proven out of reach; the nearest position is kept, "
            f"with an orientation error of {angle_deg:.1f}°"
        )

    def require(self) -> Solution:
        """Return this solution if it converged.

        Raises:
            NotConvergedError: It did not. The error has the distance and the reason.
        """
        if self.converged:
            return self
        distance = f"{1000 * self.error.position:.2f} mm, {np.degrees(self.error.angle):.3f}° away"
        if self.status in COLLIDING and self.clearance.pair is not None:
            first, second = self.clearance.pair
            distance += f", {first} and {second} {1000 * self.clearance.distance:.1f} mm apart"
        if self.nearest_free is not None:
            error = self.nearest_free.error
            distance += (
                f"; nearest without a collision: {1000 * error.position:.2f} mm, "
                f"{np.degrees(error.angle):.3f}° away"
            )
        raise NotConvergedError(
            f"{self.solver} did not reach the goal ({self.status.name}: {self.meaning}); "
            f"nearest: {distance} after {self.iterations} steps",
            self,
        )

    def __repr__(self) -> str:
        return (
            f"Solution({self.status.name}, q={short_numbers(self.q)}, solver={self.solver!r}, "
            f"iterations={self.iterations}, restarts={self.restarts}, seconds={self.seconds:.2g})"
        )
