"""Methods one after the other, and batches."""

import importlib.util
import math
import time
from pathlib import Path

import numpy as np
import pytest

from robot_ik.batch import solve_batch
from robot_ik.errors import ConfigError, InvalidGoalError, UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Budget, Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
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
    positions = solve_batch(puma, np.array([p.position for p in poses]))
    assert positions.converged.all() and positions.angle_miss.max() == 0.0


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


def test_poses_of_a_batch_are_solved_bit_by_bit_as_goals_are(puma):
    poses = poses_of(puma, 60)
    alone = [solve(puma, PoseGoal.at(None, pose)).q for pose in poses]
    assert np.array_equal(solve_batch(puma, poses).q, alone)


def test_a_batch_of_one_pose_costs_no_more_than_a_few_solves(puma):
    pose = poses_of(puma, 1)[0]
    goal, matrices = PoseGoal.at(None, pose), pose.matrix[None]
    calls = (lambda: solve(puma, goal)), (lambda: solve_batch(puma, matrices))
    times = [math.inf, math.inf]
    for _ in range(300):  # alternating, so that other work on the machine meets both
        for k, call in enumerate(calls):
            began = time.perf_counter()
            call()
            times[k] = min(times[k], time.perf_counter() - began)
    assert times[1] < 3.8 * times[0]


# ------------------------------------------------------------------------------ what auto asks first


def near_starts(robot, count, seed=3):
    """Targets, and starts beside joint angles that meet them."""
    rng = np.random.default_rng(seed)
    inside = [
        robot.lower + (robot.upper - robot.lower) * rng.uniform(0.2, 0.8, robot.nq) for _ in range(count)
    ]
    return [robot.forward(q) for q in inside], [q + rng.uniform(-0.01, 0.01, robot.nq) for q in inside]


@pytest.mark.parametrize("name", ["puma560", "ur5e"])
def test_near_its_goal_auto_asks_lm_first_and_far_from_it_the_closed_form(name):
    robot = load_robot(name)
    for pose, start in zip(*near_starts(robot, 20), strict=True):
        warm = solve(robot, PoseGoal.at(None, pose), start=start)
        assert warm.converged and warm.solver == "lm" and warm.restarts == 0
        assert np.abs(warm.q - start).max() < 0.1  # the branch on which it began
    for pose in poses_of(robot, 20):
        cold = solve(robot, PoseGoal.at(None, pose))
        assert cold.converged and cold.solver == "analytic"


def test_a_limb_with_a_closed_form_is_solved_by_lm_and_its_proofs_are_kept():
    arm = load_robot("srs_arm")
    problem, auto = Problem(arm, PoseGoal(None, (0.4, 0.1, 0.5))), make_solver("auto")
    solvers = []
    for pose in poses_of(arm, 1000):
        problem.retarget(pose)
        found = auto.solve(problem)
        assert found.converged
        solvers.append(found.solver)
    assert solvers.count("lm") > 900
    # Within the ball of all links laid end to end, but the wrist would be too near the shoulder or too far.
    radius = arm.reach(arm.tool)[1]
    centre = arm.reach(arm.tool)[0]
    proven = PoseGoal(None, centre + np.array([0, 0, 0.97 * radius]), (0, 1, 0, 0))
    assert make_solver("analytic").solve(Problem(arm, proven)).status is Status.UNREACHABLE
    assert auto.solve(Problem(arm, proven)).status is Status.UNREACHABLE


@pytest.mark.parametrize("name", ["puma560", "srs_arm"])
def test_a_batch_chooses_as_one_solve_does(name):
    robot = load_robot(name)
    near, starts = near_starts(robot, 12)
    poses = [*near, *poses_of(robot, 12)]
    starts = np.array([*starts, *([robot.home] * 12)])
    batch = solve_batch(robot, np.array([pose.matrix for pose in poses]), starts=starts)
    problem, auto = Problem(robot, PoseGoal.at(None, poses[0])), make_solver("auto")
    for row, (pose, start) in enumerate(zip(poses, starts, strict=True)):
        problem.retarget(pose)
        alone = auto.solve(problem, start)
        # Compiled versions differ in the last bits, as above; solutions of lm and of the closed form by more.
        assert (batch.status[row], batch.iterations[row]) == (alone.status, alone.iterations)
        np.testing.assert_allclose(batch.q[row], alone.q, atol=1e-7)


@pytest.fixture(scope="module")
def measure():
    """The script that makes the table of first choices."""
    file = Path(__file__).parents[2] / "docs" / "make" / "measure_first_choice.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_table_of_first_choices_follows_the_times_and_nothing_else(measure):
    from robot_ik.solvers.analytic.recognise import Family
    from robot_ik.solvers.combined import FIRST_CHOICE

    families = {family.name.lower() for family in Family}
    assert {family for family, _ in FIRST_CHOICE} <= families
    assert {start for _, start in FIRST_CHOICE} == {"cold", "warm"} and set(FIRST_CHOICE.values()) <= set(
        measure.METHODS
    )
    times = {
        ("limb", "one", "cold"): {"lm": 12.0, "analytic": 36.0, "auto": 12.5},
        ("limb", "one", "warm"): {"lm": 9.5, "analytic": 10.0, "auto": 13.0},
        ("wrist", "one", "warm"): {"lm": 7.0, "analytic": 9.0, "auto": 7.5},
        ("wrist", "other", "warm"): {"lm": 14.0, "analytic": 9.0, "auto": 9.5},
    }
    wanted = {("limb", "cold"): "lm", ("limb", "warm"): "analytic", ("wrist", "warm"): "analytic"}
    assert measure.choose(times) == wanted  # of two arms of a family both count
    assert measure.over_best(times["limb", "one", "warm"]) == pytest.approx(13.0 / 9.5)


def test_what_the_choice_is_measured_on_has_a_closed_form_for_poses_in_every_family(measure):
    from robot_ik.solvers.combined import FIRST_CHOICE

    analytic, found = make_solver("analytic"), []
    for arm in measure.arms():
        made = analytic.load(Problem(arm, PoseGoal(None, (0.0, 0.0, 0.0))))
        found.append(made.form.family.name.lower())
    assert set(found) == {family for family, _ in FIRST_CHOICE}
    assert found[-1] == "limb" and measure.arms()[-1].name == "iiwa-like"
