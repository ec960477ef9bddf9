"""Corner cases of every general method: starts outside, frames without joints, traces."""

import itertools

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.goals import PoseGoal, PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from tests.solvers.law_cases import general, goal_of, inside, measured, outcome


@general
def test_a_start_outside_the_limits_gives_a_solution_inside(name, robots):
    robot = robots("planar")
    outside = np.array([3.1, -2.9, 2.5])
    kept = outside.copy()
    solution = Problem(robot, goal_of(robot, [0.4, 0.5, 0.6], "position"), solver=name).solve(
        outside
    )
    assert solution.converged and inside(robot, solution.q) and np.array_equal(outside, kept)
    none = Problem(
        robot, goal_of(robot, [0.4, 0.5, 0.6]), budget=Budget(iterations=0), solver=name
    ).solve(outside)
    assert none.q.tolist() == [2.8, -2.6, 2.0]


@general
def test_a_fixed_frame_is_reached_or_not(name, robots):
    robot = robots("planar")
    there = Problem(robot, PositionGoal("nail", (0.3, 0.3, 0)), solver=name).solve()
    assert there.converged and there.iterations == 0
    never = Problem(robot, PoseGoal("nail", (0.5, 0.3, 0)), solver=name).solve()
    assert not never.converged and np.array_equal(never.q, robot.home)
    assert never.error.position == pytest.approx(0.2)


@general
def test_several_goals_at_once(name, robots, reachable):
    robot = robots("tree")
    for q in reachable(robot, 4):
        goals = [goal_of(robot, q, "position"), goal_of(robot, q, "position", "lamp")]
        solution = Problem(robot, goals, tolerance=Tolerance(1e-4, 1e-3), solver=name).solve()
        worst = max(measured(robot, solution.q, goal)[0] for goal in goals)
        assert (
            solution.error.position == pytest.approx(worst, abs=1e-12) and len(solution.errors) == 2
        )
        assert solution.converged == (worst <= 1e-4)
        assert solution.converged or name == "ccd"


@general
def test_the_trace_agrees_with_the_solution(name, robots, reachable):
    robot = robots("puma560")
    goal = goal_of(robot, reachable(robot, 1)[0])
    quiet = Problem(robot, goal, seed=2, solver=name).solve()
    solution = Problem(robot, goal, seed=2, trace=True, solver=name).solve()
    assert outcome(quiet) == outcome(solution) and quiet.trace == ()
    trace = solution.trace
    assert [row.iteration for row in trace] == list(range(1, solution.iterations + 1))
    assert all(a.restart <= b.restart for a, b in itertools.pairwise(trace))
    assert trace[-1].restart <= solution.restarts
    assert all(row.cost >= 0 and row.step >= 0 for row in trace)
    if solution.converged and trace:
        assert trace[-1].position == pytest.approx(solution.error.position, abs=1e-12)
        assert trace[-1].angle == pytest.approx(solution.error.angle, abs=1e-7)


def test_a_trace_has_no_fixed_length(name="ccd"):
    """For any budget. A solve that returns rows in between gives the same bits."""
    robot = load_robot("puma560")
    goal = PositionGoal(None, (-0.45, -0.10, 0.80))
    never = Tolerance(1e-300, 1e-300)
    endless = Problem(robot, goal, solver=name, budget=Budget(10**12), trace=True)
    assert endless.search.arrays["trace"].nbytes < 1_000_000
    assert len(endless.solve().trace) > 0
    budget = Budget(iterations=2500)
    traced, plain = (
        Problem(robot, goal, tolerance=never, budget=budget, trace=trace, solver=name).solve()
        for trace in (True, False)
    )
    assert traced.iterations > 1024  # more rows than the kernel stores
    assert [step.iteration for step in traced.trace] == list(range(1, traced.iterations + 1))
    assert traced.q.tobytes() == plain.q.tobytes() and traced.restarts == plain.restarts
