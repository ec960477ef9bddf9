"""``uploaded_mesh``: the command of a mesh file that a page uploads."""

from __future__ import annotations

import base64
import binascii
from pathlib import PurePath

from robot_ik.errors import InvalidObstacleError
from robot_ik.testbed.commands import AddMesh
from robot_ik.testbed.convex_hull import ConvexHull

_LONGEST_NAME = 40
"""Characters of the name that an obstacle takes from its file."""


def uploaded_mesh(name: str, content: str) -> AddMesh:
    """Return the command that adds the convex hull of a file.

    The command holds the vertices of the hull only, so that a log replays without the file.

    Args:
        name: Name of the file.
        content: The file in Base64.

    Raises:
        InvalidObstacleError: It is no mesh of a solid.
        ConfigError: The mesh is too large for the testbed.
    """
    try:
        data = base64.b64decode(content, validate=True)
    except binascii.Error:
        raise InvalidObstacleError(
            f"{name} was not uploaded completely", hint="upload the file again"
        ) from None
    hull = ConvexHull.of_file(name, data)
    title = PurePath(name).stem[:_LONGEST_NAME] or "mesh"
    x, y, z = hull.vertices.T.tolist()
    return AddMesh(title, tuple(zip(x, y, z, strict=True)))
