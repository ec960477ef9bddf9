"""S12's table 4.1 on an arm of seven segments: his numbers, ours with his parameters, ours with our own.

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
from robot_ik.jobs import Progress, share_of
from robot_ik.jobs.results import png_of, require_plots
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

TOLERANCE = Tolerance(position=DISTANCE, angle=1e-3)
FRAMES = 1000
LAP = 1000  # frames for once round the curve
BEND, WAVE, WAVES = 20.0, 10.0, 3  # of joints 2 … 7 along the curve, degrees

IN_DEGREES = ALPHA * 180.0 / math.pi
"""α as a share of a step if his steps come out in radians and are converted to degrees nowhere else."""

MUST_PASS = ("lm", "auto")
BEST_METHODS = (*METHODS, *MUST_PASS)

VARIANTS = {"same": METHODS, "degrees": METHODS[1:], "best": BEST_METHODS}
"""Ways of choosing the parameters, and the methods that are run with them."""
COLUMNS = {
    "S12": "S12, 2012", "same": "his parameters", "degrees": "α in degrees", "best": "our parameters",
}  # fmt: skip
"""Whose numbers stand in a column of the table, and its title."""


@dataclass(eq=False)
class S12Report:
    """What there is so far; filled while the job runs.

    Attributes:
        tracks: How a method fared, by (variant, method, case number).
        complete: All has been run.
    """

    frames: int = FRAMES
    seed: int = 0
    tracks: dict[tuple[str, str, int], Track] = field(default_factory=dict)
    complete: bool = False

    @property
    def failures(self) -> list[tuple[str, int]]:
        """(solver, case) that had to reach every target and did not."""
        return [
            (name, case)
            for (variant, name, case), track in self.tracks.items()
            if variant == "best" and name in MUST_PASS and not track.passed
        ]

    @property
    def passed(self) -> bool:
        """``lm`` and ``auto`` reached every target of every case with our parameters."""
        return self.complete and not self.failures


def make_witnesses(arm: Robot, case: ArmCase, frames: int, seed: int) -> Array:
    """(frames, nq) joint angles inside the limits of ±45°; where they put the tip are the targets."""
    if case.curve:
        return np.array([_curve(arm, k / LAP) for k in range(frames)])
    rng = np.random.default_rng([seed, case.number])
    return np.array([arm.sample(rng) for _ in range(frames)])


def _curve(arm: Robot, lap: float) -> Array:
    """Segment 1 upright and twisted once round in a lap; the six others bent alike, in waves."""
    q = dict.fromkeys(arm.joints, 0.0)
    q["joint1_twist"] = math.remainder(2.0 * math.pi * lap, 2.0 * math.pi)
    for k in range(2, SEGMENTS + 1):
        q[f"joint{k}_x"] = math.radians(BEND + WAVE * math.sin(2.0 * math.pi * WAVES * lap))
    return np.array([q[name] for name in arm.joints])


def make_method(variant: str, name: str) -> Solver:
    """A method with the parameters of a variant (``VARIANTS``)."""
    if variant == "best":
        return make_solver(name)
    return make_solver(name, **method_options(name, ALPHA if variant == "same" else IN_DEGREES))


def run_s12(report: S12Report, progress: Progress = lambda phase, share: None) -> S12Report:
    """Runs all cases and fills the report in."""
    jobs, done = len(CASES) * sum(map(len, VARIANTS.values())), 0
    for case in CASES:
        arm = make_arm(case.limited)
        witnesses = make_witnesses(arm, case, report.frames, report.seed)
        targets = [arm.forward(q) for q in witnesses]
        for variant, methods in VARIANTS.items():
            budget = None if variant == "best" else Budget(iterations=ITERATIONS, restarts=0)
            for name in methods:
                show = share_of(progress, f"case {case.number}: {name}, {COLUMNS[variant]}", done, jobs)
                goal = PositionGoal("tip", targets[0].position)
                problem = Problem(
                    arm,
                    goal,
                    solver=make_method(variant, name),
                    tolerance=TOLERANCE,
                    budget=budget,
                    seed=report.seed,
                )
                report.tracks[variant, name, case.number] = track(problem, targets, witnesses[0], show)
                done += 1
    report.complete = True
    return report


def s12_summary(report: S12Report) -> dict[str, Any]:
    """The content of ``s12.json``: metres, shares of 1, milliseconds."""
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
    """His numbers, then ours, by (column, method, case): t (ms), N, η (share)."""
    his = {
        ("S12", name, number): {"milliseconds": t, "n": n, "solved": eta / 100.0}
        for name, cells in THESIS_CELLS.items()
        for number, (t, n, eta) in enumerate(cells, 1)
    }
    return his | {
        key: {
            "milliseconds": found.milliseconds,
            "n": iterations_of(key[1], found.iterations),
            "solved": found.share,
        }
        for key, found in report.tracks.items()
    }


# ------------------------------------------------------------------------------------------
# S12's table as a picture (needs the extra ``plots``).


# Grey for what is quoted, two blues for what is measured.
_COLOURS = {"S12": "#9a9a9a", "same": "#9ecae1", "best": "#08519c"}
_DPI = 110


def s12_picture(report: S12Report) -> bytes:
    """PNG: share solved and time per solve, for each case and method, his and ours.

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
    figure.suptitle(f"S12, table 4.1: {report.frames} frames, within {100 * TOLERANCE.position:g} cm")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)
    return png_of(figure)


def _draw(axes: Any, report: S12Report, case: ArmCase) -> None:
    """One case: the upper axes get η, the lower t."""
    methods, cells = BEST_METHODS, s12_cells(report)
    for index, kind in enumerate(_COLOURS):
        at, solved, times = [], [], []
        for k, name in enumerate(methods):
            cell = cells.get((kind, name, case.number))
            if cell is not None:
                at.append(
                    k + 0.27 * (index - 1) if name in THESIS_CELLS else k
                )  # one bar alone: in the middle
                solved.append(100.0 * cell["solved"])
                times.append(cell["milliseconds"])
        style = {"width": 0.25, "color": _COLOURS[kind], "label": COLUMNS[kind]}
        # A bar of zero height cannot be told from a missing one: 0 % gets a sliver.
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
