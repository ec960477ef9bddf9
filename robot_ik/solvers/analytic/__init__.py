"""Closed forms: the geometry is recognised from the kinematic tree alone.

Paden-Kahan subproblems on lines in space (Paden 1986; Elias & Wen, IK-Geo, 2022), and the swivel angle of
a limb (Tolani, Goswami & Badler 2000).  All branches are computed; the solution is the one inside the limits
nearest to the start.  At singular poses the free angle stays as near to the start as can be.  Where there is
no solution, a proof is tried that nothing within tolerance can be reached (``proofs.py``).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.kernels import jit
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.bundle import address_of
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.loop import give_row, take_row
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import Q_WIDTH, Tree, open_tree
from robot_ik.problem import Budget, Problem
from robot_ik.solution import STATUS_OF, Solution, Status
from robot_ik.solvers.analytic import proofs, subproblems
from robot_ik.solvers.analytic.limb import limb
from robot_ik.solvers.analytic.recognise import (
    BRANCH_NAMES,
    Family,
    Form,
    limit_edges,
    middle_rotations,
    recognise,
)
from robot_ik.solvers.analytic.six_axes import planar_two_link, spherical_wrist, three_parallel
from robot_ik.solvers.base import BatchResult, Solver, take_start

_PLANAR, _WRIST = int(Family.PLANAR_TWO_LINK), int(Family.SPHERICAL_WRIST)
_SHOULDER = int(Family.SPHERICAL_SHOULDER)


@outlined
def solve_axes(tree, goal, work, form, family, mode):
    """Solves from work.start, which is the solution if it is at the goal; fills best, status and branches."""
    if not subproblems.measure_start(tree, goal, work, form, mode):
        return
    subproblems.clear(form.branches)
    if family == _PLANAR:
        planar_two_link(form, goal.tolerance[0, 0])
    elif family == _WRIST:
        spherical_wrist(form, form.target)
    elif family == _SHOULDER:
        subproblems.invert(form.target, form.inverse)
        spherical_wrist(form, form.inverse)
    else:
        three_parallel(form)
    inside, exists = subproblems.nearest(form)
    subproblems.take_branch(tree, goal, work, form, inside, exists)


@kernel
def closed_form(tree, goals, work, form, family, mode):
    """One solve."""
    solve_axes(
        open_tree(tree), open_goals(goals), ws.open_work(work), subproblems.open_form(form), family, mode
    )


@kernel
def closed_form_many(tree, goals, work, form, family, targets, starts, q, status, miss, iterations):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q, status, miss (n, 2), iterations."""
    tree, goal, work = open_tree(tree), open_goals(goals), ws.open_work(work)
    form = subproblems.open_form(form)
    for row in range(targets.shape[0]):
        take_row(goal, work, targets, starts, row)
        solve_axes(tree, goal, work, form, family, subproblems.SOLVE)
        give_row(work, q, miss, iterations, row)
        status[row] = work.state[ws.STATUS]


@outlined
def solve_limb(tree, goal, work, form, mode):
    """Solves from work.start; fills best and status, and the branches if they are asked for."""
    if not subproblems.measure_start(tree, goal, work, form, mode):
        return
    if mode == subproblems.EVERY:
        subproblems.clear(form.branches)
        # First without limits: a branch that is nowhere inside them is still a branch.
        limb(form, form.least, form.most, mode)
    inside, exists = limb(form, form.lower, form.upper, mode)
    if mode != subproblems.EVERY:
        subproblems.take_branch(tree, goal, work, form, inside, exists)


@kernel
def closed_limb(tree, goals, work, form, _family, mode):
    """One solve."""
    solve_limb(open_tree(tree), open_goals(goals), ws.open_work(work), subproblems.open_form(form), mode)


@kernel
def closed_limb_many(tree, goals, work, form, _family, targets, starts, q, status, miss, iterations):
    """One solve for each row of targets (n, 12), starts (n, nq): fills q, status, miss (n, 2), iterations."""
    tree, goal, work = open_tree(tree), open_goals(goals), ws.open_work(work)
    form = subproblems.open_form(form)
    for row in range(targets.shape[0]):
        take_row(goal, work, targets, starts, row)
        solve_limb(tree, goal, work, form, subproblems.SOLVE)
        give_row(work, q, miss, iterations, row)
        status[row] = work.state[ws.STATUS]


Array = NDArray[np.float64]


class Prepared:
    """A closed form made ready for one problem.

    Attributes:
        run: Solves, in a mode, without numba's inspection of its arguments; ``batch`` solves many.
        prove: Whether no joint angles bring the target within tolerance, as far as is proven.
    """

    def __init__(self, form: Form, problem: Problem) -> None:
        self.form, self.arrays = form, _arrays(form, problem.robot.tree, problem.target)
        # Held beside their addresses, which the kernels take.
        self.tables = (*problem.tables, subproblems.FORM.pack(self.arrays))
        addresses = tuple(address_of(table) for table in self.tables)
        # The kernels of a limb take longer to compile.
        is_limb = form.family is Family.LIMB
        kernel, batch = (closed_limb, closed_limb_many) if is_limb else (closed_form, closed_form_many)
        jit.announce(kernel, "closed forms")
        first = *addresses, int(form.family)
        self.run = partial(jit.entry(kernel, *first, subproblems.SOLVE), *first)
        self.batch: partial[None] = partial(batch, *first)
        prove, taken = proofs.PROOFS[form.family], (addresses[1], addresses[3])
        jit.announce(prove, "proofs of unreachable goals")
        self.prove: Callable[[], bool] = partial(jit.entry(prove, *taken), *taken)


@dataclass(frozen=True)
class Analytic(Solver):
    """Every branch in closed form, the nearest to the start inside the limits taken."""

    name: ClassVar[str] = "analytic"
    title: ClassVar[str] = "closed form: two links, six axes (wrist, shoulder, three parallel), 7-axis limb"
    source: ClassVar[str] = "Paden 1986; Tolani et al. 2000; Elias & Wen 2022"
    goals: ClassVar[tuple[type[Goal], ...]] = (PoseGoal, PositionGoal)

    def unsupported(self, problem: Problem) -> str:
        if self.made_for(problem) is not None:
            return ""
        goals = " and ".join(goal.with_article for goal in problem.goals)
        lacking = f"{goals} on {problem.robot.name}: {_what_has_a_form(problem)}"
        return super().unsupported(problem) or lacking

    def make(self, problem: Problem) -> Prepared | None:
        """The closed form made ready; None when this robot and goal have none."""
        goal = problem.given[0]
        if problem.features or len(problem.given) != 1 or not self.supports(goal):
            return None
        asked = (goal.has_position, goal.has_angle)
        if any(part and not weight > 0.0 for part, weight in zip(asked, goal.weights, strict=True)):
            return None  # a part that weighs nothing is not asked for, so there is more than the branches
        node, local = problem.robot.attachment(goal.frame)
        form = recognise(problem.robot.tree, node, local, whole=goal.has_angle)
        return None if form is None else Prepared(form, problem)

    def attempt(self, problem: Problem, start: ArrayLike | None, budget: Budget) -> Solution:
        kept = problem.made.get(id(self))
        prepared: Prepared = (kept and kept[1]) or self.load(problem)
        arrays = problem.arrays
        take_start(problem, start)
        began = time.perf_counter()
        mode = subproblems.START_ONLY if budget.iterations < 1 or budget.seconds == 0.0 else subproblems.SOLVE
        prepared.run(mode)
        number, iterations = arrays["state"][: ws.ITERATIONS + 1].tolist()
        status = STATUS_OF[number]
        if number != ws.CONVERGED:
            if (mode == subproblems.SOLVE and prepared.prove()) or _is_too_far(problem, problem.target)[0]:
                status = Status.UNREACHABLE
            elif mode == subproblems.START_ONLY:
                status = Status.ITERATION_LIMIT if budget.iterations < 1 else Status.TIME_LIMIT
        return Solution(
            arrays["best"].copy(), status, iterations, 0, time.perf_counter() - began, self.name,
            problem.robot, problem.given, problem.target.copy(),
            _trace(arrays) if problem.trace and iterations else None,
        )  # fmt: skip

    def attempt_many(
        self, problem: Problem, targets: Array, starts: Array, results: BatchResult, budget: Budget
    ) -> None:
        prepared: Prepared = self.load(problem)
        if budget.iterations < 1 or budget.seconds is not None:
            super().attempt_many(problem, targets, starts, results, budget)
            return
        jit.announce(prepared.batch.func, f"batches of solver {self.name!r}")
        prepared.batch(targets, starts, results.q, results.status, results.miss, results.iterations)
        missed = np.flatnonzero(results.status != ws.CONVERGED)
        if not len(missed):
            return
        for row in missed:
            problem.target[0] = targets[row]
            if prepared.prove():
                results.status[row] = ws.UNREACHABLE
        results.status[(results.status != ws.CONVERGED) & _is_too_far(problem, targets)] = ws.UNREACHABLE

    def branches(self, problem: Problem, start: ArrayLike | None = None) -> list[tuple[str, Array]]:
        """Every branch, inside the limits or not: name and q (nq,); joints off the chain as at ``start``.

        Raises:
            UnsupportedGoalError, ModelError, ProblemInUseError: As ``solve``.
        """
        with problem.in_use():
            prepared: Prepared = self.load(problem)
            take_start(problem, start)
            prepared.run(subproblems.EVERY)
            names = BRANCH_NAMES[prepared.form.family]
            signs = itertools.product("+-", repeat=len(names))
            found: list[tuple[str, Array]] = []
            for chosen, angles in zip(signs, prepared.arrays["branches"], strict=False):
                if not np.isnan(angles[0]):
                    q = problem.arrays["start"].copy()
                    q[prepared.arrays["qadr"]] = angles
                    found.append((" ".join(map("".join, zip(names, chosen, strict=True))), q))
            return found


def _is_too_far(problem: Problem, targets: Array) -> NDArray[np.bool_]:
    """(n,) whether targets (n, 12) of the one goal are farther than all links laid end to end."""
    reach = problem.arrays["reach"][0]
    return np.asarray(np.linalg.norm(targets[:, :3] - reach[:3], axis=1) > reach[3])


def _trace(arrays: dict[str, Any]) -> Array:
    """The one row of a closed form's trace."""
    position, angle = arrays["miss"].max(axis=0)
    step = float(np.linalg.norm(arrays["q"] - arrays["start"]))
    return np.array([[1.0, 0.0, arrays["value"][ws.BEST_COST], position, angle, 0.0, step]])


def _what_has_a_form(problem: Problem) -> str:
    """What goals of the problem's frame have a closed form, of which its own are none."""
    goal, tree = problem.given[0], problem.robot.tree
    node, local = problem.robot.attachment(goal.frame)
    texts = {True: "one pose: give position and orientation", False: "one position: give no orientation"}
    known = [text for whole, text in texts.items() if recognise(tree, node, local, whole=whole)]
    if not known:
        return "no closed form is known for this chain of joints"
    return f"its closed form is for {', or '.join(known)}"


def _arrays(form: Form, tree: Tree, target: Array) -> dict[str, Any]:
    """What the kernels work on, by their names in ``FORM``."""
    qadr: list[int] = []
    limits: list[tuple[float, float]] = []
    for node in form.nodes:
        width, v = Q_WIDTH[int(tree.kind[node])], int(tree.vadr[node])
        qadr += range(int(tree.qadr[node]), int(tree.qadr[node]) + width)
        limits += [(float(tree.lower[v]), float(tree.upper[v]))] * width
    n = len(qadr)
    lower, upper = (np.array(side) for side in zip(*limits, strict=True))
    return subproblems.FORM.zeros({"n": n}) | {
        "qadr": np.array(qadr, dtype=np.int64),
        "axes": form.axes, "extra": form.extra, "groups": form.groups, "target": target,
        "lower": lower, "upper": upper, "least": np.full(n, -np.inf), "most": np.full(n, np.inf),
        "middle_rotations": middle_rotations(form), "edges": limit_edges(form, lower, upper),
    }  # fmt: skip
