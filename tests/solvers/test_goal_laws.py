"""The laws of every solver, for every kind of goal.

``test_laws.py`` has them for complete positions, orientations and poses.
``test_goals_out_of_reach.py`` has the sixth law.
"""

import dataclasses

import numpy as np
import pytest

from robot_ik.batch import solve_batch
from robot_ik.branches import solve_all
from robot_ik.budget import Budget
from robot_ik.errors import UnsupportedGoalError
from robot_ik.execution import follow
from robot_ik.geometry import Pose
from robot_ik.goals import GOALS, PoseGoal, PosePriorGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.motion import RecorderSink, ScriptSource
from robot_ik.ports import VirtualClock
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import SOLVERS, make_solver
from tests.solvers.goal_checks import KINDS, TOLERANCE, goals_near, measured, near
from tests.solvers.law_cases import supported_problem

NAMES = list(SOLVERS)
kinds = pytest.mark.parametrize("kind", KINDS)


def _supporting():
    """Return the names of the methods that support each kind of goal on the PUMA."""
    robot = load_robot("puma560")
    goals = goals_near(robot, 0)
    return {
        k: [n for n in NAMES if supported_problem(robot, goals[k], solver=n) is not None]
        for k in KINDS
    }


NAMES_OF = _supporting()
cases = pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for kind in KINDS for name in NAMES_OF[kind]]
)
# Methods that reach every goal near home. Others may stall at limits or saddle points.
SURE = ("auto", "lm", "combined", "sdls", "bfgs")


@pytest.fixture(scope="module")
def robots():
    loaded = {name: load_robot(name) for name in ("puma560", "srs_arm", "humanoid")}
    names = loaded["srs_arm"].joints
    return loaded | {"part of srs_arm": load_robot("srs_arm", joints=[*names[1:5], names[-1]])}


def outcome(solution):
    return solution.status, solution.iterations, solution.restarts, solution.q.tobytes()


def test_every_kind_of_goal_is_tested_with_the_methods_that_support_it(robots):
    # A pose prior belongs to one robot and has no error: tests/figure/motion/test_pose_prior.py.
    tried = {type(goal) for goal in goals_near(robots["puma560"], 0).values()}
    assert tried == set(GOALS) - {PosePriorGoal}, "goals_met_at (goal_checks.py) has one of each"
    general = {"auto", "lm", "dls", "sdls", "bfgs", "pseudoinverse", "transpose", "combined"}
    for kind in KINDS:
        assert general <= set(NAMES_OF[kind]), kind


@kinds
def test_methods_that_do_not_support_a_kind_refuse_it_with_their_name(robots, kind):
    for robot in robots.values():
        goal = goals_near(robot, 0)[kind]
        able = [name for name in NAMES if supported_problem(robot, goal, solver=name) is not None]
        for name in set(NAMES) - set(able):
            with pytest.raises(UnsupportedGoalError, match=f"'{name}' does not support") as caught:
                Problem(robot, goal, solver=name)
            # ``analytic`` names two methods for arms without a closed form.
            assert list(caught.value.able) == able or name == "analytic"
            assert caught.value.able and set(caught.value.able) <= set(able)


@cases
def test_laws_1_2_the_reported_error_and_status_are_true(robots, name, kind):
    solver = make_solver(name)
    solved = 0
    for robot in robots.values():
        for seed in range(2):
            goal = goals_near(robot, seed)[kind]
            problem = supported_problem(
                robot, goal, tolerance=TOLERANCE, budget=Budget(iterations=2000), solver=solver
            )
            if problem is None:
                continue
            solution = problem.solve()
            metres, radians = measured(robot, solution.q, goal)
            assert solution.error.position == pytest.approx(metres, abs=1e-12)
            assert solution.error.angle == pytest.approx(radians, abs=1e-7)
            assert not robot.outside(solution.q)
            reached = metres <= TOLERANCE.position and radians <= TOLERANCE.angle
            assert solution.converged == reached
            assert reached or name not in SURE, (robot.name, solution)
            solved += reached
    assert solved > 0


@cases
def test_law_3_a_start_at_the_goal_is_the_solution(robots, name, kind):
    tried = []
    for robot in robots.values():
        q = near(robot, 1)
        problem = supported_problem(
            robot, goals_near(robot, 1)[kind], tolerance=TOLERANCE, solver=name
        )
        if problem is not None:
            solution = problem.solve(q)
            assert solution.converged and solution.iterations == 0 and solution.restarts == 0
            assert solution.q.tobytes() == q.tobytes() and solution.q is not q
            tried.append(robot.name)
    assert tried


@cases
def test_laws_4_5_9_retargeting_equals_a_new_problem_and_modifies_no_input(robots, name, kind):
    solver = make_solver(name)
    budget = Budget(iterations=60)
    for robot in (robots["srs_arm"], robots["humanoid"]):
        goals = [goals_near(robot, seed)[kind] for seed in (0, 1)]
        hot = supported_problem(robot, goals[0], budget=budget, seed=3, solver=solver)
        if hot is None:
            continue
        start = near(robot, 6)
        start.flags.writeable = False
        kept = start.copy(), robot.lower.copy(), robot.upper.copy(), robot.home.copy()
        fresh = [
            outcome(Problem(robot, g, budget=budget, seed=3, solver=name).solve(start))
            for g in goals
        ]
        for k in (0, 1, 0):
            solution = hot.solve(start, target=goals[k])
            assert outcome(solution) == fresh[k]
            assert solution.error.position == pytest.approx(
                measured(robot, solution.q, goals[k])[0], abs=1e-12
            )
        for before, now in zip(kept, (start, robot.lower, robot.upper, robot.home), strict=True):
            assert np.array_equal(before, now)


@cases
def test_laws_7_8_budgets_hold_and_frozen_joints_stay(robots, name, kind):
    whole = robots["srs_arm"]
    robot = robots["part of srs_arm"]
    goal = goals_near(robot, 1)[kind]
    if supported_problem(robot, goal, solver=name) is None:
        return
    solution = Problem(robot, goal, tolerance=TOLERANCE, solver=name).solve()
    assert solution.iterations > 0
    qpos = robot.qpos(solution.q)
    for joint in (whole.joints[0], whole.joints[5]):
        first = int(robot.model.joint(joint).qposadr[0])
        assert qpos[first] == robot.frozen_qpos[first]
    for iterations in (0, 1, 3):
        short = Problem(
            robot, goal, tolerance=TOLERANCE, budget=Budget(iterations), solver=name
        ).solve()
        assert short.iterations <= iterations
        assert short.converged or short.status in (Status.ITERATION_LIMIT, Status.STALLED)
        assert iterations or np.array_equal(short.q, robot.home)
    late = Problem(
        robot, goal, tolerance=TOLERANCE, budget=Budget(seconds=0.0), solver=name
    ).solve()
    assert late.converged or late.status in (Status.TIME_LIMIT, Status.STALLED)


@cases
def test_a_goal_is_met_by_its_own_tolerance(robots, name, kind):
    robot = robots["srs_arm"]
    wide = Tolerance(0.2, 0.3)
    fine = Tolerance(1e-6, 1e-6)
    q = near(robot, 1)
    goal_at = goals_near(robot, 1)[kind]
    goal = dataclasses.replace(goal_at, tolerance=wide)
    problem = supported_problem(
        robot, goal, tolerance=fine, budget=Budget(iterations=2000), solver=name
    )
    if problem is None:
        return
    solution = problem.solve(robot.clip(q - 0.8))
    metres, radians = measured(robot, solution.q, goal)
    assert solution.converged == (metres <= wide.position and radians <= wide.angle)
    narrow = Problem(
        robot, dataclasses.replace(goal_at, tolerance=fine), tolerance=wide, solver=name
    ).solve()
    metres, radians = measured(robot, narrow.q, goal)
    assert narrow.converged == (metres <= fine.position and radians <= fine.angle)


def test_two_goals_each_by_its_own_tolerance(robots):
    robot = robots["srs_arm"]
    goal_at = goals_near(robot, 1)
    rough = dataclasses.replace(goal_at["position"], tolerance=Tolerance(position=0.05))
    exact = dataclasses.replace(goal_at["plane"], tolerance=Tolerance(position=1e-8))
    for name in ("lm", "dls", "sdls", "bfgs", "pseudoinverse", "transpose"):
        solution = solve(robot, [rough, exact], solver=name)
        assert solution.converged
        assert solution.errors[0].position <= 0.05 and solution.errors[1].position <= 1e-8
        loose = dataclasses.replace(exact, tolerance=None)
        solution = solve(robot, [rough, loose], solver=name, tolerance=Tolerance(9, 9))
        assert solution.converged and solution.errors[1].position > 1e-8


@kinds
@pytest.mark.parametrize("name", ["lm", "sdls"])
def test_following_goals_of_every_kind(robots, name, kind):
    robot = robots["puma560"]
    recorder = RecorderSink(robot.joints)
    goals = [goals_near(robot, seed)[kind] for seed in (0, 1)]
    report = follow(
        robot,
        ScriptSource([(0.0, goals[0]), (0.8, goals[1])]),
        sinks=[recorder],
        solver=name,
        clock=VirtualClock(),
        start=robot.home,
        duration=1.6,
        rate=50.0,
        tolerance=TOLERANCE,
    )
    path = recorder.trajectory()
    assert (
        report.largest_step <= robot.velocity_limits / 50.0 * (1 + 1e-9)
    ).all() and report.held == 0
    for goal, tick in zip(goals, (39, 79), strict=True):
        metres, radians = measured(robot, path.q[tick], goal)
        assert metres <= TOLERANCE.position and radians <= TOLERANCE.angle
    assert np.array_equal(path.q[-1], path.q[-2])  # at the goal it is at rest


# Batches and branches


@pytest.mark.parametrize("name", ["auto", "lm", "dls"])
def test_a_batch_gives_the_solutions_of_single_solves(robots, name):
    robot = robots["puma560"]
    poses = [*(robot.forward(near(robot, seed, 0.8)) for seed in range(4)), Pose((2.0, 0, 0))]
    for whole in (True, False):
        batch = solve_batch(
            robot, [pose.matrix if whole else pose.position for pose in poses], solver=name
        )
        for k, pose in enumerate(poses):
            goal = PoseGoal.at(None, pose) if whole else PositionGoal(None, pose.position)
            single = solve(robot, goal, solver=name)
            assert batch.status[k] == single.status
            np.testing.assert_allclose(batch.q[k], single.q, atol=1e-9)
            metres, radians = measured(robot, batch.q[k], goal)
            assert batch.position_error[k] == pytest.approx(metres, abs=1e-9)
            assert batch.angle_error[k] == pytest.approx(radians, abs=1e-7)


@kinds
def test_only_complete_goals_have_branches(robots, kind):
    robot = robots["puma560"]
    goal = goals_near(robot, 0)[kind]
    if kind != "pose":
        with pytest.raises(UnsupportedGoalError, match="analytic"):
            solve_all(robot, goal)
        return
    branches = solve_all(robot, goal)
    assert len(branches) >= 2
    for branch in branches:
        assert max(measured(robot, branch.q, goal)) < 1e-6
