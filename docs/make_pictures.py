"""Draws what the whole-body examples solve: `python docs/make_pictures.py [NAME …]`.

It writes docs/images/whole_body.png and lion.png: on the left the figure at home, on the right the answer of
the example of that name, with its ball.  No OpenGL, nothing random: the same program draws the same picture.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.jobs.studio import fitted_camera, lens, photograph, surface

Image = NDArray[np.uint8]

HERE = Path(__file__).parent
# Of one picture of the two, pixels.
SIZE = (560, 560)
_BALL_RADIUS, _BALL_COLOUR = 0.045, (0.93, 0.42, 0.10, 1.0)
# Of a picture's width, left free on both sides of what is to be seen.
_AIR = 0.06


@dataclass(frozen=True)
class Scene:
    """One picture.

    Attributes:
        example: File in examples/ that says who, what is wanted, and where the ball is.
        robot: Who.
        view_deg: From where it is seen: azimuth and elevation.
    """

    example: str
    robot: str
    view_deg: tuple[float, float]


SCENES = {
    "whole_body": Scene("04_whole_body.py", "humanoid", (-62.0, 7.0)),
    "lion": Scene("05_lion.py", "lion", (-50.0, 12.0)),
}


def example(name: str) -> ModuleType:
    """A program of examples/."""
    spec = importlib.util.spec_from_file_location(Path(name).stem, HERE.parent / "examples" / name)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def answer(scene: Scene) -> tuple[rik.Solution, tuple[float, ...]]:
    """What the example solves, and its ball."""
    program, robot = example(scene.example), rik.load_robot(scene.robot)
    return rik.solve(robot, list(program.wishes(robot).values())), program.BALL


def with_ball(path: Path, place: tuple[float, ...]) -> mujoco.MjModel:
    """The model with a ball that touches nothing."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_geom(
        name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_BALL_RADIUS, 0, 0], pos=list(place),
        rgba=list(_BALL_COLOUR), contype=0, conaffinity=0,
    )  # fmt: skip
    return spec.compile()


def draw(scene: Scene) -> Image:
    """Home and answer beside each other, BGR."""
    found, ball = answer(scene)
    robot = found.robot
    model, optics = with_ball(robot.path, ball), lens(*SIZE)
    poses = [robot.qpos(robot.home), robot.qpos(found.q)]
    shapes = [surface(model, qpos) for qpos in poses]
    floor = float(surface(robot.model, poses[0])[:, 2].min())
    camera = fitted_camera(np.concatenate(shapes), scene.view_deg, optics)
    photos = [photograph(model, qpos, camera, optics, floor) for qpos in poses]
    columns = np.flatnonzero(np.maximum(photos[0].coverage, photos[1].coverage).max(axis=0) > 0)
    air = round(_AIR * SIZE[0])
    seen = slice(max(0, int(columns[0]) - air), int(columns[-1]) + 1 + air)
    return np.concatenate([photo.image[:, seen] for photo in photos], axis=1)


def main(names: list[str]) -> None:
    """Draws the scenes of those names, by default all."""
    for name in names or list(SCENES):
        path = HERE / "images" / f"{name}.png"
        cv2.imwrite(str(path), draw(SCENES[name]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(path.name)


if __name__ == "__main__":
    main(sys.argv[1:])
