"""``robot-ik servo move``: joints to angles in degrees, through the arm and its limiter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.servo_link import BusOptions, arm_on, check_beside, left, tried, wrong

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig


@dataclass(frozen=True)
class MoveOptions(BusOptions):
    """Moves joints to angles in degrees, slowly, within the limits and caps of the arm file.

    Examples: robot-ik servo move joint1=30 joint3=-45
    or all joints in order: robot-ik servo move 0 90 -90 0 0 0

    At the end, and on Ctrl-C, the arm is left as --on-exit says: torque_off lets it fall.
    """

    to: Positional[Annotated[tuple[str, ...], arg(metavar="JOINT=DEG …|DEG …")]]
    """Where to go."""
    by: bool = False
    """The angles are by how much, not where to."""
    speed: float = 0.25
    """Share of the speed caps, above 0 and up to 1."""
    on_exit: Annotated[
        str, arg(metavar="torque_off|hold|park", help_behavior_hint="(default: the arm file's)")
    ] = ""
    """How to leave the arm; park: back to where it was first."""


def run_move(options: MoveOptions) -> int:
    """Goes there; 1 when a joint did not arrive."""
    from robot_ik.cli.sim_bus import load_arm

    config = slowed(load_arm(options.arm), options.speed)
    angles = parse_angles(options.to, config)
    if not options.by:
        require_inside(angles, config)
    arm = arm_on(options, config, options.on_exit)

    def move() -> int:
        arm.enable()
        here = dict(zip(config.names, arm.read().q.tolist(), strict=True))
        goal = {name: q + here[name] for name, q in angles.items()} if options.by else angles
        require_inside(goal, config)
        arm.park(goal)
        _show(arm, here, goal)
        return console.DONE

    with arm:
        check_beside(arm)
        code = tried(move)
    console.say(left(arm), "dim")
    return code


def slowed(config: ArmConfig, speed: float) -> ArmConfig:
    """The arm with a share of its speed and acceleration caps.

    Raises:
        ConfigError: Not above 0 and up to 1.
    """
    if not 0.0 < speed <= 1.0:
        raise wrong("--speed", f"{speed:g} is no share of the speed caps", "above 0, at most 1")
    joints = (
        replace(j, velocity=speed * j.velocity, acceleration=speed * j.acceleration) for j in config.joints
    )
    return replace(config, joints=tuple(joints))


def parse_angles(words: Sequence[str], config: ArmConfig) -> dict[str, float]:
    """Joint name -> rad from ``joint1=30`` or from one number for every joint, in degrees.

    Raises:
        ConfigError: Neither form, or no finite number.
        UnknownJointError: No such joint; close ones are named.
    """
    form = f"JOINT=DEG, or {len(config.names)} numbers for {', '.join(config.names)}"
    if all("=" in word for word in words) and words:
        pairs = [(word.partition("=")[0], word.partition("=")[2]) for word in words]
    elif len(words) == len(config.names) and not any("=" in word for word in words):
        pairs = list(zip(config.names, words, strict=True))
    else:
        raise wrong("JOINT=DEG", " ".join(words) or "nothing to do", form)
    angles: dict[str, float] = {}
    for name, text in pairs:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise wrong(name, f"{text!r} is no angle", "degrees, e.g. 30 or -12.5")
        if config.joint(name).name in angles:
            raise wrong(name, "named twice", "every joint once")
        angles[name] = math.radians(value)
    return angles


def require_inside(angles: dict[str, float], config: ArmConfig) -> None:
    """Raises ``ConfigError`` unless every angle (rad) is within what the arm file and the servo allow."""
    for name, q in angles.items():
        lower, upper = config.joint(name).limits
        if not lower - 1e-9 <= q <= upper + 1e-9:
            allowed = f"{math.degrees(lower):.1f} to {math.degrees(upper):.1f} deg"
            raise wrong(name, f"{math.degrees(q):.1f} deg is outside its limits", allowed)


def _show(arm: Arm, start: dict[str, float], goal: dict[str, float]) -> None:
    """Where the joints were, were sent, and are."""
    shown = console.table("joint", "was", "asked", "is")
    for name, q in zip(arm.joints, arm.read().q.tolist(), strict=True):
        asked = degrees(goal[name]) if name in goal else "-"
        shown.add_row(name, degrees(start[name]), asked, degrees(q))
    console.out().print(shown)


def degrees(q: float) -> str:
    """An angle in rad for people."""
    return f"{round(math.degrees(q), 2) + 0.0:.2f}°"  # + 0.0: no "-0.00"
