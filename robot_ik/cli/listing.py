"""``robot-ik robots``, ``solvers`` and ``doctor``: what there is, and what this machine can do."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import Json, Overwrite, require, single
from robot_ik.errors import ModelError
from robot_ik.hardware.checks import NOTE, OK, PROBLEM
from robot_ik.jobs.environment import import_mujoco
from robot_ik.robot_file import SERVO_ROBOT, catalogue

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

    robot: Positional[Annotated[str, single("[NAME|PATH]")]] = ""
    """Robot to show with its joints, limits and frames; without it, all are listed."""
    gallery: Annotated[
        tuple[str, ...] | None,
        arg(metavar="[FOLDER]", help_behavior_hint="(default folder: runs/<time>-gallery)"),
    ] = None
    """Draw all robots, or the one given, at home and at work: a PNG each and a sheet of all."""
    overwrite: Overwrite = False
    seed: int = 0
    """Of the drawn poses at work."""
    json: Json = False


@dataclass(frozen=True)
class SolversOptions:
    """Lists the methods, or shows one with its options, their ranges and units."""

    solver: Positional[Annotated[str, single("[NAME]")]] = ""
    """Method to show; without it, all are listed."""
    json: Json = False


# ----------------------------------------------------------------------------------- robots


def run_robots(options: RobotsOptions) -> int:
    """Prints the catalogue, which is known without MuJoCo, or one robot, or draws them."""
    if options.robot or options.gallery is not None:
        import_mujoco()
    if options.gallery is not None:
        return _gallery(options, options.gallery)
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
    cells = [
        (row["name"], row["title"], len(row["joints"]), ", ".join(row["tools"]), _yes(row["arm_file"]))
        for row in rows
    ]
    console.show(console.table("name", "title", "joints", "tools (default first)", "arm file", rows=cells))
    console.say("one in detail: robot-ik robots NAME", "dim")
    return console.DONE


def _yes(value: object) -> str:
    return "yes" if value else "no"


def catalogue_facts() -> list[dict[str, Any]]:
    """One row for each robot that comes along, from its files; MuJoCo is not asked."""
    from robot_ik.robot_file import read_robot_file

    rows = []
    for name, folder in catalogue().items():
        path, file = read_robot_file(folder / "robot.toml")
        joints = list(file.groups.get("arm", ()))
        if not joints:  # all of the model are active
            world = ElementTree.parse(path).getroot().find("worldbody")
            if world is None:
                raise ModelError("the model has no worldbody")
            joints = [j.get("name", "") for j in world.iter() if j.tag in ("joint", "freejoint")]
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


def robot_facts(robot: Robot) -> dict[str, Any]:
    """All that ``robots NAME`` shows, in SI units."""
    return {
        "schema": SCHEMA,
        "name": robot.name,
        "title": robot.file.title,
        "path": robot.path,
        "arm_file": robot.arm_file or None,
        "tool": robot.tool,
        "frames": {name: about_frame(robot, name) for name in robot.frames},
        "joints": robot.joints,
        "kinds": robot.joint_kinds,
        "lower": robot.lower,
        "upper": robot.upper,
        "home": robot.home,
        "velocity_limits": robot.velocity_limits,
        "acceleration_limits": robot.acceleration_limits,
        "sources": robot.file.sources,
    }


def about_frame(robot: Robot, name: str) -> str:
    """What ``robot.toml`` says of a tool; empty for the other sites and the bodies."""
    tool = robot.file.tools.get(name)
    return tool.about if tool else ""


def _print_robot(robot: Robot) -> None:
    shown_as = {name: f"{name} (default)" if name == robot.tool else name for name in robot.frames}
    others = [name for name in robot.frames if name not in robot.file.tools]
    head = [
        ("model", robot.path),
        ("arm file", robot.arm_file or "none"),
        *(("tool", f"{shown_as[name]}: {about_frame(robot, name)}") for name in robot.file.tools),
        ("frames", ", ".join(shown_as[name] for name in others)),
    ]
    rows, tree = [], robot.tree
    for name, kind, at_q, at_v in zip(robot.joints, robot.joint_kinds, tree.qadr, tree.vadr, strict=True):
        rotary = kind in ("hinge", "ball")
        limits = [_number(values[at_v], rotary) for values in (robot.lower, robot.upper)]
        motion = (robot.velocity_limits, robot.acceleration_limits)
        speeds = [_number(values[at_v], rotary) for values in motion]
        # A quaternion does not fit a column; --json has it.
        home = _number(robot.home[at_q], rotary) if kind in ("hinge", "slide") else "…"
        rows.append((name, kind, *limits, home, *speeds, "deg" if rotary else "m"))
    columns = ("joint", "kind", "lower", "upper", "home", "speed, /s", "accel., /s²", "unit")
    console.show(
        console.table(robot.name, robot.file.title, rows=head), "", console.table(*columns, rows=rows)
    )
    console.say("in SI units and with every digit: --json", "dim")


def _number(value: float, rotary: bool) -> str:
    if not math.isfinite(value):
        return UNBOUNDED
    return f"{math.degrees(value):z.1f}" if rotary else f"{value:z.4g}"


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
        console.print_json({"schema": SCHEMA, "solvers": rows})
        return console.DONE
    cells = [(row["name"], row["title"], goals_text(row), len(row["options"])) for row in rows]
    console.show(console.table("name", "method", "goals", "options", rows=cells))
    console.say("one with its options: robot-ik solvers NAME", "dim")
    return console.DONE


def solver_facts(name: str, kind: type[Solver]) -> dict[str, Any]:
    """Name, title, source, kinds of goals and options (default, range, unit, help) of a method."""
    from robot_ik.goals import GOALS, OrientationGoal, PoseGoal, PositionGoal

    whole = (PositionGoal, OrientationGoal, PoseGoal)  # the others ask for parts only
    goals = GOALS if kind.partial_goals else whole
    served = [goal for goal in goals if issubclass(goal, kind.goals)]
    blank = {"lower": None, "upper": None, "choices": (), "unit": "", "help": ""}
    options = [
        {"name": field.name, "default": None if field.default is MISSING else field.default}
        | {key: field.metadata.get(key, none) for key, none in blank.items()}
        for field in fields(kind)
    ]
    return {
        "name": kind.name or name,
        "title": kind.title,
        "source": kind.source,
        "goals": [goal.name for goal in served],
        "every_goal": kind.partial_goals and len(served) == len(GOALS),
        "parts": kind.partial_goals,
        "capabilities": sorted(kind.capabilities),
        "options": options,
    }


def goals_text(facts: dict[str, Any]) -> str:
    """Which goals a method serves, in short."""
    if facts["every_goal"]:
        return "every kind"
    return ", ".join(goal.removesuffix(" goal") for goal in facts["goals"])


def _print_solver(facts: dict[str, Any]) -> None:
    head = (
        ("goals", goals_text(facts)),
        ("parts of a pose", _yes(facts["parts"])),
        ("capabilities", ", ".join(facts["capabilities"]) or "nothing more"),
        ("source", facts["source"]),
    )
    rows = []
    for row in facts["options"]:
        bounded = row["lower"] is not None
        span = f"{row['lower']:g} … {row['upper']:g}" if bounded else " | ".join(row["choices"]) or UNBOUNDED
        default = f"{row['default']:g}" if isinstance(row["default"], float) else row["default"]
        rows.append((row["name"], default, span, row["unit"] or "-", row["help"]))
    console.show(
        console.table(facts["name"], facts["title"], rows=head),
        "",
        console.table("option", "default", "range", "unit", "meaning", rows=rows),
    )
    console.say(f"use them with: robot-ik solve --solver {facts['name']} --set NAME=VALUE …", "dim")


# ------------------------------------------------------------------------------------------
# ``robot-ik robots --gallery``: pictures of the robots.


def gallery_folder(arguments: Sequence[str]) -> str:
    """Where the pictures go, of what stood after ``--gallery``; empty: to a new folder.

    Raises:
        ConfigError: More than one argument, or a robot's name, which belongs before the option.
    """
    hint = "one robot alone: robot-ik robots NAME --gallery [FOLDER]"
    many = f"{len(arguments)} arguments: {' '.join(arguments)}"
    require(len(arguments) <= 1, "--gallery", many, "one folder, or nothing", hint)
    folder = arguments[0] if arguments else ""
    hint = f"this robot alone: robot-ik robots {folder} --gallery; a folder so named: ./{folder}"
    free = folder not in catalogue() or Path(folder).exists()
    require(free, "--gallery", f"{folder!r} is a robot, not a folder", "a folder, or nothing", hint)
    return folder


def _gallery(options: RobotsOptions, arguments: Sequence[str]) -> int:
    """Draws one robot, or all; 0 done, 1 some robot does not reach what it is drawn reaching for."""
    folder = gallery_folder(arguments)
    from robot_ik.jobs.gallery import draw_gallery
    from robot_ik.jobs.results import results_folder
    from robot_ik.robot import load_robot

    robots = [load_robot(name) for name in ([options.robot] if options.robot else catalogue())]
    own = [f"{one.name}.png" for one in robots] + ["gallery.png"]
    kept = results_folder(folder, "gallery", own, overwrite=options.overwrite)
    with kept as path, console.progress() as bar:
        portraits, files = draw_gallery(robots, path, options.seed, console.shares_on(bar, "drawing"))
    drawn = list(zip(portraits, files, strict=False))
    if options.json:
        rows = [
            {
                "name": portrait.robot.name,
                "poses": portrait.captions,
                "status": portrait.solution.status.name,
                "solver": portrait.solution.solver,
                "error_m": portrait.solution.error.position,
                "error_rad": portrait.solution.error.angle,
                "file": file,
            }
            for portrait, file in drawn
        ]
        console.print_json({"schema": SCHEMA, "robots": rows, "sheet": files[-1]})
    else:
        cells = [(one.robot.name, *one.captions, _met(one), one.solution.solver, file) for one, file in drawn]
        console.show(console.table("name", "at home", "at work", "goals", "solver", "file", rows=cells))
        console.result(f"all on one sheet: {files[-1]}")
    return console.DONE if all(one.solution.converged for one in portraits) else console.NOT_ACHIEVED


def _met(portrait: Portrait) -> str:
    return "met" if portrait.solution.converged else f"missed: {portrait.solution.status.name}"


# ------------------------------------------------------------------------------------------
# ``robot-ik doctor``: one table of what this machine can do, with what to do about the rest.


_STYLE = {OK: "green", NOTE: "yellow", PROBLEM: "bold red"}


@dataclass(frozen=True)
class DoctorOptions:
    """Looks at this machine: versions, OpenGL, display, serial ports, cameras; with --bus at servos, too.

    Takes a few seconds, moves nothing, opens no serial port but that of --bus. OpenGL, the display and the
    cameras are tried in child processes. Exit code 0 when everything that robot_ik needs works, else 2;
    notes are about things that you may never need.
    """

    bus: Annotated[str, single("PORT", "none")] = ""
    """Also ask the servos on this port: who is missing or doubled, firmware, supply, errors, delays."""
    arm: Annotated[str, arg(metavar="FILE|NAME")] = SERVO_ROBOT
    """For --bus: which servos should be there (an arm file, or a robot that has one)."""
    json: Json = False


def run_doctor(options: DoctorOptions) -> int:
    """Prints the report; 0 when nothing required is broken, else 2."""
    from robot_ik.jobs.doctor import CHECKS, run_checks

    config = None
    if options.bus:
        from robot_ik.cli.connection import load_arm, served_or_serial_port

        config = load_arm(options.arm)  # a wrong name is reported at once
    with console.busy("looking at this machine"):
        rows = run_checks(CHECKS)
    if config is not None:
        from robot_ik.hardware.health import servo_rows

        asking = console.busy(f"asking the servos on {options.bus}")
        with asking, served_or_serial_port(options.bus, options.arm) as port:
            rows += servo_rows(port, config)
    problems = sum(row.status == PROBLEM for row in rows)
    if options.json:
        console.print_json({"schema": SCHEMA, "ok": not problems, "rows": [asdict(row) for row in rows]})
    else:
        cells = [(row.what, Text(row.status, style=_STYLE[row.status]), row.found, row.do) for row in rows]
        verdict, style = "nothing required is broken", "green"
        if problems:
            verdict, style = f"{console.count_of(problems, 'problem')}: see what to do", "bold red"
        console.show(
            console.table("what", "is", "found", "what to do", rows=cells), Text(f"\n{verdict}", style=style)
        )
    return console.WRONG_INPUT if problems else console.DONE
