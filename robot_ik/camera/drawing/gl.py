"""The pretty back end: MuJoCo's OpenGL renderer behind a calibrated lens, where the machine has one.

Whether OpenGL works is tried in a child process with a time limit, because a driver that fails may abort the
process that asks.  ``MUJOCO_GL`` is never set: MuJoCo reads it once, on import.  Instead a renderer is given
the context that was tried.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.drawing.meshes import VISIBLE_GROUPS
from robot_ik.camera.drawing.painter import Layer
from robot_ik.camera.drawing.probe import GL_OFF, probe_gl
from robot_ik.camera.drawing.raycast import ray_field
from robot_ik.camera.drawing.renderers import ARTISTS, Artist, RobotView
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Image

#: Back ends in the order in which they are tried; what the user has chosen comes first.
TRIED = ("egl", "osmesa")
_PROBE_LIMIT = 20.0
_NEAR, _FAR = 0.02, 60.0
# The pinhole picture that is warped through the lens is drawn this much finer.
_FINER = 1.5
_LARGEST = 3000


def choose_gl() -> tuple[str, str]:
    """Which OpenGL draws here: a value of ``MUJOCO_GL``, empty for none; and why.

    It is the first back end that draws a picture in a child process.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked in GL_OFF and asked:
        return "", f"MUJOCO_GL={asked} forbids it"
    reasons = []
    for backend in (asked,) if asked else TRIED:
        probe = probe_gl(backend, timeout=_PROBE_LIMIT)
        if probe.ok:
            return backend, probe.text
        reasons.append(f"{backend}: {probe.text}")
    return "", "; ".join(reasons)


def make_artist(name: str) -> tuple[Artist, str]:
    """The back end of that name, and one line where it is another one than asked.

    Raises:
        CameraError: Unknown name.
    """
    if name in ARTISTS:
        return ARTISTS[name](), ""
    if name != "gl":
        raise CameraError(f"unknown back end {name!r}", hint=f"known: {', '.join(ARTISTS)}, gl")
    backend, reason = choose_gl()
    if not backend:
        return ARTISTS["painter"](), f"no OpenGL here ({reason}): the painter draws instead"
    return GlArtist(backend), ""


@contextlib.contextmanager
def _context_of(backend: str) -> Iterator[None]:
    """MuJoCo's renderer makes its context with what this back end has, whatever was chosen on import."""
    chooser: Any = importlib.import_module("mujoco.rendering.classic.gl_context")
    own = chooser.GLContext
    made: Any = importlib.import_module(f"mujoco.{backend}")
    chooser.GLContext = made.GLContext
    try:
        yield
    finally:
        chooser.GLContext = own


def pinhole_for(intrinsics: CameraIntrinsics, finer: float) -> CameraIntrinsics:
    """A camera without distortion that sees all that this one sees, drawn ``finer`` in its middle."""
    low, high = intrinsics.extent
    fx, fy = finer * intrinsics.fx, finer * intrinsics.fy
    shrink = min(1.0, _LARGEST / max(fx * (high[0] - low[0]), fy * (high[1] - low[1])))
    fx, fy = fx * shrink, fy * shrink
    width = int(np.ceil(fx * (high[0] - low[0]))) + 4
    height = int(np.ceil(fy * (high[1] - low[1]))) + 4
    return CameraIntrinsics(width, height, fx, fy, 2.0 - fx * low[0], 2.0 - fy * low[1])


def write_frustum(camera: Any, intrinsics: CameraIntrinsics) -> None:
    """Gives a ``MjvGLCamera`` the frustum of a camera without distortion, principal point included.

    OpenCV's picture spans -0.5 to W - 0.5, OpenGL's 0 to W, hence the halves; ``frustum_width`` is the *half*
    width, whatever its comment says (MuJoCo 4.0).
    """
    w, h = intrinsics.size
    camera.frustum_near, camera.frustum_far = _NEAR, _FAR
    camera.frustum_top = (intrinsics.cy + 0.5) * _NEAR / intrinsics.fy
    camera.frustum_bottom = -(h - intrinsics.cy - 0.5) * _NEAR / intrinsics.fy
    camera.frustum_center = (w - 2.0 * intrinsics.cx - 1.0) * _NEAR / (2.0 * intrinsics.fx)
    camera.frustum_width = w * _NEAR / (2.0 * intrinsics.fx)


class GlArtist(Artist):
    """Renders with MuJoCo's OpenGL renderer: materials, lights and shadows of the model itself.

    Args:
        backend: A value of ``MUJOCO_GL`` that has drawn in a child process.
    """

    name = "gl"

    def __init__(self, backend: str) -> None:
        self._backend = backend
        self._renderers: dict[tuple[mujoco.MjModel, int, int], tuple[Any, mujoco.MjData]] = {}
        self._maps: dict[CameraIntrinsics, tuple[CameraIntrinsics, Any]] = {}

    def close(self) -> None:
        """Lets go of the contexts."""
        for renderer, _ in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _robot(self, view: RobotView) -> Layer:
        pinhole, (map_x, map_y) = self._lens(view.intrinsics)
        colour, mask = self._render(view, pinhole)
        x0, y0, x1, y1 = view.box
        crop = (slice(y0, y1), slice(x0, x1))
        # the finer picture is averaged over a pixel before it is sampled
        blur = max(0.3, 0.35 * pinhole.fx / view.intrinsics.fx)
        sheet = np.dstack([np.where(mask[..., None] > 0, colour, 0), mask]).astype(np.uint8)
        sheet = np.asarray(cv2.GaussianBlur(sheet, (0, 0), blur), dtype=np.uint8)
        seen = np.asarray(cv2.remap(sheet, map_x[crop], map_y[crop], cv2.INTER_LINEAR), dtype=np.uint8)
        return Layer(view.box, np.ascontiguousarray(seen[..., :3]), np.ascontiguousarray(seen[..., 3]))

    def _lens(self, intrinsics: CameraIntrinsics) -> tuple[CameraIntrinsics, Any]:
        if intrinsics not in self._maps:
            pinhole = pinhole_for(intrinsics, _FINER)
            normalized = ray_field(intrinsics).box(0, 0, *intrinsics.size)
            maps = pinhole.fx * normalized[..., 0] + pinhole.cx, pinhole.fy * normalized[..., 1] + pinhole.cy
            self._maps[intrinsics] = pinhole, tuple(part.astype(np.float32) for part in maps)
        return self._maps[intrinsics]

    def _render(self, view: RobotView, pinhole: CameraIntrinsics) -> tuple[Image, Image]:
        """Colour (h, w, 3) BGR and mask (h, w) of the robot through a pinhole, occluders taken away."""
        drawn, camera = view.drawn, view.drawn.camera(view.pose_board_camera)
        colour, geom, depth = self._pictures(drawn.model, view.qpos, pinhole, camera)
        hidden = geom < 0
        if drawn.occluder_geoms is not None:
            hidden |= (geom >= 0) & drawn.occluder_geoms[geom]
        if drawn.occluders is not None:
            occluders = drawn.occluders
            _, other, before = self._pictures(occluders, occluders.qpos0, pinhole, view.pose_board_camera)
            hidden |= (other >= 0) & (before < depth * drawn.scale)
        return colour, np.where(hidden, 0, 255).astype(np.uint8)

    def _pictures(
        self, model: mujoco.MjModel, qpos: ArrayLike, pinhole: CameraIntrinsics, pose: Pose
    ) -> tuple[Image, NDArray[np.int32], Array]:
        renderer, data = self._renderer(model, *pinhole.size)
        data.qpos[:] = np.asarray(qpos, dtype=float)
        mujoco.mj_forward(model, data)

        def render() -> Any:
            option = mujoco.MjvOption()
            option.geomgroup[:] = VISIBLE_GROUPS
            renderer.update_scene(data, scene_option=option)
            for eye in renderer.scene.camera:
                write_frustum(eye, pinhole)
                eye.pos[:] = pose.position
                eye.forward[:] = pose.rotation[:, 2]
                eye.up[:] = -pose.rotation[:, 1]
            return renderer.render()

        # no shadows from the model's own lamps: the sheet below has one
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        colour = np.ascontiguousarray(render()[..., ::-1])
        renderer.enable_segmentation_rendering()
        labels = render()
        renderer.disable_segmentation_rendering()
        renderer.enable_depth_rendering()
        depth = np.asarray(render(), dtype=float)
        renderer.disable_depth_rendering()
        geom = np.where(labels[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM), labels[..., 0], -1)
        flat = np.asarray(model.geom_type) == int(mujoco.mjtGeom.mjGEOM_PLANE)
        geom[(geom >= 0) & flat[geom]] = -1
        return colour, geom.astype(np.int32), depth

    def _renderer(self, model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjData]:
        key = (model, width, height)
        if key not in self._renderers:
            model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
            model.vis.global_.offheight = max(model.vis.global_.offheight, height)
            with _context_of(self._backend):
                renderer = mujoco.Renderer(model, height, width)
            self._renderers[key] = renderer, mujoco.MjData(model)
        return self._renderers[key]
