"""The tables that ``robot-ik bench`` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.text import Text

from robot_ik.cli import console

if TYPE_CHECKING:
    from robot_ik.bench.results import Cell, Results


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
