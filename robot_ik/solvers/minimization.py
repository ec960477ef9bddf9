"""Minimisation by a variable metric, projected on the active limits: G(q) = ½ |r|² over the box.

Zhao & Badler (Inverse kinematics positioning using nonlinear programming for highly articulated
figures, ACM Transactions on Graphics 13(4), 1994): BFGS steps d = H g, g = −∇G = Jᵀr, in a metric
from which the active linear constraints are projected (Rosen 1960), with a line search.

H begins as a multiple of the identity. The steps update it to the inverse of the Hessian. The axis
n of an *active* limit is taken out of H, so that H n = 0 and each step stays along the limit
(Goldfarb, Extension of Davidon's variable metric method to maximization under linear inequality and
equality constraints, SIAM J. Applied Mathematics 17(4), 1969):

    hold      H ← H − H n nᵀH / nᵀH n            release      H ← H + h n nᵀ
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import difference
from robot_ik.kernels.linalg import pushed_out
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.search import (
    NO_LIMIT,
    advance,
    apply_step,
    begin,
    copy,
    measure,
    proceed,
    step_bounds,
)
from robot_ik.kernels.tree import BALL
from robot_ik.solvers.iterative import IterativeSolver, run_layout
from robot_ik.solvers.options import option, options_layout

if TYPE_CHECKING:
    from robot_ik.problem import Problem

# Smallest cosine between a step and the change of the slope for an update of the metric.
_MIN_CURVATURE = 1e-8
# Largest number of points that the line search tries along one direction.
_TRIALS = 30
# Smallest factor by which the line search shortens a step.
_MIN_SHORTENING = 0.1
# Largest factor by which the line search shortens a step.
_MAX_SHORTENING = 0.5


@dataclass(frozen=True)
class Minimization(IterativeSolver):
    """Every step reduces the cost, without solving a system of equations."""

    # The defaults were chosen for few steps, mean and 99th percentile, on 400 cold poses each of
    # PUMA 560, UR5e and Panda, to 1 µm and 1 µrad. Curvatures of 0.1 to 0.99, descents of 30 to 150
    # steps and patience of 3 to 12 were tried.
    first_steps: int = option(
        150, "steps granted to the descent from the start", lower=1, upper=100_000
    )
    random_steps: int = option(
        150, "steps granted to a descent from a random point", lower=1, upper=100_000
    )
    patience: int = option(8, "steps without progress that end a descent", lower=1, upper=1000)
    progress: float = option(
        0.02, "smallest drop of the cost that counts as progress", lower=0.0, upper=1.0
    )
    draws: int = option(4, "random points of which a descent takes the best", lower=1, upper=1000)
    max_step: float = option(
        1.0,
        "largest change of a joint in one step",
        lower=1e-4,
        upper=1e6,
        unit="rad",
        usual=(0.0, 2.0),
    )
    decrease: float = option(
        1e-4, "share of the promised descent that a step must bring", lower=1e-9, upper=0.4
    )
    curvature: float = option(
        0.3,
        "share of the slope that may be left after a step",
        lower=0.1,
        upper=0.999,
        usual=(0.1, 0.999),
    )

    name: ClassVar[str] = "bfgs"
    title: ClassVar[str] = "minimisation by a variable metric (BFGS), projected on the limits"
    source: ClassVar[str] = "Zhao & Badler, ACM Transactions on Graphics 13(4), 1994"
    partial_goals: ClassVar[bool] = True
    capabilities: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness"})
    default_restarts: ClassVar[int] = 200
    polish_undoes_steps: ClassVar[bool] = False

    def unsupported(self, problem: Problem) -> str:
        if unsupported := super().unsupported(problem):
            return unsupported
        tree = problem.robot.tree
        for k in problem.compiled.block.arrays["nodes"]:
            if tree.kind[k] == BALL and tree.upper[tree.vadr[k]] < math.pi:
                return f"the limited ball joint {problem.robot.joints[int(k)]!r}"
        return ""


OPTIONS = options_layout(Minimization)
# With m rows of the residual, u columns, nq coordinates.
WORK = Layout(
    "BfgsWork",
    updates="int",  # of the metric since it was reset
    scale="float",  # length of a step along the slope, by the linear model
    accepted="floats nq",  # q before the step
    jacobian="table m u",
    metric="table u u",  # the inverse Hessian H
    direction="floats u",  # H g
    gradient="floats u",  # Jᵀr at q
    before="floats u",  # gradient at ``accepted``
    moved="floats u",  # from ``accepted`` to q, in units of the step
    image="floats u",  # H y
    lower="floats u",
    upper="floats u",
    active="ints u",  # 1 for a joint whose limit is active
)
RUN = run_layout("BfgsRun", WORK, OPTIONS)
open_run = RUN.open


# The metric


@outlined
def measure_gradient(tree, goals, search, work):
    """Write the gradient at q, which has been measured, and the scale of a step along it.

    The scale is gᵀg / |J g|², the minimum of the linear model along g (Cauchy 1847).
    """
    goal_jacobian(tree, goals, search, False, work.jacobian)
    rows, columns = work.jacobian.shape
    square = 0.0
    for u in range(columns):
        slope = 0.0
        for r in range(rows):
            slope += work.jacobian[r, u] * search.residual[r]
        work.gradient[u] = slope
        square += slope * slope
    curvature = 0.0
    for r in range(rows):
        moved = 0.0
        for u in range(columns):
            moved += work.jacobian[r, u] * work.gradient[u]
        curvature += moved * moved
    work.scale = square / curvature if curvature > 0.0 else 1.0


@outlined
def reset_metric(work):
    """Make the metric the scale of the slope times the identity, with no active limit."""
    columns = work.metric.shape[0]
    for u in range(columns):
        for i in range(columns):
            work.metric[u, i] = 0.0
        work.metric[u, u] = work.scale
        work.active[u] = 0
    work.updates = 0


@outlined
def hold(work, u):
    """Make the limit of joint ``u`` active."""
    metric = work.metric
    columns = metric.shape[0]
    inverse = 1.0 / metric[u, u] if metric[u, u] > 0.0 else 0.0
    for i in range(columns):
        if i != u:
            part = inverse * metric[i, u]
            for j in range(columns):
                metric[i, j] -= part * metric[u, j]
    for i in range(columns):
        metric[i, u] = 0.0
        metric[u, i] = 0.0
    work.active[u] = 1


@outlined
def update_metric(work):
    """Update H by Broyden, Fletcher, Goldfarb and Shanno (1970). Overwrites work.before.

    With s = moved, y = before − gradient and σ = sᵀy:
    H ← (1 − s yᵀ/σ) H (1 − y sᵀ/σ) + s sᵀ/σ. Nothing is done where σ is not clearly positive,
    because H would lose its definiteness.
    """
    metric = work.metric
    s = work.moved
    y = work.before
    image = work.image
    columns = s.shape[0]
    curvature = 0.0
    steps = 0.0
    changes = 0.0
    for u in range(columns):
        y[u] -= work.gradient[u]
        curvature += s[u] * y[u]
        steps += s[u] * s[u]
        changes += y[u] * y[u]
    if not curvature > _MIN_CURVATURE * math.sqrt(steps * changes):
        return
    square = 0.0
    for i in range(columns):
        image[i] = 0.0
        for j in range(columns):
            image[i] += metric[i, j] * y[j]
        square += image[i] * y[i]
    inverse = 1.0 / curvature
    factor = inverse * (1.0 + inverse * square)
    for i in range(columns):
        for j in range(columns):
            metric[i, j] += factor * s[i] * s[j] - inverse * (image[i] * s[j] + s[i] * image[j])
    work.updates += 1


# Limits and direction


@outlined
def constrain(tree, goals, search, work):
    """Make limits active that the slope points beyond; release those that it points away from."""
    step_bounds(tree, goals, search.q, work.lower, work.upper)
    for u in range(work.gradient.shape[0]):
        leaving = pushed_out(work.lower[u], work.upper[u], work.gradient[u]) != 0
        if leaving and work.active[u] == 0:
            hold(work, u)
        elif work.active[u] != 0 and not leaving:
            work.metric[u, u] = work.scale
            work.active[u] = 0


@outlined
def choose_direction(search, work):
    """Write H g to work.direction; hold the limits that it crosses; return its slope."""
    direction = work.direction
    columns = direction.shape[0]
    for _ in range(columns + 1):
        for i in range(columns):
            s = 0.0
            for j in range(columns):
                s += work.metric[i, j] * work.gradient[j]
            direction[i] = s
        crossed = False
        for u in range(columns):
            if work.active[u] == 0 and pushed_out(work.lower[u], work.upper[u], direction[u]) != 0:
                hold(work, u)
                crossed = True
        if not crossed:
            break
    search.pressed = 0
    for u in range(columns):
        search.pressed += work.active[u]
    return slope_along(work)


@inlined
def slope_along(work):
    """Return the slope gᵀd along work.direction."""
    slope = 0.0
    for u in range(work.direction.shape[0]):
        slope += work.gradient[u] * work.direction[u]
    return slope


# The line search


@outlined
def try_step(tree, goals, search, work, share):
    """Measure ``accepted`` plus a share of the direction, inside the limits.

    Writes search.step and work.moved. Returns the descent that the slope predicts for the part of
    the step inside the limits.
    """
    step = search.step
    copy(work.accepted, search.q)
    for u in range(step.shape[0]):
        step[u] = min(max(share * work.direction[u], work.lower[u]), work.upper[u])
    apply_step(tree, goals, search)
    difference(tree, work.accepted, search.q, search.dq)
    promised = 0.0
    for u in range(step.shape[0]):
        work.moved[u] = search.dq[goals.dofs[u]] / goals.joint_scale[u]
        promised += work.before[u] * work.moved[u]
    measure(tree, goals, search)
    return promised


@outlined
def line_search(tree, goals, search, work, options, slope):
    """Descend along the direction until cost and slope have decreased enough (Wolfe 1969).

    Returns whether a lower point was found; q, step, gradient and moved are then those of the
    point. A direction that meets limits is clipped to them, and searched for a lower cost only.
    """
    cost = search.cost
    longest = 0.0
    for u in range(work.direction.shape[0]):
        longest = max(longest, abs(work.direction[u]))
    share = min(1.0, options.max_step / longest)
    good = 0.0
    bad = 0.0
    for _ in range(_TRIALS):
        promised = try_step(tree, goals, search, work, share)
        won = cost - search.cost
        if promised > 0.0 and won >= options.decrease * promised:
            measure_gradient(tree, goals, search, work)
            cut = False
            for u in range(work.direction.shape[0]):
                cut = cut or search.step[u] != share * work.direction[u]
            eased = slope_along(work) <= options.curvature * slope
            if eased or cut or 2.0 * share * longest > options.max_step:
                return True
            good = share
            share = 2.0 * share if bad == 0.0 else 0.5 * (good + bad)
        else:
            bad = share
            if good > 0.0:
                share = 0.5 * (good + bad)
            else:  # the minimum of the parabola through both costs and the slope
                minimum = 0.5 * promised / (promised - won)
                share *= min(max(minimum, _MIN_SHORTENING), _MAX_SHORTENING)
    if good > 0.0:
        try_step(tree, goals, search, work, good)
        measure_gradient(tree, goals, search, work)
    return good > 0.0


@outlined
def bfgs_step(tree, goals, search, work, options):
    """Write one step downhill to search.step. If there is none, write 0 and end the descent."""
    cost = search.cost
    if search.steps == 0:
        measure_gradient(tree, goals, search, work)
        reset_metric(work)
    copy(search.q, work.accepted)
    for _ in range(2):
        constrain(tree, goals, search, work)
        slope = choose_direction(search, work)
        copy(work.gradient, work.before)
        lower = slope > 0.0 and line_search(tree, goals, search, work, options, slope)
        if lower:
            update_metric(work)
        copy(work.accepted, search.q)  # ``advance`` takes the step from here
        search.cost = cost
        if lower:
            return
        if work.updates == 0:
            break
        reset_metric(work)  # the metric gives no descent at this point, so try the slope itself
    for u in range(search.step.shape[0]):
        search.step[u] = 0.0
    search.stalls = NO_LIMIT


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    begin(run.tree, run.goals, run.search)
    while proceed(run.tree, run.goals, run.search):
        bfgs_step(run.tree, run.goals, run.search, run.work, run.options)
        advance(run.tree, run.goals, run.search)
