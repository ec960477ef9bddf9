"""Measure `rik.solve` in a plain loop against a prepared problem, small batches and verdicts.

    python docs/make/measure_front_door.py            # prints the table
    python docs/make/measure_front_door.py --write    # writes docs/reference/performance.md

A time is the wall-clock time of a Python call in a plain loop over some poses, with one thread and
without garbage collection. The best of some rounds counts for each pose, because other work on the
machine only adds to a time.
"""

from __future__ import annotations

import argparse
import gc
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

import robot_ik as rik

PAGE = Path(__file__).resolve().parents[1] / "reference" / "performance.md"
ROBOTS = {"puma560": "PUMA 560", "ur5e": "UR5e", "tabletop_puma": "tabletop PUMA"}
#: How far beyond the reach, as a share of it, the poses lie that cannot be met.
FAR = (1.1, 2.0)


def poses_of(robot: rik.Robot, count: int) -> tuple[list[rik.Pose], list[rik.Pose]]:
    """Return ``count`` poses that the arm can reach, and ``count`` poses out of its reach."""
    rng = np.random.default_rng(0)
    near = [robot.forward(robot.sample(rng)) for _ in range(count)]
    ball = robot.reach()
    assert ball is not None
    way = rng.normal(size=(count, 3))
    way *= rng.uniform(*FAR, (count, 1)) * ball[1] / np.linalg.norm(way, axis=1)[:, None]
    return near, [rik.Pose(ball[0] + off, pose.wxyz) for off, pose in zip(way, near, strict=True)]


def cases(robot: rik.Robot, count: int) -> dict[str, Callable[[int], object]]:
    """Return the timed functions by their names in the table. Each takes the index of the pose."""
    near, far = poses_of(robot, count)
    matrices = [pose.matrix for pose in near]
    beyond = [pose.matrix for pose in far]
    goals = [rik.PoseGoal.at(None, pose) for pose in near]
    problem = rik.Problem(robot, goals[0])

    def prepared(k: int) -> None:
        problem.solve(target=matrices[k])

    def out_of_reach(k: int) -> None:
        if problem.solve(target=beyond[k]).status is not rik.Status.UNREACHABLE:
            raise AssertionError(
                f"pose {k} beyond the reach of {robot.name} is not called UNREACHABLE"
            )

    return {
        "prepared: `problem.solve(q, target=…)`": prepared,
        "`rik.solve`, goal made before": lambda k: rik.solve(robot, goals[k]),
        "making a `PoseGoal`": lambda _: rik.PoseGoal("gripper", (0.1, 0.2, 0.3), (0, 1, 0, 0)),
        "`solve_batch` of 1 pose": lambda k: rik.solve_batch(robot, matrices[k : k + 1]),
        "`solve_batch` of 10, `lm`": lambda _: rik.solve_batch(robot, near[:10], solver="lm"),
        "`solve_all`": lambda k: rik.solve_all(robot, goals[k]),
        "out of reach, nearest answer": out_of_reach,
    }


def measure(robot: rik.Robot, rounds: int, count: int) -> dict[str, tuple[float, float]]:
    """Return the median and 99th percentile over the poses, µs, of the best time of each pose."""
    timed = cases(robot, count)
    rik.warm_up(robot)
    best = {name: np.full(count, np.inf) for name in timed}
    for _ in range(rounds):
        for name, case in timed.items():
            case(0)
            for k in range(count):
                begin = time.perf_counter()
                case(k)
                best[name][k] = min(best[name][k], time.perf_counter() - begin)
    return {
        name: (1e6 * float(np.median(times)), 1e6 * float(np.percentile(times, 99)))
        for name, times in best.items()
    }


def cell(times: tuple[float, float]) -> str:
    """Return median / p99."""
    return f"{times[0]:.1f} / {times[1]:.0f}"


def lines(times: dict[str, dict[str, tuple[float, float]]]) -> list[str]:
    """Return the table of the page: median / p99."""
    python = f"{platform.python_implementation()} {platform.python_version()}"
    names = next(iter(times.values()))
    return [
        f"| µs, median / p99, {python} | {' | '.join(ROBOTS[robot] for robot in times)} |",
        "| --- |" + " ---: |" * len(times),
        *(
            f"| {name} | {' | '.join(cell(robot[name]) for robot in times.values())} |"
            for name in names
        ),
    ]


def main() -> None:
    """Measure and print the table. Write it with --write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, default=10, help="rounds, of which the quietest counts"
    )
    parser.add_argument("--count", type=int, default=300, help="poses in a round")
    parser.add_argument("--write", action="store_true", help="put the table into the page")
    options = parser.parse_args()
    gc.disable()
    text = lines(
        {name: measure(rik.load_robot(name), options.rounds, options.count) for name in ROBOTS}
    )
    Console(width=140).print("\n".join(text), markup=False, highlight=False)
    if options.write:
        begin = "<!-- front door -->"
        end = "<!-- end -->"
        head, rest = PAGE.read_text(encoding="utf-8").split(begin)
        PAGE.write_text(
            f"{head}{begin}\n" + "\n".join(text) + f"\n{rest[rest.index(end) :]}", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
