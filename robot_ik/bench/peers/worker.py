"""One library's run, in that library's own interpreter: numpy and the library are all that it needs.

    python worker.py LIBRARY FOLDER SECONDS

LIBRARY is a row of ``LIBRARIES`` or FILE.py:CLASS; FOLDER holds what ``tasks`` wrote.  Solutions and times go
to ``solutions.npz`` and ``report.json`` in it.  Nothing is judged here.  A time is that of the whole call:
an array in, joint angles out, with all conversions, restarts and handling of limits.
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
import timeit
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_threads, "1")

import numpy as np

Array = Any  # of numpy's type; annotations that need no numpy.typing keep old environments in
TWO_PI = 2.0 * np.pi
# Untimed solves before each set, and the least number of problems that a set is judged by.
_WARM_UP, _LEAST = 5, 20


@dataclass(frozen=True)
class Task:
    """A robot and what is asked of it, as every library gets it.

    Attributes:
        folder: Holds ``model.urdf`` and ``model.xml``, the same kinematics in both forms.
        joints: Names of the hinges, in the order of solutions (behind the seven numbers of a free base).
        lower, upper: (n,) rad; ``home`` (nq,).
        sites: Frames with goals: one with a pose, or several with positions.
        frames: (n + 1, 4, 4) of an arm: constant transforms between axes z; empty for other robots.
        position, angle: Tolerances to ask for, m and rad.
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
        facts = json.loads((folder / "task.json").read_text(encoding="utf-8"))
        for key in ("lower", "upper", "home", "frames"):
            facts[key] = np.array(facts[key], dtype=float)
        for key in ("joints", "sites"):
            facts[key] = tuple(facts[key])
        return cls(folder=folder, **facts)

    @property
    def urdf(self) -> str:
        return str(self.folder / "model.urdf")


class Library:
    """What takes part; pip installs ``needs``, and ``settings`` says what it was asked for."""

    needs: tuple[str, ...] = ()
    settings = ""

    def setup(self, task: Task) -> bool:
        """Reads the robot; False where the library cannot serve it.  Imports the library."""
        raise NotImplementedError

    def solve(self, target: Array, start: Array) -> Array | None:
        """Target (4, 4), or (sites, 3) positions, and a start (nq,) -> (nq,), or None."""
        raise NotImplementedError

    def forward(self, q: Array) -> Array | None:
        """Pose (4, 4) of the only site by the library itself: shows that it has read the same robot."""
        return None


# ------------------------------------------------------------------------------------ the libraries


def into_limits(q: Array, task: Task) -> Array:
    """Angles moved by multiples of 2π into their range, where there is one."""
    up = np.maximum(np.ceil((task.lower - q) / TWO_PI - 1e-12), 0.0)
    down = np.maximum(np.ceil((q - task.upper) / TWO_PI - 1e-12), 0.0)
    return q + TWO_PI * (up - down)


class RoboticsToolbox(Library):
    """Robotics Toolbox for Python: ``ETS.ik_LM`` in C++, Chan's damping, up to 100 random starts."""

    needs = ("roboticstoolbox-python", "numpy<2")

    def setup(self, task: Task) -> bool:
        if len(task.sites) != 1 or task.free_base:
            return False
        rtb = importlib.import_module("roboticstoolbox")
        parts = []
        for frame, low, high in zip(task.frames, task.lower, task.upper):  # noqa: B905
            parts += [rtb.ET.SE3(frame), rtb.ET.Rz(qlim=[low, high])]
        self._chain = rtb.ETS([*parts, rtb.ET.SE3(task.frames[-1])])
        # Its residual is half the sum of squares, metres and radians alike.
        tolerance = 0.5 * (0.7 * min(task.position, task.angle)) ** 2
        self._options = {"ilimit": 30, "slimit": 100, "tol": tolerance, "k": 0.1, "method": "chan"}
        self.settings = f"ETS.ik_LM, {self._options}, joint_limits"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        found = self._chain.ik_LM(target, q0=start, joint_limits=True, **self._options)
        return np.asarray(found[0] if isinstance(found, tuple) else found.q)

    def forward(self, q: Array) -> Array:
        return np.asarray(self._chain.fkine(q).A)


class Eaik(Library):
    """EAIK: closed forms by subproblem decomposition (C++); the nearest branch inside the limits."""

    needs = ("EAIK", "numpy")

    def setup(self, task: Task) -> bool:
        if len(task.joints) != 6 or len(task.sites) != 1 or task.free_base:
            return False
        frame, axes, points = np.eye(4), [], [np.zeros(3)]
        for between in task.frames[:-1]:
            frame = frame @ between
            axes.append(frame[:3, 2].copy())
            points.append(frame[:3, 3].copy())
        frame = frame @ task.frames[-1]
        points.append(frame[:3, 3])
        self._task, self._zero = task, frame[:3, :3].copy()
        robot = importlib.import_module("eaik.IK_HP").HPRobot
        self._robot = robot(np.array(axes), np.diff(np.array(points), axis=0))
        self.settings = "HPRobot, all branches and their whole turns tried against the limits"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        wanted = target.copy()
        wanted[:3, :3] = target[:3, :3] @ self._zero.T
        result = self._robot.IK(wanted)
        every, least = np.array(result.Q), np.array(result.is_LS, dtype=bool)
        found = None if least.all() else self._nearest(every[~least], start)
        if found is None and least.any():  # what is marked as least squares may be exact
            exact = [q for q in every[least] if np.abs(self.forward(q) - target).max() < 1e-4]
            found = self._nearest(np.array(exact), start) if exact else None
        return found

    def _nearest(self, branches: Array, start: Array) -> Array | None:
        """The branch, moved by multiples of 2π, that is nearest to the start and inside the limits."""
        moves = branches - start
        moves -= TWO_PI * np.rint(moves / TWO_PI)
        lower, upper = self._task.lower, self._task.upper
        best = start + moves[np.abs(moves).max(axis=1).argmin()]
        if (best >= lower).all() and (best <= upper).all():  # as a rule it is the nearest of all
            return np.asarray(best)
        candidates = into_limits(start + moves, self._task)
        far = np.abs(candidates - start).max(axis=1)
        far[((candidates < lower - 1e-9) | (candidates > upper + 1e-9)).any(axis=1)] = np.inf
        nearest = int(far.argmin())
        return None if far[nearest] == np.inf else np.asarray(candidates[nearest])

    def forward(self, q: Array) -> Array:
        pose = np.array(self._robot.fwdKin(q))
        pose[:3, :3] = pose[:3, :3] @ self._zero
        return pose


class Placo(Library):
    """placo: a whole-body solver (C++, quadratic programs), iterated until its tasks are met."""

    needs = ("placo",)
    steps, restarts = 200, 0

    def setup(self, task: Task) -> bool:
        placo = importlib.import_module("placo")
        self._task, self._rng = task, np.random.default_rng(1)
        self._robot = placo.RobotWrapper(task.urdf, placo.Flags.ignore_collisions)
        self._solver = placo.KinematicsSolver(self._robot)
        self._solver.enable_joint_limits(True)
        self._solver.enable_velocity_limits(False)
        self._solver.dt = 1.0
        names = list(self._robot.joint_names())
        self._order = np.array([task.joints.index(name) for name in names])
        if task.free_base:
            self._points = [self._solver.add_position_task(site, np.zeros(3)) for site in task.sites]
            for one in self._points:
                one.configure("point", "soft", 1.0)
        else:
            self._solver.mask_fbase(True)
            self._frame = self._solver.add_frame_task(task.sites[0], np.eye(4))
            self._frame.configure("frame", "soft", 1.0, 1.0)
        self._solver.add_regularization_task(1e-6)
        self.settings = f"soft tasks, regularisation 1e-6, {self.steps} steps, {self.restarts} restarts"
        return True

    def _set_q(self, q: Array) -> None:
        x = self._robot.state.q.copy()
        if self._task.free_base:
            x[:7] = (*q[:3], *q[4:7], q[3])  # its quaternions are x y z w
            x[7:] = q[7:][self._order]
        else:
            x[7:] = q[self._order]
        self._robot.state.q = x
        self._robot.update_kinematics()

    def _where(self) -> Array:
        x = np.asarray(self._robot.state.q)
        base = (*x[:3], x[6], *x[3:6]) if self._task.free_base else ()
        joints = np.empty(len(self._order))
        joints[self._order] = x[7:]
        return np.concatenate([base, joints])

    def _met(self) -> bool:
        if self._task.free_base:
            for one in self._points:
                one.update()
            return max(one.error_norm() for one in self._points) < self._task.position
        position, orientation = self._frame.position(), self._frame.orientation()
        position.update()
        orientation.update()
        return position.error_norm() < self._task.position and orientation.error_norm() < self._task.angle

    def _descend(self, start: Array) -> bool:
        self._set_q(start)
        for _ in range(self.steps):
            if self._met():
                return True
            try:
                self._solver.solve(True)
            except RuntimeError:  # a program without a solution
                return False
            self._robot.update_kinematics()
        return self._met()

    def solve(self, target: Array, start: Array) -> Array | None:
        if self._task.free_base:
            for one, position in zip(self._points, target):  # noqa: B905
                one.target_world = position
        else:
            self._frame.T_world_frame = target
        met = self._descend(start)
        for _ in range(0 if met else self.restarts):
            if self._descend(self._rng.uniform(self._task.lower, self._task.upper)):
                break
        return self._where()

    def forward(self, q: Array) -> Array | None:
        if self._task.free_base:
            return None
        self._set_q(q)
        return np.asarray(self._robot.get_T_world_frame(self._task.sites[0]))


class PlacoRestarts(Placo):
    """The same with random starts."""

    steps, restarts = 40, 60

    def setup(self, task: Task) -> bool:
        return super().setup(task) and not task.free_base


class IkPy(Library):
    """ikpy: scipy's least squares with a numeric Jacobian."""

    needs = ("ikpy",)

    def setup(self, task: Task) -> bool:
        if len(task.sites) != 1 or task.free_base:
            return False
        active = [False, *(True for _ in task.joints), False]
        chain = importlib.import_module("ikpy.chain").Chain
        self._chain = chain.from_urdf_file(task.urdf, base_elements=["base"], active_links_mask=active)
        self.settings = "orientation_mode all, its defaults"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        begin = np.concatenate([[0.0], start, [0.0]])
        found = self._chain.inverse_kinematics_frame(target, initial_position=begin, orientation_mode="all")
        return np.asarray(found[1:-1])

    def forward(self, q: Array) -> Array:
        return np.asarray(self._chain.forward_kinematics(np.concatenate([[0.0], q, [0.0]])))


#: Name -> class here, or module:class that needs robot_ik.
LIBRARIES: dict[str, type[Library] | str] = {
    "robot_ik": "robot_ik.bench.peers.ours:OursAuto",
    "robot_ik_lm": "robot_ik.bench.peers.ours:Numeric",
    "robot_ik_analytic": "robot_ik.bench.peers.ours:ClosedForm",
    "rtb_lm": RoboticsToolbox,
    "eaik": Eaik,
    "placo": Placo,
    "placo_restarts": PlacoRestarts,
    "ikpy": IkPy,
}


def library_of(name: str) -> type[Library]:
    """The class of a row, or of FILE.py:CLASS."""
    row = LIBRARIES.get(name, name)
    if not isinstance(row, str):
        return row
    where, _, kind = row.rpartition(":")
    inside = runpy.run_path(where) if where.endswith(".py") else vars(importlib.import_module(where))
    found: type[Library] = inside[kind]
    return found


# ------------------------------------------------------------------------------------------- a run


def run_set(
    solve: Callable[[Array, Array], Array | None], targets: Array, starts: Array, seconds: float
) -> Any:
    """Answers (n, nq), wall-clock and processor times (n,) in µs, and the errors that were raised."""
    for target, start in zip(targets[:_WARM_UP], starts):  # noqa: B905
        _try(solve, target, start, {})
    solutions, wall, cpu, errors = [], [], [], {}  # type: ignore[var-annotated]
    began = time.perf_counter()
    gc.collect()
    gc.disable()
    for target, start in zip(targets.copy(), starts.copy()):  # noqa: B905
        c, t = time.process_time_ns(), time.perf_counter_ns()
        q = _try(solve, target, start, errors)
        wall.append((time.perf_counter_ns() - t) / 1e3)
        cpu.append((time.process_time_ns() - c) / 1e3)
        good = q is not None and np.shape(q) == starts.shape[1:]
        solutions.append(np.array(q, dtype=float) if good else np.full(starts.shape[1:], np.nan))
        if time.perf_counter() - began > seconds and len(wall) >= _LEAST:
            break
    gc.enable()
    return np.array(solutions), np.array(wall), np.array(cpu), errors


def _try(
    solve: Callable[..., Array | None], target: Array, start: Array, errors: dict[str, int]
) -> Array | None:
    try:
        return solve(target, start)
    except Exception as error:  # a solve that breaks is one that failed
        text = f"{type(error).__name__}: {str(error)[:80]}"
        errors[text] = errors.get(text, 0) + 1
        return None


def calibration() -> float:
    """Median µs of a fixed loop of plain Python: how fast, and how busy, the machine is."""
    loop = "for i in range(20_000): total += (i * 0.5) ** 0.5"
    return 1e6 * float(np.median(timeit.repeat(loop, "total = 0.0", number=1, repeat=9)))


def versions_of(kind: type[Library]) -> dict[str, str]:
    """Of the distributions it needs."""
    found = {}
    for need in kind.needs:
        name = need.partition("<")[0].partition(">")[0].partition("=")[0]
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


def run_library(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """All sets of a task by one library; and a report on it."""
    kind, task = library_of(name), Task.load(folder)
    library, report = kind(), {"calibration_us": calibration(), "errors": {}}
    try:
        report["supported"] = library.setup(task)
    except ImportError as error:
        return report | {"missing": f"{error}; pip install {' '.join(map(repr, kind.needs))}"}
    report |= {"versions": versions_of(kind), "settings": library.settings}
    if not report["supported"]:
        return report
    sets, saved = np.load(folder / "problems.npz"), {}
    poses = [library.forward(q) for q in sets["probes"]]
    if all(pose is not None for pose in poses):
        saved["probes"] = np.array(poses)
    for key in sorted(key[: -len("_targets")] for key in sets.files if key.endswith("_targets")):
        solutions, wall, cpu, errors = run_set(
            library.solve, sets[f"{key}_targets"], sets[f"{key}_starts"], seconds
        )
        saved |= {f"{key}_q": solutions, f"{key}_wall": wall, f"{key}_cpu": cpu}
        report["errors"][key] = errors  # type: ignore[index]
    np.savez(folder / "solutions.npz", **saved)  # type: ignore[arg-type]
    return report


if __name__ == "__main__":
    _folder = Path(sys.argv[2])
    _report = run_library(sys.argv[1], _folder, float(sys.argv[3]))
    (_folder / "report.json").write_text(json.dumps(_report), encoding="utf-8")
