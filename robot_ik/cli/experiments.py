"""``robot-ik experiments``: what the theses tried, tried again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from robot_ik.cli import console
from robot_ik.cli.arguments import Overwrite, Range, require, several, single

if TYPE_CHECKING:
    from robot_ik.bench.theses.a00 import A00Report
    from robot_ik.bench.theses.s12 import S12Report
    from robot_ik.theses.table_4_1 import ArmCase


@dataclass(frozen=True)
class ExperimentsOptions:
    """Repeats the experiments of two theses by stricter rules: all goals are within reach, and MuJoCo judges.

    a00: thirteen courses of chains of ball joints (Aho 2000), every frame to 0.1 mm and 1 mrad; lm, dls, bfgs
    and auto have to meet all. s12: four methods on an arm of seven segments (Simunic 2012), beside his
    numbers; lm and auto have to reach all targets. Ctrl-C keeps what is done.

    Exit code 0: what has to pass passes. 1: it does not. 2: wrong input or environment.
    """

    experiment: Positional[Literal["a00", "s12"]]
    """Which thesis."""
    tests: Annotated[tuple[int, ...], several("N", "1 … 13")] = ()
    """a00: only these tests."""
    solvers: Annotated[tuple[str, ...], several("NAME", "all")] = ()
    """a00: only these methods."""
    frames: Annotated[int | None, single("N", "whole; 1000"), Range(1)] = None
    """a00: no more than so many frames of each course; s12: frames of each case."""
    plot: bool = False
    """s12: draw the table, too (needs matplotlib)."""
    out: Annotated[str, single("DIR", "runs/<time>-<experiment>")] = ""
    """Where the JSON file and the picture go."""
    overwrite: Overwrite = False
    seed: Annotated[int, Range(0)] = 0
    """Of the random targets and of restarts."""


def run(options: ExperimentsOptions) -> int:
    """Runs an experiment; 0 when all that has to pass passes."""
    _check(options)
    from robot_ik.bench.theses import a00, s12
    from robot_ik.files import write_atomically
    from robot_ik.jobs.results import require_plots, results_folder, save_json

    if options.plot:
        require_plots("drawing the table")
    simunic = s12.S12Report(options.frames or s12.FRAMES, options.seed)
    job: Any = s12.run_s12, s12.s12_summary, print_s12, simunic
    if options.experiment == "a00":
        aho = a00.ask_a00(options.tests, options.solvers, options.frames, options.seed)
        job = a00.run_a00, a00.a00_summary, print_a00, aho
    work, summary, show, report = job
    own = [f"{options.experiment}.{kind}" for kind in ("json", "png")]
    with results_folder(options.out, options.experiment, own, overwrite=options.overwrite) as folder:
        try:
            with console.progress() as bar:
                work(report, console.shares_on(bar, options.experiment))
        finally:  # Ctrl-C and SIGTERM as well: what is done is kept, and reported
            save_json(folder / own[0], summary(report))
            if drawn := options.plot and report.complete:
                write_atomically(folder / own[1], s12.s12_picture(report))
            show(report)
            console.result(f"files in {folder}: {'  '.join(own[: 1 + drawn])}")
    return console.DONE if report.passed else console.NOT_ACHIEVED


def _check(options: ExperimentsOptions) -> None:
    """Raises ``ConfigError`` for what makes no sense before anything is built."""
    a00 = options.experiment == "a00"
    which = "--tests" if options.tests else "--solvers"
    require(a00 or not (options.tests or options.solvers), which, "s12 has neither", "with a00 alone")
    require(not (a00 and options.plot), "--plot", "a00 has no picture", "with s12 alone")


# ------------------------------------------------------------------------------------------
# The tables of ``robot-ik experiments`` on the terminal.


#: Stands where there is nothing: a method that does not serve a goal, a cell that is not run.
NOTHING = "-"


def _result(complete: bool, passed: bool, why: str) -> Text:
    if not complete:
        return Text.assemble(("INTERRUPTED", "bold yellow"), "  the tables hold what was done")
    return Text.assemble(("PASSED", "bold green") if passed else ("NOT PASSED", "bold red"), f"  {why}")


# -------------------------------------------------------------------------------------- a00


def print_a00(report: A00Report) -> None:
    """Courses, methods × courses, and whether what has to pass does."""
    from robot_ik.theses.courses import THESIS_RESULTS

    rows = [
        (
            number, len(course.robot.joints), course.goal.name.removesuffix(" goal"), course.moves,
            len(course.at), THESIS_RESULTS[number],
        )
        for number, course in report.courses.items()
    ]  # fmt: skip
    columns = ("test", "joints", "goal", "the goal moves", "frames", "A00's result")
    console.show(
        console.table(*columns, rows=rows),
        "",
        _methods_table(report),
        f"{NOTHING}: the method does not serve such a goal.  Below a share: where the goal was first lost.",
        "",
        _result(report.complete, report.passed, _why_a00(report) if report.complete else ""),
    )


def _why_a00(report: A00Report) -> str:
    from robot_ik.bench.theses import a00

    asked = [name for name in a00.MUST_PASS if name in report.solvers]
    if report.failures:
        losses = (
            f"{name} in test {k}: "
            + ("refused" if report.tracks[name, k].refused else f"lost at {report.lost_at(name, k)}")
            for name, k in report.failures
        )
        return "; ".join(losses)
    if not asked:
        return "no method was asked for that has to pass"
    return f"{', '.join(asked)} met every frame"


def _methods_table(report: A00Report) -> Table:
    """One row a method, one column a test: % of the frames met, and below it where the goal was lost."""
    rows = [(name, *(_share(report, name, k) for k in report.courses)) for name in report.solvers]
    title = "Frames met in each test, by method"
    shown = console.table("% met", *map(str, report.courses), rows=rows, title=title)
    for column in shown.columns[1:]:
        column.justify = "right"
    return shown


def _share(report: A00Report, name: str, number: int) -> Text:
    track = report.tracks.get((name, number))
    if track is None:
        return Text("")
    if track.refused:
        return Text(NOTHING, style="dim")
    if track.passed:
        return Text("100", style="green")
    # Rounded down: what is not whole must not look whole.
    return Text(f"{100 * track.solved // track.frames}\n{report.lost_at(name, number)}", style="red")


# -------------------------------------------------------------------------------------- s12


def print_s12(report: S12Report) -> None:
    """His table and ours, what differs, and whether what has to pass does."""
    from robot_ik.bench.theses import s12
    from robot_ik.theses.table_4_1 import CASES

    for case in CASES:
        console.show(_case_table(report, case), "")
    console.show("t: mean time of a solve, ms.  N: mean number of steps.  η: % of the frames solved.", "")
    if report.failures:
        why = "; ".join(
            f"{n} in case {k}: {100.0 * report.tracks['best', n, k].share:.1f} %" for n, k in report.failures
        )
    else:
        why = f"{' and '.join(s12.MUST_PASS)} reached every target of every case"
    console.show(_result(report.complete, report.passed, why))


def _case_table(report: S12Report, case: ArmCase) -> Table:
    from robot_ik.bench.theses import s12

    title, cells = f"Case {case.number}: {case.title}, {report.frames} frames", s12.s12_cells(report)
    rows = [
        (name, *(_cell(cells.get((column, name, case.number))) for column in s12.COLUMNS))
        for name in s12.BEST_METHODS
    ]
    columns = ("", *(f"{head}\n{'t':>5} {'N':>3} {'η':>3}" for head in s12.COLUMNS.values()))
    shown = console.table(*columns, rows=rows, title=title)
    for column in shown.columns:
        column.no_wrap = True
    return shown


def _cell(cell: Mapping[str, float] | None) -> str:
    if cell is None:
        return NOTHING
    milliseconds, solved = cell["milliseconds"], math.floor(round(100.0 * cell["solved"], 6))
    time = f"{milliseconds:5.3f}" if milliseconds < 1.0 else f"{milliseconds:5.1f}"
    # Rounded down: what is not whole must not look whole.
    return f"{time} {cell['n']:3.0f} {solved:3d}"
