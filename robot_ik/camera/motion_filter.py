"""Filter over time-stamped poses of an object, without prediction for an object at rest.

``MotionFilter`` is a Kalman filter with constant velocity, on position and (as error state) on
orientation. It estimates the pose of an object at any time near the last picture. The horizon of
the prediction fades to zero at low speed, so that the noise of the velocity does not shake a
resting object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import CameraError
from robot_ik.geometry import Pose, quat_to_matrix, rotation_exp
from robot_ik.ports import Array

# Parts of the state.
_POSE = slice(0, 6)
_RATE = slice(6, 12)

# Speeds at which prediction begins, m/s and rad/s. It is complete from twice these speeds. Speeds
# that the filter cannot distinguish from rest count as rest, too.
_REST_SPEED = (0.015, 0.10)
# Longest time to predict, s.
_MAX_PREDICTION = 0.15
# Squared Mahalanobis distance beyond which an observation is an outlier: one in 10 000 correct
# ones, with six degrees of freedom.
_GATE = 27.9
# This many outliers in a row mean that the object was moved. The filter restarts there.
_OUTLIERS_TO_RESTART = 3
# After this time without an observation the filter restarts, s.
_RESTART_TIME = 1.0
# A speed counts from this many of its standard deviations on. The noise of three axes seldom
# reaches it.
_SURE_SIGMAS = 4.0
# Square of a speed that no camera distinguishes from rest. It keeps the covariance of an exact
# camera regular.
_TINY_SPEED = 1e-18
# Weight of the newest observation in the estimate of how well prediction works.
_NEWEST_WEIGHT = 0.3


class Update(StrEnum):
    """What the filter did with an observation."""

    STARTED = "started"
    TAKEN = "taken"
    OUTLIER = "outlier"
    RESTARTED = "restarted"
    LATE = "late"


class Prediction(NamedTuple):
    """A pose at one time.

    Attributes:
        pose: Pose of the object.
        covariance: (6, 6): position (m) over rotation (rad), axes of the observations, about the
            origin of the pose.
        velocity: (6,): m/s over rad/s, same axes; zero while the object counts as resting.
    """

    pose: Pose
    covariance: Array
    velocity: Array


@dataclass(frozen=True)
class FilterOptions:
    """Assumptions about the motion. The defaults are for an object moved by hand.

    Attributes:
        process_noise: In a time t the velocity changes by this times the root of t (standard
            deviation), m/s and rad/s per root of s. A larger value follows faster motion and trusts
            single pictures more.
        initial_speed_sigma: Standard deviation of an unknown velocity, m/s and rad/s.
        min_sigma: Smallest standard deviation of an observation, m and rad: print and lens are
            less accurate than the corners.
    """

    process_noise: tuple[float, float] = (0.5, 4.0)
    initial_speed_sigma: tuple[float, float] = (1.0, 6.0)
    min_sigma: tuple[float, float] = (5e-5, 5e-4)


class MotionFilter:
    """Constant-velocity Kalman filter on position and orientation.

    The error state is (position, rotation, velocity, angular velocity), each along the axes of the
    observations. The rotation error w is on the left, R_true = exp(w) R. Velocity is a random walk
    (Bar-Shalom, Li & Kirubarajan 2001, eq. 6.2.2-4). Error state on SO(3) after Solà 2017
    (arXiv:1711.02508, section 7, with the error in the outer frame).

    Args:
        options: Assumptions about the motion.

    Attributes:
        time: Time of the last observation taken, s; NaN before the first.
        moving: (2,) part of the translation and of the rotation that is predicted: 0 at rest, 1 at
            high speed.
    """

    def __init__(self, options: FilterOptions | None = None) -> None:
        self.options = options or FilterOptions()
        # (6, 6) variance that the velocity gains per second.
        self._density = np.diag(np.repeat(np.square(self.options.process_noise), 3))
        self._min_noise = np.diag(np.repeat(np.square(self.options.min_sigma), 3))
        self.reset()

    @property
    def started(self) -> bool:
        """Whether there was an observation."""
        return not math.isnan(self.time)

    def reset(self) -> None:
        """Forget all observations."""
        self.time = math.nan
        self.moving = np.zeros(2)

    def _begin(self, time: float, pose: Pose, noise: Array, update: Update) -> Update:
        self.time = float(time)
        self._pose = pose
        self._rate = np.zeros(6)
        self._rejected = 0
        self._rejected_time = -math.inf
        # Covariance of the state, and the scatter of the state at rest by noise alone.
        self._spreads = np.zeros((2, 12, 12))
        self._spreads[:, _POSE, _POSE] = noise
        speeds = np.repeat(np.square(self.options.initial_speed_sigma), 3)
        self._spreads[0, _RATE, _RATE] = np.diag(speeds)
        # Mean squared errors (2, 2) of prediction and of holding, in position and rotation.
        self._errors = np.zeros((2, 2))
        self.moving = np.zeros(2)
        return update

    def update(self, time: float, pose: Pose, covariance: ArrayLike) -> Update:
        """Take an observation.

        Args:
            time: Time of the observation, s, on any one clock.
            pose: Observed pose.
            covariance: (6, 6): position (m) over rotation (rad), same axes, about the origin of the
                pose.

        Returns:
            What the filter did with it. An observation that is not newer than the last one is
            ``LATE`` and changes nothing.

        Raises:
            CameraError: The time is not finite, or the covariance is not a covariance.
        """
        noise = self._noise(time, covariance)
        if not self.started:
            return self._begin(time, pose, noise, Update.STARTED)
        if time <= max(self.time, self._rejected_time):
            return Update.LATE
        if time - self.time > _RESTART_TIME:
            return self._begin(time, pose, noise, Update.RESTARTED)

        predicted, spreads = self._advanced(time - self.time)
        innovation = pose.minus(predicted)
        spread = spreads[0, _POSE]
        right = np.concatenate([spread, innovation[:, None]], axis=1)
        weighted = np.linalg.solve(spread[:, _POSE] + noise, right)
        gain = weighted[:, :12].T
        distance = innovation @ weighted[:, 12]
        if not distance <= _GATE:
            self._rejected += 1
            self._rejected_time = time
            if self._rejected >= _OUTLIERS_TO_RESTART:
                return self._begin(time, pose, noise, Update.RESTARTED)
            return Update.OUTLIER

        errors = np.stack([innovation, pose.minus(self._pose)]).reshape(2, 2, 3)
        self._errors += _NEWEST_WEIGHT * (np.sum(errors**2, axis=2) - self._errors)
        keep = np.eye(12)
        keep[:, _POSE] -= gain
        # Joseph's form stays symmetric and positive.
        self._spreads = _symmetric(keep @ spreads @ keep.T + gain @ noise @ gain.T)
        change = gain @ innovation
        self._pose = predicted.plus(change[_POSE])
        self._rate = self._rate + change[_RATE]
        self.time = time
        self._rejected = 0
        self._rejected_time = -math.inf
        self.moving = self._moving()
        return Update.TAKEN

    def predict(self, time: float) -> Prediction:
        """Return the pose at ``time``, moved by the velocity times ``moving``.

        A time before the last observation is treated as the time of that observation.

        Raises:
            CameraError: There was no observation, or the time is not finite.
        """
        if not self.started or not np.isfinite(time):
            raise CameraError(
                "a motion filter cannot predict before its first observation, nor for a time of "
                "nan",
                hint="call update first",
            )
        span = min(max(time - self.time, 0.0), _MAX_PREDICTION)
        shares = np.repeat(self.moving, 3)
        horizon = span * shares
        pose = self._pose.plus(horizon * self._rate)
        p = self._spreads[0]
        cross = p[_POSE, _RATE] * horizon
        spread = p[_POSE, _POSE] + cross + cross.T + p[_RATE, _RATE] * np.outer(horizon, horizon)
        spread = spread + self._density * horizon**3 / 3.0
        return Prediction(pose, _symmetric(spread), self._rate * shares)

    def _moving(self) -> Array:
        """Return ``moving`` (2,) after the last observation."""
        rates = self._rate.reshape(2, 3)
        blocks = [self._spreads[1, 6:9, 6:9], self._spreads[1, 9:, 9:]]
        noise = np.stack(blocks) + _TINY_SPEED * np.eye(3)
        # Measured along the direction of the speed: depth is ten times as noisy as the directions
        # across.
        weighted = np.linalg.solve(noise, rates[..., None])[..., 0]
        sigmas = np.sqrt(np.sum(rates * weighted, axis=1))
        speeds = np.sqrt(np.sum(rates**2, axis=1))
        shares = np.minimum(speeds / _REST_SPEED, sigmas / _SURE_SIGMAS) - 1.0
        shares = np.clip(shares, 0.0, 1.0)
        shares = shares * shares * (3.0 - 2.0 * shares)
        by_prediction, by_holding = np.sqrt(self._errors)
        # Complete if prediction has less than half of the error of holding, none if it has as much.
        earned = np.clip(2.0 - 2.0 * by_prediction / np.maximum(by_holding, 1e-12), 0.0, 1.0)
        return shares * earned

    def _noise(self, time: float, covariance: ArrayLike) -> Array:
        noise = np.array(covariance, dtype=float)
        is_finite = noise.shape == (6, 6) and bool(np.isfinite(noise).all()) and math.isfinite(time)
        noise = _symmetric(noise) if is_finite else noise
        if not is_finite or np.linalg.eigvalsh(noise)[0] < -1e-9 * abs(noise.trace()):
            raise CameraError(
                f"an observation at {time} s with no finite, positive covariance (6, 6) cannot be "
                "filtered",
                hint="give the covariance of the observation: position over rotation, m and rad",
            )
        return noise + self._min_noise

    def _advanced(self, span: float) -> tuple[Pose, Array]:
        """Return pose and ``_spreads`` (2, 12, 12) ``span`` seconds after the last observation."""
        step = np.eye(12)
        step[3:6, 3:6] = quat_to_matrix(rotation_exp(span * self._rate[3:]))
        step[_POSE, _RATE] = span * np.eye(6)
        spreads = step @ self._spreads @ step.T
        gained = span * self._density
        spread = spreads[0]
        spread[_POSE, _POSE] += gained * span**2 / 3.0
        spread[_POSE, _RATE] += gained * span / 2.0
        spread[_RATE, _POSE] += gained * span / 2.0
        spread[_RATE, _RATE] += gained
        return self._pose.plus(span * self._rate), spreads


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.mT))
