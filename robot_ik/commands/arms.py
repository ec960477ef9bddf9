"""Functions of all commands with servos: selection of port and arm, and the exit of the arm."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from robot_ik.commands.options import NO_BUS
from robot_ik.commands.terminal import Report, Terminal
from robot_ik.errors import BusNotOpenError, HardwareError, RobotIkError, UnsafeCommandError
from robot_ik.hardware import bus_row

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig

# NumPy and pydantic take 0.2 s of CPU time to import. --help does without them.

KEY_POLL_SECONDS = 0.05
"""s between two checks of the keyboard."""


@dataclass(eq=False)
class ServoReport(Report):
    """Base of the reports of commands that drive servos.

    Attributes:
        error: Error of the servos that ended the run. ``driving`` sets it.
    """

    error: RobotIkError | None = field(default=None, init=False)

    @property
    def ok(self) -> bool:
        """Whether no error ended the run."""
        return self.error is None

    @property
    def failure(self) -> RobotIkError | None:
        """Error of the servos."""
        return self.error


def load_arm(name: str | Path) -> ArmConfig:
    """Load an arm file, or that of a robot. Errors as ``ArmConfig.load``."""
    from robot_ik.hardware.config import ArmConfig

    return ArmConfig.load(name)


def port_name(bus: str, option: str = "--bus") -> str:
    """Return the port of a bus option. Without a value it is the only USB serial port.

    Args:
        bus: Value of the option.
        option: Name of the option, for the error.

    Raises:
        BusNotOpenError: No port is named, and there is none or more than one.
    """
    if bus:
        return os.path.expanduser(bus)
    from robot_ik.hardware.ports import serial_ports  # pyserial

    ports = [str(port.device) for port in serial_ports()]
    if len(ports) == 1:
        return ports[0]
    if ports:
        raise BusNotOpenError(
            f"{option} is required: there are {len(ports)} serial ports ({', '.join(ports)})",
            hint=f"name one with {option} PORT; without servos: {option} pty",
        )
    raise BusNotOpenError(
        f"{option} is required: there is no USB serial port",
        hint=f"plug the adapter in, or use simulated servos: {option} pty",
    )


@contextlib.contextmanager
def open_port(bus: str, arm: str) -> Iterator[str]:
    """Yield the name of a serial port. Simulated servos are served on a port of their own."""
    name = port_name(bus)
    if not bus_row(name).virtual:
        yield name
        return
    from robot_ik.hardware import pty_port, simulated_servos
    from robot_ik.ports import RealClock

    with pty_port()(simulated_servos(load_arm(arm), RealClock()), match_baud=True) as port:
        yield port.path


def open_servo_bus(bus: str, config: ArmConfig) -> closing[ServoBus]:
    """Return the open bus of an arm, as a context manager. Nothing is sent to any servo yet.

    Raises:
        BusNotOpenError: As ``port_name``, or the port cannot be opened.
    """
    from robot_ik.hardware import open_bus

    return closing(open_bus(port_name(bus), config))


def open_arm_on(bus: str, config: ArmConfig, on_exit: str | None) -> Arm:
    """Return the arm on a bus, not connected yet.

    Raises:
        BusNotOpenError: As ``port_name``.
        CalibrationMismatchError: The model is not the one of the arm's calibration.
    """
    from robot_ik.hardware import open_arm

    return open_arm(config, port_name(bus), on_exit=on_exit)


@contextlib.contextmanager
def keeping_error(report: ServoReport) -> Iterator[None]:
    """Make an error of connected servos the report's error, which is exit code 1.

    ``UnsafeCommandError`` is raised, because the input is wrong.
    """
    try:
        yield
    except UnsafeCommandError:
        raise
    except HardwareError as error:
        report.error = error


@contextlib.contextmanager
def driving(
    arm: Arm, report: ServoReport, terminal: Terminal, *, space: bool = True
) -> Iterator[None]:
    """Connect an arm, and leave it by its exit policy, also after a signal or an error.

    An error of the connected servos becomes the report's error (exit code 1). Errors before the
    connection are raised (exit code 2).

    Args:
        arm: Arm.
        report: Report of the command.
        terminal: Shows how the arm was left.
        space: Whether the space bar stops the arm.
    """
    stopping = stop_on_space(arm, terminal) if space else contextlib.nullcontext()
    try:
        with arm, stopping, keeping_error(report):
            yield
    finally:
        exit_report = arm.exit_report
        if exit_report is not None:  # the arm was connected
            terminal.say(exit_report.text, "dim" if exit_report.ok else "bold red")


@contextlib.contextmanager
def stop_on_space(arm: Arm, terminal: Terminal) -> Iterator[None]:
    """Stop and hold the arm when the space bar is pressed at a terminal."""
    finished = threading.Event()

    def listen(file: int) -> None:
        while not finished.is_set():
            if not select.select([file], [], [], KEY_POLL_SECONDS)[0]:
                continue
            key = os.read(file, 1)
            if key == b" ":
                arm.request_stop()
            elif not key:
                return

    with single_keys() as file:
        if file is None:
            yield
            return
        terminal.say("space: stop and hold", "dim")
        listener = threading.Thread(target=listen, args=(file,), name="space", daemon=True)
        listener.start()
        try:
            yield
        finally:
            finished.set()
            listener.join()


@contextlib.contextmanager
def single_keys() -> Iterator[int | None]:
    """Yield standard input with keys one by one, without Enter. None if it is no terminal."""
    try:
        import termios  # missing on Windows
        import tty

        file = sys.stdin.fileno()
        # A program in the background of a shell must not touch the terminal.
        foreground = sys.stdin.isatty() and os.tcgetpgrp(file) == os.getpgrp()
    except (ImportError, OSError, ValueError, AttributeError):  # no terminals, or stdin is closed
        foreground = False
    if not foreground:
        yield None
        return
    before = termios.tcgetattr(file)
    try:
        tty.setcbreak(file)
        yield file
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)


def default_robot(arm: str | Path | None, bus: str) -> str:
    """Return the robot of the arm file. Without one: a robot whose servos exist on that bus.

    Raises:
        UnknownRobotError, ConfigError: As ``ArmConfig.load``, or the arm file names no robot.
    """
    from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT  # pydantic

    if arm:
        from robot_ik.robot_arm import robot_named_in

        return robot_named_in(load_arm(arm))
    return SHOWN_ROBOT if bus == NO_BUS or bus_row(bus).virtual else SERVO_ROBOT
