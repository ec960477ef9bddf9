"""Measure the methods and write the tables of the pages: `python docs/make/measurements.py`.

A table stands between `<!-- measured: NAME -->` and `<!-- end -->`. Steps, errors and joint changes
are counted and nothing is timed, so one machine gives the same numbers each time. Other machines
may differ in the last digit, so the tests look only for a row of every method.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

import robot_ik as rik
from robot_ik.solvers import SOLVERS, able_solvers

Array = NDArray[np.float64]

PLACE = re.compile(r"(<!-- measured: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
PAGES = [
    Path(__file__).resolve().parents[1] / "theory" / name
    for name in ("methods.md", "singularities.md")
]

# Joints of the PUMA, counted from 0.
_ELBOW = 2
_WRIST = 4
TARGETS = 100
# Largest distance of a start from the singular angles, rad, in each joint.
ASIDE = 0.5
# Number of poses of the path.
TICKS = 401
# Angle of the middle axis of the wrist to each side of the singular pose, rad.
_SWING = 0.4
# How far the path stays off the singular pose, rad.
PATHS = {"exactly": 0.0, "0.2° off": np.radians(0.2)}


def singular_cases(robot: rik.Robot, kind: str, count: int = TARGETS) -> list[tuple[Array, Array]]:
    """Return joint angles (6,) at which the PUMA is exactly singular, and starts near them.

    The pose of a singular wrist has other branches, which are not singular. So the start is near
    the singular branch.

    Args:
        robot: The PUMA.
        kind: ``wrist`` (axes 4 and 6 in line), ``elbow`` (arm stretched) or ``both``.
        count: Number of cases.
    """
    rng = np.random.default_rng(11)
    straight = stretched(robot)
    cases = []
    for _ in range(count):
        q = robot.sample(rng)
        if kind in ("wrist", "both"):
            q[_WRIST] = 0.0
        if kind in ("elbow", "both"):
            q[_ELBOW] = straight
        cases.append((q, robot.clip(q + rng.uniform(-ASIDE, ASIDE, robot.nq))))
    return cases


def stretched(robot: rik.Robot) -> float:
    """Return the elbow angle of the PUMA at which its wrist is farthest from the shoulder, rad."""

    def far(angle: float) -> float:
        q = robot.home.copy()
        q[_ELBOW] = angle
        shoulder = robot.forward(q, "link2").position
        return float(np.linalg.norm(robot.forward(q, "flange").position - shoulder))

    # Distance squared is c + A cos(angle) + B sin(angle): three values give the best angle exactly.
    zero, quarter, half = (far(a) ** 2 for a in (0.0, np.pi / 2, np.pi))
    centre = (zero + half) / 2
    return float(np.arctan2(quarter - centre, zero - centre))


def methods() -> Iterator[str]:
    """Return the names of the methods that support poses of the PUMA, without ``combined``."""
    robot = rik.load_robot("puma560")
    able = able_solvers(rik.Problem(robot, robot.forward(robot.home)))
    yield from (name for name in able if name != "combined")


def convergence_table(tables: ModuleType) -> str:
    """Return the share that each method reaches, and its median steps, as in the pictures."""
    plots = _script("plots")
    rows = []
    for name in SOLVERS:
        cells = []
        for task in plots.TASKS:
            curve = plots.curves(name, task)
            arrived = np.zeros(0) if curve is None else curve.steps[np.isfinite(curve.steps)]
            share = "" if curve is None else f"{100 * len(arrived) / len(curve.steps):.0f} %"
            cells.append(f"{share}, {_steps(arrived)}" if len(arrived) else share)
        rows.append((_linked(name), *cells))
    return str(tables.markdown(("method", *(task.label for task in plots.TASKS)), rows))


def _linked(name: str) -> str:
    return f"[`{name}`](../reference/solvers/{name}.md)"


def _steps(counts: ArrayLike) -> str:
    median = float(np.median(np.asarray(counts)))
    return f"{median:.0f} step{'' if median == 1 else 's'}"


def targets_table(tables: ModuleType) -> str:
    """Return how often each method reaches singular targets, and in how many steps."""
    robot = rik.load_robot("puma560")
    sets = {kind: singular_cases(robot, kind) for kind in ("wrist", "elbow", "both")}
    rows = []
    for name in methods():
        problem = rik.Problem(robot, rik.PoseGoal(None, (0, 0, 0)), solver=name)
        cells = []
        for cases in sets.values():
            solutions = []
            for q, start in cases:
                solutions.append(problem.solve(start, target=robot.forward(q)))
            steps = [s.iterations for s in solutions if s.converged]
            share = f"{100 * len(steps) / len(solutions):.0f} %"
            cells.append(f"{share}, {_steps(steps)}" if steps else share)
        rows.append((_linked(name), *cells))
    return str(tables.markdown(("method", *sets), rows))


def path_table(tables: ModuleType) -> str:
    """Return a table of the largest joint change and error on a path past a singular wrist."""
    robot = rik.load_robot("puma560")
    rows = []
    for name in methods():
        cells: list[str] = []
        for off in PATHS.values():
            change, error = follow(robot, name, off)
            cells += [f"{np.degrees(change):.1f}°", f"{np.degrees(error):.2f}°"]
        rows.append((_linked(name), *cells))
    head = [
        f"{label}: {what}" for label in PATHS for what in ("largest joint change", "largest error")
    ]
    return str(tables.markdown(("method", *head), rows))


def follow(robot: rik.Robot, name: str, off: float) -> tuple[float, float]:
    """Follow the path tick by tick without restarts.

    Returns:
        Largest joint change in a tick and largest error, rad.
    """
    poses = path(robot, off)
    q = robot.home.copy()
    q[_WRIST] = _SWING
    q = rik.solve(robot, rik.PoseGoal.at(None, poses[0]), solver="lm", start=q).require().q
    budget = rik.Budget(iterations=100, restarts=0)
    problem = rik.Problem(robot, poses[0], solver=name, budget=budget)
    changes = []
    errors = []
    for pose in poses[1:]:
        solution = problem.solve(q, target=pose)
        changes.append(float(np.abs(solution.q - q).max()))
        errors.append(solution.error.angle)
        q = solution.q
    return max(changes), max(errors)


def path(robot: rik.Robot, off: float) -> list[rik.Pose]:
    """Return poses at which joint 5 moves through zero, ``off`` (rad) beside the singular pose."""
    q = robot.home.copy()
    q[_WRIST] = 0.0
    swing = robot.jacobian(q)[3:, _WRIST]
    u = np.cross(robot.forward(q, "flange").rotation[:, 2], swing) * np.sin(off / 2)
    offset = rik.Pose((0, 0, 0), (np.cos(off / 2), *u))
    poses = []
    for angle in np.linspace(_SWING, -_SWING, TICKS):
        q[_WRIST] = angle
        flange = robot.forward(q, "flange")
        rotated = rik.Pose(flange.position, (offset @ rik.Pose((0, 0, 0), flange.wxyz)).wxyz)
        poses.append(rotated @ (flange.inverse() @ robot.forward(q)))
    return poses


MEASURED: dict[str, Callable[[ModuleType], str]] = {
    "convergence": convergence_table,
    "targets": targets_table,
    "path": path_table,
}


def _script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parent / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    measured = {key: make(_script("tables")) for key, make in MEASURED.items()}
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = PLACE.sub(lambda m: m[1] + measured[m[2]] + m[4], before)
        if after != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page}\n")
