"""``combined``: methods in turn, until one of them reaches the goal.

A fast method for few problems can come before a general one. Aho (2000, section 7.2.4)
solves with the recursive method where the Jacobian method failed. With ``hand_over`` each method
starts where the method before it ended, as Wang & Chen (IEEE T-RA 7(4), 1991) start a minimisation
where cyclic coordinate descent becomes slow (in Pađen 2011, table 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from robot_ik.errors import OptionError, UnknownSolverError
from robot_ik.solvers import SOLVERS, make_solver
from robot_ik.solvers.base import FEATURES, Prepared, Solver
from robot_ik.solvers.options import option
from robot_ik.solvers.sequence import PreparedSequence

if TYPE_CHECKING:
    from robot_ik.problem import Problem

# Methods that are lists of methods themselves.
_SEQUENCES = ("auto", "combined")


@dataclass(frozen=True)
class Combined(Solver):
    """Tries methods in the given order; the first that converges ends the solve."""

    methods: str = option("analytic lm", "names of methods, in the order in which they are tried")
    hand_over: bool = option(
        False, "start each method where the one before it ended; only the last makes restarts"
    )

    name: ClassVar[str] = "combined"
    title: ClassVar[str] = "methods in turn, until one reaches the goal"
    source: ClassVar[str] = "Aho 2000, section 7.2.4; Wang & Chen, IEEE T-RA 1991"
    partial_goals: ClassVar[bool] = True
    # The features of all methods. ``unsupported`` checks the methods in use.
    capabilities: ClassVar[frozenset[str]] = frozenset(FEATURES)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.methods.split()
        if not names or any(name in _SEQUENCES for name in names):
            raise OptionError(
                "methods",
                f"{self.methods!r} is not allowed",
                "names of single methods, separated by spaces",
                owner=f"solver {self.name}",
            )
        for name in names:
            if name not in SOLVERS:
                raise UnknownSolverError(name, SOLVERS)

    def unsupported(self, problem: Problem) -> str:
        """Return what the first method does not support, if no method supports the problem."""
        reasons = [member.unsupported(problem) for member in self._members()]
        return reasons[0] if all(reasons) else ""

    def prepare(self, problem: Problem) -> Prepared:
        """Return the methods that support the problem, all of them prepared."""
        members = [member for member in self._members() if not member.unsupported(problem)]
        attempts = [member.prepare(problem) for member in members]
        return PreparedSequence(self.name, problem, attempts, hand_over=self.hand_over)

    def _members(self) -> list[Solver]:
        return [make_solver(name) for name in self.methods.split()]
