"""Levenberg-Marquardt with joint limits as constraints of each step: the default numeric method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.linalg import box_step
from robot_ik.kernels.loop import (
    ACCEPTED,
    BLOCKED,
    COST,
    DAMPING,
    PRESSED,
    STALLED,
    STATUS,
    TRY_STEPS,
    advance,
    begin,
    proceed,
    unpack,
)
from robot_ik.kernels.residuals import goal_jacobian
from robot_ik.kernels.tree import BALL


@pure
def normal_equations(jacobian, residual, normal, gradient):  # type: ignore[no-untyped-def]
    """normal = JᵀJ (lower triangle), gradient = Jᵀr."""
    rows, n = jacobian.shape
    for i in range(n):
        s = 0.0
        for r in range(rows):
            s += jacobian[r, i] * residual[r]
        gradient[i] = s
        for j in range(i + 1):
            s = 0.0
            for r in range(rows):
                s += jacobian[r, i] * jacobian[r, j]
            normal[i, j] = s


@pure
def room(kind, qadr, dof_node, lower, upper, dofs, q, low, high):  # type: ignore[no-untyped-def]
    """How far each degree of freedom may still go from q: low <= step <= high, each (nu,)."""
    for u in range(dofs.shape[0]):
        v = dofs[u]
        k = dof_node[v]
        if kind[k] < BALL:
            low[u] = min(lower[v] - q[qadr[k]], 0.0)
            high[u] = max(upper[v] - q[qadr[k]], 0.0)
        else:
            # A ball's cone is kept by projection after the step; here a step stays below half a turn.
            low[u] = -3.0
            high[u] = 3.0


@pure
def lm_step(tree, goal, work, options):  # type: ignore[no-untyped-def]
    """One damped Gauss-Newton step inside the limits; a step that made things worse is taken back first."""
    state, value = work.state, work.value
    n = work.gradient.shape[0]
    if value[COST] < value[ACCEPTED]:
        value[DAMPING] = options[1] if state[TRY_STEPS] == 0 else max(value[DAMPING] * options[3], options[4])
        value[ACCEPTED] = value[COST]
        for i in range(work.q.shape[0]):
            work.accepted[i] = work.q[i]
        goal_jacobian(
            tree.kind, tree.vadr, tree.dof_node, work.world, goal, work.frames, work.residual,
            work.jacobian,
        )  # fmt: skip
        normal_equations(work.jacobian, work.residual, work.normal, work.gradient)
    else:
        value[DAMPING] *= options[2]
        value[COST] = value[ACCEPTED]
        for i in range(work.q.shape[0]):
            work.q[i] = work.accepted[i]
    damping = value[DAMPING] * value[COST] + options[0]
    for i in range(n):
        for j in range(i):
            work.damped[i, j] = work.normal[i, j]
        work.damped[i, i] = work.normal[i, i] + damping
    room(
        tree.kind, tree.qadr, tree.dof_node, tree.lower, tree.upper, goal.dofs, work.q, work.low, work.high
    )
    pressed = box_step(
        work.damped, work.gradient, work.low, work.high, work.step, work.rhs, work.free, work.factor
    )
    if pressed < 0:  # not positive definite to working precision: more damping
        value[DAMPING] = value[DAMPING] * options[2] + 1e-9
        for i in range(n):
            work.step[i] = 0.0
    else:
        state[PRESSED] = pressed


@outlined
def descend(tree, goal, work, options):  # type: ignore[no-untyped-def]
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        lm_step(tree, goal, work, options)
        advance(tree, goal, work)


@kernel
def lm(tree, goals, work, options):  # type: ignore[no-untyped-def]
    """Runs until ``proceed`` says stop; options: floor, start, increase, decrease, least."""
    arrays, goal, space = unpack(tree, goals, work)
    descend(arrays, goal, space, options)
