"""What the geometric methods share on the Python side: which joints and goals they take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from robot_ik.errors import UnsupportedGoalError, UnsupportedJointError
from robot_ik.goals import Goal, PositionGoal
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.problem import Problem
from robot_ik.solvers.base import IterativeSolver

_WORDS = {HINGE: "hinge", SLIDE: "slide", BALL: "ball", FREE: "floating"}


@dataclass(frozen=True)
class BoneSolver(IterativeSolver):
    """A method that moves joint positions and lets the joints follow (``kernels/aiming.py``).

    Class attributes:
        kinds: Joints that it can turn into bones.
        several: Whether it takes more than one goal at once.
    """

    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal,)
    kinds: ClassVar[tuple[int, ...]] = (HINGE, BALL)
    several: ClassVar[bool] = False

    def require_support(self, problem: Problem) -> None:
        """As every method, and also refuses what cannot be made into bones.

        Raises:
            UnsupportedGoalError: A kind of goal, a goal without a position, or several at once.
            UnsupportedJointError: A joint that is neither turned nor shifted by this method.
        """
        super().require_support(problem)
        if len(problem.goals) > 1 and not self.several:
            raise UnsupportedGoalError(self.name, "several goals at once", self._others(problem))
        for goal in problem.goals:
            if goal.weights[0] <= 0.0 < goal.weights[1]:
                raise UnsupportedGoalError(
                    self.name, f"a {goal.name} whose position weighs nothing", self._others(problem)
                )
        tree = problem.robot.tree
        for k in problem.nodes:
            if int(tree.kind[k]) not in self.kinds:
                raise UnsupportedJointError(
                    f"solver {self.name!r} cannot use the {_WORDS[int(tree.kind[k])]} joint "
                    f"{problem.robot.joints[int(k)]!r}; "
                    f"it takes {' and '.join(_WORDS[kind] for kind in self.kinds)} joints",
                    path=problem.robot.path,
                    hint="freeze it with load_robot(…, joints=[…]), or use another solver",
                )

    def _others(self, problem: Problem) -> tuple[str, ...]:
        """Methods that take these goals together, whatever they weigh."""
        from robot_ik.solvers import SOLVERS

        kinds = tuple({type(goal) for goal in problem.goals})
        return tuple(
            name
            for name, method in SOLVERS.items()
            if all(issubclass(kind, method.goals) for kind in kinds) and not issubclass(method, BoneSolver)
        )
