"""FABRIK: forward and backward reaching over joint positions, on trees of real joints.

Aristidou & Lasenby, FABRIK: A fast, iterative solver for the inverse kinematics problem, Graphical Models
73(5), 2011, algorithm 1 and section 4.2.  Reaching forward, each joint rotates about its real axis inside its
limits to where its bone comes nearest to its target.  Hinges also weigh the goal itself a little (``pull``,
ours): a target contains no error across a hinge's bone.  See ``docs/reference/solvers/fabrik.md``.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.kernels import workspace as ws
from robot_ik.kernels.bones import (
    distance,
    has_orientation,
    link_points,
    locate_all,
    offset,
    open_bones,
    settle,
    side_off_line,
)
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE, open_tree
from robot_ik.kernels.vectors import apply, apply_back, cross, minus, over, plus, put, scaled, three
from robot_ik.solvers.legacy_base import option, options_of
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
        0.1, "hinges: weight of the goal beside the targets of points", low=0.0, high=10.0, usual=(0.0, 1.0)
    )
    sweeps: int = option(3, "rounds over joints that share an anchor", low=1, high=100, usual=(1, 10))
    kick: float = option(
        0.1, "how far a straight chain is bent before it reaches inwards", low=0.0, high=1.0, unit="bones",
        usual=(0.0, 0.5),
    )  # fmt: skip

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
def pulled_position(tree, bones, k, c):
    """Where point ``c``, at its target, pulls node ``k``."""
    target, here = three(bones.target, c, 0), three(bones.now, k, 0)
    gap = distance(bones.now, k, bones.target, c)
    if tree.kind[k] == SLIDE or not gap > 1e-12:  # a slide cannot rotate: it comes along as it is
        return minus(plus(target, here), three(bones.now, c, 0))
    return plus(target, scaled(bones.length[c] / gap, minus(here, target)))


@pure
def posed_position(goal, bones, k, g):
    """Where node ``k`` stands when the frame of goal ``g`` has the wanted pose."""
    local = goal.local
    # R_target · R_localᵀ is the node's wanted rotation.
    there = -local[g, 0], -local[g, 1], bones.shift[k] - local[g, 2]
    return plus(three(goal.target, g, 0), apply(goal.target, g, 3, apply_back(local, g, 3, there)))


@outlined
def reach_back(tree, goal, work, bones):
    """Targets of all points, from the goals towards the roots."""
    n = tree.parent.shape[0]
    for index in range(work.nodes.shape[0] - 1, -1, -1):
        k, wanted = work.nodes[index], (0.0, 0.0, 0.0)
        c = bones.first[k]
        while c >= 0:
            share = bones.share[c] / bones.share[k] if bones.share[k] > 0.0 else 0.0
            if share > 0.0 and c >= n and has_orientation(goal, c - n):
                wanted = plus(wanted, scaled(share, posed_position(goal, bones, k, c - n)))
            elif share > 0.0:
                wanted = plus(wanted, scaled(share, pulled_position(tree, bones, k, c)))
            c = bones.next[c]
        put(bones.target, k, wanted)


@pure
def root_of(bones, tip):
    """Where the chain of a tip begins, and its length stretched out."""
    root, whole = tip, 0.0
    while bones.up[root] >= 0:
        whole += bones.length[root]
        root = bones.up[root]
    return root, whole


@outlined
def bend(tree, goal, work, bones, kick):
    """Bends every chain that is straight with its goal on its line; returns whether a goal is too far.

    A straight chain has no side to bend to, and would stay straight for ever.
    """
    n, too_far = tree.parent.shape[0], False
    for g in range(goal.kind.shape[0]):
        tip = n + g
        root, whole = root_of(bones, tip)
        end = bones.target
        far = distance(bones.target, tip, bones.now, root)
        if far >= whole * (1.0 - _STRETCHED):
            too_far = True
            continue
        if far < 1e-9 * whole:  # the goal is at the root: the line is the chain's own
            end = bones.now
            far = distance(bones.now, tip, bones.now, root)
            if far < 1e-9 * whole:
                continue
        line = over(offset(end, tip, bones, root), far)
        k, off = tip, 0.0
        while k != root:
            x, y, z = cross(line, offset(bones.now, k, bones, root))
            off = max(off, abs(x), abs(y), abs(z))
            k = bones.up[k]
        if off < _STRAIGHT * whole:
            push_off_line(tree, work.world, bones, root, tip, line, kick)
    return too_far


@outlined
def push_off_line(tree, world, bones, root, tip, line, kick):
    """Moves the points between root and tip off their line, to where their hinges can go."""
    k = bones.up[tip]
    while k >= 0 and k != root:
        side = side_off_line(tree, world, k, k, line)
        put(bones.now, k, plus(three(bones.now, k, 0), scaled(kick * bones.length[k], side)))
        k = bones.up[k]


@outlined
def straighten(tree, bones):
    """Targets of a single chain on the line from its root to its goal, bone after bone."""
    tip = tree.parent.shape[0]
    root, away = root_of(bones, tip)
    far = distance(bones.target, tip, bones.now, root)
    origin, line = three(bones.now, root, 0), offset(bones.target, tip, bones, root)
    k = tip
    while k != root:
        put(bones.target, k, plus(origin, scaled(away / far, line)))
        away -= bones.length[k]
        k = bones.up[k]


@outlined
def lacks_wrist(tree, goal, bones):
    """Whether some goal asks for an orientation that the joints at its end cannot take by themselves."""
    for g in range(goal.kind.shape[0]):
        k, freedoms = goal.node[g], 0
        if k < 0 or not has_orientation(goal, g):
            continue
        while k >= 0:
            freedoms += 3 if tree.kind[k] in (BALL, FREE) else (1 if tree.kind[k] == HINGE else 0)
            if bones.length[k] > _NO_BONE:
                break
            k = bones.up[k]
        if freedoms < 3:
            return True
    return False


@outlined
def fabrik_step(tree, goal, work, bones, options):
    """Back from the goals, forward from the root; leaves q moved."""
    n = tree.parent.shape[0]
    if work.state[ws.ANY_UNREACHABLE] == 1:  # which goals count may have changed
        link_points(tree, goal, work.nodes, bones)
    for g in range(goal.kind.shape[0]):
        put(bones.target, n + g, three(goal.target, g, 0))
    locate_all(tree, goal, work, bones)
    bones.pull[1] = bones.pull[0] if lacks_wrist(tree, goal, bones) else 0.0
    too_far = bend(tree, goal, work, bones, options.kick)
    reach_back(tree, goal, work, bones)
    if too_far and goal.kind.shape[0] == 1 and work.state[ws.TRY_STEPS] == 0:
        straighten(tree, bones)
    settle(tree, goal, work, bones, options.sweeps)


@kernel
def fabrik(tree, goals, work, options, bones):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), ws.open_work(work)
    options = open_options(options)
    bones = open_bones(bones)
    link_points(tree, goal, work.nodes, bones)
    work.step[:] = 0.0
    bones.pull[0] = options.pull
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        fabrik_step(tree, goal, work, bones, options)
        advance(tree, goal, work)
