"""Cyclic coordinate descent: one joint at a time, each to its exact optimum inside its limits.

A rotation about an axis changes both parts of the cost to const − A cos φ − B sin φ, so the best angle is
atan2(B, A), for positions, orientations and any mixture on any frames the joint moves; a shift has a parabola
(Wang & Chen, A combined optimization method for solving the inverse kinematics problem of mechanical
manipulators, IEEE T-RA 7(4), 1991).  ``axis="free"`` is the textbook form: each bone rotates about
(s − p) × (t − p) by the angle between the two, and is put back inside its limits (Pađen 2011; Šimunić 2012,
section 3.5); a hinge takes the part of that rotation about its own axis.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.kernels import bones
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import clip, dof_axis, forward, integrate, width_of
from robot_ik.kernels.loop import advance, begin, proceed, step_bounds
from robot_ik.kernels.residuals import ORIENTATION, POSITION, open_goals
from robot_ik.kernels.tree import BALL, open_tree
from robot_ik.kernels.vectors import dot, length, minus, over, three
from robot_ik.kernels.workspace import open_work
from robot_ik.solvers.legacy_base import IterativeSolver, option, options_of

ORDERS = ("tip_to_root", "root_to_tip")
AXES = ("joint", "free")
# Σ w² (s − p) × (t − p) shorter than this has no direction: the vectors are collinear, and the bone stays.
_COLLINEAR = 1e-12


@dataclass(frozen=True)
class CyclicCoordinateDescent(IterativeSolver):
    """One sweep over all joints a step; robust and cheap, slow in the last decimals."""

    restarts: int = option(20, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(400, "sweeps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(300, "sweeps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(20, "sweeps without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.02, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)

    order: str = option("tip_to_root", "which joint is moved first", choices=ORDERS)
    axis: str = option("joint", "real axes, or the one that a free bone would take", choices=AXES)

    name: ClassVar[str] = "ccd"
    title: ClassVar[str] = "cyclic coordinate descent, exact optimum of one joint at a time"
    source: ClassVar[str] = "Wang & Chen, IEEE T-RA 1991"

    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal, OrientationGoal, PoseGoal)

    def kernel(self) -> Callable[..., None]:
        return ccd


open_options = options_of(CyclicCoordinateDescent)


@outlined
def aim_at_goals(world, k, goal, frames, u, sums):
    """Into ``sums`` (see ``bones.add_aim``), the frames that hang on node ``k``, and their targets."""
    target, origin = goal.target, three(world, k, 0)
    for i in range(bones.AIM_SUMS):
        sums[0, i] = 0.0
    for g in range(goal.kind.shape[0]):
        if goal.moves[g, u] == 0:
            continue
        if goal.kind[g] != ORIENTATION:
            w = goal.weight[g, 0] * goal.weight[g, 0]
            bones.add_aim(sums, w, minus(three(target, g, 0), origin), minus(three(frames, g, 0), origin))
        if goal.kind[g] != POSITION:
            # ‖R_t − R‖²/2 = 3 − Σ columns c·t, and each column rotates like a point.
            bones.add_columns(goal, frames, sums, 1.0, g)


@pure
def best_shift(axis, goal, frames, u, low, high):
    """The shift along ``axis`` in [low, high] that minimises the weighted distances."""
    wanted, total = 0.0, 0.0
    for g in range(goal.kind.shape[0]):
        if goal.moves[g, u] == 0 or goal.kind[g] == ORIENTATION:
            continue
        w = goal.weight[g, 0] * goal.weight[g, 0]
        total += w
        wanted += w * dot(axis, minus(three(goal.target, g, 0), three(frames, g, 0)))
    if total <= 0.0:
        return 0.0
    return min(max(wanted / total, low), high)


@outlined
def rotate_freely(tree, goal, work, u, sums):
    """work.step of a hinge, or of all three coordinates of a ball, for the best rotation about any axis.

    For one position that axis is (s − p) × (t − p) and the angle that between the two.
    """
    v, angle = goal.dofs[u], 0.0
    k, axis = tree.dof_node[v], bones.free_axis(sums)
    norm = length(axis)
    if norm > _COLLINEAR:
        axis = over(axis, norm)
        a, b = bones.rotation_terms(sums, axis)
        angle = math.atan2(b, a)
    ax, ay, az, _ = dof_axis(tree.kind, work.world, k, v - tree.vadr[k])
    if tree.kind[k] < BALL:
        # The twist of the rotation about the hinge (swing-twist decomposition), as far as the limits allow.
        along = dot(axis, (ax, ay, az))
        twist = 2.0 * math.atan2(math.sin(0.5 * angle) * along, math.cos(0.5 * angle))
        work.step[u] = min(max(twist, work.low[u]), work.high[u])
        return
    for i in range(3):
        ax, ay, az, _ = dof_axis(tree.kind, work.world, k, v - tree.vadr[k] + i)
        work.step[u + i] = angle * dot(axis, (ax, ay, az))


@outlined
def move_joint(tree, goal, work, u, one, old):
    """Moves the node of column ``u`` by its part of work.step, and the frames that hang on it with it.

    ``one`` (1,) holds the node, ``old`` (1, 12) is work space.
    """
    k, q, dq, step = one[0], work.q, work.dq, work.step
    a, v = tree.qadr[k], tree.vadr[k]
    bones.store_pose(work.world, k, old)
    if tree.kind[k] < BALL:
        q[a] = min(max(q[a] + step[u], tree.lower[v]), tree.upper[v])
    else:
        first = u - (goal.dofs[u] - v)
        for i in range(width_of(tree.kind[k])):
            dq[v + i] = step[first + i]
        integrate(tree, one, q, dq)
        clip(tree, one, q)
    forward(tree, one, q, work.world, work.scratch)
    for g in range(goal.kind.shape[0]):
        if goal.moves[g, u] == 1:
            bones.move_with_node(work.world, k, old, work.frames, g)


@outlined
def sweep(tree, goal, work, from_root, freely, one, old, sums):
    """Every degree of freedom once; leaves q moved and work.step zero.

    A rotation moves all that hangs on the joint as one body, so only the goals' frames come along: poses of
    joints nearer to the root do not change, and those of the others are found when it is their turn.
    """
    dofs, step, low, high, world, frames = goal.dofs, work.step, work.low, work.high, work.world, work.frames
    n = dofs.shape[0]
    step_bounds(tree, goal, work)
    for u in range(n):
        step[u] = 0.0
    for index in range(n):
        u = index if from_root else n - 1 - index
        v = dofs[u]
        k = tree.dof_node[v]
        one[0] = k
        if from_root:
            forward(tree, one, work.q, world, work.scratch)
        x, y, z, rotational = dof_axis(tree.kind, world, k, v - tree.vadr[k])
        if not rotational:
            step[u] = best_shift((x, y, z), goal, frames, u, low[u], high[u])
        elif freely and tree.kind[k] >= BALL and (v - tree.vadr[k]) % 3 != 0:
            continue  # rotated with the first of its three coordinates
        else:
            aim_at_goals(world, k, goal, frames, u, sums)
            if freely:
                rotate_freely(tree, goal, work, u, sums)
            else:
                a, b = bones.rotation_terms(sums, (x, y, z))
                step[u] = bones.best_angle(a, b, low[u], high[u])
        move_joint(tree, goal, work, u, one, old)
        for i in range(u, min(u + 3, n)):
            step[i] = 0.0


@kernel
def ccd(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    from_root, freely = options.order > 0, options.axis > 0
    one, old, sums = np.empty(1, dtype=np.int64), np.empty((1, 12)), np.empty((1, bones.AIM_SUMS))
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        sweep(tree, goal, work, from_root, freely, one, old, sums)
        advance(tree, goal, work)
