"""Back ends that draw a robot on a board: ``painter`` (default) and ``ray``; ``gl`` is in ``gl.py``.

All of them give the same sheets for the same robot, camera and light, and none but ``gl`` needs OpenGL.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from robot_ik.camera.drawing import painter
from robot_ik.camera.drawing.painter import EMPTY, Layer
from robot_ik.camera.drawing.raycast import Caster, ray_field
from robot_ik.camera.image import Box
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.config import Position, Positive, Several, Table, read_table
from robot_ik.errors import ConfigError, ModelError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.model import read_model
from robot_ik.ports import Array, Mask

# Shadows fall from the light that the robot is drawn with, at least so steeply (cosine to the vertical); they
# are softened over so much of the robot's height in the picture, and take so much of the light.
_STEEP, _SOFT, _DARK = 0.6, 0.012, 0.42
# They are drawn so many times coarser than the picture: the difference is not seen.
_COARSE = 3


@dataclass(frozen=True, eq=False)
class DrawnRobot:
    """A robot beside a board, with the real objects that may hide it.

    Attributes:
        model: The robot.
        pose_board_base: Where its world frame is, seen from the board (x right, y up, z out of the print).
        scale: Drawn size over true size.
        occluders: Real objects, their world is the board's frame; drawn to depth only.
        occluder_geoms: (ngeom,) geoms of the robot's own model that are such objects.
        shadow: Whether it throws a shadow on the board's plane.
    """

    model: mujoco.MjModel
    pose_board_base: Pose = field(default_factory=Pose)
    scale: float = 1.0
    occluders: mujoco.MjModel | None = None
    occluder_geoms: Mask | None = None
    shadow: bool = True

    def camera(self, pose_board_camera: Pose) -> Pose:
        """Where a robot of true size must be seen from, so that it looks like this one."""
        seen = self.pose_board_base.inverse().compose(pose_board_camera)
        # a scene and its camera in one scale give one picture
        return Pose(seen.position / self.scale, seen.wxyz)


@dataclass(frozen=True)
class Drawing:
    """Sheets to be laid over a picture one after the other, each with its strength."""

    sheets: tuple[tuple[Layer, float], ...] = ()

    def over(self, image: NDArray[np.uint8], alpha: float = 1.0) -> None:
        """Lays them over ``image``, in place."""
        for sheet, strength in self.sheets:
            sheet.over(image, alpha * strength)

    def shifted(self, motion: Array, width: int, height: int) -> Drawing:
        """All of them moved in the picture; see ``Layer.shifted``."""
        return Drawing(tuple((sheet.shifted(motion, width, height), s) for sheet, s in self.sheets))

    @property
    def robot(self) -> Layer:
        """The robot itself; empty when nothing was drawn."""
        return self.sheets[-1][0] if self.sheets else Layer.empty()


@dataclass(frozen=True, eq=False)
class RobotView:
    """A robot where a camera sees it.

    Attributes:
        drawn, intrinsics, pose_board_camera: The robot, and the camera.
        qpos: (model.nq,) its configuration.
        faces, occluders: Its faces and those of real objects, with depths of one scale.
        box: The pixels that it touches.
    """

    drawn: DrawnRobot
    qpos: ArrayLike
    intrinsics: CameraIntrinsics
    pose_board_camera: Pose
    faces: painter.Faces
    occluders: painter.Faces | None
    box: Box


class Artist(ABC):
    """Draws a robot where a camera sees it."""

    name: str

    def draw(
        self, drawn: DrawnRobot, qpos: ArrayLike, intrinsics: CameraIntrinsics, pose_board_camera: Pose
    ) -> Drawing:
        """The sheets of one picture: the robot over its shadow; ``qpos`` is (model.nq,)."""
        faces = painter.faces_in_picture(drawn.model, qpos, intrinsics, drawn.camera(pose_board_camera))
        if drawn.scale != 1.0:
            faces = replace(faces, inverse=faces.inverse / drawn.scale, points=faces.points * drawn.scale)
        box = painter.bounding_box(faces, *intrinsics.size)
        if box == EMPTY:
            return Drawing()
        occluders = None
        if (real := drawn.occluders) is not None:
            occluders = painter.faces_in_picture(real, real.qpos0, intrinsics, pose_board_camera, planes=True)
        view = RobotView(drawn, qpos, intrinsics, pose_board_camera, faces, occluders, box)
        robot = (self._robot(view), 1.0)
        return Drawing((_shadow(view), robot) if drawn.shadow else (robot,))

    @abstractmethod
    def _robot(self, view: RobotView) -> Layer:
        """The robot alone, without what hides it."""

    def close(self) -> None:  # noqa: B027
        """Lets go of what it has opened; most have opened nothing."""


def _shadow(view: RobotView) -> tuple[Layer, float]:
    """The shadow that the robot throws on the board's plane, and its strength; occluders hide it."""
    faces, intrinsics, pose_board_camera = view.faces, view.intrinsics, view.pose_board_camera
    inverse = pose_board_camera.inverse()
    normal, origin = inverse.rotation[:, 2], inverse.position
    fall = -painter.LIGHT
    fall = fall - normal * max(_STEEP + float(fall @ normal), 0.0)
    lift = np.maximum((faces.points - origin) @ normal, 0.0) / (fall @ normal)
    points = faces.points - lift[:, None] * fall
    pixels, depths, good = painter.project(points, intrinsics)
    good &= faces.within
    whole = np.ones(len(faces.faces), dtype=bool)
    if not good.all():
        whole = np.logical_and.reduce(good[faces.faces], axis=1)
    # what is beside the lens is projected anywhere
    rows = np.clip(faces.pixels[faces.within, 1], 0.0, intrinsics.height)
    soft = max(1.0, _SOFT * float(np.ptp(rows)) / _COARSE)
    flat = replace(
        faces,
        pixels=(pixels + 0.5) / _COARSE - 0.5,
        inverse=depths,
        chosen=faces.chosen[whole[faces.chosen]],
        within=good,
    )
    width, height = intrinsics.size
    box = painter.bounding_box(flat, width // _COARSE, height // _COARSE, margin=3 + round(3 * soft))
    if box == EMPTY:
        return Layer.empty(), 0.0
    samples = painter.SurfaceSamples(box, 1)
    samples.fill(flat)
    dark = (samples.depth[..., 0] > 0).astype(np.uint8) * 255
    dark = np.asarray(cv2.GaussianBlur(dark, (0, 0), soft), dtype=np.uint8)
    dark = np.asarray(cv2.resize(dark, (0, 0), fx=_COARSE, fy=_COARSE), dtype=np.uint8)
    x0, y0, x1, y1 = (_COARSE * v for v in box)
    if view.occluders is not None:
        behind = painter.SurfaceSamples((x0, y0, x1, y1), 1)
        behind.fill(view.occluders)
        # what stands on the plane does not hide the plane where it stands
        hidden = behind.depth[..., 0] > _plane_inverse((x0, y0, x1, y1), intrinsics, inverse) * 1.005
        dark[hidden] = 0
    return Layer((x0, y0, x1, y1), np.zeros((*dark.shape, 3), dtype=np.uint8), dark), _DARK


def _plane_inverse(box: Box, intrinsics: CameraIntrinsics, pose_camera_board: Pose) -> Array:
    """One over the depth (h, w) at which pixels of the box see the board's plane; 0 where they do not."""
    normalized = ray_field(intrinsics).box(*box)
    normal = pose_camera_board.rotation[:, 2]
    return np.maximum((normalized @ normal[:2] + normal[2]) / (pose_camera_board.position @ normal), 0.0)


class PainterArtist(Artist):
    """Faces filled with a depth buffer: quick, smooth, nothing but NumPy and compiled code.

    Args:
        samples: Places in each pixel at which it is asked what is nearest: 1, 4, 8 or 16.
    """

    name = "painter"

    def __init__(self, samples: int = 4) -> None:
        self._samples = samples

    def _robot(self, view: RobotView) -> Layer:
        drawn, samples = view.drawn, painter.SurfaceSamples(view.box, self._samples)
        if view.occluders is not None:
            samples.fill(view.occluders, occluders=True)
        samples.fill(view.faces, occluders=False if drawn.occluder_geoms is None else drawn.occluder_geoms)
        return samples.layer(painter.base_colours(drawn.model))


_caster = lru_cache(maxsize=4)(Caster)


class RayArtist(Artist):
    """MuJoCo's own rays (``mj_multiRay``), analytic for primitives: exact outlines, slower."""

    name = "ray"

    def _robot(self, view: RobotView) -> Layer:
        box = view.box
        size = (box[3] - box[1], box[2] - box[0])
        near = cv2.dilate(painter.paint_mask(size, view.faces, box[:2]), np.ones((5, 5), np.uint8)) > 0
        base = painter.base_colours(view.drawn.model)
        rows, columns = np.nonzero(near)
        total = np.zeros((len(rows), 4))
        for offset in painter.SAMPLES[4]:
            geom, normal = self._cast(view, np.stack([columns + box[0], rows + box[1]], axis=1) + offset)
            on = geom >= 0
            total[on, :3] += painter.lit_colours(base[geom[on]], normal[on])
            total[on, 3] += 255.0
        total /= len(painter.SAMPLES[4])
        sheet = np.zeros((*size, 4), dtype=np.uint8)
        sheet[rows, columns] = np.rint(total)
        return Layer(box, np.ascontiguousarray(sheet[..., :3]), np.ascontiguousarray(sheet[..., 3]))

    def _cast(self, view: RobotView, pixels: Array) -> tuple[NDArray[np.int32], Array]:
        """Geoms (n,) and normals (n, 3) in the camera frame of what pixels (n, 2) see."""
        drawn, pose = view.drawn, view.pose_board_camera
        normalized = ray_field(view.intrinsics).points(pixels)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        caster = _caster(drawn.model)
        caster.place(view.qpos)
        camera = drawn.camera(pose)
        hits = caster.cast(camera.position, rays @ camera.rotation.T)
        geom = hits.geom.copy()
        if drawn.occluder_geoms is not None:
            geom[(geom >= 0) & drawn.occluder_geoms[geom]] = -1
        if drawn.occluders is not None:
            real = _caster(drawn.occluders)
            real.place(drawn.occluders.qpos0)
            before = real.cast(pose.position, rays @ pose.rotation.T, normals=False).depth
            geom[before < hits.depth * drawn.scale] = -1
        return geom, hits.normal @ camera.rotation


ARTISTS: dict[str, Callable[[], Artist]] = {"painter": PainterArtist, "ray": RayArtist}
"""Back ends that every machine has, by name."""


# ------------------------------------------------------------------------------------------
# Real objects that hide the drawn robot: geoms that are drawn to depth only.
#
# They come from a MuJoCo model, or from a TOML file of boxes::
#
#     [[box]]
#     position = [0.10, 0.05, 0.04]   # its middle, metres, in the frame of the board
#     size = [0.06, 0.06, 0.08]       # its edges, metres
#     yaw_deg = 20.0                  # about the vertical, 0 when not given


class BoxTable(Table):
    """A box: its middle and its edges in metres, turned about the vertical."""

    position: Position
    size: Annotated[
        tuple[Positive, Positive, Positive], Field(strict=False, description="three edges above 0, metres")
    ]
    yaw_deg: float = 0.0


class _BoxesFile(Table):
    box: Annotated[Several[BoxTable], Field(min_length=1, description="[[box]] with position and size")]


def load_occluders(path: Path | str) -> mujoco.MjModel:
    """The objects in a file, as a model whose world is the frame of the board.

    Raises:
        ConfigError: The file is missing, is no such file, or a box cannot be.
    """
    file = Path(path)
    if not file.is_file():
        raise ConfigError("there is no such file", file=file, allowed="boxes in TOML, or a MuJoCo model")
    if file.suffix.lower() != ".toml":
        try:
            return read_model(file, file)[0]
        except ModelError as error:
            raise ConfigError(f"is not a MuJoCo model: {error.reason or error}", file=file) from error
    return occluder_boxes(read_table(_BoxesFile, file, "the file of boxes").box)


def occluder_boxes(boxes: Iterable[BoxTable]) -> mujoco.MjModel:
    """A model of boxes."""
    spec = mujoco.MjSpec()
    for box in boxes:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.position,
            size=[0.5 * edge for edge in box.size],
            quat=rotation_exp([0.0, 0.0, np.deg2rad(box.yaw_deg)]).tolist(),
        )
    return spec.compile()
