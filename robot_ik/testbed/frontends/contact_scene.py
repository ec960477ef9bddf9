"""Parts of the robot that touch something, in red, and the places of the contacts."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from robot_ik.ports import Array
from robot_ik.testbed.arrangement import LIMIT_COLOUR, linear
from robot_ik.testbed.frontends.scene import BrowserScene, assign, body_meshes
from robot_ik.testbed.obstacles import MAX_CONTACTS
from robot_ik.testbed.view import View

Floats = NDArray[np.float32]

_COVER = 2e-3
"""Thickness of the red cover of a part, in extents of the model: it hides the part's colours."""

_SAME_POINT_DIGITS = 6
"""Decimal digits, m, in which two corners of a mesh are one point."""

_SMALLEST_NORMAL = 1e-12
"""m². A shorter normal has no direction."""


class ContactScene:
    """Draws the contacts of the first instance.

    A part that touches something gets a red cover, a little larger than the part. The page writes
    the depths at empty nodes ``/contacts/0``, ``/contacts/1``, … at the contacts.

    Args:
        server: viser's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._scene: BrowserScene | None = None
        self._covers: dict[int, list[Any]] = {}
        self._places = [
            server.scene.add_frame(f"/contacts/{k}", show_axes=False) for k in range(MAX_CONTACTS)
        ]

    def draw(self, view: View, scene: BrowserScene) -> None:
        """Show the contacts of a view beside a drawing of its robot."""
        if scene is not self._scene:
            # Removing the drawing of the robot has removed the covers too.
            self._covers = {}
            self._scene = scene
        offset = scene.arrangement.offsets[0]
        for contact, place in zip(view.contacts, self._places, strict=False):
            place.position = contact.point + offset
        red = {body for contact in view.contacts for body in contact.bodies}
        for body in red - self._covers.keys():
            self._covers[body] = self._add_covers(scene, body)
        first = view.instances[0]
        for body, covers in self._covers.items():
            for cover in covers:
                cover.visible = body in red
                if body in red:
                    position = (first.xpos[body] + offset)[None].astype(np.float32)
                    wxyz = first.xquat[body][None].astype(np.float32)
                    assign(cover, batched_positions=position, batched_wxyzs=wxyz)

    def _add_covers(self, scene: BrowserScene, body: int) -> list[Any]:
        """Add the cover of each mesh of a body."""
        meshes = [mesh for owner, mesh in body_meshes(scene.robot.model) if owner == body]
        thickness = _COVER * scene.arrangement.extent
        return [
            self._server.scene.add_batched_meshes_simple(
                f"/robot/contact_{body}_{k}",
                thickened(mesh.vertices, mesh.faces, thickness),
                mesh.faces,
                np.array([[1, 0, 0, 0]], np.float32),
                np.zeros((1, 3), np.float32),
                batched_colors=linear(LIMIT_COLOUR),
                lod="off",
                cast_shadow=False,
            )
            for k, mesh in enumerate(meshes)
        ]


def thickened(vertices: Floats, faces: NDArray[np.uint32], thickness: float) -> Floats:
    """Return vertices (v, 3) moved outwards by a thickness, m.

    Corners at one place move together, so that no gap opens at a sharp edge.
    """
    points, number = np.unique(vertices.round(_SAME_POINT_DIGITS), axis=0, return_inverse=True)
    number = number.reshape(-1)
    corners = vertices[faces].astype(float)
    across: Array = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(normals, number[faces[:, corner]], across)
    lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), _SMALLEST_NORMAL)
    return (vertices + thickness * (normals / lengths)[number]).astype(np.float32)
