"""The comparison from the command line: makes the libraries' environments, and runs each several times.

See ``robot_ik.bench.peers``.  Without an environment a library is expected beside robot_ik; one that is not
there is named, with the line that installs it, and the others go on; the exit code is then 1.
RESULTS/peers.json says what was measured, with versions, seed and day; RESULTS/tasks holds the problems.
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

import numpy as np

from robot_ik.bench.methods.results import JUMP, this_machine
from robot_ik.bench.peers import worker
from robot_ik.bench.peers.tasks import ARMS, FIGURE, site_names, write_task
from robot_ik.files import make_folder
from robot_ik.geometry import Pose
from robot_ik.jobs.results import save_json
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

#: Libraries that share an environment have the name of the first.
_SHARED = {"placo_restarts": "placo"}
_SECONDS_MARGIN, _SETS_MOST = 120.0, 6
_EPILOG = f"libraries: {', '.join(worker.LIBRARIES)}; or FILE.py:CLASS, as worker.Library describes it"


# ------------------------------------------------------------------------------------------
# What the libraries answered, judged by MuJoCo, and the rounds put together.


#: Success of a pose, m and rad; exact; beyond a limit by so much is rounding.
SUCCESS, EXACT, _SLACK = (1e-4, 1e-3), (1e-6, 1e-6), 1e-6
#: Success of positions, m.
POINTS = 1e-4
#: A library whose own forward pass is off by more has read another robot, m and parts of a rotation matrix.
SAME_ROBOT = 1e-6


def judged(folder: Path) -> dict[str, Any]:
    """The results of a library in a task's folder: ``report.json``, and a cell for each set of problems."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    if not report.get("supported"):
        return report
    robot = load_robot(folder / "model.xml")
    problems, solutions = np.load(folder / "problems.npz"), np.load(folder / "solutions.npz")
    if "probes" in solutions:
        own = [robot.measure(q, site_names(robot)[0]).matrix for q in problems["probes"]]
        off = float(np.abs(np.array(own) - solutions["probes"]).max()) if len(own) else 0.0
        if not off <= SAME_ROBOT:
            return report | {"failed": f"its own forward pass is off by {off:.1e}: it reads another robot"}
    report["sets"] = {}
    for key in [name.removesuffix("_q") for name in solutions.files if name.endswith("_q")]:
        report["sets"][key] = _cell(robot, key, problems, solutions)
    return report


def _cell(robot: Robot, key: str, problems: Any, solutions: Any) -> dict[str, Any]:
    q, wall, cpu = (solutions[f"{key}_{part}"] for part in ("q", "wall", "cpu"))
    targets, starts = problems[f"{key}_targets"][: len(q)], problems[f"{key}_starts"][: len(q)]
    marks = np.array([_mark(robot, one, target) for one, target in zip(q, targets, strict=True)])
    cell = {
        "n": len(q),
        "success": float(marks[:, 0].mean()),
        "exact": float(marks[:, 1].mean()),
        "median_us": float(np.median(wall)),
        "cpu_mean_us": float(cpu.mean()),
        "cpu_p99_us": float(np.percentile(cpu, 99)),
    }
    if key == "warm":
        moved = np.abs(q - starts)[:, 7 * (robot.nq > robot.nv) :].max(axis=1)  # not of a free base
        cell["jumps"] = int((moved[marks[:, 0] > 0] > JUMP).sum())
    return cell


def _mark(robot: Robot, q: Array, target: Array) -> tuple[bool, bool]:
    """Whether a solution (nq,) is a success, and whether it is exact."""
    if not np.isfinite(q).all() or robot.outside(q, _SLACK):
        return False, False
    there = [robot.measure(q, site) for site in site_names(robot)]
    if target.shape[-1] == 3:
        off = [pose.position for pose in there] - target
        good = bool(np.linalg.norm(off, axis=1).max() <= POINTS)
        return good, good
    metres, radians = there[0].distance(Pose.from_matrix(target))
    return (metres <= SUCCESS[0] and radians <= SUCCESS[1], metres <= EXACT[0] and radians <= EXACT[1])


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


# ------------------------------------------------------------------------------------------
# The runs.


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
    for file in ("report.json", "solutions.npz"):
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
    if done.returncode != 0 or not (task / "report.json").exists():
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
    """Every library on every robot, one after the other, several rounds: what ``peers.json`` holds.

    ``count`` problems of a kind go into ``out``; a set is cut short after ``seconds``.
    """
    tasks = {robot: write_task(robot, out / "tasks" / robot, count, seed) for robot in robots}
    runs: dict[str, dict[str, list[Any]]] = {name: {robot: [] for robot in robots} for name in names}
    blank = {"versions": {}, "settings": ""}
    libraries: dict[str, Any] = {name: blank | {"calibration_us": []} for name in names}
    left_out: dict[str, dict[str, str]] = {"missing": {}, "failed": {}}
    for _ in range(rounds):
        for name in names:
            for robot, task in tasks.items():
                if name not in libraries:
                    continue
                report = run_library(name, task, environments, seconds)
                if kind := next((kind for kind in left_out if kind in report), ""):
                    left_out[kind][name] = f"{robot}: {report[kind]}" if kind == "failed" else report[kind]
                    del libraries[name]
                elif report["supported"]:
                    about = libraries[name]
                    runs[name][robot].append(report)
                    about |= {"versions": report["versions"], "settings": report["settings"]}
                    about["calibration_us"].append(round(report["calibration_us"]))
                    sets = report["sets"].items()
                    cells = (f"{k} {100 * c['success']:.1f} % {c['median_us']:.1f} µs" for k, c in sets)
                    say(f"{name}, {robot}: {'; '.join(cells)}")
    for name, library in libraries.items():
        library["robots"] = {
            robot: {key: merged([one["sets"][key] for one in reports]) for key in reports[0]["sets"]}
            for robot, reports in runs[name].items()
            if reports
        }
    asked = {"count": count, "rounds": rounds, "seconds": seconds, "seed": seed}
    machine = this_machine().model_dump(mode="json")
    return asked | {"machine": machine, "libraries": libraries, **left_out}


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
    runner.add_argument(
        "--robots", nargs="+", default=[*ARMS, FIGURE], choices=[*ARMS, FIGURE], help="default: all"
    )
    runner.add_argument("--count", type=int, default=1000, help="problems of a kind (1000)")
    runner.add_argument(
        "--rounds", type=int, default=3, help="runs of each library; the fastest time counts (3)"
    )
    runner.add_argument("--seconds", type=float, default=8.0, help="longest time for a set of problems (8)")
    runner.add_argument("--seed", type=int, default=0, help="of the problems (0)")
    for one in (maker, runner):
        one.add_argument(
            "--libraries", nargs="+", default=[*worker.LIBRARIES], metavar="NAME", help="default: all"
        )
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
    save_json(asked.out / "peers.json", found)
    for kind in ("missing", "failed"):
        for name, why in found[kind].items():
            say(f"{kind}: {name}: {why}")
    say(f"wrote {asked.out / 'peers.json'}")
    return 1 if found["missing"] or found["failed"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
