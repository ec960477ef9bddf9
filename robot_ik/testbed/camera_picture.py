"""A picture of a camera and the markers that are detected in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from robot_ik.ports import Image


@dataclass(frozen=True, eq=False)
class CameraPicture:
    """One picture and the markers in it.

    Attributes:
        image: (h, w, 3) BGR.
        markers: Id, distance in metres and reprojection error in pixels of each marker.
        note: One line about the picture.
    """

    image: Image
    markers: tuple[tuple[int, float, float], ...]
    note: str


ReadPicture = Callable[[], CameraPicture | None]
"""Returns the next picture, or None if the robot has no scene with a camera."""
