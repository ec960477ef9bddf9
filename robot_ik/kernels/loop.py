"""The one loop of every iterative solver: begin, proceed, advance.

A solver's kernel is five lines and its own step:

    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        ...                                  # its step: fills work.step (nu,)
        advance(tree, goal, work)

Written once here: check before step, measurement, tolerance, budget, joint limits, restarts, stall,
best so far, trace.  What changes during a solve lives in the arrays of ``work``.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.couplings import follow
from robot_ik.kernels.draws import draw
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, forward
from robot_ik.kernels.out_of_reach import (
    ask_for_all,
    drop_beyond,
    mark_beyond,
    may_restart,
    some_within_reach,
)
from robot_ik.kernels.residuals import evaluate
from robot_ik.kernels.room import apply_step, finite
from robot_ik.kernels.trace import record
from robot_ik.kernels.work import (
    ACCEPTED,
    ALL_GOALS,
    ASKED,
    AWAITED,
    BACK,
    BEST_COST,
    BEYOND,
    BLOCKED,
    CONVERGED,
    COST,
    DRAW,
    DRAWN,
    DRAWS,
    FIRST_STEPS,
    FOUND,
    FRESH,
    ITERATION_LIMIT,
    ITERATIONS,
    LOWEST,
    MAX_ITERATIONS,
    MAX_RESTARTS,
    NO_LIMIT,
    NOTHING,
    NUMERICAL,
    PATIENCE,
    POLISHING,
    PRESSED,
    PROGRESS,
    RESTARTS,
    RIVAL,
    RUNNING,
    SEARCH,
    SEARCHING,
    SHARE,
    SLICE_END,
    STALLED,
    STALLS,
    STATUS,
    STEP,
    STEP_NORM,
    TRY,
    TRY_COST,
    TRY_LIMIT,
    TRY_STEPS,
)

# A later try replaces the best only when it is better by more than this share of the cost, so that
# an unreachable goal keeps its answer from tick to tick instead of hopping between equal ones.
_CLEARLY_BETTER = 1e-3
# The last, polishing descent from the best point found: steps granted, those of a budget that are kept for
# it, and the share of the cost that counts as progress.  Far finer than in a try: an answer that still
# creeps would move at every tick; and patient, because a step that did not help only says that the next must
# be shorter.
_POLISH_STEPS = 2000
_KEPT = 200
_POLISH_PROGRESS = 1e-9
_POLISH_PATIENCE = 10


@outlined
def measure(tree, goal, work):
    """Forward pass and evaluation at work.q; returns whether all goals are within tolerance."""
    forward(tree, work.nodes, work.q, work.world, work.scratch)
    cost, within = evaluate(tree, goal, work)
    work.value[COST] = cost
    return within


@pure
def copy(source, target):
    """target = source, number by number."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@pure
def keep_best(work):
    """Remembers q as the best so far."""
    work.value[BEST_COST] = work.value[COST]
    copy(work.q, work.best)


@pure
def begin_try(work):
    """Resets what belongs to one descent, whose start has been measured."""
    state, value = work.state, work.value
    state[TRY_STEPS] = 0
    state[STALLS] = 0
    value[TRY_COST] = value[COST]
    value[ACCEPTED] = math.inf


@outlined
def begin(tree, goal, work):
    """First call of a solve: put the start inside the limits.  Later calls go on."""
    state = work.state
    if state[STATUS] != FRESH:
        return
    if not finite(work.start):
        state[STATUS] = NUMERICAL
        return
    if mark_beyond(goal, work):  # no other start will help these goals
        state[BEYOND], state[FIRST_STEPS] = 1, NO_LIMIT
    copy(work.start, work.q)
    clip(tree, tree.every, work.q)
    follow(tree, work.q)
    state[STATUS], state[AWAITED] = RUNNING, TRY


@pure
def kept_for_polish(state):
    """Steps of the budget that no random try may use, so that the answer is a local minimum."""
    return min(_KEPT, state[MAX_ITERATIONS] // 4)


@pure
def rival_wins(work):
    """Whether the best of the random tries clearly beats the answer near the start; it is then polished."""
    value = work.value
    if not value[RIVAL] < value[BEST_COST] * (1.0 - _CLEARLY_BETTER):
        return False
    value[RIVAL], value[BEST_COST] = math.inf, math.inf
    copy(work.rival, work.best)
    copy(work.rival, work.q)
    return True


@outlined
def next_try(tree, goal, work):
    """Ends a descent: random starts come next, then a polish of the best; False when there is no more."""
    state, value = work.state, work.value
    more = may_restart(state)
    if state[POLISHING] == 0 and more and state[ITERATIONS] + kept_for_polish(state) < state[MAX_ITERATIONS]:
        if state[RESTARTS] == 0:
            copy(work.best, work.nearby)
        state[RESTARTS] += 1
        state[DRAWN] = 0
        value[LOWEST] = math.inf
        draw_next(tree, work)
        return True
    if state[SEARCH] == SEARCHING:  # in vain
        end_search(goal, work)
        return False
    if state[POLISHING] == 0:
        value[RIVAL] = math.inf
        if state[RESTARTS] > 0:  # what was found near the start first: it keeps the arm where it is
            value[RIVAL] = value[BEST_COST]
            copy(work.best, work.rival)
            copy(work.nearby, work.best)
        copy(work.best, work.q)
        value[BEST_COST] = math.inf
    elif state[SEARCH] == FOUND:
        end_search(goal, work)
        return False
    elif not rival_wins(work):
        if begin_search(goal, work):
            return True
        if more:  # it was steps that ran out, not tries
            state[STATUS] = ITERATION_LIMIT
        else:  # limits hold the best point, or nothing does but its own slope
            state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED
        return False
    state[POLISHING] += 1
    value[SHARE] = min(2.0 * value[SHARE], 1.0)
    state[AWAITED] = TRY
    return True


@pure
def begin_search(goal, work):
    """Where some goals are proven out of reach: is there a place that meets the others?  False if not asked.

    The answer near the start is kept: what is found must clearly beat it.
    """
    state, value = work.state, work.value
    if state[BEYOND] == 0 or state[SEARCH] != ALL_GOALS or state[MAX_RESTARTS] == 0:
        return False
    if not some_within_reach(goal, work):
        return False
    drop_beyond(goal, work)
    copy(work.best, work.rival)
    copy(work.best, work.q)
    value[RIVAL] = value[BEST_COST]
    state[SEARCH], state[POLISHING], state[AWAITED] = ASKED, 0, TRY
    return True


@pure
def polish_found(goal, work):
    """The search has found what meets the goals within reach: from there all goals count again."""
    state, value = work.state, work.value
    ask_for_all(goal)
    value[BEST_COST], value[SHARE] = math.inf, min(value[SHARE], 1.0)
    state[SEARCH], state[POLISHING], state[AWAITED] = FOUND, 1, TRY


@pure
def end_search(goal, work):
    """The better of what was kept and what was found; the former unless the latter clearly beats it."""
    state, value = work.state, work.value
    ask_for_all(goal)
    if state[SEARCH] != FOUND or not value[BEST_COST] < value[RIVAL] * (1.0 - _CLEARLY_BETTER):
        copy(work.rival, work.best)
        value[BEST_COST] = value[RIVAL]
    state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED


@pure
def draw_next(tree, work):
    """One more random start into work.q."""
    draw(tree, work.nodes, work.start, work.state, work.q)
    follow(tree, work.q)
    work.state[DRAWN] += 1
    work.state[AWAITED] = DRAW


@pure
def shorten(work, better):
    """Makes a method that takes its steps unseen go downhill only: a step that did not help is taken back."""
    state, value = work.state, work.value
    if better:
        value[SHARE] = min(2.0 * value[SHARE], 1.0)
        return
    value[SHARE] *= 0.25
    copy(work.best, work.q)
    state[AWAITED] = BACK


@outlined
def judge(tree, goal, work, within):
    """What a measurement of work.q means: converged, best so far, progress, or which random start to take."""
    state, value = work.state, work.value
    awaited, cost = state[AWAITED], value[COST]
    state[AWAITED] = NOTHING
    if awaited == BACK:
        return
    if awaited == STEP:
        state[ITERATIONS] += 1
        state[TRY_STEPS] += 1
        if work.trace.shape[0] > 0:
            record(goal.tolerance, work)
        if not cost < math.inf:  # NaN too
            state[STATUS] = NUMERICAL
            return
    if within and state[SEARCH] == SEARCHING:
        polish_found(goal, work)
        return
    if within and state[SEARCH] == ASKED:  # the answer near the start meets them already
        end_search(goal, work)
        return
    if within:
        state[STATUS] = CONVERGED
        keep_best(work)
        return
    if state[SEARCH] == ASKED:
        state[SEARCH] = SEARCHING
    if awaited == DRAW:
        if cost < value[LOWEST]:
            value[LOWEST] = cost
            copy(work.q, work.candidate)
        if state[DRAWN] < state[DRAWS]:
            draw_next(tree, work)
            return
        if value[LOWEST] < cost:
            copy(work.candidate, work.q)
            state[AWAITED] = TRY
            return
    same_try = state[RESTARTS] == 0 or state[POLISHING] > 0
    first = awaited != STEP and same_try and state[POLISHING] == 0
    bar = value[BEST_COST] if awaited == STEP and same_try else value[BEST_COST] * (1.0 - _CLEARLY_BETTER)
    better = first or cost < bar
    if better and state[SEARCH] != SEARCHING:
        keep_best(work)
    if awaited != STEP:
        begin_try(work)
        return
    if state[POLISHING] > 0 and value[SHARE] > 0.0:
        shorten(work, better)
    progress = _POLISH_PROGRESS if state[POLISHING] > 0 else value[PROGRESS]
    if cost < value[TRY_COST] * (1.0 - progress):
        value[TRY_COST] = cost
        state[STALLS] = 0
    else:
        state[STALLS] += 1


@outlined
def proceed(tree, goal, work):
    """Whether to take another step; measures where the last one led, handles budget, stalled tries, restarts.

    This is the one place where a solver measures: what it calls is large, and would be compiled once more
    for each other.
    """
    state = work.state
    while state[STATUS] == RUNNING:
        if state[AWAITED] != NOTHING:
            judge(tree, goal, work, measure(tree, goal, work))
            continue
        if state[ITERATIONS] >= state[SLICE_END]:
            return False
        if state[ITERATIONS] >= state[MAX_ITERATIONS]:
            if state[SEARCH] != ALL_GOALS:
                end_search(goal, work)
            elif state[POLISHING] > 0:
                rival_wins(work)
            state[STATUS] = ITERATION_LIMIT
            return False
        patience = state[PATIENCE]
        if state[POLISHING] > 0:
            limit, patience = _POLISH_STEPS, max(patience, _POLISH_PATIENCE)
        elif state[RESTARTS] == 0 and state[SEARCH] == ALL_GOALS:
            limit = state[FIRST_STEPS]
        else:
            limit = state[TRY_LIMIT]
        if state[TRY_STEPS] < limit and state[STALLS] < patience:
            return True
        if not next_try(tree, goal, work):
            return False
    return False


@outlined
def advance(tree, goal, work):
    """Takes work.step, inside the limits; ``proceed`` then measures where that has led."""
    norm = 0.0
    for u in range(work.step.shape[0]):
        norm += work.step[u] * work.step[u]
    work.value[STEP_NORM] = math.sqrt(norm)
    apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    work.state[AWAITED] = STEP
