"""FABRIK: forward and backward reaching over joint positions, on trees of real joints.

Reaching back, each goal pulls its bones from the tip towards the root: a joint's target is the point at
bone's length from the next joint's target, on the line to where it stands (Aristidou & Lasenby, FABRIK: A
fast, iterative solver for the inverse kinematics problem, Graphical Models 73(5), 2011, algorithm 1); at a
sub-base the targets of its branches are averaged (section 4.2).  Reaching forward puts the root back and
lets the joints follow, root to tip, each rotating about its real axis inside its limits to where its bone
comes nearest to its target; on a chain of unlimited balls that is the paper's second half to the letter.

A pose goal fixes the last node: its anchor's target is where the goal's pose puts it, and the joints whose
anchors meet there (a ball, a spherical wrist, the last hinge of a planar arm) take the orientation.

A target contains no error across a hinge's bone, and hinges whose axes are not parallel would wait
for each other; so hinges also weigh the goal itself a little (``pull``, ours), and so do balls where the last
joints cannot take the orientation by themselves.  Near the full reach of a chain progress is slow.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.bones import (
    BALL_PULL,
    DESCENDANTS,
    FIRST,
    LENGTH,
    NEXT,
    NOW,
    POINT_COLUMNS,
    PULL,
    SHARE,
    SHIFT,
    SUM_SIZE,
    TARGET,
    UP,
    across,
    distance,
    has_orientation,
    link_points,
    locate_all,
    mark_descendants,
    settle,
)
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE, open_tree
from robot_ik.solvers.base import option, options_of
from robot_ik.solvers.families import BoneSolver

# A chain is straight when no point is farther than this share of its length from the line to the target.
_STRAIGHT = 1e-6
# A goal this near to the full length of the chain, as a share of it, is at it: reaching would take for ever.
_STRETCHED = 1e-9
# Anchors nearer than this, metres, are one.
_NO_BONE = 1e-6


@dataclass(frozen=True)
class Fabrik(BoneSolver):
    """One step reaches back from the goals and forward from the root."""

    restarts: int = option(50, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(200, "passes granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(100, "passes granted to a try from a random point", low=1, high=100_000)
    patience: int = option(10, "passes without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.02, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    pull: float = option(
        0.1,
        "hinges: weight of the goal beside the targets of points",
        low=0.0,
        high=10.0,
        usual=(0.0, 1.0),
    )
    sweeps: int = option(3, "rounds over joints that share an anchor", low=1, high=100, usual=(1, 10))
    kick: float = option(
        0.1,
        "how far a straight chain is bent before it reaches inwards",
        low=0.0,
        high=1.0,
        unit="bones",
        usual=(0.0, 0.5),
    )

    name: ClassVar[str] = "fabrik"
    title: ClassVar[str] = "forward and backward reaching, on trees of real joints"
    source: ClassVar[str] = "Aristidou & Lasenby, Graphical Models 2011, algorithm 1 and section 4"
    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal, PoseGoal)
    kinds: ClassVar[tuple[int, ...]] = (HINGE, SLIDE, BALL, FREE)
    several: ClassVar[bool] = True

    def kernel(self) -> Callable[..., None]:
        return fabrik


open_options = options_of(Fabrik)


@pure
def pulled_position(tree, goal, points, k, c, i):
    """Coordinate ``i`` of where point ``c``, at its target, pulls node ``k``."""
    if tree.kind[k] == SLIDE:  # cannot rotate: comes along as it is
        return points[c, TARGET + i] + points[k, NOW + i] - points[c, NOW + i]
    gap = distance(points, k, NOW, c, TARGET)
    if gap > 1e-12:
        return points[c, TARGET + i] + points[c, LENGTH] / gap * (points[k, NOW + i] - points[c, TARGET + i])
    return points[c, TARGET + i] + points[k, NOW + i] - points[c, NOW + i]


@pure
def posed_position(goal, points, k, g, i):
    """Coordinate ``i`` of where node ``k`` stands when the frame of goal ``g`` has the wanted pose."""
    target, local = goal.target, goal.local
    result = target[g, i]
    for j in range(3):
        # Entry (i, j) of the node's wanted rotation, R_target · R_localᵀ.
        rotation_entry = 0.0
        for m in range(3):
            rotation_entry += target[g, 3 + 3 * i + m] * local[g, 3 + 3 * j + m]
        result += rotation_entry * ((points[k, SHIFT] if j == 2 else 0.0) - local[g, j])
    return result


@outlined
def reach_back(tree, goal, work, links, points):
    """Targets of all points, from the goals towards the roots."""
    n = tree.parent.shape[0]
    for index in range(work.nodes.shape[0] - 1, -1, -1):
        k = work.nodes[index]
        for i in range(3):
            points[k, TARGET + i] = 0.0
        c = links[k, FIRST]
        while c >= 0:
            share = points[c, SHARE] / points[k, SHARE] if points[k, SHARE] > 0.0 else 0.0
            if share > 0.0:
                fixed = c >= n and has_orientation(goal, c - n)
                for i in range(3):
                    target = (
                        posed_position(goal, points, k, c - n, i)
                        if fixed
                        else pulled_position(tree, goal, points, k, c, i)
                    )
                    points[k, TARGET + i] += share * target
            c = links[c, NEXT]


@outlined
def bend(tree, goal, work, links, points, kick):
    """Bends every chain that is straight with its goal on its line; returns whether a goal is too far.

    A straight chain has no side to bend to, and would stay straight for ever.
    """
    n, too_far = tree.parent.shape[0], False
    for g in range(goal.kind.shape[0]):
        tip = n + g
        root, length = tip, 0.0
        while links[root, UP] >= 0:
            length += points[root, LENGTH]
            root = links[root, UP]
        end, at = tip, TARGET
        far = distance(points, tip, TARGET, root, NOW)
        if far >= length * (1.0 - _STRETCHED):
            too_far = True
            continue
        if far < 1e-9 * length:  # the goal is at the root: the line is the chain's own
            at = NOW
            far = distance(points, tip, NOW, root, NOW)
            if far < 1e-9 * length:
                continue
        x = (points[end, at] - points[root, NOW]) / far
        y = (points[end, at + 1] - points[root, NOW + 1]) / far
        z = (points[end, at + 2] - points[root, NOW + 2]) / far
        k, off = tip, 0.0
        while k != root:
            dx = points[k, NOW] - points[root, NOW]
            dy = points[k, NOW + 1] - points[root, NOW + 1]
            dz = points[k, NOW + 2] - points[root, NOW + 2]
            off = max(off, abs(y * dz - z * dy), abs(z * dx - x * dz), abs(x * dy - y * dx))
            k = links[k, UP]
        if off < _STRAIGHT * length:
            push_off_line(tree, work.world, links, points, root, tip, x, y, z, kick)
    return too_far


@outlined
def push_off_line(tree, world, links, points, root, tip, x, y, z, kick):
    """Moves the points between root and tip off the line (x, y, z), to where their hinges can go."""
    ax, ay, az = across(x, y, z)
    k = links[tip, UP]
    while k >= 0 and k != root:
        sx, sy, sz = ax, ay, az
        if tree.kind[k] == HINGE:
            u, v, w = world[k, 5], world[k, 8], world[k, 11]
            hx, hy, hz = v * z - w * y, w * x - u * z, u * y - v * x
            norm = math.sqrt(hx * hx + hy * hy + hz * hz)
            if norm > 1e-6:
                sx, sy, sz = hx / norm, hy / norm, hz / norm
        s = kick * points[k, LENGTH]
        points[k, NOW] += s * sx
        points[k, NOW + 1] += s * sy
        points[k, NOW + 2] += s * sz
        k = links[k, UP]


@outlined
def straighten(tree, links, points):
    """Targets of a single chain on the line from its root to its goal, bone after bone."""
    tip = tree.parent.shape[0]
    root, length = tip, 0.0
    while links[root, UP] >= 0:
        length += points[root, LENGTH]
        root = links[root, UP]
    far = distance(points, tip, TARGET, root, NOW)
    x, y, z = points[tip, TARGET], points[tip, TARGET + 1], points[tip, TARGET + 2]
    k = tip
    while k != root:
        s = length / far
        points[k, TARGET] = points[root, NOW] + s * (x - points[root, NOW])
        points[k, TARGET + 1] = points[root, NOW + 1] + s * (y - points[root, NOW + 1])
        points[k, TARGET + 2] = points[root, NOW + 2] + s * (z - points[root, NOW + 2])
        length -= points[k, LENGTH]
        k = links[k, UP]


@outlined
def lacks_wrist(tree, goal, links, points):
    """Whether some goal asks for an orientation that the joints at its end cannot take by themselves."""
    for g in range(goal.kind.shape[0]):
        k, freedoms = goal.node[g], 0
        if k < 0 or not has_orientation(goal, g):
            continue
        while k >= 0:
            freedoms += 3 if tree.kind[k] in (BALL, FREE) else (1 if tree.kind[k] == HINGE else 0)
            if points[k, LENGTH] > _NO_BONE:
                break
            k = links[k, UP]
        if freedoms < 3:
            return True
    return False


@outlined
def fabrik_step(tree, goal, work, links, points, one, sums, options):
    """Back from the goals, forward from the root; leaves q moved."""
    n = tree.parent.shape[0]
    if work.state[ws.SEARCH] != ws.ALL_GOALS:  # which goals count may have changed
        link_points(tree, goal, work.nodes, links, points)
    for g in range(goal.kind.shape[0]):
        for i in range(3):
            points[n + g, TARGET + i] = goal.target[g, i]
    locate_all(tree, goal, work, links, points, one)
    sums[BALL_PULL] = sums[PULL] if lacks_wrist(tree, goal, links, points) else 0.0
    too_far = bend(tree, goal, work, links, points, options.kick)
    reach_back(tree, goal, work, links, points)
    if too_far and goal.kind.shape[0] == 1 and work.state[ws.TRY_STEPS] == 0:
        straighten(tree, links, points)
    settle(tree, goal, work, links, points, one, sums, options.sweeps)


@kernel
def fabrik(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), ws.open_work(work)
    options = open_options(options)
    count = tree.parent.shape[0] + goal.kind.shape[0]
    links = np.empty((count, DESCENDANTS + goal.kind.shape[0]), dtype=np.int64)
    points = np.empty((count, POINT_COLUMNS))
    one, sums = np.empty(1, dtype=np.int64), np.empty(SUM_SIZE)
    link_points(tree, goal, work.nodes, links, points)
    mark_descendants(goal, links)
    work.step[:] = 0.0
    sums[PULL] = options.pull
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        fabrik_step(tree, goal, work, links, points, one, sums, options)
        advance(tree, goal, work)
