"""Measure the numbers of performance.md and comparison.md in docs/reference, and write the pages.

    python -m benchmarks.peers install ENVIRONMENTS
    python docs/make/measure_performance.py ENVIRONMENTS RESULTS

The numbers go into docs/performance.json, and the tables of both pages come from this file. A
library that is not installed is named on the page with the reason.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

BENCHES = {
    "methods": "bench --count 200 --seconds 2 --plot",
    "kernels": "bench --problems kernels --solver lm dls transpose ccd fabrik --plot",
    "batch": "bench --problems batch --solver auto lm --robot puma560",
}
"""Our own benchmarks, by folder of the results."""

PAGES = Path(__file__).resolve().with_name("performance.py")

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the checkout, which holds ``benchmarks``."""


def measure(environments: Path, out: Path, rounds: int, count: int) -> int:
    """Run the comparison and our own benchmarks, and write the pages. Return the exit code."""
    out.mkdir(parents=True, exist_ok=True)
    code = call(
        "-m",
        "benchmarks.peers",
        "run",
        "--environments",
        environments,
        "--out",
        out / "peers",
        "--rounds",
        rounds,
        "--count",
        count,
    )
    for name, arguments in BENCHES.items():
        code |= call("-m", "robot_ik", *arguments.split(), "--overwrite", "--out", out / name)
    return code | call(PAGES, out)


def call(*arguments: object) -> int:
    """Print a command and run it with this Python."""
    command = [sys.executable, *(str(argument) for argument in arguments)]
    sys.stderr.write("$ " + " ".join(command) + "\n")
    return subprocess.run(command, check=False, cwd=ROOT).returncode


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
    environments = asked.environments.resolve()
    return measure(environments, asked.results.resolve(), asked.rounds, asked.count)


if __name__ == "__main__":
    raise SystemExit(main())
