"""What a script asks of this robot, this arm and this bus, looked at before anything is opened or moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_ik.errors import UnknownFrameError, apart
from robot_ik.hardware.virtual.faults import fault_for
from robot_ik.jobs.robot_setup import RobotSetup
from robot_ik.jobs.script.state import Script
from robot_ik.jobs.script.steps import (
    AnyStep,
    ClearStep,
    ExpectStep,
    FollowStep,
    GripStep,
    InjectStep,
    MarkerStep,
    RecoverStep,
    check_grip,
    keyframes,
    per_unit,
    slides,
)
from robot_ik.solution import Status

if TYPE_CHECKING:
    from robot_ik.robot import Robot


def looks(step: AnyStep) -> bool:
    """Whether a step needs the camera."""
    return isinstance(step, MarkerStep) or (isinstance(step, FollowStep) and step.path == "marker")


def check_script(script: Script, setup: RobotSetup) -> None:
    """Names, ranges and kinds of every step.

    Raises:
        ConfigError: With the key of the first step that cannot be run here.
    """
    metal = setup.arm is None or setup.arm.virtual_bus is None
    if metal and script.content.physics:
        raise script.wrong(
            "servos on a real port move by themselves", "physics", "false, or --bus sim or pty"
        )
    for k, step in enumerate(script.steps):
        at = f"steps[{k}]"
        if metal:
            _check_metal(script, step, at)
        _check_names(script, setup, step, at)
        if isinstance(step, GripStep) or (isinstance(step, ExpectStep) and step.width_mm is not None):
            check_grip(script, setup, step, at)
        if isinstance(step, InjectStep):
            _fault(script, setup, step, at)


def _check_metal(script: Script, step: AnyStep, at: str) -> None:
    """On a real port nothing is broken on purpose, and nothing shut down is switched on again by itself."""
    if isinstance(step, InjectStep | ClearStep | RecoverStep):
        raise script.wrong(
            f"{step.do!r} is for simulated servos, and this is a real port", f"{at}.do", "--bus sim or pty"
        )
    if isinstance(step, ExpectStep) and step.shafts:
        raise script.wrong("nobody knows where real shafts are", f"{at}.shafts", "false, or --bus sim or pty")
    if looks(step):
        raise script.wrong(
            "the synthetic camera does not see a real desk", f"{at}.do", "other steps, or robot-ik reach"
        )


def _check_names(script: Script, setup: RobotSetup, step: AnyStep, at: str) -> None:
    robot = setup.robot
    frame = getattr(step, "frame", None)
    if frame is not None:
        try:
            robot.frame(frame)
        except UnknownFrameError:
            raise script.unknown("frame", frame, list(robot.frames), f"{at}.frame") from None
    for key in ("joints_deg", "joints_mm"):
        for joint, number in (getattr(step, key, None) or {}).items():
            _check_joint(script, robot, step, key, joint, number, f"{at}.{key}.{joint}")
    keyframe = getattr(step, "keyframe", None)
    if keyframe is not None and keyframe not in (known := keyframes(robot)):
        raise script.unknown("keyframe", keyframe, list(known), f"{at}.keyframe")
    status = getattr(step, "status", None)
    if status is not None and status not in (names := [s.name for s in Status]):
        raise script.unknown("status", status, names, f"{at}.status")
    joint = getattr(step, "joint", None)
    if isinstance(step, ExpectStep) and joint is not None and joint not in robot.joints:
        raise script.unknown("joint", joint, list(robot.joints), f"{at}.joint")


def _check_joint(
    script: Script, robot: Robot, step: AnyStep, key: str, joint: str, number: float, at: str
) -> None:
    """One joint of ``joints_deg`` or ``joints_mm``: its name, its kind, its limits."""
    if joint not in robot.joints:
        raise script.unknown("joint", joint, list(robot.joints), at)
    right, unit = ("joints_mm", " mm") if slides(robot, joint) else ("joints_deg", "°")
    if key != right:
        problem = "a slide counts in millimetres" if right == "joints_mm" else "a hinge counts in degrees"
        raise script.wrong(problem, at, right)
    k, one = robot.joints.index(joint), per_unit(robot, joint)
    low, high = float(robot.lower[k]) / one, float(robot.upper[k]) / one
    if not isinstance(step, ExpectStep) and not low - 1e-9 <= number <= high + 1e-9:
        asked, lowest, highest = apart(number, low, high)
        raise script.wrong(f"{asked}{unit} is outside the limits", at, f"{lowest} … {highest}")


def _fault(script: Script, setup: RobotSetup, step: InjectStep, at: str) -> None:
    assert setup.config is not None
    fault_for(
        setup.config,
        step.kind,
        joint=step.joint,
        id=step.id,
        value=step.value,
        file=script.file,
        key=at,
    )
