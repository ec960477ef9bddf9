"""Residual, Jacobian and miss of every goal kind, on flat arrays.

A goal owns some rows of the residual r = (what is wanted) − (what is), weighted; its Jacobian rows are
those of the frame's motion, so that J dq ≈ r is the step wanted.  The *miss* is unweighted, in metres
and radians, and decides convergence.

Columns belong to ``goal.dofs``.  A joint that is *coupled* to another has no column: what it does is added
to that of its leader.  A stiff joint's column is shortened by ``goal.joint_scale``, and ``apply_step``
shortens the step by the same: minimising the damped step then spares the joint (weighted least squares,
Whitney, J. Dynamic Systems, Measurement and Control 94(4), 1972).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels import kinematics
from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE

# Nearer than this (sine of the angle) two axes are one, or opposite.
_PARALLEL = 1e-9


@outlined
def rotation_error(target, t, current, g, out, at):
    """Rotation vector, world, from current[g] to target[t] into out[at:at+3]; returns its angle."""
    # M = R_target · R_currentᵀ, of which only what is needed is formed.
    m00 = target[t, 3] * current[g, 3] + target[t, 4] * current[g, 4] + target[t, 5] * current[g, 5]
    m01 = target[t, 3] * current[g, 6] + target[t, 4] * current[g, 7] + target[t, 5] * current[g, 8]
    m02 = target[t, 3] * current[g, 9] + target[t, 4] * current[g, 10] + target[t, 5] * current[g, 11]
    m10 = target[t, 6] * current[g, 3] + target[t, 7] * current[g, 4] + target[t, 8] * current[g, 5]
    m11 = target[t, 6] * current[g, 6] + target[t, 7] * current[g, 7] + target[t, 8] * current[g, 8]
    m12 = target[t, 6] * current[g, 9] + target[t, 7] * current[g, 10] + target[t, 8] * current[g, 11]
    m20 = target[t, 9] * current[g, 3] + target[t, 10] * current[g, 4] + target[t, 11] * current[g, 5]
    m21 = target[t, 9] * current[g, 6] + target[t, 10] * current[g, 7] + target[t, 11] * current[g, 8]
    m22 = target[t, 9] * current[g, 9] + target[t, 10] * current[g, 10] + target[t, 11] * current[g, 11]
    x, y, z = 0.5 * (m21 - m12), 0.5 * (m02 - m20), 0.5 * (m10 - m01)
    sine = math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (m00 + m11 + m22 - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > -0.9:
        scale = 1.0 + sine * sine / 6.0 if sine < 1e-6 else angle / sine
        out[at], out[at + 1], out[at + 2] = scale * x, scale * y, scale * z
        return angle
    # u uᵀ (1 − cos) = symmetric part of M − cos·1: take its largest column as the axis.
    s00, s11, s22 = m00 - cosine, m11 - cosine, m22 - cosine
    s01, s02, s12 = 0.5 * (m01 + m10), 0.5 * (m02 + m20), 0.5 * (m12 + m21)
    if s00 >= s11 and s00 >= s22:
        u, v, w = s00, s01, s02
    elif s11 >= s22:
        u, v, w = s01, s11, s12
    else:
        u, v, w = s02, s12, s22
    norm = math.sqrt(u * u + v * v + w * w)
    if u * x + v * y + w * z < 0.0:
        norm = -norm
    scale = angle / norm
    out[at], out[at + 1], out[at + 2] = scale * u, scale * v, scale * w
    return angle


@pure
def curvature(x, y, z):
    """The k of ``rate_of_rotation_vector``, which depends on φ = (x, y, z) alone."""
    square = x * x + y * y + z * z
    if square < 1e-6:
        return 1.0 / 12.0 + square / 720.0
    half = 0.5 * math.sqrt(square)
    return (1.0 - half / math.tan(half)) / square


@pure
def rate_of_rotation_vector(x, y, z, k, a, b, c):
    """J_r⁻¹(φ) ω for φ = (x, y, z), ω = (a, b, c): ω + ½ φ×ω + k φ×(φ×ω).

    How φ = log(R_target R_currentᵀ) shrinks while the current frame rotates with ω; J_r is the right
    Jacobian of SO(3) (Solà et al., A micro Lie theory for state estimation, 2018, eq. 144).
    """
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + 0.5 * p + k * (y * r - z * q),
        b + 0.5 * q + k * (z * p - x * r),
        c + 0.5 * r + k * (x * q - y * p),
    )


@pure
def inverse_right_jacobian(x, y, z, a, b, c):
    """``rate_of_rotation_vector`` for a single ω."""
    return rate_of_rotation_vector(x, y, z, curvature(x, y, z), a, b, c)


@pure
def between(ax, ay, az, dx, dy, dz):
    """Of two unit vectors: their cross product, the sine and cosine of the angle between them, and it."""
    nx, ny, nz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
    sine, cosine = math.sqrt(nx * nx + ny * ny + nz * nz), ax * dx + ay * dy + az * dz
    return nx, ny, nz, sine, cosine, math.atan2(sine, cosine)


@pure
def axis_error(ax, ay, az, dx, dy, dz):
    """Rotation vector, world, from the unit vector a the short way to d, and its angle in [0, pi]."""
    nx, ny, nz, sine, cosine, angle = between(ax, ay, az, dx, dy, dz)
    if sine > _PARALLEL:
        scale = angle / sine
        return scale * nx, scale * ny, scale * nz, angle
    if cosine > 0.0:
        return nx, ny, nz, angle
    ux, uy, uz = kinematics.perpendicular((ax, ay, az))
    return angle * ux, angle * uy, angle * uz, angle


@pure
def axis_error_rate(ax, ay, az, dx, dy, dz, px, py, pz, qx, qy, qz):
    """Minus the derivative of ``axis_error`` while a moves with the velocity p and d with q.

    With n = a × d, s = |n|, c = a·d and θ the angle, the error is (θ/s) n; its derivative is
    (θ/s) n' − ((s − θ c)/s³) c' n, since s θ' = −c'.
    """
    nx, ny, nz, sine, cosine, angle = between(ax, ay, az, dx, dy, dz)
    if sine < 1e-3 and cosine > 0.0:
        ratio, slope = 1.0 + angle * angle / 6.0, 1.0 / 3.0 + 2.0 * angle * angle / 15.0
    elif sine > _PARALLEL:
        ratio, slope = angle / sine, (sine - angle * cosine) / (sine * sine * sine)
    else:  # by π: only the way about the axis that ``axis_error`` takes counts
        ux, uy, uz = kinematics.perpendicular((ax, ay, az))
        wx = (ay * pz - az * py) - (dy * qz - dz * qy)
        wy = (az * px - ax * pz) - (dz * qx - dx * qz)
        wz = (ax * py - ay * px) - (dx * qy - dy * qx)
        rate = ux * wx + uy * wy + uz * wz
        return rate * ux, rate * uy, rate * uz
    along = (px * dx + py * dy + pz * dz) + (ax * qx + ay * qy + az * qz)
    rx = (py * dz - pz * dy) + (ay * qz - az * qy)
    ry = (pz * dx - px * dz) + (az * qx - ax * qz)
    rz = (px * dy - py * dx) + (ax * qy - ay * qx)
    return (slope * along * nx - ratio * rx, slope * along * ny - ratio * ry, slope * along * nz - ratio * rz)


# Rows of a goal.  Whole positions, orientations and poses have a faster path of their own, above all others;
# ``goal.row_codes`` lists the rows of goals for a part of a pose, the centre of mass or the joints:
#
#     position     all three coordinates, some of them in the axes of the target, or one side of a plane
#     orientation  the whole orientation, one axis along the target's, or one aimed at the target's origin
#     of           whose position and orientation: the frame, the centre of mass, or the joints themselves
#
# The axis that counts is always z: ``Goal.fill`` and ``target_row`` rotate frame and target so that it is.

NO_POSITION, WHOLE, SOME_AXES, ONE_SIDE = range(4)
NO_ORIENTATION, ALL_AXES, ONE_AXIS, AIMED = range(4)
OF_FRAME, OF_MASS, OF_JOINTS, OF_PRIOR = range(4)
# Columns of goal.row_codes; BLOCK is the first row of the goal's masses.
POSITION_PART, ORIENTATION_PART, OF, BLOCK, ROW_CODES = range(5)

# Nearer to the point that it aims at than this, in metres, a frame has no direction to aim in.
_AT_POINT = 1e-9


@outlined
def mass_center(tree, goal, work, g):
    """Centre of mass into frames[g, :3]; first moments of what hangs on each node into goal.moments.

    goal.masses has mass and centre of each node, seen from it, and in a last row those that do not move.
    """
    parent, world, masses, moments, frames = tree.parent, work.world, goal.masses, goal.moments, work.frames
    n, first = parent.shape[0], goal.row_codes[g, BLOCK]
    for k in range(n):
        mass = masses[first + k, 0]
        moments[first + k, 0] = mass
        for i in range(3):
            x, y, z = masses[first + k, 1], masses[first + k, 2], masses[first + k, 3]
            at = world[k, i] + world[k, 3 + 3 * i] * x + world[k, 4 + 3 * i] * y + world[k, 5 + 3 * i] * z
            moments[first + k, 1 + i] = mass * at if mass > 0.0 else 0.0
    still = first + n
    moments[still, 0] = masses[still, 0]
    for i in range(1, 4):
        moments[still, i] = masses[still, 0] * masses[still, i]
    for back in range(n):
        k = n - 1 - back
        onto = first + parent[k] if parent[k] >= 0 else still
        for i in range(4):
            moments[onto, i] += moments[first + k, i]
    for i in range(3):
        frames[g, i] = moments[still, 1 + i] / moments[still, 0]


@pure
def mass_velocity(goal, work, g, k, ax, ay, az, rotational):
    """Velocity of the centre of mass per unit of a degree of freedom of node ``k``."""
    moments, first = goal.moments, goal.row_codes[g, BLOCK]
    mass = moments[first + k, 0]
    if not mass > 0.0:
        return 0.0, 0.0, 0.0
    share = mass / moments[first + work.world.shape[0], 0]
    s = 1.0 / mass
    x, y, z = kinematics.point_velocity(
        work.world, k, ax, ay, az, rotational,
        s * moments[first + k, 1], s * moments[first + k, 2], s * moments[first + k, 3],
    )  # fmt: skip
    return share * x, share * y, share * z


@outlined
def joint_rows(tree, goal, work, g):
    """Rows of a posture: the distance of each joint to where it is wanted; returns (|r|², within)."""
    kind, residual, miss, off = tree.kind, work.residual, work.miss, work.dq
    metres, radians, cost = 0.0, 0.0, 0.0
    kinematics.difference(tree, work.q, goal.posture[g], off)
    for u in range(goal.dofs.shape[0]):
        v = goal.dofs[u]
        k = tree.dof_node[v]
        i, counts = v - tree.vadr[k], goal.joint_weight[g, v]
        shift = kind[k] == SLIDE or (kind[k] == FREE and i < 3)
        w = counts * (goal.weight[g, 0] if shift else goal.weight[g, 1])
        residual[goal.row[g] + u] = w * off[v]
        cost += w * w * off[v] * off[v]
        if counts > 0.0 and shift:
            metres = max(metres, abs(off[v]))
        elif counts > 0.0 and kind[k] < BALL:
            radians = max(radians, abs(off[v]))
        elif counts > 0.0:
            a = v - i % 3
            radians = max(
                radians, math.sqrt(off[a] * off[a] + off[a + 1] * off[a + 1] + off[a + 2] * off[a + 2])
            )
    miss[g, 0], miss[g, 1] = metres, radians
    return cost, metres <= goal.tolerance[g, 0] and radians <= goal.tolerance[g, 1]


@pure
def joint_column(tree, goal, work, g, u, v):
    """The posture's rows of degree of freedom ``v``, in column ``u``."""
    jacobian, wanted, k = work.jacobian, goal.posture, tree.dof_node[v]
    joint, i, row = tree.kind[k], v - tree.vadr[k], goal.row[g] + u
    if joint < BALL or (joint == FREE and i < 3):
        jacobian[row, u] = goal.joint_weight[g, v] * goal.weight[g, 1 if joint == HINGE else 0]
        return
    a = tree.qadr[k] + (3 if joint == FREE else 0)
    x, y, z = kinematics.rotation_back(
        work.q, a, wanted[g, a], wanted[g, a + 1], wanted[g, a + 2], wanted[g, a + 3]
    )
    i %= 3
    # The vector belongs to the body's own axes, which the rotation carries along: the left Jacobian.
    ex, ey, ez = kinematics.unit(i)
    rx, ry, rz = inverse_right_jacobian(-x, -y, -z, ex, ey, ez)
    w, row, v = goal.weight[g, 1], row - i, v - i
    jacobian[row, u] = w * goal.joint_weight[g, v] * rx
    jacobian[row + 1, u] = w * goal.joint_weight[g, v + 1] * ry
    jacobian[row + 2, u] = w * goal.joint_weight[g, v + 2] * rz


@pure
def position_rows(goal, work, g, row):
    """Rows of a position in the axes of the target; returns the distance that counts."""
    target, frames, mask, w = goal.target, work.frames, goal.mask, goal.weight[g, 0]
    square = 0.0
    for i in range(3):
        off = 0.0
        for k in range(3):
            off += target[g, 3 + 3 * k + i] * (target[g, k] - frames[g, k])
        off *= mask[g, i]
        if goal.row_codes[g, POSITION_PART] == ONE_SIDE:
            off = max(off, 0.0)  # beyond the plane by its normal: nothing is asked
        work.residual[row + i] = w * off
        square += off * off
    return math.sqrt(square)


@pure
def aim_of(goal, work, g):
    """Direction in which the frame's z shall point, and the distance of what it is aimed at (0: none)."""
    target, frames = goal.target, work.frames
    if goal.row_codes[g, ORIENTATION_PART] == ONE_AXIS:
        return target[g, 5], target[g, 8], target[g, 11], 0.0
    x, y, z = target[g, 0] - frames[g, 0], target[g, 1] - frames[g, 1], target[g, 2] - frames[g, 2]
    away = math.sqrt(x * x + y * y + z * z)
    if away < _AT_POINT:
        return frames[g, 5], frames[g, 8], frames[g, 11], 0.0
    return x / away, y / away, z / away, away


@outlined
def partial_rows(tree, goal, work, g):
    """Residual and miss of a goal that has no quick path; returns (|r|², within tolerance)."""
    row_codes, frames, residual, miss = goal.row_codes, work.frames, work.residual, work.miss
    if row_codes[g, OF] == OF_JOINTS:
        return joint_rows(tree, goal, work, g)
    if row_codes[g, OF] == OF_MASS:
        mass_center(tree, goal, work, g)
    else:
        kinematics.frame_pose(work.world, goal.node[g], goal.local, g, frames)
    row, cost, distance, angle = goal.row[g], 0.0, 0.0, 0.0
    if row_codes[g, POSITION_PART] != NO_POSITION:
        distance = position_rows(goal, work, g, row)
        cost += (goal.weight[g, 0] * distance) ** 2
        row += 3
    if row_codes[g, ORIENTATION_PART] != NO_ORIENTATION:
        if row_codes[g, ORIENTATION_PART] == ALL_AXES:
            angle = rotation_error(goal.target, g, frames, g, residual, row)
        else:
            dx, dy, dz, _ = aim_of(goal, work, g)
            x, y, z, angle = axis_error(frames[g, 5], frames[g, 8], frames[g, 11], dx, dy, dz)
            residual[row], residual[row + 1], residual[row + 2] = x, y, z
        for i in range(3):
            residual[row + i] *= goal.weight[g, 1]
        cost += (goal.weight[g, 1] * angle) ** 2
    miss[g, 0], miss[g, 1] = distance, angle
    return cost, distance <= goal.tolerance[g, 0] and angle <= goal.tolerance[g, 1]


@outlined
def partial_column(tree, goal, work, g, u, v, moves):
    """Column ``u`` of the goal's rows for degree of freedom ``v``, which moves it or not (1 or 0)."""
    row_codes, jacobian, frames, world = goal.row_codes, work.jacobian, work.frames, work.world
    row, k = goal.row[g], tree.dof_node[v]
    if row_codes[g, OF] == OF_JOINTS:
        for i in range(goal.dofs.shape[0]):
            jacobian[row + i, u] = 0.0
        if moves > 0.0:
            joint_column(tree, goal, work, g, u, v)
        return
    ax, ay, az, rotational = kinematics.dof_axis(tree.kind, world, k, v - tree.vadr[k])
    if row_codes[g, OF] == OF_MASS:
        vx, vy, vz = mass_velocity(goal, work, g, k, ax, ay, az, rotational)
    else:
        fx, fy, fz = frames[g, 0], frames[g, 1], frames[g, 2]
        vx, vy, vz = kinematics.point_velocity(world, k, ax, ay, az, rotational, fx, fy, fz)
    vx, vy, vz = moves * vx, moves * vy, moves * vz
    if row_codes[g, POSITION_PART] != NO_POSITION:
        target, w = goal.target, goal.weight[g, 0]
        for i in range(3):
            along = target[g, 3 + i] * vx + target[g, 6 + i] * vy + target[g, 9 + i] * vz
            # Of a wall, only the side that pushes has a slope.
            active = row_codes[g, POSITION_PART] != ONE_SIDE or work.residual[row + i] > 0.0
            jacobian[row + i, u] = w * goal.mask[g, i] * along if active else 0.0
        row += 3
    if row_codes[g, ORIENTATION_PART] == NO_ORIENTATION:
        return
    w = goal.weight[g, 1]
    angular = moves if rotational else 0.0
    ax, ay, az = angular * ax, angular * ay, angular * az
    if row_codes[g, ORIENTATION_PART] == ALL_AXES:
        s = 1.0 / w if w > 0.0 else 0.0
        r = work.residual
        x, y, z = inverse_right_jacobian(s * r[row], s * r[row + 1], s * r[row + 2], ax, ay, az)
    else:
        x, y, z = axis_column(goal, work, g, ax, ay, az, vx, vy, vz)
    jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z


@pure
def axis_column(goal, work, g, ax, ay, az, vx, vy, vz):
    """How the error of one axis shrinks while the frame rotates with a and its origin moves with v."""
    frames = work.frames
    zx, zy, zz = frames[g, 5], frames[g, 8], frames[g, 11]
    dx, dy, dz, away = aim_of(goal, work, g)
    px, py, pz = ay * zz - az * zy, az * zx - ax * zz, ax * zy - ay * zx
    qx, qy, qz = 0.0, 0.0, 0.0
    if away > 0.0:
        s = -1.0 / away
        along = vx * dx + vy * dy + vz * dz
        qx, qy, qz = s * (vx - along * dx), s * (vy - along * dy), s * (vz - along * dz)
    return axis_error_rate(zx, zy, zz, dx, dy, dz, px, py, pz, qx, qy, qz)


# Whole positions, orientations and poses of a frame have a path of their own; ``partial_rows`` has the rest.
# But a pose prior is always soft: its rows are made where soft goals are served (``level_step.py``).
POSITION, ORIENTATION, POSE, PARTIAL, PRIOR = range(5)


GOALS = Layout(
    "Goals",
    kind="ints",  # (g,) POSITION, ORIENTATION, POSE, PARTIAL, PRIOR
    row_codes="int_table",  # (g, ROW_CODES) which rows a PARTIAL goal makes, see ``partial_rows``
    row="ints g",  # (g,) first row of its residual
    level="ints",  # (g,) its position in the order of priorities, 0 first; soft goals come after all others
    soft="ints",  # (g,) 1: wanted, not needed
    node="ints",  # (g,) node that carries its frame, -1 = world
    local="table g 12",  # frame seen from the node
    target="table",  # (g, 12) wanted pose, world
    mask="table",  # (g, 3) which coordinates count, in the axes of the target
    weight="table",  # (g, 2) on metres (already over the length scale) and on radians, as it counts now
    tolerance="table",  # (g, 2) metres, radians; inf where nothing is needed
    asked="table",  # (g, 4) weight and tolerance as asked for: those above are others during a search
    dofs="ints",  # (nu,) degrees of freedom that move any goal
    # Movers: the degrees of freedom that have a column, then the coupled ones.
    column="ints",  # (nu + c,) column of a mover: its own, or its leader's
    moved="ints",  # (nu + c,) its degree of freedom
    moves="int_table",  # (g, nu + c) does this one move that goal
    movers="int_table",  # (g, nu + c) those whose columns may not be zero in its rows, first, …
    mover_count="ints",  # (g,) … so many; the last c are the coupled ones
    hits="int_table",  # (nu, m) the rows in which a column may not be zero, first …
    hit_count="ints",  # (nu,) … and how many
    joint_scale="floats",  # (nu,) 1 for the least stiff joint, less for the stiffer ones
    coupled="int_table",  # (c, 3) coupling, column of its leader, degree of freedom that is coupled
    masses="table 0 4",  # (…, 4) of goals for the centre of mass, see ``mass_center``
    moments="table",  # … and their work space
    posture="table g nq",  # where a posture wants the joints
    joint_weight="table g nv",  # and how much each counts
    feature="int_table 0 3",  # (n, 3) the features of a pose prior, see ``pose_prior``; there is one at most
    prior="table 0 0",  # (…, n) its mixture, and its work space
)
open_goals = GOALS.open


@outlined
def evaluate(tree, goal, work):
    """Frames, residual and miss of all goals from the node poses; returns (½ |r|², all within tolerance)."""
    cost = 0.0
    within = True
    kinds, rows, nodes, local = goal.kind, goal.row, goal.node, goal.local
    target, weight, tolerance = goal.target, goal.weight, goal.tolerance
    world, frames, residual, miss = work.world, work.frames, work.residual, work.miss
    for g in range(kinds.shape[0]):
        kind = kinds[g]
        if kind == PARTIAL:
            square, met = partial_rows(tree, goal, work, g)
            cost += square
            within = within and met
            continue
        if kind == PRIOR:
            continue
        kinematics.frame_pose(world, nodes[g], local, g, frames)
        row = rows[g]
        if kind != ORIENTATION:
            x, y, z = target[g, 0] - frames[g, 0], target[g, 1] - frames[g, 1], target[g, 2] - frames[g, 2]
            w = weight[g, 0]
            square = x * x + y * y + z * z
            distance = math.sqrt(square)
            miss[g, 0] = distance
            cost += w * w * square
            residual[row], residual[row + 1], residual[row + 2] = w * x, w * y, w * z
            row += 3
            within = within and distance <= tolerance[g, 0]
        if kind != POSITION:
            w = weight[g, 1]
            angle = rotation_error(target, g, frames, g, residual, row)
            miss[g, 1] = angle
            cost += w * w * angle * angle
            for i in range(3):
                residual[row + i] *= w
            within = within and angle <= tolerance[g, 1]
    return 0.5 * cost, within


@outlined
def whole_columns(tree, goal, work, points, g, first, end):
    """Columns goal.movers[g, first:end] of a whole position, orientation or pose; others stay zero."""
    kind, vadr, dof_node, moved = tree.kind, tree.vadr, tree.dof_node, goal.moves
    world, residual, jacobian = work.world, work.residual, work.jacobian
    row, what = goal.row[g], goal.kind[g]
    angle_row = row if what == ORIENTATION else row + 3
    px, py, pz = points[g, 0], points[g, 1], points[g, 2]
    metre, radian = goal.weight[g, 0], goal.weight[g, 1]
    rx, ry, rz, factor = 0.0, 0.0, 0.0, 0.0
    if what != POSITION:
        s = 1.0 / radian if radian != 0.0 else 0.0
        rx, ry, rz = s * residual[angle_row], s * residual[angle_row + 1], s * residual[angle_row + 2]
        factor = curvature(rx, ry, rz)
    for at in range(first, end):
        mover = goal.movers[g, at]
        u, v = goal.column[mover], goal.moved[mover]
        k = dof_node[v]
        ax, ay, az, rotational = kinematics.dof_axis(kind, world, k, v - vadr[k])
        moves = float(moved[g, mover])
        if what != ORIENTATION:
            w = metre * moves
            x, y, z = kinematics.point_velocity(world, k, ax, ay, az, rotational, px, py, pz)
            jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z
        if what != POSITION:
            w = radian * moves if rotational else 0.0
            x, y, z = rate_of_rotation_vector(rx, ry, rz, factor, ax, ay, az)
            x, y, z = w * x, w * y, w * z
            jacobian[angle_row, u], jacobian[angle_row + 1, u], jacobian[angle_row + 2, u] = x, y, z


@outlined
def add_tied(tree, goal, work, points):
    """Adds what the coupled joints do to the columns of their leaders."""
    jacobian, kept = work.jacobian, work.column
    for c in range(goal.coupled.shape[0]):
        coupling, u, v = goal.coupled[c, 0], goal.coupled[c, 1], goal.coupled[c, 2]
        mover = goal.dofs.shape[0] + c
        slope = kinematics.slope_of(tree, coupling, work.q)
        for r in range(jacobian.shape[0]):
            kept[r] = jacobian[r, u]
        for g in range(goal.kind.shape[0]):
            if goal.kind[g] < PARTIAL:
                whole_columns(tree, goal, work, points, g, mover, mover + 1)
            elif goal.kind[g] == PARTIAL:
                partial_column(tree, goal, work, g, u, v, float(goal.moves[g, mover]))
        for r in range(jacobian.shape[0]):
            jacobian[r, u] = kept[r] + slope * jacobian[r, u]


@pure
def goal_end(goal, g, rows):
    """The row after the last one of goal ``g``; goals own their rows one after the other."""
    return goal.row[g + 1] if g + 1 < goal.row.shape[0] else rows


@outlined
def clamp_residual(goal, residual, wanted, clamp, alike):
    """ClampMag (Buss & Kim 2005, section 3): the residual of each goal, shortened to ``clamp`` at most.

    ``alike``: all by the factor of the longest, so that the direction of descent stays the same.
    """
    m = residual.shape[0]
    least = 1.0
    for g in range(goal.row.shape[0]):
        first, end = goal.row[g], goal_end(goal, g, m)
        square = 0.0
        for r in range(first, end):
            square += residual[r] * residual[r]
        norm = math.sqrt(square)
        share = clamp / norm if norm > clamp else 1.0
        least = min(least, share)
        for r in range(first, end):
            wanted[r] = share * residual[r]
    if alike:
        for r in range(m):
            wanted[r] = least * residual[r]


@outlined
def goal_jacobian(tree, goal, work, points):
    """Weighted Jacobian (m, nu) with J dq ≈ r: minus the derivative of the residual, exact.

    Position rows move the origins of ``points`` (g, 12): work.frames, or goal.target (alternative Jacobian).
    """
    dofs, joint_scale, jacobian = goal.dofs, goal.joint_scale, work.jacobian
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] < PARTIAL:
            whole_columns(tree, goal, work, points, g, types.int64(0), goal.mover_count[g])
            continue
        for u in range(dofs.shape[0] if goal.kind[g] == PARTIAL else 0):
            partial_column(tree, goal, work, g, u, dofs[u], float(goal.moves[g, u]))
    if goal.coupled.shape[0] > 0:
        add_tied(tree, goal, work, points)
    for u in range(dofs.shape[0]):
        if joint_scale[u] != 1.0:
            for r in range(jacobian.shape[0]):
                jacobian[r, u] *= joint_scale[u]
