"""Goals of several priorities: each level in the null space of all levels before it.

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

from robot_ik.kernels.jacobian_step import goal_end
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.linalg import eliminate
from robot_ik.kernels.loop import copy, measure
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.room import apply_step, room

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
def level_costs(goal, work, costs):
    """Half the squared residual of each level, into ``costs`` (levels,)."""
    m = work.residual.shape[0]
    for k in range(costs.shape[0]):
        costs[k] = 0.0
    for g in range(goal.row.shape[0]):
        for r in range(goal.row[g], goal_end(goal, g, m)):
            costs[goal.level[g]] += 0.5 * work.residual[r] * work.residual[r]


@pure
def level_met(goal, work, level, share=1.0):
    """Whether all goals of the level are within that share of their tolerance."""
    for g in range(goal.row.shape[0]):
        if goal.level[g] != level:
            continue
        if work.miss[g, 0] > share * goal.tolerance[g, 0] or work.miss[g, 1] > share * goal.tolerance[g, 1]:
            return False
    return True


@outlined
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
            for _ in range(2):  # twice is enough (Kahan, in Parlett, The Symmetric Eigenvalue Problem)
                for b in range(rank):
                    along = 0.0
                    for u in range(n):
                        along += own[count, u] * basis[b, u]
                    for u in range(n):
                        own[count, u] -= along * basis[b, u]
            rhs[count] = left
            count += 1
    for i in range(count):
        for j in range(i + 1):
            s = 0.0
            for u in range(n):
                s += own[i, u] * own[j, u]
            gram[i, j] = s
        gram[i, i] += damping + 1e-15
    if eliminate(gram, rhs, count):
        for i in range(count):
            for u in range(n):
                step[u] += own[i, u] * rhs[i]
    return widen(work, count, rank)


@outlined
def widen(work, count, rank):
    """Makes the first ``count`` rows of work.own part of the orthonormal work.basis; returns its size."""
    own, basis = work.own, work.basis
    n = own.shape[1]
    for i in range(count):
        before = 0.0
        for u in range(n):
            before += own[i, u] * own[i, u]
        if rank >= basis.shape[0] or rank >= n or not before > 1e-24:
            continue
        for _ in range(2):
            for b in range(rank):
                along = 0.0
                for u in range(n):
                    along += own[i, u] * basis[b, u]
                for u in range(n):
                    own[i, u] -= along * basis[b, u]
        after = 0.0
        for u in range(n):
            after += own[i, u] * own[i, u]
        if after <= _DEPENDENT * _DEPENDENT * before:
            continue
        inverse = 1.0 / math.sqrt(after)
        for u in range(n):
            basis[rank, u] = inverse * own[i, u]
        rank += 1
    return rank


@outlined
def stacked_step(tree, goal, work, top, damping):
    """work.step for levels 0 … ``top``, inside the limits; ``damping`` is that of the top level."""
    step, low, high, side = work.step, work.low, work.high, work.side
    n = step.shape[0]
    goal_jacobian(tree, goal, work, work.frames)
    room(tree, goal, work)
    for u in range(n):
        side[u] = 0
    pressed = 0
    for _ in range(n + 1):
        for u in range(n):
            step[u] = 0.0 if side[u] == 0 else (low[u] if side[u] < 0 else high[u])
        rank = types.int64(0)
        for level in range(top + 1):
            weight = damping
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
    return pressed


@outlined
def unharmed(goal, work, top, share):
    """Whether the levels before ``top`` are as well off as when they were left; met: within that share."""
    for level in range(top):
        bar = work.level_bar[level]
        if bar < 0.0:
            if not level_met(goal, work, level, share):
                return False
        elif work.level_cost[level] > bar * (1.0 + _SLACK) + 1e-18:
            return False
    return True


@outlined
def restore(tree, goal, work, top):
    """Brings the levels before ``top`` back to where they were; returns whether that worked.

    Met goals are brought far inside their tolerance: what a later level wins by leaning on it, the next
    step would lose again.
    """
    for _ in range(_RESTORE):
        if unharmed(goal, work, top, _WELL_INSIDE):
            return True
        stacked_step(
            tree,
            goal,
            work,
            top - 1,
            _HELD_DAMPING if work.level_bar[top - 1] < 0.0 else 0.5 * work.level_cost[top - 1],
        )
        apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
    return unharmed(goal, work, top, 1.0)


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
        now, best = work.level_bar[k], work.level_best[k]
        now, best = max(now, 0.0), max(best, 0.0)
        if now < best * (1.0 - 1e-3) - 1e-18:
            return True
        if now > best * (1.0 + 1e-3) + 1e-18:
            return False
    return False


@pure
def keep_levels(work):
    """Remembers q and its levels as the best so far."""
    copy(work.level_bar, work.level_best)
    copy(work.q, work.best)
