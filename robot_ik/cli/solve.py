"""``robot-ik solve``: a goal in, joint angles out, one JSON object on stdout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import XYZ_WXYZ, require, several, single, wrong
from robot_ik.cli.listing import joint_kinds

if TYPE_CHECKING:
    from robot_ik.goals import PoseGoal, PositionGoal
    from robot_ik.problem import Problem
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution


#: Version of the JSON object; raised when a field changes its meaning.
SCHEMA = 2
_BOOLEANS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


@dataclass(frozen=True)
class SolveOptions:
    """Finds joint angles that bring a frame of a robot to a goal, and prints them as JSON.

    Metres and radians, quaternions as w x y z, goals in the world frame.

        robot-ik solve --goal -0.4 -0.1 0.7

    Exit code 0: the goal is met. 1: it is not; the nearest joint angles found are printed all the same.
    2: wrong input.
    """

    robot: Annotated[str, arg(metavar="NAME|PATH")] = "puma560"
    """A name of `robot-ik robots`, or any MJCF or URDF file."""
    goal: Annotated[tuple[float, ...], arg(metavar=XYZ_WXYZ, help_behavior_hint="(required)")] = ()
    """Wanted position in metres, and, if given, orientation as a quaternion."""
    frame: Annotated[str | None, single("STR", "the robot's tool")] = None
    """What shall get there: a tool, site or body of the robot."""
    solver: Annotated[str, single(None, "the robot's own")] = ""
    """Method: see `robot-ik solvers`."""
    set: Annotated[tuple[str, ...], several("NAME=VALUE")] = ()
    """Options of the method: see `robot-ik solvers NAME`."""
    start: Annotated[tuple[float, ...], several("Q", "home")] = ()
    """Joint angles to start from, rad (m for slides)."""
    seed: int = 0
    """Of the random restarts: the same seed gives the same answer."""
    position_tolerance: Annotated[float, arg(metavar="M")] = 1e-4
    """Largest distance that still counts as reached, metres."""
    angle_tolerance: Annotated[float, arg(metavar="RAD")] = 1e-3
    """Largest angle that still counts as reached, radians."""
    iterations: int = 20_000
    """Steps of all descents together before the solve ends."""
    restarts: Annotated[int | None, single("INT", "the method's own")] = None
    """Random restarts; 0 for a local solution near the start."""
    json: bool = True
    """Print JSON; --no-json prints a table in degrees and millimetres."""


def run(options: SolveOptions) -> int:
    """Solves and prints; 0 converged, 1 not."""
    from robot_ik.budget import Budget
    from robot_ik.goals import Tolerance
    from robot_ik.problem import Problem
    from robot_ik.robot import load_robot
    from robot_ik.solvers import make_solver, solver_name

    goal = make_goal(options.goal, options.frame)
    robot = load_robot(options.robot)
    name = solver_name(options.solver, robot.file)
    solver = make_solver(name, **solver_options(name, options.set))
    tolerance = Tolerance(position=options.position_tolerance, angle=options.angle_tolerance)
    budget = Budget(iterations=options.iterations, restarts=options.restarts)
    problem = Problem(robot, goal, solver=solver, tolerance=tolerance, budget=budget, seed=options.seed)
    start = options.start or None
    with console.busy("solving"):
        problem.solve(start)
    # The first solve of a process loads or compiles the kernel; the same again shows what a solve costs.
    solution = problem.solve(start)
    facts = solution_facts(problem, solution)
    if options.json:
        console.print_json(facts)
    else:
        _print_table(robot, facts)
    return console.DONE if solution.converged else console.NOT_ACHIEVED


def make_goal(numbers: Sequence[float], frame: str | None = None) -> PositionGoal | PoseGoal:
    """The goal of three numbers (position, metres) or seven (position, then quaternion wxyz).

    No ``frame`` means the robot's tool.

    Raises:
        ConfigError, InvalidGoalError: Another count, a number that is not finite, or a zero quaternion.
    """
    from robot_ik.goals import PoseGoal, PositionGoal

    given = f"{len(numbers)} numbers" if numbers else "no goal is given"
    allowed, example = "3: x y z in metres, or 7: then w x y z", "for example: --goal -0.4 -0.1 0.7"
    require(len(numbers) in (3, 7), "--goal", given, allowed, example)
    return PositionGoal(frame, numbers) if len(numbers) == 3 else PoseGoal(frame, numbers[:3], numbers[3:])


def solver_options(solver: str, items: Sequence[str]) -> dict[str, int | float | bool | str]:
    """Options of a method from ``NAME=VALUE`` arguments, with the types of its fields.

    Raises:
        ConfigError: No ``=``, or a value that is not of the option's type.  Names and ranges are
            checked by the method itself.
    """
    from robot_ik.solvers import SOLVERS

    defaults = {field.name: field.default for field in fields(SOLVERS[solver])}
    found: dict[str, int | float | bool | str] = {}
    for item in items:
        name, equals, text = item.partition("=")
        default = defaults.get(name, 0.0)
        kind: type = type(default) if isinstance(default, (bool, int, float, str)) else float
        try:
            if not equals:
                raise ValueError
            found[name] = _BOOLEANS[text.lower()] if kind is bool else kind(text)
        except (ValueError, KeyError):
            allowed = f"NAME=VALUE with a value of type {kind.__name__}"
            raise wrong("--set", f"not {item!r}", allowed) from None
    return found


def solution_facts(problem: Problem, solution: Solution) -> dict[str, Any]:
    """What is printed of a solution: SI units, quaternions wxyz, world frame."""
    robot, goal = problem.robot, problem.goals[0]
    wanted = goal.target
    return {
        "schema": SCHEMA,
        "robot": robot.name,
        "solver": solution.solver,
        "frame": goal.frame or robot.tool,
        "goal": {"position": wanted.position, "wxyz": wanted.wxyz if goal.weights[1] > 0.0 else None},
        "converged": solution.converged,
        "status": solution.status.name.lower(),
        "meaning": solution.status.meaning,
        "joints": list(robot.joints),
        "q": solution.q,
        "error": {"position": solution.error.position, "angle": solution.error.angle},
        "tolerance": {"position": problem.tolerance.position, "angle": problem.tolerance.angle},
        "iterations": solution.iterations,
        "restarts": solution.restarts,
        "seed": problem.seed,
        "seconds": solution.seconds,
    }


def _print_table(robot: Robot, facts: dict[str, Any]) -> None:
    error = facts["error"]
    effort = [console.count_of(facts[f"{what}s"], what) for what in ("iteration", "restart")]
    head = (
        ("status", f"{facts['status']}: {facts['meaning']}"),
        ("error", f"{1e3 * error['position']:.4f} mm, {math.degrees(error['angle']):.4f} deg"),
        ("effort", ", ".join(effort)),
        ("time", f"{1e6 * facts['seconds']:.0f} µs"),
    )
    rows = []
    numbers = iter(facts["q"])
    for name, kind in zip(robot.joints, joint_kinds(robot), strict=True):
        values = [next(numbers) for _ in range({"free": 7, "ball": 4}.get(kind, 1))]
        unit = {"hinge": "deg", "slide": "m", "ball": "wxyz", "free": "m, wxyz"}[kind]
        plain = " ".join(f"{value:z9.5f}" for value in values)
        rows.append((name, f"{math.degrees(values[0]):z9.3f}" if kind == "hinge" else plain, unit))
    console.show(
        console.table("solver", facts["solver"], rows=head),
        "",
        console.table("joint", "q", "unit", rows=rows),
    )
