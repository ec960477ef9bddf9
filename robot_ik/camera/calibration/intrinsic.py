"""Intrinsics from views of a flat pattern: OpenCV's bundle adjustment, and how far to trust it.

The formal standard deviations of a bundle adjustment take every corner's error for independent of every
other's, and are about half of the real error (a bent board, a lens that the model does not quite fit).  So
the views are also dealt into groups, and the calibration is repeated without each of them: the spread of the
results is the delete-a-group jackknife (Kott 2001), and the left-out views tell the error on pictures that
the calibration has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from robot_ik.camera.calibration.coverage import Coverage, cover
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.patterns import FoundPattern
from robot_ik.errors import CalibrationError
from robot_ik.ports import Array

#: With fewer views the principal point is off by some pixels.
ENOUGH_VIEWS = 15
# Beyond these a calibration is usable, and says what it lacks: standard deviations as parts of the focal
# length and of the picture's width, reprojection errors in px and as a multiple.
_FOCAL_DOUBT, _CENTRE_DOUBT = 0.003, 0.004
_FAIR_RMS_PX = 0.5
_HOLD_OUT_RATIO = 1.6


def _focal_share(camera: CameraIntrinsics) -> float:
    """Standard deviation of the focal length as a part of it: what every distance is worth."""
    return max(camera.std[0] / camera.fx, camera.std[1] / camera.fy)


def _doubts(camera: CameraIntrinsics, rms: float, hold_out: float, coverage: Coverage) -> list[str]:
    """What is wrong with a calibration; empty when nothing is.

    Reprojection errors in px: ``rms`` on its own views, ``hold_out`` on those that it has not seen.
    """
    views = len(coverage.tilts)
    found = []
    if views < ENOUGH_VIEWS:
        found.append(f"only {views} views: take {ENOUGH_VIEWS} or more")
    if _focal_share(camera) > _FOCAL_DOUBT:
        found.append(
            f"the focal length is only known to {100 * _focal_share(camera):.1f} %: tilt more"
        )
    centre = max(camera.std[2:4])
    if centre > _CENTRE_DOUBT * camera.width:
        found.append(
            f"the principal point is only known to {centre:.1f} px: tilt more, into the corners"
        )
    if rms > _FAIR_RMS_PX:
        found.append(
            f"{rms:.2f} px RMS is high: a bent board, a moved camera, or motion in the pictures"
        )
    if hold_out > max(_HOLD_OUT_RATIO * rms, rms + 0.05):
        found.append(
            f"views that it has not seen fit worse ({hold_out:.2f} px): too few of too many kinds"
        )
    return found + [f"missing: {what}" for what in coverage.missing]


def _verdict(camera: CameraIntrinsics, rms: float, hold_out: float, doubtful: bool) -> str:
    """One sentence."""
    share = _focal_share(camera)
    errors = f"{rms:.2f} px on its own views, {hold_out:.2f} px on others"
    reach = f"distances come out to {100 * share:.2f} % ({1e3 * share:.1f} mm in a metre)"
    return f"{'usable, with doubts' if doubtful else 'good'}: {errors}; {reach}"


# A homography gives two equations for five unknowns of a pinhole; lens and noise want many more.
FEWEST_VIEWS = 6
# Without perspective a long lens and a far board look alike.
_LEAST_TILT_DEG = 12.0
_GROUPS = 5
# A view is left out when it is so many times worse than the middle one, and worse than a good one, px.
_OUTLIER_RATIO, _OUTLIER_PX = 3.0, 0.25
# A picture this many times as blurred as the middle one was moved.
_BLUR_RATIO, _BLUR_PX = 1.8, 2.0
_WORST_RMS_PX = 1.0
# Three coefficients that take away less than this of the error describe noise.
_WORTHLESS = 1.03


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The corners of one picture, and its name."""

    name: str
    found: FoundPattern


@dataclass(frozen=True)
class ViewReport:
    """What became of one view.

    Attributes:
        name: Of the picture.
        corners: How many were found.
        rms: Reprojection error, px; None when it was left out before the calibration.
        left_out: Why it was left out; empty when it was used.
    """

    name: str
    corners: int
    rms: float | None
    left_out: str = ""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration, and how far to trust it.

    Attributes:
        intrinsics: With ``rms`` (over all used corners), ``views``, and ``std`` (the larger one of the formal
            and the jackknife's).
        per_view: One report a view, in the order given.
        hold_out_rms: Reprojection error of views that the calibration had not seen, px.
        coverage: Where in the picture corners were, and how the board was tilted.
        verdict: As text.
        doubts: What the verdict complains about; empty for a good calibration.
    """

    intrinsics: CameraIntrinsics
    per_view: tuple[ViewReport, ...]
    hold_out_rms: float
    coverage: Coverage
    verdict: str
    doubts: tuple[str, ...]


def calibrate(
    views: Sequence[CalibrationView | FoundPattern],
    size: tuple[int, int],
    *,
    coefficients: Literal[5, 8] = 5,
    name: str = "camera",
) -> CalibrationResult:
    """Calibrates a camera.

    Args:
        views: The pattern as found in each picture.
        size: (width, height) of the pictures, px.
        coefficients: 5 (plumb_bob), or 8 (rational_polynomial) for a wide lens.
        name: Of the camera.

    Raises:
        CalibrationError: Too few views, no tilt among them, or a fit worse than 1 px.
    """
    named = [
        v if isinstance(v, CalibrationView) else CalibrationView(f"view {k + 1}", v)
        for k, v in enumerate(views)
    ]
    left_out = _blurred(named)
    for last in (False, True):
        used = [k for k in range(len(named)) if k not in left_out]
        _require_views(len(used), len(named))
        fit = _fit([named[k].found for k in used], size, coefficients)
        _require_tilt(fit.rotations)
        worst = max(_OUTLIER_PX, _OUTLIER_RATIO * float(np.median(fit.per_view)))
        if last or fit.per_view.max() <= worst:
            break
        for k, error in zip(used, fit.per_view, strict=True):
            if error > worst:
                left_out[k] = (
                    f"{error:.2f} px: does not fit the other views (moved, bent, or a wrong corner)"
                )
    if fit.rms > _WORST_RMS_PX:
        raise CalibrationError(
            f"the calibration leaves {fit.rms:.2f} px RMS; more than {_WORST_RMS_PX:g} px is none",
            hint="is the board flat, and every picture from one camera with fixed focus? A wide lens may "
            "need 8 coefficients",
        )
    found = [named[k].found for k in used]
    jackknife, hold_out = _without_each_group(found, size, coefficients, fit)
    std = tuple(float(v) for v in np.maximum(jackknife, fit.std))
    fx, fy, cx, cy = map(float, fit.numbers[:4])
    intrinsics = CameraIntrinsics(
        *size, fx, fy, cx, cy, tuple(fit.numbers[4:]), _MODELS[coefficients],
        rms=fit.rms, std=std, views=len(used), name=name,
    )  # fmt: skip
    intrinsics.require_plausible()
    coverage = cover(found, fit.rotations, size)
    doubts = _doubts(intrinsics, fit.rms, hold_out, coverage)
    if coefficients == 8 and _fit(found, size, 5).rms < _WORTHLESS * fit.rms:
        doubts.append("8 coefficients fit no better than 5: take 5, which behave at the rim")
    return CalibrationResult(
        intrinsics, _reports(named, used, fit, left_out), hold_out, coverage,
        _verdict(intrinsics, fit.rms, hold_out, bool(doubts)), tuple(doubts),
    )  # fmt: skip


_MODELS = {5: "plumb_bob", 8: "rational_polynomial"}


@dataclass(frozen=True, eq=False)
class _Fit:
    """Numbers are fx, fy, cx, cy, then the coefficients."""

    rms: float
    numbers: Array
    std: Array
    per_view: Array
    rotations: list[Array]


def _fit(
    found: Sequence[FoundPattern],
    size: tuple[int, int],
    coefficients: int,
    near: Array | None = None,
) -> _Fit:
    """OpenCV's calibration, from nothing or from numbers that are nearly right."""
    flags = cv2.CALIB_RATIONAL_MODEL if coefficients == 8 else 0
    matrix, lens = _NO_GUESS, _NO_GUESS
    if near is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, lens = _matrix(near), near[4:].copy()
    try:
        result: Any = cv2.calibrateCameraExtended(
            [f.points_board.astype(np.float32) for f in found],
            [f.pixels.astype(np.float32) for f in found],
            size, matrix, lens, flags=flags,
        )  # fmt: skip
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV cannot calibrate from these views: {error.err}",
            hint="take views that differ more: near and far, tilted to each side",
        ) from None
    rms, matrix, lens, rotation_vectors, _, spread, _, per_view = result
    k = np.asarray(matrix, dtype=float)
    numbers = np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.ravel(lens)[:coefficients]])
    if not np.isfinite(numbers).all():
        raise CalibrationError(
            "the calibration found no camera that fits these views",
            hint="take views that differ more: near and far, tilted to each side",
        )
    std = np.ravel(np.asarray(spread, dtype=float))[: 4 + coefficients]
    vectors = [np.asarray(t, dtype=float).reshape(3) for t in rotation_vectors]
    rotations = [np.asarray(cv2.Rodrigues(v)[0], dtype=float) for v in vectors]
    return _Fit(float(rms), numbers, std, np.ravel(np.asarray(per_view, dtype=float)), rotations)


# The stubs of OpenCV know nothing of "no guess".
_NO_GUESS: Any = None


def _matrix(numbers: Array) -> Array:
    return np.array([[numbers[0], 0, numbers[2]], [0, numbers[1], numbers[3]], [0, 0, 1.0]])


def _without_each_group(
    found: Sequence[FoundPattern], size: tuple[int, int], coefficients: int, whole: _Fit
) -> tuple[Array, float]:
    """Jackknife standard deviations, and the RMS of the views that were left out, px."""
    groups = min(_GROUPS, len(found) // 2)
    results, squares, count = [], 0.0, 0
    for group in range(groups):
        kept = [f for k, f in enumerate(found) if k % groups != group]
        fit = _fit(kept, size, coefficients, whole.numbers)
        results.append(fit.numbers)
        for view in [f for k, f in enumerate(found) if k % groups == group]:
            error = _view_error(view, fit.numbers)
            squares += float((error**2).sum())
            count += len(error)
    off = np.array(results) - np.mean(results, axis=0)
    spread = np.sqrt((groups - 1) / groups * (off**2).sum(axis=0))
    return spread, float(np.sqrt(squares / count))


def _view_error(view: FoundPattern, numbers: Array) -> Array:
    """(n, 2) pixels between corners and the board at its best place, seen by a camera of these numbers."""
    k = _matrix(numbers)
    good, rotation_vector, shift = cv2.solvePnP(view.points_board, view.pixels, k, numbers[4:])
    if not good:
        raise CalibrationError("a view has no pose under the calibration of the others")
    seen, _ = cv2.projectPoints(view.points_board, rotation_vector, shift, k, numbers[4:])
    return np.asarray(seen, dtype=float).reshape(-1, 2) - view.pixels


def _blurred(views: Sequence[CalibrationView]) -> dict[int, str]:
    widths = np.array([v.found.blur for v in views])
    usual = float(np.median(widths)) if len(widths) else 0.0
    return {
        k: f"blurred: edges {width:.1f} px wide, {usual:.1f} px in the others"
        for k, width in enumerate(widths)
        if width > max(_BLUR_RATIO * usual, _BLUR_PX)
    }


def _require_views(used: int, given: int) -> None:
    if used < FEWEST_VIEWS:
        rest = "" if used == given else f" of {given}; the others were blurred or did not fit"
        views = "view" if used == 1 else "views"
        raise CalibrationError(
            f"{used} usable {views}{rest}: too few, at least {FEWEST_VIEWS} are needed",
            hint=f"take {ENOUGH_VIEWS} to 25: near and far, in every corner, tilted to each side by 20 to 40 "
            "degrees",
        )


def _require_tilt(rotations: Sequence[Array]) -> None:
    """Checks the angles between board and picture plane."""
    tilt = np.degrees(np.arccos(min(1.0, *(abs(r[2, 2]) for r in rotations))))
    if tilt < _LEAST_TILT_DEG:
        raise CalibrationError(
            f"the board was held square to the camera in all views (tilt at most {tilt:.0f} degrees): "
            "focal length and distance cannot be told apart",
            hint="tilt the board by 20 to 40 degrees, to the left, right, up and down",
        )


def _reports(
    views: Sequence[CalibrationView], used: Sequence[int], fit: _Fit, left_out: dict[int, str]
) -> tuple[ViewReport, ...]:
    errors = dict(zip(used, fit.per_view, strict=True))
    return tuple(
        ViewReport(
            v.name, len(v.found.ids), float(errors[k]) if k in errors else None, left_out.get(k, "")
        )
        for k, v in enumerate(views)
    )
