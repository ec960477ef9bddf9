"""S12's table as a picture (needs the extra ``plots``)."""

from __future__ import annotations

import importlib.util
import io
from typing import Any

import numpy as np

from robot_ik.errors import MissingExtraError
from robot_ik.jobs.experiments import s12
from robot_ik.jobs.experiments.s12 import Case, S12Report

# Grey for what is quoted, two blues for what is measured.
_COLOURS = {"S12": "#9a9a9a", "same": "#9ecae1", "best": "#08519c"}
_TITLES = {"S12": "S12, 2012", "same": "his parameters, here", "best": "our parameters"}
_DPI = 110


def require_plots() -> None:
    """Raises ``MissingExtraError`` unless matplotlib is installed; asked before any long work."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("matplotlib", "plots", "drawing the table")


def s12_picture(report: S12Report) -> bytes:
    """PNG: share solved and time per solve, for each case and method, his and ours.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 6.4), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(s12.CASES), sharex=True, sharey="row")
    for column, case in enumerate(s12.CASES):
        _draw(axes[:, column], report, case)
    axes[0, 0].set_ylabel("solved, %")
    axes[1, 0].set_ylabel("time per solve, ms")
    figure.suptitle(f"S12, table 4.1: {report.frames} frames, within {100 * s12.TOLERANCE.position:g} cm")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw(axes: Any, report: S12Report, case: Case) -> None:
    """One case: the upper axes get η, the lower t."""
    methods = s12.BEST_METHODS
    for place, kind in enumerate(("S12", "same", "best")):
        at, solved, times = [], [], []
        for k, name in enumerate(methods):
            cell = _cell(report, kind, name, case)
            if cell is not None:
                at.append(k + 0.27 * (place - 1) if name in s12.HIS else k)  # one bar alone: in the middle
                solved.append(cell[1])
                times.append(cell[0])
        style = {"width": 0.25, "color": _COLOURS[kind], "label": _TITLES[kind]}
        # A bar of nothing would look like a missing one: 0 % gets a sliver.
        axes[0].bar(at, np.maximum(solved, 0.7), **style)
        axes[1].bar(at, times, **style)
    axes[0].set_title(f"{case.number}: {case.title}")
    axes[0].set_ylim(0.0, 105.0)
    axes[1].set_yscale("log")
    axes[1].set_xticks(range(len(methods)), methods, rotation=35, ha="right", rotation_mode="anchor")
    for axis in axes:
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)


def _cell(report: S12Report, kind: str, name: str, case: Case) -> tuple[float, float] | None:
    """(ms, %) of a method, or None where there is no such number."""
    if kind == "S12":
        return (
            (s12.HIS[name][case.number - 1][0], s12.HIS[name][case.number - 1][2])
            if name in s12.HIS
            else None
        )
    track = report.tracks.get((kind, name, case.number))
    return None if track is None else (track.milliseconds, 100.0 * track.share)
