"""``robot-ik camera list``: the cameras of this machine, and what stands in the way of using them."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rich.text import Text

from robot_ik.cli import console

if TYPE_CHECKING:
    from robot_ik.camera.sources.device_list import CameraDevice


@dataclass(frozen=True)
class CameraListOptions:
    """Lists cameras: index, name, path, permission, who uses them. Opens none of them.

    Exit code 1 when there is no camera. Linux only: macOS and Windows do not let cameras be listed.
    """

    json: bool = False
    """Print one JSON object instead of a table."""


def run(options: CameraListOptions) -> int:
    """Prints the cameras; 1 when there is none."""
    from robot_ik.camera.sources.device_list import CAN_LIST, find_cameras
    from robot_ik.cli.device_checks import users_of

    cameras = find_cameras()
    rows: list[dict[str, Any]] = [{**asdict(c), "used_by": users_of(c.path), "do": _do(c)} for c in cameras]
    if options.json:
        console.print_json({"schema": 1, "can_list": CAN_LIST, "cameras": rows})
    elif rows:
        shown = console.table("index", "name", "path", "state", "what to do")
        for camera, row in zip(cameras, rows, strict=True):
            state = _state(camera.usable, camera.pictures, row["used_by"])
            path = camera.stable or camera.path
            shown.add_row(str(camera.index), *(Text(t) for t in (camera.name or "?", path, state, row["do"])))
        console.out().print(shown)
    elif CAN_LIST:
        console.say("error: there is no camera on this machine", "bold red")
        console.say(
            "plug one in; a picture, a film, a folder, a URL or synthetic:orbit does as well "
            "wherever a camera is asked for",
            "cyan",
        )
    else:
        console.say(f"error: cameras cannot be listed on {sys.platform}", "bold red")
        console.say("the first one is 0, the next 1, …; try: robot-ik camera detect 0", "cyan")
    return console.DONE if any(c.pictures for c in cameras) else console.NOT_ACHIEVED


def _state(usable: bool, pictures: bool, users: list[str]) -> str:
    if not pictures:
        return "no pictures: a camera's second node"
    if not usable:
        return "no permission"
    return f"used by {', '.join(users)}" if users else "free"


def _do(camera: CameraDevice) -> str:
    from robot_ik.cli.device_checks import permission_hint

    return permission_hint(camera.path) if camera.pictures and not camera.usable else ""
