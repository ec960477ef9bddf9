"""Measure walks, reaches, bends and jumps of the figure, and its processor times.

    python -m benchmarks.figure [--count N] [--json]

MuJoCo judges the motions by the true shapes and by inverse dynamics. Times are processor times of
one thread, the smallest of three runs. The comparison with mink needs `pip install mink daqp`.
Without it that row is not measured.

Exit code: 0 where every measured row is within its limits, 1 otherwise, 2 for wrong input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from benchmarks.figure.rows import measure_figure
from benchmarks.quantity_table import show_quantities
from robot_ik.commands.main import DONE, INTERRUPTED, NOT_ACHIEVED, exit_code_of
from robot_ik.commands.terminal import Terminal, show_error
from robot_ik.errors import RobotIkError
from robot_ik.figure.abilities import load_abilities
from robot_ik.figure.figure import load_figure
from robot_ik.files import json_text, plain

SCHEMA = 3
"""Version of the JSON."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print. Return the exit code."""
    options = argument_parser().parse_args(arguments)
    try:
        with Terminal().running("measuring the figure"):
            abilities = load_abilities(load_figure(options.model))
            rows = list(measure_figure(abilities, options.count, options.seed))
    except RobotIkError as error:
        show_error(error)
        return exit_code_of(error)
    except KeyboardInterrupt:
        return INTERRUPTED
    if options.json:
        facts = [{"motion": motion, **quantity.facts()} for motion, quantity in rows]
        print(json_text(plain({"schema": SCHEMA, "rows": facts})))
    else:
        show_quantities("motion", rows)
    is_missed = any(quantity.passed is False for _, quantity in rows)
    return NOT_ACHIEVED if is_missed else DONE


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.figure",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--model",
        default="humanoid",
        metavar="NAME|PATH",
        help="a model whose robot.toml has a table [figure] (default: humanoid)",
    )
    parser.add_argument(
        "--count",
        type=_positive,
        default=20,
        metavar="N",
        help="balls that are reached, bent and jumped for (default: 20)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the balls (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _positive(text: str) -> int:
    """Return a number of balls."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} balls; allowed: 1 or more")
    return number


if __name__ == "__main__":
    sys.exit(main())
