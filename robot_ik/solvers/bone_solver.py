"""``BoneSolver``: methods that treat joints as points with targets (``kernels/bones.py``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from robot_ik.goals import Goal, PositionGoal
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE
from robot_ik.solvers.iterative import IterativeSolver

if TYPE_CHECKING:
    from robot_ik.problem import Problem

_KIND_NAMES = {HINGE: "hinge", SLIDE: "slide", BALL: "ball", FREE: "floating"}


@dataclass(frozen=True)
class BoneSolver(IterativeSolver):
    """A method that computes targets of points, which the joints then approach.

    Class attributes:
        joint_kinds: Kinds of joints that it can turn into bones.
        several_goals: Whether it supports several goals at once.
    """

    goals: ClassVar[tuple[type[Goal], ...]] = (PositionGoal,)
    joint_kinds: ClassVar[tuple[int, ...]] = (HINGE, BALL)
    several_goals: ClassVar[bool] = False
    # A pass cannot be shortened. After an undo the next pass would be the same.
    polish_undoes_steps: ClassVar[bool] = False

    def unsupported(self, problem: Problem) -> str:
        if unsupported := super().unsupported(problem):
            return unsupported
        if len(problem.parts) > 1 and not self.several_goals:
            return "several goals at once"
        for goal in problem.parts:
            position_weight, angle_weight = goal.weights
            if position_weight <= 0.0 < angle_weight:
                return f"{goal.with_article} without weight on its position"
        return self._unsupported_joint(problem)

    def _unsupported_joint(self, problem: Problem) -> str:
        """Return the first joint that this method cannot move; "" if there is none."""
        robot = problem.robot
        for k in problem.compiled.block.arrays["nodes"].tolist():
            kind = int(robot.tree.kind[k])
            if kind not in self.joint_kinds:
                return f"the {_KIND_NAMES[kind]} joint {robot.joints[k]!r}"
        return ""
