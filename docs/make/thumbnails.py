"""Make the pictures of the page's gallery: `python docs/make/thumbnails.py [NAME …]`.

Each is a robot in the pose of its gallery scene, cut out of its background, for light and dark.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from gallery import pose_at_work
from PIL import Image

from robot_ik import catalogue, load_robot
from robot_ik.camera.drawing.faces import surface_points
from robot_ik.camera.drawing.framing import fitted_camera, portrait_lens
from robot_ik.camera.drawing.studio import SEAMLESS, Body, photograph
from robot_ik.testbed.gallery_scene import gallery_scene

FOLDER = Path(__file__).resolve().parents[2] / "robot_ik/testbed/frontends/web/thumbnails"
SIZE = (320, 240)
"""Width and height, pixels. The page shows them at half this size."""

OVERSAMPLING = 2
"""Pixels drawn for each pixel of the picture, along each side."""

COLOURS = 192
"""Of the palette. More colours make the files larger, and no difference is visible."""


def thumbnail(name: str) -> Image.Image:
    """Return the picture of a robot of the catalogue, with an alpha channel."""
    robot = load_robot(name)
    scene = gallery_scene(robot)
    floor = float(surface_points(robot.model, robot.qpos(robot.home))[:, 2].min())
    q = pose_at_work(robot, scene, floor, seed=0).q
    optics = portrait_lens(OVERSAMPLING * SIZE[0], OVERSAMPLING * SIZE[1])
    points = surface_points(robot.model, robot.qpos(q))
    camera = fitted_camera(points, scene.view_deg, optics)
    photo = photograph([Body(robot.model, robot.qpos(q))], optics, camera, SEAMLESS, floor=floor)
    rgba = np.dstack([cv2.cvtColor(photo.image, cv2.COLOR_BGR2RGB), photo.coverage])
    return Image.fromarray(rgba, "RGBA").resize(SIZE, Image.Resampling.LANCZOS)


def main() -> None:
    """Make all pictures, or those that are named."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or catalogue():
        picture = thumbnail(name).quantize(COLOURS, Image.Quantize.FASTOCTREE)
        file = FOLDER / f"{name}.png"
        picture.save(file, optimize=True)
        print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
