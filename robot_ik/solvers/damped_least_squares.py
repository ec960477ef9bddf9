"""Damped least squares: the classic step d = (JᵀJ + λ² I)⁻¹ Jᵀ e, clamped and kept inside the limits.

Wampler (1986), Nakamura & Hanafusa (1986); the target clamping and its use are Buss & Kim's
(Selectively damped least squares for inverse kinematics, 2005).
"""

# mypy: disallow-untyped-defs = false, check-untyped-defs = false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from robot_ik.kernels.jit import kernel, outlined
from robot_ik.kernels.linalg import box_step, normal_equations
from robot_ik.kernels.loop import advance, begin, proceed, room
from robot_ik.kernels.residuals import goal_jacobian, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import DAMPING, PRESSED, open_work
from robot_ik.solvers.base import IterativeSolver, option


@dataclass(frozen=True)
class DampedLeastSquares(IterativeSolver):
    """Constant damping: smooth and predictable, slower near the solution than ``lm``."""

    first_steps: int = option(100, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(60, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(8, "steps without progress before a try is given up", low=1, high=1000)
    damping: float = option(0.05, "λ, in the units of the scaled Jacobian", low=1e-6, high=10.0)
    clamp: float = option(0.5, "longest residual taken in one step, rad", low=1e-3, high=100.0, unit="rad")
    max_step: float = option(0.4, "largest change of one joint in a step", low=1e-4, high=10.0, unit="rad")

    name: ClassVar[str] = "dls"
    title: ClassVar[str] = "damped least squares, constant damping, clamped steps"
    source: ClassVar[str] = "Wampler 1986; Nakamura & Hanafusa 1986; Buss & Kim 2005"

    def kernel(self) -> Callable[..., None]:
        return dls

    def parameters(self) -> tuple[float, ...]:
        return (self.damping, self.clamp, self.max_step)


@outlined
def dls_step(tree, goal, work, options):
    """work.step from the clamped residual; joints at a limit do not hold the others back."""
    damping, clamp, max_step = options[0], options[1], options[2]
    work.value[DAMPING] = damping
    residual, jacobian, normal, step = work.residual, work.jacobian, work.normal, work.step
    n = step.shape[0]
    goal_jacobian(tree, goal, work.world, work.frames, residual, jacobian)
    norm = 0.0
    for r in range(residual.shape[0]):
        norm += residual[r] * residual[r]
    norm = math.sqrt(norm)
    if norm > clamp:  # measured again after the step, so it may be scaled in place
        for r in range(residual.shape[0]):
            residual[r] *= clamp / norm
    normal_equations(jacobian, residual, normal, work.gradient)
    for i in range(n):
        normal[i, i] += damping * damping
    room(tree, goal, work)
    pressed = box_step(
        normal, work.gradient, work.low, work.high, step, work.rhs, work.free, work.side, work.factor
    )
    work.state[PRESSED] = max(pressed, 0)
    largest = 0.0
    for i in range(n):
        largest = max(largest, abs(step[i]))
    if largest > max_step:
        for i in range(n):
            step[i] *= max_step / largest


@kernel
def dls(tree, goals, work, options):
    """Runs until ``proceed`` says stop; options: damping, clamp, max_step."""
    tree, goal, work = open_tree(tree), open_goals(goals), open_work(work)
    begin(tree, goal, work)
    while proceed(tree, goal, work):
        dls_step(tree, goal, work, options)
        advance(tree, goal, work)
