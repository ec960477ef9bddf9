"""Serial ports of this machine: names, adapters, users. None is opened."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from robot_ik.hardware.checks import NOTE, OK, CheckRow, named_users_of, permission_hint

NO_PORTS = ("sim", "pty")
"""Names of buses (``robot_ik.hardware.BUSES``) whose servos are simulated."""

BY_ID = Path("/dev/serial/by-id")
"""Folder in which Linux names ports by their adapters."""

USB_SERIAL = Path("/sys/bus/usb-serial/devices")
"""Folder in which Linux has the settings of USB adapters."""

_ONBOARD = ("ttyS", "ttyAMA", "Bluetooth", "debug-console", "wlan-debug")
"""Parts of names of ports on the machine's own board, which lead to no servo adapter."""


def serial_ports() -> list[Any]:
    """Return the serial ports that may lead to servos, as pyserial lists them."""
    from serial.tools import list_ports

    ports = [
        port for port in list_ports.comports() if not any(word in port.device for word in _ONBOARD)
    ]
    return sorted(ports, key=lambda port: (len(port.device), str(port.device)))  # COM3 before COM10


def port_row(port: Any) -> dict[str, Any]:
    """Return the properties of a port without opening it.

    Args:
        port: As pyserial lists it.

    Returns:
        ``port``: name to open. ``stable``: name that survives replugging, or empty. ``adapter``:
            description. ``usb``: vendor:product, hexadecimal. ``serial``: number of the adapter.
            ``latency_ms``: latency timer, None if the driver has none. ``used_by``: programs that
            have it open. ``status``: ok or note. ``do``: advice.
    """
    vendor = getattr(port, "vid", None)
    product = getattr(port, "pid", None)
    row = serial_row(port.device, port.description or "serial port", vendor)
    real = os.path.realpath(port.device)
    names = (str(name) for name in sorted(BY_ID.glob("*")) if os.path.realpath(name) == real)
    return {
        "port": port.device,
        "stable": next(names, ""),
        "adapter": port.description or "",
        "usb": f"{vendor:04x}:{product:04x}" if vendor is not None and product is not None else "",
        "serial": getattr(port, "serial_number", None) or "",
        "latency_ms": latency_ms(port.device),
        "used_by": named_users_of(port.device),
        "status": row.status,
        "do": row.do,
    }


def _latency_timer(path: str) -> Path:
    return USB_SERIAL / os.path.basename(os.path.realpath(path)) / "latency_timer"


def latency_ms(path: str) -> int | None:
    """Return the latency timer of a USB serial adapter in ms; None if the driver has none."""
    try:
        return int(_latency_timer(path).read_text())
    except (OSError, ValueError):
        return None


def quicker(path: str) -> str:
    """Return how to set the latency timer of an adapter to 1 ms."""
    timer = _latency_timer(path)
    return (
        f"echo 1 | sudo tee {timer}"
        if timer.exists()
        else "set the adapter's latency timer to 1 ms"
    )


_FTDI = 0x0403
"""USB vendor id. Most servo adapters have a chip of this vendor."""

_LATENCY_ADVICE = {
    "win32": "set it to 1 ms: Device Manager, Ports, this port, Port Settings, Advanced, "
    "Latency Timer",
    "darwin": "if cycles are slow: FTDI's own driver (VCP) lets the latency timer be set to 1 ms",
}
"""Platform on which a latency timer cannot be read -> advice."""


def serial_row(path: str, about: str, vendor: int | None = None) -> CheckRow:
    """Return the check of one serial port: permission, users, latency.

    Args:
        path: Name of the port.
        about: Description of the port.
        vendor: USB vendor of the adapter; None: unknown.
    """
    what = f"serial {path}"
    system = sys.platform
    # Windows has no files for ports: only opening one shows whether it may be used.
    if system != "win32" and not os.access(path, os.R_OK | os.W_OK):
        return CheckRow(what, NOTE, f"{about}; no permission", permission_hint(path))
    if advice := _LATENCY_ADVICE.get(system):
        if vendor != _FTDI:
            return CheckRow(what, OK, about)
        problem = f"{about}; its latency timer cannot be read; the default is 16 ms"
        return CheckRow(what, NOTE, problem, advice)
    users = named_users_of(path)
    if users:
        return CheckRow(
            what, NOTE, f"{about}; in use by {', '.join(users)}", "end that program first"
        )
    latency = latency_ms(path)
    if latency is not None and latency > 1:
        # 16 ms, the driver's default, holds six servos to about 57 cycles a second.
        return CheckRow(what, NOTE, f"{about}; answers {latency} ms late", quicker(path))
    return CheckRow(what, OK, about + ("; free" if system.startswith("linux") else ""))
