"""``robot-ik servo scan``: list the servos on a bus."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import open_port
from robot_ik.commands.options import BusOptions, JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import HardwareError, OptionError, RobotIkError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.hardware.discovery import FoundServo

COLUMNS = ("baud", "id", "model", "firmware", "supply", "temp", "delay", "torque", "errors")
"""Columns of the table of servos."""


@dataclass(frozen=True, kw_only=True)
class ServoScan(BusOptions, JsonOption):
    """List the servos on a bus: id, model, firmware, supply and errors. Writes nothing.

    All baud rates take 11 seconds. Ids that two servos share are reported.

        robot-ik servo scan --bus /dev/ttyUSB0 --baud 57600 1000000

    Exit code 1: no servo answers.
    """

    baud: Annotated[
        tuple[int, ...],
        Parameter(metavar="RATE …", consume_multiple=True, allow_repeating=True),
    ] = ()
    """Baud rate of servos, in bits/s. Default: all are tried."""

    def run(self, terminal: Terminal = QUIET) -> ServoScanReport:
        """Ping all ids at each baud rate."""
        from robot_ik.hardware.discovery import LIKELY, scan  # NumPy and pydantic

        bauds = checked_bauds("--baud", self.baud) or tuple(LIKELY)
        with open_port(self.bus, self.arm) as port:
            servos = scan(port, bauds, progress=terminal.progress)
        return ServoScanReport(port, bauds, servos)


@dataclass(frozen=True, eq=False)
class ServoScanReport(Report):
    """The servos that answered on a port."""

    port: str
    bauds: tuple[int, ...]
    servos: Sequence[FoundServo]

    @property
    def ok(self) -> bool:
        return bool(self.servos)

    @property
    def failure(self) -> RobotIkError | None:
        from robot_ik.hardware.discovery import no_reply_hint

        if self.servos:
            return None
        return HardwareError(f"no servo answers on {self.port}", hint=no_reply_hint(self.bauds))

    @property
    def notes(self) -> list[str]:
        from robot_ik.hardware.discovery import scan_notes

        return list(scan_notes(self.servos))

    def tables(self) -> Iterable[Table]:
        if self.servos:
            yield servo_table(self.servos)

    def facts(self) -> dict[str, Any]:
        servos = [servo_facts(servo) for servo in self.servos]
        return {"port": self.port, "bauds": list(self.bauds), "servos": servos}


def servo_facts(servo: FoundServo) -> dict[str, Any]:
    """Return the values of a servo for programs."""
    return {"model": servo.model, **asdict(servo)}


def servo_table(servos: Iterable[FoundServo]) -> Table:
    """Return a table of servos that answered."""
    return table(*COLUMNS, rows=map(_row, servos))


def checked_bauds(option: str, bauds: Iterable[int]) -> tuple[int, ...]:
    """Return the baud rates without repetition.

    Raises:
        OptionError: No servo has such a rate.
    """
    from robot_ik.hardware.models import BAUD_RATES

    for baud in bauds:
        if baud not in BAUD_RATES:
            allowed = ", ".join(map(str, BAUD_RATES))
            raise OptionError(option, f"no servo has {baud} bits/s", allowed)
    return tuple(dict.fromkeys(bauds))


def _row(servo: FoundServo) -> tuple[object, ...]:
    return (
        servo.baud,
        servo.id,
        servo.model,
        _number(servo.firmware, "", 0),
        _number(servo.voltage, " V", 1),
        _number(servo.temperature, " C", 0),
        _number(servo.return_delay, " us", 0),
        "?" if servo.torque is None else "ON" if servo.torque else "off",
        _state(servo),
    )


def _state(servo: FoundServo) -> str:
    if servo.shared:
        return "damaged replies"
    if servo.errors:
        return ", ".join(servo.errors)
    return "answers pings only" if servo.torque is None and servo.voltage is None else "none"


def _number(value: float | None, unit: str, digits: int) -> str:
    return "?" if value is None else f"{value:z.{digits}f}{unit}"
