"""Triangulation: root to tip, each bone rotated by the law of cosines so that a triangle closes.

With a = this bone, b = the rest of the chain stretched out, c = from the joint to the target, the bone makes
the angle arccos((a² + c² − b²) / 2ac) with the line to the target (Müller-Cajar & Mukundan, Triangulation: a
new algorithm for inverse kinematics, Image and Vision Computing New Zealand 2007).  ``improved`` (after
Mukundan, A robust inverse kinematics algorithm for animating a joint chain, IJCAT 34(4), 2009): only as far
as the rest of the chain needs.  See ``docs/reference/solvers/triangulation.md``.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.bones import (
    chain_path,
    fit_joint,
    inner_radius,
    link_points,
    locate,
    locate_all,
    offset,
    open_bones,
    side_off_line,
    third_side_angle,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.vectors import dot, length, minus, over, plus, put, scaled, three
from robot_ik.kernels.workspace import open_work
from robot_ik.solvers.legacy_base import option, options_of
from robot_ik.solvers.families import BoneSolver

# A bone shorter than this, metres, is none: its ends are one point.
_NO_BONE = 1e-9


@dataclass(frozen=True)
class Triangulation(BoneSolver):
    """One step is one pass from the root to the tip."""

    restarts: int = option(100, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(60, "passes granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(60, "passes granted to a try from a random point", low=1, high=100_000)
    patience: int = option(5, "passes without progress before a try is given up", low=1, high=1000)
    progress: float = option(0.02, "smallest drop of the cost that counts as progress", low=0.0, high=1.0)
    improved: bool = option(True, "rotate each bone no farther than the rest needs", low=0, high=1)
    pull: float = option(
        0.1, "hinges: weight of the goal beside the targets of points", low=0.0, high=10.0, usual=(0.0, 1.0)
    )
    sweeps: int = option(3, "rounds over joints that share an anchor", low=1, high=100, usual=(1, 10))

    name: ClassVar[str] = "triangulation"
    title: ClassVar[str] = "triangles by the law of cosines, root to tip; balls without limits in one pass"
    source: ClassVar[str] = "Müller-Cajar & Mukundan, IVCNZ 2007; improved: Mukundan, IJCAT 2009"

    def kernel(self) -> Callable[..., None]:
        return triangulation


open_options = options_of(Triangulation)


@outlined
def bone_direction(tree, work, goal, bones, i, j, count, improved):
    """Unit vector along which the bone from path[i] to path[j] should lie."""
    p, c = bones.path[i], bones.path[j]
    a, b = bones.length[c], 0.0
    for m in range(j + 1, count):
        b += bones.length[bones.path[m]]
    way = over(offset(bones.now, c, bones, p), a)
    line = offset(goal.target, 0, bones, p)
    far = length(line)
    if far <= _NO_BONE:  # whichever way it points, the rest is as far away
        return way
    line = over(line, far)
    along = dot(way, line)
    off = minus(way, scaled(along, line))
    sine = length(off)
    angle = third_side_angle(a, far, b)
    if improved:
        least = third_side_angle(a, far, inner_radius(bones, j + 1, count))
        angle = min(max(math.atan2(sine, along), least), angle)
    off = over(off, sine) if sine > 1e-9 else side_off_line(tree, work.world, p, c, line)
    return plus(scaled(math.cos(angle), line), scaled(math.sin(angle), off))


@outlined
def target_bone(tree, work, goal, bones, i, j, count, improved):
    """Targets for the end of the bone from path[i] to path[j], and for the points after it on one line."""
    p = bones.path[i]
    way = bone_direction(tree, work, goal, bones, i, j, count, improved)
    end = plus(three(bones.now, p, 0), scaled(bones.length[bones.path[j]], way))
    # The rest on the line from there to the target.
    line = minus(three(goal.target, 0, 0), end)
    far = length(line)
    s, along = 1.0 / far if far > _NO_BONE else 0.0, 0.0
    for m in range(i + 1, count):
        e = bones.path[m]
        if m < j:
            put(bones.target, e, three(bones.now, p, 0))
            continue
        along += bones.length[e] if m > j else 0.0
        put(bones.target, e, plus(end, scaled(s * along, line)))


@outlined
def triangulation_step(tree, goal, work, bones, options):
    """One pass from the root to the tip; leaves q moved."""
    improved, sweeps = options.improved, options.sweeps
    locate_all(tree, goal, work, bones)
    count = chain_path(tree, bones)
    head = 0
    while head < count - 1:
        # Joints head … last share an anchor; the bone goes from them to path[last + 1].
        last = head
        while last < count - 2 and bones.length[bones.path[last + 1]] <= _NO_BONE:
            last += 1
        bone = bones.length[bones.path[last + 1]] > _NO_BONE
        for _ in range(sweeps if last > head else 1):
            for i in range(head, last + 1):
                for m in range(i, count):  # what hangs on the joints turned so far
                    locate(tree, goal, work, bones, bones.path[m])
                if bone:
                    target_bone(tree, work, goal, bones, i, last + 1, count, improved)
                    fit_joint(tree, goal, work, bones, bones.path[i])
        head = last + 1


@kernel
def triangulation(tree, goals, work, options, bones):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    bones = open_bones(bones)
    link_points(tree, goal, work.nodes, bones)
    work.step[:] = 0.0
    bones.pull[0], bones.pull[1] = options.pull, 0.0
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        triangulation_step(tree, goal, work, bones, options)
        advance(tree, goal, work)
