"""Selectively damped least squares: each singular direction is damped as much as it would swing the joints.

Buss & Kim (Selectively damped least squares for inverse kinematics, Journal of Graphics Tools 10(3),
2005, pages 37-49).  For each singular triple (u_i, σ_i, v_i) of J, with α_i = ⟨e, u_i⟩:

    N_i = Σ_ℓ ‖u_{ℓ,i}‖                          motion of the end effectors that is wanted
    M_i = σ_i⁻¹ Σ_ℓ Σ_j |v_{j,i}| ‖∂s_ℓ/∂θ_j‖    bound of the motion that the joints would cause
    γ_i = min(1, N_i / M_i) γ_max                 largest change allowed to this direction
    φ_i = ClampMaxAbs(σ_i⁻¹ α_i v_i, γ_i)
    Δθ  = ClampMaxAbs(Σ φ_i, γ_max)
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels import jacobian_step as steps
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.loop import advance, begin, proceed
from robot_ik.kernels.residuals import goal_end, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.workspace import open_work
from robot_ik.solvers.legacy_base import option, options_of
from robot_ik.solvers.families import JacobianSolver


@dataclass(frozen=True)
class SelectivelyDamped(JacobianSolver):
    """Smooth near singularities and at unreachable targets without a damping to tune."""

    max_step: float = option(
        math.pi / 4, "γ_max: largest change of one joint in a step", low=1e-4, high=1e6, unit="rad",
        usual=(0.0, 2.0),
    )  # fmt: skip

    name: ClassVar[str] = "sdls"
    title: ClassVar[str] = "selectively damped least squares"
    source: ClassVar[str] = "Buss & Kim, Journal of Graphics Tools 10(3), 2005"

    def kernel(self) -> Callable[..., None]:
        return sdls


open_options = options_of(SelectivelyDamped)


@outlined
def selective_share(goal, work, i):
    """N_i / M_i of one singular direction, at most 1; a goal's rows are one end effector."""
    u, v, jacobian = work.left, work.right, work.jacobian
    m, n = jacobian.shape
    wanted, caused = 0.0, 0.0
    for g in range(goal.row.shape[0]):
        first, end = goal.row[g], goal_end(goal, g, m)
        square = 0.0
        for r in range(first, end):
            square += u[i, r] * u[i, r]
        wanted += math.sqrt(square)
        for j in range(n):
            square = 0.0
            for r in range(first, end):
                square += jacobian[r, j] * jacobian[r, j]
            caused += abs(v[i, j]) * math.sqrt(square)
    caused /= work.sigma[i]
    return wanted / caused if caused > wanted else 1.0


@outlined
def selective_step(goal, work, max_step):
    """work.step = Σ φ_i from the singular vectors of work.jacobian."""
    u, sigma, v, step = work.left, work.sigma, work.right, work.step
    n = step.shape[0]
    for j in range(n):
        step[j] = 0.0
    for i in range(sigma.shape[0]):
        if not sigma[i] > 0.0:
            continue
        part = 0.0
        for r in range(work.wanted.shape[0]):
            part += work.wanted[r] * u[i, r]
        part /= sigma[i]
        largest = 0.0
        for j in range(n):
            largest = max(largest, abs(part * v[i, j]))
        allowed = selective_share(goal, work, i) * max_step
        if largest > allowed:
            part *= allowed / largest
        for j in range(n):
            step[j] += part * v[i, j]


@outlined
def sdls_step(tree, goal, work, options):
    """One step of Buss & Kim; joints that stand at a bound and would leave it are taken out first."""
    steps.prepare(tree, goal, work, options.clamp, options.alternative)
    steps.fix_pushed_by_gradient(work)
    for _ in range(work.step.shape[0] + 1):
        steps.svd(work.jacobian, work.left, work.sigma, work.right)
        selective_step(goal, work, options.max_step)
        if not steps.fix_pushed_by_step(work):
            break
    steps.keep_inside(work)
    steps.cap(work, options.gain, options.max_step)
    steps.shorten(work)


@kernel
def sdls(tree, goals, work, options):
    """Runs until ``proceed`` says stop."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    options = open_options(options)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        sdls_step(tree, goal, work, options)
        advance(tree, goal, work)
