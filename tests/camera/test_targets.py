"""Targets in synthetic pictures whose poses are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.camera.accuracy import frame_of
from benchmarks.camera.pictures import pattern_set
from robot_ik.camera import Frame, MarkerTarget, Observation, Tracker, marker, marker_grid
from robot_ik.camera.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.registration import BoardTracker
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, random_pose
from robot_ik.camera.targets import PatternTarget
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.workcell.pictures import MarkerFinder
from tests.camera.rendering import board_picture

BOARD = marker_grid(3, 3, size=0.03, gap=0.0075)
FACING = Pose((0.01, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0))
POSE = FACING.compose(Pose(wxyz=rotation_exp([0.4, 0.0, 0.0])))
# The board is 0.5 m away and the focal length is 800 px.
METRES_PER_PIXEL = 0.5 / 800.0


@pytest.mark.parametrize("target", [marker(7, size=0.05), BOARD], ids=["marker", "board"])
def test_a_pose_agrees_with_the_truth(target: MarkerTarget) -> None:
    observation = target.find(board_picture(target, POSE), STANDARD_CAMERA)
    assert observation is not None
    assert observation.target is target
    assert observation.ids == tuple(target.markers)
    assert observation.points.shape == (4 * len(target.markers), 3)
    position_error, _ = observation.pose.distance(POSE)
    assert position_error < 2e-4
    assert position_error**2 < 16.0 * observation.covariance[:3, :3].trace()


def found(frame: Frame) -> Observation | None:
    """The path of locate, hand-eye, verify and the cube on the gripper."""
    return BOARD.find(frame, STANDARD_CAMERA)


def tracked(frame: Frame) -> Observation | None:
    """The path of goals."""
    observations = Tracker(STANDARD_CAMERA, [BOARD]).observe(frame)
    return observations[0] if observations else None


def registered(frame: Frame) -> Observation | None:
    """The path of AR."""
    observation = BoardTracker(BOARD, STANDARD_CAMERA).observe(frame)
    return None if observation is None else observation.board


def listed(frame: Frame) -> Observation | None:
    """The path of ``camera detect --bodies``."""
    finder = MarkerFinder(BOARD.dictionary, STANDARD_CAMERA, bodies=[BOARD])
    return finder.observe(frame).bodies.get(BOARD.name)


@pytest.mark.parametrize("path", [found, tracked, registered, listed])
@pytest.mark.parametrize("pixels", [0.0, 0.5, 1.0, 4.0])
def test_a_displaced_marker_is_rejected_on_all_paths(
    path: Callable[[Frame], Observation | None], pixels: float
) -> None:
    frame = board_picture(BOARD, POSE, displaced=4, displacement=pixels * METRES_PER_PIXEL)
    observation = path(frame)
    assert observation is not None
    assert observation.rejected == ((4,) if pixels else ())
    assert len(observation.points) == 4 * len(observation.ids) == (32 if pixels else 36)
    assert observation.pose.distance(POSE)[0] < 2e-5


def test_a_target_that_is_not_visible_gives_no_observation() -> None:
    frame = board_picture(marker(7, size=0.05), POSE)
    assert marker(8, size=0.05).find(frame, STANDARD_CAMERA) is None


def test_half_a_board_is_enough() -> None:
    board = marker_grid(3, 3, 0.05, 0.012)
    rng = np.random.default_rng(3)
    errors = []
    for seed in range(8):
        pose = random_pose(STANDARD_CAMERA, rng, 0.8, size=0.174)
        frame = board_picture(board, pose, seed=seed)
        middle = round(float(STANDARD_CAMERA.project(pose.position[None])[0, 0]))
        frame.image[:, :middle] = 128
        observation = board.find(frame, STANDARD_CAMERA)
        assert observation is not None
        assert len(observation.ids) < 6
        errors.append(observation.pose.distance(pose))
    position, angle = np.sqrt(np.mean(np.square(errors), axis=0))
    assert position < 1e-3
    assert angle < np.deg2rad(0.3)


@pytest.mark.parametrize(
    "pattern", [CharucoPattern(8, 6, 0.03, 0.022), ChessboardPattern(9, 6, 0.025)]
)
def test_a_pattern_has_a_fitted_covariance(pattern: Pattern) -> None:
    target = PatternTarget(pattern)
    sigmas = []
    for image, pose in pattern_set(pattern, STANDARD_CAMERA, 4, seed=3):
        observation = target.find(frame_of(image), STANDARD_CAMERA)
        assert observation is not None
        error = pose.minus(observation.pose)
        assert error @ np.linalg.solve(observation.covariance, error) / 6.0 < 4.0
        sigmas.append(observation.covariance[2, 2] / pose.position[2] ** 2)
    # A small board far away is known less.
    assert max(sigmas) > 1.5 * min(sigmas)


def test_an_observation_of_another_frame_of_the_target() -> None:
    """The covariance of the other frame is that of its scatter."""
    observation = BOARD.find(board_picture(BOARD, POSE), STANDARD_CAMERA)
    assert observation is not None
    place = Pose((0.1, -0.2, 0.05), rotation_exp([0.3, 0.0, 1.0]))
    other = observation.seen_from(place)
    assert other.pose.distance(observation.pose.compose(place))[0] < 1e-12
    back = other.seen_from(place.inverse())
    assert back.points == pytest.approx(observation.points, abs=1e-12)
    assert back.covariance == pytest.approx(observation.covariance, rel=1e-9, abs=1e-18)
    # Both see the same points at the same pixels.
    pixels = STANDARD_CAMERA.project(observation.pose.apply(observation.points))
    other_pixels = STANDARD_CAMERA.project(other.pose.apply(other.points))
    assert pixels == pytest.approx(other_pixels)
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(observation.covariance)
    moved = [observation.pose.plus(root @ rng.normal(size=6)) for _ in range(4000)]
    changes = np.array([pose.compose(place).minus(other.pose) for pose in moved])
    scatter = changes.T @ changes / len(changes)
    assert np.diag(scatter) == pytest.approx(np.diag(other.covariance), rel=0.15)


def test_two_copies_of_a_marker_are_not_used(caplog: pytest.LogCaptureFixture) -> None:
    target = marker(7, size=0.05)
    images = []
    for x in (-0.08, 0.08):
        images.append(board_picture(target, Pose((x, 0.0, 0.4), (0, 1, 0, 0))).image)
    image = np.hstack([images[0][:, :320], images[1][:, 320:]])
    assert target.find(Frame(image, 0.0, 0), STANDARD_CAMERA) is None
    assert "visible 2 times" in caplog.text


@pytest.mark.parametrize(
    ("points", "pixels", "more", "message"),
    [
        (np.zeros((4, 2)), np.zeros((4, 2)), {}, "do not belong together"),
        (np.zeros((4, 3)), np.zeros((5, 2)), {}, "do not belong together"),
        (np.zeros((3, 3)), np.zeros((3, 2)), {}, "3 points do not determine a pose"),
        (np.full((4, 3), np.nan), np.zeros((4, 2)), {}, "not finite"),
        (np.zeros((4, 3)), np.zeros((4, 2)), {"sigma": 0.0}, "not finite"),
        (np.zeros((5, 3)), np.zeros((5, 2)), {"bias": 0.01}, "impossible for 5 points"),
    ],
)
def test_an_impossible_observation_is_refused(
    points: np.ndarray, pixels: np.ndarray, more: dict, message: str
) -> None:
    with pytest.raises(CameraError, match=message):
        Observation(points, pixels, Pose(), **more)
