"""Inverse kinematics of the frames of a motion, with hard rows, soft rows and limits.

Each frame minimises, from the end of the previous frame,

    Σ w |A dq − a|² + Σ s (posture − q)²    subject to    J dq = e,  lower <= dq <= upper

in two to four steps. The bounds of dq (``step_lower``, ``step_upper``) are what the joint limits
and the speed limits allow within one frame. There are no priorities below the hard rows, no test of
convergence of the soft rows and no restarts: ``lm`` has all of these and takes three times as long.
A step is solved by the Schur complement of its hard rows (Nocedal & Wright, *Numerical
Optimization*, section 16.2). A joint that the step would move over a bound is held at the bound,
and the step is solved again.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import kinematics, so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.body_goals import center_of_mass, center_velocity
from robot_ik.kernels.frame_goals import orientation_error
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.linalg import (
    factorise,
    reduced_system,
    row_dot,
    solve_lower,
    solve_upper,
)
from robot_ik.kernels.search import copy
from robot_ik.kernels.tree import FREE, HINGE, SLIDE, TREE

# Kinds of groups of three rows: the origin of a frame, its rotation, the centre of mass, the
# direction of the x axis of a frame, and the angular momentum about the centre of mass since the
# previous frame (kg m² rad).
POSITION, ROTATION, CENTER_OF_MASS, AIM, MOMENTUM = range(5)
# Weight of a row that must hold.
HARD = math.inf

# A longer step, rad or m, is shortened: rows are linear near q only.
_LONGEST = 0.4
# Weight of the step length. Posture weights are 0.02 and more.
_DAMPING = 1e-4
# Slack of the hard rows: it keeps their system solvable if they depend on each other.
_SLACK = 1e-10
# Slack if the hard rows contradict each other within the bounds.
_YIELDING = 1e-2
# Damping of a step that would be longer than ``_LONGEST``.
_CAUTIOUS = 10.0
# Angular momentum is divided by 10 kg m², the inertia of a body, to be comparable with metres.
_MOMENTUM_SCALE = 0.1
# Largest number of solves of one step with more joints held at their bounds.
_HOLDS = 8
# A step may exceed its bounds by this before a joint is held, rad or m.
_BOUND_SLACK = 1e-12
# A frame nearer to the point that it aims at than this, in metres, is taken to be this far away.
_MIN_AIM_DISTANCE = 1e-9

# With g groups, h = 3 g rows, n nodes, b = n + 1, k = max(h, nv).
WHOLE_BODY = Layout(
    "WholeBody",
    max_steps="int",  # of each frame
    rest="float",  # a shorter step (rad, m) is the last one of a frame …
    close="float",  # … if the error of no hard row is larger than this (m, rad)
    hard_count="int",  # hard rows at q
    hard_error="float",  # the largest error of a hard row at q, m or rad
    kind="ints",  # (g,) of each group of three rows
    node="ints",  # (g,) node that carries the frame
    local="table",  # (g, 12) pose of the frame in the node
    axes="ints",  # (g,) bit k: the row of world axis k counts
    share="table",  # (g, nv) 1 where a degree of freedom may move the group
    masses="table",  # (n + 1, 4) mass and centre of each node, see ``body_goals.center_of_mass``
    inertia="table",  # (n, 9) of each node about this centre, in the node's axes, row by row
    stiffness="floats",  # (nv,) weight of the posture
    lower="floats",  # (nv,)
    upper="floats",  # (nv,)
    stride="floats",  # (nv,) how far a joint may move in one frame
    # Written by the kernel.
    world="table n 12",
    scratch="table 2 12",
    pose="table g 12",
    moments="table b 4",
    carried="table n 9",  # inertia about the centre of mass of each node with its descendants
    center="floats 3",
    previous="floats nq",  # q of the previous frame
    displacement="floats nv",  # from the previous frame to q
    row="table 3 nv",
    error="floats 3",
    hard="table h nv",
    wanted="floats h",
    matrix="table nv nv",
    factor="table nv nv",
    gradient="floats nv",
    step="floats nv",
    step_lower="floats nv",  # bounds of the step
    step_upper="floats nv",
    side="ints nv",  # -1, 1 for a joint that is held at its lower or upper bound
    first="ints k",  # zeros: the matrices are dense
    hard_solved="table h nv",  # ``hard`` times L⁻ᵀ of the factors
    schur="table h h",
    multiplier="floats h",
    tree=TREE,
)
open_body = WHOLE_BODY.open


# Mass


@outlined
def carry(tree, body):
    """Write the centre of mass, and the moments and inertia of each node with its descendants."""
    center = center_of_mass(tree, body.world, body.masses, 0, body.moments)
    so3.write_vector(body.center, 0, center)
    nodes = tree.parent.shape[0]
    for k in range(nodes):
        write_inertia(body, k, center)
    for k in range(nodes - 1, 0, -1):
        parent = tree.parent[k]
        if parent >= 0:
            for i in range(9):
                body.carried[parent, i] += body.carried[k, i]


@inlined
def write_inertia(body, k, center):
    """Write the inertia of node ``k`` alone, in the world, about ``center`` to body.carried."""
    mass = body.masses[k, 0]
    rotation = so3.read_rotation(body.world, k)
    arm = so3.apply(rotation, so3.read_vector(body.masses, k, 1))
    r = so3.subtract(so3.add(so3.read_vector(body.world, k, 0), arm), center)
    local = read_inertia(body.inertia, k)
    # The columns of I Rᵀ.
    columns = (
        so3.apply(local, rotation[0]),
        so3.apply(local, rotation[1]),
        so3.apply(local, rotation[2]),
    )
    for i in range(3):
        for j in range(3):
            body.carried[k, 3 * i + j] = so3.dot(rotation[i], columns[j]) - mass * r[i] * r[j]
        body.carried[k, 4 * i] += mass * so3.dot(r, r)


@inlined
def read_inertia(table, k):
    """Return the inertia in row ``k``, a matrix row by row."""
    return (
        so3.read_vector(table, k, 0),
        so3.read_vector(table, k, 3),
        so3.read_vector(table, k, 6),
    )


@inlined
def momentum_rate(tree, body, v):
    """Return the angular momentum about the centre of mass per unit of degree of freedom ``v``.

    The bodies that it moves have the mass m, the first moment s and the inertia I about the centre
    of mass. A rotation with ω about a point p gives I ω + s × (ω × (c − p)), a shift s × v.
    """
    node = tree.dof_node[v]
    center = so3.read_vector_at(body.center, 0)
    moment = so3.subtract(
        so3.read_vector(body.moments, node, 1), so3.scale(body.moments[node, 0], center)
    )
    velocity, omega = kinematics.velocity_of(tree, body.world, v, center)
    inertia = read_inertia(body.carried, node)
    return so3.add(so3.apply(inertia, omega), so3.cross(moment, velocity))


# Rows


@outlined
def mass_rows(tree, body, momentum, target, t, g):
    """Write rows and errors of the centre of mass, or of the angular momentum about it."""
    row = body.row
    for v in range(row.shape[1]):
        if momentum:
            rate = so3.scale(_MOMENTUM_SCALE, momentum_rate(tree, body, v))
        else:
            rate = center_velocity(tree, body.world, body.moments, 0, v)
        so3.write_column(row, 0, v, so3.scale(body.share[g, v], rate))
    for i in range(3):
        if momentum:
            body.error[i] = _MOMENTUM_SCALE * target[t, i]
            for v in range(row.shape[1]):
                body.error[i] -= row[i, v] * body.displacement[v]
        else:
            body.error[i] = target[t, i] - body.center[i]


@outlined
def frame_rows(tree, body, kind, target, t, g):
    """Write rows and errors of the position, the rotation or the aim of a frame."""
    row = body.row
    row[:] = 0.0
    point = so3.read_vector(body.pose, g, 0)
    rotation = so3.read_rotation(body.pose, g)
    k = body.node[g]
    while k >= 0:
        for i in range(kinematics.width_of(tree.kind[k])):
            v = tree.vadr[k] + i
            velocity, omega = kinematics.velocity_of(tree, body.world, v, point)
            rate = velocity if kind == POSITION else omega
            so3.write_column(row, 0, v, so3.scale(body.share[g, v], rate))
        k = tree.parent[k]
    if kind == ROTATION:
        error, _ = orientation_error(so3.read_rotation(target, t), rotation)
    else:
        error = so3.subtract(so3.read_vector(target, t, 0), point)
        if kind == AIM:
            direction = so3.scale(1.0 / max(so3.norm(error), _MIN_AIM_DISTANCE), error)
            error = so3.cross((rotation[0][0], rotation[1][0], rotation[2][0]), direction)
    so3.write_vector(body.error, 0, error)


@outlined
def measure_displacement(tree, body, q):
    """Write the change (nv,) from the previous frame to q, and the bounds of the next step."""
    kinematics.difference(tree, body.previous, q, body.displacement)
    for k in range(tree.kind.shape[0]):
        a = tree.qadr[k]
        v = tree.vadr[k]
        if tree.kind[k] == FREE:
            for i in range(6):
                body.step_lower[v + i] = -math.inf
                body.step_upper[v + i] = math.inf
        else:
            body.step_lower[v] = max(body.lower[v], body.previous[a] - body.stride[v]) - q[a]
            body.step_upper[v] = min(body.upper[v], body.previous[a] + body.stride[v]) - q[a]


@outlined
def write_system(tree, body, q, target, weight, t, posture):
    """Write the quadratic form, its gradient and the hard rows at q."""
    groups = body.kind.shape[0]
    kinematics.forward(tree, tree.every, q, body.world, body.scratch)
    carry(tree, body)
    measure_displacement(tree, body, q)
    begin_system(tree, body, q, t, posture)
    body.hard_count = 0
    body.hard_error = 0.0
    for g in range(groups):
        if not weight[t, g] > 0.0:
            continue
        kind = body.kind[g]
        at = t * groups + g
        if kind in (CENTER_OF_MASS, MOMENTUM):
            mass_rows(tree, body, kind == MOMENTUM, target, at, g)
        else:
            kinematics.frame_pose(body.world, body.node[g], body.local, g, body.pose)
            frame_rows(tree, body, kind, target, at, g)
        for i in range(3):
            if not body.axes[g] >> i & 1:
                continue
            if weight[t, g] == HARD:
                add_hard_row(body, i)
            else:
                add_soft_row(body, i, weight[t, g])


@inlined
def begin_system(tree, body, q, t, posture):
    """Write the quadratic form and its gradient of the step itself and of the posture."""
    matrix = body.matrix
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[i, j] = 0.0
        matrix[i, i] = _DAMPING
        body.gradient[i] = 0.0
    for k in range(tree.kind.shape[0]):
        if tree.kind[k] != FREE:
            a = tree.qadr[k]
            v = tree.vadr[k]
            matrix[v, v] += body.stiffness[v]
            body.gradient[v] = body.stiffness[v] * (posture[t, a] - q[a])


@inlined
def add_hard_row(body, i):
    """Add row ``i`` of the group to the hard rows."""
    count = body.hard_count
    for v in range(body.row.shape[1]):
        body.hard[count, v] = body.row[i, v]
    body.wanted[count] = body.error[i]
    body.hard_error = max(body.hard_error, abs(body.error[i]))
    body.hard_count = count + 1


@inlined
def add_soft_row(body, i, weight):
    """Add row ``i`` of the group to the quadratic form."""
    row = body.row
    for u in range(row.shape[1]):
        entry = weight * row[i, u]
        if entry != 0.0:
            body.gradient[u] += entry * body.error[i]
            for v in range(u + 1):
                body.matrix[u, v] += entry * row[i, v]


# Steps


@outlined
def solve_held(body, damping, slack):
    """Write the step with the held joints at their bounds to body.step.

    The step is H⁻¹ (g + Jᵀμ) with (J H⁻¹ Jᵀ + slack) μ = e − J H⁻¹ g for the hard rows J dq = e and
    the quadratic form H = M + ``damping``.
    """
    step = body.step
    factor = body.factor
    multiplier = body.multiplier
    solved = body.hard_solved
    count = body.hard_count
    n = step.shape[0]
    reduced_system(
        body.matrix,
        damping,
        body.gradient,
        body.step_lower,
        body.step_upper,
        body.side,
        factor,
        step,
    )
    factorise(factor, body.first, n)
    copy(body.wanted, multiplier)
    for r in range(count):
        for v in range(n):
            solved[r, v] = body.hard[r, v]
            if body.side[v] != 0:
                multiplier[r] -= solved[r, v] * step[v]
                solved[r, v] = 0.0
        solve_lower(factor, body.first, solved[r], n)
    solve_lower(factor, body.first, step, n)
    for r in range(count):
        for v in range(n):
            multiplier[r] -= solved[r, v] * step[v]
        for c in range(r + 1):
            body.schur[r, c] = row_dot(solved, r, solved, c)
        body.schur[r, r] += slack
    # A hard row that depends on others has no pivot, and its multiplier is zero.
    factorise(body.schur, body.first, count)
    solve_lower(body.schur, body.first, multiplier, count)
    solve_upper(body.schur, body.first, multiplier, count)
    for r in range(count):
        for v in range(n):
            step[v] += solved[r, v] * multiplier[r]
    solve_upper(factor, body.first, step, n)


@outlined
def hold_and_solve(body, damping, slack):
    """Write a step to body.step with joints held at the bounds it would cross; return its length.

    The length is that of its largest part.
    """
    n = body.step.shape[0]
    for v in range(n):
        body.side[v] = 0
    for _ in range(_HOLDS):
        solve_held(body, damping, slack)
        newly_held = 0
        for v in range(n):
            below = body.step[v] < body.step_lower[v] - _BOUND_SLACK
            if body.side[v] == 0 and (
                below or not body.step[v] <= body.step_upper[v] + _BOUND_SLACK
            ):
                body.side[v] = -1 if below else 1
                newly_held += 1
        if newly_held == 0:
            break
    longest = 0.0
    for v in range(n):
        longest = max(longest, abs(body.step[v]))
    return longest


@outlined
def bounded_step(tree, body, q):
    """Take one step from q inside the bounds, in place; return the length of its largest part."""
    longest = hold_and_solve(body, 0.0, _SLACK)
    if longest > _LONGEST:  # unreachable soft rows cause long steps; the hard rows still hold
        longest = hold_and_solve(body, _CAUTIOUS, _SLACK)
    if longest > _LONGEST:
        longest = hold_and_solve(body, _CAUTIOUS, _YIELDING)
    share = _LONGEST / longest if longest > _LONGEST else 1.0
    for v in range(body.step.shape[0]):
        body.step[v] = min(max(share * body.step[v], body.step_lower[v]), body.step_upper[v])
    kinematics.integrate(tree, tree.every, q, body.step)
    return longest


@outlined
def continue_motion(tree, body, q):
    """Repeat the displacement of the last frame on q in place, inside the limits."""
    for k in range(tree.kind.shape[0]):
        if tree.kind[k] in (HINGE, SLIDE):
            a = tree.qadr[k]
            v = tree.vadr[k]
            position = min(max(q[a] + body.displacement[v], body.lower[v]), body.upper[v])
            body.displacement[v] = min(max(position - q[a], -body.stride[v]), body.stride[v])
    kinematics.integrate(tree, tree.every, q, body.displacement)


@kernel
def solve_frames(address, target, weight, posture, q, start, second, error, used):
    """Solve one frame after the other.

    Args:
        address: Block of ``WHOLE_BODY``, with a tree of hinges, slides and free joints.
        target: (frames · groups, 12) position, or rotation as a pose row, of every group in every
            frame.
        weight: (frames, groups) weights; ``HARD``; 0 leaves a group out.
        posture: (frames, nq).
        q: (frames, nq) written, rad and m.
        start: (nq,) q of the frame before the first.
        second: (nq,) q of the frame before ``start``; the first frame continues the motion.
        error: (frames,) written: largest error of a hard row (m, rad).
        used: (frames,) written: number of steps.
    """
    body = open_body(address)
    tree = body.tree
    copy(second, body.previous)
    measure_displacement(tree, body, start)
    copy(start, body.previous)
    for t in range(q.shape[0]):
        frame = q[t]
        copy(body.previous, frame)
        continue_motion(tree, body, frame)
        longest = math.inf
        for step in range(body.max_steps + 1):
            write_system(tree, body, frame, target, weight, t, posture)
            error[t] = body.hard_error
            used[t] = step
            at_rest = longest < body.rest and body.hard_error < body.close
            if step == body.max_steps or at_rest:
                break
            longest = bounded_step(tree, body, frame)
        copy(frame, body.previous)
