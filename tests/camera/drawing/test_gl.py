"""The OpenGL back end: where it works it draws what the others draw, where it does not nothing breaks."""

import os

import mujoco
import numpy as np
import pytest

from robot_ik.bench.camera.accuracy import BENT, STRAIGHT, projection_identity
from robot_ik.camera.drawing import gl
from robot_ik.camera.drawing.probe import Probe
from robot_ik.camera.drawing.raycast import ray_field
from robot_ik.camera.drawing.renderers import BoxTable, DrawnRobot, PainterArtist, occluder_boxes
from robot_ik.errors import CameraError
from robot_ik.geometry import Pose
from robot_ik.robot import load_robot
from tests.conftest import Require


def test_without_opengl_the_painter_draws_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    asked = []

    def probe(backend: str, *, timeout: float) -> Probe:
        asked.append(backend)
        return Probe(False, "no library")

    monkeypatch.setattr(gl, "probe_gl", probe)
    artist, notice = gl.make_artist("gl")
    assert artist.name == "painter"
    assert "painter" in notice and "no library" in notice and "\n" not in notice
    assert asked == list(gl.TRIED)
    assert "MUJOCO_GL" not in os.environ


def test_the_first_that_draws_is_taken_unless_the_user_forbids_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl, "probe_gl", lambda backend, timeout: Probe(backend == "osmesa", "llvmpipe"))
    assert gl.choose_gl()[0] == "osmesa"
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert gl.choose_gl()[0] == ""


def test_an_unknown_back_end_is_refused() -> None:
    with pytest.raises(CameraError, match="'vulkan'"):
        gl.make_artist("vulkan")


def test_the_pinhole_picture_holds_all_that_the_lens_sees() -> None:
    pinhole = gl.pinhole_for(BENT, 1.5)
    normalized = ray_field(BENT).box(0, 0, *BENT.size).reshape(-1, 2)
    pixels = pinhole.distort(normalized)
    assert pixels.min() > 0
    assert (pixels < np.array(pinhole.size) - 1).all()


def test_opengl_draws_where_opencv_projects_and_the_painter_paints(require: Require) -> None:
    backend = require("gl")
    artist = gl.GlArtist(backend)
    try:
        for lens, rms, worst in ((STRAIGHT, 0.05, 0.15), (BENT, 0.08, 0.20)):
            misses = projection_identity(artist, lens)
            assert misses.count > 100
            assert misses.rms <= rms
            assert misses.worst <= worst
        robot = load_robot("puma560")
        things = occluder_boxes([BoxTable(position=(0.02, -0.12, 0.06), size=(0.10, 0.04, 0.12))])
        eye = Pose.look_at((0.10, -0.80, 0.62), (0.0, 0.06, 0.15))
        drawn = DrawnRobot(robot.model, Pose(), 0.3, things, shadow=False)
        qpos = robot.qpos(robot.home)
        masks = [a.draw(drawn, qpos, BENT, eye).robot.mask(640, 480) > 127 for a in (artist, PainterArtist())]
        assert (masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum() > 0.985
    finally:
        artist.close()
    assert mujoco.rendering.classic.gl_context.GLContext.__module__ != "mujoco." + backend or os.environ.get(
        "MUJOCO_GL"
    ), "MuJoCo's own choice is put back"
