"""What methods of one kind share: the options of Jacobian methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from robot_ik.solvers.legacy_base import IterativeSolver, option


@dataclass(frozen=True)
class JacobianSolver(IterativeSolver):
    """A method whose step is made from the Jacobian and the residual: options that all of them share."""

    partial_goals: ClassVar[bool] = True
    unseen: ClassVar[bool] = True
    capabilities: ClassVar[frozenset[str]] = frozenset({"couplings", "stiffness"})

    first_steps: int = option(100, "steps granted to the try from the start", low=1, high=100_000)
    try_steps: int = option(60, "steps granted to a try from a random point", low=1, high=100_000)
    patience: int = option(8, "steps without progress before a try is given up", low=1, high=1000)
    clamp: float = option(
        0.5, "longest residual of a goal taken in one step", low=1e-3, high=1e6, unit="rad", usual=(0.0, 2.0)
    )
    max_step: float = option(
        0.4, "largest change of one joint in a step", low=1e-4, high=1e6, unit="rad", usual=(0.0, 2.0)
    )
    gain: float = option(1.0, "share of each step that is taken", low=1e-6, high=2.0, usual=(0.0, 2.0))
    alternative: bool = option(False, "Jacobian at the target in place of the frame (alternative Jacobian)")
