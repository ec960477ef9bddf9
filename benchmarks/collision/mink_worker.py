"""Steps of mink with its collision limit; ``limited_step.py`` runs it in another environment.

Reads the task as JSON from stdin and writes times and postures as JSON to stdout. It needs the
packages ``mink``, ``mujoco`` and ``daqp``, and not this project.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from typing import Any

import mink
import mujoco
import numpy as np


def main() -> None:
    """Run the task of stdin."""
    task = json.loads(sys.stdin.read())
    model = mujoco.MjModel.from_binary_path(task["model"])
    configuration = mink.Configuration(model)
    configuration.update(np.array(task["start"]))
    frame = mink.FrameTask(task["frame"], "site", position_cost=1.0, orientation_cost=1.0)
    limits = [
        mink.ConfigurationLimit(model),
        mink.VelocityLimit(model, {name: np.array([v]) for name, v in task["speeds"].items()}),
        mink.CollisionAvoidanceLimit(
            model,
            [([first], [second]) for first, second in task["pairs"]],
            gain=task["gain"],
            minimum_distance_from_collisions=task["margin"],
            collision_detection_distance=task["detection"],
        ),
    ]
    rotation = mink.SO3(np.array(task["wxyz"]))
    medians = []
    for _ in range(task["runs"]):
        configuration.update(np.array(task["start"]))
        seconds, rows = run(configuration, frame, rotation, limits, task)
        medians.append(statistics.median(seconds))
    print(json.dumps({"seconds": min(medians), "qpos": rows}))


def run(
    configuration: mink.Configuration,
    frame: mink.FrameTask,
    rotation: mink.SO3,
    limits: list[mink.Limit],
    task: dict[str, Any],
) -> tuple[list[float], list[list[float]]]:
    """Return the processor seconds of each step and the postures; moves ``configuration``."""
    seconds = []
    rows = []
    for target in task["targets"]:
        began = time.process_time()
        frame.set_target(mink.SE3.from_rotation_and_translation(rotation, np.array(target)))
        velocity = mink.solve_ik(
            configuration, [frame], task["dt"], "daqp", damping=1e-4, limits=limits
        )
        configuration.integrate_inplace(velocity, task["dt"])
        seconds.append(time.process_time() - began)
        rows.append(configuration.q.tolist())
    return seconds, rows


if __name__ == "__main__":
    main()
