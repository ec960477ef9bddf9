"""Markers and boards seen by the cameras that people have: tone curves, sharpening, JPEG, glare, motion.

Every camera sees the same scenes: light drawn through the lens by ``synthetic.pictures``, then what
``synthetic.sensor`` says that a camera makes of it.  Neither knows the model of an edge that is fitted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.camera.accuracy import BOARD, DICTIONARY, GAP, MARKER, frame_of, outward, rms
from benchmarks.camera.pictures import STANDARD_DISTANCES
from benchmarks.camera.rows import Effort
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
from robot_ik.jobs.quantity import Quantity
from robot_ik.ports import Array

_BOARD_SIZE = 2 * STANDARD_SIZE + GAP
# Scenes at each distance.
_SINGLES, _BOARDS = 40, 20
# Corner bias along the diagonals, px: of a usual camera, of a bad picture.  Mean squared error over the
# stated one.
_BIAS, _BIAS_HARSH, _NEES = 0.02, 0.04, (0.2, 2.0)


@dataclass(frozen=True)
class Condition:
    """One camera, and the position errors wanted of it, mm at 0.3, 0.6 and 1.0 m: of one marker, and a board.

    ``board`` may be empty: not asked; ``bias`` is that of the corners, px.
    """

    name: str
    sensor: SensorModel
    single: tuple[float, float, float]
    board: tuple[float, ...]
    bias: float = _BIAS


_TONED, _TONED_BOARD = (0.06, 0.25, 1.0), (0.03, 0.08, 0.25)
_HARSH, _HARSH_BOARD = (0.1, 0.5, 1.6), (0.05, 0.2, 0.6)

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
        "sharpening 1.5", replace(WEBCAM, sharpening=1.5), (0.08, 0.4, 2.0), (0.05, 0.15, 0.5), _BIAS_HARSH
    ),
    Condition("soft shadow", replace(WEBCAM, shadow=0.5), (0.15, 0.8, 2.5), (), _BIAS_HARSH),
    # Not corrected: the light over a print is smooth in the model.  The result says how far off it may be.
    Condition("hard shadow", replace(WEBCAM, shadow=0.5, shadow_edge=0.7), (0.4, 1.5, 4.0), (), 0.1),
)  # fmt: skip


@dataclass
class Errors:
    """What one camera got wrong, by distance.

    Attributes:
        metres: Position errors.
        nees: Squared position errors over the stated covariance, 1 on average for a consistent one.
        outward: Mean error of the corners along the diagonals, px.
        missed: Pictures in which nothing was found.
    """

    metres: dict[float, list[float]] = field(default_factory=dict)
    nees: list[float] = field(default_factory=list)
    outward: list[float] = field(default_factory=list)
    missed: int = 0

    def add(self, distance: float, off: Array, covariance: Array) -> None:
        """One pose: ``off`` (3,) metres, ``covariance`` (3, 3)."""
        self.metres.setdefault(distance, []).append(float(np.linalg.norm(off)))
        self.nees.append(float(off @ np.linalg.solve(covariance, off)) / 3.0)


def measured(
    conditions: tuple[Condition, ...],
    count: int,
    seed: int,
    *,
    board: bool,
    distances: tuple[float, ...],
) -> dict[str, Errors]:
    """Errors by the name of the camera, of markers or boards in ``count`` scenes at each distance."""
    target = BOARD if board else marker(MARKER, STANDARD_SIZE, DICTIONARY)
    result = {condition.name: Errors() for condition in conditions}
    for distance in distances:
        rng = np.random.default_rng([seed, round(1e3 * distance), board])
        for number in range(count):
            pose = random_pose(
                STANDARD_CAMERA, rng, distance, size=_BOARD_SIZE if board else STANDARD_SIZE
            )
            placed = {i: (side, pose.compose(on)) for i, (side, on) in target.markers.items()}
            begun, lights = rng.bit_generator.state, {}
            for bleed in {condition.sensor.bleed for condition in conditions}:  # on the same wall
                rng.bit_generator.state = begun
                lights[bleed], centre = marker_light(
                    STANDARD_CAMERA, placed, rng, dictionary=DICTIONARY, margin=GAP / STANDARD_SIZE,
                    sensor=replace(LINEAR, bleed=bleed),
                )  # fmt: skip
            for condition in conditions:
                noise = np.random.default_rng([seed, number, round(1e3 * distance)])
                image = photograph(lights[condition.sensor.bleed], centre, noise, condition.sensor)
                _see(target, image, pose, distance, result[condition.name], board)
    return result


def _see(
    target: MarkerTarget,
    image: NDArray[np.uint8],
    pose: Pose,
    distance: float,
    errors: Errors,
    board: bool,
) -> None:
    seen = target.find(frame_of(image), STANDARD_CAMERA)
    if seen is None:
        errors.missed += 1
        return
    errors.add(distance, seen.pose.position - pose.position, seen.covariance[:3, :3])
    if not board:
        true = STANDARD_CAMERA.project(pose.apply(marker_points(STANDARD_SIZE)))
        errors.outward.append(float(outward(seen.pixels - true, true).mean()))


def cameras(effort: Effort) -> Iterator[Quantity]:
    """Single markers and boards of four, by every camera at three distances."""
    for board, count in ((False, _SINGLES), (True, _BOARDS)):
        chosen = tuple(c for c in CONDITIONS if c.board or not board)
        found = measured(
            chosen, effort.count(count), effort.seed, board=board, distances=STANDARD_DISTANCES
        )
        for condition in chosen:
            yield from _figures(condition, found[condition.name], board)


def _figures(condition: Condition, errors: Errors, board: bool) -> Iterator[Quantity]:
    what = f"{condition.name}, {'2×2 board' if board else 'marker'}"
    wanted = condition.board if board else condition.single
    for distance, most in zip(STANDARD_DISTANCES, wanted, strict=True):
        off = errors.metres.get(distance, [float("nan")])
        yield Quantity(f"{what}, position at {distance} m, RMS", 1e3 * rms(off), "mm", most)
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
