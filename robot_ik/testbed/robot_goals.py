"""The goals of one robot in the testbed: the goal of the ball, further goals, and pins."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

from robot_ik.errors import InvalidGoalError, ModelError
from robot_ik.geometry import Pose
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    Goal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PosePriorGoal,
    PositionGoal,
    PostureGoal,
)
from robot_ik.kernels.tree import FREE
from robot_ik.pose_prior import PosePrior
from robot_ik.robot import Robot
from robot_ik.solvers.base import Solver
from robot_ik.support import supported_frames
from robot_ik.testbed import commands
from robot_ik.testbed.gallery_scene import gallery_scene

_HOLD_GOALS = 6
"""Largest number of ``hold`` goals that are offered."""

_GAZE = "gaze"

NATURAL_POSE = "natural pose"
"""Name of the goal that prefers poses like the learned ones."""

_PIN = "pin "
"""Prefix of the name of a pin's goal."""


@dataclass(frozen=True)
class ExtraGoal:
    """A goal beside the ball's.

    Attributes:
        name: Its name on the page.
        on: Whether it counts.
        priority: Goals of priority 0 are met first.
        about: What it asks.
        weight: Against goals of the same priority.
    """

    name: str
    on: bool
    priority: int
    about: str
    weight: float = 1.0


@dataclass(frozen=True)
class Pin:
    """A frame that stays at a place.

    Attributes:
        frame: The frame.
        position: (3,) world, m.
        wxyz: (4,) orientation that is kept. None: the frame may turn.
        weight: Against goals of the same priority.
        priority: Goals of priority 0 are met first.
    """

    frame: str
    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float] | None
    weight: float
    priority: int

    @property
    def name(self) -> str:
        """Name of its goal."""
        return f"{_PIN}{self.frame}"

    def goal(self) -> Goal:
        """Return its goal."""
        if self.wxyz is None:
            return PositionGoal(
                self.frame, self.position, weight=self.weight, priority=self.priority
            )
        return PoseGoal(
            self.frame,
            self.position,
            self.wxyz,
            position_weight=self.weight,
            angle_weight=self.weight,
            priority=self.priority,
        )


class RobotGoals:
    """The goals of one robot, made for each tick from the ball's pose.

    Args:
        robot: The robot.
        kind: What the ball asks of the tool.
        extras: Goals beside it. That of the ball itself is called ``ball``.
        pins: Frames that stay at a place.

    Attributes:
        robot: The robot.
        kind: What the ball asks of the tool.
        priority: Of the ball's goal.
        weight: Of the ball's goal.
        kept: Frames that do not move during a drag.
        balanced: Whether the centre of mass stays over its position.
    """

    def __init__(
        self,
        robot: Robot,
        kind: commands.GoalKind,
        extras: tuple[ExtraGoal, ...],
        pins: tuple[Pin, ...] = (),
    ) -> None:
        self.robot = robot
        self.kind = kind
        ball = next(extra for extra in extras if extra.name == "ball")
        self.priority = ball.priority
        self.weight = ball.weight
        others = [extra for extra in extras if extra.on and extra.name != "ball"]
        self._extras = [(extra, _extra_goal(robot, extra)) for extra in others]
        pins = tuple(pin for pin in pins if robot.attachment(pin.frame)[0] >= 0)  # it can move
        self._pins = [(pin, pin.goal()) for pin in pins]
        names = [extra.name for extra, _ in self._extras]
        kept = [name.removeprefix("keep ") for name in names if name.startswith("keep ")]
        kept += [pin.frame for pin in pins if pin.weight > 0.0]
        self.kept = tuple(dict.fromkeys(kept))
        self.balanced = "balance" in names

    def main(self, ball: Pose) -> Goal:
        """Return what the ball asks of the tool."""
        tool = self.robot.tool
        position = ball.position
        normal = ball.rotation[:, 2]
        rank = self.priority
        weight = self.weight
        match self.kind:
            case "pose":
                return PoseGoal(
                    tool,
                    position,
                    ball.wxyz,
                    position_weight=weight,
                    angle_weight=weight,
                    priority=rank,
                )
            case "position":
                return PositionGoal(tool, position, weight=weight, priority=rank)
            case "orientation":
                return OrientationGoal(tool, ball.wxyz, weight=weight, priority=rank)
            case "aim":
                axis = gaze_axis(tool)
                return AimGoal(tool, position, axis=axis, weight=weight, priority=rank)
            case "line":
                return LineGoal(tool, position, normal, weight=weight, priority=rank)
            case "plane":
                return PlaneGoal(tool, position, normal, weight=weight, priority=rank)
            case "half_space":
                return HalfSpaceGoal(tool, position, normal, weight=weight, priority=rank)

    def all(self, ball: Pose, solver: Solver) -> list[Goal]:
        """Return the ball's goal, then the others.

        A method that cannot order goals gets them at one priority, without posture and prior.
        """
        goals = [goal for _, goal in self.named(ball)]
        if "priorities" in solver.capabilities:
            return goals
        ranked = [goal for goal in goals if not isinstance(goal, PostureGoal | PosePriorGoal)]
        return [replace(goal, priority=0) for goal in ranked]

    def named(self, ball: Pose) -> list[tuple[str, Goal]]:
        """Return all goals by their names on the page, the ball's first."""
        goals: list[tuple[str, Goal]] = [("ball", self.main(ball))]
        for extra, goal in self._extras:
            if goal is None:
                goal = AimGoal(
                    _GAZE,
                    ball.position,
                    axis="x",
                    weight=extra.weight,
                    priority=extra.priority,
                )
            goals.append((extra.name, goal))
        goals += [(pin.name, goal) for pin, goal in self._pins]
        return goals

    def flattened(self, solver: Solver) -> bool:
        """Return whether the method takes goals of several priorities at one priority."""
        ranks = {self.priority, *(extra.priority for extra, _ in self._extras)}
        ranks |= {pin.priority for pin, _ in self._pins}
        return len(ranks) > 1 and "priorities" not in solver.capabilities


def gaze_axis(tool: str) -> str:
    """Return the axis of a frame that aims: x of eyes, z of hands and tools."""
    return "x" if tool == _GAZE else "z"


def _extra_goal(robot: Robot, extra: ExtraGoal) -> Goal | None:
    """Return the goal of an extra, or None for the gaze, whose target is the ball."""
    home = robot.home
    rank = extra.priority
    weight = extra.weight
    verb, _, frame = extra.name.partition(" ")
    if verb == "keep":
        pose = robot.forward(home, frame)
        return PoseGoal(
            frame,
            pose.position,
            pose.wxyz,
            position_weight=weight,
            angle_weight=weight,
            priority=rank,
        )
    if verb == "hold":
        position = robot.forward(home, frame).position
        return PositionGoal(frame, position, weight=weight, priority=rank)
    if verb == "level":
        wxyz = first_ball(robot).wxyz
        return OrientationGoal(frame, wxyz, free_axis="z", weight=weight, priority=rank)
    if verb == "balance":
        centre = robot.center_of_mass(home)
        return CenterOfMassGoal(None, centre, axes="xy", weight=weight, priority=rank)
    if verb == "posture":
        kinds = zip(robot.joints, robot.tree.kind.tolist(), strict=True)
        free = [joint for joint, kind in kinds if kind == FREE]
        return PostureGoal(q=home, joints=dict.fromkeys(free, 0.0), weight=weight, priority=rank)
    if extra.name == NATURAL_POSE:
        return PosePriorGoal(prior=PosePrior.of(robot), weight=weight, priority=rank)
    return None


def is_figure(robot: Robot) -> bool:
    """Return whether a robot stands on feet: it has a floating base and frames to keep."""
    floats = FREE in robot.tree.kind.tolist()
    return floats and bool(robot.file.keep)


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
    """Return the goals of a figure. Goals that conflict with the ball are off."""
    keep = robot.file.keep
    free = supported_frames(robot, (robot.tool,))
    extras = [
        ExtraGoal(f"keep {frame}", frame in free, 0, _about_keep(frame, frame in free))
        for frame in keep
    ]
    extras.append(ExtraGoal("balance", True, 1, "centre of mass above its position at home"))
    extras.append(ExtraGoal("ball", True, 2, "what the ball asks of the tool"))
    tools = robot.file.tools
    if _GAZE in tools and robot.tool != _GAZE:
        looks = not _moves_with_tool(robot, _GAZE)
        extras.append(ExtraGoal(_GAZE, looks, 3, "the eyes look at the ball"))
    others = [name for name in tools if name not in (robot.tool, _GAZE, *keep)]
    others = [name for name in others if not _moves_with_tool(robot, name)]
    for name in others[:_HOLD_GOALS]:
        extras.append(ExtraGoal(f"hold {name}", False, 3, f"{name} stays at its position"))
    extras.append(ExtraGoal("posture", True, 4, "joints as near to home as possible"))
    with contextlib.suppress(ModelError, InvalidGoalError):
        PosePrior.of(robot).indices(robot)
        about = "a pose like those of motions that were learned; for methods with priorities"
        extras.append(ExtraGoal(NATURAL_POSE, False, 3, about))
    return tuple(extras)


def _about_keep(frame: str, is_free: bool) -> str:
    return f"{frame} stays at home" if is_free else f"{frame} stays at home: the ball moves it"


def _moves_with_tool(robot: Robot, frame: str) -> bool:
    """Return whether a frame is rigidly connected to the tool."""
    rigid = robot.model.body_weldid
    return bool(rigid[robot.frame(frame).body] == rigid[robot.frame(robot.tool).body])


def first_ball(robot: Robot) -> Pose:
    """Return the first pose of the ball: the goal of the robot's gallery picture, else home."""
    home = robot.measure(robot.home)  # MuJoCo needs no compilation before the first picture
    goals = gallery_scene(robot).goals
    if robot.tool not in goals:
        return home
    values = goals[robot.tool]
    return Pose(values[:3], values[3:] if len(values) == 7 else home.wxyz)
