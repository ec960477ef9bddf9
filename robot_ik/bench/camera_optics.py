"""Optics: a drawing where OpenCV projects it, a calibration and a hand-eye calibration near the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.camera_accuracy import rms
from robot_ik.bench.camera_rows import Effort, Figure
from robot_ik.camera.ar_draw import Figure as Robot
from robot_ik.camera.ar_draw import RayArtist
from robot_ik.camera.calibrate import calibrate
from robot_ik.camera.handeye import solve_handeye
from robot_ik.camera.handeye_set import handeye_set
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.painter import faces_in_picture, paint_mask
from robot_ik.camera.pattern_set import pattern_set
from robot_ik.camera.patterns import CharucoPattern
from robot_ik.camera.standard_set import STANDARD_CAMERA
from robot_ik.geometry import Pose

Array = NDArray[np.float64]

_PINHOLE = replace(STANDARD_CAMERA, distortion=())
# Spheres of 8 pixels' radius, so many points of each outline, and what is wanted with and without a lens.
_SPHERES, _RADIUS_PX, _OUTLINE = 80, 8.0, 720
# Places in each pixel that both back ends look at: fewer count pixels, which is coarser than they are.
_SAMPLES = 16
_WANTED = {"pinhole": (_PINHOLE, 0.05, 0.15), "with distortion": (STANDARD_CAMERA, 0.08, 0.20)}
# The board: 8×6 squares of 30 mm with markers of 22 mm.
_PATTERN = CharucoPattern(8, 6, 0.030, 0.022)
_VIEWS = 20
# Hand-eye: how many poses, and the spread of their rotations in degrees.
_POSES, _SPREAD = 15, 25.0


def projection(effort: Effort) -> Iterator[Figure]:
    """Middles of drawn spheres against those of their outlines by ``cv2.projectPoints``."""
    for kind, (lens, wanted, worst) in _WANTED.items():
        misses: dict[str, list[float]] = {"painter": [], "ray": []}
        rng, rays = np.random.default_rng(effort.seed), RayArtist(_SAMPLES)
        for _ in range(effort.count(_SPHERES)):
            model, outline = _sphere(lens, rng)
            middle = _centroid(outline)
            qpos = np.zeros(0)
            faces = faces_in_picture(model, qpos, lens, Pose())
            painted = paint_mask((lens.height, lens.width), faces, count=_SAMPLES) / 255.0
            misses["painter"].append(float(np.linalg.norm(_middle(painted, (0, 0)) - middle)))
            cast = rays.draw(Robot(model, shadow=False), qpos, lens, Pose()).robot
            misses["ray"].append(float(np.linalg.norm(_middle(cast.coverage / 255.0, cast.box[:2]) - middle)))
        for name, away in misses.items():
            yield Figure(f"{name} against projectPoints, {kind}, RMS", rms(away), "px", wanted)
            yield Figure(f"{name} against projectPoints, {kind}, worst", max(away), "px", worst)


def _sphere(lens: CameraIntrinsics, rng: np.random.Generator) -> tuple[mujoco.MjModel, Array]:
    """A sphere before the camera, and its outline (n, 2) in pixels: where its cone of tangents leads."""
    pixel, z = rng.uniform((40, 40), np.array(lens.size) - 41), rng.uniform(0.4, 2.0)
    centre = lens.unproject(pixel) * z
    radius = _RADIUS_PX * z / lens.fx
    way = np.linalg.norm(centre)
    axis = centre / way
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)[:, None]
    ring = np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
    points = centre * (1.0 - (radius / way) ** 2) + radius * np.sqrt(1.0 - (radius / way) ** 2) * ring
    place = " ".join(f"{value:.12g}" for value in centre)
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom type='sphere' size='{radius:.12g}' pos='{place}'/></worldbody></mujoco>"
    )
    lens_terms = np.array(lens.distortion) if lens.distortion else None
    seen = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), lens.matrix, lens_terms)[0]
    return model, np.asarray(seen, dtype=float).reshape(-1, 2)


def _centroid(outline: Array) -> Array:
    """Middle (2,) of the area inside an outline (n, 2)."""
    x, y = outline.T
    x2, y2 = np.roll(outline, -1, axis=0).T
    cross = x * y2 - x2 * y
    return np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3.0 * cross.sum())


def _middle(mask: Array, corner: tuple[int, int]) -> Array:
    """Middle (2,) of a mask whose pixel (0, 0) is ``corner`` of the picture."""
    y, x = np.indices(mask.shape)
    return np.array([(mask * x).sum(), (mask * y).sum()]) / mask.sum() + np.array(corner)


def calibration(effort: Effort) -> Iterator[Figure]:
    """Intrinsics from 20 pictures of a ChArUco board; worst of the sets tried."""
    focal, centre, error, counted = [], [], [], []
    for trial in range(1 if effort.quick else 3):
        views = pattern_set(_PATTERN, STANDARD_CAMERA, _VIEWS, seed=effort.seed + trial)
        found = [seen for view in views if (seen := _PATTERN.find(view.image)) is not None]
        result = calibrate(found, STANDARD_CAMERA.size)
        lens = result.intrinsics
        focal.append(max(abs(lens.fx / STANDARD_CAMERA.fx - 1.0), abs(lens.fy / STANDARD_CAMERA.fy - 1.0)))
        centre.append(float(np.hypot(lens.cx - STANDARD_CAMERA.cx, lens.cy - STANDARD_CAMERA.cy)))
        error.append(result.rms)
        counted.append(len(found))
    yield Figure("focal length, off by", 100.0 * max(focal), "%", 0.15)
    yield Figure("optical centre, off by", max(centre), "px", 2.0)
    yield Figure("reprojection error, RMS", max(error), "px", 0.2)
    yield Figure("views in which the board was found", min(counted), "", _VIEWS, at_least=True)


def handeye(effort: Effort) -> Iterator[Figure]:
    """Camera on the hand: true error and stated uncertainty, from 15 poses and a single 50 mm marker."""
    off, stated = [], []
    for trial in range(effort.count(40)):
        truth, samples = handeye_set(_POSES, spread_deg=_SPREAD, seed=1000 * effort.seed + trial)
        found = solve_handeye(samples, STANDARD_CAMERA, mounting="eye_in_hand")
        off.append(found.pose_parent_camera.distance(truth.pose_parent_camera))
        stated.append((found.sigma_position, found.sigma_angle))
    error, sigma = np.array(off), np.array(stated)
    yield Figure("camera on the hand, position, RMS", 1e3 * rms(error[:, 0]), "mm", 1.5)
    yield Figure("camera on the hand, orientation, RMS", float(np.degrees(rms(error[:, 1]))), "°", 0.25)
    for k, what in enumerate(("position", "orientation")):
        ratio = rms(error[:, k]) / rms(sigma[:, k])
        yield Figure(f"stated {what} off by a factor of", max(ratio, 1.0 / ratio), "", 2.0)
