"""One robot of the testbed, solved on its own: its method, its angles, its statistics."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import RobotIkError
from robot_ik.figure.motion.drag import Drag
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, Tolerance
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers.base import Solver
from robot_ik.testbed.commands import RATE, DragLink
from robot_ik.testbed.setup import BUDGET, RobotGoals, gaze_axis, retarget

TRAIL = 120
"""Places of the tool that a trail has."""
HISTORY_SECONDS = 5.0
_TOLERANCE = Tolerance()
_DRAG_SPEED = 10.0  # times the joints' limits: what is drawn is as quick as a mouse; an arm has its limiter


WINDOW = 1000
"""Solves that the statistics cover, as in S12's program."""


@dataclass(frozen=True)
class Statistics:
    """Of the last ``count`` solves, at most ``WINDOW``."""

    count: int = 0  # how many solves these numbers cover
    mean: float = 0.0  # s of processor time of a solve, without waiting for others: no benchmark
    p99: float = 0.0
    iterations: float = 0.0  # mean steps of a solve
    solved: float = 0.0  # share of solves that met the ball's goal, 0 to 1; goals beside it do not count

    @classmethod
    def of(cls, solves: Array) -> Statistics:
        """Of solves (n, 3): seconds, steps, and 1 where the ball's goal was met."""
        if not len(solves):
            return cls()
        mean, iterations, solved = solves.mean(axis=0).tolist()
        return cls(len(solves), mean, float(np.percentile(solves[:, 0], 99)), iterations, solved)


def appended(rows: Array, row: ArrayLike, length: int) -> Array:
    """The last ``length`` of rows (n, width) and one more; a new array."""
    return np.concatenate([rows, [row]])[-length:]


@dataclass(frozen=True, eq=False)
class InstanceView:
    """What is seen of an instance; arrays change no more."""

    method: str  # its name
    options: tuple[tuple[str, Any], ...]  # (name, value) of each of the method's options
    q: Array  # (nq,) joint angles, rad or m
    xpos: Array  # (nbody, 3) positions of MuJoCo's bodies, world
    xquat: Array  # (nbody, 4) their orientations, wxyz
    status: str  # how the last solve ended, or why nothing can be solved, as text
    able: bool  # whether its method can serve what is asked
    note: str  # what it does otherwise than the others, as text
    error: float  # m of the tool off what the ball asks, by MuJoCo's kinematics
    angle: float  # rad, likewise
    iterations: int  # steps of the last solve
    statistics: Statistics  # of the last ``WINDOW`` solves
    goals: tuple[tuple[str, float, float], ...]  # (name, m, rad) off at the last full second
    trail: Array  # (n, 3) where the tool was, oldest first
    errors: Array  # (n, 3) history: error in m, in rad, manipulability

    @property
    def off(self) -> str:
        """How far the tool is off what the ball asks; in degrees where the angle alone is missed."""
        if self.error <= _TOLERANCE.position and self.angle > _TOLERANCE.angle:
            return f"{math.degrees(self.angle):.2f}°"
        return f"{1e3 * self.error:.2f} mm"

    @property
    def summary(self) -> str:
        """What its last solve gave, in one line, or why its method cannot serve what is asked."""
        if not self.able:
            return self.status
        solved = f", {100.0 * self.statistics.solved:.0f} % solved" if self.statistics.count else ""
        return f"{self.off} off, {self.iterations} steps{solved}"


class Instance:
    """One robot with its method; it stands still until it has one.

    Args:
        robot: Within the limits that hold.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.solver: Solver | None = None
        self.data = mujoco.MjData(robot.model)
        frame = robot.frame(robot.tool)
        self._body, self._local = frame.body, frame.local
        self.refused = self.note = ""
        self.reset()

    def reset(self) -> None:
        """Home, with empty statistics."""
        self.move_to(self.robot.home)
        self._problem: Problem | None = None
        self._drag: Drag | None = None
        self._held: tuple[str, tuple[float, float, float]] | None = None
        self._status, self._iterations = "", 0
        self.error = self.angle = self.manipulability = 0.0
        self._trail, self._errors = np.empty((0, 3)), np.empty((0, 3))
        self._begin_statistics()
        self._goals: tuple[tuple[str, float, float], ...] = ()

    def _begin_statistics(self) -> None:
        self._solves, self._statistics = np.empty((0, 3)), Statistics()

    def take(self, robot: Robot, solver: Solver, refused: str, note: str) -> None:
        """Goes on with another method, options or limits; a method that changed begins new statistics."""
        if self.solver != solver or self.robot is not robot:
            self._begin_statistics()
        self.robot, self.solver, self.refused, self.note = robot, solver, refused, note
        self._problem = self._drag = None
        if robot.outside(self.q):
            self.move_to(robot.clip(self.q))

    def move_to(self, q: Array) -> None:
        """Stands at ``q`` (nq,)."""
        self.q = np.array(q, dtype=float)
        self.data.qpos[:] = self.robot.qpos(self.q)
        mujoco.mj_kinematics(self.robot.model, self.data)

    def tool_pose(self) -> Pose:
        """Where the tool is, by MuJoCo's kinematics."""
        rotation, position = self._tool()
        return Pose.from_rotation(rotation, position)

    def _tool(self) -> tuple[Array, Array]:
        """Rotation (3, 3) and position (3,) of the tool."""
        rotation = self.data.xmat[self._body].reshape(3, 3)
        return rotation @ self._local.rotation, self.data.xpos[self._body] + rotation @ self._local.position

    def solve(self, goals: RobotGoals, ball: Pose) -> None:
        """Goes to what the ball asks for."""
        self._drag = None
        if self.solver is None:
            return
        solution, self._status = None, self.refused
        if not self.refused:
            wanted = goals.all(ball, self.solver)
            if self._problem is None:
                self._problem = Problem(self.robot, wanted, solver=self.solver, budget=BUDGET)
            solution = self._solved(self._problem, wanted)
        self._measure(goals, ball)
        if solution is not None:
            met = self.error <= _TOLERANCE.position and self.angle <= _TOLERANCE.angle
            self._solves = appended(self._solves, (self._seconds, solution.iterations, met), WINDOW)

    def stand(self, q: Array, doing: str, goals: RobotGoals, ball: Pose) -> None:
        """Stands at ``q`` (nq,), as a figure that decides by itself does; nothing is solved."""
        self._drag, self._status, self._iterations = None, doing, 0
        self.move_to(q)
        self._measure(goals, ball)

    def drag(self, drag: DragLink, goals: RobotGoals, ball: Pose) -> None:
        """Brings a grabbed point to where the mouse is; what the goals keep stays where it is."""
        held = drag.body, drag.grip
        try:
            if self._drag is None or self._held != held:
                self._drag = Drag(
                    self.robot, pinned=goals.kept, start=self.q, rate=RATE, speed=_DRAG_SPEED,
                    balance=goals.balanced,
                )  # fmt: skip
                self._drag.grab(*held)
                self._held = held
            self.move_to(self._drag.step(drag.to))
            self._status, self._iterations = "dragged", 0
        except RobotIkError as error:
            self._drag, self._status = None, str(error).splitlines()[0]
        self._measure(goals, ball)

    def _solved(self, problem: Problem, wanted: list[Goal]) -> Solution | None:
        try:
            retarget(problem, wanted)
            begin = time.thread_time()
            solution = problem.solve(self.q)
            self._seconds = time.thread_time() - begin
        except RobotIkError as error:
            self._status = str(error).splitlines()[0]
            return None
        self._status, self._iterations = solution.status.name.lower().replace("_", " "), solution.iterations
        if np.isfinite(solution.q).all():
            self.move_to(solution.q)
        return solution

    def _measure(self, goals: RobotGoals, ball: Pose) -> None:
        """Error, trail and histories."""
        rotation, position = self._tool()
        self.error, self.angle = off(goals, rotation, position, ball)
        self._trail = appended(self._trail, position, TRAIL)
        kept = round(HISTORY_SECONDS * RATE)
        self._errors = appended(self._errors, (self.error, self.angle, self.manipulability), kept)

    def measure_manipulability(self) -> None:
        """Product of the singular values of the tool's Jacobian; costs 60 µs, so not in each tick."""
        values = np.linalg.svd(self.robot.jacobian(self.q), compute_uv=False)
        self.manipulability = float(np.prod(values[: min(6, self.robot.nv)]))

    def measure_statistics(self, goals: RobotGoals, ball: Pose) -> None:
        """Of the window as it is now, and of each goal: 50 µs each, so once a second."""
        self._statistics = Statistics.of(self._solves)
        self._goals = tuple((name, *goal.error(self.robot, self.q)) for name, goal in goals.named(ball))

    def view(self) -> InstanceView:
        """What is seen of it."""
        items = () if self.solver is None else dataclasses.fields(self.solver)
        options = tuple((item.name, getattr(self.solver, item.name)) for item in items)
        return InstanceView(
            "" if self.solver is None else self.solver.name, options, self.q.copy(), self.data.xpos.copy(),
            self.data.xquat.copy(), self._status, not self.refused, self.note, self.error, self.angle,
            self._iterations, self._statistics, self._goals, self._trail, self._errors,
        )  # fmt: skip


def off(goals: RobotGoals, rotation: Array, position: Array, ball: Pose) -> tuple[float, float]:
    """Metres and radians that the tool is off what the ball asks.

    As ``Goal.off``, which costs 50 µs; this 5: it is asked 240 times a second.
    """
    offset = ball.position - position
    match goals.kind:
        case "position":
            return math.sqrt(offset @ offset), 0.0
        case "pose":
            return math.sqrt(offset @ offset), _angle(rotation, ball.rotation)
        case "aim":
            axis = rotation[:, 0 if gaze_axis(goals.robot.tool) == "x" else 2]
            sine = np.cross(axis, offset)
            return 0.0, math.atan2(math.sqrt(sine @ sine), float(axis @ offset))
    normal = ball.rotation[:, 2]
    along = float(offset @ normal)
    if goals.kind == "plane":
        return abs(along), 0.0
    across = offset - along * normal
    return math.sqrt(across @ across), 0.0


def _angle(a: Array, b: Array) -> float:
    """Of the rotation between two frames, radians."""
    # The sine from the antisymmetric part: exact for small angles, where the cosine is blind.
    m = a.T @ b
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    return math.atan2(0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1.0))
