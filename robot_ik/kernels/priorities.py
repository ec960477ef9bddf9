"""``lm`` for goals of several priorities: a level never raises the cost of an earlier level.

A level is all goals of one priority. Soft goals form the last levels: they are minimised, but they
do not decide whether the solve has converged, and they cause no restarts.

One step solves level 0 by damped least squares, then level 1 with the remaining freedom, and so on
(Siciliano & Slotine, A general framework for managing multiple tasks in highly redundant robotic
systems, ICAR 1991). A joint that the step would move over a limit is set to the limit, and the step
is computed again without it (Flacco, De Luca & Khatib, Control of redundant robots under hard joint
constraints, IEEE Transactions on Robotics 31(3), 2015). Null spaces are correct to first order
only. After each step the earlier levels are therefore restored. The step is accepted only if no
earlier level is worse and its own level is better.

The search has its own phases, because its cost is a list of costs that are compared in order:

    TOGETHER  steps for all levels at once, from the start
    FIRST     level after level from the start
    RANDOM    level after level from random points, until level 0 is met or no restarts are left
    POLISH    level after level from the best point
    COMPLETE  level after level from a point where the goals of level 0 within reach are met

    TOGETHER goes on to FIRST when a step does not help all levels.
    FIRST and RANDOM go on to RANDOM, then to POLISH. POLISH and COMPLETE end the solve.
    When all needed levels are met, the solve ends in any phase: CONVERGED.

If level 0 has goals that are proven out of reach, they are left out after FIRST
(``search.reduced``). The next point is then the best so far, then random points. When the other
goals of level 0 are met, COMPLETE begins there.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import follow
from robot_ik.kernels.linalg import (
    eliminate,
    factorise,
    row_dot,
    solve_lower,
    solve_upper,
)
from robot_ik.kernels.pose_prior import PRIOR_WORK, prior_jacobian, prior_residual
from robot_ik.kernels.residuals import GOALS, goal_jacobian, rows_end
from robot_ik.kernels.search import (
    BLOCKED,
    CONVERGED,
    FIRST,
    FRESH,
    ITERATION_LIMIT,
    NOTHING,
    NUMERICAL,
    POLISH,
    RANDOM,
    RUNNING,
    SEARCH,
    STALLED,
    advance,
    apply_step,
    copy,
    count_all_goals,
    count_step,
    draw,
    is_finite,
    keep_best,
    leave_out_unreachable,
    mark_unreachable,
    measure,
    put_start,
    step_bounds,
)
from robot_ik.kernels.tree import TREE

# More values of search.phase.
TOGETHER = 3
COMPLETE = 4

# Steps without progress before a level is left, and the share of its cost that counts as progress.
_LEVEL_PATIENCE = 8
_LEVEL_PROGRESS = 1e-6
# Steps of all levels at once: how many at most, and the largest change of a joint in one, rad or m.
_TOGETHER_STEPS = 6
_TOGETHER_STRIDE = 0.3
# Such a step brings each needed level to this share of its cost, or to this many tolerances.
_TOGETHER_SHARE = 0.25
_TOGETHER_TOLERANCES = 30.0
# Damping of a soft level, as a share of the largest entry of JᵀJ.
_SOFT_DAMPING = 1e-6
# A soft level is at rest if its step is no longer than this, rad or m.
_REST = 3e-4
# rad or m. The error after such a step of all levels is about its square, so it is the last step.
_LAST_STEP = 0.05
# Damping of an earlier level: this if it is met, else also a share of its cost.
_MET_DAMPING = 1e-12
_EARLIER_DAMPING = 0.1
# Damping, as a share of the cost, while earlier levels are restored.
_RESTORE_DAMPING = 0.5
# A row of which less than this share is left beside earlier rows adds no direction.
_DEPENDENT = 1e-6
# A row with a smaller square is zero.
_ZERO_ROW = 1e-24
# Added to the diagonal of a system, so that it stays positive definite.
_TINY = 1e-15
# A joint may exceed its bound by this before it is set to the bound, rad or m.
_BOUND_SLACK = 1e-12
# Largest change of a joint in one step, rad or m.
_STRIDE = 0.5
# Share of its cost that a level that cannot be met may lose to rounding and second order.
_COST_SLACK = 1e-5
# A cost that counts as zero.
_ZERO_COST = 1e-18
# Steps that may restore earlier levels, and the share of their tolerance that is aimed at.
_RESTORE_STEPS = 6
_RESTORE_TOLERANCE = 1e-3
# A result is better only if its first different cost differs by this share.
_CLEARLY_BETTER = 1e-3
# In ``left_cost`` and ``best_cost``: the level is met.
_MET = -1.0
# Numba compiles a callee again for a bare 0, which has a type of its own.
_ZERO = types.int64(0)

OPTIONS = Layout(
    "LevelOptions",
    damping="float",
    increase="float",
    decrease="float",
    min_damping="float",
    floor="float",
)

# With m rows of the residual, u columns, l = min(m, u).
WORK = Layout(
    "LevelWork",
    level="int",  # the current level; the number of levels after the last level
    damping="float",  # per unit of cost of a needed level
    cost="floats levels",  # half the squared residual of each level
    left_cost="floats levels",  # the cost when the next level began, or _MET
    best_cost="floats levels",  # the same of the best point
    accepted="floats nq",  # the point before the step
    jacobian="table m u",
    lower="floats u",  # bounds of the step
    upper="floats u",
    side="ints u",  # -1, 1 for a joint that the step puts at its lower or upper bound
    basis="table l u",  # orthonormal rows that span the rows of the levels so far
    projected="table m u",  # rows of a level without their part in the basis
    gram="table m m",
    multipliers="floats m",
    hessian="table u u",  # of a soft level, then its factors
    first="ints u",  # first column of each row of ``hessian`` that may differ from zero
    gradient="floats u",  # of a soft level
    direction="floats u",  # step of a soft level
    prior=PRIOR_WORK,
)

RUN = Layout("LevelRun", tree=TREE, goals=GOALS, search=SEARCH, work=WORK, options=OPTIONS)
open_run = RUN.open


# Measuring


@outlined
def measure_levels(tree, goals, search, work):
    """Measure q with the prior, and write the cost of each level; return whether all are met."""
    within = measure(tree, goals, search)
    rows = search.residual.shape[0]
    if goals.prior_goal >= 0:
        search.cost += 0.5 * prior_residual(goals, search, work.prior, goals.prior_goal)
    for level in range(work.cost.shape[0]):
        work.cost[level] = 0.0
    for g in range(goals.row.shape[0]):
        for r in range(goals.row[g], rows_end(goals, g, rows)):
            work.cost[goals.level[g]] += 0.5 * search.residual[r] * search.residual[r]
    return within


@outlined
def write_jacobian(tree, goals, search, work):
    """Write the Jacobian of all goals at q, with the rows of the pose prior."""
    goal_jacobian(tree, goals, search, False, work.jacobian)
    if goals.prior_goal >= 0:
        prior_jacobian(tree, goals, search, work.prior, goals.prior_goal, work.jacobian)


@outlined
def level_met(goals, search, level, tolerances):
    """Return whether a level is within a multiple of its tolerances. Soft levels are never met."""
    for g in range(goals.row.shape[0]):
        if goals.level[g] != level:
            continue
        if goals.soft[g] == 1:
            return False
        for i in range(2):
            if search.error[g, i] > tolerances * search.tolerance[g, i]:
                return False
    return True


@inlined
def levels_met(goals, search):
    """Return whether all needed levels are within tolerance."""
    met = True
    for level in range(goals.needed_levels):
        met = met and level_met(goals, search, level, 1.0)
    return met


# One step


@outlined
def stacked_step(tree, goals, search, work, top, damping):
    """Write the step for the levels up to ``top`` to search.step, inside the limits.

    ``damping`` is that of the top level.

    Returns:
        The number of joints pressed against a bound, and the largest change of a joint before the
        step was shortened.
    """
    step = search.step
    side = work.side
    columns = step.shape[0]
    write_jacobian(tree, goals, search, work)
    step_bounds(tree, goals, search.q, work.lower, work.upper)
    for u in range(columns):
        side[u] = 0
    pressed = 0
    for _ in range(columns + 1):
        add_levels(goals, search, work, top, damping)
        worst = worst_violation(step, work)
        if worst < 0:
            break
        side[worst] = 1 if step[worst] > work.upper[worst] else -1
        pressed += 1
    largest = 0.0
    for u in range(columns):
        largest = max(largest, abs(step[u]))
    share = _STRIDE / largest if largest > _STRIDE else 1.0
    for u in range(columns):
        step[u] = min(max(share * step[u], work.lower[u]), work.upper[u])
    return pressed, largest


@inlined
def add_levels(goals, search, work, top, damping):
    """Write the step for the levels up to ``top``, with some joints at their bounds."""
    for u in range(search.step.shape[0]):
        bound = work.lower[u] if work.side[u] < 0 else work.upper[u]
        search.step[u] = 0.0 if work.side[u] == 0 else bound
    rank = _ZERO
    for level in range(top + 1):
        if level == top and level >= goals.needed_levels:
            add_soft_level(goals, search, work, level, damping, rank)
            return
        level_damping = damping
        if level < top:
            level_damping = _MET_DAMPING
            if not level_met(goals, search, level, 1.0):
                level_damping += _EARLIER_DAMPING * work.cost[level]
        rank = add_level(goals, search, work, level, level_damping, rank)


@inlined
def worst_violation(step, work):
    """Return the free joint that the step takes farthest over its bound, or -1."""
    worst = -1
    largest = _BOUND_SLACK
    for u in range(step.shape[0]):
        excess = max(step[u] - work.upper[u], work.lower[u] - step[u])
        if work.side[u] == 0 and excess > largest:
            worst = u
            largest = excess
    return worst


@outlined
def add_level(goals, search, work, level, damping, rank):
    """Add the part of a level to search.step; return the new number of rows of work.basis.

    J'ᵀ (J'J'ᵀ + λ)⁻¹ (r − J d), with the step d so far. J' is the rows of the level without their
    part in the basis.
    """
    step = search.step
    columns = step.shape[0]
    rows = search.residual.shape[0]
    count = _ZERO
    for g in range(goals.row.shape[0]):
        if goals.level[g] != level:
            continue
        for r in range(goals.row[g], rows_end(goals, g, rows)):
            left = search.residual[r]
            for u in range(columns):
                entry = work.jacobian[r, u]
                left -= entry * step[u]
                work.projected[count, u] = entry if work.side[u] == 0 else 0.0
            project_out(work, count, _ZERO, rank)
            work.multipliers[count] = left
            count += 1
    for i in range(count):
        for j in range(i + 1):
            work.gram[i, j] = row_dot(work.projected, i, work.projected, j)
        work.gram[i, i] += damping + _TINY
    if eliminate(work.gram, work.multipliers, count):
        for i in range(count):
            for u in range(columns):
                step[u] += work.projected[i, u] * work.multipliers[i]
    return extend_basis(work, count, rank)


@outlined
def project_out(work, row, first, rank):
    """Subtract from work.projected[row] its part in work.basis[first:rank].

    Returns its square before and after.
    """
    projected = work.projected
    before = row_dot(projected, row, projected, row)
    after = before
    for _ in range(2):  # twice is enough (Kahan, in Parlett, The Symmetric Eigenvalue Problem)
        last = after
        for b in range(first, rank):
            part = row_dot(projected, row, work.basis, b)
            for u in range(projected.shape[1]):
                projected[row, u] -= part * work.basis[b, u]
        after = row_dot(projected, row, projected, row)
        if after > 0.25 * last:  # no digits were lost
            break
    return before, after


@inlined
def extend_basis(work, count, rank):
    """Add the first ``count`` rows of work.projected to the basis; return its number of rows."""
    basis = work.basis
    columns = basis.shape[1]
    first = rank
    for i in range(count):
        if rank >= basis.shape[0] or rank >= columns:
            break
        before, after = project_out(work, i, first, rank)
        if not before > _ZERO_ROW or after <= _DEPENDENT * _DEPENDENT * before:
            continue
        inverse = 1.0 / math.sqrt(after)
        for u in range(columns):
            basis[rank, u] = inverse * work.projected[i, u]
        rank += 1
    return rank


@outlined
def add_soft_level(goals, search, work, level, damping, rank):
    """Add the part of a soft level to search.step.

    z minimises ½ |r − J (d + z)|² + ½ λ |z|² with B z = 0, where B is the basis. With H = JᵀJ + λ
    and g = Jᵀ(r − J d), z = H⁻¹ (g − Bᵀμ) and (B H⁻¹ Bᵀ) μ = B H⁻¹ g. A soft level may have as many
    rows as there are joints, so the system of its free joints is solved and not that of its rows.
    """
    columns = search.step.shape[0]
    factors = work.hessian
    write_soft_system(goals, search, work, level, damping)
    factorise(factors, work.first, columns)
    copy(work.gradient, work.direction)
    solve_lower(factors, work.first, work.direction, columns)
    for b in range(rank):
        copy(work.basis[b], work.projected[b])
        solve_lower(factors, work.first, work.projected[b], columns)
        for c in range(b + 1):
            work.gram[b, c] = row_dot(work.projected, b, work.projected, c)
        work.multipliers[b] = 0.0
        for u in range(columns):
            work.multipliers[b] += work.projected[b, u] * work.direction[u]
    if not eliminate(work.gram, work.multipliers, rank):
        return
    for b in range(rank):
        for u in range(columns):
            work.direction[u] -= work.multipliers[b] * work.projected[b, u]
    solve_upper(factors, work.first, work.direction, columns)
    for u in range(columns):
        search.step[u] += work.direction[u]


@outlined
def write_soft_system(goals, search, work, level, damping):
    """Write JᵀJ + λ of the free joints of a level to work.hessian, Jᵀ(r − J d) to work.gradient.

    λ is ``damping`` times the largest entry of JᵀJ. Also writes work.first.
    """
    columns = search.step.shape[0]
    rows = search.residual.shape[0]
    for u in range(columns):
        work.gradient[u] = 0.0
        work.first[u] = u
        for v in range(u + 1):
            work.hessian[u, v] = 0.0
    for g in range(goals.row.shape[0]):
        if goals.level[g] != level:
            continue
        for r in range(goals.row[g], rows_end(goals, g, rows)):
            add_soft_row(search, work, r)
    largest = 0.0
    for u in range(columns):
        largest = max(largest, work.hessian[u, u])
    for u in range(columns):
        if work.side[u] == 0:
            work.hessian[u, u] += damping * largest + _TINY
        else:
            work.hessian[u, u] = 1.0


@inlined
def add_soft_row(search, work, r):
    """Add one row of the residual to the system of a soft level."""
    jacobian = work.jacobian
    columns = search.step.shape[0]
    left = search.residual[r]
    start = columns
    for u in range(columns - 1, -1, -1):
        left -= jacobian[r, u] * search.step[u]
        if jacobian[r, u] != 0.0:
            start = u
    for u in range(start, columns):
        entry = jacobian[r, u] if work.side[u] == 0 else 0.0
        if entry == 0.0:
            continue
        work.gradient[u] += entry * left
        work.first[u] = min(work.first[u], start)
        for v in range(start, u + 1):
            if work.side[v] == 0:
                work.hessian[u, v] += entry * jacobian[r, v]


# Earlier levels


@outlined
def levels_kept(goals, search, work, top, tolerances):
    """Return whether the levels before ``top`` are as good as when the search left them.

    A level that was met must be within ``tolerances`` times its tolerance.
    """
    for level in range(top):
        left_cost = work.left_cost[level]
        if left_cost == _MET:
            if not level_met(goals, search, level, tolerances):
                return False
        elif work.cost[level] > left_cost * (1.0 + _COST_SLACK) + _ZERO_COST:
            return False
    return True


@outlined
def restore(tree, goals, search, work, top):
    """Bring the levels before ``top`` back to where they were left; return whether that worked.

    Goals that were met are brought far inside their tolerance. Else the next step would lose what a
    later level gains inside the tolerance of an earlier one.
    """
    for _ in range(_RESTORE_STEPS):
        if levels_kept(goals, search, work, top, _RESTORE_TOLERANCE):
            return True
        damping = _MET_DAMPING
        if work.left_cost[top - 1] != _MET:
            damping = _RESTORE_DAMPING * work.cost[top - 1]
        stacked_step(tree, goals, search, work, top - 1, damping)
        apply_step(tree, goals, search)
        measure_levels(tree, goals, search, work)
    return levels_kept(goals, search, work, top, 1.0)


@inlined
def leave_level(goals, search, work, level):
    """Store whether a level is met, or its cost, when the next level begins."""
    met = level_met(goals, search, level, 1.0)
    work.left_cost[level] = _MET if met else work.cost[level]


@inlined
def is_better(work):
    """Return whether left_cost is better than best_cost. The first level that differs decides."""
    for level in range(work.cost.shape[0]):
        now = max(work.left_cost[level], 0.0)
        best = max(work.best_cost[level], 0.0)
        if now < best * (1.0 - _CLEARLY_BETTER) - _ZERO_COST:
            return True
        if now > best * (1.0 + _CLEARLY_BETTER) + _ZERO_COST:
            return False
    return False


# Steps of the search


@inlined
def is_short_try(search, work):
    """Return whether the search descends to level 0 from a random point, with few steps."""
    return search.phase == RANDOM and work.level == 0


@inlined
def keep_accepted(search):
    """In the descent from the start each accepted step is the best point so far."""
    if (search.phase == TOGETHER or search.phase == FIRST) and not search.reduced:
        keep_best(search)


@outlined
def take_step(tree, goals, search, work):
    """Take the step and measure the new point."""
    copy(search.q, work.accepted)
    advance(tree, goals, search)
    search.pending = NOTHING
    measure_levels(tree, goals, search, work)


@outlined
def undo_step(tree, goals, search, work):
    """Go back to work.accepted."""
    copy(work.accepted, search.q)
    measure_levels(tree, goals, search, work)


@outlined
def step_level(tree, goals, search, work, options):
    """Take one step of the current level. Undo it unless it helps and keeps the earlier levels."""
    level = work.level
    before = work.cost[level]
    soft = level >= goals.needed_levels
    if search.steps == 0 and not soft:
        work.damping = options.damping
    damping = work.damping if soft else work.damping * before + options.floor
    pressed, largest = stacked_step(tree, goals, search, work, level, damping)
    if soft and largest <= _REST:
        search.stalls = _LEVEL_PATIENCE
        return
    take_step(tree, goals, search, work)
    if restore(tree, goals, search, work, level) and work.cost[level] < before:
        progress = search.progress if is_short_try(search, work) else _LEVEL_PROGRESS
        min_damping = _SOFT_DAMPING if soft else options.min_damping
        work.damping = max(work.damping * options.decrease, min_damping)
        search.pressed = pressed
        search.stalls += 1
        if work.cost[level] < before * (1.0 - progress):
            search.stalls = 0
        keep_accepted(search)
    else:
        undo_step(tree, goals, search, work)
        work.damping *= options.increase
        search.stalls += 1
    search.damping = work.damping
    count_step(search)


@outlined
def step_together(tree, goals, search, work):
    """Take one step of all levels; return whether this phase goes on or has converged."""
    last = work.cost.shape[0] - 1
    needed = goals.needed_levels
    met = levels_met(goals, search)
    pressed, largest = stacked_step(tree, goals, search, work, last, _SOFT_DAMPING)
    if met and largest <= _REST:
        converge(search)
        return True
    if largest > _TOGETHER_STRIDE or search.stalls >= _TOGETHER_STEPS:
        return False
    copy(work.cost, work.left_cost)
    take_step(tree, goals, search, work)
    helped = not met or work.cost[last] < work.left_cost[last]
    for level in range(needed):
        shrunk = work.cost[level] <= _TOGETHER_SHARE * work.left_cost[level]
        helped = helped and (shrunk or level_met(goals, search, level, _TOGETHER_TOLERANCES))
    search.stalls += 1
    count_step(search)
    if not helped:
        undo_step(tree, goals, search, work)
        return False
    search.pressed = pressed
    keep_accepted(search)
    if levels_met(goals, search) and (needed > last or largest <= _LAST_STEP):
        converge(search)
    return True


@inlined
def converge(search):
    """End the solve at q, where all needed goals are met."""
    keep_best(search)
    search.status = CONVERGED


# Phases


@outlined
def begin(tree, goals, search, work, options):
    """Measure the start. Does nothing when a solve continues."""
    if search.status != FRESH:
        return
    if not is_finite(search):
        search.status = NUMERICAL
        return
    count_all_goals(goals, search)
    mark_unreachable(goals, search)
    put_start(tree, search)
    within = measure_levels(tree, goals, search, work)
    keep_best(search)
    for level in range(work.best_cost.shape[0]):
        work.best_cost[level] = math.inf
    work.damping = options.damping
    work.level = 0
    search.phase = TOGETHER
    search.status = RUNNING
    if within and goals.needed_levels == work.cost.shape[0]:
        search.status = CONVERGED


@outlined
def begin_levels(tree, goals, search, work, q):
    """Begin with level 0 at ``q``."""
    copy(q, search.q)
    measure_levels(tree, goals, search, work)
    work.level = 0
    search.steps = 0
    search.stalls = 0


@outlined
def begin_random(tree, goals, search, work):
    """Begin at the best of a few random points."""
    search.phase = RANDOM
    search.restarts += 1
    search.lowest_draw = math.inf
    for _ in range(search.draws):
        draw(tree, goals, search)
        follow(tree, search.q)
        measure_levels(tree, goals, search, work)
        if work.cost[0] < search.lowest_draw:
            search.lowest_draw = work.cost[0]
            copy(search.q, search.best_draw)
    begin_levels(tree, goals, search, work, search.best_draw)


@inlined
def begin_next_try(tree, goals, search, work):
    """Begin another try for level 0; return False if no try can help."""
    if search.phase == COMPLETE:
        return False
    if search.reduced or not level_0_is_beyond_reach(goals, search):
        begin_random(tree, goals, search, work)
        return True
    if not mark_unreachable(goals, search):
        return False
    leave_out_unreachable(goals, search)
    begin_levels(tree, goals, search, work, search.best)
    return not level_met(goals, search, _ZERO, 1.0)


@inlined
def level_0_is_beyond_reach(goals, search):
    """Return whether a goal of level 0 is proven out of reach."""
    beyond = False
    for g in range(goals.row.shape[0]):
        beyond = beyond or (goals.level[g] == 0 and search.unreachable[g] == 1)
    return beyond


@outlined
def end_try(tree, goals, search, work):
    """After the last level: end the solve, or begin another try. Level 0 decides."""
    for level in range(work.level, work.cost.shape[0]):
        leave_level(goals, search, work, level)
    if not search.reduced and is_better(work):
        copy(work.left_cost, work.best_cost)
        keep_best(search)
    met = True
    for level in range(goals.needed_levels):
        met = met and work.best_cost[level] == _MET
    may_go_on = work.best_cost[0] != _MET and search.phase != POLISH
    if met:
        search.status = CONVERGED
    elif search.iterations >= search.max_iterations:
        search.status = ITERATION_LIMIT
    elif (
        may_go_on
        and search.restarts < search.max_restarts
        and begin_next_try(tree, goals, search, work)
    ):
        return
    elif may_go_on and search.phase == RANDOM and not search.reduced:
        search.phase = POLISH
        begin_levels(tree, goals, search, work, search.best)
        return
    else:
        search.status = BLOCKED if search.pressed > 0 else STALLED
    count_all_goals(goals, search)


@outlined
def end_level(tree, goals, search, work, options):
    """Leave a level that is met, or that no step improves."""
    level = work.level
    met = level_met(goals, search, level, 1.0)
    if search.reduced and met:
        count_all_goals(goals, search)
        search.phase = COMPLETE
        begin_levels(tree, goals, search, work, search.q)
        return
    if search.reduced or (is_short_try(search, work) and not met):
        end_try(tree, goals, search, work)
        return
    leave_level(goals, search, work, level)
    copy(search.q, work.accepted)
    if not restore(tree, goals, search, work, level + 1):
        undo_step(tree, goals, search, work)
    work.level = level + 1
    work.damping = options.damping if work.level < goals.needed_levels else _SOFT_DAMPING
    search.stalls = 0


@inlined
def has_patience(search, work):
    """Return whether the level has steps and patience left."""
    if is_short_try(search, work):
        return search.stalls < search.patience and search.steps < search.random_steps
    return search.stalls < _LEVEL_PATIENCE


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    tree = run.tree
    goals = run.goals
    search = run.search
    work = run.work
    begin(tree, goals, search, work, run.options)
    while search.status == RUNNING and search.iterations < search.slice_end:
        if work.level >= work.cost.shape[0] or search.iterations >= search.max_iterations:
            end_try(tree, goals, search, work)
        elif search.phase == TOGETHER:
            if not step_together(tree, goals, search, work):
                search.phase = FIRST
                search.steps = 0
                search.stalls = 0
        elif level_met(goals, search, work.level, 1.0) or not has_patience(search, work):
            end_level(tree, goals, search, work, run.options)
        else:
            step_level(tree, goals, search, work, run.options)
