"""Write the tables of the pages that come from the program: `python docs/make/tables.py`.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. Tables of one method have its name
after theirs: `<!-- table: options lm -->`. The tests fail if a table is out of date.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PLACE = re.compile(r"(<!-- table: (\w+)(?: (\w+))? -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def markdown(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table."""
    lines = [list(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines
    )


def solvers() -> str:
    """Return a table with one row for each method."""
    from robot_ik.commands.solvers import goals_text, solver_facts
    from robot_ik.solvers import SOLVERS

    facts = [solver_facts(name, kind) for name, kind in SOLVERS.items()]
    return markdown(
        ("name", "method", "goals", "source"),
        (
            (
                f"[`{f['name']}`](solvers/{f['name']}.md)",
                f["title"],
                goals_text(f),
                f["source"],
            )
            for f in facts
        ),
    )


def method(name: str) -> str:
    """Return a table with title, goals and source of one method."""
    from robot_ik.commands.solvers import goals_text, solver_facts
    from robot_ik.solvers import SOLVERS

    facts = solver_facts(name, SOLVERS[name])
    goals = goals_text(facts)
    return markdown(("method", "goals", "source"), [(facts["title"], goals, facts["source"])])


def options(name: str) -> str:
    """Return a table of all options of one method."""
    from robot_ik.commands.solvers import solver_facts
    from robot_ik.solvers import SOLVERS

    rows = []
    for option in solver_facts(name, SOLVERS[name])["options"]:
        bounded = option["lower"] is not None and not isinstance(option["default"], bool)
        span = f"{option['lower']:g} … {option['upper']:g} {option['unit']}" if bounded else ""
        span = span or ", ".join(option["choices"])
        default = (
            f"{option['default']:.4g}"
            if isinstance(option["default"], float)
            else option["default"]
        )
        rows.append((f"`{option['name']}`", default, span.strip(), option["help"]))
    return (
        markdown(("option", "default", "range", "meaning"), rows)
        if rows
        else "It has no options.\n\n"
    )


def floors(name: str) -> str:
    """Return a table of the solve rates of one method below which the tests fail."""
    with (ROOT / "tests" / "solvers" / "floors.toml").open("rb") as stream:
        table: dict[str, Any] = tomllib.load(stream).get(name, {})
    kinds = [
        k for k in ("position", "orientation", "pose") if any(k in row for row in table.values())
    ]
    rows = []
    for robot, row in table.items():
        shares = [f"{100 * row[kind]:.0f} %" if kind in row else "" for kind in kinds]
        rows.append((f"`{robot}`", *shares, row.get("reason", "")))
    reasons = any(row[-1] for row in rows)
    head = ("robot", *kinds, "why") if reasons else ("robot", *kinds)
    return markdown(head, rows if reasons else [row[:-1] for row in rows])


def buses() -> str:
    """Return a table with one row for each bus."""
    from robot_ik.hardware import BUSES

    kinds = {True: "simulated", False: "real"}
    return markdown(
        ("`--bus`", "what it is", "servos"),
        ((f"`{bus.name}`", bus.title, kinds[bus.virtual]) for bus in BUSES.values()),
    )


def servos() -> str:
    """Return a table with one row for each servo model."""
    from robot_ik.hardware.families.dynamixel_x_table import X_TABLES

    return markdown(
        ("model", "number", "modes"),
        (
            (f"`{name}`", table.number, ", ".join(mode.name.lower() for mode in table.modes))
            for name, table in X_TABLES.items()
        ),
    )


def faults() -> str:
    """Return a table with one row for each kind of fault."""
    from robot_ik.hardware.virtual.faults import FAULTS

    return markdown(
        ("kind", "what happens", "to a", "value"),
        (
            (f"`{name}`", kind.help, "servo" if kind.servo else "bus", kind.span)
            for name, kind in FAULTS.items()
        ),
    )


def commands() -> str:
    """Return a table with one row for each command of `robot-ik`."""
    from robot_ik.commands.main import GROUPS

    rows = [row for rows in GROUPS.values() for row in rows]
    return markdown(("command", "what it does"), ((f"`{row.name}`", row.help) for row in rows))


def flag_rows() -> list[tuple[str, str, list[str]]]:
    """Return flag, meaning and commands of all options. A flag with two meanings has two rows."""
    from robot_ik.commands.main import GROUPS, make_app
    from robot_ik.commands.usage import command_app, prepare_command

    app = make_app()
    commands: dict[tuple[str, str], list[str]] = {}
    for row in (row for rows in GROUPS.values() for row in rows):
        command = command_app(app, row.name)
        prepare_command(command)
        for argument in command.assemble_argument_collection(parse_docstring=True):
            flags = [name for name in argument.names if name.startswith("--")]
            text = " ".join((argument.parameter.help or "").split())
            meaning = text.split(". ")[0].rstrip(".")
            if flags:
                commands.setdefault((flags[0], meaning), []).append(row.name)
    return [(flag, meaning, names) for (flag, meaning), names in sorted(commands.items())]


def flags() -> str:
    """Return a table with one row for each option of `robot-ik`."""
    count = sum(len(names) for _, _, names in flag_rows())
    rows = [
        (f"`{flag}`", meaning.replace("|", "\\|"), ", ".join(f"`{name}`" for name in names))
        for flag, meaning, names in flag_rows()
    ]
    return f"{len(rows)} options, {count} uses.\n\n" + markdown(
        ("option", "meaning", "commands"), rows
    )


def keys() -> str:
    """Return a table with one row for each key of the testbed."""
    from robot_ik.testbed.keys import KEYMAP

    rows = (
        (key.about, *(f"`{k}`" if k else "" for k in (key.label, key.window))) for key in KEYMAP
    )
    return markdown(("what it does", "browser", "window"), rows)


TABLES: dict[str, Callable[..., str]] = {
    make.__name__: make
    for make in (solvers, method, options, floors, buses, servos, faults, commands, flags, keys)
}


def filled(text: str) -> str:
    """Return ``text`` with all tables filled from the program."""
    return PLACE.sub(lambda m: m[1] + TABLES[m[2]](*filter(None, [m[3]])) + m[5], text)


if __name__ == "__main__":
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page}\n")
