"""Draw a virtual robot at a fixed place on a board in every picture.

``LatencyOptions`` are the measures against delay. ``drawing/drawn_robot.py`` draws the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.drawing.drawn_robot import Drawing, DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.motion_filter import MotionFilter
from robot_ik.camera.sources import Frame
from robot_ik.camera.targets import MarkerTarget, Observation, Target
from robot_ik.camera.tracker import Tracker
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

#: Pixels (2,) of points by their position on the board, metres.
Points = Mapping[tuple[float, ...], Array]
Sync = Literal["tracked", "latest"]

# Nothing is drawn on a board that has been lost for longer than this, s.
_HOLD = 0.25
# The rotation and zoom between two pictures are estimated if the points are spread by more than
# this, px^2.
_MIN_SPREAD = 1.0


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """A board in one picture, and a marker beside it.

    Attributes:
        board: The board. Its frame: x right, y up, z out of the print; a robot stands there.
        marker: The marker that is followed; None if there is none or it is not visible.
    """

    board: Observation
    marker: Observation | None = None

    @property
    def pose_board_marker(self) -> Pose | None:
        """Pose of the marker in the board's frame; None if it is not visible."""
        if self.marker is None:
            return None
        return self.board.pose.inverse().compose(self.marker.pose)


class BoardTracker:
    """Finds a board, and another marker, in the pictures of one camera.

    Args:
        board: The board.
        intrinsics: Intrinsics of the pictures.
        marker: A marker that is not on the board, or None.
    """

    def __init__(
        self, board: Target, intrinsics: CameraIntrinsics, marker: MarkerTarget | None = None
    ) -> None:
        self.board = board
        self._tracker = Tracker(intrinsics, [board] if marker is None else [board, marker])

    def observe(self, frame: Frame) -> BoardObservation | None:
        """Return the board in a picture; None if it is not visible.

        Raises:
            CalibrationError: The frame does not have the size of the intrinsics.
        """
        board = None
        marker = None
        for observation in self._tracker.observe(frame):
            if observation.target is self.board:
                board = observation.seen_from(self.board.pose_target_stand)
            else:
                marker = observation
        return None if board is None else BoardObservation(board, marker)


def optical_motion(before: Points, after: Points) -> Array:
    """Return the shift, rotation and zoom (2, 3) in the picture from one observation to the next.

    Least squares over the points in both observations: z' = a z + b with complex pixels. A single
    point determines only the shift.
    """
    common = [point for point in before if point in after]
    if not common:
        return np.eye(2, 3)
    z = np.array([complex(*before[point]) for point in common])
    w = np.array([complex(*after[point]) for point in common])
    spread = z - z.mean()
    power = float(np.vdot(spread, spread).real)
    a = np.vdot(spread, w - w.mean()) / power if power > _MIN_SPREAD else 1.0 + 0.0j
    b = w.mean() - a * z.mean()
    return np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag]])


@dataclass(frozen=True)
class LatencyOptions:
    """Measures against delay (Azuma 1997, section 4.4).

    Attributes:
        sync: ``tracked`` shows the picture in which the pose was measured: the video waits for the
            tracker. ``latest`` shows the newest picture.
        predict: Draw where the board will be when the picture shown was taken (Kalman filter).
        shift: Move the finished drawing by the motion of the board's points in the picture.
    """

    sync: Sync = "tracked"
    predict: bool = False
    shift: bool = False


class Registrar:
    """Tracks a board, draws a robot on it, and composes the picture.

    Args:
        tracker: Finds the board; None for a camera whose pose is known.
        drawn: The robot.
        intrinsics: Intrinsics of the pictures.
        latency_options: Measures against delay.
        pose_board_camera: Pose of the camera if there is no ``tracker``.
        alpha: Opacity of the robot, from 0 to 1.
    """

    def __init__(
        self,
        tracker: BoardTracker | None,
        drawn: DrawnRobot,
        intrinsics: CameraIntrinsics,
        latency_options: LatencyOptions | None = None,
        *,
        pose_board_camera: Pose | None = None,
        alpha: float = 1.0,
    ) -> None:
        self.drawn = drawn
        self.latency_options = latency_options or LatencyOptions()
        self._tracker = tracker
        self._intrinsics = intrinsics
        self._alpha = alpha
        self._fixed = None if pose_board_camera is None else pose_board_camera.inverse()
        self._filter = MotionFilter() if self.latency_options.predict else None
        self._last: BoardObservation | None = None

    def track(self, frame: Frame) -> BoardObservation | None:
        """Return the board in a frame. An observation stays valid for a quarter of a second."""
        if self._tracker is None:
            return None
        observation = self._tracker.observe(frame)
        if observation is not None:
            self._last = observation
            if self._filter is not None:
                board = observation.board
                self._filter.update(board.time, board.pose, board.covariance)
        elif self._last is not None and frame.time - self._last.board.time > _HOLD:
            self._last = None
        return self._last

    def compose(
        self, observation: BoardObservation | None, shown: Frame, qpos: ArrayLike
    ) -> tuple[Image, Drawing | None]:
        """Return the picture ``shown`` with the robot at ``qpos`` (nq,), and the drawing.

        The drawing is None if no board is known.
        """
        pose, motion = self.place(observation, shown)
        if pose is None:
            return shown.image, None
        drawing = self.drawn.draw(qpos, self._intrinsics, pose.inverse())
        if motion is not None:
            drawing = drawing.shifted(motion, *self._intrinsics.size)
        image = shown.image.copy()
        drawing.over(image, self._alpha)
        return image, drawing

    def place(
        self, observation: BoardObservation | None, shown: Frame
    ) -> tuple[Pose | None, Array | None]:
        """Return ``pose_camera_board`` for the drawing, and a motion (2, 3) of the finished one.

        Either is None if there is none.
        """
        if self._tracker is None:
            return self._fixed, None
        if observation is None:
            return None, None
        board = observation.board
        pose = board.pose
        if self._filter is not None and self._filter.started:
            pose = self._filter.predict(shown.time).pose
        if not self.latency_options.shift or not shown.time > board.time:
            return pose, None
        now = self._tracker.observe(shown)
        if now is None:
            return pose, None
        after = _points(now.board.points, now.board.pixels)
        if self._filter is None:
            return pose, optical_motion(_points(board.points, board.pixels), after)
        # The drawing is of the predicted board. The motion corrects only the error of the
        # prediction.
        predicted = self._intrinsics.project(pose.apply(now.board.points))
        return pose, optical_motion(_points(now.board.points, predicted), after)


def _points(points: Array, pixels: Array) -> Points:
    return dict(zip(map(tuple, points.tolist()), pixels, strict=True))
