"""Jacobian transpose: d = α Jᵀ e, the direction of steepest descent, without any inverse.

Balestrino, De Maria & Sciavicco (Robust control of robotic manipulators, IFAC 1984), Wolovich &
Elliott (1984). α = ⟨e, JJᵀe⟩ / ⟨JJᵀe, JJᵀe⟩ is the best length on the linear model (Buss,
Introduction to inverse kinematics with Jacobian transpose, pseudoinverse and damped least squares
methods, 2004, section 3); with ``fixed_alpha`` it is a constant (Šimunić 2012, section 3.1).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jacobian_step import (
    fix_pushed_by_gradient,
    keep_inside,
    limit,
    prepare,
    shorten_in_polish,
)
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.linalg import BOX_PROBLEM
from robot_ik.kernels.search import advance, begin, proceed
from robot_ik.solvers.iterative import GuidedSolver, run_layout
from robot_ik.solvers.options import option, options_layout


@dataclass(frozen=True)
class JacobianTranspose(GuidedSolver):
    """Many cheap steps that do not diverge. Joints far from the tip move most."""

    first_steps: int = option(
        600, "steps granted to the descent from the start", lower=1, upper=100_000
    )
    random_steps: int = option(
        400, "steps granted to a descent from a random point", lower=1, upper=100_000
    )
    patience: int = option(20, "steps without progress that end a descent", lower=1, upper=1000)
    # A little less than the best length ends the zigzag of steepest descent (Raydan & Svaiter
    # 2002).
    gain: float = option(
        0.9, "share of each step that is taken", lower=1e-6, upper=2.0, usual=(0.0, 2.0)
    )
    fixed_alpha: float = option(
        0.0, "α; 0 for the best length on the linear model", lower=0.0, upper=1e6, usual=(0.0, 1.0)
    )

    name: ClassVar[str] = "transpose"
    title: ClassVar[str] = "Jacobian transpose, best step length on the linear model"
    source: ClassVar[str] = "Balestrino et al. 1984; Wolovich & Elliott 1984; Buss 2004"
    default_restarts: ClassVar[int] = 20


OPTIONS = options_layout(JacobianTranspose)
WORK = Layout("TransposeWork", box=BOX_PROBLEM)
RUN = run_layout("TransposeRun", WORK, OPTIONS)
open_run = RUN.open


@inlined
def best_alpha(box):
    """Return the α that minimises ‖e − α J Jᵀe‖; needs box.gradient = Jᵀe."""
    along = 0.0
    square = 0.0
    for r in range(box.residual.shape[0]):
        moved = 0.0
        for u in range(box.gradient.shape[0]):
            moved += box.jacobian[r, u] * box.gradient[u]
        along += box.residual[r] * moved
        square += moved * moved
    return along / square if square > 0.0 else 0.0


@outlined
def transpose_step(tree, goals, search, box, options):
    """Write α Jᵀe to search.step, without the joints that would leave their limits."""
    prepare(tree, goals, search, box, options.clamp, options.alternative)
    fix_pushed_by_gradient(search, box)
    alpha = options.fixed_alpha
    if alpha == 0.0:
        alpha = best_alpha(box)
    for u in range(search.step.shape[0]):
        search.step[u] = alpha * box.gradient[u]
    keep_inside(box, search.step)
    limit(search.step, options.gain, options.max_step)
    shorten_in_polish(search)


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    begin(run.tree, run.goals, run.search)
    while proceed(run.tree, run.goals, run.search):
        transpose_step(run.tree, run.goals, run.search, run.work.box, run.options)
        advance(run.tree, run.goals, run.search)
