"""Compile a method, or the painter of overlays, in another process (``kernels.precompile``)."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np

from robot_ik.camera.corners import refine_markers
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import DEFAULT_DICTIONARY, marker
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.kernels import jit
from robot_ik.kernels.precompile import Precompilation
from robot_ik.robot import load_robot
from robot_ik.solvers import levenberg_marquardt, make_solver
from robot_ik.solvers.analytic import closed_form
from robot_ik.solvers.iterative import IterativeSolver

_CELL = 12
"""Side of a cell of the marker that is fitted, px."""


def precompile_solver(robot: str, solver: str) -> Precompilation:
    """Compile a method in another process, unless it has been compiled.

    Args:
        robot: Name or path of the robot, as for ``load_robot``.
        solver: Name of the method.
    """
    method = make_solver(solver)
    # A first solve uses one of these kernels. The robot decides which one.
    kernels: list[Callable[..., None]] = [closed_form, levenberg_marquardt.solve]
    if isinstance(method, IterativeSolver):
        kernels = [importlib.import_module(type(method).__module__).solve]
    if any(jit.compiled(kernel) for kernel in kernels):
        return Precompilation(None)
    jit.announce(kernels[0], f"solver {solver!r}")
    return Precompilation(f"{__name__}:solve_at_home", robot, solver)


def solve_at_home(robot: str, solver: str) -> None:
    """Solve for the pose at home. It compiles the kernels and takes no step."""
    loaded = load_robot(robot)
    solve(loaded, PoseGoal.at(None, loaded.forward(loaded.home)), solver=solver)


def precompile_overlay() -> Precompilation:
    """Compile what draws a robot into a picture with a board, unless it has been compiled."""
    from robot_ik.camera.drawing.zbuffer import fill_faces  # loads the compiler

    if jit.compiled(fill_faces):
        return Precompilation(None)
    jit.announce(fill_faces, "the painter")
    return Precompilation(f"{__name__}:fit_and_draw")


def fit_and_draw() -> None:
    """Fit a marker and draw a robot: the compiled code of an overlay, in the order of its use."""
    intrinsics = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    camera = Pose.look_at((0.1, -0.4, 0.5), (0.0, 0.0, 0.0))
    cells = marker_bits(DEFAULT_DICTIONARY, 0)
    side = _CELL * len(cells)
    image = np.full((480, 640, 3), 255, dtype=np.uint8)
    square = np.kron(cells, np.ones((_CELL, _CELL), np.uint8))
    image[100 : 100 + side, 100 : 100 + side] = square[..., None]
    corners = 99.5 + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    refined = refine_markers(image, [corners], [0], DEFAULT_DICTIONARY, intrinsics)
    marker(0, 0.05).fit({0: refined[0]}, intrinsics)
    robot = load_robot("puma560")
    drawn = DrawnRobot(robot.model, scale=0.2)
    drawn.draw(robot.qpos(robot.home), intrinsics, camera).over(image)
