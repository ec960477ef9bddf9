"""``robot-ik servo move``: joints to angles in degrees (slides: mm), through the arm and its limiter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, arm_on, driving, load_arm, require_model, tried
from robot_ik.errors import apart

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig, JointMap


@dataclass(frozen=True)
class MoveOptions(BusOptions):
    """Moves joints to angles in degrees (slides: mm), slowly, within limits and caps of the arm file.

        robot-ik servo move joint1=30 joint3=-45
        robot-ik servo move 0 90 -90 0 0 0       (all joints in order)

    At the end, and on Ctrl-C, the arm is left as --on-exit says: torque_off lets it fall.
    """

    to: Positional[Annotated[tuple[str, ...], arg(metavar="JOINT=DEG|MM …|DEG|MM …", help_behavior_hint="")]]
    """Where to go."""
    by: bool = False
    """The angles are by how much, not where to."""
    speed: Annotated[float, arg(metavar="SHARE")] = 0.25
    """Share of the speed caps, above 0 and up to 1."""
    on_exit: Annotated[
        str, arg(metavar="torque_off|hold|park", help_behavior_hint="(default: the arm file's)")
    ] = ""
    """How to leave the arm; park: back to where it was first."""


def run_move(options: MoveOptions) -> int:
    """Goes there; 1 when a joint did not arrive."""
    config = slowed(load_arm(options.arm), options.speed)
    require_model(config)
    angles = parse_angles(options.to, config)
    if not options.by:
        require_inside(angles, config)
    arm = arm_on(options, config, options.on_exit)

    def move() -> int:
        arm.enable()
        arm.read()
        here = arm.positions()
        goal = {name: q + here[name] for name, q in angles.items()} if options.by else angles
        require_inside(goal, config)
        way = {name: abs(q - here[name]) for name, q in goal.items()}
        takes = max((far / config.joint(name).velocity for name, far in way.items()), default=0.0)
        with console.busy("moving", takes):
            arm.park(goal)
        _show(arm, here, goal)
        return console.DONE

    with driving(arm):
        return tried(move)


def slowed(config: ArmConfig, speed: float) -> ArmConfig:
    """The arm with a share of its speed and acceleration caps.

    Raises:
        ConfigError: Not above 0 and up to 1.
    """
    if not 0.0 < speed <= 1.0:
        raise wrong("--speed", f"{speed:g} is no share of the speed caps", "above 0, at most 1")
    joints, aside = (
        tuple(replace(j, velocity=speed * j.velocity, acceleration=speed * j.acceleration) for j in row)
        for row in (config.joints, config.aside)
    )
    return replace(config, joints=joints, aside=aside)


def parse_angles(words: Sequence[str], config: ArmConfig) -> dict[str, float]:
    """Joint name -> rad (m) from ``joint1=30`` or from one number for every joint, in degrees (slides: mm).

    Raises:
        ConfigError: Neither form, or no finite number.
        UnknownJointError: No such joint; close ones are named.
    """
    word = (
        "JOINT=DEG" if not any(joint.slides for joint in (*config.joints, *config.aside)) else "JOINT=DEG|MM"
    )
    form = f"{word}, or {len(config.names)} numbers for {', '.join(config.names)}"
    if all("=" in word for word in words) and words:
        pairs = [(word.partition("=")[0], word.partition("=")[2]) for word in words]
    elif len(words) == len(config.names) and not any("=" in word for word in words):
        pairs = list(zip(config.names, words, strict=True))
    else:
        raise wrong(word, " ".join(words) or "nothing to do", form)
    angles: dict[str, float] = {}
    for name, text in pairs:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        joint = config.joint(name)
        if not math.isfinite(value):
            raise wrong(name, f"{text!r} is no number", f"{joint.unit}, e.g. 30 or -12.5")
        if name in angles:
            raise wrong(name, "named twice", "every joint once")
        angles[name] = value * joint.per_unit
    return angles


def require_inside(angles: dict[str, float], config: ArmConfig) -> None:
    """Raises ``ConfigError`` unless every value (rad, m) is within what the arm file and the servo allow."""
    for name, q in angles.items():
        joint = config.joint(name)
        lower, upper = joint.limits
        if not lower - 1e-9 <= q <= upper + 1e-9:
            asked, low, high = apart(*(value / joint.per_unit for value in (q, lower, upper)))
            unit = joint.unit
            raise wrong(name, f"{asked} {unit} is outside its limits", f"{low} to {high} {unit}")


def _show(arm: Arm, start: dict[str, float], goal: dict[str, float]) -> None:
    """Where the joints were, were sent, and are."""
    shown = console.table("joint", "was", "asked", "is")
    arm.read()
    for name, q in arm.positions().items():
        joint = arm.config.joint(name)
        asked = shown_value(joint, goal[name]) if name in goal else "-"
        shown.add_row(name, shown_value(joint, start[name]), asked, shown_value(joint, q))
    console.out().print(shown)


def shown_value(joint: JointMap, q: float) -> str:
    """A joint value for people: degrees, or mm of a slide."""
    return degrees(q) if not joint.slides else joint.text(q, 2)


def degrees(q: float) -> str:
    """An angle in rad for people."""
    return f"{round(math.degrees(q), 2) + 0.0:.2f}°"  # + 0.0: no "-0.00"
