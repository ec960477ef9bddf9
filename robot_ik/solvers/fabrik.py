"""FABRIK: forward and backward reaching over joint positions, on trees of hinges, slides and balls.

Aristidou & Lasenby, FABRIK: A fast, iterative solver for the inverse kinematics problem, Graphical
Models 73(5), 2011, algorithm 1 and section 4.2. Reaching forward, each joint rotates about its axis
inside its limits until its bone is nearest to its target. Hinges also have a weight on the goal
itself (``pull``, an addition of this library), because the target of a point contains no error
across the bone of a hinge.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.kernels import so3
from robot_ik.kernels.bones import (
    BONES,
    clear_step,
    distance,
    has_orientation,
    link_points,
    locate_all,
    offset,
    settle,
    side_of_line,
)
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.search import advance, begin, proceed
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.solvers.bone_solver import BoneSolver
from robot_ik.solvers.iterative import run_layout
from robot_ik.solvers.options import option, options_layout

# A chain is straight if no point is farther from its line than this share of its length.
_STRAIGHT = 1e-6
# Displacement of the points of a straight chain that must bend, as a share of each bone. Any small
# share works, because the next passes are exact.
_BEND = 0.1
# A goal at this share of the full length of a chain, or beyond, stretches the chain in one pass.
# Otherwise the passes would approach it without end.
_STRETCHED = 1.0 - 1e-9
# A goal at this share of the length from the root has no direction.
_AT_ROOT = 1e-9
# Two points nearer than this, in metres, have no direction between them.
_COINCIDENT = 1e-12
# Joints whose anchors are nearer than this, in metres, share one anchor.
_NO_BONE = 1e-6


@dataclass(frozen=True)
class Fabrik(BoneSolver):
    """Each step reaches back from the goals and forward from the root."""

    first_steps: int = option(
        200, "passes granted to the descent from the start", lower=1, upper=100_000
    )
    random_steps: int = option(
        100, "passes granted to a descent from a random point", lower=1, upper=100_000
    )
    patience: int = option(10, "passes without progress that end a descent", lower=1, upper=1000)
    progress: float = option(
        0.02, "smallest drop of the cost that counts as progress", lower=0.0, upper=1.0
    )
    pull: float = option(
        0.1,
        "weight of the goal for hinges, beside the targets of points",
        lower=0.0,
        upper=10.0,
        usual=(0.0, 1.0),
    )
    sweeps: int = option(
        3, "sweeps over joints that share an anchor", lower=1, upper=100, usual=(1, 10)
    )

    name: ClassVar[str] = "fabrik"
    title: ClassVar[str] = "forward and backward reaching, on trees of real joints"
    source: ClassVar[str] = "Aristidou & Lasenby, Graphical Models 2011, algorithm 1 and section 4"
    default_restarts: ClassVar[int] = 50
    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal, PoseGoal)
    joint_kinds: ClassVar[tuple[int, ...]] = (HINGE, SLIDE, BALL, FREE)
    several_goals: ClassVar[bool] = True


OPTIONS = options_layout(Fabrik)
WORK = BONES
RUN = run_layout("FabrikRun", WORK, OPTIONS)
open_run = RUN.open


# Backward


@inlined
def pulled_point(tree, bones, k, c):
    """Return the position to which point ``c``, at its target, pulls node ``k``."""
    target = so3.read_vector(bones.target, c, 0)
    point = so3.read_vector(bones.point, k, 0)
    gap = distance(bones.target, c, bones, k)
    if tree.kind[k] == SLIDE or not gap > _COINCIDENT:  # a slide cannot rotate
        return so3.subtract(so3.add(target, point), so3.read_vector(bones.point, c, 0))
    return so3.add(target, so3.scale(bones.length[c] / gap, so3.subtract(point, target)))


@inlined
def posed_point(goals, search, bones, k, g):
    """Return the position of node ``k`` when the frame of goal ``g`` has its target pose."""
    # The rotation of the node is then R_target R_localᵀ.
    local = so3.read_vector(goals.local, g, 0)
    from_frame = -local[0], -local[1], bones.shift[k] - local[2]
    local_rotation = so3.read_rotation(goals.local, g)
    target_rotation = so3.read_matrix_rotation(search.target, g)
    lever = so3.apply(target_rotation, so3.apply_inverse(local_rotation, from_frame))
    return so3.add(so3.read_matrix_point(search.target, g), lever)


@outlined
def reach_back(tree, goals, search, bones):
    """Write the targets of all points, from the goals towards the roots.

    A point with several children moves to the weighted mean of the positions to which they pull it.
    """
    nodes = tree.parent.shape[0]
    for index in range(goals.nodes.shape[0] - 1, -1, -1):
        k = goals.nodes[index]
        target = (0.0, 0.0, 0.0)
        c = bones.child[k]
        while c >= 0:
            share = bones.share[c] / bones.share[k] if bones.share[k] > 0.0 else 0.0
            if share > 0.0:
                if c >= nodes and has_orientation(goals, search, c - nodes):
                    pulled = posed_point(goals, search, bones, k, c - nodes)
                else:
                    pulled = pulled_point(tree, bones, k, c)
                target = so3.add(target, so3.scale(share, pulled))
            c = bones.sibling[c]
        so3.write_row(bones.target, k, target)


# Straight chains


@inlined
def root_of(bones, tip):
    """Return the first point of the chain of a tip, and the length of the chain."""
    root = tip
    length = 0.0
    while bones.parent[root] >= 0:
        length += bones.length[root]
        root = bones.parent[root]
    return root, length


@outlined
def bend_straight_chains(tree, goals, search, bones):
    """Bend each chain that is straight with its goal on its line; return if a goal is too far.

    For such a chain no direction of bending is defined, so it would stay straight.
    """
    nodes = tree.parent.shape[0]
    too_far = False
    for g in range(goals.row.shape[0]):
        tip = nodes + g
        root, length = root_of(bones, tip)
        reach = distance(bones.target, tip, bones, root)
        if reach >= length * _STRETCHED:
            too_far = True
            continue
        end = offset(bones.target, tip, bones, root)
        if reach < _AT_ROOT * length:  # then the line is that of the chain
            end = offset(bones.point, tip, bones, root)
            reach = so3.norm(end)
        if reach < _AT_ROOT * length:
            continue
        line = so3.scale(1.0 / reach, end)
        if is_straight(bones, root, tip, line, length):
            push_off_line(tree, search.world, bones, root, tip, line)
    return too_far


@inlined
def is_straight(bones, root, tip, line, length):
    """Return whether all points from ``root`` to ``tip`` are on a line through ``root``."""
    largest = 0.0
    k = tip
    while k != root:
        x, y, z = so3.cross(line, offset(bones.point, k, bones, root))
        largest = max(max(largest, abs(x)), max(abs(y), abs(z)))
        k = bones.parent[k]
    return largest < _STRAIGHT * length


@outlined
def push_off_line(tree, world, bones, root, tip, line):
    """Move the points between ``root`` and ``tip`` off their line, as far as their hinges allow."""
    k = bones.parent[tip]
    while k >= 0 and k != root:
        side = side_of_line(tree, world, k, k, line)
        shifted = so3.add(
            so3.read_vector(bones.point, k, 0), so3.scale(_BEND * bones.length[k], side)
        )
        so3.write_row(bones.point, k, shifted)
        k = bones.parent[k]


@outlined
def stretch_to_goal(tree, bones):
    """Write targets of a single chain on the line from its root to its goal."""
    tip = tree.parent.shape[0]
    root, along = root_of(bones, tip)
    origin = so3.read_vector(bones.point, root, 0)
    line = offset(bones.target, tip, bones, root)
    reach = so3.norm(line)
    k = tip
    while k != root:
        so3.write_row(bones.target, k, so3.add(origin, so3.scale(along / reach, line)))
        along -= bones.length[k]
        k = bones.parent[k]


# One pass


@outlined
def lacks_wrist(tree, goals, search, bones):
    """Return whether the last joints before some goal cannot produce its orientation alone."""
    for g in range(goals.row.shape[0]):
        k = goals.node[g]
        if k < 0 or not has_orientation(goals, search, g):
            continue
        freedoms = 0
        while k >= 0:
            if tree.kind[k] == HINGE:
                freedoms += 1
            elif tree.kind[k] != SLIDE:
                freedoms += 3
            if bones.length[k] > _NO_BONE:
                break
            k = bones.parent[k]
        if freedoms < 3:
            return True
    return False


@outlined
def fabrik_step(tree, goals, search, bones, options):
    """Move q by one pass: back from the goals, forward from the root."""
    nodes = tree.parent.shape[0]
    if bones.reduced != search.reduced:
        link_points(tree, goals, search, bones)
    for g in range(goals.row.shape[0]):
        so3.write_row(bones.target, nodes + g, so3.read_matrix_point(search.target, g))
    locate_all(tree, goals, search, bones)
    bones.ball_pull = options.pull if lacks_wrist(tree, goals, search, bones) else 0.0
    too_far = bend_straight_chains(tree, goals, search, bones)
    reach_back(tree, goals, search, bones)
    if too_far and goals.row.shape[0] == 1 and search.steps == 0:
        stretch_to_goal(tree, bones)
    settle(tree, goals, search, bones, options.sweeps)


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    bones = run.work
    begin(run.tree, run.goals, run.search)
    link_points(run.tree, run.goals, run.search, bones)
    clear_step(run.search)
    bones.hinge_pull = run.options.pull
    while proceed(run.tree, run.goals, run.search):
        fabrik_step(run.tree, run.goals, run.search, bones, run.options)
        advance(run.tree, run.goals, run.search)
