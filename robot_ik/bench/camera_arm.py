"""Joint zero offsets from pictures: recovered from what is hidden in a simulated arm."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.arm_zeros.fit import ArmView, KnownPose, fit_zero_offsets
from robot_ik.camera.boards.view import BoardView
from robot_ik.camera.made_up.standard_set import STANDARD_CAMERA
from robot_ik.camera.made_up.synthetic import look_at
from robot_ik.camera.pose.bodies import grid_body
from robot_ik.camera.pose.marker import marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import Robot, load_robot

Array = NDArray[np.float64]

_ROBOT, _VIEWS = "puma560", 30
# Hidden offsets up to so much; scatter of a servo (a twelve-bit tick) and of corners.
_HIDDEN, _TICK, _PIXELS = np.deg2rad(2.0), np.deg2rad(0.088), 0.1
# How well camera and board are known before: m, rad.
_CAMERA_KNOWN, _BOARD_KNOWN = (1e-3, np.deg2rad(0.05)), (1e-3, np.deg2rad(0.05))
_DISTANCE, _BEND, _STEEPEST = 0.8, 0.6, 0.4
_BOARD = Pose((0.0, 0.0, 0.03))


def offsets(effort: Effort) -> Iterator[Figure]:
    """Zero offsets of six joints from 30 pictures of a 2×2 board in the hand, by a camera that stands."""
    robot = load_robot(_ROBOT)
    rng, off, counted = np.random.default_rng(effort.seed), [], []
    seen = robot.forward(robot.home).compose(_BOARD)
    eye = look_at(seen.apply([0.05, -0.1, _DISTANCE]), seen.position)
    for _ in range(2 if effort.quick else 6):
        hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
        views = [_view(robot, eye, hidden, rng) for _ in range(_VIEWS)]
        found = fit_zero_offsets(
            views, robot, robot.tool, STANDARD_CAMERA,
            camera=_known(eye, _CAMERA_KNOWN, rng), board=_known(_BOARD, _BOARD_KNOWN, rng),
        )  # fmt: skip
        known = found.sigma > 0.0
        off.append(np.abs(found.offsets - hidden)[known])
        counted.append(len(found.found))
    every = np.degrees(np.concatenate(off))
    yield Figure("joint zero offsets from 30 views, RMS", float(np.sqrt(np.mean(every**2))), "°", 0.1)
    yield Figure("joint zero offsets from 30 views, worst", float(every.max()), "°")
    yield Figure("joints of 6 whose offset was found", min(counted), "", robot.nv, at_least=True)


def _known(pose: Pose, sigma: tuple[float, float], rng: np.random.Generator) -> KnownPose:
    """A guess that is off by what it is said to be."""
    turn = Pose(wxyz=rotation_exp(rng.normal(0.0, sigma[1], 3)))
    guess = Pose(pose.position + rng.normal(0.0, sigma[0], 3), turn.compose(Pose(wxyz=pose.wxyz)).wxyz)
    return KnownPose.within(guess, *sigma)


def _view(robot: Robot, eye: Pose, hidden: Array, rng: np.random.Generator) -> ArmView:
    """What the servos say and the camera sees, at a random pose that shows the board."""
    layout = grid_body(2, 2, 0.05, 0.012).markers
    points = np.concatenate([on.apply(marker_points(side)) for side, on in layout.values()])
    while True:
        q = robot.clip(robot.home + rng.uniform(-_BEND, _BEND, robot.nq))
        true = q + hidden + rng.normal(0.0, 0.5 * _TICK, robot.nv)
        board = eye.inverse().compose(robot.forward(true)).compose(_BOARD)
        way = -board.position / np.linalg.norm(board.position)
        if board.position[2] < 0.3 or board.rotation[:, 2] @ way < _STEEPEST:
            continue
        pixels = STANDARD_CAMERA.project(board.apply(points))
        if (pixels > 5).all() and (pixels < np.array(STANDARD_CAMERA.size) - 6).all():
            noisy = pixels + rng.normal(0.0, _PIXELS, pixels.shape)
            return ArmView(q, BoardView(points, noisy, board, _PIXELS))
