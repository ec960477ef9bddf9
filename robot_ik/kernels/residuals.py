"""Residual, Jacobian and miss of every goal kind, on flat arrays.

A goal owns some rows of the residual r = (what is wanted) − (what is), weighted; its Jacobian rows are
those of the frame's motion, so that J dq ≈ r is the step wanted.  The *miss* is unweighted, in metres
and radians, and decides convergence.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import dof_axis, forward, frame_pose, point_velocity
from robot_ik.kernels.tree import open_tree

POSITION, ORIENTATION, POSE = 0, 1, 2
ROWS_OF = {POSITION: 3, ORIENTATION: 3, POSE: 6}


GOALS = Layout(
    "Goals",
    kind="ints",  # (g,) POSITION, ORIENTATION, POSE
    row="ints",  # (g,) first row of its residual
    node="ints",  # (g,) node that carries its frame, -1 = world
    local="table",  # (g, 12) frame seen from the node
    target="table",  # (g, 12) wanted pose, world
    weight="table",  # (g, 2) on metres (already over the length scale) and on radians
    tolerance="table",  # (g, 2) metres, radians
    dofs="ints",  # (nu,) degrees of freedom that move any goal
    moves="int_table",  # (g, nu) does this one move that goal
)
open_goals = GOALS.open


@outlined
def rotation_error(target, current, g, out, at):
    """Rotation vector, world axes, that turns current[g] into target[g] (pose rows), into out[at:at+3].

    Returns its angle in [0, pi].  Exact at both ends: near pi the axis comes from the symmetric part.
    """
    # M = R_target · R_currentᵀ, of which only what is needed is formed.
    m00 = target[g, 3] * current[g, 3] + target[g, 4] * current[g, 4] + target[g, 5] * current[g, 5]
    m01 = target[g, 3] * current[g, 6] + target[g, 4] * current[g, 7] + target[g, 5] * current[g, 8]
    m02 = target[g, 3] * current[g, 9] + target[g, 4] * current[g, 10] + target[g, 5] * current[g, 11]
    m10 = target[g, 6] * current[g, 3] + target[g, 7] * current[g, 4] + target[g, 8] * current[g, 5]
    m11 = target[g, 6] * current[g, 6] + target[g, 7] * current[g, 7] + target[g, 8] * current[g, 8]
    m12 = target[g, 6] * current[g, 9] + target[g, 7] * current[g, 10] + target[g, 8] * current[g, 11]
    m20 = target[g, 9] * current[g, 3] + target[g, 10] * current[g, 4] + target[g, 11] * current[g, 5]
    m21 = target[g, 9] * current[g, 6] + target[g, 10] * current[g, 7] + target[g, 11] * current[g, 8]
    m22 = target[g, 9] * current[g, 9] + target[g, 10] * current[g, 10] + target[g, 11] * current[g, 11]
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


@outlined
def evaluate(goal, world, frames, residual, miss):
    """Frames, residual and miss of all goals from the node poses; returns (½ |r|², all within tolerance)."""
    cost = 0.0
    within = True
    kinds, rows, nodes, local = goal.kind, goal.row, goal.node, goal.local
    target, weight, tolerance = goal.target, goal.weight, goal.tolerance
    for g in range(kinds.shape[0]):
        frame_pose(world, nodes[g], local, g, frames)
        row = rows[g]
        kind = kinds[g]
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


@pure
def inverse_right_jacobian(x, y, z, a, b, c):
    """J_r⁻¹(φ) ω for φ = (x, y, z), ω = (a, b, c): ω + ½ φ×ω + k φ×(φ×ω).

    How φ = log(R_target R_currentᵀ) shrinks while the current frame turns with ω; J_r is the right
    Jacobian of SO(3) (Solà et al., A micro Lie theory for state estimation, 2018, eq. 144).
    """
    square = x * x + y * y + z * z
    if square < 1e-6:
        k = 1.0 / 12.0 + square / 720.0
    else:
        angle = math.sqrt(square)
        k = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + 0.5 * p + k * (y * r - z * q),
        b + 0.5 * q + k * (z * p - x * r),
        c + 0.5 * r + k * (x * q - y * p),
    )


@outlined
def goal_jacobian(tree, goal, world, frames, residual, jacobian):
    """Weighted Jacobian (m, nu) with J dq ≈ r: minus the derivative of the residual, exact."""
    joint, vadr, dof_node = tree.kind, tree.vadr, tree.dof_node
    kinds, rows, weight, dofs, moved = goal.kind, goal.row, goal.weight, goal.dofs, goal.moves
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        ax, ay, az, turn = dof_axis(joint, world, k, v - vadr[k])
        for g in range(kinds.shape[0]):
            row = rows[g]
            what = kinds[g]
            moves = float(moved[g, u])
            if what != ORIENTATION:
                w = weight[g, 0] * moves
                x, y, z = point_velocity(world, k, ax, ay, az, turn, frames[g, 0], frames[g, 1], frames[g, 2])
                jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z
                row += 3
            if what != POSITION:
                w = weight[g, 1]
                s = 1.0 / w if w != 0.0 else 0.0
                x, y, z = inverse_right_jacobian(
                    s * residual[row], s * residual[row + 1], s * residual[row + 2], ax, ay, az
                )
                w *= moves if turn else 0.0
                jacobian[row, u], jacobian[row + 1, u], jacobian[row + 2, u] = w * x, w * y, w * z


@kernel
def residual_and_jacobian(tree, goals, nodes, q, world, frames, scratch, residual, miss, jacobian):
    """For tests: fills residual (m,), miss (g, 2) and jacobian (m, nu) at q; returns the cost."""
    tree, goal = open_tree(tree), open_goals(goals)
    forward(tree, nodes, q, world, scratch)
    cost, _ = evaluate(goal, world, frames, residual, miss)
    goal_jacobian(tree, goal, world, frames, residual, jacobian)
    return cost
