"""Pictures of a reachability map: slices, coloured by a quantity. Needs the extra ``plots``."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.errors import MissingExtraError, OptionError
from robot_ik.geometry import is_real
from robot_ik.reachability.reachability_map import QUANTITIES, ReachabilityMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = {"x": 0, "y": 1, "z": 2}
"""Name of a world axis -> its index. A slice is perpendicular to the axis."""

_WIDTH = 6.0
"""inch."""

_DPI = 110
"""Pixels an inch."""


def draw_slice(
    reach_map: ReachabilityMap, *, across: str = "y", at: float = 0.0, quantity: str = "index"
) -> Figure:
    """Return a figure of the layer of cells that a plane cuts.

    Args:
        reach_map: The map.
        across: World axis that is perpendicular to the slice: "x", "y" or "z".
        at: Coordinate of the plane on this axis, m.
        quantity: One of ``QUANTITIES``.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OptionError: Another axis or quantity, or a plane outside the map.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "plots", "a picture of a map") from None
    if across not in AXES:
        raise OptionError("across", f"{across!r}", ", ".join(AXES))
    axis = AXES[across]
    grid = reach_map.grid
    lower = grid.corner[axis]
    upper = lower + grid.cell * grid.shape[axis]
    if not is_real(at, lower, upper):
        raise OptionError("at", f"{at!r}", f"{lower:g} to {upper:g} m")
    layer = min(int((at - lower) / grid.cell), grid.shape[axis] - 1)
    values = np.take(reach_map.quantity(quantity), layer, axis=axis)
    first, second = (k for k in range(3) if k != axis)
    left = grid.corner[first]
    right = left + grid.cell * grid.shape[first]
    bottom = grid.corner[second]
    top = bottom + grid.cell * grid.shape[second]
    height = 0.8 * _WIDTH * (top - bottom) / (right - left) + 0.6
    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    highest = 1.0 if quantity == "index" else None
    picture = axes.imshow(
        values.T,
        origin="lower",
        extent=(left, right, bottom, top),
        vmin=0.0,
        vmax=highest,
        cmap="viridis",
    )
    axes.set_xlabel(f"{'xyz'[first]}, m")
    axes.set_ylabel(f"{'xyz'[second]}, m")
    center = grid.centers(axis)[layer]
    axes.set_title(
        f"{reach_map.robot.name}, {reach_map.frame}, {across} = {center:.3f} m", fontsize=10
    )
    figure.colorbar(picture, ax=axes, label=QUANTITIES[quantity])
    return figure


def slice_png(
    reach_map: ReachabilityMap, *, across: str = "y", at: float = 0.0, quantity: str = "index"
) -> bytes:
    """Return ``draw_slice`` as a PNG file."""
    stream = io.BytesIO()
    figure = draw_slice(reach_map, across=across, at=at, quantity=quantity)
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
