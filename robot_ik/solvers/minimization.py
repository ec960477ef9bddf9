"""Minimisation by a variable metric, projected on the active limits: G(q) = ½ |r|² over the joint box.

Zhao & Badler (Inverse kinematics positioning using nonlinear programming for highly articulated figures,
ACM Transactions on Graphics 13(4), 1994): BFGS steps d = H g, g = −∇G = Jᵀr, in a metric from which the
active linear constraints are projected (Rosen 1960; Goldfarb 1969), with a line search.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import workspace as ws
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import difference
from robot_ik.kernels.linalg import pushed_out
from robot_ik.kernels.loop import advance, apply_step, begin, copy, measure, proceed, step_bounds
from robot_ik.kernels.residuals import goal_jacobian, open_goals
from robot_ik.kernels.tree import BALL, open_tree
from robot_ik.kernels.vectors import cross, dot, minus, plus, scaled, three
from robot_ik.solvers.legacy_base import IterativeSolver, option, options_of

# Cones of balls as constraints of a variable metric.
# A ball whose rotation is as large as its cone allows would leave it along that rotation's axis n, body axes:
# ``work.outward``.  Held there, it moves along the edge, and n moves with it: the metric is carried from one
# edge point to the next by the shortest rotation between their axes, and slopes are compared without their
# parts along n, which the edge takes up.  (The edge is curved: the parts along n, whose size does not go to
# zero at the minimum, would spoil the update of the metric.)

# A ball this near to the edge of its cone, rad, is on it; one with a smaller cone does not move at all.
AT_CONE = 1e-9


@pure
def is_cone(tree, goal, u):
    """Whether ``u`` is the first coordinate of a ball that has a cone."""
    v = goal.dofs[u]
    k = tree.dof_node[v]
    return tree.kind[k] == BALL and tree.vadr[k] == v and tree.upper[v] < math.pi


@pure
def edge_axis(tree, goal, q, u):
    """Axis of the ball's rotation where that is as large as its cone allows, else zero."""
    v = goal.dofs[u]
    a = tree.qadr[tree.dof_node[v]]
    x, y, z = q[a + 1], q[a + 2], q[a + 3]
    sine = math.sqrt(x**2 + y**2 + z**2)
    if not sine > 0.0 or 2.0 * math.atan2(sine, abs(q[a])) < tree.upper[v] - AT_CONE:
        return 0.0, 0.0, 0.0
    return scaled(math.copysign(1.0, q[a]) / sine, (x, y, z))


@pure
def part(vector, u):
    """The ball's three coordinates of a vector (nu,)."""
    return vector[u], vector[u + 1], vector[u + 2]


@pure
def put_part(vector, u, a):
    """Puts them back."""
    vector[u], vector[u + 1], vector[u + 2] = a


@pure
def leaves_cone(work, vector, u):
    """Whether ``vector`` would take the ball out of the cone at whose edge it stands."""
    return dot(part(work.outward, u), part(vector, u)) > 0.0


@outlined
def hold_cone(work, u):
    """Makes the cone of the ball whose first coordinate is ``u`` active."""
    metric, normal, image, n = work.metric, part(work.outward, u), work.rhs, work.metric.shape[0]
    for i in range(n):
        image[i] = dot(normal, three(metric, i, u))
    square = dot(normal, part(image, u))
    inverse = 1.0 / square if square > 0.0 else 0.0
    for i in range(n):
        for j in range(n):
            metric[i, j] -= inverse * image[i] * image[j]
    work.side[u] = 1


@outlined
def release_cone(work, u):
    """Gives the direction of a cone back to the metric."""
    normal = work.outward
    for i in range(u, u + 3):
        for j in range(u, u + 3):
            work.metric[i, j] += work.value[ws.SCALE] * normal[i] * normal[j]
    work.side[u] = 0


@outlined
def slope_left(tree, goal, work):
    """The slope at work.q along work.search_direction, less what the edges of the held cones take up."""
    gradient, search_direction = work.gradient, work.search_direction
    left = 0.0
    for u in range(search_direction.shape[0]):
        left += gradient[u] * search_direction[u]
        if work.side[u] != 0 and is_cone(tree, goal, u):
            axis = edge_axis(tree, goal, work.q, u)
            left -= dot(axis, part(gradient, u)) * dot(axis, part(search_direction, u))
    return left


@pure
def rotated(a, v, k):
    """a + v × a + k v × (v × a): Rodrigues' rotation with v = sine · axis, k = 1 / (1 + cosine)."""
    c = cross(v, a)
    return plus(plus(a, c), scaled(k, cross(v, c)))


@outlined
def transport(tree, goal, work):
    """Takes metric, work.moved and work.before of the held cones from work.accepted along to work.q."""
    metric, moved, before = work.metric, work.moved, work.before
    n = metric.shape[0]
    for u in range(n):
        if work.side[u] == 0 or not is_cone(tree, goal, u):
            continue
        old, new = part(work.outward, u), edge_axis(tree, goal, work.q, u)
        cosine = dot(old, new)
        if cosine < 0.5:  # off the edge, or too far along it to be the same constraint
            release_cone(work, u)
            continue
        v, k = cross(old, new), 1.0 / (1.0 + cosine)
        for vector in (moved, before):
            across = minus(part(vector, u), scaled(dot(old, part(vector, u)), old))
            put_part(vector, u, rotated(across, v, k))
        for i in range(n):
            column = metric[u, i], metric[u + 1, i], metric[u + 2, i]
            metric[u, i], metric[u + 1, i], metric[u + 2, i] = rotated(column, v, k)
        for i in range(n):
            row = metric[i, u], metric[i, u + 1], metric[i, u + 2]
            metric[i, u], metric[i, u + 1], metric[i, u + 2] = rotated(row, v, k)
        put_part(work.outward, u, new)
        # So that before − gradient is without its part along the axis here, too.
        put_part(before, u, plus(part(before, u), scaled(dot(new, part(work.gradient, u)), new)))


# The metric of a variable-metric method, projected on the limits that are active.
# ``work.metric`` (nu, nu) is H: the step is d = H g with g = Jᵀr, the descent direction.  It begins as
# a multiple of the identity and is updated to the inverse of the Hessian by the steps that are taken
# (``update_metric``).
#
# A limit that is *active* has its direction n taken out of H, so that H n = 0 and every step keeps along
# it (Rosen's projection in the metric: Goldfarb, Extension of Davidon's variable metric method to
# maximization under linear inequality and equality constraints, SIAM J. Applied Mathematics 17(4), 1969):
#
#     hold      H ← H − H n nᵀH / nᵀH n            release      H ← H + h n nᵀ
#
# n is a coordinate for hinges and slides; the cones of balls are above.

# Least cosine between a step and the change of slope along it for the metric to be updated from them.
_LEAST_CURVATURE = 1e-8


@outlined
def measure_gradient(tree, goal, work):
    """At work.q, which has been measured: work.gradient = Jᵀr, and the step along it that the goals ask for.

    That step is value[SCALE] = gᵀg / |J g|², of the linearised goals (Cauchy 1847).
    """
    goal_jacobian(tree, goal, work, work.frames)
    jacobian, residual, gradient = work.jacobian, work.residual, work.gradient
    square, curvature = 0.0, 0.0
    for u in range(gradient.shape[0]):
        along = 0.0
        for r in range(residual.shape[0]):
            along += jacobian[r, u] * residual[r]
        gradient[u] = along
        square += along * along
    for r in range(residual.shape[0]):
        row = 0.0
        for u in range(gradient.shape[0]):
            row += jacobian[r, u] * gradient[u]
        curvature += row * row
    work.value[ws.SCALE] = square / curvature if curvature > 0.0 else 1.0


@outlined
def reset(work):
    """H = the scale of the slope times the identity, no limit held."""
    metric = work.metric
    for u in range(metric.shape[0]):
        for i in range(metric.shape[0]):
            metric[u, i] = 0.0
        metric[u, u] = work.value[ws.SCALE]
        work.side[u] = 0
    work.state[ws.UPDATES] = 0


@outlined
def hold_coordinate(work, u):
    """Makes the limit of a hinge or slide active."""
    metric = work.metric
    n, inverse = metric.shape[0], 1.0 / metric[u, u] if metric[u, u] > 0.0 else 0.0
    for i in range(n):
        if i != u:
            part = inverse * metric[i, u]
            for j in range(n):
                metric[i, j] -= part * metric[u, j]
    for i in range(n):
        metric[i, u] = metric[u, i] = 0.0
    work.side[u] = 1


@outlined
def constrain(tree, goal, work):
    """Holds the limits that the slope pushes against and releases those from which it leads away."""
    side, gradient, outward = work.side, work.gradient, work.outward
    step_bounds(tree, goal, work)
    for u in range(gradient.shape[0]):
        if is_cone(tree, goal, u):
            if side[u] == 0:
                put_part(outward, u, edge_axis(tree, goal, work.q, u))
            leaving = leaves_cone(work, gradient, u)
            if leaving and side[u] == 0:
                hold_cone(work, u)
            elif side[u] != 0 and not leaving:
                release_cone(work, u)
            if tree.upper[goal.dofs[u]] < AT_CONE:
                for i in range(u, u + 3):
                    work.low[i] = work.high[i] = 0.0
            continue
        leaving = pushed_out(work.low[u], work.high[u], gradient[u]) != 0
        if leaving and side[u] == 0:
            hold_coordinate(work, u)
        elif side[u] != 0 and not leaving:
            work.metric[u, u] = work.value[ws.SCALE]
            side[u] = 0


@outlined
def direction(tree, goal, work):
    """work.search_direction = H g; limits that it crosses at once are held, too.  Returns its slope."""
    metric, gradient, search_direction, side = work.metric, work.gradient, work.search_direction, work.side
    n = gradient.shape[0]
    for _ in range(n + 1):
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += metric[i, j] * gradient[j]
            search_direction[i] = s
        crossed = False
        for u in range(n):
            if is_cone(tree, goal, u) and leaves_cone(work, search_direction, u) and side[u] == 0:
                hold_cone(work, u)
                crossed = True
            elif side[u] == 0 and pushed_out(work.low[u], work.high[u], search_direction[u]) != 0:
                hold_coordinate(work, u)
                crossed = True
        if not crossed:
            break
    pressed, slope = 0, 0.0
    for u in range(n):
        pressed += side[u]
        slope += gradient[u] * search_direction[u]
    work.state[ws.PRESSED] = pressed
    return slope


@outlined
def displacement(tree, goal, work):
    """work.moved (nu,): the displacement from work.accepted to work.q in units of the step."""
    difference(tree, work.accepted, work.q, work.dq)
    for u in range(work.moved.shape[0]):
        work.moved[u] = work.dq[goal.dofs[u]] / goal.joint_scale[u]


@outlined
def update_metric(work):
    """The update of Broyden, Fletcher, Goldfarb and Shanno (1970) from s = moved and y = before − gradient.

    H ← (1 − s yᵀ/σ) H (1 − y sᵀ/σ) + s sᵀ/σ, σ = sᵀy; left out where σ is not clearly positive, which
    would cost H its definiteness.
    """
    metric, s, y, image = work.metric, work.moved, work.before, work.rhs
    n = s.shape[0]
    curvature, steps, changes = 0.0, 0.0, 0.0
    for u in range(n):
        y[u] -= work.gradient[u]
        curvature += s[u] * y[u]
        steps += s[u] * s[u]
        changes += y[u] * y[u]
    if not curvature > _LEAST_CURVATURE * math.sqrt(steps * changes):
        return
    square = 0.0
    for i in range(n):
        image[i] = 0.0
        for j in range(n):
            image[i] += metric[i, j] * y[j]
        square += image[i] * y[i]
    inverse = 1.0 / curvature
    factor = inverse * (1.0 + inverse * square)
    for i in range(n):
        for j in range(n):
            metric[i, j] += factor * s[i] * s[j] - inverse * (image[i] * s[j] + s[i] * image[j])
    work.state[ws.UPDATES] += 1


# Points tried along one direction before it is given up.
_TRIALS = 30


@dataclass(frozen=True)
class Minimization(IterativeSolver):
    """Downhill at every step, whatever the goals are; needs no system of equations to be solved."""

    # Chosen for few steps, mean and 99th percentile, on 400 cold poses each of PUMA 560, UR5e and Panda,
    # to 1 µm and 1 µrad; curvatures of 0.1 … 0.99, tries of 30 … 150 steps and patience of 3 … 12 were tried.
    restarts: int = option(200, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(150, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(150, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(8, "steps without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.02, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    draws: int = option(4, "random points of which a try takes the best", low=1, high=1000)
    max_step: float = option(
        1.0, "largest change of one joint in a step", low=1e-4, high=1e6, unit="rad", usual=(0.0, 2.0)
    )
    decrease: float = option(1e-4, "share of the promised descent that a step must bring", low=1e-9, high=0.4)
    curvature: float = option(
        0.3, "share of the slope that may be left after a step", low=0.1, high=0.999, usual=(0.1, 0.999)
    )

    name: ClassVar[str] = "bfgs"
    title: ClassVar[str] = "minimisation by a variable metric (BFGS), projected on the limits"
    source: ClassVar[str] = "Zhao & Badler, ACM Transactions on Graphics 13(4), 1994"
    partial_goals: ClassVar[bool] = True
    capabilities: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness"})

    def kernel(self) -> Callable[..., None]:
        return bfgs


open_options = options_of(Minimization)


@outlined
def try_step(tree, goal, work, share):
    """Measures work.accepted plus ``share`` of work.search_direction, in limits; returns what is promised.

    That is the descent which the slope promises for the part that is left of it at the limits.
    """
    step, low, high, search_direction = work.step, work.low, work.high, work.search_direction
    copy(work.accepted, work.q)
    for u in range(step.shape[0]):
        step[u] = min(max(share * search_direction[u], low[u]), high[u])
    apply_step(tree, goal, work.nodes, step, work.dq, work.q)
    displacement(tree, goal, work)
    measure(tree, goal, work)
    promised = 0.0
    for u in range(step.shape[0]):
        promised += work.before[u] * work.moved[u]
    return promised


@outlined
def line_search(tree, goal, work, options, slope):
    """Goes down along work.search_direction until enough is won and the slope has eased (Wolfe 1969).

    Returns whether a lower point was found: then work.q, work.step, work.gradient and work.moved are its own.
    A direction that meets limits is clipped to them, and searched for descent only.
    """
    max_step, decrease, curvature = options.max_step, options.decrease, options.curvature
    cost, search_direction = work.value[ws.COST], work.search_direction
    longest = 0.0
    for u in range(search_direction.shape[0]):
        longest = max(longest, abs(search_direction[u]))
    share = min(1.0, max_step / longest)
    good, bad = 0.0, 0.0
    for _ in range(_TRIALS):
        promised = try_step(tree, goal, work, share)
        won = cost - work.value[ws.COST]
        if promised > 0.0 and won >= decrease * promised:
            measure_gradient(tree, goal, work)
            clipped = False
            for u in range(search_direction.shape[0]):
                clipped = clipped or work.step[u] != share * search_direction[u]
            eased = slope_left(tree, goal, work) <= curvature * slope
            if eased or clipped or 2.0 * share * longest > max_step:
                return True
            good = share
            share = 2.0 * share if bad == 0.0 else 0.5 * (good + bad)
        else:
            bad = share
            if good > 0.0:
                share = 0.5 * (good + bad)
            else:  # the parabola through both costs and the slope
                share *= min(max(0.5 * promised / (promised - won), 0.1), 0.5)
    if good > 0.0:
        try_step(tree, goal, work, good)
        measure_gradient(tree, goal, work)
    return good > 0.0


@outlined
def bfgs_step(tree, goal, work, options):
    """work.step for one step downhill; zero, and the end of the try, where there is none."""
    state, cost = work.state, work.value[ws.COST]
    if state[ws.TRY_STEPS] == 0:
        measure_gradient(tree, goal, work)
        reset(work)
    copy(work.q, work.accepted)
    for _ in range(2):
        constrain(tree, goal, work)
        slope = direction(tree, goal, work)
        copy(work.gradient, work.before)
        found = slope > 0.0 and line_search(tree, goal, work, options, slope)
        if found:
            transport(tree, goal, work)
            update_metric(work)
        copy(work.accepted, work.q)  # ``advance`` goes on from there
        work.value[ws.COST] = cost
        if found:
            return
        if state[ws.UPDATES] == 0:
            break
        reset(work)  # what was learned does not hold here: down the plain slope
    for u in range(work.step.shape[0]):
        work.step[u] = 0.0
    state[ws.STALLS] = ws.NO_LIMIT


@kernel
def bfgs(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), ws.open_work(work)
    options = open_options(options)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        bfgs_step(tree, goal, work, options)
        advance(tree, goal, work)
