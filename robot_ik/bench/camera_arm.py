"""Joint zero offsets from 30 pictures: recovered from what is hidden in a simulated arm.

Nothing is known that a person could not know: the camera's place comes from one picture of a sheet on the
table, or from the arm's own views; where the board sits in the hand, from the drawing of its mount, which is
made with errors, or from those views.  The job that moves servos and takes pictures is the row ``zeros``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_accuracy import rms
from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.arm_zeros.fit import ArmView, KnownPose, fit_zero_offsets
from robot_ik.camera.boards.view import BoardView, Layout
from robot_ik.camera.handeye import HandEyeSample, solve_handeye
from robot_ik.camera.handeye.model import moved
from robot_ik.camera.handeye.places import locate_camera
from robot_ik.camera.made_up.standard_set import STANDARD_CAMERA
from robot_ik.camera.made_up.synthetic import look_at
from robot_ik.camera.pose import estimate_body
from robot_ik.camera.pose.bodies import grid_body
from robot_ik.camera.pose.marker import marker_points
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.robot import Robot, load_robot

Array = NDArray[np.float64]

_ROBOT, _VIEWS, _TRIALS = "puma560", 30, 6
# Hidden offsets up to so much; scatter of a servo (half a tick of twelve bits) and of corners.
_HIDDEN, _SERVO, _PIXELS = np.deg2rad(2.0), np.deg2rad(0.044), 0.1
_DISTANCE, _BEND, _STEEPEST = 0.8, 1.2, 0.4
# So far inside the picture, px, is a board that is looked at.
_EDGE = 6.0
# On the tool, a board of 2×2, where the drawing of its mount has it; on the table, a sheet of A4, seen at 45
# degrees, 0.9 m away.
_DRAWN, _CARRIED = Pose((0.0, 0.0, 0.03)), grid_body(2, 2, 0.05, 0.012).markers
_SHEET = grid_body(4, 3, 0.05, 0.0125).markers
_SHEET_SEEN = Pose((0.0, 0.05, 0.9), rotation_exp([0.75 * np.pi, 0.0, 0.0]))
# How far the board is from its drawing, each axis, m and rad: held in a hand; in a mount made to it.
_HELD, _MOUNTED = (0.02, np.deg2rad(3.0)), (1e-4, np.deg2rad(0.03))
# What hand-eye calibration by the same views says of a place is worth no more before zeros are known.
_ANYWHERE = (0.05, np.deg2rad(5.0))


@dataclass(frozen=True)
class _Case:
    """What is known beforehand, and how many of six joints can be told then.

    Attributes:
        words: For the table.
        located: Whether the camera's place was found by the sheet on the table.
        made: How well the board sits where its drawing says, m and rad.
        drawing: Whether that drawing is known.
        joints: Of six.
    """

    words: str
    located: bool
    made: tuple[float, float]
    drawing: bool
    joints: int


_CASES = (
    _Case("camera and board anywhere", False, _HELD, False, 4),
    _Case("camera located, board anywhere", True, _HELD, False, 5),
    _Case("camera located, board in a mount", True, _MOUNTED, True, 6),
)


def offsets(effort: Effort) -> Iterator[Figure]:
    """Zero offsets of six joints from 30 pictures of a 2×2 board in the hand, by a camera that stands."""
    robot = load_robot(_ROBOT)
    seen = robot.forward(robot.home).compose(_DRAWN)
    eye = look_at(seen.apply([0.05, -0.1, _DISTANCE]), seen.position)
    ratios = []
    for number, case in enumerate(_CASES):
        off, counted = [], []
        for trial in range(2 if effort.quick else _TRIALS):
            rng = np.random.default_rng([effort.seed, number, trial])
            error, sigma = _trial(robot, eye, case, rng)
            off.append(np.abs(error))
            counted.append(len(error))
            ratios.append(error / sigma)
        every = np.degrees(np.concatenate(off))
        yield Figure(f"{case.words}: joint zeros, RMS", rms(every), "°", 0.1)
        yield Figure(f"{case.words}: joint zeros, worst", float(every.max()), "°", 0.1)
        yield Figure(f"{case.words}: joints of 6 told", min(counted), "", case.joints, at_least=True)
    ratio = rms(np.concatenate(ratios))
    yield Figure("stated uncertainty of joint zeros off by a factor of", max(ratio, 1.0 / ratio), "", 2.0)


def _trial(robot: Robot, eye: Pose, case: _Case, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors and stated standard deviations of the joints that are told, rad."""
    hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
    board = moved(_DRAWN, rng.normal(0.0, 1.0, 6) * np.repeat(case.made, 3))
    views = [_view(robot, eye, board, hidden, rng) for _ in range(_VIEWS)]
    samples = [HandEyeSample(robot.forward(one.q), one.view) for one in views]
    start = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    found = fit_zero_offsets(
        views, robot, robot.tool, STANDARD_CAMERA,
        camera=_located(eye, rng) if case.located else KnownPose.within(start.pose_parent_camera, *_ANYWHERE),
        board=KnownPose.within(_DRAWN, *case.made) if case.drawing
        else KnownPose.within(start.pose_other_board, *_ANYWHERE),
    )  # fmt: skip
    told = found.sigma > 0.0
    return (found.offsets - hidden)[told], found.sigma[told]


def _located(eye: Pose, rng: np.random.Generator) -> KnownPose:
    """The camera's place by one picture of the sheet on the table, which lies where the world begins."""
    place = locate_camera([_look(_SHEET_SEEN, _SHEET, rng)], eye.compose(_SHEET_SEEN), STANDARD_CAMERA)
    return KnownPose(place.pose_parent_camera, place.covariance)


def _look(pose: Pose, layout: Layout, rng: np.random.Generator) -> BoardView:
    """A board at ``pose`` (camera frame): its corners, with noise, and the pose that they give."""
    corners, points = {}, []
    for id, (side, on) in layout.items():
        points.append(on.apply(marker_points(side)))
        clean = STANDARD_CAMERA.project(pose.apply(points[-1]))
        corners[id] = clean + rng.normal(0.0, _PIXELS, clean.shape)
    seen = estimate_body(corners, layout, STANDARD_CAMERA)
    assert seen is not None
    return BoardView(
        np.concatenate(points), np.concatenate([*corners.values()]), seen.pose_camera_body, _PIXELS
    )


def _view(robot: Robot, eye: Pose, board: Pose, hidden: Array, rng: np.random.Generator) -> ArmView:
    """What the servos say and the camera sees, at a random pose that shows the board."""
    while True:
        q = robot.clip(robot.home + rng.uniform(-_BEND, _BEND, robot.nq))
        true = q + hidden + rng.normal(0.0, _SERVO, robot.nv)
        there = eye.inverse().compose(robot.forward(true)).compose(board)
        way = -there.position / np.linalg.norm(there.position)
        if there.position[2] < 0.3 or there.rotation[:, 2] @ way < _STEEPEST:
            continue
        corners = np.concatenate([on.apply(marker_points(side)) for side, on in _CARRIED.values()])
        pixels = STANDARD_CAMERA.project(there.apply(corners))
        if (pixels > _EDGE).all() and (pixels < np.array(STANDARD_CAMERA.size) - _EDGE - 1).all():
            return ArmView(q, _look(there, _CARRIED, rng))
