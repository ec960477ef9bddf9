"""Solutions of the libraries, judged by MuJoCo, and rounds put together."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.tasks import POINTS_TOLERANCE, site_names
from robot_ik.bench.methods.results import JUMP
from robot_ik.geometry import Pose
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

SUCCESS_POSITION = 1e-3
"""Largest position error of a success, m."""

SUCCESS_ANGLE = math.radians(1.0)
"""Largest angle error of a success, rad."""

EXACT = 1e-6
"""Largest errors of an exact solution, m and rad."""

SAME_ROBOT = 1e-6
"""Largest error of a library's forward kinematics, m and parts of a rotation matrix. With a larger
one the library has read another robot."""

_LIMIT_SLACK = 1e-6
"""Radians by which rounding may exceed a joint limit."""


def judged(folder: Path) -> dict[str, Any]:
    """Return the report in a task's folder, with a cell for each set of problems."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    if not report.get("supported"):
        return report
    robot = load_robot(folder / "model.xml")
    problems = np.load(folder / "problems.npz")
    solutions = np.load(folder / "solutions.npz")
    if "probes" in solutions:
        site = site_names(robot)[0]
        poses = [robot.measure(q, site).matrix for q in problems["probes"]]
        error = 0.0
        if poses:
            error = float(np.abs(np.array(poses) - solutions["probes"]).max())
        if not error <= SAME_ROBOT:
            failure = f"its forward kinematics are wrong by {error:.1e}: it reads another robot"
            return report | {"failed": failure}
    keys = [name.removesuffix("_q") for name in solutions.files if name.endswith("_q")]
    report["sets"] = {key: _cell(robot, key, problems, solutions) for key in keys}
    return report


def _cell(robot: Robot, key: str, problems: Any, solutions: Any) -> dict[str, Any]:
    """Return the results of one set of problems."""
    q = solutions[f"{key}_q"]
    cpu = solutions[f"{key}_cpu"]
    targets = problems[f"{key}_targets"][: len(q)]
    starts = problems[f"{key}_starts"][: len(q)]
    marks = [_mark(robot, row, target) for row, target in zip(q, targets, strict=True)]
    is_success = np.array([success for success, _ in marks])
    cell = {
        "n": len(q),
        "success": float(is_success.mean()),
        "exact": float(np.mean([exact for _, exact in marks])),
        "median_us": float(np.median(solutions[f"{key}_wall"])),
        "cpu_mean_us": float(cpu.mean()),
        "cpu_p99_us": float(np.percentile(cpu, 99)),
    }
    if key == "warm":
        first_joint = 7 if robot.nq > robot.nv else 0
        changes = np.abs(q - starts)[:, first_joint:].max(axis=1)
        cell["jumps"] = int((changes[is_success] > JUMP).sum())
    return cell


def _mark(robot: Robot, q: Array, target: Array) -> tuple[bool, bool]:
    """Return whether a solution (nq,) is a success, and whether it is exact."""
    if not np.isfinite(q).all() or robot.outside(q, _LIMIT_SLACK):
        return False, False
    poses = [robot.measure(q, site) for site in site_names(robot)]
    if target.shape[-1] == 3:
        errors = np.array([pose.position for pose in poses]) - target
        is_near = bool(np.linalg.norm(errors, axis=1).max() <= POINTS_TOLERANCE)
        return is_near, is_near
    distance, angle = poses[0].distance(Pose.from_matrix(target))
    is_success = distance <= SUCCESS_POSITION and angle <= SUCCESS_ANGLE
    return is_success, distance <= EXACT and angle <= EXACT


def merged(rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return one cell for several rounds: successes of all, times of the fastest.

    Other work on a machine only adds to a time. The median is wall-clock time. Mean and p99 are
    processor time, because beside other programs they would measure the scheduler.
    """
    total = sum(cell["n"] for cell in rounds)
    result: dict[str, Any] = {}
    for name, key in (
        ("median_us", "median_us"),
        ("mean_us", "cpu_mean_us"),
        ("p99_us", "cpu_p99_us"),
    ):
        result[name] = round(min(cell[key] for cell in rounds), 2)
    for key in ("success", "exact"):
        result[key] = round(sum(cell[key] * cell["n"] for cell in rounds) / total, 5)
    result["jumps"] = max(cell.get("jumps", 0) for cell in rounds)
    result["n"] = total
    result["rounds"] = len(rounds)
    return result
