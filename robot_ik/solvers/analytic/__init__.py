"""Closed forms: the geometry is recognised from the kinematic tree alone.

Paden-Kahan subproblems on lines in space (Paden 1986; Elias & Wen, IK-Geo, 2022).  All branches are
computed; the answer is the one inside the limits nearest to the start.  At singular poses the free angle
stays as near to the start as can be.  The branches are those of
the exact target: that none is inside the limits does not prove that nothing within tolerance is.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import UnsupportedGoalError
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.kernels import jit
from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.kinematics import clip
from robot_ik.kernels.loop import copy, keep_best, measure
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import (
    BEST_COST,
    BLOCKED,
    CONVERGED,
    COST,
    ITERATION_LIMIT,
    ITERATIONS,
    STALLED,
    STATUS,
    TIME_LIMIT,
    UNREACHABLE,
    open_work,
)
from robot_ik.problem import Problem
from robot_ik.solution import STATUS_OF, Solution, Status
from robot_ik.solvers.analytic.choose import nearest
from robot_ik.solvers.analytic.geometry import BRANCH_NAMES, Family, Form, recognise
from robot_ik.solvers.analytic.planar import planar_two_link
from robot_ik.solvers.analytic.six_axes import spherical_wrist, three_parallel
from robot_ik.solvers.base import Answers, Solver
from robot_ik.solvers.ready import take_start

Array = NDArray[np.float64]

FORM = Layout(
    "Form",
    place="ints",  # (n,) where the chain's joints stand in q
    axes="table",  # (n, 6)
    extra="table",  # (5, 3)
    lower="floats",  # (n,)
    upper="floats",  # (n,)
    start="floats",  # (n,)
    best="floats",  # (n,)
    branches="table",  # (8, n)
    target="table",  # (1, 12) the goal in the world
)
open_form = FORM.open

_PLANAR, _WRIST = int(Family.PLANAR_TWO_LINK), int(Family.SPHERICAL_WRIST)
# What a run is for: the answer; every branch, even for a start at the goal; only a look at the start.
SOLVE, EVERY, LOOK = range(3)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A closed form made ready for one problem; keeps the arrays that the last table points to.

    Attributes:
        form: Which one.
        arrays: By their names in ``FORM``.
        tables: What the kernels take first: tree, goals, work space, form.
        family: The form's number.
        run: ``closed_form`` without numba's look at its arguments.
    """

    form: Form
    arrays: dict[str, Any]
    tables: tuple[Any, Any, Any, Any]
    family: int
    run: Callable[..., None]


@dataclass(frozen=True)
class Analytic(Solver):
    """Every branch in closed form, the nearest to the start inside the limits taken."""

    name: ClassVar[str] = "analytic"
    title: ClassVar[str] = "closed form: planar two-link, spherical wrist, three parallel axes"
    source: ClassVar[str] = "Paden 1986; Elias & Wen 2022"
    goals: ClassVar[tuple[type[Goal], ...]] = (PoseGoal, PositionGoal)

    def applies(self, problem: Problem) -> bool:
        """Whether this robot and goal have a closed form."""
        return self.prepare(problem) is not None

    def prepare(self, problem: Problem) -> Prepared | None:
        """The closed form for a problem, made once; None when there is none."""
        if "analytic" not in problem.prepared:
            problem.prepared["analytic"] = _prepare(problem)
        found: Prepared | None = problem.prepared["analytic"]
        return found

    def _require(self, problem: Problem) -> Prepared:
        prepared = self.prepare(problem)
        if prepared is None:
            self.require_support(problem)
            raise UnsupportedGoalError(
                self.name,
                f"{' and '.join('a ' + g.name for g in problem.goals)} on {problem.robot.name}: "
                "no closed form is known for this chain of joints",
                ("auto", "lm"),
            )
        return prepared

    def solve(self, problem: Problem, start: ArrayLike | None = None) -> Solution:
        prepared = self._require(problem)
        arrays = problem.arrays
        take_start(problem, start)
        began = time.perf_counter()
        budget = problem.budget
        mode = LOOK if budget.iterations < 1 or budget.seconds == 0.0 else SOLVE
        prepared.run(*prepared.tables, prepared.family, mode)
        state = arrays["state"]
        if mode == LOOK and state[STATUS] != CONVERGED:
            state[STATUS] = ITERATION_LIMIT if budget.iterations < 1 else TIME_LIMIT
        number, iterations = state[: ITERATIONS + 1].tolist()
        status = STATUS_OF[number]
        if status is not Status.CONVERGED and problem.out_of_reach():
            status = Status.UNREACHABLE
        return Solution(
            arrays["best"].copy(), status, iterations, 0, time.perf_counter() - began, self.name,
            problem.robot, tuple(problem.goals), problem.target.copy(),
            _trace(arrays) if problem.trace and iterations else None,
        )  # fmt: skip

    def solve_many(self, problem: Problem, targets: Array, starts: Array, answers: Answers) -> None:
        prepared = self._require(problem)
        jit.announce(closed_form_many, f"batches of solver {self.name!r}")
        closed_form_many(
            *prepared.tables, prepared.family, targets, starts, answers.q, answers.status, answers.miss
        )
        answers.status[(answers.status != CONVERGED) & problem.rows_out_of_reach(targets)] = UNREACHABLE

    def branches(self, problem: Problem, start: ArrayLike | None = None) -> list[tuple[str, Array]]:
        """Every branch, inside the limits or not: name and q (nq,); joints off the chain as at ``start``."""
        prepared, arrays = self._require(problem), problem.arrays
        arrays["start"][:] = problem.robot.home if start is None else problem.robot.check_q(start, "start")
        closed_form(*prepared.tables, prepared.family, EVERY)
        names = BRANCH_NAMES[prepared.form.family]
        found: list[tuple[str, Array]] = []
        for row, angles in enumerate(prepared.arrays["branches"]):
            if np.isnan(angles[0]):
                continue
            q = problem.arrays["start"].copy()
            q[prepared.arrays["place"]] = angles
            bits = [(row >> (len(names) - 1 - k)) & 1 for k in range(len(names))]
            found.append(
                (" ".join(f"{n}{'+' if b == 0 else '-'}" for n, b in zip(names, bits, strict=True)), q)
            )
        return found


def _trace(arrays: dict[str, Any]) -> Array:
    """The one row of a closed form's trace."""
    position, angle = arrays["miss"].max(axis=0)
    step = float(np.linalg.norm(arrays["q"] - arrays["start"]))
    return np.array([[1.0, 0.0, arrays["value"][BEST_COST], position, angle, 0.0, step]])


def _prepare(problem: Problem) -> Prepared | None:
    if problem.features or not problem.goals[0].rows.whole:
        return None
    if len(problem.goals) != 1 or not isinstance(problem.goals[0], (PoseGoal, PositionGoal)):
        return None
    if not all(weight > 0.0 for weight in problem.goals[0].weights[: 1 + problem.goals[0].has_angle]):
        return None  # a part that weighs nothing is not asked for, so there is more than the branches
    tree = problem.robot.tree
    node, local = problem.robot.attachment(problem.goals[0].frame)
    form = recognise(tree, node, local)
    if form is None or (form.family is Family.PLANAR_TWO_LINK) != isinstance(problem.goals[0], PositionGoal):
        return None
    n, nodes = len(form.nodes), list(form.nodes)
    arrays: dict[str, Any] = {
        "place": np.ascontiguousarray(tree.qadr[nodes]),
        "axes": form.axes,
        "extra": form.extra,
        "lower": np.ascontiguousarray(tree.lower[tree.vadr[nodes]]),
        "upper": np.ascontiguousarray(tree.upper[tree.vadr[nodes]]),
        "start": np.zeros(n),
        "best": np.zeros(n),
        "branches": np.zeros((8, n)),
        "target": problem.target,
    }
    jit.announce(closed_form, "closed forms")
    tables = (tree.handle, problem.handle, problem.work, FORM.pack(arrays))
    run = jit.entry(closed_form, *tables, int(form.family), SOLVE)
    return Prepared(form, arrays, tables, int(form.family), run)


@outlined
def answer(tree, goal, work, form, family, mode):
    """Solves from work.start, which is the answer if it is at the goal; fills best, status and branches."""
    state, q = work.state, work.q
    state[ITERATIONS] = 0
    copy(work.start, q)
    clip(tree, work.nodes, q)
    within = measure(tree, goal, work)
    keep_best(work)
    state[STATUS] = CONVERGED
    if mode == LOOK or (within and mode == SOLVE):
        if not within:
            state[STATUS] = STALLED
        return
    place, start, branches = form.place, form.start, form.branches
    for j in range(place.shape[0]):
        start[j] = q[place[j]]
    if family == _PLANAR:
        found = planar_two_link(form.axes, form.extra, form.target, start, goal.tolerance[0, 0], branches)
    elif family == _WRIST:
        found = spherical_wrist(form.axes, form.extra, form.target, start, branches)
    else:
        found = three_parallel(form.axes, form.extra, form.target, start, branches)
    state[ITERATIONS] = 1
    row = nearest(branches, start, form.lower, form.upper, form.best)
    if row < 0:
        # No proof: the branches are those of the exact target, and one within tolerance may have others.
        state[STATUS] = BLOCKED if found > 0 else STALLED
        return
    for j in range(place.shape[0]):
        q[place[j]] = form.best[j]
    state[STATUS] = CONVERGED if measure(tree, goal, work) else STALLED
    if state[STATUS] == CONVERGED or work.value[COST] < work.value[BEST_COST]:
        keep_best(work)


@kernel
def closed_form(tree, goals, work, form, family, mode):
    """One solve."""
    answer(open_tree(tree), open_goals(goals), open_work(work), open_form(form), family, mode)


@kernel
def closed_form_many(tree, goals, work, form, family, targets, starts, q, status, miss):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q (n, nq), status, miss (n, 2)."""
    tree, goal, work, form = open_tree(tree), open_goals(goals), open_work(work), open_form(form)
    target, start, best, state, now = goal.target, work.start, work.best, work.state, work.miss
    for row in range(targets.shape[0]):
        for i in range(12):
            target[0, i] = targets[row, i]
        for i in range(start.shape[0]):
            start[i] = starts[row, i]
        answer(tree, goal, work, form, family, SOLVE)
        for i in range(start.shape[0]):
            q[row, i] = best[i]
        status[row] = state[STATUS]
        miss[row, 0], miss[row, 1] = now[0, 0], now[0, 1]
