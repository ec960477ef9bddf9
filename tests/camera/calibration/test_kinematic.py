"""Joint zero offsets and errors of an arm, from pictures of a carried board."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robot_ik.camera.calibration.handeye import HandEyeSample, solve_handeye
from robot_ik.camera.calibration.kinematic import (
    ArmModel,
    CalibrationStation,
    KnownPose,
    doubted_zeros,
    fit_zero_offsets,
    measure_errors,
)
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import Observation
from robot_ik.commands.camera_verify import unobservable_text
from robot_ik.errors import CalibrationError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.robot import Robot, load_robot

Array = NDArray[np.float64]

FRAME = "flange"
CAMERA = Pose((0.75, -0.5, 0.45), (0.50099, -0.74367, -0.36714, 0.24733))
BOARD = Pose((0.01, -0.02, 0.05), (0.9, 0.2, -0.3, 0.1))
# Corners that are visible from all sides.
POINTS = 0.03 * np.array(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
)
EXACT = 1e-6, 1e-6


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("tabletop_puma")


def views_of(
    robot: Robot, offsets: Array, count: int, seed: int, *, pixel: float = 0.0, joint: float = 0.0
) -> list[CalibrationStation]:
    """Return random views.

    Args:
        robot: The robot.
        offsets: (nv,) zero offsets of the joints, rad.
        count: Number of views.
        seed: Of the random views.
        pixel: Standard deviation of the corners, px.
        joint: Standard deviation of the joint angles, rad.
    """
    rng = np.random.default_rng(seed)
    views = []
    while len(views) < count:
        q = robot.clip(robot.home + rng.uniform(0.1, 0.6) * (robot.sample(rng) - robot.home))
        seen = CAMERA.inverse().compose(robot.forward(q + offsets, FRAME)).compose(BOARD)
        pixels = STANDARD_CAMERA.project(seen.apply(POINTS)) + rng.normal(0, 1, (8, 2)) * pixel
        if seen.position[2] > 0.2 and (np.abs(pixels - 300) < 400).all():
            view = Observation(POINTS, pixels, seen, max(pixel, 0.01))
            views.append(CalibrationStation(q + rng.normal(0, 1, robot.nv) * joint, view))
    return views


def model_of(views: list[CalibrationStation], robot: Robot, **changes: Any) -> ArmModel:
    known = {"camera": KnownPose.within(CAMERA, *EXACT), "board": KnownPose.within(BOARD, *EXACT)}
    arguments = {"robot": robot, "frame": FRAME, "intrinsics": STANDARD_CAMERA, "views": views}
    return ArmModel(**(arguments | known | changes))


def fit(views: list[CalibrationStation], robot: Robot, *, hold: Any = (), **changes: Any) -> Any:
    return fit_zero_offsets(model_of(views, robot, **changes), hold)


@settings(max_examples=4)
@given(degrees=st.lists(st.floats(-3, 3), min_size=6, max_size=6), seed=st.integers(0, 99))
def test_exact_corners_give_exact_offsets(robot: Robot, degrees: list[float], seed: int) -> None:
    offsets = np.deg2rad(degrees)
    found = fit(views_of(robot, offsets, 8, seed), robot)
    assert found.unobservable == () and found.determined == robot.joints and found.outliers == ()
    np.testing.assert_allclose(found.offsets, offsets, atol=2e-6)
    assert found.residual_px < 1e-2
    assert max(error.distance for error in found.errors) < 2e-5


def test_a_camera_on_the_arm_determines_the_same_offsets(robot: Robot) -> None:
    """The equations are the same, with world and hand exchanged."""
    rng = np.random.default_rng(5)
    views = []
    offsets = np.deg2rad([1.0, -2.0, 1.5, 2.0, -1.0, 2.5])
    camera = Pose((0.02, 0.0, -0.05))
    board = Pose((0.3, 0.0, -0.3), (0.0, 1.0, 0.0, 0.0))
    while len(views) < 10:
        q = robot.clip(robot.home + 0.4 * (robot.sample(rng) - robot.home))
        pose_world_camera = robot.forward(q + offsets, FRAME).compose(camera)
        pose_camera_board = pose_world_camera.inverse().compose(board)
        x, y, depth = pose_camera_board.position
        if depth > 0.1 and max(abs(x), abs(y)) < depth:
            pixels = STANDARD_CAMERA.project(pose_camera_board.apply(POINTS))
            observation = Observation(POINTS, pixels, pose_camera_board, 0.01)
            views.append(CalibrationStation(q, observation))
    known = {"camera": KnownPose.within(camera, *EXACT), "board": KnownPose.within(board, *EXACT)}
    found = fit(views, robot, mounting="eye_in_hand", **known)
    np.testing.assert_allclose(found.offsets, offsets, atol=1e-5)
    assert max(error.distance for error in found.errors) < 2e-5
    errors = measure_errors(model_of(views, robot, mounting="eye_in_hand", **known))
    for error, view in zip(errors, views, strict=True):
        reported = robot.forward(view.q, FRAME).compose(camera)
        true = robot.forward(view.q + offsets, FRAME).compose(camera)
        np.testing.assert_allclose(error.vector, true.position - reported.position, atol=1e-9)
        assert 0.0 < error.sigma < 2e-4


def test_stated_uncertainty_agrees_with_the_errors(robot: Robot) -> None:
    """Each seed draws all uncertain values: pixels, joints, pose of camera and board."""
    camera = KnownPose.within(CAMERA, 5e-4, 5e-4)
    board = KnownPose.within(BOARD, 2e-4, 1e-3)
    errors = []
    stated = []
    noise = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        offsets = np.deg2rad(rng.uniform(-3, 3, 6))
        views = views_of(robot, offsets, 12, seed, pixel=0.2, joint=5e-4)
        drawn_poses = [
            KnownPose(
                known.pose.plus(rng.normal(0, np.sqrt(np.diag(known.covariance)))), known.covariance
            )
            for known in (camera, board)
        ]
        found = fit(views, robot, camera=drawn_poses[0], board=drawn_poses[1])
        assert found.determined == robot.joints
        errors.append(found.offsets - offsets)
        stated.append(found.sigma)
        noise.append(found.joint_noise)
    each = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(stated), axis=0))
    assert ((each > 0.4) & (each < 2.0)).all(), each
    overall = float(np.sqrt(np.mean(np.square(np.array(errors) / np.array(stated)))))
    assert 0.5 < overall < 2.0
    assert 2e-4 < np.median(noise) < 1e-3


def test_indistinguishable_offsets_are_named_and_held(robot: Robot) -> None:
    offsets = np.deg2rad([2.0, -1.5, 1.0, -2.0, 2.5, -3.0])
    views = views_of(robot, offsets, 12, 3)
    loose = {
        "camera": KnownPose.within(CAMERA, 0.1, 0.2),
        "board": KnownPose.within(BOARD, 0.1, 0.2),
    }
    found = fit(views, robot, **loose)
    assert {joint.joint for joint in found.unobservable} == {"joint1", "joint6"}
    assert found.determined == ("joint2", "joint3", "joint4", "joint5")
    texts = {joint.joint: unobservable_text(joint, "link6") for joint in found.unobservable}
    assert (
        "the offset of joint1 and the rotation of the camera about z of the world"
        in texts["joint1"]
    )
    assert "the offset of joint6 and the rotation of the board about" in texts["joint6"]
    np.testing.assert_allclose(found.offsets[1:5], offsets[1:5], atol=np.deg2rad(0.02))
    assert found.offsets[0] == found.offsets[5] == found.sigma[0] == found.sigma[5] == 0.0
    # The poses of camera and board absorb both offsets, so the residual is small.
    assert found.residual_px < 0.05
    # With known poses of camera and board the same pictures determine all six offsets.
    assert fit(views, robot).unobservable == ()
    # One known pose determines one of the two offsets.
    (left,) = fit(
        views, robot, camera=KnownPose.within(CAMERA, *EXACT), board=loose["board"]
    ).unobservable
    assert left.joint == "joint6" and np.degrees(left.sigma) > 1.0


def test_a_joint_that_does_not_move_the_board_is_named(robot: Robot) -> None:
    def seen_from_link5(one: CalibrationStation) -> CalibrationStation:
        seen = CAMERA.inverse().compose(robot.forward(one.q, "link5")).compose(BOARD)
        return CalibrationStation(
            one.q, Observation(POINTS, STANDARD_CAMERA.project(seen.apply(POINTS)), seen, 0.01)
        )

    views = [seen_from_link5(view) for view in views_of(robot, np.zeros(6), 8, 1)]
    found = fit(views, robot, frame="link5")
    (one,) = found.unobservable
    assert (
        one.joint == "joint6"
        and unobservable_text(one, "link5") == "the offset of joint6 does not show in these views"
    )
    assert np.isinf(one.sigma)
    held = fit(views, robot, frame="link5", hold=["joint6", "joint2"])
    assert held.unobservable == () and held.offsets[1] == held.sigma[1] == 0.0


def test_a_pose_that_contradicts_the_others_is_an_outlier(robot: Robot) -> None:
    offsets = np.deg2rad([1.0, 2.0, -1.0, 2.0, -2.0, 1.0])
    views = views_of(robot, offsets, 12, 4, pixel=0.1, joint=2e-4)
    wrong = views[7].q + np.deg2rad([0, 0, 4.0, 0, 0, 0])
    views[7] = CalibrationStation(wrong, views[7].view)
    found = fit(views, robot)
    assert found.outliers == (7,)
    np.testing.assert_allclose(found.offsets, offsets, atol=np.deg2rad(0.1))


def test_errors_are_true_positions_minus_reported_positions(robot: Robot) -> None:
    offsets = np.deg2rad([0.0, 2.0, 0.0, 0.0, 1.0, 0.0])
    views = views_of(robot, offsets, 5, 2)
    known = KnownPose.within(CAMERA, 1e-3, 1e-6), KnownPose.within(BOARD, 1e-6, 1e-6)
    errors = measure_errors(model_of(views, robot, camera=known[0], board=known[1]))
    for one, view in zip(errors, views, strict=True):
        said, really = (robot.forward(q, FRAME).compose(BOARD) for q in (view.q, view.q + offsets))
        np.testing.assert_allclose(one.vector, really.position - said.position, atol=1e-9)
        np.testing.assert_allclose(one.position, said.position, atol=1e-12)
        assert one.angle == pytest.approx(really.distance(said)[1], abs=1e-7)
        # The camera's millimetre in three axes dominates; the corners add little.
        assert 1.7e-3 < one.sigma < 1.9e-3
    # A small rotation of the camera moves the board in proportion to its distance.
    turned = KnownPose.within(CAMERA, 1e-6, 1e-3), known[1]
    errors = measure_errors(model_of(views, robot, camera=turned[0], board=turned[1]))
    for one, view in zip(errors, views, strict=True):
        far = float(np.linalg.norm(view.view.pose.position))
        assert one.sigma == pytest.approx(np.sqrt(2.0) * 1e-3 * far, rel=0.03)


def test_each_pose_is_judged_by_the_fit_to_all_others(robot: Robot) -> None:
    offsets = np.deg2rad([1.0, 2.0, -1.0, 2.0, -2.0, 1.0])
    views = views_of(robot, offsets, 12, 6, pixel=0.2, joint=1e-3)
    camera = KnownPose.within(CAMERA, 1e-3, 1e-3)
    board = KnownPose.within(BOARD, 1e-3, 1e-3)
    whole = fit(views, robot, camera=camera, board=board)
    apart = []
    for k in (0, 3, 6, 9):
        view = views[k]
        others = fit([*views[:k], *views[k + 1 :]], robot, camera=camera, board=board)
        corrected = CalibrationStation(view.q + others.offsets, view.view)
        poses = (others.pose_parent_camera, others.pose_other_board)
        known = dict(
            zip(("camera", "board"), (KnownPose.within(p, *EXACT) for p in poses), strict=True)
        )
        (one,) = measure_errors(model_of([corrected], robot, **known))
        apart.append((np.linalg.norm(one.vector - whole.errors[k].vector), one.distance))
    miss, size = np.sqrt(np.mean(np.square(apart), axis=0))
    assert miss < 0.2 * size


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("off", [None, "joint2", "joint3"])
def test_hand_eye_views_show_a_zero_offset_of_half_a_degree(
    robot: Robot, off: str | None, seed: int
) -> None:
    """12 views with servo ticks and 0.1 px. The poses of camera and board are unknown."""
    offsets = np.deg2rad([0.5 if name == off else 0.0 for name in robot.joints])
    views = views_of(robot, offsets, 12, seed, pixel=0.1, joint=np.deg2rad(0.03))
    samples = [HandEyeSample(robot.forward(view.q, FRAME), view.view) for view in views]
    found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    doubted = doubted_zeros(views, robot, FRAME, STANDARD_CAMERA, found)
    assert list(doubted) == ([] if off is None else [off])
    for degrees, sigma in (np.degrees(sigmas) for sigmas in doubted.values()):
        assert degrees == pytest.approx(0.5, abs=0.15) and sigma < 0.07


def test_invalid_input_is_reported(robot: Robot) -> None:
    views = views_of(robot, np.zeros(6), 4, 0)
    with pytest.raises(CalibrationError, match="3 views are too few"):
        fit(views[:3], robot)
    with pytest.raises(CalibrationError, match="unknown mounting 'aside'"):
        fit(views, robot, mounting="aside")
    with pytest.raises(UnknownJointError, match="joint7"):
        fit(views, robot, hold=["joint7"])
    with pytest.raises(CalibrationError, match="positive definite"):
        KnownPose(CAMERA, np.zeros((6, 6)))
    with pytest.raises(CalibrationError, match="hinges and slides"):
        fit(views, load_robot("humanoid"))
