"""The rows of a trace: one for each step, while there is room."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import outlined
from robot_ik.kernels.work import COST, DAMPING, ITERATIONS, RESTARTS, STEP_NORM, TRACE_ROWS


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
