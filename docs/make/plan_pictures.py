"""Draw the picture and the film of a planned motion: an arm goes round a shelf.

    python -m docs.make.plan_pictures

docs/images/plan_shelf.png: the arm at the start, half-way and at the goal.
docs/images/plan_shelf.gif: the motion (extra `video`).
No OpenGL, nothing random: the same program draws the same pictures.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from benchmarks.collision.scenes import shelf
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.workcell.films import open_sink

IMAGES = Path(__file__).resolve().parents[1] / "images"

MARGIN = 0.01
"""m. Distance that the motion keeps."""

SHELF = (0.66, 0.0, 0.5)
"""m. Middle of the shelf."""

INSIDE = 0.05
"""m. The tool enters the compartments to this distance behind the front of the shelf's middle."""

COMPARTMENT = 0.2
"""m. Distance of the middle of a compartment from the middle of the shelf, to the side and up."""

FORWARDS = (0.5, 0.5, 0.5, 0.5)
"""Orientation (w x y z) of a tool that points into the shelf."""

PICTURE_SIZE = (400, 400)
"""Width and height of each part of the picture, pixels."""

SHOWN = (0.0, 0.5, 1.0)
"""Shares of the duration that the picture shows."""

FILM_SIZE = (420, 320)
"""Width and height of the film, pixels."""

FILM_RATE = 10.0
"""Hz. Pictures a second of the film."""

REST = 0.8
"""s. Time that the film shows the start and the goal."""

VIEW_DEG = (-150.0, 22.0)
"""Azimuth and elevation of the camera."""

SPEED = 0.5
"""Share of the speed limits."""

BOARD_COLOUR = (0.72, 0.55, 0.36, 1.0)
"""Colour of the shelf, red, green, blue and opacity."""

LINE_COLOUR = (200, 110, 30)
"""Colour of the way of the tool, blue, green and red."""

SUBPIXEL_BITS = 4
"""Bits of a fraction of a pixel."""

VIEW_POSTURES = 12
"""Postures of the motion that the view must contain."""

Image = NDArray[np.uint8]


def planned() -> tuple[rik.Scene, rik.Trajectory]:
    """Return the scene and the motion from one compartment to the opposite one."""
    robot = rik.load_robot("panda")
    scene = rik.Scene(robot, shelf(SHELF))
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    start = rik.solve(robot, compartment(1.0, 1.0), collisions=avoid).require().q
    result = rik.plan(robot, start, compartment(-1.0, -1.0), collisions=avoid, speed=SPEED)
    return scene, result.require()


def compartment(side: float, floor: float) -> rik.Pose:
    """Return the pose of the tool in a compartment of the shelf; both signs are 1 or -1."""
    position = (
        SHELF[0] - INSIDE,
        SHELF[1] + side * COMPARTMENT,
        SHELF[2] + floor * COMPARTMENT,
    )
    return rik.Pose(position, FORWARDS)


def coloured(scene: rik.Scene) -> mujoco.MjModel:
    """Return a copy of the scene's model with a wooden shelf."""
    model = copy.copy(scene.model)
    for obstacle in scene.obstacles:
        model.geom(obstacle.name).rgba = BOARD_COLOUR
    return model


@dataclass(frozen=True, eq=False)
class View:
    """A camera, the robot and the shelf.

    Attributes:
        scene: The robot and the shelf.
        model: The same in colours.
        optics: The lens.
        camera: Pose of the camera in the world.
        tools: (n, 3) positions of the tool on the motion, m.
    """

    scene: rik.Scene
    model: mujoco.MjModel
    optics: CameraIntrinsics
    camera: rik.Pose
    tools: NDArray[np.float64]

    @classmethod
    def of(cls, scene: rik.Scene, trajectory: rik.Trajectory, size: tuple[int, int]) -> View:
        """Return the view in which the whole motion fills a picture of this size."""
        robot = scene.robot
        model = coloured(scene)
        rows = trajectory.q[:: max(1, len(trajectory) // VIEW_POSTURES)]
        points = [surface_points(model, robot.qpos(q)) for q in rows]
        optics = portrait_lens(*size)
        camera = fitted_camera(np.concatenate(points), VIEW_DEG, optics)
        tools = rik.forward_batch(robot, trajectory.q).positions
        return cls(scene, model, optics, camera, tools)

    def picture(self, q: NDArray[np.float64]) -> Image:
        """Return the robot at ``q`` (nq,) with the path of the tool, BGR."""
        body = Body(self.model, self.scene.robot.qpos(q))
        photo = photograph([body], self.optics, self.camera, SEAMLESS, floor=0.0, subject=SHELF[:2])
        image = photo.image.copy()
        pixels = self.optics.project(self.camera.inverse().apply(self.tools))
        line = np.rint(pixels * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(image, [line], False, LINE_COLOUR, 2, cv2.LINE_AA, SUBPIXEL_BITS)
        return np.asarray(image, dtype=np.uint8)


def still(scene: rik.Scene, trajectory: rik.Trajectory) -> Image:
    """Return pictures of the arm at the start, half-way and at the goal, side by side."""
    view = View.of(scene, trajectory, PICTURE_SIZE)
    times = trajectory.duration * np.array(SHOWN)
    return np.concatenate([view.picture(trajectory.at(t)) for t in times], axis=1)


def film(scene: rik.Scene, trajectory: rik.Trajectory, path: Path) -> None:
    """Write the film of the motion."""
    view = View.of(scene, trajectory, FILM_SIZE)
    count = round((trajectory.duration + 2.0 * REST) * FILM_RATE)
    with open_sink(path, FILM_RATE, overwrite=True) as sink:
        for k in range(count):
            time = k / FILM_RATE
            sink.write(view.picture(trajectory.at(time - REST)), time)


def main() -> None:
    """Draw picture and film."""
    scene, trajectory = planned()
    picture = IMAGES / "plan_shelf.png"
    cv2.imwrite(str(picture), still(scene, trajectory), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(picture.name)
    clip = IMAGES / "plan_shelf.gif"
    film(scene, trajectory, clip)
    print(clip.name)


if __name__ == "__main__":
    main()
