"""Joint values of a script: hinges in degrees and slides in millimetres."""

from __future__ import annotations

from typing import Annotated, ClassVar

import mujoco
import numpy as np
from pydantic import Field

from robot_ik.config import KeyProblem, Positive
from robot_ik.errors import distinct_texts
from robot_ik.motion.key_poses import KeyPoses, named_poses
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.script.state import RunState
from robot_ik.script.steps.base import ScriptStep, require_known
from robot_ik.script.steps.findings import Finding, error_finding

#: Tolerance of the check of joint limits, degrees or millimetres. It covers the rounding of the
#: conversion from rad or m.
LIMIT_ROUNDING = 1e-9


def keyframes(robot: Robot) -> dict[str, Array]:
    """Return the model's keyframes and ``home`` by name, each (nq,) in rad and m."""
    return {**named_poses(robot, KeyPoses(robot)), "home": robot.home}


def slides(robot: Robot, joint: str) -> bool:
    """Return whether a joint slides. Its unit is then the millimetre, otherwise the degree."""
    return int(robot.model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)


def per_unit(robot: Robot, joint: str) -> float:
    """Return one millimetre in m for a slide, and one degree in rad for a hinge."""
    return 1e-3 if slides(robot, joint) else float(np.radians(1.0))


class JointValues(ScriptStep):
    """A step with values of joints.

    Attributes:
        joints_deg: Angles of hinges, degrees.
        joints_mm: Positions of slides, millimetres.
    """

    joints_deg: Annotated[dict[str, float], Field(min_length=1)] | None = None
    joints_mm: Annotated[dict[str, float], Field(min_length=1)] | None = None

    ignores_limits: ClassVar[bool] = False
    """Whether values outside the joint limits are allowed."""

    def with_values(self, robot: Robot, q: Array) -> Array:
        """Return a copy of ``q``, (nq,) in rad and m, with the values of the named joints."""
        target = q.copy()
        values = {**(self.joints_deg or {}), **(self.joints_mm or {})}
        for joint, value in values.items():
            target[robot.joints.index(joint)] = value * per_unit(robot, joint)
        return target

    def check(self, state: RunState) -> None:
        """Check the names, the units and the limits of the joints."""
        super().check(state)
        for key in ("joints_deg", "joints_mm"):
            for joint, value in (getattr(self, key) or {}).items():
                self._check_joint(state.robot, key, joint, value)

    def _check_joint(self, robot: Robot, key: str, joint: str, value: float) -> None:
        place = f"{key}.{joint}"
        require_known("joint", joint, robot.joints, place)
        is_slide = slides(robot, joint)
        if is_slide and key != "joints_mm":
            raise KeyProblem("a slide counts in millimetres", place, "joints_mm")
        if not is_slide and key != "joints_deg":
            raise KeyProblem("a hinge counts in degrees", place, "joints_deg")
        if self.ignores_limits:
            return

        unit = " mm" if is_slide else "°"
        index = robot.joints.index(joint)
        scale = per_unit(robot, joint)
        lower = float(robot.lower[index]) / scale
        upper = float(robot.upper[index]) / scale
        if not lower - LIMIT_ROUNDING <= value <= upper + LIMIT_ROUNDING:
            given, lowest, highest = distinct_texts(value, lower, upper)
            problem = f"{given}{unit} is outside the limits"
            raise KeyProblem(problem, place, f"{lowest} … {highest}")


class Tolerant(ScriptStep):
    """A step that compares a position with a tolerance.

    Attributes:
        tolerance_mm: Tolerance of the position of a frame or of a slide, millimetres.
        tolerance_deg: Tolerance of the rotation of a frame or of a hinge, degrees.
    """

    tolerance_mm: Positive = 2.0
    tolerance_deg: Positive = 0.5

    def farthest(self, robot: Robot, q: Array, target: Array, key: str = "off") -> Finding:
        """Return the finding about the joint with the largest error relative to its tolerance.

        Args:
            robot: The robot.
            q: Measured joint values, (nq,) in rad and m.
            target: Expected joint values, (nq,) in rad and m.
            key: Key of the error in the report, without its unit.
        """
        rows = []
        for joint, difference in zip(robot.joints, np.abs(q - target).tolist(), strict=True):
            is_slide = slides(robot, joint)
            allowed = self.tolerance_mm if is_slide else self.tolerance_deg
            rows.append((difference / per_unit(robot, joint), allowed, is_slide, joint))
        error, allowed, is_slide, joint = max(rows, key=lambda row: row[0] / row[1])
        unit = " mm" if is_slide else "°"
        suffix = "mm" if is_slide else "deg"
        return error_finding(error, allowed, unit, joint, f"{key}_{suffix}")
