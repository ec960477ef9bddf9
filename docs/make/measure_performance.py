"""Measure the numbers of performance.md and comparison.md in docs/reference.

    python -m benchmarks.peers install ENVIRONMENTS
    python docs/make/measure_performance.py ENVIRONMENTS RESULTS
    python docs/make/performance.py RESULTS

A library that is not installed is named, and its rows are missing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

#: The libraries of the page. `ikpy` is left out: it takes minutes, the others seconds.
LIBRARIES = (
    "robot_ik",
    "robot_ik_lm",
    "robot_ik_analytic",
    "rtb_lm",
    "eaik",
    "placo",
    "placo_restarts",
)
#: Our own benchmarks, each with its own folder of results.
BENCHES = {
    "methods": "bench --count 200 --seconds 2",
    "kernels": "bench --problems kernels --solver lm dls transpose ccd fabrik",
    "batch": "bench --problems batch --solver auto lm --robot puma560",
}


def measure(environments: Path, out: Path, rounds: int, count: int) -> int:
    """Run the comparison and our own benchmarks. Return the exit code of the comparison."""
    out.mkdir(parents=True, exist_ok=True)
    code = call(
        "-m",
        "benchmarks.peers",
        "run",
        "--environments",
        environments,
        "--out",
        out / "peers",
        "--libraries",
        *LIBRARIES,
        "--rounds",
        rounds,
        "--count",
        count,
    )
    for name, arguments in BENCHES.items():
        code |= call("-m", "robot_ik", *arguments.split(), "--out", out / name)
    return code


def call(*arguments: object) -> int:
    """Print a command and run it with this Python."""
    command = [sys.executable, *(str(argument) for argument in arguments)]
    sys.stderr.write("$ " + " ".join(command) + "\n")
    return subprocess.run(command, check=False).returncode


def main() -> int:
    """Run the comparison and the benchmarks of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in ("environments", "results"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--rounds", type=int, default=3, help="rounds of all libraries")
    parser.add_argument("--count", type=int, default=1000, help="problems of a kind")
    asked = parser.parse_args()
    return measure(asked.environments, asked.results, asked.rounds, asked.count)


if __name__ == "__main__":
    raise SystemExit(main())
