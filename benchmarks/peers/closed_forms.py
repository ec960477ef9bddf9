"""Libraries that derive a closed form of an arm."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.peers.library import Array, Library, Task, nearest_branch

_EXACT = 1e-4
"""Largest difference of a pose matrix at which a least-squares branch of EAIK is exact."""

_PARALLEL = 1e-9
"""Sine of the angle between axes below which they are parallel."""

_DIGITS = 12
"""Decimals of the Denavit-Hartenberg parameters, so that a rounded zero is zero."""

_SIX = 6
"""Joints of the arms that EAIK and the Robotics Toolbox solve in closed form."""


class Eaik(Library):
    """EAIK: closed forms by subproblem decomposition (C++), the nearest branch in the limits."""

    needs = ("EAIK", "numpy")

    def setup(self, task: Task) -> bool:
        if len(task.joints) != _SIX or not task.is_arm:
            return False
        frame = np.eye(4)
        axes = []
        points = [np.zeros(3)]
        for transform in task.frames[:-1]:
            frame = frame @ transform
            axes.append(frame[:3, 2].copy())
            points.append(frame[:3, 3].copy())
        frame = frame @ task.frames[-1]
        points.append(frame[:3, 3])
        self._task = task
        self._zero = frame[:3, :3].copy()
        robot = importlib.import_module("eaik.IK_HP").HPRobot
        self._robot = robot(np.array(axes), np.diff(np.array(points), axis=0))
        self.settings = "HPRobot, all branches and their whole turns tried against the limits"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        rotated = target.copy()
        rotated[:3, :3] = target[:3, :3] @ self._zero.T
        answer = self._robot.IK(rotated)
        branches = np.array(answer.Q)
        is_least_squares = np.array(answer.is_LS, dtype=bool)
        nearest = nearest_branch(branches[~is_least_squares], start, self._task)
        if nearest is None and is_least_squares.any():
            # A branch that is marked as least squares may be exact.
            candidates = branches[is_least_squares]
            exact = [q for q in candidates if np.abs(self.forward(q) - target).max() < _EXACT]
            nearest = nearest_branch(np.array(exact), start, self._task)
        return nearest

    def forward(self, q: Array) -> Array:
        pose = np.array(self._robot.fwdKin(q))
        pose[:3, :3] = pose[:3, :3] @ self._zero
        return pose


class Ssik(Library):
    """ssik: closed forms of six and seven hinges (C++), specialised by ``ssik build``."""

    needs = ("ssik[urdf]",)

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        importlib.import_module("ssik")
        solver = task.folder / "ssik_solver.py"
        if not solver.exists():
            program = Path(sys.executable).with_name("ssik")
            command = [str(program), "build", task.urdf, "--out", str(solver), "--no-validate"]
            command += ["--base", "base", "--ee", task.sites[0]]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        spec = importlib.util.spec_from_file_location(solver.stem, solver)
        if spec is None or spec.loader is None:
            raise ImportError(f"cannot import {solver}")
        self._arm = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self._arm)
        self.settings = "ssik build; solve with max_solutions=1 and q_seed=start"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        branches = self._arm.solve(target, max_solutions=1, q_seed=start)
        return branches[0].q if branches else None

    def forward(self, q: Array) -> Array:
        return np.asarray(self._arm.fk(q))


class RoboticsToolboxAnalytic(Library):
    """Robotics Toolbox for Python: ``ikine_analytic``, derived by SymPy and run as Python."""

    needs = ("roboticstoolbox-python[ik]",)

    def setup(self, task: Task) -> bool:
        if len(task.joints) != _SIX or not task.is_arm:
            return False
        rtb = importlib.import_module("roboticstoolbox")
        se3 = importlib.import_module("spatialmath").SE3
        base, parameters, tool = standard_dh(task.frames)
        links = []
        for (offset, d, a, alpha), lower, upper in zip(
            parameters.tolist(), task.lower, task.upper, strict=True
        ):
            limits = [lower, upper]
            links.append(rtb.RevoluteDH(d=d, a=a, alpha=alpha, offset=offset, qlim=limits))
        self._arm = rtb.DHRobot(links, base=se3(base, check=False), tool=se3(tool, check=False))
        self._solver = self._arm.analytic_ik()
        self.settings = f"{type(self._solver).__name__}.ikine, nearest to the start"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        answer = self._solver.ikine(target, start)
        return np.asarray(answer.q) if answer.success else None

    def forward(self, q: Array) -> Array:
        return np.asarray(self._arm.fkine(q).A)


def standard_dh(frames: Array) -> tuple[Array, Array, Array]:
    """Return the standard Denavit-Hartenberg parameters of a chain of hinges.

    Args:
        frames: (n + 1, 4, 4) constant transforms between the axes z, as in ``Task``.

    Returns:
        Pose (4, 4) of the base, the rows theta offset, d, a, alpha (n, 4) in rad and m, and pose
        (4, 4) of the tool.
    """
    axes = []
    frame = np.eye(4)
    for transform in frames:
        frame = frame @ transform
        axes.append(frame)
    base = axes[0]
    current = base
    rows = []
    for following in axes[1:-1]:
        z = current[:3, 2]
        z_next = following[:3, 2]
        way = following[:3, 3] - current[:3, 3]
        normal = np.cross(z, z_next)
        sine = np.linalg.norm(normal)
        if sine < _PARALLEL:
            perpendicular = way - (way @ z) * z
            a = np.linalg.norm(perpendicular)
            x_next = perpendicular / a if a > _PARALLEL else current[:3, 0]
            d = 0.0
        else:
            x_next = normal / sine
            # d z + a x_next ends on the following axis.
            d, a, _ = np.linalg.solve(np.column_stack([z, x_next, -z_next]), way)
        x = current[:3, 0]
        theta = np.arctan2(np.cross(x, x_next) @ z, x @ x_next)
        alpha = np.arctan2(normal @ x_next, z @ z_next)
        rows.append((theta, d, a, alpha))
        origin = current[:3, 3] + d * z + a * x_next
        current = np.eye(4)
        current[:3] = np.column_stack([x_next, np.cross(z_next, x_next), z_next, origin])
    rows.append((0.0, 0.0, 0.0, 0.0))
    return base, np.round(rows, _DIGITS), np.linalg.inv(current) @ axes[-1]
