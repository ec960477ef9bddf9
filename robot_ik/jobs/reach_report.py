"""What happened in a reach, as far as it got."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import RobotIkError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.jobs.eyes import Eyes, Seen
from robot_ik.jobs.limbs import Limbs
from robot_ik.jobs.reach_request import ReachRequest
from robot_ik.jobs.verdict import EXACT, Bound, Judgement, Verdict, decide
from robot_ik.motion.reports import Execution, FollowReport
from robot_ik.motion.trajectory import Trajectory
from robot_ik.problem import Tolerance

if TYPE_CHECKING:
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution

Array = NDArray[np.float64]

# The solve is asked for far more than the servos can do, so that its miss does not count.
SOLVE_TOLERANCE = Tolerance(position=1e-5, angle=1e-4)


@dataclass(eq=False)
class ReachReport:
    """What happened, as far as it got; fields stay None where it did not get.

    Attributes:
        robot: With the limits that were used.
        frame: What was to reach the goal.
        seen: The target marker in the first picture.
        goal, target: What was wanted; its pose in the world.
        tolerance: What the solution's miss may be; part of ``bound``.
        behind: While following: how far the tool was from the goal of the moment, median and largest, metres.
        problem: Why it ended early: an error that means "not achieved".
        goal_sigma: How well ``target`` is known beside what the arm was sent to; zeros where both are one.
        read_back, by_camera: The two judgements.
        blind: Why no camera looked at the arm; empty: one looked.
    """

    request: ReachRequest
    robot: Robot
    frame: str
    limbs: Limbs
    eyes: Eyes | None
    seen: Seen | None = None
    goal: Goal | None = None
    target: Pose | None = None
    solution: Solution | None = None
    microseconds: float | None = None
    trajectory: Trajectory | None = None
    execution: Execution | None = None
    following: FollowReport | None = None
    q_start: Array | None = None
    q_end: Array | None = None
    tolerance: Tolerance = SOLVE_TOLERANCE
    behind: tuple[float, float] | None = None
    bound: Bound | None = None
    read_back: Judgement | None = None
    by_camera: Judgement | None = None
    goal_sigma: Bound = EXACT
    blind: str = ""
    before: Any = None
    after: Any = None
    problem: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def decision(self) -> Verdict:
        """Did it arrive, and why so; text and exit code are its."""
        if self.problem is not None or self.read_back is None:
            return Verdict(False, "")
        return decide(
            self.read_back,
            self.by_camera,
            servos=self.limbs.arm is not None,
            blind=self.blind,
            seen_goal=self.request.goal is None,
            stopped_short=self._stopped_short(),
            followed=self.following is not None,
        )

    @property
    def reached(self) -> bool:
        """Whether it arrived."""
        return self.decision.reached

    @property
    def verdict(self) -> str:
        """One sentence on that; empty where ``problem`` says it."""
        return self.decision.text

    def _stopped_short(self) -> str:
        """Which servo did not get to where it was sent, by its own account; empty: all did."""
        off = None if self.execution is None else self.execution.final_error
        if off is None or self.following is not None:
            return ""
        worst = int(abs(off).argmax())
        if abs(off[worst]) <= self.limbs.resolution[worst]:
            return ""
        joint = self.execution.joints[worst]  # type: ignore[union-attr]
        return (
            f"{joint} is {math.degrees(abs(float(off[worst]))):.2f}° from its command by its own account: "
            "is it held, overloaded or too slow?"
        )
