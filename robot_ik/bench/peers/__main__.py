"""The comparison from the command line: makes the libraries' environments, and runs each several times.

    python -m robot_ik.bench.peers install ENVIRONMENTS            # a virtual environment for each library
    python -m robot_ik.bench.peers run --environments ENVIRONMENTS --out RESULTS

Without an environment a library is expected beside robot_ik.  One that is not there is named, with the line
that installs it, and the others go on; the exit code is then 1.  RESULTS/peers.json says what was measured,
with which versions, seed and day; RESULTS/tasks holds the problems.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robot_ik.bench.methods.results import this_machine
from robot_ik.bench.peers import worker
from robot_ik.bench.peers.results import judged, merged
from robot_ik.bench.peers.tasks import ARMS, FIGURE, write_task
from robot_ik.files import make_folder, plain, write_atomically

#: Libraries that share an environment have the name of the first.
_SHARED = {"placo_restarts": "placo"}
_SECONDS_MARGIN, _SETS_MOST = 120.0, 6
_EPILOG = f"libraries: {', '.join(worker.LIBRARIES)}; or FILE.py:CLASS, as worker.Library describes it"


def interpreter(name: str, environments: Path | None) -> str:
    """Which Python runs a library: that of its environment, where there is one, else this one."""
    if environments is not None:
        own = environments / _SHARED.get(name, name) / "bin" / "python"
        if own.exists():
            return str(own)
    return sys.executable


def install(environments: Path, names: Sequence[str]) -> int:
    """Makes an environment for each library that needs one; 1 where one could not be made."""
    failed = 0
    for name in dict.fromkeys(_SHARED.get(name, name) for name in names):
        kind = worker.LIBRARIES[name]
        if isinstance(kind, str):
            continue  # ours
        folder = environments / name
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        done = subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "--quiet", *kind.needs])
        failed += done.returncode != 0
        say(f"{name}: {'installed' if done.returncode == 0 else 'could not be installed'}")
    return 1 if failed else 0


def run_library(name: str, task: Path, environments: Path | None, seconds: float) -> dict[str, Any]:
    """A library solves all sets of a task in a process of its own, and MuJoCo judges it."""
    for file in ("turn.json", "answers.npz"):
        (task / file).unlink(missing_ok=True)
    if ":" in name and not Path(name.rpartition(":")[0]).is_file():
        return {"failed": f"there is no file {name.rpartition(':')[0]}"}
    python = interpreter(name, environments)
    command = [python, "-P", worker.__file__, name, str(task), str(seconds)]
    limit = _SETS_MOST * seconds + _SECONDS_MARGIN
    # What this interpreter finds there is not meant for another one.
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    try:
        done = subprocess.run(command, env=clean, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return {"failed": f"it took more than {limit:.0f} s"}
    if done.returncode != 0 or not (task / "turn.json").exists():
        last = (done.stderr.strip().splitlines() or ["it ended without a word"])[-1]
        return {"failed": last}
    return judged(task)


def compare(
    names: Sequence[str],
    robots: Sequence[str],
    out: Path,
    environments: Path | None = None,
    *,
    count: int = 1000,
    rounds: int = 3,
    seconds: float = 8.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Every library on every robot, one after the other, several rounds.

    Args:
        names: Rows of ``worker.LIBRARIES``, or FILE.py:CLASS.
        robots: Of ``ARMS``, or ``FIGURE``.
        out: Folder for the problems.
        environments: What ``install`` made.
        count: Problems of a kind.
        rounds: How often each is run.
        seconds: For a set; it is cut short after them.
        seed: Of the problems.

    Returns:
        What ``peers.json`` holds: ``missing`` has a line that installs each library that is not there,
        ``failed`` why a library could not take part.
    """
    tasks = {robot: write_task(robot, out / "tasks" / robot, count, seed) for robot in robots}
    runs: dict[str, dict[str, list[Any]]] = {name: {robot: [] for robot in robots} for name in names}
    about: dict[str, Any] = {name: {"versions": {}, "settings": "", "calibration_us": []} for name in names}
    missing: dict[str, str] = {}
    failed: dict[str, str] = {}
    for _ in range(rounds):
        for name in names:
            for robot, task in tasks.items():
                if name in missing or name in failed:
                    continue
                report = run_library(name, task, environments, seconds)
                if "missing" in report:
                    missing[name] = f"{report['missing']}; pip install {' '.join(map(repr, report['needs']))}"
                elif "failed" in report:
                    failed[name] = f"{robot}: {report['failed']}"
                elif report["supported"]:
                    runs[name][robot].append(report)
                    about[name] |= {"versions": report["versions"], "settings": report["settings"]}
                    about[name]["calibration_us"].append(round(report["calibration_us"]))
                    say(_line(name, robot, report))
    libraries = {
        name: about[name]
        | {"robots": {robot: _cells(report) for robot, report in runs[name].items() if report}}
        for name in names
        if name not in missing and name not in failed
    }
    asked = {"count": count, "rounds": rounds, "seconds": seconds, "seed": seed}
    machine = this_machine().model_dump(mode="json")
    return asked | {"machine": machine, "libraries": libraries, "missing": missing, "failed": failed}


def _cells(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {key: merged([one["sets"][key] for one in runs]) for key in runs[0]["sets"]}


def _line(name: str, robot: str, report: dict[str, Any]) -> str:
    cells = (f"{key} {100 * c['success']:.1f} % {c['median_us']:.1f} µs" for key, c in report["sets"].items())
    return f"{name}, {robot}: {'; '.join(cells)}"


def say(text: str) -> None:
    """One line of talk."""
    sys.stderr.write(text + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when all that was asked for was measured, 1 when a library is missing or failed."""
    parser = argparse.ArgumentParser(prog="python -m robot_ik.bench.peers", epilog=_EPILOG)
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("install", help="an environment for each library")
    maker.add_argument("environments", type=Path)
    runner = commands.add_parser("run", help="measure")
    runner.add_argument("--environments", type=Path, help="what install made")
    runner.add_argument("--out", type=Path, required=True, help="folder for the results")
    runner.add_argument("--robots", nargs="+", default=[*ARMS, FIGURE], choices=[*ARMS, FIGURE])
    runner.add_argument("--count", type=int, default=1000, help="problems of a kind")
    runner.add_argument("--rounds", type=int, default=3)
    runner.add_argument("--seconds", type=float, default=8.0, help="for a set of problems")
    runner.add_argument("--seed", type=int, default=0)
    for one in (maker, runner):
        one.add_argument("--libraries", nargs="+", default=[*worker.LIBRARIES], metavar="NAME")
    asked = parser.parse_args(arguments)
    strangers = [name for name in asked.libraries if name not in worker.LIBRARIES and ":" not in name]
    if strangers:
        parser.error(f"unknown: {', '.join(strangers)}; {_EPILOG}")
    if asked.command == "install":
        return install(asked.environments, asked.libraries)
    make_folder(asked.out)
    found = compare(
        asked.libraries, asked.robots, asked.out, asked.environments,
        count=asked.count, rounds=asked.rounds, seconds=asked.seconds, seed=asked.seed,
    )  # fmt: skip
    write_atomically(asked.out / "peers.json", json.dumps(plain(found), indent=1, ensure_ascii=False) + "\n")
    for kind in ("missing", "failed"):
        for name, why in found[kind].items():
            say(f"{kind}: {name}: {why}")
    say(f"wrote {asked.out / 'peers.json'}")
    return 1 if found["missing"] or found["failed"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
