"""What a session solves: robot, methods, goals.

``Setup`` holds the choices as names and numbers. Commands change it. ``prepare`` builds the robots,
goals and solvers of a setup. It loads models and compiles, which takes seconds, so the session runs
it beside the loop.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robot_ik.branches import solve_all
from robot_ik.budget import Budget
from robot_ik.errors import ConfigError, RobotIkError
from robot_ik.figure.abilities import Abilities, load_abilities
from robot_ik.figure.figure import load_figure
from robot_ik.figure.motion.drag import Drag
from robot_ik.geometry import Pose
from robot_ik.goals import CenterOfMassGoal, Goal, PosePriorGoal, PostureGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.motion.sources import CurveSource
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.robot_file import CHAIN
from robot_ik.solvers import make_solver
from robot_ik.solvers.analytic.branch import Branch
from robot_ik.solvers.base import Solver
from robot_ik.testbed import commands
from robot_ik.testbed.limb import Limb
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.robot_goals import (
    ExtraGoal,
    Pin,
    RobotGoals,
    first_ball,
    is_figure,
    usual_extras,
)
from robot_ik.theses.courses import Course, make_course

BUDGET = Budget(iterations=200, restarts=0)
"""Budget of one solve.

It limits iterations, not seconds, so that a replay gives the same bits. It has no restarts, because
an arm that follows must not jump.
"""

MOST_INSTANCES = 4
"""Instances that have a method and limits, shown or not."""

POSE_FREEDOMS = 6
"""Degrees of freedom of a pose."""

RESTART_ITERATIONS = 5
"""Factor of the iterations of a solve that may restart."""

METHODS = ("dls", "lm", "pseudoinverse", "ccd")
"""First methods of four arms: damped, with a trust region, undamped, geometric."""

WHOLE_BODY_METHODS = ("lm", "dls", "sdls", "bfgs")
"""Likewise of figures. Geometric methods do not serve their balance and gaze."""

CURVE_PERIOD = 8.0
"""Seconds of ball time for one round of the curve."""

_CURVE_METHOD = "dls"
"""Method that tries the curve if the methods of the instances do not support the goals."""

_CURVE_RADIUS = 0.15
"""Radius of the curve in extents of the model."""

_CURVE_STEPS = 12
"""Points of the curve that are tried."""

_CURVE_POSITION = 1e-3
"""Metres by which the tool may miss a point of the curve."""

_CURVE_ANGLE = 1e-2
"""Radians, likewise."""

_SHRINK = 0.7
"""Factor of a curve that the tool cannot follow."""

_SHRINKS = 5
"""Largest number of times that a curve shrinks."""


@dataclass(frozen=True)
class MethodChoice:
    """A method and its options that differ from the defaults."""

    method: str
    options: tuple[tuple[str, Any], ...] = ()

    def solver(self) -> Solver:
        """Return the solver.

        Raises:
            UnknownSolverError, OptionError: No such method, option or value.
        """
        return make_solver(self.method, **dict(self.options))


@dataclass(frozen=True)
class Setup:
    """What is solved.

    Attributes:
        robot: A name of the catalogue or the path of a model.
        count: Instances side by side.
        choices: Methods of four instances. The first ``count`` are used.
        kind: What the ball asks. None: what suits the robot.
        extras: Goals beside it. The ball's own priority is that of ``ball``. None: what suits the
            robot.
        pins: Frames that stay at a place.
        limits: Whether joint limits of four instances hold. None: what suits the robot.
        branches: Whether all branches of a closed form are searched.
        figure: Whether the first instance decides by itself.
        tool: Frame that follows the ball. Empty: that of the model.
        base: Frame that carries the joints that move. Empty: all joints move.
        joints: Names of the joints that move. Empty: all.
        stiffness: Joints and their stiffness, where it is not that of the model.
        course: Number of the course that the ball follows. 0: none.
    """

    robot: str
    count: commands.Count = 1
    choices: tuple[MethodChoice, ...] = ()
    kind: commands.GoalKind | None = None
    extras: tuple[ExtraGoal, ...] | None = None
    pins: tuple[Pin, ...] = ()
    limits: tuple[bool, ...] | None = None
    branches: bool = False
    figure: commands.FigureMode = "off"
    tool: str = ""
    base: str = ""
    joints: tuple[str, ...] = ()
    stiffness: tuple[tuple[str, float], ...] = ()
    course: int = 0

    @classmethod
    def of(cls, start: commands.Start) -> Setup:
        """Return what a session begins with."""
        return cls(
            start.robot,
            start.count,
            tuple(MethodChoice(method) for method in start.methods),
            tool=start.tool,
            base=start.base,
            joints=start.joints,
        )

    def after(self, command: commands.SetupCommand) -> Setup:
        """Return what is solved after a command.

        Raises:
            ConfigError: It names an unknown goal or pin.
        """
        match command:
            case commands.SetRobot(name):
                return Setup(name, self.count, self.choices)
            case commands.SetCourse(number):
                return self._with_course(number)
            case commands.SetCount(count):
                return replace(self, count=count)
            case commands.SetMethod(k, method, options):
                return self._with_choice(k, MethodChoice(method, tuple(sorted(options))))
            case commands.SetOption(k, name, value):
                old = self.choices[k]
                options = tuple(sorted((dict(old.options) | {name: value}).items()))
                return self._with_choice(k, MethodChoice(old.method, options))
            case commands.SetGoalKind(kind):
                return replace(self, kind=kind)
            case commands.SetLimits(on, None):
                return replace(self, limits=(on,) * MOST_INSTANCES)
            case commands.SetLimits(on, int(k)):
                limits = self.limits or (True,) * MOST_INSTANCES
                return replace(self, limits=(*limits[:k], on, *limits[k + 1 :]))
            case commands.ShowBranches(on):
                return replace(self, branches=on)
            case commands.SetExtraGoal():
                return self._with_extra(command)
            case commands.SetFigure("off"):
                return replace(self, figure="off")
            case commands.SetFigure(mode):
                return replace(self, figure=mode, base="", joints=(), extras=None)
            case _:
                return self._with_selection(command)

    def _with_selection(self, command: commands.SetupCommand) -> Setup:
        """Return what is solved after a command about frames, pins or joints."""
        match command:
            case commands.SetTool(frame):
                return replace(self, tool=frame, extras=None)
            case commands.SetBase(frame):
                return replace(self, base=frame, figure="off", extras=None)
            case commands.SetPin(frame, position, wxyz, weight, priority):
                pin = Pin(frame, position, wxyz, weight, priority)
                others = tuple(one for one in self.pins if one.frame != frame)
                return replace(self, pins=(*others, pin))
            case commands.RemovePin(frame):
                self._require_pin(frame)
                return replace(self, pins=tuple(one for one in self.pins if one.frame != frame))
            case commands.SetStiffness(joint, value):
                values = dict(self.stiffness) | {joint: value}
                return replace(self, stiffness=tuple(sorted(values.items())))
        raise TypeError(f"{command!r} does not change the setup")

    def _with_course(self, number: int) -> Setup:
        course = make_course(number)
        kind: commands.GoalKind = "pose" if course.goal.weights[1] > 0.0 else "position"
        robot = f"{CHAIN}{len(course.robot.joints)}"
        return Setup(robot, self.count, self.choices, kind=kind, course=number)

    def _require_pin(self, frame: str) -> None:
        names = [pin.frame for pin in self.pins]
        if frame not in names:
            allowed = ", ".join(names) or "no frame is pinned"
            raise ConfigError(
                f"{frame!r} is not pinned", file="command", key="frame", allowed=allowed
            )

    def _with_choice(self, k: int, choice: MethodChoice) -> Setup:
        return replace(self, choices=(*self.choices[:k], choice, *self.choices[k + 1 :]))

    def _with_extra(self, command: commands.SetExtraGoal) -> Setup:
        extras = {extra.name: extra for extra in self.extras or ()}
        if command.name not in extras:
            raise ConfigError(
                f"there is no goal {command.name!r}",
                file="command",
                key="name",
                allowed=", ".join(extras) or "none with this robot",
            )
        changed = replace(
            extras[command.name],
            on=command.on,
            priority=command.priority,
            weight=command.weight,
        )
        return replace(self, extras=tuple((extras | {command.name: changed}).values()))


@dataclass(frozen=True, eq=False)
class Ready:
    """A setup that the loop can solve at once.

    Attributes:
        setup: The setup, completed with what suits the robot.
        robots: One for each instance, within the limits that hold for it.
        goals: What is asked.
        solvers: One for each instance.
        loaded: The robot as it was loaded.
        chosen: The robot with the tool, the joints and the stiffness of the setup.
        curve: The ball's path. The tool can follow it.
        course: The course that the ball follows. None: there is none.
        refused: Why each instance's method does not support these goals. Empty if it does.
        limbs: For each instance of a figure, the limb that its method moves alone. None: its method
            moves the whole robot.
        abilities: Of a figure that decides by itself. None: it does not.
    """

    setup: Setup
    robots: tuple[Robot, ...]
    goals: RobotGoals
    solvers: tuple[Solver, ...]
    loaded: Robot
    chosen: Robot
    curve: CurveSource
    course: Course | None
    refused: tuple[str, ...]
    limbs: tuple[Limb | None, ...]
    abilities: Abilities | None

    @property
    def robot(self) -> Robot:
        """Robot of the first instance."""
        return self.robots[0]


def selected(loaded: Robot, setup: Setup) -> Robot:
    """Return a robot with the tool, the joints and the stiffness of a setup.

    Raises:
        RobotIkError: There is no such frame or joint, or no joint would move.
    """
    robot = loaded.with_parts(tool=setup.tool, base=setup.base, joints=setup.joints)
    stiffness = {joint: value for joint, value in setup.stiffness if joint in robot.joints}
    return robot.with_stiffness(stiffness) if stiffness else robot


def completed(setup: Setup, robot: Robot) -> Setup:
    """Return the setup with what suits the robot where nothing was chosen."""
    usual = WHOLE_BODY_METHODS if is_figure(robot) else METHODS
    choices = setup.choices + tuple(MethodChoice(method) for method in usual[len(setup.choices) :])
    extras = usual_extras(robot) if setup.extras is None else setup.extras
    # Optional limits are off until a person asks for them.
    limits = (not robot.file.optional_limits,) * MOST_INSTANCES
    return replace(
        setup,
        choices=choices,
        kind=setup.kind or _usual_kind(robot),
        extras=extras,
        limits=setup.limits or limits,
    )


def _usual_kind(robot: Robot) -> commands.GoalKind:
    """Return what the ball asks of a robot unless a person chooses.

    An arm of five joints meets a position, but not a pose. Chains and figures are posed by points.
    """
    is_arm = robot.nq == robot.nv and robot.nv >= POSE_FREEDOMS
    return "pose" if is_arm and not robot.file.figure else "position"


First = Callable[[Setup, Robot, RobotGoals, Sequence[Solver]], None]
"""Called before anything is compiled: with the completed setup, its robot, goals and solvers."""


def prepare(
    setup: Setup,
    loaded: Robot,
    before: Ready | None,
    say: Callable[[str], None],
    first: First | None = None,
) -> Ready:
    """Compile and try everything that the setup needs.

    Args:
        setup: The choice.
        loaded: Its robot.
        before: The result of the last call. Parts that did not change are reused.
        say: Called with what is done now.
        first: See ``First``.

    Raises:
        RobotIkError: There is no such method or option.
    """
    chosen = selected(loaded, setup)
    if before is not None and is_figure(before.chosen) is not is_figure(chosen):
        setup = replace(setup, choices=())  # arms and figures need different methods
    setup = completed(setup, chosen)
    if setup.kind is None or setup.extras is None or setup.limits is None:
        raise RuntimeError("the setup is not completed")
    kept = before is not None and _same_selection(before, loaded, setup)
    if before is not None and kept:
        chosen = before.chosen
    robots = _limited_robots(chosen, setup.limits[: setup.count], before if kept else None)
    for pin in setup.pins:
        chosen.frame(pin.frame)
    goals = RobotGoals(robots[0], setup.kind, setup.extras, setup.pins)
    home = first_ball(chosen)
    refused = []
    limbs: list[Limb | None] = []
    solvers = tuple(choice.solver() for choice in setup.choices[: setup.count])
    if first is not None:
        first(setup, robots[0], goals, solvers)
    for robot, solver in zip(robots, solvers, strict=True):
        say(f"preparing {solver.name} …")
        reason = _tried(robot, goals, solver, home)
        limb = _limb(robot, goals, solver, home) if reason and is_figure(chosen) else None
        refused.append("" if limb else reason)
        limbs.append(limb)
    if setup.branches:
        with contextlib.suppress(RobotIkError):
            branches_of(robots[0], goals.main(home), robots[0].home)
    if before is not None and kept and _has_same_goals(before, setup, robots[0]):
        curve = before.curve
    else:
        able = [solver for solver, reason in zip(solvers, refused, strict=True) if not reason]
        tries = able[0] if able else MethodChoice(_CURVE_METHOD).solver()
        curve = reachable_curve(robots[0], goals, tries)
    course = None
    if setup.course:
        is_same = before is not None and before.setup.course == setup.course
        course = before.course if before is not None and is_same else make_course(setup.course)
    abilities = None
    if setup.figure != "off":
        if before is not None and before.loaded is loaded:
            abilities = before.abilities
        abilities = abilities or _abilities(loaded, say)
    return Ready(
        setup,
        robots,
        goals,
        solvers,
        loaded,
        chosen,
        curve,
        course,
        tuple(refused),
        tuple(limbs),
        abilities,
    )


def _same_selection(before: Ready, loaded: Robot, setup: Setup) -> bool:
    """Return whether tool, joints and stiffness are those of the last setup."""
    old = before.setup
    return before.loaded is loaded and (old.tool, old.base, old.joints, old.stiffness) == (
        setup.tool,
        setup.base,
        setup.joints,
        setup.stiffness,
    )


def _has_same_goals(before: Ready, setup: Setup, robot: Robot) -> bool:
    """Return whether the first instance has the same robot and goals as in the last setup."""
    old = before.setup
    same_goals = (old.kind, old.extras, old.pins) == (setup.kind, setup.extras, setup.pins)
    return same_goals and before.robot is robot


def _limited_robots(
    robot: Robot, limits: tuple[bool, ...], before: Ready | None
) -> tuple[Robot, ...]:
    """Return the robot of each instance, with its limits or without.

    Args:
        robot: The robot.
        limits: Whether the limits of each instance hold.
        before: The last setup of this robot, whose robots are used again.
    """
    made: dict[bool, Robot] = {}
    if before is not None and before.setup.limits is not None:
        made = dict(zip(before.setup.limits, before.robots, strict=False))
    for on in limits:
        if on not in made:
            made[on] = robot.with_optional_limits() if on else without_limits(robot)
    return tuple(made[on] for on in limits)


def _abilities(robot: Robot, say: Callable[[str], None]) -> Abilities:
    """Return what a figure can do: from a file, or for another model computed in some minutes.

    Raises:
        ModelError: It is no figure.
    """

    def progress(done: int, total: int) -> None:
        say(f"finding out what the figure can do: {100 * done // max(total, 1)} % …")

    figure = load_figure(robot)
    say("reading what the figure can do …")
    return load_abilities(figure, progress=progress)


def warm_drag(robot: Robot) -> None:
    """Load the kernels of dragging, or compile them on a new machine. All robots share them."""
    Drag(robot, robot.tool).step()


def _tried(robot: Robot, goals: RobotGoals, solver: Solver, ball: Pose) -> str:
    """Compile the kernels of the goals. Return why the method does not support them, or empty."""
    try:
        wanted = goals.all(ball, solver)
        problem = Problem(robot, wanted, solver=solver, budget=BUDGET)
        retarget(problem, wanted)
        problem.solve(robot.home)
    except RobotIkError as error:
        return problem_text(error)
    return ""


def _limb(robot: Robot, goals: RobotGoals, solver: Solver, ball: Pose) -> Limb | None:
    """Return the limb of the tool, if the method supports the ball's goal with it alone."""
    with contextlib.suppress(RobotIkError):
        limb = Limb(robot)
        goal = replace(goals.main(ball), priority=0)
        Problem(limb.robot, [goal], solver=solver, budget=BUDGET).solve(limb.robot.home)
        return limb
    return None


def retarget(problem: Problem, goals: list[Goal]) -> None:
    """Move the targets of a problem to those of goals of the same kinds."""
    for index, goal in enumerate(goals):
        # The targets of these goals do not move.
        if not isinstance(goal, PostureGoal | CenterOfMassGoal | PosePriorGoal):
            problem.retarget(goal, index)


def branches_of(robot: Robot, goal: Goal, start: Array) -> tuple[Branch, ...]:
    """Return all branches of a closed form, the nearest to ``start`` (nq,) first.

    Raises:
        UnsupportedGoalError: No closed form is known.
    """
    return solve_all(robot, replace(goal, priority=0), start=start)


def restarting(budget: Budget, robot: Robot) -> Budget:
    """Return the budget of a solve that may restart at random joint angles.

    A figure gets no more iterations: 36 joints take too long for one frame.
    """
    factor = 1 if is_figure(robot) else RESTART_ITERATIONS
    return Budget(iterations=factor * budget.iterations)


def without_limits(robot: Robot) -> Robot:
    """Return the robot without limits of hinges and slides. Balls keep their cones."""
    lower = robot.lower.copy()
    upper = robot.upper.copy()
    for kind, at in zip(robot.tree.kind.tolist(), robot.tree.vadr.tolist(), strict=True):
        if kind in (HINGE, SLIDE):
            lower[at] = -np.inf
            upper[at] = np.inf
    return dataclasses.replace(robot, tree=robot.tree.with_limits(lower, upper))


def reachable_curve(robot: Robot, goals: RobotGoals, solver: Solver) -> CurveSource:
    """Return a figure of eight around the first ball, as large as the tool can follow it."""
    ball = first_ball(robot)
    middle = np.array(ball.position)
    radius = _CURVE_RADIUS * float(robot.model.stat.extent)
    towards = np.array(robot.forward(robot.home).position)
    for _ in range(_SHRINKS):
        curve = CurveSource.lemniscate(
            robot.tool, middle, radius, CURVE_PERIOD, normal=(1.0, 0.0, 0.2), wxyz=ball.wxyz
        )
        if _follows(robot, goals, solver, curve):
            break
        radius *= _SHRINK
        middle = _SHRINK * middle + (1.0 - _SHRINK) * towards
    return CurveSource(robot.tool, curve.curve)


def _follows(robot: Robot, goals: RobotGoals, solver: Solver, curve: CurveSource) -> bool:
    """Return whether the tool reaches all points of a curve, starting at home."""
    q = robot.home
    for t in np.linspace(0.0, CURVE_PERIOD, _CURVE_STEPS):
        wanted = goals.all(curve.poll(float(t)).target, solver)
        try:
            solution = solve(robot, wanted, solver=solver, start=q, budget=BUDGET)
        except RobotIkError:
            return True  # the method does not support these goals, so the curve does not matter
        q = solution.q
        error = solution.errors[0]
        if error.position > _CURVE_POSITION or error.angle > _CURVE_ANGLE:
            return False
    return True
