"""``robot-ik sim-bus``: serve simulated servos on a serial port of this machine."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.arms import load_arm
from robot_ik.commands.options import ArmName, Seed
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.faults import Fault
    from robot_ik.hardware.virtual.pty import PtyPort

MAX_BAUD = 10_500_000
"""bits/s. Largest rate of a simulated wire."""

MAX_LATENCY = 1000.0
"""ms. Largest delay of a reply."""

FAULT_FORM = "KIND, KIND:JOINT, KIND:JOINT=VALUE, KIND=VALUE or FILE.toml"
"""Forms of a value of ``--fault``."""


@dataclass(frozen=True, kw_only=True)
class SimBus:
    """Serve simulated servos on a serial port of this machine until Ctrl-C.

    Any program may open the port: the tools of the servo's maker, LeRobot, another robot_ik, your
    own code.

        robot-ik sim-bus --link /tmp/arm
        robot-ik reach --bus /tmp/arm            (in another terminal)
    """

    arm: ArmName = "tabletop_puma"
    link: Annotated[Path | None, Parameter(metavar="PATH")] = None
    """Also make a symbolic link to the port, which always has this name. It is removed at the end.
    Default: no link."""
    match_baud: bool = False
    """Servos hear only a client that has set the port to their baud rate, as on a real wire."""
    wire_baud: Annotated[int, Parameter(metavar="RATE", validator=Number(gte=0, lte=MAX_BAUD))] = 0
    """Take the time that bytes need on a wire of this rate, in bits/s. Default: no time."""
    latency_ms: Annotated[
        float, Parameter(metavar="MS", validator=Number(gte=0, lte=MAX_LATENCY))
    ] = 0.0
    """Delay of the replies, in ms. A USB adapter has 16 unless it is set to 1."""
    fault: Annotated[
        tuple[str, ...],
        Parameter(
            metavar="KIND[:JOINT[=VALUE]]|FILE.toml …",
            consume_multiple=True,
            allow_repeating=True,
        ),
    ] = ()
    """Faults to inject. For example stuck:joint3, zero-offset:joint2=2, corrupt=0.01, or a file of
    faults with times."""
    seed: Seed | None = None
    physics: bool = False
    """Move the MuJoCo model of the arm: gravity causes current, and an arm without torque falls."""

    def run(self, terminal: Terminal = QUIET) -> SimBusReport:
        """Serve the port until SIGINT, SIGTERM or SIGHUP, which are the normal end."""
        from robot_ik.hardware import pty_port
        from robot_ik.hardware.virtual.bus import VirtualBus, home_of
        from robot_ik.ports import RealClock
        from robot_ik.signals import deferred_signals

        make_port = pty_port()
        _require_free(self.link)
        config = load_arm(self.arm)
        faults, file_seed = parse_faults(self.fault, config)
        seed = file_seed if self.seed is None else self.seed
        bus = VirtualBus.from_config(config, RealClock(), home_of(config), seed=seed)
        if self.physics:
            _add_physics(config, bus)
        bus.inject(*faults, *_latency(self.latency_ms))
        terminal.end_progress()
        served = make_port(bus, self.link, match_baud=self.match_baud, wire_baud=self.wire_baud)
        with deferred_signals() as signals, served as port:
            self._announce(config, port, terminal)
            signals.wait()
        terminal.say("closed", "dim")
        return SimBusReport()

    def _announce(self, config: ArmConfig, port: PtyPort, terminal: Terminal) -> None:
        """Print the port alone on stdout, for scripts, and everything else on stderr."""
        name = str(port.link or port.path)
        servos = (f"{servo.id} {joint.name} ({servo.model})" for joint, servo in config.drives)
        print(name, flush=True)
        terminal.say(f"{config.name}: {port.bus.side.name} at {config.baud} baud, torque off")
        terminal.say(f"servos: {', '.join(servos)}")
        terminal.say(f"try: {_client(self.arm, config)} --bus {shlex.quote(name)}", "cyan")
        terminal.say("end with Ctrl-C", "dim")


class SimBusReport(Report):
    """The port was closed."""

    streamed: ClassVar[bool] = True

    def tables(self) -> Iterable[Any]:
        return ()

    def facts(self) -> dict[str, Any]:
        return {}


def parse_faults(items: Iterable[str], config: ArmConfig) -> tuple[list[Fault], int]:
    """Return the faults of ``--fault``, and the seed of their last file or 0.

    Raises:
        OptionError: An item has another form, or the value of a fault is wrong.
        ConfigError: A file of faults cannot be used.
        UnknownJointError: A joint does not exist.
    """
    from robot_ik.hardware.virtual.faults import load_faults

    faults: list[Fault] = []
    seed = 0
    for item in items:
        if item.endswith(".toml"):
            file = load_faults(item, config)
            faults += file.faults
            seed = file.seed
        else:
            faults.append(_parse_fault(item, config))
    return faults, seed


def _parse_fault(item: str, config: ArmConfig) -> Fault:
    from robot_ik.config import KeyProblem, is_number
    from robot_ik.hardware.virtual.faults import FAULTS, Fault, joint_offset

    target, has_value, text = item.partition("=")
    kind, has_joint, name = target.partition(":")
    kind = kind.replace("-", "_")
    value = float(text) if is_number(text) else math.nan
    if has_value and not math.isfinite(value):
        raise OptionError("--fault", f"cannot read the value of {item!r}", FAULT_FORM)
    if kind not in FAULTS:
        raise OptionError("--fault", f"unknown fault {kind!r}", ", ".join(FAULTS))
    if has_joint and not FAULTS[kind].servo:
        raise OptionError("--fault", f"{kind} is a fault of the bus, not of {name!r}", kind)
    joint = config.joint(name) if has_joint else None
    try:
        if kind == "zero_offset" and joint is not None and has_value:
            return joint_offset(joint, value)
        id = None if joint is None else joint.servo.id
        return Fault(kind, id, value if has_value else None)
    except KeyProblem as error:
        raise OptionError("--fault", f"{item!r}: {error}", FAULT_FORM) from error


def _latency(milliseconds: float) -> tuple[Fault, ...]:
    from robot_ik.hardware.virtual.faults import Fault

    return (Fault("latency", value=milliseconds),) if milliseconds else ()


def _add_physics(config: ArmConfig, bus: VirtualBus) -> None:
    from robot_ik.hardware.virtual.world import World
    from robot_ik.robot import load_robot
    from robot_ik.robot_arm import robot_named_in

    World(load_robot(robot_named_in(config)).model, config, bus)


def _require_free(link: Path | None) -> None:
    if link is not None and link.is_symlink() and link.exists():  # clients would get other servos
        raise OptionError(
            "--link",
            f"{link} is the name of another port, {os.readlink(link)}",
            "a name that is free",
            hint="is another robot-ik sim-bus running? If not, remove the link",
        )


def _client(arm: str, config: ArmConfig) -> str:
    """Return a command for these servos: reach if the model is available, else monitor."""
    from robot_ik.hardware.virtual.bus import robot_of
    from robot_ik.robot_file import catalogue

    servos = f"--arm {shlex.quote(arm)}"
    if robot_of(config) is None:
        return f"robot-ik servo monitor {servos}"
    return f"robot-ik reach --robot {arm}" if arm in catalogue() else f"robot-ik reach {servos}"
