"""Optics: a drawing where OpenCV projects it, a calibration and a hand-eye calibration near the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_ik.bench.camera_accuracy import rms
from robot_ik.bench.camera_rows import Effort, Figure, NotMeasuredError
from robot_ik.camera.ar.draw import Artist
from robot_ik.camera.ar.gl_draw import make_artist
from robot_ik.camera.ar.registration import BENT, STRAIGHT, overlay_error, projection_identity
from robot_ik.camera.boards.patterns import CharucoPattern, ChessboardPattern, Pattern
from robot_ik.camera.calibrate import calibrate
from robot_ik.camera.handeye import solve_handeye
from robot_ik.camera.made_up.handeye_set import handeye_set
from robot_ik.camera.made_up.pattern_set import pattern_set
from robot_ik.camera.made_up.standard_set import STANDARD_CAMERA

# What is wanted of drawn spheres (RMS, worst, px) without and with a lens.
_WANTED = {"pinhole": (STRAIGHT, 0.05, 0.15), "with distortion": (BENT, 0.08, 0.20)}
# The boards: squares of 30 mm with markers of 22 mm; 9 × 6 inner corners of squares of 25 mm.
_PATTERNS: dict[str, Pattern] = {
    "ChArUco 8×6": CharucoPattern(8, 6, 0.030, 0.022),
    "chessboard 9×6": ChessboardPattern(9, 6, 0.025),
}
_VIEWS, _SETS = 20, 3
# Hand-eye: how many poses, and the spread of their rotations in degrees.
_POSES, _SPREAD = 15, 25.0


def projection(effort: Effort) -> Iterator[Figure]:
    """Middles of spheres that painter and rays draw for users, against OpenCV's projection."""
    for name in ("painter", "ray"):
        yield from _identity(make_artist(name)[0], effort)


def gl_projection(effort: Effort) -> Iterator[Figure]:
    """The same by MuJoCo's renderer.

    Raises:
        NotMeasuredError: OpenGL does not work here.
    """
    artist, notice = make_artist("gl")
    if notice:
        raise NotMeasuredError(notice)
    yield from _identity(artist, effort)


def _identity(artist: Artist, effort: Effort) -> Iterator[Figure]:
    for kind, (lens, wanted, worst) in _WANTED.items():
        misses = projection_identity(artist, lens, seed=effort.seed)
        what = f"{artist.name} against projectPoints, {kind}"
        yield Figure(f"{what}, RMS", misses.rms, "px", wanted)
        yield Figure(f"{what}, worst", misses.worst, "px", worst)


def overlay(effort: Effort) -> Iterator[Figure]:
    """Points of a robot, up to 300 mm above and 150 mm beside a 2×2 board, drawn with the pose seen."""
    for distance in (0.7, 1.0):
        misses = overlay_error(distance, effort.count(60), seed=effort.seed)
        what = f"overlay on a 2×2 board at {distance} m"
        yield Figure(f"{what}, RMS", misses.rms, "px", 0.3)
        yield Figure(f"{what}, worst", misses.worst, "px", 1.0)


def calibration(effort: Effort) -> Iterator[Figure]:
    """Intrinsics from 20 pictures of a board; worst of the sets tried."""
    for name, pattern in _PATTERNS.items():
        focal, centre, error, counted = [], [], [], []
        for trial in range(1 if effort.quick else _SETS):
            # Other seeds, other sets: none is measured twice.
            seed = _SETS * (effort.seed - 1) + trial + 1
            views = pattern_set(pattern, STANDARD_CAMERA, _VIEWS, seed=seed)
            found = [seen for view in views if (seen := pattern.find(view.image)) is not None]
            result = calibrate(found, STANDARD_CAMERA.size)
            lens, true = result.intrinsics, STANDARD_CAMERA
            focal.append(max(abs(lens.fx / true.fx - 1.0), abs(lens.fy / true.fy - 1.0)))
            centre.append(float(np.hypot(lens.cx - true.cx, lens.cy - true.cy)))
            error.append(result.rms)
            counted.append(len(found))
        yield Figure(f"{name}: focal length, off by", 100.0 * max(focal), "%", 0.15)
        yield Figure(f"{name}: optical centre, off by", max(centre), "px", 2.0)
        yield Figure(f"{name}: reprojection error, RMS", max(error), "px", 0.2)
        yield Figure(f"{name}: views in which the board was found", min(counted), "", _VIEWS, at_least=True)


def handeye(effort: Effort) -> Iterator[Figure]:
    """Camera on the hand: true error and stated uncertainty, from 15 poses and a single 50 mm marker."""
    off, stated = [], []
    for trial in range(effort.count(40)):
        truth, samples = handeye_set(_POSES, spread_deg=_SPREAD, seed=1000 * effort.seed + trial)
        found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand")
        off.append(found.pose_parent_camera.distance(truth.pose_parent_camera))
        stated.append((found.sigma_position, found.sigma_angle))
    error, sigma = np.array(off), np.array(stated)
    yield Figure("camera on the hand, position, RMS", 1e3 * rms(error[:, 0]), "mm", 1.5)
    yield Figure("camera on the hand, orientation, RMS", float(np.degrees(rms(error[:, 1]))), "°", 0.25)
    for k, what in enumerate(("position", "orientation")):
        ratio = rms(error[:, k]) / rms(sigma[:, k])
        yield Figure(f"stated {what} off by a factor of", max(ratio, 1.0 / ratio), "", 2.0)
