"""Writes the tables of the documentation that come from the program: `python docs/make_tables.py`.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`.  The tests fail where one is out of date.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

PLACE = re.compile(r"(<!-- table: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def markdown(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [list(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def solvers() -> str:
    """One row for each method."""
    from robot_ik.cli.listing import solver_facts
    from robot_ik.solvers import SOLVERS

    facts = [solver_facts(name, kind) for name, kind in SOLVERS.items()]
    return markdown(
        ("name", "method", "goals", "source"),
        (
            (
                f"`{f['name']}`",
                f["title"],
                ", ".join(goal.removesuffix(" goal") for goal in f["goals"]),
                f["source"],
            )
            for f in facts
        ),
    )


def options() -> str:
    """All options of all methods."""
    from robot_ik.cli.listing import solver_facts
    from robot_ik.solvers import SOLVERS

    rows = []
    for name, kind in SOLVERS.items():
        for option in solver_facts(name, kind)["options"]:
            span = "" if option["low"] is None else f"{option['low']:g} … {option['high']:g} {option['unit']}"
            cells = (f"`{option['name']}`", option["default"], span.strip(), option["help"])
            rows.append((f"`{name}`", *cells))
    return markdown(("method", "option", "default", "range", "meaning"), rows)


def buses() -> str:
    """One row for each way to reach servos."""
    from robot_ik.hardware import BUSES

    kinds = {True: "simulated", False: "real"}
    return markdown(
        ("`--bus`", "what it is", "servos"),
        ((f"`{bus.name}`", bus.title, kinds[bus.virtual]) for bus in BUSES.values()),
    )


def servos() -> str:
    """One row for each servo model."""
    from robot_ik.hardware.control_table import CONTROL_TABLES

    return markdown(
        ("model", "number", "modes"),
        (
            (f"`{name}`", table.number, ", ".join(mode.name.lower() for mode in table.modes))
            for name, table in CONTROL_TABLES.items()
        ),
    )


def commands() -> str:
    """One row for each command of `robot-ik`."""
    from robot_ik.cli.main import COMMANDS

    return markdown(("command", "what it does"), ((f"`{n}`", c.about) for n, c in COMMANDS.items()))


TABLES: dict[str, Callable[[], str]] = {
    make.__name__: make for make in (solvers, options, buses, servos, commands)
}


def filled(text: str) -> str:
    """``text`` with every table as the program has it now."""
    return PLACE.sub(lambda m: m[1] + TABLES[m[2]]() + m[4], text)


if __name__ == "__main__":
    for page in [*Path(__file__).parent.glob("*.md"), Path(__file__).parents[1] / "README.md"]:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page}\n")
