"""Goals of several priorities: each level in the null space of all levels before it.

A step serves level 0 by damped least squares, then level 1 with what freedom is left, and so on (Siciliano
& Slotine, A general framework for managing multiple tasks in highly redundant robotic systems, ICAR
1991); a joint that a step would push over its bound is put there, and the whole step is made anew
without it (Flacco, De Luca & Khatib, Control of redundant robots under hard joint constraints, IEEE
Transactions on Robotics 31(3), 2015).  Null spaces are right to first order only, so after each step the
earlier levels are restored, and the step is kept only when none of them lost and its own level won.

Levels of soft goals come last, and ask for the nearest that the others leave open: never met, never searched.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.bundle import named_row
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import follow
from robot_ik.kernels.linalg import eliminate
from robot_ik.kernels.loop import (
    apply_step,
    ask_for_all,
    begin,
    copy,
    draw,
    drop_beyond,
    judge,
    measure,
    record,
    some_within_reach,
    step_bounds,
)
from robot_ik.kernels.residuals import goal_end, goal_jacobian, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import (
    ALL_GOALS,
    BEST_COST,
    BLOCKED,
    CONVERGED,
    COST,
    DAMPING,
    DRAWS,
    FOUND,
    ITERATION_LIMIT,
    ITERATIONS,
    MAX_ITERATIONS,
    MAX_RESTARTS,
    PATIENCE,
    POLISHING,
    PRESSED,
    PROGRESS,
    RESTARTS,
    RUNNING,
    SEARCH,
    SEARCHING,
    SLICE_END,
    STAGE,
    STALLED,
    STALLS,
    STATUS,
    TRY_LIMIT,
    TRY_STEPS,
    open_run,
    open_work,
)

LEVEL_OPTIONS = ("damping", "increase", "decrease", "least", "floor")
"""Options of ``lm`` that count here, in their order."""
open_options = named_row("LevelOptions", tuple((name, float) for name in LEVEL_OPTIONS))

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


@pure
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
def levels_met(goal, work, needed, share=1.0):
    """Whether the first ``needed`` levels are within that share of their tolerance."""
    met = True
    for level in range(needed):
        met = met and level_met(goal, work, level, share)
    return met


@pure
def take_away(own, row, basis, first, rank):
    """Takes out of own[row] what lies along basis[first:rank]; returns its square before and after."""
    n = own.shape[1]
    before, after = 0.0, 0.0
    for u in range(n):
        before += own[row, u] * own[row, u]
    after = before
    for _ in range(2):  # twice is enough (Kahan, in Parlett, The Symmetric Eigenvalue Problem)
        last = after
        for b in range(first, rank):
            along = 0.0
            for u in range(n):
                along += own[row, u] * basis[b, u]
            for u in range(n):
                own[row, u] -= along * basis[b, u]
        after = 0.0
        for u in range(n):
            after += own[row, u] * own[row, u]
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
            take_away(own, count, basis, 0, rank)
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


@pure
def widen(work, count, rank):
    """Makes the first ``count`` rows of work.own part of the orthonormal work.basis; returns its size."""
    own, basis = work.own, work.basis
    n, first = own.shape[1], rank
    for i in range(count):
        if rank >= basis.shape[0] or rank >= n:
            break
        before, after = take_away(own, i, basis, first, rank)
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
    matrix, slope, way, first = work.damped, work.gradient, work.way, work.free
    n = work.step.shape[0]
    soft_system(goal, work, level, damping)
    for i in range(n):  # way = L⁻¹ g, own = B L⁻ᵀ
        s = slope[i]
        for k in range(first[i], i):
            s -= matrix[i, k] * way[k]
        way[i] = s
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
            s += own[b, i] * matrix[i, i] * way[i]
        rhs[b] = s
    if not eliminate(gram, rhs, rank):
        return
    for b in range(rank):
        for i in range(n):
            way[i] -= rhs[b] * own[b, i]
    for i in range(n):
        way[i] *= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(first[i], i):
            way[k] -= matrix[i, k] * way[i]
    for i in range(n):
        work.step[i] += way[i]


@pure
def stacked_step(tree, goal, work, top, damping):
    """work.step for levels 0 … ``top``, inside the limits; ``damping`` is that of the top level.

    Returns the joints that are pressed against a bound, and the largest change of a joint that was asked for.
    """
    step, low, high, side = work.step, work.low, work.high, work.side
    n, needed = step.shape[0], needed_levels(goal)
    goal_jacobian(tree, goal, work, work.frames)
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


@pure
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


# ------------------------------------------------------------------------------------------
# ``lm`` for goals of several priorities: level after level, each kept while the next is served.
#
# Near the answer all levels are served by one and the same step.  Where that leads nowhere, level after level
# is; random restarts are for the first level only, and not towards what is proven out of reach.


# Steps without progress before a level is left as it is, and the share of its cost that counts as progress.
_LEVEL_PATIENCE, _LEVEL_PROGRESS = 8, 1e-6
# All levels in one step: so many steps at most, none of them longer than this (rad or m) …
_AT_MOST, _NEAR = 6, 0.3
# … and each brings a needed level to this share of its cost, or to so many times its tolerance.
_SHRINKS, _NEARLY_MET = 0.25, 30.0
# Damping of a soft level, as a share of the largest entry of JᵀJ.
_SOFT_DAMPING = 1e-6
# A soft level rests where a step would be no longer than this (rad or m).  A step shorter than the second
# leaves about its square: it was the last.
_REST, _LAST = 3e-4, 0.05

# Entry of state[STAGE] while all levels are served together.
_TOGETHER = -1


@pure
def arrive(tree, goal, work):
    """Measures where work.step leads, in the costs of the levels."""
    apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    measure(tree, goal, work)
    level_costs(goal, work, work.level_cost)


@pure
def go_back(tree, goal, work):
    """To where work.accepted is."""
    copy(work.accepted, work.q)
    measure(tree, goal, work)
    level_costs(goal, work, work.level_cost)


@pure
def count_step(goal, work):
    """One step more."""
    work.state[ITERATIONS] += 1
    if work.trace.shape[0] > 0:
        record(goal.tolerance, work)


@pure
def hurried(state):
    """Whether a level is served for a random try only, which is short."""
    return state[STAGE] == 0 and state[RESTARTS] > 0 and state[POLISHING] == 0 and state[SEARCH] != FOUND


@pure
def keep_first(work):
    """In the try from the start every step that is kept is the best so far."""
    state = work.state
    if state[RESTARTS] == 0 and state[SEARCH] == ALL_GOALS:
        copy(work.q, work.best)
        work.value[BEST_COST] = work.value[COST]


@outlined
def level_step(tree, goal, work, options):
    """One step of the level that is being served; taken back unless it helps and harms no earlier level."""
    state, value = work.state, work.value
    floor, least = options.floor, options.least
    increase, decrease = options.increase, options.decrease
    stage = state[STAGE]
    before = work.level_cost[stage]
    soft = stage >= needed_levels(goal)
    if state[TRY_STEPS] == 0 and not soft:
        value[DAMPING] = options.damping
    copy(work.q, work.accepted)
    damping = value[DAMPING] if soft else value[DAMPING] * before + floor
    pressed, largest = stacked_step(tree, goal, work, stage, damping)
    if soft and largest <= _REST:
        state[STALLS] = _LEVEL_PATIENCE
        return
    arrive(tree, goal, work)
    helped = restore(tree, goal, work, stage) and work.level_cost[stage] < before
    if helped:
        progress = value[PROGRESS] if hurried(state) else _LEVEL_PROGRESS
        state[PRESSED] = pressed
        value[DAMPING] = max(value[DAMPING] * decrease, _SOFT_DAMPING if soft else least)
        state[STALLS] = 0 if work.level_cost[stage] < before * (1.0 - progress) else state[STALLS] + 1
        keep_first(work)
    else:
        go_back(tree, goal, work)
        value[DAMPING] *= increase
        state[STALLS] += 1
    state[TRY_STEPS] += 1
    count_step(goal, work)


@pure
def converge(work, cost):
    """The answer is work.q: all that is needed is met."""
    copy(work.q, work.best)
    work.value[BEST_COST], work.state[STATUS] = cost, CONVERGED
    return True


@outlined
def step_together(tree, goal, work):
    """One step of all levels at once; False where that does not lead on."""
    state, levels = work.state, work.level_cost.shape[0]
    needed, last = needed_levels(goal), levels - 1
    met = levels_met(goal, work, needed)
    pressed, largest = stacked_step(tree, goal, work, last, _SOFT_DAMPING)
    if met and largest <= _REST:
        return converge(work, work.value[COST])
    if largest > _NEAR or state[STALLS] >= _AT_MOST:
        return False
    copy(work.q, work.accepted)
    copy(work.level_cost, work.level_bar)
    arrive(tree, goal, work)
    helped = not met or work.level_cost[last] < work.level_bar[last]
    for level in range(needed):
        shrunk = work.level_cost[level] <= _SHRINKS * work.level_bar[level]
        helped = helped and (shrunk or level_met(goal, work, level, _NEARLY_MET))
    state[STALLS] += 1
    count_step(goal, work)
    if not helped:
        go_back(tree, goal, work)
        return False
    state[PRESSED] = pressed
    keep_first(work)
    if levels_met(goal, work, needed) and (needed == levels or largest <= _LAST):
        return converge(work, work.value[COST])
    return True


@outlined
def serve_from(tree, goal, work, q):
    """Begins with the first level at ``q``."""
    state = work.state
    copy(q, work.q)
    measure(tree, goal, work)
    level_costs(goal, work, work.level_cost)
    state[STAGE], state[STALLS], state[TRY_STEPS] = 0, 0, 0


@outlined
def start_anew(tree, goal, work):
    """The best of a few random starts."""
    state, lowest = work.state, math.inf
    state[RESTARTS] += 1
    for _ in range(state[DRAWS]):
        draw(tree, work.nodes, work.start, state, work.q)
        follow(tree, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        if work.level_cost[0] < lowest:
            lowest = work.level_cost[0]
            copy(work.q, work.candidate)
    serve_from(tree, goal, work, work.candidate)


@pure
def beyond_first(goal, work):
    """Whether a goal of the first level is proven out of reach."""
    found = False
    for g in range(goal.kind.shape[0]):
        found = found or (goal.level[g] == 0 and work.beyond[g] == 1)
    return found


@outlined
def go_on(tree, goal, work):
    """Another try for the first level; False where none can help.

    Where it has goals that are proven out of reach, the others are searched for without them, first from the
    best so far, and once.
    """
    state = work.state
    if state[SEARCH] == FOUND:
        return False
    if state[SEARCH] == SEARCHING or not beyond_first(goal, work):
        start_anew(tree, goal, work)
        return True
    if not some_within_reach(goal, work):
        return False
    drop_beyond(goal, work)
    state[SEARCH] = SEARCHING
    serve_from(tree, goal, work, work.best)
    return not level_met(goal, work, 0)


@outlined
def end_try(tree, goal, work):
    """After the last level: done, another random start, or the best of all; the first level decides.

    Later levels are served from where the first one was met: nothing starts anew for them.
    """
    state, levels = work.state, work.level_cost.shape[0]
    for level in range(max(state[STAGE], 0), levels):
        leave_level(goal, work, level)
    if state[SEARCH] != SEARCHING and better(work, levels):
        keep_levels(work)
        work.value[BEST_COST] = work.value[COST]
    met = True
    for level in range(needed_levels(goal)):
        met = met and work.level_best[level] < 0.0
    more = work.level_best[0] >= 0.0 and state[POLISHING] == 0
    if met:
        state[STATUS] = CONVERGED
    elif state[ITERATIONS] >= state[MAX_ITERATIONS]:
        state[STATUS] = ITERATION_LIMIT
    elif more and state[RESTARTS] < state[MAX_RESTARTS] and go_on(tree, goal, work):
        return
    elif more and state[RESTARTS] > 0 and state[SEARCH] == ALL_GOALS:
        state[POLISHING] = 1
        serve_from(tree, goal, work, work.best)
        return
    else:
        state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED
    ask_for_all(goal)


@outlined
def next_level(tree, goal, work, first_damping):
    """Leaves a level that is met, or that no step helps any more."""
    state, stage = work.state, work.state[STAGE]
    met = level_met(goal, work, stage)
    if state[SEARCH] == SEARCHING:
        if met:  # from here all goals count again
            ask_for_all(goal)
            state[SEARCH] = FOUND
            copy(work.q, work.candidate)
            serve_from(tree, goal, work, work.candidate)
        else:
            end_try(tree, goal, work)
        return
    if hurried(state) and not met:
        end_try(tree, goal, work)
        return
    leave_level(goal, work, stage)
    copy(work.q, work.accepted)
    if not restore(tree, goal, work, stage + 1):
        go_back(tree, goal, work)
    state[STAGE], state[STALLS] = stage + 1, 0
    work.value[DAMPING] = first_damping if stage + 1 < needed_levels(goal) else _SOFT_DAMPING


@pure
def exhausted(state):
    """Whether a level has had its steps."""
    if hurried(state):
        return state[STALLS] >= state[PATIENCE] or state[TRY_STEPS] >= state[TRY_LIMIT]
    return state[STALLS] >= _LEVEL_PATIENCE


@outlined
def begin_levels(tree, goal, work, first_damping):
    """Measures the start."""
    state = work.state
    begin(tree, goal, work)
    if state[STATUS] == RUNNING:
        judge(tree, goal, work, measure(tree, goal, work))
    level_costs(goal, work, work.level_cost)
    for level in range(work.level_cost.shape[0]):
        work.level_best[level] = math.inf
    work.value[DAMPING] = first_damping
    state[STAGE] = _TOGETHER
    if state[STATUS] == CONVERGED and needed_levels(goal) < work.level_cost.shape[0]:
        state[STATUS] = RUNNING  # what is only wanted is still to be served


@pure
def run_levels(tree, goal, work, options):
    """All steps of a solve, until it ends or its slice does."""
    state, levels = work.state, work.level_cost.shape[0]
    if state[STATUS] != RUNNING:
        begin_levels(tree, goal, work, options.damping)
    while state[STATUS] == RUNNING and state[ITERATIONS] < state[SLICE_END]:
        stage = state[STAGE]
        if stage >= levels or state[ITERATIONS] >= state[MAX_ITERATIONS]:
            end_try(tree, goal, work)
        elif stage == _TOGETHER:
            if not step_together(tree, goal, work):
                state[STAGE], state[STALLS] = 0, 0
        elif level_met(goal, work, stage) or exhausted(state):
            next_level(tree, goal, work, options.damping)
        else:
            level_step(tree, goal, work, options)


@kernel
def lm_levels(run):
    """``lm`` for goals of several priorities, and for soft ones; its options are ``LEVEL_OPTIONS``."""
    run = open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), open_work(run.work)
    run_levels(tree, goal, work, open_options(run.options))
