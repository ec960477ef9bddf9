"""Measures one installed robot_ik; ``compare.py`` runs it in two environments.

    python worker.py counts ROBOT METHOD GOALS
    python worker.py times ROBOT METHOD
    python worker.py batch ROBOT METHOD
    python worker.py compile ROBOT METHOD
    python worker.py traces ROBOT METHOD GOALS SEED FILE

Prints one line of JSON. It supports the calls of both designs: a solver that takes a problem, and
a problem that owns its solver.
"""

from __future__ import annotations

import functools
import inspect
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import robot_ik as rik

# Seeds of the cold poses and of the path.
_COLD_SEED = 20
_PATH_SEED = 7
# Poses of one timed round, and joint step between two ticks of the path, rad.
_TIMED_POSES = 200
_TICK = 0.01
_BATCH_POSES = 40_000
# Solves of a count may take this many steps.
_COUNT_ITERATIONS = 3000

_OWNS_SOLVER = "solver" in inspect.signature(rik.Problem.__init__).parameters
# Methods that take positions only.
_POSITION_ONLY = ("fabrik", "triangulation", "recursive")

Solve = Callable[[Any, Any], Any]


def prepared(robot: Any, goal: Any, method: str, **options: Any) -> Solve:
    """Return ``solve(start, target)`` of a problem that is built once."""
    if _OWNS_SOLVER:
        problem = rik.Problem(robot, goal, solver=method, **options)
        return lambda start, target: problem.solve(start, target=target)
    problem = rik.Problem(robot, goal, **options)
    solver = rik.make_solver(method)

    def solve(start: Any, target: Any) -> Any:
        problem.retarget(target)
        return solver.solve(problem, start)

    return solve


def poses(robot: Any, count: int, seed: int = _COLD_SEED) -> list[Any]:
    """Return reachable poses (4, 4) of the tool."""
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)).matrix for _ in range(count)]


def goal_for(method: str) -> Any:
    """Return a goal of the kind that the method takes."""
    if method in _POSITION_ONLY:
        return rik.PositionGoal(None, (0.0, 0.0, 0.0))
    return rik.PoseGoal(None, (0.0, 0.0, 0.0))


def counts(robot: Any, method: str, number: int) -> dict[str, Any]:
    """Return sums over seeded goals, each solved from home."""
    solve = prepared(
        robot, goal_for(method), method, budget=rik.Budget(iterations=_COUNT_ITERATIONS)
    )
    totals = {"converged": 0, "iterations": 0, "restarts": 0}
    for pose in poses(robot, number):
        target = pose[:3, 3] if method in _POSITION_ONLY else pose
        solution = solve(robot.home, target)
        totals["converged"] += int(solution.converged)
        totals["iterations"] += solution.iterations
        totals["restarts"] += solution.restarts
    return totals


def write_traces(robot: Any, method: str, number: int, seed: int, file: str) -> dict[str, Any]:
    """Write status, steps and the cost of each step of seeded goals to a JSON file."""
    budget = rik.Budget(iterations=_COUNT_ITERATIONS)
    solve = prepared(robot, goal_for(method), method, budget=budget, trace=True)
    rows = []
    for pose in poses(robot, number, seed):
        solution = solve(robot.home, pose[:3, 3] if method in _POSITION_ONLY else pose)
        costs = [step.cost for step in solution.trace]
        rows.append({"status": solution.status.name, "steps": solution.iterations, "costs": costs})
    Path(file).write_text(json.dumps(rows), encoding="utf-8")
    return {"goals": len(rows)}


def times(robot: Any, method: str) -> dict[str, float]:
    """Return medians in microseconds: ``rik.solve`` and a prepared problem, cold and tracking."""
    cold = poses(robot, _TIMED_POSES)
    goals = [rik.PoseGoal.at(None, rik.Pose.from_matrix(pose)) for pose in cold]
    solve = prepared(robot, rik.PoseGoal(None, (0.0, 0.0, 0.0)), method)
    rng = np.random.default_rng(_PATH_SEED)
    q = robot.home.copy()
    direction = rng.uniform(-1.0, 1.0, robot.nv)
    path = []
    for tick in range(_TIMED_POSES):
        step = _TICK * np.cos(0.05 * tick) * direction
        q = robot.clip(robot.integrate(q, step))
        path.append(robot.forward(q).matrix)

    def warm() -> list[float]:
        taken = []
        for goal in goals:
            began = time.perf_counter()
            rik.solve(robot, goal, solver=method)
            taken.append(time.perf_counter() - began)
        return taken

    def loop() -> list[float]:
        taken = []
        for pose in cold:
            began = time.perf_counter()
            solve(robot.home, pose)
            taken.append(time.perf_counter() - began)
        return taken

    def tracking() -> list[float]:
        taken = []
        last = robot.home
        for pose in path:
            began = time.perf_counter()
            last = solve(last, pose).q
            taken.append(time.perf_counter() - began)
        return taken

    path_goals = [rik.PoseGoal.at(None, rik.Pose.from_matrix(pose)) for pose in path]

    def warm_tracking() -> list[float]:
        durations = []
        last = robot.home
        for goal in path_goals:
            began = time.perf_counter()
            last = rik.solve(robot, goal, solver=method, start=last).q
            durations.append(time.perf_counter() - began)
        return durations

    runs = {
        "warm": warm,
        "warm tracking": warm_tracking,
        "loop": loop,
        "tracking": tracking,
    }
    results = {}
    for name, run in runs.items():
        run()
        results[name] = 1e6 * min(statistics.median(run()) for _ in range(5))
    return results


def batch(robot: Any, method: str) -> dict[str, float]:
    """Return microseconds of CPU time a pose, of a whole call on one thread."""
    targets = np.array(poses(robot, 500))[np.arange(_BATCH_POSES) % 500]
    rik.solve_batch(robot, targets[:100], solver=method, threads=1)
    taken = []
    for _ in range(5):
        began = time.process_time()
        rik.solve_batch(robot, targets, solver=method, threads=1)
        taken.append(time.process_time() - began)
    return {"pose": 1e6 * min(taken) / _BATCH_POSES}


def first_compile(robot: Any, method: str) -> dict[str, float]:
    """Return CPU seconds of the first solve of a process."""
    if method == "frames":
        run = figure_frames()
    elif method == "levels":
        goals = [goal_for("lm"), rik.PostureGoal(q=robot.home, priority=1)]
        run = functools.partial(rik.solve, robot, goals, solver="lm")
    else:
        goal = rik.PoseGoal.at(None, robot.forward(robot.home))
        if method in _POSITION_ONLY:
            goal = rik.PositionGoal(None, goal.position)
        run = functools.partial(rik.solve, robot, goal, solver=method)
    began = time.process_time()
    run()
    return {"seconds": time.process_time() - began}


def figure_frames() -> Callable[[], Any]:
    """Return the solve of a motion of the humanoid, frame by frame."""
    from robot_ik.figure.figure import load_figure
    from robot_ik.figure.frames import FrameRows
    from robot_ik.figure.poses import STIFFNESS

    figure = load_figure()
    rows = FrameRows(figure, 3)
    rows.feet(figure.feet_at_home)
    rows.center(figure.center(figure.home), axes="xy")
    rows.momentum(0.1)
    rows.aim(np.array([1.0, 0.0, 1.0]), 8.0)
    rows.position("right_hand", figure.pose(figure.home, "right_hand")[0] * np.ones((3, 1)))
    return lambda: rows.solve(figure.home, figure.stiffnesses(STIFFNESS), figure.home)


def main() -> None:
    """Run the command line."""
    what, name, method, *rest = sys.argv[1:]
    robot = rik.load_robot(name)
    if what == "counts":
        results: dict[str, Any] = counts(robot, method, int(rest[0]))
    elif what == "traces":
        results = write_traces(robot, method, int(rest[0]), int(rest[1]), rest[2])
    else:
        results = {"times": times, "batch": batch, "compile": first_compile}[what](robot, method)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
