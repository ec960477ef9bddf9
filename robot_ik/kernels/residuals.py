"""Residual, Jacobian and miss of every goal kind, on flat arrays.

A goal owns some rows of the residual r = (what is wanted) − (what is), weighted; its Jacobian rows are
those of the frame's motion, so that J dq ≈ r is the step wanted.  The *miss* is unweighted, in metres
and radians, and decides convergence.

Columns belong to ``goal.dofs``.  A joint that is *tied* to another has no column: what it does is added
to that of its leader.  A stiff joint's column is shortened by ``goal.joint_scale``, and ``apply_step``
shortens the step by the same: minimising the damped step then spares the joint (weighted least squares,
Whitney, J. Dynamic Systems, Measurement and Control 94(4), 1972).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import entry, kernel, outlined, pure
from robot_ik.kernels.kinematics import dof_axis, forward, frame_pose, point_velocity, slope_of
from robot_ik.kernels.pose_prior import prior_column, prior_rows
from robot_ik.kernels.rotations import (
    axis_error,
    axis_error_rate,
    bent,
    curvature,
    inverse_right_jacobian,
    rotation_back,
    rotation_error,
)
from robot_ik.kernels.tree import BALL, FREE, SLIDE, open_tree
from robot_ik.kernels.workspace import open_work

# ------------------------------------------------------------------------------------------
# Rows of a goal.  Whole positions, orientations and poses have a faster path of their own, above all others;
# ``goal.how`` lists the rows of goals for a part of a pose, the centre of mass or the joints:
#
#     place   all three coordinates, some of them in the axes of the target, or one side of a plane only
#     turn    the whole orientation, one axis along the target's, or one axis aimed at the target's origin
#     of      what is placed and turned: the frame, the centre of mass, or the joints themselves, one by one
#             or by a pose prior (``pose_prior.py``)
#
# The axis that counts is always z: ``Problem`` turns frame and target so that it is.


NO_PLACE, WHOLE, SOME_AXES, ONE_SIDE = range(4)
NO_TURN, ALL_AXES, ONE_AXIS, AIMED = range(4)
OF_FRAME, OF_MASS, OF_JOINTS, OF_PRIOR = range(4)
# Columns of goal.how; BLOCK is the first row of the goal's masses.
PLACE, TURN, OF, BLOCK, HOW_SIZE = range(5)

# Nearer to the point that it aims at than this, in metres, a frame has no direction to aim in.
_AT_POINT = 1e-9


@outlined
def mass_center(tree, goal, work, g):
    """Centre of mass into frames[g, :3]; first moments of what hangs on each node into goal.moments.

    goal.masses holds for each node its own mass and centre, seen from the node, and in a last row those
    of the bodies that do not move.
    """
    parent, world, masses, moments, frames = tree.parent, work.world, goal.masses, goal.moments, work.frames
    n, first = parent.shape[0], goal.how[g, BLOCK]
    for k in range(n):
        mass = masses[first + k, 0]
        moments[first + k, 0] = mass
        for i in range(3):
            moments[first + k, 1 + i] = 0.0
            if mass > 0.0:
                moments[first + k, 1 + i] = mass * (
                    world[k, i]
                    + world[k, 3 + 3 * i] * masses[first + k, 1]
                    + world[k, 4 + 3 * i] * masses[first + k, 2]
                    + world[k, 5 + 3 * i] * masses[first + k, 3]
                )
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
def mass_velocity(goal, work, g, k, ax, ay, az, turn):
    """Velocity of the centre of mass per unit of a degree of freedom of node ``k``."""
    moments, first = goal.moments, goal.how[g, BLOCK]
    mass = moments[first + k, 0]
    if not mass > 0.0:
        return 0.0, 0.0, 0.0
    share = mass / moments[first + work.world.shape[0], 0]
    s = 1.0 / mass
    x, y, z = point_velocity(
        work.world, k, ax, ay, az, turn,
        s * moments[first + k, 1], s * moments[first + k, 2], s * moments[first + k, 3],
    )  # fmt: skip
    return share * x, share * y, share * z


@outlined
def joint_rows(tree, goal, work, g):
    """Rows of a posture: the way of each joint to where it is wanted; returns (|r|², within)."""
    kind, qadr, vadr, dof_node = tree.kind, tree.qadr, tree.vadr, tree.dof_node
    q, wanted, residual, miss = work.q, goal.posture, work.residual, work.miss
    metres, radians, cost = 0.0, 0.0, 0.0
    x, y, z = 0.0, 0.0, 0.0
    for u in range(goal.dofs.shape[0]):
        v = goal.dofs[u]
        k = dof_node[v]
        a, i = qadr[k], v - vadr[k]
        if kind[k] < BALL:
            off = wanted[g, a] - q[a]
        elif kind[k] == FREE and i < 3:
            off = wanted[g, a + i] - q[a + i]
        else:
            b = a + 3 if kind[k] == FREE else a
            x, y, z = rotation_back(q, b, wanted[g, b], wanted[g, b + 1], wanted[g, b + 2], wanted[g, b + 3])
            off = x if i % 3 == 0 else (y if i % 3 == 1 else z)
        joint_weights = goal.joint_weight[g, v]
        shift = kind[k] == SLIDE or (kind[k] == FREE and i < 3)
        w = joint_weights * (goal.weight[g, 0] if shift else goal.weight[g, 1])
        residual[goal.row[g] + u] = w * off
        cost += w * w * off * off
        if joint_weights > 0.0:
            size = math.sqrt(x * x + y * y + z * z) if kind[k] >= BALL and not shift else abs(off)
            if shift:
                metres = max(metres, size)
            else:
                radians = max(radians, size)
    miss[g, 0], miss[g, 1] = metres, radians
    return cost, metres <= goal.tolerance[g, 0] and radians <= goal.tolerance[g, 1]


@pure
def joint_column(tree, goal, work, g, u, v):
    """The posture's rows of degree of freedom ``v``, in column ``u``."""
    kind, qadr, vadr = tree.kind, tree.qadr, tree.vadr
    q, wanted, jacobian = work.q, goal.posture, work.jacobian
    k = tree.dof_node[v]
    i, row = v - vadr[k], goal.row[g] + u
    if kind[k] < BALL or (kind[k] == FREE and i < 3):
        shift = kind[k] != 0
        jacobian[row, u] = goal.joint_weight[g, v] * (goal.weight[g, 0] if shift else goal.weight[g, 1])
        return
    a = qadr[k] + 3 if kind[k] == FREE else qadr[k]
    x, y, z = rotation_back(q, a, wanted[g, a], wanted[g, a + 1], wanted[g, a + 2], wanted[g, a + 3])
    i %= 3
    # The vector belongs to the body's own axes, which the turn carries along: the left Jacobian.
    rx, ry, rz = inverse_right_jacobian(
        -x, -y, -z, 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0
    )
    w, row, v = goal.weight[g, 1], row - i, v - i
    jacobian[row, u] = w * goal.joint_weight[g, v] * rx
    jacobian[row + 1, u] = w * goal.joint_weight[g, v + 1] * ry
    jacobian[row + 2, u] = w * goal.joint_weight[g, v + 2] * rz


@pure
def place_rows(goal, work, g, row):
    """Rows of a place in the axes of the target; returns the distance that counts."""
    target, frames, mask, w = goal.target, work.frames, goal.mask, goal.weight[g, 0]
    square = 0.0
    for i in range(3):
        off = 0.0
        for k in range(3):
            off += target[g, 3 + 3 * k + i] * (target[g, k] - frames[g, k])
        off *= mask[g, i]
        if goal.how[g, PLACE] == ONE_SIDE:
            off = max(off, 0.0)  # beyond the plane by its normal: nothing is asked
        work.residual[row + i] = w * off
        square += off * off
    return math.sqrt(square)


@pure
def aim_of(goal, work, g):
    """Direction in which the frame's z shall point, and the distance of what it is aimed at (0: none)."""
    target, frames = goal.target, work.frames
    if goal.how[g, TURN] == ONE_AXIS:
        return target[g, 5], target[g, 8], target[g, 11], 0.0
    x, y, z = target[g, 0] - frames[g, 0], target[g, 1] - frames[g, 1], target[g, 2] - frames[g, 2]
    away = math.sqrt(x * x + y * y + z * z)
    if away < _AT_POINT:
        return frames[g, 5], frames[g, 8], frames[g, 11], 0.0
    return x / away, y / away, z / away, away


@outlined
def partial_rows(tree, goal, work, g):
    """Residual and miss of a goal that has no quick path; returns (|r|², within tolerance)."""
    how, frames, residual, miss = goal.how, work.frames, work.residual, work.miss
    if how[g, OF] == OF_JOINTS:
        return joint_rows(tree, goal, work, g)
    if how[g, OF] == OF_PRIOR:
        miss[g, 0], miss[g, 1] = 0.0, 0.0
        return prior_rows(goal, work, g), True
    if how[g, OF] == OF_MASS:
        mass_center(tree, goal, work, g)
    else:
        frame_pose(work.world, goal.node[g], goal.local, g, frames)
    row, cost, distance, angle = goal.row[g], 0.0, 0.0, 0.0
    if how[g, PLACE] != NO_PLACE:
        distance = place_rows(goal, work, g, row)
        cost += (goal.weight[g, 0] * distance) ** 2
        row += 3
    if how[g, TURN] != NO_TURN:
        if how[g, TURN] == ALL_AXES:
            angle = rotation_error(goal.target, frames, g, residual, row)
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
    how, jacobian, frames, world = goal.how, work.jacobian, work.frames, work.world
    row, k = goal.row[g], tree.dof_node[v]
    if how[g, OF] == OF_JOINTS:
        for i in range(goal.dofs.shape[0]):
            jacobian[row + i, u] = 0.0
        if moves > 0.0:
            joint_column(tree, goal, work, g, u, v)
        return
    if how[g, OF] == OF_PRIOR:
        for i in range(goal.feature.shape[0] + 1):
            jacobian[row + i, u] = 0.0
        axis = v - tree.vadr[k]
        prior_column(goal, work, g, u, k, axis - 3 if tree.kind[k] == FREE else axis)
        return
    ax, ay, az, turn = dof_axis(tree.kind, world, k, v - tree.vadr[k])
    if how[g, OF] == OF_MASS:
        vx, vy, vz = mass_velocity(goal, work, g, k, ax, ay, az, turn)
    else:
        vx, vy, vz = point_velocity(world, k, ax, ay, az, turn, frames[g, 0], frames[g, 1], frames[g, 2])
    vx, vy, vz = moves * vx, moves * vy, moves * vz
    if how[g, PLACE] != NO_PLACE:
        target, w = goal.target, goal.weight[g, 0]
        for i in range(3):
            along = target[g, 3 + i] * vx + target[g, 6 + i] * vy + target[g, 9 + i] * vz
            # Of a wall, only the side that pushes has a slope.
            active = how[g, PLACE] != ONE_SIDE or work.residual[row + i] > 0.0
            jacobian[row + i, u] = w * goal.mask[g, i] * along if active else 0.0
        row += 3
    if how[g, TURN] == NO_TURN:
        return
    w = goal.weight[g, 1]
    turned = moves if turn else 0.0
    ax, ay, az = turned * ax, turned * ay, turned * az
    if how[g, TURN] == ALL_AXES:
        s = 1.0 / w if w > 0.0 else 0.0
        r = work.residual
        x, y, z = inverse_right_jacobian(s * r[row], s * r[row + 1], s * r[row + 2], ax, ay, az)
    else:
        x, y, z = axis_column(goal, work, g, ax, ay, az, vx, vy, vz)
    jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z


@pure
def axis_column(goal, work, g, ax, ay, az, vx, vy, vz):
    """How the error of one axis shrinks while the frame turns with a and its origin moves with v."""
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
POSITION, ORIENTATION, POSE, PARTIAL = 0, 1, 2, 3


GOALS = Layout(
    "Goals",
    kind="ints",  # (g,) POSITION, ORIENTATION, POSE, PARTIAL
    how="int_table",  # (g, HOW_SIZE) which rows a PARTIAL goal makes, see ``partial_rows``
    row="ints",  # (g,) first row of its residual
    level="ints",  # (g,) its place in the order of priorities, 0 first; soft goals come after all others
    soft="ints",  # (g,) 1: wanted, not needed
    node="ints",  # (g,) node that carries its frame, -1 = world
    local="table",  # (g, 12) frame seen from the node
    target="table",  # (g, 12) wanted pose, world
    mask="table",  # (g, 3) which coordinates count, in the axes of the target
    weight="table",  # (g, 2) on metres (already over the length scale) and on radians, as it counts now
    tolerance="table",  # (g, 2) metres, radians; inf where nothing is needed
    asked="table",  # (g, 4) weight and tolerance as asked for: those above are others during a search
    dofs="ints",  # (nu,) degrees of freedom that move any goal
    # Movers: the degrees of freedom that have a column, then the tied ones.
    column="ints",  # (nu + c,) column of a mover: its own, or its leader's
    moved="ints",  # (nu + c,) its degree of freedom
    moves="int_table",  # (g, nu + c) does this one move that goal
    movers="int_table",  # (g, nu + c) those whose columns may not be zero in its rows, first, …
    mover_count="ints",  # (g,) … so many; the last c are the tied ones
    hits="int_table",  # (nu, m) the rows in which a column may not be zero, first …
    hit_count="ints",  # (nu,) … and how many
    joint_scale="floats",  # (nu,) 1 for the least stiff joint, less for the stiffer ones
    tied="int_table",  # (c, 3) coupling, column of its leader, degree of freedom that is tied
    masses="table",  # (…, 4) of goals for the centre of mass, see ``partial_rows.mass_center``
    moments="table",  # … and their work space
    posture="table",  # (g, nq) where a posture wants the joints
    joint_weight="table",  # (g, nv) and how much each counts
    feature="int_table",  # (n, 3) the features of a pose prior, see ``pose_prior``; there is one at most
    prior="table",  # (…, n) its mixture, and its work space
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
        frame_pose(world, nodes[g], local, g, frames)
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
            angle = rotation_error(target, frames, g, residual, row)
            miss[g, 1] = angle
            cost += w * w * angle * angle
            for i in range(3):
                residual[row + i] *= w
            within = within and angle <= tolerance[g, 1]
    return 0.5 * cost, within


@outlined
def whole_columns(tree, goal, work, points, g, first, end):
    """The columns listed in goal.movers[g, first:end], of a whole position, orientation or pose.

    Those of joints that cannot move the goal are zero from the beginning, and stay it.
    """
    kind, vadr, dof_node, moved = tree.kind, tree.vadr, tree.dof_node, goal.moves
    world, residual, jacobian = work.world, work.residual, work.jacobian
    row, what = goal.row[g], goal.kind[g]
    turned = row if what == ORIENTATION else row + 3
    px, py, pz = points[g, 0], points[g, 1], points[g, 2]
    metre, radian = goal.weight[g, 0], goal.weight[g, 1]
    rx, ry, rz, bend = 0.0, 0.0, 0.0, 0.0
    if what != POSITION:
        s = 1.0 / radian if radian != 0.0 else 0.0
        rx, ry, rz = s * residual[turned], s * residual[turned + 1], s * residual[turned + 2]
        bend = curvature(rx, ry, rz)
    for at in range(first, end):
        mover = goal.movers[g, at]
        u, v = goal.column[mover], goal.moved[mover]
        k = dof_node[v]
        ax, ay, az, turn = dof_axis(kind, world, k, v - vadr[k])
        moves = float(moved[g, mover])
        if what != ORIENTATION:
            w = metre * moves
            x, y, z = point_velocity(world, k, ax, ay, az, turn, px, py, pz)
            jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z
        if what != POSITION:
            w = radian * moves if turn else 0.0
            x, y, z = bent(rx, ry, rz, bend, ax, ay, az)
            jacobian[turned, u], jacobian[turned + 1, u], jacobian[turned + 2, u] = w * x, w * y, w * z


@outlined
def add_tied(tree, goal, work, points):
    """Adds what the tied joints do to the columns of their leaders."""
    jacobian, kept = work.jacobian, work.column
    for c in range(goal.tied.shape[0]):
        coupling, u, v = goal.tied[c, 0], goal.tied[c, 1], goal.tied[c, 2]
        mover = goal.dofs.shape[0] + c
        slope = slope_of(tree, coupling, work.q)
        for r in range(jacobian.shape[0]):
            kept[r] = jacobian[r, u]
        for g in range(goal.kind.shape[0]):
            if goal.kind[g] != PARTIAL:
                whole_columns(tree, goal, work, points, g, mover, mover + 1)
            else:
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

    ``alike``: all by the factor of the longest, so that the way down stays the same.
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

    ``points`` (g, 12) are the poses whose origins the position rows move: work.frames, or goal.target
    for the alternative Jacobian.
    """
    dofs, joint_scale, jacobian = goal.dofs, goal.joint_scale, work.jacobian
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] != PARTIAL:
            whole_columns(tree, goal, work, points, g, types.int64(0), goal.mover_count[g])
            continue
        for u in range(dofs.shape[0]):
            partial_column(tree, goal, work, g, u, dofs[u], float(goal.moves[g, u]))
    if goal.tied.shape[0] > 0:
        add_tied(tree, goal, work, points)
    for u in range(dofs.shape[0]):
        if joint_scale[u] != 1.0:
            for r in range(jacobian.shape[0]):
                jacobian[r, u] *= joint_scale[u]


@kernel
def residual_and_jacobian(tree, goals, work):
    """For tests: residual (m,), miss (g, 2), jacobian (m, nu) at the work space's q; returns the cost."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    forward(tree, work.nodes, work.q, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    goal_jacobian(tree, goal, work, work.frames)
    return cost


# ------------------------------------------------------------------------------------------
# Moving a target in compiled code: the hot loop does it before every solve.


MOVE = Layout(
    "Move",
    matrix="table",  # (4, 4) homogeneous, the wanted pose
    target="table",  # (g, 12) rows of all goals
)
open_move = MOVE.open


@kernel
def take_matrix(move, index):
    """target[index] = matrix; False, and nothing is done, when a number is not finite.

    With ~index in place of index the position alone is taken, and asked about.
    """
    move = open_move(move)
    matrix, target = move.matrix, move.target
    first = 0 if index >= 0 else 3
    row = index if index >= 0 else ~index
    size = 0.0
    for i in range(4 if index >= 0 else 3):
        for j in range(first, 4):
            x = matrix[i, j]
            size = max(size, abs(x)) if x == x else math.inf
    if not size < math.inf:
        return False
    for i in range(3):
        target[row, i] = matrix[i, 3]
        for j in range(first, 3):
            target[row, 3 + 3 * i + j] = matrix[i, j]
    return True


class Mover:
    """Takes matrices and positions as targets: fill the array of their shape, then take them.

        array, flip = mover.places[shape]
        array[...] = target
        mover.take(mover.move, index ^ flip)      # False when it is not finite; nothing is done then

    Attributes:
        places: For (4, 4) and (3,): where to put one, and what turns the index into that of ``take_matrix``.
        dtype: What a target must be of to need no conversion that may fail.
        take, move: The compiled code, and what it takes before the goal's index.
    """

    __slots__ = ("_table", "dtype", "move", "places", "take")

    def __init__(self, target: NDArray[np.float64]) -> None:
        matrix = np.zeros((4, 4))
        self.places: dict[Any, tuple[Any, int]] = {(4, 4): (matrix, 0), (3,): (matrix[:3, 3], -1)}
        self.dtype = matrix.dtype
        self._table = MOVE.pack({"matrix": matrix, "target": target})
        self.move: int = self._table.ctypes.data
        self.take: Any = entry(take_matrix, self.move, 0)
