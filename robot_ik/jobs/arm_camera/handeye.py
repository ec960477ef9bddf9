"""The hand-eye job: plans views, drives the arm through them, looks, and solves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, today
from robot_ik.camera.calibration.handeye import HandEye, Mount, Mounting, solve_handeye
from robot_ik.camera.calibration.kinematic import CalibrationStation, doubted_zeros
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticMarker, SyntheticScene, SyntheticSource
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerTarget, Squares, Target, marker_grid
from robot_ik.errors import CalibrationError, CameraError, ConfigError
from robot_ik.execution import execute
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs import Progress
from robot_ik.jobs.arm_camera.samples import SampleSet
from robot_ik.jobs.arm_camera.view_planning import Clearance, ViewTask, plan_views
from robot_ik.jobs.robot_setup import ArmRequest, RobotSetup, prepare_robot
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.vision import open_calibrated
from robot_ik.motion.trajectory import joint_move
from robot_ik.ports import Array
from robot_ik.robot import Robot

# Error of the simulated guesses of camera and board, m and rad: real guesses are rough, too.
_GUESS_ERROR = np.array([0.02, -0.015, 0.01, 0.02, -0.015, 0.02])
# Distance of the simulated camera on the hand to the side of the tool, in reaches of the robot.
_BESIDE = 0.12
# Its distance behind the tool, in reaches.
_BEHIND = 0.08
# Its rotation towards the tool's axis, rad.
_INWARDS = 0.2
# Its rotation about the optical axis, rad: the picture is not aligned with the tool.
_ROLL = 0.4
# Sides of the tool that are tried for it, rad about the tool's axis.
_SIDES = (0.0, np.pi, 0.5 * np.pi, -0.5 * np.pi)
# Distance ahead of the camera at which the arm must not hide the view, in reaches: past the tool.
_VIEW_DEPTH = 0.12
# Columns and rows of the simulated board on the table.
_GRID = (3, 2)
# Least marker id on that board.
_FIRST_ID = 30
# Side of its markers over the side of the scene's marker.
_MARKER_PART = 0.6
# Gap between its markers over the side of the scene's marker.
_GAP_PART = 0.2
# Time for the servos to arrive after the last command, s.
_SETTLE_SECONDS = 0.3
# Time between two readings that check whether the arm rests, s.
_REST_CHECK_SECONDS = 0.1
# Number of such checks before the station counts as missed.
_REST_CHECKS = 20
# Largest difference of two readings of an arm at rest, ticks.
_STILL_TICKS = 1.01
# Pictures of a real camera that are dropped: they may have begun before the arm came to rest.
_STALE_FRAMES = 3
# Limits of a sound arm's own error, each axis. Servo ticks alone give up to 0.0004 of the reach and
# 0.09 deg (8 views and more). Twice the ticks give 0.0007 and 0.13 deg. A second joint that is off
# by 1.5 deg gives 0.0015 and 0.23 deg.
# Largest position error over the reach of the robot.
_SOUND_POSITION = 8e-4
# Largest angle error, rad.
_SOUND_ANGLE = float(np.deg2rad(0.15))
# Largest share of rejected views. One view is always allowed: its picture may be bad.
_SOUND_REJECTED = 0.1


@dataclass(frozen=True)
class HandEyeRequest(ArmRequest):
    """An arm, a camera, a board, and the number of pictures.

    Attributes:
        mounting: ``eye_in_hand`` or ``eye_to_hand``.
        camera: ``synthetic``, or a source for ``open_source``.
        intrinsics: Calibration file. A real camera needs one.
        board: None for the simulated one.
        pose_parent_camera: Rough pose of the camera. None for the one of the scene.
        pose_other_board: Rough pose of the board. None for the one of the scene.
        views: Number of pictures.
        dry_run: Only plan the views, without moving.
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
class HandEyeScene:
    """The camera and the board of the job.

    Attributes:
        task: Rough poses, for planning.
        board: Board to detect.
        source: Where the pictures come from.
        truth: True poses of camera and board. None if they are unknown.
        stale: Number of pictures to drop before each picture that counts.
    """

    task: ViewTask
    board: Target
    source: FrameSource
    truth: Mount | None
    stale: int = 0

    def take(self) -> Frame:
        """Return a picture that begins after the arm came to rest, without its truth."""
        for _ in range(self.stale):
            self.source.read()
        return self.source.read().without_truth()


def open_scene(
    request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> HandEyeScene:
    """Open the camera and the board of a request. ``stack`` closes the camera.

    Raises:
        CameraError: The camera cannot be opened, or the board is not given.
        CalibrationError: The camera needs a calibration.
        ConfigError: The camera cannot see the arm or the board of the request.
    """
    if request.camera != "synthetic":
        return _real(request, setup, stack)
    if setup.arm is not None and setup.arm.virtual_bus is None:
        raise ConfigError(
            "the synthetic camera cannot see real servos",
            file="command line",
            key="--camera",
            allowed="a camera's index, file or URL",
        )
    if request.board is not None:
        raise ConfigError(
            "the synthetic camera looks at a board of its own",
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
    camera = request.pose_parent_camera or truth.pose_parent_camera.plus(_GUESS_ERROR)
    board = request.pose_other_board or truth.pose_other_board.plus(0.5 * _GUESS_ERROR)
    roughly = Mount(camera, board, truth.mounting)
    task = ViewTask(roughly, frame, squares, synthetic.intrinsics, scene.table)
    return HandEyeScene(task, MarkerTarget(squares, scene.dictionary), source, truth)


def _carried_camera(setup: RobotSetup, scene: Scene) -> tuple[Mount, Squares, SyntheticScene]:
    """Return a camera beside the tool that looks at a board of markers on the table."""
    truth = Mount(
        _beside_the_tool(setup.robot, setup.frame), scene.pose_world_marker, "eye_in_hand"
    )
    gap = _GAP_PART * scene.marker_size
    squares = marker_grid(*_GRID, _MARKER_PART * scene.marker_size, gap, _FIRST_ID).markers
    marker = partial(SyntheticMarker, dictionary=scene.dictionary, margin=0.5 * gap)
    markers = (
        marker(id, side, truth.pose_other_board @ pose) for id, (side, pose) in squares.items()
    )
    return (
        truth,
        squares,
        SyntheticScene(
            setup.robot,
            STANDARD_CAMERA,
            truth.pose_parent_camera,
            tuple(markers),
            table=scene.table,
            camera_frame=setup.frame,
        ),
    )


def _beside_the_tool(robot: Robot, frame: str) -> Pose:
    """Return the pose of a camera on the hand, on the first side with a free view."""
    ball = robot.reach(frame)
    reach = 1.0 if ball is None else ball[1]
    beside = Pose(
        (_BESIDE * reach, 0.0, -_BEHIND * reach), rotation_exp([0.0, -_INWARDS, 0.0])
    ).compose(Pose(wxyz=rotation_exp([0.0, 0.0, _ROLL])))
    clearance = Clearance(robot, robot.home)
    hand = robot.forward(robot.home, frame)
    view_points = (
        _VIEW_DEPTH
        * reach
        * np.array([(u, v, 1.0) for u in (-0.2, 0.0, 0.2) for v in (-0.15, 0.15)])
    )
    for angle in _SIDES if reach > 0.0 else ():
        side = Pose(wxyz=rotation_exp([0.0, 0.0, angle])).compose(beside)
        camera = hand.compose(side)
        if clearance.sees(robot.home, camera.position, camera.apply(view_points)):
            return side
    return beside


def _real(request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack) -> HandEyeScene:
    no_board = CameraError(
        "what board the camera looks at is not given",
        hint="say it with --board, for example --board grid:2x2:50:12",
    )
    if request.board is None and request.intrinsics is not None:
        raise no_board
    source, intrinsics = open_calibrated(request.camera, request.intrinsics, stack)
    if request.board is None:
        raise no_board
    carried = request.mounting == "eye_in_hand"
    if not source.live:
        raise ConfigError(
            "recorded pictures do not show this arm where it goes",
            file="command line",
            key="--camera",
            allowed="a camera or a stream, or --samples FILE",
        )
    scene = scene_for(setup.robot, setup.frame)
    camera = request.pose_parent_camera or (Pose() if carried else scene.pose_world_camera)
    board = request.pose_other_board or (scene.pose_world_marker if carried else Pose())
    squares = request.board.squares
    task = ViewTask(
        Mount(camera, board, request.mounting), setup.frame, squares, intrinsics, scene.table
    )
    return HandEyeScene(task, request.board, source, None, _STALE_FRAMES)


@dataclass(eq=False, kw_only=True)
class ArmCameraReport:
    """Measurements of an arm.

    Attributes:
        stations: (nq,) planned, in order.
        unseen: Numbers, from 0, of those where the board was not found or the arm did not come to
            rest.
    """

    samples: SampleSet
    stations: tuple[Array, ...] = ()
    unseen: tuple[int, ...] = ()


@dataclass(eq=False, kw_only=True)
class HandEyeReport(ArmCameraReport):
    """Result of the hand-eye job.

    Attributes:
        truth: True poses of camera and board. None if they are unknown.
        result: None for a dry run.
        doubt: Why the error may exceed the stated uncertainty. Empty if there is no reason.
    """

    truth: Mount | None = None
    result: HandEye | None = None
    doubt: str = ""

    @property
    def parent(self) -> str:
        """Name of the frame of the camera's pose."""
        return self.samples.frame if self.samples.mounting == "eye_in_hand" else "world"

    @property
    def true_error(self) -> tuple[float, float] | None:
        """Error of the camera's pose, metres and rad. None if the truth is unknown."""
        if self.truth is None or self.result is None:
            return None
        return self.result.pose_parent_camera.distance(self.truth.pose_parent_camera)

    def solve(self, robot: Robot) -> None:
        """Solve for the camera's pose and check the arm, without moving.

        Raises:
            CalibrationError: The views do not determine the pose.
        """
        samples = self.samples
        self.result = solve_handeye(
            samples.samples(robot), samples.intrinsics, mounting=samples.mounting
        )
        stations = [
            CalibrationStation(q, view) for q, view in zip(samples.q, samples.views, strict=True)
        ]
        zeros = doubted_zeros(stations, robot, samples.frame, samples.intrinsics, self.result)
        self.doubt = self_contradiction(self.result, robot.reach(samples.frame), zeros)

    def extrinsics(self) -> CameraExtrinsics:
        result = self.result
        if result is None:
            raise CalibrationError("the samples have not been solved: a dry run has no result")
        return CameraExtrinsics(
            result.pose_parent_camera,
            self.parent,
            result.covariance[:6, :6],
            result.residual_px,
            result.residual_mm,
            today(),
            self.samples.intrinsics.digest,
            method=f"handeye, {result.mounting.replace('_', ' ')}",
            views=len(self.samples),
            doubt=self.doubt,
        )


def run_handeye(
    request: HandEyeRequest,
    *,
    keep: Callable[[SampleSet], None] = lambda _samples: None,
    progress: Progress = lambda _phase, _share: None,
) -> HandEyeReport:
    """Plan the views, visit them and solve for the camera's pose.

    Args:
        request: Arm, camera and board.
        keep: Called with all samples after each station, so that an interruption loses none.
        progress: Called with the phase and its finished share.

    Raises:
        MarkerNotFoundError: The board was seen at fewer than four stations.
        RobotIkError: Wrong input or environment, or views that do not determine the pose.
    """
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request)
        scene = open_scene(request, setup, stack)
        task = scene.task
        samples = SampleSet(
            request.robot, setup.robot.joints, task.frame, request.mounting, task.intrinsics
        )
        report = HandEyeReport(samples=samples, truth=scene.truth)
        stack.enter_context(setup.connected())
        visit_stations(report, request, setup, scene, keep, progress)
    if request.dry_run:
        return report
    samples.require(len(report.stations), "give better guesses of where camera and board are")
    progress("solving", 0.0)
    report.solve(setup.robot)
    return report


def handeye_from_samples(
    samples: SampleSet, intrinsics: CameraIntrinsics | None = None
) -> HandEyeReport:
    """Solve for the camera's pose from saved samples, without moving.

    Args:
        samples: The samples.
        intrinsics: Newer intrinsics of the same camera.

    Raises:
        CalibrationError: The intrinsics are for another picture size, or the views do not determine
            the pose.
    """
    if intrinsics is not None:
        intrinsics.require_size(*samples.intrinsics.size)
        samples.intrinsics = intrinsics
    report = HandEyeReport(samples=samples, stations=tuple(samples.q))
    report.solve(samples.load_robot())
    return report


def self_contradiction(
    found: HandEye, ball: tuple[Array, float] | None, zeros: Mapping[str, tuple[float, float]]
) -> str:
    """Return what contradicts a sound arm, in one sentence. Empty if nothing does.

    Args:
        found: Result of the calibration.
        ball: Reach of the robot. None if it is unknown: then the position is not checked.
        zeros: Joints whose zero is off, see ``doubted_zeros``.
    """
    views = len(found.residuals)
    rejected = len(found.outliers)
    position = np.inf if ball is None else _SOUND_POSITION * ball[1]
    reasons = [
        f"the zero of {name} seems to be off by "
        f"{np.degrees(offset):.2f} ± {np.degrees(sigma):.2f} deg"
        for name, (offset, sigma) in zeros.items()
    ]
    if (
        found.arm_position > position
        or found.arm_angle > _SOUND_ANGLE
        or rejected > max(1.0, _SOUND_REJECTED * views)
    ):
        own = f"{1e3 * found.arm_position:.2f} mm and {np.degrees(found.arm_angle):.2f} deg"
        sound = f"{np.degrees(_SOUND_ANGLE):.2f} deg"
        if ball is not None:
            sound = f"{1e3 * position:.2f} mm and {sound}"
        reasons.append(
            f"its own error is {own} (a sound arm: below {sound}) "
            f"and {rejected} of {views} views are not believed"
        )
    if not reasons:
        return ""
    return (
        f"the arm contradicts itself: {'; '.join(reasons)}; so the pose may be wrong by far more "
        "than is stated; check the joints' zeros: robot-ik camera verify --fit"
    )


def samples_path(out: Path) -> Path:
    """Return the path of the samples of a result: beside it."""
    return out.with_name(f"{out.stem}.samples.json")


def visit_stations(
    report: ArmCameraReport,
    request: HandEyeRequest,
    setup: RobotSetup,
    scene: HandEyeScene,
    keep: Callable[[SampleSet], None],
    progress: Progress,
) -> None:
    """Plan stations, visit them and write the observations of the board into ``report``.

    A dry run only plans. ``keep`` is called with the samples after each station.

    Raises:
        HardwareError: The arm fails.
        TrajectoryError: A station cannot be reached.
        CameraError: The camera fails, or too few stations are found.
    """
    progress("planning", 0.0)
    planned = plan_views(setup.robot, scene.task, request.views, start=setup.q, seed=request.seed)
    report.stations = tuple(planned)
    count = len(planned)
    if request.dry_run:
        return
    setup.enable_torque()
    for number, asked in enumerate(planned):
        trajectory = joint_move(setup.robot, setup.q, asked, **setup.caps(request.speed))

        def show(tick: Any, number: int = number, ticks: int = max(1, len(trajectory))) -> None:
            share = (number + min(1.0, tick.index / ticks)) / count
            progress(f"view {number + 1} of {count}", share)

        settle = 0.0 if setup.arm is None else _SETTLE_SECONDS
        execute(
            trajectory,
            setup.sinks,
            source=setup.arm,
            clock=setup.clock,
            on_tick=show,
            settle=settle,
        )
        before, still = _come_to_rest(setup)
        frame = scene.take()
        # Mean of the readings before and after the picture.
        q = 0.5 * (before + setup.q)
        view = scene.board.find(frame, scene.task.intrinsics) if still else None
        if view is None:
            report.unseen += (number,)
            continue
        report.samples.add(q, view)
        keep(report.samples)


def _come_to_rest(setup: RobotSetup) -> tuple[Array, bool]:
    """Read the servos until two readings agree. Return the last (nq,) and whether they agree."""
    last = setup.q
    if setup.arm is None:
        setup.shown = last.copy()
        return last, True
    for _ in range(_REST_CHECKS):
        setup.repeat(_REST_CHECK_SECONDS)
        now = setup.q
        if bool(np.all(np.abs(now - last) <= _STILL_TICKS * setup.resolution)):
            return now, True
        last = now
    return last, False
