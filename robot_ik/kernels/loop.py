"""The one loop of every iterative solver: begin, proceed, advance.

A solver's kernel is five lines and its own step:

    tree, goal, work = unpack(tree, goals, work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        ...                                  # its step: fills work.step (nu,)
        advance(tree, goal, work)

Written once here: check before step, tolerance, budget, joint limits, restarts, stall, best so far,
trace.  What changes during a solve lives in the arrays of ``work``.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math
from collections import namedtuple

from numba import types
from numba.experimental import structref

from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import clip, forward, turn_quat
from robot_ik.kernels.residuals import evaluate, goal_arrays
from robot_ik.kernels.tree import BALL, FREE

# Status; ``solution.Status`` gives them their names.
FRESH, RUNNING, CONVERGED, STALLED, ITERATION_LIMIT, TIME_LIMIT, UNREACHABLE, BLOCKED, NUMERICAL = range(9)

# Entries of work.state (int64).
(
    STATUS, ITERATIONS, RESTARTS, TRY_STEPS, STALLS, PRESSED, POLISHING, TRACE_ROWS,
    MAX_ITERATIONS, MAX_RESTARTS, FIRST_STEPS, TRY_LIMIT, PATIENCE, SLICE_END, STATE_SIZE,
) = range(15)  # fmt: skip

# Entries of work.value (float64).
COST, BEST_COST, TRY_COST, STEP_NORM, DAMPING, ACCEPTED, PROGRESS, VALUE_SIZE = range(8)

# Columns of a trace row.
TRACE_COLUMNS = ("iteration", "restart", "cost", "position", "angle", "damping", "step")

# A later try replaces the best only when it is better by more than this share of the cost, so that
# an unreachable goal keeps its answer from tick to tick instead of hopping between equal ones.
_CLEARLY_BETTER = 1e-3
# Steps granted to the last, polishing descent from the best point found.
_POLISH_STEPS = 100


@structref.register
class _WorkType(types.StructRef):  # type: ignore[misc]
    def preprocess_fields(self, fields):
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class WorkProxy(structref.StructRefProxy):  # type: ignore[misc]
    """Handle of a solver's work space: hand it to kernels, do not look inside."""


structref.define_boxing(_WorkType, WorkProxy)
_INTS = types.Array(types.int64, 1, "C")
_FLOATS = types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
WORK = _WorkType(
    (
        ("state", _INTS),  # (STATE_SIZE,)
        ("value", _FLOATS),  # (VALUE_SIZE,)
        ("seed", types.Array(types.uint64, 1, "C")),  # (1,) state of the random numbers
        ("start", _FLOATS),  # (nq,)
        ("q", _FLOATS),  # (nq,) where the solver is
        ("best", _FLOATS),  # (nq,) best so far
        ("accepted", _FLOATS),  # (nq,) free for a solver that may reject a step
        ("nodes", _INTS),  # joints that move any goal, parents first
        ("world", _TABLE),  # (n, 12) node poses
        ("scratch", _TABLE),  # (2, 12)
        ("frames", _TABLE),  # (g, 12) goal frames
        ("residual", _FLOATS),  # (m,)
        ("miss", _TABLE),  # (g, 2) metres, radians
        ("jacobian", _TABLE),  # (m, nu)
        ("normal", _TABLE),  # (nu, nu)
        ("damped", _TABLE),  # (nu, nu)
        ("factor", _TABLE),  # (k, k), k = max(m, nu)
        ("gradient", _FLOATS),  # (nu,)
        ("step", _FLOATS),  # (nu,) the step to take
        ("low", _FLOATS),  # (nu,) room of the step
        ("high", _FLOATS),  # (nu,)
        ("rhs", _FLOATS),  # (k,)
        ("free", _INTS),  # (k,)
        ("dq", _FLOATS),  # (nv,)
        ("trace", _TABLE),  # (rows, len(TRACE_COLUMNS)); no rows = no trace
    )
)
WORK_FIELDS = tuple(name for name, _ in WORK.field_dict.items())
WorkArrays = namedtuple("WorkArrays", WORK_FIELDS)
TreeArrays = namedtuple(
    "TreeArrays",
    "kind parent qadr vadr constant lower upper low high dof_node dof_kind",
)


@kernel
def new_work(
    state, value, seed, start, q, best, accepted, nodes, world, scratch, frames, residual, miss, jacobian,
    normal, damped, factor, gradient, step, low, high, rhs, free, dq, trace,
):  # fmt: skip
    work = structref.new(WORK)
    work.state, work.value, work.seed = state, value, seed
    work.start, work.q, work.best, work.accepted, work.nodes = start, q, best, accepted, nodes
    work.world, work.scratch, work.frames = world, scratch, frames
    work.residual, work.miss, work.jacobian = residual, miss, jacobian
    work.normal, work.damped, work.factor, work.gradient = normal, damped, factor, gradient
    work.step, work.low, work.high, work.rhs, work.free = step, low, high, rhs, free
    work.dq, work.trace = dq, trace
    return work


@kernel
def unpack(tree, goals, work):
    """All fields as local values: read once per solve, not once per use."""
    arrays = TreeArrays(
        tree.kind, tree.parent, tree.qadr, tree.vadr, tree.constant, tree.lower, tree.upper, tree.low,
        tree.high, tree.dof_node, tree.dof_kind,
    )  # fmt: skip
    space = WorkArrays(
        work.state, work.value, work.seed, work.start, work.q, work.best, work.accepted, work.nodes,
        work.world, work.scratch, work.frames, work.residual, work.miss, work.jacobian, work.normal,
        work.damped, work.factor, work.gradient, work.step, work.low, work.high, work.rhs, work.free,
        work.dq, work.trace,
    )  # fmt: skip
    return arrays, goal_arrays(goals), space


@pure
def uniform(seed):
    """Next number in [0, 1): xorshift64* (Vigna 2016), so that a seed gives the same bits everywhere."""
    x = seed[0]
    x ^= x >> types.uint64(12)
    x ^= x << types.uint64(25)
    x ^= x >> types.uint64(27)
    seed[0] = x
    return types.float64((x * types.uint64(2685821657736338717)) >> types.uint64(11)) * (
        1.0 / 9007199254740992.0
    )


@pure
def measure(tree, goal, work):
    """Forward pass and evaluation at work.q; returns whether all goals are within tolerance."""
    forward(tree.kind, tree.parent, tree.qadr, tree.constant, work.nodes, work.q, work.world, work.scratch)
    cost, within = evaluate(work.world, goal, work.frames, work.residual, work.miss)
    work.value[COST] = cost
    return within


@pure
def keep_best(value, q, best):
    """Remembers q as the best so far."""
    value[BEST_COST] = value[COST]
    for i in range(q.shape[0]):
        best[i] = q[i]


@pure
def begin_try(state, value):
    """Resets what belongs to one descent, whose start has been measured."""
    state[TRY_STEPS] = 0
    state[STALLS] = 0
    value[TRY_COST] = value[COST]
    value[ACCEPTED] = math.inf


@outlined
def begin(tree, goal, work):
    """First call of a solve: put the start inside the limits and measure it.  Later calls go on."""
    if work.state[STATUS] != FRESH:
        return
    for i in range(work.q.shape[0]):
        work.q[i] = work.start[i]
    clip(tree.kind, tree.qadr, tree.vadr, tree.lower, tree.upper, work.nodes, work.q)
    within = measure(tree, goal, work)
    work.state[STATUS] = CONVERGED if within else RUNNING
    keep_best(work.value, work.q, work.best)
    begin_try(work.state, work.value)


@outlined
def draw(kind, qadr, vadr, low, high, nodes, start, seed, q):
    """A random start for the joints that matter, inside their limits, into q; floats roam round ``start``."""
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a, v = qadr[k], vadr[k]
        joint = kind[k]
        if joint < BALL:
            q[a] = low[v] + (high[v] - low[v]) * uniform(seed)
            continue
        if joint == FREE:
            for i in range(3):
                spread = low[v + i] + (high[v + i] - low[v + i]) * uniform(seed)
                q[a + i] = start[a + i] + spread
            a, v = a + 3, v + 3
        q[a], q[a + 1], q[a + 2], q[a + 3] = 1.0, 0.0, 0.0, 0.0
        # A direction on the sphere and an angle in the cone.
        z = 2.0 * uniform(seed) - 1.0
        around = 2.0 * math.pi * uniform(seed)
        angle = min(high[v], math.pi) * uniform(seed)
        r = angle * math.sqrt(max(0.0, 1.0 - z * z))
        turn_quat(q, a, r * math.cos(around), r * math.sin(around), angle * z)


@outlined
def next_try(tree, goal, work):
    """Ends a descent: a random restart, then one last polish of the best; False when there is no more."""
    if work.state[POLISHING] == 1:
        # Out of tries: limits hold the best point, or nothing does but its own slope.
        work.state[STATUS] = BLOCKED if work.state[PRESSED] > 0 else STALLED
        return False
    if work.state[RESTARTS] < work.state[MAX_RESTARTS]:
        work.state[RESTARTS] += 1
        draw(tree.kind, tree.qadr, tree.vadr, tree.low, tree.high, work.nodes, work.start, work.seed, work.q)
    else:
        work.state[POLISHING] = 1
        for i in range(work.q.shape[0]):
            work.q[i] = work.best[i]
    if measure(tree, goal, work):
        keep_best(work.value, work.q, work.best)
        work.state[STATUS] = CONVERGED
        return False
    if work.value[COST] < work.value[BEST_COST] * (1.0 - _CLEARLY_BETTER):
        keep_best(work.value, work.q, work.best)
    begin_try(work.state, work.value)
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
def apply_step(kind, qadr, vadr, dof_node, lower, upper, dofs, nodes, step, dq, q):
    """q = q ⊕ step for the degrees of freedom ``dofs``, then inside the limits; ``dq`` (nv,) is work space."""
    floating = False
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            q[a] = min(max(q[a] + step[u], lower[v]), upper[v])
        else:
            floating = True
            dq[v] = step[u]
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
    clip(kind, qadr, vadr, lower, upper, nodes, q)


@pure
def room(kind, qadr, dof_node, lower, upper, dofs, q, low, high):
    """How far each degree of freedom may still go from q: low <= step <= high, each (nu,)."""
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            low[u] = min(lower[v] - q[qadr[k]], 0.0)
            high[u] = max(upper[v] - q[qadr[k]], 0.0)
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


@pure
def advance(tree, goal, work):
    """Takes work.step: integrate, limits, measure, best so far, stall, trace."""
    state, value = work.state, work.value
    norm = 0.0
    for u in range(work.step.shape[0]):
        norm += work.step[u] * work.step[u]
    value[STEP_NORM] = math.sqrt(norm)
    apply_step(
        tree.kind, tree.qadr, tree.vadr, tree.dof_node, tree.lower, tree.upper, goal.dofs, work.nodes,
        work.step, work.dq, work.q,
    )  # fmt: skip
    within = measure(tree, goal, work)
    state[ITERATIONS] += 1
    state[TRY_STEPS] += 1
    if work.trace.shape[0] > 0:
        record(state, value, work.miss, work.trace)
    cost = value[COST]
    if not math.isfinite(cost):
        state[STATUS] = NUMERICAL
        return
    if within:
        state[STATUS] = CONVERGED
        keep_best(work.value, work.q, work.best)
        return
    same_try = state[RESTARTS] == 0 or state[POLISHING] == 1
    bar = value[BEST_COST] if same_try else value[BEST_COST] * (1.0 - _CLEARLY_BETTER)
    if cost < bar:
        keep_best(work.value, work.q, work.best)
    if cost < value[TRY_COST] * (1.0 - value[PROGRESS]):
        value[TRY_COST] = cost
        state[STALLS] = 0
    else:
        state[STALLS] += 1
