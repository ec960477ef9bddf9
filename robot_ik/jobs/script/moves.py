"""The steps that move the arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from robot_ik.errors import apart
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.jobs.reach_report import SOLVE_TOLERANCE
from robot_ik.jobs.script.gripping import gripper_angles, gripper_joints
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import (
    ExpectStep,
    GripStep,
    JointsStep,
    KeyframeStep,
    LineStep,
    MarkerStep,
    PoseStep,
    PositionStep,
)
from robot_ik.motion.line import line_move
from robot_ik.motion.trajectory import joint_move
from robot_ik.problem import Problem, Tolerance
from robot_ik.solvers import make_solver

if TYPE_CHECKING:
    from robot_ik.ports import Array
    from robot_ik.robot import Robot

Move = PoseStep | PositionStep | LineStep | JointsStep | KeyframeStep | MarkerStep | GripStep


# -------------------------------------------------------------------------------------- where to


def keyframes(robot: Robot) -> dict[str, Array]:
    """Name -> (nq,) of the model's keyframes, and ``home``."""
    model = robot.model
    places = model.jnt_qposadr[list(robot.tree.joint_ids)]  # a servo's joint is a hinge: one number
    found = {model.key(k).name: np.array(model.key_qpos[k][places]) for k in range(model.nkey)}
    return {**found, "home": robot.home}


def slides(robot: Robot, joint: str) -> bool:
    """Whether a joint slides: then it counts in millimetres, else in degrees."""
    return int(robot.model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)


def per_unit(robot: Robot, joint: str) -> float:
    """One degree in rad; one millimetre in m of a slide."""
    return 1e-3 if slides(robot, joint) else float(np.radians(1.0))


def with_joints(robot: Robot, q: Array, step: JointsStep | ExpectStep) -> Array:
    """``q`` (nq,) with the joints that a step names at its degrees and millimetres."""
    wanted = q.copy()
    for name, number in {**(step.joints_deg or {}), **(step.joints_mm or {})}.items():
        wanted[robot.joints.index(name)] = number * per_unit(robot, name)
    return wanted


# --------------------------------------------------------------------------------------- how far


def off_text(millimetres: float, degrees: float | None, step: Move) -> str:
    """How far off the frame is, and how far it may be, for people."""
    pairs = [apart(millimetres, step.tolerance_mm, digits=2)]
    pairs += [] if degrees is None else [apart(degrees, step.tolerance_deg, digits=2)]
    off, allowed = (
        ", ".join(f"{text}{unit}" for text, unit in zip(texts, (" mm", "°"), strict=False))
        for texts in zip(*pairs, strict=True)
    )
    return f"{off} off; allowed {allowed}"


def pose_miss(
    robot: Robot, q: Array, frame: str | None, position: Any, wxyz: Any
) -> tuple[float | None, float | None]:
    """Millimetres and degrees by which the frame at ``q`` misses, by MuJoCo; None where nothing was asked."""
    at = robot.measure(q, frame)
    metres = None if position is None else float(np.linalg.norm(at.position - np.asarray(position)))
    angle = None if wxyz is None else at.distance(Pose(at.position, wxyz))[1]
    return None if metres is None else 1e3 * metres, None if angle is None else float(np.degrees(angle))


def joints_miss(
    robot: Robot, q: Array, wanted: Array, step: Move | ExpectStep
) -> tuple[str, float, float, str]:
    """The joint that is farthest off: its name, by how much, what the step allows, and the unit of both."""
    rows = []
    for joint, off in zip(robot.joints, np.abs(q - wanted).tolist(), strict=True):
        allowed, unit = (step.tolerance_mm, " mm") if slides(robot, joint) else (step.tolerance_deg, "°")
        rows.append((joint, off / per_unit(robot, joint), allowed, unit))
    return max(rows, key=lambda row: row[1] / row[2])


# --------------------------------------------------------------------------------------- the steps


def go(now: Situation, step: Move, result: StepResult) -> None:
    """Plans, sends, and waits until the servos have arrived.

    Raises:
        StepFailed: They did not, or not in time.
        NotConvergedError, TrajectoryError: There is no way; nothing was sent.
        RobotIkError: Of the arm or the camera.
    """
    start = now.start()
    caps: dict[str, Any] = {
        "velocity": now.config.velocity,
        "acceleration": now.config.acceleration,
        "rate": now.config.rate_hz,
        "speed": step.speed or now.script.content.speed,
    }
    if isinstance(step, LineStep):
        target = line_target(now.robot, start, step)
        trajectory = line_move(
            now.robot, start, target, frame=step.frame, linear_speed=step.linear_speed, **caps
        )
        judge = _by_pose(now, step, PoseGoal.at(step.frame, target))
    elif isinstance(step, PoseStep | PositionStep | MarkerStep):
        goal, wanted = _goal(now, step, result)
        trajectory = joint_move(now.robot, start, solve_for(now, goal, start), **caps)
        judge = _by_pose(now, step, wanted)
    else:
        angles = _angles(now.robot, start, step)
        trajectory = joint_move(now.robot, start, angles, **caps)
        judge = _by_joints(now, step, angles)
    now.play(trajectory, step.time_limit_s, lambda: judge()[0], result)
    there, result.found, numbers = judge()
    result.numbers.update(numbers)
    if not there:
        raise StepFailed(f"not arrived: {result.found}")


def line_target(robot: Robot, start: Array, step: LineStep) -> Pose:
    """Where the line ends, world."""
    begin = robot.forward(start, step.frame)
    position = begin.position + np.asarray(step.by) if step.position is None else np.asarray(step.position)
    return Pose(position, begin.wxyz if step.wxyz is None else step.wxyz)


def solve_for(now: Situation, goal: Goal, start: Array) -> Array:
    """(nq,) that meets the goal.

    Raises:
        NotConvergedError: None was found.
    """
    problem = Problem(now.robot, goal, tolerance=SOLVE_TOLERANCE, seed=now.seed)
    solution = make_solver(now.solver).solve(problem, start)
    now.status = solution.status.name
    q = np.array(solution.require().q)
    aside = [k for k, name in enumerate(now.robot.joints) if name in gripper_joints(now.robot)]
    q[aside] = start[aside]  # what is in the gripper stays there
    return q


def _goal(
    now: Situation, step: PoseStep | PositionStep | MarkerStep, result: StepResult
) -> tuple[Goal, Goal]:
    """The goal to solve for, and the one by which the arm is judged: at the marker's true place."""
    if not isinstance(step, MarkerStep):
        frame = step.frame or now.robot.tool
        given = (
            PoseGoal(frame, step.position, step.wxyz)
            if isinstance(step, PoseStep)
            else PositionGoal(frame, step.position)
        )
        return given, given
    assert now.eyes is not None
    seen = now.eyes.find_target()
    assert seen.true_pose is not None  # the camera is synthetic
    true = seen.true_pose.compose(now.eyes.stage.pose_marker_tool)
    off = float(np.linalg.norm(seen.goal.target.position - true.position))
    result.numbers["seen_off_mm"] = round(1e3 * off, 4)
    goal = seen.goal
    if isinstance(goal, PoseGoal) and goal.free_axis is not None:
        # Five joints point the axis within a plane, and it is seen a little beside that.
        near = Tolerance(SOLVE_TOLERANCE.position, 0.5 * float(np.radians(step.tolerance_deg)))
        return replace(goal, tolerance=near), goal.moved_to(true)
    return goal, goal.moved_to(true)


def _angles(robot: Robot, start: Array, step: JointsStep | KeyframeStep | GripStep) -> Array:
    if isinstance(step, JointsStep):
        return with_joints(robot, start, step)
    if isinstance(step, KeyframeStep):
        return keyframes(robot)[step.keyframe]
    return gripper_angles(robot, start, step.opening or 0.0)


Judge = Callable[[], tuple[bool, str, dict[str, float]]]


def _by_pose(now: Situation, step: Move, goal: Goal) -> Judge:
    def judge() -> tuple[bool, str, dict[str, float]]:
        metres, radians = goal.off(now.robot.measure(now.arm.read().q, goal.frame), goal.target)
        mm, deg = 1e3 * metres, float(np.degrees(radians)) if goal.has_angle else None
        numbers = {"off_mm": round(mm, 4)} | ({} if deg is None else {"off_deg": round(deg, 4)})
        inside = mm <= step.tolerance_mm and (deg is None or deg <= step.tolerance_deg)
        return inside, off_text(mm, deg, step), numbers

    return judge


def _by_joints(now: Situation, step: Move, wanted: Array) -> Judge:
    def judge() -> tuple[bool, str, dict[str, float]]:
        joint, off, allowed, unit = joints_miss(now.robot, now.arm.read().q, wanted, step)
        here, most = apart(off, allowed, digits=2)
        text = f"{joint} {here}{unit} off; allowed {most}{unit}"
        return off <= allowed, text, {"off_deg" if unit == "°" else "off_mm": round(off, 4)}

    return judge
