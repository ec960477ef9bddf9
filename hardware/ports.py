"""Serial ports of this machine: which are there, what is behind them, who uses them.  None is opened."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from robot_ik.hardware.checks import NOTE, OK, CheckRow, named_users_of, permission_hint

NO_PORTS = ("sim", "pty")
"""Names of buses (``robot_ik.hardware.BUSES``) whose servos are simulated."""

BY_ID = Path("/dev/serial/by-id")
"""Where Linux names ports by their adapters."""

USB_SERIAL = Path("/sys/bus/usb-serial/devices")
"""Where Linux has the settings of USB adapters."""

#: Ports that only a machine's own board has; no adapter of servos is behind them.
_ONBOARD = ("ttyS", "ttyAMA", "Bluetooth", "debug-console", "wlan-debug")


def serial_ports() -> list[Any]:
    """Serial ports of this machine behind which servos may be, as pyserial lists them."""
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if not any(word in port.device for word in _ONBOARD)]
    return sorted(ports, key=lambda port: (len(port.device), str(port.device)))  # COM3 before COM10


def port_row(port: Any) -> dict[str, Any]:
    """What is known of a port as pyserial lists it, without opening it.

    Returns:
        ``port``: name to open; ``stable``: a name that survives replugging, empty where there is none;
        ``adapter``: its description; ``usb``: vendor:product, hexadecimal; ``serial``: number of the adapter;
        ``latency_ms``: latency timer, None where the driver has none; ``used_by``: programs that
        have it open; ``status``: ok or note; ``do``: what to do about it.
    """
    vendor, product = getattr(port, "vid", None), getattr(port, "pid", None)
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
    """Latency timer of a USB serial adapter in ms, or ``None`` where the driver has none."""
    try:
        return int(_latency_timer(path).read_text())
    except (OSError, ValueError):
        return None


def quicker(path: str) -> str:
    """How an adapter is made to answer sooner: with a latency timer of 1 ms."""
    timer = _latency_timer(path)
    return f"echo 1 | sudo tee {timer}" if timer.exists() else "set the adapter's latency timer to 1 ms"


_FTDI = 0x0403  # USB vendor; most adapters of servos have such a chip

_LATENCY_ADVICE = {
    "win32": "set it to 1 ms: Device Manager, Ports, this one, Port Settings, Advanced, Latency Timer",
    "darwin": "where cycles are slow: FTDI's own driver (VCP) lets the latency timer be set to 1 ms",
}
"""Systems on which a latency timer cannot be read -> what to do about it."""


def serial_row(path: str, about: str, vendor: int | None = None) -> CheckRow:
    """One serial port: may it be used, is it in use, how late does it answer.

    ``about``: its description; ``vendor``: of the USB adapter, where known.
    """
    what, system = f"serial {path}", sys.platform
    # Windows has no files for ports: only opening one shows who may use it.
    if system != "win32" and not os.access(path, os.R_OK | os.W_OK):
        return CheckRow(what, NOTE, f"{about}; no permission", permission_hint(path))
    if advice := _LATENCY_ADVICE.get(system):
        late = vendor == _FTDI
        text = "; its latency timer cannot be read, as it comes it is 16 ms"
        return CheckRow(what, NOTE if late else OK, about + (text if late else ""), advice if late else "")
    users = named_users_of(path)
    if users:
        return CheckRow(what, NOTE, f"{about}; in use by {', '.join(users)}", "end that program first")
    latency = latency_ms(path)
    if latency is not None and latency > 1:
        # 16 ms, the driver's default, holds six servos to about 57 cycles a second.
        return CheckRow(what, NOTE, f"{about}; answers {latency} ms late", quicker(path))
    return CheckRow(what, OK, about + ("; free" if system.startswith("linux") else ""))
