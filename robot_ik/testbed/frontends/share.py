"""One HTML file with a motion that plays and scrubs in any browser, without this program."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
import viser
from viser import _messages as vm

from robot_ik.testbed.arrangement import FIELD_OF_VIEW
from robot_ik.testbed.frontends.scene import BrowserScene
from robot_ik.testbed.session import Session

RATE_HZ = 30.0
"""Frames a second of a shared motion."""

_ASPECT = 1.6
"""Width over height of the picture that the camera is fitted to."""

_HIDDEN = ("/goal", "/robot/trails")
"""Nodes that are of no use without the program."""

_STYLE = (
    # viser dims its canvas whenever a light is loaded, which its player does in every round.
    "<style>#root canvas{opacity:1!important}"
    "#shared-title{position:fixed;left:20px;top:16px;z-index:9;font:600 15px/1.3 system-ui;"
    "padding:9px 14px;border-radius:10px;background:rgba(20,24,32,.82);color:#fff}"
    "#shared-title small{display:block;font-weight:400;opacity:.7;font-size:12px}</style>"
)


def shared_page(
    server: viser.ViserServer, scene: BrowserScene, session: Session, dark: bool
) -> str:
    """Return the present scene with the timeline's motion as one HTML page.

    The frames go into the recording only: browsers that look now do not show them.
    """
    recording = server.get_scene_serializer()
    # The recording gets the frames of the timeline, and not what the loop draws meanwhile.
    handles = server._websock_server._record_handles
    handles.remove(recording)
    try:
        for message in _setting(scene, session):
            recording._insert_message(message)
        _insert_motion(recording, scene, session)
    finally:
        handles.append(recording)
    page = recording.as_html(dark_mode=dark)
    return page.replace("</body>", _caption(session) + "</body>")


def _insert_motion(recording: Any, scene: BrowserScene, session: Session) -> None:
    """Add the frames of the timeline."""
    timeline = session.timeline
    if timeline.is_empty:
        return
    robot = scene.robot
    frame = robot.frame(robot.tool)
    for k in range(max(1, round(RATE_HZ * timeline.duration)) + 1):
        data = robot.data_at(timeline.at(min(k / RATE_HZ, timeline.duration)))
        for body, handle in scene.bodies:
            wxyz = np.tile(data.xquat[body].astype(np.float32), (scene.count, 1))
            positions = (data.xpos[body] + scene.offsets).astype(np.float32)
            arrays = {"batched_positions": positions, "batched_wxyzs": wxyz}
            recording._insert_message(vm.SceneNodeUpdateMessage(handle._impl.name, arrays))
        rotation = data.xmat[frame.body].reshape(3, 3)
        tool = data.xpos[frame.body] + rotation @ frame.local.position
        ball = {"batched_positions": (tool + scene.offsets).astype(np.float32)}
        recording._insert_message(vm.SceneNodeUpdateMessage(scene.ball._impl.name, ball))
        recording._time += 1.0 / RATE_HZ


def _setting(scene: BrowserScene, session: Session) -> list[Any]:
    """Return messages that place the camera and hide nodes."""
    position, target = scene.arrangement.camera(session.ball_path(), _ASPECT)
    x, y, z = (float(value) for value in position)
    u, v, w = (float(value) for value in target)
    return [
        *(vm.SetSceneNodeVisibilityMessage(name, False) for name in _HIDDEN),
        vm.SetCameraPositionMessage((x, y, z), initial=True),
        vm.SetCameraLookAtMessage((u, v, w), initial=True),
        vm.SetCameraFovMessage(FIELD_OF_VIEW, initial=True),
    ]


def _caption(session: Session) -> str:
    """Return a title over the picture."""
    timeline = session.timeline.view()
    content = "a still scene"
    if timeline.times:
        content = f"{len(timeline.times)} key poses, {timeline.times[-1]:.1f} s"
    name = html.escape(session.robot.name)
    small = f"<small>{content} · made with robot_ik</small>"
    return f'{_STYLE}<div id="shared-title">{name}{small}</div>'
