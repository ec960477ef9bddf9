"""Residual and Jacobian of a pose prior: how unlikely a pose is under a Gaussian mixture.

Features x of a pose are joint positions, the lean of the free base and rotation vectors of balls,
minus their centre and divided by their spread. The energy is E(x) = −log Σ w_k N(x; μ_k, P_k⁻¹).
With the share γ_k of each part in this sum, the gradient of E is g = Σ γ_k P_k (x − μ_k). With
H = Σ γ_k P_k = L Lᵀ and the smallest energy E₀ the residual and its Jacobian are

    r = (−L⁻¹ g, √(2 (E − E₀) − |L⁻¹ g|²))        J = (Lᵀ ∂x/∂dq, 0)

so that ½ |r|² = E − E₀ and Jᵀ r = −∂E/∂dq exactly. JᵀJ is the Hessian of the bound that
expectation-maximisation puts on E (Dempster, Laird & Rubin 1977). The root is real because the
smallest value of the bound, E − ½ |L⁻¹ g|², is at least E₀.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.kinematics import rotation_back, slope_of, unit
from robot_ik.kernels.linalg import factorise, solve_lower
from robot_ik.kernels.tree import FREE

# Kinds of features: a number of q, world up along x and y of the base, parts of the rotation vector
# of a ball.
NUMBER, LEAN_X, LEAN_Y, VECTOR_X, VECTOR_Y, VECTOR_Z = range(6)
# Columns of ``PRIOR.features``.
KIND, ADDRESS, NODE = range(3)
# Smaller shares of a part do not count.
_MIN_SHARE = 1e-12

# With n features and k parts. Read-only, a part of ``residuals.GOALS``; empty without a prior.
PRIOR = Layout(
    "Prior",
    min_energy="float",  # E₀
    features="int_table",  # (n, 3) kind, address in q, node
    center="floats",  # (n,)
    spread="floats",  # (n,)
    log_weights="floats",  # (k,) log of w_k divided by the norm of the part
    means="table",  # (k, n)
    precisions="table",  # (k n, n) one matrix P_k below the other
)

# Memory that the method writes.
PRIOR_WORK = Layout(
    "PriorWork",
    x="floats features",
    log_densities="floats parts",  # log w_k N(x; …)
    gradient="floats features",  # g, then L⁻¹ g
    hessian="table features features",  # H, then its factors
    first="ints features",  # zeros: no row of H begins later
)


@outlined
def prior_residual(goals, search, work, g):
    """Write the residual of the prior, which is goal ``g``, at search.q; return |r|².

    Leaves the factors of H in ``work`` for ``prior_jacobian``.
    """
    prior = goals.prior
    count = work.x.shape[0]
    weight = search.weight[g, 1]
    row = goals.row[g]
    write_features(prior, search.q, work.x)
    energy = write_bound(prior, work, write_densities(prior, work))
    factorise(work.hessian, work.first, count)
    solve_lower(work.hessian, work.first, work.gradient, count)
    square = 0.0
    for i in range(count):
        entry = work.gradient[i]
        square += entry * entry
        search.residual[row + i] = -weight * entry
    rest = max(2.0 * (energy - prior.min_energy) - square, 0.0)
    search.residual[row + count] = weight * math.sqrt(rest)
    search.error[g, 0] = 0.0
    search.error[g, 1] = 0.0
    return weight * weight * (square + rest)


@outlined
def prior_jacobian(tree, goals, search, work, g, jacobian):
    """Write the rows of the prior to ``jacobian``, as ``residuals.goal_jacobian`` does."""
    row = goals.row[g]
    columns = goals.dofs.shape[0]
    for u in range(columns):
        for i in range(work.x.shape[0] + 1):
            jacobian[row + i, u] = 0.0
    for mover in range(goals.moved.shape[0]):
        column = goals.column[mover]
        factor = search.weight[g, 1] * goals.joint_scale[column]
        if mover >= columns:
            factor *= slope_of(tree, goals.coupled[mover - columns, 0], search.q)
        add_column(tree, goals, search, work, row, column, goals.moved[mover], factor, jacobian)


@inlined
def add_column(tree, goals, search, work, row, column, v, factor, jacobian):
    """Add factor · Lᵀ ∂x/∂dq of degree of freedom ``v`` to a column of ``jacobian``."""
    prior = goals.prior
    node = tree.dof_node[v]
    axis = v - tree.vadr[node] - (3 if tree.kind[node] == FREE else 0)
    if axis < 0:  # the position of the base is not a feature
        return
    for j in range(work.x.shape[0]):
        if prior.features[j, NODE] != node:
            continue
        kind = prior.features[j, KIND]
        rate = feature_rate(kind, search.q, prior.features[j, ADDRESS], axis)
        rate *= factor / prior.spread[j]
        if rate == 0.0:
            continue
        for i in range(j):
            jacobian[row + i, column] += rate * work.hessian[j, i]
        jacobian[row + j, column] += rate / work.hessian[j, j]  # which is 1 / L


@outlined
def write_features(prior, q, x):
    """Write the features of q to ``x``."""
    for i in range(x.shape[0]):
        kind = prior.features[i, KIND]
        a = prior.features[i, ADDRESS]
        if kind == NUMBER:
            value = q[a]
        elif kind in (LEAN_X, LEAN_Y):
            up = world_up(q, a)
            value = up[0] if kind == LEAN_X else up[1]
        else:
            value = part_of(rotation_vector(q, a), kind)
        x[i] = (value - prior.center[i]) / prior.spread[i]


@inlined
def feature_rate(kind, q, a, axis):
    """Return the change of a feature per unit of the degree of freedom ``axis`` of its joint."""
    if kind == NUMBER:
        return 1.0
    if kind in (LEAN_X, LEAN_Y):
        rate = so3.cross(world_up(q, a), unit(axis))
        return rate[0] if kind == LEAN_X else rate[1]
    phi = rotation_vector(q, a)
    return part_of(so3.jr_inv(phi, so3.curvature(phi), unit(axis)), kind)


@inlined
def world_up(q, a):
    """Return the world's z axis in the axes of the base with the quaternion q[a : a + 4]."""
    w = q[a]
    x = q[a + 1]
    y = q[a + 2]
    z = q[a + 3]
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@inlined
def rotation_vector(q, a):
    """Return the rotation vector of the quaternion q[a : a + 4]."""
    return so3.scale(-1.0, rotation_back(q, a, 1.0, 0.0, 0.0, 0.0))


@inlined
def part_of(vector, kind):
    """Return the coordinate of a vector that is the feature of this kind."""
    if kind == VECTOR_X:
        return vector[0]
    return vector[1] if kind == VECTOR_Y else vector[2]


@outlined
def write_densities(prior, work):
    """Write log w_k N(x; …) of each part; return the largest."""
    largest = -math.inf
    n = work.x.shape[0]
    for k in range(prior.log_weights.shape[0]):
        first = k * n
        square = 0.0
        for i in range(n):
            difference = work.x[i] - prior.means[k, i]
            s = 0.0
            for j in range(i):
                s += prior.precisions[first + i, j] * (work.x[j] - prior.means[k, j])
            square += difference * (2.0 * s + prior.precisions[first + i, i] * difference)
        work.log_densities[k] = prior.log_weights[k] - 0.5 * square
        largest = max(largest, work.log_densities[k])
    return largest


@outlined
def write_bound(prior, work, largest):
    """Write g and the lower triangle of H; return the energy E.

    ``largest`` is the largest of work.log_densities.
    """
    n = work.x.shape[0]
    total = 0.0
    for k in range(prior.log_weights.shape[0]):
        total += math.exp(work.log_densities[k] - largest)
    for i in range(n):
        work.gradient[i] = 0.0
        for j in range(i + 1):
            work.hessian[i, j] = 0.0
    for k in range(prior.log_weights.shape[0]):
        share = math.exp(work.log_densities[k] - largest) / total
        if share < _MIN_SHARE:
            continue
        first = k * n
        for i in range(n):
            difference = share * (work.x[i] - prior.means[k, i])
            s = 0.0
            for j in range(i):
                p = prior.precisions[first + i, j]
                work.hessian[i, j] += share * p
                s += p * (work.x[j] - prior.means[k, j])
                work.gradient[j] += p * difference
            diagonal = prior.precisions[first + i, i]
            work.hessian[i, i] += share * diagonal
            work.gradient[i] += share * s + diagonal * difference
    return -(largest + math.log(total))
