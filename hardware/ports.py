"""Serial ports of this machine: which are there, what is behind them, who uses them.  None is opened."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_ik.environment import NOTE, OK, CheckRow, named_users_of, permission_hint

BY_ID = "/dev/serial/by-id"
"""Where Linux names ports by their adapters."""

#: Ports that only a machine's own board has; no adapter of servos is behind them.
_ONBOARD = ("ttyS", "ttyAMA", "Bluetooth", "debug-console", "wlan-debug")


def serial_ports(listed: Iterable[Any] | None = None) -> list[Any]:
    """Serial ports of this machine behind which servos may be; ``listed``: by pyserial, asked if None."""
    from serial.tools import list_ports

    found = list_ports.comports() if listed is None else listed
    ports = [port for port in found if not any(word in port.device for word in _ONBOARD)]
    return sorted(ports, key=lambda port: (len(port.device), str(port.device)))  # COM3 before COM10


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


def port_row(port: Any, system: str = sys.platform) -> PortRow:
    """What is known of a port as pyserial lists it, without opening it; ``system``: as ``sys.platform``."""
    vendor, product = getattr(port, "vid", None), getattr(port, "pid", None)
    about = port.description or "serial port"
    row = serial_row(port.device, about, system=system, vendor=vendor)
    return PortRow(
        port.device,
        stable_name(port.device),
        port.description or "",
        f"{vendor:04x}:{product:04x}" if vendor is not None and product is not None else "",
        getattr(port, "serial_number", None) or "",
        latency_ms(port.device),
        named_users_of(port.device),
        row.status,
        row.do,
    )


def stable_name(device: str, folder: str = BY_ID) -> str:
    """The name by adapter that leads to ``device``; empty where the system keeps none."""
    real = os.path.realpath(device)
    return next((name for name in sorted(glob.glob(f"{folder}/*")) if os.path.realpath(name) == real), "")


def latency_ms(path: str, sys_root: str = "/sys") -> int | None:
    """Latency timer of a USB serial adapter in ms, or ``None`` where the driver has none."""
    name = os.path.basename(os.path.realpath(path))
    try:
        return int(Path(sys_root, "bus/usb-serial/devices", name, "latency_timer").read_text())
    except (OSError, ValueError):
        return None


_FTDI = 0x0403  # USB vendor; most adapters of servos have such a chip

_LATENCY_ADVICE = {
    "win32": "set it to 1 ms: Device Manager, Ports, this one, Port Settings, Advanced, Latency Timer",
    "darwin": "where cycles are slow: FTDI's own driver (VCP) lets the latency timer be set to 1 ms",
}
"""Systems on which a latency timer cannot be read -> what to do about it."""


def serial_row(
    path: str, about: str, *, sys_root: str = "/sys", system: str = sys.platform, vendor: int | None = None
) -> CheckRow:
    """One serial port: may it be used, is it in use, how late does it answer.

    ``about``: its description; ``system``: as ``sys.platform``; ``vendor``: of the USB adapter, where known.
    """
    what = f"serial {path}"
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
    latency = latency_ms(path, sys_root)
    if latency is not None and latency > 1:
        name = os.path.basename(os.path.realpath(path))
        timer = f"/sys/bus/usb-serial/devices/{name}/latency_timer"
        # 16 ms, the driver's default, holds six servos to about 57 cycles a second.
        return CheckRow(what, NOTE, f"{about}; answers {latency} ms late", f"echo 1 | sudo tee {timer}")
    return CheckRow(what, OK, about + ("; free" if system.startswith("linux") else ""))
