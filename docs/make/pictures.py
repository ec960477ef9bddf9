"""Draw pictures of the pages: `python -m docs.make.pictures [NAME ...]`.

docs/images/whole_body.png and lion.png show a figure at home and the solution of the example of
that name, with its ball. calibration.png shows the printed board and two views of it. No OpenGL and
nothing random: the same program draws the same picture.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from benchmarks.camera.pictures import pattern_set
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.prints import Print
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.camera.patterns import CharucoPattern
from robot_ik.camera.registration import BoardTracker, Registrar
from robot_ik.camera.sheets.sheets import SheetRequest, make_sheet_page
from robot_ik.camera.synthetic.board_table import BOARD, BoardMotion, synthetic_scene
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.synthetic.sensor import SensorModel
from robot_ik.camera.target_files import parse_target
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.testbed.ar.overlay import heights
from robot_ik.workcell.arm_camera.error_map import error_picture
from robot_ik.workcell.arm_camera.verify import VerifyRequest, run_verify
from robot_ik.workcell.robot_setup import Rehearsal

Image = NDArray[np.uint8]

DOCS = Path(__file__).resolve().parents[1]
# Size of each of the two pictures, pixels.
SIZE = (560, 560)
# Radius of the ball, m.
_BALL_RADIUS = 0.045
_BALL_COLOUR = (0.93, 0.42, 0.10, 1.0)
# Share of a picture's width that stays free on both sides of the robot.
_AIR = 0.06


@dataclass(frozen=True)
class Scene:
    """One picture.

    Attributes:
        example: File in examples/ with the robot, its goals and the position of the ball.
        robot: Name of the robot.
        view_deg: Azimuth and elevation of the view.
    """

    example: str
    robot: str
    view_deg: tuple[float, float]


SCENES = {
    "whole_body": Scene("04_whole_body.py", "humanoid", (-62.0, 7.0)),
    "lion": Scene("05_lion.py", "lion", (-50.0, 12.0)),
}


def example(name: str) -> ModuleType:
    """Return a program of examples/ as a module."""
    spec = importlib.util.spec_from_file_location(Path(name).stem, DOCS.parent / "examples" / name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def solved(scene: Scene) -> tuple[rik.Solution, tuple[float, ...]]:
    """Return the solution of the example, and the position of its ball, m."""
    program = example(scene.example)
    robot = rik.load_robot(scene.robot)
    return rik.solve(robot, list(program.goals(robot).values())), program.BALL


def with_ball(path: Path, position: tuple[float, ...]) -> mujoco.MjModel:
    """Return the model with a ball that has no contacts."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[_BALL_RADIUS, 0, 0],
        pos=list(position),
        rgba=list(_BALL_COLOUR),
        contype=0,
        conaffinity=0,
    )
    return spec.compile()


def draw(scene: Scene) -> Image:
    """Return a picture of home and solution beside each other, BGR."""
    solution, ball = solved(scene)
    robot = solution.robot
    model = with_ball(robot.path, ball)
    optics = portrait_lens(*SIZE)
    poses = [robot.qpos(robot.home), robot.qpos(solution.q)]
    shapes = [surface_points(model, qpos) for qpos in poses]
    floor = float(surface_points(robot.model, poses[0])[:, 2].min())
    camera = fitted_camera(np.concatenate(shapes), scene.view_deg, optics)
    photos = [
        photograph([Body(model, qpos)], optics, camera, SEAMLESS, floor=floor) for qpos in poses
    ]
    columns = np.flatnonzero(np.maximum(photos[0].coverage, photos[1].coverage).max(axis=0) > 0)
    air = round(_AIR * SIZE[0])
    visible = slice(max(0, int(columns[0]) - air), int(columns[-1]) + 1 + air)
    return np.concatenate([photo.image[:, visible] for photo in photos], axis=1)


def calibration() -> Image:
    """Draw the printed board and two views of it with its corners."""
    board = CharucoPattern(8, 6, 0.03, 0.022)
    views = list(pattern_set(board, STANDARD_CAMERA, 3, seed=2, sensor=SensorModel(noise=1.0)))
    page = make_sheet_page(SheetRequest("charuco"))
    scale = 60.0 / 25.4
    width = round(page.width * scale)
    height = round(page.height * scale)
    paper = (0.0, 0.0, float(width), float(height))
    sheet = Print.of_boxes(page.boxes[:, :4] * scale, paper, page.boxes[:, 4])
    tiles = [sheet.flat(width, height)]
    for image, _ in views[1:]:
        tile = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        view = board.find(image)
        for x, y in [] if view is None else view.pixels:
            cv2.circle(tile, (round(16 * x), round(16 * y)), 72, (40, 110, 250), 2, cv2.LINE_AA, 4)
        tiles.append(tile)
    return np.concatenate([_tile(tile, 400, 300) for tile in tiles], axis=1)


def _tile(image: Image, width: int, height: int) -> Image:
    """Return the picture in the middle of a white area, as large as possible."""
    bgr = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    scale = min((width - 16) / bgr.shape[1], (height - 16) / bgr.shape[0])
    small = cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    tile = np.full((height, width, 3), 255, np.uint8)
    y = (height - small.shape[0]) // 2
    x = (width - small.shape[1]) // 2
    tile[y : y + small.shape[0], x : x + small.shape[1]] = small
    return tile


def robot_in_the_picture() -> Image:
    """Draw virtual robots on a board in photographs of a table. One stands behind real objects."""
    objects = mujoco.MjSpec()
    for kind, position, size, colour in (
        (
            mujoco.mjtGeom.mjGEOM_BOX,
            [0.075, -0.12, 0.055],
            [0.040, 0.03, 0.055],
            [0.70, 0.22, 0.16, 1],
        ),
        (
            mujoco.mjtGeom.mjGEOM_CYLINDER,
            [-0.15, -0.02, 0.08],
            [0.04, 0.08, 0],
            [0.16, 0.42, 0.46, 1],
        ),
    ):
        objects.worldbody.add_geom(type=kind, pos=position, size=size, rgba=colour)
    real = objects.compile()
    tiles = [
        _table_with("puma560", None, 0.37, 25.0),
        _table_with("puma560", real, 0.37, 60.0),
        _table_with("humanoid", None, 0.38, -80.0),
        _table_with("lion", None, 0.30, -35.0),
    ]
    whole = np.concatenate([np.concatenate(tiles[k : k + 2], axis=1) for k in (0, 2)])
    return np.asarray(cv2.resize(whole, (960, 630), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _table_with(name: str, objects: mujoco.MjModel | None, height: float, yaw: float) -> Image:
    """Return a picture of the table with a drawn robot of this height, m, turned by degrees."""
    still = BoardMotion((0.0, 0.0), np.radians(20.0) if objects is None else 0.0, middle=(0.0, 0.0))
    source, clock = synthetic_scene(640, 420, motion=still, occluders=objects)
    near = Pose.look_at((0.12, -0.66, 0.46), (0.0, 0.05, 0.13))
    source.scene = replace(source.scene, pose_world_camera=near)
    clock.sleep_until(1.0)
    frame = source.read().without_truth()
    optics = source.scene.intrinsics
    robot = rik.load_robot(name)
    low, high = heights(robot)
    scale = height / (high - low)
    base = rik.Pose((0.0, 0.0, -scale * low), rotation_exp([0.0, 0.0, np.radians(yaw)]))
    tracker = BoardTracker(parse_target(BOARD), optics)
    registrar = Registrar(tracker, DrawnRobot(robot.model, base, scale, objects), optics)
    return registrar.compose(registrar.track(frame), frame, robot.qpos(robot.home))[0]


def error_map() -> Image:
    """Draw the errors of an arm with a slipped horn on joint 2, before and after the fit."""
    report = run_verify(
        VerifyRequest("tabletop_puma", fit=True, rehearsal=Rehearsal({"joint2": 1.5}))
    )
    drawn = cv2.imdecode(
        np.frombuffer(error_picture(report.error_maps()), np.uint8), cv2.IMREAD_COLOR
    )
    return np.asarray(drawn, dtype=np.uint8)


# One row a picture; its function stands above.
PICTURES: dict[str, Callable[[], Image]] = {
    **{name: partial(draw, scene) for name, scene in SCENES.items()},
    "calibration": calibration,
    "robot_in_the_picture": robot_in_the_picture,
    "error_map": error_map,
}


def main(names: list[str]) -> None:
    """Draw the pictures of those names, by default all."""
    for name in names or list(PICTURES):
        path = DOCS / "images" / f"{name}.png"
        cv2.imwrite(str(path), PICTURES[name](), [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(path.name)


if __name__ == "__main__":
    main(sys.argv[1:])
