"""``PreparedAvoiding``: a prepared method whose solutions must be free of collisions.

The method solves without regard to collisions. If its solution touches, a free one is searched:

    closed form      the nearest free branch. If no branch is free and no branch is singular, it is
                     proven that no free solution exists.
    seven hinges     first a closed form for each angle of the last joint, see ``swept.py``
    other methods    the same method from other starts, first near the start, then anywhere;
                     between these tries limited steps move a solution out of its collisions

Only a solution that keeps the margin is CONVERGED. The compiled check decides this. If its verdict
is UNDECIDED, MuJoCo decides. If no solution is found, limited steps lead to a free posture near the
goal, ``Solution.nearest_free``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.distances import announce
from robot_ik.geometry import Array
from robot_ik.kernels import collision, jit
from robot_ik.kernels.limited_step import KEPT_SHARE
from robot_ik.model import random_q
from robot_ik.robot import Robot
from robot_ik.solution import COLLIDING, Solution, Status
from robot_ik.solvers.analytic import Analytic, PreparedClosedForm
from robot_ik.solvers.analytic.branch import listed_branches
from robot_ik.solvers.analytic.five_joint import PreparedFiveJoint
from robot_ik.solvers.analytic.swept import PreparedSwept, last_joint_of
from robot_ik.solvers.base import BatchResult, FoundBranch, Prepared, run_each
from robot_ik.solvers.limited_step import LimitedStep

if TYPE_CHECKING:
    from robot_ik.budget import Budget
    from robot_ik.problem import Problem

# Starts that are tried after a solution that touches, if the budget has no limit of restarts.
_MAX_STARTS = 200
# The share of the way to a random posture grows by this from start to start.
_SHARE_STEP = 0.25
# Random restarts of the method from each start.
_RESTARTS_EACH = 10
# After each this many starts limited steps move one touching solution out of its collisions.
# Restarts cost less, but fail where nearly all solutions touch.
_RESTARTS_PER_LEAD = 10
# Largest number of limited steps that move one solution out of its collisions.
_MAX_LIMITED_STEPS = 80
# Largest change of a joint in a limited step, rad or m.
_LARGEST_STEP = 0.2
# m. A limited step moves touching parts apart by this at most.
_WAY_OUT = 0.02
# m. Margin of limited steps beyond that of the condition: parts that touch are not free.
_EXTRA_MARGIN = 1e-5
# If a limited step reduces the cost by a smaller share, the cost counts as constant.
_MIN_DECREASE = 1e-3
# Below this smallest singular value of its Jacobian a branch is one of a continuum.
_SINGULAR = 1e-6
# Methods whose solution may be replaced by another branch.
_AUTO = "auto"
_WITH_BRANCHES = (_AUTO, "analytic")


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
        self._swept: PreparedSwept | None = None
        last = last_joint_of(problem) if problem.solver.name == _AUTO else None
        if last is not None:
            self._swept = PreparedSwept(last, problem, self._memory, collisions.margin)
        announce()
        example = np.zeros(problem.robot.nq)
        arguments = self._address, example, collisions.margin
        self._verdict = jit.entry(collision.posture_verdict, *arguments)
        self._start = problem.search.arrays["start"]
        self._rows = moved_coordinates(problem)
        self._step: LimitedStep | None = None

    def is_free(self, q: Array) -> bool:
        """Return whether ``q`` (nq,) keeps the margin."""
        verdict = self._verdict(self._address, q, self.collisions.margin)
        if verdict == collision.UNDECIDED:
            return bool(self.collisions.clearance(q).distance >= self.collisions.margin)
        return bool(verdict == collision.FREE)

    def run(self, problem: Problem, budget: Budget) -> Solution:
        """Solve, and search for a free solution if the first solution touches."""
        if self._swept is not None:
            swept = self._swept.run(problem, budget)
            if swept is not None:
                swept.avoidance = self.collisions
                return swept
        solution = self.method.run(problem, budget)
        solution.avoidance = self.collisions
        if solution.status is not Status.CONVERGED or self.is_free(solution.q):
            return solution
        began = time.perf_counter() - solution.seconds
        start = self._start.copy()
        seed = problem.seed
        try:
            best = self._free_branch(problem, solution, start)
            search = _Search(problem, solution, budget, began, start)
            if best is None:
                best = self._from_other_starts(search)
            if best.status in COLLIDING:
                best = self._lead_out(search, best.q) or self._lead_out(search, start) or best
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
        """Solve all rows, then search for free solutions of the rows that touch."""
        if self._swept is not None:
            run_each(self, problem, targets, starts, results, budget)
            return
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

    def _from_other_starts(self, search: _Search) -> Solution:
        """Return a free solution from another start, else the first as BLOCKED_BY_COLLISION."""
        problem = search.problem
        first = search.first
        rng = np.random.default_rng(problem.seed)
        budget = search.budget
        max_starts = (
            _MAX_STARTS if budget.restarts is None else max(0, budget.restarts - first.restarts)
        )
        touching = first.q
        for attempt in range(max_starts):
            if search.is_over:
                break
            if attempt % _RESTARTS_PER_LEAD == _RESTARTS_PER_LEAD - 1:
                free = self._lead_out(search, touching)
                if free is not None:
                    return free
            problem.seed = int(rng.integers(1 << 31))
            share = min(1.0, _SHARE_STEP * (attempt + 1))
            self._start[...] = self._between(problem.robot, search.start, share, rng)
            solution = self.method.run(
                problem, search.remaining_budget(min(_RESTARTS_EACH, max_starts - attempt - 1))
            )
            first.restarts += 1
            search.count(solution)
            if solution.converged and self.is_free(solution.q):
                return search.with_totals(solution)
            if solution.converged:
                touching = solution.q
            if budget.restarts is not None and first.restarts >= budget.restarts:
                break
        first.status = Status.BLOCKED_BY_COLLISION
        return first

    def _lead_out(self, search: _Search, q: Array) -> Solution | None:
        """Move a posture (nq,) out of its collisions and towards the goals by limited steps.

        Returns:
            A free solution, or None. Then a free posture with the smallest cost so far is
            ``nearest_free`` of the first solution.
        """
        problem = search.problem
        step = self._limited_step(problem)
        posture = q
        cost = np.inf
        status = Status.ITERATION_LIMIT
        for _ in range(_MAX_LIMITED_STEPS):
            if search.is_over or status is not Status.ITERATION_LIMIT:
                break
            before = posture
            status = step.advance(posture)
            search.first.iterations += 1
            is_slow = step.cost > (1.0 - _MIN_DECREASE) * cost
            posture = step.posture
            cost = step.cost
            if np.array_equal(before, posture) or (is_slow and self.is_free(posture)):
                break
        if not np.isfinite(posture).all() or not self.is_free(posture):
            return None
        if cost < search.nearest_cost:
            search.nearest_cost = cost
            nearest = search.first.at(posture, Status.BLOCKED_BY_COLLISION)
            search.first.nearest_free = nearest
        # The method decides whether the goals are met, and removes the remaining errors.
        self._start[...] = posture
        solution = self.method.run(problem, search.remaining_budget(0))
        search.count(solution)
        if solution.converged and self.is_free(solution.q):
            return search.with_totals(solution)
        return None

    def _limited_step(self, problem: Problem) -> LimitedStep:
        """Return the limited steps of the problem, prepared on first use."""
        if self._step is None:
            margin = self.collisions.margin / KEPT_SHARE + _EXTRA_MARGIN
            self._step = LimitedStep(
                problem, self.collisions, _LARGEST_STEP, margin=margin, way_out=_WAY_OUT
            )
        return self._step

    def _between(self, robot: Robot, start: Array, share: float, rng: np.random.Generator) -> Array:
        """Return a posture between ``start`` and a random one; only joints that move goals change.

        Balls and free bases take their random values: a share of a quaternion is not a rotation.
        """
        q = start.copy()
        drawn = random_q(robot.tree, start, rng)
        single = robot.nq == robot.nv
        moved = start + share * (drawn - start) if single else drawn
        q[self._rows] = moved[self._rows]
        return robot.apply_couplings(robot.clip(q))


@dataclass
class _Search:
    """A search for a free solution.

    Attributes:
        problem: The problem.
        first: The first solution, which touches. It has the totals of iterations and restarts.
        budget: Budget of the whole search.
        began: When the search began, on ``time.perf_counter``.
        start: Start (nq,) of the problem.
        nearest_cost: Cost of the nearest free posture so far.
    """

    problem: Problem
    first: Solution
    budget: Budget
    began: float
    start: Array
    nearest_cost: float = np.inf

    @property
    def seconds(self) -> float | None:
        """Seconds that are left; None without a limit."""
        if self.budget.seconds is None:
            return None
        return self.budget.seconds - (time.perf_counter() - self.began)

    @property
    def is_over(self) -> bool:
        """Whether the budget is used up."""
        seconds = self.seconds
        is_late = seconds is not None and seconds <= 0.0
        return is_late or self.first.iterations >= self.budget.iterations

    def remaining_budget(self, restarts: int) -> Budget:
        """Return the remaining budget, with a number of restarts."""
        seconds = self.seconds
        return replace(
            self.budget,
            iterations=max(0, self.budget.iterations - self.first.iterations),
            seconds=None if seconds is None else max(0.0, seconds),
            restarts=restarts,
        )

    def count(self, solution: Solution) -> None:
        """Add the iterations and restarts of a solve to the totals."""
        self.first.iterations += solution.iterations
        self.first.restarts += solution.restarts

    def with_totals(self, solution: Solution) -> Solution:
        """Return a free solution with the iterations and restarts of the whole search."""
        solution.iterations = self.first.iterations
        solution.restarts = self.first.restarts
        return solution


def moved_coordinates(problem: Problem) -> Array:
    """Return the indices in q (k,) of the joints that move a goal."""
    tree = problem.robot.tree
    nodes = problem.compiled.block.arrays["nodes"]
    widths = np.diff(np.append(tree.qadr, problem.robot.nq))
    return np.concatenate(
        [np.arange(tree.qadr[k], tree.qadr[k] + widths[k]) for k in nodes] or [np.zeros(0)]
    ).astype(np.int64)
