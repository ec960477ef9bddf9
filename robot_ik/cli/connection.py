"""The option ``--bus`` of all commands: names and help from the table of buses; which robot is meant."""

from __future__ import annotations

import math
import os
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import ArmName
from robot_ik.errors import (
    BusNotOpenError,
    HardwareError,
    RobotIkError,
    UnsafeCommandError,
)
from robot_ik.hardware import BUSES, bus_row
from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.bus import ServoBus
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.jobs.hand_guiding import Limits


NONE = "none"
"""Where a command can do without servos."""


def bus_argument(*, none: bool = False, default: str = "", text: str = "") -> Any:
    """Annotation of a field of type ``str``; ``none``: there may be no servos at all.

    ``default`` is what it says behind the help; empty: the field's own default.  ``text`` is the help where
    another option has explained the buses.
    """
    titles = {bus.name: bus.title for bus in BUSES.values()} | ({NONE: "no servos"} if none else {})
    hint = f"(default: {default})" if default else None
    explained = "; ".join(f"{name}: {title}" for name, title in titles.items())
    text = text or f"Where the servos are. {explained}."
    return arg(metavar="|".join(titles), help=text, help_behavior_hint=hint)


def resolved_robot(arm: Path | None, bus: str) -> str:
    """The robot where none is named: the arm's; at a port the one that servos move; else the shown one.

    Raises:
        UnknownRobotError, ConfigError: As ``ArmConfig.load``; or the arm file names no robot.
    """
    if arm:
        from robot_ik.jobs.robot_setup import robot_named_in

        return robot_named_in(load_arm(arm))
    return SHOWN_ROBOT if bus == NONE or bus_row(bus).virtual else SERVO_ROBOT


# ------------------------------------------------------------------------------------------
# What the subcommands of ``robot-ik servo`` share: which port, which arm, who is asked, how it ends.


_KEY_POLL = 0.05  # s


@dataclass(frozen=True, kw_only=True)
class BusOptions:
    """Where the servos are."""

    bus: Annotated[str, bus_argument(default="the only USB serial port")] = ""
    arm: ArmName = SERVO_ROBOT


def port_name(bus: str, option: str = "--bus") -> str:
    """The port meant: the one named with ``option``, else the only one there is.

    Raises:
        BusNotOpenError: None is named and there is none, or more than one.
    """
    if bus:
        return os.path.expanduser(bus)
    from robot_ik.hardware.ports import serial_ports

    ports = [str(port.device) for port in serial_ports()]
    if len(ports) == 1:
        return ports[0]
    found = f"{len(ports)} serial ports are there: {', '.join(ports)}" if ports else "there is no serial port"
    raise BusNotOpenError(
        f"which port are the servos on? {found}",
        hint=f"name one with {option} PORT; without servos: {option} pty"
        + ("" if ports else ", or plug one in"),
    )


@contextmanager
def served_or_serial_port(bus: str, arm: str) -> Iterator[str]:
    """A port by name; for simulated servos one that serves the arm's virtual servos at their rate."""
    name = port_name(bus)
    if not bus_row(name).virtual:
        yield name
        return
    from robot_ik.hardware import pty_port, simulated_servos
    from robot_ik.ports import RealClock

    with pty_port()(simulated_servos(load_arm(arm), RealClock()), match_baud=True) as port:
        yield port.path


def load_arm(name: str | Path) -> ArmConfig:
    """``ArmConfig.load``, which is imported when an arm is asked for and not before."""
    from robot_ik.hardware.config import ArmConfig

    return ArmConfig.load(name)


@contextmanager
def attempt() -> Iterator[None]:
    """What may fail on the way: an error of the hardware inside ends the command as "tried, not achieved"."""
    try:
        yield
    except UnsafeCommandError:
        raise
    except HardwareError as error:
        console.show_error(error)
        raise SystemExit(console.NOT_ACHIEVED) from error


def opened(options: BusOptions, config: ArmConfig) -> closing[ServoBus]:
    """The bus of these options, open; nothing is asked of any servo yet.  Raises ``BusNotOpenError``."""
    from robot_ik.hardware import open_bus

    return closing(open_bus(port_name(options.bus), config))


def arm_on(options: BusOptions, config: ArmConfig, on_exit: str = "") -> Arm:
    """The arm of these options, still disconnected.

    Raises:
        BusNotOpenError: No port is named and there is not exactly one.
        ConfigError: As ``require_model``.
    """
    from robot_ik.hardware import open_arm

    require_model(config)
    return open_arm(config, port_name(options.bus), on_exit=on_exit or None)


@contextmanager
def single_keys() -> Iterator[int | None]:
    """Standard input whose keys come one by one, without Enter; None where it is no terminal of ours."""
    try:
        import termios
        import tty

        file = sys.stdin.fileno()
        # A program in the shell's background may not touch the terminal.
        ours = sys.stdin.isatty() and os.tcgetpgrp(file) == os.getpgrp()
    except (ImportError, OSError, ValueError, AttributeError):  # no terminals here, or stdin is closed
        ours = False
    if not ours:
        yield None
        return
    before = termios.tcgetattr(file)
    try:
        tty.setcbreak(file)
        yield file
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)


@contextmanager
def stop_on_space(arm: Arm) -> Iterator[None]:
    """At a terminal the space bar makes the arm stop and hold, as ``robot-ik stop`` does from another one."""
    over = threading.Event()

    def listen(file: int) -> None:
        while not over.is_set():
            if select.select([file], [], [], _KEY_POLL)[0]:
                key = os.read(file, 1)
                if key == b" ":
                    arm.request_stop()
                elif not key:
                    return

    with single_keys() as file:
        if file is None:
            yield
            return
        console.say("space: stop and hold", "dim")
        listener = threading.Thread(target=listen, args=(file,), name="space", daemon=True)
        listener.start()
        try:
            yield
        finally:
            over.set()
            listener.join()


@contextmanager
def driving(arm: Arm, *, space: bool = True) -> Iterator[None]:
    """The arm connected, and left by its policy; says how it was left, also after a signal or an error.

    ``space``: as ``stop_on_space``.  Errors of the hardware inside are as in ``attempt``.
    """
    try:
        with arm, stop_on_space(arm) if space else nullcontext(), attempt():
            yield
    finally:
        if (left := arm.exit_report) is not None:  # it was connected
            console.say(left.text, "dim" if left.ok else "bold red")


def require_model(config: ArmConfig) -> None:
    """``check_model``, which asks for the model only where there is a calibration beside the arm file."""
    from robot_ik.hardware.calibration import check_model, own_calibration

    if own_calibration(config) is not None:
        check_model(config, model_limits(config))


def model_limits(config: ArmConfig) -> Limits:
    """Joint -> limits of the model, rad; the arm file's where the model is not at hand (then it says so)."""
    from robot_ik.robot import load_robot

    try:
        robot = load_robot(config.robot, joints=config.names)
    except RobotIkError as error:
        console.say(f"without the model ({error.args[0]}): limits are the arm file's", "yellow")
        return {joint.name: (joint.lower, joint.upper) for joint in config.joints}
    limits = zip(robot.lower.tolist(), robot.upper.tolist(), strict=True)
    found = dict(zip(robot.joints, limits, strict=True))
    return {
        j.name: found[j.name] if all(map(math.isfinite, found[j.name])) else (j.lower, j.upper)
        for j in config.joints
    }
