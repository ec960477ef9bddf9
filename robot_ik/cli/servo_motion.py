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
from robot_ik.cli.arguments import require, several, single, wrong
from robot_ik.cli.connection import BusOptions, arm_on, driving, load_arm, open_servo_bus
from robot_ik.cli.servo_bus import checked_rates
from robot_ik.config import is_number

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.recovery import ServoReset
    from robot_ik.hardware.servo import Joint

LIMIT_SLACK = 1e-9
"""rad (m) by which a value may be outside its limits: rounding of degrees."""


def parse_angles(arguments: Sequence[str], config: ArmConfig) -> dict[str, float]:
    """Return joint name -> rad (m) of ``joint1=30``, or of one number for every joint.

    Args:
        arguments: Numbers in degrees (slides: mm).
        config: Arm file.

    Raises:
        ConfigError: Neither form, or no finite number.
        UnknownJointError: No such joint; close ones are named.
    """
    slides = any(joint.slides for joint in config.joints)
    pair = "JOINT=DEG|MM" if slides else "JOINT=DEG"
    named = ["=" in argument for argument in arguments]
    if named and all(named):
        parts = (argument.partition("=") for argument in arguments)
        pairs = [(name, text) for name, _, text in parts]
    elif len(arguments) == len(config.names) and not any(named):
        pairs = list(zip(config.names, arguments, strict=True))
    else:
        form = f"{pair}, or {len(config.names)} numbers for {', '.join(config.names)}"
        raise wrong(pair, " ".join(arguments) or "nothing to do", form)
    angles: dict[str, float] = {}
    for name, text in pairs:
        value = float(text) if is_number(text) else math.nan
        joint = config.joint(name)
        allowed = f"{joint.unit}, e.g. 30 or -12.5"
        require(math.isfinite(value), name, f"{text!r} is no number", allowed)
        require(name not in angles, name, "named twice", "every joint once")
        angles[name] = value * joint.per_unit
    return angles


def shown_value(joint: Joint, q: float) -> str:
    """Return a joint value as text: degrees, or mm of a slide."""
    if joint.slides:
        return joint.text(q, 2)
    return f"{math.degrees(q):z.2f}°"


@dataclass(frozen=True)
class ServoTorqueOptions(BusOptions):
    """Switches torque on (every joint holds its pose) or off (support the arm: it may fall).

    on checks the servos as any start of the arm does, and leaves them holding, with no watchdog
    armed. off needs no confirmation and works in any state of the arm. Both are read back.
    """

    to: Positional[Annotated[Literal["on", "off"], arg(metavar="on|off")]]
    """What to do."""
    joints: Positional[Annotated[tuple[str, ...], several("JOINT")]] = ()
    """Only these joints; all if none is named."""
    ids: Annotated[tuple[int, ...], several("N")] = ()
    """For off: these servo ids, also if they are not in the arm file."""
    baud: Annotated[int | None, single("RATE", "the arm file's")] = None
    """For --ids: the rate of these servos, bits/s."""


def run_torque(options: ServoTorqueOptions) -> int:
    """Switch torque; 1 if a servo did not confirm it."""
    all_off = not options.joints and options.to == "off"
    problem = "only for torque off, and not together with joints"
    require(all_off or not options.ids, "--ids", problem, "torque off --ids N …")
    config = load_arm(options.arm)
    return _torque_on(options, config) if options.to == "on" else _torque_off(options, config)


def _torque_on(options: ServoTorqueOptions, config: ArmConfig) -> int:
    from robot_ik.hardware.model_check import check_own_model

    check_own_model(config)  # also if only some joints of the model get torque
    arm = arm_on(options, config.only(options.joints), "hold")
    with driving(arm):
        arm.enable()
    report = arm.exit_report
    return console.DONE if report is not None and report.ok else console.NOT_ACHIEVED


def _torque_off(options: ServoTorqueOptions, config: ArmConfig) -> int:
    from robot_ik.hardware.leaving import leave
    from robot_ik.hardware.models import require_id

    servos = {drive.id: drive.name for drive in config.only(options.joints).drives}
    if options.ids:
        for id in options.ids:
            require_id(id, "--ids")
        servos = {id: f"servo {id}" for id in options.ids}
        if options.baud is not None:
            config = replace(config, baud=checked_rates([options.baud])[0])
    with open_servo_bus(options, config) as bus:
        broadcast = not options.ids and not options.joints
        report = leave(bus, config, "torque_off", {}, servos=servos, broadcast=broadcast)
    if not report.ok:
        console.say(f"error: {report.doubt}", "bold red")
    if report.verified:
        console.result(f"torque off, read back: {', '.join(report.verified)}")
    return console.DONE if report.ok else console.NOT_ACHIEVED


@dataclass(frozen=True)
class ServoResetFaultOptions(BusOptions):
    """Restarts servos that have shut down (overload, heat, voltage …) and checks them again.

    Remove the cause first. A restarted servo has no torque: support the arm. Nothing is switched
    on. Exit code 1 if an error remains, or a servo has lost whole revolutions.
    """

    joints: Positional[Annotated[tuple[str, ...], several("JOINT")]] = ()
    """Only these joints; all if none is named."""


def run_reset_fault(options: ServoResetFaultOptions) -> int:
    """Restart servos; 1 if a servo still has an error or does not answer."""
    from robot_ik.hardware.recovery import reset_servos

    config = load_arm(options.arm).only(options.joints)
    with open_servo_bus(options, config) as bus:
        rows = reset_servos(bus, config)
    cells = []
    for row in rows:
        before = ", ".join(row.before) or ("healthy" if row.silence is None else "no answer")
        after = "no answer" if row.after is None else ", ".join(row.after) or "healthy"
        cells.append((row.joint, row.id, before, after, _advice(row)))
    console.show(console.table("joint", "id", "was", "is", "what to do", rows=cells))
    return console.DONE if all(row.ok for row in rows) else console.NOT_ACHIEVED


def _advice(row: ServoReset) -> str:
    """Return what to do about a servo after its reset."""
    if row.ok:
        return "torque is off: robot-ik servo torque on" if row.before else ""
    if row.after is None:
        return "check power, cable, id and baud rate"
    if row.after:
        return "remove the cause: load, heat or supply"
    return (
        f"its reading changed by {row.turned} ticks: it lost whole revolutions; "
        "turn the joint by hand"
    )


@dataclass(frozen=True)
class StopOptions:
    """Stops arms that other programs drive: they hold their pose, with torque on.

    Needs neither the port nor the program's terminal. Exit code 0 only if every servo confirmed
    it; 1 if a servo did not, if no arm runs, or without an answer for 3 s. After 3 s the request
    stays: the arm stops when its program continues. It does not replace a switch in the servos'
    supply.
    """

    bus: Annotated[str, single("PORT", "every arm of this user")] = ""
    """Only the arm on this port."""
    torque_off: bool = False
    """Switch torque off instead, after a confirmation: the arm may fall."""
    yes: bool = False
    """With --torque-off: skip the confirmation."""


def run_stop(options: StopOptions) -> int:
    """Stop the arms; 1 if an arm did not confirm it, or none runs."""
    from robot_ik.hardware.stop_file import running_arms

    arms = running_arms(os.path.expanduser(options.bus) or None)
    if not arms:
        console.say("no arm runs" + (f" on {options.bus}" if options.bus else ""), "yellow")
        if options.torque_off:
            port = options.bus or "PORT"
            command = f"robot-ik servo torque off --bus {port}"
            console.say(f"servos may hold without a program: {command}", "cyan")
        return console.NOT_ACHIEVED
    if options.torque_off and not options.yes:
        problem = "there is no terminal to ask at"
        require(sys.stdin.isatty(), "--torque-off", problem, "--torque-off --yes")
        names = ", ".join(arm.name for arm in arms)
        question = f"{names}: without torque an arm falls. Support it. Torque off?"
        if not console.confirm(question):
            console.say("nothing was done", "dim")
            return console.NOT_ACHIEVED
    stopped = 0
    for arm in arms:
        ok, text = arm.stop("torque_off" if options.torque_off else "hold")
        stopped += ok
        line = f"{arm.name} on {arm.port} (process {arm.pid}): {text}"
        console.say(line, "" if ok else "bold red")
    return console.DONE if stopped == len(arms) else console.NOT_ACHIEVED
