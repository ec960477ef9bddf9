"""combined: methods in turn within one budget, from one start or from the last method's result."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.compiled_goals import length_scale
from robot_ik.errors import OptionError, UnknownSolverError, UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.solution import Status
from robot_ik.solvers import make_solver
from robot_ik.solvers.sequence import PreparedSequence


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


def poses_of(robot, count, seed=1):
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)) for _ in range(count)]


def pose_beyond_the_limits():
    """A pose that no method reaches, and that no method proves unreachable."""
    return PoseGoal(None, (0.02, 0.03, -0.5), (0.5, 0.5, -0.5, 0.5))


def weighted_cost(robot, goal, solution):
    """Half the squared residual, with metres scaled as the solvers scale them."""
    metres = solution.error.position / length_scale(robot, goal)
    return 0.5 * (metres**2 + solution.error.angle**2)


def combined(robot, goal, methods, **options):
    return Problem(robot, goal, solver="combined", methods=methods, **options)


def test_a_later_method_solves_what_an_earlier_method_does_not(puma):
    poses = poses_of(puma, 12)
    goal = PoseGoal.at(None, poses[0])
    alone = Problem(puma, goal, solver="ccd")
    together = combined(puma, goal, "ccd lm")
    missed = [pose for pose in poses if not alone.solve(target=pose).converged]
    assert missed, "the set should hold poses that ccd does not reach"
    for pose in poses:
        solution = together.solve(target=pose)
        assert solution.converged
        assert solution.solver == ("lm" if any(pose is other for other in missed) else "ccd")


def test_the_recursive_method_solves_what_the_jacobian_method_does_not():
    """Aho's order: a chain of balls, straight, with its goal on its line."""
    chain = rik.make_chain(4)
    goal = PositionGoal(None, (0.0, 0.0, 2.0))
    few = Budget(restarts=0)
    assert not Problem(chain, goal, solver="pseudoinverse", budget=few).solve().converged
    solution = combined(chain, goal, "pseudoinverse recursive", budget=few).solve()
    assert solution.converged
    assert solution.solver == "recursive"


def test_methods_that_do_not_support_the_problem_are_left_out(puma):
    pose = poses_of(puma, 1)[0]
    solution = combined(puma, OrientationGoal(None, pose.wxyz), "recursive analytic lm").solve()
    assert solution.converged
    assert solution.solver == "lm"
    with pytest.raises(UnsupportedGoalError, match=r"combined.*orientation goal"):
        combined(puma, OrientationGoal(None, pose.wxyz), "recursive analytic")


@pytest.mark.parametrize("methods", ["", "auto", "lm combined"])
def test_only_single_methods_can_be_combined(puma, methods):
    with pytest.raises(OptionError, match=r"methods.*single methods"):
        combined(puma, pose_beyond_the_limits(), methods)


def test_unknown_methods_are_refused_with_close_names(puma):
    with pytest.raises(UnknownSolverError, match="fabrik"):
        combined(puma, pose_beyond_the_limits(), "fabric lm")
    with pytest.raises(OptionError, match=r"methods.*text"):
        combined(puma, pose_beyond_the_limits(), 3)


# One budget


def test_the_solution_reports_the_steps_of_all_methods(puma):
    budget = Budget(iterations=400, restarts=3)
    goal = pose_beyond_the_limits()
    together = combined(puma, goal, "ccd lm", budget=budget, trace=True).solve()
    first = Problem(puma, goal, solver="ccd", budget=budget, trace=True).solve()
    rest = Budget(iterations=400 - first.iterations, restarts=3 - first.restarts)
    second = Problem(puma, goal, solver="lm", budget=rest, trace=True).solve()

    assert not together.converged
    assert first.iterations and second.iterations
    assert together.iterations == first.iterations + second.iterations <= 400
    assert together.restarts == first.restarts + second.restarts <= 3
    assert [row.iteration for row in together.trace] == list(range(1, together.iterations + 1))
    assert together.trace[: len(first.trace)] == first.trace
    assert together.trace[-1].cost == second.trace[-1].cost
    assert together.trace[-1].restart == first.restarts + second.trace[-1].restart


def test_a_budget_of_seconds_is_one_for_all_methods(puma):
    combined(puma, pose_beyond_the_limits(), "ccd lm", budget=Budget(iterations=1)).solve()
    endless = Budget(iterations=1 << 40, seconds=0.15, restarts=1 << 40)
    solution = combined(puma, pose_beyond_the_limits(), "ccd lm", budget=endless).solve()
    assert solution.status is Status.TIME_LIMIT
    assert solution.seconds >= 0.15


@pytest.mark.parametrize("methods", ["ccd lm", "dls lm"])
def test_an_exhausted_budget_is_not_reported_as_a_failure(puma, methods):
    budget = Budget(iterations=40)
    solution = combined(puma, pose_beyond_the_limits(), methods, budget=budget).solve()
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.iterations == 40


def test_a_goal_that_is_proven_out_of_reach_gets_no_restarts(puma):
    far = combined(puma, PositionGoal(None, (3.0, 1.0, 1.0)), "ccd lm").solve()
    assert far.status is Status.UNREACHABLE
    assert far.restarts == 0


class Recorder:
    """A prepared method that stores its budget."""

    proves_best = False

    def __init__(self, name, problem):
        self.name = name
        self.prepared = make_solver(name).prepare(problem)

    def run(self, problem, budget):
        self.budget = budget
        return self.prepared.run(problem, budget)


@pytest.mark.parametrize(
    ("others", "restarts"), [([], 0), ([OrientationGoal(None, (1, 0, 0, 0))], None)]
)
def test_goals_beside_an_unreachable_goal_get_restarts(puma, others, restarts):
    far = PositionGoal("flange", (3.0, 1.0, 1.0))
    problem = Problem(puma, [far, *others], solver="ccd")
    attempts = [Recorder("ccd", problem), Recorder("lm", problem)]
    solution = PreparedSequence("combined", problem, attempts).run(problem, Budget())
    assert solution.status is Status.UNREACHABLE
    assert attempts[1].budget.restarts == restarts


def test_the_better_of_two_failures_is_kept(puma):
    goal = pose_beyond_the_limits()
    budget = Budget(restarts=0)
    costs = {}
    for methods in ("transpose", "lm", "lm transpose", "transpose lm"):
        solution = combined(puma, goal, methods, budget=budget).solve()
        assert not solution.converged
        costs[methods] = weighted_cost(puma, goal, solution)
    better = min(costs["lm"], costs["transpose"])
    assert costs["lm transpose"] <= better * (1.0 + 1e-9)
    assert costs["transpose lm"] <= better * (1.0 + 1e-9)


# Batches


@pytest.mark.parametrize("hand_over", [False, True])
@pytest.mark.parametrize(
    "budget", [Budget(0), Budget(1), Budget(8, restarts=0), Budget(300, restarts=2)]
)
def test_a_batch_shares_the_budget_as_single_solves_do(puma, budget, hand_over):
    goals = [PoseGoal.at(None, pose) for pose in poses_of(puma, 6)]
    goals += [pose_beyond_the_limits(), pose_beyond_the_limits(), PoseGoal(None, (3.0, 1.0, 1.0))]
    poses = [goal.target for goal in goals]
    options = {"methods": "dls analytic lm", "hand_over": hand_over}
    batch = rik.solve_batch(puma, poses, solver="combined", budget=budget, **options)
    problem = Problem(puma, goals[0], solver="combined", budget=budget, **options)
    for row, pose in enumerate(poses):
        alone = problem.solve(target=pose)
        assert batch.status[row] == alone.status
        assert batch.iterations[row] == alone.iterations
        assert batch.restarts[row] == alone.restarts
        np.testing.assert_allclose(batch.q[row], alone.q, atol=1e-7)
    assert batch.iterations.max() <= budget.iterations


# Hand over


def test_a_method_starts_where_the_method_before_it_ended(puma):
    budget = Budget(restarts=0)
    for pose in poses_of(puma, 10):
        goal = PoseGoal.at(None, pose)
        first = Problem(puma, goal, solver="ccd", budget=budget).solve()
        together = combined(puma, goal, "ccd lm", hand_over=True, budget=budget).solve()
        if first.converged:
            assert together.q.tobytes() == first.q.tobytes()
            continue
        second = Problem(puma, goal, solver="lm", budget=budget).solve(first.q)
        assert together.iterations == first.iterations + second.iterations
        assert together.status is second.status
        if second.converged:
            assert together.q.tobytes() == second.q.tobytes()


def test_handing_over_takes_fewer_steps_than_a_slow_method_alone(puma):
    """Pađen 2011, table 1: ccd slows down near the solution and can be combined with others."""
    goal = PoseGoal.at(None, poses_of(puma, 1)[0])
    alone = Problem(puma, goal, solver="ccd")
    together = combined(puma, goal, "ccd lm", hand_over=True)
    steps = np.zeros(2)
    for pose in poses_of(puma, 20):
        slow = alone.solve(target=pose)
        fast = together.solve(target=pose)
        assert fast.converged
        steps += slow.iterations, fast.iterations
    assert steps[1] < 0.5 * steps[0]


def test_only_the_last_method_restarts_after_a_hand_over(puma):
    goal = pose_beyond_the_limits()
    first = Problem(puma, goal, solver="ccd", budget=Budget(restarts=0)).solve()
    budget = Budget(iterations=5_000)
    together = combined(puma, goal, "ccd dls", hand_over=True, budget=budget, trace=True).solve()
    assert {row.restart for row in together.trace[: first.iterations]} == {0}
    assert together.restarts > 0


def test_a_solve_does_not_start_at_the_end_of_the_last_solve(puma):
    pose = poses_of(puma, 1)[0]
    problem = combined(puma, PoseGoal.at(None, pose), "ccd dls", hand_over=True)
    first = problem.solve()
    problem.solve(target=pose_beyond_the_limits().target)
    again = problem.solve(target=pose)
    assert again.q.tobytes() == first.q.tobytes()
    assert again.iterations == first.iterations
