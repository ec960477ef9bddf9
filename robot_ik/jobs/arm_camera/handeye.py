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
from robot_ik.jobs.arm_camera.view_planning import ViewTask, is_visible, plan_views
from robot_ik.jobs.robot_setup import ArmRequest, RobotSetup, prepare_robot
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.vision import open_calibrated
from robot_ik.motion.trajectory import joint_move
from robot_ik.ports import Array
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
# Servos may take this long to arrive after the last command, and then to come to rest.
_SETTLE_SECONDS, _REST_CHECK_SECONDS, _REST_CHECKS = 0.3, 0.1, 20
# Two readings that differ by no more than this many ticks are of an arm at rest.
_STILL_TICKS = 1.01
# A camera's pictures that are on their way when the arm comes to rest are thrown away.
_STALE_FRAMES = 3
# A sound arm's own error stays below these, each axis: a part of its reach, and rad.  Servo ticks alone give
# up to 0.0004 of the reach and 0.09 deg (8 views and more), twice the ticks 0.0007 and 0.13 deg, a second
# joint that is off by 1.5 deg 0.0015 and 0.23 deg.  One view or a tenth may be spoilt by the picture.
_SOUND_POSITION, _SOUND_ANGLE, _SOUND_REJECTED = 8e-4, float(np.deg2rad(0.15)), 0.1


@dataclass(frozen=True)
class HandEyeRequest(ArmRequest):
    """An arm, a camera, a board, and how many pictures to take of it.

    Attributes:
        mounting: ``eye_in_hand`` or ``eye_to_hand``.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file; needed for a real camera.
        board: None: the simulated one.
        pose_parent_camera, pose_other_board: Where they are, roughly; None: as in the scene.
        views: How many pictures.
        dry_run: Plan only; nothing moves.
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

    ``task`` is for planning; ``truth``, where camera and board really are, None where it is unknown; so many
    ``stale`` pictures are thrown away before one counts.
    """

    task: ViewTask
    board: Target
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
    if setup.has_real_servos:
        raise ConfigError(
            "the synthetic camera cannot see real servos",
            file="command line", key="--camera", allowed="a camera's index, file or URL",
        )  # fmt: skip
    if request.board is not None:
        raise ConfigError(
            "the synthetic camera looks at a board of its own",
            file="command line", key="--board", allowed="only with a real camera",
        )  # fmt: skip
    scene, frame = scene_for(setup.robot, setup.frame), setup.frame
    if request.mounting == "eye_in_hand":
        truth, squares, synthetic = _carried_camera(setup, scene)
    else:  # the scene's camera looks at the markers on the tool
        truth = Mount(scene.pose_world_camera, scene.cube_offset, "eye_to_hand")
        frame, squares, synthetic = scene.cube_frame, dict(scene.cube), scene.synthetic(setup.robot)
    source = SyntheticSource(synthetic, setup.true_q, seed=request.seed, clock=setup.clock)
    stack.enter_context(source)
    camera = request.pose_parent_camera or truth.pose_parent_camera.plus(_WRONG)
    board = request.pose_other_board or truth.pose_other_board.plus(0.5 * _WRONG)
    roughly = Mount(camera, board, truth.mounting)
    task = ViewTask(roughly, frame, squares, synthetic.intrinsics, scene.table)
    return HandEyeScene(task, MarkerTarget(squares, scene.dictionary), source, truth)


def _carried_camera(setup: RobotSetup, scene: Scene) -> tuple[Mount, Squares, SyntheticScene]:
    """A camera beside the tool looks at a board of markers on the table."""
    truth = Mount(_beside_the_tool(setup.robot, setup.frame), scene.pose_world_marker, "eye_in_hand")
    gap = _GAP_PART * scene.marker_size
    squares = marker_grid(*_GRID, _MARKER_PART * scene.marker_size, gap, _FIRST_ID).markers
    marker = partial(SyntheticMarker, dictionary=scene.dictionary, margin=0.5 * gap)
    markers = (marker(id, side, truth.pose_other_board @ pose) for id, (side, pose) in squares.items())
    return truth, squares, SyntheticScene(
        setup.robot, STANDARD_CAMERA, truth.pose_parent_camera, tuple(markers), table=scene.table,
        camera_frame=setup.frame,
    )  # fmt: skip


def _beside_the_tool(robot: Robot, frame: str) -> Pose:
    """Where the hand carries its camera: on the first side from which nothing of the arm hides the view."""
    ball = robot.reach(frame)
    reach = 1.0 if ball is None else ball[1]
    beside = Pose((_BESIDE * reach, 0.0, -_BEHIND * reach), rotation_exp([0.0, -_INWARDS, 0.0])).compose(
        Pose(wxyz=rotation_exp([0.0, 0.0, 0.4]))
    )
    hand = robot.forward(robot.home, frame)
    view_points = (
        _VIEW_DEPTH * reach * np.array([(u, v, 1.0) for u in (-0.2, 0.0, 0.2) for v in (-0.15, 0.15)])
    )
    for angle in _SIDES if reach > 0.0 else ():
        side = Pose(wxyz=rotation_exp([0.0, 0.0, angle])).compose(beside)
        camera = hand.compose(side)
        if is_visible(robot, robot.home, camera.position, camera.apply(view_points)):
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
            file="command line", key="--camera", allowed="a camera or a stream, or --samples FILE",
        )  # fmt: skip
    scene = scene_for(setup.robot, setup.frame)
    camera = request.pose_parent_camera or (Pose() if carried else scene.pose_world_camera)
    board = request.pose_other_board or (scene.pose_world_marker if carried else Pose())
    squares = request.board.squares
    task = ViewTask(Mount(camera, board, request.mounting), setup.frame, squares, intrinsics, scene.table)
    return HandEyeScene(task, request.board, source, None, _STALE_FRAMES)


# ------------------------------------------------------------------------------------------
# The phases, and what came of them.


@dataclass(eq=False, kw_only=True)
class ArmCameraReport:
    """What an arm was seen to do.

    Attributes:
        stations: (nq,) planned, in order.
        unseen: Numbers, from 0, of those where the board was not found or the arm did not come to rest.
    """

    samples: SampleSet
    stations: tuple[Array, ...] = ()
    unseen: tuple[int, ...] = ()


@dataclass(eq=False, kw_only=True)
class HandEyeReport(ArmCameraReport):
    """What came out.

    Attributes:
        truth: Where camera and board really are; None where it is unknown.
        result: None for a dry run.
        doubt: Why the result may be wrong by more than it states; empty: nothing speaks against it.
    """

    truth: Mount | None = None
    result: HandEye | None = None
    doubt: str = ""

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

    def solve(self, robot: Robot) -> None:
        """Finds the camera by the samples, of ``robot``, and judges the arm; nothing moves.

        Raises:
            CalibrationError: The views cannot tell where the camera is.
        """
        samples = self.samples
        self.result = solve_handeye(samples.samples(robot), samples.intrinsics, mounting=samples.mounting)
        stations = [CalibrationStation(q, view) for q, view in zip(samples.q, samples.views, strict=True)]
        zeros = doubted_zeros(stations, robot, samples.frame, samples.intrinsics, self.result)
        self.doubt = self_contradiction(self.result, robot.reach(samples.frame), zeros)

    def extrinsics(self) -> CameraExtrinsics:
        result = self.result
        if result is None:
            raise CalibrationError("the samples have not been solved: a dry run has no result")
        return CameraExtrinsics(
            result.pose_parent_camera, self.parent, result.covariance[:6, :6],
            result.residual_px, result.residual_mm, today(), self.samples.intrinsics.digest,
            method=f"handeye, {result.mounting.replace('_', ' ')}", views=len(self.samples),
            doubt=self.doubt,
        )  # fmt: skip


def run_handeye(
    request: HandEyeRequest,
    *,
    keep: Callable[[SampleSet], None] = lambda samples: None,
    progress: Progress = lambda phase, share: None,
) -> HandEyeReport:
    """Plans, moves, looks, solves.

    ``keep`` is handed the samples after each station, so that an interruption loses none.

    Raises:
        MarkerNotFoundError: The board was seen at fewer than four stations.
        RobotIkError: Wrong input or environment, or views that cannot tell where the camera is.
    """
    with contextlib.ExitStack() as stack:
        setup = prepare_robot(request)
        scene = open_scene(request, setup, stack)
        task = scene.task
        samples = SampleSet(request.robot, setup.robot.joints, task.frame, request.mounting, task.intrinsics)
        report = HandEyeReport(samples=samples, truth=scene.truth)
        stack.enter_context(setup.connected())
        visit_stations(report, request, setup, scene, keep, progress)
    if request.dry_run:
        return report
    samples.require(len(report.stations), "give better guesses of where camera and board are")
    progress("solving", 0.0)
    report.solve(setup.robot)
    return report


def handeye_from_samples(samples: SampleSet, intrinsics: CameraIntrinsics | None = None) -> HandEyeReport:
    """Solves again what was measured before, also with newer ``intrinsics`` of the same camera.

    Raises:
        CalibrationError: For another picture size, or views that cannot tell where the camera is.
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
    """What a sound arm would not do: err more, have views at odds, or zeros that are off; empty: it is sound.

    ``ball`` is the robot's reach; None where it is not known, and the position is not judged then.  ``zeros``
    are those of ``doubted_zeros``.
    """
    views, rejected = len(found.residuals), len(found.outliers)
    position = np.inf if ball is None else _SOUND_POSITION * ball[1]
    reasons = [
        f"the zero of {name} seems to be off by {np.degrees(offset):.2f} ± {np.degrees(sigma):.2f} deg"
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
            f"its own error is {own} (a sound arm: below {sound}) and {rejected} of {views} views are not "
            "believed"
        )
    if not reasons:
        return ""
    return (
        f"the arm contradicts itself: {'; '.join(reasons)}; so the pose may be wrong by far more than is "
        "stated; check the joints' zeros: robot-ik camera verify --fit"
    )


def samples_path(out: Path) -> Path:
    """Where the samples of a result go: beside it."""
    return out.with_name(f"{out.stem}.samples.json")


def visit_stations(
    report: ArmCameraReport,
    request: HandEyeRequest,
    setup: RobotSetup,
    scene: HandEyeScene,
    keep: Callable[[SampleSet], None],
    progress: Progress,
) -> None:
    """Plans stations; unless that is all, goes to them with torque and looks at the board.

    The report has what came of it, and its samples are handed to ``keep`` after each.

    Raises:
        HardwareError, TrajectoryError, CameraError: As the arm and the camera do.
    """
    progress("planning", 0.0)
    planned = plan_views(
        setup.robot,
        scene.task,
        request.views,
        start=setup.q,
        seed=request.seed,
        collisions=setup.collisions,
    )
    report.stations, count = tuple(planned), len(planned)
    if request.dry_run:
        return
    setup.enable_torque()
    for number, asked in enumerate(planned):
        trajectory = setup.checked(joint_move(setup.robot, setup.q, asked, **setup.caps(request.speed)))

        def show(tick: Any, number: int = number, ticks: int = max(1, len(trajectory))) -> None:
            progress(f"view {number + 1} of {count}", (number + min(1.0, tick.index / ticks)) / count)

        settle = 0.0 if setup.arm is None else _SETTLE_SECONDS
        execute(trajectory, setup.sinks, source=setup.opened, clock=setup.clock, on_tick=show, settle=settle)
        before, still = _come_to_rest(setup)
        frame = scene.take()
        q = 0.5 * (before + setup.q)  # where the servos say that it is, before and after the picture
        view = scene.board.find(frame, scene.task.intrinsics) if still else None
        if view is None:
            report.unseen += (number,)
            continue
        report.samples.add(q, view)
        keep(report.samples)


def _come_to_rest(setup: RobotSetup) -> tuple[Array, bool]:
    """Reads until two readings agree: the last one (nq,), and whether they did."""
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
