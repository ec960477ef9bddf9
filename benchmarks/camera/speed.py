"""Times of detection, drawing and goals.

Processor time of one thread, without OpenCV's threads, is the time on a dedicated core. Time by
the clock, with OpenCV's threads, is the time that a user waits. It depends on other programs. Each
is the best of three rounds of a picture, and the median over pictures. Delays are by the clock.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from benchmarks.camera.accuracy import frame_of
from benchmarks.camera.rows import Effort
from benchmarks.quantity import Quantity
from robot_ik.camera.device import DeviceSource
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticSource, placed_print
from robot_ik.camera.synthetic.painted import PaintedScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import MarkerTarget, find_corners, marker, marker_grid
from robot_ik.camera.tracker import Tracker
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array, RealClock
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell.scene import scene_for

# The marker: id, side in metres, dictionary, and distance in metres.
_MARKER = 7
_SIZE = 0.05
_DICTIONARY = "DICT_5X5_50"
_DISTANCE = 0.5
# Radius of the circle in which the marker moves, metres, and pictures for one turn.
_CIRCLE = 0.06
_TURN = 60
# Side and gap of the markers of a board, and its distance, metres.
_BOARD_SIZE = 0.03
_BOARD_GAP = 0.0075
_BOARD_DISTANCE = 0.55
# Time between two pictures of the camera, s, and between two ticks of the loop, s.
_PERIOD = 1.0 / 30.0
_TICK = 0.01
# Rounds of which the best counts, and numbers of pictures and of poses.
_ROUNDS = 3
_PICTURES = 60
_POSES = 20
# Duration of the measurement of delays, and of the quick one, s.
_DELAY_SECONDS = 5.0
_QUICK_DELAY_SECONDS = 1.5
#: 640×480 and 1280×720, both with 800 px and more of focal length.
CAMERAS = (
    STANDARD_CAMERA,
    CameraIntrinsics(
        1280, 720, 1000.0, 1000.0, 643.0, 357.0, STANDARD_CAMERA.distortion, name="720p"
    ),
)
# Time limit of one marker by the width of the picture, ms.
_MARKER_WANTED = {640: 4.0, 1280: 12.0}
# Time limit of boards by columns and rows, ms. Of the last one only a part is fitted.
_BOARDS_WANTED = {(3, 3): 14.0, (5, 4): 30.0, (6, 4): 35.0, (8, 6): 33.0}
# Processor time of the light of a synthetic picture, ms.
_EXPOSURE_WANTED = 35.0
# Wanted rate of the whole loop by the width of the picture, frames/s.
_LOOP_WANTED = {640: 60.0, 1280: 30.0}
_DELAY_WANTED_MS = 15.0
# Robots that are drawn, and the wanted times of a drawing, ms. The arm also gets goals.
_ARM = "puma560"
_FIGURE = "humanoid"
_DRAWING_WANTED = {_ARM: 3.0, _FIGURE: 8.0}


def moving_frames(camera: CameraIntrinsics, count: int, seed: int) -> list[Frame]:
    """Return pictures of one marker that moves in a circle, 30 per second."""
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(count):
        angle = 2.0 * np.pi * k / _TURN
        position = (_CIRCLE * np.cos(angle), _CIRCLE * np.sin(angle), _DISTANCE)
        turned = Pose(wxyz=rotation_exp([0.5, 0.2, angle]))
        pose = Pose(position, Pose(wxyz=(0, 1, 0, 0)).compose(turned).wxyz)
        image = render_markers(camera, {_MARKER: (_SIZE, pose)}, rng, dictionary=_DICTIONARY)
        frames.append(frame_of(image, k, k * _PERIOD))
    return frames


@dataclass(frozen=True)
class ElapsedTimes:
    """Median over pictures of the best of three rounds.

    Attributes:
        processor: Processor time of one thread, ms.
        clock: Time by the clock, ms.
    """

    processor: float
    clock: float

    def figures(self, what: str, wanted: float | None) -> Iterator[Quantity]:
        """Return both times. The limit is that of processor time."""
        yield Quantity(what, self.processor, "ms", wanted)
        yield Quantity(f"{what}, by the clock", self.clock, "ms")


def milliseconds(work: Callable[[Any], object], items: Sequence[Any]) -> ElapsedTimes:
    """Return the time of ``work`` for one of the ``items``."""
    # Compile and warm up.
    for item in items:
        work(item)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        processor = _best(work, items, time.thread_time)
    finally:
        cv2.setNumThreads(threads)
    return ElapsedTimes(processor, _best(work, items, time.perf_counter))


def _best(work: Callable[[Any], object], items: Sequence[Any], clock: Callable[[], float]) -> float:
    """Return the median over items of the best of three rounds, ms."""
    best = np.full(len(items), np.inf)
    for _ in range(_ROUNDS):
        for k, item in enumerate(items):
            began = clock()
            work(item)
            best[k] = min(best[k], clock() - began)
    return 1e3 * float(np.median(best))


def times(effort: Effort) -> Iterator[Quantity]:
    """Measure the detection, refinement and pose of a marker and of boards in whole pictures.

    The targets are tracked, as for goals and AR. "Any id" is a marker whose id is not known.
    """
    count = effort.count(_PICTURES)
    for camera in CAMERAS:
        frames = moving_frames(camera, count, effort.seed)
        size = f"{camera.width}×{camera.height}"

        def find_all(frame: Frame, camera: CameraIntrinsics = camera) -> object:
            return find_corners(frame, camera, _DICTIONARY)

        yield from milliseconds(find_all, frames).figures(f"one marker, {size}, any id", None)
        tracker = Tracker(camera, [marker(_MARKER, _SIZE, _DICTIONARY)])
        wanted = _MARKER_WANTED[camera.width]
        what = f"one marker, {size}, its id"
        yield from milliseconds(tracker.observe, frames).figures(what, wanted)
    for (columns, rows), wanted in _BOARDS_WANTED.items():
        board = marker_grid(columns, rows, _BOARD_SIZE, _BOARD_GAP, dictionary=_DICTIONARY)
        frames = _board_frames(board, count, effort.seed)
        tracker = Tracker(STANDARD_CAMERA, [board])
        what = f"board of {columns}×{rows} markers, 640×480"
        yield from milliseconds(tracker.observe, frames).figures(what, wanted)


def _board_frames(board: MarkerTarget, count: int, seed: int) -> list[Frame]:
    """Return pictures of a board that fills most of the picture."""
    rng = np.random.default_rng([seed, len(board.markers)])
    frames = []
    for k in range(count):
        tilt = rotation_exp([0.3, 0.1 * np.sin(k), 0.1 * np.cos(k)])
        rotation = Pose(wxyz=(0, 1, 0, 0)).compose(Pose(wxyz=tilt)).wxyz
        pose = Pose((0.0, 0.0, _BOARD_DISTANCE), rotation)
        placed = {i: (size, pose.compose(on)) for i, (size, on) in board.markers.items()}
        image = render_markers(STANDARD_CAMERA, placed, rng, dictionary=board.dictionary)
        frames.append(frame_of(image, k, k * _PERIOD))
    return frames


def _view_of(robot: Robot) -> Pose:
    """Return the pose of a camera that has all of a robot in view."""
    centre = robot.model.stat.center
    extent = float(robot.model.stat.extent)
    return Pose.look_at(centre + 1.6 * extent * np.array([0.7, -0.6, 0.4]), centre)


def drawing(effort: Effort) -> Iterator[Quantity]:
    """Measure the drawing of a robot over a picture of 1280×720, without and with its shadow."""
    camera = CAMERAS[1]
    picture = np.full((camera.height, camera.width, 3), 120, np.uint8)
    rng = np.random.default_rng(effort.seed)
    for name, wanted in _DRAWING_WANTED.items():
        robot = load_robot(name)
        pose = _view_of(robot)
        configurations = [
            robot.qpos(robot.clip(robot.home + rng.uniform(-0.2, 0.2, robot.nq)))
            for _ in range(_POSES)
        ]
        for shadow in (False, True):
            drawn = DrawnRobot(robot.model, shadow=shadow)

            def draw(qpos: Any, drawn: DrawnRobot = drawn, pose: Pose = pose) -> None:
                drawn.draw(qpos, camera, pose).over(picture)

            what = f"painter, {name}, 1280×720" + (", with its shadow" if shadow else "")
            elapsed = milliseconds(draw, configurations)
            yield from elapsed.figures(what, None if shadow else wanted)


def exposure(effort: Effort) -> Iterator[Quantity]:
    """Measure pictures of the synthetic camera, 1280×720: the painted scene, and all of it."""
    robot = load_robot(_ARM)
    scene = scene_for(robot).synthetic(robot)
    source = SyntheticSource(scene, lambda: robot.home, seed=effort.seed)
    painted = PaintedScene(scene.model, scene.intrinsics, scene.pose_world_camera, scene.table)
    sheets = [placed_print(m, m.pose_world(scene, robot.home, 0.0)) for m in scene.markers]
    configurations = [robot.qpos(robot.home)] * _POSES
    elapsed = milliseconds(lambda qpos: painted.expose(qpos, sheets), configurations)
    yield from elapsed.figures("light on the sensor, 1280×720", _EXPOSURE_WANTED)
    elapsed = milliseconds(lambda _: source.read(), configurations)
    yield from elapsed.figures("picture, 1280×720", None)


class _PreparedPictures(FrameSource):
    """Prepared pictures, one after the other, with the times of a camera."""

    live = True

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self._next = 0

    def read(self) -> Frame:
        """Return the next picture."""
        frame = self._frames[self._next % len(self._frames)]
        self._next += 1
        return replace(frame, sequence=self._next, time=self._next * _PERIOD)


def _goals(
    source: FrameSource, camera: CameraIntrinsics, robot: Robot, **options: Any
) -> MarkerGoalSource:
    """Return a source of goals. The marker is where the tool is at home, so that it is in reach."""
    tool = robot.forward(robot.home)
    pose_camera_marker = Pose((0.0, 0.0, _DISTANCE), (0, 1, 0, 0))
    flip = Pose(wxyz=(0, 1, 0, 0))
    world_camera = tool.compose(flip.inverse()).compose(pose_camera_marker.inverse())
    target = marker(_MARKER, _SIZE, _DICTIONARY)
    return MarkerGoalSource(source, camera, target, world_camera, flip, robot.tool, **options)


def loop(effort: Effort) -> Iterator[Quantity]:
    """Measure all from picture to drawing: marker, filter, goal, joint angles, and the robot."""
    robot = load_robot(_ARM)
    view = _view_of(robot)
    drawn = DrawnRobot(robot.model)
    problem = Problem(robot, robot.forward(robot.home), solver="lm")
    for camera in CAMERAS:
        frames = moving_frames(camera, effort.count(_PICTURES), effort.seed)
        goals = _goals(_PreparedPictures(frames), camera, robot)
        ticks = itertools.count(1)
        q = robot.home.copy()

        def step(
            frame: Frame, goals: Any = goals, camera: Any = camera, ticks: Any = ticks, q: Array = q
        ) -> None:
            goal = goals.poll(next(ticks) * _PERIOD)
            if goal is None:
                raise RuntimeError("a marker of the bench was not found")
            q[:] = problem.solve(q, target=goal.target).q
            drawn.draw(robot.qpos(q), camera, view).over(frame.image.copy())

        took = milliseconds(step, frames)
        what = f"whole loop, {camera.width}×{camera.height}"
        yield Quantity(what, 1e3 / took.processor, "frames/s", least=_LOOP_WANTED[camera.width])
        yield Quantity(f"{what}, by the clock", 1e3 / took.clock, "frames/s")


def _camera(frames: Sequence[Frame]) -> Any:
    """Return a stand-in for ``cv2.VideoCapture`` whose pictures come 30 times per second."""
    coming = itertools.cycle(frames)
    due = time.monotonic()

    def read() -> tuple[bool, Any]:
        nonlocal due
        due += _PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
        return True, next(coming).image

    return SimpleNamespace(
        read=read,
        set=lambda *_: True,
        get=lambda *_: 0.0,
        isOpened=lambda: True,
        release=lambda: None,
    )


def delay(effort: Effort) -> Iterator[Quantity]:
    """Measure the age of goals with a camera of 30 Hz, a detecting thread and a loop of 100 Hz."""
    robot = load_robot(_ARM)
    for camera in CAMERAS:
        frames = moving_frames(camera, 30, effort.seed)
        with DeviceSource("simulated", opener=partial(_camera, frames)) as source:
            goals = _goals(source, camera, robot, clock=RealClock())
            with LatestGoals(goals, RealClock()) as latest:
                seconds = _QUICK_DELAY_SECONDS if effort.quick else _DELAY_SECONDS
                end = time.monotonic() + seconds
                while time.monotonic() < end:
                    latest.poll(time.monotonic())
                    time.sleep(_TICK)
        made = goals.goal_delays.summary()
        used = goals.picture_ages.summary()
        size = f"{camera.width}×{camera.height}"
        yield Quantity(f"grab to goal, {size}, p50", 1e3 * made.p50, "ms", _DELAY_WANTED_MS)
        yield Quantity(f"grab to goal, {size}, p95", 1e3 * made.p95, "ms")
        what = f"age of the picture at a tick of 100 Hz, {size}, p50"
        yield Quantity(what, 1e3 * used.p50, "ms")
