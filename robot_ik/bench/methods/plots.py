"""Plots of a benchmark: success against time, convergence, and growth with joints and goals."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.bench.methods.results import Cell, Curve, Growth, Results
from robot_ik.workcell.results import png_of, require_plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 110
"""Resolution of the plots."""

_COLOURS = (
    "#1f4e79",
    "#d1495b",
    "#2e8b57",
    "#edae49",
    "#7d5ba6",
    "#00798c",
    "#a05c2c",
    "#666666",
)
"""Colours of the methods."""

_DASHES = ("-", "--", ":")
"""Line styles of the methods. They change when the colours start again."""

_LEAST_ERROR = 1e-10
"""Metres. Smaller errors are drawn here on the logarithmic axis."""

Style = dict[str, dict[str, Any]]
"""Arguments of matplotlib's lines, by method."""


def draw(results: Results) -> dict[str, bytes]:
    """Return PNG files by name, for the parts that these results have.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("drawing the plots")
    parts: list[Cell | Curve | Growth] = [*results.cells, *results.curves, *results.growth]
    style = _styles(part.solver for part in parts)
    pictures: dict[str, bytes] = {}
    measured = [cell for cell in results.cells if cell.count and cell.set != "unreachable"]
    for robot in _in_order(cell.robot for cell in measured):
        cells = [cell for cell in measured if cell.robot == robot]
        pictures[f"success-{robot}.png"] = _success(cells, style)
    for robot in _in_order(curve.robot for curve in results.curves):
        pictures[f"convergence-{robot}.png"] = _convergence(results, robot, style)
    if results.growth:
        pictures["growth.png"] = _growth(results, style)
    return pictures


def _in_order(names: Iterable[str]) -> list[str]:
    """Return the different names in the order in which they come."""
    return list(dict.fromkeys(names))


def _styles(solvers: Iterable[str]) -> Style:
    """Return a style for each method."""
    pairs = itertools.cycle(itertools.product(_DASHES, _COLOURS))
    return {
        name: {"color": colour, "linestyle": dashes, "linewidth": 1.6, "label": name}
        for name, (dashes, colour) in zip(_in_order(solvers), pairs, strict=False)
    }


def _figure(columns: int, width: float, height: float, rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of a size in inches, and its axes row by row."""
    from matplotlib.figure import Figure  # optional dependency

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    axes = [panel for row in grid for panel in row]
    for panel in axes:
        panel.grid(True, which="major", color="#dddddd", linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, axes


def _png(figure: Figure, axes: list[Axes]) -> bytes:
    """Return the PNG of a figure with one legend for all axes."""
    lines = {str(line.get_label()): line for panel in axes for line in panel.get_lines()}
    named = {name: line for name, line in lines.items() if not name.startswith("_")}
    figure.legend(
        list(named.values()), list(named), loc="outside right center", frameon=False, fontsize=9
    )
    return png_of(figure)


def _success(cells: list[Cell], style: Style) -> bytes:
    """Draw, for each set, the share of problems that are solved within a time."""
    sets = _in_order(cell.set for cell in cells)
    columns = min(2, len(sets))
    rows = -(-len(sets) // columns)
    figure, axes = _figure(columns, 4.6 * columns + 1.4, 3.1 * rows + 0.4, rows)
    figure.suptitle(f"{cells[0].robot}: share of problems solved within a time")
    for panel, name in zip(axes, sets, strict=False):
        of_set = [cell for cell in cells if cell.set == name]
        for cell in of_set:
            times = np.sort(np.array(cell.microseconds)[np.array(cell.success, dtype=bool)])
            share = 100.0 * np.arange(1, len(times) + 1) / cell.count
            if len(times):
                x = np.append(times, 1e7)
                y = np.append(share, share[-1])
                panel.step(x, y, where="post", **_labelled(style, cell))
        slowest = max((max(cell.microseconds) for cell in of_set), default=1.0)
        panel.set(xscale="log", ylim=(0, 103))
        panel.set(xlabel="time of the whole Python call, µs", ylabel="solved, %")
        panel.set_xlim(right=2.0 * slowest)
        panel.xaxis.set_minor_formatter("")  # these labels overlap within one decade
        panel.set_title(name, fontsize=10)
    for panel in axes[len(sets) :]:
        panel.set_axis_off()
    return _png(figure, axes)


def _labelled(style: Style, part: Cell | Curve) -> dict[str, Any]:
    """Return the style of a method. The label tells if the goal was the position only."""
    label = part.solver + (" (position)" if part.goal == "position" else "")
    return style[part.solver] | {"label": label}


def _convergence(results: Results, robot: str, style: Style) -> bytes:
    """Draw the error of the best point so far against the steps."""
    figure, axes = _figure(1, 7.4, 4.0)
    panel = axes[0]
    for curve in results.curves:
        if curve.robot == robot:
            steps = np.arange(1, len(curve.error) + 1)
            error = np.maximum(np.array(curve.error, dtype=float), _LEAST_ERROR)
            panel.plot(steps, error, **_labelled(style, curve))
    panel.axhline(results.settings.position_tolerance, color="#999999", linewidth=0.8)
    panel.set(
        xscale="log",
        yscale="log",
        xlabel="step (a sweep of ccd, a pass of fabrik and triangulation)",
        ylabel="position error of the best so far, m",
        title=f"{robot}, cold: median over problems; grey: the tolerance",
    )
    return _png(figure, axes)


def _growth(results: Results, style: Style) -> bytes:
    """Draw the time of a step against the number of joints and of goals."""
    kinds = _in_order(point.across for point in results.growth)
    figure, axes = _figure(len(kinds), 4.4 * len(kinds) + 1.4, 3.8)
    titles = {
        "joints": "chains of hinges, one goal at the tip",
        "goals": "humanoid, position goals",
    }
    for panel, across in zip(axes, kinds, strict=True):
        points = [point for point in results.growth if point.across == across]
        for solver in _in_order(point.solver for point in points):
            of_solver = [point for point in points if point.solver == solver]
            sizes = [point.size for point in of_solver]
            times = [point.step_us for point in of_solver]
            panel.plot(sizes, times, marker="o", markersize=4, **style[solver])
        panel.set(xlabel=across, ylabel="one step, µs", yscale="log", title=titles[across])
        if across == "joints":
            panel.set_xscale("log")
        all_sizes = sorted({point.size for point in points})
        panel.set_xticks(all_sizes, [str(size) for size in all_sizes])
        panel.minorticks_off()
    return _png(figure, axes)
