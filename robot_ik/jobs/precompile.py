"""Compiles in a process of its own while this one looks through the camera.

What that has compiled is taken from the cache; where it fails, this process compiles.
"""

from __future__ import annotations

import contextlib
import importlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from robot_ik.camera.corners import refine_markers
from robot_ik.camera.drawing.drawn_robot import DrawnRobot
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.targets import DEFAULT_DICTIONARY, marker
from robot_ik.geometry import Pose
from robot_ik.kernels import jit
from robot_ik.ports import Closing
from robot_ik.robot import load_robot
from robot_ik.solvers import levenberg_marquardt, make_solver
from robot_ik.solvers.analytic import closed_form
from robot_ik.solvers.iterative import IterativeSolver

# Side of a cell of the marker that is fitted, px.
_CELL = 12
# A solve from the goal itself compiles everything and takes no step.
_SOLVE = """
import sys
import robot_ik as rik
robot = rik.load_robot(sys.argv[1])
rik.solve(robot, rik.PoseGoal.at(None, robot.forward(robot.home)), solver=sys.argv[2])
"""


class Precompilation(Closing):
    """A program that compiles ``what``, unless one of ``kernels`` has been; ``wait`` before its use."""

    def __init__(self, kernels: Sequence[Callable[..., None]], what: str, *arguments: str) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if any(jit.compiled(kernel) for kernel in kernels):
            return
        jit.announce(kernels[0], what)
        quiet = subprocess.DEVNULL
        with contextlib.suppress(OSError):  # no process to be had: it is compiled here, then
            self._process = subprocess.Popen(
                [sys.executable, *arguments], stdin=quiet, stdout=quiet, stderr=quiet
            )

    @classmethod
    def solver(cls, robot: str, solver: str) -> Self:
        """A method, by its name, for a robot as for ``load_robot``."""
        method = make_solver(solver)
        # A first solve needs one of them; which one, the other process finds out.
        kernels: list[Callable[..., None]] = [closed_form, levenberg_marquardt.solve]
        if isinstance(method, IterativeSolver):
            kernels = [importlib.import_module(type(method).__module__).solve]
        return cls(kernels, f"solver {solver!r}", "-c", _SOLVE, robot, solver)

    @classmethod
    def overlay(cls) -> Self:
        """What draws a robot into a picture with a board."""
        from robot_ik.camera.drawing.zbuffer import fill_faces

        return cls((fill_faces,), "the painter", "-m", "robot_ik.jobs.precompile")

    def wait(self) -> None:
        """Returns when it is done, or has failed."""
        if self._process is not None:
            self._process.wait()

    def close(self) -> None:
        """Ends it, done or not."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()


# ------------------------------------------------------------------------------------------
# What a first ``robot-ik ar`` compiles, as a program: ``python -m robot_ik.jobs.precompile``.


def compile_overlay() -> None:
    """Fit a marker and draw a robot: all compiled code, in the order in which it is needed."""
    lens = CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    camera = Pose.look_at((0.1, -0.4, 0.5), (0.0, 0.0, 0.0))
    cells = marker_bits(DEFAULT_DICTIONARY, 0)
    side = _CELL * len(cells)
    image = np.full((480, 640, 3), 255, dtype=np.uint8)
    image[100 : 100 + side, 100 : 100 + side] = np.kron(cells, np.ones((_CELL, _CELL), np.uint8))[..., None]
    corners = 99.5 + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    refined = refine_markers(image, [corners], [0], DEFAULT_DICTIONARY, lens)
    marker(0, 0.05).fit({0: refined[0]}, lens)
    robot = load_robot("puma560")
    DrawnRobot(robot.model, scale=0.2).draw(robot.qpos(robot.home), lens, camera).over(image)


if __name__ == "__main__":
    compile_overlay()
