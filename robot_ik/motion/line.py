"""`line_move`: the tool runs straight, the joints follow without a jump.

Three passes.  Trace: walk along the line in small steps, each solved from the last, halving the step
where the joints move much, until it is plain whether that is a fast stretch or a jump.  Time: run
along the traced path as fast as the joints and the tool may.  Sample: solve once more at every tick,
then measure what was made; where a bound is broken by the sampling, slow down and sample again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError, TrajectoryError, distinct_texts
from robot_ik.geometry import Pose, quat_multiply, rotation_exp, rotation_log
from robot_ik.goals import PoseGoal, Tolerance
from robot_ik.motion.timing import Timing, fastest_timing
from robot_ik.motion.trajectory import Trajectory, joint_vector, motion_limits, require_positive
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solvers.base import Solver

# Longest step of the trace: short against any arm, so that the nearest solution is the same branch.
_STEP_LENGTH = 0.005  # m
_STEP_ANGLE = 0.03  # rad
_FEWEST = 8  # steps: the timing needs derivatives on the shortest line too
# Largest change of one joint, rad or m, from point to point.  The trace halves a step at most this often;
# what still moves a joint farther in 1/1024 of it is a jump.
_MAX_JUMP, _HALVINGS = 0.1, 10
# A joint this near to a limit is named as the reason when no further point is found: rad or m.
_AT_LIMIT = 0.02
# Each round of slowing aims this much below the bound, so that few rounds are needed.
_MARGIN = 1.002
_ROUNDS = 12
_SLOWEST = 64.0  # times the ideal duration: more is not a matter of sampling
# m and rad, of each sample: at 100 Hz an error of 1e-7 rad is seen as 4e-3 rad/s^2, one of 1e-5 rad as
# 0.4 rad/s^2, which no timing can remove.  Hence no choice of it.
_TOLERANCE = 1e-7


@dataclass(frozen=True)
class _Line:
    """Poses from ``begin`` (s = 0) to the goal (s = 1): straight in position, one axis in rotation."""

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

    def off(self, position: Array) -> float:
        """Distance in m of ``position`` (3,) from the line's segment."""
        rest = position - self.begin.position
        along = 0.0 if self.length == 0.0 else float(np.clip(rest @ self.shift / self.length**2, 0.0, 1.0))
        return float(np.linalg.norm(rest - along * self.shift))


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
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
) -> Trajectory:
    """Moves ``frame`` on a straight line to ``goal_pose``, rotating evenly about one axis (slerp).

    As fast as the joint limits and the two tool speeds allow at each point; slow where the arm
    is near a singularity.  Between samples, too, the tool stays within ``deviation`` of the line.

    Args:
        robot: Its limits count.
        start: (nq,) rad, m for slides; the line begins where the frame then is.
        goal_pose: In the world.
        frame: The frame that runs straight; None means the robot's default tool.
        solver: A name of `SOLVERS` or a solver; it must converge to 1e-7 m and rad ("lm" does).
        speed: Part of the robot's velocity and acceleration limits to use, above 0 and up to 1.
        linear_speed: Most of the tool, m/s.
        angular_speed: Most of the tool, rad/s.
        rate: Samples a second, Hz; the duration is rounded up to whole periods.
        deviation: Largest distance of the tool from the line, m.
        velocity: (nq,) further cap in rad/s, such as that of the arm file; the lower one counts.
        acceleration: (nq,) likewise, rad/s^2.

    Raises:
        TrajectoryError: A point on the line cannot be reached, or only by a jump of a joint; states
            how far the line is possible and which joint is in the way.
        UnsupportedJointError: The robot has ball or free joints.
        InvalidGoalError: ``goal_pose`` is no ``Pose``.
    """
    given: object = goal_pose
    if not isinstance(given, Pose):
        hint = "Pose(position, wxyz), or Pose(position, robot.forward(start).wxyz) to keep the orientation"
        raise InvalidGoalError(f"goal_pose is to be a Pose, not {given!r}", hint=hint)
    first = joint_vector(robot, start, "start")
    top, push = motion_limits(robot, speed, velocity, acceleration)
    for what, value, unit in (
        ("rate", rate, "Hz"),
        ("linear_speed", linear_speed, "m/s"),
        ("angular_speed", angular_speed, "rad/s"),
        ("deviation", deviation, "m"),
    ):
        require_positive(what, value, unit)
    name = robot.tool if frame is None else frame
    line = _Line.between(robot.forward(first, name), goal_pose)
    if line.length <= _TOLERANCE and line.angle <= _TOLERANCE:
        return Trajectory([0.0], [first], robot.joints)
    tolerance = Tolerance(_TOLERANCE, _TOLERANCE)
    problem = Problem(robot, PoseGoal.at(name, Pose()), solver=solver, tolerance=tolerance)
    tracer = _Tracer(robot, name, line, problem)
    knots, path = tracer.trace(first)
    with np.errstate(divide="ignore"):
        fastest = float(min(np.divide(linear_speed, line.length), np.divide(angular_speed, line.angle)))
    timing = fastest_timing(knots, path, top, push, fastest)
    return _sampled(tracer, timing, path, top, push, rate, deviation)


@dataclass(frozen=True)
class _Tracer:
    """Solves points on one line, each from its neighbour."""

    robot: Robot  # its joint names and limits appear in errors
    frame: str
    line: _Line
    problem: Problem  # one pose of the frame

    def solve(self, s: float, start: Array) -> Array | None:
        """Joint vector (nq,) of the point ``s`` nearest to ``start``, None where there is none."""
        solution = self.problem.solve(start, target=self.line.pose(s))
        return solution.q if solution.converged else None

    def trace(self, first: Array) -> tuple[Array, Array]:
        """Knots (n,) from 0 to 1 and joint vectors (n, nq), the first one ``first``."""
        line = self.line
        steps = max(_FEWEST, int(np.ceil(max(line.length / _STEP_LENGTH, line.angle / _STEP_ANGLE))))
        longest = 1.0 / steps
        knots, path, step = [0.0], [first], longest
        while knots[-1] < 1.0:
            s = min(1.0, knots[-1] + step)
            s = 1.0 if 1.0 - s < 1e-3 * longest else s  # no crumb of a step at the end
            q = self.solve(s, path[-1])
            if q is not None and np.abs(q - path[-1]).max() <= _MAX_JUMP:
                knots.append(s)
                path.append(q)
                step = min(longest, 2.0 * step)
            elif step > longest / 2**_HALVINGS:
                step *= 0.5
            else:
                raise self.broken(knots[-1], path[-1], q)
        return np.array(knots), np.stack(path)

    def broken(self, s: float, q: Array, beyond: Array | None) -> TrajectoryError:
        """The error for a path that is good up to ``s`` and ``q`` (nq,), and then leads to ``beyond``."""
        line = self.line
        reached = f"{100.0 * s:.1f} % of the line ({1e3 * s * line.length:.1f} of {1e3 * line.length:.1f} mm"
        reached += f", {np.degrees(s * line.angle):.1f} of {np.degrees(line.angle):.1f} deg)"
        if beyond is None:
            margin = np.minimum(q - self.robot.lower, self.robot.upper - q)
            k = int(np.argmin(margin))
            why = "no joint is at a limit, so the arm is too short or the point is singular"
            if margin[k] < _AT_LIMIT:
                why = f"joint {self.robot.joints[k]!r} is at its limit there"
            return TrajectoryError(
                f"{self.frame!r} can follow only {reached}: beyond, the solver found no joint angles; {why}",
                hint="shorten the line, start from another configuration, or use joint_move",
            )
        k = int(np.argmax(np.abs(beyond - q)))
        jump, most = distinct_texts(abs(beyond[k] - q[k]), _MAX_JUMP, digits=3)
        return TrajectoryError(
            f"{self.frame!r} can follow only {reached}: there joint {self.robot.joints[k]!r} would jump by "
            f"{jump}; at most {most} is allowed (rad, m for slides)",
            hint="a limit or a singularity is in the way: start from another configuration or use joint_move",
        )


def _sampled(
    tracer: _Tracer, timing: Timing, path: Array, top: Array, push: Array, rate: float, deviation: float
) -> Trajectory:
    """The trajectory at ``rate`` Hz; slowed as a whole until every bound holds as measured."""
    duration = timing.duration
    for _ in range(_ROUNDS):
        count = max(1, int(np.ceil(duration * rate * (1.0 - 1e-12))))
        s = timing.progress(np.linspace(0.0, timing.duration, count + 1, dtype=np.float64))
        q = _solved(tracer, timing.s, path, s)
        trajectory = Trajectory(np.arange(count + 1) / rate, q, tracer.robot.joints)
        # Joints run straight from sample to sample: half-way the tool is farthest from the line.
        tool = [tracer.robot.forward(middle, tracer.frame) for middle in 0.5 * (q[1:] + q[:-1])]
        off = [tracer.line.off(pose.position) for pose in tool]
        excess = max(
            float(np.max(trajectory.peak_velocity / top)),
            float(np.sqrt(np.max(trajectory.peak_acceleration / push))),
            float(np.sqrt(max(off) / deviation)),
        )
        if excess <= 1.0:
            return trajectory
        if duration > _SLOWEST * timing.duration + 1.0:
            break
        duration = max(count + 1, np.ceil(count * min(excess * _MARGIN, 4.0))) / rate
    raise TrajectoryError(
        f"no timing of this line was found that keeps the limits ({excess:.2f} times exceeded)",
        hint="lower speed or linear_speed, or allow a larger deviation",
    )


def _solved(tracer: _Tracer, knots: Array, path: Array, s: Array) -> Array:
    """(n, nq) joint vectors at the points ``s`` (n,), each on the traced branch."""
    near = np.column_stack([np.interp(s, knots, path[:, j]) for j in range(path.shape[1])])
    q = near.copy()
    for k in range(1, len(s) - 1):
        found = tracer.solve(float(s[k]), near[k])
        if found is None or np.abs(found - near[k]).max() > _MAX_JUMP:
            raise tracer.broken(float(s[k]), near[k], found)
        q[k] = found
    q[0], q[-1] = path[0], path[-1]
    return q
