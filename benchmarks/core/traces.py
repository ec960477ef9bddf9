"""Compares the descents of two installed versions of robot_ik, goal by goal.

    python benchmarks/core/traces.py OLD_PYTHON NEW_PYTHON [--method transpose] [--goals 300]
        [--seed 20]

Both versions solve the same seeded poses of the PUMA from home. The script prints at which step the
costs of the two traces of a goal differ, and the paired difference of the steps with its standard
error. If the first difference is a rounding error and the mean difference is not significant, the
two versions take the same steps.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

_WORKER = Path(__file__).with_name("worker.py")
# Relative differences of the cost for which the first step is printed.
_DIFFERENCES = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


def traces(python: str, method: str, goals: int, seed: int) -> list[dict[str, Any]]:
    """Return steps, status and costs of each goal."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "traces.json"
        command = [python, str(_WORKER), "traces", "puma560", method, str(goals), str(seed)]
        subprocess.run([*command, str(file)], check=True, stdout=subprocess.DEVNULL)
        rows: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))
    return rows


def first_steps(old: list[float], new: list[float]) -> list[int | None]:
    """Return the first step whose costs differ by more than each of ``_DIFFERENCES``."""
    count = min(len(old), len(new))
    before = np.array(old[:count])
    change = np.abs(before - np.array(new[:count])) / np.maximum(before, 1e-300)
    steps: list[int | None] = []
    for limit in _DIFFERENCES:
        beyond = np.flatnonzero(change > limit)
        steps.append(int(beyond[0]) if len(beyond) else None)
    return steps


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", help="Python of the old version")
    parser.add_argument("new", help="Python of the new version")
    parser.add_argument("--method", default="transpose")
    parser.add_argument("--goals", type=int, default=300)
    parser.add_argument("--seed", type=int, default=20)
    options = parser.parse_args()
    old, new = (
        traces(python, options.method, options.goals, options.seed)
        for python in (options.old, options.new)
    )
    drift = [first_steps(a["costs"], b["costs"]) for a, b in zip(old, new, strict=True)]
    print("median first step at which the costs differ by more than")
    for limit, column in zip(_DIFFERENCES, zip(*drift, strict=True), strict=True):
        first = [step for step in column if step is not None]
        median = np.median(first) if first else float("nan")
        print(f"  {limit:7.0e}  {median:7.0f}  ({len(first)} of {len(column)} goals)")
    steps = np.array([[row["steps"] for row in rows] for rows in (old, new)], dtype=float)
    change = steps[1] - steps[0]
    error = change.std(ddof=1) / np.sqrt(len(change))
    converged = [sum(row["status"] == "CONVERGED" for row in rows) for rows in (old, new)]
    print(f"converged {converged[0]} and {converged[1]} of {len(change)}")
    print(f"steps {steps[0].sum():.0f} and {steps[1].sum():.0f}")
    print(
        f"fewer steps for {(change < 0).sum()} goals, equal for {(change == 0).sum()}, "
        f"more for {(change > 0).sum()}"
    )
    print(f"mean difference {change.mean():.1f} steps, standard error {error:.1f}")


if __name__ == "__main__":
    main()
