"""``View``: an immutable snapshot of a session at one tick."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.figure.decide import Decision
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.testbed import commands
from robot_ik.testbed.course_run import CourseView
from robot_ik.testbed.instance import InstanceView
from robot_ik.testbed.obstacles import ContactView, ObstacleView
from robot_ik.testbed.planning import PlanView
from robot_ik.testbed.robot_goals import ExtraGoal, Pin
from robot_ik.testbed.timeline import TimelineView

if TYPE_CHECKING:
    from robot_ik.testbed.arm import ArmView


@dataclass(frozen=True, eq=False)
class BranchView:
    """One branch of the solution.

    Attributes:
        name: Its name.
        q: (nq,) joint angles, rad or m.
        xpos: (nbody, 3) positions of the bodies, world.
        xquat: (nbody, 4) their orientations, wxyz.
    """

    name: str
    q: Array
    xpos: Array
    xquat: Array


@dataclass(frozen=True)
class FigureView:
    """The state of a figure that decides by itself.

    Attributes:
        mode: ``active``: it follows the ball. ``passive``: it acts on the ball on demand.
        action: Its present action.
        phase: Progress of the action, 0 to 1.
        decision: Its latest decision.
        waiting: Whether it is passive and waits for the command to act.
        locked: Whether it is passive and acts, so that the ball cannot be moved.
    """

    mode: commands.FigureMode
    action: str
    phase: float
    decision: Decision
    waiting: bool
    locked: bool


@dataclass(frozen=True, eq=False)
class View:
    """A session at one tick.

    Attributes:
        tick: Ticks taken.
        now: Their time, s.
        robot: Name or path as it was asked for.
        motion: What moves the ball: a curve, random positions, a hand, joint values, the timeline.
        running: Whether the session runs. False after STOP.
        speed: Of the ball; 1 is real time.
        pace: Seconds at each random position.
        restarts: Whether methods restart while the ball is at random positions.
        ball: Pose of the ball, world.
        kind: What the ball asks of the tool.
        extras: Goals beside it.
        pins: Frames that are pinned.
        tool: Frame that follows the ball.
        base: Frame that carries the joints that move. Empty: all joints move.
        stiffness: Joints and their stiffness, where it is not that of the model.
        course: The course of thesis A00 that the ball follows. None: there is none.
        show_branches: Whether branches are shown.
        dragged: Body that is dragged. Empty: none.
        pull: (2, 3) the grabbed point and where the mouse pulls it, world, m. None: no drag.
        instances: One to four.
        branches: Of the first instance, if they are shown.
        busy: What is prepared beside the loop. Empty: nothing.
        message: An error in one sentence, for some seconds.
        arm: The servo arm that the first instance drives. None without one.
        figure: The first instance, if it is a figure that decides by itself.
        can_act: Whether this robot is a figure that can decide by itself.
        missing_meshes: Mesh files of the robot that are not drawn, as its file names them.
        timeline: Key poses and cursor.
        obstacles: Obstacles and their distances.
        plan: The planned motion of the first instance.
        contacts: Parts of the first instance that touch each other or an obstacle, deepest first.
    """

    tick: int
    now: float
    robot: str
    motion: commands.Motion
    running: bool
    speed: float
    pace: float
    restarts: bool
    ball: Pose
    kind: commands.GoalKind
    extras: tuple[ExtraGoal, ...]
    pins: tuple[Pin, ...]
    tool: str
    base: str
    stiffness: tuple[tuple[str, float], ...]
    course: CourseView | None
    show_branches: bool
    dragged: str
    pull: Array | None
    instances: tuple[InstanceView, ...]
    branches: tuple[BranchView, ...]
    busy: str
    message: str
    arm: ArmView | None
    figure: FigureView | None
    can_act: bool
    missing_meshes: tuple[str, ...]
    timeline: TimelineView
    obstacles: tuple[ObstacleView, ...]
    plan: PlanView
    contacts: tuple[ContactView, ...]

    @property
    def count(self) -> commands.Count:
        """Instances side by side."""
        return len(self.instances)  # type: ignore[return-value]

    @property
    def limits(self) -> bool:
        """Whether the joint limits of all instances hold."""
        return all(one.limited for one in self.instances)

    @property
    def state(self) -> str:
        """What the session does, in a few words."""
        if self.tick == 0:
            return "getting ready"
        if self.dragged:
            return f"{self.dragged} is dragged"
        return "running" if self.running else "holding still"

    def digest(self) -> str:
        """Return a fingerprint of everything that commands decide: no times and no servo arm."""
        fields: list[Any] = [self.tick, self.robot, self.motion, self.running, self.speed]
        fields += [self.pace, self.restarts, self.kind, self.limits, self.dragged]
        fields += [self.tool, self.base, self.stiffness]
        fields += [dataclasses.astuple(extra) for extra in self.extras]
        fields += [dataclasses.astuple(pin) for pin in self.pins]
        fields.append(None if self.course is None else dataclasses.astuple(self.course))
        fields.append(None if self.figure is None else dataclasses.astuple(self.figure))
        fields.append(dataclasses.astuple(self.timeline))
        fields += [self.plan.duration, self.plan.now, self.plan.playing]
        fields += [[one.placed.name, one.placed.shape, one.placed.size] for one in self.obstacles]
        arrays = [self.ball.position, self.ball.wxyz]
        arrays.append(self.plan.path)
        arrays += [obstacle.placed.position for obstacle in self.obstacles]
        for one in self.instances:
            statistics = one.statistics
            fields += [one.method, one.options, one.status, one.iterations, one.distance]
            fields += [one.budget.iterations, statistics.count, statistics.iterations]
            fields.append(statistics.solved)
            arrays += [one.q, one.xpos, one.trail, one.errors, np.array((one.error, one.angle))]
        arrays += [branch.q for branch in self.branches]
        content = hashlib.sha256(json.dumps(fields).encode())
        for array in arrays:
            content.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return content.hexdigest()[:32]
