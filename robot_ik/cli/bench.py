"""``robot-ik bench``: solvers × robots on seeded problem sets, judged by MuJoCo."""

from __future__ import annotations

import gc
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.console import results_folder
from robot_ik.environment import import_mujoco
from robot_ik.errors import GoalError, UnsupportedJointError
from robot_ik.files import write_atomically

if TYPE_CHECKING:
    from rich.progress import Progress

    from robot_ik.bench.methods.results import Cell, Results, Settings
    from robot_ik.bench.methods.runner import Bench
    from robot_ik.robot import Robot
    from robot_ik.solvers.base import Solver


SetName = Literal["cold", "warm", "singular", "limits", "unreachable", "kernels", "batch"]
_EXTRA = ("kernels", "batch")
_BATCH = 500  # times as many poses as in the other sets


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

    solvers: Annotated[tuple[str, ...], arg(metavar="NAME …", help_behavior_hint="(default: all)")] = ()
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
    from robot_ik.bench.methods.results import Results, Settings, need_matplotlib, this_machine
    from robot_ik.goals import Tolerance

    solvers, robots = _solvers(options), _robots(options)
    Tolerance(options.position_tolerance, options.angle_tolerance)  # refuses what is not positive
    if options.plots:
        need_matplotlib()
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
            _measure(options, solvers, robots, results)
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


def _robots(options: BenchOptions) -> list[Robot]:
    from robot_ik.robot import load_robot

    return [load_robot(name) for name in dict.fromkeys(options.robots)]


# ---------------------------------------------------------------------------------------- measuring


def _measure(options: BenchOptions, solvers: list[Solver], robots: list[Robot], results: Results) -> None:
    machine = results.machine
    console.say(f"on {machine.processor}, {machine.cores} cores, Python {machine.python}", "dim")
    with console.progress() as bar:
        benches = _prepare(options, solvers, robots, results.settings, bar)
    # What compiling left behind need not be looked through again before each method's turn.
    gc.collect()
    gc.freeze()
    console.say("kernels are ready; Ctrl-C keeps what is done", "dim")
    try:
        with console.progress() as bar:
            _run_cells(benches, results, bar)
            if "kernels" in options.sets:
                _run_kernels(solvers, robots, results, bar)
            if "batch" in options.sets:
                _run_batches(options, solvers, robots, results, bar)
    finally:
        gc.unfreeze()


def _prepare(
    options: BenchOptions, solvers: list[Solver], robots: list[Robot], settings: Settings, bar: Progress
) -> list[Bench]:
    """All that takes long and is not measured: problem sets, and kernels, which announce themselves."""
    from robot_ik.bench.methods.problems import make_set
    from robot_ik.bench.methods.runner import prepare

    benches = []
    names = [name for name in dict.fromkeys(options.sets) if name not in _EXTRA]
    task = bar.add_task("preparing", total=max(1, len(names) * len(robots)), note="")
    for name in names:
        for robot in robots:
            bar.update(task, note=f"{name}, {robot.name}")
            problems = make_set(name, robot, options.count, options.seed)
            benches += [prepare(solver, robot, problems, settings) for solver in solvers]
            bar.advance(task)
    return benches


def _run_cells(benches: list[Bench], results: Results, bar: Progress) -> None:
    from robot_ik.bench.methods.runner import curve

    task = bar.add_task("solving", total=max(1, len(benches)), note="")
    for done, bench in enumerate(benches):
        cell = bench.cell
        bar.update(task, note=f"{cell.set}, {cell.robot}, {cell.solver}")
        results.cells.append(cell)
        bench.run(results.settings, lambda share, done=done: bar.update(task, completed=done + share))  # type: ignore[misc]
        if cell.set == "cold" and (found := curve(bench, results.settings)):
            results.curves.append(found)
    bar.remove_task(task)


def _run_kernels(solvers: list[Solver], robots: list[Robot], results: Results, bar: Progress) -> None:
    from robot_ik.bench.methods import growth
    from robot_ik.robot import load_robot

    task = bar.add_task("kernels", total=len(solvers), note="forward and Jacobian")
    seed, figure = results.settings.seed, load_robot(growth.FIGURE)
    results.floors += [growth.floor(robot, seed) for robot in robots]
    for solver in solvers:
        bar.update(task, note=f"growth, {solver.name}")
        for point in growth.growth_with_joints(solver, seed):
            results.growth.append(point)
        for point in growth.growth_with_goals(solver, figure, seed):
            results.growth.append(point)
        bar.advance(task)
    bar.remove_task(task)


def _run_batches(
    options: BenchOptions, solvers: list[Solver], robots: list[Robot], results: Results, bar: Progress
) -> None:
    from robot_ik.bench.methods.growth import batches

    task = bar.add_task("batches", total=len(robots) * len(solvers), note="")
    for robot in robots:
        for solver in solvers:
            bar.update(task, note=f"{robot.name}, {solver.name}")
            try:
                for found in batches(robot, solver, _BATCH * options.count, options.seed):
                    results.batches.append(found)
            except (GoalError, UnsupportedJointError) as error:
                console.say(f"no batch: {error.args[0]}", "dim")
            bar.advance(task)
    bar.remove_task(task)


# ------------------------------------------------------------------------------------------ showing


def _finish(results: Results, folder: Path, *, plots: bool) -> None:
    from robot_ik.bench.methods.results import draw, results_text

    results.cells = [cell for cell in results.cells if cell.count or cell.skipped]
    if not (results.cells or results.floors or results.batches):
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
    _print_floors(results)
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


def _print_floors(results: Results) -> None:
    if results.floors:
        shown = console.table(
            "robot", "joints", "forward µs", "forward + Jacobian µs", title="kinematics in a compiled loop"
        )
        for one in results.floors:
            shown.add_row(one.robot, str(one.joints), f"{one.forward_us:.3f}", f"{one.jacobian_us:.3f}")
        console.out().print(shown)
        console.out().print()


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
        console.out().print(shown)
        console.out().print()


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
        console.out().print(shown)
        console.out().print()
