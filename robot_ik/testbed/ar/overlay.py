"""``robot-ik ar``: the virtual robot standing in the pictures of a camera."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.drawing.faces import project, surface_points
from robot_ik.camera.drawing.occluders import load_occluders
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.registration import BoardTracker, LatencyOptions, Registrar, Sync
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.board_table import (
    AT_REST,
    BOARD,
    FOLLOWED,
    BoardMotion,
    synthetic_scene,
)
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import DEFAULT_DICTIONARY, MarkerTarget, marker
from robot_ik.errors import ConfigError, MarkerNotFoundError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.kernels.precompile import Precompilation
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot
from robot_ik.schedule import Schedule, regular
from robot_ik.testbed.ar.motion import DrawnMotion, make_motion, marker_from_base, standing
from robot_ik.workcell.films import PictureSink, open_sink
from robot_ik.workcell.precompile import precompile_overlay
from robot_ik.workcell.vision import open_calibrated

# Height of a robot that is drawn on the synthetic table, metres.
_TABLE_SIZE = 0.40
# Length of a film of the synthetic table by default, s.
_SECONDS = 4.0
# Pictures per second of the written film.
_RATE_HZ = 30.0
# Free border around the robot, as a share of the size of the picture.
_MARGIN = 0.02
# Moments of the motion at which the robot must be inside the picture.
_MOMENTS = 24
# Least share of the usual scale. A robot that fits only below it keeps the usual scale and is
# partly outside the picture.
_LEAST_SHARE = 0.05
_OUT_OF_VIEW = (
    "nothing of the robot is in view, its board is: try a smaller --scale, or another --robot-pose"
)


@dataclass(frozen=True)
class ArRequest:
    """What to draw on which pictures.

    Attributes:
        robot: Robot to draw, see ``load_robot``.
        camera: ``synthetic``, or a source for ``open_source``.
        intrinsics: Calibration file of a real camera.
        board: Board on which the robot stands, see ``parse_target``.
        dictionary: Dictionary of the board's markers.
        extrinsics: File with the pose of a camera that does not move, instead of a board.
        base: Where the robot stands: x, y, z in metres and degrees about the vertical, seen from
            the middle of the board (x right, y up, z out of the print), or in the world of
            ``extrinsics``.
        scale: Drawn size over true size. 0: 1 with a real camera, fitted to the synthetic table.
        motion: See ``make_motion``.
        marker: Id and side (m) of the marker to follow.
        occluders: Model file of real objects that hide the robot.
        occluder_geoms: Names of the robot model's geoms that hide the robot.
        latency_options: How the delay between camera and drawing is compensated.
        alpha: Opacity of the robot, from 0 to 1.
        shadow: Whether the robot casts a shadow.
        out: Film, picture or folder to write.
        overwrite: Whether to replace ``out``.
        seconds: Length, s. 0: to the end of the recording, or of the motion on the synthetic table.
        size: Size of synthetic and live pictures, px.
        seed: Of the synthetic camera's noise.
    """

    robot: str = "puma560"
    camera: str = "synthetic"
    intrinsics: Path | None = None
    board: str = BOARD
    dictionary: str = ""
    extrinsics: Path | None = None
    base: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    scale: float = 0.0
    motion: str = "wave"
    marker: tuple[int, float] = FOLLOWED
    occluders: Path | None = None
    occluder_geoms: tuple[str, ...] = ()
    latency_options: LatencyOptions = field(default_factory=LatencyOptions)
    alpha: float = 1.0
    shadow: bool = True
    out: Path = Path("ar.mp4")
    overwrite: bool = False
    seconds: float = 0.0
    size: tuple[int, int] | None = None
    seed: int = 0


@dataclass(eq=False)
class ArReport:
    """Result of a run.

    Attributes:
        scale: Drawn size over true size.
        notice: What differs from the request, in one line.
        pictures: Number of written pictures.
        drawn: Number of pictures with a tracked board, in which the robot is drawn.
        in_view: Number of pictures in which a part of the robot is inside the picture.
        reprojection_px: Mean RMS error of the board's corners, px.
        seconds: Time of tracking and drawing, without reading and writing pictures, s.
        interrupted: Whether the user stopped the run.
        file: The written film, picture or folder.
    """

    scale: float
    notice: str
    pictures: int = 0
    drawn: int = 0
    in_view: int = 0
    reprojection_px: float = float("nan")
    seconds: float = 0.0
    interrupted: bool = False
    file: Path | None = None

    @property
    def rate_hz(self) -> float:
        """Pictures per second of tracking and drawing."""
        return self.pictures / self.seconds if self.seconds > 0 else float("nan")


#: Called with the number of finished pictures and of all pictures (0: unknown).
PictureProgress = Callable[[int, int], None]
Mover = Callable[[Robot, DrawnRobot], DrawnMotion]


def run_ar(
    request: ArRequest,
    progress: PictureProgress = lambda _done, _total: None,
    *,
    robot: Robot | None = None,
    mover: Mover | None = None,
) -> ArReport:
    """Draw the robot into each picture and write the pictures.

    Args:
        request: What to draw.
        progress: Called after each picture.
        robot: Drawn instead of the robot of the request.
        mover: Makes the motion instead of ``request.motion``.

    Raises:
        MarkerNotFoundError: The board was in no picture.
        RobotIkError: Wrong input or environment.
    """
    with contextlib.ExitStack() as stack:
        sink = stack.enter_context(open_sink(request.out, _RATE_HZ, overwrite=request.overwrite))
        robot = robot or load_robot(request.robot)
        compiling = stack.enter_context(precompile_overlay())
        figure = _figure(request, robot)
        make = mover or partial(make_motion, request.motion, stack=stack)
        motion = make(robot, figure)
        opened = _open(request, figure, motion, stack)
        if opened.pose_board_camera is not None and not request.scale:
            figure = _in_view(figure, request, robot, motion, opened, opened.pose_board_camera)
            if request.motion == "follow":
                # The reach depends on the scale of the drawn robot.
                motion = make(robot, figure)
        report = ArReport(figure.scale, motion.notice)
        registrar = _registrar(request, opened.intrinsics, figure)
        _draw(report, request, robot, motion, opened, registrar, sink, compiling, progress)
        report.file = sink.close()
    if report.pictures and not report.drawn:
        raise MarkerNotFoundError(
            f"the board {request.board} was seen in no picture; what was drawn is in {report.file}",
            hint=_why_unseen(request, opened),
        )
    if 2 * report.drawn < report.pictures:
        seen = f"the board was seen in {report.drawn} of {report.pictures} pictures only"
        report.notice = _joined(report.notice, f"{seen}: {_why_unseen(request, opened)}")
    if report.drawn and not report.in_view:
        report.notice = _joined(report.notice, _OUT_OF_VIEW)
    return report


def _why_unseen(request: ArRequest, opened: _Opened) -> str:
    """Return what to try if the board is seen in few pictures or in none."""
    if request.camera != "synthetic":
        return (
            "check --board and --dictionary against the print (robot-ik camera detect), "
            "light and focus; the whole board should be in view"
        )
    if (request.board, request.dictionary) != (BOARD, ""):
        return f"the synthetic table has the board {BOARD}: leave --board and --dictionary away"
    width, height = opened.intrinsics.size
    return (
        f"the board is too small in pictures of {width}x{height} px: "
        "try a larger --size, such as 640 480"
    )


def _joined(*notices: str) -> str:
    return "; ".join(filter(None, notices))


@dataclass(frozen=True, eq=False)
class _Opened:
    """The pictures, with times since the first one: ``total`` of them (0: unknown), their optics.

    ``pose_board_camera`` by time, of synthetic ones alone.
    """

    frames: Iterator[Frame]
    intrinsics: CameraIntrinsics
    total: int
    pose_board_camera: Callable[[float], Pose] | None


def _draw(
    report: ArReport,
    request: ArRequest,
    robot: Robot,
    motion: DrawnMotion,
    opened: _Opened,
    registrar: Registrar,
    sink: PictureSink,
    compiling: Precompilation,
    progress: PictureProgress,
) -> None:
    """Track, draw and write all pictures until they end or Ctrl-C, and write into ``report``."""
    errors: list[float] = []
    try:
        for tracked, shown in _pairs(opened.frames, request.latency_options.sync):
            start = time.perf_counter()
            observation = registrar.track(tracked)
            compiling.wait()
            pose_board_marker = None if observation is None else observation.pose_board_marker
            q = motion.q(shown.time, pose_board_marker)
            image, drawing = registrar.compose(observation, shown, robot.qpos(q))
            report.seconds += time.perf_counter() - start
            sink.write(image, shown.time)
            report.pictures += 1
            if drawing is not None:
                report.drawn += 1
                report.in_view += bool(drawing.robot.coverage.any())
                if observation is not None:
                    errors.append(observation.board.reprojection_error)
            progress(report.pictures, opened.total)
    except KeyboardInterrupt:
        report.interrupted = True
    report.reprojection_px = float(np.mean(errors)) if errors else float("nan")


def marker_positions(request: ArRequest, robot: Robot) -> Iterator[tuple[float, Array | None]]:
    """Yield the positions of the followed marker in the frame of the robot's base.

    Yields:
        Time since the first picture, s, and the position (3,) in the robot's own metres, without
        the scale of the drawing. None if board or marker is not visible.

    Raises:
        RobotIkError: Wrong input or environment.
    """
    request = replace(request, motion="follow")
    with contextlib.ExitStack() as stack:
        figure = _figure(request, robot)
        opened = _open(request, figure, standing(robot), stack)
        tracker = _board_tracker(request, opened.intrinsics)
        for frame in opened.frames:
            observation = tracker.observe(frame)
            pose = None if observation is None else observation.pose_board_marker
            yield frame.time, None if pose is None else marker_from_base(pose, figure)


def _in_view(
    usual: DrawnRobot,
    request: ArRequest,
    robot: Robot,
    motion: DrawnMotion,
    opened: _Opened,
    camera_at: Callable[[float], Pose],
) -> DrawnRobot:
    """Return the largest robot, up to the usual scale, that is inside all pictures of the scene.

    A robot far from the middle of the picture (``base``) keeps the usual scale.
    """
    size = np.array(opened.intrinsics.size)
    # Robot and board move slowly, so a few moments suffice.
    times = np.linspace(0.0, opened.total / _RATE_HZ, min(_MOMENTS, opened.total)).tolist()
    moments = [
        (surface_points(robot.model, robot.qpos(motion.q(time, None))), camera_at(time))
        for time in times
    ]

    def scaled(scale: float) -> DrawnRobot:
        return replace(usual, pose_board_base=_base(request, robot, scale), scale=scale)

    def fits(figure: DrawnRobot) -> bool:
        for points, camera in moments:
            pixels, _, within = project(
                figure.camera(camera).inverse().apply(points), opened.intrinsics
            )
            if not (within.all() and (np.abs(pixels - 0.5 * size) < (0.5 - _MARGIN) * size).all()):
                return False
        return True

    least = _LEAST_SHARE * usual.scale
    most = usual.scale
    if fits(usual) or not fits(scaled(least)):
        return usual
    while most > 1.02 * least:
        middle = float(np.sqrt(least * most))
        least, most = (middle, most) if fits(scaled(middle)) else (least, middle)
    return scaled(least)


def _figure(request: ArRequest, robot: Robot) -> DrawnRobot:
    """Return the drawn robot at the requested or the usual scale."""
    low, high = heights(robot)
    usual = _TABLE_SIZE / max(high - low, 1e-6) if request.camera == "synthetic" else 1.0
    scale = request.scale or usual
    geoms = _named_geoms(robot, request.occluder_geoms)
    occluders = None if request.occluders is None else load_occluders(request.occluders)
    base = _base(request, robot, scale)
    return DrawnRobot(robot.model, base, scale, occluders, geoms, shadow=request.shadow)


def _base(request: ArRequest, robot: Robot, scale: float) -> Pose:
    """Return the pose of the base: the lowest point of the robot is on the board."""
    x, y, z, yaw = request.base
    return Pose((x, y, z - scale * heights(robot)[0]), rotation_exp([0.0, 0.0, np.deg2rad(yaw)]))


def heights(robot: Robot) -> tuple[float, float]:
    """Return the heights of the lowest and the highest point of the robot at home, metres."""
    up = surface_points(robot.model, robot.qpos(robot.home))[:, 2]
    return (float(up.min()), float(up.max())) if len(up) else (0.0, 0.0)


def _named_geoms(robot: Robot, names: tuple[str, ...]) -> NDArray[np.bool_] | None:
    known = [robot.model.geom(g).name for g in range(robot.model.ngeom)]
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{robot.name} has no geom {name!r}",
                file="command line",
                key="--occluders",
                allowed=", ".join(sorted(filter(None, known))) or "none: its geoms have no names",
            )
    return np.array([name in names for name in known]) if names else None


def _open(
    request: ArRequest, figure: DrawnRobot, motion: DrawnMotion, stack: contextlib.ExitStack
) -> _Opened:
    if request.camera == "synthetic":
        width, height = request.size or (1280, 720)
        board = BoardMotion() if figure.occluders is None else AT_REST
        source, clock = synthetic_scene(
            width,
            height,
            motion=board,
            occluders=figure.occluders,
            follow=request.motion == "follow",
            seed=request.seed,
        )
        camera = source.scene.pose_world_camera
        seconds = request.seconds or motion.seconds or _SECONDS
        count = max(1, round(seconds * _RATE_HZ))

        def made() -> Iterator[Frame]:
            for _ in Schedule(clock).ticks(regular(_RATE_HZ, count)):
                yield source.read().without_truth()

        intrinsics = source.scene.intrinsics
        return _Opened(made(), intrinsics, count, lambda t: board.pose(t).inverse().compose(camera))
    real, lens = open_calibrated(
        request.camera, request.intrinsics, stack, size=request.size, scaled=True
    )
    return _Opened(_limited(real, request.seconds), lens, 0, None)


def _limited(source: FrameSource, seconds: float) -> Iterator[Frame]:
    first: float | None = None
    for frame in source:
        first = frame.time if first is None else first
        if 0.0 < seconds < frame.time - first:
            return
        yield replace(frame, time=frame.time - first)


def _pairs(frames: Iterator[Frame], sync: Sync) -> Iterator[tuple[Frame, Frame]]:
    """Yield pairs of a picture to track and a picture to show.

    They are the same if the video waits for tracking. Otherwise the next picture is shown: of a
    live camera, it is the newest one after tracking and drawing.
    """
    return ((frame, frame) for frame in frames) if sync == "tracked" else itertools.pairwise(frames)


def _registrar(request: ArRequest, intrinsics: CameraIntrinsics, figure: DrawnRobot) -> Registrar:
    tracker = None
    camera = None
    if request.extrinsics is None:
        tracker = _board_tracker(request, intrinsics)
    else:
        extrinsics = CameraExtrinsics.load(request.extrinsics, intrinsics)
        extrinsics.require_parent("world")
        camera = extrinsics.pose_parent_camera
    return Registrar(
        tracker,
        figure,
        intrinsics,
        request.latency_options,
        pose_board_camera=camera,
        alpha=request.alpha,
    )


def _board_tracker(request: ArRequest, intrinsics: CameraIntrinsics) -> BoardTracker:
    board = parse_target(request.board, request.dictionary)
    if request.motion != "follow":
        return BoardTracker(board, intrinsics)
    marker_id, size = request.marker
    dictionary = request.dictionary or DEFAULT_DICTIONARY
    if isinstance(board, MarkerTarget):
        dictionary = board.dictionary
        if marker_id in board.markers:
            raise ConfigError(
                f"marker {marker_id} is on the board, so it cannot be followed",
                file="command line",
                key="--marker",
                allowed="an id that is not on the board",
            )
    return BoardTracker(board, intrinsics, marker(marker_id, size, dictionary))
