"""Measure which method is faster for which family of closed forms: what ``auto`` tries first.

    python docs/make/measure_first_choice.py

Prints times and choices. Fails if they contradict ``LM_FIRST_WHEN_NEAR`` in
robot_ik/solvers/auto.py.

For each bundled arm that has a closed form for poses, the closed form, ``lm`` and ``auto`` solve
the same ``cold`` poses from home, and the same ``warm`` poses along a path. The mean of the CPU
time decides, because one slow solve in ten matters. The arms of a family count together. ``lm`` is
chosen only if it is faster by ``MARGIN``.
"""

from __future__ import annotations

import argparse
import gc
import time

import numpy as np

from robot_ik.bench.methods.problems import ProblemSet, make_set
from robot_ik.goals import PoseGoal
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.analytic import Analytic
from robot_ik.solvers.analytic.recognise import Family
from robot_ik.solvers.auto import LM_FIRST_WHEN_NEAR

# ``lm`` comes first only if it takes less than this share of the time of the closed form.
MARGIN = 0.9
# The largest time of ``auto``, as a share of that of the faster method.
MAX_RATIO = 1.2
METHODS = ("analytic", "lm")
# Short rounds of all methods in turn. The fastest counts: the speed of a machine varies.
_ROUNDS = 25
_BUNDLED = ("puma560", "tabletop_puma", "vx300s", "wx250s", "ur5e")

Times = dict[tuple[str, str, str], dict[str, float]]


def arms() -> list[Robot]:
    """Return arms with a closed form for poses of their tool."""
    return [load_robot(name) for name in _BUNDLED]


def family_of(robot: Robot) -> str:
    """Return the family of the closed form of a robot."""
    problem = Problem(robot, PoseGoal(None, (0.0, 0.0, 0.0)))
    return Analytic().prepare(problem).form.family.name.lower()


def mean_times(robot: Robot, problems: ProblemSet, methods: tuple[str, ...]) -> dict[str, float]:
    """Return the microseconds of CPU time of a solve by each method, in its fastest round."""
    times = {name: np.inf for name in methods}
    goal = PoseGoal(None, (0.0, 0.0, 0.0))
    prepared = {name: Problem(robot, goal, solver=name) for name in methods}
    for _ in range(_ROUNDS):
        for name, problem in prepared.items():
            q = problems.first
            began = time.thread_time()
            for target in problems.targets:
                solution = problem.solve(q, target=target)
                q = solution.q if problems.tracking and solution.converged else problems.first
            times[name] = min(times[name], 1e6 * (time.thread_time() - began) / len(problems))
    return times


def measure(robots: list[Robot], count: int, seed: int = 0) -> Times:
    """Return the microseconds of each method by (family, arm, "cold" or "warm")."""
    times: Times = {}
    gc.disable()
    try:
        for robot in robots:
            family = family_of(robot)
            for kind in ("cold", "warm"):
                problems = make_set(kind, robot, count, seed)
                times[family, robot.name, kind] = mean_times(robot, problems, (*METHODS, "auto"))
    finally:
        gc.enable()
    return times


def choose(times: Times) -> dict[tuple[str, str], str]:
    """Return the faster method for each family and kind of start, over all its arms."""
    sums: dict[tuple[str, str], dict[str, float]] = {}
    for (family, _, kind), by_method in sorted(times.items()):
        total = sums.setdefault((family, kind), dict.fromkeys(METHODS, 0.0))
        for method in METHODS:
            total[method] += by_method[method]
    return {
        row: "lm" if total["lm"] < MARGIN * total["analytic"] else "analytic"
        for row, total in sums.items()
    }


def choice_of_auto() -> dict[tuple[str, str], str]:
    """Return what ``auto`` tries first, in the form of ``choose``."""
    choice = {}
    for family in Family:
        name = family.name.lower()
        choice[name, "cold"] = "analytic"
        choice[name, "warm"] = "lm" if family in LM_FIRST_WHEN_NEAR else "analytic"
    return choice


def over_best(by_method: dict[str, float]) -> float:
    """Return the time of ``auto`` as a share of that of the faster method."""
    return by_method["auto"] / min(by_method[method] for method in METHODS)


def main() -> None:
    """Run the script. It also fails if ``auto`` is slower than ``MAX_RATIO`` allows."""
    parser = argparse.ArgumentParser(description="Measure which method auto should try first.")
    parser.add_argument("--count", type=int, default=200)
    times = measure(arms(), parser.parse_args().count)
    for (family, arm, kind), by_method in times.items():
        shown = "  ".join(f"{method} {took:7.1f} us" for method, took in by_method.items())
        print(f"{family:16} {arm:14} {kind:5} {shown}  auto / best {over_best(by_method):.2f}")
    choice = choose(times)
    for (family, kind), name in choice.items():
        print(f"{family:16} {kind:5} -> {name}")
    differs = any(choice_of_auto()[row] != name for row, name in choice.items())
    if differs or max(map(over_best, times.values())) > MAX_RATIO:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
