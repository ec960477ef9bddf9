"""The one loop of every iterative solver: begin, proceed, advance.

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

from numba import types

from robot_ik.kernels import workspace as ws
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, follow, forward, integrate, rotate_quat
from robot_ik.kernels.residuals import ONE_SIDE, PARTIAL, POSITION_PART, evaluate
from robot_ik.kernels.tree import BALL, FREE


@pure
def uniform(state):
    """Next number in [0, 1): xorshift64* (Vigna 2016), so that a seed gives the same bits everywhere."""
    x = types.uint64(state[ws.SEED])
    x ^= x >> types.uint64(12)
    x ^= x << types.uint64(25)
    x ^= x >> types.uint64(27)
    state[ws.SEED] = types.int64(x)
    bits = (x * types.uint64(2685821657736338717)) >> types.uint64(11)
    return types.float64(bits) * (1.0 / 9007199254740992.0)


@outlined
def draw(tree, nodes, start, state, q):
    """A random start for the joints that matter, inside their limits, into q; a free base near ``start``."""
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
        rotate_quat(q, a, r * math.cos(around), r * math.sin(around), angle * z)


@outlined
def apply_step(tree, goal, nodes, step, dq, q):
    """q = q ⊕ joint scale · step for the goals' joints, inside the limits; ``dq`` is work space."""
    dofs, joint_scale = goal.dofs, goal.joint_scale
    kind, qadr, lower, upper = tree.kind, tree.qadr, tree.lower, tree.upper
    floating = False
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = tree.dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            q[a] = min(max(q[a] + joint_scale[u] * step[u], lower[v]), upper[v])
        else:
            if not floating:
                floating = True
                dq[:] = 0.0
            dq[v] = joint_scale[u] * step[u]
    if floating:
        integrate(tree, nodes, q, dq)
        clip(tree, nodes, q)
    if tree.coupled.shape[0] > 0:
        follow(tree, q)


@pure
def step_bounds(tree, goal, work):
    """work.low <= step <= work.high: how far each degree of freedom may go from work.q, as a step."""
    kind, qadr, dof_node, lower, upper = tree.kind, tree.qadr, tree.dof_node, tree.lower, tree.upper
    dofs, joint_scale, q, low, high = goal.dofs, goal.joint_scale, work.q, work.low, work.high
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            low[u] = min(lower[v] - q[a], 0.0) / joint_scale[u]
            high[u] = max(upper[v] - q[a], 0.0) / joint_scale[u]
        else:
            # A ball's cone is kept by projection after the step; here a step stays below π.
            low[u] = -3.0
            high[u] = 3.0


@outlined
def record(tolerance, work):
    """One trace row; of goals that are only wanted, and of parts not asked for, the miss does not count."""
    state, value, miss, trace = work.state, work.value, work.miss, work.trace
    row = state[ws.TRACE_ROWS]
    if row >= trace.shape[0]:
        return
    position, angle = 0.0, 0.0
    for g in range(miss.shape[0]):
        position = max(position, miss[g, 0] if tolerance[g, 0] < math.inf else 0.0)
        angle = max(angle, miss[g, 1] if tolerance[g, 1] < math.inf else 0.0)
    trace[row, 0], trace[row, 1] = state[ws.ITERATIONS], state[ws.RESTARTS]
    trace[row, 2], trace[row, 3], trace[row, 4] = value[ws.COST], position, angle
    trace[row, 5], trace[row, 6] = value[ws.DAMPING], value[ws.STEP_NORM]
    state[ws.TRACE_ROWS] = row + 1


# A goal for a position farther away than all links laid end to end cannot be met from any start.  The goals
# beside it can: it is left out until they are met, and all goals share the last descent.


@pure
def squared_distance(goal, reach, g):
    """Squared metres from the centre of the ball that goal ``g`` cannot leave to the position it asks for."""
    target, square = goal.target, 0.0
    x, y, z = target[g, 0] - reach[g, 0], target[g, 1] - reach[g, 1], target[g, 2] - reach[g, 2]
    if goal.kind[g] != PARTIAL:
        return x * x + y * y + z * z
    for i in range(3):
        off = goal.mask[g, i] * (target[g, 3 + i] * x + target[g, 6 + i] * y + target[g, 9 + i] * z)
        if goal.row_codes[g, POSITION_PART] == ONE_SIDE:
            off = max(off, 0.0)
        square += off * off
    return square


@outlined
def mark_unreachable(goal, work):
    """Marks in work.unreachable the goals that are proven out of reach.

    Returns whether there are any, and whether the first level needs something beside them.
    """
    any_beyond, others = False, False
    ask_for_all(goal)
    for g in range(goal.kind.shape[0]):
        far = work.reach[g, 3] < math.inf
        far = far and squared_distance(goal, work.reach, g) > work.reach[g, 3] * work.reach[g, 3]
        work.unreachable[g] = 1 if far else 0
        any_beyond = any_beyond or far
        needed = min(goal.asked[g, 2], goal.asked[g, 3]) < math.inf
        others = others or (needed and goal.level[g] == 0 and not far)
    return any_beyond, others


@pure
def ask_for_all(goal):
    """All goals count as they were asked for."""
    for g in range(goal.kind.shape[0]):
        for i in range(2):
            goal.weight[g, i] = goal.asked[g, i]
            goal.tolerance[g, i] = goal.asked[g, 2 + i]


@outlined
def drop_unreachable(goal, work):
    """Goals that are proven out of reach count nothing until ``ask_for_all``."""
    for g in range(goal.kind.shape[0]):
        for i in range(2):
            if work.unreachable[g] == 1:
                goal.weight[g, i], goal.tolerance[g, i] = 0.0, math.inf


# A later try replaces the best only when it is better by more than this share of the cost, so that
# an unreachable goal keeps its solution from tick to tick instead of hopping between equal ones.
_CLEARLY_BETTER = 1e-3
# The last, polishing descent from the best point found: steps granted, those of a budget kept for it …
_POLISH_STEPS, _KEPT = 2000, 200
# … and the share of the cost that counts as progress: a solution that still creeps would move at every tick.
# Patient, because a step that did not help only says that the next must be shorter.
_POLISH_PROGRESS, _POLISH_PATIENCE = 1e-9, 10


@outlined
def measure(tree, goal, work):
    """Forward pass and evaluation at work.q; returns whether all goals are within tolerance."""
    forward(tree, work.nodes, work.q, work.world, work.scratch)
    cost, within = evaluate(tree, goal, work)
    work.value[ws.COST] = cost
    return within


@pure
def copy(source, target):
    """target = source, number by number."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@pure
def take_row(goal, work, targets, starts, row):
    """The target (n, 12) and the start (n, nq) of one row of a batch."""
    for i in range(12):
        goal.target[0, i] = targets[row, i]
    for i in range(work.start.shape[0]):
        work.start[i] = starts[row, i]


@pure
def give_row(work, q, miss, iterations, row):
    """The result of that row: q (n, nq), miss (n, 2), iterations (n,)."""
    for i in range(work.best.shape[0]):
        q[row, i] = work.best[i]
    miss[row, 0], miss[row, 1] = work.miss[0, 0], work.miss[0, 1]
    iterations[row] = work.state[ws.ITERATIONS]


@pure
def keep_best(work):
    """Remembers q as the best so far."""
    work.value[ws.BEST_COST] = work.value[ws.COST]
    copy(work.q, work.best)


@outlined
def begin(tree, goal, work):
    """First call of a solve: put the start inside the limits.  Later calls go on."""
    state = work.state
    if state[ws.STATUS] != ws.FRESH:
        return
    for i in range(work.start.shape[0]):
        if not abs(work.start[i]) < math.inf:  # NaN too
            state[ws.STATUS] = ws.NUMERICAL
            return
    any_beyond, others = mark_unreachable(goal, work)
    if any_beyond:
        state[ws.ANY_UNREACHABLE] = 1
        if others and work.level_cost.shape[0] == 0 and state[ws.MAX_RESTARTS] > 0:
            drop_unreachable(goal, work)
            state[ws.SEARCH] = ws.SEARCHING
        else:
            state[ws.FIRST_STEPS] = ws.NO_LIMIT  # no other start will help these goals
    copy(work.start, work.q)
    clip(tree, tree.every, work.q)
    follow(tree, work.q)
    state[ws.STATUS], state[ws.AWAITED] = ws.RUNNING, ws.TRY


@pure
def rival_wins(work):
    """Whether the best of the random tries clearly beats the solution near the start; it is then polished."""
    value = work.value
    if not value[ws.RIVAL] < value[ws.BEST_COST] * (1.0 - _CLEARLY_BETTER):
        return False
    value[ws.RIVAL], value[ws.BEST_COST] = math.inf, math.inf
    copy(work.rival, work.best)
    copy(work.rival, work.q)
    return True


@outlined
def next_try(tree, goal, work):
    """Ends a descent: random starts come next, then a polish of the best; False when there is no more."""
    state, value = work.state, work.value
    # Not towards what is proven out of reach.
    more = state[ws.ANY_UNREACHABLE] == 0 or state[ws.SEARCH] == ws.SEARCHING
    more = more and state[ws.RESTARTS] < state[ws.MAX_RESTARTS]
    # No random try may use the steps of the polish: the result is a local minimum.
    left = state[ws.MAX_ITERATIONS] - min(_KEPT, state[ws.MAX_ITERATIONS] // 4) - state[ws.ITERATIONS]
    if state[ws.POLISHING] == 0 and more and left > 0:
        if state[ws.RESTARTS] == 0:
            copy(work.best, work.nearby)
        state[ws.RESTARTS] += 1
        state[ws.DRAWN], value[ws.LOWEST] = 0, math.inf
        draw_next(tree, work)
        return True
    if state[ws.SEARCH] == ws.SEARCHING:  # in vain
        copy(work.best, work.q)
        descend_with_all(goal, work)
        return True
    if state[ws.POLISHING] == 0:
        value[ws.RIVAL] = math.inf
        if state[ws.RESTARTS] > 0:  # what was found near the start first: it keeps the arm where it is
            value[ws.RIVAL] = value[ws.BEST_COST]
            copy(work.best, work.rival)
            copy(work.nearby, work.best)
        copy(work.best, work.q)
        value[ws.BEST_COST] = math.inf
    elif not rival_wins(work):
        if more:  # it was steps that ran out, not tries
            state[ws.STATUS] = ws.ITERATION_LIMIT
        else:  # limits hold the best point, or nothing does but its own slope
            state[ws.STATUS] = ws.BLOCKED if state[ws.PRESSED] > 0 else ws.STALLED
        return False
    state[ws.POLISHING] += 1
    value[ws.SHARE] = min(2.0 * value[ws.SHARE], 1.0)
    state[ws.AWAITED] = ws.TRY
    return True


@pure
def descend_with_all(goal, work):
    """The last descent, from work.q: what is proven out of reach counts too from here on."""
    state, value = work.state, work.value
    ask_for_all(goal)
    value[ws.BEST_COST], value[ws.RIVAL], value[ws.SHARE] = math.inf, math.inf, min(value[ws.SHARE], 1.0)
    state[ws.SEARCH], state[ws.POLISHING], state[ws.AWAITED] = ws.ALL_GOALS, 1, ws.TRY


@pure
def draw_next(tree, work):
    """One more random start into work.q."""
    draw(tree, work.nodes, work.start, work.state, work.q)
    follow(tree, work.q)
    work.state[ws.DRAWN] += 1
    work.state[ws.AWAITED] = ws.DRAW


@pure
def adapt_share(work, better):
    """Makes a method that takes its steps unseen go downhill only: a step that did not help is taken back."""
    state, value = work.state, work.value
    if better:
        value[ws.SHARE] = min(2.0 * value[ws.SHARE], 1.0)
        return
    value[ws.SHARE] *= 0.25
    copy(work.best, work.q)
    state[ws.AWAITED] = ws.BACK


@outlined
def judge(tree, goal, work, within):
    """What a measurement of work.q means: converged, best so far, progress, or which random start to take."""
    state, value = work.state, work.value
    awaited, cost = state[ws.AWAITED], value[ws.COST]
    state[ws.AWAITED] = ws.NOTHING
    if awaited == ws.BACK:
        return
    if awaited == ws.STEP:
        state[ws.ITERATIONS] += 1
        state[ws.TRY_STEPS] += 1
        if work.trace.shape[0] > 0:
            record(goal.tolerance, work)
        if not cost < math.inf:  # NaN too
            state[ws.STATUS] = ws.NUMERICAL
            return
    if within and state[ws.SEARCH] == ws.SEARCHING:
        descend_with_all(goal, work)
        return
    if within:
        state[ws.STATUS] = ws.CONVERGED
        keep_best(work)
        return
    if awaited == ws.DRAW:
        if cost < value[ws.LOWEST]:
            value[ws.LOWEST] = cost
            copy(work.q, work.candidate)
        if state[ws.DRAWN] < state[ws.DRAWS]:
            draw_next(tree, work)
            return
        if value[ws.LOWEST] < cost:
            copy(work.candidate, work.q)
            state[ws.AWAITED] = ws.TRY
            return
    first = awaited != ws.STEP and state[ws.RESTARTS] == 0 and state[ws.POLISHING] == 0
    same_try = awaited == ws.STEP and (state[ws.RESTARTS] == 0 or state[ws.POLISHING] > 0)
    better = first or cost < value[ws.BEST_COST] * (1.0 if same_try else 1.0 - _CLEARLY_BETTER)
    if better:
        keep_best(work)
    if awaited != ws.STEP:
        state[ws.TRY_STEPS] = state[ws.STALLS] = 0
        value[ws.TRY_COST], value[ws.ACCEPTED] = cost, math.inf
        return
    if state[ws.POLISHING] > 0 and value[ws.SHARE] > 0.0:
        adapt_share(work, better)
    progress = _POLISH_PROGRESS if state[ws.POLISHING] > 0 else value[ws.PROGRESS]
    if cost < value[ws.TRY_COST] * (1.0 - progress):
        value[ws.TRY_COST] = cost
        state[ws.STALLS] = 0
    else:
        state[ws.STALLS] += 1


@outlined
def proceed(tree, goal, work):
    """Whether to take another step; the one place that measures: what it calls is large."""
    state = work.state
    while state[ws.STATUS] == ws.RUNNING:
        if state[ws.AWAITED] != ws.NOTHING:
            judge(tree, goal, work, measure(tree, goal, work))
            continue
        if state[ws.ITERATIONS] >= state[ws.SLICE_END]:
            return False
        if state[ws.ITERATIONS] >= state[ws.MAX_ITERATIONS]:
            if state[ws.SEARCH] == ws.SEARCHING:
                ask_for_all(goal)
            elif state[ws.POLISHING] > 0:
                rival_wins(work)
            state[ws.STATUS] = ws.ITERATION_LIMIT
            return False
        patience = state[ws.PATIENCE]
        if state[ws.POLISHING] > 0:
            limit, patience = _POLISH_STEPS, max(patience, _POLISH_PATIENCE)
        elif state[ws.RESTARTS] == 0:
            limit = state[ws.FIRST_STEPS]
        else:
            limit = state[ws.TRY_LIMIT]
        if state[ws.TRY_STEPS] < limit and state[ws.STALLS] < patience:
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
    work.value[ws.STEP_NORM] = math.sqrt(norm)
    apply_step(tree, goal, work.nodes, work.step, work.dq, work.q)
    work.state[ws.AWAITED] = ws.STEP
