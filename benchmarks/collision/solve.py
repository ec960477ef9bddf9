"""Success and cost of free solutions and of certificates.

    taskset -c 0 python benchmarks/collision/solve.py [ROBOT ...]

The goals are poses of random postures that keep the margin, so each has a free solution. The same
goals are solved with and without the condition in turn. The certificates are of straight lines in
joint space between free postures.
"""

from __future__ import annotations

import itertools
import sys
import time

import numpy as np

import robot_ik as rik
from robot_ik.errors import MotionBlockedError
from robot_ik.motion.certificate import certify

ROBOTS = ("puma560", "ur5e", "panda")
GOALS = 2000
EDGES = 300
MARGIN = 0.002


def obstacles() -> list[rik.Box]:
    """Return a board beside the robot and a table below it."""
    return [
        rik.Box("board", size=(0.3, 0.1, 0.4), pose=rik.Pose((0.5, 0.2, 0.4))),
        rik.Box("table", size=(1.5, 1.5, 0.02), pose=rik.Pose((0.0, 0.0, -0.05))),
    ]


def free_postures(avoid: rik.CollisionAvoidance, count: int, seed: int) -> np.ndarray:
    """Return random postures (count, nq) that keep a little more than the margin."""
    rng = np.random.default_rng(seed)
    robot = avoid.scene.robot
    postures: list[np.ndarray] = []
    while len(postures) < count:
        rows = np.array([robot.sample(rng) for _ in range(count)])
        postures += list(rows[avoid.scene.free(rows, 1.5 * avoid.margin)])
    return np.array(postures[:count])


def solve_all_goals(avoid: rik.CollisionAvoidance) -> str:
    """Return cells: colliding answers without the condition, solved with it, and times in us."""
    robot = avoid.scene.robot
    poses = [robot.forward(q) for q in free_postures(avoid, GOALS, 1)]
    plain = rik.Problem(robot, poses[0])
    free = rik.Problem(robot, poses[0], collisions=avoid)
    touching = 0
    solved = 0
    times: dict[bool, list[float]] = {False: [], True: []}
    for pose in poses:
        for problem, is_free in ((plain, False), (free, True)):
            began = time.perf_counter()
            solution = problem.solve(target=pose)
            times[is_free].append(1e6 * (time.perf_counter() - began))
            if not is_free:
                touching += solution.converged and not avoid.free(solution.q)
            else:
                solved += solution.converged
                if solution.converged and solution.clearance.distance < avoid.margin - 1e-6:
                    raise SystemExit(f"{robot.name}: MuJoCo finds {solution.clearance}")
    median = [np.median(times[key]) for key in (False, True)]
    mean = [np.mean(times[key]) for key in (False, True)]
    return (
        f"{100 * touching / GOALS:.1f} % | {solved} of {GOALS} "
        f"| {median[0]:.1f} / {mean[0]:.1f} | {median[1]:.1f} / {mean[1]:.1f}"
    )


def certify_edges(avoid: rik.CollisionAvoidance) -> str:
    """Return cells: proven, refuted and undecided edges, and the median time in ms."""
    rows = free_postures(avoid, EDGES + 1, 2)
    counts = [0, 0, 0]
    times = []
    for first, last in itertools.pairwise(rows):
        began = time.perf_counter()
        try:
            certified = certify([first, last], avoid).certified
        except MotionBlockedError:
            counts[1] += 1
            continue
        times.append(1e3 * (time.perf_counter() - began))
        counts[0 if certified else 2] += 1
    return f"{counts[0]} / {counts[1]} / {counts[2]} | {np.median(times):.2f}"


def main() -> None:
    """Print the table."""
    print(
        "| robot | obstacles | touching before | free found | µs before, median / mean "
        "| µs with the condition | edges proven / refuted / open | ms a proof |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for name in sys.argv[1:] or ROBOTS:
        robot = rik.load_robot(name)
        for shapes in ([], obstacles()):
            avoid = rik.CollisionAvoidance(rik.Scene(robot, shapes), margin=MARGIN)
            row = solve_all_goals(avoid)
            print(f"| {name} | {len(shapes)} | {row} | {certify_edges(avoid)} |", flush=True)


if __name__ == "__main__":
    main()
