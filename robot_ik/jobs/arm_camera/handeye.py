"""The hand-eye job: plans views, drives the arm through them, looks, and solves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.boards.board import Board, MarkerBoard
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.calibration.extrinsics import CameraExtrinsics, today
from robot_ik.camera.calibration.handeye import HandEye, Mount, Mounting, solve_handeye
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.motion_filter import moved
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import CarriedSource, SyntheticMarker, SyntheticScene, SyntheticSource
from robot_ik.camera.synthetic.datasets import STANDARD_CAMERA
from robot_ik.camera.tracker import Layout
from robot_ik.errors import CameraError, ConfigError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs import JobReport, Progress
from robot_ik.jobs.arm_camera.measuring import ArmCameraRequest, SampleSet, visit_stations
from robot_ik.jobs.arm_camera.view_planning import Clearance, ViewTask, plan_views
from robot_ik.jobs.robot_setup import RobotSetup, prepare_robot
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.vision import calibration_of, open_calibrated
from robot_ik.robot import Robot

# ------------------------------------------------------------------------------------------
# Camera and board of a hand-eye calibration: real ones, or simulated ones with a truth to compare with.


# What is planned with is wrong by this much on purpose: before calibration a camera's pose is known roughly.
_WRONG = np.array([0.02, -0.015, 0.01, 0.02, -0.015, 0.02])
# The simulated camera on the hand, in reaches of the robot: beside the tool and behind it, looking inwards.
_BESIDE, _BEHIND, _INWARDS = 0.12, 0.08, 0.2
# Sides of the tool to carry it on, rad, and how far it must see ahead, in reaches: past the tool.
_SIDES, _VIEW_DEPTH = (0.0, np.pi, 0.5 * np.pi, -0.5 * np.pi), 0.12
# The simulated board on the table: columns, rows, first id, and parts of the scene's marker.
_GRID, _FIRST_ID, _MARKER_PART, _GAP_PART = (3, 2), 30, 0.6, 0.2
# A camera's pictures that are on their way when the arm comes to rest are thrown away.
_STALE_FRAMES = 3


@dataclass(frozen=True)
class HandEyeRequest(ArmCameraRequest):
    """What ``run_handeye`` shall do.

    Attributes:
        mounting: ``eye_in_hand`` or ``eye_to_hand``.
        pose_parent_camera, pose_other_board: Where they are, roughly; None: as in the scene.
    """

    mounting: Mounting = "eye_to_hand"
    pose_parent_camera: Pose | None = None
    pose_other_board: Pose | None = None


@dataclass(frozen=True, eq=False)
class HandEyeScene:
    """The camera and the board of the job.

    Attributes:
        task: For planning.
        board: How it is seen.
        source: The camera.
        truth: Where camera and board really are; None where it is unknown.
        stale: Pictures to throw away before one counts.
    """

    task: ViewTask
    board: Board
    source: FrameSource
    truth: Mount | None
    stale: int = 0

    def take(self) -> Frame:
        """A picture that was begun after the arm came to rest; without its truth."""
        for _ in range(self.stale):
            self.source.read()
        return self.source.read().without_truth()


def open_scene(request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack) -> HandEyeScene:
    """Camera and board of a request.

    Raises:
        CameraError, CalibrationError, ConfigError: It cannot be opened, something is not given, or the
            simulated camera is asked to look at real servos.
    """
    if request.camera != "synthetic":
        return _real(request, setup, stack)
    if setup.arm is not None and setup.arm.virtual_bus is None:
        raise ConfigError(
            "the synthetic camera cannot see real servos",
            file="command line", key="--camera", allowed="a camera's index, file or URL",
        )  # fmt: skip
    if request.board is not None:
        raise ConfigError(
            "the synthetic camera looks at a board of its own",
            file="command line", key="--board", allowed="only with a real camera",
        )  # fmt: skip
    scene = scene_for(setup.robot, setup.frame)
    made = _carried_camera if request.mounting == "eye_in_hand" else _standing_camera
    return made(request, setup, scene, stack)


def _standing_camera(
    request: HandEyeRequest, setup: RobotSetup, scene: Scene, stack: contextlib.ExitStack
) -> HandEyeScene:
    """The scene's camera looks at the markers on the tool."""
    truth = Mount(scene.pose_world_camera, scene.cube_offset, "eye_to_hand")
    source = SyntheticSource(
        scene.synthetic(setup.robot), setup.true_q, seed=request.seed, clock=setup.clock, quality="fast"
    )
    board = MarkerBoard(dict(scene.cube), scene.dictionary)
    task = ViewTask(_roughly(request, truth), scene.cube_frame, board.layout, scene.intrinsics, scene.table)
    return HandEyeScene(task, board, stack.enter_context(source), truth)


def _carried_camera(
    request: HandEyeRequest, setup: RobotSetup, scene: Scene, stack: contextlib.ExitStack
) -> HandEyeScene:
    """A camera beside the tool looks at a board of markers on the table."""
    camera = _beside_the_tool(setup.robot, setup.frame)
    truth = Mount(camera, scene.pose_world_marker, "eye_in_hand")
    size = _MARKER_PART * scene.marker_size
    layout = grid_body(*_GRID, size, _GAP_PART * scene.marker_size, _FIRST_ID).markers
    markers = tuple(
        SyntheticMarker(
            id, side, truth.pose_other_board.compose(pose), dictionary=scene.dictionary,
            margin=0.5 * _GAP_PART * scene.marker_size,
        )
        for id, (side, pose) in layout.items()
    )  # fmt: skip
    synthetic = SyntheticScene(setup.robot, STANDARD_CAMERA, Pose(), markers, table=scene.table)
    source = CarriedSource(synthetic, setup.frame, camera, setup.true_q, seed=request.seed, clock=setup.clock)
    task = ViewTask(_roughly(request, truth), setup.frame, layout, STANDARD_CAMERA, scene.table)
    return HandEyeScene(task, MarkerBoard(layout, scene.dictionary), stack.enter_context(source), truth)


def _beside_the_tool(robot: Robot, frame: str) -> Pose:
    """Where the hand carries its camera: on the first side from which nothing of the arm hides the view."""
    ball = robot.reach(frame)
    reach = 1.0 if ball is None else ball[1]
    beside = Pose((_BESIDE * reach, 0.0, -_BEHIND * reach), rotation_exp([0.0, -_INWARDS, 0.0])).compose(
        Pose(wxyz=rotation_exp([0.0, 0.0, 0.4]))
    )
    if reach <= 0.0:
        return beside
    sides = [Pose(wxyz=rotation_exp([0.0, 0.0, angle])).compose(beside) for angle in _SIDES]
    clearance, hand = Clearance(robot, robot.home), robot.forward(robot.home, frame)
    view_points = (
        _VIEW_DEPTH * reach * np.array([(u, v, 1.0) for u in (-0.2, 0.0, 0.2) for v in (-0.15, 0.15)])
    )
    for side in sides:
        camera = hand.compose(side)
        if clearance.sees(robot.home, camera.position, camera.apply(view_points)):
            return side
    return beside


def _roughly(request: HandEyeRequest, truth: Mount) -> Mount:
    camera = request.pose_parent_camera or moved(truth.pose_parent_camera, _WRONG)
    board = request.pose_other_board or moved(truth.pose_other_board, 0.5 * _WRONG)
    return Mount(camera, board, truth.mounting)


def _real(request: HandEyeRequest, setup: RobotSetup, stack: contextlib.ExitStack) -> HandEyeScene:
    calibration = calibration_of(request.camera, request.intrinsics)
    if request.board is None:
        raise CameraError(
            "what board the camera looks at is not given",
            hint="say it with --board, for example --board grid:2x2:50:12",
        )
    carried = request.mounting == "eye_in_hand"
    source, intrinsics = open_calibrated(request.camera, calibration, stack)
    if not source.live:
        raise ConfigError(
            "recorded pictures do not show this arm where it goes",
            file="command line", key="--camera", allowed="a camera or a stream, or --samples FILE",
        )  # fmt: skip
    scene = scene_for(setup.robot, setup.frame)
    camera = request.pose_parent_camera or (Pose() if carried else scene.pose_world_camera)
    board = request.pose_other_board or (scene.pose_world_marker if carried else Pose())
    layout: Layout = request.board.layout
    task = ViewTask(Mount(camera, board, request.mounting), setup.frame, layout, intrinsics, scene.table)
    return HandEyeScene(task, request.board, source, None, _STALE_FRAMES)


Array = NDArray[np.float64]


# ------------------------------------------------------------------------------------------
# The phases, and what came of them.


@dataclass(eq=False)
class HandEyeReport(JobReport):
    """What came out.

    Attributes:
        samples: What was measured.
        truth: Where camera and board really are; None where it is unknown.
        stations: (nq,) planned, in order.
        unseen: Numbers of the stations where the board was not found.
        result: None for a dry run.
    """

    samples: SampleSet
    truth: Mount | None
    stations: tuple[Array, ...] = ()
    unseen: tuple[int, ...] = ()
    result: HandEye | None = None

    @property
    def parent(self) -> str:
        """What the camera's pose is seen from."""
        return self.samples.frame if self.samples.mounting == "eye_in_hand" else "world"

    @property
    def true_error(self) -> tuple[float, float] | None:
        """Distance from the truth in metres and rad, where it is known."""
        if self.truth is None or self.result is None:
            return None
        return self.result.pose_parent_camera.distance(self.truth.pose_parent_camera)

    def extrinsics(self) -> CameraExtrinsics:
        """For the file."""
        result = self.result
        assert result is not None  # a dry run has none
        return CameraExtrinsics(
            result.pose_parent_camera, self.parent, result.covariance[:6, :6],
            result.residual_px, result.residual_mm, today(), self.samples.intrinsics.digest,
            method=f"handeye, {result.mounting.replace('_', ' ')}", views=len(self.samples),
        )  # fmt: skip


def run_handeye(
    request: HandEyeRequest,
    *,
    dry_run: bool = False,
    keep: Callable[[SampleSet], None] = lambda samples: None,
    progress: Progress = lambda phase, share: None,
) -> HandEyeReport:
    """Plans, moves, looks, solves.

    Args:
        request: What to do.
        dry_run: Plan only; nothing moves.
        keep: Handed the samples after each station, so that an interruption loses none.
        progress: Called with the phase and the share of it that is done.

    Raises:
        MarkerNotFoundError: The board was seen at fewer than four stations.
        RobotIkError: Wrong input or environment, or views that cannot tell where the camera is.
    """
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request.setup())
        scene = open_scene(request, setup, stack)
        task = scene.task
        samples = SampleSet(request.robot, setup.robot.joints, task.frame, request.mounting, task.intrinsics)
        report = HandEyeReport(samples, scene.truth)
        phases = ViewPhases(request, setup, scene, progress)
        stack.enter_context(setup.connected())
        planned = report.keep(phases.plan(task))
        if dry_run:
            return report
        setup.enable_torque()
        report.keep(phases.measure(planned, samples, lambda: keep(samples)))
    samples.require(len(planned.stations), "say better where camera and board are")
    progress("solving", 0.0)
    report.keep(solve(samples, setup.robot))
    return report


def handeye_from_samples(samples: SampleSet, intrinsics: CameraIntrinsics | None = None) -> HandEyeReport:
    """Solves again what was measured before.

    Args:
        samples: From a file.
        intrinsics: A newer calibration of the same camera; None: the one the samples were taken with.

    Raises:
        CalibrationError: For another picture size, or views that cannot tell where the camera is.
    """
    if intrinsics is not None:
        intrinsics.require_size(*samples.intrinsics.size)
        samples.intrinsics = intrinsics
    report = HandEyeReport(samples, None, tuple(samples.q))
    report.keep(solve(samples, samples.load_robot()))
    return report


def samples_path(out: Path) -> Path:
    """Where the samples of a result go: beside it."""
    return out.with_name(f"{out.stem}.samples.json")


@dataclass(frozen=True, eq=False)
class PlannedViews:
    """Stations to visit, (nq,) each, in order."""

    stations: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class MeasuredViews:
    """Numbers, from 0, of the stations where the board was not found or the arm did not come to rest."""

    unseen: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SolvedMount:
    """Where the camera is."""

    result: HandEye


def solve(samples: SampleSet, robot: Robot) -> SolvedMount:
    """From samples of ``robot``; nothing moves.

    Raises:
        CalibrationError: The views cannot tell where the camera is.
    """
    return SolvedMount(solve_handeye(samples.samples(robot), samples.intrinsics, mounting=samples.mounting))


@dataclass(frozen=True, eq=False)
class ViewPhases:
    """What hand-eye and verify do alike before a camera, and what it needs; ``setup`` is connected."""

    request: ArmCameraRequest
    setup: RobotSetup
    scene: HandEyeScene
    progress: Progress

    def plan(self, task: ViewTask) -> PlannedViews:
        """Views for a task.  Nothing moves."""
        self.progress("planning", 0.0)
        request, setup = self.request, self.setup
        return PlannedViews(
            tuple(plan_views(setup.robot, task, request.views, start=setup.q, seed=request.seed))
        )

    def measure(self, planned: PlannedViews, samples: SampleSet, keep: Callable[[], None]) -> MeasuredViews:
        """Goes to all stations and looks at the board; the servos have torque.

        Args:
            planned: Where to.
            samples: Joint angles read and corners seen are added to it.
            keep: Called after each station.

        Raises:
            HardwareError, TrajectoryError, CameraError: As the arm and the camera do.
        """
        unseen, count, scene = [], len(planned.stations), self.scene

        def show(number: int, share: float) -> None:
            self.progress(f"view {number + 1} of {count}", (number + share) / count)

        visits = visit_stations(
            self.setup, planned.stations, scene.take, speed=self.request.speed, progress=show
        )
        for station in visits:
            view = scene.board.see(station.frame, scene.task.intrinsics) if station.still else None
            if view is None:
                unseen.append(station.number)
                continue
            samples.add(station.q, view)
            keep()
        return MeasuredViews(tuple(unseen))
