"""Run one library in its own interpreter. It needs numpy and the library only.

    python -P -m benchmarks.peers.worker LIBRARY FOLDER SECONDS

LIBRARY is a row of ``LIBRARIES`` or FILE.py:CLASS. FOLDER holds the files of ``tasks``. Solutions
and times go into ``solutions.npz`` and ``report.json`` in it. ``judge`` checks them. A time is that
of a whole call: an array in, joint angles out, with all conversions, restarts and limits.
"""

from __future__ import annotations

import gc
import importlib
import importlib.metadata
import json
import os
import re
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_variable, "1")

import numpy as np

from benchmarks.peers.library import Array, Library, Task

_WARM_UP = 5
"""Solves before each set whose times do not count."""

_LEAST_PROBLEMS = 20
"""Smallest number of problems of a set, even after its time is over."""

_COMMIT_DIGITS = 8
"""Digits of a commit in a version."""

_PLACE = "benchmarks.peers"

LIBRARIES = {
    "robot_ik": f"{_PLACE}.ours:OursAuto",
    "robot_ik_lm": f"{_PLACE}.ours:Numeric",
    "robot_ik_analytic": f"{_PLACE}.ours:ClosedForm",
    "eaik": f"{_PLACE}.closed_forms:Eaik",
    "ssik": f"{_PLACE}.closed_forms:Ssik",
    "rtb_analytic": f"{_PLACE}.closed_forms:RoboticsToolboxAnalytic",
    "rtb_lm": f"{_PLACE}.numeric:RoboticsToolbox",
    "trac_ik": f"{_PLACE}.numeric:TracIk",
    "placo": f"{_PLACE}.differential:Placo",
    "placo_restarts": f"{_PLACE}.differential:PlacoRestarts",
    "mink": f"{_PLACE}.differential:Mink",
    "mink_restarts": f"{_PLACE}.differential:MinkRestarts",
    "pink": f"{_PLACE}.differential:Pink",
    "pink_restarts": f"{_PLACE}.differential:PinkRestarts",
    "pyroki": f"{_PLACE}.jax_based:PyRoki",
    "pyroki_beam": f"{_PLACE}.jax_based:PyRokiBeam",
    "ikpy": f"{_PLACE}.numeric:IkPy",
}
"""Class of each library, as module:class, by name."""


def library_of(name: str) -> type[Library]:
    """Return the class of a row, or of FILE.py:CLASS."""
    place, _, kind = LIBRARIES.get(name, name).rpartition(":")
    is_file = place.endswith(".py")
    names = runpy.run_path(place) if is_file else vars(importlib.import_module(place))
    library: type[Library] = names[kind]
    return library


def run_set(
    solve: Callable[[Array, Array], Array | None], targets: Array, starts: Array, seconds: float
) -> Any:
    """Solve one set of problems.

    Returns:
        Solutions (n, nq), wall-clock and processor times (n,) in µs, and the errors by their text.
    """
    errors: dict[str, int] = {}
    for target, start in zip(targets[:_WARM_UP], starts, strict=False):
        _try(solve, target, start, {})
    solutions = []
    wall = []
    cpu = []
    began = time.perf_counter()
    gc.collect()
    gc.disable()
    for target, start in zip(targets.copy(), starts.copy(), strict=True):
        cpu_begin = time.process_time_ns()
        wall_begin = time.perf_counter_ns()
        q = _try(solve, target, start, errors)
        wall.append((time.perf_counter_ns() - wall_begin) / 1e3)
        cpu.append((time.process_time_ns() - cpu_begin) / 1e3)
        shape = starts.shape[1:]
        is_complete = q is not None and np.shape(q) == shape
        solutions.append(np.array(q, dtype=float) if is_complete else np.full(shape, np.nan))
        if time.perf_counter() - began > seconds and len(wall) >= _LEAST_PROBLEMS:
            break
    gc.enable()
    return np.array(solutions), np.array(wall), np.array(cpu), errors


def _try(
    solve: Callable[..., Array | None], target: Array, start: Array, errors: dict[str, int]
) -> Array | None:
    """Return the solution, or None. An exception is counted in ``errors`` by its text."""
    try:
        return solve(target, start)
    except Exception as error:  # a solve that raises is a failed solve
        text = f"{type(error).__name__}: {str(error)[:80]}"
        errors[text] = errors.get(text, 0) + 1
        return None


def versions_of(kind: type[Library]) -> dict[str, str]:
    """Return the versions of the distributions that a library needs."""
    versions = {}
    for need in kind.needs:
        name = distribution_of(need)
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "unknown"
    for name in kind.sources:
        head = source_folder(Path(sys.prefix), name) / ".git" / "HEAD"
        commit = head.read_text(encoding="utf-8").strip() if head.exists() else "unknown"
        versions[name] = f"commit {commit[:_COMMIT_DIGITS]}"
    return versions


def distribution_of(need: str) -> str:
    """Return the name of the distribution in a requirement of pip."""
    match = re.match(r"[\w.-]+", need)
    return need if match is None else match[0]


def source_folder(environment: Path, name: str) -> Path:
    """Return the folder of the source of a library in its environment."""
    return environment / "src" / name


def run_library(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Solve all sets of a task by one library. Return its report."""
    kind = library_of(name)
    task = Task.load(folder)
    library = kind()
    try:
        supported = library.setup(task)
    except ImportError as error:
        sources = [f"git+{source.url}@{source.commit}" for source in kind.sources.values()]
        install = f"pip install {' '.join(map(repr, [*kind.needs, *sources]))}"
        return {"missing": f"{error}; {install}"}
    report: dict[str, Any] = {"supported": supported, "errors": {}}
    report["versions"] = versions_of(kind)
    report["settings"] = library.settings
    if not supported:
        return report
    problems = np.load(folder / "problems.npz")
    arrays: dict[str, Array] = {}
    poses = [library.forward(q) for q in problems["probes"]]
    if all(pose is not None for pose in poses):
        arrays["probes"] = np.array(poses)
    suffix = "_targets"
    for key in sorted(name[: -len(suffix)] for name in problems.files if name.endswith(suffix)):
        solutions, wall, cpu, errors = run_set(
            library.solve, problems[f"{key}_targets"], problems[f"{key}_starts"], seconds
        )
        arrays[f"{key}_q"] = solutions
        arrays[f"{key}_wall"] = wall
        arrays[f"{key}_cpu"] = cpu
        report["errors"][key] = errors
    np.savez(folder / "solutions.npz", **arrays)
    return report


if __name__ == "__main__":
    _folder = Path(sys.argv[2])
    _report = run_library(sys.argv[1], _folder, float(sys.argv[3]))
    (_folder / "report.json").write_text(json.dumps(_report), encoding="utf-8")
