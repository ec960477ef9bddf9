"""Steps, restarts and successes of the geometric methods on seeded goals.

    python benchmarks/core/bones.py > new.txt

Prints one line per case. Two versions of the library agree if their lines are equal. The script
runs with both forms of the call: ``Problem(…, solver=…).solve(q)`` and the former
``solver.solve(problem, q)``.

``--compile NAME`` solves one goal with one method and prints the CPU seconds of that solve.
With an empty cache (``XDG_CACHE_HOME``) this is the time of the first compile.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.problem import Problem
from robot_ik.solvers import make_solver

GOALS = 40
# Steps granted to each goal.
ITERATIONS = 4000

# A carriage on a rail with a column, a ball joint with a cone, two hinges, and a branch.
TREE = """\
<mujoco model="tree"><compiler angle="radian"/><worldbody>
<body name="carriage" pos="0 0 0.2" quat="0.9 0.1 -0.2 0.3">
 <joint name="rail" type="slide" axis="1 0 0" range="-0.5 0.5"/>
 <joint name="column" type="slide" axis="0 0 1" range="0 0.6" ref="0.1"/>
 <geom size="0.05"/>
 <body name="arm" pos="0 0 0.3"><joint name="shoulder" type="ball" range="0 1.2" limited="true"/>
  <geom size="0.05"/>
  <body name="forearm" pos="0.4 0 0">
   <joint name="elbow" pos="0.05 0 0" axis="0 1 0.2" range="-2.2 2.2"/><geom size="0.05"/>
   <body name="hand" pos="0.3 0 0"><joint name="roll" axis="1 0 0"/><geom size="0.05"/>
    <site name="tool" pos="0.1 0 0" quat="0.7 0 0.7 0.1"/></body></body></body>
 <body name="branch" pos="0 0.2 0">
  <joint name="swing" axis="0 0 1" range="-1 1"/><geom size="0.05"/>
  <site name="lamp" pos="0 0.3 0"/></body>
</body></worldbody></mujoco>"""

# A trunk with two arms.
TWO_ARMS = """\
<mujoco><compiler angle="radian"/><worldbody>
<body name="trunk"><joint type="ball"/><geom size="0.05"/>
 <body name="chest" pos="0 0 0.5">
  <joint name="waist" type="ball" range="0 0.9" limited="true"/><geom size="0.05"/>
  <body name="left1" pos="0 0.2 0.3"><joint type="ball"/><geom size="0.05"/>
   <body name="left2" pos="0 0.3 0"><joint axis="0 0 1" range="-0.2 2.4"/><geom size="0.05"/>
    <site name="left" pos="0 0.3 0"/></body></body>
  <body name="right1" pos="0 -0.2 0.3"><joint type="ball"/><geom size="0.05"/>
   <body name="right2" pos="0 -0.3 0"><joint axis="0 0 1" range="-2.4 0.2"/><geom size="0.05"/>
    <site name="right" pos="0 -0.3 0"/></body></body>
</body></body></worldbody></mujoco>"""

# Four ball joints with cones.
CONES = """\
<mujoco><compiler angle="radian"/><worldbody>
<body><joint type="ball" range="0 1.2" limited="true"/><geom size="0.01"/>
 <body pos="0.4 0 0"><joint type="ball" range="0 0.8" limited="true"/><geom size="0.01"/>
  <body pos="0.3 0 0"><joint type="ball" range="0 0.9" limited="true"/><geom size="0.01"/>
   <body pos="0.3 0 0"><joint type="ball" range="0 0.6" limited="true"/><geom size="0.01"/>
    <site name="tool" pos="0.2 0 0"/></body></body></body></body>
</worldbody></mujoco>"""


def robots() -> dict[str, Any]:
    """The robots by name."""
    return {
        "puma560": rik.load_robot("puma560"),
        "seven_segment": rik.load_robot("seven_segment"),
        "chain2": rik.make_chain(2),
        "chain5": rik.make_chain(5, 0.3),
        "cones": rik.load_robot(CONES, tool="tool"),
        "tree": rik.load_robot(TREE, tool="tool"),
        "two_arms": rik.load_robot(TWO_ARMS, tool="left"),
    }


# Method, options (``restarts`` belong to the budget), robots and kinds of goals.
CASES = (
    ("ccd", {}, "puma560 seven_segment chain5 cones tree", "position orientation pose far"),
    (
        "ccd",
        {"axis": "free"},
        "puma560 seven_segment chain5 cones tree",
        "position orientation pose",
    ),
    ("ccd", {}, "two_arms", "two half"),
    ("fabrik", {}, "puma560 seven_segment chain2 chain5 cones tree", "position pose far line"),
    ("fabrik", {"pull": 0.5, "sweeps": 1}, "puma560 tree", "position"),
    ("fabrik", {}, "two_arms", "two half"),
    ("triangulation", {}, "puma560 seven_segment chain2 chain5 cones", "position far line"),
    ("triangulation", {"improved": False}, "puma560 seven_segment chain5", "position far"),
    ("recursive", {}, "seven_segment chain2 chain5 cones", "position far line"),
    ("recursive", {"restarts": 50}, "puma560 chain5 cones", "position"),
)


def goals_of(robot: Any, kind: str) -> Iterator[tuple[Any, Any]]:
    """Yield seeded goals and starts."""
    rng = np.random.default_rng(20)
    for row in range(GOALS):
        q = robot.sample(rng)
        start = robot.home if row % 2 else robot.sample(rng)
        if kind in ("two", "half"):
            sides = [
                rik.PositionGoal(name, robot.forward(q, name).position)
                for name in ("left", "right")
            ]
            if kind == "half":  # one goal beyond all links laid end to end
                sides[1] = rik.PositionGoal("right", (0.0, -4.0, 1.0))
            yield sides, start
            continue
        pose = robot.forward(q)
        center, radius = robot.reach()
        if kind == "position":
            goal = rik.PositionGoal(None, pose.position)
        elif kind == "orientation":
            goal = rik.OrientationGoal(None, pose.wxyz)
        elif kind == "pose":
            goal = rik.PoseGoal(None, pose.position, pose.wxyz)
        elif kind == "far":
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            goal = rik.PositionGoal(None, center + direction * radius * rng.uniform(1.01, 2.0))
        else:  # on the line from the root to the frame at home
            tip = robot.forward(robot.home).position
            goal = rik.PositionGoal(None, center + (tip - center) * rng.uniform(-0.9, 0.9))
            start = robot.home
        yield goal, start


def solve(robot: Any, goal: Any, start: Any, name: str, options: dict[str, Any]) -> Any:
    """Return a solution, by the present form of the call or the former one."""
    options = dict(options)
    budget = Budget(iterations=ITERATIONS, restarts=options.pop("restarts", None))
    try:
        problem = Problem(robot, goal, solver=name, budget=budget, seed=1, **options)
    except TypeError:
        problem = Problem(robot, goal, budget=budget, seed=1)
        return make_solver(name, **options).solve(problem, start)
    return problem.solve(start)


def count(only: str) -> None:
    """Print the line of each case."""
    known = robots()
    for name, options, names, kinds in CASES:
        if only and name != only:
            continue
        for robot_name in names.split():
            for kind in kinds.split():
                robot = known[robot_name]
                iterations = 0
                restarts = 0
                statuses: Counter[str] = Counter()
                for goal, start in goals_of(robot, kind):
                    solution = solve(robot, goal, start, name, options)
                    iterations += solution.iterations
                    restarts += solution.restarts
                    statuses[solution.status.name] += 1
                set_options = " ".join(f"{key}={value}" for key, value in options.items())
                outcome = " ".join(f"{key} {value}" for key, value in sorted(statuses.items()))
                print(
                    f"{name} {set_options} {robot_name} {kind}: {iterations} steps, "
                    f"{restarts} restarts, {outcome}",
                    flush=True,
                )


def first_compile(name: str) -> None:
    """Print the CPU seconds of one solve by one method."""
    robot = rik.load_robot("puma560")
    goal = rik.PositionGoal(None, (0.4, 0.1, 0.8))
    before = time.process_time()
    solve(robot, goal, robot.home, name, {})
    print(f"{name}: {time.process_time() - before:.2f} s of CPU time")


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="one method")
    parser.add_argument("--compile", default="", metavar="NAME", help="time the first compile")
    arguments = parser.parse_args()
    if arguments.compile:
        first_compile(arguments.compile)
    else:
        count(arguments.only)


if __name__ == "__main__":
    main()
