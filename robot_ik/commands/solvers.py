"""``robot-ik solvers``: list the solvers, or the options of one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.options import JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.solvers.base import Solver

NO_METADATA = {"lower": None, "upper": None, "choices": (), "unit": "", "help": ""}
"""Metadata of an option that has none."""


@dataclass(frozen=True)
class Solvers(JsonOption):
    """List the solvers, or describe one with its options, their ranges and units.

    Use the options with robot-ik solve.

        robot-ik solvers dls
        robot-ik solve --goal -0.4 -0.1 0.7 --solver dls --set damping=0.02
    """

    solver: Annotated[str, Parameter(name="NAME")] = ""
    """Solver to describe. Default: list all."""

    def run(self, terminal: Terminal = QUIET) -> SolversReport | SolverReport:
        """Read the table of solvers."""
        from robot_ik.solvers import SOLVERS  # Numba

        terminal.progress("reading")
        if self.solver:
            return SolverReport(solver_facts(self.solver, SOLVERS[self.solver]))
        return SolversReport([solver_facts(name, kind) for name, kind in SOLVERS.items()])


@dataclass(frozen=True, eq=False)
class SolversReport(Report):
    """All solvers."""

    rows: Sequence[Mapping[str, Any]]

    @property
    def hints(self) -> Sequence[str]:
        return ("one with its options: robot-ik solvers NAME",)

    def tables(self) -> Iterable[Table]:
        cells = [
            (row["name"], row["title"], goals_text(row), len(row["options"])) for row in self.rows
        ]
        yield table("name", "method", "goals", "options", rows=cells)

    def facts(self) -> dict[str, Any]:
        return {"solvers": self.rows}


@dataclass(frozen=True, eq=False)
class SolverReport(Report):
    """One solver with its options."""

    solver: Mapping[str, Any]

    @property
    def hints(self) -> Sequence[str]:
        name = self.solver["name"]
        return (f"use them with: robot-ik solve --solver {name} --set NAME=VALUE …",)

    def tables(self) -> Iterable[Table]:
        facts = self.solver
        head = (
            ("goals", goals_text(facts)),
            ("parts of a pose", "yes" if facts["parts"] else "no"),
            ("capabilities", ", ".join(facts["capabilities"]) or "none"),
            ("source", facts["source"]),
        )
        yield table(facts["name"], facts["title"], rows=head)
        columns = ("option", "default", "range", "unit", "meaning")
        yield table(*columns, rows=map(_option_cells, facts["options"]))

    def facts(self) -> Mapping[str, Any]:
        return self.solver


def solver_facts(name: str, kind: type[Solver]) -> dict[str, Any]:
    """Return name, title, source, goals and options of a solver.

    An option has a default, a range or choices, a unit and a help text.
    """
    from robot_ik.goals import GOALS, OrientationGoal, PoseGoal, PositionGoal

    # The other goals constrain a part of a position or of an orientation.
    goals = GOALS if kind.partial_goals else (PositionGoal, OrientationGoal, PoseGoal)
    supported = [goal for goal in goals if issubclass(goal, kind.goals)]
    options = []
    for item in fields(kind):
        default = None if item.default is MISSING else item.default
        metadata = {key: item.metadata.get(key, none) for key, none in NO_METADATA.items()}
        options.append({"name": item.name, "default": default, **metadata})
    return {
        "name": kind.name or name,
        "title": kind.title,
        "source": kind.source,
        "goals": [goal.name for goal in supported],
        "every_goal": kind.partial_goals and len(supported) == len(GOALS),
        "parts": kind.partial_goals,
        "capabilities": sorted(kind.capabilities),
        "options": options,
    }


def goals_text(facts: Mapping[str, Any]) -> str:
    """Return the goals that a solver supports, in short."""
    if facts["every_goal"]:
        return "every kind"
    return ", ".join(goal.removesuffix(" goal") for goal in facts["goals"])


def _option_cells(option: Mapping[str, Any]) -> tuple[object, ...]:
    limits = " | ".join(option["choices"]) or "-"
    if option["lower"] is not None:
        limits = f"{option['lower']:g} … {option['upper']:g}"
    default = option["default"]
    text = f"{default:g}" if isinstance(default, float) else default
    return option["name"], text, limits, option["unit"] or "-", option["help"]
