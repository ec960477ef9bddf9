"""Errors of an arm over its workspace: statistics by region, and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_ik.camera.calibration.kinematic import PoseError
from robot_ik.workcell.results import png_of, require_plots

_AXES = "xyz"
_DPI = 100
# Size of the picture: width, and height of each row, inches.
_WIDTH = 10.0
_ROW_HEIGHT = 4.4
# Views of the picture: name, world axis to the right, world axis upwards.
_VIEWS = (("from above", 0, 1), ("from the side", 0, 2))
# Length of the longest arrow, as a share of the extent of the poses.
_LONGEST_ARROW = 0.25
# Smallest length by which is divided, mm.
_MIN_LENGTH = 1e-9


@dataclass(frozen=True)
class Region:
    """Statistics of the errors of some poses.

    Attributes:
        name: Name of the region.
        poses: Number of poses.
        rms_m: RMS distance, metres.
        median_m: Median distance, metres.
        largest_m: Largest distance, metres.
        rms_rad: RMS angle, rad.
        sigma_m: RMS of the stated standard deviations of the distances, metres.
    """

    name: str
    poses: int
    rms_m: float
    median_m: float
    largest_m: float
    rms_rad: float
    sigma_m: float


def summary(errors: Sequence[PoseError], name: str = "all") -> Region:
    """Return the statistics of at least one error."""
    distances = np.array([error.distance for error in errors])
    angles = np.array([error.angle for error in errors])
    sigmas = np.array([error.sigma for error in errors])
    return Region(
        name=name,
        poses=len(errors),
        rms_m=_rms(distances),
        median_m=float(np.median(distances)),
        largest_m=float(distances.max()),
        rms_rad=_rms(angles),
        sigma_m=_rms(sigmas),
    )


def regions(errors: Sequence[PoseError]) -> tuple[Region, ...]:
    """Return the statistics of all poses, then of both halves along each axis of the world.

    The halves meet in the middle of the extent. An axis with an empty half is left out.
    """
    positions = np.array([error.position for error in errors])
    result = [summary(errors)]
    for k, axis in enumerate(_AXES):
        middle = 0.5 * float(positions[:, k].min() + positions[:, k].max())
        for sign, is_inside in (("<", positions[:, k] < middle), (">=", positions[:, k] >= middle)):
            half = [error for error, inside in zip(errors, is_inside, strict=True) if inside]
            if half and len(half) < len(errors):
                result.append(summary(half, f"{axis} {sign} {1e3 * middle:.0f} mm"))
    return tuple(result)


def error_picture(rows: Sequence[tuple[str, Sequence[PoseError]]]) -> bytes:
    """Return a PNG with an arrow for each pose, from above and from the side.

    Args:
        rows: Title and errors of each row of the picture. A row has one scale and one colour map.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("drawing the errors")
    # matplotlib is an optional dependency.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, _ROW_HEIGHT * len(rows)), dpi=_DPI, layout="constrained")
    grid = figure.subplots(len(rows), len(_VIEWS), squeeze=False)
    for line, (title, errors) in zip(grid, rows, strict=True):
        for axes, (view, right, up) in zip(line, _VIEWS, strict=True):
            arrows, scale = draw_arrows(axes, errors, right, up)
            axes.set_title(f"{title}, {view}, arrows ×{scale:.0f}")
        figure.colorbar(arrows, ax=list(line), label="error, mm")
    return png_of(figure)


def draw_arrows(axes: Any, errors: Sequence[PoseError], right: int, up: int) -> tuple[Any, float]:
    """Draw the errors as arrows into matplotlib's ``axes``.

    Args:
        axes: Where to draw.
        errors: The errors.
        right: World axis to the right.
        up: World axis upwards.

    Returns:
        The arrows, and the factor by which they are longer than the errors.
    """
    plane = [right, up]
    positions = 1e3 * np.array([error.position for error in errors])
    vectors = 1e3 * np.array([error.vector for error in errors])
    lengths = np.linalg.norm(vectors, axis=1)
    longest = max(float(lengths.max()), _MIN_LENGTH)
    scale = _LONGEST_ARROW * float(np.ptp(positions, axis=0).max()) / longest
    arrows = axes.quiver(
        *positions[:, plane].T,
        *vectors[:, plane].T,
        lengths,
        angles="xy",
        scale_units="xy",
        scale=1.0 / max(scale, _MIN_LENGTH),
        cmap="viridis",
        width=0.005,
    )
    arrows.set_clim(0.0, float(lengths.max()))
    axes.plot(*positions[:, plane].T, ".", color="#999999", markersize=4, zorder=0)
    # The origin of the world: the base of the arm.
    axes.plot(0.0, 0.0, "s", color="#444444", markersize=8)
    # matplotlib ignores the tips of arrows when it chooses the limits.
    axes.update_datalim((positions + scale * vectors)[:, plane])
    axes.autoscale_view()
    axes.set_xlabel(f"{_AXES[right]}, mm")
    axes.set_ylabel(f"{_AXES[up]}, mm")
    axes.set_aspect("equal", adjustable="datalim")
    return arrows, scale


def _rms(values: np.typing.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
