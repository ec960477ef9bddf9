"""Compile what tracks and draws in another process, so that a running session is not held up."""

from __future__ import annotations

import numpy as np

from robot_ik.camera.drawing.zbuffer import fill_faces, lay_over
from robot_ik.camera.print_model import linearise
from robot_ik.camera.target_files import parse_target
from robot_ik.kernels import jit
from robot_ik.kernels.precompile import Precompilation
from robot_ik.robot import load_robot
from robot_ik.testbed.ar.camera import ArCamera
from robot_ik.testbed.ar.late_registrar import LateRegistrar, RecentBoards
from robot_ik.testbed.ar.scene import ArScene
from robot_ik.testbed.ar.setup import ArDelay, ArSetup

_ROBOT = "tabletop_puma"

_PICTURES = 2
"""Pictures to track. The second one uses the state of the tracker after the first."""


def is_warm() -> bool:
    """Return whether the kernels of tracking and drawing are in this machine's cache."""
    return all(map(jit.compiled, (linearise, fill_faces, lay_over)))


def warm_up() -> None:
    """Compile in another process unless it is done. If that fails, this process compiles."""
    if not is_warm():
        with Precompilation(f"{__name__}:track_and_draw") as compilation:
            compilation.wait()


def track_and_draw() -> None:
    """Track and draw pictures of the synthetic table."""
    setup = ArSetup()
    scene = ArScene(load_robot(_ROBOT))
    with ArCamera(setup) as camera:
        tracker = RecentBoards(parse_target(setup.board), camera.intrinsics)
        registrar = LateRegistrar(tracker, scene.drawn, camera.intrinsics, ArDelay())
        for _ in range(_PICTURES):
            frame = camera.read()
            registrar.take(frame)
            registrar.composed(frame, scene.qpos(scene.robot.home, np.zeros(3)))
