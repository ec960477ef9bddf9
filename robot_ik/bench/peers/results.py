"""What the libraries answered, judged by MuJoCo, and the rounds put together."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.bench.methods.results import JUMP
from robot_ik.bench.peers.tasks import Sites

Array = NDArray[np.float64]
Cells = dict[str, dict[str, Any]]

#: Success of a pose, m and rad; exact; beyond a limit by so much is rounding.
SUCCESS, EXACT, _SLACK = (1e-4, 1e-3), (1e-6, 1e-6), 1e-6
#: Success of positions, m.
POINTS = 1e-4
#: A library whose own forward pass is off by more has read another robot, m and parts of a rotation matrix.
SAME_ROBOT = 1e-6


def judged(folder: Path) -> dict[str, Any]:
    """The results of a run: ``turn.json`` with a cell for each set of problems.

    Args:
        folder: Of the task, with the solutions of one library.
    """
    report: dict[str, Any] = json.loads((folder / "turn.json").read_text(encoding="utf-8"))
    if not report.get("supported"):
        return report
    sites = Sites(mujoco.MjModel.from_xml_path(str(folder / "model.xml")))
    problems, solutions = np.load(folder / "problems.npz"), np.load(folder / "answers.npz")
    if "probes" in solutions:
        own = [sites.poses(q)[0] for q in problems["probes"]]
        off = float(np.abs(np.array(own) - solutions["probes"]).max()) if len(own) else 0.0
        report["forward_off"] = off
        if not off <= SAME_ROBOT:
            return report | {"failed": f"its own forward pass is off by {off:.1e}: it reads another robot"}
    report["sets"] = {}
    for key in [name[: -len("_answers")] for name in solutions.files if name.endswith("_answers")]:
        report["sets"][key] = _cell(sites, key, problems, solutions)
    return report


def _cell(sites: Sites, key: str, problems: Any, solutions: Any) -> dict[str, Any]:
    q, wall, cpu = (solutions[f"{key}_{part}"] for part in ("answers", "wall", "cpu"))
    targets, starts = problems[f"{key}_targets"][: len(q)], problems[f"{key}_starts"][: len(q)]
    marks = np.array([_mark(sites, one, target) for one, target in zip(q, targets, strict=True)])
    cell = {
        "n": len(q),
        "success": float(marks[:, 0].mean()),
        "exact": float(marks[:, 1].mean()),
        "median_us": float(np.median(wall)),
        "cpu_mean_us": float(cpu.mean()),
        "cpu_p99_us": float(np.percentile(cpu, 99)),
    }
    if key == "warm":
        moved = np.abs(q - starts)[:, -len(sites.lower) :].max(axis=1)
        cell["jumps"] = int((moved[marks[:, 0] > 0] > JUMP).sum())
    return cell


def _mark(sites: Sites, q: Array, target: Array) -> tuple[bool, bool]:
    """Whether a solution (nq,) is a success, and whether it is exact."""
    if not np.isfinite(q).all():
        return False, False
    hinges = q[-len(sites.lower) :]
    if (hinges < sites.lower - _SLACK).any() or (hinges > sites.upper + _SLACK).any():
        return False, False
    if target.shape[-1] == 3:
        good = bool(np.linalg.norm(sites.positions(q) - target, axis=1).max() <= POINTS)
        return good, good
    there = sites.poses(q)[0]
    metres = float(np.linalg.norm(there[:3, 3] - target[:3, 3]))
    chord = float(np.linalg.norm(there[:3, :3] - target[:3, :3])) / (2.0 * np.sqrt(2.0))
    radians = 2.0 * float(np.arcsin(min(1.0, chord)))
    return (
        metres <= SUCCESS[0] and radians <= SUCCESS[1],
        metres <= EXACT[0] and radians <= EXACT[1],
    )


def merged(rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rounds of one cell put together: successes of all, times of the fastest.

    Other work on a machine only ever adds time.  The median is of wall-clock time; mean and p99 are of
    processor time, since among others on few cores they would else measure the scheduler.
    """
    total = sum(one["n"] for one in rounds)
    found: dict[str, Any] = {
        name: round(min(one[key] for one in rounds), 2)
        for name, key in (("median_us", "median_us"), ("mean_us", "cpu_mean_us"), ("p99_us", "cpu_p99_us"))
    }
    for key in ("success", "exact"):
        found[key] = round(sum(one[key] * one["n"] for one in rounds) / total, 5)
    return found | {"jumps": max(one.get("jumps", 0) for one in rounds), "n": total, "rounds": len(rounds)}
