"""A step of following that keeps away from collisions: time and kept margin, beside mink.

    taskset -c 0 python -m benchmarks.collision.limited_step [--mink PYTHON]

``--mink`` names the Python of another environment with the packages ``mink``, ``mujoco`` and
``daqp``. Both sides push the hand of a Panda sideways and down through a box beside a table, 400
steps at 200 Hz, with joint and speed limits, all pairs of the scene, and the same detection
distance. A time is the median processor time of a whole step in Python, from the creation of the
target to the new posture. Neither side's time includes the record of the postures. The lowest
median of some equal runs counts, because other programs on the machine only add to a time. MuJoCo
measures the clearance of all postures.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

import robot_ik as rik
from robot_ik.motion.trajectory import RecorderSink

RATE = 200.0
"""Hz."""

STEPS = 400
"""Steps of a run."""

RUNS = 6
"""Equal runs of each side. The first also loads the compiled code."""

MARGIN = 0.005
"""m. Distance that the hand must keep."""

DETECTION = 0.05
"""m. Pairs nearer than this beyond the margin limit a step: the constant of our step."""

START = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
"""rad. Joint angles of the Panda at the start."""

GAINS = {"mink, default gain": 0.85, "mink, gain 0.85 dt": 0.85 / RATE}
"""Gains of mink's limit. Its bound is divided by dt, so the default does not keep the margin."""

_WORKER = Path(__file__).with_name("mink_worker.py")


def positions(begin: np.ndarray) -> np.ndarray:
    """Return the target positions (STEPS, 3), m, of the hand."""
    u = 2.0 * np.pi * np.arange(STEPS) / STEPS
    shift = [0.12 * np.sin(u), 0.25 * np.sin(2.0 * u), -0.125 * (1.0 - np.cos(u))]
    return begin + np.column_stack(shift)


@dataclass
class Push:
    """A source of the targets that records when it is read.

    Attributes:
        targets: (n, 3) positions, m.
        wxyz: Orientation of all targets.
        began: Processor seconds at which each step began.
    """

    targets: np.ndarray
    wxyz: np.ndarray
    began: list[float] = field(default_factory=list)

    def poll(self, now: float) -> rik.PoseGoal:
        """Return the target of a tick."""
        self.began.append(time.process_time())
        index = min(round(now * RATE), len(self.targets) - 1)
        return rik.PoseGoal.at(None, rik.Pose(self.targets[index], self.wxyz))


class Arrivals(RecorderSink):
    """A recorder of the postures that records when they arrive.

    Attributes:
        ended: Processor seconds at which each step ended.
    """

    def __init__(self, joints: tuple[str, ...]) -> None:
        super().__init__(joints)
        self.ended: list[float] = []

    def send(self, q: np.ndarray, now: float) -> None:
        """Record a posture."""
        self.ended.append(time.process_time())
        super().send(q, now)


def scene_of(robot: rik.Robot) -> rik.Scene:
    """Return the Panda with a box and a table."""
    box = rik.Box("box", size=(0.2, 0.3, 0.4), pose=rik.Pose((0.5, 0.0, 0.2)))
    table = rik.Box("table", size=(1.1, 1.0, 0.03), pose=rik.Pose((0.3, 0.0, -0.03)))
    return rik.Scene(robot, [box, table])


def run_ours(scene: rik.Scene) -> tuple[float, float]:
    """Return the median of a step, s, and the smallest clearance, m."""
    robot = scene.robot
    start = np.array(START)
    begin = robot.forward(start)
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    medians = []
    for _ in range(RUNS):
        source = Push(positions(begin.position), begin.wxyz)
        recorder = Arrivals(robot.joints)
        rik.follow(
            robot,
            source,
            sinks=[recorder],
            start=start,
            rate=RATE,
            duration=STEPS / RATE,
            clock=rik.VirtualClock(),
            collisions=avoid,
        )
        medians.append(float(np.median(np.array(recorder.ended) - source.began)))
    return min(medians), smallest_clearance(scene, recorder.trajectory().q)


def run_mink(scene: rik.Scene, python: str, gain: float) -> tuple[float, float]:
    """Return the median of a step of mink, s, and the smallest clearance, m."""
    robot = scene.robot
    start = np.array(START)
    begin = robot.forward(start)
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "scene.mjb"
        mujoco.mj_saveModel(scene.model, str(model), None)
        task = {
            "model": str(model),
            "start": robot.qpos(start).tolist(),
            "frame": robot.tool,
            "targets": positions(begin.position).tolist(),
            "wxyz": begin.wxyz.tolist(),
            "pairs": scene.pairs.tolist(),
            "speeds": dict(zip(robot.joints, robot.velocity_limits.tolist(), strict=True)),
            "dt": 1.0 / RATE,
            "runs": RUNS,
            "gain": gain,
            "margin": MARGIN,
            "detection": MARGIN + DETECTION,
        }
        process = subprocess.run(
            [python, str(_WORKER)],
            input=json.dumps(task),
            capture_output=True,
            text=True,
            check=True,
        )
    answer = json.loads(process.stdout.splitlines()[-1])
    rows = np.array(answer["qpos"])[:, robot._addresses]
    return answer["seconds"], smallest_clearance(scene, rows)


def smallest_clearance(scene: rik.Scene, rows: np.ndarray) -> float:
    """Return the smallest clearance of postures (n, nq), m, by MuJoCo."""
    return min(scene.clearance(q).distance for q in rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mink", default="", metavar="PYTHON")
    options = parser.parse_args()
    scene = scene_of(rik.load_robot("panda"))
    print(f"{len(scene.pairs)} pairs, margin {1e3 * MARGIN:g} mm")
    print("| method | step, µs | smallest clearance, mm | ratio of the times |")
    print("|---|---:|---:|---:|")
    ours, clearance = run_ours(scene)
    print(f"| ours | {1e6 * ours:.1f} | {1e3 * clearance:.2f} | |", flush=True)
    for name, gain in GAINS.items() if options.mink else ():
        theirs, clearance = run_mink(scene, options.mink, gain)
        ratio = theirs / ours
        print(f"| {name} | {1e6 * theirs:.1f} | {1e3 * clearance:.2f} | {ratio:.1f} |", flush=True)


if __name__ == "__main__":
    main()
