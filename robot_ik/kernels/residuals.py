"""Residual, Jacobian and miss of every goal kind, on flat arrays.

A goal owns some rows of the residual r = (what is wanted) − (what is), weighted; its Jacobian rows are
those of the frame's motion, so that J dq ≈ r is the step wanted.  The *miss* is unweighted, in metres
and radians, and decides convergence.

Columns belong to ``goal.dofs``.  A joint that is *tied* to another has no column: what it does is added
to that of its leader.  A stiff joint's column is shortened by ``goal.ease``, and ``apply_step`` shortens
the step by the same: minimising the damped step then spares the joint (weighted least squares,
Whitney, J. Dynamic Systems, Measurement and Control 94(4), 1972).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.couplings import slope_of
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.kinematics import dof_axis, forward, frame_pose, point_velocity
from robot_ik.kernels.partial_rows import partial_column, partial_rows
from robot_ik.kernels.rotation_rows import bent, curvature, rotation_error
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import open_work

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
    ease="floats",  # (nu,) 1 for the least stiff joint, less for the stiffer ones
    tied="int_table",  # (c, 3) coupling, column of its leader, degree of freedom that is tied
    masses="table",  # (…, 4) of goals for the centre of mass, see ``partial_rows.mass_center``
    moments="table",  # … and their work space
    posture="table",  # (g, nq) where a posture wants the joints
    joint_weight="table",  # (g, nv) and how much each counts
    feature="int_table",  # (n, 3) what a pose prior looks at, see ``pose_prior``; there is one at most
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


@outlined
def goal_jacobian(tree, goal, work, points):
    """Weighted Jacobian (m, nu) with J dq ≈ r: minus the derivative of the residual, exact.

    ``points`` (g, 12) are the poses whose origins the position rows move: work.frames, or goal.target
    for the alternative Jacobian.
    """
    dofs, ease, jacobian = goal.dofs, goal.ease, work.jacobian
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] != PARTIAL:
            whole_columns(tree, goal, work, points, g, types.int64(0), goal.mover_count[g])
            continue
        for u in range(dofs.shape[0]):
            partial_column(tree, goal, work, g, u, dofs[u], float(goal.moves[g, u]))
    if goal.tied.shape[0] > 0:
        add_tied(tree, goal, work, points)
    for u in range(dofs.shape[0]):
        if ease[u] != 1.0:
            for r in range(jacobian.shape[0]):
                jacobian[r, u] *= ease[u]


@kernel
def residual_and_jacobian(tree, goals, work):
    """For tests: residual (m,), miss (g, 2), jacobian (m, nu) at the work space's q; returns the cost."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    forward(tree, work.nodes, work.q, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    goal_jacobian(tree, goal, work, work.frames)
    return cost
