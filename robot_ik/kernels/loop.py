"""The one loop of every iterative solver: begin, proceed, advance.

A solver's kernel is five lines and its own step:

    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        ...                                  # its step: fills work.step (nu,)
        advance(tree, goal, work)

Written once here: check before step, tolerance, budget, joint limits, restarts, stall, best so far,
trace.  What changes during a solve lives in the arrays of ``work``.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.couplings import follow
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, forward, turn_quat
from robot_ik.kernels.residuals import evaluate
from robot_ik.kernels.tree import BALL, FREE
from robot_ik.kernels.work import (
    ACCEPTED,
    BEST_COST,
    BLOCKED,
    CONVERGED,
    COST,
    DAMPING,
    FIRST_STEPS,
    FRESH,
    ITERATION_LIMIT,
    ITERATIONS,
    MAX_ITERATIONS,
    MAX_RESTARTS,
    NUMERICAL,
    PATIENCE,
    POLISHING,
    PRESSED,
    PROGRESS,
    RESTARTS,
    RUNNING,
    SEED,
    SLICE_END,
    STALLED,
    STALLS,
    STATUS,
    STEP_NORM,
    TRACE_ROWS,
    TRY_COST,
    TRY_LIMIT,
    TRY_STEPS,
)

# A later try replaces the best only when it is better by more than this share of the cost, so that
# an unreachable goal keeps its answer from tick to tick instead of hopping between equal ones.
_CLEARLY_BETTER = 1e-3
# The last, polishing descent from the best point found: steps granted, and the share of the cost that
# counts as progress.  Far finer than in a try: an answer that still creeps would move at every tick.
_POLISH_STEPS = 100
_POLISH_PROGRESS = 1e-9


@pure
def uniform(state):
    """Next number in [0, 1): xorshift64* (Vigna 2016), so that a seed gives the same bits everywhere."""
    x = types.uint64(state[SEED])
    x ^= x >> types.uint64(12)
    x ^= x << types.uint64(25)
    x ^= x >> types.uint64(27)
    state[SEED] = types.int64(x)
    return types.float64((x * types.uint64(2685821657736338717)) >> types.uint64(11)) * (
        1.0 / 9007199254740992.0
    )


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
    """First call of a solve: put the start inside the limits and measure it.  Later calls go on."""
    if work.state[STATUS] != FRESH:
        return
    copy(work.start, work.q)
    clip(tree, tree.every, work.q)
    follow(tree, work.q)
    within = measure(tree, goal, work)
    work.state[STATUS] = CONVERGED if within else RUNNING
    keep_best(work)
    begin_try(work)


@outlined
def draw(tree, nodes, start, state, q):
    """A random start for the joints that matter, inside their limits, into q; floats roam round ``start``."""
    kind, qadr, vadr, low, high = tree.kind, tree.qadr, tree.vadr, tree.low, tree.high
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a, v = qadr[k], vadr[k]
        joint = kind[k]
        if joint < BALL:
            q[a] = low[v] + (high[v] - low[v]) * uniform(state)
            continue
        if joint == FREE:
            for i in range(3):
                spread = low[v + i] + (high[v + i] - low[v + i]) * uniform(state)
                q[a + i] = start[a + i] + spread
            a, v = a + 3, v + 3
        q[a], q[a + 1], q[a + 2], q[a + 3] = 1.0, 0.0, 0.0, 0.0
        # A direction on the sphere and an angle in the cone.
        z = 2.0 * uniform(state) - 1.0
        around = 2.0 * math.pi * uniform(state)
        angle = min(high[v], math.pi) * uniform(state)
        r = angle * math.sqrt(max(0.0, 1.0 - z * z))
        turn_quat(q, a, r * math.cos(around), r * math.sin(around), angle * z)


@outlined
def next_try(tree, goal, work):
    """Ends a descent: a random restart, then one last polish of the best; False when there is no more."""
    state, value = work.state, work.value
    if state[POLISHING] == 1:
        # Out of tries: limits hold the best point, or nothing does but its own slope.
        state[STATUS] = BLOCKED if state[PRESSED] > 0 else STALLED
        return False
    if state[RESTARTS] < state[MAX_RESTARTS]:
        state[RESTARTS] += 1
        draw(tree, work.nodes, work.start, state, work.q)
        follow(tree, work.q)
    else:
        state[POLISHING] = 1
        copy(work.best, work.q)
    if measure(tree, goal, work):
        keep_best(work)
        state[STATUS] = CONVERGED
        return False
    if value[COST] < value[BEST_COST] * (1.0 - _CLEARLY_BETTER):
        keep_best(work)
    begin_try(work)
    return True


@pure
def proceed(tree, goal, work):
    """Whether to take another step; handles budget, stalled tries and restarts."""
    state = work.state
    if state[STATUS] != RUNNING or state[ITERATIONS] >= state[SLICE_END]:
        return False
    if state[ITERATIONS] >= state[MAX_ITERATIONS]:
        state[STATUS] = ITERATION_LIMIT
        return False
    if state[POLISHING] == 1:
        limit = _POLISH_STEPS
    elif state[RESTARTS] == 0:
        limit = state[FIRST_STEPS]
    else:
        limit = state[TRY_LIMIT]
    if state[TRY_STEPS] >= limit or state[STALLS] >= state[PATIENCE]:
        return next_try(tree, goal, work)
    return True


@outlined
def apply_step(tree, goal, nodes, step, dq, q):
    """q = q ⊕ ease · step for the goals' degrees of freedom, inside the limits; ``dq`` is work space."""
    dofs, ease = goal.dofs, goal.ease
    kind, qadr, vadr, dof_node, lower, upper = (
        tree.kind, tree.qadr, tree.vadr, tree.dof_node, tree.lower, tree.upper,
    )  # fmt: skip
    floating = False
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            q[a] = min(max(q[a] + ease[u] * step[u], lower[v]), upper[v])
        else:
            floating = True
            dq[v] = ease[u] * step[u]
    if tree.tied.shape[0] > 0:
        follow(tree, q)
    if not floating:
        return
    for index in range(nodes.shape[0]):
        k = nodes[index]
        if kind[k] < BALL:
            continue
        a, v = qadr[k], vadr[k]
        if kind[k] == FREE:
            for i in range(3):
                q[a + i] += dq[v + i]
            a, v = a + 3, v + 3
        turn_quat(q, a, dq[v], dq[v + 1], dq[v + 2])
    clip(tree, nodes, q)


@pure
def room(tree, goal, work):
    """How far each degree of freedom may still go from work.q: work.low <= step <= work.high.

    In units of the step, which ``apply_step`` shortens for stiff joints.
    """
    kind, qadr, dof_node, lower, upper = tree.kind, tree.qadr, tree.dof_node, tree.lower, tree.upper
    dofs, ease, q, low, high = goal.dofs, goal.ease, work.q, work.low, work.high
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            low[u] = min(lower[v] - q[a], 0.0) / ease[u]
            high[u] = max(upper[v] - q[a], 0.0) / ease[u]
        else:
            # A ball's cone is kept by projection after the step; here a step stays below half a turn.
            low[u] = -3.0
            high[u] = 3.0


@outlined
def record(state, value, miss, trace):
    """One trace row, if there is room."""
    row = state[TRACE_ROWS]
    if row >= trace.shape[0]:
        return
    position, angle = 0.0, 0.0
    for g in range(miss.shape[0]):
        position = max(position, miss[g, 0])
        angle = max(angle, miss[g, 1])
    trace[row, 0] = state[ITERATIONS]
    trace[row, 1] = state[RESTARTS]
    trace[row, 2] = value[COST]
    trace[row, 3] = position
    trace[row, 4] = angle
    trace[row, 5] = value[DAMPING]
    trace[row, 6] = value[STEP_NORM]
    state[TRACE_ROWS] = row + 1


@outlined
def advance(tree, goal, work):
    """Takes work.step: integrate, limits, measure, best so far, stall, trace."""
    state, value, step = work.state, work.value, work.step
    norm = 0.0
    for u in range(step.shape[0]):
        norm += step[u] * step[u]
    value[STEP_NORM] = math.sqrt(norm)
    apply_step(tree, goal, work.nodes, step, work.dq, work.q)
    within = measure(tree, goal, work)
    state[ITERATIONS] += 1
    state[TRY_STEPS] += 1
    if work.trace.shape[0] > 0:
        record(state, value, work.miss, work.trace)
    cost = value[COST]
    if not cost < math.inf:  # NaN too
        state[STATUS] = NUMERICAL
        return
    if within:
        state[STATUS] = CONVERGED
        keep_best(work)
        return
    same_try = state[RESTARTS] == 0 or state[POLISHING] == 1
    bar = value[BEST_COST] if same_try else value[BEST_COST] * (1.0 - _CLEARLY_BETTER)
    if cost < bar:
        keep_best(work)
    progress = _POLISH_PROGRESS if state[POLISHING] == 1 else value[PROGRESS]
    if cost < value[TRY_COST] * (1.0 - progress):
        value[TRY_COST] = cost
        state[STALLS] = 0
    else:
        state[STALLS] += 1
