"""Turn observations into goals for inverse kinematics.

The weight of a goal follows from the covariance of the observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.targets import Observation
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.ports import Array

# Above this ambiguity the orientation is unknown. All wrong choices in our trials had 0.63 or more.
MAX_AMBIGUITY = 0.6
# Smallest weight of a goal.
MIN_WEIGHT = 0.05
# Both poses agree on the position of the tool if it differs by less than this, metres.
_SAME_POSITION = 0.002
# Standard deviations up to which a goal has weight 1, m and rad.
TRUSTED_POSITION = 1e-3
TRUSTED_ANGLE = math.radians(0.5)
# Standard deviation of an unknown orientation, rad.
_UNKNOWN_ANGLE = 10.0


@dataclass(frozen=True, eq=False)
class PlacedTarget:
    """An observed target in the world.

    Attributes:
        pose: ``pose_world_target``.
        covariance: (6, 6) translation (m) over rotation (rad), both along the world's axes.
        tool_offset: (3,) from the target to the tool along the world's axes, metres, if the
            orientation is ambiguous but the position of the tool is not. None if the orientation is
            known.
    """

    pose: Pose
    covariance: Array
    tool_offset: Array | None = None

    def goal(self, pose_target_tool: Pose, frame: str | None = None) -> PoseGoal | PositionGoal:
        """Return the goal of a tool that keeps a pose relative to the target."""
        if self.tool_offset is not None:
            sigma, _ = worst_sigmas(self.covariance, np.zeros(3))
            position = self.pose.position + self.tool_offset
            return PositionGoal(frame, position, weight=goal_weight(sigma, TRUSTED_POSITION))
        target = self.pose.compose(pose_target_tool)
        position_sigma, angle_sigma = worst_sigmas(
            self.covariance, target.position - self.pose.position
        )
        return PoseGoal(
            frame,
            target.position,
            target.wxyz,
            position_weight=goal_weight(position_sigma, TRUSTED_POSITION),
            angle_weight=goal_weight(angle_sigma, TRUSTED_ANGLE),
        )


def observed_goal(
    observation: Observation,
    pose_world_camera: Pose,
    pose_target_tool: Pose,
    frame: str | None = None,
) -> PoseGoal | PositionGoal | None:
    """Return the goal of a tool that keeps a pose relative to an observed target.

    Args:
        observation: Observation of the target.
        pose_world_camera: Pose of the camera.
        pose_target_tool: Wanted pose of the tool in the target's frame.
        frame: Frame of the robot that is the tool; None: its default tool.

    Returns:
        A ``PoseGoal``; a ``PositionGoal`` if the orientation is ambiguous but the position is not;
        else None.
    """
    placed = place_target(observation, pose_world_camera, pose_target_tool)
    return None if placed is None else placed.goal(pose_target_tool, frame)


def place_target(
    observation: Observation, pose_world_camera: Pose, pose_target_tool: Pose
) -> PlacedTarget | None:
    """Return an observed target in the world; None if the position of the tool is ambiguous.

    Arguments as for ``observed_goal``.
    """
    pose = pose_world_camera.compose(observation.pose)
    rotation = np.zeros((6, 6))
    rotation[:3, :3] = pose_world_camera.rotation
    rotation[3:, 3:] = pose_world_camera.rotation
    covariance = rotation @ observation.covariance @ rotation.T
    if observation.alternative is None or observation.ambiguity <= MAX_AMBIGUITY:
        return PlacedTarget(pose, covariance)

    other = pose_world_camera.compose(observation.alternative)
    tool = pose.apply(pose_target_tool.position)
    other_tool = other.apply(pose_target_tool.position)
    if np.linalg.norm(tool - other_tool) > _SAME_POSITION:
        return None
    position_only = np.zeros((6, 6))
    position_only[:3, :3] = covariance[:3, :3]
    position_only[3:, 3:] = _UNKNOWN_ANGLE**2 * np.eye(3)
    return PlacedTarget(pose, position_only, 0.5 * (tool + other_tool) - pose.position)


def worst_sigmas(covariance: Array, lever: ArrayLike) -> tuple[float, float]:
    """Return the largest standard deviations (m, rad) of a point away from the origin.

    Covariance (6, 6) and ``lever`` (3,), the position of the point, have the same axes. A small
    rotation w moves the point by w x lever.
    """
    x, y, z = np.asarray(lever, dtype=float).tolist()
    jacobian = np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]])
    of_point = jacobian @ covariance @ jacobian.T
    largest = np.linalg.eigvalsh(np.stack([of_point, covariance[3:, 3:]]))[:, -1]
    position, angle = np.sqrt(np.maximum(largest, 0.0)).tolist()
    return position, angle


def goal_weight(sigma: float, trusted: float) -> float:
    """Return the weight of a goal with the standard deviation ``sigma``.

    It is 1 up to ``trusted``, then trusted / sigma, and at least ``MIN_WEIGHT``.
    """
    return max(MIN_WEIGHT, min(1.0, trusted / sigma)) if sigma > 0.0 else 1.0
