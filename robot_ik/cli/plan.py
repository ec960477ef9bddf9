"""``robot-ik plan``: a motion around obstacles, as a table or JSON, and as a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    XYZ_WXYZ,
    Json,
    Overwrite,
    Range,
    Speed,
    make_goal,
    positive,
    require,
    robot_argument,
    several,
    single,
    wrong,
)

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.geometry import Array
    from robot_ik.goals import Goal
    from robot_ik.motion.plan import Plan
    from robot_ik.robot import Robot

SCHEMA = 1
"""Version of the JSON object. It is raised when a field changes its meaning."""


@dataclass(frozen=True)
class PlanOptions:
    """Plans a motion around obstacles, and proves that it is free.

    Metres and radians, quaternions as w x y z, goals in the world frame.

        robot-ik plan --scene shelf.xml --goal 0.4 0.1 0.7 --out motion.csv

    Exit code 0: a motion was found. 1: none was found; the reason is printed. 2: wrong input.
    """

    robot: Annotated[str, robot_argument("puma560")] = "puma560"
    scene: Annotated[Path | None, single("FILE.xml", "the robot alone")] = None
    """Obstacles around the robot: an MJCF file without joints."""
    start: Annotated[tuple[float, ...], several("Q", "home")] = ()
    """Joint angles at the start, rad (m for slides)."""
    goal: Annotated[tuple[float, ...], single(XYZ_WXYZ, "or --goal-q")] = ()
    """Position of the frame at the end in metres, and, if given, its orientation."""
    goal_q: Annotated[tuple[float, ...], several("Q", "or --goal")] = ()
    """Joint angles at the end, rad (m for slides)."""
    frame: Annotated[str | None, single("NAME", "the robot's tool")] = None
    """The frame that moves to --goal: a tool, site or body of the robot."""
    margin: Annotated[float, arg(metavar="M"), Range(0.0, what=" m")] = 0.005
    """Smallest allowed distance of two parts, metres."""
    ignore: Annotated[tuple[str, ...], several("PART:PART", "none")] = ()
    """Pairs of bodies or geoms that may touch anywhere."""
    allowed: Annotated[tuple[str, ...], several("PART:PART", "none")] = ()
    """Pairs that may touch at the start and at the goal, such as gripper and part."""
    speed: Speed = 1.0
    rate: Annotated[float, arg(metavar="HZ"), positive(what=" Hz")] = 100.0
    """Samples a second of the motion."""
    seed: int = 0
    """Seed of the random postures. The same seed gives the same motion."""
    iterations: Annotated[int, arg(metavar="N")] = 20_000
    """Random postures before the search ends."""
    seconds: Annotated[float | None, single("S", "no limit"), positive(what=" s")] = None
    """Time before the search ends, seconds. The result then depends on the machine."""
    out: Annotated[Path | None, single("FILE.csv", "none")] = None
    """Write the motion: time and joint angles."""
    overwrite: Overwrite = False
    json: Json = False


def run(options: PlanOptions) -> int:
    """Plan and print; 0 found, 1 not found."""
    from robot_ik.budget import Budget
    from robot_ik.jobs.results import claimed
    from robot_ik.motion.plan import plan
    from robot_ik.robot import load_robot

    goal = _goal(options)
    robot = load_robot(options.robot)
    collisions = _collisions(options, robot)
    start = _joint_angles(robot, options.start, "--start") if options.start else robot.home
    with claimed(options.out, overwrite=options.overwrite):
        with console.busy("planning"):
            result = plan(
                robot,
                start,
                _joint_angles(robot, options.goal_q, "--goal-q") if goal is None else goal,
                collisions=collisions,
                allowed=_pairs(options.allowed, "--allowed"),
                budget=Budget(iterations=options.iterations, seconds=options.seconds),
                seed=options.seed,
                speed=options.speed,
                rate=options.rate,
            )
        if options.out is not None and result.trajectory is not None:
            result.trajectory.save_csv(options.out)
    if options.json:
        console.print_json(plan_facts(robot, result, options))
    else:
        _print_tables(robot, result, options)
    return console.DONE if result.found else console.NOT_ACHIEVED


def _goal(options: PlanOptions) -> Goal | None:
    """Return the goal in task space; None for joint angles."""
    problem = "both --goal and --goal-q are given" if options.goal else "no goal is given"
    allowed = "one of --goal X Y Z [W X Y Z] and --goal-q Q …"
    require(bool(options.goal) != bool(options.goal_q), "--goal", problem, allowed)
    if options.goal:
        return make_goal(options.goal, options.frame)
    require(options.frame is None, "--frame", "joint angles have no frame", "with --goal")
    return None


def _joint_angles(robot: Robot, numbers: Sequence[float], option: str) -> tuple[float, ...]:
    """Return the numbers of an option as joint angles.

    Raises:
        ConfigError: A number is not finite, or there is not one for each joint.
    """
    problem = f"{len(numbers)} numbers"
    require(len(numbers) == robot.nq, option, problem, f"{robot.nq}: {' '.join(robot.joints)}")
    require(all(map(math.isfinite, numbers)), option, "a number is not finite", "finite numbers")
    return tuple(numbers)


def _pairs(items: Sequence[str], option: str) -> list[tuple[str, str]]:
    """Return pairs of names from ``PART:PART`` items.

    Raises:
        ConfigError: An item is not two names.
    """
    pairs = []
    for item in items:
        first, colon, second = item.partition(":")
        if not (colon and first and second) or ":" in second:
            raise wrong(option, repr(item), "PART:PART, e.g. gripper:crate")
        pairs.append((first, second))
    return pairs


def _collisions(options: PlanOptions, robot: Robot) -> CollisionAvoidance:
    """Return the condition: the robot among the obstacles of the scene file."""
    from robot_ik.workcell.motion_condition import condition_among

    ignore = _pairs(options.ignore, "--ignore")
    return condition_among(robot, options.scene, options.margin, ignore)


def plan_facts(robot: Robot, result: Plan, options: PlanOptions) -> dict[str, Any]:
    """Return the JSON object: SI units, as described in docs/how-to/collisions.md."""
    trajectory = result.trajectory
    return {
        "schema": SCHEMA,
        "robot": robot.name,
        "found": result.found,
        "status": result.status.name.lower(),
        "meaning": result.meaning,
        "joints": list(robot.joints),
        "corners": None if result.corners is None else result.corners.tolist(),
        "duration": None if trajectory is None else trajectory.duration,
        "certified": trajectory is not None and trajectory.certified,
        "clearance": None if trajectory is None else trajectory.clearance,
        "margin": result.margin,
        "goal_postures": result.goal_postures,
        "iterations": result.iterations,
        "restarts": result.restarts,
        "nodes": list(result.nodes),
        "seed": options.seed,
        "seconds": result.seconds,
    }


def _print_tables(robot: Robot, result: Plan, options: PlanOptions) -> None:
    """Print the result, and the corners in degrees and millimetres."""
    rows = [("status", f"{result.status.name.lower()}: {result.meaning}")]
    trajectory = result.trajectory
    if trajectory is not None and trajectory.clearance is not None:
        rows.append(("proven", f"every part keeps {1e3 * trajectory.clearance:.1f} mm"))
    elif trajectory is not None:
        rows.append(("proven", "no: a part comes so near to the margin that nothing is proven"))
    if trajectory is not None:
        rows.append(("motion", f"{trajectory.duration:.2f} s at {options.rate:g} Hz"))
    searched = [
        console.count_of(result.iterations, "iteration"),
        console.count_of(result.restarts, "restart"),
    ]
    rows += [
        ("search", f"{', '.join(searched)}, {sum(result.nodes)} nodes"),
        ("time", f"{1e3 * result.seconds:.1f} ms"),
    ]
    tables: list[Any] = [console.table("plan", robot.name, rows=rows)]
    if result.corners is not None:
        tables += ["", _corner_table(robot, result.corners)]
    console.show(*tables)
    if trajectory is not None and options.out is not None:
        console.result(f"motion in {options.out}")


def _corner_table(robot: Robot, corners: Array) -> Any:
    """Return the table of the corners (k, nq): a row for each joint, a column for each corner."""
    rows = []
    for k, (name, kind) in enumerate(zip(robot.joints, robot.joint_kinds, strict=True)):
        scale = math.degrees(1.0) if kind == "hinge" else 1e3
        values = [f"{scale * row[k]:z8.1f}" for row in corners]
        rows.append((name, *values, "deg" if kind == "hinge" else "mm"))
    middle = [str(k) for k in range(1, len(corners) - 1)]
    heads = ["start", *middle, "goal"][: len(corners)]
    return console.table("joint", *heads, "unit", rows=rows)
