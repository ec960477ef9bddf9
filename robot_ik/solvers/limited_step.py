"""``LimitedStep``: a step of differential inverse kinematics that keeps away from collisions."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.distances import MAX_NEAR_PAIRS
from robot_ik.geometry import Array
from robot_ik.kernels import jit, limited_step
from robot_ik.solution import Solution, Status

if TYPE_CHECKING:
    from robot_ik.problem import Problem

DETECTION = 0.05
"""m. Pairs nearer than this beyond the margin have a row in the step."""

GAIN = 0.85
"""Share of the distance beyond the margin that a step may use."""

WAY_OUT = 0.002
"""m. A step moves a pair that is nearer than the margin apart by this at most.

It is the speed of a real arm that follows a goal: 0.2 m/s at 100 Hz.
"""

DAMPING = 1e-4
"""Damping of the step, in the units of the residual (rad)."""

DAMPING_PER_COST = 0.5
"""Further damping per unit of cost, rad²: half the squared residual."""

_STATUS = {
    limited_step.MOVED: Status.ITERATION_LIMIT,
    limited_step.AT_GOAL: Status.CONVERGED,
    limited_step.BLOCKED: Status.BLOCKED_BY_COLLISION,
    limited_step.NOT_FINITE: Status.NUMERICAL,
}


class LimitedStep:
    """Single steps of a problem that keep away from collisions.

    Goals of different priorities count by their weights only. The object shares the memory of the
    problem, and keeps no reference to the problem.
    """

    name = "limited step"

    def __init__(
        self,
        problem: Problem,
        collisions: CollisionAvoidance,
        largest_step: ArrayLike,
        *,
        margin: float | None = None,
        way_out: float = WAY_OUT,
    ) -> None:
        """Prepare the kernel.

        Args:
            problem: The problem with the goals. Each step uses their current targets.
            collisions: The condition.
            largest_step: Largest change (nv,) of each degree of freedom in a step, rad or m.
            margin: Smallest allowed distance, m. None for that of the condition.
            way_out: A step moves a pair that is nearer than the margin apart by this at most, m.
        """
        self._robot = problem.robot
        self._collisions = collisions
        margin = collisions.margin if margin is None else margin
        goals = problem.compiled.block
        sizes = {**problem.sizes, "r": MAX_NEAR_PAIRS, "s": problem.sizes["u"] + 1}
        self._step = limited_step.STEP.allocate(sizes)
        self._step["margin"] = margin
        self._step["detection"] = margin + DETECTION
        self._step["gain"] = GAIN
        self._step["way_out"] = way_out
        self._step["damping"] = DAMPING
        self._step["damping_per_cost"] = DAMPING_PER_COST
        largest = np.broadcast_to(np.asarray(largest_step, dtype=float), problem.robot.nv)
        self._step.arrays["largest"][...] = largest[goals.arrays["dofs"]]
        self._run = limited_step.RUN.allocate(
            given={
                "tree": problem.robot.tree.block,
                "goals": goals,
                "search": problem.search,
                "collision": collisions.memory(),
                "step": self._step,
            }
        )
        self._address = self._run.address
        jit.announce(limited_step.limited_step, "steps away from collisions")
        self._entry = jit.entry(limited_step.limited_step, self._address)
        self._search = problem.search
        self._start = problem.search.arrays["start"]
        self._best = problem.search.arrays["best"]
        self._target = problem.search.arrays["target"].reshape(-1, 4, 4)

    def advance(self, q: Array) -> Status:
        """Take one step from ``q`` (nq,) to ``posture``."""
        self._start[...] = q
        return _STATUS[self._entry(self._address)]

    @property
    def posture(self) -> Array:
        """Copy of the posture (nq,) after the last step."""
        return self._best.copy()

    @property
    def cost(self) -> float:
        """Half the squared residual after the last step."""
        return float(self._search["cost"])

    def solve(self, problem: Problem, q: Array) -> Solution:
        """Return the posture after one step from ``q`` (nq,) for the targets of the problem."""
        began = time.perf_counter()
        status = self.advance(q)
        return Solution(
            self.posture,
            status,
            1,
            0,
            time.perf_counter() - began,
            self.name,
            self._robot,
            problem.given,
            self._target.copy(),
            avoidance=self._collisions,
        )
