"""Camera and board of a job in which an arm moves one of them: real ones or simulated ones."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from robot_ik.camera.calibration.handeye import Mount, Mounting
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene, SyntheticSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerTarget, Squares, Target, marker_grid
from robot_ik.errors import CameraError, ConfigError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import Robot
from robot_ik.workcell.arm_camera.view_planning import ViewTask, is_visible
from robot_ik.workcell.robot_setup import ArmRequest, RobotSetup
from robot_ik.workcell.scene import Scene, scene_for
from robot_ik.workcell.vision import open_calibrated

# Error of the poses with which the simulated job plans: translation (m), then rotation (rad).
# Before a calibration, poses are known roughly.
_PLANNING_ERROR = np.array([0.02, -0.015, 0.01, 0.02, -0.015, 0.02])

# Position of the simulated camera on the hand: beside the tool and behind it, in reaches of the
# robot.
_BESIDE = 0.12
_BEHIND = 0.08
# Its rotation towards the tool and about its own axis, rad.
_INWARDS = 0.2
_ROLL = 0.4
# Sides of the tool that are tried for the camera, rad about the axis of the tool.
_SIDES = (0.0, math.pi, 0.5 * math.pi, -0.5 * math.pi)
# The arm must not hide points at this depth in front of the camera, in reaches. The points are
# beyond the tool.
_VIEW_DEPTH = 0.12
# Normalised coordinates of these points.
_VIEW_COLUMNS = (-0.2, 0.0, 0.2)
_VIEW_ROWS = (-0.15, 0.15)

# The simulated board on the table: columns, rows and first id.
_COLUMNS = 3
_ROWS = 2
_FIRST_ID = 30
# Side of its markers and gap between them, in sides of the scene's marker.
_MARKER_SHARE = 0.6
_GAP_SHARE = 0.2

# Number of pictures of a real camera that are discarded when the arm comes to rest. They were
# exposed before.
_STALE_FRAMES = 3


@dataclass(frozen=True)
class HandEyeRequest(ArmRequest):
    """An arm, a camera, a board, and the number of pictures.

    Attributes:
        mounting: ``eye_in_hand`` or ``eye_to_hand``.
        camera: ``synthetic``, or a source for ``open_source``.
        intrinsics: Calibration file. A real camera needs it.
        board: The board. None: the simulated one.
        pose_parent_camera: Rough pose of the camera. None: that of the scene.
        pose_other_board: Rough pose of the board. None: that of the scene.
        views: Number of pictures.
        dry_run: Whether only to plan. Nothing moves then.
    """

    mounting: Mounting = "eye_to_hand"
    camera: str = "synthetic"
    intrinsics: Path | None = None
    board: Target | None = None
    pose_parent_camera: Pose | None = None
    pose_other_board: Pose | None = None
    views: int = 15
    dry_run: bool = False


@dataclass(frozen=True, eq=False)
class CameraAndBoard:
    """The camera and the board of a job.

    Attributes:
        task: Their rough poses, for planning.
        board: The board.
        source: Source of the pictures.
        truth: True poses of camera and board. None if they are unknown.
        stale: Number of pictures that are discarded before each one that is used.
    """

    task: ViewTask
    board: Target
    source: FrameSource
    truth: Mount | None
    stale: int = 0

    def take(self) -> Frame:
        """Return a picture, without its truth, whose exposure began after this call."""
        for _ in range(self.stale):
            self.source.read()
        return self.source.read().without_truth()


def open_camera_and_board(
    request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> CameraAndBoard:
    """Open the camera of a request.

    Args:
        request: The request.
        setup: The arm.
        stack: Closes the camera.

    Raises:
        CameraError: The camera cannot be opened, or the board is missing.
        CalibrationError: The calibration is missing or wrong.
        ConfigError: The synthetic camera is combined with real servos or with a board, or the
            source is a recording.
    """
    if request.camera == "synthetic":
        return _open_synthetic(request, setup, stack)
    return _open_real(request, setup, stack)


def _open_synthetic(
    request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> CameraAndBoard:
    if setup.has_real_servos:
        raise ConfigError(
            "the synthetic camera cannot see real servos",
            file="command line",
            key="--camera",
            allowed="a camera's index, file or URL",
        )
    if request.board is not None:
        raise ConfigError(
            "the synthetic camera has a simulated board",
            file="command line",
            key="--board",
            allowed="only with a real camera",
        )
    scene = scene_for(setup.robot, setup.frame)
    frame = setup.frame
    if request.mounting == "eye_in_hand":
        truth, squares, synthetic = _carried_camera(setup, scene)
    else:
        # The camera of the scene looks at the markers on the tool.
        truth = Mount(scene.pose_world_camera, scene.cube_offset, "eye_to_hand")
        frame = scene.cube_frame
        squares = dict(scene.cube)
        synthetic = scene.synthetic(setup.robot)
    source = SyntheticSource(synthetic, setup.true_q, seed=request.seed, clock=setup.clock)
    stack.enter_context(source)
    camera = request.pose_parent_camera or truth.pose_parent_camera.plus(_PLANNING_ERROR)
    board = request.pose_other_board or truth.pose_other_board.plus(0.5 * _PLANNING_ERROR)
    roughly = Mount(camera, board, truth.mounting)
    task = ViewTask(roughly, frame, squares, synthetic.intrinsics, scene.table)
    return CameraAndBoard(task, MarkerTarget(squares, scene.dictionary), source, truth)


def _carried_camera(setup: RobotSetup, scene: Scene) -> tuple[Mount, Squares, SyntheticScene]:
    """Return a camera beside the tool that looks at a board of markers on the table."""
    camera = camera_beside_tool(setup.robot, setup.frame)
    truth = Mount(camera, scene.pose_world_marker, "eye_in_hand")
    gap = _GAP_SHARE * scene.marker_size
    size = _MARKER_SHARE * scene.marker_size
    squares = marker_grid(_COLUMNS, _ROWS, size, gap, _FIRST_ID).markers
    make_marker = partial(SyntheticMarker, dictionary=scene.dictionary, margin=0.5 * gap)
    markers = [
        make_marker(marker_id, side, truth.pose_other_board @ pose)
        for marker_id, (side, pose) in squares.items()
    ]
    synthetic = SyntheticScene(
        setup.robot,
        STANDARD_CAMERA,
        camera,
        tuple(markers),
        table=scene.table,
        camera_frame=setup.frame,
    )
    return truth, squares, synthetic


def camera_beside_tool(robot: Robot, frame: str) -> Pose:
    """Return the pose of a camera on the hand, seen from ``frame``.

    It is on the first side of the tool from which the arm, at home, does not hide the view ahead.
    """
    ball = robot.reach(frame)
    reach = 1.0 if ball is None else ball[1]
    position = (_BESIDE * reach, 0.0, -_BEHIND * reach)
    roll = Pose(wxyz=rotation_exp([0.0, 0.0, _ROLL]))
    beside = Pose(position, rotation_exp([0.0, -_INWARDS, 0.0])).compose(roll)
    if not reach > 0.0:
        return beside
    hand = robot.forward(robot.home, frame)
    directions = np.array([(u, v, 1.0) for u in _VIEW_COLUMNS for v in _VIEW_ROWS])
    for angle in _SIDES:
        side = Pose(wxyz=rotation_exp([0.0, 0.0, angle])).compose(beside)
        camera = hand.compose(side)
        points = camera.apply(_VIEW_DEPTH * reach * directions)
        if is_visible(robot, robot.home, camera.position, points):
            return side
    return beside


def _open_real(
    request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> CameraAndBoard:
    board = request.board
    if board is None and request.intrinsics is not None:
        raise _missing_board()
    # If the intrinsics are missing too, this reports them first.
    source, intrinsics = open_calibrated(request.camera, request.intrinsics, stack)
    if board is None:
        raise _missing_board()
    if not source.live:
        raise ConfigError(
            "recorded pictures do not show the motions of this arm",
            file="command line",
            key="--camera",
            allowed="a camera or a stream, or --samples FILE",
        )
    scene = scene_for(setup.robot, setup.frame)
    is_carried = request.mounting == "eye_in_hand"
    camera = request.pose_parent_camera or (Pose() if is_carried else scene.pose_world_camera)
    board_pose = request.pose_other_board or (scene.pose_world_marker if is_carried else Pose())
    mount = Mount(camera, board_pose, request.mounting)
    task = ViewTask(mount, setup.frame, board.squares, intrinsics, scene.table)
    return CameraAndBoard(task, board, source, None, _STALE_FRAMES)


def _missing_board() -> CameraError:
    return CameraError(
        "no board is given",
        hint="give the board in front of the camera, for example --board grid:2x2:50:12",
    )
