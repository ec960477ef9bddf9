"""What one sight of a marker is worth: which of its two poses, how sure, and how much its goal weighs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.pose import BodyObservation, MarkerObservation
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

# Above this ratio of errors the two branches of a flat marker cannot be told apart: all wrong choices in our
# trials (low contrast, 1.5 m) had 0.63 or more.
AMBIGUITY_LIMIT = 0.6
# Both branches may still agree on where the tool should be, to this distance.
_SAME_PLACE = 0.002
# Standard deviation of an orientation that says nothing, rad.
_ANY_TURN = 10.0
# However uncertain, a goal weighs at least this: it was seen.
LEAST_WEIGHT = 0.05


@dataclass(frozen=True, eq=False)
class Sight:
    """One sight, in the world.

    Attributes:
        pose: Of the marker or body.
        covariance: (6, 6) of it, along the world's axes.
        place: (3,) the tool seen from the origin of ``pose``, along the world's axes, where only that is
            sure; None where the orientation is.
    """

    pose: Pose
    covariance: Array
    place: Array | None = None


class Choice:
    """Chooses between the two poses that a flat marker allows.

    Args:
        pose_marker_tool: Where the tool is wanted.
        normal: Known world direction (3,) of the marker's z axis, or None.
    """

    def __init__(self, pose_marker_tool: Pose, normal: ArrayLike | None) -> None:
        self._tool = pose_marker_tool
        self._normal = None if normal is None else np.asarray(normal, dtype=float).reshape(3)

    def of(self, seen: MarkerObservation | BodyObservation, pose_world_camera: Pose) -> Sight | None:
        """The sight of an observation, or None when nobody can say where the tool should go."""
        own = seen.pose_camera_body if isinstance(seen, BodyObservation) else seen.pose
        pose = pose_world_camera.compose(own)
        turn = np.kron(np.eye(2), pose_world_camera.rotation)
        covariance = turn @ seen.covariance @ turn.T
        if seen.alternative is None:
            return Sight(pose, covariance)
        other = pose_world_camera.compose(seen.alternative)
        if self._normal is not None:
            return Sight(min((pose, other), key=self._tilt), covariance)
        if seen.ambiguity <= AMBIGUITY_LIMIT:
            return Sight(pose, covariance)
        one, two = (branch.apply(self._tool.position) for branch in (pose, other))
        if np.linalg.norm(one - two) > _SAME_PLACE:
            return None
        unsure = np.zeros((6, 6))
        unsure[:3, :3] = covariance[:3, :3]
        unsure[3:, 3:] = _ANY_TURN**2 * np.eye(3)
        return Sight(pose, unsure, 0.5 * (one + two) - pose.position)

    def _tilt(self, pose: Pose) -> float:
        """Angle between the marker's z axis and the direction it is known to have; smaller is better."""
        assert self._normal is not None
        cosine = pose.rotation[:, 2] @ self._normal / np.linalg.norm(self._normal)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def sigmas_at(covariance: Array, lever: ArrayLike) -> tuple[float, float]:
    """Standard deviations (m, rad) in the worst direction of a point ``lever`` (3,) away from the origin.

    A small turn ω moves that point by ω × lever.  Covariance (6, 6) and lever have the same axes.
    """
    x, y, z = np.asarray(lever, dtype=float)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    jacobian = np.hstack([np.eye(3), -cross])
    metres = np.linalg.eigvalsh(jacobian @ covariance @ jacobian.T)[-1]
    radians = np.linalg.eigvalsh(covariance[3:, 3:])[-1]
    return float(np.sqrt(max(metres, 0.0))), float(np.sqrt(max(radians, 0.0)))


def goal_weight(sigma: float, trusted: float) -> float:
    """Weight of a goal that is known to ``sigma``: 1 up to ``trusted``, then trusted / σ, at least 0.05."""
    return max(LEAST_WEIGHT, min(1.0, trusted / sigma)) if sigma > 0.0 else 1.0
