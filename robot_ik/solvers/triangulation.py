"""Triangulation: from root to tip, each bone rotates by the law of cosines to close a triangle.

With a the length of this bone, b that of the rest of the chain stretched out, and c the distance
from the joint to the target, the bone makes the angle arccos((a² + c² − b²) / 2ac) with the line to
the target. Müller-Cajar & Mukundan, Triangulation: a new algorithm for inverse kinematics, Image
and Vision Computing New Zealand 2007. With ``improved`` a bone rotates only as far as the rest of
the chain needs (after Mukundan, A robust inverse kinematics algorithm for animating a joint chain,
Int. J. Computer Applications in Technology 34(4), 2009).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import so3
from robot_ik.kernels.bones import (
    BONES,
    clear_step,
    find_path,
    fit_joint,
    inner_radius,
    link_points,
    locate,
    locate_all,
    offset,
    side_of_line,
    triangle_angle,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.search import advance, begin, proceed
from robot_ik.solvers.bone_solver import BoneSolver
from robot_ik.solvers.iterative import run_layout
from robot_ik.solvers.options import option, options_layout

# A bone shorter than this, in metres, has no direction: its ends are one point.
_NO_BONE = 1e-9
# The smallest sine between a bone and the line to the target that decides the side of the triangle.
_MIN_SINE = 1e-9


@dataclass(frozen=True)
class Triangulation(BoneSolver):
    """Each step is one pass from the root to the tip."""

    first_steps: int = option(
        60, "passes granted to the descent from the start", lower=1, upper=100_000
    )
    random_steps: int = option(
        60, "passes granted to a descent from a random point", lower=1, upper=100_000
    )
    patience: int = option(5, "passes without progress that end a descent", lower=1, upper=1000)
    progress: float = option(
        0.02, "smallest drop of the cost that counts as progress", lower=0.0, upper=1.0
    )
    improved: bool = option(True, "rotate each bone only as far as the rest needs")
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

    name: ClassVar[str] = "triangulation"
    title: ClassVar[str] = (
        "triangles by the law of cosines, root to tip; balls without limits in one pass"
    )
    source: ClassVar[str] = "Müller-Cajar & Mukundan, IVCNZ 2007; improved: Mukundan, IJCAT 2009"


OPTIONS = options_layout(Triangulation)
WORK = BONES
RUN = run_layout("TriangulationRun", WORK, OPTIONS)
open_run = RUN.open


@outlined
def bone_direction(tree, search, bones, i, j, count, improved):
    """Return the direction in which the bone from path[i] to path[j] should point."""
    p = bones.path[i]
    c = bones.path[j]
    length = bones.length[c]
    rest = 0.0
    for m in range(j + 1, count):
        rest += bones.length[bones.path[m]]
    direction = so3.scale(1.0 / length, offset(bones.point, c, bones, p))
    line = so3.subtract(so3.read_matrix_point(search.target, 0), so3.read_vector(bones.point, p, 0))
    reach = so3.norm(line)
    if reach <= _NO_BONE:  # the target is at the joint, so no direction is better
        return direction
    line = so3.scale(1.0 / reach, line)
    along = so3.dot(direction, line)
    side = so3.subtract(direction, so3.scale(along, line))
    sine = so3.norm(side)
    angle = triangle_angle(length, reach, rest)
    if improved:
        smallest = triangle_angle(length, reach, inner_radius(bones, j + 1, count))
        angle = min(max(math.atan2(sine, along), smallest), angle)
    if sine > _MIN_SINE:
        side = so3.scale(1.0 / sine, side)
    else:
        side = side_of_line(tree, search.world, p, c, line)
    return so3.add(so3.scale(math.cos(angle), line), so3.scale(math.sin(angle), side))


@outlined
def target_bone(tree, search, bones, i, j, count, improved):
    """Write targets for the end of the bone from path[i] to path[j], and for the points after it.

    The points after it lie on the line from that end to the target of the goal.
    """
    anchor = so3.read_vector(bones.point, bones.path[i], 0)
    direction = bone_direction(tree, search, bones, i, j, count, improved)
    end = so3.add(anchor, so3.scale(bones.length[bones.path[j]], direction))
    line = so3.subtract(so3.read_matrix_point(search.target, 0), end)
    length = so3.norm(line)
    scale = 1.0 / length if length > _NO_BONE else 0.0
    for m in range(i + 1, j):
        so3.write_row(bones.target, bones.path[m], anchor)
    so3.write_row(bones.target, bones.path[j], end)
    along = 0.0
    for m in range(j + 1, count):
        c = bones.path[m]
        along += bones.length[c]
        so3.write_row(bones.target, c, so3.add(end, so3.scale(scale * along, line)))


@outlined
def triangulation_step(tree, goals, search, bones, options):
    """Move q by one pass from the root to the tip."""
    locate_all(tree, goals, search, bones)
    count = find_path(tree, bones)
    first = 0
    while first < count - 1:
        # Joints first … last share an anchor. Their bone ends in path[last + 1].
        last = first
        while last < count - 2 and bones.length[bones.path[last + 1]] <= _NO_BONE:
            last += 1
        has_bone = bones.length[bones.path[last + 1]] > _NO_BONE
        for _ in range(options.sweeps if last > first else 1):
            for i in range(first, last + 1):
                for m in range(i, count):  # the joints before them have moved them
                    locate(tree, goals, search, bones, bones.path[m])
                if has_bone:
                    target_bone(tree, search, bones, i, last + 1, count, options.improved)
                    fit_joint(tree, goals, search, bones, bones.path[i])
        first = last + 1


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    bones = run.work
    begin(run.tree, run.goals, run.search)
    link_points(run.tree, run.goals, run.search, bones)
    clear_step(run.search)
    bones.hinge_pull = run.options.pull
    bones.ball_pull = 0.0
    while proceed(run.tree, run.goals, run.search):
        triangulation_step(run.tree, run.goals, run.search, bones, run.options)
        advance(run.tree, run.goals, run.search)
