"""Which cameras this machine shows, without opening any of them.

Linux tells it in ``/sys/class/video4linux``.  macOS and Windows tell it only to programs that use their own
video interfaces, which OpenCV's Python wheel does not expose: there the list is empty and ``CAN_LIST`` False.
"""

from __future__ import annotations

import glob
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

#: Whether this system lets its cameras be listed.
CAN_LIST = sys.platform.startswith("linux")


@dataclass(frozen=True)
class CameraDevice:
    """One video device.

    Attributes:
        index: What ``open_source`` takes as a number.
        path: Its device file.
        name: What the camera calls itself; empty where the system does not say.
        stable: A name that survives replugging, empty where there is none.
        usable: Whether this user may read and write it.
        pictures: False for a camera's further nodes, which carry its metadata and no pictures.
    """

    index: int
    path: str
    name: str
    stable: str
    usable: bool
    pictures: bool


def list_cameras() -> tuple[str, ...]:
    """Camera devices that this machine shows, by path (Linux only; empty elsewhere)."""
    return tuple(camera.path for camera in find_cameras())


def find_cameras(dev: str = "/dev", sys_root: str = "/sys") -> tuple[CameraDevice, ...]:
    """Video devices in the order of their numbers.

    Args:
        dev: Folder of device files.
        sys_root: Where the kernel tells their names.
    """
    if not CAN_LIST:
        return ()
    paths = [p for p in glob.glob(f"{dev}/video*") if re.fullmatch(r"video\d+", os.path.basename(p))]
    return tuple(_describe(p, dev, sys_root) for p in sorted(paths, key=_number))


def _number(path: str) -> int:
    return int(os.path.basename(path).removeprefix("video"))


def _describe(path: str, dev: str, sys_root: str) -> CameraDevice:
    folder = Path(sys_root, "class/video4linux", os.path.basename(path))
    return CameraDevice(
        _number(path),
        path,
        _said(folder / "name"),
        _stable_name(path, dev),
        os.access(path, os.R_OK | os.W_OK),
        # The kernel counts the nodes of one camera from 0, and the first is the one with pictures.
        _said(folder / "index") in ("", "0"),
    )


def _said(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _stable_name(path: str, dev: str) -> str:
    real = os.path.realpath(path)
    names = sorted(glob.glob(f"{dev}/v4l/by-id/*"))
    return next((name for name in names if os.path.realpath(name) == real), "")
