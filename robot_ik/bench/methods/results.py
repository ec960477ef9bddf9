"""What a benchmark found, as data: one JSON file; ``Results.model_validate_json`` reads it back."""

from __future__ import annotations

import itertools
import os
import platform
import time
import timeit
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from robot_ik.batch import usable_cores
from robot_ik.errors import DISTRIBUTION
from robot_ik.jobs.results import png_of, require_plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: A larger step of a joint between two warm solutions is a jump to another branch, rad.
JUMP = 0.2


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Machine(_Data):
    """Where it was measured.

    Attributes:
        calibration_us: Median time of a fixed loop of plain Python: shows how fast, and how busy, it was.
        load: Load average of the last minute at the start.
    """

    system: str
    processor: str
    cores: int
    python: str
    versions: dict[str, str]
    calibration_us: float
    load: float
    when: str


class Settings(_Data):
    """What was asked; with the machine, all that is needed to do it again."""

    command: str
    count: int
    seed: int
    position_tolerance: float
    angle_tolerance: float
    seconds: float


class Cell(_Data):
    """One solver on one problem set of one robot.  Lists have one number for each problem solved.

    Attributes:
        goal: ``pose`` or ``position``: what was asked of the frame.
        asked: Problems in the set; fewer in the lists where time ran out or it was interrupted.
        skipped: Why nothing was measured; empty otherwise.
        microseconds: Whole Python calls: 4×4 matrix in, joint array out.
        success: By MuJoCo's forward pass within tolerance, and inside the model's joint ranges.
        position_error, angle_error: By MuJoCo, metres and radians; 0 for a part that was not asked for.
        status: What the solver said, names of ``Status``.
        largest_step: Largest change of a joint between solutions (warm only), rad or m.
        jumps: Changes above ``JUMP`` (warm only).
    """

    solver: str
    robot: str
    set: str
    goal: str = "pose"
    asked: int = 0
    skipped: str = ""
    microseconds: list[float] = []
    success: list[bool] = []
    position_error: list[float] = []
    angle_error: list[float] = []
    iterations: list[int] = []
    restarts: list[int] = []
    status: list[str] = []
    largest_step: float = 0.0
    jumps: int = 0

    @property
    def count(self) -> int:
        return len(self.microseconds)

    @property
    def rate(self) -> float:
        """Share of them that succeeded, 0 … 1."""
        return sum(self.success) / self.count if self.count else 0.0

    def microsecond(self, which: Literal["mean", "median"] | float) -> float:
        """Mean, median or a percentile (a number) of the times, µs; NaN when there are none."""
        if not self.count:
            return float("nan")
        if which == "mean":
            return float(np.mean(self.microseconds))
        return float(np.percentile(self.microseconds, 50.0 if which == "median" else which))


class Curve(_Data):
    """How a method closed in: median over problems of the position error (m) at its best point so far."""

    solver: str
    robot: str
    goal: str
    error: list[float]


class LowerBound(_Data):
    """Cost of the kinematics alone, measured in a compiled loop, µs."""

    robot: str
    joints: int
    forward_us: float
    jacobian_us: float


class Growth(_Data):
    """Cost of one step of a method; ``across`` says what grows: joints or goals."""

    solver: str
    across: Literal["joints", "goals"]
    size: int
    step_us: float


class Batch(_Data):
    """Many poses by one call of ``solve_batch``."""

    solver: str
    robot: str
    poses: int
    threads: int
    per_second: float
    success: float


class Results(_Data):
    """Everything of one run.

    Attributes:
        schema_version: Of the file; raised when a field changes its meaning.
        complete: Whether it ran to its end.
    """

    schema_version: Literal[1] = 1
    complete: bool = False
    machine: Machine
    settings: Settings
    cells: list[Cell] = []
    curves: list[Curve] = []
    lower_bounds: list[LowerBound] = []
    growth: list[Growth] = []
    batches: list[Batch] = []


def this_machine() -> Machine:
    """The machine, and how fast it is just now."""
    packages = (DISTRIBUTION, "mujoco", "numpy", "numba")
    return Machine(
        system=f"{platform.system()} {platform.machine()}",
        processor=_processor(),
        cores=usable_cores(),
        python=platform.python_version(),
        versions={name: metadata.version(name) for name in packages},
        calibration_us=round(calibration(), 1),
        load=round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else 0.0,
        when=time.strftime("%Y-%m-%d %H:%M"),
    )


def calibration() -> float:
    """Return the median time of a fixed loop of plain Python, µs: the speed and load of the machine."""
    loop = "for i in range(20_000): total += (i * 0.5) ** 0.5"
    return 1e6 * float(np.median(timeit.repeat(loop, "total = 0.0", number=1, repeat=9)))


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


# ------------------------------------------------------------------------------------------
# Pictures of a benchmark: success against time, convergence, and growth with joints and goals.


_DPI = 110
# Twelve methods need more than ten colours: the dashes change when the colours start again.
_COLOURS = ("#1f4e79", "#d1495b", "#2e8b57", "#edae49", "#7d5ba6", "#00798c", "#a05c2c", "#666666")
_DASHES = ("-", "--", ":")

Style = dict[str, dict[str, Any]]


def draw(results: Results) -> dict[str, bytes]:
    """PNG files by name: what these results have something to show for.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("drawing the plots")
    found: list[Cell | Curve | Growth] = [*results.cells, *results.curves, *results.growth]
    style = _styles(one.solver for one in found)
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
    pairs = itertools.cycle(itertools.product(_DASHES, _COLOURS))
    return {
        name: {"color": colour, "linestyle": dashes, "linewidth": 1.6, "label": name}
        for name, (dashes, colour) in zip(_in_order(solvers), pairs, strict=False)
    }


def _figure(columns: int, width: float, height: float, rows: int = 1) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    flat = [one for line in axes for one in line]
    for one in flat:
        one.grid(True, which="major", color="#dddddd", linewidth=0.6)
        one.set_axisbelow(True)
    return figure, flat


def _png(figure: Figure, axes: list[Axes]) -> bytes:
    lines = {line.get_label(): line for one in axes for line in one.get_lines()}
    shown = {str(name): line for name, line in lines.items() if not str(name).startswith("_")}
    figure.legend(list(shown.values()), list(shown), loc="outside right center", frameon=False, fontsize=9)
    return png_of(figure)


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
        one.xaxis.set_minor_formatter("")  # over one decade their labels overlap
        one.set_title(name, fontsize=10)
    for one in axes[len(sets) :]:
        one.set_axis_off()
    return _png(figure, axes)


def _labelled(style: Style, cell: Cell | Curve) -> dict[str, Any]:
    """The style of a cell's method, which says so if it was asked for the position only."""
    label = cell.solver + (" (position)" if cell.goal == "position" else "")
    return style[cell.solver] | {"label": label}


def _convergence(results: Results, robot: str, style: Style) -> bytes:
    figure, axes = _figure(1, 7.4, 4.0)
    for curve in (c for c in results.curves if c.robot == robot):
        steps = np.arange(1, len(curve.error) + 1)
        axes[0].plot(steps, np.maximum(np.array(curve.error, dtype=float), 1e-10), **_labelled(style, curve))
    axes[0].axhline(results.settings.position_tolerance, color="#999999", linewidth=0.8)
    axes[0].set(
        xscale="log",
        yscale="log",
        xlabel="step (a sweep of ccd, a pass of fabrik and triangulation)",
        ylabel="position error of the best so far, m",
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
                [p.size for p in mine], [p.step_us for p in mine], marker="o", markersize=4, **style[solver]
            )
        one.set(xlabel=across, ylabel="one step, µs", yscale="log", title=titles[across])
        sizes = sorted({point.size for point in points})
        if across == "joints":
            one.set_xscale("log")
        one.set_xticks(sizes, [str(size) for size in sizes])
        one.minorticks_off()
    return _png(figure, axes)
