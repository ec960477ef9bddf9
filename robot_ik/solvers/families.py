"""What methods of one kind share: the options of Jacobian methods; goals and joints of the geometric ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from robot_ik.errors import UnsupportedJointError
from robot_ik.goals import Goal, PositionGoal
from robot_ik.kernels.bones import BONES
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.legacy_problem import LegacyProblem as Problem
from robot_ik.solvers.legacy_base import IterativeSolver, option

_KIND_NAMES = {HINGE: "hinge", SLIDE: "slide", BALL: "ball", FREE: "floating"}


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


@dataclass(frozen=True)
class BoneSolver(IterativeSolver):
    """A method that moves joint positions and lets the joints follow (``kernels/bones.py``).

    Class attributes:
        kinds: Joints that it can turn into bones.
        several: Whether it takes more than one goal at once.
    """

    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal,)
    kinds: ClassVar[tuple[int, ...]] = (HINGE, BALL)
    several: ClassVar[bool] = False

    def tables(self, problem: Problem) -> tuple[Any, ...]:
        nodes, goals = len(problem.arrays["world"]), len(problem.arrays["frames"])
        bones = BONES.zeros({"c": nodes + goals, "g": goals})
        return *super().tables(problem), BONES.pack(bones)

    def require_support(self, problem: Problem) -> None:
        """As every method.

        Raises:
            UnsupportedGoalError: A kind of goal, a goal without a position, or several at once.
            UnsupportedJointError: A joint that this method cannot move.
        """
        if (stiff := self._stiff(problem)) and self.unsupported(problem) == stiff:
            raise UnsupportedJointError(
                f"solver {self.name!r} cannot use the {stiff}; "
                f"it takes {' and '.join(_KIND_NAMES[kind] for kind in self.kinds)} joints",
                path=problem.robot.path,
                hint="freeze it with load_robot(…, joints=[…]), or use another solver",
            )
        super().require_support(problem)

    def unsupported(self, problem: Problem) -> str:
        if kind := super().unsupported(problem):
            return kind
        if len(problem.goals) > 1 and not self.several:
            return "several goals at once"
        for goal in problem.goals:
            if goal.weights[0] <= 0.0 < goal.weights[1]:
                return f"{goal.with_article} whose position weighs nothing"
        return self._stiff(problem)

    def _stiff(self, problem: Problem) -> str:
        """The first joint that this method cannot move; empty when there is none."""
        robot = problem.robot
        for k in problem.nodes:
            kind = int(robot.tree.kind[k])
            if kind not in self.kinds:
                return f"{_KIND_NAMES[kind]} joint {robot.joints[int(k)]!r}"
        return ""
