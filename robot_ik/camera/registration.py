"""The virtual robot in the camera's picture, in time: kept on a board from picture to picture.

``LatencyOptions`` are the measures against delay. ``camera/drawing/drawn_robot.py`` draws the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.boards.board import MarkerBoard, PatternBoard
from robot_ik.camera.drawing.drawn_robot import Drawing, DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.motion_filter import MotionFilter
from robot_ik.camera.observations import MarkerObservation
from robot_ik.camera.sources import Frame
from robot_ik.camera.tracker import MarkerTracker
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

#: Pixels (2,) of corners by where they are on the board, metres.
Points = Mapping[tuple[float, ...], Array]
Sync = Literal["tracked", "latest"]

# A board that is lost for longer is not drawn upon any more, seconds.
_HOLD_S = 0.25
# Believed of a pattern, whose pose comes without a covariance: metres and radians.
_PATTERN_SIGMA = (2e-4, 1e-3)


@dataclass(frozen=True, eq=False)
class Seen:
    """A board in one picture.

    Attributes:
        pose_camera_board: Its middle: x right, y up, z out of the print.
        covariance: (6, 6) of it, as in ``BodyObservation``.
        points: Where its corners were seen.
        marker: The other marker, when it was asked for and seen.
        error: RMS reprojection error, px.
        time: Of the picture.
    """

    pose_camera_board: Pose
    covariance: Array
    points: Points
    marker: MarkerObservation | None
    error: float
    time: float


class BoardWatcher:
    """Finds a board, and another marker, in pictures; keeps to the neighbourhood of the last find.

    Args:
        board: See ``parse_board``.
        intrinsics: Of the pictures' size.
        other: Id and side in metres of a marker that is not on the board.
        window: Search only near the last find (Azuma's first measure: less delay).
        dictionary: Of that marker, where the board has none.
    """

    def __init__(
        self,
        board: MarkerBoard | PatternBoard,
        intrinsics: CameraIntrinsics,
        other: tuple[int, float] | None = None,
        *,
        window: bool = True,
        dictionary: str = "DICT_5X5_50",
    ) -> None:
        self._board, self._intrinsics, self._other = board, intrinsics, other
        sizes = {} if other is None else dict([other])
        if isinstance(board, MarkerBoard):
            sizes |= {id: side for id, (side, _) in board.layout.items()}
            dictionary = board.dictionary
        self._tracker = MarkerTracker(intrinsics, dictionary, sizes, window=window) if sizes else None

    def see(self, frame: Frame) -> Seen | None:
        """The board in a picture; None when it is not there.

        Raises:
            CalibrationError: The picture has not the size of the calibration.
        """
        tracker, marker = self._tracker, None
        if tracker is not None and self._other is not None:
            others = tracker.observe(frame, self._other[:1])
            marker = others[0] if len(others) == 1 else None
        if isinstance(self._board, PatternBoard):
            view = self._board.see(frame, self._intrinsics)
            if view is None:
                return None
            middle, pixels = self._board.layout[0][1], view.pixels
            on_board, pose = middle.inverse().apply(view.points), view.pose_camera_board.compose(middle)
            covariance = np.diag(np.repeat(np.square(_PATTERN_SIGMA), 3))
            off = self._intrinsics.project(view.pose_camera_board.apply(view.points)) - pixels
            error = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        else:
            assert tracker is not None, "a board of markers has a tracker"
            body = tracker.observe_body(frame, self._board.layout)
            if body is None:
                return None
            found = tracker.corners(frame)
            pixels = np.concatenate([found[i].corners for i in body.ids])
            on_board, pose = self._board.corners(body.ids), body.pose_camera_body
            covariance, error = body.covariance, body.reprojection_error
        points = dict(zip(map(tuple, on_board.tolist()), pixels, strict=True))
        return Seen(pose, covariance, points, marker, error, frame.time)


def optical_motion(before: Points, after: Points) -> Array:
    """Shift, rotation and zoom (2, 3) in the picture from the corners of one observation to the next.

    Least squares over the corners seen twice: z' = a z + b with complex pixels; only a shift for one corner.
    """
    common = [point for point in before if point in after]
    if not common:
        return np.eye(2, 3)
    z = np.array([complex(*before[k]) for k in common])
    w = np.array([complex(*after[k]) for k in common])
    spread = z - z.mean()
    power = float(np.vdot(spread, spread).real)
    a = np.vdot(spread, w - w.mean()) / power if power > 1.0 else 1.0 + 0.0j
    b = w.mean() - a * z.mean()
    return np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag]])


@dataclass(frozen=True)
class LatencyOptions:
    """What is done about delay: Azuma 1997, section 4.4.

    Attributes:
        sync: ``tracked`` shows the picture the pose was measured in: the video waits for the tracker.
            ``latest`` shows the newest one.
        predict: Draw where the board will be when the picture shown was taken (Kalman).
        shift: Move the finished drawing by how the board's corners moved in the picture.
    """

    sync: Sync = "tracked"
    predict: bool = False
    shift: bool = False


class Registrar:
    """Tracks, draws and puts together.

    Args:
        watcher: Finds the board; None for a camera whose place is known.
        drawn: The robot.
        intrinsics: Of the pictures.
        latency_options: What is done about delay.
        pose_board_camera: Where the camera is when there is no ``watcher``.
        alpha: Opacity of the robot, 0 to 1.
    """

    def __init__(
        self,
        watcher: BoardWatcher | None,
        drawn: DrawnRobot,
        intrinsics: CameraIntrinsics,
        latency_options: LatencyOptions | None = None,
        *,
        pose_board_camera: Pose | None = None,
        alpha: float = 1.0,
    ) -> None:
        self.drawn = drawn
        self.latency_options = latency_options or LatencyOptions()
        self._watcher, self._intrinsics, self._alpha = watcher, intrinsics, alpha
        self._fixed = None if pose_board_camera is None else pose_board_camera.inverse()
        self._filter = MotionFilter() if self.latency_options.predict else None
        self._last: Seen | None = None

    def track(self, frame: Frame) -> Seen | None:
        """Looks for the board; the last observation counts a quarter of a second longer."""
        if self._watcher is None:
            return None
        seen = self._watcher.see(frame)
        if seen is not None:
            self._last = seen
            if self._filter is not None:
                self._filter.update(seen.time, seen.pose_camera_board, seen.covariance)
        elif self._last is not None and frame.time - self._last.time > _HOLD_S:
            self._last = None
        return self._last

    def compose(self, seen: Seen | None, shown: Frame, qpos: ArrayLike) -> tuple[Image, Drawing | None]:
        """The picture ``shown`` with the robot at ``qpos`` (nq,), drawn for ``seen``, and the drawing.

        That is None when there was no board to stand on.
        """
        pose, motion = self.place(seen, shown)
        if pose is None:
            return shown.image, None
        drawing = self.drawn.draw(qpos, self._intrinsics, pose.inverse())
        if motion is not None:
            drawing = drawing.shifted(motion, *self._intrinsics.size)
        image = shown.image.copy()
        drawing.over(image, self._alpha)
        return image, drawing

    def place(self, seen: Seen | None, shown: Frame) -> tuple[Pose | None, Array | None]:
        """``pose_camera_board`` to draw for, and how to move the drawing (2, 3) after that, if at all."""
        if self._watcher is None:
            return self._fixed, None
        if seen is None:
            return None, None
        pose = seen.pose_camera_board
        if self._filter is not None and self._filter.started:
            pose = self._filter.predict(shown.time).pose
        if not self.latency_options.shift or not shown.time > seen.time:
            return pose, None
        now = self._watcher.see(shown)
        if now is None:
            return pose, None
        if self._filter is None:
            return pose, optical_motion(seen.points, now.points)
        # the drawing is of the predicted board already: only what the prediction lacks is left
        where = self._intrinsics.project(pose.apply(list(now.points)))
        return pose, optical_motion(dict(zip(now.points, where, strict=True)), now.points)
