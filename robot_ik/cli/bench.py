"""``robot-ik bench``: solvers × robots on seeded problem sets, judged by MuJoCo."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import several, wrong
from robot_ik.environment import import_mujoco
from robot_ik.files import write_atomically
from robot_ik.jobs.results import require_plots, results_folder

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.bench.methods.results import Cell, Results
    from robot_ik.bench.methods.runner import Campaign
    from robot_ik.solvers.base import Solver


SetName = Literal["cold", "warm", "singular", "limits", "unreachable", "kernels", "batch"]


_FILES = ("bench.json", "success-*.png", "convergence-*.png", "growth.png")


@dataclass(frozen=True)
class BenchOptions:
    """Times methods on seeded problems and lets MuJoCo judge their answers.

    A time is that of the whole Python call: 4×4 matrix in, joint array out, limits obeyed. Kernels are
    compiled and warmed up before; collection of garbage is off. Nothing passes or fails by its time.

    Writes bench.json and plots; Ctrl-C keeps what is done. See also: robot-ik bench camera --help,
    robot-ik bench figure --help, robot-ik bench page --help

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
    count: int = 200
    """Problems in each set; a batch has 500 times as many."""
    seed: int = 0
    """Of problems and restarts: the same seed gives the same problems."""
    position_tolerance: Annotated[float, arg(metavar="M")] = 1e-4
    """Largest distance that still counts as solved, metres."""
    angle_tolerance: Annotated[float, arg(metavar="RAD")] = 1e-3
    """Largest angle that still counts as solved, radians."""
    seconds: float = 3.0
    """Longest time for one method on one set; what is left then is not tried."""
    out: Annotated[str, arg(metavar="FOLDER", help_behavior_hint="(default: runs/<time>-bench)")] = ""
    """Where bench.json and the plots go."""
    overwrite: bool = False
    """That folder may hold files of an earlier run: they are replaced."""
    plots: bool = True
    """Draw plots (needs matplotlib)."""


def run(options: BenchOptions) -> int:
    """Measures, writes and prints."""
    import_mujoco()
    from robot_ik.bench.methods.results import Results, Settings, this_machine
    from robot_ik.bench.methods.runner import Campaign
    from robot_ik.goals import Tolerance
    from robot_ik.robot import load_robot

    solvers, robots = _solvers(options), [load_robot(name) for name in dict.fromkeys(options.robots)]
    Tolerance(options.position_tolerance, options.angle_tolerance)  # refuses what is not positive
    if options.plots:
        require_plots("drawing the plots")
    settings = Settings(
        command=shlex.join(["robot-ik", *sys.argv[1:]]) if sys.argv[1:2] == ["bench"] else "robot-ik bench",
        count=options.count,
        seed=options.seed,
        position_tolerance=options.position_tolerance,
        angle_tolerance=options.angle_tolerance,
        seconds=options.seconds,
    )
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

    if options.count < 1:
        raise wrong("--count", f"{options.count} problems", "1 or more")
    if not options.seconds > 0.0:
        raise wrong("--seconds", f"{options.seconds:g} s", "above 0")
    # `combined` with its default options is `auto`.
    names = options.solvers or tuple(name for name in SOLVERS if name != "combined")
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
    from robot_ik.bench.methods.results import draw, results_text

    results.cells = [cell for cell in results.cells if cell.count or cell.skipped]
    if not (results.cells or results.lower_bounds or results.batches):
        return  # it had not begun
    write_atomically(folder / "bench.json", results_text(results))
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
        _print_cells(robot, name, cells)
    _print_lower_bounds(results)
    _print_growth(results)
    _print_batches(results)


def _print_cells(robot: str, name: str, cells: list[Cell]) -> None:
    reasons = {cell.skipped for cell in cells}
    if len(reasons) == 1 and "" not in reasons:  # the problems do not exist, whoever would solve them
        console.out().print(Text(f"{robot}, {name}: {reasons.pop()}\n"))
        return
    shown = console.table(
        "solver", "goal", "solved %", "median µs", "mean µs", "p99 µs", "steps", "restarts", "note",
        title=f"{robot}, {name}",
    )  # fmt: skip
    for cell in sorted((c for c in cells if c.count), key=lambda c: (-c.rate, c.microsecond("mean"))):
        shown.add_row(
            cell.solver, cell.goal, f"{100 * cell.rate:.1f}",
            *(microseconds(cell.microsecond(which)) for which in ("median", "mean", 99.0)),
            f"{np.mean(cell.iterations):.1f}", f"{np.mean(cell.restarts):.2f}", Text(_note(cell)),
        )  # fmt: skip
    for cell in (c for c in cells if not c.count):
        shown.add_row(cell.solver, *["-"] * 7, Text(cell.skipped, style="dim"))
    _show(shown)


def _show(shown: Table) -> None:
    console.out().print(shown)
    console.out().print()


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


def _print_lower_bounds(results: Results) -> None:
    if results.lower_bounds:
        shown = console.table(
            "robot", "joints", "forward µs", "forward + Jacobian µs", title="kinematics in a compiled loop"
        )
        for one in results.lower_bounds:
            shown.add_row(one.robot, str(one.joints), f"{one.forward_us:.3f}", f"{one.jacobian_us:.3f}")
        _show(shown)


def _print_growth(results: Results) -> None:
    for across in ("joints", "goals"):
        points = [point for point in results.growth if point.across == across]
        if not points:
            continue
        sizes = sorted({point.size for point in points})
        shown = console.table("solver", *map(str, sizes), title=f"µs a step, by number of {across}")
        for solver in dict.fromkeys(point.solver for point in points):
            mine = {point.size: point.step_us for point in points if point.solver == solver}
            shown.add_row(solver, *(microseconds(mine[size]) if size in mine else "-" for size in sizes))
        _show(shown)


def _print_batches(results: Results) -> None:
    if results.batches:
        shown = console.table(
            "robot", "solver", "poses", "threads", "solves/s", "solved %", title="batches of cold poses"
        )
        for one in results.batches:
            shown.add_row(
                one.robot, one.solver, str(one.poses), str(one.threads), f"{one.per_second:.0f}",
                f"{100 * one.success:.2f}",
            )  # fmt: skip
        _show(shown)
