"""The goals and joints that the geometric methods take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from robot_ik.compiled_problem import CompiledProblem
from robot_ik.errors import UnsupportedJointError
from robot_ik.goals import Goal, PositionGoal
from robot_ik.kernels.bones import BONES
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.problem import Problem
from robot_ik.solvers.base import IterativeSolver

_KIND_NAMES = {HINGE: "hinge", SLIDE: "slide", BALL: "ball", FREE: "floating"}


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

    def tables(self, compiled: CompiledProblem) -> tuple[Any, ...]:
        nodes, goals = len(compiled.arrays["world"]), len(compiled.arrays["frames"])
        bones = BONES.zeros({"c": nodes + goals, "g": goals})
        return *super().tables(compiled), BONES.pack(bones)

    def applies(self, problem: Problem) -> bool:
        return super().applies(problem) and not self._stiff(problem)

    def require_support(self, problem: Problem) -> None:
        """As every method, and also refuses what cannot be made into bones.

        Raises:
            UnsupportedGoalError: A kind of goal, a goal without a position, or several at once.
            UnsupportedJointError: A joint that this method cannot move.
        """
        super().require_support(problem)
        if stiff := self._stiff(problem):
            raise UnsupportedJointError(
                f"solver {self.name!r} cannot use the {stiff}; "
                f"it takes {' and '.join(_KIND_NAMES[kind] for kind in self.kinds)} joints",
                path=problem.robot.path,
                hint="freeze it with load_robot(…, joints=[…]), or use another solver",
            )

    def unsupported(self, problem: Problem) -> str:
        if kind := super().unsupported(problem):
            return kind
        if len(problem.goals) > 1 and not self.several:
            return "several goals at once"
        for goal in problem.goals:
            if goal.weights[0] <= 0.0 < goal.weights[1]:
                return f"a {goal.name} whose position weighs nothing"
        return ""

    def _stiff(self, problem: Problem) -> str:
        """The first joint that this method cannot move; empty when there is none."""
        robot = problem.robot
        for k in problem.nodes:
            kind = int(robot.tree.kind[k])
            if kind not in self.kinds:
                return f"{_KIND_NAMES[kind]} joint {robot.joints[int(k)]!r}"
        return ""
