"""``robot-ik plan``: plan a motion around obstacles, and prove that it is free."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import (
    OUTPUT,
    OUTPUT_GROUP,
    FrameName,
    GoalNumbers,
    Iterations,
    JsonOption,
    Margin,
    OverwriteOption,
    RobotName,
    SceneFile,
    Seconds,
    Seed,
    Speed,
    StartNumbers,
    parse_goal,
)
from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.geometry import Array
    from robot_ik.goals import Goal
    from robot_ik.motion.plan import Plan as PlannedMotion
    from robot_ik.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Plan(OverwriteOption, JsonOption):
    """Plan a motion around obstacles, and prove that it is free.

    Metres and radians, quaternions as w x y z, goals in the world frame.

        robot-ik plan --scene shelf.xml --goal 0.4 0.1 0.7 --out motion.csv

    Exit code 0: a motion was found. 1: none was found, and the reason is printed.
    """

    goal: GoalNumbers = ()
    goal_q: Annotated[tuple[float, ...], Parameter(metavar="Q …", consume_multiple=True)] = ()
    """Joint angles at the end in rad (slides: m), instead of --goal."""
    robot: RobotName = "puma560"
    frame: FrameName = None
    start: StartNumbers = ()
    scene: SceneFile = None
    margin: Margin = 0.005
    ignore: Annotated[
        tuple[str, ...],
        Parameter(metavar="PART:PART …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Pairs of bodies or geoms that may touch anywhere."""
    allowed: Annotated[
        tuple[str, ...],
        Parameter(metavar="PART:PART …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Pairs that may touch at the start and at the goal, such as gripper and part."""
    speed: Speed = 1.0
    rate: Annotated[float, Parameter(metavar="HZ", validator=Number(gt=0, lt=math.inf))] = 100.0
    """Samples a second."""
    seed: Seed = 0
    iterations: Iterations = 20_000
    seconds: Annotated[
        Seconds | None,
        Parameter(
            help="Duration, in s. The search ends then, and its result depends on the machine. "
            "Default: no limit."
        ),
    ] = None
    out: Annotated[Path | None, Parameter(metavar="FILE.csv", group=OUTPUT_GROUP), OUTPUT] = None
    """Destination of the results. A file with time and joint angles; default: none."""

    def run(self, terminal: Terminal = QUIET) -> PlanReport:
        """Plan the motion, and write it."""
        # MuJoCo and Numba take 0.9 s to import, --help takes 0.1 s.
        from robot_ik.budget import Budget
        from robot_ik.motion.plan import plan
        from robot_ik.robot import load_robot
        from robot_ik.workcell.motion_condition import condition_among

        goal = self._goal()
        ignore = parse_part_pairs("--ignore", self.ignore)
        allowed = parse_part_pairs("--allowed", self.allowed)
        robot = load_robot(self.robot)
        collisions = condition_among(robot, self.scene, self.margin, ignore)
        start = joint_angles("--start", robot, self.start) if self.start else robot.home
        terminal.progress("planning")
        result = plan(
            robot,
            start,
            joint_angles("--goal-q", robot, self.goal_q) if goal is None else goal,
            collisions=collisions,
            allowed=allowed,
            budget=Budget(iterations=self.iterations, seconds=self.seconds),
            seed=self.seed,
            speed=self.speed,
            rate=self.rate,
        )
        if self.out is not None and result.trajectory is not None:
            result.trajectory.save_csv(self.out)
        return PlanReport(self, robot, result)

    def _goal(self) -> Goal | None:
        """Return the goal in task space. None: the goal is joint angles."""
        if bool(self.goal) == bool(self.goal_q):
            problem = "--goal-q is given, too" if self.goal else "no goal is given"
            allowed = "one of --goal X Y Z [W X Y Z] and --goal-q Q …"
            raise OptionError("--goal", problem, allowed)
        if self.goal:
            return parse_goal(self.goal, self.frame)
        if self.frame is not None:
            raise OptionError("--frame", "joint angles have no frame", "with --goal")
        return None


@dataclass(frozen=True, eq=False)
class PlanReport(Report):
    """The result of a search for a motion."""

    command: Plan
    robot: Robot
    result: PlannedMotion

    @property
    def ok(self) -> bool:
        """Whether a motion was found."""
        return self.result.found

    def facts(self) -> dict[str, Any]:
        """Return the JSON object. docs/reference/json.md describes it."""
        result = self.result
        trajectory = result.trajectory
        return {
            "robot": self.robot.name,
            "found": result.found,
            "status": result.status.name.lower(),
            "meaning": result.meaning,
            "joints": list(self.robot.joints),
            "corners": None if result.corners is None else result.corners.tolist(),
            "duration": None if trajectory is None else trajectory.duration,
            "certified": trajectory is not None and trajectory.certified,
            "clearance": None if trajectory is None else trajectory.clearance,
            "margin": result.margin,
            "goal_postures": result.goal_postures,
            "iterations": result.iterations,
            "restarts": result.restarts,
            "nodes": list(result.nodes),
            "seed": self.command.seed,
            "seconds": result.seconds,
        }

    def tables(self) -> Iterable[Any]:
        """Return the result, and the corners in degrees and millimetres."""
        result = self.result
        rows = [("status", f"{result.status.name.lower()}: {result.meaning}")]
        trajectory = result.trajectory
        if trajectory is not None:
            proof = "no: a part comes so near to the margin that nothing can be proven"
            if trajectory.clearance is not None:
                proof = f"every part keeps {1e3 * trajectory.clearance:.1f} mm"
            rows.append(("proven", proof))
            rows.append(("motion", f"{trajectory.duration:.2f} s at {self.command.rate:g} Hz"))
        iterations = plural(result.iterations, "iteration")
        restarts = plural(result.restarts, "restart")
        rows.append(("search", f"{iterations}, {restarts}, {sum(result.nodes)} nodes"))
        rows.append(("time", f"{1e3 * result.seconds:.1f} ms"))
        yield table("plan", self.robot.name, rows=rows)
        if result.corners is not None:
            yield corner_table(self.robot, result.corners)
        if trajectory is not None and self.command.out is not None:
            yield f"motion in {self.command.out}"


def corner_table(robot: Robot, corners: Array) -> Table:
    """Return a table of corners (k, nq): one row for each joint, one column for each corner."""
    rows = []
    for index, (name, kind) in enumerate(zip(robot.joints, robot.joint_kinds, strict=True)):
        is_hinge = kind == "hinge"
        scale = math.degrees(1.0) if is_hinge else 1e3
        values = [f"{scale * corner[index]:z8.1f}" for corner in corners]
        rows.append((name, *values, "deg" if is_hinge else "mm"))
    inner = [str(number) for number in range(1, len(corners) - 1)]
    heads = ["start", *inner, "goal"][: len(corners)]
    return table("joint", *heads, "unit", rows=rows)


def joint_angles(option: str, robot: Robot, numbers: Sequence[float]) -> tuple[float, ...]:
    """Return the numbers of an option as joint angles of a robot.

    Raises:
        OptionError: A number is not finite, or the count is not that of the joint angles.
    """
    if len(numbers) != robot.nq:
        allowed = f"{robot.nq}: {' '.join(robot.joints)}"
        raise OptionError(option, f"{len(numbers)} numbers", allowed)
    if not all(map(math.isfinite, numbers)):
        raise OptionError(option, "a number is not finite", "finite numbers")
    return tuple(numbers)


def parse_part_pairs(option: str, items: Iterable[str]) -> list[tuple[str, str]]:
    """Return pairs of names from ``PART:PART`` items.

    Raises:
        OptionError: An item is not two names.
    """
    pairs = []
    for item in items:
        names = item.split(":")
        if len(names) != 2 or not all(names):
            raise OptionError(option, f"cannot read {item!r}", "PART:PART, e.g. gripper:crate")
        pairs.append((names[0], names[1]))
    return pairs
