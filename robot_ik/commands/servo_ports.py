"""``robot-ik servo ports``: list the serial ports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from robot_ik.commands.options import JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import HardwareError, RobotIkError

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = ("port", "adapter", "USB", "latency", "state", "what to do")
"""Columns of the table of ports."""


@dataclass(frozen=True, kw_only=True)
class ServoPorts(JsonOption):
    """List serial ports with their adapters, latency and the programs that use them. Opens none.

    Exit code 1: there is no port.
    """

    def run(self, terminal: Terminal = QUIET) -> ServoPortsReport:  # noqa: ARG002
        """List the ports."""
        from robot_ik.hardware.ports import port_row, serial_ports  # pyserial

        return ServoPortsReport([port_row(port) for port in serial_ports()])


@dataclass(frozen=True, eq=False)
class ServoPortsReport(Report):
    """The serial ports of this machine.

    Attributes:
        ports: One row for each port, as ``hardware.ports.port_row`` returns it.
    """

    ports: Sequence[Mapping[str, Any]]

    @property
    def ok(self) -> bool:
        return bool(self.ports)

    @property
    def failure(self) -> RobotIkError | None:
        if self.ports:
            return None
        return HardwareError(
            "there is no USB serial port on this machine",
            hint="plug the adapter in; without servos: robot-ik sim-bus --link PATH",
        )

    def tables(self) -> Iterable[Table]:
        if self.ports:
            yield table(*COLUMNS, rows=map(_row, self.ports))

    def facts(self) -> dict[str, Any]:
        return {"ports": list(self.ports)}


def _row(port: Mapping[str, Any]) -> tuple[object, ...]:
    latency = "-" if port["latency_ms"] is None else f"{port['latency_ms']} ms"
    state = f"used by {', '.join(port['used_by'])}" if port["used_by"] else port["status"]
    name = port["stable"] or port["port"]
    return name, port["adapter"], port["usb"] or "-", latency, state, port["do"]
