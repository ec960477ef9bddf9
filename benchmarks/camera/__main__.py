"""Measure the camera on synthetic pictures with known truth, and compare with limits.

    python -m benchmarks.camera [--rows NAME ...] [--json FILE]

Accuracy is the same on every machine. Times are processor time of one thread, the best of three
rounds. Wall-clock times and delays depend on other programs. Ctrl-C keeps the rows that are done.

Exit code: 0 if every row was measured and is within its limits, 1 otherwise, 2 for wrong input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.camera import rows as table
from benchmarks.camera.rows import Effort, MeasuredRows, Row
from benchmarks.quantity_table import show_quantities
from robot_ik.bench.methods.results import this_machine
from robot_ik.commands.main import DONE, INTERRUPTED, NOT_ACHIEVED, exit_code_of
from robot_ik.commands.terminal import Terminal, say, show_error
from robot_ik.errors import OptionError, RobotIkError, unknown_name_text
from robot_ik.workcell.results import claimed, save_json

#: Version of the file of figures.
SCHEMA = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write. Return the exit code."""
    options = argument_parser().parse_args(arguments)
    effort = Effort(options.quick, options.seed, options.photographs)
    try:
        chosen = chosen_rows(options.rows, options.skip)
        if "photographs" in options.rows and not options.photographs:
            problem = "the row photographs needs real pictures"
            raise OptionError("--photographs", problem, "a folder of them")
        if options.photographs and not Path(options.photographs).is_dir():
            problem = f"{options.photographs} is not a folder"
            raise OptionError("--photographs", problem, "a folder of pictures")
        measured = measure(chosen, effort, options.json, overwrite=options.overwrite)
    except RobotIkError as error:
        show_error(error)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return INTERRUPTED
    return NOT_ACHIEVED if measured.failed or measured.unmeasured else DONE


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.camera",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = ", ".join(row.name for row in table.ROWS)
    parser.add_argument("--rows", nargs="+", default=[], metavar="NAME", help=f"only: {names}")
    parser.add_argument("--skip", nargs="+", default=[], metavar="NAME", help="all rows but these")
    parser.add_argument("--quick", action="store_true", help="measure a tenth of the pictures")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--seed", type=int, default=1, help="of pictures and noise (default: 1)")
    parser.add_argument(
        "--photographs",
        default="",
        metavar="FOLDER",
        help="real pictures without markers, for false finds; with chessboards of 9 × 6 corners, "
        "for real corners",
    )
    return parser


def chosen_rows(names: Sequence[str], skipped: Sequence[str] = ()) -> list[Row]:
    """Return the rows of these names, or all rows without names, except the skipped ones.

    Raises:
        OptionError: No such row, or no row is left.
    """
    known = {row.name: row for row in table.ROWS}
    for option, given in (("--rows", names), ("--skip", skipped)):
        for name in given:
            if name not in known:
                raise OptionError(option, unknown_name_text("row", name, list(known)))
    chosen = [known[name] for name in dict.fromkeys(names or known) if name not in skipped]
    if not chosen:
        raise OptionError("--skip", "no row is left", "fewer names")
    return chosen


def measure(
    rows: Sequence[Row], effort: Effort, file: Path | None, *, overwrite: bool
) -> MeasuredRows:
    """Measure rows, print the figures, and write them to a file if one is given."""
    measured = MeasuredRows()
    with claimed(file, overwrite=overwrite):
        try:
            terminal = Terminal()
            with terminal.running("measuring"):
                measured.measure(rows, effort, terminal.progress)
        finally:
            # After an interrupt, too, the measured rows are saved and shown.
            if measured.figures:
                print_figures(measured)
                if file is not None:
                    facts = {"schema": SCHEMA, "machine": this_machine().model_dump(mode="json")}
                    facts |= {"quick": effort.quick, "seed": effort.seed, **measured.facts()}
                    save_json(file, facts)
                    say(f"figures: {file}", "dim")
    return measured


def print_figures(measured: MeasuredRows) -> None:
    """Print the figures and the names of unmeasured rows."""
    remarks = []
    if measured.unmeasured:
        remarks.append(f"not measured: {', '.join(measured.unmeasured)}")
    if not measured.complete:
        remarks.append("not all measured")
    figures = (
        (name, quantity) for name, quantities in measured.figures.items() for quantity in quantities
    )
    show_quantities("row", figures, *remarks)


if __name__ == "__main__":
    sys.exit(main())
