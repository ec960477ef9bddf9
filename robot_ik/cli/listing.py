"""``robot-ik robots`` and ``robot-ik solvers``: what there is, from the model folders and ``SOLVERS``."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.errors import ConfigError

if TYPE_CHECKING:
    from robot_ik.jobs.gallery import Portrait
    from robot_ik.robot import Robot
    from robot_ik.solvers.base import Solver


#: Version of the JSON objects; raised when a field changes its meaning.
SCHEMA = 1
UNBOUNDED = "-"


@dataclass(frozen=True)
class RobotsOptions:
    """Lists the robots that come along, shows one in detail, or draws them.

    Any MJCF or URDF file works as well: robot-ik robots path/to/arm.xml
    """

    robot: Positional[Annotated[str, arg(metavar="[NAME|PATH]", help_behavior_hint="")]] = ""
    """Robot to show with its joints, limits and frames; without it, all are listed."""
    gallery: Annotated[
        tuple[str, ...] | None,
        arg(metavar="[FOLDER]", help_behavior_hint="(default folder: runs/<time>-gallery)"),
    ] = None
    """Draw all robots, or the one given, at home and at work: a PNG each and a sheet of all."""
    overwrite: bool = False
    """The folder of --gallery may hold pictures of these names: they are replaced."""
    seed: int = 0
    """Of the drawn poses at work."""
    json: bool = False
    """Print one JSON object instead of tables."""


@dataclass(frozen=True)
class SolversOptions:
    """Lists the methods, or shows one with its options, their ranges and units."""

    solver: Positional[Annotated[str, arg(metavar="[NAME]", help_behavior_hint="")]] = ""
    """Method to show; without it, all are listed."""
    json: bool = False
    """Print one JSON object instead of tables."""


# ----------------------------------------------------------------------------------- robots


def run_robots(options: RobotsOptions) -> int:
    """Prints the catalogue, or one robot, or draws them."""
    if options.gallery is not None:
        return run_gallery(
            options.robot, options.gallery, options.seed, json=options.json, overwrite=options.overwrite
        )
    if options.robot:
        from robot_ik.robot import load_robot

        robot = load_robot(options.robot)
        if options.json:
            console.print_json(robot_facts(robot))
        else:
            _print_robot(robot)
        return console.DONE
    rows = catalogue_facts()
    if options.json:
        console.print_json({"schema": SCHEMA, "robots": rows})
        return console.DONE
    shown = console.table("name", "title", "joints", "tools (default first)", "arm file")
    for row in rows:
        tools, arm = ", ".join(row["tools"]), "yes" if row["arm_file"] else "no"
        shown.add_row(row["name"], Text(row["title"]), str(len(row["joints"])), tools, arm)
    console.out().print(shown)
    console.say("one in detail: robot-ik robots NAME", "dim")
    return console.DONE


def catalogue_facts() -> list[dict[str, Any]]:
    """One row for each robot that comes along, from its files; MuJoCo is not asked."""
    from robot_ik.robot_file import catalogue, read_robot_file

    rows = []
    for name, folder in catalogue().items():
        path, file = read_robot_file(folder / "robot.toml")
        # Without a group of that name all joints of the model are active.
        joints = list(file.groups.get("arm", ())) or _joints_of(path)
        arm = folder / "arm.toml"
        rows.append(
            {
                "name": name,
                "title": file.title,
                "joints": joints,
                "tools": sorted(file.tools, key=lambda tool: tool != file.tool),
                "arm_file": str(arm) if arm.is_file() else None,
            }
        )
    return rows


def _joints_of(model: Path) -> list[str]:
    """Names of the joints in an MJCF file of the catalogue, in declared order."""
    world = ElementTree.parse(model).getroot().find("worldbody")
    assert world is not None
    return [joint.get("name", "") for joint in world.iter() if joint.tag in ("joint", "freejoint")]


def robot_facts(robot: Robot) -> dict[str, Any]:
    """All that ``robots NAME`` shows, in SI units."""
    return {
        "schema": SCHEMA,
        "name": robot.name,
        "title": robot.file.title,
        "path": str(robot.path),
        "arm_file": str(robot.arm_file) if robot.arm_file else None,
        "tool": robot.tool,
        "frames": {name: about_frame(robot, name) for name in robot.frames},
        "joints": list(robot.joints),
        "kinds": joint_kinds(robot),
        "lower": robot.lower,
        "upper": robot.upper,
        "home": robot.home,
        "velocity": robot.velocity,
        "acceleration": robot.acceleration,
        "sources": list(robot.file.sources),
    }


def about_frame(robot: Robot, name: str) -> str:
    """What ``robot.toml`` says of a tool; empty for the other sites and the bodies."""
    tool = robot.file.tools.get(name)
    return tool.about if tool else ""


def joint_kinds(robot: Robot) -> list[str]:
    """``free``, ``ball``, ``slide`` or ``hinge`` for each active joint."""
    from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE

    names = {FREE: "free", BALL: "ball", SLIDE: "slide", HINGE: "hinge"}
    return [names[int(kind)] for kind in robot.tree.kind]


def _print_robot(robot: Robot) -> None:
    screen = console.out()
    head = console.table(robot.name, robot.file.title)
    head.add_row("model", Text(str(robot.path)))
    head.add_row("arm file", Text(str(robot.arm_file or "none")))
    for name in robot.file.tools:
        default = " (default)" if name == robot.tool else ""
        head.add_row("tool", Text(f"{name}{default}: {about_frame(robot, name)}"))
    others = [name for name in robot.frames if name not in robot.file.tools]
    head.add_row("frames", Text(", ".join(f"{f} (default)" if f == robot.tool else f for f in others)))
    screen.print(head)
    screen.print()
    shown = console.table("joint", "kind", "lower", "upper", "home", "velocity", "acceleration", "unit")
    at_q = at_v = 0
    for name, kind in zip(robot.joints, joint_kinds(robot), strict=True):
        turns = kind in ("hinge", "ball")
        limits = [_number(values[at_v], turns) for values in (robot.lower, robot.upper)]
        speeds = [_number(values[at_v], turns) for values in (robot.velocity, robot.acceleration)]
        # A quaternion does not fit a column; --json has it.
        home = _number(robot.home[at_q], turns) if kind in ("hinge", "slide") else "…"
        shown.add_row(name, kind, *limits, home, *speeds, "deg" if turns else "m")
        at_q += {"free": 7, "ball": 4}.get(kind, 1)
        at_v += {"free": 6, "ball": 3}.get(kind, 1)
    screen.print(shown)
    console.say("in SI units and with every digit: --json", "dim")


def _number(value: float, turns: bool) -> str:
    if not math.isfinite(value):
        return UNBOUNDED
    return f"{math.degrees(value):.1f}" if turns else f"{value:.4g}"


# ---------------------------------------------------------------------------------- solvers


def run_solvers(options: SolversOptions) -> int:
    """Prints the table of methods, or one method with its options."""
    from robot_ik.solvers import SOLVERS

    if options.solver:
        facts = solver_facts(options.solver, SOLVERS[options.solver])
        if options.json:
            console.print_json({"schema": SCHEMA, **facts})
        else:
            _print_solver(facts)
        return console.DONE
    rows = [solver_facts(name, kind) for name, kind in SOLVERS.items()]
    if options.json:
        console.print_json({"schema": SCHEMA, "auto": SOLVERS["auto"].name, "solvers": rows})
        return console.DONE
    shown = console.table("name", "method", "goals", "options")
    for row in rows:
        shown.add_row(row["name"], Text(row["title"]), goals_text(row), str(len(row["options"])))
    console.out().print(shown)
    console.say(f"auto chooses {SOLVERS['auto'].name}; the options of one: robot-ik solvers NAME", "dim")
    return console.DONE


def solver_facts(name: str, kind: type[Solver]) -> dict[str, Any]:
    """Name, title, source, kinds of goals and options (default, range, unit, help) of a method."""
    from robot_ik.goals import GOALS

    options = [
        {
            "name": field.name,
            "default": None if field.default is MISSING else field.default,
            "low": field.metadata.get("low"),
            "high": field.metadata.get("high"),
            "choices": list(field.metadata.get("choices", ())),
            "unit": field.metadata.get("unit", ""),
            "help": field.metadata.get("help", ""),
        }
        for field in fields(kind)
    ]
    return {
        "name": kind.name or name,
        "title": kind.title,
        "source": kind.source,
        "goals": [goal.name for goal in kind.goals],
        "every_goal": kind.partial_goals and set(kind.goals) >= set(GOALS),
        "parts": kind.partial_goals,
        "capabilities": sorted(kind.capabilities),
        "options": options,
    }


def goals_text(facts: dict[str, Any]) -> str:
    """Which goals a method serves, in few words."""
    if facts["every_goal"]:
        return "every kind"
    return ", ".join(goal.removesuffix(" goal") for goal in facts["goals"])


def _print_solver(facts: dict[str, Any]) -> None:
    screen = console.out()
    head = console.table(facts["name"], facts["title"])
    head.add_row("goals", goals_text(facts))
    head.add_row("parts of a pose", "yes" if facts["parts"] else "no")
    head.add_row("capabilities", ", ".join(facts["capabilities"]) or "nothing more")
    head.add_row("source", Text(facts["source"]))
    screen.print(head)
    screen.print()
    shown = console.table("option", "default", "range", "unit", "meaning")
    for row in facts["options"]:
        bounded = row["low"] is not None
        span = f"{row['low']:g} … {row['high']:g}" if bounded else " | ".join(row["choices"]) or UNBOUNDED
        default = f"{row['default']:g}" if isinstance(row["default"], float) else str(row["default"])
        shown.add_row(row["name"], default, span, row["unit"] or "-", Text(row["help"]))
    screen.print(shown)
    console.say(f"use them with: robot-ik solve --solver {facts['name']} --set NAME=VALUE …", "dim")


# ------------------------------------------------------------------------------------------
# ``robot-ik robots --gallery``: pictures of the robots.


def gallery_folder(words: Sequence[str]) -> str:
    """Where the pictures go; empty: to a new folder.

    Args:
        words: What stood after ``--gallery``: nothing, or a folder.

    Raises:
        ConfigError: More than one word, or a robot's name, which belongs before the option.
    """
    from robot_ik.robot_file import catalogue

    if len(words) > 1:
        raise ConfigError(
            f"{len(words)} words after --gallery: {' '.join(words)}", file="robot-ik robots", key="--gallery",
            allowed="one folder, or nothing", hint="one robot alone: robot-ik robots NAME --gallery [FOLDER]",
        )  # fmt: skip
    if words and words[0] in catalogue() and not Path(words[0]).exists():
        raise ConfigError(
            f"{words[0]!r} is a robot, not a folder", file="robot-ik robots", key="--gallery",
            allowed="a folder, or nothing",
            hint=f"this robot alone: robot-ik robots {words[0]} --gallery; a folder so named: ./{words[0]}",
        )  # fmt: skip
    return words[0] if words else ""


def run_gallery(robot: str, words: Sequence[str], seed: int, *, json: bool, overwrite: bool) -> int:
    """Draws one robot, or all; 0 done, 1 some robot does not reach what it is drawn reaching for."""
    folder = gallery_folder(words)
    from robot_ik.jobs.gallery import draw_gallery
    from robot_ik.jobs.results import results_folder
    from robot_ik.robot import load_robot
    from robot_ik.robot_file import catalogue

    robots = [load_robot(name) for name in ([robot] if robot else catalogue())]
    own = [f"{one.name}.png" for one in robots] + ["gallery.png"]
    with results_folder(folder, "gallery", own, overwrite=overwrite) as place, console.progress() as bar:
        task = bar.add_task("drawing", total=len(robots), note="")
        portraits, files = draw_gallery(
            robots, place, seed, progress=lambda name, k: bar.update(task, completed=k, note=name)
        )
    if json:
        rows = [_facts(portrait, file) for portrait, file in zip(portraits, files, strict=False)]
        console.print_json({"schema": SCHEMA, "robots": rows, "sheet": str(files[-1])})
    else:
        _print(portraits, files)
    return console.DONE if all(p.solution.converged for p in portraits) else console.NOT_ACHIEVED


def _facts(portrait: Portrait, file: Path) -> dict[str, object]:
    solution = portrait.solution
    return {
        "name": portrait.robot.name,
        "poses": list(portrait.captions),
        "status": solution.status.name,
        "solver": solution.solver,
        "miss_m": solution.miss.position,
        "miss_rad": solution.miss.angle,
        "file": str(file),
    }


def _print(portraits: Sequence[Portrait], files: Sequence[Path]) -> None:
    shown = console.table("name", "at home", "at work", "goals", "solver", "file")
    for portrait, file in zip(portraits, files, strict=False):
        solution = portrait.solution
        met = "met" if solution.converged else f"missed: {solution.status.name}"
        shown.add_row(portrait.robot.name, *portrait.captions, met, solution.solver, str(file))
    console.out().print(shown)
    console.result(f"all on one sheet: {files[-1]}")
