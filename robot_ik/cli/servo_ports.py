"""``robot-ik servo ports``: serial ports, who made them, and what stands in the way of using them."""

from __future__ import annotations

import glob
import os
import sys
from dataclasses import asdict, dataclass
from typing import Any

from robot_ik.cli import console
from robot_ik.cli.device_checks import latency_ms, serial_row, users_of

BY_ID = "/dev/serial/by-id"


@dataclass(frozen=True)
class PortsOptions:
    """Lists serial ports: which adapter, how late it answers, who uses it. Opens none of them.

    Exit code 1 when there is no port at all.
    """

    json: bool = False
    """Print one JSON object instead of a table."""


@dataclass(frozen=True)
class PortRow:
    """One serial port.

    Attributes:
        port: Name to open; ``stable``: a name that survives replugging, empty where there is none.
        adapter: Its description; ``usb``: vendor:product, hexadecimal; ``serial``: number of the adapter.
        latency_ms: Latency timer, None where the driver has none; ``used_by``: programs that have it open.
        status: ok or note; ``do``: what to do about it.
    """

    port: str
    stable: str
    adapter: str
    usb: str
    serial: str
    latency_ms: int | None
    used_by: list[str]
    status: str
    do: str


def run_ports(options: PortsOptions) -> int:
    """Prints the ports; 1 when there is none."""
    from robot_ik.cli.servo_link import serial_ports

    rows = [port_row(port) for port in serial_ports()]
    if options.json:
        console.print_json({"schema": 1, "ports": [asdict(row) for row in rows]})
    elif rows:
        shown = console.table("port", "adapter", "USB", "latency", "state", "what to do")
        for row in rows:
            late = "-" if row.latency_ms is None else f"{row.latency_ms} ms"
            state = f"used by {', '.join(row.used_by)}" if row.used_by else row.status
            shown.add_row(row.stable or row.port, row.adapter, row.usb or "-", late, state, row.do)
        console.out().print(shown)
    else:
        console.say("error: there is no USB serial port on this machine", "bold red")
        console.say("plug the adapter in; without servos: robot-ik sim-bus --link PATH", "cyan")
    return console.DONE if rows else console.NOT_ACHIEVED


def port_row(port: Any, sys_root: str = "/sys", system: str = sys.platform) -> PortRow:
    """What is known of a port as pyserial lists it, without opening it; ``system``: as ``sys.platform``."""
    vendor, product = getattr(port, "vid", None), getattr(port, "pid", None)
    about = port.description or "serial port"
    row = serial_row(port.device, about, sys_root=sys_root, system=system, vendor=vendor)
    return PortRow(
        port.device,
        stable_name(port.device),
        port.description or "",
        f"{vendor:04x}:{product:04x}" if vendor is not None and product is not None else "",
        getattr(port, "serial_number", None) or "",
        latency_ms(port.device, sys_root),
        users_of(port.device),
        row.status,
        row.do,
    )


def stable_name(device: str, folder: str = BY_ID) -> str:
    """The name by adapter that leads to ``device``; empty where the system keeps none."""
    real = os.path.realpath(device)
    return next((name for name in sorted(glob.glob(f"{folder}/*")) if os.path.realpath(name) == real), "")
