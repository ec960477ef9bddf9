"""Rows of a pose prior: how unlikely a pose is under a Gaussian mixture, as a least-squares goal.

Features x of a pose are joint angles, the lean of the free base and rotation vectors of balls, less their
middle and over their spread.  With E(x) = −log Σ w_k N(x; μ_k, P_k⁻¹), shares γ_k of the parts in that sum,
g = Σ γ_k P_k (x − μ_k) its gradient and H = Σ γ_k P_k = L Lᵀ, the rows are

    r = (−L⁻¹ g, √(2 (E − E₀) − |L⁻¹ g|²)),     J = (Lᵀ ∂x/∂dq, 0)

so that ½ |r|² = E − E₀ and Jᵀ r = −∂E/∂dq exactly, and JᵀJ is the Hessian of the bound that
expectation-maximisation puts on E (Dempster, Laird & Rubin 1977).  The root is real: the bound's least value,
E − ½ |L⁻¹ g|², is no less than E₀, the least energy of all.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import rotation_back, slope_of, unit
from robot_ik.kernels.residuals import inverse_right_jacobian
from robot_ik.kernels.tree import FREE

# Kinds of features: a number of q, the world's up in the base's x and y, parts of a ball's rotation vector.
NUMBER, LEAN_X, LEAN_Y, VECTOR_X, VECTOR_Y, VECTOR_Z = range(6)
# Columns of goal.feature.
WHAT, AT, NODE = range(3)
# Rows of goal.prior: middle, spread, x and g; numbers for all (E₀ first); H, then L, in its lower triangle;
# then for each part its mean, its numbers (log of w_k over the norm, log density) and its precision.
MIDDLE, SPREAD, X, GRADIENT, NUMBERS, HESSIAN = range(6)
PART_MEAN, PART_NUMBERS, PART_PRECISION = range(3)
# Shares of a part below this count nothing.
_NO_SHARE = 1e-12


@outlined
def features(goal, q):
    """Features of q into row X of goal.prior."""
    feature, prior = goal.feature, goal.prior
    for i in range(feature.shape[0]):
        what, a = feature[i, WHAT], feature[i, AT]
        if what == NUMBER:
            value = q[a]
        elif what == LEAN_X:
            value = 2.0 * (q[a + 1] * q[a + 3] - q[a] * q[a + 2])
        elif what == LEAN_Y:
            value = 2.0 * (q[a + 2] * q[a + 3] + q[a] * q[a + 1])
        else:
            x, y, z = rotation_back(q, a, 1.0, 0.0, 0.0, 0.0)
            value = -x if what == VECTOR_X else (-y if what == VECTOR_Y else -z)
        prior[X, i] = (value - prior[MIDDLE, i]) / prior[SPREAD, i]


@pure
def feature_rate(what, q, a, axis):
    """How a feature changes per unit of the axis-th degree of freedom of its joint."""
    if what == NUMBER:
        return 1.0
    if what in (LEAN_X, LEAN_Y):  # up in the base's axes moves with up × ω
        ux, uy = 2.0 * (q[a + 1] * q[a + 3] - q[a] * q[a + 2]), 2.0 * (q[a + 2] * q[a + 3] + q[a] * q[a + 1])
        uz = 1.0 - 2.0 * (q[a + 1] * q[a + 1] + q[a + 2] * q[a + 2])
        if what == LEAN_X:
            return 0.0 if axis == 0 else (-uz if axis == 1 else uy)
        return uz if axis == 0 else (0.0 if axis == 1 else -ux)
    x, y, z = rotation_back(q, a, 1.0, 0.0, 0.0, 0.0)
    ex, ey, ez = unit(axis)
    rx, ry, rz = inverse_right_jacobian(-x, -y, -z, ex, ey, ez)
    return rx if what == VECTOR_X else (ry if what == VECTOR_Y else rz)


@outlined
def densities(prior, n, count):
    """Log of w_k N(x; …) of every part into its numbers; returns the largest."""
    best = -math.inf
    for k in range(count):
        first = HESSIAN + n + k * (PART_PRECISION + n)
        square = 0.0
        for i in range(n):
            off = prior[X, i] - prior[first + PART_MEAN, i]
            s = 0.0
            for j in range(i):
                s += prior[first + PART_PRECISION + i, j] * (prior[X, j] - prior[first + PART_MEAN, j])
            square += off * (2.0 * s + prior[first + PART_PRECISION + i, i] * off)
        prior[first + PART_NUMBERS, 1] = prior[first + PART_NUMBERS, 0] - 0.5 * square
        best = max(best, prior[first + PART_NUMBERS, 1])
    return best


@outlined
def energy_terms(prior, n, count, best):
    """Gradient and Hessian of the bound into their rows; returns the energy E."""
    total = 0.0
    for k in range(count):
        total += math.exp(prior[HESSIAN + n + k * (PART_PRECISION + n) + PART_NUMBERS, 1] - best)
    for i in range(n):
        prior[GRADIENT, i] = 0.0
        for j in range(i + 1):
            prior[HESSIAN + i, j] = 0.0
    for k in range(count):
        first = HESSIAN + n + k * (PART_PRECISION + n)
        share = math.exp(prior[first + PART_NUMBERS, 1] - best) / total
        if share < _NO_SHARE:
            continue
        precision, mean = first + PART_PRECISION, first + PART_MEAN
        for i in range(n):
            s = 0.0
            off = share * (prior[X, i] - prior[mean, i])
            for j in range(i):
                p = prior[precision + i, j]
                prior[HESSIAN + i, j] += share * p
                s += p * (prior[X, j] - prior[mean, j])
                prior[GRADIENT, j] += p * off
            prior[HESSIAN + i, i] += share * prior[precision + i, i]
            prior[GRADIENT, i] += share * s + prior[precision + i, i] * off
    return -(best + math.log(total))


@outlined
def whiten(prior, n):
    """L in place of H and L⁻¹ g in place of g; returns |L⁻¹ g|²."""
    square = 0.0
    for i in range(n):
        s = prior[GRADIENT, i]
        for j in range(i):
            t = prior[HESSIAN + i, j]
            for k in range(j):
                t -= prior[HESSIAN + i, k] * prior[HESSIAN + j, k]
            t /= prior[HESSIAN + j, j]
            prior[HESSIAN + i, j] = t
            s -= t * prior[GRADIENT, j]
        d = prior[HESSIAN + i, i]
        for k in range(i):
            d -= prior[HESSIAN + i, k] * prior[HESSIAN + i, k]
        d = math.sqrt(d)
        prior[HESSIAN + i, i] = d
        prior[GRADIENT, i] = s / d
        square += prior[GRADIENT, i] * prior[GRADIENT, i]
    return square


@outlined
def prior_rows(goal, work, g):
    """Rows of the prior of goal ``g`` at work.q; returns |r|²."""
    prior, residual, row, w = goal.prior, work.residual, goal.row[g], goal.weight[g, 1]
    n = goal.feature.shape[0]
    count = (prior.shape[0] - HESSIAN - n) // (PART_PRECISION + n)
    features(goal, work.q)
    energy = energy_terms(prior, n, count, densities(prior, n, count))
    square = whiten(prior, n)
    rest = max(2.0 * (energy - prior[NUMBERS, 0]) - square, 0.0)
    for i in range(n):
        residual[row + i] = -w * prior[GRADIENT, i]
    residual[row + n] = w * math.sqrt(rest)
    return w * w * (square + rest)


@outlined
def prior_column(tree, goal, work, g, u, v, share):
    """Adds ``share`` of what degree of freedom ``v`` does to these rows to column ``u``."""
    feature, prior, jacobian, row = goal.feature, goal.prior, work.jacobian, goal.row[g]
    node = tree.dof_node[v]
    axis = v - tree.vadr[node] - (3 if tree.kind[node] == FREE else 0)
    if axis < 0:  # where the base stands says nothing of the pose
        return
    for j in range(feature.shape[0]):
        if feature[j, NODE] != node:
            continue
        rate = feature_rate(feature[j, WHAT], work.q, feature[j, AT], axis)
        rate *= share * goal.weight[g, 1] / prior[SPREAD, j]
        if rate == 0.0:
            continue
        for i in range(j + 1):
            jacobian[row + i, u] += rate * prior[HESSIAN + j, i]


@outlined
def prior_jacobian(tree, goal, work, g):
    """These rows of work.jacobian, coupled joints and stiffness as in ``residuals.goal_jacobian``."""
    jacobian, row, joint_scale = work.jacobian, goal.row[g], goal.joint_scale
    for u in range(goal.dofs.shape[0]):
        for i in range(goal.feature.shape[0] + 1):
            jacobian[row + i, u] = 0.0
        prior_column(tree, goal, work, g, u, goal.dofs[u], joint_scale[u])
    for c in range(goal.coupled.shape[0]):
        u = goal.coupled[c, 1]
        slope = slope_of(tree, goal.coupled[c, 0], work.q)
        prior_column(tree, goal, work, g, u, goal.coupled[c, 2], joint_scale[u] * slope)
