"""Hand-eye calibration: laws of AX = XB, accuracy, consistent uncertainty, errors and outliers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.camera.pictures import handeye_set
from robot_ik.camera.calibration.handeye import (
    MOUNTINGS,
    HandEyeSample,
    Mounting,
    solve_handeye,
    start_handeye,
    view_derivatives,
)
from robot_ik.camera.calibration.pose_means import mean_rotation, robust_mean_pose, rotation_spread
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, STANDARD_SIZE
from robot_ik.camera.targets import Observation, marker_points
from robot_ik.errors import CalibrationError, CameraError
from robot_ik.geometry import Pose, rotation_exp

Array = NDArray[np.float64]

MARKER = marker_points(STANDARD_SIZE)


@settings(max_examples=4)
@given(seed=st.integers(0, 10**6), mounting=st.sampled_from(MOUNTINGS))
def test_exact_views_give_the_exact_mount(seed: int, mounting: Mounting) -> None:
    truth, samples = handeye_set(
        6, mounting=mounting, seed=seed, corner_sigma=0.0, arm_sigma=(0.0, 0.0)
    )
    start = start_handeye(samples, mounting)
    assert max(start.pose_parent_camera.distance(truth.pose_parent_camera)) < 1e-7
    found = solve_handeye(samples, STANDARD_CAMERA, mounting=mounting)
    for pose, true in (
        (found.pose_parent_camera, truth.pose_parent_camera),
        (found.pose_other_board, truth.pose_other_board),
    ):
        assert max(pose.distance(true)) < 1e-7
    assert found.residual_px < 1e-4 and not found.outliers


@settings(max_examples=4)
@given(seed=st.integers(0, 10**6))
def test_another_world_frame_transforms_only_the_answer(seed: int) -> None:
    _, samples = handeye_set(8, mounting="eye_to_hand", seed=seed)
    world = Pose().plus(np.random.default_rng(seed).normal(0, 1, 6))
    elsewhere = [
        HandEyeSample(world.compose(sample.pose_world_hand), sample.view) for sample in samples
    ]
    first = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    second = solve_handeye(elsewhere, STANDARD_CAMERA, mounting="eye_to_hand")
    wanted = world.compose(first.pose_parent_camera)
    assert max(second.pose_parent_camera.distance(wanted)) < 1e-5
    assert max(second.pose_other_board.distance(first.pose_other_board)) < 1e-5
    assert second.sigma_position == pytest.approx(first.sigma_position, rel=0.02)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_derivatives_are_those_of_finite_differences(mounting: Mounting) -> None:
    mount, (sample, *_) = handeye_set(mounting=mounting, seed=3)
    residual, shared, hand = view_derivatives(mount, sample, STANDARD_CAMERA)
    np.testing.assert_allclose(
        residual, mount.residual(sample, STANDARD_CAMERA).ravel(), atol=1e-10
    )
    step = 1e-6
    for k in range(12):
        move = np.eye(12)[k] * step
        difference = (
            mount.plus(move).residual(sample, STANDARD_CAMERA)
            - mount.plus(-move).residual(sample, STANDARD_CAMERA)
        ).ravel()
        np.testing.assert_allclose(shared[:, k], difference / (2 * step), rtol=1e-4, atol=1e-2)
    for k in range(6):
        there, back = (
            HandEyeSample(
                sample.pose_world_hand.compose(Pose().plus(sign * step * np.eye(6)[k])), sample.view
            )
            for sign in (1, -1)
        )
        difference = (
            mount.residual(there, STANDARD_CAMERA) - mount.residual(back, STANDARD_CAMERA)
        ).ravel()
        np.testing.assert_allclose(hand[:, k], difference / (2 * step), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_fifteen_views_meet_the_target_with_a_consistent_uncertainty(
    mounting: Mounting,
) -> None:
    errors = []
    stated = []
    arm = []
    for seed in range(6):
        truth, samples = handeye_set(mounting=mounting, seed=seed)
        found = solve_handeye(samples, STANDARD_CAMERA, mounting=mounting)
        errors.append(found.pose_parent_camera.distance(truth.pose_parent_camera))
        stated.append((found.sigma_position, found.sigma_angle))
        arm.append((found.arm_position, found.arm_angle))
        assert not found.outliers
    errors_rms, stated_rms = (np.sqrt(np.mean(np.square(v), axis=0)) for v in (errors, stated))
    assert errors_rms[0] < 1.5e-3 and errors_rms[1] < np.deg2rad(0.25)
    assert (errors_rms < 2 * stated_rms).all() and (stated_rms < 2 * errors_rms).all()
    # the arm's error is told apart from the pixels' (three times is as well as 15 views can tell
    # it)
    assert 1e-4 < np.median(arm, axis=0)[0] < 9e-4


def test_a_bias_that_all_views_share_is_in_the_uncertainty() -> None:
    truth, samples = handeye_set(seed=4, corner_sigma=0.003, arm_sigma=(1e-7, 1e-7))

    def found(bias: float, outwards: float) -> tuple[float, float]:
        shifted = []
        for sample in samples:
            view = sample.view
            away = view.pixels - view.pixels.mean(axis=0)
            pixels = view.pixels + outwards * away / np.linalg.norm(away, axis=1, keepdims=True)
            observation = Observation(view.points, pixels, view.pose, view.sigma, bias)
            shifted.append(HandEyeSample(sample.pose_world_hand, observation))
        result = solve_handeye(shifted, STANDARD_CAMERA, mounting="eye_in_hand")
        return (
            result.pose_parent_camera.distance(truth.pose_parent_camera)[0],
            result.sigma_position,
        )

    error_with_offset, error = found(0.0, 0.05)
    # The views agree with each other, so the stated error does not show it.
    assert error_with_offset > 3 * error
    again, stated = found(0.05, 0.05)
    assert again == error_with_offset < 2 * stated and stated < 2 * error_with_offset
    assert found(0.01, 0.0)[1] < 0.5 * stated


def test_small_rotations_give_a_larger_sigma() -> None:
    sigmas = []
    for spread in (8.0, 25.0):
        _, samples = handeye_set(seed=1, spread_deg=spread)
        sigmas.append(
            solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand").sigma_position
        )
    assert sigmas[0] > 2 * sigmas[1]


def test_with_an_exact_arm_it_equals_scipys_least_squares_of_all_corners() -> None:
    truth, samples = handeye_set(12, mounting="eye_to_hand", seed=5, arm_sigma=(0.0, 0.0))
    found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")

    def residuals(step: Array) -> Array:
        mount = truth.plus(step)
        return np.concatenate(
            [mount.residual(sample, STANDARD_CAMERA).ravel() for sample in samples]
        )

    judge = truth.plus(least_squares(residuals, np.zeros(12), x_scale=1e-3).x)
    position, angle = found.pose_parent_camera.distance(judge.pose_parent_camera)
    assert position < 0.5 * found.sigma_position and angle < 0.5 * found.sigma_angle


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_wrong_views_are_named_and_hardly_count(mounting: Mounting) -> None:
    truth, samples = handeye_set(mounting=mounting, seed=2)
    bumped = Pose().plus([0.008, -0.006, 0.01, 0.03, -0.04, 0.02])
    samples[4] = HandEyeSample(samples[4].pose_world_hand.compose(bumped), samples[4].view)
    view = samples[11].view
    moved = view.pixels + np.array([[9, 0], [0, 7], [-6, 0], [0, -8]])
    shifted = Observation(view.points, moved, view.pose)
    samples[11] = HandEyeSample(samples[11].pose_world_hand, shifted)
    found = solve_handeye(samples, STANDARD_CAMERA, mounting=mounting)
    assert found.outliers == (4, 11)
    position, angle = found.pose_parent_camera.distance(truth.pose_parent_camera)
    assert position < 1.5e-3 and angle < np.deg2rad(0.25)
    assert found.residuals[4].left_out_position > 3e-3


def test_a_flipped_first_estimate_does_not_change_the_result() -> None:
    truth, samples = handeye_set(mounting="eye_to_hand", seed=7)
    view = samples[6].view
    mirrored = view.pose.compose(Pose(wxyz=rotation_exp([0.9, 0.3, 0.0])))
    samples[6] = HandEyeSample(
        samples[6].pose_world_hand, Observation(view.points, view.pixels, mirrored, view.sigma)
    )
    found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_to_hand")
    assert not found.outliers
    assert found.pose_parent_camera.distance(truth.pose_parent_camera)[0] < 1.5e-3


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"axes": (1.0, 0.02, 0.02)}, "about one axis only"),
        ({"spread_deg": 1.0}, "hardly turned"),
        ({"count": 3}, "3 views are too few"),
    ],
)
def test_uninformative_motions_are_rejected(changes: dict[str, object], text: str) -> None:
    _, samples = handeye_set(**changes)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match=text) as refused:
        solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand")
    assert "30 degrees" in refused.value.hint


def test_an_invalid_view_is_rejected() -> None:
    for points, pixels in (
        (MARKER, np.zeros((3, 2))),
        (MARKER[:3], np.zeros((3, 2))),
        (MARKER, np.full((4, 2), np.nan)),
    ):
        with pytest.raises(CameraError):
            Observation(points, pixels, Pose())
    with pytest.raises(CameraError, match="four corners"):
        Observation(np.eye(5, 3), np.zeros((5, 2)), Pose(), bias=0.01)
    with pytest.raises(CalibrationError, match="eye_in_hand or eye_to_hand"):
        solve_handeye(handeye_set()[1], STANDARD_CAMERA, mounting="beside")  # type: ignore[arg-type]


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_pictures_with_wrong_joint_angles_give_no_mount(mounting: Mounting) -> None:
    _, samples = handeye_set(12, mounting=mounting, seed=3)
    views = [sample.view for sample in samples]
    shuffled = [
        HandEyeSample(one.pose_world_hand, view)
        for one, view in zip(samples, views[5:] + views[:5], strict=True)
    ]
    with pytest.raises(CalibrationError, match="no result explains the views"):
        solve_handeye(shuffled, STANDARD_CAMERA, mounting=mounting)


def quaternions(rotations: Sequence[Rotation]) -> Array:
    """(n, 4), wxyz."""
    return np.array([r.as_quat()[[3, 0, 1, 2]] for r in rotations])


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_the_mean_rotation_is_scipys_whatever_the_signs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(0, 0.7, (6, 3)))
    signs = rng.choice([-1.0, 1.0], (6, 1))
    mean = Rotation.from_quat(mean_rotation(signs * quaternions(turns))[[1, 2, 3, 0]])
    assert (mean.inv() * turns.mean()).magnitude() < 1e-7


def test_the_robust_mean_ignores_an_outlier_pose() -> None:
    rng = np.random.default_rng(0)
    poses = [Pose().plus(rng.normal(0, 1e-3, 6)) for _ in range(9)]
    mean = robust_mean_pose([*poses, Pose((0.3, 0, 0), (0, 1, 0, 0))])
    assert max(mean.distance(Pose())) < 1.5e-3


def test_spread_by_axis() -> None:
    turns = Rotation.from_rotvec(np.outer([-0.4, -0.2, 0.0, 0.2, 0.4], [0.6, 0.8, 0.0]))
    np.testing.assert_allclose(
        rotation_spread(list(quaternions(turns))), [np.sqrt(0.08), 0, 0], atol=1e-9
    )
