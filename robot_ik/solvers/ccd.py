"""Cyclic coordinate descent: each joint in turn moves to its exact optimum inside its limits.

A rotation about an axis changes the cost to const − A cos φ − B sin φ, so the best angle is
atan2(B, A), for positions, orientations and any mixture on all frames that the joint moves. A slide
has a parabola instead. Wang & Chen, A combined optimization method for solving the inverse
kinematics problem of mechanical manipulators, IEEE Trans. Robotics and Automation 7(4), 1991.

With ``axis="free"`` a joint is a free bone: it rotates about (s − p) × (t − p) by the angle between
the two vectors, with s the frame, t its target and p the joint, and then returns inside its limits.
A hinge takes the part of that rotation about its own axis. Pađen 2011; Šimunić 2012, section 3.5.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.goals import Goal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.kernels import so3
from robot_ik.kernels.alignment import (
    NO_VECTORS,
    add_axes,
    add_vector,
    best_angle,
    moment,
    rotation_terms,
)
from robot_ik.kernels.block import Layout
from robot_ik.kernels.bones import move_frame
from robot_ik.kernels.frame_goals import NO_ORIENTATION, NO_POSITION
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import clip, dof_axis, forward, integrate, width_of
from robot_ik.kernels.search import advance, begin, proceed, step_bounds
from robot_ik.kernels.tree import BALL
from robot_ik.solvers.iterative import IterativeSolver, run_layout
from robot_ik.solvers.options import option, options_layout

# A shorter Σ w² (s − p) × (t − p) has no direction: the vectors are collinear. The bone stays.
_COLLINEAR = 1e-12


@dataclass(frozen=True)
class CyclicCoordinateDescent(IterativeSolver):
    """Each step is a sweep over all joints; robust, with cheap steps, slow near the solution."""

    first_steps: int = option(
        400, "sweeps granted to the descent from the start", lower=1, upper=100_000
    )
    random_steps: int = option(
        300, "sweeps granted to a descent from a random point", lower=1, upper=100_000
    )
    patience: int = option(20, "sweeps without progress that end a descent", lower=1, upper=1000)
    progress: float = option(
        0.02, "smallest drop of the cost that counts as progress", lower=0.0, upper=1.0
    )
    axis: str = option(
        "joint", "axis of a rotation: of the joint, or of a free bone", choices=("joint", "free")
    )

    name: ClassVar[str] = "ccd"
    title: ClassVar[str] = "cyclic coordinate descent, exact optimum of one joint at a time"
    source: ClassVar[str] = "Wang & Chen, IEEE T-RA 1991"
    default_restarts: ClassVar[int] = 20
    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal, OrientationGoal, PoseGoal)
    # A sweep cannot be shortened. After an undo the next sweep would be the same.
    polish_undoes_steps: ClassVar[bool] = False


OPTIONS = options_layout(CyclicCoordinateDescent)

WORK = Layout(
    "CcdWork",
    node="ints 1",  # list of nodes for the forward pass of one joint
    lower="floats u",
    upper="floats u",
)

RUN = run_layout("CcdRun", WORK, OPTIONS)
open_run = RUN.open


# The best motion of one joint


@outlined
def correlation_of_goals(goals, search, k, u):
    """Return the correlation of the goals that column ``u`` of node ``k`` moves (``alignment``)."""
    correlation = NO_VECTORS
    anchor = so3.read_vector(search.world, k, 0)
    for g in range(goals.row.shape[0]):
        if goals.moves[g, u] == 0:
            continue
        if goals.position_part[g] != NO_POSITION:
            weight = search.weight[g, 0] * search.weight[g, 0]
            target = so3.subtract(so3.read_matrix_point(search.target, g), anchor)
            vector = so3.subtract(so3.read_vector(search.frames, g, 0), anchor)
            correlation = add_vector(correlation, weight, target, vector)
        if goals.orientation_part[g] != NO_ORIENTATION:
            weight = search.weight[g, 1] * search.weight[g, 1]
            target_rotation = so3.read_matrix_rotation(search.target, g)
            rotation = so3.read_rotation(search.frames, g)
            correlation = add_axes(correlation, weight, target_rotation, rotation)
    return correlation


@inlined
def best_shift(goals, search, axis, u, lower, upper):
    """Return the shift along ``axis`` in [lower, upper] that minimises the weighted distances."""
    wanted = 0.0
    total = 0.0
    for g in range(goals.row.shape[0]):
        if goals.moves[g, u] == 0 or goals.position_part[g] == NO_POSITION:
            continue
        weight = search.weight[g, 0] * search.weight[g, 0]
        target = so3.read_matrix_point(search.target, g)
        error = so3.subtract(target, so3.read_vector(search.frames, g, 0))
        total += weight
        wanted += weight * so3.dot(axis, error)
    if total <= 0.0:
        return 0.0
    return min(max(wanted / total, lower), upper)


@inlined
def free_rotation(correlation):
    """Return axis and angle of the best rotation about the free axis.

    For one position that is the axis (s − p) × (t − p) and the angle between the two vectors.
    """
    axis = moment(correlation)
    length = so3.norm(axis)
    if not length > _COLLINEAR:
        return axis, 0.0
    axis = so3.scale(1.0 / length, axis)
    a_term, b_term = rotation_terms(correlation, axis)
    return axis, math.atan2(b_term, a_term)


@outlined
def rotate_freely(tree, goals, search, work, u, correlation):
    """Write the free rotation of column ``u``, for a ball of its three columns, to search.step."""
    v = goals.dofs[u]
    k = tree.dof_node[v]
    axis, angle = free_rotation(correlation)
    if tree.kind[k] >= BALL:
        for i in range(3):
            x, y, z, _ = dof_axis(tree.kind, search.world, k, v - tree.vadr[k] + i)
            search.step[u + i] = angle * so3.dot(axis, (x, y, z))
        return
    # The twist about the hinge (swing-twist decomposition), as far as the limits allow.
    x, y, z, _ = dof_axis(tree.kind, search.world, k, v - tree.vadr[k])
    along = so3.dot(axis, (x, y, z))
    twist = 2.0 * math.atan2(math.sin(0.5 * angle) * along, math.cos(0.5 * angle))
    search.step[u] = min(max(twist, work.lower[u]), work.upper[u])


# A sweep


@outlined
def move_joint(tree, goals, search, work, u):
    """Move the node of column ``u`` by its part of search.step, and the frames that it carries."""
    v = goals.dofs[u]
    k = tree.dof_node[v]
    q = search.q
    point = so3.read_vector(search.world, k, 0)
    rotation = so3.read_rotation(search.world, k)
    first = tree.vadr[k]
    work.node[0] = k
    if tree.kind[k] < BALL:
        a = tree.qadr[k]
        q[a] = min(max(q[a] + search.step[u], tree.lower[first]), tree.upper[first])
    else:
        for i in range(width_of(tree.kind[k])):
            search.dq[first + i] = search.step[u - (v - first) + i]
        integrate(tree, work.node, q, search.dq)
        clip(tree, work.node, q)
    forward(tree, work.node, q, search.world, search.scratch)
    for g in range(goals.row.shape[0]):
        if goals.moves[g, u] == 1:
            move_frame(search, k, point, rotation, g)


@outlined
def sweep(tree, goals, search, work, rotates_freely):
    """Move each degree of freedom once, tip to root. Leaves search.step zero.

    A rotation moves all that the joint carries as one body. So only the frames of the goals move
    with it: the poses of the joints nearer to the root do not change.
    """
    step = search.step
    columns = goals.dofs.shape[0]
    step_bounds(tree, goals, search.q, work.lower, work.upper)
    for u in range(columns):
        step[u] = 0.0
    for u in range(columns - 1, -1, -1):
        v = goals.dofs[u]
        k = tree.dof_node[v]
        index = v - tree.vadr[k]
        x, y, z, rotational = dof_axis(tree.kind, search.world, k, index)
        if not rotational:
            step[u] = best_shift(goals, search, (x, y, z), u, work.lower[u], work.upper[u])
        elif rotates_freely and tree.kind[k] >= BALL and index % 3 != 0:
            continue  # moved with the first of its three columns
        else:
            correlation = correlation_of_goals(goals, search, k, u)
            if rotates_freely:
                rotate_freely(tree, goals, search, work, u, correlation)
            else:
                a_term, b_term = rotation_terms(correlation, (x, y, z))
                step[u] = best_angle(a_term, b_term, work.lower[u], work.upper[u])
        move_joint(tree, goals, search, work, u)
        for i in range(u, min(u + 3, columns)):
            step[i] = 0.0


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    begin(run.tree, run.goals, run.search)
    while proceed(run.tree, run.goals, run.search):
        sweep(run.tree, run.goals, run.search, run.work, run.options.axis == 1)
        advance(run.tree, run.goals, run.search)
