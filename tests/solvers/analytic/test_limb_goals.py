"""The closed forms of a limb for less than a pose: a point of the hand to a place, an axis aimed."""

import numpy as np
import pytest

from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import AimGoal, OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import solve, solve_all
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import BatchResult
from tests.solvers.analytic.test_limb import make_limb, random_limits

EXACT = Tolerance(position=1e-9, angle=1e-9)
KINDS = ("position", "x", "-z", (1.0, 2.0, 3.0))


def load(name):
    if name == "humanoid":
        return load_robot(name, joints="right_arm", tool="right_hand")
    return load_robot(name)


def axis_of(kind):
    if isinstance(kind, str):
        return {"x": 1.0, "-z": -1.0}[kind] * np.eye(3)["xyz".index(kind[-1])]
    return np.array(kind) / np.linalg.norm(kind)


def goal_at(kind, pose, rng, frame=None):
    """A goal of which ``pose`` is a witness."""
    if kind == "position":
        return PositionGoal(frame, pose.position)
    return AimGoal(frame, pose.apply(rng.uniform(0.05, 1.5) * axis_of(kind)), axis=kind)


def miss(robot, goal, q, frame=None):
    """Metres, or radians between the axis and the way to the point, by MuJoCo's own forward pass."""
    pose = robot.measure(q, frame or robot.tool)
    way = goal.target.position - pose.position
    if isinstance(goal, PositionGoal):
        return np.linalg.norm(way)
    axis = pose.rotation @ axis_of(goal.axis)
    return np.arctan2(np.linalg.norm(np.cross(axis, way)), axis @ way)


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("name", ["srs_arm", "humanoid"])
def test_what_is_reachable_is_met_exactly_inside_the_limits_or_left_to_others(name, kind):
    robot, rng = load(name), np.random.default_rng(5)
    problem = Problem(robot, goal_at(kind, robot.forward(robot.home), rng), tolerance=EXACT)
    solver, auto, missed = make_solver("analytic"), make_solver("auto"), 0
    for k in range(350):
        q = robot.sample(rng)
        goal = goal_at(kind, robot.forward(q), rng)
        problem.retarget(goal)
        near = robot.clip(q + 0.1 * rng.normal(size=robot.nv))
        start = (robot.home, robot.sample(rng), near)[k % 3]
        solution = solver.solve(problem, start)
        assert not robot.outside(solution.q)
        if not solution.converged:
            assert solution.status is Status.STALLED and miss(robot, goal, solution.q) > 1e-9
            missed += 1
            solution = auto.solve(problem, start)
            assert solution.converged and solution.solver == "lm" and not robot.outside(solution.q)
        assert miss(robot, goal, solution.q) < 1.5e-9  # 1 nm, and MuJoCo's rounding
        if k % 3 == 2 and solution.solver == "analytic":
            # Nearer than the witness, but for a few near the limits.
            assert np.linalg.norm(solution.q - start) < 2.0 * np.linalg.norm(q - start) + 0.3
    assert missed <= 7  # 2 %


@pytest.mark.parametrize("kind", KINDS[:2])
def test_a_start_at_the_goal_is_the_answer_and_answers_are_the_same_each_time(kind):
    robot, rng = load("srs_arm"), np.random.default_rng(6)
    solver = make_solver("analytic")
    for _ in range(20):
        q, start = robot.sample(rng), robot.sample(rng)
        problem = Problem(robot, goal_at(kind, robot.forward(q), rng), tolerance=EXACT)
        there = solver.solve(problem, q)
        assert there.converged and there.iterations == 0 and np.array_equal(there.q, q)
        once = solver.solve(problem, start)
        solver.solve(problem, q)
        assert np.array_equal(once.q, solver.solve(problem, start).q) and once.iterations == 1


@pytest.mark.parametrize("kind", KINDS[:2])
def test_many_at_once_are_answered_as_one_by_one(kind):
    robot, rng = load("srs_arm"), np.random.default_rng(7)
    problem = Problem(robot, goal_at(kind, robot.forward(robot.home), rng))
    solver, starts = make_solver("analytic"), np.array([robot.sample(rng) for _ in range(30)])
    targets, single = [], []
    for start in starts:
        problem.retarget(goal_at(kind, robot.forward(robot.sample(rng)), rng))
        targets.append(problem.target[0].copy())
        single.append(solver.solve(problem, start))
    answers = BatchResult.empty(len(starts), robot.nq)
    solver.solve_many(problem, np.array(targets), starts, answers)
    assert np.array_equal(answers.q, [s.q for s in single])
    assert np.array_equal(answers.status, [s.status for s in single])


@pytest.mark.parametrize(("name", "kind"), [("srs_arm", "x"), ("srs_arm", "position"), ("humanoid", "x")])
def test_along_a_path_the_joints_do_not_jump(name, kind):
    robot, rng, solver = load(name), np.random.default_rng(1), make_solver("analytic")
    middle, swing = robot.clip(0.5 * robot.sample(rng)), 0.15 * (robot.upper - robot.lower)
    phase, pace = rng.uniform(0, 6, robot.nq), rng.integers(1, 4, robot.nq)
    known = [robot.clip(middle + swing * np.sin(pace * t + phase)) for t in np.linspace(0, 2 * np.pi, 500)]
    q, problem = known[0], None
    for there in known:
        pose = robot.forward(there)
        goal = (
            PositionGoal(None, pose.position)
            if kind == "position"
            else AimGoal(None, pose.apply((0.6, 0, 0)), axis=kind)
        )
        problem = problem or Problem(robot, goal, tolerance=EXACT)
        problem.retarget(goal)
        solution = solver.solve(problem, q)
        assert solution.converged and np.abs(solution.q - q).max() < 0.04
        q = solution.q


@pytest.mark.parametrize("kind", KINDS[:2])
@pytest.mark.parametrize("ball", [False, True])
@pytest.mark.parametrize("off", [0.0, 0.1])
def test_only_the_geometry_counts_and_any_hinges_make_a_wrist(kind, ball, off, tmp_path):
    rng = np.random.default_rng(8)
    solved = 0
    for k in range(5):
        limits = random_limits(rng, (ball, False), (1.0, 2.9))
        robot = make_limb(rng, tmp_path / f"{k}.xml", (ball, False), off=off, limits=limits)
        solver = make_solver("analytic")
        problem = Problem(robot, goal_at(kind, robot.forward(robot.home), rng), tolerance=EXACT)
        for _ in range(20):
            goal = goal_at(kind, robot.forward(robot.sample(rng)), rng)
            problem.retarget(goal)
            solution = solver.solve(problem, robot.sample(rng))
            assert not robot.outside(solution.q)
            if solution.converged:
                solved += 1
                assert miss(robot, goal, solution.q) < 1.5e-9
    assert solved >= 80  # of 100, some of them behind narrow limits from a start far away


def test_what_has_no_such_form_is_refused(tmp_path):
    rng = np.random.default_rng(9)
    limb, other = load("srs_arm"), make_limb(rng, tmp_path / "ball.xml", (False, True))
    aim = AimGoal(None, (1.0, 0.0, 0.0))
    puma = load_robot("puma560")  # its first three axes do not meet
    for robot, goal in (
        (other, AimGoal("tool", (0, 0, 1))),
        (other, PositionGoal("tool", (0, 0, 1))),
        (puma, aim),
        (puma, PositionGoal(None, (0.3, 0.3, 0.3))),
        (limb, [aim, PositionGoal(None, (0.3, 0.3, 0.3))]),
        (limb, AimGoal(None, (1.0, 0.0, 0.0), weight=0.0)),
        (limb, PositionGoal(None, (0.3, 0.3, 0.3), axes="xy")),
        (limb, PoseGoal(None, (0.3, 0.3, 0.3), free_axis="z")),
        (limb, OrientationGoal(None, (1, 0, 0, 0))),
    ):
        assert not make_solver("analytic").applies(Problem(robot, goal))
        with pytest.raises(UnsupportedGoalError):
            solve(robot, goal, solver="analytic")


def test_every_branch_of_an_aim_meets_it_and_is_named():
    robot, rng = load("srs_arm"), np.random.default_rng(10)
    for _ in range(10):
        q = robot.sample(rng)
        goal = goal_at("x", robot.forward(q), rng)
        found = solve_all(robot, goal, start=q, limits=False)
        assert len({b.name for b in found}) == len(found) >= 2
        assert max(miss(robot, goal, b.q) for b in found) < 1e-8
        assert np.abs(found[0].q - q).max() < 1e-6 and found[0].inside


def test_out_of_reach_or_out_of_sight_is_said_so():
    robot = load("srs_arm")
    assert solve(robot, PositionGoal(None, (3.0, 0, 0)), solver="analytic").status is Status.UNREACHABLE
    q = robot.home
    stiff = robot.with_limits(q - 0.05, q + 0.05)
    behind = robot.forward(q).compose(Pose((0.0, 0.0, -0.5))).position
    solution = solve(stiff, AimGoal(None, behind), solver="analytic")
    assert solution.status is Status.STALLED and not stiff.outside(solution.q)
    ahead = robot.forward(q + 0.03).apply((0.0, 0.0, 0.5))
    assert solve(stiff, AimGoal(None, ahead), solver="analytic", tolerance=EXACT).converged
