"""The option ``--bus`` of all commands, and how commands open a bus or an arm.

Commands that need joints as a robot open it by ``robot_ik.open_robot``.  The commands here need
servos and no robot, so they run on a machine without MuJoCo.  They open an arm by ``arm_on`` and a
bus by ``open_servo_bus``.  Both ways compare the model with the calibration.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import ArmName
from robot_ik.cli.terminal_keys import stop_on_space
from robot_ik.errors import BusNotOpenError, HardwareError, UnsafeCommandError
from robot_ik.hardware import BUSES, bus_row
from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig

NONE = "none"
"""Value of ``--bus`` for a command that can do without servos."""

ONLY_PORT = "the only USB serial port"
"""Default of ``--bus`` in the commands of servos, for help."""


def bus_argument(*, none: bool = False, default: str = "", text: str = "") -> Any:
    """Return the annotation of an option ``--bus`` of type ``str``.

    Args:
        none: The command can do without servos.
        default: Default for the help.  Empty: the field's own.
        text: Help, if another option has explained the buses.
    """
    titles = {bus.name: bus.title for bus in BUSES.values()}
    if none:
        titles[NONE] = "no servos"
    hint = f"(default: {default})" if default else None
    explained = "; ".join(f"{name}: {title}" for name, title in titles.items())
    text = text or f"Where the servos are. {explained}."
    return arg(metavar="|".join(titles), help=text, help_behavior_hint=hint)


def resolved_robot(arm: Path | None, bus: str) -> str:
    """Return the robot of a command line that names none.

    It is the robot of the arm file.  Without one it is the robot with servos at a port, and
    otherwise the robot that examples show.

    Raises:
        UnknownRobotError, ConfigError: As ``ArmConfig.load``; or the arm file names no robot.
    """
    if arm:
        from robot_ik.robot_arm import robot_named_in

        return robot_named_in(load_arm(arm))
    return SHOWN_ROBOT if bus == NONE or bus_row(bus).virtual else SERVO_ROBOT


@dataclass(frozen=True, kw_only=True)
class BusOptions:
    """Where the servos are."""

    bus: Annotated[str, bus_argument(default=ONLY_PORT)] = ""
    arm: ArmName = SERVO_ROBOT


def port_name(bus: str, option: str = "--bus") -> str:
    """Return the name of the bus: the one that was given, else the only serial port.

    Args:
        bus: Value of the option.
        option: Name of the option, for the error.

    Raises:
        BusNotOpenError: None was given, and there is no serial port or more than one.
    """
    if bus:
        return os.path.expanduser(bus)
    from robot_ik.hardware.ports import serial_ports

    ports = [str(port.device) for port in serial_ports()]
    if len(ports) == 1:
        return ports[0]
    found = "there is no serial port"
    hint = f"name one with {option} PORT; without servos: {option} pty"
    if ports:
        found = f"{len(ports)} serial ports are there: {', '.join(ports)}"
    else:
        hint += ", or plug one in"
    raise BusNotOpenError(f"which port are the servos on? {found}", hint=hint)


@contextmanager
def served_or_serial_port(bus: str, arm: str) -> Iterator[str]:
    """Yield the name of a serial port.

    For simulated servos it is a port that serves the virtual servos of the arm at their baud rate.

    Args:
        bus: Value of ``--bus``.
        arm: Value of ``--arm``.
    """
    name = port_name(bus)
    if not bus_row(name).virtual:
        yield name
        return
    from robot_ik.hardware import pty_port, simulated_servos
    from robot_ik.ports import RealClock

    with pty_port()(simulated_servos(load_arm(arm), RealClock()), match_baud=True) as port:
        yield port.path


def load_arm(name: str | Path) -> ArmConfig:
    """Return an arm file.  The module is imported here: it loads numpy, and help needs none."""
    from robot_ik.hardware.config import ArmConfig

    return ArmConfig.load(name)


@contextmanager
def attempt() -> Iterator[None]:
    """Report a hardware error inside and end the command with exit code 1, not achieved."""
    try:
        yield
    except UnsafeCommandError:
        raise
    except HardwareError as error:
        console.show_error(error)
        raise SystemExit(console.NOT_ACHIEVED) from error


def open_servo_bus(options: BusOptions, config: ArmConfig) -> closing[ServoBus]:
    """Return the open bus of a command.  No servo is asked anything yet.

    Raises:
        BusNotOpenError: It cannot be opened, or no port is named and there is not exactly one.
    """
    from robot_ik.hardware import open_bus

    return closing(open_bus(port_name(options.bus), config))


def arm_on(options: BusOptions, config: ArmConfig, on_exit: str = "") -> Arm:
    """Return the arm of a command, not connected yet.

    Args:
        options: Options of the command.
        config: Arm file, or some of its joints.
        on_exit: Exit policy.  Empty: as in the arm file.

    Raises:
        BusNotOpenError: No port is named and there is not exactly one.
        CalibrationMismatchError: The model is not the one of the calibration.
    """
    from robot_ik.hardware import open_arm

    return open_arm(config, port_name(options.bus), on_exit=on_exit or None)


@contextmanager
def driving(arm: Arm, *, space: bool = True) -> Iterator[None]:
    """Connect an arm, leave it by its policy, and say how it was left, also after an error.

    A hardware error inside ends the command as in ``attempt``.

    Args:
        arm: Arm.
        space: The space bar stops the arm.
    """
    try:
        with arm, stop_on_space(arm) if space else nullcontext(), attempt():
            yield
    finally:
        report = arm.exit_report
        if report is not None:  # the arm was connected
            console.say(report.text, "dim" if report.ok else "bold red")
