"""Methods in turn, and batches."""

import numpy as np
import pytest

from robot_ik.errors import ConfigError, InvalidGoalError, UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Budget, Problem
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


# Behind the limits of the PUMA: no method meets it, and nothing proves so.
def behind(puma):
    return PoseGoal(None, (0.02, 0.03, -0.5), (0.5, 0.5, -0.5, 0.5))


def test_a_combined_solve_reports_what_all_its_methods_took(puma):
    budget = Budget(iterations=400, restarts=3)
    problem = Problem(puma, behind(puma), budget=budget, trace=True)
    together = make_solver("combined", methods="ccd lm").solve(problem)
    one = make_solver("ccd").solve(problem)
    rest = Budget(iterations=400 - one.iterations, restarts=3 - one.restarts)
    other = make_solver("lm").solve(Problem(puma, behind(puma), budget=rest, trace=True))
    assert not together.converged and one.iterations and other.iterations
    assert together.iterations == one.iterations + other.iterations <= 400
    assert together.restarts == one.restarts + other.restarts <= 3
    assert len(together.trace) == together.iterations
    assert [row.iteration for row in together.trace] == list(range(1, together.iterations + 1))
    assert together.trace[: len(one.trace)] == one.trace
    assert together.trace[-1].cost == other.trace[-1].cost
    assert together.trace[-1].restart == one.restarts + other.trace[-1].restart


def test_the_time_of_a_combined_solve_is_that_of_all_methods_and_one_budget(puma):
    solver = make_solver("combined", methods="ccd lm")
    solver.solve(Problem(puma, behind(puma), budget=Budget(iterations=1)))
    solution = solver.solve(Problem(puma, behind(puma), budget=Budget(1 << 40, 0.15, 1 << 40)))
    assert solution.status is Status.TIME_LIMIT
    assert 0.15 <= solution.seconds < 2.0  # generous: the machine may be busy


@pytest.mark.parametrize("name", ["auto", "combined"])
@pytest.mark.parametrize("budget", [Budget(0), Budget(1), Budget(8, restarts=0), Budget(300, restarts=2)])
def test_in_a_batch_a_budget_is_one_for_all_methods_as_in_single_solves(puma, name, budget):
    solver = make_solver(name) if name == "auto" else make_solver(name, methods="dls analytic lm")
    goals = [PoseGoal.at(None, pose) for pose in poses_of(puma, 6)] + [behind(puma)] * 2
    goals.append(PoseGoal(None, (3.0, 1.0, 1.0)))
    poses = [goal.target for goal in goals]
    batch = solve_batch(puma, poses, solver=solver, budget=budget)
    for row, goal in enumerate(goals):
        alone = solver.solve(Problem(puma, goal, budget=budget))
        assert (batch.status[row], batch.iterations[row], batch.restarts[row]) == (
            alone.status, alone.iterations, alone.restarts,
        )  # fmt: skip
    assert batch.iterations.max() <= budget.iterations
    if budget.restarts is not None:
        assert batch.restarts.max() <= budget.restarts


def test_a_method_whose_budget_ran_out_does_not_say_that_nothing_helps(puma):
    for methods in ("ccd lm", "dls lm"):
        solution = solve(puma, behind(puma), solver="combined", methods=methods, budget=Budget(iterations=40))
        assert solution.status is Status.ITERATION_LIMIT and solution.iterations == 40


def test_lists_of_poses_are_batches_too(puma):
    poses = poses_of(puma, 4)
    by_matrix = solve_batch(puma, np.array([p.matrix for p in poses]))
    for given in (poses, tuple(poses)):
        assert np.abs(solve_batch(puma, given).q - by_matrix.q).max() < 1e-9
    assert np.abs(solve_batch(puma, poses[0]).q - by_matrix.q[:1]).max() < 1e-9
    with pytest.raises(InvalidGoalError, match="poses"):
        solve_batch(puma, [poses[0], "nothing"])
