"""Pseudoinverse: d = J⁺ e + (I − J⁺J) φ, with a stated cut-off of small singular values.

Whitney (Resolved motion rate control of manipulators, IEEE T-MMS 10(2), 1969); null space after Liégeois
(IEEE T-SMC 7(12), 1977).  Goal halving is Aho's (Implementation of articulated mechanisms in computer
animation, 2000, section 4.6): a step that does not land near enough to its (sub)goal is undone and half
the way tried.
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.jacobian_step import (
    cap,
    filtered_step,
    keep_inside,
    mistrust,
    pin_downhill,
    pin_outward,
    prepare,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.linalg import svd
from robot_ik.kernels.loop import advance, begin, copy, measure, proceed
from robot_ik.kernels.null_space import AIMS, add_null_motion, keep_aim_inside, set_aim
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.room import apply_step
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import POLISHING, open_work
from robot_ik.solvers.base import JacobianSolver, option


@dataclass(frozen=True)
class Pseudoinverse(JacobianSolver):
    """The shortest step that solves the linear model; fast near a solution, rough near singularities."""

    cutoff: float = option(
        1e-4,
        "singular values below this share of the largest count as zero",
        low=1e-12,
        high=1.0,
        usual=(0.0, 0.1),
    )
    aim: str = option("none", "what the null space is used for", choices=AIMS)
    aim_gain: float = option(0.2, "share of the aim in each step", low=0.0, high=1e3, usual=(0.0, 1.0))
    halvings: int = option(
        0, "times a step may be halved until it lands; 0: never", low=0, high=60, usual=(0, 20)
    )
    landing: float = option(0.1, "how far from its subgoal a step may land", low=1e-9, high=1e3, unit="rad")

    name: ClassVar[str] = "pseudoinverse"
    title: ClassVar[str] = "pseudoinverse by singular values, with null-space motion"
    source: ClassVar[str] = "Whitney 1969; Liégeois 1977; goal halving: Aho 2000"

    def kernel(self) -> Callable[..., None]:
        return pseudoinverse

    def parameters(self) -> tuple[float, ...]:
        aim = float(AIMS.index(self.aim))
        return (*self.common(), self.cutoff, aim, self.aim_gain, float(self.halvings), self.landing)


@outlined
def pseudo_step(tree, goal, work, options):
    """work.step = J⁺ e + (I − J⁺J) φ; joints that stand at a bound and would leave it are taken out.

    Returns the share of the step that limits and caps have left.
    """
    clamp, alternative, gain, max_step, cutoff = options[0], options[1], options[2], options[3], options[4]
    set_aim(tree, goal, work, int(options[5]), options[6])
    prepare(tree, goal, work, clamp, alternative)
    extra = math.sqrt(mistrust(work))
    if work.state[POLISHING] > 0:
        cutoff = 0.0  # to end where nothing is left to win, in the directions that were cut off as well
    pin_downhill(work)
    keep_aim_inside(work)
    for _ in range(work.step.shape[0] + 1):
        svd(work.jacobian, work.left, work.sigma, work.right)
        filtered_step(work, cutoff, extra)
        add_null_motion(work, cutoff)
        if not pin_outward(work):
            break
    share = keep_inside(work)
    return share * cap(work, gain, max_step)


@outlined
def halve(tree, goal, work, share, halvings, landing):
    """Shortens work.step until it lands within ``landing`` of its subgoal; leaves q where it was.

    ``share`` is what the step is of the full one; the subgoal takes as much of the wanted residual away.
    A step that does not land after ``halvings`` halvings is taken as short as it has become, or not at
    all if it leads uphill.
    """
    residual, wanted, before, step = work.residual, work.wanted, work.rhs, work.step
    m, n = residual.shape[0], step.shape[0]
    old = 0.0
    for r in range(m):
        before[r] = residual[r]
        old += 0.5 * residual[r] * residual[r]
    copy(work.q, work.accepted)
    for tries in range(halvings + 1):
        apply_step(tree, goal, work.nodes, step, work.dq, work.q)
        measure(tree, goal, work)
        copy(work.accepted, work.q)
        off, new = 0.0, 0.0
        for r in range(m):
            off += (residual[r] - before[r] + share * wanted[r]) ** 2
            new += 0.5 * residual[r] * residual[r]
        if off <= landing * landing:
            return
        if tries == halvings:
            for u in range(n):
                step[u] *= 1.0 if new < old else 0.0
            return
        share *= 0.5
        for u in range(n):
            step[u] *= 0.5


@kernel
def pseudoinverse(tree, goals, work, options):
    """Runs until ``proceed`` says stop; options: the shared four, then as in ``parameters``."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    halvings, landing = int(options[7]), options[8]
    while proceed(tree, goal, work):
        share = pseudo_step(tree, goal, work, options)
        if halvings > 0:
            halve(tree, goal, work, share, halvings, landing)
        advance(tree, goal, work)
