"""A camera that exists only in numbers: exact optics, known truth, the same interface as a real one.

It shows a robot, a table and printed markers through a distorting lens, with blur and noise.  Where the
robot really stands is asked from a callable, so a fault of the arm shows in the picture.  ``Frame.truth``
holds what is really the case; a program under test must not see it (``Frame.without_truth``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.prints import PRINT_MARKER, SeenPrint, blank_paper, marker_print
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.synthetic.photograph import INK, PAPER, QUALITIES, Photographer, PlacedPrint
from robot_ik.camera.synthetic.scene import Lights, SceneTable, still_picture
from robot_ik.camera.synthetic.sensor import WEBCAM, SensorModel
from robot_ik.camera.targets import marker_points
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Clock
from robot_ik.robot import Robot

# Pixels by which the piece of noise is larger that pictures share: 257² parts.
_LARGER = 256


def _sensor_noise(size: tuple[int, int], seed: int, picture: int, shared: bool) -> NDArray[np.float32]:
    """Normal noise (h, w, 3) of sigma 1, not to be written to; picture k of one seed always gets the same.

    ``shared``: some part of one larger piece.  Drawing noise takes as long as a third of a fast picture.
    """
    (w, h), rng = size, np.random.default_rng([seed, picture])
    if not shared:
        return rng.standard_normal((h, w, 3), dtype=np.float32)
    y, x = rng.integers(_LARGER + 1, size=2)
    return _larger_piece((h + _LARGER, w + _LARGER, 3), seed)[y : y + h, x : x + w]


# A piece for pictures of 1280x720 takes 18 MB and as long as a quarter of one of them.
@lru_cache(maxsize=1)
def _larger_piece(shape: tuple[int, int, int], seed: int) -> NDArray[np.float32]:
    """The (cached) noise that the pictures of a source share; not to be written to."""
    piece = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    piece.setflags(write=False)
    return piece


Condition = Literal["printed", "blank", "covered"]
# Of the patch that covers a marker: reflectance, as ink on paper.
_PATCH = (PAPER - 0.45) / (PAPER - INK)
# A marker of which less than this is seen does not count as visible in the truth.
_VISIBLE_PART = 0.02
# White round a marker: detectors take the paper's own outline for the marker's when it is much nearer.
_MARGIN_CELLS = 1.5
# Brightness lost in the corners of the picture.
_VIGNETTE = 0.10


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Pose:
    """Where a camera is that looks from ``position`` at ``target``: ``pose_world_camera``.

    OpenCV camera axes: x right, y down, z forward; ``up`` is upwards in the picture.

    Raises:
        CameraError: Position and target coincide, or ``up`` is along the view.
    """
    eye = np.asarray(position, dtype=float)
    forward = np.asarray(target, dtype=float) - eye
    right = np.cross(forward, np.asarray(up, dtype=float))
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise CameraError(
            f"a camera at {position!r} cannot look at {target!r} with {up!r} upwards",
            hint="choose another target, or an up direction that is not along the view",
        )
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    return Pose.from_rotation(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


@dataclass(frozen=True)
class SyntheticMarker:
    """A printed marker, either at a place in the world or carried by a frame of the robot.

    Marker axes: x right, y up, z out of the print.

    Attributes:
        id: In the dictionary.
        size: Side of the black border, metres.
        pose: In the world, or seen from ``frame``; a callable is asked with the time in seconds.
        frame: Robot frame that carries it; ``None``: it stands in the world.
        dictionary: OpenCV's name of it.
        margin: White paper beyond the border, metres; 1.5 cells when not given.
        condition: ``printed``, ``blank`` (white paper only) or ``covered`` (a grey patch over it).
    """

    id: int
    size: float
    pose: Pose | Callable[[float], Pose] = Pose()
    frame: str | None = None
    dictionary: str = "DICT_5X5_50"
    margin: float | None = None
    condition: Condition = "printed"

    def pose_world(self, scene: SyntheticScene, q: Array, now: float) -> Pose:
        """Where it is when the robot stands at ``q`` and the time is ``now``."""
        return scene.placed(self.pose(now) if callable(self.pose) else self.pose, self.frame, q)


@dataclass(frozen=True)
class SyntheticScene:
    """What the synthetic camera looks at.

    Attributes:
        robot: What moves; objects that do not move come as their model.
        intrinsics: The lens.
        pose_world_camera: OpenCV camera axes seen from the world, or from ``camera_frame``.
        markers: Each id once per dictionary.
        table: ``None`` for no table.
        camera_frame: Robot frame that carries the camera; ``None``: it stands in the world.
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
            raise CameraError(
                f"a marker appears twice in the scene: {sorted(names)}", hint="give each its own id"
            )

    def with_marker(self, *ids: int, **changes: object) -> SyntheticScene:
        """The scene with some fields of these markers changed, e.g. ``pose`` or ``condition``.

        Raises:
            CameraError: The scene has no such marker.
        """
        known = [m.id for m in self.markers]
        if missing := set(ids) - set(known):
            raise CameraError(f"the scene has no marker {min(missing)}", hint=f"it has {known}")
        changed = tuple(replace(m, **changes) if m.id in ids else m for m in self.markers)  # type: ignore[arg-type]
        return replace(self, markers=changed)

    @property
    def model(self) -> mujoco.MjModel:
        """Of the robot, or the objects."""
        return self.robot.model if isinstance(self.robot, Robot) else self.robot

    def qpos(self, q: Array) -> Array:
        """Of ``model`` (nq,) when the robot stands at ``q``."""
        return self.robot.qpos(q) if isinstance(self.robot, Robot) else np.array(self.robot.qpos0)

    def camera(self, q: Array) -> Pose:
        """``pose_world_camera`` when the robot stands at ``q`` (nq,)."""
        return self.placed(self.pose_world_camera, self.camera_frame, q)

    def placed(self, pose: Pose, frame: str | None, q: Array) -> Pose:
        """A pose in the world of what stands there, or is carried by a ``frame`` of the robot at ``q``."""
        if frame is None:
            return pose
        assert isinstance(self.robot, Robot), "what does not move has no frame that carries anything"
        return self.robot.forward(q, frame).compose(pose)


class SyntheticSource(FrameSource):
    """Photographs of a ``SyntheticScene``: a ``FrameSource`` with ``truth``.

    A camera that the robot carries sees another empty scene in each picture, which takes longer.

    Args:
        scene: What to look at; may be replaced between pictures (``source.scene = ...``) as long as lens,
            table and robot stay the same.
        true_q: Where the robot really is, (nq,), asked at each picture.
        seed: Of the sensor noise; picture k of two sources with one seed is the same.
        sensor: What the camera makes of the light; a webcam when not given.
        clock: Gives ``Frame.time``; the machine's monotonic clock when not given.
        quality: ``full`` for a photograph, ``fast`` for following: the robot is coarse, markers stay exact.
            May be changed between pictures: ``source.quality = QUALITIES[...]``.
    """

    live = True

    def __init__(
        self,
        scene: SyntheticScene,
        true_q: Callable[[], ArrayLike],
        seed: int = 0,
        sensor: SensorModel = WEBCAM,
        clock: Clock | None = None,
        quality: Literal["full", "fast"] = "full",
    ) -> None:
        if quality not in QUALITIES:
            raise CameraError(f"unknown quality {quality!r}", hint=f"known: {', '.join(QUALITIES)}")
        self.scene = scene
        self.size = scene.intrinsics.size
        self._true_q, self._sensor, self._seed = true_q, sensor, seed
        self._clock, self.quality = clock, QUALITIES[quality]
        self._sequence = 0
        self._photographer: tuple[Pose, Photographer] | None = None
        self._vignette: NDArray[np.float32] | None = None

    def read(self) -> Frame:
        """Takes the next picture; its ``truth`` is a dict.

        * ``q`` (nq,), ``pose_world_camera``,
        * ``pose_camera_marker`` and ``pose_world_marker``: by id, of the markers that are seen,
        * ``corners``: by id (4, 2) pixels in OpenCV's order, ``visible``: by id the part seen, 0..1.
        """
        # Before the clock is asked: a sensor has its noise in no time.
        noise = None
        if self._sensor.noise > 0:
            noise = _sensor_noise(self.size, self._seed, self._sequence, self.quality.same_noise)
        now = time.monotonic() if self._clock is None else self._clock.now()
        q = np.array(self._true_q(), dtype=float)
        scene, camera = self.scene, self.scene.camera(q)
        poses = [m.pose_world(scene, q, now) for m in scene.markers]
        sheets = [_placed(m, p) for m, p in zip(scene.markers, poses, strict=True)]
        light, _, painted = self._at(camera).expose(scene.qpos(q), self.quality, sheets)
        truth = self._truth(q, camera, poses, painted)
        frame = Frame(self._develop(light, noise), now, self._sequence, truth)
        self._sequence += 1
        return frame

    def _at(self, camera: Pose) -> Photographer:
        if self._photographer is None or self._photographer[0] != camera:
            scene, lens = self.scene, self.scene.intrinsics
            distance = _subject_distance(scene, camera)
            x, y, z = camera.apply([0.0, 0.0, distance]).tolist()
            lights = Lights.beside(camera, distance)
            still = still_picture(lens, camera, scene.table, lights, (x, y, z))
            self._photographer = camera, Photographer(scene.model, lens, camera, lights, still)
        return self._photographer[1]

    def _develop(self, light: NDArray[np.float32], noise: NDArray[np.float32] | None) -> NDArray[np.uint8]:
        """Lens and sensor: vignette, then what the model of the sensor says."""
        if self._vignette is None:
            w, h = self.size
            x, y = np.linspace(-1, 1, w, dtype=np.float32), np.linspace(-1, 1, h, dtype=np.float32)
            plain = 255.0 * (1 - _VIGNETTE * 0.5 * (x[None, :] ** 2 + y[:, None] ** 2))
            self._vignette = np.dstack([plain, plain, plain])
        return self._sensor.developed(self._sensor.scattered(cv2.multiply(light, self._vignette)), noise)

    def _truth(
        self, q: Array, camera: Pose, poses: list[Pose], painted: list[SeenPrint | None]
    ) -> dict[str, object]:
        scene, inverse = self.scene, camera.inverse()
        seen = [
            (m, p, mark.visible)
            for m, p, mark in zip(scene.markers, poses, painted, strict=True)
            if mark is not None and mark.visible > _VISIBLE_PART and m.condition == "printed"
        ]
        return {
            "q": q,
            "pose_world_camera": camera,
            "pose_world_marker": {m.id: p for m, p, _ in seen},
            "pose_camera_marker": {m.id: inverse.compose(p) for m, p, _ in seen},
            "corners": {
                m.id: scene.intrinsics.project(inverse.compose(p).apply(marker_points(m.size)))
                for m, p, _ in seen
            },
            "visible": {m.id: part for m, _, part in seen},
        }


def _placed(marker: SyntheticMarker, pose: Pose) -> PlacedPrint:
    margin = marker.margin
    if margin is None:
        margin = _MARGIN_CELLS * marker.size / len(marker_bits(marker.dictionary, marker.id))
    if marker.condition == "printed":
        sheet = marker_print(marker.dictionary, marker.id, marker.size, margin)
    else:
        sheet = blank_paper(marker.size + 2.0 * margin, _PATCH if marker.condition == "covered" else 0.0)
    return PlacedPrint(sheet, pose.compose(PRINT_MARKER), marker.frame is not None)


def _subject_distance(scene: SyntheticScene, camera: Pose) -> float:
    """How far from the lens the objects of interest are: the table, else the robot's middle, metres."""
    inverse = camera.inverse()
    if scene.table is not None:
        centre = np.array([np.mean(scene.table.x), np.mean(scene.table.y), scene.table.height])
    else:
        centre = np.array(scene.model.stat.center, dtype=float)
    return float(max(inverse.apply(centre)[2], 0.3))
