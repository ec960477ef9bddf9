"""The model that MuJoCo's window shows: a robot in its scene, on a floor, with a ball."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing.faces import surface_points
from robot_ik.errors import ViewerError
from robot_ik.model import compiled, read_spec
from robot_ik.robot import Robot
from robot_ik.testbed.arrangement import BALL_RADIUS, GOAL_COLOUR
from robot_ik.testbed.frontends.window import rgba_of

SCENE_FILE = "scene.xml"
"""File beside a robot's model: the robot with floor, light and table."""

_BALL = "testbed_ball"
"""Name of the ball's body."""

_FLOOR_GREY = (0.60, 0.61, 0.62, 1.0)
"""Of the floor of a robot without a scene."""

_BELOW = 2e-3
"""Metres between the lowest point of a robot and its floor, so that they do not flicker."""


class WindowScene:
    """A robot in its scene. Several robots stand on the floor: their tables would overlap.

    Args:
        robot: The robot.

    Attributes:
        model: The robot in its scene. The joints of the robot are its first ones.
        ball: Mocap index of the ball.
        ball_body: Its body.

    Raises:
        ViewerError: The model was not loaded from a file.
    """

    def __init__(self, robot: Robot) -> None:
        if not robot.path.is_file():
            problem = f"{robot.name} was not loaded from a file, which the window needs"
            raise ViewerError(problem, hint="use --viewer browser")
        points = surface_points(robot.model, robot.qpos(robot.home))
        self._lowest = float(points[:, 2].min(initial=0.0)) - _BELOW
        model = _own_scene(robot)
        self.model = _with_ball(robot, robot.path, self._lowest) if model is None else model
        self.ball_body = int(self.model.body(_BALL).id)
        self.ball = int(self.model.body(_BALL).mocapid[0])
        others = _other_geoms(robot, self.model)
        is_plane = self.model.geom_type[others] == mujoco.mjtGeom.mjGEOM_PLANE
        self._floors = others[is_plane]
        self._furniture = others[~is_plane]
        self._opacities = self.model.geom_rgba[self._furniture, 3].copy()
        self._heights = self.model.geom_pos[self._floors, 2].copy()

    def seat(self, count: int) -> None:
        """Show the table of one robot, or none and the floor under the feet of several."""
        is_alone = count == 1 or not len(self._furniture)
        self.model.geom_rgba[self._furniture, 3] = self._opacities if is_alone else 0.0
        self.model.geom_pos[self._floors, 2] = self._heights if is_alone else self._lowest


def _own_scene(robot: Robot) -> mujoco.MjModel | None:
    """Return the model of the scene beside the robot's file, or None if there is none."""
    file = robot.path.parent / SCENE_FILE
    if not file.is_file() or file == robot.path:
        return None
    if f'file="{robot.path.name}"' not in file.read_text(encoding="utf-8"):
        return None  # the scene of another model of that folder
    model = _with_ball(robot, file)
    names = [robot.model.joint(j).name for j in range(robot.model.njnt)]
    return model if [model.joint(j).name for j in range(len(names))] == names else None


def _with_ball(robot: Robot, file: Path, floor: float | None = None) -> mujoco.MjModel:
    """Return a model with a ball that the mouse can move, and a floor at a height, metres."""
    spec, _ = read_spec(file, file)
    ball = spec.worldbody.add_body(name=_BALL, mocap=True)
    ball.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_RADIUS * float(robot.model.stat.extent), 0.0, 0.0],
        rgba=list(rgba_of(GOAL_COLOUR)),
        contype=0,
        conaffinity=0,
    )
    if floor is not None:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            pos=[0.0, 0.0, floor],
            size=[0.0, 0.0, 0.05],
            rgba=list(_FLOOR_GREY),
            contype=0,
            conaffinity=0,
        )
    return compiled(spec)


def _other_geoms(robot: Robot, model: mujoco.MjModel) -> NDArray[np.int64]:
    """Return the geoms of a scene that are neither the robot's nor the ball."""
    robots = {robot.model.body(b).name for b in range(1, robot.model.nbody)} | {_BALL}
    fixed = np.flatnonzero(robot.model.geom_bodyid == 0).tolist()
    named = {robot.model.geom(g).name for g in fixed} - {""}
    return np.array(
        [
            g
            for g in range(model.ngeom)
            if model.body(int(model.geom_bodyid[g])).name not in robots
            and model.geom(g).name not in named
        ],
        dtype=np.int64,
    )
