"""One camera before one scene: viewing rays, what stands still, and which light gets past the robot."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.raycast import Caster, RayField
from robot_ik.camera.made_up.lights import Lights
from robot_ik.camera.made_up.stage import StillPicture
from robot_ik.geometry import Pose

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Box = tuple[int, int, int, int]

# Neighbouring points ask different points of a light, in a repeating tile of this side; a blur over the
# tile then gives soft shadows from few rays (interleaved sampling, Keller and Heidrich 2001).
_TILE = 4


@dataclass(frozen=True)
class Quality:
    """How much work a picture is worth.

    Attributes:
        stride: Robot rays every so many pixels; markers are exact always.
        self_stride, self_spots: Shadows on the robot: every so many pixels, so many points of each light.
        stage_stride, stage_spots: The same for shadows of the robot on table and floor.
        same_grain: Pictures share their noise, each moved to another place.
    """

    stride: int
    self_stride: int
    self_spots: int
    stage_stride: int
    stage_spots: int
    same_grain: bool = False


QUALITIES = {"full": Quality(1, 2, 2, 4, 2), "fast": Quality(3, 6, 1, 8, 1, same_grain=True)}


@dataclass(frozen=True)
class View:
    """What the parts of a picture have in common.

    Attributes:
        field: Viewing rays of the lens.
        camera: ``pose_world_camera``.
        lights: Lamp, ceiling, window.
        robot: The robot's model, to be asked by rays; placed anew for each picture.
        stage: The empty scene.
    """

    field: RayField
    camera: Pose
    lights: Lights
    robot: Caster
    stage: StillPicture

    def world(self, ideal: Array) -> Array:
        """World directions (n, 3), unit along the optical axis, of ideal coordinates (n, 2)."""
        turn = self.camera.rotation
        return np.asarray(ideal @ turn.T[:2] + turn[:, 2])

    def visibility(self, points: Array, tile: NDArray[np.int64], spots: int) -> Array:
        """Part (n, 2) of lamp and ceiling that each point sees past the robot.

        Args:
            points: (n, 3) world.
            tile: (n,) place of each point in its tile, 0 .. _TILE**2 - 1: which points of a light it asks.
            spots: How many it asks.
        """
        classes = _TILE * _TILE
        result = np.zeros((len(points), 2))
        for c, source in enumerate(("lamp", "ceiling")):
            for k, spot in enumerate(self.lights.spots(source, classes)):
                asking = np.flatnonzero((k - tile * 7) % classes < spots)
                result[asking, c] += self.robot.lit(spot, points[asking]) / spots
        return result


def lattice(box: Box, stride: int) -> tuple[Array, Array]:
    """Columns and rows at the centres of blocks of ``stride`` pixels that fill ``box``."""
    return tuple(  # type: ignore[return-value]
        low + (np.arange(-(-(high - low) // stride)) + 0.5) * stride - 0.5
        for low, high in ((box[0], box[2]), (box[1], box[3]))
    )


def tiles(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Place (h, w) of each lattice point in its tile."""
    i, j = np.indices(shape)
    return np.asarray((i % _TILE) * _TILE + j % _TILE)


def softened(picture: Float32) -> Float32:
    """Mean over one tile, then a little more, so that no pattern is left."""
    return np.asarray(cv2.GaussianBlur(cv2.blur(picture, (_TILE, _TILE)), (0, 0), 0.8), dtype=np.float32)


def enlarged(picture: ArrayLike, stride: int, size: tuple[int, int]) -> Float32:
    """Blocks of ``stride`` pixels blown up smoothly and cropped to ``size`` (rows, columns)."""
    small = np.ascontiguousarray(picture, dtype=np.float32)
    if stride == 1:
        return small
    large = cv2.resize(
        small, (small.shape[1] * stride, small.shape[0] * stride), interpolation=cv2.INTER_LINEAR
    )
    return np.ascontiguousarray(large[: size[0], : size[1]])
