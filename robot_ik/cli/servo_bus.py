"""``robot-ik servo ports``, ``scan``, ``setup``, ``backup``, ``restore`` and ``monitor``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.live import Live
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import Json, Overwrite, Range, positive, require, several, single
from robot_ik.cli.connection import BusOptions, load_arm, open_servo_bus, served_or_serial_port
from robot_ik.jobs.results import claimed

if TYPE_CHECKING:
    from robot_ik.hardware.discovery import FoundServo
    from robot_ik.hardware.health import ServoState


@dataclass(frozen=True)
class ServoPortsOptions:
    """Lists serial ports: adapter, latency, and programs that use them. Opens none of them.

    Exit code 1 if there is no port at all.
    """

    json: Json = False


def run_ports(options: ServoPortsOptions) -> int:
    """Print the ports; 1 if there is none."""
    from robot_ik.hardware.ports import port_row, serial_ports

    rows = [port_row(port) for port in serial_ports()]
    if options.json:
        console.print_json({"schema": 1, "ports": rows})
    elif rows:
        cells = []
        for row in rows:
            latency = "-" if row["latency_ms"] is None else f"{row['latency_ms']} ms"
            state = f"used by {', '.join(row['used_by'])}" if row["used_by"] else row["status"]
            name = row["stable"] or row["port"]
            cells.append((name, row["adapter"], row["usb"] or "-", latency, state, row["do"]))
        columns = ("port", "adapter", "USB", "latency", "state", "what to do")
        console.show(console.table(*columns, rows=cells))
    else:
        console.refused(
            "there is no USB serial port on this machine",
            "plug the adapter in; without servos: robot-ik sim-bus --link PATH",
        )
    return console.DONE if rows else console.NOT_ACHIEVED


def checked_rates(rates: Sequence[int]) -> tuple[int, ...]:
    """Return the rates of a command line, each once.

    Raises:
        ConfigError: No servo has such a rate.
    """
    from robot_ik.hardware.models import BAUD_RATES

    allowed = ", ".join(map(str, BAUD_RATES))
    for rate in rates:
        require(rate in BAUD_RATES, "--baud", f"no servo talks at {rate} bits/s", allowed)
    return tuple(dict.fromkeys(rates))


def print_found(servos: Sequence[FoundServo]) -> None:
    """Print a table of servos on stdout."""
    columns = ("baud", "id", "model", "firmware", "supply", "temp", "delay", "torque", "errors")
    rows = [
        (
            servo.baud,
            servo.id,
            servo.model,
            _number(servo.firmware, "", 0, "?"),
            _number(servo.voltage, " V", 1, "?"),
            _number(servo.temperature, " C", 0, "?"),
            _number(servo.return_delay, " us", 0, "?"),
            _on_off(servo.torque, "?"),
            _errors(servo),
        )
        for servo in servos
    ]
    console.show(console.table(*columns, rows=rows))


def _errors(servo: FoundServo) -> str:
    """Return the last cell of a servo's row."""
    if servo.shared:
        return "damaged replies"
    pings_only = servo.torque is None and servo.voltage is None
    return ", ".join(servo.errors) or ("answers pings only" if pings_only else "none")


@dataclass(frozen=True)
class ServoSetupOptions(BusOptions):
    """Gives one servo its id and baud rate. Exactly one servo may be connected, at any rate.

        robot-ik servo setup --joint joint3    (id and rate of the arm file)
        robot-ik servo setup --id 3 --baud 1000000

    Written to EEPROM with torque off, and read back under the new address. Return delay becomes 0.
    """

    joint: Annotated[str, single("JOINT")] = ""
    """Joint of the arm file that this servo is for: its id, rate and model. Or --id."""
    id: Annotated[int | None, single("N")] = None
    """New id, 0 to 252. Or --joint."""
    baud: Annotated[int | None, single("RATE", "the arm file's")] = None
    """New rate, bits/s."""
    from_baud: Annotated[tuple[int, ...], several("RATE", "all rates")] = ()
    """Look for the servo at these rates only."""


def run_setup(options: ServoSetupOptions) -> int:
    """Find the servo, write its address, and read it back."""
    from robot_ik.hardware.discovery import LIKELY, no_reply_hint
    from robot_ik.hardware.servo_setup import set_up

    is_named_once = (options.id is None) != (not options.joint)
    require(is_named_once, "--id", "the servo is not named", "either --id N or --joint JOINT")
    config = load_arm(options.arm)
    joint = config.joint(options.joint) if options.joint else None
    id = joint.servo.id if joint else options.id
    if id is None:
        raise RuntimeError("neither --id nor --joint is given")
    bauds = checked_rates(options.from_baud) or LIKELY
    (baud,) = checked_rates([config.baud if options.baud is None else options.baud])
    model = joint.servo.model if joint else ""
    with served_or_serial_port(options.bus, options.arm) as port, console.progress() as bar:
        progress = console.shares_on(bar, "scan")
        servo = set_up(port, id, baud, model=model, bauds=bauds, progress=progress)
    if servo is None:
        return console.refused(f"no servo answers on {port}", no_reply_hint(bauds))
    print_found([servo])
    change = f"id {servo.id} -> {id}, {servo.baud} -> {baud} baud"
    console.result(f"{change}, return delay 0: read back, done")
    return console.DONE


@dataclass(frozen=True)
class ServoBackupOptions(BusOptions):
    """Saves the control table of every servo of the arm as JSON. Writes nothing to any servo."""

    file: Positional[Annotated[Path, arg(metavar="FILE.json")]]
    """File to write."""
    overwrite: Overwrite = False


def run_backup(options: ServoBackupOptions) -> int:
    """Read all registers and write the file."""
    from robot_ik.hardware.backup import read_tables, save_backup

    with claimed(options.file, overwrite=options.overwrite):
        config = load_arm(options.arm)
        with open_servo_bus(options, config) as bus:
            servos = read_tables(bus, config)
        save_backup(options.file, config.name, servos)
    count = sum(len(servo.registers) for servo in servos)
    console.result(f"{options.file}: {len(servos)} servos, {count} registers")
    return console.DONE


@dataclass(frozen=True)
class ServoRestoreOptions(BusOptions):
    """Restores the EEPROM of servos from a backup: modes, limits, offsets, shutdown.

    Needs torque off. Only what differs is written, and read back. Ids, baud rates and RAM stay.
    Another model than the file's is refused.
    """

    file: Positional[Annotated[Path, arg(metavar="FILE.json")]]
    """A file of backup."""
    joints: Positional[Annotated[tuple[str, ...], several("JOINT")]] = ()
    """Only these joints of the file; all if none is named."""
    dry_run: bool = False
    """Only show what differs."""


def run_restore(options: ServoRestoreOptions) -> int:
    """Write what differs, and show it."""
    from robot_ik.hardware.backup import differences, load_backup, restore

    servos = load_backup(options.file)
    known = tuple(servo.joint for servo in servos)
    for name in options.joints:
        require(name in known, "JOINT", f"{name!r} is not in {options.file}", ", ".join(known))
    if options.joints:
        servos = [servo for servo in servos if servo.joint in options.joints]
    with open_servo_bus(options, load_arm(options.arm)) as bus:
        changes = differences(bus, servos) if options.dry_run else restore(bus, servos)
    if not changes:
        console.show("nothing differs")
        return console.DONE
    after = "would become" if options.dry_run else "is now"
    rows = [(row.joint, row.id, row.register, row.present, row.saved) for row in changes]
    console.show(console.table("joint", "id", "register", "was", after, rows=rows))
    return console.DONE


@dataclass(frozen=True)
class ServoMonitorOptions(BusOptions):
    """Watches the servos: position, velocity, current, voltage, temperature, torque, errors.

    Moves nothing. Runs until Ctrl-C, or --count samples. Exit code 1 if a servo did not answer in
    the last one.
    """

    rate: Annotated[float, arg(metavar="HZ"), positive(200.0, " Hz")] = 10.0
    """Samples a second, at most 200."""
    count: Annotated[int | None, single("N", "until Ctrl-C"), Range(1, what=" samples")] = None
    """End after so many samples."""
    json: bool = False
    """Print one JSON object a line for each sample."""


def run_monitor(options: ServoMonitorOptions) -> int:
    """Print samples; 1 if a servo did not answer in the last one."""
    from robot_ik.hardware.health import read_states

    config = load_arm(options.arm)
    with open_servo_bus(options, config) as bus, ExitStack() as stack:
        begin = bus.clock.now()
        screen = console.out()
        live = None
        if screen.is_terminal and not options.json:
            live = stack.enter_context(Live(console=screen, auto_refresh=False))
        due = begin
        for k in itertools.count(1):
            states = read_states(bus, config.drives)
            if options.json:
                passed = round(bus.clock.now() - begin, 6)
                servos = [asdict(state) for state in states]
                console.print_json_line({"time": passed, "servos": servos})
            elif live is None:
                screen.print(states_table(states))
            else:
                live.update(states_table(states), refresh=True)
            if k == options.count:
                break
            due = max(due + 1.0 / options.rate, bus.clock.now())
            bus.clock.sleep_until(due)
    return console.DONE if all(state.answered for state in states) else console.NOT_ACHIEVED


def states_table(states: Sequence[ServoState]) -> Table:
    """Return one sample as a table."""
    columns = (
        "joint",
        "id",
        "position",
        "velocity",
        "current",
        "supply",
        "temp",
        "torque",
        "errors",
    )
    return console.table(*columns, rows=[_state_row(state) for state in states])


def _state_row(state: ServoState) -> tuple[object, ...]:
    """Return one servo of a sample."""
    if state.position_mm is not None or state.velocity_mm is not None:  # a slide
        position = _number(state.position_mm, " mm", 2)
        velocity = _number(state.velocity_mm, " mm/s", 1)
    else:
        position = _number(state.position_deg, "°", 2)
        velocity = _number(state.velocity_deg, " °/s", 1)
    effort = _number(state.current_ma, " mA", 0)
    if state.load_percent is not None:
        effort = _number(state.load_percent, " % load", 0)
    errors = ", ".join(state.errors) or ("none" if state.answered else "no answer")
    style = "bold red" if state.errors or not state.answered else "green"
    return (
        state.joint,
        state.id,
        position,
        velocity,
        effort,
        _number(state.voltage, " V", 1),
        _number(state.temperature, " C", 0),
        _on_off(state.torque),
        Text(errors, style=style),
    )


def _on_off(torque: bool | None, unknown: str = "-") -> str:
    """Return a cell about torque."""
    if torque is None:
        return unknown
    return "ON" if torque else "off"


def _number(value: float | None, unit: str, digits: int, unknown: str = "-") -> str:
    """Return a cell with a number and its unit."""
    return unknown if value is None else f"{value:z.{digits}f}{unit}"
