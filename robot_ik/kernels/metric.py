"""The metric of a variable-metric method, projected on the limits that are active.

``work.metric`` (nu, nu) is H: the step is d = H g with g = Jᵀr, the way down.  It begins as a multiple of
the identity and learns the inverse of the Hessian from the steps that are taken (``learn``).

A limit that is *active* has its direction n taken out of H, so that H n = 0 and every step keeps along
it (Rosen's projection in the metric: Goldfarb, Extension of Davidon's variable metric method to
maximization under linear inequality and equality constraints, SIAM J. Applied Mathematics 17(4), 1969):

    hold      H ← H − H n nᵀH / nᵀH n            release      H ← H + h n nᵀ

n is a coordinate for hinges and slides; ``cones.py`` has the cones of balls.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.cones import AT_CONE, edge_axis, hold_cone, is_cone, leaves_cone, release_cone
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.room import room
from robot_ik.kernels.rotation_rows import rotation_back
from robot_ik.kernels.tree import BALL, FREE
from robot_ik.kernels.work import PRESSED, SCALE, UPDATES

# A joint with less room than this, rad or m, stands at its bound.
_AT_BOUND = 1e-12
# Least cosine between a step and the change of slope along it for the metric to learn from them.
_LEAST_CURVATURE = 1e-8


@outlined
def slopes(tree, goal, work):
    """At work.q, which has been measured: work.gradient = Jᵀr, and how far down it the linearised goals want.

    That is value[SCALE] = gᵀg / |J g|² (Cauchy 1847).
    """
    goal_jacobian(tree, goal, work, work.frames)
    jacobian, residual, gradient = work.jacobian, work.residual, work.gradient
    square, bend = 0.0, 0.0
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
        bend += row * row
    work.value[SCALE] = square / bend if bend > 0.0 else 1.0


@outlined
def reset(work):
    """H = the scale of the slope times the identity, no limit held."""
    metric = work.metric
    for u in range(metric.shape[0]):
        for i in range(metric.shape[0]):
            metric[u, i] = 0.0
        metric[u, u] = work.value[SCALE]
        work.side[u] = 0
    work.state[UPDATES] = 0


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


@pure
def leaves(work, vector, u):
    """Whether ``vector`` would take the coordinate beyond the bound at which it stands."""
    return (work.low[u] > -_AT_BOUND and vector[u] < 0.0) or (work.high[u] < _AT_BOUND and vector[u] > 0.0)


@outlined
def constrain(tree, goal, work):
    """Holds the limits that the slope pushes against and releases those from which it leads away."""
    side, gradient, outward = work.side, work.gradient, work.outward
    room(tree, goal, work)
    for u in range(gradient.shape[0]):
        if is_cone(tree, goal, u):
            if side[u] == 0:
                outward[u], outward[u + 1], outward[u + 2] = edge_axis(tree, goal, work.q, u)
            leaving = leaves_cone(work, gradient, u)
            if leaving and side[u] == 0:
                hold_cone(work, u)
            elif side[u] != 0 and not leaving:
                release_cone(work, u)
            if tree.upper[goal.dofs[u]] < AT_CONE:
                for i in range(u, u + 3):
                    work.low[i] = work.high[i] = 0.0
            continue
        leaving = leaves(work, gradient, u)
        if leaving and side[u] == 0:
            hold_coordinate(work, u)
        elif side[u] != 0 and not leaving:
            work.metric[u, u] = work.value[SCALE]
            side[u] = 0


@outlined
def direction(tree, goal, work):
    """work.way = H g; limits that it would cross at once are held, too.  Returns the slope along it."""
    metric, gradient, way, side = work.metric, work.gradient, work.way, work.side
    n = gradient.shape[0]
    for _ in range(n + 1):
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += metric[i, j] * gradient[j]
            way[i] = s
        crossed = False
        for u in range(n):
            if is_cone(tree, goal, u) and leaves_cone(work, way, u) and side[u] == 0:
                hold_cone(work, u)
                crossed = True
            elif leaves(work, way, u) and side[u] == 0:
                hold_coordinate(work, u)
                crossed = True
        if not crossed:
            break
    pressed, slope = 0, 0.0
    for u in range(n):
        pressed += side[u]
        slope += gradient[u] * way[u]
    work.state[PRESSED] = pressed
    return slope


@outlined
def displacement(tree, goal, work):
    """work.moved (nu,): the way from work.accepted to work.q in units of the step."""
    kind, qadr, vadr = tree.kind, tree.qadr, tree.vadr
    before, q, dofs, ease, moved = work.accepted, work.q, goal.dofs, goal.ease, work.moved
    for u in range(dofs.shape[0]):
        k = tree.dof_node[dofs[u]]
        a, i = qadr[k], dofs[u] - vadr[k]
        if kind[k] < BALL or (kind[k] == FREE and i < 3):
            moved[u] = (q[a + i] - before[a + i]) / ease[u]
        elif i % 3 == 0:
            a = a + 3 if kind[k] == FREE else a
            x, y, z = rotation_back(before, a, q[a], q[a + 1], q[a + 2], q[a + 3])
            moved[u], moved[u + 1], moved[u + 2] = x / ease[u], y / ease[u + 1], z / ease[u + 2]


@outlined
def learn(work):
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
    work.state[UPDATES] += 1
