"""``robot-ik bench``: solvers × robots on seeded problem sets."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    Overwrite,
    Range,
    positive,
    request_of,
    several,
    single,
)
from robot_ik.files import write_atomically
from robot_ik.jobs.results import require_plots, results_folder, save_json

if TYPE_CHECKING:
    from robot_ik.bench.methods.results import Cell, Results
    from robot_ik.bench.methods.runner import Campaign
    from robot_ik.jobs.quantity import Quantity
    from robot_ik.solvers.base import Solver


SetName = Literal["cold", "warm", "singular", "limits", "unreachable", "kernels", "batch"]


_FILES = ("bench.json", "success-*.png", "convergence-*.png", "growth.png")


@dataclass(frozen=True)
class BenchOptions:
    """Times methods on seeded problems and lets MuJoCo judge their solutions.

    A time is that of the whole Python call: 4×4 matrix in, joint array out, limits obeyed. Kernels are
    compiled and warmed up before; collection of garbage is off. Nothing passes or fails by its time.

    Writes bench.json and plots; Ctrl-C keeps what is done.

        robot-ik bench --solvers auto lm --robots puma560 --sets cold warm
    """

    solvers: Annotated[tuple[str, ...], several("NAME", "all")] = ()
    """Methods: see `robot-ik solvers`."""
    robots: Annotated[tuple[str, ...], arg(metavar="NAME|PATH …")] = ("puma560", "ur5e", "panda")
    """Names of `robot-ik robots`, or any MJCF or URDF file."""
    sets: Annotated[
        tuple[SetName, ...], arg(metavar="cold|warm|singular|limits|unreachable|kernels|batch …")
    ] = ("cold", "warm", "singular", "limits", "unreachable")
    """Kinds of problems; kernels: cost of kinematics, growth with joints and goals; batch: solve_batch."""
    count: Annotated[int, Range(1, 100_000, " problems")] = 200
    """Problems in each set; a batch has 500 times as many."""
    seed: int = 0
    """Of problems and restarts: the same seed gives the same problems."""
    position_tolerance: Annotated[float, arg(metavar="M")] = 1e-4
    """Largest distance that still counts as solved, metres."""
    angle_tolerance: Annotated[float, arg(metavar="RAD")] = 1e-3
    """Largest angle that still counts as solved, radians."""
    seconds: Annotated[float, arg(metavar="S"), positive(what=" s")] = 3.0
    """Longest time for one method on one set, seconds; what is left then is not tried."""
    out: Annotated[str, single("FOLDER", "runs/<time>-bench")] = ""
    """Where bench.json and the plots go."""
    overwrite: Overwrite = False
    plots: bool = True
    """Draw plots (needs matplotlib)."""


def run(options: BenchOptions) -> int:
    """Measures, writes and prints."""
    from robot_ik.bench.methods.results import Results, Settings, this_machine
    from robot_ik.bench.methods.runner import Campaign
    from robot_ik.goals import Tolerance
    from robot_ik.robot import load_robot

    solvers, robots = _solvers(options), [load_robot(name) for name in dict.fromkeys(options.robots)]
    Tolerance(options.position_tolerance, options.angle_tolerance)  # refuses what is not positive
    if options.plots:
        require_plots("drawing the plots")
    command = shlex.join(["robot-ik", *sys.argv[1:]]) if sys.argv[1:2] == ["bench"] else "robot-ik bench"
    settings = request_of(Settings, options, command=command)
    with results_folder(options.out, "bench", _FILES, overwrite=options.overwrite) as folder:
        results = Results(machine=this_machine(), settings=settings)
        try:
            _measure(Campaign(solvers, robots, tuple(dict.fromkeys(options.sets)), settings), results)
            results.complete = True
        finally:
            # Ctrl-C and SIGTERM come through here as well: what is done is kept and shown.
            _finish(results, folder, plots=options.plots)
    return console.DONE


def _solvers(options: BenchOptions) -> list[Solver]:
    from robot_ik.solvers import SOLVERS, make_solver

    names = options.solvers or tuple(SOLVERS)
    return [make_solver(name) for name in dict.fromkeys(names)]


def _measure(campaign: Campaign, results: Results) -> None:
    machine = results.machine
    console.say(f"on {machine.processor}, {machine.cores} cores, Python {machine.python}", "dim")
    with console.progress() as bar:
        benches = campaign.prepare(console.shares_on(bar, "preparing"))
    console.say("kernels are ready; Ctrl-C keeps what is done", "dim")
    with console.progress() as bar:
        for note in campaign.measure(benches, results, console.shares_on(bar, "measuring")):
            console.say(note, "dim")


# ------------------------------------------------------------------------------------------ showing


def _finish(results: Results, folder: Path, *, plots: bool) -> None:
    from robot_ik.bench.methods.plots import draw

    results.cells = [cell for cell in results.cells if cell.count or cell.skipped]
    if not (results.cells or results.lower_bounds or results.batches):
        return  # it had not begun
    save_json(folder / "bench.json", results.model_dump(mode="json"))
    print_results(results)
    for name, picture in (draw(results) if plots else {}).items():
        write_atomically(folder / name, picture)
    console.say(f"{'' if results.complete else 'partial '}results: {folder}", "dim")


# ------------------------------------------------------------------------------------------
# The tables that ``robot-ik bench`` prints.


def print_results(results: Results) -> None:
    """One table for each robot and set, then kernels and batches: whatever there is."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in results.cells:
        groups.setdefault((cell.robot, cell.set), []).append(cell)
    for (robot, name), cells in groups.items():
        reasons = {cell.skipped for cell in cells}
        if len(reasons) == 1 and "" not in reasons:  # the problems do not exist, whoever would solve them
            console.show(f"{robot}, {name}: {reasons.pop()}\n")
        else:
            columns = "solver, goal, solved %, median µs, mean µs, p99 µs, steps, restarts, note"
            _show(f"{robot}, {name}", columns, _cell_rows(cells))
    _show(
        "kinematics in a compiled loop", "robot, joints, forward µs, forward + Jacobian µs",
        [(b.robot, b.joints, f"{b.forward_us:.3f}", f"{b.jacobian_us:.3f}") for b in results.lower_bounds],
    )  # fmt: skip
    for across in ("joints", "goals"):
        points = [point for point in results.growth if point.across == across]
        sizes = sorted({point.size for point in points})
        steps = {(point.solver, point.size): microseconds(point.step_us) for point in points}
        solvers = dict.fromkeys(point.solver for point in points)
        rows = [(solver, *(steps.get((solver, size), "-") for size in sizes)) for solver in solvers]
        _show(f"µs a step, by number of {across}", ", ".join(["solver", *map(str, sizes)]), rows)
    _show(
        "batches of cold poses", "robot, solver, poses, threads, solves/s, solved %",
        [(one.robot, one.solver, one.poses, one.threads, f"{one.per_second:.0f}", f"{100 * one.success:.2f}")
         for one in results.batches],
    )  # fmt: skip


def _show(title: str, columns: str, rows: Sequence[tuple[object, ...]]) -> None:
    if rows:
        console.show(console.table(*columns.split(", "), rows=rows, title=title), "")


def _cell_rows(cells: list[Cell]) -> list[tuple[object, ...]]:
    """The best first; those that were left out behind them."""
    tried = sorted((c for c in cells if c.count), key=lambda c: (-c.rate, c.microsecond("mean")))
    rows: list[tuple[object, ...]] = [
        (
            cell.solver, cell.goal, f"{100 * cell.rate:.1f}",
            *(microseconds(cell.microsecond(which)) for which in ("median", "mean", 99.0)),
            f"{np.mean(cell.iterations):.1f}", f"{np.mean(cell.restarts):.2f}", _note(cell),
        )
        for cell in tried
    ]  # fmt: skip
    return rows + [(c.solver, *["-"] * 7, Text(c.skipped, style="dim")) for c in cells if not c.count]


def microseconds(value: float) -> str:
    """A time with three figures that mean something."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _note(cell: Cell) -> str:
    notes = []
    if cell.count < cell.asked:
        notes.append(f"{cell.count} of {cell.asked} tried")
    if cell.jumps:
        notes.append(f"{cell.jumps} jumps")
    if cell.set == "unreachable":
        notes.append(f"proven: {cell.status.count('UNREACHABLE')}")
    return "; ".join(notes)


_MARKS = {None: "", True: Text("pass", style="green"), False: Text("FAIL", style="bold red")}


def show_quantities(of: str, rows: Iterable[tuple[str, Quantity]], *remarks: str) -> None:
    """A table of what was measured, beside what is wanted; ``of``: the title of the names in ``rows``."""
    cells, judged, before = [], [], ""
    for name, one in rows:
        mark = _MARKS[one.passed]
        cells.append(("" if name == before else name, one.quantity, one.measured_text, one.wanted_text, mark))
        judged += [] if one.passed is None else [one.passed]
        before = name
    console.show(
        console.table(of, "quantity", "measured", "wanted", "", rows=cells),
        "; ".join([f"{sum(judged)} of {len(judged)} as wanted", *remarks]),
    )
