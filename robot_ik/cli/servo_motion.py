"""``robot-ik servo move``, ``torque`` and ``reset-fault``; ``robot-ik stop``."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import OnExit, positive, require, several, single, wrong
from robot_ik.cli.connection import BusOptions, arm_on, driving, load_arm, opened, require_model
from robot_ik.cli.servo_bus import checked_rates
from robot_ik.config import is_number
from robot_ik.errors import distinct_texts

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.servo import Joint
    from robot_ik.hardware.startup import ServoReset


@dataclass(frozen=True)
class ServoMoveOptions(BusOptions):
    """Moves joints to angles in degrees (slides: mm), slowly, within limits and caps of the arm file.

        robot-ik servo move joint1=30 joint3=-45
        robot-ik servo move 0 90 -90 0 0 0       (all joints in order)

    With [collisions] in the arm file all joints move together on a straight path, and a path that would
    touch is refused.
    At the end, and on Ctrl-C, the arm is left as --on-exit says: torque_off lets it fall.
    """

    to: Positional[Annotated[tuple[str, ...], several("JOINT=DEG …|DEG")]]
    """Where to go."""
    by: bool = False
    """The angles are by how much, not where to."""
    speed: Annotated[float, arg(metavar="SHARE"), positive(1.0, " is no share of the speed caps")] = 0.25
    """Share of the speed caps, above 0 and up to 1."""
    on_exit: OnExit = ""


def run_move(options: ServoMoveOptions) -> int:
    """Goes there; 1 when a joint did not arrive, or the path is blocked."""
    from robot_ik.workcell.arm_guard import guard_of

    config = load_arm(options.arm).slowed(options.speed)
    angles = parse_angles(options.to, config)
    if not options.by:
        require_inside(angles, config)
    guard = guard_of(config)
    arm = arm_on(options, config, options.on_exit)
    with driving(arm):
        if guard is None:
            arm.enable()
        arm.read()
        here = arm.positions()
        goal = {name: q + here[name] for name, q in angles.items()} if options.by else angles
        require_inside(goal, config)
        if guard is not None:
            from robot_ik.jobs.hand_guiding import play_straight

            play_straight(arm, goal, guard, console.busy)
        travel = {name: abs(q - here[name]) for name, q in goal.items()}
        takes = max((far / config.joint(name).velocity for name, far in travel.items()), default=0.0)
        with console.busy("moving", takes):
            arm.move_to(goal)
        _show(arm, here, goal)
    return console.DONE


def parse_angles(arguments: Sequence[str], config: ArmConfig) -> dict[str, float]:
    """Joint name -> rad (m) from ``joint1=30`` or from one number for every joint, in degrees (slides: mm).

    Raises:
        ConfigError: Neither form, or no finite number.
        UnknownJointError: No such joint; close ones are named.
    """
    slides = any(joint.slides for joint in config.joints)
    pair = "JOINT=DEG|MM" if slides else "JOINT=DEG"
    named = ["=" in argument for argument in arguments]
    if named and all(named):
        pairs = [(name, text) for name, _, text in (argument.partition("=") for argument in arguments)]
    elif len(arguments) == len(config.names) and not any(named):
        pairs = list(zip(config.names, arguments, strict=True))
    else:
        form = f"{pair}, or {len(config.names)} numbers for {', '.join(config.names)}"
        raise wrong(pair, " ".join(arguments) or "nothing to do", form)
    angles: dict[str, float] = {}
    for name, text in pairs:
        value = float(text) if is_number(text) else math.nan
        joint = config.joint(name)
        require(math.isfinite(value), name, f"{text!r} is no number", f"{joint.unit}, e.g. 30 or -12.5")
        require(name not in angles, name, "named twice", "every joint once")
        angles[name] = value * joint.per_unit
    return angles


def require_inside(angles: dict[str, float], config: ArmConfig) -> None:
    """Raises ``ConfigError`` unless every value (rad, m) is within what the arm file and the servo allow."""
    for name, q in angles.items():
        joint = config.joint(name)
        lower, upper = joint.limits
        if not lower - 1e-9 <= q <= upper + 1e-9:
            asked, low, high = distinct_texts(*(value / joint.per_unit for value in (q, lower, upper)))
            unit = joint.unit
            raise wrong(name, f"{asked} {unit} is outside its limits", f"{low} to {high} {unit}")


def _show(arm: Arm, start: dict[str, float], goal: dict[str, float]) -> None:
    arm.read()
    rows = []
    for name, q in arm.positions().items():
        joint = arm.config.joint(name)
        asked = shown_value(joint, goal[name]) if name in goal else "-"
        rows.append((name, shown_value(joint, start[name]), asked, shown_value(joint, q)))
    console.show(console.table("joint", "was", "asked", "is", rows=rows))


def shown_value(joint: Joint, q: float) -> str:
    """A joint value for people: degrees, or mm of a slide."""
    if joint.slides:
        return joint.text(q, 2)
    return f"{math.degrees(q):z.2f}°"


@dataclass(frozen=True)
class ServoTorqueOptions(BusOptions):
    """Switches torque on (every joint holds where it stands) or off (support the arm: it may fall).

    on checks the servos as any start of the arm does, and leaves them holding, with no watchdog armed.
    off asks nothing first: it is for an arm in any state. Both are read back.
    """

    to: Positional[Annotated[Literal["on", "off"], arg(metavar="on|off")]]
    """What to do."""
    joints: Positional[Annotated[tuple[str, ...], several("JOINT")]] = ()
    """Only these joints; all if none is named."""
    ids: Annotated[tuple[int, ...], several("N")] = ()
    """For off: these servo ids, whatever the arm file says."""
    baud: Annotated[int | None, single("RATE", "the arm file's")] = None
    """For --ids: the rate of these servos, bits/s."""


def run_torque(options: ServoTorqueOptions) -> int:
    """1 when a servo did not confirm it."""
    off = not options.joints and options.to == "off"
    only = "only for torque off, and not together with joints"
    require(off or not options.ids, "--ids", only, "torque off --ids N …")
    config = load_arm(options.arm)
    if options.to == "on":
        require_model(config)  # of the joints that stay as they are, too
        arm = arm_on(options, config.only(options.joints), "hold")
        with driving(arm):
            arm.enable()
        return console.DONE if arm.exit_report is not None and arm.exit_report.ok else console.NOT_ACHIEVED
    from robot_ik.hardware.models import require_id
    from robot_ik.hardware.torque import leave

    servos = {drive.id: drive.name for drive in config.only(options.joints).drives}
    if options.ids:
        for id in options.ids:
            require_id(id, "--ids")
        servos = {id: f"servo {id}" for id in options.ids}
        if options.baud is not None:
            config = replace(config, baud=checked_rates([options.baud])[0])
    with opened(options, config) as bus:
        everyone = not options.ids and not options.joints
        report = leave(bus, config, "torque_off", {}, servos=servos, everyone=everyone)
    if not report.ok:
        console.say(f"error: {report.doubt}", "bold red")
    if report.verified:
        console.result(f"torque off, read back: {', '.join(report.verified)}")
    return console.DONE if report.ok else console.NOT_ACHIEVED


@dataclass(frozen=True)
class ServoResetFaultOptions(BusOptions):
    """Restarts servos that have shut down (overload, heat, voltage …) and looks at them again.

    Remove the cause first. A restarted servo has no torque: support the arm. Nothing is switched on.
    Exit code 1 when an error is still there, or a servo has forgotten whole revolutions.
    """

    joints: Positional[Annotated[tuple[str, ...], several("JOINT")]] = ()
    """Only these joints; all if none is named."""


def run_reset_fault(options: ServoResetFaultOptions) -> int:
    """1 when something is still wrong."""
    from robot_ik.hardware.startup import reset_servos

    config = load_arm(options.arm).only(options.joints)
    with opened(options, config) as bus:
        rows = reset_servos(bus, config)
    cells = []
    for row in rows:
        now = "no answer" if row.after is None else ", ".join(row.after) or "healthy"
        was = ", ".join(row.before) or ("healthy" if row.silence is None else "no answer")
        cells.append((row.joint, row.id, was, now, _advice(row)))
    console.show(console.table("joint", "id", "was", "is", "what to do", rows=cells))
    return console.DONE if all(row.ok for row in rows) else console.NOT_ACHIEVED


def _advice(row: ServoReset) -> str:
    if row.ok:
        return "torque is off: robot-ik servo torque on" if row.before else ""
    if row.after is None:
        return "check power, cable, id and baud rate"
    if row.after:
        return "the cause is still there: load, heat, supply?"
    return f"its reading changed by {row.turned} ticks: it forgot whole revolutions; turn the joint by hand"


@dataclass(frozen=True)
class StopOptions:
    """Stops arms that other programs drive: they hold where they are, with torque on.

    Needs neither the port nor the program's terminal. Exit code 0 only when every servo confirmed it;
    1 when one did not, when no arm runs, or without an answer for 3 s. Then the request stays: the arm stops
    when its program goes on. It is no substitute for a switch in the servos' supply.
    """

    bus: Annotated[str, single("PORT", "every arm of this user")] = ""
    """Only the arm on this port."""
    torque_off: bool = False
    """Let go instead: the arm may fall. Asks first."""
    yes: bool = False
    """With --torque-off: do not ask."""


def run_stop(options: StopOptions) -> int:
    """1 when an arm did not confirm it, or none runs."""
    from robot_ik.hardware.stop_file import running_arms

    arms = running_arms(os.path.expanduser(options.bus) or None)
    if not arms:
        console.say("no arm runs" + (f" on {options.bus}" if options.bus else ""), "yellow")
        if options.torque_off:
            port = options.bus or "PORT"
            console.say(f"servos may hold without a program: robot-ik servo torque off --bus {port}", "cyan")
        return console.NOT_ACHIEVED
    if options.torque_off and not options.yes:
        require(sys.stdin.isatty(), "--torque-off", "there is no terminal to ask at", "--torque-off --yes")
        names = ", ".join(arm.name for arm in arms)
        if not console.confirm(f"{names}: without torque an arm falls. Support it. Torque off?"):
            console.say("nothing was done", "dim")
            return console.NOT_ACHIEVED
    stopped = 0
    for arm in arms:
        ok, text = arm.stop("torque_off" if options.torque_off else "hold")
        stopped += ok
        console.say(f"{arm.name} on {arm.port} (process {arm.pid}): {text}", "" if ok else "bold red")
    return console.DONE if stopped == len(arms) else console.NOT_ACHIEVED
