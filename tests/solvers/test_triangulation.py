"""triangulation: exact on balls in one pass; the improved version moves the root less; hinges."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.goals import PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.solution import Status

TIGHT = Tolerance(position=1e-9, angle=1e-9)
both = pytest.mark.parametrize("improved", [False, True])


def problem_of(robot, **options):
    """A position goal, to be moved."""
    return Problem(robot, PositionGoal(None, (0.0, 0.0, 0.0)), solver="triangulation", **options)


def draws(robot, n, length, seed):
    rng = np.random.default_rng(seed)
    for reach in [*rng.uniform(0.0, 1.0, 8), 1e-6, 1.0 - 1e-6]:
        direction = rng.normal(size=3)
        yield direction / np.linalg.norm(direction) * reach * n * length, robot.sample(rng)


@both
@pytest.mark.parametrize("n", range(2, 11))
def test_balls_reach_all_targets_in_reach_in_one_pass(n, improved):
    robot = rik.make_chain(n, 0.7)
    problem = problem_of(robot, tolerance=TIGHT, improved=improved)
    for target, start in draws(robot, n, 0.7, n):
        solution = problem.solve(start, target=target)
        assert solution.converged
        assert solution.iterations <= 1


@both
@pytest.mark.parametrize("n", range(1, 11))
def test_balls_stretch_towards_an_unreachable_target(n, improved):
    robot = rik.make_chain(n)
    problem = problem_of(robot, tolerance=TIGHT, improved=improved)
    for target, start in draws(robot, n, 1.0, n):
        far = target / np.linalg.norm(target) * n * 1.2
        solution = problem.solve(start, target=far)
        assert solution.status is Status.UNREACHABLE
        for i in range(2, n + 1):
            position = robot.measure(solution.q, f"link{i}").position
            np.testing.assert_allclose(position, far / np.linalg.norm(far) * (i - 1), atol=1e-9)
        assert solution.error.position == pytest.approx(0.2 * n, abs=1e-9)


def test_the_textbook_triangle():
    """Two links of 1 and a target at distance 1: the corner of an equilateral triangle."""
    robot = rik.make_chain(2)
    problem = problem_of(robot, tolerance=TIGHT, improved=False)
    start = robot.integrate(robot.home, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0])  # leans towards +x
    solution = problem.solve(start, target=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(
        robot.measure(solution.q, "link2").position, [0.5, 0.0, np.sqrt(0.75)], atol=1e-9
    )


def test_the_improved_version_rotates_less_near_the_root():
    robot = rik.make_chain(8)
    rng = np.random.default_rng(4)
    problems = {improved: problem_of(robot, improved=improved) for improved in (False, True)}
    angle_sums = {False: 0.0, True: 0.0}
    moved = {False: 0, True: 0}
    for _ in range(20):
        start = robot.sample(rng)
        target = robot.forward(start).position + rng.normal(size=3) * 0.3
        for improved in angle_sums:
            solution = problems[improved].solve(start, target=target)
            assert solution.converged
            cosines = np.abs((solution.q.reshape(8, 4) * start.reshape(8, 4)).sum(axis=1))
            angles = 2.0 * np.arccos(np.clip(cosines, 0.0, 1.0))
            angle_sums[improved] += angles[0]
            moved[improved] += int((angles > 1e-6).sum())
    assert angle_sums[True] < 0.2 * angle_sums[False]
    assert moved[True] < 0.6 * moved[False]


@both
def test_on_hinges_the_reported_error_is_true(improved):
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(6)
    budget = Budget(iterations=100, restarts=3)
    problem = problem_of(robot, improved=improved, budget=budget)
    for _ in range(10):
        target = robot.forward(robot.sample(rng)).position
        solution = problem.solve(target=target)
        error = np.linalg.norm(robot.measure(solution.q).position - target)
        assert solution.converged == (error <= 1e-4)
        assert np.array_equal(robot.clip(solution.q), solution.q)


def test_solve_rate_on_the_puma():
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(20)
    problem = problem_of(robot, tolerance=Tolerance(1e-5, 1e-4))
    solved = 0
    for _ in range(40):
        solved += problem.solve(target=robot.forward(robot.sample(rng)).position).converged
    assert solved / 40 >= 0.95, solved
