"""The report of ``robot-ik bench methods``: tables, files, and plots."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from robot_ik.commands.tables import table
from robot_ik.commands.terminal import Report

if TYPE_CHECKING:
    from robot_ik.bench.methods.results import Cell, Results

NOTHING = "-"
"""Cell of a table for a number that was not measured."""

COLUMNS = (
    "solver",
    "goal",
    "solved %",
    "median µs",
    "mean µs",
    "p99 µs",
    "steps",
    "restarts",
    "note",
)
"""Columns of the table of a problem set."""


@dataclass(eq=False)
class MethodsReport(Report):
    """Solvers on problem sets, cost of the kinematics, and batches.

    Attributes:
        results: The measurements. They are filled in while the benchmark runs.
        folder: Folder for the files. None: no files are written.
        plot: Whether plots are drawn.
        files: Names of the files that were written.
    """

    results: Results
    folder: Path | None
    plot: bool = False
    files: list[str] = field(default_factory=list, init=False)

    @property
    def has_begun(self) -> bool:
        """Whether something was measured."""
        results = self.results
        cells = [cell for cell in results.cells if cell.count or cell.skipped]
        return bool(cells or results.lower_bounds or results.batches)

    @property
    def hints(self) -> list[str]:
        """Name the folder of the results."""
        if not self.files:
            return []
        part = "" if self.results.complete else "partial "
        return [f"{part}results in {self.folder}: {'  '.join(self.files)}"]

    def save(self) -> None:
        """Write bench.json, and the plots if ``plot`` is set."""
        from robot_ik.bench.methods.plots import draw
        from robot_ik.files import write_atomically
        from robot_ik.workcell.results import save_json

        results = self.results
        results.cells = [cell for cell in results.cells if cell.count or cell.skipped]
        if self.folder is None:
            return
        save_json(self.folder / "bench.json", self.facts())
        self.files.append("bench.json")
        for name, picture in (draw(results) if self.plot else {}).items():
            write_atomically(self.folder / name, picture)
            self.files.append(name)

    def facts(self) -> dict[str, Any]:
        """Return the content of bench.json."""
        return self.results.model_dump(mode="json")

    def tables(self) -> Iterable[Any]:
        """Return one table for each robot and problem set, then kernels and batches."""
        yield from self._problem_set_tables()
        yield from self._kernel_tables()
        yield from self._batch_tables()

    def _problem_set_tables(self) -> Iterable[Any]:
        groups: dict[tuple[str, str], list[Cell]] = {}
        for cell in self.results.cells:
            groups.setdefault((cell.robot, cell.set), []).append(cell)
        for (robot, name), cells in groups.items():
            reasons = {cell.skipped for cell in cells}
            if len(reasons) == 1 and "" not in reasons:  # the problems do not exist
                yield f"{robot}, {name}: {reasons.pop()}"
            else:
                yield table(*COLUMNS, rows=cell_rows(cells), title=f"{robot}, {name}")

    def _kernel_tables(self) -> Iterable[Any]:
        results = self.results
        if results.lower_bounds:
            columns = ("robot", "joints", "forward µs", "forward + Jacobian µs")
            rows = [
                (bound.robot, bound.joints, f"{bound.forward_us:.3f}", f"{bound.jacobian_us:.3f}")
                for bound in results.lower_bounds
            ]
            yield table(*columns, rows=rows, title="kinematics in a compiled loop")
        for across in ("joints", "goals"):
            points = [point for point in results.growth if point.across == across]
            if not points:
                continue
            sizes = sorted({point.size for point in points})
            times = {(point.solver, point.size): point.step_us for point in points}
            solvers = dict.fromkeys(point.solver for point in points)
            growth = [
                (name, *(microseconds(times.get((name, size))) for size in sizes))
                for name in solvers
            ]
            title = f"µs a step, by number of {across}"
            yield table("solver", *map(str, sizes), rows=growth, title=title)

    def _batch_tables(self) -> Iterable[Any]:
        if not self.results.batches:
            return
        columns = ("robot", "solver", "poses", "threads", "solves/s", "solved %")
        rows = [
            (
                batch.robot,
                batch.solver,
                batch.poses,
                batch.threads,
                f"{batch.per_second:.0f}",
                f"{100 * batch.success:.2f}",
            )
            for batch in self.results.batches
        ]
        yield table(*columns, rows=rows, title="batches of cold poses")


def cell_rows(cells: list[Cell]) -> list[tuple[object, ...]]:
    """Return the rows of a problem set: the best solver first, skipped ones last."""
    tried = sorted(
        (cell for cell in cells if cell.count),
        key=lambda cell: (-cell.rate, cell.microsecond("mean")),
    )
    rows: list[tuple[object, ...]] = [
        (
            cell.solver,
            cell.goal,
            f"{100 * cell.rate:.1f}",
            microseconds(cell.microsecond("median")),
            microseconds(cell.microsecond("mean")),
            microseconds(cell.microsecond(99.0)),
            f"{np.mean(cell.iterations):.1f}",
            f"{np.mean(cell.restarts):.2f}",
            cell_note(cell),
        )
        for cell in tried
    ]
    for cell in cells:
        if not cell.count:
            rows.append((cell.solver, *[NOTHING] * 7, Text(cell.skipped, style="dim")))
    return rows


def microseconds(value: float | None) -> str:
    """Return a time with three significant digits."""
    if value is None:
        return NOTHING
    if value < 10:
        return f"{value:.2f}"
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def cell_note(cell: Cell) -> str:
    """Return what is special about the problems of a cell."""
    notes = []
    if cell.count < cell.asked:
        notes.append(f"{cell.count} of {cell.asked} tried")
    if cell.jumps:
        notes.append(f"{cell.jumps} jumps")
    if cell.set == "unreachable":
        notes.append(f"proven: {cell.status.count('UNREACHABLE')}")
    return "; ".join(notes)
