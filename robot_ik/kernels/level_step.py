"""One step for goals of several priorities: each level in the null space of all levels before it.

A step serves level 0 by damped least squares, then level 1 with what freedom is left, and so on (Siciliano
& Slotine, A general framework for managing multiple tasks in highly redundant robotic systems, ICAR
1991); a joint that a step would push over its bound is put there, and the whole step is made anew
without it (Flacco, De Luca & Khatib, Control of redundant robots under hard joint constraints, IEEE
Transactions on Robotics 31(3), 2015).  Null spaces are right to first order only, so after each step the
earlier levels are restored, and the step is kept only when none of them lost and its own level won.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.linalg import eliminate, row_dot
from robot_ik.kernels.loop import apply_step, measure, step_bounds
from robot_ik.kernels.pose_prior import prior_jacobian, prior_rows
from robot_ik.kernels.residuals import PRIOR, goal_end, goal_jacobian
from robot_ik.kernels.workspace import COST

# Damping of levels that are served already: nothing where they are met, else in proportion to their cost.
_HELD_DAMPING = 1e-12
# A row of which less than this share is left beside earlier rows adds no direction of its own.
_DEPENDENT = 1e-6
# Largest change of one joint in a step, rad or m.
_LONGEST = 0.5
# How much of its cost a level that cannot be met may lose to rounding and second order.
_SLACK = 1e-5
# Steps granted to bring earlier levels back, and the share of their tolerance within which they are kept.
_RESTORE, _WELL_INSIDE = 6, 1e-3


@outlined
def measure_levels(tree, goal, work):
    """``measure``, with the rows of a pose prior and half the squared residual of each level."""
    within, costs, m = measure(tree, goal, work), work.level_cost, work.residual.shape[0]
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] == PRIOR:
            work.value[COST] += 0.5 * prior_rows(goal, work, g)
    for k in range(costs.shape[0]):
        costs[k] = 0.0
    for g in range(goal.row.shape[0]):
        for r in range(goal.row[g], goal_end(goal, g, m)):
            costs[goal.level[g]] += 0.5 * work.residual[r] * work.residual[r]
    return within


@outlined
def level_jacobian(tree, goal, work):
    """``goal_jacobian``, with the rows of a pose prior."""
    goal_jacobian(tree, goal, work, work.frames)
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] == PRIOR:
            prior_jacobian(tree, goal, work, g)


@pure
def level_met(goal, work, level, share=1.0):
    """Whether all goals of the level are within that share of their tolerance; soft ones never are."""
    for g in range(goal.row.shape[0]):
        if goal.level[g] != level:
            continue
        if goal.soft[g] == 1:
            return False
        if work.miss[g, 0] > share * goal.tolerance[g, 0] or work.miss[g, 1] > share * goal.tolerance[g, 1]:
            return False
    return True


@pure
def needed_levels(goal):
    """How many levels have goals that are needed: those of the soft ones come after them."""
    count = types.int64(0)
    for g in range(goal.row.shape[0]):
        if goal.soft[g] == 0:
            count = max(count, goal.level[g] + 1)
    return count


@pure
def levels_met(goal, work, needed):
    """Whether the first ``needed`` levels are within their tolerance."""
    met = True
    for level in range(needed):
        met = met and level_met(goal, work, level)
    return met


@pure
def project_out(own, row, basis, first, rank):
    """Takes out of own[row] what lies along basis[first:rank]; returns its square before and after."""
    n = own.shape[1]
    before = after = row_dot(own, row, own, row)
    for _ in range(2):  # twice is enough (Kahan, in Parlett, The Symmetric Eigenvalue Problem)
        last = after
        for b in range(first, rank):
            along = row_dot(own, row, basis, b)
            for u in range(n):
                own[row, u] -= along * basis[b, u]
        after = row_dot(own, row, own, row)
        if after > 0.25 * last:  # nothing was lost in the difference
            break
    return before, after


@pure
def serve_level(goal, work, level, damping, rank):
    """Adds to work.step what serves ``level`` beside the rows of work.basis; returns their new number.

    z = J'ᵀ (J'J'ᵀ + λ)⁻¹ (r − J d) with J' the rows of the level less their part in the basis.
    """
    step, basis, own, gram, rhs = work.step, work.basis, work.own, work.gram, work.rhs
    jacobian, residual, side = work.jacobian, work.residual, work.side
    n, m = step.shape[0], residual.shape[0]
    count = types.int64(0)
    for g in range(goal.row.shape[0]):
        if goal.level[g] != level:
            continue
        for r in range(goal.row[g], goal_end(goal, g, m)):
            left = residual[r]
            for u in range(n):
                left -= jacobian[r, u] * step[u]
                own[count, u] = jacobian[r, u] if side[u] == 0 else 0.0
            project_out(own, count, basis, 0, rank)
            rhs[count] = left
            count += 1
    for i in range(count):
        for j in range(i + 1):
            gram[i, j] = row_dot(own, i, own, j)
        gram[i, i] += damping + 1e-15
    if eliminate(gram, rhs, count):
        for i in range(count):
            for u in range(n):
                step[u] += own[i, u] * rhs[i]
    return extend_basis(work, count, rank)


@pure
def extend_basis(work, count, rank):
    """Makes the first ``count`` rows of work.own part of the orthonormal work.basis; returns its size."""
    own, basis = work.own, work.basis
    n, first = own.shape[1], rank
    for i in range(count):
        if rank >= basis.shape[0] or rank >= n:
            break
        before, after = project_out(own, i, basis, first, rank)
        if not before > 1e-24 or after <= _DEPENDENT * _DEPENDENT * before:
            continue
        inverse = 1.0 / math.sqrt(after)
        for u in range(n):
            basis[rank, u] = inverse * own[i, u]
        rank += 1
    return rank


@pure
def factorise(matrix, first, n):
    """L D Lᵀ in place of the lower triangle: L below the diagonal, 1/D on it.

    first[i]: where row i begins; what is left of it is zero, and stays it.
    """
    for i in range(n):
        for j in range(first[i], i):
            s = matrix[i, j]
            for k in range(max(first[i], first[j]), j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = s
        d = matrix[i, i]
        for j in range(first[i], i):
            s = matrix[i, j] * matrix[j, j]
            d -= s * matrix[i, j]
            matrix[i, j] = s
        matrix[i, i] = 1.0 / d if d > 0.0 else 0.0


@pure
def soft_system(goal, work, level, damping):
    """work.damped = JᵀJ + λ of the level's free joints, factorised, work.gradient = Jᵀ(r − J d).

    λ is in proportion to the largest entry.
    """
    jacobian, step, side, first = work.jacobian, work.step, work.side, work.free
    matrix, gradient = work.damped, work.gradient
    n, m, largest = step.shape[0], work.residual.shape[0], 0.0
    for u in range(n):
        gradient[u], first[u] = 0.0, u
        for v in range(u + 1):
            matrix[u, v] = 0.0
    for g in range(goal.row.shape[0]):
        if goal.level[g] != level:
            continue
        for r in range(goal.row[g], goal_end(goal, g, m)):
            left, start = work.residual[r], n
            for u in range(n - 1, -1, -1):
                left -= jacobian[r, u] * step[u]
                if jacobian[r, u] != 0.0:
                    start = u
            for u in range(start, n):
                x = jacobian[r, u] if side[u] == 0 else 0.0
                if x != 0.0:
                    gradient[u] += x * left
                    first[u] = min(first[u], start)
                    for v in range(start, u + 1):
                        matrix[u, v] += x * jacobian[r, v] if side[v] == 0 else 0.0
    for u in range(n):
        largest = max(largest, matrix[u, u])
    for u in range(n):
        matrix[u, u] = matrix[u, u] + damping * largest + 1e-15 if side[u] == 0 else 1.0
    factorise(matrix, first, n)


@pure
def serve_soft(goal, work, level, damping, rank):
    """Adds to work.step what serves ``level`` beside the rows of work.basis.

    z minimises ½ |r − J (d + z)|² + ½ λ |z|² with B z = 0, B the basis: with H = JᵀJ + λ and g = Jᵀ(r − J d),
    z = H⁻¹ (g − Bᵀμ) and (B H⁻¹ Bᵀ) μ = B H⁻¹ g.  Such levels may have as many rows as there are joints: it
    is what the levels before them leave that is solved for.
    """
    basis, own, gram, rhs = work.basis, work.own, work.gram, work.rhs
    matrix, slope, search_direction, first = work.damped, work.gradient, work.search_direction, work.free
    n = work.step.shape[0]
    soft_system(goal, work, level, damping)
    for i in range(n):  # search_direction = L⁻¹ g, own = B L⁻ᵀ
        s = slope[i]
        for k in range(first[i], i):
            s -= matrix[i, k] * search_direction[k]
        search_direction[i] = s
    for b in range(rank):
        for i in range(n):
            s = basis[b, i]
            for k in range(first[i], i):
                s -= matrix[i, k] * own[b, k]
            own[b, i] = s
    for b in range(rank):
        for c in range(b + 1):
            s = 0.0
            for i in range(n):
                s += own[b, i] * matrix[i, i] * own[c, i]
            gram[b, c] = s
        s = 0.0
        for i in range(n):
            s += own[b, i] * matrix[i, i] * search_direction[i]
        rhs[b] = s
    if not eliminate(gram, rhs, rank):
        return
    for b in range(rank):
        for i in range(n):
            search_direction[i] -= rhs[b] * own[b, i]
    for i in range(n):
        search_direction[i] *= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(first[i], i):
            search_direction[k] -= matrix[i, k] * search_direction[i]
    for i in range(n):
        work.step[i] += search_direction[i]


@pure
def stacked_step(tree, goal, work, top, damping):
    """work.step for levels 0 … ``top``, inside the limits; ``damping`` is that of the top level.

    Returns the joints that are pressed against a bound, and the largest change of a joint that was asked for.
    """
    step, low, high, side = work.step, work.low, work.high, work.side
    n, needed = step.shape[0], needed_levels(goal)
    level_jacobian(tree, goal, work)
    step_bounds(tree, goal, work)
    for u in range(n):
        side[u] = 0
    pressed = 0
    for _ in range(n + 1):
        for u in range(n):
            step[u] = 0.0 if side[u] == 0 else (low[u] if side[u] < 0 else high[u])
        rank = types.int64(0)
        for level in range(top + 1):
            weight = damping
            if level == top and level >= needed:
                serve_soft(goal, work, level, damping, rank)
                continue
            if level < top:
                met = level_met(goal, work, level)
                weight = _HELD_DAMPING if met else 0.1 * work.level_cost[level] + _HELD_DAMPING
            rank = serve_level(goal, work, level, weight, rank)
        worst, most = -1, 1e-12
        for u in range(n):
            over = max(step[u] - high[u], low[u] - step[u])
            if side[u] == 0 and over > most:
                worst, most = u, over
        if worst < 0:
            break
        side[worst] = 1 if step[worst] > high[worst] else -1
        pressed += 1
    largest = 0.0
    for u in range(n):
        largest = max(largest, abs(step[u]))
    share = _LONGEST / largest if largest > _LONGEST else 1.0
    for u in range(n):
        step[u] = min(max(share * step[u], low[u]), high[u])
    return pressed, largest


@pure
def levels_kept(goal, work, top, share):
    """Whether the levels before ``top`` are as well off as when they were left; met: within that share."""
    for level in range(top):
        bar = work.level_bar[level]
        if bar < 0.0:
            if not level_met(goal, work, level, share):
                return False
        elif work.level_cost[level] > bar * (1.0 + _SLACK) + 1e-18:
            return False
    return True


@pure
def restore(tree, goal, work, top):
    """Brings the levels before ``top`` back to where they were; returns whether that worked.

    Met goals are brought far inside their tolerance: what a later level wins by leaning on it, the next
    step would lose again.
    """
    for _ in range(_RESTORE):
        if levels_kept(goal, work, top, _WELL_INSIDE):
            return True
        damping = _HELD_DAMPING if work.level_bar[top - 1] < 0.0 else 0.5 * work.level_cost[top - 1]
        stacked_step(tree, goal, work, top - 1, damping)
        apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
        measure_levels(tree, goal, work)
    return levels_kept(goal, work, top, 1.0)


@pure
def leave_level(goal, work, level):
    """Remembers how well off a level is when the next one begins: met (-1), or its cost."""
    work.level_bar[level] = -1.0 if level_met(goal, work, level) else work.level_cost[level]


@pure
def better(work, levels):
    """Whether work.level_cost beats work.level_best, the first level that differs deciding.

    A level that is met counts as zero.
    """
    for k in range(levels):
        now, best = max(work.level_bar[k], 0.0), max(work.level_best[k], 0.0)
        if now < best * (1.0 - 1e-3) - 1e-18:
            return True
        if now > best * (1.0 + 1e-3) + 1e-18:
            return False
    return False
