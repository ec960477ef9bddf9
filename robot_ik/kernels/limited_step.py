"""One step of differential inverse kinematics that keeps away from collisions.

    minimise ½ |J d − r|² + ½ λ |d|²    with    lower ≤ d ≤ upper
    and for each near pair    g · d ≥ −gain (distance − margin)

g is the change of the pair's distance per unit of d (Faverjon & Tournassoud 1987). A pair that is
nearer than the margin must move apart. If that is impossible for all such pairs at once, they must
not come nearer. If these constraints contradict each other, each of them becomes a weighted
residual: the deepest contact must not become deeper.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.block import Layout
from robot_ik.kernels.collision import FREE, list_near, verdict
from robot_ik.kernels.collision import RUN as COLLISION
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.linalg import normal_equations
from robot_ik.kernels.quadratic_program import PROGRAM, solve_program
from robot_ik.kernels.residuals import GOALS, goal_jacobian
from robot_ik.kernels.search import (
    SEARCH,
    apply_step,
    copy,
    count_all_goals,
    measure,
    step_bounds,
)
from robot_ik.kernels.tree import TREE

# Outcomes of a step.
MOVED, AT_GOAL, BLOCKED, NOT_FINITE = range(4)

# A step to a distance below this share of the margin is shortened, unless the distance increases.
KEPT_SHARE = 0.9
# Weight of moving a pair apart, 1/m², if that is not a constraint. The goals weigh about 1.
_PUSH = 1e3
# m. A pair that touches may come nearer by this in a step, through rounding.
_ROUNDING = 1e-6
_MAX_HALVINGS = 6
# A step shorter than this, rad or m, moves nothing.
_NO_STEP = 1e-7

# With m rows of the residual, u columns, nq.
STEP = Layout(
    "LimitedStep",
    margin="float",  # m
    detection="float",  # m, distance from which pairs have a row
    gain="float",  # share of the distance beyond the margin that a step may use
    way_out="float",  # m, largest increase of the distance of a pair inside the margin in a step
    damping="float",
    damping_per_cost="float",  # keeps the joints from oscillating at a goal that cannot be met
    halvings="int",  # of the last step
    pressed="int",  # rows of collisions that hold the last step back
    largest="floats u",  # largest change of each column in a step
    jacobian="table m u",
    normal_matrix="table u u",
    before="floats nq",
    program=PROGRAM,
)
RUN = Layout(
    "LimitedStepRun", tree=TREE, goals=GOALS, search=SEARCH, collision=COLLISION, step=STEP
)
open_run = RUN.open


@outlined
def write_rows(run, way_out):
    """Write the rows of all near pairs. Touching pairs must move apart by ``way_out``, m."""
    check = run.collision.check
    step = run.step
    program = step.program
    program.row_count = check.near_count
    for c in range(check.near_count):
        write_row(run, c, c)
        bound = -step.gain * (check.near_distance[c] - step.margin)
        program.bounds[c] = min(bound, way_out) if bound > 0.0 else bound


@inlined
def write_row(run, near, row):
    """Write the gradient of a near pair to a row of the program."""
    for u in range(run.goals.dofs.shape[0]):
        rate = run.collision.check.near_rows[near, run.goals.dofs[u]]
        run.step.program.rows[row, u] = run.goals.joint_scale[u] * rate


@outlined
def push_out(run):
    """Add the separation of touching pairs to the objective; only the other pairs keep rows."""
    check = run.collision.check
    step = run.step
    program = step.program
    columns = run.goals.dofs.shape[0]
    count = 0
    for c in range(check.near_count):
        bound = -step.gain * (check.near_distance[c] - step.margin)
        write_row(run, c, count)
        if bound <= 0.0:
            program.bounds[count] = bound
            count += 1
            continue
        way = min(bound, step.way_out)
        for i in range(columns):
            rate = program.rows[count, i]
            program.gradient[i] += _PUSH * way * rate
            for j in range(columns):
                program.hessian[i, j] += _PUSH * rate * program.rows[count, j]
    program.row_count = count


@outlined
def write_objective(run):
    """Write Hessian, gradient and bounds of the step at search.q, which was just measured."""
    step = run.step
    program = step.program
    columns = run.goals.dofs.shape[0]
    damping = step.damping + step.damping_per_cost * run.search.cost
    for i in range(step.jacobian.shape[0]):
        for u in range(columns):
            step.jacobian[i, u] = 0.0
    goal_jacobian(run.tree, run.goals, run.search, False, step.jacobian)
    normal_equations(step.jacobian, run.search.residual, step.normal_matrix, program.gradient)
    for i in range(columns):
        for j in range(i + 1):
            program.hessian[i, j] = step.normal_matrix[i, j]
            program.hessian[j, i] = step.normal_matrix[i, j]
        program.hessian[i, i] += damping
    step_bounds(run.tree, run.goals, run.search.q, program.lower, program.upper)
    for u in range(columns):
        longest = step.largest[u] / run.goals.joint_scale[u]
        program.lower[u] = max(program.lower[u], -longest)
        program.upper[u] = min(program.upper[u], longest)


@inlined
def square_norm(a):
    """Return the sum of the squares of a vector."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * a[i]
    return total


@outlined
def keeps_distance(run, q, distance, reach):
    """Return whether all pairs are at least ``distance`` apart at ``q``; negative: a depth.

    This check takes a third of the time of the list of near pairs. Only the list has depths.
    """
    if distance > 0.0:
        return verdict(run, q, distance) == FREE
    list_near(run, q, reach)
    return run.check.nearest_distance >= distance


@kernel
def limited_step(address):
    """Take one step from search.start to search.best; return MOVED, AT_GOAL or BLOCKED.

    AT_GOAL: the posture is within tolerance and keeps the margin. BLOCKED: collisions hold every
    step back.
    """
    run = open_run(address)
    search = run.search
    step = run.step
    count_all_goals(run.goals, search)
    copy(search.start, search.q)
    copy(search.start, search.best)
    within = measure(run.tree, run.goals, search)
    if not search.cost < math.inf:
        return NOT_FINITE
    list_near(run.collision, search.q, step.detection)
    distance_before = run.collision.check.nearest_distance
    cost = search.cost
    step.pressed = 0
    step.halvings = 0
    if within and distance_before >= step.margin:
        return AT_GOAL
    write_objective(run)
    write_rows(run, step.way_out)
    possible = solve_program(step.program)
    if not possible:
        write_rows(run, 0.0)
        possible = solve_program(step.program)
        if not possible or square_norm(step.program.solution) < _NO_STEP * _NO_STEP:
            push_out(run)
            possible = solve_program(step.program)
    if not possible:
        return BLOCKED
    for a in range(step.program.active):
        if step.program.chosen[a] < step.program.row_count:
            step.pressed += 1
    copy(step.program.solution, search.step)
    copy(search.q, step.before)
    allowed = min(KEPT_SHARE * step.margin, distance_before - _ROUNDING)
    for halving in range(_MAX_HALVINGS):
        apply_step(run.tree, run.goals, search)
        within = measure(run.tree, run.goals, search)
        # The nearest points of two flat parts jump from edge to edge. The joints must not follow
        # these jumps, so a step must reduce the cost or increase a distance below the margin.
        useful = search.cost < cost or distance_before < KEPT_SHARE * step.margin
        if useful and keeps_distance(run.collision, search.q, allowed, step.detection):
            copy(search.q, search.best)
            if within and keeps_distance(run.collision, search.q, step.margin, step.detection):
                return AT_GOAL
            has_moved = square_norm(search.step) > _NO_STEP * _NO_STEP
            return MOVED if has_moved or step.pressed == 0 else BLOCKED
        copy(step.before, search.q)
        for u in range(search.step.shape[0]):
            search.step[u] *= 0.5
        step.halvings = halving + 1
    measure(run.tree, run.goals, search)
    return BLOCKED
