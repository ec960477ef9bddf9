"""Calls without ``collisions=``: the same bits and no more time than at an earlier commit.

    git worktree add FOLDER COMMIT
    taskset -c 0 python -m benchmarks.collision.unchanged FOLDER [--rounds 5]

Both checkouts solve the same poses, in turn, each in its own process. The answers are compared
bit by bit. A time is the smallest processor time of a call over all rounds, so other programs on
the machine count little.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROBOTS = ("puma560", "ur5e", "panda")
SOLVERS = ("auto", "lm")
POSES = 300

PROGRAM = f"""
import hashlib, json, time
import numpy as np
import robot_ik as rik

answers = {{}}
for name in {ROBOTS!r}:
    robot = rik.load_robot(name)
    rng = np.random.default_rng(5)
    poses = [robot.forward(robot.sample(rng)) for _ in range({POSES})]
    for solver in {SOLVERS!r}:
        digest = hashlib.sha256()
        times = []
        rik.solve(robot, poses[0], solver=solver)
        for pose in poses:
            began = time.thread_time()
            solution = rik.solve(robot, pose, solver=solver)
            times.append(time.thread_time() - began)
            digest.update(np.ascontiguousarray(solution.q).tobytes())
            digest.update(solution.status.name.encode())
        answers[f"{{name}}, {{solver}}"] = digest.hexdigest(), sorted(times)[len(times) // 2]
print(json.dumps(answers))
"""
"""Runs with the package of one checkout, and prints digest and median time of each case."""


def run(folder: Path) -> dict[str, tuple[str, float]]:
    """Return digest and median seconds of each case with the package of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", PROGRAM]
    process = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    answers: dict[str, tuple[str, float]] = json.loads(process.stdout.splitlines()[-1])
    return answers


def main() -> None:
    """Print the table. Exit with 1 if an answer differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path, help="folder of the earlier commit")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    before = options.before.resolve()
    now = Path(__file__).resolve().parents[2]
    rounds = [(run(before), run(now)) for _ in range(options.rounds)]
    print("| call | same bits | µs before | µs now | ratio |")
    print("|---|---|---:|---:|---:|")
    differs = False
    for case, (digest, _) in rounds[0][0].items():
        same = rounds[0][1][case][0] == digest
        differs = differs or not same
        old = min(first[case][1] for first, _ in rounds)
        new = min(second[case][1] for _, second in rounds)
        print(
            f"| {case} | {'yes' if same else 'no'} | {1e6 * old:.1f} | {1e6 * new:.1f} "
            f"| {new / old:.2f} |"
        )
    sys.exit(1 if differs else 0)


if __name__ == "__main__":
    main()
