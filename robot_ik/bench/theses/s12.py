"""S12's table 4.1 on an arm of seven segments: its numbers beside those of this library.

K. Šimunić, *Interactive inverse kinematic model*, FER Zagreb 2012.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robot_ik.bench.theses.tracking import SCHEMA, Track, track
from robot_ik.budget import Budget
from robot_ik.goals import PositionGoal, Tolerance
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import Solver
from robot_ik.theses.table_4_1 import (
    ALPHA,
    CASES,
    DISTANCE,
    ITERATIONS,
    METHODS,
    SEGMENTS,
    THESIS_CELLS,
    ArmCase,
    iterations_of,
    make_arm,
    method_options,
)
from robot_ik.workcell.progress import Progress, share_of
from robot_ik.workcell.results import png_of, require_plots

TOLERANCE = Tolerance(position=DISTANCE, angle=1e-3)
"""Tolerance of a success."""

FRAMES = 1000
"""Frames of a case."""

LAP = 1000
"""Frames of a lap of the curve."""

BEND_DEG = 20.0
"""Mean bend of joints 2 to 7 along the curve, degrees."""

WAVE_DEG = 10.0
"""Amplitude of their bend, degrees."""

WAVES = 3
"""Waves of their bend in a lap."""

IN_DEGREES = ALPHA * 180.0 / math.pi
"""α if the steps of the thesis are in radians and are nowhere else converted to degrees."""

MUST_PASS = ("lm", "auto")
"""Methods that must reach every target with our parameters."""

BEST_METHODS = (*METHODS, *MUST_PASS)

VARIANTS = {"same": METHODS, "degrees": METHODS[1:], "best": BEST_METHODS}
"""Choices of the parameters, and the methods that are run with them."""

COLUMNS = {
    "S12": "S12, 2012",
    "same": "its parameters",
    "degrees": "α in degrees",
    "best": "our parameters",
}
"""Titles of the columns of the table."""

_COLOURS = {"S12": "#9a9a9a", "same": "#9ecae1", "best": "#08519c"}
"""Colours of the columns in the picture: grey for quoted numbers, blue for measured ones."""

_DPI = 110
"""Resolution of the picture."""

_LEAST_BAR = 0.7
"""Per cent. Smallest height of a bar. A bar of zero height would look like a missing bar."""


@dataclass(eq=False)
class S12Report:
    """Results so far. They are written while the job runs.

    Attributes:
        frames: Frames of a case.
        seed: Seed of targets and restarts.
        tracks: Results by (variant, method, case number).
        complete: Whether everything was run.
    """

    frames: int = FRAMES
    seed: int = 0
    tracks: dict[tuple[str, str, int], Track] = field(default_factory=dict)
    complete: bool = False

    @property
    def failures(self) -> list[tuple[str, int]]:
        """Pairs (solver, case) that must reach every target and did not."""
        return [
            (name, case)
            for (variant, name, case), track in self.tracks.items()
            if variant == "best" and name in MUST_PASS and not track.passed
        ]

    @property
    def passed(self) -> bool:
        """Whether ``lm`` and ``auto`` reached every target with our parameters."""
        return self.complete and not self.failures


def make_witnesses(arm: Robot, case: ArmCase, frames: int, seed: int) -> Array:
    """Return joint angles (frames, nq) inside the limits of ±45°. Their tips are the targets."""
    if case.curve:
        return np.array([_curve(arm, k / LAP) for k in range(frames)])
    rng = np.random.default_rng([seed, case.number])
    return np.array([arm.sample(rng) for _ in range(frames)])


def _curve(arm: Robot, lap: float) -> Array:
    """Return joint angles (nq,): segment 1 twists once in a lap, the other six bend in waves."""
    q = dict.fromkeys(arm.joints, 0.0)
    q["joint1_twist"] = math.remainder(2.0 * math.pi * lap, 2.0 * math.pi)
    for k in range(2, SEGMENTS + 1):
        wave = WAVE_DEG * math.sin(2.0 * math.pi * WAVES * lap)
        q[f"joint{k}_x"] = math.radians(BEND_DEG + wave)
    return np.array([q[name] for name in arm.joints])


def make_method(variant: str, name: str) -> Solver:
    """Return a method with the parameters of a variant (``VARIANTS``)."""
    if variant == "best":
        return make_solver(name)
    alpha = ALPHA if variant == "same" else IN_DEGREES
    return make_solver(name, **method_options(name, alpha))


def no_progress(_phase: str, _share: float) -> None:
    """Show no progress."""


def run_s12(report: S12Report, progress: Progress = no_progress) -> S12Report:
    """Run all cases and write the results into a report."""
    jobs = len(CASES) * sum(map(len, VARIANTS.values()))
    done = 0
    for case in CASES:
        arm = make_arm(case.limited)
        witnesses = make_witnesses(arm, case, report.frames, report.seed)
        targets = [arm.forward(q) for q in witnesses]
        for variant, methods in VARIANTS.items():
            budget = None if variant == "best" else Budget(iterations=ITERATIONS, restarts=0)
            for name in methods:
                phase = f"case {case.number}: {name}, {COLUMNS[variant]}"
                show = share_of(progress, phase, done, jobs)
                goal = PositionGoal("tip", targets[0].position)
                problem = Problem(
                    arm,
                    goal,
                    solver=make_method(variant, name),
                    tolerance=TOLERANCE,
                    budget=budget,
                    seed=report.seed,
                )
                result = track(problem, targets, witnesses[0], show)
                report.tracks[variant, name, case.number] = result
                done += 1
    report.complete = True
    return report


def s12_summary(report: S12Report) -> dict[str, Any]:
    """Return the content of ``s12.json``: metres, shares of 1, milliseconds."""
    return {
        "schema": SCHEMA,
        "experiment": "s12",
        "complete": report.complete,
        "passed": report.passed,
        "seed": report.seed,
        "frames": report.frames,
        "tolerance_position_m": TOLERANCE.position,
        "must_pass": MUST_PASS,
        "cases": [{"case": case.number, "title": case.title} for case in CASES],
        "tracks": [
            {"parameters": column, "method": name, "case": number} | cell
            for (column, name, number), cell in s12_cells(report).items()
        ],
    }


def s12_cells(report: S12Report) -> dict[tuple[str, str, int], dict[str, float]]:
    """Return the numbers of the thesis and ours, by (column, method, case): t (ms), N, η."""
    quoted = {
        ("S12", name, number): {"milliseconds": t, "n": n, "solved": eta / 100.0}
        for name, cells in THESIS_CELLS.items()
        for number, (t, n, eta) in enumerate(cells, 1)
    }
    return quoted | {
        key: {
            "milliseconds": result.milliseconds,
            "n": iterations_of(key[1], result.iterations),
            "solved": result.share,
        }
        for key, result in report.tracks.items()
    }


def s12_picture(report: S12Report) -> bytes:
    """Return a PNG with the share solved and the time per solve, by case and method.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_plots("drawing the table")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 6.4), dpi=_DPI, layout="constrained")
    axes = figure.subplots(2, len(CASES), sharex=True, sharey="row")
    for column, case in enumerate(CASES):
        _draw(axes[:, column], report, case)
    axes[0, 0].set_ylabel("solved, %")
    axes[1, 0].set_ylabel("time per solve, ms")
    centimetres = 100 * TOLERANCE.position
    figure.suptitle(f"S12, table 4.1: {report.frames} frames, within {centimetres:g} cm")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    return png_of(figure)


def _draw(axes: Any, report: S12Report, case: ArmCase) -> None:
    """Draw one case into two axes: η above, t below."""
    methods = BEST_METHODS
    cells = s12_cells(report)
    for index, kind in enumerate(_COLOURS):
        positions = []
        solved = []
        times = []
        for k, name in enumerate(methods):
            cell = cells.get((kind, name, case.number))
            if cell is None:
                continue
            # A single bar is in the middle.
            positions.append(k + 0.27 * (index - 1) if name in THESIS_CELLS else k)
            solved.append(100.0 * cell["solved"])
            times.append(cell["milliseconds"])
        style = {"width": 0.25, "color": _COLOURS[kind], "label": COLUMNS[kind]}
        axes[0].bar(positions, np.maximum(solved, _LEAST_BAR), **style)
        axes[1].bar(positions, times, **style)
    axes[0].set_title(f"{case.number}: {case.title}")
    axes[0].set_ylim(0.0, 105.0)
    axes[1].set_yscale("log")
    ticks = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
    axes[1].set_xticks(range(len(methods)), methods, **ticks)
    for axis in axes:
        axis.grid(axis="y", alpha=0.3)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
