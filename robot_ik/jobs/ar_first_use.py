"""What a first ``robot-ik ar`` compiles, as a program: ``python -m robot_ik.jobs.ar_first_use``."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.ar.draw import Figure, PainterArtist
from robot_ik.camera.boards.board import MarkerBoard
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.synthetic import look_at
from robot_ik.camera.pose.cells import fit_print
from robot_ik.camera.pose.estimate import estimate_body
from robot_ik.camera.pose.marker import marker_points
from robot_ik.geometry import Pose
from robot_ik.robot import load_robot


def compile_overlay() -> None:
    """Fits a marker to computed corners and to an empty picture, and draws a robot beside it.

    That is all of the compiled code in the order in which it is needed, but for the refinement of corners:
    whoever started this compiles that meanwhile.
    """
    lens = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    camera = look_at((0.1, -0.4, 0.5), (0.0, 0.0, 0.0))
    board, there = MarkerBoard({0: (0.05, Pose())}), camera.inverse()
    estimate_body({0: lens.project(there.apply(marker_points(0.05)))}, board.layout, lens)
    image = np.full((480, 640, 3), 128, dtype=np.uint8)
    fit_print(image[..., 0].copy(), board.layout, [0], board.dictionary, lens, there)
    robot = load_robot("puma560")
    drawing = PainterArtist().draw(Figure(robot.model, scale=0.2), robot.qpos(robot.home), lens, camera)
    drawing.over(image)


if __name__ == "__main__":
    compile_overlay()
