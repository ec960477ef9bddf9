"""What Gauss-Newton leaves out: how the Jacobian itself turns, weighed with the residual.

Near a goal that can be met the residual vanishes and this with it.  Near the nearest point to a goal that
cannot, it decides how quickly a descent ends: without it each step takes off a fixed share of the way.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import dof_axis
from robot_ik.kernels.residuals import ORIENTATION, PARTIAL, POSITION
from robot_ik.kernels.rotation_rows import curvature
from robot_ik.kernels.tree import HINGE, SLIDE

# Beyond so many joints the matrix costs more than the steps that it saves: its factors grow with the cube.
_MOST_JOINTS = 64


@pure
def has_second_order(tree, goal):
    """Whether ``second_order`` serves a problem: some hinges and slides, whole goals, nothing tied."""
    if goal.tied.shape[0] > 0 or goal.dofs.shape[0] > _MOST_JOINTS:
        return False
    for g in range(goal.kind.shape[0]):
        if goal.kind[g] == PARTIAL:
            return False
    for u in range(goal.dofs.shape[0]):
        joint = tree.kind[tree.dof_node[goal.dofs[u]]]
        if joint != HINGE and joint != SLIDE:
            return False
    return True


@outlined
def second_order(tree, goal, work, out):
    """Hessian of ½ |r|² less JᵀJ into the lower triangle of ``out`` (nu, nu); r and J are in the work space.

    Of two joints that move a goal the one with the smaller index is nearer to the root, a its axis.  A hinge
    there turns the other's column of the position, v: ∂²p = a × v.  Of a rotation, with unit axes a before b
    and φ = log(R_target Rᵀ), the Hessian of ½ |φ|² is a·b + k ((φ·a)(φ·b) − |φ|² a·b) − ½ φ·(a × b), as
    follows from φ' = −J_r⁻¹(φ) ω and b' = a × b (k of ``curvature``).
    """
    kinds, vadr, dof_node, ease = tree.kind, tree.vadr, tree.dof_node, goal.ease
    world, residual, jacobian = work.world, work.residual, work.jacobian
    n = goal.dofs.shape[0]
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = 0.0
    for g in range(goal.kind.shape[0]):
        what, row, weight = goal.kind[g], goal.row[g], goal.weight[g, 1]
        turned = row if what == ORIENTATION else row + 3
        ex, ey, ez, fx, fy, fz, k, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if what != ORIENTATION:
            ex, ey, ez = residual[row], residual[row + 1], residual[row + 2]
        if what != POSITION and weight > 0.0:
            s = 1.0 / weight
            fx, fy, fz = s * residual[turned], s * residual[turned + 1], s * residual[turned + 2]
            k, square = curvature(fx, fy, fz), fx * fx + fy * fy + fz * fz
        for j in range(n):
            node = dof_node[goal.dofs[j]]
            if goal.moves[g, j] == 0:
                continue
            ax, ay, az, turn = dof_axis(kinds, world, node, goal.dofs[j] - vadr[node])
            if not turn:
                continue
            s = ease[j]
            # e · (a × v) = v · (e × a), and φ · (a × b) = b · (φ × a).
            px, py, pz = s * (ey * az - ez * ay), s * (ez * ax - ex * az), s * (ex * ay - ey * ax)
            qx, qy, qz = fy * az - fz * ay, fz * ax - fx * az, fx * ay - fy * ax
            along = fx * ax + fy * ay + fz * az
            for i in range(j, n):
                if goal.moves[g, i] == 0:
                    continue
                if what != ORIENTATION:
                    out[i, j] -= px * jacobian[row, i] + py * jacobian[row + 1, i] + pz * jacobian[row + 2, i]
                if what == POSITION:
                    continue
                other = dof_node[goal.dofs[i]]
                bx, by, bz, turns = dof_axis(kinds, world, other, goal.dofs[i] - vadr[other])
                if not turns:
                    continue
                cosine = ax * bx + ay * by + az * bz
                hessian = cosine + k * (along * (fx * bx + fy * by + fz * bz) - square * cosine)
                hessian -= 0.5 * (qx * bx + qy * by + qz * bz)
                product = 0.0
                for r in range(turned, turned + 3):
                    product += jacobian[r, i] * jacobian[r, j]
                out[i, j] += weight * weight * s * ease[i] * hessian - product
