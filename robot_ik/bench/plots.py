"""Pictures of a benchmark: success against time, convergence, and growth with joints and goals."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.bench.results import Cell, Curve, Results
from robot_ik.errors import MissingExtraError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 110
# Twelve methods need more than ten colours: the dashes change when the colours start again.
_COLOURS = ("#1f4e79", "#d1495b", "#2e8b57", "#edae49", "#7d5ba6", "#00798c", "#a05c2c", "#666666")
_DASHES = ("-", "--", ":")

Style = Callable[[str], dict[str, Any]]


def need_matplotlib() -> None:
    """Raises ``MissingExtraError`` unless plots can be drawn: asked before a long run, not after it."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plots", "drawing the plots") from error


def draw(results: Results) -> dict[str, bytes]:
    """PNG files by name: what these results have something to show for.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    need_matplotlib()
    style = _styles(
        [c.solver for c in results.cells]
        + [c.solver for c in results.curves]
        + [g.solver for g in results.growth]
    )
    pictures: dict[str, bytes] = {}
    measured = [cell for cell in results.cells if cell.count and cell.set != "unreachable"]
    for robot in _in_order(cell.robot for cell in measured):
        pictures[f"success-{robot}.png"] = _success([c for c in measured if c.robot == robot], style)
    for robot in _in_order(curve.robot for curve in results.curves):
        pictures[f"convergence-{robot}.png"] = _convergence(results, robot, style)
    if results.growth:
        pictures["growth.png"] = _growth(results, style)
    return pictures


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _styles(solvers: Iterable[str]) -> Style:
    places = {name: index for index, name in enumerate(_in_order(solvers))}

    def style(solver: str) -> dict[str, Any]:
        index = places[solver]
        return {
            "color": _COLOURS[index % len(_COLOURS)],
            "linestyle": _DASHES[index // len(_COLOURS) % len(_DASHES)],
            "linewidth": 1.6,
            "label": solver,
        }

    return style


def _figure(columns: int, width: float, height: float, rows: int = 1) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    flat = [one for line in axes for one in line]
    for one in flat:
        one.grid(True, which="major", color="#dddddd", linewidth=0.6)
        one.set_axisbelow(True)
    return figure, flat


def _png(figure: Figure, axes: list[Axes]) -> bytes:
    lines = {line.get_label(): line for one in axes for line in one.get_lines()}
    shown = {str(name): line for name, line in lines.items() if not str(name).startswith("_")}
    figure.legend(list(shown.values()), list(shown), loc="outside right upper", frameon=False, fontsize=9)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


def _success(cells: list[Cell], style: Style) -> bytes:
    """For each set: the share of problems solved within a time."""
    sets = _in_order(cell.set for cell in cells)
    columns = min(2, len(sets))
    rows = -(-len(sets) // columns)
    figure, axes = _figure(columns, 4.6 * columns + 1.4, 3.1 * rows + 0.4, rows)
    figure.suptitle(f"{cells[0].robot}: share of problems solved within a time")
    for one, name in zip(axes, sets, strict=False):
        for cell in (c for c in cells if c.set == name):
            good = np.array(cell.success, dtype=bool)
            times = np.sort(np.array(cell.microseconds)[good])
            share = 100.0 * np.arange(1, len(times) + 1) / cell.count
            if len(times):
                one.step(
                    np.append(times, 1e7), np.append(share, share[-1]), where="post", **_labelled(style, cell)
                )
        slowest = max((max(c.microseconds) for c in cells if c.set == name), default=1.0)
        one.set(xscale="log", ylim=(0, 103), xlabel="time of the whole Python call, µs", ylabel="solved, %")
        one.set_xlim(right=2.0 * slowest)
        one.set_title(name, fontsize=10)
    for one in axes[len(sets) :]:
        one.set_axis_off()
    return _png(figure, axes)


def _labelled(style: Style, cell: Cell | Curve) -> dict[str, Any]:
    """The style of a cell's method, which says so if it was asked for the position only."""
    label = cell.solver + (" (position)" if cell.goal == "position" else "")
    return style(cell.solver) | {"label": label}


def _convergence(results: Results, robot: str, style: Style) -> bytes:
    figure, axes = _figure(1, 7.4, 4.0)
    for curve in (c for c in results.curves if c.robot == robot):
        steps = np.arange(1, len(curve.miss) + 1)
        axes[0].plot(steps, np.maximum(np.array(curve.miss, dtype=float), 1e-10), **_labelled(style, curve))
    axes[0].axhline(results.settings.position_tolerance, color="#999999", linewidth=0.8)
    axes[0].set(
        xscale="log",
        yscale="log",
        xlabel="step (a sweep or pass for ccd and the methods of bones)",
        ylabel="position miss of the best so far, m",
        title=f"{robot}, cold: median over problems; grey: the tolerance",
    )
    return _png(figure, axes)


def _growth(results: Results, style: Style) -> bytes:
    kinds = _in_order(point.across for point in results.growth)
    figure, axes = _figure(len(kinds), 4.4 * len(kinds) + 1.4, 3.8)
    titles = {"joints": "chains of hinges, one goal at the tip", "goals": "humanoid, position goals"}
    for one, across in zip(axes, kinds, strict=True):
        points = [point for point in results.growth if point.across == across]
        for solver in _in_order(point.solver for point in points):
            mine = [point for point in points if point.solver == solver]
            one.plot(
                [p.size for p in mine], [p.step_us for p in mine], marker="o", markersize=4, **style(solver)
            )
        one.set(xlabel=across, ylabel="one step, µs", yscale="log", title=titles[across])
        sizes = sorted({point.size for point in points})
        if across == "joints":
            one.set_xscale("log")
        one.set_xticks(sizes, [str(size) for size in sizes])
        one.minorticks_off()
    return _png(figure, axes)
