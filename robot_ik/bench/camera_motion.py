"""What prediction gains: a hand that moves, seen late, by different filters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.filter import FilterOptions, MotionFilter
from robot_ik.camera.goals.one_euro import OneEuro
from robot_ik.geometry import Pose, rotation_exp

Array = NDArray[np.float64]

DELAYS = (0.0, 0.033, 0.066, 0.1, 0.15)
_RATE_HZ, _NOISE_M, _NOISE_RAD = 30.0, 3e-4, 2e-3
# A hand that waves: root mean square of its speed (m/s), and the frequencies in it (Hz).
_SPEED, _SLOWEST, _QUICKEST, _WAVES = 0.196, 0.3, 1.5, 6
# Pictures before the figures count.
_RUN_IN = 30


@dataclass(frozen=True)
class Lag:
    """Root mean square errors at one delay, m.

    Attributes:
        delay: From the picture to the time it is used at, s.
        hold: Of the last observation as it is.
        predicted: Of the motion filter.
        calmed: Of the 1 € filter.
    """

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


def compare_filters(
    hands: int = 4, seconds: float = 20.0, seed: int = 0, options: FilterOptions | None = None
) -> tuple[list[Lag], list[Lag]]:
    """Errors of a moving and of a resting hand, at each of ``DELAYS``.

    30 pictures a second, noise of 0.3 mm along each axis.

    Args:
        hands: Different motions.
        seconds: Of each.
        seed: Of motions and noise.
        options: Of the motion filter.
    """
    rng = np.random.default_rng(seed)
    moving = [_errors(hand(rng), seconds, rng, options) for _ in range(hands)]
    resting = [_errors(lambda t: np.zeros(3), seconds, rng, options) for _ in range(hands)]
    return _lags(np.concatenate(moving)), _lags(np.concatenate(resting))


def _errors(
    path: Callable[[float], Array], seconds: float, rng: np.random.Generator, options: FilterOptions | None
) -> Array:
    """(n, delays, 3) errors in metres of holding, predicting and calming."""
    tracked, calm = MotionFilter(options), OneEuro()
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
                [np.linalg.norm(found - truth) for found in (seen.position, ahead, shown)]
                for truth, ahead in zip(truths, predicted, strict=True)
            ]
        )
    return np.array(rows)


def _lags(errors: Array) -> list[Lag]:
    squares = np.sqrt(np.mean(errors**2, axis=0))
    return [Lag(delay, *(float(value) for value in row)) for delay, row in zip(DELAYS, squares, strict=True)]


def prediction(effort: Effort) -> Iterator[Figure]:
    """Errors of a hand at 0.2 m/s, seen 66 ms ago; and what a hand at rest is shaken by."""
    hands = 1 if effort.quick else 6
    moving, resting = compare_filters(hands, 10.0 if effort.quick else 20.0, effort.seed)
    late = next(row for row in moving if row.delay == 0.066)
    yield Figure("hand seen 66 ms ago, taken as it is, RMS", 1e3 * late.hold, "mm")
    yield Figure("hand seen 66 ms ago, predicted, RMS", 1e3 * late.predicted, "mm", 6.5)
    yield Figure("what prediction leaves of the error", late.predicted / late.hold, "", 0.5)
    worst = max(resting, key=lambda row: row.predicted)
    yield Figure(
        "hand at rest: noise of a prediction over that of a picture", worst.predicted / worst.hold, "", 1.0
    )
    yield Figure("hand at rest, calmed: the same", worst.calmed / worst.hold, "")
