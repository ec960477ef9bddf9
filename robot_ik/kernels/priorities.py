"""``lm`` for goals of several priorities: level after level, each kept while the next is served.

Near the solution all levels are served by one and the same step (``level_step.py``).  Where that leads
nowhere, level after level is; random restarts are for the first level only, and not towards what is proven
out of reach.  Levels of soft goals come last: they are never met, and never searched.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import level_step, loop
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.bundle import named_row
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import follow
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree

LEVEL_OPTIONS = ("damping", "increase", "decrease", "least", "floor")
"""Options of ``lm`` that count here, in their order."""
open_options = named_row("LevelOptions", tuple((name, "float") for name in LEVEL_OPTIONS))

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

# Entry of state[LEVEL] while all levels are served together.
_TOGETHER = -1


@pure
def take_step(tree, goal, work):
    """Measures where work.step leads, in the costs of the levels."""
    loop.apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    level_step.measure_levels(tree, goal, work)


@pure
def revert_step(tree, goal, work):
    """To where work.accepted is."""
    loop.copy(work.accepted, work.q)
    level_step.measure_levels(tree, goal, work)


@pure
def count_step(goal, work):
    """One step more."""
    work.state[ws.ITERATIONS] += 1
    if work.trace.shape[0] > 0:
        loop.record(goal.tolerance, work)


@pure
def in_random_try(state):
    """Whether a level is served for a random try only, which is short."""
    return (
        state[ws.LEVEL] == 0
        and state[ws.RESTARTS] > 0
        and state[ws.POLISHING] == 0
        and state[ws.SEARCH] != ws.FOUND
    )


@pure
def keep_first(work):
    """In the try from the start every step that is kept is the best so far."""
    state = work.state
    if state[ws.RESTARTS] == 0 and state[ws.SEARCH] == ws.ALL_GOALS:
        loop.keep_best(work)


@outlined
def step_level(tree, goal, work, options):
    """One step of the level that is being served; taken back unless it helps and harms no earlier level."""
    state, value = work.state, work.value
    floor, least = options.floor, options.least
    increase, decrease = options.increase, options.decrease
    level = state[ws.LEVEL]
    before = work.level_cost[level]
    soft = level >= level_step.needed_levels(goal)
    if state[ws.TRY_STEPS] == 0 and not soft:
        value[ws.DAMPING] = options.damping
    loop.copy(work.q, work.accepted)
    damping = value[ws.DAMPING] if soft else value[ws.DAMPING] * before + floor
    pressed, largest = level_step.stacked_step(tree, goal, work, level, damping)
    if soft and largest <= _REST:
        state[ws.STALLS] = _LEVEL_PATIENCE
        return
    take_step(tree, goal, work)
    helped = level_step.restore(tree, goal, work, level) and work.level_cost[level] < before
    if helped:
        progress = value[ws.PROGRESS] if in_random_try(state) else _LEVEL_PROGRESS
        state[ws.PRESSED] = pressed
        value[ws.DAMPING] = max(value[ws.DAMPING] * decrease, _SOFT_DAMPING if soft else least)
        state[ws.STALLS] = 0 if work.level_cost[level] < before * (1.0 - progress) else state[ws.STALLS] + 1
        keep_first(work)
    else:
        revert_step(tree, goal, work)
        value[ws.DAMPING] *= increase
        state[ws.STALLS] += 1
    state[ws.TRY_STEPS] += 1
    count_step(goal, work)


@pure
def converge(work):
    """The solution is work.q: all that is needed is met."""
    loop.keep_best(work)
    work.state[ws.STATUS] = ws.CONVERGED
    return True


@outlined
def step_together(tree, goal, work):
    """One step of all levels at once; False where that does not lead on."""
    state, levels = work.state, work.level_cost.shape[0]
    needed, last = level_step.needed_levels(goal), levels - 1
    met = level_step.levels_met(goal, work, needed)
    pressed, largest = level_step.stacked_step(tree, goal, work, last, _SOFT_DAMPING)
    if met and largest <= _REST:
        return converge(work)
    if largest > _NEAR or state[ws.STALLS] >= _AT_MOST:
        return False
    loop.copy(work.q, work.accepted)
    loop.copy(work.level_cost, work.level_bar)
    take_step(tree, goal, work)
    helped = not met or work.level_cost[last] < work.level_bar[last]
    for level in range(needed):
        shrunk = work.level_cost[level] <= _SHRINKS * work.level_bar[level]
        helped = helped and (shrunk or level_step.level_met(goal, work, level, _NEARLY_MET))
    state[ws.STALLS] += 1
    count_step(goal, work)
    if not helped:
        revert_step(tree, goal, work)
        return False
    state[ws.PRESSED] = pressed
    keep_first(work)
    if level_step.levels_met(goal, work, needed) and (needed == levels or largest <= _LAST):
        return converge(work)
    return True


@outlined
def begin_at(tree, goal, work, q):
    """Begins with the first level at ``q``."""
    state = work.state
    loop.copy(q, work.q)
    level_step.measure_levels(tree, goal, work)
    state[ws.LEVEL], state[ws.STALLS], state[ws.TRY_STEPS] = 0, 0, 0


@outlined
def start_anew(tree, goal, work):
    """The best of a few random starts."""
    state, lowest = work.state, math.inf
    state[ws.RESTARTS] += 1
    for _ in range(state[ws.DRAWS]):
        loop.draw(tree, work.nodes, work.start, state, work.q)
        follow(tree, work.q)
        level_step.measure_levels(tree, goal, work)
        if work.level_cost[0] < lowest:
            lowest = work.level_cost[0]
            loop.copy(work.q, work.candidate)
    begin_at(tree, goal, work, work.candidate)


@outlined
def try_again(tree, goal, work):
    """Another try for the first level; False where none can help.

    Where it has goals that are proven out of reach, the others are searched for without them, first from the
    best so far, and once.
    """
    state, beyond = work.state, False
    for g in range(goal.kind.shape[0]):
        beyond = beyond or (goal.level[g] == 0 and work.unreachable[g] == 1)
    if state[ws.SEARCH] == ws.FOUND:
        return False
    if state[ws.SEARCH] == ws.SEARCHING or not beyond:
        start_anew(tree, goal, work)
        return True
    if not loop.mark_unreachable(goal, work)[1]:
        return False
    loop.drop_unreachable(goal, work)
    state[ws.SEARCH] = ws.SEARCHING
    begin_at(tree, goal, work, work.best)
    return not level_step.level_met(goal, work, 0)


@outlined
def end_try(tree, goal, work):
    """After the last level: done, another random start, or the best of all; the first level decides.

    Later levels are served from where the first one was met: nothing starts anew for them.
    """
    state, levels = work.state, work.level_cost.shape[0]
    for level in range(max(state[ws.LEVEL], 0), levels):
        level_step.leave_level(goal, work, level)
    if state[ws.SEARCH] != ws.SEARCHING and level_step.better(work, levels):
        loop.copy(work.level_bar, work.level_best)
        loop.keep_best(work)
    met = True
    for level in range(level_step.needed_levels(goal)):
        met = met and work.level_best[level] < 0.0
    more = work.level_best[0] >= 0.0 and state[ws.POLISHING] == 0
    if met:
        state[ws.STATUS] = ws.CONVERGED
    elif state[ws.ITERATIONS] >= state[ws.MAX_ITERATIONS]:
        state[ws.STATUS] = ws.ITERATION_LIMIT
    elif more and state[ws.RESTARTS] < state[ws.MAX_RESTARTS] and try_again(tree, goal, work):
        return
    elif more and state[ws.RESTARTS] > 0 and state[ws.SEARCH] == ws.ALL_GOALS:
        state[ws.POLISHING] = 1
        begin_at(tree, goal, work, work.best)
        return
    else:
        state[ws.STATUS] = ws.BLOCKED if state[ws.PRESSED] > 0 else ws.STALLED
    loop.ask_for_all(goal)


@outlined
def next_level(tree, goal, work, first_damping):
    """Leaves a level that is met, or that no step helps any more."""
    state, level = work.state, work.state[ws.LEVEL]
    met = level_step.level_met(goal, work, level)
    if state[ws.SEARCH] == ws.SEARCHING:
        if met:  # from here all goals count again
            loop.ask_for_all(goal)
            state[ws.SEARCH] = ws.FOUND
            begin_at(tree, goal, work, work.q)
        else:
            end_try(tree, goal, work)
        return
    if in_random_try(state) and not met:
        end_try(tree, goal, work)
        return
    level_step.leave_level(goal, work, level)
    loop.copy(work.q, work.accepted)
    if not level_step.restore(tree, goal, work, level + 1):
        revert_step(tree, goal, work)
    state[ws.LEVEL], state[ws.STALLS] = level + 1, 0
    work.value[ws.DAMPING] = first_damping if level + 1 < level_step.needed_levels(goal) else _SOFT_DAMPING


@pure
def exhausted(state):
    """Whether a level has had its steps."""
    if in_random_try(state):
        return state[ws.STALLS] >= state[ws.PATIENCE] or state[ws.TRY_STEPS] >= state[ws.TRY_LIMIT]
    return state[ws.STALLS] >= _LEVEL_PATIENCE


@outlined
def begin_levels(tree, goal, work, first_damping):
    """Measures the start."""
    state = work.state
    loop.begin(tree, goal, work)
    if state[ws.STATUS] == ws.RUNNING:
        loop.judge(tree, goal, work, level_step.measure_levels(tree, goal, work))
    for level in range(work.level_cost.shape[0]):
        work.level_best[level] = math.inf
    work.value[ws.DAMPING] = first_damping
    state[ws.LEVEL] = _TOGETHER
    if state[ws.STATUS] == ws.CONVERGED and level_step.needed_levels(goal) < work.level_cost.shape[0]:
        state[ws.STATUS] = ws.RUNNING  # what is only wanted is still to be served


@kernel
def lm_levels(run):
    """``lm`` for goals of several priorities, and for soft ones; its options are ``LEVEL_OPTIONS``."""
    run = ws.open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), ws.open_work(run.work)
    options = open_options(run.options)
    state, levels = work.state, work.level_cost.shape[0]
    if state[ws.STATUS] != ws.RUNNING:
        begin_levels(tree, goal, work, options.damping)
    while state[ws.STATUS] == ws.RUNNING and state[ws.ITERATIONS] < state[ws.SLICE_END]:
        level = state[ws.LEVEL]
        if level >= levels or state[ws.ITERATIONS] >= state[ws.MAX_ITERATIONS]:
            end_try(tree, goal, work)
        elif level == _TOGETHER:
            if not step_together(tree, goal, work):
                state[ws.LEVEL], state[ws.STALLS] = 0, 0
        elif level_step.level_met(goal, work, level) or exhausted(state):
            next_level(tree, goal, work, options.damping)
        else:
            step_level(tree, goal, work, options)
