"""How well drawings lie on pictures, in pixels: measured against ``cv2.projectPoints`` and exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.ar.draw import Artist, Figure, PainterArtist
from robot_ik.camera.ar.registrar import BoardWatcher, Registrar, Remedies, Seen
from robot_ik.camera.boards.board import MarkerBoard
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.standard_set import STANDARD_CAMERA, random_pose, render_markers
from robot_ik.camera.pose.bodies import grid_body
from robot_ik.camera.sources import Frame
from robot_ik.geometry import Pose, rotation_exp

Array = NDArray[np.float64]

#: A lens with strong distortion, and the same without any.
BENT = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9, (-0.28, 0.09, 0.001, -0.0007, 0.0))
STRAIGHT = CameraIntrinsics(640, 480, 612.0, 605.0, 331.3, 228.9)
# Spheres in the picture: radius and room round each, pixels.
_RADIUS_PX, _ROOM_PX = 8.0, 44
# Where a robot on the board may be: metres beside it and above it.
_BESIDE, _ABOVE, _POINTS = 0.15, 0.30, 120
_DICTIONARY = "DICT_4X4_50"
_BOARD = MarkerBoard(grid_body(2, 2, 0.05, 0.012).markers, _DICTIONARY)


@dataclass(frozen=True)
class Misses:
    """Distances between where things are and where they belong, pixels.

    Attributes:
        rms: Root mean square; ``worst`` the largest; ``bias`` the larger part of the mean.
        worst: See ``rms``.
        bias: See ``rms``.
        count: How many were measured.
    """

    rms: float
    worst: float
    bias: float
    count: int

    @classmethod
    def of(cls, offsets: ArrayLike) -> Misses:
        """From offsets (n, 2)."""
        off = np.asarray(offsets, dtype=float).reshape(-1, 2)
        if not len(off):
            return cls(float("nan"), float("nan"), float("nan"), 0)
        length = np.linalg.norm(off, axis=1)
        return cls(
            float(np.sqrt(np.mean(length**2))),
            float(length.max()),
            float(np.abs(off.mean(axis=0)).max()),
            len(off),
        )


def projection_identity(artist: Artist, intrinsics: CameraIntrinsics = BENT, *, seed: int = 3) -> Misses:
    """Centres of drawn spheres against those that OpenCV projects.

    Spheres of 8 px radius at random depths all over the picture; the middle of what is drawn of each is
    compared with the middle of its outline, the circle at which rays of sight touch it, projected by
    ``cv2.projectPoints``.
    """
    rng = np.random.default_rng(seed)
    spec, spheres = mujoco.MjSpec(), []
    for x in np.arange(_ROOM_PX / 2, intrinsics.width - _ROOM_PX / 2 + 1, _ROOM_PX):
        for y in np.arange(_ROOM_PX / 2, intrinsics.height - _ROOM_PX / 2 + 1, _ROOM_PX):
            depth = rng.uniform(0.4, 2.0)
            pixel = np.array([[x, y]]) + rng.uniform(-4.0, 4.0, (1, 2))
            centre = intrinsics.unproject(pixel)[0] * depth
            radius = _RADIUS_PX * depth / intrinsics.fx
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=centre.tolist()
            )
            spheres.append((pixel[0], centre, radius))
    figure = Figure(spec.compile(), shadow=False)
    drawn = artist.draw(figure, [], intrinsics, Pose()).robot.mask(*intrinsics.size).astype(float)
    half = _ROOM_PX // 2
    offsets = []
    for pixel, centre, radius in spheres:
        x, y = np.rint(pixel).astype(int)
        x0, y0 = max(x - half, 0), max(y - half, 0)
        part = drawn[y0 : y + half, x0 : x + half]
        alone = _middle(part, (x0, y0))
        offsets.append(alone - outline_middle(centre, radius, intrinsics))
    return Misses.of(offsets)


def _middle(part: Array, corner: tuple[int, int]) -> Array:
    """Centroid (2,) of the piece of a mask in the middle of ``part``, in pixels of the picture."""
    _, labels = cv2.connectedComponents((part > 0).astype(np.uint8))
    middle = labels[part.shape[0] // 2, part.shape[1] // 2]
    weight = np.where(labels == middle, part, 0.0) if middle else np.full_like(part, np.nan)
    rows, columns = np.indices(part.shape)
    return np.array(
        [
            (weight * columns).sum() / weight.sum() + corner[0],
            (weight * rows).sum() / weight.sum() + corner[1],
        ]
    )


def outline_middle(centre: Array, radius: float, intrinsics: CameraIntrinsics) -> Array:
    """Centroid (2,) of a sphere's outline in the picture, by ``cv2.projectPoints``."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)[:, None]
    shrink = (radius / distance) ** 2
    ring = radius * np.sqrt(1 - shrink) * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    coefficients = intrinsics.coefficients if len(intrinsics.distortion) else None
    pixels = np.asarray(
        cv2.projectPoints(
            centre * (1 - shrink) + ring, np.zeros(3), np.zeros(3), intrinsics.matrix, coefficients
        )[0]
    ).reshape(-1, 2)
    moments = cv2.moments((pixels - pixels[0]).astype(np.float32).reshape(-1, 1, 2))
    return np.asarray(
        pixels[0] + [moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]], dtype=float
    )


def robot_points(seed: int = 0) -> Array:
    """Points (n, 3) where a robot standing on the board may be, board frame, metres."""
    rng = np.random.default_rng([seed, 46])
    return rng.uniform((-_BESIDE, -_BESIDE, 0.0), (_BESIDE, _BESIDE, _ABOVE), (_POINTS, 3))


def overlay_error(distance: float, count: int = 20, *, seed: int = 0) -> Misses:
    """From picture to overlay: points of a robot on a 2 x 2 board (112 mm), against exact truth.

    The pictures are those of the standard set (blur, noise, uneven light, tilts up to 60 degrees).
    """
    rng = np.random.default_rng([seed, round(1e3 * distance)])
    watcher = BoardWatcher(_BOARD, STANDARD_CAMERA, window=False)
    points, offsets = robot_points(seed), []
    for number in range(count):
        pose, _ = random_pose(STANDARD_CAMERA, rng, distance, size=0.112)
        seen = watcher.see(_photograph(pose, rng, number, 0.0))
        if seen is None:
            continue
        true, drawn = (STANDARD_CAMERA.project(p.apply(points)) for p in (pose, seen.pose_camera_board))
        offsets.append((drawn - true)[_in_view(true)])
    return Misses.of(np.concatenate(offsets) if offsets else np.zeros((0, 2)))


def _in_view(pixels: Array) -> NDArray[np.bool_]:
    return np.asarray(((pixels > 0) & (pixels < np.array(STANDARD_CAMERA.size) - 1)).all(axis=1))


def _photograph(pose: Pose, rng: np.random.Generator, number: int, at: float) -> Frame:
    markers = {id: (side, pose.compose(place)) for id, (side, place) in _BOARD.layout.items()}
    image = render_markers(STANDARD_CAMERA, markers, rng, dictionary=_DICTIONARY, margin=0.12)
    return Frame(np.ascontiguousarray(np.repeat(image[:, :, None], 3, axis=2)), at, number)


def hand_motion(t: float) -> Pose:
    """``pose_camera_board`` of a board that a hand moves about 0.8 m away: some 200 mm/s, 40 deg/s."""
    place = (
        0.060 * np.sin(2.6 * t) + 0.015 * np.sin(6.1 * t + 1.0),
        0.035 * np.sin(3.4 * t + 0.7),
        0.80 + 0.04 * np.sin(1.9 * t),
    )
    facing = Pose(wxyz=rotation_exp([np.pi, 0.0, 0.0]))
    lean = rotation_exp([-0.6 + 0.20 * np.sin(2.2 * t), 0.15 * np.sin(2.9 * t), 0.35 * np.sin(1.7 * t)])
    return Pose(place, facing.compose(Pose(wxyz=lean)).wxyz)


REMEDIES: dict[str, tuple[float, Remedies]] = {
    "nothing": (1.0, Remedies("latest")),
    "less delay (half)": (0.5, Remedies("latest")),
    "image shifting": (1.0, Remedies("latest", shift=True)),
    "prediction": (1.0, Remedies("latest", predict=True)),
    "prediction and shifting": (1.0, Remedies("latest", predict=True, shift=True)),
    "delayed video": (0.0, Remedies("tracked")),
}
"""Azuma's remedies: what part of the delay is left, and what is done about it."""


def remedy_errors(
    delay: float = 0.066, seconds: float = 4.0, *, rate_hz: float = 30.0, seed: int = 0
) -> dict[str, Misses]:
    """Registration errors of a robot on a moving board when tracking and drawing take ``delay`` seconds.

    Each remedy is measured on the same pictures, with points of a robot on the board.
    """
    rng = np.random.default_rng([seed, 5])
    steps = max(1, round(delay * rate_hz))
    count = round(seconds * rate_hz)
    times = np.arange(count) / rate_hz
    frames = [_photograph(hand_motion(t), rng, k, float(t)) for k, t in enumerate(times)]
    watcher = BoardWatcher(_BOARD, STANDARD_CAMERA, window=False)
    looks = [watcher.see(frame) for frame in frames]
    return {
        name: _remedy_error(remedies, round(share * steps), frames, looks, robot_points(seed))
        for name, (share, remedies) in REMEDIES.items()
    }


def _remedy_error(
    remedies: Remedies, steps: int, frames: list[Frame], looks: list[Seen | None], points: Array
) -> Misses:
    registrar = Registrar(
        _Remembering(looks), PainterArtist(), Figure(mujoco.MjSpec().compile()), STANDARD_CAMERA, remedies
    )
    offsets = []
    for k in range(len(frames)):
        if k < steps:
            continue
        seen = registrar.track(frames[k - steps])
        # the first half second is for the filter to find the speed
        pose, motion = registrar.place(seen, frames[k])
        if pose is None or frames[k].time < 0.5:
            continue
        true = STANDARD_CAMERA.project(hand_motion(frames[k].time).apply(points))
        drawn = STANDARD_CAMERA.project(pose.apply(points))
        if motion is not None:
            drawn = drawn @ motion[:, :2].T + motion[:, 2]
        offsets.append((drawn - true)[_in_view(true)])
    return Misses.of(np.concatenate(offsets) if offsets else np.zeros((0, 2)))


class _Remembering(BoardWatcher):
    """Has seen all pictures before."""

    def __init__(self, looks: list[Seen | None]) -> None:
        self._looks = looks

    def see(self, frame: Frame) -> Seen | None:
        return self._looks[frame.sequence]
