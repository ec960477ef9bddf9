"""An arm before a camera: is what locate, hand-eye and ``verify --fit`` find as near as it says?

Nothing is known that a person could not know: the camera's pose comes from one picture of a sheet on the
table, or from the arm's own views; where the board sits in the hand, from the drawing of its mount, which is
made with errors, or from those views.  The job that moves servos and takes pictures is the row ``zeros``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.camera.accuracy import DICTIONARY, board_frame, rms
from benchmarks.camera.rows import Effort
from robot_ik.camera.calibration.extrinsics import locate_camera
from robot_ik.camera.calibration.handeye import HandEye, HandEyeSample, solve_handeye
from robot_ik.camera.calibration.kinematic import (
    ANYWHERE,
    ArmModel,
    CalibrationStation,
    KnownPose,
    fit_zero_offsets,
)
from robot_ik.camera.motion_filter import MotionFilter
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerTarget, Observation, marker_grid
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.jobs.arm_camera.verify import VerifyRequest, run_verify, summary
from robot_ik.jobs.quantity import Quantity
from robot_ik.jobs.robot_setup import Rehearsal
from robot_ik.jobs.scene import scene_for
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

_ROBOT, _SEEDS, _VIEWS = "puma560", 20, 20
# Hidden offsets up to so much; scatter of a servo (half a tick of twelve bits).
_HIDDEN, _SERVO = np.deg2rad(2.0), np.deg2rad(0.044)
_DISTANCE, _BEND, _STEEPEST = 0.8, 1.2, 0.4
# So far inside the picture, px, is a board that is observed.
_EDGE = 6.0
# On the tool, a board of 2×2, where the drawing of its mount has it; on the table, a sheet of A4, seen at 45
# degrees, 0.9 m away.
_DRAWN = Pose((0.0, 0.0, 0.03))
_CARRIED = marker_grid(2, 2, 0.05, 0.012, dictionary=DICTIONARY)
_SHEET = marker_grid(4, 3, 0.05, 0.0125, dictionary=DICTIONARY)
_SHEET_SEEN = Pose((0.0, 0.05, 0.9), rotation_exp([0.75 * np.pi, 0.0, 0.0]))
# How far the board in its mount is from its drawing, each axis, m and rad.
_MOUNTED = (1e-4, float(np.deg2rad(0.03)))
# What is known beforehand, and how many of six joints are observable then.
_CASES = {
    "camera and board anywhere": 4,
    "camera located, board anywhere": 5,
    "camera located, board in a mount": 6,
}
# Mean squared error over the stated one.
_NEES_RANGE = (0.3, 3.0)


def consistency(effort: Effort) -> Iterator[Quantity]:
    """The camera's pose and the zeros of six joints by the pictures of a webcam that stands.

    Each seed has an arm with hidden offsets, a camera, and a 2×2 board in the hand.
    """
    robot = load_robot(_ROBOT)
    seen = robot.forward(robot.home).compose(_DRAWN)
    eye = Pose.look_at(seen.apply([0.05, -0.1, _DISTANCE]), seen.position)
    cameras: dict[str, list[float]] = {"camera by a sheet": [], "camera by the arm's views": []}
    zeros: dict[str, list[tuple[Array, Array]]] = {case: [] for case in _CASES}
    for seed in range(effort.count(_SEEDS)):
        rng = np.random.default_rng([effort.seed, seed])
        hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
        board = _mounted(_DRAWN, rng)
        views = [_view(robot, eye, board, hidden, rng) for _ in range(_VIEWS)]
        camera = _located(eye, rng)
        # The same pictures by an arm whose zeros are right: the camera's pose by its views alone.
        right = _handeye(robot, views, hidden)
        for errors, found, covariance in zip(
            cameras.values(), (camera.pose, right.pose_parent_camera),
            (camera.covariance, right.covariance[:6, :6]), strict=True,
        ):  # fmt: skip
            errors.append(_nees(found.minus(eye), covariance))
        start = _handeye(robot, views, np.zeros(robot.nv))
        anywhere = KnownPose.within(start.pose_parent_camera, *ANYWHERE)
        held = KnownPose.within(start.pose_other_board, *ANYWHERE)
        drawing = KnownPose.within(_DRAWN, *_MOUNTED)
        known = ((anywhere, held), (camera, held), (camera, drawing))
        for results, (at, on) in zip(zeros.values(), known, strict=True):
            fit = fit_zero_offsets(ArmModel(robot, robot.tool, STANDARD_CAMERA, views, at, on))
            observable = np.flatnonzero(fit.sigma > 0.0)
            covariance = fit.covariance[np.ix_(observable, observable)]
            results.append(((fit.offsets - hidden)[observable], covariance))
    least, most = _NEES_RANGE
    for what, errors in cameras.items():
        yield Quantity(
            f"{what}, squared error over the stated", float(np.mean(errors)), "", most, least
        )
    for case, results in zeros.items():
        off = np.degrees(np.concatenate([error for error, _ in results]))
        nees = float(np.mean([_nees(*one) for one in results]))
        yield Quantity(f"{case}: joint zeros, squared error over the stated", nees, "", most, least)
        yield Quantity(f"{case}: joint zeros, RMS", rms(off), "°", 0.1)
        yield Quantity(f"{case}: joint zeros, worst", float(np.abs(off).max()), "°", 0.1)
        counted = min(len(error) for error, _ in results)
        yield Quantity(f"{case}: joints of 6 observable", counted, least=_CASES[case])


def _mounted(drawn: Pose, rng: np.random.Generator) -> Pose:
    """Where a board really sits: off its drawing by what its mount is made to."""
    return drawn.plus(rng.normal(0.0, 1.0, 6) * np.repeat(_MOUNTED, 3))


def _handeye(robot: Robot, views: Sequence[CalibrationStation], offsets: Array) -> HandEye:
    """The camera's pose, and the board's in the hand, by views of an arm that believes these offsets."""
    samples = [HandEyeSample(robot.forward(one.q + offsets), one.view) for one in views]
    return solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")


def _nees(off: Array, covariance: Array) -> float:
    """Squared error (n,) over the stated one: 1 on average for a consistent one."""
    return float(off @ np.linalg.solve(covariance, off)) / len(off)


def _located(eye: Pose, rng: np.random.Generator) -> KnownPose:
    """The camera's pose by one picture of the sheet on the table, which lies where the world begins."""
    sheet = _photographed(_SHEET_SEEN, _SHEET, rng)
    if sheet is None:
        raise RuntimeError("the sheet of the bench was not found")
    found = locate_camera([sheet], eye.compose(_SHEET_SEEN), STANDARD_CAMERA)
    return KnownPose(found.pose_parent_camera, found.covariance)


def _photographed(pose: Pose, board: MarkerTarget, rng: np.random.Generator) -> Observation | None:
    """A board at ``pose`` (camera frame) as it is seen in a picture of a webcam."""
    return board.find(board_frame(pose, board, rng), STANDARD_CAMERA)


def _view(
    robot: Robot, eye: Pose, board: Pose, hidden: Array, rng: np.random.Generator
) -> CalibrationStation:
    """What the servos say and the camera sees, at a random pose that shows the board."""
    while True:
        q = robot.clip(robot.home + rng.uniform(-_BEND, _BEND, robot.nq))
        true = q + hidden + rng.normal(0.0, _SERVO, robot.nv)
        there = eye.inverse().compose(robot.forward(true)).compose(board)
        direction = -there.position / np.linalg.norm(there.position)
        if there.position[2] < 0.3 or there.rotation[:, 2] @ direction < _STEEPEST:
            continue
        corners = _CARRIED.points(_CARRIED.markers).reshape(-1, 3)
        pixels = STANDARD_CAMERA.project(there.apply(corners))
        if (pixels > _EDGE).all() and (pixels < np.array(STANDARD_CAMERA.size) - _EDGE - 1).all():
            seen = _photographed(there, _CARRIED, rng)
            if seen is not None:
                return CalibrationStation(q, seen)


# ------------------------------------------------------------------------------------------
# What prediction gains: a hand that moves, seen late, by different filters.


DELAYS = (0.0, 0.033, 0.066, 0.1, 0.15)
_RATE_HZ, _NOISE_M, _NOISE_RAD = 30.0, 3e-4, 2e-3
# A hand that waves: root mean square of its speed (m/s), and the frequencies in it (Hz).
_SPEED, _SLOWEST, _QUICKEST, _WAVES = 0.196, 0.3, 1.5, 6
# Pictures before the figures count.
_RUN_IN = 30


def hand(rng: np.random.Generator) -> Callable[[float], Array]:
    """Position (3,) in metres of a waving hand, by time: a few waves along each axis."""
    frequency = rng.uniform(_SLOWEST, _QUICKEST, (_WAVES, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3))
    size = rng.uniform(0.5, 1.0, (_WAVES, 3)) / frequency
    speeds = 2.0 * np.pi * frequency * size
    size *= _SPEED / np.sqrt(0.5 * np.sum(speeds**2))
    return lambda t: np.asarray((size * np.sin(2.0 * np.pi * frequency * t + phase)).sum(axis=0))


def compare_filters(hands: int = 4, seconds: float = 20.0, seed: int = 0) -> tuple[Array, Array]:
    """RMS errors of a moving and of a resting hand, each (delays, 3), metres.

    At each of ``DELAYS``: of the last observation and of the motion filter.  30 pictures a second,
    noise of 0.3 mm along each axis; so many ``hands``, that is motions, of so many ``seconds``.
    """
    rng = np.random.default_rng(seed)
    moving = [_errors(hand(rng), seconds, rng) for _ in range(hands)]
    resting = [_errors(lambda t: np.zeros(3), seconds, rng) for _ in range(hands)]
    means = [np.mean(np.concatenate(errors) ** 2, axis=0) for errors in (moving, resting)]
    return np.sqrt(means[0]), np.sqrt(means[1])


def _errors(path: Callable[[float], Array], seconds: float, rng: np.random.Generator) -> Array:
    """(n, delays, 2) errors in metres of holding and predicting."""
    tracked = MotionFilter()
    covariance = np.diag([_NOISE_M**2] * 3 + [_NOISE_RAD**2] * 3)
    rows = []
    for k in range(int(seconds * _RATE_HZ)):
        time = k / _RATE_HZ
        seen = Pose(
            path(time) + rng.normal(0.0, _NOISE_M, 3), rotation_exp(rng.normal(0.0, _NOISE_RAD, 3))
        )
        tracked.update(time, seen, covariance)
        if k < _RUN_IN:
            continue
        truths = [path(time + delay) for delay in DELAYS]
        predicted = [tracked.predict(time + delay).pose.position for delay in DELAYS]
        rows.append(
            [
                [np.linalg.norm(found - truth) for found in (seen.position, forecast)]
                for truth, forecast in zip(truths, predicted, strict=True)
            ]
        )
    return np.array(rows)


def prediction(effort: Effort) -> Iterator[Quantity]:
    """Errors of a hand at 0.2 m/s, seen 66 ms ago; and what a hand at rest is shaken by."""
    hands = 1 if effort.quick else 6
    moving, resting = compare_filters(hands, 10.0 if effort.quick else 20.0, effort.seed)
    held, predicted = moving[DELAYS.index(0.066)].tolist()
    yield Quantity("hand seen 66 ms ago, taken as it is, RMS", 1e3 * held, "mm")
    yield Quantity("hand seen 66 ms ago, predicted, RMS", 1e3 * predicted, "mm", 6.5)
    yield Quantity("what prediction leaves of the error", predicted / held, "", 0.5)
    held, predicted = max(resting.tolist(), key=lambda row: row[1])
    yield Quantity(
        "hand at rest: noise of a prediction over that of a picture", predicted / held, "", 1.0
    )


# ------------------------------------------------------------------------------------------
# Joint zero offsets hidden in simulated servos, and found again: a row of ``robot-ik bench camera``.


_VERIFIED_ROBOT, _VERIFIED_VIEWS = "tabletop_puma", 30
# Hidden: up to so many degrees in each joint.
_LARGEST_DEG = 3.0


def joint_zero_offsets(effort: Effort) -> Iterator[Quantity]:
    """The whole job on the simulated arm."""
    worst, largest = [], []
    robot = load_robot(_VERIFIED_ROBOT, joints=[f"joint{k}" for k in range(1, 7)])
    scene = scene_for(robot, robot.tool)
    for trial in range(1 if effort.quick else 2):
        seed = 1000 * effort.seed + trial
        rng = np.random.default_rng(seed)
        hidden = rng.uniform(-_LARGEST_DEG, _LARGEST_DEG, robot.nv)
        offsets = dict(zip(robot.joints, hidden.tolist(), strict=True))
        # What is known of the board is the drawing of its mount, off by what the mount is made to.
        board = _mounted(scene.cube_offset, rng)
        request = VerifyRequest(
            _VERIFIED_ROBOT, views=_VERIFIED_VIEWS, fit=True, seed=seed, rehearsal=Rehearsal(offsets),
            frame=scene.cube_frame, pose_other_board=board, board_sigma=_MOUNTED,
        )  # fmt: skip
        report = run_verify(request)
        if report.fit is None or report.samples.true_offsets is None:
            raise RuntimeError("the rehearsal gave no fit, or no true offsets")
        worst.append(float(np.abs(report.fit.offsets - report.samples.true_offsets).max()))
        largest.append(summary(report.judged(corrected=True)).largest_m)
    yield Quantity("zero offsets, worst joint off by", float(np.degrees(max(worst))), "°", 0.1)
    yield Quantity("board after that, worst pose off by", 1e3 * max(largest), "mm")
