"""Compares two installed versions of robot_ik: steps, success and time.

    python benchmarks/core/compare.py OLD_PYTHON NEW_PYTHON [--goals 100] [--rounds 3]
        [--only counts|times|compile] [--method NAME]

Runs ``worker.py`` with both interpreters in turn, so that both see the same load of the machine,
and prints a table for each measurement. A ratio below 1 means that the new version is faster.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_WORKER = Path(__file__).with_name("worker.py")
_ROBOTS = ("puma560", "panda", "ur5e")
_TIMED = ("auto", "lm", "dls")
_COUNTED = ("auto", "lm", "dls", "transpose", "sdls", "pseudoinverse", "bfgs", "ccd", "fabrik")
# ``frames`` is the kernel of the figure's motions, ``levels`` is ``lm`` with priorities.
_COMPILED = (*_COUNTED, "triangulation", "recursive", "frames", "levels")


def run(python: str, *arguments: str, cache: str | None = None) -> dict[str, Any]:
    """Return what the worker prints; ``cache`` replaces the folder of compiled code."""
    environment = dict(os.environ, OPENBLAS_NUM_THREADS="1")
    if cache is not None:
        environment["XDG_CACHE_HOME"] = cache
    done = subprocess.run(
        [python, str(_WORKER), *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def compare_counts(old: str, new: str, methods: Sequence[str], goals: int) -> None:
    """Print converged goals, steps and restarts of every method."""
    print(f"\ncounts over {goals} seeded goals: converged / steps / restarts")
    for method in methods:
        for robot in _ROBOTS:
            counts = [run(python, "counts", robot, method, str(goals)) for python in (old, new)]
            texts = [
                f"{count['converged']:4d} {count['iterations']:7d} {count['restarts']:5d}"
                for count in counts
            ]
            print(f"{method:14s} {robot:8s}  old {texts[0]}   new {texts[1]}", flush=True)


def compare_times(old: str, new: str, methods: Sequence[str], rounds: int) -> None:
    """Print medians in microseconds, the two versions in turn."""
    print("\nmicroseconds: old, new, ratio")
    for method in methods:
        for robot in _ROBOTS:
            for what in ("times", "batch"):
                pairs = [
                    (run(old, what, robot, method), run(new, what, robot, method))
                    for _ in range(rounds)
                ]
                for key in pairs[0][0]:
                    before = min(pair[0][key] for pair in pairs)
                    after = min(pair[1][key] for pair in pairs)
                    ratio = statistics.median(pair[1][key] / pair[0][key] for pair in pairs)
                    print(
                        f"{method:5s} {robot:8s} {key:13s} {before:8.2f} {after:8.2f} {ratio:6.2f}",
                        flush=True,
                    )


def compare_compile(old: str, new: str, methods: Sequence[str], rounds: int) -> None:
    """Print CPU seconds of a first solve with an empty cache, the two versions in turn.

    The seconds are the least of all rounds, the ratio is the median of the pairs.
    """
    print("\nfirst compile with an empty cache, CPU seconds: old, new (least), ratio (median)")
    for method in methods:
        pairs = []
        for _ in range(rounds):
            seconds = []
            for python in (old, new):
                with tempfile.TemporaryDirectory() as cache:
                    result = run(python, "compile", _ROBOTS[0], method, cache=cache)
                seconds.append(result["seconds"])
            pairs.append(seconds)
        before = min(pair[0] for pair in pairs)
        after = min(pair[1] for pair in pairs)
        ratio = statistics.median(pair[1] / pair[0] for pair in pairs)
        print(f"{method:14s} {before:6.2f} {after:6.2f} {ratio:6.2f}", flush=True)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", help="Python of the old version")
    parser.add_argument("new", help="Python of the new version")
    parser.add_argument("--goals", type=int, default=100, help="Goals of each count")
    parser.add_argument("--rounds", type=int, default=3, help="Pairs of each timing")
    parser.add_argument(
        "--only", choices=("counts", "times", "compile"), help="Run this measurement only"
    )
    parser.add_argument("--method", help="Measure this method only")
    options = parser.parse_args()
    methods = [options.method] if options.method else None
    if options.only in (None, "counts"):
        compare_counts(options.old, options.new, methods or _COUNTED, options.goals)
    if options.only in (None, "times"):
        compare_times(options.old, options.new, methods or _TIMED, options.rounds)
    if options.only in (None, "compile"):
        compare_compile(options.old, options.new, methods or _COMPILED, options.rounds)


if __name__ == "__main__":
    main()
