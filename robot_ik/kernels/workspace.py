"""The work space of a solve: what changes while it runs, and where each number stands."""

from __future__ import annotations

from robot_ik.kernels.bundle import Layout

# Status; ``solution.Status`` gives them their names.
FRESH, RUNNING, CONVERGED, STALLED, ITERATION_LIMIT, TIME_LIMIT, UNREACHABLE, BLOCKED, NUMERICAL = range(9)

# Entries of work.state (int64).
(
    STATUS, ITERATIONS, RESTARTS, TRACE_ROWS, ANY_UNREACHABLE, TRY_STEPS, STALLS, PRESSED, POLISHING,
    MAX_ITERATIONS, MAX_RESTARTS, FIRST_STEPS, TRY_LIMIT, PATIENCE, DRAWS, DRAWN, AWAITED, SLICE_END, SEED,
    LEVEL, UPDATES, SEARCH, STATE_SIZE,
) = range(23)  # fmt: skip
# What Python asks for after a solve: the first five.
OUTCOME = slice(STATUS, ANY_UNREACHABLE + 1)

# Entries of work.value (float64).
(
    COST, BEST_COST, TRY_COST, STEP_NORM, DAMPING, ACCEPTED, PROGRESS, LOWEST, SCALE, SHARE, RIVAL,
    VALUE_SIZE,
) = range(12)  # fmt: skip

# What ``work.state[AWAITED]`` says of work.q while it is not yet measured.
NOTHING, STEP, DRAW, TRY, BACK = range(5)

# Where some goals are proven out of reach, ``work.state[SEARCH]``: all goals count, only the others do until
# they are met, and they are (of use where there are levels).
ALL_GOALS, SEARCHING, FOUND = range(3)

# As a limit of steps: none.
NO_LIMIT = 1 << 60

# Rows of a trace that are kept here, before Python takes them away.
TRACE_CAPACITY = 1024

# With g goals, m rows, nu joints that move them, n nodes, k = max(m, nu), p = min(m, nu).
WORK = Layout(
    "Work",
    state=f"ints {STATE_SIZE}",
    value=f"floats {VALUE_SIZE}",
    start="floats nq",
    q="floats nq",  # where the solver is
    best="floats nq",  # best so far
    nearby="floats nq",  # best of the try from the start
    rival="floats nq",  # best of all tries, while the one from the start is polished
    accepted="floats nq",  # free for a solver that may reject a step
    candidate="floats nq",  # the best of several random starts
    reach="table g 4",  # centre and radius, metres, of a ball that the goal's frame cannot leave; or inf
    unreachable="ints g",  # 1 for a goal that is proven out of reach
    nodes="ints",  # joints that move any goal, parents first
    world="table n 12",  # node poses
    scratch="table 2 12",
    frames="table g 12",  # goal frames
    residual="floats m",
    miss="table g 2",  # metres, radians
    jacobian="table m nu",
    column="floats m",  # work space of the Jacobian
    normal="table nu nu",
    damped="table nu nu",
    factor="table k k",
    gradient="floats nu",
    step="floats nu",  # the step to take
    low="floats nu",  # lower bounds of the step
    high="floats nu",
    rhs="floats k",
    free="ints k",
    side="ints k",
    dq="floats nv",
    wanted="floats m",  # the part of the residual that a step shall remove
    left="table p m",  # singular vectors u
    sigma="floats p",  # singular values
    right="table p nu",  # singular vectors v
    aim="floats nu",  # where the null space should go
    rest="floats",  # (nq,) the robot's home, an aim
    level_cost="floats levels",  # cost of the goals of each priority; empty where all are equal
    level_bar="floats levels",  # what it was when the next level began, -1 = met
    level_best="floats levels",  # the same of the best so far
    basis="table free nu",  # orthonormal rows: what the levels before have taken
    own="table dense nu",  # rows of a level less their part in the basis
    gram="table dense dense",
    metric="table nu nu",  # the inverse Hessian that steps along the slope are multiplied by (bfgs)
    search_direction="floats nu",  # the direction that is searched
    before="floats nu",  # gradient before the step
    moved="floats nu",  # how far the joints have really gone
    outward="floats nu",  # axis along which a ball would leave its cone
    trace="table trace 7",  # rows of ``solution.Step``; none = no trace
)
open_work = WORK.open

# All that a run needs, as one number: the address of its table.
RUN = Layout("Run", tree="int_table", goals="int_table", work="int_table", options="floats")
open_run = RUN.open
