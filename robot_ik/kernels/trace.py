"""The rows of a trace: one for each step.  The caller empties the table before it is full."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined
from robot_ik.kernels.work import COST, DAMPING, ITERATIONS, RESTARTS, STEP_NORM, TRACE_ROWS


@outlined
def record(tolerance, work):
    """One trace row; of goals that are only wanted, and of parts not asked for, the miss does not count."""
    state, value, miss, trace = work.state, work.value, work.miss, work.trace
    row = state[TRACE_ROWS]
    if row >= trace.shape[0]:
        return
    position, angle = 0.0, 0.0
    for g in range(miss.shape[0]):
        position = max(position, miss[g, 0] if tolerance[g, 0] < math.inf else 0.0)
        angle = max(angle, miss[g, 1] if tolerance[g, 1] < math.inf else 0.0)
    trace[row, 0] = state[ITERATIONS]
    trace[row, 1] = state[RESTARTS]
    trace[row, 2] = value[COST]
    trace[row, 3] = position
    trace[row, 4] = angle
    trace[row, 5] = value[DAMPING]
    trace[row, 6] = value[STEP_NORM]
    state[TRACE_ROWS] = row + 1
