"""Joint zero offsets from 30 pictures: recovered from what is hidden in a simulated arm.

Nothing is known that a person could not know: the camera's pose comes from one picture of a sheet on the
table, or from the arm's own views; where the board sits in the hand, from the drawing of its mount, which is
made with errors, or from those views.  The job that moves servos and takes pictures is the row ``zeros``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from robot_ik.bench.camera import Effort
from robot_ik.bench.camera.accuracy import DICTIONARY, board_frame, factor, rms
from robot_ik.bench.quantity import Quantity
from robot_ik.camera.boards.board import BoardView, MarkerBoard
from robot_ik.camera.bodies import grid_body
from robot_ik.camera.calibration.extrinsics import locate_camera
from robot_ik.camera.calibration.handeye import HandEyeSample, solve_handeye
from robot_ik.camera.calibration.kinematic import CalibrationStation, KnownPose, fit_zero_offsets
from robot_ik.camera.motion_filter import MotionFilter, OneEuro
from robot_ik.camera.observations import estimate_body, marker_points
from robot_ik.camera.synthetic.camera import look_at
from robot_ik.camera.synthetic.datasets import STANDARD_CAMERA
from robot_ik.camera.tracker import Layout
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs.arm_camera.verify import VerifyReport, VerifyRequest, run_verify, summary
from robot_ik.jobs.robot_setup import Rehearsal
from robot_ik.jobs.scene import scene_for
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

_ROBOT, _VIEWS, _TRIALS = "puma560", 30, 6
# Hidden offsets up to so much; scatter of a servo (half a tick of twelve bits) and of corners.
_HIDDEN, _SERVO, _PIXELS = np.deg2rad(2.0), np.deg2rad(0.044), 0.1
_DISTANCE, _BEND, _STEEPEST = 0.8, 1.2, 0.4
# So far inside the picture, px, is a board that is observed.
_EDGE = 6.0
# On the tool, a board of 2×2, where the drawing of its mount has it; on the table, a sheet of A4, seen at 45
# degrees, 0.9 m away.
_DRAWN, _CARRIED = Pose((0.0, 0.0, 0.03)), grid_body(2, 2, 0.05, 0.012).markers
_SHEET = grid_body(4, 3, 0.05, 0.0125).markers
_SHEET_SEEN = Pose((0.0, 0.05, 0.9), rotation_exp([0.75 * np.pi, 0.0, 0.0]))
# How far the board is from its drawing, each axis, m and rad: held in a hand; in a mount made to it.
_HELD, _MOUNTED = (0.02, np.deg2rad(3.0)), (1e-4, float(np.deg2rad(0.03)))
# What hand-eye calibration by the same views says of a pose is worth no more before zeros are known.
_ANYWHERE = (0.05, np.deg2rad(5.0))


_Observer = Callable[[Pose, Layout, np.random.Generator], BoardView | None]


@dataclass(frozen=True)
class _Case:
    """What is known beforehand, and how many of six joints are observable then.

    Attributes:
        text: For the table.
        located: Whether the camera's pose was found by the sheet on the table.
        made: How well the board sits where its drawing says, m and rad.
        drawing: Whether that drawing is known.
        joints: Of six.
    """

    text: str
    located: bool
    made: tuple[float, float]
    drawing: bool
    joints: int


_CASES = (
    _Case("camera and board anywhere", False, _HELD, False, 4),
    _Case("camera located, board anywhere", True, _HELD, False, 5),
    _Case("camera located, board in a mount", True, _MOUNTED, True, 6),
)


def offsets(effort: Effort) -> Iterator[Quantity]:
    """Zero offsets of six joints from 30 pictures of a 2×2 board in the hand, by a camera that stands."""
    robot, eye = _robot_and_eye()
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
        yield Quantity(f"{case.text}: joint zeros, RMS", rms(every), "°", 0.1)
        yield Quantity(f"{case.text}: joint zeros, worst", float(every.max()), "°", 0.1)
        yield Quantity(f"{case.text}: joints of 6 observable", min(counted), "", least=case.joints)
    yield Quantity(
        "stated uncertainty of joint zeros off by a factor of", factor(rms(np.concatenate(ratios))), "", 2.0
    )


def _robot_and_eye() -> tuple[Robot, Pose]:
    """The arm, and a camera that sees the board in its hand."""
    robot = load_robot(_ROBOT)
    seen = robot.forward(robot.home).compose(_DRAWN)
    return robot, look_at(seen.apply([0.05, -0.1, _DISTANCE]), seen.position)


def _trial(robot: Robot, eye: Pose, case: _Case, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors and stated standard deviations of the joints that are observable, rad."""
    hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
    board = _mounted(_DRAWN, case.made, rng)
    views = [_view(robot, eye, board, hidden, rng) for _ in range(_VIEWS)]
    samples = [HandEyeSample(robot.forward(one.q), one.view) for one in views]
    start = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    camera = KnownPose.within(start.pose_parent_camera, *_ANYWHERE)
    held = KnownPose.within(start.pose_other_board, *_ANYWHERE)
    found = fit_zero_offsets(
        views, robot, robot.tool, STANDARD_CAMERA,
        camera=_located(eye, rng, _observe) if case.located else camera,
        board=KnownPose.within(_DRAWN, *case.made) if case.drawing else held,
    )  # fmt: skip
    observable = found.sigma > 0.0
    return (found.offsets - hidden)[observable], found.sigma[observable]


def _mounted(drawn: Pose, made: tuple[float, float], rng: np.random.Generator) -> Pose:
    """Where a board really sits: off its drawing by what its mount is ``made`` to."""
    return drawn.moved(rng.normal(0.0, 1.0, 6) * np.repeat(made, 3))


def _located(eye: Pose, rng: np.random.Generator, observe: _Observer) -> KnownPose:
    """The camera's pose by one picture of the sheet on the table, which lies where the world begins."""
    sheet = observe(_SHEET_SEEN, _SHEET, rng)
    assert sheet is not None, "the sheet of the bench was not found"
    found = locate_camera([sheet], eye.compose(_SHEET_SEEN), STANDARD_CAMERA)
    return KnownPose(found.pose_parent_camera, found.covariance)


def _observe(pose: Pose, layout: Layout, rng: np.random.Generator) -> BoardView:
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


def _view(
    robot: Robot,
    eye: Pose,
    board: Pose,
    hidden: Array,
    rng: np.random.Generator,
    observe: _Observer = _observe,
) -> CalibrationStation:
    """What the servos say and the camera sees, at a random pose that shows the board."""
    while True:
        q = robot.clip(robot.home + rng.uniform(-_BEND, _BEND, robot.nq))
        true = q + hidden + rng.normal(0.0, _SERVO, robot.nv)
        there = eye.inverse().compose(robot.forward(true)).compose(board)
        direction = -there.position / np.linalg.norm(there.position)
        if there.position[2] < 0.3 or there.rotation[:, 2] @ direction < _STEEPEST:
            continue
        corners = np.concatenate([on.apply(marker_points(side)) for side, on in _CARRIED.values()])
        pixels = STANDARD_CAMERA.project(there.apply(corners))
        if (pixels > _EDGE).all() and (pixels < np.array(STANDARD_CAMERA.size) - _EDGE - 1).all():
            seen = observe(there, _CARRIED, rng)
            if seen is not None:
                return CalibrationStation(q, seen)


# ------------------------------------------------------------------------------------------
# The whole chain by pictures of a webcam: is each result as near as it says?


_SEEDS, _CHAIN_VIEWS = 20, 20
# Mean squared error over the stated one.
_NEES_RANGE = (0.3, 3.0)


def _photographed(pose: Pose, layout: Layout, rng: np.random.Generator) -> BoardView | None:
    """A board at ``pose`` (camera frame) as it is seen in a picture of a webcam."""
    return MarkerBoard(layout, DICTIONARY).see(board_frame(pose, layout, rng), STANDARD_CAMERA)


def _chain(robot: Robot, eye: Pose, rng: np.random.Generator) -> tuple[tuple[float, float, float], Array]:
    """One arm with hidden offsets, one camera, one board in a mount.

    Squared errors over the stated ones of the camera's pose by a sheet on the table, of the same by the arm's
    views, and of the joint zeros; and errors (n,) of these, rad.
    """
    hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
    board = _mounted(_DRAWN, _MOUNTED, rng)
    views = [_view(robot, eye, board, hidden, rng, _photographed) for _ in range(_CHAIN_VIEWS)]
    camera = _located(eye, rng, _photographed)
    # The same pictures by an arm whose zeros are right: the camera's pose by its views alone.
    samples = [HandEyeSample(robot.forward(one.q + hidden), one.view) for one in views]
    found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    known = KnownPose.within(_DRAWN, *_MOUNTED)
    fit = fit_zero_offsets(views, robot, robot.tool, STANDARD_CAMERA, camera=camera, board=known)
    observable = np.flatnonzero(fit.sigma > 0.0)
    off = (fit.offsets - hidden)[observable]
    covariance = fit.covariance[np.ix_(observable, observable)]
    zeros = float(off @ np.linalg.solve(covariance, off)) / len(observable)
    located = _nees(camera.pose, eye, camera.covariance)
    return (located, _nees(found.pose_parent_camera, eye, found.covariance[:6, :6]), zeros), np.abs(off)


def _nees(found: Pose, truth: Pose, covariance: Array) -> float:
    """Squared error of a pose over the stated one: 1 on average for a consistent one."""
    off = found.change_from(truth)
    return float(off @ np.linalg.solve(covariance, off)) / 6.0


def consistency(effort: Effort) -> Iterator[Quantity]:
    """Locate, hand-eye and ``verify --fit`` by the pictures of a webcam: is each as near as it says?"""
    robot, eye = _robot_and_eye()
    seeds = range(effort.count(_SEEDS))
    found = [_chain(robot, eye, np.random.default_rng([effort.seed, seed])) for seed in seeds]
    nees = np.mean([one for one, _ in found], axis=0).tolist()
    for what, value in zip(
        ("camera by a sheet", "camera by the arm's views", "joint zeros"), nees, strict=True
    ):
        yield Quantity(f"{what}, squared error over the stated", value, "", _NEES_RANGE[1])
        yield Quantity(f"{what}, the same, at least", value, "", least=_NEES_RANGE[0])
    off = np.degrees(np.concatenate([one for _, one in found]))
    yield Quantity("joint zeros, RMS", rms(off), "°", 0.1)
    yield Quantity("joint zeros, worst", float(off.max()), "°")


# ------------------------------------------------------------------------------------------
# What prediction gains: a hand that moves, seen late, by different filters.


DELAYS = (0.0, 0.033, 0.066, 0.1, 0.15)
_RATE_HZ, _NOISE_M, _NOISE_RAD = 30.0, 3e-4, 2e-3
# A hand that waves: root mean square of its speed (m/s), and the frequencies in it (Hz).
_SPEED, _SLOWEST, _QUICKEST, _WAVES = 0.196, 0.3, 1.5, 6
# Pictures before the figures count.
_RUN_IN = 30


@dataclass(frozen=True)
class Lag:
    """RMS errors at one delay (s), m: of the last observation, the motion filter, the 1 € filter."""

    delay: float
    hold: float
    predicted: float
    calmed: float


def hand(rng: np.random.Generator) -> Callable[[float], Array]:
    """Position (3,) in metres of a waving hand, by time: a few waves along each axis."""
    frequency = rng.uniform(_SLOWEST, _QUICKEST, (_WAVES, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3))
    size = rng.uniform(0.5, 1.0, (_WAVES, 3)) / frequency
    speeds = 2.0 * np.pi * frequency * size
    size *= _SPEED / np.sqrt(0.5 * np.sum(speeds**2))
    return lambda t: np.asarray((size * np.sin(2.0 * np.pi * frequency * t + phase)).sum(axis=0))


def compare_filters(hands: int = 4, seconds: float = 20.0, seed: int = 0) -> tuple[list[Lag], list[Lag]]:
    """Errors of a moving and of a resting hand, at each of ``DELAYS``.

    30 pictures a second, noise of 0.3 mm along each axis.

    There are so many ``hands``, that is motions, of so many ``seconds``.
    """
    rng = np.random.default_rng(seed)
    moving = [_errors(hand(rng), seconds, rng) for _ in range(hands)]
    resting = [_errors(lambda t: np.zeros(3), seconds, rng) for _ in range(hands)]

    def lags(errors: list[Array]) -> list[Lag]:
        squares = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).tolist()
        return [Lag(delay, *row) for delay, row in zip(DELAYS, squares, strict=True)]

    return lags(moving), lags(resting)


def _errors(path: Callable[[float], Array], seconds: float, rng: np.random.Generator) -> Array:
    """(n, delays, 3) errors in metres of holding, predicting and calming."""
    tracked, calm = MotionFilter(), OneEuro()
    covariance = np.diag([_NOISE_M**2] * 3 + [_NOISE_RAD**2] * 3)
    rows = []
    for k in range(int(seconds * _RATE_HZ)):
        time = k / _RATE_HZ
        seen = Pose(path(time) + rng.normal(0.0, _NOISE_M, 3), rotation_exp(rng.normal(0.0, _NOISE_RAD, 3)))
        tracked.update(time, seen, covariance)
        shown = calm.update(time, seen).position
        if k < _RUN_IN:
            continue
        truths = [path(time + delay) for delay in DELAYS]
        predicted = [tracked.predict(time + delay).pose.position for delay in DELAYS]
        rows.append(
            [
                [np.linalg.norm(found - truth) for found in (seen.position, forecast, shown)]
                for truth, forecast in zip(truths, predicted, strict=True)
            ]
        )
    return np.array(rows)


def prediction(effort: Effort) -> Iterator[Quantity]:
    """Errors of a hand at 0.2 m/s, seen 66 ms ago; and what a hand at rest is shaken by."""
    hands = 1 if effort.quick else 6
    moving, resting = compare_filters(hands, 10.0 if effort.quick else 20.0, effort.seed)
    late = next(row for row in moving if row.delay == 0.066)
    yield Quantity("hand seen 66 ms ago, taken as it is, RMS", 1e3 * late.hold, "mm")
    yield Quantity("hand seen 66 ms ago, predicted, RMS", 1e3 * late.predicted, "mm", 6.5)
    yield Quantity("what prediction leaves of the error", late.predicted / late.hold, "", 0.5)
    worst = max(resting, key=lambda row: row.predicted)
    yield Quantity(
        "hand at rest: noise of a prediction over that of a picture", worst.predicted / worst.hold, "", 1.0
    )
    yield Quantity("hand at rest, calmed: the same", worst.calmed / worst.hold, "")


# ------------------------------------------------------------------------------------------
# Joint zero offsets hidden in simulated servos, and found again: a row of ``robot-ik bench camera``.


_VERIFIED_ROBOT = "tabletop_puma"
# Hidden: up to so many degrees in each joint.
_LARGEST_DEG = 3.0
# Errors that simulated servos and pictures do not have: px of each corner, rad of each joint.
_PIXEL, _JOINT = 0.15, float(np.deg2rad(0.05))
# How often the same pictures are spoilt anew.
_SPOILT = 4


def joint_zero_offsets(effort: Effort) -> Iterator[Quantity]:
    """The whole job on the simulated arm, then the same views with the noise of metal added."""
    worst, largest, ratio, spoilt = [], [], [], []
    robot = load_robot(_VERIFIED_ROBOT, joints=[f"joint{k}" for k in range(1, 7)])
    scene = scene_for(robot, robot.tool)
    for trial in range(1 if effort.quick else 2):
        seed = 1000 * effort.seed + trial
        rng = np.random.default_rng(seed)
        hidden = rng.uniform(-_LARGEST_DEG, _LARGEST_DEG, robot.nv)
        offsets = dict(zip(robot.joints, hidden.tolist(), strict=True))
        # What is known of the board is the drawing of its mount, off by what the mount is made to.
        board = _mounted(scene.cube_offset, _MOUNTED, rng)
        request = VerifyRequest(
            _VERIFIED_ROBOT, views=_VIEWS, fit=True, seed=seed, rehearsal=Rehearsal(offsets),
            frame=scene.cube_frame, pose_other_board=board, board_sigma=_MOUNTED,
        )  # fmt: skip
        report = run_verify(request)
        assert report.fit is not None and report.samples.true_offsets is not None
        worst.append(float(np.abs(report.fit.offsets - report.samples.true_offsets).max()))
        largest.append(summary(report.judged(corrected=True)).largest_m)
        for _ in range(_SPOILT):
            off, sigma = _spoilt(report, rng)
            spoilt.append(off)
            ratio.append(off / sigma)
    yield Quantity("zero offsets, worst joint off by", float(np.degrees(max(worst))), "°", 0.1)
    yield Quantity("board after that, worst pose off by", 1e3 * max(largest), "mm")
    yield Quantity(
        "the same with noise, worst joint off by", float(np.degrees(np.abs(spoilt).max())), "°", 0.1
    )
    yield Quantity("stated uncertainty off by a factor of", factor(rms(np.array(ratio))), "", 2.0)


def _spoilt(report: VerifyReport, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors and standard deviations (nv,) with noise in corners and joints."""
    samples, views = report.samples, []
    for q, view in zip(samples.q, samples.views, strict=True):
        pixels = view.pixels + rng.normal(0, _PIXEL, view.pixels.shape)
        said = q + rng.normal(0, _JOINT, q.shape)
        views.append(CalibrationStation(said, BoardView(view.points, pixels, view.pose_camera_board, _PIXEL)))
    fit = fit_zero_offsets(
        views, report.robot, samples.frame, samples.intrinsics, camera=samples.camera, board=samples.board
    )
    assert samples.true_offsets is not None and fit.found == report.robot.joints
    return fit.offsets - samples.true_offsets, fit.sigma
