"""Where the light of a synthetic photograph comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lights:
    """One large lamp, a bright ceiling, a window behind the camera, and light from everywhere.

    Attributes:
        lamp: Position (3,) of the lamp, metres, world.
        lamp_radius: Its radius: how soft its shadows are.
        ceiling: Centre (3,) of the bright ceiling; ``ceiling_radius`` its radius.
        ceiling_radius: See ``ceiling``.
        window: Where the window (3,) is; it throws no shadows.
        strength: Of lamp, ceiling, window, ambient from above, ambient from below; they add up to about 1
            on a level sheet of paper.
    """

    lamp: Array
    lamp_radius: float
    ceiling: Array
    ceiling_radius: float
    window: Array
    strength: tuple[float, float, float, float, float] = (0.25, 0.17, 0.33, 0.35, 0.28)

    @classmethod
    def beside(cls, pose_world_camera: Pose, distance: float) -> Lights:
        """A lamp above and to the left of the camera, a ceiling above what it looks at."""
        turn, eye = pose_world_camera.rotation, pose_world_camera.position
        subject = eye + turn[:, 2] * distance
        lamp = eye - 0.55 * distance * turn[:, 0] + np.array([0.0, 0.0, 0.9 * distance])
        overhead = subject + np.array([0.0, 0.0, 1.6 * distance])
        return cls(lamp, 0.10 * distance, overhead, 0.8 * distance, eye)

    def terms(self, points: Array, normals: Array) -> tuple[Array, Array, Array]:
        """Light (n,) that ``points`` (n, 3) with ``normals`` (n, 3) get: lamp, ceiling, ambient."""
        lamp, ceiling, window, above, below = self.strength

        def facing(source: Array) -> Array:
            way = source - points
            return np.asarray(
                np.maximum(
                    np.einsum("ij,ij->i", way, normals) / np.maximum(np.linalg.norm(way, axis=1), 1e-9), 0.0
                )
            )

        up = 0.5 + 0.5 * normals[:, 2]
        ambient = below + (above - below) * up + window * facing(self.window)
        return lamp * facing(self.lamp), ceiling * facing(self.ceiling), ambient

    def spots(self, source: str, count: int) -> Array:
        """``count`` points (count, 3) on the level disc of the ``"lamp"`` or the ``"ceiling"``."""
        centre, radius = (
            (self.lamp, self.lamp_radius) if source == "lamp" else (self.ceiling, self.ceiling_radius)
        )
        k = np.arange(count)
        # a sunflower fills a disc evenly with any number of points
        r, angle = radius * np.sqrt((k + 0.5) / count), k * np.pi * (3.0 - np.sqrt(5.0))
        return np.asarray(centre + np.stack([r * np.cos(angle), r * np.sin(angle), 0 * r], axis=1))
