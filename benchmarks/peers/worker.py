"""Run one library in its own interpreter. It needs numpy and the library only.

    python worker.py LIBRARY FOLDER SECONDS

LIBRARY is a row of ``LIBRARIES`` or FILE.py:CLASS. FOLDER holds the files of ``tasks``. Solutions
and times go into ``solutions.npz`` and ``report.json`` in it. ``judge`` checks them. A time is that
of a whole call: an array in, joint angles out, with all conversions, restarts and limits.
"""

from __future__ import annotations

import gc
import importlib
import importlib.metadata
import json
import os
import runpy
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_variable, "1")

import numpy as np

Array = Any  # numpy.typing of old environments does not have NDArray
TWO_PI = 2.0 * np.pi

_WARM_UP = 5
"""Solves before each set whose times do not count."""

_LEAST_PROBLEMS = 20
"""Smallest number of problems of a set, even after its time is over."""

_ROUNDING = 1e-9
"""Radians by which rounding may exceed a joint limit."""


@dataclass(frozen=True)
class Task:
    """A robot and its problems, as every library gets them.

    Attributes:
        folder: Holds ``model.urdf`` and ``model.xml``, the same kinematics in both forms.
        robot: Name of the robot.
        joints: Names of the hinges in the order of solutions. A free base has seven numbers before.
        lower: (n,) lower limits of the hinges, rad.
        upper: (n,) upper limits of the hinges, rad.
        home: (nq,) joint values at home.
        sites: Frames with goals: one with a pose, or several with positions.
        free_base: Whether the robot has a free base.
        frames: (n + 1, 4, 4) constant transforms between the axes z of an arm. Empty for others.
        position: Position tolerance, m.
        angle: Angle tolerance, rad.
    """

    folder: Path
    robot: str
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    home: Array
    sites: tuple[str, ...]
    free_base: bool
    frames: Array
    position: float
    angle: float

    @classmethod
    def load(cls, folder: Path) -> Task:
        """Read the task of a folder."""
        facts = json.loads((folder / "task.json").read_text(encoding="utf-8"))
        for key in ("lower", "upper", "home", "frames"):
            facts[key] = np.array(facts[key], dtype=float)
        for key in ("joints", "sites"):
            facts[key] = tuple(facts[key])
        return cls(folder=folder, **facts)

    @property
    def urdf(self) -> str:
        """Path of the URDF."""
        return str(self.folder / "model.urdf")

    @property
    def is_arm(self) -> bool:
        """Whether the task is the pose of one site of a robot on the ground."""
        return len(self.sites) == 1 and not self.free_base


class Library:
    """A library of the comparison.

    Attributes:
        needs: Distributions that pip installs.
        settings: How the library is used, for the report.
    """

    needs: tuple[str, ...] = ()
    settings = ""

    def setup(self, task: Task) -> bool:
        """Import the library and read the robot. Return False if it does not support the task."""
        raise NotImplementedError

    def solve(self, target: Array, start: Array) -> Array | None:
        """Return joint angles (nq,), or None.

        Args:
            target: (4, 4) pose, or (sites, 3) positions.
            start: (nq,) joint angles.
        """
        raise NotImplementedError

    def forward(self, q: Array) -> Array | None:
        """Return the pose (4, 4) of the only site by the library, or None.

        It shows that the library has read the same robot.
        """
        del q
        return None


def into_limits(q: Array, task: Task) -> Array:
    """Return angles moved by multiples of 2π into their range, where possible."""
    up = np.maximum(np.ceil((task.lower - q) / TWO_PI - 1e-12), 0.0)
    down = np.maximum(np.ceil((q - task.upper) / TWO_PI - 1e-12), 0.0)
    return q + TWO_PI * (up - down)


class RoboticsToolbox(Library):
    """Robotics Toolbox for Python: ``ETS.ik_LM`` in C++, Chan's damping, 100 random starts."""

    needs = ("roboticstoolbox-python", "numpy<2")

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        rtb = importlib.import_module("roboticstoolbox")
        parts = []
        for frame, lower, upper in zip(task.frames, task.lower, task.upper):  # noqa: B905
            parts += [rtb.ET.SE3(frame), rtb.ET.Rz(qlim=[lower, upper])]
        self._chain = rtb.ETS([*parts, rtb.ET.SE3(task.frames[-1])])
        # Its residual is half the sum of squares of metres and radians.
        tolerance = 0.5 * (0.7 * min(task.position, task.angle)) ** 2
        self._options = {
            "ilimit": 30,
            "slimit": 100,
            "tol": tolerance,
            "k": 0.1,
            "method": "chan",
        }
        self.settings = f"ETS.ik_LM, {self._options}, joint_limits"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        answer = self._chain.ik_LM(target, q0=start, joint_limits=True, **self._options)
        return np.asarray(answer[0] if isinstance(answer, tuple) else answer.q)

    def forward(self, q: Array) -> Array:
        return np.asarray(self._chain.fkine(q).A)


class Eaik(Library):
    """EAIK: closed forms by subproblem decomposition (C++), the nearest branch in the limits."""

    needs = ("EAIK", "numpy")

    def setup(self, task: Task) -> bool:
        if len(task.joints) != 6 or not task.is_arm:
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
        nearest = None
        if not is_least_squares.all():
            nearest = self._nearest(branches[~is_least_squares], start)
        if nearest is None and is_least_squares.any():
            # A branch that is marked as least squares may be exact.
            candidates = branches[is_least_squares]
            exact = [q for q in candidates if np.abs(self.forward(q) - target).max() < 1e-4]
            nearest = self._nearest(np.array(exact), start) if exact else None
        return nearest

    def _nearest(self, branches: Array, start: Array) -> Array | None:
        """Return the branch inside the limits that is nearest to the start, modulo whole turns."""
        changes = branches - start
        changes -= TWO_PI * np.rint(changes / TWO_PI)
        lower = self._task.lower
        upper = self._task.upper
        best = start + changes[np.abs(changes).max(axis=1).argmin()]
        if (best >= lower).all() and (best <= upper).all():  # usually it is the nearest of all
            return np.asarray(best)
        candidates = into_limits(start + changes, self._task)
        distances = np.abs(candidates - start).max(axis=1)
        is_outside = (candidates < lower - _ROUNDING) | (candidates > upper + _ROUNDING)
        distances[is_outside.any(axis=1)] = np.inf
        nearest = int(distances.argmin())
        return None if distances[nearest] == np.inf else np.asarray(candidates[nearest])

    def forward(self, q: Array) -> Array:
        pose = np.array(self._robot.fwdKin(q))
        pose[:3, :3] = pose[:3, :3] @ self._zero
        return pose


class Placo(Library):
    """placo: a whole-body solver (C++, quadratic programs), iterated until its tasks are met."""

    needs = ("placo",)
    steps = 200
    restarts = 0

    def setup(self, task: Task) -> bool:
        placo = importlib.import_module("placo")
        self._task = task
        self._rng = np.random.default_rng(1)
        self._robot = placo.RobotWrapper(task.urdf, placo.Flags.ignore_collisions)
        self._solver = placo.KinematicsSolver(self._robot)
        self._solver.enable_joint_limits(True)
        self._solver.enable_velocity_limits(False)
        self._solver.dt = 1.0
        names = list(self._robot.joint_names())
        self._order = np.array([task.joints.index(name) for name in names])
        if task.free_base:
            self._points = [
                self._solver.add_position_task(site, np.zeros(3)) for site in task.sites
            ]
            for point in self._points:
                point.configure("point", "soft", 1.0)
        else:
            self._solver.mask_fbase(True)
            self._frame = self._solver.add_frame_task(task.sites[0], np.eye(4))
            self._frame.configure("frame", "soft", 1.0, 1.0)
        self._solver.add_regularization_task(1e-6)
        self.settings = (
            f"soft tasks, regularisation 1e-6, {self.steps} steps, {self.restarts} restarts"
        )
        return True

    def _set_q(self, q: Array) -> None:
        state = self._robot.state.q.copy()
        if self._task.free_base:
            state[:7] = (*q[:3], *q[4:7], q[3])  # its quaternions are x y z w
            state[7:] = q[7:][self._order]
        else:
            state[7:] = q[self._order]
        self._robot.state.q = state
        self._robot.update_kinematics()

    def _q(self) -> Array:
        state = np.asarray(self._robot.state.q)
        base = (*state[:3], state[6], *state[3:6]) if self._task.free_base else ()
        joints = np.empty(len(self._order))
        joints[self._order] = state[7:]
        return np.concatenate([base, joints])

    def _is_met(self) -> bool:
        task = self._task
        if task.free_base:
            for point in self._points:
                point.update()
            return max(point.error_norm() for point in self._points) < task.position
        position = self._frame.position()
        orientation = self._frame.orientation()
        position.update()
        orientation.update()
        is_near = position.error_norm() < task.position
        return is_near and orientation.error_norm() < task.angle

    def _descend(self, start: Array) -> bool:
        """Step from a start until the tasks are met. Return whether they are."""
        self._set_q(start)
        for _ in range(self.steps):
            if self._is_met():
                return True
            try:
                self._solver.solve(True)
            except RuntimeError:  # the quadratic program has no solution
                return False
            self._robot.update_kinematics()
        return self._is_met()

    def solve(self, target: Array, start: Array) -> Array | None:
        if self._task.free_base:
            for point, position in zip(self._points, target):  # noqa: B905
                point.target_world = position
        else:
            self._frame.T_world_frame = target
        is_met = self._descend(start)
        for _ in range(0 if is_met else self.restarts):
            if self._descend(self._rng.uniform(self._task.lower, self._task.upper)):
                break
        return self._q()

    def forward(self, q: Array) -> Array | None:
        if self._task.free_base:
            return None
        self._set_q(q)
        return np.asarray(self._robot.get_T_world_frame(self._task.sites[0]))


class PlacoRestarts(Placo):
    """placo with random starts, for arms."""

    steps = 40
    restarts = 60

    def setup(self, task: Task) -> bool:
        return super().setup(task) and not task.free_base


class IkPy(Library):
    """ikpy: scipy's least squares with a numeric Jacobian."""

    needs = ("ikpy",)

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        active = [False, *(True for _ in task.joints), False]
        chain = importlib.import_module("ikpy.chain").Chain
        self._chain = chain.from_urdf_file(
            task.urdf, base_elements=["base"], active_links_mask=active
        )
        self.settings = "orientation_mode all, its defaults"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        links = np.concatenate([[0.0], start, [0.0]])
        answer = self._chain.inverse_kinematics_frame(
            target, initial_position=links, orientation_mode="all"
        )
        return np.asarray(answer[1:-1])

    def forward(self, q: Array) -> Array:
        return np.asarray(self._chain.forward_kinematics(np.concatenate([[0.0], q, [0.0]])))


LIBRARIES: dict[str, type[Library] | str] = {
    "robot_ik": "benchmarks.peers.ours:OursAuto",
    "robot_ik_lm": "benchmarks.peers.ours:Numeric",
    "robot_ik_analytic": "benchmarks.peers.ours:ClosedForm",
    "rtb_lm": RoboticsToolbox,
    "eaik": Eaik,
    "placo": Placo,
    "placo_restarts": PlacoRestarts,
    "ikpy": IkPy,
}
"""Class of each library by name. A text is module:class of a library that needs robot_ik."""


def library_of(name: str) -> type[Library]:
    """Return the class of a row, or of FILE.py:CLASS."""
    row = LIBRARIES.get(name, name)
    if not isinstance(row, str):
        return row
    place, _, kind = row.rpartition(":")
    is_file = place.endswith(".py")
    names = runpy.run_path(place) if is_file else vars(importlib.import_module(place))
    library: type[Library] = names[kind]
    return library


def run_set(
    solve: Callable[[Array, Array], Array | None], targets: Array, starts: Array, seconds: float
) -> Any:
    """Solve one set of problems.

    Returns:
        Solutions (n, nq), wall-clock and processor times (n,) in µs, and the errors by their text.
    """
    errors: dict[str, int] = {}
    for target, start in zip(targets[:_WARM_UP], starts):  # noqa: B905
        _try(solve, target, start, {})
    solutions = []
    wall = []
    cpu = []
    began = time.perf_counter()
    gc.collect()
    gc.disable()
    for target, start in zip(targets.copy(), starts.copy()):  # noqa: B905
        cpu_begin = time.process_time_ns()
        wall_begin = time.perf_counter_ns()
        q = _try(solve, target, start, errors)
        wall.append((time.perf_counter_ns() - wall_begin) / 1e3)
        cpu.append((time.process_time_ns() - cpu_begin) / 1e3)
        shape = starts.shape[1:]
        is_complete = q is not None and np.shape(q) == shape
        solutions.append(np.array(q, dtype=float) if is_complete else np.full(shape, np.nan))
        if time.perf_counter() - began > seconds and len(wall) >= _LEAST_PROBLEMS:
            break
    gc.enable()
    return np.array(solutions), np.array(wall), np.array(cpu), errors


def _try(
    solve: Callable[..., Array | None], target: Array, start: Array, errors: dict[str, int]
) -> Array | None:
    """Return the solution, or None. An exception is counted in ``errors`` by its text."""
    try:
        return solve(target, start)
    except Exception as error:  # a solve that raises is a failed solve
        text = f"{type(error).__name__}: {str(error)[:80]}"
        errors[text] = errors.get(text, 0) + 1
        return None


def versions_of(kind: type[Library]) -> dict[str, str]:
    """Return the versions of the distributions that a library needs."""
    versions = {}
    for need in kind.needs:
        name = need.partition("<")[0].partition(">")[0].partition("=")[0]
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "unknown"
    return versions


def run_library(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Solve all sets of a task by one library. Return its report."""
    kind = library_of(name)
    task = Task.load(folder)
    library = kind()
    try:
        supported = library.setup(task)
    except ImportError as error:
        install = f"pip install {' '.join(map(repr, kind.needs))}"
        return {"missing": f"{error}; {install}"}
    report: dict[str, Any] = {"supported": supported, "errors": {}}
    report["versions"] = versions_of(kind)
    report["settings"] = library.settings
    if not supported:
        return report
    problems = np.load(folder / "problems.npz")
    arrays: dict[str, Array] = {}
    poses = [library.forward(q) for q in problems["probes"]]
    if all(pose is not None for pose in poses):
        arrays["probes"] = np.array(poses)
    suffix = "_targets"
    for key in sorted(name[: -len(suffix)] for name in problems.files if name.endswith(suffix)):
        solutions, wall, cpu, errors = run_set(
            library.solve, problems[f"{key}_targets"], problems[f"{key}_starts"], seconds
        )
        arrays[f"{key}_q"] = solutions
        arrays[f"{key}_wall"] = wall
        arrays[f"{key}_cpu"] = cpu
        report["errors"][key] = errors
    np.savez(folder / "solutions.npz", **arrays)
    return report


if __name__ == "__main__":
    _folder = Path(sys.argv[2])
    _report = run_library(sys.argv[1], _folder, float(sys.argv[3]))
    (_folder / "report.json").write_text(json.dumps(_report), encoding="utf-8")
