"""The reports of ``robot-ik bench a00`` and ``robot-ik bench s12``."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from robot_ik.bench.theses import a00, s12
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import Report
from robot_ik.theses.courses import THESIS_RESULTS
from robot_ik.theses.table_4_1 import CASES

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.bench.theses.a00 import A00Report
    from robot_ik.bench.theses.s12 import S12Report
    from robot_ik.theses.table_4_1 import ArmCase
    from robot_ik.workcell.progress import Progress

NOTHING = "-"
"""Cell of a table for a method that does not support the goal, or a case that is not run."""


@dataclass(eq=False)
class ThesisReport(Report):
    """Base of the reports on the experiments of the theses.

    Attributes:
        folder: Folder for the files. None: no files are written.
        plot: Whether a picture is drawn.
        files: Names of the files that were written.
    """

    folder: Path | None
    plot: bool = field(default=False, kw_only=True)
    files: list[str] = field(default_factory=list, init=False)

    @abstractmethod
    def measure(self, progress: Progress) -> None:
        """Run the experiment. The results are filled in meanwhile."""

    @abstractmethod
    def save(self) -> None:
        """Write the files."""

    @property
    def hints(self) -> list[str]:
        """Name the files."""
        return [f"results in {self.folder}: {'  '.join(self.files)}"] if self.files else []

    def save_facts(self, name: str) -> None:
        """Write the facts as JSON."""
        from robot_ik.workcell.results import save_json

        if self.folder is not None:
            save_json(self.folder / name, self.facts())
            self.files.append(name)


@dataclass(eq=False)
class AhoReport(ThesisReport):
    """Courses, methods × courses, and whether the required methods pass."""

    results: A00Report = field(kw_only=True)

    @property
    def ok(self) -> bool:
        """Whether all required methods met every frame."""
        return self.results.passed

    def measure(self, progress: Progress) -> None:
        """Run the courses."""
        a00.run_a00(self.results, progress)

    def save(self) -> None:
        """Write a00.json."""
        self.save_facts("a00.json")

    def facts(self) -> dict[str, Any]:
        """Return the content of a00.json."""
        return a00.a00_summary(self.results)

    def tables(self) -> Iterable[Any]:
        """Return the courses, the methods, and the verdict."""
        report = self.results
        rows = [
            (
                number,
                len(course.robot.joints),
                course.goal.name.removesuffix(" goal"),
                course.moves,
                len(course.at),
                THESIS_RESULTS[number],
            )
            for number, course in report.courses.items()
        ]
        columns = ("test", "joints", "goal", "the goal moves", "frames", "A00's result")
        yield table(*columns, rows=rows)
        yield self._methods_table()
        yield f"{NOTHING}: the method does not support this goal. Below a share: first lost frame."
        yield verdict(report.complete, report.passed, self._reason())

    def _reason(self) -> str:
        report = self.results
        required = [name for name in a00.MUST_PASS if name in report.solvers]
        if report.failures:
            losses = []
            for name, number in report.failures:
                refused = report.tracks[name, number].refused
                loss = "refused" if refused else f"lost at {report.lost_at(name, number)}"
                losses.append(f"{name} in test {number}: {loss}")
            return "; ".join(losses)
        if not required:
            return "no required method was run"
        return f"{', '.join(required)} met every frame"

    def _methods_table(self) -> Table:
        """Return one row for each method, one column for each test."""
        report = self.results
        rows = [
            (name, *(self._share(name, number) for number in report.courses))
            for name in report.solvers
        ]
        title = "Frames met in each test, by method"
        grid = table("% met", *map(str, report.courses), rows=rows, title=title)
        for column in grid.columns[1:]:
            column.justify = "right"
        return grid

    def _share(self, name: str, number: int) -> Text:
        """Return the percentage of met frames, and below it where the goal was first lost."""
        track = self.results.tracks.get((name, number))
        if track is None:
            return Text("")
        if track.refused:
            return Text(NOTHING, style="dim")
        if track.passed:
            return Text("100", style="green")
        # Rounded down: only complete success is shown as 100 %.
        share = 100 * track.solved // track.frames
        return Text(f"{share}\n{self.results.lost_at(name, number)}", style="red")


@dataclass(eq=False)
class SimunicReport(ThesisReport):
    """The table of the thesis and ours, and whether the required methods pass."""

    results: S12Report = field(kw_only=True)

    @property
    def ok(self) -> bool:
        """Whether all required methods reached every target."""
        return self.results.passed

    def measure(self, progress: Progress) -> None:
        """Run the cases."""
        s12.run_s12(self.results, progress)

    def save(self) -> None:
        """Write s12.json, and s12.png if ``plot`` is set and all cases were run."""
        from robot_ik.files import write_atomically

        self.save_facts("s12.json")
        if self.folder is not None and self.plot and self.results.complete:
            write_atomically(self.folder / "s12.png", s12.s12_picture(self.results))
            self.files.append("s12.png")

    def facts(self) -> dict[str, Any]:
        """Return the content of s12.json."""
        return s12.s12_summary(self.results)

    def tables(self) -> Iterable[Any]:
        """Return a table for each case, and the verdict."""
        report = self.results
        for case in CASES:
            yield case_table(report, case)
        yield ""
        yield "t: mean time of a solve, ms. N: mean number of steps. η: % of the frames solved."
        reason = f"{' and '.join(s12.MUST_PASS)} reached every target of every case"
        if report.failures:
            reason = "; ".join(
                f"{name} in case {case}: {100.0 * report.tracks['best', name, case].share:.1f} %"
                for name, case in report.failures
            )
        yield verdict(report.complete, report.passed, reason)


def verdict(complete: bool, passed: bool, reason: str) -> Text:
    """Return the last line of an experiment."""
    if not complete:
        return Text.assemble(("INTERRUPTED", "bold yellow"), "  the tables show the finished part")
    word = ("PASSED", "bold green") if passed else ("NOT PASSED", "bold red")
    return Text.assemble(word, f"  {reason}")


def case_table(report: S12Report, case: ArmCase) -> Table:
    """Return the table of a case: methods in rows, parameters in columns."""
    cells = s12.s12_cells(report)
    rows = [
        (name, *(cell_text(cells.get((column, name, case.number))) for column in s12.COLUMNS))
        for name in s12.BEST_METHODS
    ]
    heads = (f"{head}\n{'t':>5} {'N':>3} {'η':>3}" for head in s12.COLUMNS.values())
    title = f"Case {case.number}: {case.title}, {report.frames} frames"
    return table("method", *heads, rows=rows, title=title, fold=False)


def cell_text(cell: Mapping[str, float] | None) -> str:
    """Return time, steps and per cent solved. Per cent are rounded down."""
    if cell is None:
        return NOTHING
    milliseconds = cell["milliseconds"]
    # 0.29 * 100 is 28.999…, so the product is rounded first. 99.9 % is shown as 99.
    solved = math.floor(round(100.0 * cell["solved"], 6))
    time = f"{milliseconds:5.3f}" if milliseconds < 1.0 else f"{milliseconds:5.1f}"
    return f"{time} {cell['n']:3.0f} {solved:3d}"
