"""Accuracy of markers and boards in pictures of common cameras.

The cameras differ in tone curve, sharpening, exposure, glare and motion. All cameras see the same
scenes: ``synthetic.pictures`` draws the light through the lens, and ``synthetic.sensor`` turns it
into a picture. Neither uses the edge model that the corner fit uses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.camera.accuracy import BOARD, DICTIONARY, GAP, MARKER, frame_of, outward, rms
from benchmarks.camera.pictures import STANDARD_DISTANCES
from benchmarks.camera.rows import Effort
from benchmarks.quantity import Quantity
from robot_ik.camera.synthetic.pictures import (
    STANDARD_CAMERA,
    STANDARD_SIZE,
    marker_light,
    photograph,
    random_pose,
)
from robot_ik.camera.synthetic.sensor import LINEAR, WEBCAM, SensorModel
from robot_ik.camera.targets import MarkerTarget, marker, marker_points
from robot_ik.geometry import Pose
from robot_ik.ports import Array

_BOARD_SIZE = 2 * STANDARD_SIZE + GAP
# Scenes with one marker, at each distance.
_SINGLES = 40
# Scenes with a board, at each distance.
_BOARDS = 20
# Largest corner bias along the diagonals with a usual camera, px.
_BIAS = 0.02
# The same for pictures of poor quality, px.
_BIAS_HARSH = 0.04
# Accepted range of the squared error over the stated variance. A consistent estimate has 1.
_NEES = (0.2, 2.0)
# Largest position errors at the three distances, mm: of a marker with a usual tone curve.
_TONED = (0.06, 0.25, 1.0)
# The same of a board, mm.
_TONED_BOARD = (0.03, 0.08, 0.25)
# Largest position errors in pictures of poor quality, mm: of a marker.
_HARSH = (0.1, 0.5, 1.6)
# The same of a board, mm.
_HARSH_BOARD = (0.05, 0.2, 0.6)


@dataclass(frozen=True)
class Condition:
    """One camera and the largest accepted errors.

    Attributes:
        name: Name of the camera in the results.
        sensor: Model of the sensor.
        single: Position errors of one marker at 0.3, 0.6 and 1.0 m, mm.
        board: Position errors of a board at these distances, mm. Empty: boards are not measured.
        bias: Corner bias along the diagonals, px.
    """

    name: str
    sensor: SensorModel
    single: tuple[float, float, float]
    board: tuple[float, ...]
    bias: float = _BIAS


CONDITIONS: tuple[Condition, ...] = (
    Condition("linear", replace(WEBCAM, tone="linear"), (0.05, 0.2, 0.8), (0.02, 0.05, 0.2)),
    Condition("gamma 1.5", replace(WEBCAM, tone="gamma 1.5"), _TONED, _TONED_BOARD),
    Condition("gamma 2.2", replace(WEBCAM, tone="gamma 2.2"), _TONED, _TONED_BOARD),
    Condition("sRGB", WEBCAM, _TONED, _TONED_BOARD),
    Condition("S-curve", replace(WEBCAM, tone="s-curve"), (0.06, 0.35, 1.2), (0.03, 0.1, 0.3)),
    Condition("overexposed 1.5", replace(WEBCAM, exposure=1.5), _HARSH, _HARSH_BOARD, _BIAS_HARSH),
    Condition("bloom 15 %", replace(WEBCAM, bloom=0.15), _HARSH, _HARSH_BOARD, _BIAS_HARSH),
    Condition("ink bled by 0.05 mm", replace(WEBCAM, bleed=5e-5), _TONED, _TONED_BOARD),
    Condition("motion 2 px", replace(WEBCAM, motion=2.0), _HARSH, _HARSH_BOARD, _BIAS_HARSH),
    Condition(
        "sharpening 1.5",
        replace(WEBCAM, sharpening=1.5),
        (0.08, 0.4, 2.0),
        (0.05, 0.15, 0.5),
        _BIAS_HARSH,
    ),
    Condition("soft shadow", replace(WEBCAM, shadow=0.5), (0.15, 0.8, 2.5), (), _BIAS_HARSH),
    # The edge model assumes smooth light over a print, so a hard shadow is not corrected. The
    # stated covariance covers the error.
    Condition(
        "hard shadow", replace(WEBCAM, shadow=0.5, shadow_edge=0.7), (0.4, 1.5, 4.0), (), 0.1
    ),
)


@dataclass
class Errors:
    """Errors of one camera.

    Attributes:
        metres: Position errors by distance, metres.
        nees: Squared position errors over the stated covariance. The mean of a consistent estimate
            is 1.
        outward: Mean errors of the corners along the diagonals, px.
        missed: Number of pictures in which the target was not found.
    """

    metres: dict[float, list[float]] = field(default_factory=dict)
    nees: list[float] = field(default_factory=list)
    outward: list[float] = field(default_factory=list)
    missed: int = 0

    def add(self, distance: float, error: Array, covariance: Array) -> None:
        """Add a pose by its ``error`` (3,), metres, and its stated ``covariance`` (3, 3)."""
        self.metres.setdefault(distance, []).append(float(np.linalg.norm(error)))
        self.nees.append(float(error @ np.linalg.solve(covariance, error)) / 3.0)


def measured(
    conditions: tuple[Condition, ...],
    count: int,
    seed: int,
    *,
    board: bool,
    distances: tuple[float, ...],
) -> dict[str, Errors]:
    """Return the errors by camera, in ``count`` scenes of markers or boards at each distance."""
    target = BOARD if board else marker(MARKER, STANDARD_SIZE, DICTIONARY)
    result = {condition.name: Errors() for condition in conditions}
    for distance in distances:
        rng = np.random.default_rng([seed, round(1e3 * distance), board])
        for number in range(count):
            pose = random_pose(
                STANDARD_CAMERA, rng, distance, size=_BOARD_SIZE if board else STANDARD_SIZE
            )
            placed = {i: (side, pose.compose(on)) for i, (side, on) in target.markers.items()}
            state = rng.bit_generator.state
            lights = {}
            for bleed in {condition.sensor.bleed for condition in conditions}:
                # The same random numbers give the same wall behind the print.
                rng.bit_generator.state = state
                lights[bleed], centre = marker_light(
                    STANDARD_CAMERA,
                    placed,
                    rng,
                    dictionary=DICTIONARY,
                    margin=GAP / STANDARD_SIZE,
                    sensor=replace(LINEAR, bleed=bleed),
                )
            for condition in conditions:
                noise = np.random.default_rng([seed, number, round(1e3 * distance)])
                image = photograph(lights[condition.sensor.bleed], centre, noise, condition.sensor)
                _observe(target, image, pose, distance, result[condition.name], board)
    return result


def _observe(
    target: MarkerTarget,
    image: NDArray[np.uint8],
    pose: Pose,
    distance: float,
    errors: Errors,
    board: bool,
) -> None:
    """Find a target at the true ``pose`` in a picture, and add its errors to ``errors``."""
    observation = target.find(frame_of(image), STANDARD_CAMERA)
    if observation is None:
        errors.missed += 1
        return
    error = observation.pose.position - pose.position
    errors.add(distance, error, observation.covariance[:3, :3])
    if not board:
        true = STANDARD_CAMERA.project(pose.apply(marker_points(STANDARD_SIZE)))
        errors.outward.append(float(outward(observation.pixels - true, true).mean()))


def cameras(effort: Effort) -> Iterator[Quantity]:
    """Yield the errors of markers and 2×2 boards, of every camera at three distances."""
    for board, count in ((False, _SINGLES), (True, _BOARDS)):
        chosen = tuple(c for c in CONDITIONS if c.board or not board)
        errors = measured(
            chosen, effort.count(count), effort.seed, board=board, distances=STANDARD_DISTANCES
        )
        for condition in chosen:
            yield from _figures(condition, errors[condition.name], board)


def _figures(condition: Condition, errors: Errors, board: bool) -> Iterator[Quantity]:
    what = f"{condition.name}, {'2×2 board' if board else 'marker'}"
    limits = condition.board if board else condition.single
    for distance, limit in zip(STANDARD_DISTANCES, limits, strict=True):
        metres = errors.metres.get(distance, [float("nan")])
        yield Quantity(f"{what}, position at {distance} m, RMS", 1e3 * rms(metres), "mm", limit)
    nees = float(np.mean(errors.nees))
    yield Quantity(f"{what}, squared error over the stated", nees, least=_NEES[0], most=_NEES[1])
    yield Quantity(f"{what}, not found", errors.missed, "", 0)
    if errors.outward:
        yield Quantity(
            f"{what}, corner bias outwards",
            abs(float(np.mean(errors.outward))),
            "px",
            condition.bias,
        )
