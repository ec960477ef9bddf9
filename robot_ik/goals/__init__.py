"""Goals: what is wanted of the robot.  One class a kind; ``GOALS`` lists them."""

from __future__ import annotations

from robot_ik.goals.base import Goal, Rows, Tolerance
from robot_ik.goals.frames import AimGoal, OrientationGoal, PoseGoal, PositionGoal
from robot_ik.goals.places import HalfSpaceGoal, LineGoal, PlaneGoal
from robot_ik.goals.pose_prior import PosePrior, PosePriorGoal
from robot_ik.goals.whole_body import CenterOfMassGoal, PostureGoal

__all__ = [
    "GOALS",
    "AimGoal",
    "CenterOfMassGoal",
    "Goal",
    "HalfSpaceGoal",
    "LineGoal",
    "OrientationGoal",
    "PlaneGoal",
    "PoseGoal",
    "PosePrior",
    "PosePriorGoal",
    "PositionGoal",
    "PostureGoal",
    "Rows",
    "Tolerance",
]

GOALS: tuple[type[Goal], ...] = (
    PositionGoal,
    OrientationGoal,
    PoseGoal,
    AimGoal,
    LineGoal,
    PlaneGoal,
    HalfSpaceGoal,
    CenterOfMassGoal,
    PostureGoal,
    PosePriorGoal,
)
