"""Draw a robot on a board with a delayed tracker, and measure the registration error.

The delay is the time from taking a picture until its measured pose is available: 100 ms in simple
systems, 250 ms in complex ones (Azuma 1997). ``ArDelay`` sets the delay and the measures against
it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.registration import (
    BoardObservation,
    BoardTracker,
    LatencyOptions,
    Registrar,
)
from robot_ik.camera.sources import Frame
from robot_ik.camera.targets import MarkerTarget, Target
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image
from robot_ik.testbed.ar.setup import ArDelay

_KEPT_PICTURES = 40
"""Pictures that are kept: more than the longest delay of a camera of 60 pictures a second."""


@dataclass(frozen=True, eq=False)
class Registered:
    """One finished picture.

    Attributes:
        image: (h, w, 3) BGR with robot and ball.
        shown: The camera's picture before robot and ball were drawn.
        delay: Seconds between the picture that was tracked and the one that is shown.
        error: RMS distance in pixels between the board's points at the pose used for drawing and
            the points in the picture. NaN if the board is not in the picture.
        pose_camera_board: Pose of the board used for drawing. None: nothing is drawn.
        pose_board_marker: The marker beside the board in the tracked picture. None: not visible.
    """

    image: Image
    shown: Frame
    delay: float
    error: float
    pose_camera_board: Pose | None
    pose_board_marker: Pose | None


class RecentBoards(BoardTracker):
    """A tracker that keeps the observations of the last pictures."""

    def __init__(
        self, board: Target, intrinsics: CameraIntrinsics, marker: MarkerTarget | None = None
    ) -> None:
        super().__init__(board, intrinsics, marker)
        self._recent: deque[tuple[Frame, BoardObservation | None]] = deque(maxlen=_KEPT_PICTURES)

    def observe(self, frame: Frame) -> BoardObservation | None:
        """Return the board in a picture; None if it is not visible."""
        for known, observation in self._recent:
            if known is frame:
                return observation
        observation = super().observe(frame)
        self._recent.append((frame, observation))
        return observation


class LateRegistrar:
    """Registers a robot on a board in each picture, with the delay that is set.

    Args:
        tracker: Tracks the board.
        drawn: The drawn robot.
        intrinsics: Optics of the pictures.
        delay: The delay and the measures against it.
    """

    def __init__(
        self,
        tracker: RecentBoards,
        drawn: DrawnRobot,
        intrinsics: CameraIntrinsics,
        delay: ArDelay,
    ) -> None:
        self._tracker = tracker
        self._intrinsics = intrinsics
        self._delay = delay
        options = LatencyOptions(delay.sync, delay.predict, delay.shift)
        self._registrar = Registrar(tracker, drawn, intrinsics, options)
        self._waiting: deque[Frame] = deque(maxlen=_KEPT_PICTURES)
        self._tracked: Frame | None = None
        self._observation: BoardObservation | None = None

    def take(self, frame: Frame) -> None:
        """Track a new picture. Its pose is used when the delay is over."""
        self._tracker.observe(frame)
        self._waiting.append(frame)
        latest = self._delay.sync == "latest"
        # The newest picture cannot be tracked before it is shown.
        while len(self._waiting) > (1 if latest else 0):
            if self._waiting[0].time > frame.time - self._delay.seconds:
                break
            self._tracked = self._waiting.popleft()
            self._observation = self._registrar.track(self._tracked)

    def composed(self, frame: Frame, qpos: Array) -> Registered:
        """Return the picture that is shown now, with the robot at ``qpos`` (model.nq,).

        Args:
            frame: The newest picture.
            qpos: Configuration of the drawn model.
        """
        tracked = self._tracked
        if tracked is None:
            return Registered(frame.image, frame, 0.0, np.nan, None, None)
        shown = frame if self._delay.sync == "latest" else tracked
        observation = self._observation
        image, _ = self._registrar.compose(observation, shown, qpos)
        pose, motion = self._registrar.place(observation, shown)
        return Registered(
            image,
            shown,
            shown.time - tracked.time,
            self._error(shown, pose, motion),
            pose,
            None if observation is None else observation.pose_board_marker,
        )

    def _error(self, shown: Frame, pose: Pose | None, motion: Array | None) -> float:
        """Return the registration error, see ``Registered.error``, px."""
        observation = self._tracker.observe(shown)
        if observation is None or pose is None:
            return float("nan")
        pixels = self._intrinsics.project(pose.apply(observation.board.points))
        if motion is not None:
            pixels = pixels @ motion[:, :2].T + motion[:, 2]
        return float(np.sqrt(np.mean(np.sum((pixels - observation.board.pixels) ** 2, axis=1))))
