"""``PreparedAvoiding``: a prepared method whose solutions must be free of collisions.

The method solves without regard to collisions. If its solution touches, another one is searched:

    closed form      the nearest free branch. If none is free or singular, that is a proof.
    other methods    the same method from other starts, first near the start, then anywhere

Only a solution that keeps the margin is CONVERGED. The compiled check decides. If it
cannot, MuJoCo does.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.distances import announce
from robot_ik.geometry import Array
from robot_ik.kernels import collision, jit
from robot_ik.model import random_q
from robot_ik.robot import Robot
from robot_ik.solution import Solution, Status
from robot_ik.solvers.analytic import Analytic, PreparedClosedForm
from robot_ik.solvers.analytic.branch import listed_branches
from robot_ik.solvers.analytic.five_joint import PreparedFiveJoint
from robot_ik.solvers.base import BatchResult, FoundBranch, Prepared

if TYPE_CHECKING:
    from robot_ik.budget import Budget
    from robot_ik.problem import Problem

# Starts that are tried after a solution that touches, if the budget has no limit of restarts.
_MAX_STARTS = 200
# The share of the way to a random posture grows by this from start to start.
_SHARE_STEP = 0.25
# Random restarts of the method from each start.
_RESTARTS_EACH = 10
# Below this smallest singular value of its Jacobian a branch is one of a continuum.
_SINGULAR = 1e-6
# Methods whose solution may be replaced by another branch.
_WITH_BRANCHES = ("auto", "analytic")


class PreparedAvoiding:
    """A prepared method with a condition on collisions.

    Args:
        method: The method, prepared for the problem.
        problem: The problem.
        collisions: The condition.
    """

    def __init__(self, method: Prepared, problem: Problem, collisions: CollisionAvoidance) -> None:
        self.name = method.name
        self.proves_best = method.proves_best
        self.method = method
        self.collisions = collisions
        self._closed_form: PreparedClosedForm | PreparedFiveJoint | None = None
        if problem.solver.name in _WITH_BRANCHES and not Analytic().unsupported(problem):
            self._closed_form = Analytic().prepare(problem)
        self._memory = collisions.memory()
        self._address = self._memory.address
        announce()
        example = np.zeros(problem.robot.nq)
        arguments = self._address, example, collisions.margin
        self._verdict = jit.entry(collision.posture_verdict, *arguments)
        self._start = problem.search.arrays["start"]
        self._rows = moved_numbers(problem)

    def is_free(self, q: Array) -> bool:
        """Return whether ``q`` (nq,) keeps the margin."""
        verdict = self._verdict(self._address, q, self.collisions.margin)
        if verdict == collision.UNDECIDED:
            return bool(self.collisions.clearance(q).distance >= self.collisions.margin)
        return bool(verdict == collision.FREE)

    def run(self, problem: Problem, budget: Budget) -> Solution:
        """Solve, and look for a free solution if the first one touches."""
        solution = self.method.run(problem, budget)
        solution.avoidance = self.collisions
        if solution.status is not Status.CONVERGED or self.is_free(solution.q):
            return solution
        began = time.perf_counter() - solution.seconds
        start = self._start.copy()
        seed = problem.seed
        try:
            best = self._free_branch(problem, solution, start)
            if best is None:
                best = self._from_other_starts(problem, solution, budget, start, began)
        finally:
            self._start[...] = start
            problem.seed = seed
        best.seconds = time.perf_counter() - began
        best.avoidance = self.collisions
        return best

    def run_many(
        self,
        problem: Problem,
        targets: Array,
        starts: Array,
        results: BatchResult,
        budget: Budget,
    ) -> None:
        """Solve all rows, then look for free solutions of the rows that touch."""
        self.method.run_many(problem, targets, starts, results, budget)
        converged = np.flatnonzero(results.status == Status.CONVERGED)
        free = self.collisions.free(results.q[converged].reshape(-1, problem.robot.nq))
        for row in converged[~free]:
            problem.search.arrays["target"][...] = targets[row]
            self._start[...] = starts[row]
            solution = self.run(problem, budget)
            results.q[row] = solution.q
            results.status[row] = solution.status
            results.error[row] = solution.error.position, solution.error.angle
            results.iterations[row] = solution.iterations
            results.restarts[row] = solution.restarts

    def branches(self) -> list[FoundBranch]:
        """Return the branches of a closed form, free or not."""
        if self._closed_form is None:
            raise RuntimeError("branches are known only for the solver 'analytic'")
        return self._closed_form.branches()

    def _free_branch(self, problem: Problem, touching: Solution, start: Array) -> Solution | None:
        """Return the nearest free branch, or the proof that none exists; None without either."""
        if self._closed_form is None:
            return None
        robot = problem.robot
        branches = listed_branches(robot, self._closed_form.branches(), start, limits=True)
        for branch in branches:
            if self.is_free(branch.q):
                self._start[...] = branch.q
                solution = self._closed_form.run(problem, problem.budget)
                # At a singular pose the closed form is exact only to the square root of rounding.
                if solution.converged and self.is_free(solution.q):
                    solution.iterations += touching.iterations
                    solution.restarts += touching.restarts
                    return solution
        if any(self._is_singular(problem, branch.q) for branch in branches):
            return None
        for branch in branches:
            if self.collisions.clearance(branch.q).distance >= self.collisions.margin:
                return None
        touching.status = Status.NO_FREE_BRANCH
        return touching

    def _is_singular(self, problem: Problem, q: Array) -> bool:
        """Return whether a branch is one of a continuum of solutions."""
        jacobian = problem.robot.jacobian(q, problem.given[0].frame)
        rows = jacobian[:3] if problem.given[0].weights[1] == 0.0 else jacobian
        moving = rows[:, np.abs(rows).max(axis=0) > 0.0]
        values = np.linalg.svd(moving, compute_uv=False)
        return bool(values[: moving.shape[1]].min(initial=np.inf) < _SINGULAR)

    def _from_other_starts(
        self, problem: Problem, first: Solution, budget: Budget, start: Array, began: float
    ) -> Solution:
        """Return a free solution from another start, else ``first`` as BLOCKED_BY_COLLISION."""
        rng = np.random.default_rng(problem.seed)
        max_starts = (
            _MAX_STARTS if budget.restarts is None else max(0, budget.restarts - first.restarts)
        )
        for attempt in range(max_starts):
            seconds = None
            if budget.seconds is not None:
                seconds = budget.seconds - (time.perf_counter() - began)
            if first.iterations >= budget.iterations or (seconds is not None and seconds <= 0.0):
                break
            problem.seed = int(rng.integers(1 << 31))
            share = min(1.0, _SHARE_STEP * (attempt + 1))
            self._start[...] = self._between(problem.robot, start, share, rng)
            rest = replace(
                budget,
                iterations=budget.iterations - first.iterations,
                seconds=seconds,
                restarts=min(_RESTARTS_EACH, max_starts - attempt - 1),
            )
            solution = self.method.run(problem, rest)
            first.iterations += solution.iterations
            first.restarts += 1 + solution.restarts
            if solution.converged and self.is_free(solution.q):
                solution.iterations = first.iterations
                solution.restarts = first.restarts
                return solution
            if budget.restarts is not None and first.restarts >= budget.restarts:
                break
        first.status = Status.BLOCKED_BY_COLLISION
        return first

    def _between(self, robot: Robot, start: Array, share: float, rng: np.random.Generator) -> Array:
        """Return a posture on the way from ``start`` to a random one; only joints that matter move.

        Balls and free bases turn all the way: a share of a quaternion is no rotation.
        """
        q = start.copy()
        drawn = random_q(robot.tree, start, rng)
        single = robot.nq == robot.nv
        moved = start + share * (drawn - start) if single else drawn
        q[self._rows] = moved[self._rows]
        return robot.apply_couplings(robot.clip(q))


def moved_numbers(problem: Problem) -> Array:
    """Return which numbers of q (k,) belong to joints that move a goal."""
    tree = problem.robot.tree
    nodes = problem.compiled.block.arrays["nodes"]
    widths = np.diff(np.append(tree.qadr, problem.robot.nq))
    return np.concatenate(
        [np.arange(tree.qadr[k], tree.qadr[k] + widths[k]) for k in nodes] or [np.zeros(0)]
    ).astype(np.int64)
