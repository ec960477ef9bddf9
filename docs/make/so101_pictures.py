"""Draw the pictures of the page about the SO-101.

    python docs/make/so101_pictures.py

docs/images/so101_middle.png: every joint in the middle of its range, for the calibration.
docs/images/so101_home.png: the arm at home.
docs/images/so101_reach.jpg: what the camera sees after `robot-ik reach --robot so101 --bus sim`.
No OpenGL, nothing random: the same program draws the same pictures.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph

IMAGES = Path(__file__).resolve().parents[1] / "images"

SIZE = (640, 480)
"""Width and height of a picture, pixels."""

VIEW_DEG = (-50.0, 16.0)
"""Azimuth and elevation of the camera."""

REACH_WIDTH = 800
"""Width of the picture of the reach, pixels."""

Image = NDArray[np.uint8]


def draw(robot: rik.Robot, qpos: NDArray[np.float64]) -> Image:
    """Return a picture of the robot, BGR."""
    optics = portrait_lens(*SIZE)
    points = surface_points(robot.model, qpos)
    camera = fitted_camera(points, VIEW_DEG, optics)
    floor = float(points[:, 2].min())
    return photograph([Body(robot.model, qpos)], optics, camera, SEAMLESS, floor=floor).image


def middle(robot: rik.Robot) -> NDArray[np.float64]:
    """Return qpos with every joint in the middle of its range."""
    return np.asarray(robot.model.jnt_range.mean(axis=1))


def reach() -> Image:
    """Return the picture that `robot-ik reach` writes, BGR."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "reach"
        command = ["reach", "--robot", "so101", "--bus", "sim", "--out", str(out)]
        subprocess.run([sys.executable, "-m", "robot_ik", *command], check=True)
        picture = cv2.imread(str(out / "reach.png"))
    height = round(picture.shape[0] * REACH_WIDTH / picture.shape[1])
    return cv2.resize(picture, (REACH_WIDTH, height), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Draw all pictures."""
    robot = rik.load_robot("so101")
    pictures = {
        "so101_middle.png": draw(robot, middle(robot)),
        "so101_home.png": draw(robot, robot.qpos(robot.home)),
        "so101_reach.jpg": reach(),
    }
    for name, picture in pictures.items():
        cv2.imwrite(str(IMAGES / name), picture)
        print(IMAGES / name)


if __name__ == "__main__":
    main()
