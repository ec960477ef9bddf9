"""The step that grips: by a servo of the arm's q, or by one that is aside and only told how hard to press."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_ik.jobs.script.file import Script
from robot_ik.jobs.script.report import StepResult
from robot_ik.jobs.script.situation import Situation, StepFailed
from robot_ik.jobs.script.steps import ExpectStep, GripStep

if TYPE_CHECKING:
    from robot_ik.hardware.joint_map import JointMap
    from robot_ik.jobs.limbs import Limbs
    from robot_ik.ports import Array
    from robot_ik.robot import Robot

GRIPPER = "gripper"
"""Group of ``robot.toml`` and of the arm file."""


def gripper_joints(robot: Robot) -> list[str]:
    """The joints of the group ``gripper`` that are part of q and have servos."""
    return [name for name in robot.file.groups.get(GRIPPER, ()) if name in robot.joints]


def gripper_angles(robot: Robot, q: Array, opening: float) -> Array:
    """``q`` (nq,) with the gripper at a share of its range: 0 at the lower limits, 1 at the upper."""
    wanted = q.copy()
    for name in gripper_joints(robot):
        k = robot.joints.index(name)
        wanted[k] = robot.lower[k] + opening * (robot.upper[k] - robot.lower[k])
    return wanted


def fingers_on(robot: Robot, joint: JointMap) -> int:
    """How many fingers one servo moves: its own, and those that a coupling of the model makes follow it."""
    model = robot.model
    leader = next((k for k in range(model.njnt) if model.joint(k).name == joint.name), -1)
    return 1 + sum(coupling.leader == leader for coupling in robot.couplings)


def check_grip(script: Script, limbs: Limbs, step: GripStep | ExpectStep, at: str) -> None:
    """Whether there is a gripper, and one that can do this.

    Raises:
        ConfigError: There is none, or it opens no width, or cannot be told how hard to press.
    """
    assert limbs.config is not None
    aside = limbs.config.aside_of(GRIPPER)
    if not aside and (isinstance(step, ExpectStep) or not gripper_joints(limbs.robot)):
        raise script.wrong(
            f"the arm of {limbs.robot.name!r} has no gripper",
            f"{at}.do",
            "an arm file with a servo for a joint of the group gripper (robot.toml)",
        )
    slides = bool(aside) and all(joint.slides for joint in aside)
    for key, able in (("width_mm", slides), ("force_n", bool(aside)), ("held", bool(aside))):
        if getattr(step, key, None) is not None and not able:
            problem = (
                f"that needs a {'slide' if key == 'width_mm' else 'joint'} of the arm file's group gripper"
            )
            raise script.wrong(problem, f"{at}.{key}", "opening alone")
    if step.width_mm is not None:
        most = sum(1e3 * joint.limits[1] * fingers_on(limbs.robot, joint) for joint in aside)
        if step.width_mm > most + 1e-9:
            raise script.wrong(f"{step.width_mm:g} mm is too wide", f"{at}.width_mm", f"0 to {most:g}")


def width_mm(now: Situation) -> float:
    """Millimetres between the fingers, measured."""
    at = now.arm.positions()
    joints = now.config.aside_of(GRIPPER)
    return sum(1e3 * at[joint.name] * fingers_on(now.robot, joint) for joint in joints)


def grip(now: Situation, step: GripStep, result: StepResult) -> None:
    """Moves the fingers until they are there or something stops them.

    Raises:
        StepFailed: Something is between them that should not be, or nothing that should.
        RobotIkError: Of the arm.
    """
    joints = now.config.aside_of(GRIPPER)
    if not joints:
        from robot_ik.jobs.script.moves import go

        go(now, step, result)
        return
    for joint in joints:
        fingers = fingers_on(now.robot, joint)
        lower, upper = joint.limits
        goal = lower + (step.opening or 0.0) * (upper - lower)
        if step.width_mm is not None:
            goal = max(lower, min(upper, 1e-3 * step.width_mm / fingers / len(joints)))
        current = None if step.force_n is None else current_for(joint, step.force_n, fingers)
        (report,) = now.arm.grip({joint.name: goal}, current=current, timeout=step.time_limit_s)
        result.numbers.update(held=report.held, width_mm=round(width_mm(now), 4))
        if report.current is not None:
            result.numbers["current_ma"] = round(report.current, 1)
    held = "something is held" if result.numbers["held"] else "nothing is held"
    result.found = f"{result.numbers['width_mm']:.1f} mm, {held}"
    if "current_ma" in result.numbers:
        result.found += f", {result.numbers['current_ma']:.0f} mA"
    if step.held is not None and step.held != result.numbers["held"]:
        raise StepFailed(result.found)


def current_for(joint: JointMap, newtons: float, fingers: int) -> float:
    """mA with which each finger presses so hard, friction not counted; at most ``current_ma``.

    Where a horn is near a dead centre a torque presses harder: nowhere harder than asked.
    """
    torque = newtons * fingers * joint.levers[0] / joint.ratio
    wanted = 1e3 * torque / joint.table.motor.torque_per_ampere
    return wanted if joint.current is None else min(wanted, joint.current)
