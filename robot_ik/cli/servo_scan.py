"""``robot-ik servo scan``: who is on the wire, at every rate and under every id."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.servo_link import BusOptions, served_or_real

if TYPE_CHECKING:
    from robot_ik.hardware.scan import FoundServo


@dataclass(frozen=True)
class ScanOptions(BusOptions):
    """Asks at every baud rate which servos are there: id, model, firmware, supply, errors. Writes nothing.

    Takes 11 seconds for all rates; finds ids that two servos share. Exit code 1 when nobody answers.
    """

    baud: Annotated[tuple[int, ...], arg(metavar="RATE …", help_behavior_hint="(default: all rates)")] = ()
    """Only these rates, bits/s."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run_scan(options: ScanOptions) -> int:
    """Prints who answers; 1 when nobody does."""
    from robot_ik.hardware.scan import LIKELY, nobody_hint

    bauds = checked_rates(options.baud) or LIKELY
    with served_or_real(options.bus, options.arm) as port:
        found = scanned(port, bauds)
    if options.json:
        rows = [{"model": servo.model, **asdict(servo)} for servo in found]
        console.print_json({"schema": 1, "port": port, "bauds": list(bauds), "servos": rows})
    elif found:
        print_found(found)
    if not found:
        console.say(f"error: no servo answers on {port}", "bold red")
        console.say(nobody_hint(bauds), "cyan")
    for note in _notes(found):
        console.say(note, "yellow")
    return console.DONE if found else console.NOT_ACHIEVED


def _notes(found: Sequence[FoundServo]) -> list[str]:
    """What is wrong with all of them together."""
    if len(found) > 1 and all(servo.shared for servo in found):
        return ["every answer is damaged: check the cable, its contacts and the adapter"]
    notes = [
        f"id {servo.id} at {servo.baud}: damaged answers. Two servos with this id? Connect one alone "
        "and give it another: robot-ik servo setup --id N"
        for servo in found
        if servo.shared
    ]
    rates: dict[int, list[str]] = {}
    for servo in found:
        rates.setdefault(servo.baud, []).append(str(servo.id))
    if len(rates) > 1:
        listed = "; ".join(f"{baud}: id {', '.join(ids)}" for baud, ids in rates.items())
        notes.append(
            f"they talk at different rates ({listed}). "
            "Connect one alone: robot-ik servo setup --id N --baud RATE"
        )
    return notes


def checked_rates(rates: Sequence[int]) -> tuple[int, ...]:
    """Rates from the command line.

    Raises:
        ConfigError: One that no servo has.
    """
    from robot_ik.hardware.control_table import BAUD_RATES

    for rate in rates:
        if rate not in BAUD_RATES.values():
            allowed = ", ".join(map(str, BAUD_RATES.values()))
            raise wrong("--baud", f"no servo talks at {rate} bits/s", allowed)
    return tuple(dict.fromkeys(rates))


def scanned(port: str, bauds: Sequence[int]) -> list[FoundServo]:
    """``scan`` with a progress bar."""
    from robot_ik.hardware.scan import scan

    with console.progress() as bar:
        task = bar.add_task("scan", total=1.0, note="")
        return scan(port, bauds, progress=lambda what, share: bar.update(task, completed=share, note=what))


def _state(servo: FoundServo) -> str:
    if servo.shared:
        return "damaged answers"
    pings_only = servo.torque is None and servo.voltage is None
    return ", ".join(servo.errors) or ("answers pings only" if pings_only else "none")


def print_found(found: Sequence[FoundServo]) -> None:
    """The table of servos on stdout."""
    names = ("baud", "id", "model", "firmware", "supply", "temp", "delay", "torque", "errors")
    shown = console.table(*names)
    for s in found:
        shown.add_row(
            str(s.baud),
            str(s.id),
            s.model,
            "?" if s.firmware is None else str(s.firmware),
            "?" if s.voltage is None else f"{s.voltage:.1f} V",
            "?" if s.temperature is None else f"{s.temperature} C",
            "?" if s.return_delay is None else f"{s.return_delay} us",
            "?" if s.torque is None else ("ON" if s.torque else "off"),
            Text(_state(s)),
        )
    console.out().print(shown)
