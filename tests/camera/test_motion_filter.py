"""Laws of the motion filter, and what it gains on a moving hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.camera.arm import DELAYS, compare_filters
from robot_ik.camera.motion_filter import FilterOptions, MotionFilter, Update
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, rotation_exp

SIGMA_M = 3e-4
SIGMA_RAD = 2e-3
NOISE = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
PERIOD = 1 / 30

vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def noisy(pose: Pose, rng: np.random.Generator) -> Pose:
    return pose.plus(rng.normal(0.0, [SIGMA_M] * 3 + [SIGMA_RAD] * 3))


@settings(max_examples=8)
@given(seeds, vectors, vectors)
def test_a_still_target_gives_the_mean_and_is_not_predicted(
    seed: int, place: np.ndarray, turn: np.ndarray
) -> None:
    """With no process noise and no speed the filter is recursive least squares: the mean of all."""
    rng = np.random.default_rng(seed)
    truth = Pose(place, rotation_exp(turn))
    seen = []
    still = MotionFilter(
        FilterOptions(
            process_noise=(1e-9, 1e-9), initial_speed_sigma=(1e-9, 1e-9), min_sigma=(0.0, 0.0)
        )
    )
    usual = MotionFilter()
    for k in range(40):
        seen.append(noisy(truth, rng))
        still.update(k * PERIOD, seen[-1], NOISE)
        usual.update(k * PERIOD, seen[-1], NOISE)
    mean = np.mean([pose.minus(truth) for pose in seen], axis=0)
    found, covariance, _ = still.predict(39 * PERIOD)
    np.testing.assert_allclose(found.minus(truth), mean, atol=2e-6)
    np.testing.assert_allclose(covariance, NOISE / 40, rtol=1e-3, atol=1e-12)
    # With default options the prediction of an object at rest is its position, at any horizon.
    now = usual.predict(39 * PERIOD)
    later = usual.predict(39 * PERIOD + 0.1)
    np.testing.assert_array_equal(now.pose.position, later.pose.position)
    assert not later.velocity.any() and np.abs(later.pose.minus(truth)[:3]).max() < 5 * SIGMA_M


@settings(max_examples=8)
@given(vectors, vectors, st.floats(0.2, 1.0), st.floats(1.0, 3.0), st.floats(0.0, 0.15))
def test_constant_velocity_is_tracked_and_predicted_without_lag(
    way: np.ndarray, axis: np.ndarray, speed: float, turning: float, ahead: float
) -> None:
    velocity = speed * (way + 2.0) / np.linalg.norm(way + 2.0)
    rate = turning * (axis - 2.0) / np.linalg.norm(axis - 2.0)
    tracked = MotionFilter()
    for k in range(60):
        t = k * PERIOD
        tracked.update(t, Pose(velocity * t, rotation_exp(rate * t)), NOISE)
    t = 59 * PERIOD + ahead
    found = tracked.predict(t)
    error = found.pose.minus(Pose(velocity * t, rotation_exp(rate * t)))
    assert np.linalg.norm(error[:3]) < 1e-5 and np.linalg.norm(error[3:]) < 1e-3
    np.testing.assert_allclose(found.velocity, [*velocity, *rate], atol=5e-3)


@settings(max_examples=10)
@given(seeds, st.lists(st.floats(1e-4, 2.0), min_size=1, max_size=25))
def test_the_covariance_stays_symmetric_and_positive_at_any_gaps(
    seed: int, gaps: list[float]
) -> None:
    rng = np.random.default_rng(seed)
    kept = MotionFilter()
    time = 0.0
    truth = Pose()
    for gap in gaps:
        time += gap
        truth = truth.plus(rng.normal(0.0, 0.02, 6))
        root = rng.normal(0.0, 1e-3, (6, 6))
        kept.update(time, noisy(truth, rng), root @ root.T)
        for later in (0.0, gap):
            covariance = kept.predict(time + later).covariance
            np.testing.assert_array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert np.isfinite(kept.predict(time + 9.0).pose.minus(truth)).all()


def test_the_covariance_is_consistent() -> None:
    """Normalised errors of a walk that is what the filter assumes: six degrees of freedom."""
    rng = np.random.default_rng(3)
    options = FilterOptions(process_noise=(0.5, 2.0), min_sigma=(0.0, 0.0))
    squares = []
    for _ in range(6):
        tracked = MotionFilter(options)
        truth = Pose()
        rate = np.zeros(6)
        for k in range(60):
            tracked.update(k * PERIOD, noisy(truth, rng), NOISE)
            found = tracked.predict(k * PERIOD)
            error = found.pose.minus(truth)
            squares.append(error @ np.linalg.solve(found.covariance, error))
            change = rng.normal(0.0, np.repeat(options.process_noise, 3)) * np.sqrt(PERIOD)
            truth = truth.plus(PERIOD * (rate + 0.5 * change))
            rate = rate + change
    assert 5.0 < np.mean(squares) < 7.0


def test_time_going_backwards_is_ignored() -> None:
    tracked = MotionFilter()
    assert tracked.update(1.0, Pose(), NOISE) is Update.STARTED
    assert tracked.update(1.1, Pose((0.01, 0, 0)), NOISE) is Update.TAKEN
    before = tracked.predict(1.1)
    for time in (1.1, 1.05, -3.0):
        assert tracked.update(time, Pose((5.0, 0, 0)), NOISE) is Update.LATE
    np.testing.assert_array_equal(tracked.predict(1.1).covariance, before.covariance)
    assert tracked.predict(1.1).pose.position.tolist() == before.pose.position.tolist()
    assert tracked.predict(0.2).pose.position.tolist() == before.pose.position.tolist()


def test_an_outlier_is_left_out_and_a_marker_put_elsewhere_is_found_again() -> None:
    tracked = MotionFilter()
    for k in range(10):
        tracked.update(k * PERIOD, Pose((0.0, 0.0, 0.5)), NOISE)
    away = Pose((0.2, 0.0, 0.5), rotation_exp([0.0, 2.0, 0.0]))
    assert tracked.update(10 * PERIOD, away, NOISE) is Update.OUTLIER
    assert tracked.predict(10 * PERIOD).pose.position[0] == 0.0
    assert (
        tracked.update(11 * PERIOD, Pose((0.0, 0.0, 0.5)), NOISE) is Update.TAKEN
    )  # the count restarts
    updates = [tracked.update((12 + k) * PERIOD, away, NOISE) for k in range(4)]
    assert updates == [Update.OUTLIER, Update.OUTLIER, Update.RESTARTED, Update.TAKEN]
    assert np.abs(tracked.predict(15 * PERIOD).pose.minus(away)).max() < 1e-9


def test_fast_motions_are_not_predicted() -> None:
    """Back and forth from picture to picture: prediction would increase the error."""
    tracked = MotionFilter()
    worst = 0.0
    for k in range(40):
        x = 0.006 * (k % 2)
        tracked.update(k * PERIOD, Pose((x, 0.0, 0.5)), NOISE)
        if k > 5:
            worst = max(worst, abs(tracked.predict((k + 1) * PERIOD).pose.position[0] - x))
    assert worst < 0.007


@pytest.mark.parametrize("speed", [0.0, 0.06])
def test_noise_of_the_depth_hides_no_motion_across_the_view(speed: float) -> None:
    """A small marker: known to 0.02 mm across, to 0.7 mm along the view, 15 pictures a second."""
    sigma = [2e-5, 2e-5, 7e-4]
    rng = np.random.default_rng(1)
    tracked = MotionFilter()
    worst = []
    for k in range(60):
        x = speed * k / 15
        covariance = np.diag(np.square([*sigma, 2e-3, 2e-3, 2e-3]))
        tracked.update(k / 15, Pose(rng.normal([x, 0.0, 0.6], sigma)), covariance)
        ahead = tracked.predict(k / 15 + 0.1).pose.position
        worst.append(abs(ahead[0] - x - 0.1 * speed))
        if speed == 0.0:
            np.testing.assert_array_equal(ahead, tracked.predict(k / 15).pose.position)
    # Without prediction the error is 6 mm.
    assert np.mean(worst[10:]) < 1.2e-3


def test_a_long_gap_restarts_the_filter_and_a_short_gap_does_not() -> None:
    for gap, what in ((0.4, Update.TAKEN), (1.5, Update.RESTARTED)):
        tracked = MotionFilter()
        for k in range(20):
            tracked.update(k * PERIOD, Pose((0.3 * k * PERIOD, 0.0, 0.0)), NOISE)
        time = 19 * PERIOD + gap
        assert tracked.update(time, Pose((0.3 * time, 0.0, 0.0)), NOISE) is what
        assert tracked.predict(time).pose.position[0] == pytest.approx(0.3 * time, abs=1e-6)


@pytest.mark.parametrize("broken", [np.eye(3), np.full((6, 6), np.nan), -np.eye(6)])
def test_an_invalid_covariance_is_rejected(broken: np.ndarray) -> None:
    with pytest.raises(CameraError, match="covariance"):
        MotionFilter().update(0.0, Pose(), broken)
    with pytest.raises(CameraError, match="at nan s"):
        MotionFilter().update(float("nan"), Pose(), NOISE)
    with pytest.raises(CameraError, match="before its first observation"):
        MotionFilter().predict(0.0)


def test_prediction_halves_the_error_of_66_ms_and_adds_no_noise_at_rest() -> None:
    """The table of the documentation: a hand at 0.2 m/s, 30 pictures a second, 0.3 mm of noise."""
    hand, still = compare_filters(hands=2, seconds=8.0)
    held, predicted = hand.T
    assert DELAYS[:3] == (0.0, 0.033, 0.066)
    assert 12.0e-3 < held[2] < 14.5e-3
    assert predicted[2] < 6.5e-3 and predicted[1] < 3e-3
    assert predicted[0] <= 1.1 * held[0]
    held, predicted = still.T
    assert (predicted <= held).all()
