"""Motions around the obstacles of a session: planned beside the loop, shown and played.

A plan goes from a posture that a person marks to where the ball is. ``motion.plan`` proves that it
keeps ``MARGIN``. A plan belongs to the obstacles that it was made for: a change of them removes it.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.obstacles import Obstacle
from robot_ik.collision.scene import Scene
from robot_ik.errors import RobotIkError
from robot_ik.goals import Goal
from robot_ik.kernels import collision, jit, path_edges, path_shortcut, tree_search
from robot_ik.kernels.precompile import Precompilation
from robot_ik.motion.plan import Plan, plan
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot
from robot_ik.testbed.commands import RATE, PlanMotion
from robot_ik.testbed.playback import Playback

_log = logging.getLogger(__name__)

MARGIN = 0.003
"""m. Distance that a planned motion keeps. The parts of a Koch arm at home are 4.9 mm apart."""

GHOSTS = 6
"""Postures that are shown along a plan, its ends among them."""

PATH_POINTS = 120
"""Positions of the tool that are shown along a plan."""

_KERNELS = (
    collision.verdicts,
    collision.smallest_distances,
    tree_search.grow_trees,
    path_edges.unproven_edge,
    path_shortcut.shorten,
)
"""Kernels of a plan. If one is not compiled, another process compiles all of them."""

_NICENESS = 10
"""Niceness of that process: the page comes first."""

_TRIES = 8
"""Largest number of plans that compile the planner: a goal may be in collision."""

_CHANGE = 0.3
"""rad or m. Typical change of a joint in these plans."""

PlanState = Literal["none", "planning", "found", "failed"]


@dataclass(frozen=True, eq=False)
class GhostPose:
    """Poses of all bodies of a robot.

    Attributes:
        xpos: (nbody, 3) positions, world, m.
        xquat: (nbody, 4) orientations, wxyz.
    """

    xpos: Array
    xquat: Array


@dataclass(frozen=True, eq=False)
class PlanView:
    """The plan of a session at one tick.

    Attributes:
        state: Whether a plan is being made, or how the last one ended.
        text: Description for people.
        path: (n, 3) positions of the tool, world, m. Empty without a motion.
        ghosts: Postures along the motion; without a motion the start alone, if one is marked.
        duration: Of the motion, s.
        now: Seconds of the cursor.
        playing: Whether the cursor moves.
    """

    state: PlanState
    text: str
    path: Array
    ghosts: tuple[GhostPose, ...]
    duration: float
    now: float
    playing: bool


@dataclass(frozen=True, eq=False)
class PlanTask:
    """What the planner needs of a session.

    Attributes:
        command: The command, with the posture of the start and the pose of the ball.
        robot: The robot, within the limits that hold.
        goal: What the ball asks of the tool.
        obstacles: The obstacles.
    """

    command: PlanMotion
    robot: Robot
    goal: Goal
    obstacles: tuple[Obstacle, ...]


@dataclass(frozen=True, eq=False)
class PlanDone:
    """The result of a task.

    Attributes:
        task: The task.
        plan: The plan. None if it could not be made.
        error: Why it could not be made. Empty with a plan.
    """

    task: PlanTask
    plan: Plan | None
    error: str = ""


def planned(task: PlanTask) -> PlanDone:
    """Plan a task. The result depends on the task only."""
    try:
        scene = Scene(task.robot, task.obstacles)
        avoid = CollisionAvoidance(scene, margin=MARGIN)
        start = np.array(task.command.start)
        return PlanDone(task, plan(task.robot, start, task.goal, collisions=avoid, rate=RATE))
    except RobotIkError as error:
        return PlanDone(task, None, str(error).splitlines()[0])
    except Exception as error:  # without a result the page would wait forever
        _log.exception("no plan for %s", task.command)
        return PlanDone(task, None, f"the motion cannot be planned: {error}")


class Planner:
    """Plans tasks one after the other.

    Args:
        done: Called with each result.
        beside: Plan on a thread. Else at once.
    """

    def __init__(self, done: Callable[[PlanDone], None], *, beside: bool) -> None:
        self._done = done
        self._beside = beside
        self._tasks: queue.SimpleQueue[PlanTask | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._compiler: Precompilation | None = None
        self._is_over = False

    def ask(self, task: PlanTask) -> None:
        """Plan a task."""
        if not self._beside:
            self._done(planned(task))
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="testbed-planner", daemon=True)
            self._thread.start()
        self._tasks.put(task)

    def close(self) -> None:
        """End, without waiting for a plan or for the compiler."""
        self._is_over = True
        if self._compiler is not None:
            self._compiler.close()
        self._tasks.put(None)

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            self._compile(task.robot)
            if self._is_over:
                return
            self._done(planned(task))

    def _compile(self, robot: Robot) -> None:
        """Compile in another process: a compiler here would hold up the page."""
        if all(map(jit.compiled, _KERNELS)) or robot.source is None:
            return
        function = f"{__name__}:compile_planner"
        self._compiler = Precompilation(function, str(robot.source), niceness=_NICENESS)
        self._compiler.wait()


class PlannedMotion(Playback):
    """The plan of one robot, its start, and a cursor.

    Args:
        robot: The robot.

    Attributes:
        start: (nq,) the posture at which a plan starts.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        self._robot = robot
        self.start = robot.home.copy()
        self._task: PlanTask | None = None
        self._state: PlanState = "none"
        self._text = ""
        self._plan: Plan | None = None
        self._path: Array = np.zeros((0, 3))
        self._ghosts: tuple[GhostPose, ...] = ()

    @property
    def has_motion(self) -> bool:
        """Whether there is a motion to show."""
        return self._plan is not None

    @property
    def duration(self) -> float:
        """Seconds of the motion, 0 without one."""
        trajectory = None if self._plan is None else self._plan.trajectory
        return 0.0 if trajectory is None else trajectory.duration

    def mark_start(self, q: Array) -> None:
        """Let the next plan start at ``q`` (nq,). The present plan is removed."""
        self.remove()
        self.start = q.copy()
        self._ghosts = (self._ghost(q),)
        self._text = "the start is marked: move the ball to the goal, then plan"

    def begin(self, task: PlanTask) -> None:
        """Show that a plan is being made."""
        self.remove()
        self._task = task
        self._state = "planning"
        self._text = "planning …"

    def take(self, done: PlanDone) -> bool:
        """Show a result. Return False for the result of a task that was replaced or removed."""
        if done.task is not self._task:
            return False
        self._task = None
        self._show(done)
        return True

    def _show(self, done: PlanDone) -> None:
        result = done.plan
        if result is None or result.trajectory is None:
            self._state = "failed"
            self._text = done.error if result is None else result.meaning
            self._ghosts = (self._ghost(self.start),)
            return
        trajectory = result.trajectory
        self._state = "found"
        self._plan = result
        self.now = 0.0
        proof = "not proven"
        if trajectory.clearance is not None:
            proof = f"proven to keep {1e3 * trajectory.clearance:.0f} mm"
        self._text = f"{trajectory.duration:.1f} s, {proof}; planned in {result.seconds:.2f} s"
        rows = np.linspace(0, len(trajectory) - 1, PATH_POINTS).round().astype(int)
        self._path = np.array([self._robot.measure(trajectory.q[k]).position for k in rows])
        shown = np.linspace(0, len(trajectory) - 1, GHOSTS).round().astype(int)
        self._ghosts = tuple(self._ghost(trajectory.q[k]) for k in shown)

    def use(self, robot: Robot) -> None:
        """Plan for another goal, or for the same joints with another tool or other limits."""
        self._robot = robot
        self.invalidate()

    def invalidate(self) -> None:
        """Remove a plan because what it was made for has changed."""
        if self._state != "none":
            self.remove()
            self._text = "the obstacles or the goal have changed: plan again"

    def remove(self) -> None:
        """Remove the plan. The result of a task that is not ready will not be shown."""
        self.playing = False
        self._task = None
        self._state = "none"
        self._text = ""
        self._plan = None
        self._path = np.zeros((0, 3))
        self._ghosts = ()
        self.now = 0.0

    def _ghost(self, q: Array) -> GhostPose:
        data = self._robot.data_at(q)
        return GhostPose(data.xpos.copy(), data.xquat.copy())

    def step(self, seconds: float) -> Array | None:
        """Advance the cursor and return the posture (nq,) there, or None without a motion."""
        trajectory = None if self._plan is None else self._plan.trajectory
        if trajectory is None:
            return None
        return np.asarray(trajectory.at(self.advance(seconds)))

    def view(self) -> PlanView:
        """Return what a front end shows."""
        return PlanView(
            state=self._state,
            text=self._text,
            path=self._path,
            ghosts=self._ghosts,
            duration=self.duration,
            now=self.now,
            playing=self.playing,
        )


def compile_planner(source: str) -> None:
    """Compile the planner with a plan of a robot: a name, a path or the text of a model."""
    robot = load_robot(source)
    rng = np.random.default_rng(0)
    avoid = CollisionAvoidance(Scene(robot), margin=MARGIN)
    for _ in range(_TRIES):
        near = robot.clip(robot.home + _CHANGE * rng.normal(size=robot.nq))
        if plan(robot, robot.home, robot.forward(near), collisions=avoid).found:
            return
