"""Measures which method is quicker for which arm: what ``auto`` asks first.

    python -m robot_ik.bench.first_choice            prints a table
    python -m robot_ik.bench.first_choice --write    and makes robot_ik/solvers/first_choice.py from it

For each family of closed forms for poses one arm that ships: ``cold`` poses from home and ``warm`` ones along
a path, the closed form and ``lm`` in turn on the same ones.  The mean of processor time decides, since one
slow solve in ten is slow for its user too; the closed form stays where ``lm`` is not quicker by ``MARGIN``.
"""

from __future__ import annotations

import argparse
import gc
import time
from pathlib import Path

import numpy as np

import robot_ik.solvers.first_choice as table
from robot_ik.bench.methods.problems import ProblemSet, make_set
from robot_ik.goals import PoseGoal
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers import make_solver

#: ``lm`` is asked first only where it takes less than this share of the closed form's time.
MARGIN = 0.9
METHODS = ("analytic", "lm")
_ROUNDS = 5


def arms() -> dict[str, Robot]:
    """An arm for each family of closed forms, by the family's name."""
    return {
        "spherical_wrist": load_robot("puma560"),
        "three_parallel": load_robot("ur5e"),
        "limb": load_robot("srs_arm"),
    }


def mean_times(robot: Robot, problems: ProblemSet, methods: tuple[str, ...]) -> dict[str, float]:
    """Microseconds of processor time a solve by each method: of some rounds in turn, the quickest."""
    frame, times = problems.frame, {name: np.inf for name in methods}
    for _ in range(_ROUNDS):
        for name in methods:
            problem, solver = Problem(robot, PoseGoal(frame, (0.0, 0.0, 0.0))), make_solver(name)
            q = problems.first
            solver.load(problem)
            began = time.thread_time()
            for target in problems.targets:
                problem.retarget(target)
                found = solver.solve(problem, q)
                q = found.q if problems.tracking and found.converged else problems.first
            times[name] = min(times[name], 1e6 * (time.thread_time() - began) / len(problems))
    return times


def measure(count: int, seed: int = 0) -> dict[tuple[str, str], dict[str, float]]:
    """(family, "cold" or "warm") -> microseconds by method."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    gc.disable()
    try:
        for family, robot in arms().items():
            for kind in ("cold", "warm"):
                problems = make_set(kind, robot, count, seed)
                found[family, kind] = mean_times(robot, problems, METHODS)
    finally:
        gc.enable()
    return found


def choose(times: dict[tuple[str, str], dict[str, float]]) -> dict[tuple[str, str], str]:
    """The first choice for each row of ``measure``."""
    return {
        row: "lm" if by_method["lm"] < MARGIN * by_method["analytic"] else "analytic"
        for row, by_method in sorted(times.items())
    }


def write(choice: dict[tuple[str, str], str]) -> None:
    """Puts the rows into the module that ``auto`` reads."""
    path = Path(table.__file__)
    head = path.read_text(encoding="utf-8").partition("] = {\n")[0]
    rows = "".join(f'    ("{family}", "{kind}"): "{name}",\n' for (family, kind), name in choice.items())
    path.write_text(f"{head}] = {{\n{rows}}}\n", encoding="utf-8")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Which method auto asks first.")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    times = measure(options.count)
    choice = choose(times)
    for (family, kind), name in choice.items():
        shown = "  ".join(f"{method} {times[family, kind][method]:7.1f} us" for method in METHODS)
        print(f"{family:18} {kind:5} {shown}  -> {name}")
    if options.write:
        write(choice)


if __name__ == "__main__":
    main()
