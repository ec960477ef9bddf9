"""``line_move``: the tool moves on a straight line, and the joints follow without a jump.

It has three passes. The trace solves points along the line in small steps, each from the last. If a
joint moves much, the step is halved until a fast part and a jump can be distinguished. The timing
runs along the path as fast as the joints and the tool may. The sampling solves again at every tick
and measures the result. If a sample exceeds a bound, the timing is slowed and sampled again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError, TrajectoryError, distinct_texts
from robot_ik.geometry import Array, Pose, quat_multiply, rotation_exp, rotation_log
from robot_ik.goals import PoseGoal, Tolerance
from robot_ik.motion.timing import MAX_SLOWDOWNS, SLOWDOWN_MARGIN, Timing, fastest_timing
from robot_ik.motion.trajectory import (
    Trajectory,
    certified_trajectory,
    joint_vector,
    motion_limits,
    require_positive,
)
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers.base import Solver

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

LONGEST_STEP = 0.005
"""Metres. Longest step of the trace. The nearest solution of a short step is the same branch."""

LARGEST_STEP_ANGLE = 0.03
"""rad. Largest rotation in a step of the trace."""

FEWEST_STEPS = 8
"""Steps of the shortest line. The timing needs derivatives of short lines, too."""

SHORTEST_LAST_STEP = 1e-3
"""If the rest of the line is below this share of a step, it is added to the step."""

LARGEST_JUMP = 0.1
"""rad or m. Largest change of a joint from one point of the path to the next."""

MAX_HALVINGS = 10
"""A joint that moves more than ``LARGEST_JUMP`` in 2**-10 of a step jumps."""

AT_LIMIT = 0.02
"""rad or m. A joint this near to a limit is named as the cause if no further point is found."""

LARGEST_STRETCH = 4.0
"""Largest factor of the duration in one round."""

SLOWEST = 64.0
"""Largest factor of the duration. A larger factor has another cause than the sampling."""

COUNT_ROUNDING = 1e-12
"""Rounding error of a number of samples."""

POINT_TOLERANCE = 1e-7
"""m and rad of each sample. At 100 Hz an error of 1e-5 rad is an acceleration of 0.4 rad/s², which
no timing can remove. 1e-7 rad are 4e-3 rad/s². Therefore it is not an option."""


@dataclass(frozen=True)
class _Line:
    """Poses from ``begin`` (s = 0) to the goal (s = 1), with a rotation about one axis (slerp)."""

    begin: Pose
    shift: Array
    rotation_vector: Array

    @classmethod
    def between(cls, begin: Pose, end: Pose) -> _Line:
        rotation_vector = rotation_log(quat_multiply(begin.inverse().wxyz, end.wxyz))
        return cls(begin, end.position - begin.position, rotation_vector)

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.shift))

    @property
    def angle(self) -> float:
        return float(np.linalg.norm(self.rotation_vector))

    def pose(self, s: float) -> Pose:
        wxyz = quat_multiply(self.begin.wxyz, rotation_exp(s * self.rotation_vector))
        return Pose(self.begin.position + s * self.shift, wxyz)

    def distance(self, position: Array) -> float:
        """Return the distance of a position (3,) from the segment, m."""
        offset = position - self.begin.position
        along = 0.0
        if self.length > 0.0:
            along = float(np.clip(offset @ self.shift / self.length**2, 0.0, 1.0))
        return float(np.linalg.norm(offset - along * self.shift))


def line_move(
    robot: Robot,
    start: ArrayLike,
    goal_pose: Pose,
    *,
    frame: str | None = None,
    solver: str | Solver = "auto",
    speed: float = 1.0,
    linear_speed: float = 0.25,
    angular_speed: float = 1.5,
    rate: float = 100.0,
    deviation: float = 1e-4,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    collisions: CollisionAvoidance | None = None,
) -> Trajectory:
    """Return a motion of ``frame`` on a straight line to ``goal_pose``, with an even rotation.

    It is as fast as the joint limits and the two tool speeds allow at each point, and slow near
    singularities. The tool stays within ``deviation`` of the line between the samples, too.

    Args:
        robot: The robot, whose limits count.
        start: Joint angles (nq,), rad or m for slides. The line starts at the pose of the frame.
        goal_pose: End of the line in the world.
        frame: The frame that moves on the line. None for the default tool of the robot.
        solver: A name in ``SOLVERS`` or a solver. It must converge to 1e-7 m and rad ("lm" does).
        speed: Share of the velocity and acceleration limits to use, above 0 and up to 1.
        linear_speed: Largest speed of the tool, m/s.
        angular_speed: Largest angular speed of the tool, rad/s.
        rate: Samples a second, Hz. The duration is rounded up to whole periods.
        deviation: Largest distance of the tool from the line, m.
        velocity_limits: Further limits (nq,), such as those of an arm file, rad/s or m/s. The lower
            limit counts.
        acceleration_limits: Further limits (nq,), rad/s² or m/s².
        collisions: Condition that the whole motion must keep. ``trajectory.certified`` is
            True if that is proven.

    Raises:
        MotionBlockedError: Parts would touch. The error has the time, the pair and the depth.
        TrajectoryError: A point on the line cannot be reached, or only by a jump of a joint. The
            message has the part of the line that is possible and the joint that is the cause.
        UnsupportedJointError: The robot has ball or free joints.
        InvalidGoalError: ``goal_pose`` is not a ``Pose``.
    """
    given: object = goal_pose
    if not isinstance(given, Pose):
        hint = (
            "Pose(position, wxyz), or Pose(position, robot.forward(start).wxyz) "
            "to keep the orientation"
        )
        raise InvalidGoalError(f"goal_pose must be a Pose, not {given!r}", hint=hint)
    first = joint_vector(robot, start, "start")
    limits = motion_limits(robot, speed, velocity_limits, acceleration_limits)
    for what, value, unit in (
        ("rate", rate, "Hz"),
        ("linear_speed", linear_speed, "m/s"),
        ("angular_speed", angular_speed, "rad/s"),
        ("deviation", deviation, "m"),
    ):
        require_positive(what, value, unit)
    name = robot.tool if frame is None else frame
    line = _Line.between(robot.forward(first, name), goal_pose)
    if line.length <= POINT_TOLERANCE and line.angle <= POINT_TOLERANCE:
        return certified_trajectory(Trajectory([0.0], [first], robot.joints), robot, collisions)
    tolerance = Tolerance(POINT_TOLERANCE, POINT_TOLERANCE)
    problem = Problem(robot, PoseGoal.at(name, Pose()), solver=solver, tolerance=tolerance)
    tracer = _Tracer(robot, name, line, problem)
    knots, path = tracer.trace(first)
    with np.errstate(divide="ignore"):
        by_length = np.divide(linear_speed, line.length)
        by_angle = np.divide(angular_speed, line.angle)
    timing = fastest_timing(knots, path, *limits, float(min(by_length, by_angle)))
    trajectory = _sampled(tracer, timing, path, limits, rate, deviation)
    return certified_trajectory(trajectory, robot, collisions)


@dataclass(frozen=True)
class _Tracer:
    """Solves points on one line, each from the point before it.

    Attributes:
        robot: The robot, whose joint names and limits appear in errors.
        frame: The frame that moves on the line.
        line: The line.
        problem: A problem with one pose of the frame.
    """

    robot: Robot
    frame: str
    line: _Line
    problem: Problem

    def solve(self, s: float, start: Array) -> Array | None:
        """Return the joint vector (nq,) of the point ``s`` near ``start``, None without one."""
        solution = self.problem.solve(start, target=self.line.pose(s))
        return solution.q if solution.converged else None

    def trace(self, first: Array) -> tuple[Array, Array]:
        """Return knots (n,) from 0 to 1 and joint vectors (n, nq) that start with ``first``."""
        steps = max(self.line.length / LONGEST_STEP, self.line.angle / LARGEST_STEP_ANGLE)
        longest = 1.0 / max(FEWEST_STEPS, int(np.ceil(steps)))
        knots = [0.0]
        path = [first]
        step = longest
        while knots[-1] < 1.0:
            s = min(1.0, knots[-1] + step)
            if 1.0 - s < SHORTEST_LAST_STEP * longest:
                s = 1.0
            q = self.solve(s, path[-1])
            if q is not None and np.abs(q - path[-1]).max() <= LARGEST_JUMP:
                knots.append(s)
                path.append(q)
                step = min(longest, 2.0 * step)
            elif step > longest / 2**MAX_HALVINGS:
                step *= 0.5
            else:
                raise self.broken(knots[-1], path[-1], q)
        return np.array(knots), np.stack(path)

    def broken(self, s: float, q: Array, beyond: Array | None) -> TrajectoryError:
        """Return the error for a path that ends at ``s`` and ``q`` (nq,).

        Args:
            s: Last point of the path.
            q: Joint angles (nq,) there.
            beyond: Joint angles (nq,) of the next point, after a jump. None if it has no solution.
        """
        line = self.line
        reached = (
            f"{100.0 * s:.1f} % of the line "
            f"({1e3 * s * line.length:.1f} of {1e3 * line.length:.1f} mm, "
            f"{np.degrees(s * line.angle):.1f} of {np.degrees(line.angle):.1f} deg)"
        )
        if beyond is None:
            margin = np.minimum(q - self.robot.lower, self.robot.upper - q)
            k = int(np.argmin(margin))
            cause = "no joint is at a limit, so the arm is too short or the point is singular"
            if margin[k] < AT_LIMIT:
                cause = f"joint {self.robot.joints[k]!r} is at its limit there"
            return TrajectoryError(
                f"{self.frame!r} can follow only {reached}: "
                f"beyond, the solver found no joint angles; {cause}",
                hint="shorten the line, start from another configuration, or use joint_move",
            )
        k = int(np.argmax(np.abs(beyond - q)))
        jump, largest = distinct_texts(abs(beyond[k] - q[k]), LARGEST_JUMP, digits=3)
        return TrajectoryError(
            f"{self.frame!r} can follow only {reached}: there joint {self.robot.joints[k]!r} would "
            f"jump by {jump}; at most {largest} is allowed (rad, m for slides)",
            hint="a limit or a singularity is in the way: "
            "start from another configuration or use joint_move",
        )


def _sampled(
    tracer: _Tracer,
    timing: Timing,
    path: Array,
    limits: tuple[Array, Array],
    rate: float,
    deviation: float,
) -> Trajectory:
    """Return the trajectory at ``rate`` Hz, slowed down until every measured bound holds."""
    velocity_limits, acceleration_limits = limits
    duration = timing.duration
    for _ in range(MAX_SLOWDOWNS):
        count = max(1, int(np.ceil(duration * rate * (1.0 - COUNT_ROUNDING))))
        s = timing.progress(np.linspace(0.0, timing.duration, count + 1, dtype=np.float64))
        q = _solved(tracer, timing.s, path, s)
        trajectory = Trajectory(np.arange(count + 1) / rate, q, tracer.robot.joints)
        # The joints move straight between samples, so the tool is farthest from the line halfway.
        middles = [tracer.robot.forward(middle, tracer.frame) for middle in 0.5 * (q[1:] + q[:-1])]
        distance = max(tracer.line.distance(pose.position) for pose in middles)
        excess = max(
            float(np.max(trajectory.peak_velocity / velocity_limits)),
            float(np.sqrt(np.max(trajectory.peak_acceleration / acceleration_limits))),
            float(np.sqrt(distance / deviation)),
        )
        if excess <= 1.0:
            return trajectory
        if duration > SLOWEST * timing.duration + 1.0:
            break
        stretch = min(excess * SLOWDOWN_MARGIN, LARGEST_STRETCH)
        duration = max(count + 1, np.ceil(count * stretch)) / rate
    raise TrajectoryError(
        f"no timing of this line keeps the limits (exceeded {excess:.2f} times)",
        hint="lower speed or linear_speed, or allow a larger deviation",
    )


def _solved(tracer: _Tracer, knots: Array, path: Array, s: Array) -> Array:
    """Return joint vectors (n, nq) at the points ``s`` (n,), each on the traced branch."""
    columns = [np.interp(s, knots, path[:, j]) for j in range(path.shape[1])]
    starts = np.column_stack(columns)
    q = starts.copy()
    for k in range(1, len(s) - 1):
        solved = tracer.solve(float(s[k]), starts[k])
        if solved is None or np.abs(solved - starts[k]).max() > LARGEST_JUMP:
            raise tracer.broken(float(s[k]), starts[k], solved)
        q[k] = solved
    q[0] = path[0]
    q[-1] = path[-1]
    return q
