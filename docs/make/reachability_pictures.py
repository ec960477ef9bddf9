"""Draw the pictures of the page about reachability maps.

    python docs/make/reachability_pictures.py

docs/images/reachability/index.png: the reachability index of the PUMA, cut upright.
docs/images/reachability/shelf.png: the same beside a shelf, cut level through the shelf.
docs/images/reachability/manipulability.png: the largest manipulability, cut upright.
docs/images/reachability/cloud.png: the cloud that the command writes, of the half behind y = 0.
Nothing is random: the same program draws the same pictures. Needs matplotlib (the extra `plots`).
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import robot_ik as rik
from robot_ik.reachability.pictures import slice_png

FOLDER = Path(__file__).resolve().parents[1] / "images" / "reachability"

CELL = 0.06
"""m."""

ROLLS = 4
"""Turns of the tool about each direction."""

MARGIN = 0.005
"""m. Smallest distance between parts."""

SHELF = rik.Box("shelf", size=(0.3, 0.1, 0.6), pose=rik.Pose((0.5, 0.3, 0.6)))

HEIGHT = 0.6
"""m. Height of the level cut: the middle of the shelf."""

DPI = 110
"""Pixels an inch."""


def cloud_png(reach_map: rik.ReachabilityMap) -> bytes:
    """Return a picture of the half of the cloud behind y = 0."""
    cloud = reach_map.cloud()
    behind = cloud.points[:, 1] > 0.0
    points = cloud.points[behind]
    figure = Figure(figsize=(6.0, 5.0), dpi=DPI, layout="constrained")
    axes = figure.add_subplot(projection="3d")
    axes.scatter(*points.T, c=cloud.colours[behind] / 255.0, s=6.0, depthshade=False)
    axes.view_init(elev=18.0, azim=-70.0)
    axes.set_box_aspect(np.ptp(points, axis=0))
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_zlabel("z, m")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def main() -> None:
    """Draw all pictures."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    robot = rik.load_robot("puma560")
    maps = []
    for obstacles in ([], [SHELF]):
        avoid = rik.CollisionAvoidance(rik.Scene(robot, obstacles), margin=MARGIN)
        maps.append(rik.map_reachability(robot, cell=CELL, rolls=ROLLS, collisions=avoid))
    bare, beside = maps
    pictures = {
        "index": slice_png(bare, across="y", at=0.0),
        "shelf": slice_png(beside, across="z", at=HEIGHT),
        "manipulability": slice_png(bare, across="y", at=0.0, quantity="manipulability"),
        "cloud": cloud_png(bare),
    }
    for name, picture in pictures.items():
        (FOLDER / f"{name}.png").write_bytes(picture)
        print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
