"""The recursive method: the end of the chain pulls the bones after it, from tip to root.

From the tip, a bone that cannot reach the goal by a rotation is moved there. Its other end becomes
the goal of the previous bone: on the circle in which the spheres of both bones intersect, else
at the point to which it is dragged. If the root would have to move, q does not change. Aho,
Implementation of articulated mechanisms in computer animation, University of Helsinki 2000, section
4.3. A dragged bone stays within reach of the bones before it. This is an addition of this library:
the published method does not reach some goals.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.bones import (
    BONES,
    clear_step,
    distance,
    find_path,
    inner_radius,
    link_points,
    locate_all,
    offset,
    settle,
    triangle_angle,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.search import advance, begin, copy, measure, proceed
from robot_ik.solvers.bone_solver import BoneSolver
from robot_ik.solvers.iterative import run_layout
from robot_ik.solvers.options import option, options_layout

# Lengths are equal if they differ by less than this share of the length of the chain.
_EQUAL = 1e-10
# The smallest sine that gives a direction across a line.
_MIN_SINE = 1e-9


@dataclass(frozen=True)
class Recursive(BoneSolver):
    """Each step is one attempt. It reaches the goal or changes nothing."""

    first_steps: int = option(1, "attempts from the start", lower=1, upper=100_000)
    random_steps: int = option(1, "attempts from a random point", lower=1, upper=100_000)
    patience: int = option(1, "failed attempts that end a descent", lower=1, upper=1000)
    sweeps: int = option(
        10, "sweeps over joints that share an anchor", lower=1, upper=100, usual=(1, 30)
    )

    name: ClassVar[str] = "recursive"
    title: ClassVar[str] = "a chain pulled by its end; undone if it fails"
    source: ClassVar[str] = "Aho, University of Helsinki 2000, section 4.3"
    default_restarts: ClassVar[int] = 0


OPTIONS = options_layout(Recursive)

WORK = Layout(
    "RecursiveWork",
    before="floats nq",  # q before the attempt
    bones=BONES,
)

RUN = run_layout("RecursiveRun", WORK, OPTIONS)
open_run = RUN.open


@outlined
def intersect_spheres(bones, e, b, p, radius):
    """Write the target of ``b`` where the spheres of two bones intersect; return if they do.

    One sphere has its centre at the target of ``e`` and the length of its bone as radius. The other
    has its centre at ``p``. The target is the point of their circle nearest to ``b``.
    """
    bone = bones.length[e]
    line = offset(bones.target, e, bones, p)
    gap = so3.norm(line)
    if gap > bone + radius or gap < abs(bone - radius) or gap == 0.0:
        return False
    line = so3.scale(1.0 / gap, line)
    along = (gap * gap + radius * radius - bone * bone) / (2.0 * gap)
    across = math.sqrt(max(0.0, radius * radius - along * along))
    point = offset(bones.point, b, bones, p)
    side = so3.subtract(point, so3.scale(so3.dot(point, line), line))
    length = so3.norm(side)
    side = so3.scale(1.0 / length, side) if length > _MIN_SINE * gap else so3.perpendicular(line)
    center = so3.add(so3.read_vector(bones.point, p, 0), so3.scale(along, line))
    so3.write_row(bones.target, b, so3.add(center, so3.scale(across, side)))
    return True


@outlined
def drag_bone(bones, e, b, root, shortest, longest):
    """Write the target of ``b``: at the length of its bone from the target of ``e``.

    It is in the direction of ``b``, but from ``shortest`` to ``longest`` metres from the root.
    """
    bone = bones.length[e]
    end = so3.read_vector(bones.target, e, 0)
    direction = so3.subtract(so3.read_vector(bones.point, b, 0), end)
    length = so3.norm(direction)
    direction = so3.scale(1.0 / length, direction) if length > 0.0 else (0.0, 0.0, 1.0)
    gap = distance(bones.target, e, bones, root)
    if gap > 0.0 and bone > 0.0:
        back = so3.scale(-1.0 / gap, offset(bones.target, e, bones, root))
        along = so3.dot(direction, back)
        side = so3.subtract(direction, so3.scale(along, back))
        sine = so3.norm(side)
        angle = math.atan2(sine, along)
        smallest = triangle_angle(bone, gap, shortest)
        largest = triangle_angle(bone, gap, longest)
        allowed = min(max(angle, smallest), largest)
        if allowed != angle:
            side = so3.scale(1.0 / sine, side) if sine > _MIN_SINE else so3.perpendicular(back)
            direction = so3.add(
                so3.scale(math.cos(allowed), back), so3.scale(math.sin(allowed), side)
            )
    so3.write_row(bones.target, b, so3.add(end, so3.scale(bone, direction)))


@outlined
def pull_chain(tree, search, bones):
    """Write the targets of all points, tip to root; return if the root can stay."""
    count = find_path(tree, bones)
    total = 0.0
    for i in range(count):
        c = bones.path[i]
        total += bones.length[c]
        so3.write_row(bones.target, c, so3.read_vector(bones.point, c, 0))
    root = bones.path[0]
    so3.write_row(bones.target, bones.path[count - 1], so3.read_matrix_point(search.target, 0))
    rest = total
    for i in range(count - 1, 0, -1):
        e = bones.path[i]
        b = bones.path[i - 1]
        if abs(distance(bones.target, e, bones, b) - bones.length[e]) <= _EQUAL * total:
            return True
        if i == 1:
            return False
        rest -= bones.length[e]
        if intersect_spheres(bones, e, b, bones.path[i - 2], bones.length[b]):
            return True
        drag_bone(bones, e, b, root, inner_radius(bones, 1, i), rest)
    return False


@outlined
def recursive_step(tree, goals, search, work, options):
    """Make one attempt; return if q is at the goal. Otherwise q is as it was."""
    bones = work.bones
    copy(search.q, work.before)
    locate_all(tree, goals, search, bones)
    if pull_chain(tree, search, bones):
        settle(tree, goals, search, bones, options.sweeps)
        if measure(tree, goals, search):
            return True
    copy(work.before, search.q)
    return False


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    search = run.search
    bones = run.work.bones
    begin(run.tree, run.goals, search)
    link_points(run.tree, run.goals, search, bones)
    clear_step(search)
    bones.hinge_pull = 0.0
    bones.ball_pull = 0.0
    while proceed(run.tree, run.goals, search):
        reached = recursive_step(run.tree, run.goals, search, run.work, run.options)
        advance(run.tree, run.goals, search)
        if not reached:
            copy(run.work.before, search.q)  # ``advance`` has normalised quaternions
