"""The gripper of an arm: its joints, its width and its force.

A gripper has joints in the robot's q, or auxiliary servos in the arm file's group ``gripper``. Only
auxiliary servos measure a width and limit their force.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from robot_ik.config import KeyProblem
from robot_ik.errors import distinct_texts
from robot_ik.hardware.servo import GRIPPER, Joint
from robot_ik.robot import Robot
from robot_ik.script.state import RunState
from robot_ik.script.steps.base import NotNegative, ScriptStep

#: Tolerance of the check of the widest opening, millimetres. It covers rounding.
WIDTH_ROUNDING = 1e-9


def gripper_joints(robot: Robot) -> list[str]:
    """Return the joints of the group ``gripper`` that are part of q and have servos."""
    return [name for name in robot.file.groups.get(GRIPPER, ()) if name in robot.joints]


def fingers_on(robot: Robot, joint: Joint) -> int:
    """Return the number of fingers that one servo moves.

    These are its own finger, and the fingers that a coupling of the model makes follow it.
    """
    model = robot.model
    indices = range(model.njnt)
    leader = next((index for index in indices if model.joint(index).name == joint.name), -1)
    return 1 + sum(coupling.leader == leader for coupling in robot.couplings)


def width_mm(state: RunState) -> float:
    """Return the measured width between the fingers, millimetres."""
    positions = state.arm.positions()
    return sum(
        1e3 * positions[joint.name] * fingers_on(state.robot, joint)
        for joint in state.config.group(GRIPPER)
    )


def current_for(joint: Joint, newtons: float, fingers: int) -> float:
    """Return the current with which each finger presses with a force, at most ``current_ma``.

    Friction is neglected. The same torque presses harder where the lever is smaller, for example
    near the dead centre of a horn. The smallest lever of the range is used, so the force is
    exceeded nowhere.

    Args:
        joint: Joint of the gripper.
        newtons: Force of each finger, newtons.
        fingers: Number of fingers that the joint's servo moves.

    Returns:
        The current, milliamperes.
    """
    torque = newtons * fingers * joint.levers[0]
    current = 1e3 * torque / joint.servo.table.motor.torque_per_ampere
    return current if joint.current is None else min(current, joint.current)


class GripperWidth(ScriptStep):
    """A step about the width between fingers that slide.

    Attributes:
        width_mm: Width between the fingers, millimetres.
    """

    width_mm: NotNegative | None = None

    by_opening: ClassVar[bool] = False
    """Whether a gripper with joints in q is enough. Such a gripper has no width."""

    def check_gripper(self, state: RunState) -> None:
        """Check that the arm has a gripper that can do the step.

        Raises:
            KeyProblem: The arm has no gripper, or the gripper cannot do the step.
        """
        joints = state.config.group(GRIPPER)
        if not joints and not (self.by_opening and gripper_joints(state.robot)):
            problem = f"the arm of {state.robot.name!r} has no gripper"
            allowed = "an arm file with a servo for a joint of the group gripper (robot.toml)"
            raise KeyProblem(problem, "do", allowed)

        has_slides = bool(joints) and all(joint.slides for joint in joints)
        if self.width_mm is not None and not has_slides:
            raise _needs_gripper("slide", "width_mm")
        for key in ("force_n", "held"):
            if getattr(self, key, None) is not None and not joints:
                raise _needs_gripper("joint", key)
        if self.width_mm is not None:
            self._check_widest(state.robot, self.width_mm, joints)

    def _check_widest(self, robot: Robot, width: float, joints: Sequence[Joint]) -> None:
        widest = sum(1e3 * joint.limits[1] * fingers_on(robot, joint) for joint in joints)
        if width > widest + WIDTH_ROUNDING:
            given, largest = distinct_texts(width, widest, digits=6, form="g")
            raise KeyProblem(f"{given} mm is too wide", "width_mm", f"0 to {largest}")


def _needs_gripper(kind: str, key: str) -> KeyProblem:
    problem = f"this key needs a {kind} of the arm file's group gripper"
    return KeyProblem(problem, key, "opening alone")
