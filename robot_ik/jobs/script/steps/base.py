"""What steps share: a name, a check, a run; joints, frames and grippers by name, and how far off they are.

Lengths are metres, angles degrees (``_deg``), tolerances millimetres and degrees, times seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, get_args

import mujoco
import numpy as np
from pydantic import AfterValidator, Field

from robot_ik.config import KeyProblem, Pair, Positive, Table, Word
from robot_ik.errors import distinct_texts
from robot_ik.hardware import SIMULATED
from robot_ik.hardware.servo import GRIPPER, Joint
from robot_ik.jobs.script.state import RunState, StepFailed, StepResult, error_classes
from robot_ik.motion.key_poses import KeyPoses, named_poses
from robot_ik.ports import Array
from robot_ik.robot import Robot


def require_known(what: str, name: str | None, known: Iterable[str], key: str = "") -> None:
    """Raises ``KeyProblem`` unless ``name`` is None or one of those that are ``known``."""
    if name is not None and name not in (names := list(known)):
        raise KeyProblem.unknown(what, name, names, key)


def _error_class(name: str) -> str:
    require_known("error", name, error_classes())
    return name


def _rising(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise KeyProblem(f"{list(span)} is empty", allowed="[from, to]")
    return span


LONGEST = 86_400.0  # s: a day
NotNegative = Annotated[float, Field(ge=0.0)]
Seconds = Annotated[float, Field(gt=0.0, le=LONGEST)]
Span = Annotated[Pair, AfterValidator(_rising)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
ErrorClass = Annotated[Word, AfterValidator(_error_class)]


STEPS: dict[str, type[ScriptStep]] = {}
"""Every kind of step by the value of ``do``; classes enter themselves."""


class ScriptStep(Table):
    """What every step has; a subclass with a key ``do`` is a kind of step.  ``name``: in place of a title."""

    title_keys: ClassVar[tuple[str, ...]] = ()
    """Keys whose values, after ``do``, make the title of a step without a name."""
    simulated_only: ClassVar[bool] = False
    """On a real port nothing is broken on purpose, and nothing that shut down is switched on by itself."""

    do: str
    name: str = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        STEPS.update(dict.fromkeys(get_args(cls.model_fields["do"].annotation), cls))

    @property
    def needs_camera(self) -> bool:
        """Whether it needs the synthetic camera."""
        return False

    @property
    def title(self) -> str:
        """What it is called in the report."""
        if self.name:
            return self.name
        found = [self.do]
        for key in self.title_keys:
            value = getattr(self, key)
            if isinstance(value, dict):
                unit = " mm" if key == "joints_mm" else "°"
                found += [f"{joint} {number:g}{unit}" for joint, number in value.items()]
            elif isinstance(value, tuple):
                found += [f"{number:g}" for number in value]
            elif value is not None:
                found.append(f"{value:g} s" if key == "seconds" else str(value))
        return " ".join(found)

    def check(self, now: RunState) -> None:
        """Whether this robot, arm and bus can do it; before anything is opened or moves.

        Raises:
            KeyProblem: They cannot.
        """
        if not now.simulated and self.simulated_only:
            problem = f"{self.do!r} is for simulated servos, and this is a real port"
            raise KeyProblem(problem, "do", SIMULATED)
        if not now.simulated and self.needs_camera:
            problem = "the synthetic camera does not see a real desk"
            raise KeyProblem(problem, "do", "other steps, or robot-ik reach")

    def run(self, now: RunState, result: StepResult) -> None:
        """Does it; what was found goes into ``result``.

        Raises:
            StepFailed: It did not do what it should.
            RobotIkError: Of the arm, the camera or the solver.
        """
        raise NotImplementedError


def step_class(table: Mapping[str, Any]) -> type[ScriptStep]:
    """The class of a step by what stands in its table; KeyProblem: there is no such step."""
    if "do" not in table:
        raise KeyProblem("this key is missing", "do", ", ".join(STEPS))
    if not isinstance(table["do"], str) or table["do"] not in STEPS:
        raise KeyProblem.unknown("step", table["do"], STEPS, "do")
    return STEPS[table["do"]]


class Action(ScriptStep):
    """A step that takes time, at most so much, and ends with the error it ``raises``, if any."""

    time_limit_s: Seconds | None = None
    raises: ErrorClass | None = None


@dataclass(frozen=True)
class Finding:
    """One finding: what it is, and what it should be; ``numbers``: the same for programs."""

    right: bool
    found: str
    wanted: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.found if self.right else f"{self.found} instead of {self.wanted}"


def near(off: float, allowed: float, unit: str, what: str, key: str) -> Finding:
    """How far something is off, both in ``unit``; ``key``: what the number is called in the report."""
    here, permitted = distinct_texts(off, allowed, digits=2)
    return Finding(
        off <= allowed, f"{what} {here}{unit} off", f"at most {permitted}{unit}", {key: round(off, 4)}
    )


def report_findings(findings: Sequence[Finding], result: StepResult, failure: str = "") -> None:
    """All of them go into ``result``; StepFailed, which begins with ``failure``: one is not right."""
    for finding in findings:
        result.numbers.update(finding.numbers)
    result.found = "; ".join(map(str, findings))
    if wrong := "; ".join(str(finding) for finding in findings if not finding.right):
        raise StepFailed(failure + wrong)


# ------------------------------------------------------------------------------------------
# Joints and frames by name, and how far off they are.


def keyframes(robot: Robot) -> dict[str, Array]:
    """Name -> (nq,) of the model's keyframes, and ``home``."""
    return {**named_poses(robot, KeyPoses(robot)), "home": robot.home}


def slides(robot: Robot, joint: str) -> bool:
    """Whether a joint slides: then it counts in millimetres, else in degrees."""
    return int(robot.model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)


def per_unit(robot: Robot, joint: str) -> float:
    """One degree in rad; one millimetre in m of a slide."""
    return 1e-3 if slides(robot, joint) else float(np.radians(1.0))


class Framed(ScriptStep):
    """A step for a frame of the robot; by default its tool."""

    frame: str | None = None

    def check(self, now: RunState) -> None:
        super().check(now)
        require_known("frame", self.frame, now.robot.frames, "frame")


class JointValues(ScriptStep):
    """Joints at angles, slides at millimetres."""

    joints_deg: Annotated[dict[str, float], Field(min_length=1)] | None = None
    joints_mm: Annotated[dict[str, float], Field(min_length=1)] | None = None

    anywhere: ClassVar[bool] = False
    """Whether the joints may be named outside their limits."""

    def placed(self, robot: Robot, q: Array) -> Array:
        """``q`` (nq,) with the joints that are named at their degrees and millimetres."""
        wanted = q.copy()
        for name, number in {**(self.joints_deg or {}), **(self.joints_mm or {})}.items():
            wanted[robot.joints.index(name)] = number * per_unit(robot, name)
        return wanted

    def check(self, now: RunState) -> None:
        """Names and kinds of the joints, and whether they can go there."""
        super().check(now)
        robot = now.robot
        for key in ("joints_deg", "joints_mm"):
            for joint, number in (getattr(self, key) or {}).items():
                at = f"{key}.{joint}"
                require_known("joint", joint, robot.joints, at)
                right, unit = ("joints_mm", " mm") if slides(robot, joint) else ("joints_deg", "°")
                if key != right:
                    counts = "a slide counts in millimetres" if unit == " mm" else "a hinge counts in degrees"
                    raise KeyProblem(counts, at, right)
                k, one = robot.joints.index(joint), per_unit(robot, joint)
                low, high = float(robot.lower[k]) / one, float(robot.upper[k]) / one
                if not self.anywhere and not low - 1e-9 <= number <= high + 1e-9:
                    asked, lowest, highest = distinct_texts(number, low, high)
                    raise KeyProblem(f"{asked}{unit} is outside the limits", at, f"{lowest} … {highest}")


class Tolerant(ScriptStep):
    """A step that judges where something is.

    Attributes:
        tolerance_mm, tolerance_deg: Of the frame; or of each slide, and of each other joint.
    """

    tolerance_mm: Positive = 2.0
    tolerance_deg: Positive = 0.5

    def farthest(self, robot: Robot, q: Array, wanted: Array, key: str = "off") -> Finding:
        """Of the joint that is farthest off at ``q`` (nq,)."""
        rows = []
        for joint, off in zip(robot.joints, np.abs(q - wanted).tolist(), strict=True):
            allowed, unit = (self.tolerance_mm, " mm") if slides(robot, joint) else (self.tolerance_deg, "°")
            rows.append((off / per_unit(robot, joint), allowed, unit, joint))
        off, allowed, unit, joint = max(rows, key=lambda row: row[0] / row[1])
        return near(off, allowed, unit, joint, f"{key}_deg" if unit == "°" else f"{key}_mm")


# ------------------------------------------------------------------------------------------
# Grippers: of a servo of the arm's q, or of an auxiliary one that can be asked how hard to press.


def gripper_joints(robot: Robot) -> list[str]:
    """The joints of the group ``gripper`` that are part of q and have servos."""
    return [name for name in robot.file.groups.get(GRIPPER, ()) if name in robot.joints]


def fingers_on(robot: Robot, joint: Joint) -> int:
    """How many fingers one servo moves: its own, and those that a coupling of the model makes follow it."""
    model = robot.model
    leader = next((k for k in range(model.njnt) if model.joint(k).name == joint.name), -1)
    return 1 + sum(coupling.leader == leader for coupling in robot.couplings)


def width_mm(now: RunState) -> float:
    """Millimetres between the fingers, measured."""
    at = now.arm.positions()
    joints = now.config.group(GRIPPER)
    return sum(1e3 * at[joint.name] * fingers_on(now.robot, joint) for joint in joints)


def current_for(joint: Joint, newtons: float, fingers: int) -> float:
    """mA with which each finger presses so hard, friction not counted; at most ``current_ma``.

    Where a horn is near a dead centre a torque presses harder: nowhere harder than asked.
    """
    torque = newtons * fingers * joint.levers[0]
    wanted = 1e3 * torque / joint.servo.table.motor.torque_per_ampere
    return wanted if joint.current is None else min(wanted, joint.current)


class GripperWidth(ScriptStep):
    """Something about the width between fingers that slide."""

    width_mm: NotNegative | None = None

    by_opening: ClassVar[bool] = False
    """Whether joints of q will do, which know no width."""

    def check_gripper(self, now: RunState) -> None:
        """Whether there is a gripper, and one that can do this; else KeyProblem."""
        joints = now.config.group(GRIPPER)
        if not joints and (not self.by_opening or not gripper_joints(now.robot)):
            problem = f"the arm of {now.robot.name!r} has no gripper"
            allowed = "an arm file with a servo for a joint of the group gripper (robot.toml)"
            raise KeyProblem(problem, "do", allowed)
        sliding = bool(joints) and all(joint.slides for joint in joints)
        for key, able in (("width_mm", sliding), ("force_n", bool(joints)), ("held", bool(joints))):
            if getattr(self, key, None) is not None and not able:
                what = "slide" if key == "width_mm" else "joint"
                problem = f"that needs a {what} of the arm file's group gripper"
                raise KeyProblem(problem, key, "opening alone")
        if self.width_mm is not None:
            opening = sum(1e3 * joint.limits[1] * fingers_on(now.robot, joint) for joint in joints)
            if self.width_mm > opening + 1e-9:
                asked, widest = distinct_texts(self.width_mm, opening, digits=6, form="g")
                raise KeyProblem(f"{asked} mm is too wide", "width_mm", f"0 to {widest}")
