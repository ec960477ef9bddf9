"""Accuracy and consistency of locate, hand-eye and ``verify --fit``, and the gain of prediction.

The rows use only what a user knows. The pose of the camera comes from one picture of a sheet on
the table or from the views of the arm. The pose of the board in the hand comes from the drawing of
its mount, which has manufacturing errors, or from these views. The row ``zeros`` runs the complete
command, which moves servos and takes pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from benchmarks.camera.accuracy import DICTIONARY, board_frame, rms
from benchmarks.camera.rows import Effort
from benchmarks.quantity import Quantity
from robot_ik.camera.calibration.extrinsics import locate_camera
from robot_ik.camera.calibration.handeye import HandEye, HandEyeSample, solve_handeye
from robot_ik.camera.calibration.kinematic import (
    HANDEYE_PRIOR,
    ArmModel,
    CalibrationStation,
    KnownPose,
    fit_zero_offsets,
)
from robot_ik.camera.motion_filter import MotionFilter
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import MarkerTarget, Observation, marker_grid
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot
from robot_ik.workcell.arm_camera.error_map import summary
from robot_ik.workcell.arm_camera.verify import VerifyRequest, run_verify
from robot_ik.workcell.robot_setup import Rehearsal
from robot_ik.workcell.scene import scene_for

_ROBOT = "puma560"
# Arms with different offsets in a full run.
_SEEDS = 20
# Views of each arm.
_VIEWS = 20
# Largest hidden offset of a joint, rad.
_HIDDEN = np.deg2rad(2.0)
# Standard deviation of a servo's angle, rad: half a tick of 12 bits.
_SERVO = np.deg2rad(0.044)
# Distance of the camera in front of the board at home, metres.
_DISTANCE = 0.8
# Largest distance of a joint from home in a view, rad.
_BEND = 1.2
# Smallest cosine between the normal of the board and the direction to the camera.
_STEEPEST = 0.4
# Smallest distance of the camera's image plane to a board in a view, metres.
_NEAREST = 0.3
# Smallest distance of a board's corners from the edge of the picture, px.
_EDGE = 6.0
# Pose of the board on the tool by the drawing of its mount.
_DRAWN = Pose((0.0, 0.0, 0.03))
# Board on the tool: 2×2 markers.
_CARRIED = marker_grid(2, 2, 0.05, 0.012, dictionary=DICTIONARY)
# Sheet of A4 on the table.
_SHEET = marker_grid(4, 3, 0.05, 0.0125, dictionary=DICTIONARY)
# Pose of the sheet in the camera's frame: 0.9 m away, tilted by 45 degrees.
_SHEET_SEEN = Pose((0.0, 0.05, 0.9), rotation_exp([0.75 * np.pi, 0.0, 0.0]))
# Standard deviation of the board in its mount from the drawing, each axis, m and rad.
_MOUNTED = (1e-4, float(np.deg2rad(0.03)))
# Prior knowledge, and how many of the six joints are observable with it.
_CASES = {
    "camera and board anywhere": 4,
    "camera located, board anywhere": 5,
    "camera located, board in a mount": 6,
}
# Accepted range of the squared error over the stated variance. A consistent estimate has 1.
_NEES_RANGE = (0.3, 3.0)
# Ages of the last picture for which the pose of a hand is predicted, s.
DELAYS = (0.0, 0.033, 0.066, 0.1, 0.15)
# Pictures per second of the hand.
_RATE_HZ = 30.0
# Standard deviation of a measured position, each axis, metres.
_NOISE_M = 3e-4
# Standard deviation of a measured orientation, each axis, rad.
_NOISE_RAD = 2e-3
# RMS speed of a waving hand, m/s.
_SPEED = 0.196
# Lowest frequency in its motion, Hz.
_SLOWEST = 0.3
# Highest frequency in its motion, Hz.
_QUICKEST = 1.5
# Number of waves along each axis.
_WAVES = 6
# Pictures before the errors count: the filter needs them to converge.
_RUN_IN = 30
_VERIFIED_ROBOT = "tabletop_puma"
# Views of the whole job.
_VERIFIED_VIEWS = 30
# Largest hidden offset of a joint in the whole job, degrees.
_LARGEST_DEG = 3.0


def consistency(effort: Effort) -> Iterator[Quantity]:
    """Yield the consistency of the camera's pose and of the zeros of six joints.

    Each seed has an arm with hidden offsets, a webcam that does not move, and a 2×2 board in the
    hand.
    """
    robot = load_robot(_ROBOT)
    board_at_home = robot.forward(robot.home).compose(_DRAWN)
    position = board_at_home.apply([0.05, -0.1, _DISTANCE])
    eye = Pose.look_at(position, board_at_home.position)
    cameras: dict[str, list[float]] = {"camera by a sheet": [], "camera by the arm's views": []}
    zeros: dict[str, list[tuple[Array, Array]]] = {case: [] for case in _CASES}
    for seed in range(effort.count(_SEEDS)):
        rng = np.random.default_rng([effort.seed, seed])
        hidden = rng.uniform(-_HIDDEN, _HIDDEN, robot.nv)
        board = _mounted(_DRAWN, rng)
        views = [_view(robot, eye, board, hidden, rng) for _ in range(_VIEWS)]
        camera = _located(eye, rng)
        # With the true zeros, the same pictures give the camera's pose without the arm's errors.
        right = _handeye(robot, views, hidden)
        for errors, pose, covariance in zip(
            cameras.values(),
            (camera.pose, right.pose_parent_camera),
            (camera.covariance, right.covariance[:6, :6]),
            strict=True,
        ):
            errors.append(_nees(pose.minus(eye), covariance))
        start = _handeye(robot, views, np.zeros(robot.nv))
        anywhere = KnownPose.within(start.pose_parent_camera, *HANDEYE_PRIOR)
        held = KnownPose.within(start.pose_other_board, *HANDEYE_PRIOR)
        drawing = KnownPose.within(_DRAWN, *_MOUNTED)
        known = ((anywhere, held), (camera, held), (camera, drawing))
        for results, (at, on) in zip(zeros.values(), known, strict=True):
            fit = fit_zero_offsets(ArmModel(robot, robot.tool, STANDARD_CAMERA, views, at, on))
            observable = np.flatnonzero(fit.sigma > 0.0)
            covariance = fit.covariance[np.ix_(observable, observable)]
            results.append(((fit.offsets - hidden)[observable], covariance))
    lower, upper = _NEES_RANGE
    for what, errors in cameras.items():
        yield Quantity(
            f"{what}, squared error over the stated", float(np.mean(errors)), "", upper, lower
        )
    for case, results in zeros.items():
        degrees = np.degrees(np.concatenate([error for error, _ in results]))
        nees = float(np.mean([_nees(error, covariance) for error, covariance in results]))
        yield Quantity(
            f"{case}: joint zeros, squared error over the stated", nees, "", upper, lower
        )
        yield Quantity(f"{case}: joint zeros, RMS", rms(degrees), "°", 0.1)
        yield Quantity(f"{case}: joint zeros, worst", float(np.abs(degrees).max()), "°", 0.1)
        counted = min(len(error) for error, _ in results)
        yield Quantity(f"{case}: joints of 6 observable", counted, least=_CASES[case])


def _mounted(drawn: Pose, rng: np.random.Generator) -> Pose:
    """Return the pose of a board in its mount: the drawing with a manufacturing error."""
    return drawn.plus(rng.normal(0.0, 1.0, 6) * np.repeat(_MOUNTED, 3))


def _handeye(robot: Robot, views: Sequence[CalibrationStation], offsets: Array) -> HandEye:
    """Return the poses of the camera and of the board in the hand, for assumed joint offsets."""
    samples = [HandEyeSample(robot.forward(view.q + offsets), view.view) for view in views]
    return solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")


def _nees(error: Array, covariance: Array) -> float:
    """Return the squared ``error`` (n,) over the ``covariance`` (n, n), divided by n."""
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def _located(eye: Pose, rng: np.random.Generator) -> KnownPose:
    """Return the camera's pose by one picture of the sheet on the table."""
    sheet = _photographed(_SHEET_SEEN, _SHEET, rng)
    if sheet is None:
        raise RuntimeError("the sheet of the bench was not found")
    camera = locate_camera([sheet], eye.compose(_SHEET_SEEN), STANDARD_CAMERA)
    return KnownPose(camera.pose_parent_camera, camera.covariance)


def _photographed(pose: Pose, board: MarkerTarget, rng: np.random.Generator) -> Observation | None:
    """Return the observation of a board at ``pose``, camera frame, in a picture of a webcam."""
    return board.find(board_frame(pose, board, rng), STANDARD_CAMERA)


def _view(
    robot: Robot, eye: Pose, board: Pose, hidden: Array, rng: np.random.Generator
) -> CalibrationStation:
    """Return the servos' angles and the observed board, at a random pose that shows the board."""
    while True:
        q = robot.clip(robot.home + rng.uniform(-_BEND, _BEND, robot.nq))
        true = q + hidden + rng.normal(0.0, _SERVO, robot.nv)
        pose = eye.inverse().compose(robot.forward(true)).compose(board)
        direction = -pose.position / np.linalg.norm(pose.position)
        if pose.position[2] < _NEAREST or pose.rotation[:, 2] @ direction < _STEEPEST:
            continue
        corners = _CARRIED.points(_CARRIED.markers).reshape(-1, 3)
        pixels = STANDARD_CAMERA.project(pose.apply(corners))
        if (pixels > _EDGE).all() and (pixels < np.array(STANDARD_CAMERA.size) - _EDGE - 1).all():
            observation = _photographed(pose, _CARRIED, rng)
            if observation is not None:
                return CalibrationStation(q, observation)


def hand(rng: np.random.Generator) -> Callable[[float], Array]:
    """Return a waving hand: its position (3,), metres, by time. It has waves along each axis."""
    frequency = rng.uniform(_SLOWEST, _QUICKEST, (_WAVES, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3))
    size = rng.uniform(0.5, 1.0, (_WAVES, 3)) / frequency
    speeds = 2.0 * np.pi * frequency * size
    size *= _SPEED / np.sqrt(0.5 * np.sum(speeds**2))
    return lambda t: np.asarray((size * np.sin(2.0 * np.pi * frequency * t + phase)).sum(axis=0))


def compare_filters(hands: int = 4, seconds: float = 20.0, seed: int = 0) -> tuple[Array, Array]:
    """Compare the last observation with the prediction of the motion filter.

    Args:
        hands: Number of motions.
        seconds: Length of each motion.
        seed: Of the motions and of the noise.

    Returns:
        RMS errors of moving hands and of resting hands, metres, each (delays, 2): a row for each
        of ``DELAYS``, with the error of the last observation and of the prediction.
    """
    rng = np.random.default_rng(seed)
    moving = [_errors(hand(rng), seconds, rng) for _ in range(hands)]
    resting = [_errors(lambda _time: np.zeros(3), seconds, rng) for _ in range(hands)]
    means = [np.mean(np.concatenate(errors) ** 2, axis=0) for errors in (moving, resting)]
    return np.sqrt(means[0]), np.sqrt(means[1])


def _errors(path: Callable[[float], Array], seconds: float, rng: np.random.Generator) -> Array:
    """Return the errors (n, delays, 2) of the last observation and of the prediction, metres."""
    tracked = MotionFilter()
    covariance = np.diag([_NOISE_M**2] * 3 + [_NOISE_RAD**2] * 3)
    rows = []
    for k in range(int(seconds * _RATE_HZ)):
        time = k / _RATE_HZ
        measured = Pose(
            path(time) + rng.normal(0.0, _NOISE_M, 3), rotation_exp(rng.normal(0.0, _NOISE_RAD, 3))
        )
        tracked.update(time, measured, covariance)
        if k < _RUN_IN:
            continue
        truths = [path(time + delay) for delay in DELAYS]
        predicted = [tracked.predict(time + delay).pose.position for delay in DELAYS]
        rows.append(
            [
                [np.linalg.norm(position - truth) for position in (measured.position, forecast)]
                for truth, forecast in zip(truths, predicted, strict=True)
            ]
        )
    return np.array(rows)


def prediction(effort: Effort) -> Iterator[Quantity]:
    """Yield the errors of a hand at 0.2 m/s, seen 66 ms ago, and the noise of a hand at rest."""
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


def joint_zero_offsets(effort: Effort) -> Iterator[Quantity]:
    """Yield the errors of the joint zeros that the whole job finds on the simulated arm."""
    worst = []
    largest = []
    robot = load_robot(_VERIFIED_ROBOT, joints=[f"joint{k}" for k in range(1, 7)])
    scene = scene_for(robot, robot.tool)
    for trial in range(1 if effort.quick else 2):
        seed = 1000 * effort.seed + trial
        rng = np.random.default_rng(seed)
        hidden = rng.uniform(-_LARGEST_DEG, _LARGEST_DEG, robot.nv)
        offsets = dict(zip(robot.joints, hidden.tolist(), strict=True))
        # The pose of the board is that of the drawing of its mount, with the manufacturing error.
        board = _mounted(scene.cube_offset, rng)
        request = VerifyRequest(
            _VERIFIED_ROBOT,
            views=_VERIFIED_VIEWS,
            fit=True,
            seed=seed,
            rehearsal=Rehearsal(offsets),
            frame=scene.cube_frame,
            pose_other_board=board,
            board_sigma=_MOUNTED,
        )
        report = run_verify(request)
        if report.fit is None or report.samples.true_offsets is None:
            raise RuntimeError("the rehearsal gave no fit, or no true offsets")
        worst.append(float(np.abs(report.fit.offsets - report.samples.true_offsets).max()))
        largest.append(summary(report.judged(corrected=True)).largest_m)
    yield Quantity("zero offsets, worst joint off by", float(np.degrees(max(worst))), "°", 0.1)
    yield Quantity("board after that, worst pose off by", 1e3 * max(largest), "mm")
