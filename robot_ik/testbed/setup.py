"""What a session solves: robot, methods, goals.

``Setup`` is the choice, as names and numbers. Commands change it. ``prepare`` makes what the loop
needs from it. It loads models and compiles, which takes seconds, so the session runs it beside the
loop.
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
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    Goal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.kernels.tree import FREE, HINGE, SLIDE
from robot_ik.motion.sources import CurveSource
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers import make_solver
from robot_ik.solvers.analytic.branch import Branch
from robot_ik.solvers.base import Solver
from robot_ik.support import supported_frames
from robot_ik.testbed import commands
from robot_ik.testbed.gallery_scene import gallery_scene

BUDGET = Budget(iterations=200, restarts=0)
"""Of one solve. Iterations instead of seconds, so that a replay gives the same bits. Without
restarts, because an arm that follows must not jump."""

RESTART_ITERATIONS = 5
"""Factor of the iterations of a solve that may restart."""

METHODS = ("dls", "lm", "pseudoinverse", "ccd")
"""First methods of four arms: damped, with a trust region, undamped, geometric."""

WHOLE_BODY_METHODS = ("lm", "dls", "sdls", "bfgs")
"""Likewise of figures. Geometric methods do not serve their balance and gaze."""

CURVE_PERIOD = 8.0
"""Seconds of ball time for one round of the curve."""

_CURVE_METHOD = "dls"
"""Tries the curve if no instance's own method can."""

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
"""How often a curve may shrink."""

_HOLD_GOALS = 6
"""Frames beside the tool that are offered to be held."""

_GAZE = "gaze"


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
class ExtraGoal:
    """A goal beside the ball's.

    Attributes:
        name: Its name on the page.
        on: Whether it counts.
        priority: 0 is served first.
        about: What it asks.
    """

    name: str
    on: bool
    priority: int
    about: str


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
        limits: Whether joint limits hold.
        branches: Whether all branches of a closed form are searched.
        figure: Whether the first instance decides by itself.
    """

    robot: str
    count: commands.Count = 1
    choices: tuple[MethodChoice, ...] = ()
    kind: commands.GoalKind | None = None
    extras: tuple[ExtraGoal, ...] | None = None
    limits: bool = True
    branches: bool = False
    figure: commands.FigureMode = "off"

    def after(self, command: commands.SetupCommand) -> Setup:
        """Return what is solved after a command.

        Raises:
            ConfigError: It names an unknown goal.
        """
        match command:
            case commands.SetRobot(name):
                return Setup(name, self.count, self.choices)
            case commands.SetCount(count):
                return replace(self, count=count)
            case commands.SetMethod(k, method):
                return self._with_choice(k, MethodChoice(method))
            case commands.SetOption(k, name, value):
                old = self.choices[k]
                options = tuple(sorted((dict(old.options) | {name: value}).items()))
                return self._with_choice(k, MethodChoice(old.method, options))
            case commands.SetGoalKind(kind):
                return replace(self, kind=kind)
            case commands.SetLimits(on):
                return replace(self, limits=on)
            case commands.ShowBranches(on):
                return replace(self, branches=on)
            case commands.SetExtraGoal():
                return self._with_extra(command)
            case commands.SetFigure(mode):
                return replace(self, figure=mode)
        raise TypeError(f"{command!r} changes no setup")

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
        changed = replace(extras[command.name], on=command.on, priority=command.priority)
        return replace(self, extras=tuple((extras | {command.name: changed}).values()))


class RobotGoals:
    """The goals of one robot, made for each tick from the ball's pose.

    Attributes:
        robot: The robot.
        kind: What the ball asks of the tool.
        priority: Of the ball's goal.
        kept: Frames that do not move during a drag.
        balanced: Whether the centre of mass stays over its position.
    """

    def __init__(
        self, robot: Robot, kind: commands.GoalKind, extras: tuple[ExtraGoal, ...]
    ) -> None:
        self.robot = robot
        self.kind = kind
        self.priority = next(extra.priority for extra in extras if extra.name == "ball")
        others = [extra for extra in extras if extra.on and extra.name != "ball"]
        self._extras = [(extra, _extra_goal(robot, extra)) for extra in others]
        names = [extra.name for extra, _ in self._extras]
        self.kept = tuple(name.removeprefix("keep ") for name in names if name.startswith("keep "))
        self.balanced = "balance" in names

    def main(self, ball: Pose) -> Goal:
        """Return what the ball asks of the tool."""
        rank = self.priority
        tool = self.robot.tool
        position = ball.position
        match self.kind:
            case "pose":
                return PoseGoal(tool, position, ball.wxyz, priority=rank)
            case "position":
                return PositionGoal(tool, position, priority=rank)
            case "aim":
                return AimGoal(tool, position, axis=gaze_axis(tool), priority=rank)
            case "line":
                return LineGoal(tool, position, ball.rotation[:, 2], priority=rank)
            case "plane":
                return PlaneGoal(tool, position, ball.rotation[:, 2], priority=rank)

    def all(self, ball: Pose, solver: Solver) -> list[Goal]:
        """Return the ball's goal, then the others.

        A method that cannot order goals gets them at one priority, without the posture.
        """
        goals = [goal for _, goal in self.named(ball)]
        if "priorities" in solver.capabilities:
            return goals
        ranked = [goal for goal in goals if not isinstance(goal, PostureGoal)]
        return [replace(goal, priority=0) for goal in ranked]

    def named(self, ball: Pose) -> list[tuple[str, Goal]]:
        """Return all goals by their names on the page, the ball's first."""
        goals: list[tuple[str, Goal]] = [("ball", self.main(ball))]
        for extra, goal in self._extras:
            if goal is None:
                goal = AimGoal(_GAZE, ball.position, axis="x", priority=extra.priority)
            goals.append((extra.name, goal))
        return goals

    def flattened(self, solver: Solver) -> bool:
        """Return whether the method takes goals of several priorities at one priority."""
        ranks = {self.priority, *(extra.priority for extra, _ in self._extras)}
        return len(ranks) > 1 and "priorities" not in solver.capabilities


def gaze_axis(tool: str) -> str:
    """Return the axis of a frame that aims: x of eyes, z of hands and tools."""
    return "x" if tool == _GAZE else "z"


def _extra_goal(robot: Robot, extra: ExtraGoal) -> Goal | None:
    """Return the goal of an extra, or None for the gaze, whose target is the ball."""
    home = robot.home
    verb, _, frame = extra.name.partition(" ")
    if verb == "keep":
        pose = robot.forward(home, frame)
        return PoseGoal(frame, pose.position, pose.wxyz, priority=extra.priority)
    if verb == "hold":
        return PositionGoal(frame, robot.forward(home, frame).position, priority=extra.priority)
    if verb == "level":
        wxyz = first_ball(robot).wxyz
        return OrientationGoal(frame, wxyz, free_axis="z", priority=extra.priority)
    if verb == "balance":
        centre = robot.center_of_mass(home)
        return CenterOfMassGoal(None, centre, axes="xy", priority=extra.priority)
    if verb == "posture":
        kinds = zip(robot.joints, robot.tree.kind.tolist(), strict=True)
        free = [joint for joint, kind in kinds if kind == FREE]
        return PostureGoal(q=home, joints=dict.fromkeys(free, 0.0), priority=extra.priority)
    return None


def is_figure(robot: Robot) -> bool:
    """Return whether a robot stands on feet: it has a floating base and frames to keep."""
    return robot.nq > robot.nv and bool(robot.file.keep)


def usual_extras(robot: Robot) -> tuple[ExtraGoal, ...]:
    """Return the goals that the page offers beside the ball's."""
    return _figure_extras(robot) if is_figure(robot) else _arm_extras(robot)


def _arm_extras(robot: Robot) -> tuple[ExtraGoal, ...]:
    level = "its z axis keeps its direction, as a cup needs it"
    return (
        ExtraGoal("ball", True, 0, "what the ball asks of the tool"),
        ExtraGoal(f"level {robot.tool}", False, 0, level),
        ExtraGoal("posture", False, 1, "joints as near to home as possible"),
    )


def _figure_extras(robot: Robot) -> tuple[ExtraGoal, ...]:
    keep = supported_frames(robot, (robot.tool,))
    tools = robot.file.tools
    extras = [ExtraGoal(f"keep {frame}", True, 0, f"{frame} stays at home") for frame in keep]
    extras.append(ExtraGoal("balance", True, 1, "centre of mass above its position at home"))
    extras.append(ExtraGoal("ball", True, 2, "what the ball asks of the tool"))
    if _GAZE in tools and robot.tool != _GAZE:
        extras.append(ExtraGoal(_GAZE, True, 3, "the eyes look at the ball"))
    others = [name for name in tools if name not in (robot.tool, _GAZE, *keep)]
    for name in others[:_HOLD_GOALS]:
        extras.append(ExtraGoal(f"hold {name}", False, 3, f"{name} stays at its position"))
    extras.append(ExtraGoal("posture", True, 4, "joints as near to home as possible"))
    return tuple(extras)


@dataclass(frozen=True, eq=False)
class Ready:
    """A setup that the loop can solve at once.

    Attributes:
        setup: The setup, completed with what suits the robot.
        robot: Robot of every instance, within the limits that hold.
        goals: What is asked.
        solvers: One for each instance.
        loaded: The robot within the limits of its model.
        curve: The ball's path. The tool can follow it.
        refused: Why each instance's method cannot serve these goals. Empty if it can.
        abilities: Of a figure that decides by itself. None: it does not.
    """

    setup: Setup
    robot: Robot
    goals: RobotGoals
    solvers: tuple[Solver, ...]
    loaded: Robot
    curve: CurveSource
    refused: tuple[str, ...]
    abilities: Abilities | None


def completed(setup: Setup, robot: Robot) -> Setup:
    """Return the setup with what suits the robot where nothing was chosen."""
    usual = WHOLE_BODY_METHODS if is_figure(robot) else METHODS
    choices = setup.choices + tuple(MethodChoice(method) for method in usual[len(setup.choices) :])
    extras = usual_extras(robot) if setup.extras is None else setup.extras
    # An arm of five joints meets a position, but not a pose.
    usual_kind: commands.GoalKind = "position" if is_figure(robot) or robot.nv < 6 else "pose"
    return replace(setup, choices=choices, kind=setup.kind or usual_kind, extras=extras)


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
    if before is not None and is_figure(before.loaded) is not is_figure(loaded):
        setup = replace(setup, choices=())  # arms and figures need different methods
    setup = completed(setup, loaded)
    if setup.kind is None or setup.extras is None:
        raise RuntimeError("the setup is not completed")
    same = before is not None and before.loaded is loaded and before.setup.limits == setup.limits
    used = before.robot if before and same else loaded if setup.limits else without_limits(loaded)
    goals = RobotGoals(used, setup.kind, setup.extras)
    home = first_ball(loaded)
    refused = []
    solvers = tuple(choice.solver() for choice in setup.choices[: setup.count])
    if first is not None:
        first(setup, used, goals, solvers)
    for solver in solvers:
        say(f"preparing {solver.name} …")
        refused.append(_tried(used, goals, solver, home))
    if setup.branches:
        with contextlib.suppress(RobotIkError):
            branches_of(used, goals.main(home), used.home)
    asks_same = before is not None and before.setup.kind == setup.kind
    if before and same and asks_same and before.setup.extras == setup.extras:
        curve = before.curve
    else:
        able = [solver for solver, reason in zip(solvers, refused, strict=True) if not reason]
        chosen = able[0] if able else MethodChoice(_CURVE_METHOD).solver()
        curve = reachable_curve(used, goals, chosen)
    abilities = None
    if setup.figure != "off":
        if before is not None and before.loaded is loaded:
            abilities = before.abilities
        abilities = abilities or _abilities(loaded, say)
    return Ready(setup, used, goals, solvers, loaded, curve, tuple(refused), abilities)


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
    """Compile what the goals need. Return why the method cannot serve them, empty if it can."""
    try:
        wanted = goals.all(ball, solver)
        problem = Problem(robot, wanted, solver=solver, budget=BUDGET)
        retarget(problem, wanted)
        problem.solve(robot.home)
    except RobotIkError as error:
        return str(error).splitlines()[0]
    return ""


def retarget(problem: Problem, goals: list[Goal]) -> None:
    """Move the targets of a problem that was made for such goals."""
    for index, goal in enumerate(goals):
        if not isinstance(goal, PostureGoal | CenterOfMassGoal):  # these stay where they are
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


def first_ball(robot: Robot) -> Pose:
    """Return the first pose of the ball: the goal of the robot's gallery picture, else home."""
    home = robot.measure(robot.home)  # MuJoCo needs no compilation before the first picture
    goals = gallery_scene(robot).goals
    if robot.tool not in goals:
        return home
    values = goals[robot.tool]
    return Pose(values[:3], values[3:] if len(values) == 7 else home.wxyz)


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
            return True  # the method cannot serve these goals, so the curve does not matter
        q = solution.q
        error = solution.errors[0]
        if error.position > _CURVE_POSITION or error.angle > _CURVE_ANGLE:
            return False
    return True
