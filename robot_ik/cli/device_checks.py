"""The doctor's view of serial ports and cameras: permission, latency, who else uses them.

No serial port is opened (opening one can reset the board behind it); cameras are opened for one
picture in a child process with a time limit.
"""

from __future__ import annotations

import getpass
import os
import sys
from pathlib import Path

from robot_ik import environment
from robot_ik.cli.checks import NOTE, OK, Row, time_left

# Prints a line per camera as it goes, so that what was found survives the time limit.
_CAMERA_CODE = """
import os, sys
os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
import cv2
for path in {paths!r}:
    capture = cv2.VideoCapture(path)
    good, image = capture.read() if capture.isOpened() else (False, None)
    size = f"{{image.shape[1]}}x{{image.shape[0]}}" if good else "no picture"
    print(f"{{path}}={{size}}", flush=True)
    capture.release()
"""


def _group_of(path: str) -> str:
    try:
        import grp

        return grp.getgrgid(os.stat(path).st_gid).gr_name
    except (ImportError, KeyError, OSError):
        return ""


def permission_hint(path: str) -> str:
    """What gives this user the right to use the device file."""
    group = _group_of(path)
    if group in ("", "root", "wheel"):
        return f"you may not read and write {path}: ask for a udev rule that gives it to a group of yours"
    return f"sudo usermod -aG {group} {getpass.getuser()}, then log out and in again"


def users_of(path: str) -> list[str]:
    """Programs that have ``path`` open, as ``name (pid)``; only what this user may see, Linux only."""
    return [f"{name} ({number})" for number, name in environment.users_of(path).items()]


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
) -> Row:
    """One serial port: may it be used, is it in use, how late does it answer.

    Args:
        path: Its name.
        about: Its description.
        sys_root: Where Linux tells of devices.
        system: As ``sys.platform``.
        vendor: Of the USB adapter, where known.
    """
    what = f"serial {path}"
    if advice := _LATENCY_ADVICE.get(system):
        # Windows has no files for ports, and tells by opening only who may use one.
        if system != "win32" and not os.access(path, os.R_OK | os.W_OK):
            return Row(what, NOTE, f"{about}; no permission", permission_hint(path))
        late = vendor == _FTDI
        text = "; its latency timer cannot be read, as it comes it is 16 ms"
        return Row(what, NOTE if late else OK, about + (text if late else ""), advice if late else "")
    if not os.access(path, os.R_OK | os.W_OK):
        return Row(what, NOTE, f"{about}; no permission", permission_hint(path))
    users = users_of(path)
    if users:
        return Row(what, NOTE, f"{about}; in use by {', '.join(users)}", "end that program first")
    latency = latency_ms(path, sys_root)
    if latency is not None and latency > 1:
        name = os.path.basename(os.path.realpath(path))
        timer = f"/sys/bus/usb-serial/devices/{name}/latency_timer"
        # 16 ms, the driver's default, holds six servos to about 57 cycles a second.
        return Row(what, NOTE, f"{about}; answers {latency} ms late", f"echo 1 | sudo tee {timer}")
    return Row(what, OK, about + ("; free" if system.startswith("linux") else ""))


def check_serial(until: float) -> list[Row]:
    """Serial ports with what stands in the way of using them."""
    from serial.tools import list_ports

    ports = [p for p in list_ports.comports() if sys.platform == "win32" or os.path.exists(p.device)]
    # On-board UARTs are listed whether or not anything is behind them.
    rows = [serial_row(p.device, p.description or "serial port") for p in ports if "ttyS" not in p.device]
    if not rows:
        return [Row("serial", NOTE, "no USB serial port", "plug the adapter in; --bus pty and sim need none")]
    return rows


def check_cameras(until: float) -> list[Row]:
    """Cameras that give a picture."""
    if not sys.platform.startswith("linux"):
        return [Row("camera", NOTE, "not looked for on this system", "try: robot-ik reach --camera 0")]
    from robot_ik.camera.sources.device_list import find_cameras

    # A camera has a second device node for its metadata, which never gives a picture.
    names = {camera.path: camera.name for camera in find_cameras() if camera.pictures}
    paths = list(names)
    if not paths:
        return [Row("camera", NOTE, "none", "plug one in; --camera synthetic, a photo or a video need none")]
    rows = [
        Row(f"camera {p}", NOTE, "no permission", permission_hint(p))
        for p in paths
        if not os.access(p, os.R_OK | os.W_OK)
    ]
    usable = [p for p in paths if os.access(p, os.R_OK | os.W_OK)]
    if not usable:
        return rows
    probe = environment.run_probe(_CAMERA_CODE.format(paths=usable), timeout=time_left(until))
    answers = dict(line.split("=", 1) for line in probe.text.splitlines() if "=" in line)
    for path in usable:
        answer = answers.get(path, "no answer in time")
        good = answer[:1].isdigit()
        do = "" if good else "in use by another program, or this node carries no pictures"
        found = f"{names[path]}: {answer}" if names[path] else answer
        rows.append(Row(f"camera {path}", OK if good else NOTE, found, do))
    return rows
