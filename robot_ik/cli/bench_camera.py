"""``robot-ik bench camera``: every figure of the camera beside what is wanted of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from robot_ik.bench.camera import ROWS, Effort, MeasuredRows, Row
from robot_ik.cli import console
from robot_ik.cli.arguments import several, wrong
from robot_ik.environment import import_mujoco
from robot_ik.errors import unknown_name_text
from robot_ik.files import claimed
from robot_ik.jobs.results import save_json


@dataclass(frozen=True)
class BenchCameraOptions:
    """Measures the camera on synthetic pictures whose truth is known, and prints it beside what is wanted.

    Accuracy is the same on every machine.  Times are processor time of one thread, the best of three rounds,
    and beside it time by the clock, which depends on what else runs, as delays do.
    Ctrl-C keeps what is done.

    Exit code 0 where every row was measured and is as wanted, else 1.
    """

    rows: Annotated[tuple[str, ...], several("NAME", "all")] = ()
    """Which rows of the table: corners, marker, board, …"""
    skip: Annotated[tuple[str, ...], several("NAME")] = ()
    """Leave these rows out."""
    quick: bool = False
    """A tenth of the pictures: for a look, not for the record."""
    json: Annotated[str, arg(metavar="FILE", help_behavior_hint="")] = ""
    """Write the figures there, too."""
    overwrite: bool = False
    """Replace that file."""
    seed: int = 1
    """Of pictures and noise."""
    photographs: Annotated[str, arg(metavar="FOLDER", help_behavior_hint="")] = ""
    """Real pictures without markers, for false finds; with chessboards of 9 × 6 corners, for real corners."""


def run(options: BenchCameraOptions) -> int:
    """Measures, prints and writes."""
    import_mujoco()
    rows = chosen_rows(options.rows, options.skip)
    if "photographs" in options.rows and not options.photographs:
        raise wrong("--photographs", "the row photographs needs real pictures", "a folder of them")
    if options.photographs and not Path(options.photographs).is_dir():
        raise wrong("--photographs", f"{options.photographs} is no folder", "a folder of pictures")
    effort, found = Effort(options.quick, options.seed, options.photographs), MeasuredRows()
    file = Path(options.json) if options.json else None
    with claimed(file, overwrite=options.overwrite):
        return _measure_and_print(rows, effort, found, file)


def _measure_and_print(rows: Sequence[Row], effort: Effort, found: MeasuredRows, file: Path | None) -> int:
    try:
        with console.progress() as bar:
            found.measure(rows, effort, console.shares_on(bar, "measuring"))
    finally:
        # Ctrl-C and SIGTERM come through here as well: what is done is kept and shown.
        if found.figures:
            print_figures(rows, found)
            if file is not None:
                _write(file, found, effort)
    return console.DONE if found.passed else console.NOT_ACHIEVED


def chosen_rows(names: Sequence[str], skipped: Sequence[str] = ()) -> list[Row]:
    """The rows of these names, all when none is given, without those that are skipped.

    Raises:
        ConfigError: No such row, or none is left.
    """
    known = {row.name: row for row in ROWS}
    for option, given in (("--rows", names), ("--skip", skipped)):
        for name in given:
            if name not in known:
                raise wrong(option, unknown_name_text("row", name, list(known)))
    chosen = [known[name] for name in dict.fromkeys(names or known) if name not in skipped]
    if not chosen:
        raise wrong("--skip", "no row is left", "fewer names")
    return chosen


def print_figures(rows: Sequence[Row], found: MeasuredRows) -> None:
    """The table: quantity, value, wanted, verdict."""
    shown = console.table("row", "quantity", "measured", "wanted", "")
    for row in rows:
        for index, one in enumerate(found.figures.get(row.name, ())):
            shown.add_row(
                row.name if index == 0 else "",
                one.quantity,
                one.measured_text,
                one.wanted_text,
                console.verdict_mark(one.passed),
            )
        if row.name in found.unmeasured:
            why = f"not measured: {found.unmeasured[row.name]}"
            shown.add_row(row.name, why, "", "", console.verdict_mark(False))
    console.out().print(shown)
    missed = sum(one.passed is False for figures in found.figures.values() for one in figures)
    every = sum(one.passed is not None for figures in found.figures.values() for one in figures)
    console.out().print(
        f"{every - missed} of {every} as wanted"
        + (f"; not measured: {', '.join(found.unmeasured)}" if found.unmeasured else "")
        + ("" if found.complete else "; not all measured")
    )


def _write(path: Path, found: MeasuredRows, effort: Effort) -> None:
    from robot_ik.bench.methods.results import this_machine

    facts = {
        "schema": 1,
        "machine": this_machine().model_dump(mode="json"),
        "quick": effort.quick,
        "seed": effort.seed,
        **found.facts(),
    }
    save_json(path, facts)
    console.say(f"figures: {path}", "dim")
