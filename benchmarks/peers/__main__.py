"""Make the environments of the libraries, and run each library several times.

    python -m benchmarks.peers install ENVIRONMENTS
    python -m benchmarks.peers run --environments ENVIRONMENTS --out RESULTS

A library without an environment is expected beside robot_ik. A missing library is reported with
the line that installs it, the others are measured, and the exit code is 1. RESULTS/peers.json holds
what was measured, with versions, seed and day. RESULTS/tasks holds the problems.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.peers import worker
from benchmarks.peers.judge import judged, merged
from benchmarks.peers.library import Library
from benchmarks.peers.tasks import ARMS, FIGURE, write_task
from robot_ik.bench.methods.results import calibration, this_machine
from robot_ik.files import make_folder
from robot_ik.workcell.results import save_json

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the checkout. The worker is imported from it."""

_SHARED = {
    "rtb_analytic": "rtb_lm",
    "placo_restarts": "placo",
    "mink_restarts": "mink",
    "pink_restarts": "pink",
    "pyroki_beam": "pyroki",
}
"""Environment of a library that shares that of another."""

_SLOW = ("ikpy",)
"""Libraries that run only if they are named. They take minutes, the others seconds."""

_OURS = "benchmarks.peers.ours"
"""Module of our own rows. They run in this environment."""

_SETS = 6
"""Largest number of sets of a task."""

_SECONDS_MARGIN = 600.0
"""Time of a library beside its sets, s. JAX compiles PyRoki's 64 starts for minutes."""

_EPILOG = (
    f"libraries: {', '.join(worker.LIBRARIES)}; or FILE.py:CLASS, as library.Library describes it"
)


def interpreter(name: str, environments: Path | None) -> str:
    """Return the Python of a library: that of its environment, or this one."""
    if environments is not None:
        python = environments / _SHARED.get(name, name) / "bin" / "python"
        if python.exists():
            return str(python)
    return sys.executable


def install(environments: Path, names: Sequence[str]) -> int:
    """Make an environment for each library that needs one. Return 1 if one could not be made."""
    is_complete = True
    for name in dict.fromkeys(_SHARED.get(name, name) for name in names):
        if worker.LIBRARIES[name].startswith(_OURS):
            continue
        folder = environments / name
        is_installed = all(
            subprocess.run(command, check=False).returncode == 0
            for command in install_commands(worker.library_of(name), folder)
        )
        is_complete = is_complete and is_installed
        say(f"{name}: {'installed' if is_installed else 'could not be installed'}")
    return 0 if is_complete else 1


def install_commands(kind: type[Library], folder: Path) -> list[list[str]]:
    """Return the commands that make the environment of a library in a folder.

    Only the folder ``src`` of a source is checked out. Its requirements are among ``kind.needs``.
    """
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    commands = [[sys.executable, "-m", "venv", str(folder)], [*pip, *kind.needs]]
    for name, source in kind.sources.items():
        clone = str(worker.source_folder(folder, name))
        git = ["git", "-C", clone]
        if not Path(clone).exists():
            commands.append(["git", "clone", "--quiet", "--no-checkout", source.url, clone])
        commands.append([*git, "sparse-checkout", "set", "src"])
        commands.append([*git, "checkout", "--quiet", "--detach", source.commit])
        commands.append([*pip, "--no-deps", clone])
    return commands


def run_library(name: str, task: Path, environments: Path | None, seconds: float) -> dict[str, Any]:
    """Run all sets of a task by a library in another process, and judge its solutions."""
    for file in ("report.json", "solutions.npz"):
        (task / file).unlink(missing_ok=True)
    place = name.rpartition(":")[0]
    if place and not Path(place).is_file():
        return {"failed": f"there is no file {place}"}
    command = [interpreter(name, environments), "-P", "-m", worker.__name__, name, str(task)]
    command.append(str(seconds))
    limit = _SETS * seconds + _SECONDS_MARGIN
    # The worker is in the checkout. Nothing else of this interpreter's path reaches another one.
    environment = os.environ | {"PYTHONPATH": str(_ROOT)}
    speed_us = calibration()
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"it took more than {limit:.0f} s"}
    if done.returncode != 0 or not (task / "report.json").exists():
        lines = done.stderr.strip().splitlines()
        return {"failed": lines[-1] if lines else "it ended without a message"}
    return judged(task) | {"calibration_us": speed_us}


def compare(
    names: Sequence[str],
    robots: Sequence[str],
    out: Path,
    environments: Path | None = None,
    *,
    count: int = 1000,
    rounds: int = 3,
    seconds: float = 4.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Run every library on every robot in several rounds. Return the content of ``peers.json``.

    Args:
        names: Libraries.
        robots: Robots.
        out: Folder of the problems.
        environments: Folder that ``install`` made.
        count: Problems of each kind.
        rounds: Runs of each library.
        seconds: Longest time of a set.
        seed: Seed of the problems.
    """
    tasks = {robot: write_task(robot, out / "tasks" / robot, count, seed) for robot in robots}
    libraries: dict[str, Any] = {
        name: {"versions": {}, "settings": "", "calibration_us": []} for name in names
    }
    reports: dict[str, dict[str, list[Any]]] = {
        name: {robot: [] for robot in robots} for name in names
    }
    excluded: dict[str, dict[str, str]] = {"missing": {}, "failed": {}}
    for _ in range(rounds):
        for name in names:
            for robot, task in tasks.items():
                if name not in libraries:
                    continue
                report = run_library(name, task, environments, seconds)
                if "missing" in report:
                    excluded["missing"][name] = report["missing"]
                    del libraries[name]
                elif "failed" in report:
                    excluded["failed"][name] = f"{robot}: {report['failed']}"
                    del libraries[name]
                elif report["supported"]:
                    reports[name][robot].append(report)
                    _note(libraries[name], report)
                    say(f"{name}, {robot}: {_summary(report)}")
    for name, library in libraries.items():
        library["robots"] = {
            robot: _merged_sets(of_robot) for robot, of_robot in reports[name].items() if of_robot
        }
    settings = {"count": count, "rounds": rounds, "seconds": seconds, "seed": seed}
    machine = this_machine().model_dump(mode="json")
    return settings | {"machine": machine, "libraries": libraries, **excluded}


def _note(library: dict[str, Any], report: dict[str, Any]) -> None:
    """Write versions, settings and speed of a report into the row of a library."""
    library["versions"] = report["versions"]
    library["settings"] = report["settings"]
    library["calibration_us"].append(round(report["calibration_us"]))


def _summary(report: dict[str, Any]) -> str:
    """Return success, time and exceptions of each set in one line."""
    parts = []
    for key, cell in report["sets"].items():
        part = f"{key} {100 * cell['success']:.1f} % {cell['median_us']:.1f} µs"
        raised = report["errors"].get(key, {})
        if raised:
            counts = (f"{count} of {text}" for text, count in raised.items())
            part += f" (raised: {', '.join(counts)})"
        parts.append(part)
    return "; ".join(parts)


def _merged_sets(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the cells of all rounds, by set."""
    keys = reports[0]["sets"]
    return {key: merged([report["sets"][key] for report in reports]) for key in keys}


def say(text: str) -> None:
    """Write one line to stderr."""
    sys.stderr.write(text + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Return 1 if a library is missing or failed, otherwise 0."""
    parser = argument_parser()
    options = parser.parse_args(arguments)
    unknown = [
        name for name in options.libraries if name not in worker.LIBRARIES and ":" not in name
    ]
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; {_EPILOG}")
    if options.command == "install":
        return install(options.environments, options.libraries)
    make_folder(options.out)
    result = compare(
        options.libraries,
        options.robots,
        options.out,
        options.environments,
        count=options.count,
        rounds=options.rounds,
        seconds=options.seconds,
        seed=options.seed,
    )
    save_json(options.out / "peers.json", result)
    for kind in ("missing", "failed"):
        for name, reason in result[kind].items():
            say(f"{kind}: {name}: {reason}")
    say(f"wrote {options.out / 'peers.json'}")
    return 1 if result["missing"] or result["failed"] else 0


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", epilog=_EPILOG)
    commands = parser.add_subparsers(dest="command", required=True)
    installer = commands.add_parser("install", help="make an environment for each library")
    installer.add_argument("environments", type=Path)
    runner = commands.add_parser("run", help="measure")
    runner.add_argument("--environments", type=Path, help="the folder that install made")
    runner.add_argument("--out", type=Path, required=True, help="folder for the results")
    robots = [*ARMS, FIGURE]
    runner.add_argument("--robots", nargs="+", default=robots, choices=robots, help="default: all")
    runner.add_argument(
        "--count", type=int, default=1000, help="problems of each kind (default: 1000)"
    )
    runner.add_argument(
        "--rounds",
        type=int,
        default=3,
        help="runs of each library; the fastest time counts (default: 3)",
    )
    runner.add_argument(
        "--seconds", type=float, default=4.0, help="longest time of a set (default: 4)"
    )
    runner.add_argument("--seed", type=int, default=0, help="of the problems (default: 0)")
    for subparser in (installer, runner):
        subparser.add_argument(
            "--libraries",
            nargs="+",
            default=[name for name in worker.LIBRARIES if name not in _SLOW],
            metavar="NAME",
            help=f"default: all but {', '.join(_SLOW)}",
        )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
