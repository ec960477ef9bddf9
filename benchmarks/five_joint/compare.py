"""Compare the closed form of five joints with brute force, and time it.

    python benchmarks/five_joint/compare.py --targets 2000 koch_v11 omx_f

For each arm the script prints how often the closed form is worse than brute force, the largest
position error by MuJoCo, whether a proven bound was ever violated, and times of one core.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from brute_force import Search, nearest_distance
from numpy.typing import NDArray

import robot_ik as rik

Array = NDArray[np.float64]

# Targets out of reach that are compared with least squares, and paths of the tracking test.
FAR_TARGETS = 40
PATHS = 30
PATH_STEPS = 101
# rad: the closed form counts as worse if its angle is larger by more than this (0.01 degrees).
WORSE = np.radians(0.01)


def targets(robot: rik.Robot, count: int, rng: np.random.Generator) -> list[rik.Pose]:
    """Return poses: forward kinematics, a ball, stretched, near the pan axis, joints at limits."""
    home = robot.forward(robot.home)
    center, radius = robot.reach()
    poses = []
    for k in range(count):
        q = robot.sample(rng)
        kind = k % 20
        if kind >= 18:  # two joints at their limits
            for joint in rng.choice(5, 2, replace=False):
                q[joint] = (robot.lower, robot.upper)[rng.integers(2)][joint]
        position = np.array(robot.forward(q).position)
        if 11 <= kind < 14:
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            position = center + radius * direction * rng.random() ** (1 / 3)
        elif 14 <= kind < 16:  # nearly stretched
            q[2] = np.clip(0.1 * rng.normal(), robot.lower[2], robot.upper[2])
            q[3] = np.clip(0.1 * rng.normal(), robot.lower[3], robot.upper[3])
            position = np.array(robot.forward(q).position)
        elif 16 <= kind < 18:  # within 2 cm of the pan axis
            position[:2] = center[:2] + 0.02 * rng.uniform(-1.0, 1.0, 2)
        poses.append(rik.Pose(position, _orientation(robot, q, home, rng)))
    return poses


def _orientation(robot: rik.Robot, q: Array, home: rik.Pose, rng: np.random.Generator) -> Array:
    choice = rng.random()
    if choice < 0.4:
        return rng.normal(size=4)
    if choice < 0.7:  # tool axis down, any turn
        angle = rng.uniform(-np.pi, np.pi)
        return np.array([0.0, np.cos(angle / 2), np.sin(angle / 2), 0.0])
    near = np.array(robot.forward(q).wxyz if choice < 0.8 else home.wxyz)
    return near + 0.2 * rng.normal(size=4)


def compare(robot: rik.Robot, poses: list[rik.Pose], free_axis: str | None) -> None:
    """Print a comparison with brute force."""
    search = Search(robot)
    axis = None if free_axis is None else np.array([0.0, 0.0, 1.0])
    goal = rik.PoseGoal(None, (0, 0, 0), orientation="best", free_axis=free_axis)
    problem = rik.Problem(robot, goal)
    reached = brute_reached = missed = worse = brute_worse = violated = unproven = outside = 0
    largest_gap = largest_excess = largest_position = 0.0
    times = []
    far_times = []
    for pose in poses:
        solution = problem.solve(target=pose)
        times.append(
            min([solution.seconds] + [problem.solve(target=pose).seconds for _ in range(3)])
        )
        brute = search.best(np.array(pose.position), pose.rotation, axis)
        outside += bool(((solution.q < robot.lower) | (solution.q > robot.upper)).any())
        brute_reached += brute is not None
        if solution.error.position > 1e-5:
            missed += brute is not None
            far_times.append(times.pop())
            unproven += solution.status is not rik.Status.UNREACHABLE
            continue
        reached += 1
        angle = solution.error.angle
        largest_position = max(largest_position, solution.error.position)
        largest_gap = max(largest_gap, angle - solution.angle_bound)
        unproven += angle - solution.angle_bound > WORSE
        if brute is not None:
            worse += angle > brute.angle + WORSE
            largest_excess = max(largest_excess, angle - brute.angle)
            brute_worse += brute.angle > angle + WORSE
            violated += brute.angle < solution.angle_bound - 1e-6
    micros = 1e6 * np.array(times)
    what = "whole orientation" if free_axis is None else f"axis {free_axis}"
    print(f"{robot.name}, {what}: {len(poses)} targets")
    print(f"  with a configuration: closed form {reached}, brute force {brute_reached}")
    print(f"  brute force has one, the closed form has none: {missed}")
    print(
        f"  worse by > 0.01°: closed form {worse} (worst {np.degrees(largest_excess):.5f}°), "
        f"brute force {brute_worse}"
    )
    print(f"  bounds violated {violated}, not proven {unproven}, outside limits {outside}")
    print(f"  largest gap {np.degrees(largest_gap):.4f}°, position {1e6 * largest_position:.3f} µm")
    p50, p90, p99 = np.percentile(micros, [50, 90, 99])
    print(
        f"  time µs: p50 {p50:.0f}, p90 {p90:.0f}, p99 {p99:.0f}, max {micros.max():.0f}; "
        f"out of reach p50 {1e6 * np.median(far_times):.0f}"
    )


def compare_far(robot: rik.Robot, rng: np.random.Generator) -> None:
    """Print how far targets out of reach stay away, against least squares."""
    center, radius = robot.reach()
    problem = rik.Problem(robot, rik.PoseGoal(None, (0, 0, 0), orientation="best"))
    farther = -np.inf
    seconds = []
    count = 0
    while count < FAR_TARGETS:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        position = center + direction * radius * rng.uniform(0.2, 1.5)
        solution = problem.solve(target=rik.Pose(position, rng.normal(size=4)))
        if solution.error.position < 1e-5:
            continue
        count += 1
        seconds.append(solution.seconds)
        best = nearest_distance(robot, position, rng)
        farther = max(farther, solution.error.position - best)
    print(
        f"  out of reach: {count} targets, at most {1e6 * farther:.2f} µm farther than least "
        f"squares; median {1e3 * np.median(seconds):.1f} ms"
    )


def track(robot: rik.Robot, rng: np.random.Generator) -> None:
    """Print steps of paths that stay on their branch."""
    goal = rik.PoseGoal(None, (0, 0, 0), orientation="best")
    problem = rik.Problem(robot, goal, keep_branch=True)
    seconds = []
    steps = []
    for _ in range(PATHS):
        first = robot.forward(robot.sample(rng))
        shift = rng.normal(size=3)
        shift *= 0.08 / np.linalg.norm(shift)
        q = problem.solve(target=first).q
        for s in np.linspace(0.0, 1.0, PATH_STEPS):
            target = rik.Pose(np.array(first.position) + s * shift, first.wxyz)
            solution = problem.solve(q, target=target)
            if solution.error.position > 1e-5:
                break
            seconds.append(solution.seconds)
            steps.append(float(np.abs(solution.q - q).max()))
            q = solution.q
    times = 1e6 * np.array(seconds)
    print(
        f"  tracking: {len(steps)} steps, p50 {np.median(times):.0f} µs, "
        f"p99 {np.percentile(times, 99):.0f} µs, steps over 15° "
        f"{int((np.array(steps) > np.radians(15)).sum())}, largest "
        f"{np.degrees(max(steps)):.0f}°"
    )


def five_joints(name: str) -> rik.Robot:
    """Return a robot without the joints that do not move its tool, such as a gripper."""
    robot = rik.load_robot(name, tool="gripper")
    node, _ = robot.attachment()
    joints = [robot.joints[k] for k in robot.tree.ancestors(node)]
    return robot if len(joints) == robot.nq else rik.load_robot(name, joints=joints, tool="gripper")


def main() -> None:
    """Run the comparison for each robot of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=["koch_v11", "omx_f"])
    parser.add_argument("--targets", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for name in arguments.robots:
        robot = five_joints(name)
        rng = np.random.default_rng(arguments.seed)
        poses = targets(robot, arguments.targets, rng)
        began = time.perf_counter()
        compare(robot, poses, None)
        compare(robot, poses[: arguments.targets // 4], "z")
        compare_far(robot, rng)
        track(robot, rng)
        print(f"  ({time.perf_counter() - began:.0f} s)")


if __name__ == "__main__":
    main()
