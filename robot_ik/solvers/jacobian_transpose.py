"""Jacobian transpose: d = α Jᵀ e, the steepest way down, with no inverse at all.

Balestrino, De Maria & Sciavicco (Robust control of robotic manipulators, IFAC 1984), Wolovich & Elliott
(1984); α = ⟨e, JJᵀe⟩ / ⟨JJᵀe, JJᵀe⟩ is the best length on the linear model (Buss, Introduction to
inverse kinematics …, 2004, section 3; Šimunić 2012, section 3.1).
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.jacobian_step import cap, fix_pushed_by_gradient, keep_inside, prepare, shorten
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import open_work
from robot_ik.solvers.base import option, options_of
from robot_ik.solvers.families import JacobianSolver


@dataclass(frozen=True)
class JacobianTranspose(JacobianSolver):
    """Cheap steps that never blow up, many of them; joints far from the tip move most."""

    restarts: int = option(20, "random restarts when a try stalls", low=0, high=100_000)
    first_steps: int = option(600, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(400, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(20, "steps without progress before a try is given up", low=1, high=1000)
    # A little less than the best length breaks the zigzag of steepest descent (Raydan & Svaiter 2002).
    gain: float = option(0.9, "share of each step that is taken", low=1e-6, high=2.0, usual=(0.0, 2.0))
    fixed_gain: float = option(
        0.0, "fixed α in place of Buss's; 0: Buss's", low=0.0, high=1e6, usual=(0.0, 1.0)
    )

    name: ClassVar[str] = "transpose"
    title: ClassVar[str] = "Jacobian transpose, best step length on the linear model"
    source: ClassVar[str] = "Balestrino et al. 1984; Wolovich & Elliott 1984; Buss 2004"

    def kernel(self) -> Callable[..., None]:
        return transpose


open_options = options_of(JacobianTranspose)


@outlined
def transpose_step(tree, goal, work, options):
    """work.step = α Jᵀ e without the joints that stand at a bound and would leave it."""
    alpha = options.fixed_gain
    prepare(tree, goal, work, options.clamp, options.alternative)
    fix_pushed_by_gradient(work)  # afterwards work.gradient is Jᵀ e of the joints that remain
    jacobian, gradient, step = work.jacobian, work.gradient, work.step
    if alpha == 0.0:
        along, square = 0.0, 0.0
        for r in range(work.wanted.shape[0]):
            moved = 0.0
            for u in range(step.shape[0]):
                moved += jacobian[r, u] * gradient[u]
            along += work.wanted[r] * moved
            square += moved * moved
        alpha = along / square if square > 0.0 else 0.0
    for u in range(step.shape[0]):
        step[u] = alpha * gradient[u]
    keep_inside(work)
    cap(work, options.gain, options.max_step)
    shorten(work)


@kernel
def transpose(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        transpose_step(tree, goal, work, options)
        advance(tree, goal, work)
