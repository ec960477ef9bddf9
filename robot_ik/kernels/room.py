"""Taking a step inside the joint limits, and how far it may go."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.couplings import follow
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, turn_quat
from robot_ik.kernels.tree import BALL, FREE


@outlined
def apply_step(tree, goal, nodes, step, dq, q):
    """q = q ⊕ ease · step for the goals' degrees of freedom, inside the limits; ``dq`` is work space."""
    dofs, ease = goal.dofs, goal.ease
    kind, qadr, vadr, dof_node, lower, upper = (
        tree.kind, tree.qadr, tree.vadr, tree.dof_node, tree.lower, tree.upper,
    )  # fmt: skip
    floating = False
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            q[a] = min(max(q[a] + ease[u] * step[u], lower[v]), upper[v])
        else:
            floating = True
            dq[v] = ease[u] * step[u]
    if tree.tied.shape[0] > 0:
        follow(tree, q)
    if not floating:
        return
    for index in range(nodes.shape[0]):
        k = nodes[index]
        if kind[k] < BALL:
            continue
        a, v = qadr[k], vadr[k]
        if kind[k] == FREE:
            for i in range(3):
                q[a + i] += dq[v + i]
            a, v = a + 3, v + 3
        turn_quat(q, a, dq[v], dq[v + 1], dq[v + 2])
    clip(tree, nodes, q)


@pure
def room(tree, goal, work):
    """How far each degree of freedom may still go from work.q: work.low <= step <= work.high.

    In units of the step, which ``apply_step`` shortens for stiff joints.
    """
    kind, qadr, dof_node, lower, upper = tree.kind, tree.qadr, tree.dof_node, tree.lower, tree.upper
    dofs, ease, q, low, high = goal.dofs, goal.ease, work.q, work.low, work.high
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            a = qadr[k]
            low[u] = min(lower[v] - q[a], 0.0) / ease[u]
            high[u] = max(upper[v] - q[a], 0.0) / ease[u]
        else:
            # A ball's cone is kept by projection after the step; here a step stays below half a turn.
            low[u] = -3.0
            high[u] = 3.0


@pure
def finite(q):
    """Whether all numbers are."""
    size = 0.0
    for i in range(q.shape[0]):
        size = max(size, abs(q[i])) if q[i] == q[i] else math.inf
    return size < math.inf
