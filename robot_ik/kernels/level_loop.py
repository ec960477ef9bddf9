"""``lm`` for goals of several priorities: level after level, each kept while the next is served."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.couplings import follow
from robot_ik.kernels.draws import draw
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.levels import (
    better,
    keep_levels,
    leave_level,
    level_costs,
    level_met,
    restore,
    stacked_step,
)
from robot_ik.kernels.loop import begin, copy, judge, measure
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.room import apply_step
from robot_ik.kernels.trace import record
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import (
    BEST_COST,
    BLOCKED,
    CONVERGED,
    COST,
    DAMPING,
    ITERATION_LIMIT,
    ITERATIONS,
    MAX_ITERATIONS,
    MAX_RESTARTS,
    PRESSED,
    RESTARTS,
    RUNNING,
    SLICE_END,
    STAGE,
    STALLED,
    STALLS,
    STATUS,
    open_run,
    open_work,
)

# Steps without progress before a level is left as it is, and the share of its cost that counts as progress.
_LEVEL_PATIENCE, _LEVEL_PROGRESS = 8, 1e-6


@outlined
def level_step(tree, goal, work, options):
    """One step of the level that is being served; taken back unless it helps and harms no earlier level."""
    state, value = work.state, work.value
    floor, increase, decrease, least = options[0], options[2], options[3], options[4]
    stage = state[STAGE]
    before = work.level_cost[stage]
    copy(work.q, work.accepted)
    pressed = stacked_step(tree, goal, work, stage, value[DAMPING] * before + floor)
    apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    measure(tree, goal, work)
    level_costs(goal, work, work.level_cost)
    helped = restore(tree, goal, work, stage) and work.level_cost[stage] < before
    if helped:
        state[PRESSED] = pressed
        value[DAMPING] = max(value[DAMPING] * decrease, least)
        state[STALLS] = 0 if work.level_cost[stage] < before * (1.0 - _LEVEL_PROGRESS) else state[STALLS] + 1
    else:
        copy(work.accepted, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        value[DAMPING] *= increase
        state[STALLS] += 1
    state[ITERATIONS] += 1
    if work.trace.shape[0] > 0:
        record(state, value, work.miss, work.trace)


@outlined
def end_try(tree, goal, work):
    """After the last level: done, another random start, or the best of all; the first level decides.

    Later levels are served from where the first one was met: nothing starts anew for them.
    """
    state, levels = work.state, work.level_cost.shape[0]
    for level in range(state[STAGE], levels):
        leave_level(goal, work, level)
    if better(work, levels):
        keep_levels(work)
        work.value[BEST_COST] = work.value[COST]
    met = True
    for level in range(levels):
        met = met and work.level_bar[level] < 0.0
    if met:
        state[STATUS] = CONVERGED
    elif state[ITERATIONS] >= state[MAX_ITERATIONS]:
        state[STATUS] = ITERATION_LIMIT
    elif work.level_best[0] < 0.0 or state[RESTARTS] >= state[MAX_RESTARTS]:
        state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED
    else:
        state[RESTARTS] += 1
        draw(tree, work.nodes, work.start, state, work.q)
        follow(tree, work.q)
        measure(tree, goal, work)
        level_costs(goal, work, work.level_cost)
        state[STAGE] = 0


@kernel
def lm_levels(run):
    """``lm`` for goals of several priorities; options as there."""
    run = open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), open_work(run.work)
    state, options, levels = work.state, run.options, work.level_cost.shape[0]
    if state[STATUS] != RUNNING:
        begin(tree, goal, work)
        if state[STATUS] == RUNNING:
            judge(tree, work, measure(tree, goal, work))
        level_costs(goal, work, work.level_cost)
        for level in range(levels):
            work.level_best[level] = math.inf
        work.value[DAMPING] = options[1]
    while state[STATUS] == RUNNING and state[ITERATIONS] < state[SLICE_END]:
        stage = state[STAGE]
        if stage >= levels or state[ITERATIONS] >= state[MAX_ITERATIONS]:
            end_try(tree, goal, work)
            continue
        if level_met(goal, work, stage) or state[STALLS] >= _LEVEL_PATIENCE:
            leave_level(goal, work, stage)
            copy(work.q, work.accepted)
            if not restore(tree, goal, work, stage + 1):
                copy(work.accepted, work.q)
                measure(tree, goal, work)
                level_costs(goal, work, work.level_cost)
            state[STAGE], state[STALLS] = stage + 1, 0
            work.value[DAMPING] = options[1]
            continue
        level_step(tree, goal, work, options)
