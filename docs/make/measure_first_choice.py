"""Measures which method is quicker for which arm: what ``auto`` asks first.

    python docs/make/measure_first_choice.py

It prints times and choice, and fails where ``FIRST_CHOICE`` in robot_ik/solvers/combined.py is another.

For each arm that ships and has a closed form for poses, and for one built as the KUKA LBR iiwa is: ``cold``
poses from home and ``warm`` ones along a path, the closed form, ``lm`` and ``auto`` in turn on the same ones.
The mean of processor time decides, since one slow solve in ten is slow for its user too; of several arms of a
family that of their sum.  The closed form stays where ``lm`` is not quicker by ``MARGIN``.
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
from robot_ik.solvers import make_solver
from robot_ik.solvers.combined import FIRST_CHOICE

#: ``lm`` is asked first only where it takes less than this share of the closed form's time.
MARGIN = 0.9
#: What ``auto`` may take of the better one's time.
MOST = 1.2
METHODS = ("analytic", "lm")
# Short rounds of all methods in turn, of which the quickest counts: a machine whose speed varies meets all.
_ROUNDS = 25
_SHIPPED = ("puma560", "tabletop_puma", "vx300s", "wx250s", "ur5e", "srs_arm")

# Height of each joint above the one before in metres, and its limit in degrees: KUKA, LBR iiwa 14 R820,
# Specification, "Axis data" and "Main dimensions" (360, 420, 400, 126 mm).
_IIWA = ((0.36, 170), (0.0, 120), (0.42, 170), (0.0, 120), (0.40, 170), (0.0, 120), (0.0, 175))

Times = dict[tuple[str, str, str], dict[str, float]]


def iiwa_like() -> Robot:
    """A seven-axis limb with the lengths and limits of the LBR iiwa 14 R820, upright at zero."""
    inner = '<site name="flange" pos="0 0 0.126"/>'
    for k, (height, limit) in reversed(list(enumerate(_IIWA))):
        axis = "0 1 0" if k % 2 else "0 0 1"
        inner = (
            f'<body pos="0 0 {height}"><joint name="joint{k + 1}" axis="{axis}" range="-{limit} {limit}"/>'
            f'<geom size="0.05"/>{inner}</body>'
        )
    text = f'<mujoco model="iiwa-like"><compiler autolimits="true"/><worldbody>{inner}</worldbody></mujoco>'
    return load_robot(text, tool="flange")


def arms() -> list[Robot]:
    """Arms with a closed form for poses of their tool."""
    return [*map(load_robot, _SHIPPED), iiwa_like()]


def mean_times(robot: Robot, problems: ProblemSet, methods: tuple[str, ...]) -> dict[str, float]:
    """Microseconds of processor time a solve by each method: of some rounds in turn, the quickest."""
    times = {name: np.inf for name in methods}
    for _ in range(_ROUNDS):
        for name in methods:
            problem, solver = Problem(robot, PoseGoal(None, (0.0, 0.0, 0.0)), solver=name), make_solver(name)
            q = problems.first
            solver.load(problem)
            began = time.thread_time()
            for target in problems.targets:
                problem.retarget(target)
                found = problem.solve(q)
                q = found.q if problems.tracking and found.converged else problems.first
            times[name] = min(times[name], 1e6 * (time.thread_time() - began) / len(problems))
    return times


def measure(robots: list[Robot], count: int, seed: int = 0) -> Times:
    """(family, arm, "cold" or "warm") -> microseconds by method, ``auto`` as it is now among them."""
    found: Times = {}
    gc.disable()
    try:
        for robot in robots:
            closed = make_solver("analytic").load(Problem(robot, PoseGoal(None, (0.0, 0.0, 0.0))))
            family = closed.form.family.name.lower()
            for kind in ("cold", "warm"):
                problems = make_set(kind, robot, count, seed)
                found[family, robot.name, kind] = mean_times(robot, problems, (*METHODS, "auto"))
    finally:
        gc.enable()
    return found


def choose(times: Times) -> dict[tuple[str, str], str]:
    """The first choice for each family and start, from all arms of the family in ``times``."""
    sums: dict[tuple[str, str], dict[str, float]] = {}
    for (family, _, kind), by_method in sorted(times.items()):
        total = sums.setdefault((family, kind), dict.fromkeys(METHODS, 0.0))
        for method in METHODS:
            total[method] += by_method[method]
    return {
        row: "lm" if total["lm"] < MARGIN * total["analytic"] else "analytic" for row, total in sums.items()
    }


def over_best(by_method: dict[str, float]) -> float:
    """Time of ``auto`` over that of the better of its members."""
    return by_method["auto"] / min(by_method[method] for method in METHODS)


def main() -> None:
    """The command; it also fails where ``auto`` takes more than ``MOST`` of the better one's time."""
    parser = argparse.ArgumentParser(description="Which method auto asks first.")
    parser.add_argument("--count", type=int, default=200)
    times = measure(arms(), parser.parse_args().count)
    for (family, arm, kind), by_method in times.items():
        shown = "  ".join(f"{method} {took:7.1f} us" for method, took in by_method.items())
        print(f"{family:16} {arm:14} {kind:5} {shown}  auto / best {over_best(by_method):.2f}")
    choice = choose(times)
    for (family, kind), name in choice.items():
        print(f"{family:16} {kind:5} -> {name}")
    if choice != FIRST_CHOICE or max(map(over_best, times.values())) > MOST:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
