"""Where an object seen by a camera is now: a filter over time-stamped poses, and prediction that knows rest.

``MotionFilter`` is a Kalman filter with constant velocity, on position and (as error state) on orientation.
It estimates where the object is at any time near the last picture.  The horizon of the prediction fades to
zero at low speed: an object that lies still is not shaken by the noise of its own velocity.
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

_POSE, _RATE = slice(0, 6), slice(6, 12)


class Update(StrEnum):
    """What became of an observation."""

    STARTED = "started"
    TAKEN = "taken"
    OUTLIER = "outlier"
    RESTARTED = "restarted"
    LATE = "late"


class Prediction(NamedTuple):
    """A pose at one time.

    Attributes:
        pose: Where the object is.
        covariance: (6, 6): position (m) over rotation (rad), axes of the observations, about the origin.
        velocity: (6,): m/s over rad/s, same axes; zero while it counts as resting.
    """

    pose: Pose
    covariance: Array
    velocity: Array


@dataclass(frozen=True)
class FilterOptions:
    """What is assumed of the motion.  The defaults are for something moved by hand.

    Attributes:
        process_noise: Standard deviation of what the velocity changes in a time t is this times √t: m/s and
            rad/s per √s.  Larger follows faster motion and trusts single pictures more.
        initial_speed_sigma: Standard deviation of a velocity of which nothing is known yet, m/s and rad/s.
        least_sigma: Least standard deviation that an observation is believed to have, m and rad: print and
            lens are never as good as the corners.
    """

    process_noise: tuple[float, float] = (0.5, 4.0)
    initial_speed_sigma: tuple[float, float] = (1.0, 6.0)
    least_sigma: tuple[float, float] = (5e-5, 5e-4)


# Speeds, m/s and rad/s, at which prediction begins; from twice as much it is whole.  Speeds that the filter
# cannot tell from rest count as rest, too.
_REST_SPEED = (0.015, 0.10)
# Longest time to predict, s.
_LONGEST_PREDICTION = 0.15
# Squared Mahalanobis distance beyond which an observation is an outlier: one of 10 000 good ones is, with six
# degrees of freedom.  So many in a row are none: the object was moved, and the filter restarts there.
_GATE, _OUTLIERS_TO_RESTART = 27.9, 3
# After this time without an observation the filter starts again, s.
_RESTART_AFTER = 1.0
# A speed counts once it is so many of its standard deviations: the noise of three axes seldom reaches it.
_SURE = 4.0
# Square of a speed that no camera tells from rest: keeps the noise of a perfect one from being singular.
_TINY = 1e-18
# Of the newest observation in what is known of how well prediction does.
_NEW_SHARE = 0.3


class MotionFilter:
    """Constant-velocity Kalman filter on position and orientation.

    The error state is (position, rotation, velocity, angular velocity), each along the axes of the
    observations; the rotation error θ is on the left, R_true = exp(θ) R.  Velocity is a random walk
    (Bar-Shalom, Li & Kirubarajan 2001, eq. 6.2.2-4); error state on SO(3) after Solà 2017 (arXiv:1711.02508,
    section 7, with the error in the outer frame).

    Args:
        options: What is assumed of the motion.

    Attributes:
        time: Of the last observation taken, s; NaN before the first.
        moving: (2,) how much it counts as moving and as turning: 0 at rest, 1 when fast enough to predict.
    """

    def __init__(self, options: FilterOptions | None = None) -> None:
        self.options = options or FilterOptions()
        # (6, 6) variance that the velocity gains in each second, and the least variance of an observation.
        self._density = np.diag(np.repeat(np.square(self.options.process_noise), 3))
        self._least_noise = np.diag(np.repeat(np.square(self.options.least_sigma), 3))
        self.reset()

    @property
    def started(self) -> bool:
        """Whether anything was observed yet."""
        return bool(self.time == self.time)

    def reset(self) -> None:
        """Forgets everything."""
        self.time, self.moving = float("nan"), np.zeros(2)

    def _begin(self, time: float, pose: Pose, noise: Array, how: Update) -> Update:
        self.time, self._pose, self._rate = float(time), pose, np.zeros(6)
        self._rejected, self._rejected_at = 0, -np.inf
        # Covariance of the state, and how far noise of the observations alone moves one at rest.
        self._spreads = np.zeros((2, 12, 12))
        self._spreads[:, _POSE, _POSE] = noise
        self._spreads[0, _RATE, _RATE] = np.diag(np.repeat(np.square(self.options.initial_speed_sigma), 3))
        # Mean squares of what prediction would have missed by, and of what holding would have: (2, 2).
        self._misses, self.moving = np.zeros((2, 2)), np.zeros(2)
        return how

    def update(self, time: float, pose: Pose, covariance: ArrayLike) -> Update:
        """Takes an observation.

        Args:
            time: When it was made, s, on any one clock.
            pose: What was observed.
            covariance: (6, 6) of it: position (m) over rotation (rad), same axes, about the pose's origin.

        Returns:
            What became of it.  One that is not newer than the last is ``LATE`` and changes nothing.

        Raises:
            CameraError: The time is not finite, or the covariance is no covariance.
        """
        noise = self._noise(time, covariance)
        if not self.started:
            return self._begin(time, pose, noise, Update.STARTED)
        if time <= max(self.time, self._rejected_at):
            return Update.LATE
        if time - self.time > _RESTART_AFTER:
            return self._begin(time, pose, noise, Update.RESTARTED)
        predicted, spreads = self._advanced(time - self.time)
        innovation = pose.change_from(predicted)
        spread = spreads[0, _POSE]
        weighted = np.linalg.solve(
            spread[:, _POSE] + noise, np.concatenate([spread, innovation[:, None]], axis=1)
        )
        gain, distance = weighted[:, :12].T, innovation @ weighted[:, 12]
        if not distance <= _GATE:
            self._rejected, self._rejected_at = self._rejected + 1, time
            if self._rejected >= _OUTLIERS_TO_RESTART:
                return self._begin(time, pose, noise, Update.RESTARTED)
            return Update.OUTLIER
        change = gain @ innovation
        keep = np.eye(12)
        keep[:, _POSE] -= gain
        # How the observation was met by prediction and by holding.
        missed = np.stack([innovation, pose.change_from(self._pose)]).reshape(2, 2, 3)
        self._misses += _NEW_SHARE * (np.sum(missed**2, axis=2) - self._misses)
        self._spreads = _symmetric(keep @ spreads @ keep.T + gain @ noise @ gain.T)  # Joseph's form
        self._pose, self._rate = predicted.moved(change[_POSE]), self._rate + change[_RATE]
        self.time, self._rejected, self._rejected_at = time, 0, -np.inf
        self.moving = self._how_much_moving()
        return Update.TAKEN

    def predict(self, time: float) -> Prediction:
        """Where the object is at ``time``: with the velocity, as far as it can be told from rest.

        Times before the last observation are taken for its time.

        Raises:
            CameraError: Nothing was observed yet, or the time is not finite.
        """
        if not self.started or not np.isfinite(time):
            raise CameraError(
                "a motion filter cannot predict before its first observation, nor for a time of nan",
                hint="call update first",
            )
        span = min(max(time - self.time, 0.0), _LONGEST_PREDICTION)
        shares = np.repeat(self.moving, 3)
        horizon = span * shares
        pose = self._pose.moved(horizon * self._rate)
        p = self._spreads[0]
        cross = p[_POSE, _RATE] * horizon
        spread = p[_POSE, _POSE] + cross + cross.T + p[_RATE, _RATE] * np.outer(horizon, horizon)
        spread = spread + self._density * horizon**3 / 3.0
        return Prediction(pose, _symmetric(spread), self._rate * shares)

    # ------------------------------------------------------------------------------------ inside

    def _how_much_moving(self) -> Array:
        """(2,) ``moving``, by the last observation."""
        rates = self._rate.reshape(2, 3)
        shaking = np.stack([self._spreads[1, 6:9, 6:9], self._spreads[1, 9:, 9:]]) + _TINY * np.eye(3)
        # In its own direction: depth shakes ten times as much as what lies across the view.
        sure = np.sqrt(np.sum(rates * np.linalg.solve(shaking, rates[..., None])[..., 0], axis=1))
        speeds = np.sqrt(np.sum(rates**2, axis=1))
        shares = np.clip(np.minimum(speeds / _REST_SPEED, sure / _SURE) - 1.0, 0.0, 1.0)
        shares = shares * shares * (3.0 - 2.0 * shares)
        missed, held = np.sqrt(self._misses)
        # Whole where prediction misses by less than half of what holding does, nothing where by as much.
        earned = np.clip(2.0 - 2.0 * missed / np.maximum(held, 1e-12), 0.0, 1.0)
        return shares * earned

    def _noise(self, time: float, covariance: ArrayLike) -> Array:
        noise = np.array(covariance, dtype=float)
        good = noise.shape == (6, 6) and bool(np.isfinite(noise).all()) and math.isfinite(time)
        noise = _symmetric(noise) if good else noise
        if not good or np.linalg.eigvalsh(noise)[0] < -1e-9 * abs(noise.trace()):
            raise CameraError(
                f"an observation at {time} s with no finite, positive covariance (6, 6) cannot be filtered",
                hint="give the covariance of the observation: position over rotation, m and rad",
            )
        return noise + self._least_noise

    def _advanced(self, span: float) -> tuple[Pose, Array]:
        """Pose and ``_spreads`` (2, 12, 12) ``span`` seconds after the last observation."""
        step = np.eye(12)
        step[3:6, 3:6] = quat_to_matrix(rotation_exp(span * self._rate[3:]))
        step[_POSE, _RATE] = span * np.eye(6)
        spreads = step @ self._spreads @ step.T
        gained, spread = span * self._density, spreads[0]
        spread[_POSE, _POSE] += gained * span**2 / 3.0
        spread[_POSE, _RATE] += gained * span / 2.0
        spread[_RATE, _POSE] += gained * span / 2.0
        spread[_RATE, _RATE] += gained
        return self._pose.moved(span * self._rate), spreads


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.mT))
