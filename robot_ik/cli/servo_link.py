"""What the subcommands of ``robot-ik servo`` share: which port, which arm, who is asked, how it ends."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from robot_ik.catalogue import SERVO_ROBOT
from robot_ik.cli import console
from robot_ik.errors import BusNotOpenError, ConfigError, HardwareError, UnsafeCommandError

if TYPE_CHECKING:
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.control_table import ControlTable

#: Ports that only a machine's own board has; no adapter of servos is behind them.
_ONBOARD = ("ttyS", "ttyAMA", "Bluetooth")


@dataclass(frozen=True)
class BusOptions:
    """Where the servos are."""

    bus: Annotated[
        str, arg(metavar="PORT|pty|sim", help_behavior_hint="(default: the only USB serial port)")
    ] = ""
    """Serial port of the servos; pty and sim: virtual ones."""
    arm: Annotated[str, arg(metavar="FILE|NAME")] = SERVO_ROBOT
    """Arm file (TOML), or a robot of the catalogue that has one."""


@dataclass(frozen=True)
class ServoAt:
    """One servo that a command speaks to."""

    name: str
    id: int
    table: ControlTable


def serial_ports() -> list[Any]:
    """Serial ports of this machine behind which servos may be, as pyserial lists them."""
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if not any(word in port.device for word in _ONBOARD)]
    return sorted(ports, key=lambda port: str(port.device))


def port_name(bus: str) -> str:
    """The port meant: the one named, else the only one there is.

    Raises:
        BusNotOpenError: None is named and there is none, or more than one.
    """
    if bus:
        return os.path.expanduser(bus)
    ports = [str(port.device) for port in serial_ports()]
    if len(ports) == 1:
        return ports[0]
    found = f"{len(ports)} serial ports are there: {', '.join(ports)}" if ports else "there is no serial port"
    raise BusNotOpenError(
        f"which port are the servos on? {found}",
        hint="name one with --bus PORT; without servos: --bus pty" + ("" if ports else ", or plug one in"),
    )


@contextmanager
def served_or_real(bus: str, arm: str) -> Iterator[str]:
    """A port by name; for ``pty`` and ``sim`` one that serves the arm's virtual servos at their rate."""
    name = port_name(bus)
    if name not in ("pty", "sim"):
        yield name
        return
    from robot_ik.cli.sim_bus import load_arm
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.pty import PtyPort
    from robot_ik.ports import RealClock

    with PtyPort(VirtualBus.from_config(load_arm(arm), RealClock()), match_baud=True) as port:
        yield port.path


def wrong(key: str, problem: str, allowed: str, hint: str = "") -> ConfigError:
    """A wrong option."""
    return ConfigError(problem, file="command line", key=key, allowed=allowed, hint=hint)


def tried(action: Callable[[], int]) -> int:
    """Runs what may fail on the way: an error of the hardware then means "tried, not achieved"."""
    try:
        return action()
    except UnsafeCommandError:
        raise
    except HardwareError as error:
        console.show_error(error)
        return console.NOT_ACHIEVED


def chosen(config: ArmConfig, names: Sequence[str]) -> list[ServoAt]:
    """The servos of these joints, or of all; a joint that two servos turn gives both.

    Raises:
        UnknownJointError: No such joint; close ones are named.
    """
    wanted = {config.joint(name).name for name in names} or set(config.names)
    return [ServoAt(s.name, s.id, s.table) for s in config.servos if s.name in wanted]


@contextmanager
def opened(options: BusOptions) -> Iterator[tuple[ServoBus, ArmConfig]]:
    """The bus, open, and the arm file; nothing is asked of any servo yet.

    Raises:
        BusNotOpenError, ConfigError, UnknownRobotError.
    """
    from robot_ik.cli.sim_bus import load_arm
    from robot_ik.hardware import open_bus

    config = load_arm(options.arm)
    bus = open_bus(port_name(options.bus), config)
    try:
        yield bus, config
    finally:
        bus.close()
