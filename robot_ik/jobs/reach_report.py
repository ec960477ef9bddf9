"""What happened in a reach, as far as it got."""

from __future__ import annotations

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
from robot_ik.jobs.verdict import Bound, Judgement
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
        read_back, by_camera: The two judgements.
        verdict: One sentence on the camera's judgement.
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
    verdict: str = ""
    camera_counts: bool = False
    before: Any = None
    after: Any = None
    problem: RobotIkError | None = None
    counters: dict[str, int] = field(default_factory=dict)

    @property
    def reached(self) -> bool:
        """Both judgements passed, or the only one that could be made."""
        if self.problem is not None or self.read_back is None or not self.read_back.passed:
            return False
        if not self.camera_counts:
            return True
        return self.by_camera is not None and self.by_camera.passed
