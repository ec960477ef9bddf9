"""Goals of every kind that cannot be met: a true status, a local minimum, and rest."""

import dataclasses

import numpy as np
import pytest

from robot_ik.budget import Budget
from robot_ik.compiled_goals import length_scale
from robot_ik.geometry import Pose
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
)
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import SOLVERS, make_solver
from tests.residual_rows import columns_of
from tests.solvers.goal_checks import BODY, KINDS, LOOKS, TOLERANCE, cost, direction, measured, near
from tests.solvers.law_cases import supported_problem

UNREACHABLE = tuple(kind for kind in KINDS if kind != "some joints")


@pytest.fixture(scope="module")
def narrow_robots():
    """The PUMA and the figure (standing on its pelvis) with little range in every joint."""
    figure = load_robot("humanoid")
    figure = load_robot("humanoid", joints=[joint for joint in figure.joints if joint != "root"])
    narrow = [
        robot.with_limits(robot.home - 0.3, robot.home + 0.4)
        for robot in (load_robot("puma560"), figure)
    ]
    return {robot.name: robot for robot in narrow}


def unreachable_goal(robot, kind):
    """A goal of that kind that the limits put out of reach."""
    pose = robot.forward(robot.home)
    (eye, axis) = LOOKS[robot.name]
    eye_pose = robot.forward(robot.home, eye)
    body = BODY[robot.name]
    rotated = (pose @ Pose((0, 0, 0), (np.cos(1.1), 0.6 * np.sin(1.1), 0.8 * np.sin(1.1), 0))).wxyz
    far = pose.position + np.array([1.1, -0.9, 0.8])
    slant = np.array([0.6, 0.0, 0.8])
    backward = (
        eye_pose.position - 0.7 * (eye_pose.rotation @ direction(axis)) + np.array([0.1, 0.3, 0.4])
    )
    return {
        "position": PositionGoal(None, far),
        "height": PositionGoal(None, np.add(far, (0, 0, 1.5)), axes="z"),
        "orientation": OrientationGoal(None, rotated),
        "axis": OrientationGoal(None, rotated, free_axis="z"),
        "pose": PoseGoal(None, far, rotated),
        "drill": PoseGoal(None, far, rotated, free_axis="z"),
        "aim": AimGoal(eye, backward, axis=axis),
        "line": LineGoal(None, far, (0.8, 0.3, 0)),
        "plane": PlaneGoal(None, pose.position + 2.0 * slant, slant),
        "wall": HalfSpaceGoal(None, pose.position + 2.0 * slant, slant),
        "mass": CenterOfMassGoal(body, far),
        "balance": CenterOfMassGoal(body, far, axes="xy"),
        "posture": PostureGoal(q=robot.home + np.resize([1.0, -0.7], robot.nq)),
    }[kind]


unreachable = pytest.mark.parametrize("kind", UNREACHABLE)


def slope(problem, q):
    """Return the steepest descent of √(2 cost) inside the limits, by differences of MuJoCo."""
    robot = problem.robot
    step = 1e-6
    size = np.sqrt(2 * cost(problem, q))
    gradient = np.zeros(robot.nv)
    for v in columns_of(problem):
        dq = np.zeros(robot.nv)
        dq[v] = step
        forward = cost(problem, robot.integrate(q, dq))
        backward = cost(problem, robot.integrate(q, -dq))
        gradient[v] = (forward - backward) / (2 * step) / size
    open_ = ~(
        (q <= robot.lower + 1e-9) & (gradient > 0) | (q >= robot.upper - 1e-9) & (gradient < 0)
    )
    return float(np.abs(gradient * open_).max())


@unreachable
@pytest.mark.parametrize("name", ["auto", "lm", "combined"])
def test_law_6_lm_ends_where_no_small_step_helps(narrow_robots, name, kind):
    # The default budget polishes the best descent. A budget that ends between two does not.
    budget = Budget() if name == "lm" else Budget(restarts=0)
    for robot in narrow_robots.values():
        problem = Problem(
            robot, unreachable_goal(robot, kind), tolerance=TOLERANCE, budget=budget, solver=name
        )
        solution = problem.solve(near(robot, 2, 0.1))
        assert not solution.converged
        if kind == "posture":  # each joint is at its nearest allowed value
            np.testing.assert_allclose(solution.q, robot.clip(problem.goals[0].q), atol=1e-6)
        else:
            assert slope(problem, solution.q) < 1e-3


@pytest.mark.parametrize("name", ["lm", "dls", "sdls", "pseudoinverse", "transpose", "bfgs"])
def test_law_6_stretched_out_to_a_distant_goal_no_small_step_helps(name):
    """The Jacobian is nearly singular there, and a step hardly changes the cost."""
    robot = load_robot("puma560")
    rng = np.random.default_rng(1)
    for _ in range(4):
        pose = robot.forward(robot.sample(rng))
        far = pose.position / np.linalg.norm(pose.position) * rng.uniform(1.5, 4.0)
        two = [
            PositionGoal(None, far),
            PositionGoal("flange", -far),
        ]  # the way down is between them
        for goal in (PositionGoal(None, far), PoseGoal(None, far, pose.wxyz), two):
            problem = Problem(
                robot, goal, tolerance=TOLERANCE, budget=Budget(restarts=0), solver=name
            )
            solution = problem.solve(robot.home)
            assert not solution.converged
            assert slope(problem, solution.q) < 1e-3


@unreachable
@pytest.mark.parametrize("name", list(SOLVERS))
def test_law_6_an_unreachable_goal_is_reported_and_approached(narrow_robots, name, kind):
    for robot in narrow_robots.values():
        problem = supported_problem(
            robot,
            unreachable_goal(robot, kind),
            tolerance=TOLERANCE,
            budget=Budget(iterations=200),
            solver=name,
        )
        if problem is None:
            continue
        start = near(robot, 2, 0.1)
        solution = problem.solve(start)
        metres, radians = measured(robot, solution.q, problem.goals[0])
        assert not solution.converged and not robot.outside(solution.q)
        assert solution.status is not Status.NUMERICAL
        assert (solution.error.position, solution.error.angle) == pytest.approx(
            (metres, radians), abs=1e-7
        )
        if kind != "posture":
            assert cost(problem, solution.q) <= cost(problem, start) * (1 + 1e-9)


@unreachable
@pytest.mark.parametrize("name", ["auto", "lm", "dls", "sdls", "bfgs"])
def test_law_6_tracking_comes_to_rest(narrow_robots, name, kind):
    for robot in narrow_robots.values():
        budget = Budget(restarts=0)
        problem = supported_problem(
            robot, unreachable_goal(robot, kind), solver=name, tolerance=TOLERANCE, budget=budget
        )
        if problem is None:
            continue
        q = robot.home
        largest = 0.0
        for tick in range(60):
            solution = problem.solve(q)
            if tick >= 30:
                largest = max(largest, float(np.abs(solution.q - q).max()))
            q = solution.q
        assert largest <= 1e-3


@pytest.mark.parametrize("name", ["puma560", "panda"])
@pytest.mark.parametrize(
    "other",
    [{"priority": 1}, {"weight": 1e-9}, {"weight": 1e-9, "frame": "wrist"}],
    ids=["later", "light", "light elsewhere"],
)
@pytest.mark.parametrize("method", ["auto", "bfgs"])
def test_an_unreachable_goal_does_not_end_the_search_for_other_goals(name, other, method):
    """A goal 9 m away does not change which of 60 random poses are met."""
    robot = load_robot(name)
    rng = np.random.default_rng(0)
    if method == "bfgs" and "priority" in other:
        other = {"weight": 1e-6}  # for methods without priorities
    frame = {"wrist": robot.frames[-1]}.get(other.get("frame"))
    extra = {key: value for key, value in other.items() if key != "frame"}
    far = PositionGoal(frame, (9.0, 0.0, 0.0), **extra)
    missed = []
    for k in range(60 if method == "auto" else 20):
        pose = PoseGoal.at(None, robot.forward(robot.sample(rng)))
        alone = solve(robot, pose, solver=method)
        both = solve(robot, [pose, far], solver=method)
        assert both.status is Status.UNREACHABLE
        error = both.errors[0]
        if alone.converged and not (error.position <= 1e-4 and error.angle <= 1e-3):
            missed.append(k)
    assert missed == []


def test_an_unreachable_half_space_does_not_end_the_search():
    robot = load_robot("puma560")
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = PoseGoal.at(None, robot.forward(robot.sample(rng)))
        wall = HalfSpaceGoal(None, (0, 0, 9.0), "z", weight=1e-7)
        both = solve(robot, [pose, wall])
        assert both.status is Status.UNREACHABLE
        assert both.errors[0].position <= 1e-4 and both.errors[0].angle <= 1e-3


def test_goals_left_out_of_the_search_count_in_the_result_and_the_next_solve():
    """Goals that the search left out count again in the result and in the next solve."""
    robot = load_robot("puma560")
    rng = np.random.default_rng(2)
    pose = PoseGoal.at(None, robot.forward(robot.sample(rng)))
    far = PositionGoal(None, (9.0, 0, 0), weight=1e-9)
    solver = make_solver("lm")
    for budget in (Budget(iterations=k) for k in (1, 7, 20, 35, 60, 20_000)):
        problem = Problem(robot, [pose, far], budget=budget, solver=solver)
        first = problem.solve(robot.home)
        assert first.q.tobytes() == problem.solve(robot.home).q.tobytes()
        assert cost(problem, first.q) <= cost(problem, robot.home)
        assert first.iterations <= budget.iterations


def test_beside_a_heavy_goal_out_of_reach_tracking_comes_to_rest():
    robot = load_robot("puma560")
    rng = np.random.default_rng(3)
    pose = PoseGoal.at(None, robot.forward(robot.sample(rng)))
    problem = Problem(robot, [pose, PositionGoal(None, (3.0, 0, 0.5))], solver="lm")
    q = robot.home
    steps = []
    for _ in range(60):
        solution = problem.solve(q)
        steps.append(float(np.abs(solution.q - q).max()))
        q = solution.q
    assert max(steps[30:]) <= 1e-3


def test_length_sets_the_metres_that_count_as_one_radian():
    """A00's scale c: with a longer length metres count less, and the result minimises that cost."""
    robot = load_robot("puma560")
    errors = []
    q = robot.home
    far = PoseGoal(None, (-1.1, -0.4, 0.7), (0.5, 0.5, 0.5, -0.5))
    for degrees in (600.0, 60.0, 6.0):  # that count as much as one metre
        goal = dataclasses.replace(far, length=360 / (2 * np.pi * degrees))
        problem = Problem(robot, goal, tolerance=TOLERANCE, budget=Budget(restarts=0), solver="lm")
        solution = problem.solve(q)
        assert (
            length_scale(problem.robot, goal) == goal.length and slope(problem, solution.q) < 1e-3
        )
        q = solution.q
        errors.append(solution.error)
    assert errors[0].position < errors[1].position - 1e-3 < errors[2].position - 2e-3
    assert errors[0].angle > errors[1].angle + 1e-3 > errors[2].angle + 2e-3
