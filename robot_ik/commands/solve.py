"""``robot-ik solve``: a goal in, joint angles out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import (
    BaseName,
    FrameName,
    FreeFeet,
    GoalNumbers,
    Iterations,
    JointNames,
    JsonOption,
    RobotName,
    Seed,
    SolverName,
    StartNumbers,
    parse_goal,
)
from robot_ik.commands.tables import plural, table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.goals import Goal
    from robot_ik.problem import Problem
    from robot_ik.solution import Solution

_BOOLEANS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
"""Texts of a boolean solver option."""

_UNITS = {"hinge": "deg", "slide": "m", "ball": "wxyz", "free": "m, wxyz"}
"""Unit of the values of each kind of joint, in the table."""

_NUMBERS_PER_JOINT = {"ball": 4, "free": 7}
"""Numbers of ``q`` of the kinds of joints that have more than one."""


@dataclass(frozen=True, kw_only=True)
class Solve(JsonOption):
    """Find joint angles that bring a frame of a robot to a goal.

    Metres and radians, quaternions as w x y z, goals in the world frame.

        robot-ik solve --goal -0.4 -0.1 0.7
        robot-ik solve --robot humanoid --goal 0.4 -0.3 1.5

    Exit code 0: the goal is met. 1: it is not, and the nearest joint angles are printed.
    """

    goal: GoalNumbers = ()
    robot: RobotName = "puma560"
    frame: FrameName = None
    base: BaseName = None
    joints: JointNames = ()
    free_feet: FreeFeet = False
    solver: SolverName = ""
    set: Annotated[
        tuple[str, ...],
        Parameter(metavar="NAME=VALUE …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Options of the solver (see `robot-ik solvers NAME`)."""
    start: StartNumbers = ()
    seed: Seed = 0
    position_tolerance: Annotated[float, Parameter(metavar="M", validator=Number(gt=0))] = 1e-4
    """Largest position error of a solution, in metres."""
    angle_tolerance: Annotated[float, Parameter(metavar="RAD", validator=Number(gt=0))] = 1e-3
    """Largest orientation error of a solution, in radians."""
    iterations: Iterations = 20_000
    restarts: Annotated[int | None, Parameter(metavar="N", validator=Number(gte=0))] = None
    """Random restarts. 0: a local solution near the start. Default: the solver's own."""

    def run(self, terminal: Terminal = QUIET) -> SolveReport:
        """Solve the problem twice, and report the second solution with its time."""
        # MuJoCo and Numba take 0.9 s to import, --help takes 0.1 s.
        from robot_ik.budget import Budget
        from robot_ik.goals import Tolerance
        from robot_ik.problem import Problem
        from robot_ik.robot import load_robot
        from robot_ik.solvers import make_solver, solver_name
        from robot_ik.support import support_goals

        goal: Goal = parse_goal(self.goal, self.frame)
        robot = load_robot(self.robot)
        robot = robot.with_parts(tool=self.frame, base=self.base, joints=self.joints)
        name = solver_name(self.solver, robot.file)
        solver = make_solver(name, **solver_options(name, self.set))
        kept = [] if self.free_feet else support_goals(robot, [robot.tool])
        if kept and "priorities" in solver.capabilities:
            goal = replace(goal, priority=1)  # the feet have priority 0
        problem = Problem(
            robot,
            [goal, *kept],
            solver=solver,
            tolerance=Tolerance(position=self.position_tolerance, angle=self.angle_tolerance),
            budget=Budget(iterations=self.iterations, restarts=self.restarts),
            seed=self.seed,
        )
        start = self.start or None
        terminal.progress("solving")
        problem.solve(start)
        # The first solve of a process loads or compiles the kernel. The second is timed.
        return SolveReport(problem, problem.solve(start))


@dataclass(frozen=True, eq=False)
class SolveReport(Report):
    """A problem and its solution."""

    SCHEMA: ClassVar[int] = 2

    problem: Problem
    solution: Solution

    @property
    def ok(self) -> bool:
        """Whether the goal is met."""
        return self.solution.converged

    def facts(self) -> dict[str, Any]:
        """Return the JSON object."""
        problem = self.problem
        solution = self.solution
        goal = problem.goals[0]
        return {
            "robot": problem.robot.name,
            "solver": solution.solver,
            "frame": goal.frame or problem.robot.tool,
            "goal": {
                "position": goal.target.position,
                "wxyz": goal.target.wxyz if goal.weights[1] > 0.0 else None,
            },
            "converged": solution.converged,
            "status": solution.status.name.lower(),
            "meaning": solution.meaning,
            "kept": [kept.frame for kept in problem.goals[1:]],
            "joints": list(problem.robot.joints),
            "q": solution.q,
            "error": {"position": solution.error.position, "angle": solution.error.angle},
            "tolerance": {
                "position": problem.tolerance.position,
                "angle": problem.tolerance.angle,
            },
            "iterations": solution.iterations,
            "restarts": solution.restarts,
            "seed": problem.seed,
            "seconds": solution.seconds,
        }

    def tables(self) -> Iterable[Table]:
        """Return the solution and the joint angles in degrees and millimetres."""
        solution = self.solution
        iterations = plural(solution.iterations, "iteration")
        restarts = plural(solution.restarts, "restart")
        position = 1e3 * solution.error.position
        angle = math.degrees(solution.error.angle)
        rows = (
            ("status", f"{solution.status.name.lower()}: {solution.meaning}"),
            ("error", f"{position:.4f} mm, {angle:.4f} deg"),
            ("effort", f"{iterations}, {restarts}"),
            ("time", f"{1e6 * solution.seconds:.0f} µs"),
        )
        yield table("solver", solution.solver, rows=rows)
        yield table("joint", "q", "unit", rows=self._joint_rows())

    def _joint_rows(self) -> Iterable[tuple[str, str, str]]:
        numbers = iter(self.solution.q)
        robot = self.problem.robot
        for name, kind in zip(robot.joints, robot.joint_kinds, strict=True):
            values = [next(numbers) for _ in range(_NUMBERS_PER_JOINT.get(kind, 1))]
            text = " ".join(f"{value:z9.5f}" for value in values)
            if kind == "hinge":
                text = f"{math.degrees(values[0]):z9.3f}"
            yield name, text, _UNITS[kind]


def solver_options(solver: str, items: Iterable[str]) -> dict[str, int | float | bool | str]:
    """Return the options of a solver from ``NAME=VALUE`` items, with the types of its fields.

    The solver itself checks names and ranges.

    Raises:
        OptionError: An item has no ``=``, or its value has another type.
    """
    from robot_ik.solvers import SOLVERS

    defaults = {item.name: item.default for item in fields(SOLVERS[solver])}
    options: dict[str, int | float | bool | str] = {}
    for item in items:
        name, equals, text = item.partition("=")
        default = defaults.get(name, 0.0)
        kind: type = type(default) if isinstance(default, bool | int | float | str) else float
        try:
            if not equals:
                raise ValueError
            options[name] = _BOOLEANS[text.lower()] if kind is bool else kind(text)
        except (ValueError, KeyError):
            allowed = f"NAME=VALUE with a value of type {kind.__name__}"
            raise OptionError("--set", f"cannot read {item!r}", allowed) from None
    return options
