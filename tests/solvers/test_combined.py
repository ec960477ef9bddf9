"""Methods in turn, and batches."""

import numpy as np
import pytest

from robot_ik.errors import ConfigError, InvalidGoalError, UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solve import solve, solve_batch
from robot_ik.solvers import make_solver


@pytest.fixture(scope="module")
def puma():
    return load_robot("puma560")


def poses_of(robot, count, seed=1):
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)) for _ in range(count)]


def test_auto_takes_the_closed_form_where_there_is_one_and_lm_elsewhere(puma):
    pose = poses_of(puma, 1)[0]
    assert solve(puma, PoseGoal.at(None, pose)).solver == "analytic"
    assert solve(puma, PositionGoal(None, pose.position)).solver == "lm"
    assert solve(puma, [PoseGoal.at(None, pose), OrientationGoal(None, pose.wxyz)]).solver == "lm"


def test_a_later_method_takes_over_where_an_earlier_one_fails(puma):
    hopeless = make_solver("combined", methods="ccd lm")
    slow = [p for p in poses_of(puma, 12) if not solve(puma, PoseGoal.at(None, p), solver="ccd").converged]
    assert slow, "the set should hold poses that ccd alone does not reach"
    for pose in slow:
        solution = hopeless.solve(Problem(puma, PoseGoal.at(None, pose)))
        assert solution.converged and solution.solver == "lm"


def test_wrong_members_are_refused(puma):
    problem = Problem(puma, PoseGoal.at(None, poses_of(puma, 1)[0]))
    for methods in ("", "auto", "lm combined"):
        with pytest.raises(ConfigError, match="methods"):
            make_solver("combined", methods=methods).solve(problem)
    with pytest.raises(UnsupportedGoalError):
        make_solver("combined", methods="analytic").solve(Problem(puma, OrientationGoal(None, (1, 0, 0, 0))))


@pytest.mark.parametrize("name", ["auto", "lm", "dls", "analytic"])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_batch_gives_the_same_answers_as_one_by_one(puma, name, threads, monkeypatch):
    monkeypatch.setattr("robot_ik.batch._LEAST_PER_THREAD", 5)
    poses = poses_of(puma, 24)
    matrices = np.array([p.matrix for p in poses])
    matrices[3, :3, 3] = 3.0  # out of reach
    rng = np.random.default_rng(2)
    starts = np.array([puma.sample(rng) for _ in poses])
    batch = solve_batch(puma, matrices, starts=starts, solver=name, threads=threads)
    assert len(batch) == 24 and batch.converged.sum() == 23
    problem, solver = Problem(puma, PoseGoal.at(None, poses[0])), make_solver(name)
    for row in range(24):
        problem.retarget(matrices[row])
        alone = solver.solve(problem, starts[row])
        assert batch.status[row] == alone.status
        # Two compiled versions of one source may differ in the last bits (multiply-add, order of sums).
        np.testing.assert_allclose(batch.q[row], alone.q, atol=1e-7)
        assert batch.position_miss[row] == pytest.approx(alone.miss.position, abs=1e-9)
        assert batch.angle_miss[row] == pytest.approx(alone.miss.angle, abs=1e-6)
    assert batch.status[3] == Status.UNREACHABLE


def test_the_three_ways_of_giving_poses_agree(puma):
    poses = poses_of(puma, 5)
    by_matrix = solve_batch(puma, np.array([p.matrix for p in poses]))
    by_quaternion = solve_batch(puma, np.array([[*p.position, *(2.0 * p.wxyz)] for p in poses]))
    assert np.abs(by_matrix.q - by_quaternion.q).max() < 1e-9
    places = solve_batch(puma, np.array([p.position for p in poses]))
    assert places.converged.all() and places.angle_miss.max() == 0.0


@pytest.mark.parametrize(
    "poses", [np.zeros((2, 5)), np.full((2, 3), np.nan), np.zeros((2, 7)), np.zeros((3, 4, 3))]
)
def test_malformed_batches_are_refused(puma, poses):
    with pytest.raises(InvalidGoalError):
        solve_batch(puma, poses)
    with pytest.raises(InvalidGoalError, match="starts"):
        solve_batch(puma, np.zeros((2, 3)), starts=np.zeros((3, 6)))


def test_an_empty_batch_is_no_problem(puma):
    assert len(solve_batch(puma, np.zeros((0, 4, 4)))) == 0
