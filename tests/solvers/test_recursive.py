"""recursive: an attempt reaches the goal or changes no joint."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.goals import PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.solution import Status

TIGHT = Tolerance(position=1e-8, angle=1e-9)


def solve(robot, target, start=None, **options):
    return Problem(robot, PositionGoal(None, target), solver="recursive", **options).solve(start)


def positions(robot, q, n):
    names = [f"link{i}" for i in range(1, n + 1)] + ["tip"]
    return np.array([robot.measure(q, name).position for name in names])


@pytest.mark.parametrize("n", range(2, 11))
def test_balls_reach_all_targets_in_reach(n):
    robot = rik.make_chain(n, 0.4)
    rng = np.random.default_rng(n)
    for reach in [*rng.uniform(0.0, 1.0, 8), 1e-6, 1.0 - 1e-6]:
        direction = rng.normal(size=3)
        target = direction / np.linalg.norm(direction) * reach * 0.4 * n
        solution = solve(robot, target, robot.sample(rng), tolerance=TIGHT)
        assert solution.converged
        assert solution.iterations == 1


def test_only_the_necessary_bones_move():
    """The last two bones can reach the target, so the other joints keep their values."""
    robot = rik.make_chain(6)
    start = robot.sample(np.random.default_rng(1))
    before = positions(robot, start, 6)
    direction = np.array([0.6, 0.0, 0.8])
    target = before[4] + 1.3 * direction  # within 2 of the base of the last bone but one
    solution = solve(robot, target, start, tolerance=TIGHT)
    assert solution.converged
    np.testing.assert_allclose(positions(robot, solution.q, 6)[:5], before[:5], atol=1e-12)
    np.testing.assert_allclose(solution.q[:16], start[:16], atol=1e-15)


def test_two_bones_meet_at_the_nearest_point_of_their_circle():
    robot = rik.make_chain(2)
    start = robot.integrate(robot.home, [0.0, 0.3, 0.0, 0.0, 0.4, 0.0])
    solution = solve(robot, (1.0, 0, 0), start, tolerance=TIGHT)
    np.testing.assert_allclose(
        positions(robot, solution.q, 2)[1], [0.5, 0.0, np.sqrt(0.75)], atol=1e-9
    )


def test_only_the_last_bone_rotates_if_that_is_enough():
    robot = rik.make_chain(3)
    start = robot.sample(np.random.default_rng(9))
    target = positions(robot, start, 3)[2] + [0.0, 1.0, 0.0]
    solution = solve(robot, target, start, tolerance=TIGHT)
    assert solution.converged
    np.testing.assert_allclose(solution.q[:8], start[:8], atol=1e-15)


@pytest.mark.parametrize("where", ["out of reach", "too near", "hinges"])
def test_a_failed_attempt_is_undone_to_the_bit(where):
    rng = np.random.default_rng(2)
    robots = {
        "hinges": rik.load_robot("puma560"),
        "too near": rik.make_chain(1),
        "out of reach": rik.make_chain(4),
    }
    robot = robots[where]
    failed = 0
    for _ in range(20):
        start = robot.sample(rng)
        if where == "hinges":
            target = robot.forward(robot.sample(rng)).position
        else:
            direction = rng.normal(size=3)
            target = direction / np.linalg.norm(direction) * (0.3 if where == "too near" else 4.2)
        solution = solve(robot, target, start)
        if solution.converged:
            continue
        failed += 1
        assert solution.q.tobytes() == start.tobytes()
        assert solution.status in (Status.STALLED, Status.UNREACHABLE, Status.BLOCKED_BY_LIMITS)
    assert failed >= 10


def test_a_dragged_bone_stays_where_the_bones_before_it_can_follow():
    """The published method, which drags bones out of reach, does not reach some of these goals."""
    robot = rik.make_chain(5)
    rng = np.random.default_rng(20)
    for _ in range(60):
        target = robot.forward(robot.sample(rng)).position
        assert solve(robot, target, tolerance=TIGHT).converged


def test_restarts_are_attempts_from_other_points():
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(20)
    solved = 0
    for _ in range(20):
        target = robot.forward(robot.sample(rng)).position
        solution = solve(robot, target, budget=Budget(restarts=500))
        assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
        solved += solution.converged
    assert solved >= 4, solved
