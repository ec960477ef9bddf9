"""``robot-ik camera list``: list the cameras of this machine."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from robot_ik.commands.options import JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import CameraNotFoundError, RobotIkError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.camera.device import CameraDevice


@dataclass(frozen=True, kw_only=True)
class CameraList(JsonOption):
    """List the cameras of this machine and the programs that use them. Opens no camera.

    Linux only: macOS and Windows do not list their cameras.

        robot-ik camera list

    Exit code 1: there is no camera.
    """

    def run(self, _terminal: Terminal = QUIET) -> CameraListReport:
        """Find the video devices and the programs that have them open."""
        from robot_ik.camera.device import CAN_LIST, find_cameras  # OpenCV
        from robot_ik.hardware.checks import named_users_of, permission_hint

        cameras = []
        for device in find_cameras():
            hint = permission_hint(device.path) if device.pictures and not device.usable else ""
            cameras.append(ListedCamera(device, named_users_of(device.path), hint))
        return CameraListReport(CAN_LIST, cameras)


@dataclass(frozen=True)
class ListedCamera:
    """One camera of the machine.

    Attributes:
        device: Number, path and name.
        users: Programs that have it open.
        hint: What to do about a missing permission. Empty: nothing.
    """

    device: CameraDevice
    users: Sequence[str]
    hint: str

    @property
    def state(self) -> str:
        """State for people."""
        if not self.device.pictures:
            return "no pictures: a metadata node"
        if not self.device.usable:
            return "no permission"
        return f"used by {', '.join(self.users)}" if self.users else "free"


@dataclass(frozen=True, eq=False)
class CameraListReport(Report):
    """The cameras.

    Attributes:
        can_list: Whether this system lists its cameras.
        cameras: The cameras, by number.
    """

    can_list: bool
    cameras: Sequence[ListedCamera]

    @property
    def ok(self) -> bool:
        return any(camera.device.pictures for camera in self.cameras)

    @property
    def failure(self) -> RobotIkError | None:
        if self.cameras:
            return None
        if self.can_list:
            return CameraNotFoundError(
                "there is no camera on this machine",
                hint="connect a camera, or use another image source: a picture, a film, a folder, "
                "a URL or synthetic:orbit",
            )
        return CameraNotFoundError(
            f"cameras cannot be listed on {sys.platform}",
            hint="the first camera is 0, the next is 1; try: robot-ik camera detect 0",
        )

    def tables(self) -> Iterable[Table]:
        if self.cameras:
            yield table(
                "index", "name", "path", "state", "what to do", rows=map(_cells, self.cameras)
            )

    def facts(self) -> dict[str, Any]:
        cameras = [
            {**asdict(camera.device), "used_by": list(camera.users), "do": camera.hint}
            for camera in self.cameras
        ]
        return {"can_list": self.can_list, "cameras": cameras}


def _cells(camera: ListedCamera) -> tuple[object, ...]:
    device = camera.device
    return (
        device.index,
        device.name or "?",
        device.stable or device.path,
        camera.state,
        camera.hint,
    )
