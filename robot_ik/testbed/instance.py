"""One robot of the testbed, solved on its own: its method, its angles, its statistics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_ik.errors import RobotIkError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PositionGoal, Tolerance
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers.base import Solver
from robot_ik.testbed.commands import DragLink
from robot_ik.testbed.setup import BUDGET, Goals, gaze_axis, retarget
from robot_ik.testbed.statistics import History, Statistics, Window

TRAIL = 120
"""Places of the tool that a trail has."""
HISTORY_SECONDS = 5.0
_TOLERANCE = Tolerance()
_DRAG_PROBLEMS = 8  # problems of grabbed parts that are kept

# Joints that leave the place of their own anchor as it is.
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))


@dataclass(frozen=True, eq=False)
class InstanceView:
    """What is seen of an instance; arrays are copies.

    Attributes:
        method, options: Name of its method; (name, value) of each of its options.
        q: (nq,) joint angles, rad or m.
        xpos, xquat: (nbody, 3) and (nbody, 4) poses of MuJoCo's bodies, world, wxyz.
        status: How the last solve ended, in words; why it cannot be solved, where it cannot.
        able: Whether its method can serve what is asked.
        note: What it does otherwise than the others, in words.
        miss, angle: Metres and radians of the tool off what the ball asks, by MuJoCo's kinematics.
        iterations: Steps of the last solve.
        manipulability: Product of the singular values of the tool's Jacobian.
        statistics: Of the last second.
        trail: (n, 3) where the tool was, oldest first.
        errors: (n, 2) history: miss in metres, manipulability.
    """

    method: str
    options: tuple[tuple[str, Any], ...]
    q: Array
    xpos: Array
    xquat: Array
    status: str
    able: bool
    note: str
    miss: float
    angle: float
    iterations: int
    manipulability: float
    statistics: Statistics
    trail: Array
    errors: Array


class Instance:
    """One robot with its method.

    Args:
        robot: Within the limits that hold.
        solver: Its method; None: it stands still until there is one.
        rate: Ticks a second, Hz.
    """

    def __init__(self, robot: Robot, solver: Solver | None, rate: float) -> None:
        self.robot, self.solver = robot, solver
        self.data = mujoco.MjData(robot.model)
        frame = robot.frame(robot.tool)
        self._body, self._local = frame.body, frame.local
        self._window, self._statistics = Window(), Statistics()
        self._trail, self._errors = History(TRAIL, 3), History(round(HISTORY_SECONDS * rate), 2)
        self.q = robot.home.copy()
        self.refused = self.note = ""
        self.reset()

    def reset(self) -> None:
        """Home, with empty statistics."""
        self.move_to(self.robot.home)
        self._problem: Problem | None = None
        self._kind: tuple[Any, ...] = ()
        self._dragged: dict[str, Problem] = {}
        self._status, self._iterations = "", 0
        self.miss = self.angle = self.manipulability = 0.0
        self._window.clear()
        self._trail.clear()
        self._errors.clear()
        self._statistics = Statistics()

    def take(self, robot: Robot, solver: Solver, refused: str, note: str) -> None:
        """Goes on with another method, options or limits; a method that changed begins new statistics."""
        if self.solver != solver or self.robot is not robot:
            self._window.clear()
            self._statistics = Statistics()
        self.robot, self.solver, self.refused, self.note = robot, solver, refused, note
        self._problem, self._dragged = None, {}
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
        turned = self.data.xmat[self._body].reshape(3, 3)
        return turned @ self._local.rotation, self.data.xpos[self._body] + turned @ self._local.position

    def solve(self, goals: Goals, ball: Pose) -> None:
        """Goes to what the ball asks for."""
        if self.solver is None:
            return
        if self.refused:
            self._status = self.refused
        else:
            wanted = goals.all(ball, self.solver)
            if self._problem is None:
                self._problem = Problem(self.robot, wanted, budget=BUDGET)
            solution = self._solved(self.solver, self._problem, wanted)
            self._measure(goals, ball)
            if solution is not None:
                self._window.add(solution.seconds, solution.iterations, self._met())
            return
        self._measure(goals, ball)

    def drag(self, drag: DragLink, grip: Array, fallback: Solver, goals: Goals, ball: Pose) -> None:
        """Brings a grabbed point to where the mouse is.

        Args:
            drag: What is dragged.
            grip: (3,) the grabbed point in the frame of that body, metres.
            fallback: Where the instance's own method serves no position of such a part.
            goals: What the miss is measured by meanwhile.
            ball: Likewise.
        """
        body = self.robot.model.body(drag.body).id
        frame, origin = frame_on(self.robot, body, grip)
        # That origin so that the grabbed point comes to `to` with the body turned as it is now.
        place = np.array(drag.to) - self.data.xmat[body].reshape(3, 3) @ (grip - origin)
        if (ball_of_reach := self.robot.reach(frame)) is not None:
            # Where the part cannot follow, as near as it comes: methods stop where they have a proof.
            centre, radius = ball_of_reach
            way = place - centre
            place = centre + way * min(1.0, 0.999 * radius / max(float(np.linalg.norm(way)), 1e-12))
        solver = self.solver
        wanted = PositionGoal(frame, place)
        if solver is None or not solver.supports(wanted) or self.refused:
            solver = fallback
        problem = self._dragged.get(frame)
        if problem is None:
            if len(self._dragged) >= _DRAG_PROBLEMS:
                self._dragged.clear()
            problem = self._dragged[frame] = Problem(self.robot, wanted, budget=BUDGET)
        if self._solved(solver, problem, [wanted]) is None and solver is not fallback:
            self._solved(fallback, problem, [wanted])
        self._measure(goals, ball)

    def _solved(self, solver: Solver, problem: Problem, wanted: Sequence[Goal]) -> Solution | None:
        try:
            retarget(problem, list(wanted))
            solution = solver.solve(problem, self.q)
        except RobotIkError as error:
            self._status = str(error).splitlines()[0]
            return None
        self._status, self._iterations = solution.status.name.lower().replace("_", " "), solution.iterations
        if np.isfinite(solution.q).all():
            self.move_to(solution.q)
        return solution

    def _measure(self, goals: Goals, ball: Pose) -> None:
        """Miss, trail and histories."""
        rotation, position = self._tool()
        self.miss, self.angle = off(goals, rotation, position, ball)
        self._trail.add(position)
        self._errors.add(np.array((self.miss, self.manipulability)))

    def _met(self) -> bool:
        return self.miss <= _TOLERANCE.position and self.angle <= _TOLERANCE.angle

    def measure_manipulability(self) -> None:
        """Product of the singular values of the tool's Jacobian; costs 60 µs, so not in each tick."""
        values = np.linalg.svd(self.robot.jacobian(self.q), compute_uv=False)
        self.manipulability = float(np.prod(values[: min(6, self.robot.nv)]))

    def measure_statistics(self) -> None:
        """Of the window as it is now."""
        self._statistics = self._window.statistics()

    def view(self) -> InstanceView:
        """What is seen of it."""
        items = () if self.solver is None else dataclasses.fields(self.solver)
        options = tuple((item.name, getattr(self.solver, item.name)) for item in items)
        return InstanceView(
            "" if self.solver is None else self.solver.name,
            options,
            self.q.copy(),
            self.data.xpos.copy(),
            self.data.xquat.copy(),
            self._status,
            not self.refused,
            self.note,
            self.miss,
            self.angle,
            self._iterations,
            self.manipulability,
            self._statistics,
            self._trail.rows(),
            self._errors.rows(),
        )


def frame_on(robot: Robot, body: int, grip: Array) -> tuple[str, Array]:
    """The frame with its origin fixed to a body, nearest to a point of it; where that origin is in the body.

    The origin of a link often lies on the axis that moves it, where it cannot be dragged anywhere.  Where its
    joints turn about its origin, a child's origin is as fixed to the body, and usually at its other end.

    Raises:
        UnknownFrameError: The body has no name and no frame on it.
    """
    frames: dict[int, tuple[str, Pose]] = robot.memory.setdefault("frame_of_body", {})
    if not frames:
        for name in robot.frames:
            frame = robot.frame(name)
            frames.setdefault(frame.body, (name, frame.local))
    if body not in frames:
        robot.frame(robot.model.body(body).name or f"body {body}")
    model, found = robot.model, [(frames[body][0], frames[body][1].position)]
    for child in map(int, np.flatnonzero(model.body_parentid == body)):
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] == child]
        turns = all(int(model.jnt_type[j]) in _TURNING and not model.jnt_pos[j].any() for j in joints)
        if turns and child in frames and not frames[child][1].position.any():
            found.append((frames[child][0], model.body_pos[child]))
    return min(found, key=lambda one: float(np.linalg.norm(one[1] - grip)))


def off(goals: Goals, rotation: Array, position: Array, ball: Pose) -> tuple[float, float]:
    """Metres and radians that the tool is off what the ball asks.

    As ``Goal.off``, which costs 50 µs; this 5: it is asked 240 times a second.
    """
    way = ball.position - position
    match goals.kind:
        case "position":
            return math.sqrt(way @ way), 0.0
        case "pose":
            return math.sqrt(way @ way), _angle(rotation, ball.rotation)
        case "aim":
            axis = rotation[:, 0 if gaze_axis(goals.robot.tool) == "x" else 2]
            sine = np.cross(axis, way)
            return 0.0, math.atan2(math.sqrt(sine @ sine), float(axis @ way))
    normal = ball.rotation[:, 2]
    along = float(way @ normal)
    if goals.kind == "plane":
        return abs(along), 0.0
    across = way - along * normal
    return math.sqrt(across @ across), 0.0


def _angle(a: Array, b: Array) -> float:
    """Of the rotation between two frames, radians."""
    # The sine from the antisymmetric part: exact for small angles, where the cosine is blind.
    m = a.T @ b
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    return math.atan2(0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1.0))
