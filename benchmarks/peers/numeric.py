"""Libraries that search joint angles of an arm numerically."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from benchmarks.peers.library import Array, Library, Task, wxyz_of


class RoboticsToolbox(Library):
    """Robotics Toolbox for Python: ``ETS.ik_LM`` in C++, Chan's damping, 100 random starts."""

    needs = ("roboticstoolbox-python[ik]",)

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        rtb = importlib.import_module("roboticstoolbox")
        parts = []
        for frame, lower, upper in zip(task.frames, task.lower, task.upper, strict=False):
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
        return np.asarray(answer.q)

    def forward(self, q: Array) -> Array:
        return np.asarray(self._chain.fkine(q).A)


class TracIk(Library):
    """TRAC-IK by pytracik: KDL's Newton steps and a nonlinear program, in two threads (C++)."""

    needs = ("pytracik", "numpy")
    timeout = 0.05
    """Longest time of a solve, s. With its default of 0.005 it misses more poses."""

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        # The binding itself: the class around it needs an older numpy.
        self._binding = importlib.import_module("pytracik")
        text = Path(task.urdf).read_text(encoding="utf-8")
        epsilon = 0.3 * min(task.position, task.angle)  # of each of six coordinates
        kind = self._binding.SolveType.Speed
        self._solver = self._binding.TRAC_IK(
            "base", task.sites[0], text, self.timeout, epsilon, kind
        )
        self.settings = f"Speed, timeout {self.timeout} s, epsilon {epsilon:g}"
        return True

    def solve(self, target: Array, start: Array) -> Array | None:
        x, y, z = target[:3, 3].tolist()
        qw, qx, qy, qz = wxyz_of(target[:3, :3])
        answer = self._binding.ik(self._solver, start, x, y, z, qx, qy, qz, qw)
        return np.asarray(answer[1:]) if answer[0] >= 0 else None

    def forward(self, q: Array) -> Array:
        return np.asarray(self._binding.fk(self._solver, q))


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
