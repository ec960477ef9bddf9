"""The error map of an arm as a picture: from above and from the side, as it is and corrected."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.calibration.kinematic import PoseError
from robot_ik.errors import MissingExtraError
from robot_ik.jobs.arm_camera.verify import VerifyReport

Array = NDArray[np.float64]

_DPI = 100
# World axes across and up of each view.
_VIEWS = (("from above", 0, 1), ("from the side", 0, 2))
# The longest arrow, as a share of the space that the poses take.
_LONGEST = 0.25


def require_plots() -> None:
    """Raises ``MissingExtraError`` unless matplotlib is installed; asked before the arm moves."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plots", "drawing the errors")


def error_picture(report: VerifyReport) -> bytes:
    """PNG: an arrow for each pose, in each row of the same scale and colours; no OpenGL.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [("as it is", report.judged(corrected=False))]
    if report.fit is not None:
        rows.append(("with new zeros", report.judged(corrected=True)))
    figure = Figure(figsize=(10.0, 4.4 * len(rows)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), len(_VIEWS), squeeze=False)
    for line, (title, errors) in zip(grid, rows, strict=True):
        for axes, (view, across, up) in zip(line, _VIEWS, strict=True):
            arrows, scale = _draw(axes, errors, across, up)
            axes.set_title(f"{title}, {view}, arrows ×{scale:.0f}")
        figure.colorbar(arrows, ax=list(line), label="off by, mm")
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw(axes: Any, errors: Sequence[PoseError], across: int, up: int) -> tuple[Any, float]:
    places = 1e3 * np.array([one.place for one in errors])
    vectors = 1e3 * np.array([one.vector for one in errors])
    length = np.linalg.norm(vectors, axis=1)
    scale = _LONGEST * float(np.ptp(places, axis=0).max()) / max(float(length.max()), 1e-9)
    arrows = axes.quiver(
        places[:, across], places[:, up], vectors[:, across], vectors[:, up], length,
        angles="xy", scale_units="xy", scale=1.0 / max(scale, 1e-9), cmap="viridis", width=0.005,
    )  # fmt: skip
    arrows.set_clim(0.0, float(length.max()))
    axes.plot(places[:, across], places[:, up], ".", color="#999999", markersize=4, zorder=0)
    axes.plot(0.0, 0.0, "s", color="#444444", markersize=8)  # the origin of the world: the arm's base
    axes.set_xlabel(f"{'xyz'[across]}, mm")
    axes.set_ylabel(f"{'xyz'[up]}, mm")
    axes.set_aspect("equal", adjustable="datalim")
    return arrows, scale
