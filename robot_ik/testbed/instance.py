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

from robot_ik.budget import Budget
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
from robot_ik.testbed.limb import Limb
from robot_ik.testbed.problem_text import problem_text
from robot_ik.testbed.robot_goals import NATURAL_POSE, RobotGoals, gaze_axis
from robot_ik.testbed.setup import BUDGET, restarting, retarget

TRAIL = 120
"""Positions of the tool that a trail has."""

HISTORY_SECONDS = 5.0
"""Length of the history of errors."""

WINDOW = 1000
"""Solves that the statistics cover, as in the program of thesis S12."""

STUCK_TICKS = RATE
"""Ticks without a success after which a following method counts as stuck."""

_TOLERANCE = Tolerance()

_DRAG_SPEED = 10.0
"""Factor of the speed limits of the joints: a drawn robot is as fast as a mouse. A servo arm has
its limiter."""

_STUCK_STATUSES = ("blocked by limits", "stalled", "iteration limit")
"""Statuses of solves that may succeed from another start."""

_HARMLESS_STATUSES = ("converged", "stalled", "iteration limit", "")
"""Statuses that are not shown if every goal is met."""


@dataclass(frozen=True)
class Statistics:
    """Statistics of the last solves, at most ``WINDOW``.

    A frame counts if the ball moved in it, or if the last solve did not meet the ball.

    Attributes:
        count: Number of solves.
        mean: Mean processor time of a solve in seconds, without waiting for other threads.
        p99: 99th percentile of that time.
        iterations: Mean iterations of a solve.
        solved: Share of solves that met the ball's goal, 0 to 1. Other goals do not count.
        joint_change: Largest change of a joint between two frames, rad or m.
    """

    count: int = 0
    mean: float = 0.0
    p99: float = 0.0
    iterations: float = 0.0
    solved: float = 0.0
    joint_change: float = 0.0

    @classmethod
    def of(cls, solves: Array) -> Statistics:
        """Return the statistics of solves (n, 4): seconds, iterations, success, joint change."""
        if not len(solves):
            return cls()
        mean, iterations, solved, _ = solves.mean(axis=0).tolist()
        p99 = float(np.percentile(solves[:, 0], 99))
        return cls(len(solves), mean, p99, iterations, solved, float(solves[:, 3].max()))


_ALWAYS_MISSED = ("ball", "posture", NATURAL_POSE)
"""Goals that do not explain a status: the ball is met, and a posture is only approached."""


def appended(rows: Array, row: ArrayLike, length: int) -> Array:
    """Return the last ``length`` of rows (n, width) and one more as a new array."""
    return np.concatenate([rows, [row]])[-length:]


@dataclass(frozen=True, eq=False)
class InstanceView:
    """An instance at one tick. Its arrays do not change.

    Attributes:
        method: Name of its method.
        options: Name and value of each of the method's options.
        budget: Limits of one solve.
        distance: Metres between tool and ball at which a solve counts as a success.
        q: (nq,) joint angles, rad or m.
        xpos: (nbody, 3) positions of MuJoCo's bodies, world.
        xquat: (nbody, 4) their orientations, wxyz.
        status: How the last solve ended, or why nothing can be solved.
        able: Whether its method supports the goals.
        note: How its goals differ from those of the other instances.
        limited: Whether its joint limits hold.
        error: Metres between the tool and what the ball asks, by MuJoCo's kinematics.
        angle: Radians, likewise.
        met: Whether error and angle are within the tolerances of this instance.
        stuck: Whether the method cannot leave a pose from which it does not reach the ball.
        iterations: Iterations of the last solve.
        statistics: Of the last ``WINDOW`` solves.
        goals: Name, metres and radians of each goal's error at the last full second.
        trail: (n, 3) positions of the tool, oldest first.
        errors: (n, 3) history: error in m, in rad, manipulability.
    """

    method: str
    options: tuple[tuple[str, Any], ...]
    budget: Budget
    distance: float
    q: Array
    xpos: Array
    xquat: Array
    status: str
    able: bool
    note: str
    limited: bool
    error: float
    angle: float
    met: bool
    stuck: bool
    iterations: int
    statistics: Statistics
    goals: tuple[tuple[str, float, float], ...]
    trail: Array
    errors: Array

    @property
    def off(self) -> str:
        """Error of the tool as text, in degrees if only the angle is missed."""
        if self.error <= self.distance and self.angle > _TOLERANCE.angle:
            return f"{math.degrees(self.angle):.2f}°"
        return f"{1e3 * self.error:.2f} mm"

    @property
    def words(self) -> str:
        """The state of the instance in words, which agree with the numbers."""
        if not self.able:
            return self.status
        if not self.met:
            return f"{self.status}: press Reset, or choose a branch" if self.stuck else self.status
        if self.status in _HARMLESS_STATUSES:
            return "ball met"
        missed = self._missed_goal()
        return f"ball met; {missed} {self.status}" if missed else "ball met"

    def _missed_goal(self) -> str:
        """Return the name of the first other goal that is missed, except the posture."""
        for name, metres, angle in self.goals:
            is_missed = metres > _TOLERANCE.position or angle > _TOLERANCE.angle
            if is_missed and name not in _ALWAYS_MISSED:
                return name
        return ""

    @property
    def summary(self) -> str:
        """The last result in one line, or why the method does not support the goals."""
        if not self.able:
            return self.status
        solved = f", {100.0 * self.statistics.solved:.0f} % solved" if self.statistics.count else ""
        return f"{self.off} off, {self.iterations} steps{solved}"


class Instance:
    """One robot with its method. Without a method it does not move.

    Args:
        robot: The robot, with the limits that hold for it.
    """

    def __init__(self, robot: Robot) -> None:
        self.solver: Solver | None = None
        self.data = mujoco.MjData(robot.model)
        self._set_robot(robot)
        self.limited = True
        self.refused = ""
        self.note = ""
        self._limb: Limb | None = None
        self.budget = BUDGET
        self.distance = _TOLERANCE.position
        self._restarts = False
        self.reset()

    def _set_robot(self, robot: Robot) -> None:
        self.robot = robot
        frame = robot.frame(robot.tool)
        self._body = frame.body
        self._local = frame.local

    def reset(self) -> None:
        """Go home and empty the statistics."""
        self.move_to(self.robot.home)
        self._problem: Problem | None = None
        self._drag: Drag | None = None
        self._held: tuple[str, tuple[float, float, float]] | None = None
        self._status = ""
        self._iterations = 0
        self._unmet_ticks = 0
        self.error = 0.0
        self.angle = 0.0
        self.manipulability = 0.0
        self._trail = np.empty((0, 3))
        self._errors = np.empty((0, 3))
        self._begin_statistics()
        self._goals: tuple[tuple[str, float, float], ...] = ()

    def _begin_statistics(self) -> None:
        self._solves = np.empty((0, 4))
        self._statistics = Statistics()
        self._last_ball: Pose | None = None

    def take(
        self,
        robot: Robot,
        solver: Solver,
        *,
        limited: bool,
        refused: str,
        note: str,
        limb: Limb | None = None,
    ) -> None:
        """Continue with another method, options, tool or limits.

        A changed method or robot begins new statistics.

        Args:
            robot: The robot, with the same joints.
            solver: The method.
            limited: Whether the joint limits hold.
            refused: Why the method does not support the goals. Empty if it does.
            note: How its goals differ from those of the other instances.
            limb: The limb that the method moves alone, towards the ball. None: all goals are served
                with all joints.
        """
        if self.solver != solver or self.robot is not robot:
            self._begin_statistics()
        if self.robot.tool != robot.tool:
            self._trail = np.empty((0, 3))
        self._set_robot(robot)
        self.limited = limited
        self.solver = solver
        self.refused = refused
        self.note = note
        self._limb = limb
        self._problem = None
        self._drag = None
        self._unmet_ticks = 0
        if robot.outside(self.q):
            self.move_to(robot.clip(self.q))

    def set_budget(self, iterations: int, distance: float) -> None:
        """Set the iterations of one solve and the distance in metres that counts as a success."""
        self.budget = dataclasses.replace(self.budget, iterations=iterations)
        self.distance = distance
        self._problem = None
        self._begin_statistics()

    def move_to(self, q: Array) -> None:
        """Put the robot to ``q`` (nq,)."""
        self.q = np.array(q, dtype=float)
        self.data.qpos[:] = self.robot.qpos(self.q)
        mujoco.mj_kinematics(self.robot.model, self.data)

    def tool_pose(self) -> Pose:
        """Return the pose of the tool, by MuJoCo's kinematics."""
        rotation, position = self._tool()
        return Pose.from_rotation(rotation, position)

    def _tool(self) -> tuple[Array, Array]:
        """Return rotation (3, 3) and position (3,) of the tool."""
        rotation = self.data.xmat[self._body].reshape(3, 3)
        position = self.data.xpos[self._body] + rotation @ self._local.position
        return rotation @ self._local.rotation, position

    def solve(self, goals: RobotGoals, ball: Pose, *, restarts: bool = False) -> None:
        """Solve the goals once and move to the solution.

        Args:
            goals: The goals.
            ball: Pose of the ball, world.
            restarts: Whether the method may restart at random joint angles.
        """
        self._drag = None
        if self.solver is None:
            return
        if self._restarts is not restarts:
            self._restarts = restarts
            self._problem = None
        solution = None
        is_requested = self._is_requested(ball)
        self._status = self.refused
        before = self.q
        if not self.refused:
            wanted = self._wanted(goals, ball, self.solver)
            if self._problem is None:
                budget = restarting(self.budget, self.robot) if restarts else self.budget
                robot = self.robot if self._limb is None else self._limb.robot
                self._problem = Problem(robot, wanted, solver=self.solver, budget=budget)
            solution = self._solved(self._problem, wanted)
        self._measure(goals, ball)
        if solution is not None:
            met = self.is_met
            self._unmet_ticks = 0 if met else self._unmet_ticks + 1
        if solution is not None and is_requested:
            change = float(np.abs(self._change_from(before)).max(initial=0.0))
            row = (self._seconds, solution.iterations, met, change)
            self._solves = appended(self._solves, row, WINDOW)

    def _wanted(self, goals: RobotGoals, ball: Pose, solver: Solver) -> list[Goal]:
        """Return the goals that the method supports."""
        if self._limb is None:
            wanted = goals.all(ball, solver)
        else:
            wanted = [dataclasses.replace(goals.main(ball), priority=0)]
        # The success distance ends the ball's solve, and does not loosen the other goals.
        tolerance = dataclasses.replace(_TOLERANCE, position=self.distance)
        wanted[0] = dataclasses.replace(wanted[0], tolerance=tolerance)
        return wanted

    def _change_from(self, before: Array) -> Array:
        """Return the change (nv,) of the joints since ``before`` (nq,), rad or m."""
        if self.robot.nq == self.robot.nv:
            return np.asarray(self.q - before)
        return self.robot.difference(before, self.q)

    def _is_requested(self, ball: Pose) -> bool:
        """Return whether the ball has moved since the last solve, or that solve did not meet it."""
        last = self._last_ball
        self._last_ball = ball
        if last is None or not self.is_met:
            return True
        same_position = np.array_equal(last.position, ball.position)
        return not (same_position and np.array_equal(last.wxyz, ball.wxyz))

    @property
    def is_met(self) -> bool:
        """Whether error and angle are within the tolerances of this instance."""
        return self.error <= self.distance and self.angle <= _TOLERANCE.angle

    def stand(self, q: Array, action: str, goals: RobotGoals, ball: Pose) -> None:
        """Put the robot to ``q`` (nq,) without solving, and measure its error.

        Args:
            q: Joint angles, rad or m.
            action: Status that is shown.
            goals: The goals.
            ball: Pose of the ball, world.
        """
        self._drag = None
        self._status = action
        self._iterations = 0
        self._unmet_ticks = 0
        self.move_to(q)
        self._measure(goals, ball)

    def drag(self, drag: DragLink, goals: RobotGoals, ball: Pose) -> None:
        """Bring a grabbed point to the mouse. Frames that the goals keep do not move."""
        held = drag.body, drag.grip
        try:
            if self._drag is None or self._held != held:
                self._drag = Drag(
                    self.robot,
                    pinned=goals.kept,
                    start=self.q,
                    rate=RATE,
                    speed=_DRAG_SPEED,
                    balance=goals.balanced,
                )
                self._drag.grab(*held)
                self._held = held
            self.move_to(self._drag.step(drag.to))
            self._status = "dragged"
            self._iterations = 0
        except RobotIkError as error:
            self._drag = None
            self._status = problem_text(error)
        self._measure(goals, ball)

    def _solved(self, problem: Problem, wanted: list[Goal]) -> Solution | None:
        try:
            retarget(problem, wanted)
            begin = time.thread_time()
            start = self.q if self._limb is None else self._limb.limb_q(self.q)
            solution = problem.solve(start)
            self._seconds = time.thread_time() - begin
        except RobotIkError as error:
            self._status = problem_text(error)
            return None
        self._status = solution.status.name.lower().replace("_", " ")
        self._iterations = solution.iterations
        if np.isfinite(solution.q).all():
            self.move_to(solution.q if self._limb is None else self._limb.figure_q(solution.q))
        return solution

    def _measure(self, goals: RobotGoals, ball: Pose) -> None:
        """Measure the error and extend trail and histories."""
        rotation, position = self._tool()
        self.error, self.angle = tool_error(goals, rotation, position, ball)
        self._trail = appended(self._trail, position, TRAIL)
        row = (self.error, self.angle, self.manipulability)
        self._errors = appended(self._errors, row, round(HISTORY_SECONDS * RATE))

    def measure_manipulability(self) -> None:
        """Measure the product of the singular values of the tool's Jacobian.

        It takes 60 µs, so it is not called in each tick.
        """
        values = np.linalg.svd(self.robot.jacobian(self.q), compute_uv=False)
        self.manipulability = float(np.prod(values[: min(6, self.robot.nv)]))

    def measure_statistics(self, goals: RobotGoals, ball: Pose) -> None:
        """Evaluate the window of solves and each goal. It takes 50 µs a goal: once a second."""
        self._statistics = Statistics.of(self._solves)
        named = goals.named(ball)
        self._goals = tuple((name, *goal.error(self.robot, self.q)) for name, goal in named)

    def view(self) -> InstanceView:
        """Return what a front end shows."""
        items = () if self.solver is None else dataclasses.fields(self.solver)
        is_stuck = self._unmet_ticks >= STUCK_TICKS and self._status in _STUCK_STATUSES
        return InstanceView(
            method="" if self.solver is None else self.solver.name,
            options=tuple((item.name, getattr(self.solver, item.name)) for item in items),
            budget=self.budget,
            distance=self.distance,
            q=self.q.copy(),
            xpos=self.data.xpos.copy(),
            xquat=self.data.xquat.copy(),
            status=self._status,
            able=not self.refused,
            note=self.note,
            limited=self.limited,
            error=self.error,
            angle=self.angle,
            met=self.is_met,
            stuck=is_stuck,
            iterations=self._iterations,
            statistics=self._statistics,
            goals=self._goals,
            trail=self._trail,
            errors=self._errors,
        )


def tool_error(
    goals: RobotGoals, rotation: Array, position: Array, ball: Pose
) -> tuple[float, float]:
    """Return metres and radians between the tool and what the ball asks.

    The result is that of ``Goal.error``, which takes 50 µs. This takes 5 µs and is called 240 times
    a second.
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
        case "orientation":
            return 0.0, _angle(rotation, ball.rotation)
    normal = ball.rotation[:, 2]
    along = float(offset @ normal)
    if goals.kind == "plane":
        return abs(along), 0.0
    if goals.kind == "half_space":
        return max(along, 0.0), 0.0
    across = offset - along * normal
    return math.sqrt(across @ across), 0.0


def _angle(a: Array, b: Array) -> float:
    """Return the angle of the rotation between two frames, radians."""
    # The sine from the antisymmetric part: exact for small angles, unlike the cosine.
    m = a.T @ b
    x = m[2, 1] - m[1, 2]
    y = m[0, 2] - m[2, 0]
    z = m[1, 0] - m[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1.0)
    return math.atan2(sine, cosine)
