"""The recursive method: the chain is pulled by its end like a chain of rings, or not moved at all.

From the tip, a bone that cannot reach the goal by rotating is moved there, and its other end becomes the goal
of the bone before it: on the circle where the spheres of both bones cut, else where the pull drags it.  On
failure q is, bit for bit, what it was (Aho, Implementation of articulated mechanisms in computer animation,
University of Helsinki 2000, section 4.3).  ``guard`` is ours; see ``docs/reference/solvers/recursive.md``.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robot_ik.kernels.bones import (
    chain_path,
    distance,
    inner_radius,
    link_points,
    locate_all,
    offset,
    open_bones,
    settle,
    third_side_angle,
)
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.kinematics import perpendicular
from robot_ik.kernels.loop import advance, begin, copy, measure, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.vectors import dot, length, minus, over, plus, put, scaled, three
from robot_ik.kernels.workspace import BEST_COST, open_work
from robot_ik.solvers.legacy_base import option, options_of
from robot_ik.solvers.families import BoneSolver

# Lengths that agree to this share of the chain are equal.
_EQUAL = 1e-10


@dataclass(frozen=True)
class Recursive(BoneSolver):
    """One step is one try, kept whole or undone whole."""

    restarts: int = option(0, "random starts to try from when the first fails", low=0, high=100_000)
    first_steps: int = option(1, "tries from the start", low=1, high=100_000)
    try_steps: int = option(1, "tries from a random point", low=1, high=100_000)
    patience: int = option(1, "tries in vain before a start is given up", low=1, high=1000)
    guard: bool = option(True, "drag bones only where the bones before them can follow", low=0, high=1)
    sweeps: int = option(10, "rounds over joints that share an anchor", low=1, high=100, usual=(1, 30))

    name: ClassVar[str] = "recursive"
    title: ClassVar[str] = "a chain of rings pulled by its end; undone whole where it fails"
    source: ClassVar[str] = "Aho, University of Helsinki 2000, section 4.3"

    def kernel(self) -> Callable[..., None]:
        return recursive


open_options = options_of(Recursive)


@pure
def intersect_spheres(bones, e, b, p, radius):
    """Target of ``b`` on the circle of the spheres about that of ``e`` (its bone) and ``p`` (``radius``).

    Of the circle's points, the one nearest to where ``b`` is.  Returns False when the spheres do not cut.
    """
    bone = bones.length[e]
    far = distance(bones.target, e, bones.now, p)
    if far > bone + radius or far < abs(bone - radius) or far == 0.0:
        return False
    line = over(offset(bones.target, e, bones, p), far)
    along = (far * far + radius * radius - bone * bone) / (2.0 * far)
    off = math.sqrt(max(0.0, radius * radius - along * along))
    here = offset(bones.now, b, bones, p)
    side = minus(here, scaled(dot(here, line), line))
    norm = length(side)
    side = over(side, norm) if norm > 1e-9 * far else perpendicular(line)
    put(bones.target, b, plus(plus(three(bones.now, p, 0), scaled(along, line)), scaled(off, side)))
    return True


@pure
def drag_bone(bones, e, b, root, low, high, guard):
    """Target of ``b`` at bone's length from that of ``e``, towards where it is, [low, high] from the root."""
    bone, end = bones.length[e], three(bones.target, e, 0)
    way = minus(three(bones.now, b, 0), end)
    norm = length(way)
    way = over(way, norm) if norm > 0.0 else (0.0, 0.0, 1.0)
    far = distance(bones.now, root, bones.target, e)
    if guard and far > 0.0 and bone > 0.0:
        back = over(minus(three(bones.now, root, 0), end), far)
        along = dot(way, back)
        side = minus(way, scaled(along, back))
        sine = length(side)
        angle = math.atan2(sine, along)
        allowed = min(max(angle, third_side_angle(bone, far, low)), third_side_angle(bone, far, high))
        if allowed != angle:
            side = over(side, sine) if sine > 1e-9 else perpendicular(back)
            way = plus(scaled(math.cos(allowed), back), scaled(math.sin(allowed), side))
    put(bones.target, b, plus(end, scaled(bone, way)))


@outlined
def pull_chain(tree, goal, bones, guard):
    """Targets of all points, tip to root; False when the root bone cannot follow."""
    count = chain_path(tree, bones)
    total = 0.0
    for i in range(count):
        c = bones.path[i]
        total += bones.length[c]
        put(bones.target, c, three(bones.now, c, 0))
    tip, root = bones.path[count - 1], bones.path[0]
    put(bones.target, tip, three(goal.target, 0, 0))
    rest = total
    for i in range(count - 1, 0, -1):
        e, b = bones.path[i], bones.path[i - 1]
        if abs(distance(bones.target, e, bones.now, b) - bones.length[e]) <= _EQUAL * total:
            return True
        if i == 1:
            return False
        rest -= bones.length[e]
        if not intersect_spheres(bones, e, b, bones.path[i - 2], bones.length[b]):
            drag_bone(bones, e, b, root, inner_radius(bones, 1, i), rest, guard)
        else:
            return True
    return False


@outlined
def recursive_step(tree, goal, work, bones, options):
    """One try; leaves q at the goal, or as it was and returns False."""
    copy(work.q, work.accepted)
    locate_all(tree, goal, work, bones)
    if pull_chain(tree, goal, bones, options.guard):
        settle(tree, goal, work, bones, options.sweeps)
        if measure(tree, goal, work):
            return True
    copy(work.accepted, work.q)
    return False


@kernel
def recursive(tree, goals, work, options, bones):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    bones = open_bones(bones)
    best = np.empty(work.best.shape[0])
    link_points(tree, goal, work.nodes, bones)
    work.step[:] = 0.0
    bones.pull[:] = 0.0
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        copy(work.best, best)
        best_cost = work.value[BEST_COST]
        moved = recursive_step(tree, goal, work, bones, options)
        advance(tree, goal, work)
        if not moved:
            # ``advance`` normalises quaternions: a failure must not change a bit.
            copy(work.accepted, work.q)
            copy(best, work.best)
            work.value[BEST_COST] = best_cost
