"""Selectively damped least squares: each singular direction has the damping that its joints need.

Buss & Kim (Selectively damped least squares for inverse kinematics, J. Graphics Tools 10(3), 2005,
pages 37-49). For each singular triple (u_i, σ_i, v_i) of J, with α_i = ⟨e, u_i⟩:

    N_i = Σ_ℓ ‖u_{ℓ,i}‖                          desired motion of the end effectors
    M_i = σ_i⁻¹ Σ_ℓ Σ_j |v_{j,i}| ‖∂s_ℓ/∂θ_j‖    bound of the motion that the joints would cause
    γ_i = min(1, N_i / M_i) γ_max                largest change allowed to this direction
    φ_i = ClampMaxAbs(σ_i⁻¹ α_i v_i, γ_i)
    Δθ  = ClampMaxAbs(Σ φ_i, γ_max)
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jacobian_step import (
    SINGULAR,
    fix_pushed_by_gradient,
    fix_pushed_by_step,
    keep_inside,
    limit,
    prepare,
    shorten_in_polish,
)
from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.linalg import BOX_PROBLEM, svd
from robot_ik.kernels.residuals import rows_end
from robot_ik.kernels.search import advance, begin, proceed
from robot_ik.solvers.iterative import GuidedSolver, run_layout
from robot_ik.solvers.options import option, options_layout


@dataclass(frozen=True)
class SelectivelyDamped(GuidedSolver):
    """Smooth near singularities and at unreachable targets, without a damping to tune."""

    max_step: float = option(
        math.pi / 4,
        "γ_max: largest change of a joint in one step",
        lower=1e-4,
        upper=1e6,
        unit="rad",
        usual=(0.0, 2.0),
    )

    name: ClassVar[str] = "sdls"
    title: ClassVar[str] = "selectively damped least squares"
    source: ClassVar[str] = "Buss & Kim, Journal of Graphics Tools 10(3), 2005"


OPTIONS = options_layout(SelectivelyDamped)
WORK = Layout("SdlsWork", box=BOX_PROBLEM, singular=SINGULAR)
RUN = run_layout("SdlsRun", WORK, OPTIONS)
open_run = RUN.open


@outlined
def selective_share(goals, box, singular, i):
    """Return N_i / M_i of one singular direction, at most 1; the rows of a goal are one ℓ."""
    rows, columns = box.jacobian.shape
    wanted = 0.0
    caused = 0.0
    for g in range(goals.row.shape[0]):
        first = goals.row[g]
        end = rows_end(goals, g, rows)
        square = 0.0
        for r in range(first, end):
            square += singular.left[i, r] * singular.left[i, r]
        wanted += math.sqrt(square)
        for j in range(columns):
            square = 0.0
            for r in range(first, end):
                square += box.jacobian[r, j] * box.jacobian[r, j]
            caused += abs(singular.right[i, j]) * math.sqrt(square)
    caused /= singular.sigma[i]
    return wanted / caused if caused > wanted else 1.0


@outlined
def selective_step(goals, box, singular, max_step, step):
    """Write Σ φ_i to ``step``, from the singular vectors of the Jacobian."""
    columns = step.shape[0]
    for j in range(columns):
        step[j] = 0.0
    for i in range(singular.sigma.shape[0]):
        if not singular.sigma[i] > 0.0:
            continue
        part = 0.0
        for r in range(box.residual.shape[0]):
            part += box.residual[r] * singular.left[i, r]
        part /= singular.sigma[i]
        largest = 0.0
        for j in range(columns):
            largest = max(largest, abs(part * singular.right[i, j]))
        allowed = selective_share(goals, box, singular, i) * max_step
        if largest > allowed:
            part *= allowed / largest
        for j in range(columns):
            step[j] += part * singular.right[i, j]


@outlined
def sdls_step(tree, goals, search, work, options):
    """Write a step of Buss & Kim to search.step, without the joints that leave their limits."""
    box = work.box
    singular = work.singular
    prepare(tree, goals, search, box, options.clamp, options.alternative)
    fix_pushed_by_gradient(search, box)
    for _ in range(search.step.shape[0] + 1):
        svd(box.jacobian, singular.left, singular.sigma, singular.right)
        selective_step(goals, box, singular, options.max_step, search.step)
        if fix_pushed_by_step(search, box) < 0:
            break
    keep_inside(box, search.step)
    limit(search.step, options.gain, options.max_step)
    shorten_in_polish(search)


@kernel
def solve(address):
    """Run one solve, or a slice of it."""
    run = open_run(address)
    begin(run.tree, run.goals, run.search)
    while proceed(run.tree, run.goals, run.search):
        sdls_step(run.tree, run.goals, run.search, run.work, run.options)
        advance(run.tree, run.goals, run.search)
