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
from robot_ik.camera.target_files import parse_target
from robot_ik.camera.targets import DEFAULT_DICTIONARY, MarkerTarget, marker
from robot_ik.errors import ConfigError, MarkerNotFoundError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs.ar.motion import DrawnMotion, make_motion, marker_from_base, standing
from robot_ik.jobs.ar.scene import AT_REST, BOARD, FOLLOWED, BoardMotion, synthetic_scene
from robot_ik.jobs.films import PictureSink, open_sink
from robot_ik.jobs.precompile import Precompilation
from robot_ik.jobs.vision import open_calibrated
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

# On the synthetic table a robot is drawn so high, metres; films of it are this long unless said otherwise.
_TABLE_SIZE, _SECONDS = 0.40, 4.0
_RATE_HZ = 30.0
# All of it stays in the picture, with so much of the picture's size to spare; looked at in so many moments.
_MARGIN, _MOMENTS = 0.02, 24
# A robot that fits only below this part of the usual scale stands beside the picture, not too large in it.
_LEAST_SHARE = 0.05
_OUT_OF_VIEW = "nothing of the robot is in view, its board is: try a smaller --scale, or another --base"


@dataclass(frozen=True)
class ArRequest:
    """What to draw on what.

    Attributes:
        camera: ``synthetic``, or what ``open_source`` takes; ``intrinsics``: its calibration, of a real one.
        board: See ``parse_target``; ``dictionary`` of its markers.
        extrinsics: Of a camera that stands still, instead of a board.
        base: Where the robot stands: x, y, z in metres and degrees about the vertical, seen from the middle
            of the board (x right, y up, z out of the print), or in the world of ``extrinsics``.
        scale: Drawn over true size; 0 is 1 for a real camera and what suits the synthetic table.
        motion: See ``make_motion``.
        marker: Id and side (m) of the marker to follow.
        occluders: File of real objects that hide the robot; ``occluder_geoms`` names of the model's own.
        alpha: Opacity of the robot, 0 to 1.
        out: Film, picture or folder.
        seconds: How long; 0 to the end of what is recorded, or on the synthetic table of the motion.
        size: Of synthetic and live pictures.
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
    """What came of it.

    Attributes:
        scale: Drawn size over true size.
        notice: What did not go as asked, in one line.
        pictures, drawn, in_view: Written; of these with the robot; with some of it in the picture.
        reprojection_px: Mean RMS error of the board's corners.
        seconds: Of tracking and drawing alone, without taking and writing pictures.
        interrupted: The run was ended by hand.
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
        """Pictures a second that tracking and drawing manage."""
        return self.pictures / self.seconds if self.seconds > 0 else float("nan")


#: Called with how many pictures are done, and of how many (0: unknown).
PictureProgress = Callable[[int, int], None]
Mover = Callable[[Robot, DrawnRobot], DrawnMotion]


def run_ar(
    request: ArRequest,
    progress: PictureProgress = lambda done, total: None,
    *,
    robot: Robot | None = None,
    mover: Mover | None = None,
) -> ArReport:
    """Draws the robot into each picture and writes them.

    ``progress`` is given how many pictures are done, and of how many (0: unknown); ``robot`` is drawn in
    place of the request's, and ``mover`` makes what moves it in place of ``request.motion``.

    Raises:
        MarkerNotFoundError: The board was in no picture.
        RobotIkError: Wrong input or environment.
    """
    with contextlib.ExitStack() as stack:
        sink = stack.enter_context(open_sink(request.out, _RATE_HZ, overwrite=request.overwrite))
        robot = robot or load_robot(request.robot)
        compiling = stack.enter_context(Precompilation.overlay())
        figure = _figure(request, robot)
        make = mover or partial(make_motion, request.motion, stack=stack)
        motion = make(robot, figure)
        opened = _open(request, figure, motion, stack)
        if opened.pose_board_camera is not None and not request.scale:  # all of it stays in the picture
            figure = _in_view(figure, request, robot, motion, opened, opened.pose_board_camera)
            if request.motion == "follow":  # it reaches with the arm as it is drawn
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
    """What to try where the board is seen in few pictures, or in none."""
    if request.camera != "synthetic":
        return (
            "check --board and --dictionary against the print (robot-ik camera detect), light and focus; "
            "the whole board should be in view"
        )
    if (request.board, request.dictionary) != (BOARD, ""):
        return f"the synthetic table has the board {BOARD}: leave --board and --dictionary away"
    width, height = opened.intrinsics.size
    return f"the board is too small in pictures of {width}x{height} px: try a larger --size, such as 640 480"


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
    """Tracks, draws and writes all pictures, until they end or Ctrl-C; fills in the report."""
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
    """Times since the first picture, and where the followed marker is, seen from the robot's base.

    Places (3,) in the robot's own metres (``scale``); None where board or marker is not seen.

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
    """The usual drawing, or the largest in which the whole robot is in all pictures of the scene.

    A robot that is nowhere near the middle of the picture (``base``) keeps the usual scale.
    """
    size = np.array(opened.intrinsics.size)
    # A few moments tell as much as all of them: robot and board go on slowly.
    times = np.linspace(0.0, opened.total / _RATE_HZ, min(_MOMENTS, opened.total)).tolist()
    moments = [
        (surface_points(robot.model, robot.qpos(motion.q(time, None))), camera_at(time)) for time in times
    ]

    def scaled(scale: float) -> DrawnRobot:
        return replace(usual, pose_board_base=_base(request, robot, scale), scale=scale)

    def fits(figure: DrawnRobot) -> bool:
        for points, camera in moments:
            pixels, _, within = project(figure.camera(camera).inverse().apply(points), opened.intrinsics)
            if not (within.all() and (np.abs(pixels - 0.5 * size) < (0.5 - _MARGIN) * size).all()):
                return False
        return True

    least, most = _LEAST_SHARE * usual.scale, usual.scale
    if fits(usual) or not fits(scaled(least)):
        return usual
    while most > 1.02 * least:
        middle = float(np.sqrt(least * most))
        least, most = (middle, most) if fits(scaled(middle)) else (least, middle)
    return scaled(least)


def _figure(request: ArRequest, robot: Robot) -> DrawnRobot:
    """The robot as asked for, or at its usual scale."""
    low, high = heights(robot)
    usual = _TABLE_SIZE / max(high - low, 1e-6) if request.camera == "synthetic" else 1.0
    scale = request.scale or usual
    geoms = _named_geoms(robot, request.occluder_geoms)
    occluders = None if request.occluders is None else load_occluders(request.occluders)
    base = _base(request, robot, scale)
    return DrawnRobot(robot.model, base, scale, occluders, geoms, shadow=request.shadow)


def _base(request: ArRequest, robot: Robot, scale: float) -> Pose:
    """Where it stands: with its lowest point on the board."""
    x, y, z, yaw = request.base
    return Pose((x, y, z - scale * heights(robot)[0]), rotation_exp([0.0, 0.0, np.deg2rad(yaw)]))


def heights(robot: Robot) -> tuple[float, float]:
    """Of the lowest and the highest point of the robot at home, metres."""
    up = surface_points(robot.model, robot.qpos(robot.home))[:, 2]
    return (float(up.min()), float(up.max())) if len(up) else (0.0, 0.0)


def _named_geoms(robot: Robot, names: tuple[str, ...]) -> NDArray[np.bool_] | None:
    known = [robot.model.geom(g).name for g in range(robot.model.ngeom)]
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{robot.name} has no geom {name!r}", file="command line", key="--occluder-geoms",
                allowed=", ".join(sorted(filter(None, known))) or "none: its geoms have no names",
            )  # fmt: skip
    return np.array([name in names for name in known]) if names else None


def _open(
    request: ArRequest, figure: DrawnRobot, motion: DrawnMotion, stack: contextlib.ExitStack
) -> _Opened:
    if request.camera == "synthetic":
        width, height = request.size or (1280, 720)
        board = BoardMotion() if figure.occluders is None else AT_REST
        source, clock = synthetic_scene(
            width, height, motion=board, occluders=figure.occluders, follow=request.motion == "follow",
            seed=request.seed,
        )  # fmt: skip
        camera = source.scene.pose_world_camera
        seconds = request.seconds or motion.seconds or _SECONDS
        count = max(1, round(seconds * _RATE_HZ))

        def made() -> Iterator[Frame]:
            for number in range(1, count + 1):
                yield source.read().without_truth()
                clock.sleep_until(number / _RATE_HZ)

        intrinsics = source.scene.intrinsics
        return _Opened(made(), intrinsics, count, lambda t: board.pose(t).inverse().compose(camera))
    real, lens = open_calibrated(request.camera, request.intrinsics, stack, size=request.size, scaled=True)
    return _Opened(_limited(real, request.seconds), lens, 0, None)


def _limited(source: FrameSource, seconds: float) -> Iterator[Frame]:
    first: float | None = None
    for frame in source:
        first = frame.time if first is None else first
        if 0.0 < seconds < frame.time - first:
            return
        yield replace(frame, time=frame.time - first)


def _pairs(frames: Iterator[Frame], sync: Sync) -> Iterator[tuple[Frame, Frame]]:
    """Pictures to track and pictures to show; the same ones unless the video does not wait.

    Then the next one read is shown, which of a live camera is the newest when tracking and drawing are done.
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
        tracker, figure, intrinsics, request.latency_options, pose_board_camera=camera,
        alpha=request.alpha,
    )  # fmt: skip


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
