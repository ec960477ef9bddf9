"""A marker in front of a camera as a source of goals."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.pose import MarkerObservation
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.track import MarkerTracker
from robot_ik.geometry import Pose

if TYPE_CHECKING:
    from robot_ik.goals import PoseGoal, PositionGoal

_log = logging.getLogger(__name__)

# Above this ratio of errors the two branches of a flat marker cannot be told apart: all wrong choices in our
# trials (low contrast, 1.5 m) had 0.63 or more.
AMBIGUITY_LIMIT = 0.6
# Both branches may still agree on where the tool should be, to this distance.
_SAME_PLACE = 0.002
# Without a new picture for this long the last goal is history.
_MAX_AGE_S = 0.5


class MarkerGoalSource:
    """Goals that follow a marker: a pose of the tool, fixed relative to the marker.

    What comes out:

    * marker seen, orientation certain: a ``PoseGoal``;
    * orientation uncertain (``ambiguity`` above 0.6), but both possible poses put the tool in the same
      place to 2 mm: a ``PositionGoal`` there;
    * orientation uncertain otherwise, marker not seen, seen twice, or no new picture for half a second:
      None, which means hold where you are.

    Only ``marker_id`` can become a goal, whatever else is in view.

    Args:
        source: Gives the frames; their truth is removed before anything looks at them.
        tracker: Knows the optics, the dictionary and the sizes.
        pose_world_camera: Where the camera is.
        marker_id: The marker to follow.
        pose_marker_tool: The wanted pose of the frame, seen from the marker (x right, y up, z out of the
            printed face).
        frame: Name of the robot's frame that shall go there.
        normal: World direction (3,) of the marker's z axis where it is known, for example (0, 0, 1) on a
            table.  The branch nearer to it is taken, and no orientation is uncertain any more.

    Attributes:
        last: Observation of the marker in the last frame; None when it was not seen.
        last_frame: The last frame looked at, without its truth; None before the first.
    """

    def __init__(
        self,
        source: FrameSource,
        tracker: MarkerTracker,
        pose_world_camera: Pose,
        marker_id: int,
        pose_marker_tool: Pose,
        frame: str = "gripper",
        *,
        normal: ArrayLike | None = None,
    ) -> None:
        self.source = source
        self.tracker = tracker
        self.pose_world_camera = pose_world_camera
        self.marker_id = marker_id
        self.pose_marker_tool = pose_marker_tool
        self.tool = frame
        self.last: MarkerObservation | None = None
        self.last_frame: Frame | None = None
        self._normal = None if normal is None else np.asarray(normal, dtype=float).reshape(3)
        self._goal: PoseGoal | PositionGoal | None = None
        self._fresh_at = -np.inf

    def poll(self, now: float) -> PoseGoal | PositionGoal | None:
        """The goal for the time ``now`` (seconds on the run's clock); None means hold.

        Cameras are not waited for: between two pictures the goal stays the same.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames have not the size of the calibration.
        """
        frame = self._new_frame()
        if frame is not None:
            self._fresh_at = now
            self.last_frame = frame
            self.last = self._look(frame)
            self._goal = None if self.last is None else self._make_goal(self.last)
        elif self.source.live and now - self._fresh_at > _MAX_AGE_S:
            self.last = self._goal = None
        return self._goal

    def _new_frame(self) -> Frame | None:
        newest = getattr(self.source, "newest", None)
        frame: Frame | None = newest() if newest is not None else self.source.read()
        if frame is None or (self.last_frame is not None and frame.sequence == self.last_frame.sequence):
            return None
        return frame.without_truth()

    def _look(self, frame: Frame) -> MarkerObservation | None:
        seen = [o for o in self.tracker.observe(frame) if o.id == self.marker_id]
        if len(seen) > 1:
            _log.warning("marker %d is in view %d times; holding", self.marker_id, len(seen))
        return seen[0] if len(seen) == 1 else None

    def _make_goal(self, seen: MarkerObservation) -> PoseGoal | PositionGoal | None:
        # Imported at the first goal: looking needs no robot.
        from robot_ik.goals import PoseGoal, PositionGoal

        target = self._tool_pose(seen.pose)
        if seen.alternative is not None:
            other = self._tool_pose(seen.alternative)
            if self._normal is not None:
                if self._tilt(seen.alternative) < self._tilt(seen.pose):
                    target = other
            elif seen.ambiguity > AMBIGUITY_LIMIT:
                if np.linalg.norm(target.position - other.position) > _SAME_PLACE:
                    return None
                return PositionGoal(self.tool, position=0.5 * (target.position + other.position))
        return PoseGoal(self.tool, position=target.position, wxyz=target.wxyz)

    def _tool_pose(self, pose_camera_marker: Pose) -> Pose:
        return self.pose_world_camera.compose(pose_camera_marker).compose(self.pose_marker_tool)

    def _tilt(self, pose_camera_marker: Pose) -> float:
        """Angle between the marker's z axis and the direction it is known to have; smaller is better."""
        assert self._normal is not None
        axis = self.pose_world_camera.compose(pose_camera_marker).rotation[:, 2]
        return float(np.arccos(np.clip(axis @ self._normal / np.linalg.norm(self._normal), -1.0, 1.0)))
