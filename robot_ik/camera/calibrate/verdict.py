"""What a calibration is worth, in words."""

from __future__ import annotations

from dataclasses import dataclass

from robot_ik.camera.calibrate.coverage import Coverage

#: With fewer views the principal point is off by some pixels.
ENOUGH_VIEWS = 15
# Beyond these a calibration is usable, and says what it lacks: standard deviations as parts of the focal
# length and of the picture's width, reprojection errors in px and as a multiple.
_FOCAL_DOUBT, _CENTRE_DOUBT = 0.003, 0.004
_FAIR_RMS_PX = 0.5
_HOLD_OUT_RATIO = 1.6


@dataclass(frozen=True)
class Worth:
    """The figures that a verdict rests on.

    Attributes:
        focal: fx and fy, px.
        std: Standard deviations of fx, fy, cx, cy, … in px.
        rms: Reprojection error on its own views, px; ``hold_out``: on views that it has not seen.
        hold_out: See ``rms``.
        views: Number of views used.
        size: (width, height) of the pictures, px.
    """

    focal: tuple[float, float]
    std: tuple[float, ...]
    rms: float
    hold_out: float
    views: int
    size: tuple[int, int]

    @property
    def focal_share(self) -> float:
        """Standard deviation of the focal length as a part of it: what every distance is worth."""
        return max(s / f for s, f in zip(self.std, self.focal, strict=False))

    @property
    def centre_px(self) -> float:
        """Standard deviation of the principal point, px."""
        return max(self.std[2:4])


def doubts_of(worth: Worth, coverage: Coverage) -> list[str]:
    """What is wrong with a calibration; empty when nothing is."""
    found = []
    if worth.views < ENOUGH_VIEWS:
        found.append(f"only {worth.views} views: take {ENOUGH_VIEWS} or more")
    if worth.focal_share > _FOCAL_DOUBT:
        found.append(f"the focal length is only known to {100 * worth.focal_share:.1f} %: tilt more")
    if worth.centre_px > _CENTRE_DOUBT * worth.size[0]:
        found.append(
            f"the principal point is only known to {worth.centre_px:.1f} px: tilt more, into the corners"
        )
    if worth.rms > _FAIR_RMS_PX:
        found.append(
            f"{worth.rms:.2f} px RMS is high: a bent board, a moved camera, or motion in the pictures"
        )
    if worth.hold_out > max(_HOLD_OUT_RATIO * worth.rms, worth.rms + 0.05):
        found.append(
            f"views that it has not seen fit worse ({worth.hold_out:.2f} px): too few of too many kinds"
        )
    return found + [f"missing: {what}" for what in coverage.missing]


def verdict_of(worth: Worth, doubtful: bool) -> str:
    """One sentence."""
    share = worth.focal_share
    rms = f"{worth.rms:.2f} px on its own views, {worth.hold_out:.2f} px on others"
    reach = f"distances come out to {100 * share:.2f} % ({1e3 * share:.1f} mm in a metre)"
    return f"{'usable, with doubts' if doubtful else 'good'}: {rms}; {reach}"
