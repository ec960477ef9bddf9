"""``robot-ik sim-bus``: simulated servos on a port that any Dynamixel client on this machine can open."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import ArmName, Range, joint_degrees, several, single, wrong
from robot_ik.cli.connection import load_arm
from robot_ik.hardware.virtual.faults import FAULTS
from robot_ik.robot_file import SERVO_ROBOT, catalogue
from robot_ik.signals import deferred_signals

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.faults import Fault
    from robot_ik.hardware.virtual.pty import PtyPort


def _help(kind: str) -> str:
    """One line of a flag that is short for a row of ``FAULTS``."""
    row = FAULTS[kind]
    whom = "Joints with the fault" if row.servo else f"Probability ({row.span}) of the fault"
    return f"{whom} {kind}: {row.help}."


_FILE_HELP = (
    "File of faults (TOML): what goes wrong with which servo, when and for how long. "
    f"Kinds: {', '.join(FAULTS)}."
)


@dataclass(frozen=True)
class SimBusOptions:
    """Serves simulated Dynamixel servos (Protocol 2.0) on a serial port of this machine until Ctrl-C.

    Any program may open the port: the ROBOTIS SDK and tools, another robot_ik, your own code.

        robot-ik sim-bus --link /tmp/arm
        robot-ik reach --bus /tmp/arm            (in another terminal)
    """

    arm: ArmName = SERVO_ROBOT
    link: Annotated[Path | None, single("PATH", "no link")] = None
    """Also make a symbolic link to the port: a name that stays the same; removed at the end."""
    match_baud: bool = False
    """Servos hear only a client that set the port to their baud rate, as on a real wire."""
    wire_baud: Annotated[int, Range(0, 10_500_000)] = 0
    """Take the time that bytes take on a wire of this rate, bits/s; 0: none."""
    latency_ms: Annotated[float, Range(0.0, 1000.0)] = 0.0
    """Answer so many ms later, as a USB adapter does (16 unless it is set to 1)."""
    stuck: Annotated[tuple[str, ...], several("JOINT", help=_help("stuck"))] = ()
    silent: Annotated[tuple[str, ...], several("JOINT", help=_help("silent"))] = ()
    zero_offset: Annotated[tuple[str, ...], several("JOINT=DEG")] = ()
    """Joints whose zero is off by so many degrees, unknown to their registers."""
    corrupt: Annotated[float, arg(metavar="P", help=_help("corrupt")), Range(0.0, 1.0)] = 0.0
    drop: Annotated[float, arg(metavar="P", help=_help("drop")), Range(0.0, 1.0)] = 0.0
    faults: Annotated[Path | None, single("FILE", "none", _FILE_HELP)] = None
    seed: Annotated[int | None, single("N", "the file's, or 0")] = None
    """Of random faults: the same seed and traffic give the same ones."""
    physics: bool = False
    """Move the MuJoCo model of the arm: gravity shows up as current, and without torque it falls."""


def run(options: SimBusOptions) -> int:
    """Serves until SIGINT, SIGTERM or SIGHUP, which are the normal end."""
    from robot_ik.hardware import pty_port
    from robot_ik.hardware.virtual.bus import VirtualBus, home_of
    from robot_ik.hardware.virtual.faults import load_faults
    from robot_ik.ports import RealClock

    make_port = pty_port()
    _require_free(options.link)
    config = load_arm(options.arm)
    file = None if options.faults is None else load_faults(options.faults, config)
    seed = (file.seed if file else 0) if options.seed is None else options.seed
    bus = VirtualBus.from_config(config, RealClock(), home_of(config), seed=seed)
    bus.inject(*_faults(options, config))
    if options.physics:
        from robot_ik.hardware.virtual.world import World
        from robot_ik.jobs.robot_setup import robot_named_in
        from robot_ik.robot import load_robot

        World(load_robot(robot_named_in(config)).model, config, bus)
    bus.inject(*(file.faults if file else ()))
    served = make_port(bus, options.link, match_baud=options.match_baud, wire_baud=options.wire_baud)
    with deferred_signals() as signals, served as port:
        _announce(options.arm, config, port)
        signals.wait()
    console.say("closed", "dim")
    return console.DONE


def _faults(options: SimBusOptions, config: ArmConfig) -> list[Fault]:
    from robot_ik.hardware.virtual.faults import Fault, joint_offset

    offsets = joint_degrees("--zero-offset", options.zero_offset, 360.0)
    return [
        *(joint_offset(config.joint(name), degrees) for name, degrees in offsets.items()),
        *(Fault("stuck", config.joint(name).servo.id) for name in options.stuck),
        *(Fault("silent", config.joint(name).servo.id) for name in options.silent),
        Fault("corrupt", value=options.corrupt),
        Fault("drop", value=options.drop),
        Fault("latency", value=options.latency_ms),
    ]


def _require_free(link: Path | None) -> None:
    if link is not None and link.is_symlink() and link.exists():  # its clients would find other servos
        problem = f"{link} is the name of another port, {os.readlink(link)}"
        hint = "is another robot-ik sim-bus running? If not, remove the link"
        raise wrong("--link", problem, "a name that is free", hint)


def _announce(arm: str, config: ArmConfig, port: PtyPort) -> None:
    """The port alone on stdout, for scripts; the rest goes to stderr."""
    name = str(port.link or port.path)
    ids = ", ".join(f"{servo.id} {joint.name} ({servo.model})" for joint, servo in config.drives)
    print(name, flush=True)
    console.say(f"{config.name}: {port.bus.side.name} at {config.baud} baud, torque off")
    console.say(f"servos: {ids}")
    console.say(f"try: {_client(arm, config)} --bus {shlex.quote(name)}", "cyan")
    console.say("end with Ctrl-C", "dim")


def _client(arm: str, config: ArmConfig) -> str:
    """A command that works on these servos: reach, where the model is at hand and moved by them."""
    from robot_ik.hardware.virtual.bus import robot_of

    servos = f"--arm {shlex.quote(arm)}"
    if robot_of(config) is None:
        return f"robot-ik servo monitor {servos}"
    return f"robot-ik reach --robot {arm}" if arm in catalogue() else f"robot-ik reach {servos}"
