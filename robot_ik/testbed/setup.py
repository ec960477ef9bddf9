"""What a session solves: robot, methods, goals.  Commands change it; making it ready may compile kernels.

``Setup`` is the choice, as names and numbers.  ``prepare`` makes of it what the loop needs; it loads models
and compiles, which takes seconds, so the session runs it beside the loop.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

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
from robot_ik.testbed import commands
from robot_ik.testbed.gallery_scene import gallery_scene

# Without restarts: an arm that follows must not jump.
BUDGET = Budget(iterations=200, restarts=0)
"""Of one solve: steps and not seconds, so that a replay gives the same bits."""
RESTART_ITERATIONS = 5
"""Factor of the iterations of a solve that may restart."""
METHODS = ("dls", "lm", "pseudoinverse", "ccd")
"""What four arms begin with: a damped, a trusted, an undamped and a geometric method."""
WHOLE_BODY_METHODS = ("lm", "dls", "sdls", "bfgs")
"""As ``METHODS`` for figures, whose balance and gaze geometric methods do not serve."""
_CURVE_METHOD = "dls"  # tries the curve where no instance's own method can
CURVE_PERIOD = 8.0
"""Seconds of ball time for once round the curve."""
_CURVE_RADIUS = 0.15  # of the model's extent
_CURVE_STEPS = 12
_SHRINK, _SHRINKS = 0.7, 5
_HOLD_GOALS = 6  # frames beside the tool that are offered to be held
_GAZE = "gaze"


@dataclass(frozen=True)
class MethodChoice:
    """A method and those of its options that are not its own defaults."""

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
    """A goal beside the ball's: its name on the page, whether it is on, its priority."""

    name: str
    on: bool
    priority: int
    about: str


@dataclass(frozen=True)
class Setup:
    """What is solved."""

    robot: str  # a name of the catalogue or the path of a model
    count: commands.Count = 1  # instances side by side
    choices: tuple[MethodChoice, ...] = ()  # of four instances; the first ``count`` are used
    kind: commands.GoalKind | None = None  # what the ball asks; None: what suits the robot
    extras: tuple[ExtraGoal, ...] | None = None  # the ball's own priority is that of ``ball``; None: as suits
    limits: bool = True  # whether joint limits hold
    branches: bool = False  # whether all branches of a closed form are looked for
    figure: Literal["off", "active", "passive"] = "off"  # the first instance decides by itself

    def after(self, command: commands.SetupCommand) -> Setup:
        """What is solved after a command of this kind.

        Raises:
            ConfigError: It names a goal that there is not.
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
                file="command", key="name", allowed=", ".join(extras) or "none with this robot",
            )  # fmt: skip
        changed = replace(extras[command.name], on=command.on, priority=command.priority)
        return replace(self, extras=tuple((extras | {command.name: changed}).values()))


class RobotGoals:
    """The goals of one robot, made for each tick from the ball's pose.

    Attributes:
        kept: Frames that stay where they are, whatever is dragged.
        balanced: Whether the centre of mass stays over its position.
    """

    def __init__(self, robot: Robot, kind: commands.GoalKind, extras: tuple[ExtraGoal, ...]) -> None:
        self.robot, self.kind = robot, kind
        self.priority = next(extra.priority for extra in extras if extra.name == "ball")
        self._extras = [
            (extra, _extra_goal(robot, extra)) for extra in extras if extra.on and extra.name != "ball"
        ]
        names = [extra.name for extra, _ in self._extras]
        self.kept = tuple(name.removeprefix("keep ") for name in names if name.startswith("keep "))
        self.balanced = "balance" in names

    def main(self, ball: Pose) -> Goal:
        """What the ball asks of the tool."""
        rank = self.priority
        tool, position = self.robot.tool, ball.position
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
        """The ball's goal first, then the others.

        A method that cannot order goals gets them at one priority, and no posture to fall back on.
        """
        ranked = "priorities" in solver.capabilities
        goals = [goal for _, goal in self.named(ball) if ranked or not isinstance(goal, PostureGoal)]
        return goals if ranked else [replace(goal, priority=0) for goal in goals]

    def named(self, ball: Pose) -> list[tuple[str, Goal]]:
        """All goals by their names on the page, the ball's first."""
        found: list[tuple[str, Goal]] = [("ball", self.main(ball))]
        for extra, goal in self._extras:
            if goal is None:
                goal = AimGoal(_GAZE, ball.position, axis="x", priority=extra.priority)
            found.append((extra.name, goal))
        return found

    def flattened(self, solver: Solver) -> bool:
        """Whether the method takes goals at one priority that have several."""
        ranks = {self.priority, *(extra.priority for extra, _ in self._extras)}
        return len(ranks) > 1 and "priorities" not in solver.capabilities


def gaze_axis(tool: str) -> str:
    """Which axis of a frame aims: x of eyes, z of hands and tools."""
    return "x" if tool == _GAZE else "z"


def _extra_goal(robot: Robot, extra: ExtraGoal) -> Goal | None:
    """The goal of that name where its target stays; None for the gaze, which follows the ball."""
    home = robot.home
    verb, _, frame = extra.name.partition(" ")
    if verb == "keep":
        pose = robot.forward(home, frame)
        return PoseGoal(frame, pose.position, pose.wxyz, priority=extra.priority)
    if verb == "hold":
        return PositionGoal(frame, robot.forward(home, frame).position, priority=extra.priority)
    if verb == "level":
        return OrientationGoal(frame, first_ball(robot).wxyz, free_axis="z", priority=extra.priority)
    if verb == "balance":
        return CenterOfMassGoal(None, robot.center_of_mass(home), axes="xy", priority=extra.priority)
    if verb == "posture":
        kinds = zip(robot.joints, robot.tree.kind.tolist(), strict=True)
        free = [joint for joint, kind in kinds if kind == FREE]
        return PostureGoal(q=home, joints=dict.fromkeys(free, 0.0), priority=extra.priority)
    return None


def is_figure(robot: Robot) -> bool:
    """Whether it stands on feet: a floating base and frames to keep."""
    return robot.nq > robot.nv and bool(gallery_scene(robot).keep)


def usual_extras(robot: Robot) -> tuple[ExtraGoal, ...]:
    """The goals that the page offers beside the ball's."""
    figure = is_figure(robot)
    keep = gallery_scene(robot).keep if figure else ()
    found = [ExtraGoal(f"keep {frame}", True, 0, f"{frame} stays where it is at home") for frame in keep]
    if figure:
        found.append(ExtraGoal("balance", True, 1, "centre of mass over its place at home"))
    found.append(ExtraGoal("ball", True, 2 if figure else 0, "what the ball asks of the tool"))
    tools = robot.file.tools
    if figure and _GAZE in tools and robot.tool != _GAZE:
        found.append(ExtraGoal(_GAZE, True, 3, "the eyes look at the ball"))
    others = [name for name in tools if name not in (robot.tool, _GAZE, *keep)]
    if figure:
        found += [ExtraGoal(f"hold {n}", False, 3, f"{n} stays at its place") for n in others[:_HOLD_GOALS]]
    else:
        tool = robot.tool
        found.append(ExtraGoal(f"level {tool}", False, 0, "its z axis keeps its direction, as a cup would"))
    found.append(ExtraGoal("posture", figure, 4 if figure else 1, "joints as near to home as can be"))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Ready:
    """A setup that the loop can solve at once."""

    setup: Setup  # with what suits the robot filled in
    robot: Robot  # within its limits; the robot of every instance
    goals: RobotGoals  # what is asked
    solvers: tuple[Solver, ...]  # one for each instance
    loaded: Robot  # the robot within the limits of its model
    curve: CurveSource  # the ball's path; the tool can follow it
    refused: tuple[str, ...]  # why each instance's method cannot serve these goals; empty where it can
    abilities: Abilities | None  # of a figure that decides by itself; None: it does not


def completed(setup: Setup, robot: Robot) -> Setup:
    """The setup with what suits the robot where nothing was chosen."""
    usual = WHOLE_BODY_METHODS if is_figure(robot) else METHODS
    choices = setup.choices + tuple(MethodChoice(method) for method in usual[len(setup.choices) :])
    extras = usual_extras(robot) if setup.extras is None else setup.extras
    # A pose where six freedoms carry the tool; else a position, which an arm of five joints can meet.
    usual_kind: commands.GoalKind = "position" if is_figure(robot) or robot.nv < 6 else "pose"
    return replace(setup, choices=choices, kind=setup.kind or usual_kind, extras=extras)


def prepare(
    setup: Setup,
    loaded: Robot,
    before: Ready | None,
    say: Callable[[str], None],
    first: Callable[[Setup, Robot, RobotGoals, Sequence[Solver]], None] = lambda *given: None,
) -> Ready:
    """Compiles and tries all that the setup needs.

    Args:
        setup: The choice.
        loaded: Its robot.
        before: What was made ready last: what did not change since is taken over.
        say: Called with what is going on, as text.
        first: Called before anything is compiled: with the completed setup, its robot, goals and solvers.

    Raises:
        RobotIkError: No such method or option.
    """
    if before is not None and is_figure(before.loaded) is not is_figure(loaded):
        setup = replace(setup, choices=())  # an arm's methods do not suit a figure, nor a figure's an arm
    setup = completed(setup, loaded)
    if setup.kind is None or setup.extras is None:
        raise RuntimeError("the setup is not completed")
    same = before is not None and before.loaded is loaded and before.setup.limits == setup.limits
    used = before.robot if before and same else loaded if setup.limits else without_limits(loaded)
    goals = RobotGoals(used, setup.kind, setup.extras)
    home, refused = first_ball(loaded), []
    solvers = tuple(choice.solver() for choice in setup.choices[: setup.count])
    first(setup, used, goals, solvers)
    for solver in solvers:
        say(f"preparing {solver.name} …")
        refused.append(_tried(used, goals, solver, home))
    if setup.branches:
        with contextlib.suppress(RobotIkError):
            branches_of(used, goals.main(home), used.home)
    if before and same and (before.setup.kind, before.setup.extras) == (setup.kind, setup.extras):
        curve = before.curve
    else:
        able = [solver for solver, why in zip(solvers, refused, strict=True) if not why]
        curve = reachable_curve(used, goals, able[0] if able else MethodChoice(_CURVE_METHOD).solver())
    abilities = None
    if setup.figure != "off":
        abilities = before.abilities if before is not None and before.loaded is loaded else None
        abilities = abilities or _abilities(loaded, say)
    return Ready(setup, used, goals, solvers, loaded, curve, tuple(refused), abilities)


def _abilities(robot: Robot, say: Callable[[str], None]) -> Abilities:
    """What a figure can do: read from a file, or for a model of somebody's own made in some minutes.

    Raises:
        ModelError: It is no figure.
    """
    figure = load_figure(robot)
    say("reading what the figure can do …")
    finding = "finding out what the figure can do"
    return load_abilities(
        figure, progress=lambda done, whole: say(f"{finding}: {100 * done // max(whole, 1)} % …")
    )


def warm_drag(robot: Robot) -> None:
    """Loads what dragging needs, or compiles it on a new machine; once is enough for all robots."""
    Drag(robot, robot.tool).step()


def _tried(robot: Robot, goals: RobotGoals, solver: Solver, ball: Pose) -> str:
    """Compiles what the goals need; why the method cannot serve them, in one sentence, or nothing."""
    try:
        wanted = goals.all(ball, solver)
        problem = Problem(robot, wanted, solver=solver, budget=BUDGET)
        retarget(problem, wanted)
        problem.solve(robot.home)
    except RobotIkError as error:
        return str(error).splitlines()[0]
    return ""


def retarget(problem: Problem, goals: list[Goal]) -> None:
    """Moves the targets of a problem that was made for such goals."""
    for index, goal in enumerate(goals):
        if not isinstance(goal, PostureGoal | CenterOfMassGoal):  # these stay where they are
            problem.retarget(goal, index)


def branches_of(robot: Robot, goal: Goal, start: Array) -> tuple[Branch, ...]:
    """All branches that a closed form knows, the nearest to ``start`` (nq,) first.

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
    """The robot whose hinges and slides may go anywhere; balls keep their cones."""
    lower, upper = robot.lower.copy(), robot.upper.copy()
    for kind, at in zip(robot.tree.kind.tolist(), robot.tree.vadr.tolist(), strict=True):
        if kind in (HINGE, SLIDE):
            lower[at], upper[at] = -np.inf, np.inf
    return dataclasses.replace(robot, tree=robot.tree.with_limits(lower, upper))


def first_ball(robot: Robot) -> Pose:
    """Where the ball is before it moves: what the robot's gallery picture reaches for, else home."""
    home = robot.measure(robot.home)  # by MuJoCo: nothing has to be compiled for the first picture
    goals = gallery_scene(robot).goals
    if robot.tool not in goals:
        return home
    values = goals[robot.tool]
    return Pose(values[:3], values[3:] if len(values) == 7 else home.wxyz)


def reachable_curve(robot: Robot, goals: RobotGoals, solver: Solver) -> CurveSource:
    """A figure of eight round the first ball, as large as the tool can follow it."""
    ball, extent = first_ball(robot), float(robot.model.stat.extent)
    middle, radius = np.array(ball.position), _CURVE_RADIUS * extent
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
    """Whether the tool gets to all of a curve, from home on."""
    q = robot.home
    for t in np.linspace(0.0, CURVE_PERIOD, _CURVE_STEPS):
        wanted = goals.all(curve.poll(float(t)).target, solver)
        try:
            solution = solve(robot, wanted, solver=solver, start=q, budget=BUDGET)
        except RobotIkError:
            return True  # the method cannot serve these goals: any curve will do
        q = solution.q
        if solution.errors[0].position > 1e-3 or solution.errors[0].angle > 1e-2:
            return False
    return True
