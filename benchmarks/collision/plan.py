"""Planning around obstacles: success, time and proof, beside OMPL.

    taskset -c 0 python -m benchmarks.collision.plan [--problems 60] [--ompl PYTHON]

``--ompl`` names the Python of another environment with the packages ``ompl`` and ``mujoco``. OMPL's
RRT-Connect then plans the same problems, simplifies each path, and checks postures by MuJoCo
(``ompl_worker.py``). Both sides search in the same limits and to the same margin. Ours also proves
the path. Times are of the processor, for search, simplification and proof. The last column has our
whole call, with the timing along the path. Some problems among boxes have no solution.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

import robot_ik as rik
from benchmarks.collision.scenes import (
    boxes,
    free_postures,
    has_contact,
    pairs_of,
    postures_in_shelf,
    shelf,
)
from robot_ik.motion.plan_search import search_path

MARGIN = 0.002
"""m. Distance that all paths must keep."""

OMPL_SECONDS = 10.0
"""s. Time after which OMPL gives up a problem."""

OMPL_RESOLUTION = 1.0 / 32.0
"""rad. Largest distance of two postures that OMPL checks on an edge. It has no proof, so it needs
more samples than ours."""

SHELVES = {"puma560": (0.75, 0.15, 0.9), "panda": (0.72, 0.0, 0.5)}
"""m. Middle of the shelf of each robot."""

_WORKER = Path(__file__).with_name("ompl_worker.py")


@dataclass(frozen=True, eq=False)
class Problems:
    """Starts and goals in one scene.

    Attributes:
        name: Robot and obstacles.
        avoid: The scene and the margin.
        starts: (n, nq) free postures.
        goals: (n, nq) free postures.
    """

    name: str
    avoid: rik.CollisionAvoidance
    starts: np.ndarray
    goals: np.ndarray


def problem_sets(count: int) -> Iterator[Problems]:
    """Yield the sets. No straight line from a start to its goal is free."""
    for name, middle in SHELVES.items():
        robot = rik.load_robot(name)
        among_boxes = rik.CollisionAvoidance(rik.Scene(robot, boxes(robot, 1)), margin=MARGIN)
        rows = free_postures(among_boxes, 8 * count, 2)
        yield blocked_only(f"{name}, boxes", among_boxes, rows[::2], rows[1::2], count)
        at_shelf = rik.CollisionAvoidance(rik.Scene(robot, shelf(middle)), margin=MARGIN)
        inside = postures_in_shelf(at_shelf, middle, 4 * count, 3)
        yield blocked_only(f"{name}, shelf", at_shelf, inside[::2], inside[1::2], count)


def blocked_only(
    name: str, avoid: rik.CollisionAvoidance, starts: np.ndarray, goals: np.ndarray, count: int
) -> Problems:
    """Return the first problems whose straight line is blocked."""
    shares = np.linspace(0.0, 1.0, 200)[:, None]
    kept = [
        k
        for k, (start, goal) in enumerate(zip(starts, goals, strict=True))
        if not avoid.free(start + shares * (goal - start)).all()
    ][:count]
    return Problems(name, avoid, starts[kept], goals[kept])


@dataclass(frozen=True)
class Outcome:
    """Results of one method.

    Attributes:
        solved: Share of the problems.
        free: Share of the returned paths that MuJoCo finds free at dense samples.
        median: Median processor time of the solved problems, s.
        mean: Mean processor time of the solved problems, s.
        length: Median length of the paths, rad.
    """

    solved: float
    free: float
    median: float
    mean: float
    length: float


def run_ours(problems: Problems) -> tuple[Outcome, float, float]:
    """Return our outcome, the share of certified motions, and the median of the whole call."""
    robot = problems.avoid.scene.robot
    box = (robot.tree.sample_lower, robot.tree.sample_upper)
    paths = []
    seconds = []
    call_seconds = []
    certified = 0
    for start, goal in zip(problems.starts, problems.goals, strict=True):
        began = time.process_time()
        result = search_path(problems.avoid, start, goal[None], box, rik.Budget(), 0)
        seconds.append(time.process_time() - began)
        paths.append(result.corners)
        began = time.process_time()
        planned = rik.plan(robot, start, goal, collisions=problems.avoid)
        call_seconds.append(time.process_time() - began)
        certified += planned.trajectory is not None and planned.trajectory.certified
    outcome = judged(problems, paths, seconds)
    return outcome, certified / len(paths), float(np.median(call_seconds))


def run_ompl(problems: Problems, python: str) -> Outcome:
    """Return the outcome of OMPL with checks by MuJoCo."""
    scene = problems.avoid.scene
    robot = scene.robot
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "scene.mjb"
        mujoco.mj_saveModel(scene.model, str(model), None)
        task = {
            "model": str(model),
            "qpos": robot.qpos(robot.home).tolist(),
            "addresses": robot._addresses.tolist(),
            "lower": robot.tree.sample_lower.tolist(),
            "upper": robot.tree.sample_upper.tolist(),
            "margin": MARGIN,
            "resolution": OMPL_RESOLUTION,
            "seconds": OMPL_SECONDS,
            "starts": problems.starts.tolist(),
            "goals": problems.goals.tolist(),
        }
        text = json.dumps(task)
        process = subprocess.run(
            [python, str(_WORKER)], input=text, capture_output=True, text=True, check=True
        )
    answers = json.loads(process.stdout.splitlines()[-1])
    paths = [None if row["path"] is None else np.array(row["path"]) for row in answers]
    return judged(problems, paths, [row["seconds"] for row in answers])


def judged(problems: Problems, paths: list[np.ndarray | None], seconds: list[float]) -> Outcome:
    """Return the outcome; ``mj_collision`` judges the paths at samples of 0.002 rad."""
    solved = [k for k, path in enumerate(paths) if path is not None]
    scene = problems.avoid.scene
    pairs = pairs_of(scene)
    lengths = []
    free = 0
    for k in solved:
        path = paths[k]
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        lengths.append(float(steps.sum()))
        free += not any(has_contact(scene, pairs, q) for q in densely(path))
    times = [seconds[k] for k in solved]
    return Outcome(
        len(solved) / len(paths),
        free / len(solved),
        float(np.median(times)),
        float(np.mean(times)),
        float(np.median(lengths)),
    )


def densely(path: np.ndarray, step: float = 0.002) -> np.ndarray:
    """Return samples (n, nq) of a path (k, nq) with at most ``step`` rad between them."""
    rows = []
    for first, last in itertools.pairwise(path):
        count = int(np.linalg.norm(last - first) / step) + 2
        rows.append(first + np.linspace(0.0, 1.0, count)[:, None] * (last - first))
    return np.concatenate(rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--ompl", default="", metavar="PYTHON")
    options = parser.parse_args()
    print("| problems | method | solved | free | ms median / mean | length, rad | whole call, ms |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for problems in problem_sets(options.problems):
        ours, certified, call_seconds = run_ours(problems)
        print(
            row(
                problems.name, "ours", ours, f"{1e3 * call_seconds:.1f}, {certified:.0%} certified"
            ),
            flush=True,
        )
        if options.ompl:
            theirs = run_ompl(problems, options.ompl)
            ratio = theirs.median / ours.median
            print(row(problems.name, "OMPL", theirs, f"ratio **{ratio:.1f}**"), flush=True)


def row(name: str, method: str, outcome: Outcome, last: str) -> str:
    """Return a row of the table."""
    times = f"{1e3 * outcome.median:.1f} / {1e3 * outcome.mean:.1f}"
    return (
        f"| {name} | {method} | {outcome.solved:.0%} | {outcome.free:.0%} | {times} "
        f"| {outcome.length:.2f} | {last} |"
    )


if __name__ == "__main__":
    main()
