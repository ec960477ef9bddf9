"""How long it takes to detect, to draw and to give goals.

Processor time of one thread, OpenCV's own switched off, is what the work takes on a core of its own; time by
the clock, with OpenCV's threads, is what a user waits, and depends on what else runs.  Each is the best of
three rounds of a picture, and the median over pictures.  Delays are by the clock.
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
from robot_ik.camera.device import DeviceSource
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.latest_goals import LatestGoals
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.camera import SyntheticSource, look_at, placed_print
from robot_ik.camera.synthetic.painted import PaintedScene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.camera.targets import MarkerTarget, find_corners, marker, marker_grid
from robot_ik.camera.tracker import Tracker
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal
from robot_ik.jobs.quantity import Quantity
from robot_ik.jobs.scene import scene_for
from robot_ik.ports import Array, RealClock
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers import make_solver

_MARKER, _SIZE, _DICTIONARY, _DISTANCE = 7, 0.05, "DICT_5X5_50", 0.5
_PERIOD, _ROUNDS = 1.0 / 30.0, 3
#: 640×480 and 1280×720, both with 800 px and more of focal length.
CAMERAS = (
    STANDARD_CAMERA,
    CameraIntrinsics(1280, 720, 1000.0, 1000.0, 643.0, 357.0, STANDARD_CAMERA.distortion, name="720p"),
)
# Wanted time of one marker by the width of the picture, ms.
_MARKER_WANTED = {640: 4.0, 1280: 12.0}
# Wanted time of boards by columns and rows, ms. Of the last one only a part is fitted.
_BOARDS_WANTED = {(3, 3): 14.0, (5, 4): 30.0, (6, 4): 35.0, (8, 6): 33.0}
# Processor time of the light of a synthetic picture, ms.
_EXPOSURE_WANTED = 35.0
# Wanted rate of the whole loop by the width of the picture, frames/s.
_LOOP_WANTED = {640: 60.0, 1280: 30.0}
_DELAY_WANTED_MS = 15.0
# Robots that are drawn; the arm is asked for goals, too.
_ARM, _FIGURE = "puma560", "humanoid"


def moving_frames(camera: CameraIntrinsics, count: int, seed: int) -> list[Frame]:
    """Pictures of one marker that goes round in a circle before the camera, 30 a second."""
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(count):
        angle = 2.0 * np.pi * k / 60.0
        position = (0.06 * np.cos(angle), 0.06 * np.sin(angle), _DISTANCE)
        pose = Pose(
            position, Pose(wxyz=(0, 1, 0, 0)).compose(Pose(wxyz=rotation_exp([0.5, 0.2, angle]))).wxyz
        )
        image = render_markers(camera, {_MARKER: (_SIZE, pose)}, rng, dictionary=_DICTIONARY)
        frames.append(frame_of(image, k, k * _PERIOD))
    return frames


@dataclass(frozen=True)
class ElapsedTimes:
    """Median over pictures of the best of three rounds, ms: of one thread's processor time, by the clock."""

    processor: float
    clock: float

    def figures(self, what: str, wanted: float | None) -> Iterator[Quantity]:
        """Both; the bound is for the processor's."""
        yield Quantity(what, self.processor, "ms", wanted)
        yield Quantity(f"{what}, by the clock", self.clock, "ms")


def milliseconds(work: Callable[[Any], object], items: Sequence[Any]) -> ElapsedTimes:
    """How long ``work`` takes for one of the ``items``."""
    for item in items:  # compiles and warms up
        work(item)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        processor = _best(work, items, time.thread_time)
    finally:
        cv2.setNumThreads(threads)
    return ElapsedTimes(processor, _best(work, items, time.perf_counter))


def _best(work: Callable[[Any], object], items: Sequence[Any], clock: Callable[[], float]) -> float:
    best = np.full(len(items), np.inf)
    for _ in range(_ROUNDS):
        for k, item in enumerate(items):
            began = clock()
            work(item)
            best[k] = min(best[k], clock() - began)
    return 1e3 * float(np.median(best))


def times(effort: Effort) -> Iterator[Quantity]:
    """Detecting, refining and posing one marker and boards anywhere in the picture.

    The targets are tracked, as goals and AR ask for them. All ids of a dictionary: a single marker
    whose id is not known.
    """
    count = effort.count(60)
    for camera in CAMERAS:
        frames = moving_frames(camera, count, effort.seed)
        size = f"{camera.width}×{camera.height}"

        def find_all(frame: Frame, camera: CameraIntrinsics = camera) -> object:
            return find_corners(frame, camera, _DICTIONARY)

        yield from milliseconds(find_all, frames).figures(f"one marker, {size}, any id", None)
        tracker = Tracker(camera, [marker(_MARKER, _SIZE, _DICTIONARY)])
        wanted = _MARKER_WANTED[camera.width]
        yield from milliseconds(tracker.observe, frames).figures(f"one marker, {size}, its id", wanted)
    for (columns, rows), wanted in _BOARDS_WANTED.items():
        board = marker_grid(columns, rows, 0.03, 0.0075, dictionary=_DICTIONARY)
        frames = _board_frames(board, count, effort.seed)
        tracker = Tracker(STANDARD_CAMERA, [board])
        what = f"board of {columns}×{rows} markers, 640×480"
        yield from milliseconds(tracker.observe, frames).figures(what, wanted)


def _board_frames(board: MarkerTarget, count: int, seed: int) -> list[Frame]:
    """Pictures of a board that fills most of the picture."""
    rng = np.random.default_rng([seed, len(board.markers)])
    frames = []
    for k in range(count):
        tilt = rotation_exp([0.3, 0.1 * np.sin(k), 0.1 * np.cos(k)])
        pose = Pose((0.0, 0.0, 0.55), Pose(wxyz=(0, 1, 0, 0)).compose(Pose(wxyz=tilt)).wxyz)
        placed = {i: (size, pose.compose(on)) for i, (size, on) in board.markers.items()}
        image = render_markers(STANDARD_CAMERA, placed, rng, dictionary=board.dictionary)
        frames.append(frame_of(image, k, k * _PERIOD))
    return frames


def _view_of(robot: Robot) -> Pose:
    """A camera that has all of a robot in view."""
    centre, extent = robot.model.stat.center, float(robot.model.stat.extent)
    return look_at(centre + 1.6 * extent * np.array([0.7, -0.6, 0.4]), centre)


def drawing(effort: Effort) -> Iterator[Quantity]:
    """Painting a robot over a picture of 1280×720, without its shadow, which is reported apart."""
    camera = CAMERAS[1]
    picture = np.full((camera.height, camera.width, 3), 120, np.uint8)
    rng = np.random.default_rng(effort.seed)
    for name, wanted in ((_ARM, 3.0), (_FIGURE, 8.0)):
        robot = load_robot(name)
        pose = _view_of(robot)
        spots = [robot.qpos(robot.clip(robot.home + rng.uniform(-0.2, 0.2, robot.nq))) for _ in range(20)]
        for shadow in (False, True):
            drawn = DrawnRobot(robot.model, shadow=shadow)

            def draw(qpos: Any, drawn: DrawnRobot = drawn, pose: Pose = pose) -> None:
                drawn.draw(qpos, camera, pose).over(picture)

            what = f"painter, {name}, 1280×720" + (", with its shadow" if shadow else "")
            yield from milliseconds(draw, spots).figures(what, None if shadow else wanted)


def exposure(effort: Effort) -> Iterator[Quantity]:
    """Pictures of the synthetic camera of a reach, 1280×720: the painted scene, and all of it."""
    robot = load_robot(_ARM)
    scene = scene_for(robot).synthetic(robot)
    source = SyntheticSource(scene, lambda: robot.home, seed=effort.seed)
    painted = PaintedScene(scene.model, scene.intrinsics, scene.pose_world_camera, scene.table)
    sheets = [placed_print(marker, marker.pose_world(scene, robot.home, 0.0)) for marker in scene.markers]
    qpos = [robot.qpos(robot.home)] * 20
    yield from milliseconds(lambda q: painted.expose(q, sheets), qpos).figures(
        "light on the sensor, 1280×720", _EXPOSURE_WANTED
    )
    yield from milliseconds(lambda q: source.read(), qpos).figures("picture, 1280×720", None)


class _PreparedPictures(FrameSource):
    """Pictures made before, one after the other; their times go on as a camera's do."""

    live = True

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames, self._next = frames, 0

    def read(self) -> Frame:
        frame = self._frames[self._next % len(self._frames)]
        self._next += 1
        return replace(frame, sequence=self._next, time=self._next * _PERIOD)


def _goals(source: FrameSource, camera: CameraIntrinsics, robot: Robot, **options: Any) -> MarkerGoalSource:
    """The marker's middle is where the tool is at home, so that the robot can go there."""
    tool = robot.forward(robot.home)
    seen = Pose((0.0, 0.0, _DISTANCE), (0, 1, 0, 0))
    flip = Pose(wxyz=(0, 1, 0, 0))
    world_camera = tool.compose(flip.inverse()).compose(seen.inverse())
    return MarkerGoalSource(
        source, camera, marker(_MARKER, _SIZE, _DICTIONARY), world_camera, flip, robot.tool, **options
    )


def loop(effort: Effort) -> Iterator[Quantity]:
    """A picture in; marker, filter, goal, joint angles, and the robot drawn over the picture."""
    robot, solver = load_robot(_ARM), make_solver("lm")
    view, drawn = _view_of(robot), DrawnRobot(robot.model)
    problem = Problem(robot, PoseGoal.at(robot.tool, robot.forward(robot.home)))
    for camera in CAMERAS:
        frames = moving_frames(camera, effort.count(60), effort.seed)
        goals = _goals(_PreparedPictures(frames), camera, robot)
        ticks, q = itertools.count(1), robot.home.copy()

        def step(
            frame: Frame, goals: Any = goals, camera: Any = camera, ticks: Any = ticks, q: Array = q
        ) -> None:
            goal = goals.poll(next(ticks) * _PERIOD)
            assert goal is not None, "a marker of the bench was not found"
            problem.retarget(goal.target)
            q[:] = solver.solve(problem, q).q
            drawn.draw(robot.qpos(q), camera, view).over(frame.image.copy())

        took = milliseconds(step, frames)
        what = f"whole loop, {camera.width}×{camera.height}"
        yield Quantity(what, 1e3 / took.processor, "frames/s", least=_LOOP_WANTED[camera.width])
        yield Quantity(f"{what}, by the clock", 1e3 / took.clock, "frames/s")


def _camera(frames: Sequence[Frame]) -> Any:
    """What ``cv2.VideoCapture`` is to ``DeviceSource``: pictures that come 30 times a second."""
    coming, due = itertools.cycle(frames), time.monotonic()

    def read() -> tuple[bool, Any]:
        nonlocal due
        due += _PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
        return True, next(coming).image

    return SimpleNamespace(
        read=read, set=lambda *_: True, get=lambda *_: 0.0, isOpened=lambda: True, release=lambda: None
    )


def delay(effort: Effort) -> Iterator[Quantity]:
    """A camera of 30 Hz with its thread, a thread that detects, and a loop of 100 Hz that asks for goals."""
    robot = load_robot(_ARM)
    for camera in CAMERAS:
        frames = moving_frames(camera, 30, effort.seed)
        with DeviceSource("simulated", opener=partial(_camera, frames)) as source:
            goals = _goals(source, camera, robot, clock=RealClock())
            with LatestGoals(goals, RealClock()) as latest:
                end = time.monotonic() + (1.5 if effort.quick else 5.0)
                while time.monotonic() < end:
                    latest.poll(time.monotonic())
                    time.sleep(0.01)
        made, used = goals.goal_delays.summary(), goals.picture_ages.summary()
        size = f"{camera.width}×{camera.height}"
        yield Quantity(f"grab to goal, {size}, p50", 1e3 * made.p50, "ms", _DELAY_WANTED_MS)
        yield Quantity(f"grab to goal, {size}, p95", 1e3 * made.p95, "ms")
        yield Quantity(f"age of the picture at a tick of 100 Hz, {size}, p50", 1e3 * used.p50, "ms")
