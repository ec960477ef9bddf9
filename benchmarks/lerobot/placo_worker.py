"""LeRobot's ``RobotKinematics`` on placo, for ``compare_placo.py``, in an environment with placo.

    python placo_worker.py FOLDER

The calls of placo are those of ``lerobot.model.kinematics`` of LeRobot 0.6.1, without its import of
PyTorch. Each call begins with ``update_kinematics`` at the start: LeRobot's class leaves that to
its pipelines, which call ``forward_kinematics`` first. The program needs placo and NumPy only.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import placo

FRAME = "tool"
POSITION_WEIGHT = 1.0
ORIENTATION_WEIGHT = 0.01
"""LeRobot's default."""


class LeRobotKinematics:
    """LeRobot's kinematics with updated joints."""

    def __init__(self, urdf: Path, joints: list[str]) -> None:
        self.joints = joints
        self.robot = placo.RobotWrapper(str(urdf))
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.mask_fbase(True)
        self.frame_task = self.solver.add_frame_task(FRAME, np.eye(4))

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) at joint angles, rad."""
        for name, angle in zip(self.joints, q, strict=True):
            self.robot.set_joint(name, float(angle))
        self.robot.update_kinematics()
        return np.array(self.robot.get_T_world_frame(FRAME))

    def inverse(self, q: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return joint angles after one call from ``q``, rad."""
        self.forward(q)
        self.frame_task.T_world_frame = target
        self.frame_task.configure(FRAME, "soft", POSITION_WEIGHT, ORIENTATION_WEIGHT)
        self.solver.solve(True)
        self.robot.update_kinematics()
        return np.array([self.robot.get_joint(name) for name in self.joints])


def main() -> None:
    """Solve the cases of a folder and write the answers beside them."""
    folder = Path(sys.argv[1])
    cases = json.loads((folder / "cases.json").read_text())
    kinematics = LeRobotKinematics(folder / "arm.urdf", cases["joints"])
    answers = {"poses": [kinematics.forward(np.array(q)).tolist() for q in cases["check"]]}
    for name, case in cases["cases"].items():
        for calls in case["calls"]:
            rows = []
            seconds = []
            q = np.zeros(len(cases["joints"]))
            for start, target in zip(case["starts"], case["targets"], strict=True):
                q = q if start is None else np.array(start)
                begin = time.perf_counter()
                for _ in range(calls):
                    q = kinematics.inverse(q, np.array(target))
                seconds.append(time.perf_counter() - begin)
                rows.append(q.tolist())
            answers[f"{name}/{calls}"] = {"q": rows, "seconds": seconds}
    (folder / "answers.json").write_text(json.dumps(answers))


if __name__ == "__main__":
    main()
