"""Synthetic camera with exact optics, known truth and the interface of a real camera.

It shows a robot, a table and printed markers through a distorting lens, with blur and noise. A
callable gives the true configuration of the robot, so a fault of the arm shows in the picture.
``Frame.truth`` holds the truth. A program under test must not use it (``Frame.without_truth``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.drawing.prints import PRINT_MARKER, ProjectedPrint, blank_paper, marker_print
from robot_ik.camera.image import Float32, marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.painted import INK, PAPER, PaintedScene, PlacedPrint, SceneTable
from robot_ik.camera.synthetic.sensor import WEBCAM, SensorModel
from robot_ik.camera.targets import marker_points
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Clock
from robot_ik.robot import Robot

Condition = Literal["printed", "blank", "covered"]

# The noise of a picture is a part of one larger piece, larger by this many pixels: 257² parts.
# Drawing new noise would take a third of the time of a picture.
_NOISE_MARGIN = 256
# Ink of the grey patch that covers a marker. Its reflectance is 0.45.
_PATCH_INK = (PAPER - 0.45) / (PAPER - INK)
# A marker does not count as visible in the truth if less than this part of it is visible.
_VISIBLE_PART = 0.02
# White paper round a marker, in cells. Detectors take the outline of the paper for that of the
# marker if it is much nearer.
_MARGIN_CELLS = 1.5
# Brightness lost in the corners of the picture.
_VIGNETTE = 0.10


@dataclass(frozen=True)
class SyntheticMarker:
    """A printed marker, either at a place in the world or carried by a frame of the robot.

    Marker axes: x right, y up, z out of the print.

    Attributes:
        id: In the dictionary.
        size: Side of the black border, metres.
        pose: In the world, or seen from ``frame``. A callable returns it for a time in seconds.
        frame: Robot frame that carries the marker. None: it is fixed in the world.
        dictionary: OpenCV's name of the dictionary.
        margin: White paper beyond the border, metres. Default: 1.5 cells.
        condition: ``printed``, ``blank`` (only white paper) or ``covered`` (by a grey patch).
    """

    id: int
    size: float
    pose: Pose | Callable[[float], Pose] = Pose()
    frame: str | None = None
    dictionary: str = "DICT_5X5_50"
    margin: float | None = None
    condition: Condition = "printed"

    def pose_world(self, scene: SyntheticScene, q: Array, now: float) -> Pose:
        """Return its pose in the world for a robot at ``q`` (nq,) and a time in seconds."""
        return scene.placed(self.pose(now) if callable(self.pose) else self.pose, self.frame, q)


@dataclass(frozen=True)
class SyntheticScene:
    """Scene of a synthetic camera.

    Attributes:
        robot: The robot, or a model of objects that do not move.
        intrinsics: The lens.
        pose_world_camera: OpenCV camera axes seen from the world, or from ``camera_frame``.
        markers: Each id once per dictionary.
        table: None for no table.
        camera_frame: Robot frame that carries the camera. None: it is fixed in the world.

    Raises:
        CameraError: A marker appears twice.
    """

    robot: Robot | mujoco.MjModel
    intrinsics: CameraIntrinsics
    pose_world_camera: Pose
    markers: tuple[SyntheticMarker, ...] = ()
    table: SceneTable | None = None
    camera_frame: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "markers", tuple(self.markers))
        names = [(m.dictionary, m.id) for m in self.markers]
        if len(set(names)) != len(names):
            problem = f"a marker appears twice in the scene: {sorted(names)}"
            raise CameraError(problem, hint="give each marker a different id")

    def with_marker(self, *ids: int, **changes: Any) -> SyntheticScene:
        """Return the scene with some fields of these markers changed, e.g. ``condition``.

        Raises:
            CameraError: The scene has no such marker.
        """
        known = [m.id for m in self.markers]
        missing = set(ids) - set(known)
        if missing:
            raise CameraError(f"the scene has no marker {min(missing)}", hint=f"it has {known}")
        changed = tuple(replace(m, **changes) if m.id in ids else m for m in self.markers)
        return replace(self, markers=changed)

    @property
    def model(self) -> mujoco.MjModel:
        """The model of the robot, or of the objects."""
        return self.robot.model if isinstance(self.robot, Robot) else self.robot

    def qpos(self, q: Array) -> Array:
        """Return ``model``'s full configuration (model.nq,) for a robot at ``q`` (nq,)."""
        return self.robot.qpos(q) if isinstance(self.robot, Robot) else np.array(self.robot.qpos0)

    def camera(self, q: Array) -> Pose:
        """Return ``pose_world_camera`` for a robot at ``q`` (nq,)."""
        return self.placed(self.pose_world_camera, self.camera_frame, q)

    def placed(self, pose: Pose, frame: str | None, q: Array) -> Pose:
        """Return the world pose of an object that is fixed, or carried by a ``frame`` at ``q``.

        Raises:
            CameraError: A frame of a scene without a robot.
        """
        if frame is None:
            return pose
        if not isinstance(self.robot, Robot):
            raise CameraError(
                f"no frame {frame!r}: the scene has no robot",
                hint="give SyntheticScene a Robot, or place the object in the world",
            )
        return self.robot.forward(q, frame).compose(pose)


class SyntheticSource(FrameSource):
    """Pictures of a ``SyntheticScene``: a ``FrameSource`` with ``truth``.

    Args:
        scene: May be replaced between pictures (``source.scene = ...``). Lens, table and robot
            must stay the same.
        true_q: Returns the true configuration (nq,) of the robot, at each picture.
        seed: Of the sensor noise. Picture k of two sources with one seed is the same.
        sensor: Model of the sensor. Default: a webcam.
        clock: Gives ``Frame.time``. Default: the machine's monotonic clock.
    """

    live = True

    def __init__(
        self,
        scene: SyntheticScene,
        true_q: Callable[[], ArrayLike],
        seed: int = 0,
        sensor: SensorModel = WEBCAM,
        clock: Clock | None = None,
    ) -> None:
        self.scene = scene
        self.size = scene.intrinsics.size
        self._true_q = true_q
        self._sensor = sensor
        self._seed = seed
        self._clock = clock
        self._sequence = 0
        self._painted: tuple[Pose, PaintedScene] | None = None

    def read(self) -> Frame:
        """Take the next picture.

        Its ``truth`` is a dict:

        * ``q`` (nq,) and ``pose_world_camera``,
        * ``pose_camera_marker`` and ``pose_world_marker``: by id, of the visible markers,
        * ``corners``: by id, (4, 2) pixels in OpenCV's order,
        * ``visible``: by id, the visible part, 0 to 1.
        """
        # The computation of the noise must not delay the picture, so it precedes the clock reading.
        noise = None
        if self._sensor.noise > 0:
            noise = _sensor_noise(self.size, self._seed, self._sequence)
        now = time.monotonic() if self._clock is None else self._clock.now()
        q = np.array(self._true_q(), dtype=float)
        camera = self.scene.camera(q)
        poses = [marker.pose_world(self.scene, q, now) for marker in self.scene.markers]
        sheets = [placed_print(m, p) for m, p in zip(self.scene.markers, poses, strict=True)]
        exposure = self._scene_from(camera).expose(self.scene.qpos(q), sheets)
        light = cv2.multiply(exposure.light, _vignette(self.size))
        image = self._sensor.developed(self._sensor.scattered(light), noise)
        frame = Frame(image, now, self._sequence, self._truth(q, camera, poses, exposure.sheets))
        self._sequence += 1
        return frame

    def _scene_from(self, camera: Pose) -> PaintedScene:
        """Return the scene from a camera pose. It is cached for a camera that does not move."""
        if self._painted is None or self._painted[0] != camera:
            scene = self.scene
            painted = PaintedScene(scene.model, scene.intrinsics, camera, scene.table)
            self._painted = (camera, painted)
        return self._painted[1]

    def _truth(
        self, q: Array, camera: Pose, poses: list[Pose], sheets: list[ProjectedPrint | None]
    ) -> dict[str, object]:
        lens = self.scene.intrinsics
        inverse = camera.inverse()
        visible = [
            (marker, pose, sheet.visible)
            for marker, pose, sheet in zip(self.scene.markers, poses, sheets, strict=True)
            if sheet is not None and sheet.visible > _VISIBLE_PART and marker.condition == "printed"
        ]
        corners = {
            m.id: lens.project(inverse.compose(pose).apply(marker_points(m.size)))
            for m, pose, _ in visible
        }
        return {
            "q": q,
            "pose_world_camera": camera,
            "pose_world_marker": {m.id: pose for m, pose, _ in visible},
            "pose_camera_marker": {m.id: inverse.compose(pose) for m, pose, _ in visible},
            "corners": corners,
            "visible": {m.id: part for m, _, part in visible},
        }


def placed_print(marker: SyntheticMarker, pose: Pose) -> PlacedPrint:
    """Return the print of a marker at a pose in the world."""
    margin = marker.margin
    if margin is None:
        margin = _MARGIN_CELLS * marker.size / len(marker_bits(marker.dictionary, marker.id))
    if marker.condition == "printed":
        sheet = marker_print(marker.dictionary, marker.id, marker.size, margin)
    else:
        ink = _PATCH_INK if marker.condition == "covered" else 0.0
        sheet = blank_paper(marker.size + 2.0 * margin, ink)
    return PlacedPrint(sheet, pose.compose(PRINT_MARKER), marker.frame is not None)


@lru_cache(maxsize=2)
def _vignette(size: tuple[int, int]) -> Float32:
    """Return 255 times the part (h, w, 3) of the light that passes the lens."""
    width, height = size
    x = np.linspace(-1, 1, width, dtype=np.float32)
    y = np.linspace(-1, 1, height, dtype=np.float32)
    light = 255.0 * (1 - _VIGNETTE * 0.5 * (x[None, :] ** 2 + y[:, None] ** 2))
    return np.dstack([light, light, light])


def _sensor_noise(size: tuple[int, int], seed: int, picture: int) -> Float32:
    """Return normal noise (h, w, 3) of sigma 1, the same for one seed and picture.

    It must not be changed.
    """
    width, height = size
    y, x = np.random.default_rng([seed, picture]).integers(_NOISE_MARGIN + 1, size=2)
    piece = _noise_piece((height + _NOISE_MARGIN, width + _NOISE_MARGIN, 3), seed)
    return piece[y : y + height, x : x + width]


# A piece for pictures of 1280x720 takes 18 MB.
@lru_cache(maxsize=1)
def _noise_piece(shape: tuple[int, int, int], seed: int) -> Float32:
    """Return the (cached) noise that the pictures of a source share. It must not be changed."""
    piece = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    piece.setflags(write=False)
    return piece
