"""Damped least squares: the classic step d = (JᵀJ + λ² I)⁻¹ Jᵀ e, clamped and kept inside the limits.

Wampler (1986).  ``adaptive``: Nakamura & Hanafusa (Inverse kinematic solutions with singularity
robustness for robot manipulator control, ASME J. Dynamic Systems 108(3), 1986) damp by manipulability:
λ² = λ₀² (1 − w / w₀)² where w < w₀, else none.  ``svd``: the same step as ``constant`` from the singular
values, Σ σ / (σ² + λ²) v uᵀ e (Maciejewski & Klein 1988); it differs at the limits only.  The target
clamping is Buss & Kim's (Selectively damped least squares for inverse kinematics, 2005).
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import jacobian_step as steps
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.linalg import box_step, normal_equations, row_products, row_step
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import DAMPING, PRESSED, open_work
from robot_ik.solvers.legacy_base import option, options_of
from robot_ik.solvers.families import JacobianSolver

MODES = ("constant", "adaptive", "svd")
CONSTANT, ADAPTIVE, SVD = range(3)


@dataclass(frozen=True)
class DampedLeastSquares(JacobianSolver):
    """Smooth and predictable; slower near the solution than ``lm``."""

    damping: float = option(
        0.05, "λ, in the units of the scaled Jacobian", low=1e-6, high=10.0, usual=(0.0, 0.2)
    )
    mode: str = option("constant", "how the damping is chosen, and the step made", choices=MODES)
    threshold: float = option(
        0.1, "w₀: manipulability below which ``adaptive`` damps", low=1e-12, high=1e6, usual=(0.0, 0.2)
    )

    name: ClassVar[str] = "dls"
    title: ClassVar[str] = "damped least squares, clamped steps"
    source: ClassVar[str] = "Wampler 1986; Nakamura & Hanafusa 1986; Buss & Kim 2005"

    def kernel(self) -> Callable[..., None]:
        return dls


open_options = options_of(DampedLeastSquares)


@outlined
def box_damped(goal, work, damping):
    """work.step minimises ‖J d − e‖² + λ² ‖d‖² inside the limits, exactly; among few rows."""
    normal, step, strength = work.normal, work.step, damping * damping + steps.extra_damping(work)
    m, n = work.jacobian.shape
    if m < n:
        row_products(work.jacobian, work.wanted, goal.hits, goal.hit_count, normal, work.gradient)
        pressed = row_step(
            work.jacobian, work.wanted, normal, work.gradient, strength, work.low, work.high,
            goal.hits, goal.hit_count, step, work.free, work.side, work.factor, work.rhs,
        )  # fmt: skip
    else:
        normal_equations(work.jacobian, work.wanted, normal, work.gradient)
        for i in range(n):
            normal[i, i] += strength
        pressed = box_step(
            normal, work.gradient, work.low, work.high, step, work.free, work.side, work.factor
        )
    if pressed < 0:  # λ² is lost in the rounding of a singular JᵀJ: stand still rather than anywhere
        for i in range(step.shape[0]):
            step[i] = 0.0
    work.state[PRESSED] = max(pressed, 0)
    work.value[DAMPING] = damping


@outlined
def svd_damped(work, damping, adaptive, threshold):
    """work.step = Σ σ / (σ² + λ²) v uᵀ e; joints that stand at a bound and would leave it are taken out."""
    steps.fix_pushed_by_gradient(work)
    for _ in range(work.step.shape[0] + 1):
        steps.svd(work.jacobian, work.left, work.sigma, work.right)
        strength = damping
        if adaptive:
            strength = damping * max(0.0, 1.0 - steps.volume(work.sigma) / threshold)
        steps.filtered_step(
            work, steps.NEGLIGIBLE, math.sqrt(strength * strength + steps.extra_damping(work))
        )
        if not steps.fix_pushed_by_step(work):
            break
    steps.keep_inside(work)


@outlined
def dls_step(tree, goal, work, options):
    """work.step from the clamped residual; joints at a limit do not hold the others back."""
    steps.prepare(tree, goal, work, options.clamp, options.alternative)
    if options.mode == CONSTANT:
        box_damped(goal, work, options.damping)
    else:
        svd_damped(work, options.damping, options.mode == ADAPTIVE, options.threshold)
    steps.cap(work, options.gain, options.max_step)


@kernel
def dls(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        dls_step(tree, goal, work, options)
        advance(tree, goal, work)
