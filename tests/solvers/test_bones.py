"""fabrik, triangulation and recursive: laws, limits, degenerate geometry."""

from collections.abc import Callable
from functools import cache

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.errors import UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solution import Status

METHODS = ["fabrik", "triangulation", "recursive"]
methods = pytest.mark.parametrize("name", METHODS)
NO_RESTARTS = Budget(restarts=0)
TOLERANCE = Tolerance(position=1e-6, angle=1e-5)


def of_xml(bodies: str, tool: str = "tool") -> Robot:
    xml = f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody></mujoco>'
    return rik.load_robot(xml, tool=tool)


def links(joints: list[str], lengths: list[float], tail: str = "") -> str:
    """Nested bodies with their joints (elements may hold several) and their lengths along x."""
    text = f'<site name="tool" pos="{lengths[-1]} 0 0"/>{tail}'
    for i in reversed(range(len(joints))):
        offset = f'pos="{lengths[i - 1] if i else 0.0} 0 0"'
        text = f'<body {offset}>{joints[i]}<geom size="0.01"/>{text}</body>'
    return text


def planar(*ranges: tuple[float, float]) -> Robot:
    joints = [
        f'<joint name="j{i}" axis="0 0 1" range="{low} {high}"/>'
        for i, (low, high) in enumerate(ranges)
    ]
    return of_xml(links(joints, [0.5, 0.4, 0.2][: len(ranges)]))


PLANAR = ((-2.8, 2.8), (-2.6, 2.6), (-2.0, 2.0))
CONES = [
    f'<joint name="b{i}" type="ball" range="0 {c}" limited="true"/>'
    for i, c in enumerate((1.2, 0.8, 0.9, 0.6))
]
SHOULDER = (
    '<joint name="yaw" axis="0 0 1" range="-2.5 2.5"/>'
    '<joint name="pitch" axis="0 1 0" range="-1.4 1.4"/>'
    '<joint name="roll" axis="1 0 0" range="-2 2"/>'
)
ELBOW = '<joint name="elbow" axis="0 1 0" range="0 2.5"/>'

ROBOTS: dict[str, Callable[[], Robot]] = {
    "puma560": lambda: rik.load_robot("puma560"),
    "planar": lambda: planar(*PLANAR),
    "chain4": lambda: rik.make_chain(4),
    "cones": lambda: of_xml(links(CONES, [0.4, 0.3, 0.3, 0.2])),
    "limb": lambda: of_xml(links([SHOULDER, ELBOW], [0.35, 0.3])),
    "socket": lambda: of_xml(
        links(['<joint name="s" type="ball" range="0 1.5" limited="true"/>', ELBOW], [0.35, 0.3])
    ),
}


@cache
def robot_named(name: str) -> Robot:
    return ROBOTS[name]()


def measured(robot: Robot, q: np.ndarray, position: np.ndarray) -> float:
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_forward(robot.model, data)
    return float(np.linalg.norm(data.site_xpos[robot.model.site(robot.tool).id] - position))


def targets(robot: Robot, count: int, seed: int = 5) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [robot.forward(robot.sample(rng)).position for _ in range(count)]


def outcome(solution):
    return solution.status, solution.iterations, solution.restarts, solution.q.tobytes()


# Laws


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_the_result_is_inside_the_limits_and_has_the_reported_error(name, robot_name):
    robot = robot_named(robot_name)
    rng = np.random.default_rng(1)
    for position in targets(robot, 8):
        start = robot.sample(rng)
        before = start.copy()
        goal = PositionGoal(None, position)
        problem = Problem(robot, goal, solver=name, tolerance=TOLERANCE)
        solution = problem.solve(start)
        error = measured(robot, solution.q, position)
        assert solution.error.position == pytest.approx(error, abs=1e-12)
        assert solution.converged == (error <= TOLERANCE.position)
        assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
        assert error <= measured(robot, start, position) + 1e-12
        assert np.array_equal(start, before)
        assert outcome(problem.solve(start)) == outcome(solution)


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_a_start_at_the_goal_is_the_solution(name, robot_name):
    robot = robot_named(robot_name)
    q = robot.sample(np.random.default_rng(3))
    goal = PositionGoal(None, robot.forward(q).position)
    solution = Problem(robot, goal, solver=name).solve(q)
    assert solution.converged
    assert solution.iterations == 0
    assert solution.q.tobytes() == q.tobytes()


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_a_goal_out_of_reach_is_proven_and_budgets_hold(name, robot_name):
    robot = robot_named(robot_name)
    centre, radius = robot.reach()
    far = PositionGoal(None, centre + np.array([0.6, -0.48, 0.64]) * 1.5 * radius)
    solution = Problem(robot, far, solver=name).solve()
    assert solution.status is Status.UNREACHABLE
    assert np.isfinite(solution.q).all()
    for steps in (0, 1, 3):
        solution = Problem(robot, far, solver=name, budget=Budget(iterations=steps)).solve()
        assert solution.iterations <= steps
        assert not solution.converged
        if steps == 0:
            assert np.array_equal(solution.q, robot.home)


@methods
def test_the_trace_and_slices_of_time_change_nothing(name):
    robot = robot_named("puma560")
    goal = PositionGoal(None, targets(robot, 1)[0])
    few = Budget(restarts=5)
    timed = Budget(restarts=5, seconds=60.0)
    quiet = Problem(robot, goal, solver=name, seed=2, budget=few).solve()
    traced = Problem(robot, goal, solver=name, seed=2, budget=few, trace=True).solve()
    sliced = Problem(robot, goal, solver=name, seed=2, budget=timed).solve()
    assert outcome(quiet) == outcome(traced) == outcome(sliced)
    assert [row.iteration for row in traced.trace] == list(range(1, traced.iterations + 1))


@methods
def test_frozen_joints_and_joints_that_move_no_goal_stay(name):
    text = links([ELBOW, ELBOW.replace("elbow", "wrist")], [0.4, 0.3])
    lamp = '<joint name="lamp" axis="0 1 0" range="-1 1"/><geom size="0.01"/>'
    robot = of_xml(f'{text}<body pos="0 0 0.2">{lamp}</body>')
    q = np.array([0.4, 0.6, 0.7])
    goal = PositionGoal(None, robot.forward([0.9, 1.2, 0.0]).position)
    solution = Problem(robot, goal, solver=name).solve(q)
    assert solution.converged
    assert solution.q[2] == 0.7


# Degenerate geometry


def solve_soundly(name: str, robot: Robot, position, start=None, budget=None):
    """Solve; check that q is finite and inside the limits."""
    goal = PositionGoal(None, position)
    problem = Problem(robot, goal, solver=name, tolerance=TOLERANCE, budget=budget)
    solution = problem.solve(start)
    assert np.isfinite(solution.q).all()
    assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
    return solution


@methods
@pytest.mark.parametrize("n", range(1, 6))
def test_a_straight_chain_reaches_targets_on_its_line(name, n):
    """The vectors are collinear, so the axis of a rotation and the side to bend are undefined."""
    robot = rik.make_chain(n)
    for height in (n, -n, n - 0.5, 0.5 - n, 0.3, -0.3):
        solution = solve_soundly(name, robot, (0.0, 0.0, height), budget=NO_RESTARTS)
        if n > 1 or abs(height) == n:
            assert solution.converged, height


@methods
@pytest.mark.parametrize("n", range(1, 6))
def test_a_target_at_the_root_is_reached_by_all_chains_but_a_single_link(name, n):
    robot = rik.make_chain(n)
    for start in (None, robot.sample(np.random.default_rng(n))):
        solution = solve_soundly(name, robot, (0.0, 0.0, 0.0), start, NO_RESTARTS)
        assert solution.converged == (n > 1)


@methods
def test_points_that_coincide_form_no_bone(name):
    ball = '<joint name="b{}" type="ball"/>'
    robot = of_xml(links([ball.format(i) for i in range(5)], [0.0, 0.4, 0.0, 0.3, 0.0]))
    start = robot.sample(np.random.default_rng(0))
    for position in [*targets(robot, 5), (0.7, 0.0, 0.0), (0.0, 0.69, 0.0)]:
        assert solve_soundly(name, robot, position, start, NO_RESTARTS).converged
    still = of_xml(links([ball.format(i) for i in range(2)], [0.0, 0.0]))
    assert not solve_soundly(name, still, (0.1, 0.0, 0.0)).converged


@methods
def test_a_planar_arm_meets_targets_beside_its_plane_and_on_its_axes(name):
    robot = robot_named("planar")
    beside = [(0.5, 0.3, 0.1), (0.0, 0.0, 0.4)]
    on_axes = [(0.0, 0.0, 0.0), (1.1, 0.0, 0.0), (-1.1, 0.0, 0.0)]
    for position in beside + on_axes:
        solve_soundly(name, robot, position, np.zeros(3))


@methods
def test_a_frame_that_no_joint_moves(name):
    robot = of_xml(links([ELBOW], [0.4]) + '<site name="nail" pos="0.3 0.3 0"/>')
    problem = Problem(robot, PositionGoal("nail", (0.3, 0.3, 0.0)), solver=name)
    solution = problem.solve()
    assert solution.converged
    assert solution.iterations == 0
    solution = problem.solve(target=(0.5, 0.3, 0.0))
    assert not solution.converged
    assert np.array_equal(solution.q, robot.home)


# Refusals


@methods
def test_an_unsupported_goal_is_refused_with_the_names_of_supporting_methods(name):
    robot = robot_named("puma560")
    with pytest.raises(UnsupportedGoalError, match=rf"{name}.*orientation goal") as caught:
        Problem(robot, OrientationGoal(None, (1, 0, 0, 0)), solver=name)
    assert "lm" in caught.value.able
    assert name not in caught.value.able
    with pytest.raises(UnsupportedGoalError, match="position goal on single axes"):
        Problem(robot, PositionGoal(None, (0.4, 0.0, 0.8), axes="xy"), solver=name)
    with pytest.raises(UnsupportedGoalError, match="pose goal"):
        Problem(robot, PoseGoal(None, (0.4, 0, 0.8), position_weight=0.0), solver=name)


@pytest.mark.parametrize("name", ["triangulation", "recursive"])
def test_only_one_position_of_one_chain_is_supported(name):
    robot = robot_named("puma560")
    goal = PositionGoal(None, (0.4, 0.0, 0.8))
    with pytest.raises(UnsupportedGoalError, match="several goals"):
        Problem(robot, [goal, PositionGoal("flange", (0.4, 0.0, 0.7))], solver=name)
    with pytest.raises(UnsupportedGoalError, match="pose goal") as caught:
        Problem(robot, PoseGoal(None, (0.4, 0, 0.8)), solver=name)
    assert "fabrik" in caught.value.able
    slide = '<joint name="rail" type="slide" axis="1 0 0" range="0 1"/>'
    rail = of_xml(links([slide, ELBOW], [0.1, 0.3]))
    with pytest.raises(UnsupportedGoalError, match="the slide joint 'rail'") as caught:
        Problem(rail, PositionGoal(None, (0.4, 0.0, 0.0)), solver=name)
    assert "fabrik" in caught.value.able
