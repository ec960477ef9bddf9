"""A robot drawn on a board, with its shadow, hidden by the real objects in front of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.faces import (
    EMPTY,
    LIGHT,
    Faces,
    bounding_box,
    faces_in_picture,
    project,
)
from robot_ik.camera.drawing.painter import Layer, SurfaceBuffer, geom_paint
from robot_ik.camera.drawing.rays import ray_field
from robot_ik.camera.image import Box
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Mask

# Part of the light that a shadow removes.
SHADOW_STRENGTH = 0.42
# Cosine between the light of shadows and the normal of the plane, at least. Longer shadows would
# leave the picture.
_STEEPEST = 0.6
# Standard deviation of the edge of a shadow, in heights of the robot in the picture.
_SOFTNESS = 0.012
# Shadows are drawn this much coarser than the picture. Their edges are soft, so it is not visible.
_COARSE = 3
# Standard deviation of a blur on its own lattice, px. Less would show the lattice.
_BLUR_PIXELS = 4.0
# Factor of inverse depth by which an object must be nearer than the plane to hide a shadow on it.
# An object that stands on the plane does not hide the plane under it.
_NEARER = 1.005


@dataclass(frozen=True)
class Drawing:
    """Layers to be laid over a picture one after the other, each with its opacity."""

    layers: tuple[tuple[Layer, float], ...] = ()

    def over(self, image: NDArray[np.uint8], alpha: float = 1.0) -> None:
        """Lay them over ``image``, in place."""
        for layer, opacity in self.layers:
            layer.over(image, alpha * opacity)

    def shifted(self, motion: Array, width: int, height: int) -> Drawing:
        """Return the drawing moved in the picture, see ``Layer.shifted``."""
        return Drawing(tuple((layer.shifted(motion, width, height), s) for layer, s in self.layers))

    @property
    def robot(self) -> Layer:
        """The robot itself, without its shadow."""
        return self.layers[-1][0] if self.layers else Layer.empty()


@dataclass(frozen=True, eq=False)
class DrawnRobot:
    """A robot beside a board, with the real objects that may hide it.

    Attributes:
        model: The robot.
        pose_board_base: Pose of its world frame in the frame of the board (x right, y up, z out of
            the print).
        scale: Drawn size over true size.
        occluders: Real objects in the frame of the board. They hide the robot and are not drawn.
        occluder_geoms: (ngeom,) geoms of the robot's own model that are such objects.
        shadow: Whether the robot casts a shadow on the plane of the board.
    """

    model: mujoco.MjModel
    pose_board_base: Pose = field(default_factory=Pose)
    scale: float = 1.0
    occluders: mujoco.MjModel | None = None
    occluder_geoms: Mask | None = None
    shadow: bool = True

    def camera(self, pose_board_camera: Pose) -> Pose:
        """Return ``pose_world_camera`` from which a robot of true size looks like this one."""
        pose_base_camera = self.pose_board_base.inverse().compose(pose_board_camera)
        # A scene and its camera in one scale give one picture.
        return Pose(pose_base_camera.position / self.scale, pose_base_camera.wxyz)

    def draw(
        self, qpos: ArrayLike, intrinsics: CameraIntrinsics, pose_board_camera: Pose
    ) -> Drawing:
        """Draw the robot and its shadow.

        Args:
            qpos: (model.nq,) full configuration.
            intrinsics: Lens of the picture.
            pose_board_camera: OpenCV camera axes seen from the board.

        Returns:
            The layers of the drawing. It is empty if no part of the robot is in the picture.
        """
        faces = faces_in_picture(self.model, qpos, intrinsics, self.camera(pose_board_camera))
        if self.scale != 1.0:
            faces = replace(
                faces, inverse=faces.inverse / self.scale, points=faces.points * self.scale
            )
        box = bounding_box(faces, *intrinsics.size)
        if box == EMPTY:
            return Drawing()
        objects = None
        if self.occluders is not None:
            objects = faces_in_picture(
                self.occluders, self.occluders.qpos0, intrinsics, pose_board_camera, planes=True
            )
        buffer = SurfaceBuffer(box)
        if objects is not None and self.occluders is not None:
            buffer.fill(objects, geom_paint(self.occluders, occluders=True))
        hidden_geoms = False if self.occluder_geoms is None else self.occluder_geoms
        buffer.fill(faces, geom_paint(self.model, occluders=hidden_geoms))
        robot = (buffer.layer(), 1.0)
        if not self.shadow:
            return Drawing((robot,))
        pose_camera_board = pose_board_camera.inverse()
        shadow = cast_shadow(faces, intrinsics, pose_camera_board)
        if objects is not None:
            _hide_shadow(shadow, objects, intrinsics, pose_camera_board)
        return Drawing(((shadow, SHADOW_STRENGTH), robot))


def cast_shadow(
    faces: Faces,
    intrinsics: CameraIntrinsics,
    pose_camera_plane: Pose,
    softness: float = _SOFTNESS,
) -> Layer:
    """Draw the soft shadow that faces cast on the plane z = 0 of a frame.

    Args:
        faces: Of the robot, in the picture.
        intrinsics: Lens of the picture.
        pose_camera_plane: The frame, z on the side of the light.
        softness: Standard deviation of the edge of the shadow, in heights of the robot in the
            picture.

    Returns:
        A black layer. Its coverage is 255 in the full shadow.
    """
    normal = pose_camera_plane.rotation[:, 2]
    direction = -LIGHT
    direction = direction - normal * max(_STEEPEST + float(direction @ normal), 0.0)
    height = (faces.points - pose_camera_plane.position) @ normal
    fall = np.maximum(height, 0.0) / (direction @ normal)
    points = faces.points - fall[:, None] * direction
    pixels, inverse, within = project(points, intrinsics)
    within &= faces.within
    # Faces behind the plane cast no shadow on it.
    above = np.asarray(height > 0.0)
    corners_above = np.logical_or.reduce(above[faces.faces], axis=1)
    casting = corners_above & np.logical_and.reduce(within[faces.faces], axis=1)
    # Vertices beside the lens have meaningless pixels.
    rows = np.clip(faces.pixels[faces.within, 1], 0.0, intrinsics.height)
    height_px = float(np.ptp(rows)) if len(rows) else 0.0
    sigma = max(1.0, softness * height_px / _COARSE)
    flat = replace(
        faces,
        pixels=(pixels + 0.5) / _COARSE - 0.5,
        inverse=inverse,
        chosen=faces.chosen[casting[faces.chosen]],
        within=within,
    )
    width, picture_height = intrinsics.size
    margin = 3 + round(3 * sigma)
    box = bounding_box(flat, width // _COARSE, picture_height // _COARSE, margin=margin)
    if box == EMPTY:
        return Layer.empty()
    buffer = SurfaceBuffer(box, 1)
    buffer.fill(flat, np.zeros((int(faces.geom.max()) + 1, 4), dtype=np.float32))
    dark = np.where(buffer.depth > 0.0, np.uint8(255), np.uint8(0))
    x0, y0, x1, y1 = box
    large = (_COARSE * x0, _COARSE * y0, _COARSE * x1, _COARSE * y1)
    size = (large[2] - large[0], large[3] - large[1])
    # A wide blur is as smooth on a coarser lattice, and takes less time.
    shrink = max(1, int(sigma / _BLUR_PIXELS))
    if shrink > 1:
        small = (-(-dark.shape[1] // shrink), -(-dark.shape[0] // shrink))
        dark = np.asarray(cv2.resize(dark, small, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    dark = np.asarray(cv2.GaussianBlur(dark, (0, 0), sigma / shrink), dtype=np.uint8)
    coverage = np.asarray(cv2.resize(dark, size), dtype=np.uint8)
    return Layer(large, np.zeros((*coverage.shape, 3), dtype=np.uint8), coverage)


def _hide_shadow(
    shadow: Layer, objects: Faces, intrinsics: CameraIntrinsics, pose_camera_plane: Pose
) -> None:
    """Clear the coverage of a shadow where objects hide the plane, in place."""
    if not shadow.coverage.size:
        return
    buffer = SurfaceBuffer(shadow.box, 1)
    buffer.fill(objects, np.zeros((int(objects.geom.max(initial=0)) + 1, 4), dtype=np.float32))
    plane = _plane_inverse_depth(shadow.box, intrinsics, pose_camera_plane)
    shadow.coverage[buffer.depth > plane * _NEARER] = 0


def _plane_inverse_depth(box: Box, intrinsics: CameraIntrinsics, pose_camera_plane: Pose) -> Array:
    """Return the inverse depth (h, w) of the plane at the pixels of a box, 0 behind the lens."""
    rays = ray_field(intrinsics).box(*box)
    normal = pose_camera_plane.rotation[:, 2]
    distance = pose_camera_plane.position @ normal
    return np.maximum(
        (rays[..., 0] * normal[0] + rays[..., 1] * normal[1] + normal[2]) / distance, 0.0
    )
