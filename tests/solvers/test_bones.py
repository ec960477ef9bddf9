"""What fabrik, triangulation and recursive have in common: the laws, limits, and degenerate geometry."""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import UnsupportedGoalError, UnsupportedJointError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.problem import Budget, Problem
from robot_ik.robot import Robot
from robot_ik.solution import Status
from robot_ik.solvers import make_solver

METHODS = ["fabrik", "triangulation", "recursive"]
methods = pytest.mark.parametrize("name", METHODS)
TOLERANCE = Tolerance(position=1e-6, angle=1e-5)


def of_xml(bodies: str, tool: str = "tool") -> Robot:
    xml = f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody></mujoco>'
    return rik.load_robot(xml, tool=tool)


def links(joints: list[str], lengths: list[float], tail: str = "") -> str:
    """Nested bodies, each with the joints given (several elements allowed) and its length along x."""
    text = f'<site name="tool" pos="{lengths[-1]} 0 0"/>{tail}'
    for i in reversed(range(len(joints))):
        offset = f'pos="{lengths[i - 1] if i else 0.0} 0 0"'
        text = f'<body {offset}>{joints[i]}<geom size="0.01"/>{text}</body>'
    return text


def planar(*ranges: tuple[float, float]) -> Robot:
    joints = [f'<joint name="j{i}" axis="0 0 1" range="{a} {b}"/>' for i, (a, b) in enumerate(ranges)]
    return of_xml(links(joints, [0.5, 0.4, 0.2][: len(ranges)]))


PLANAR = ((-2.8, 2.8), (-2.6, 2.6), (-2.0, 2.0))
CONES = [
    f'<joint name="b{i}" type="ball" range="0 {c}" limited="true"/>'
    for i, c in enumerate((1.2, 0.8, 0.9, 0.6))
]
SHOULDER = (
    '<joint name="yaw" axis="0 0 1" range="-2.5 2.5"/><joint name="pitch" axis="0 1 0" range="-1.4 1.4"/>'
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
_MADE: dict[str, Robot] = {}


def robot_named(name: str) -> Robot:
    return _MADE.setdefault(name, _MADE.get(name) or ROBOTS[name]())


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


# ------------------------------------------------------------------------------ laws


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_what_is_reported_is_true_and_inside_the_limits(name, robot_name):
    robot = robot_named(robot_name)
    rng = np.random.default_rng(1)
    for position in targets(robot, 8):
        start = robot.sample(rng)
        before = start.copy()
        problem = Problem(robot, PositionGoal(None, position), tolerance=TOLERANCE, solver=name)
        solution = problem.solve(start)
        miss = measured(robot, solution.q, position)
        assert solution.miss.position == pytest.approx(miss, abs=1e-12)
        assert solution.converged == (miss <= TOLERANCE.position)
        assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
        assert miss <= measured(robot, start, position) + 1e-12
        assert np.array_equal(start, before)
        again = problem.solve(start)
        assert outcome(again) == outcome(solution)


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_a_start_at_the_goal_is_the_answer(name, robot_name):
    robot = robot_named(robot_name)
    q = robot.sample(np.random.default_rng(3))
    solution = Problem(robot, PositionGoal(None, robot.forward(q).position), solver=name).solve(q)
    assert solution.converged and solution.iterations == 0 and solution.q.tobytes() == q.tobytes()


@methods
@pytest.mark.parametrize("robot_name", ROBOTS)
def test_a_goal_out_of_reach_is_said_and_budgets_hold(name, robot_name):
    robot = robot_named(robot_name)
    centre, radius = robot.reach()
    far = PositionGoal(None, centre + np.array([0.6, -0.48, 0.64]) * 1.5 * radius)
    solution = Problem(robot, far, solver=name).solve()
    assert solution.status is Status.UNREACHABLE and np.isfinite(solution.q).all()
    for steps in (0, 1, 3):
        solution = Problem(robot, far, budget=Budget(iterations=steps), solver=name).solve()
        assert solution.iterations <= steps and not solution.converged
    problem = Problem(robot, far, budget=Budget(iterations=0), solver=name)
    assert np.array_equal(problem.solve().q, robot.home)


@methods
def test_the_trace_and_slices_of_time_change_nothing(name):
    robot = robot_named("puma560")
    goal = PositionGoal(None, targets(robot, 1)[0])
    quiet = Problem(robot, goal, seed=2, solver=make_solver(name, restarts=5)).solve()
    traced = Problem(robot, goal, seed=2, trace=True, solver=make_solver(name, restarts=5)).solve()
    sliced = Problem(robot, goal, seed=2, budget=Budget(seconds=60.0), solver=make_solver(name, restarts=5)).solve()
    assert outcome(quiet) == outcome(traced) == outcome(sliced)
    assert [row.iteration for row in traced.trace] == list(range(1, traced.iterations + 1))


@methods
def test_frozen_joints_and_joints_that_do_not_matter_stay(name):
    text = links([ELBOW, ELBOW.replace("elbow", "wrist")], [0.4, 0.3])
    branch = '<body pos="0 0 0.2"><joint name="lamp" axis="0 1 0" range="-1 1"/><geom size="0.01"/></body>'
    robot = of_xml(text + branch)
    q = np.array([0.4, 0.6, 0.7])
    goal = PositionGoal(None, robot.forward([0.9, 1.2, 0.0]).position)
    solution = Problem(robot, goal, solver=name).solve(q)
    assert solution.converged and solution.q[2] == 0.7


# ------------------------------------------------------------------------------ degenerate geometry


def sound(name: str, robot: Robot, position, start=None, **options):
    solution = Problem(robot, PositionGoal(None, position), tolerance=TOLERANCE, solver=make_solver(name, **options)).solve(start)
    assert np.isfinite(solution.q).all()
    assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
    return solution


@methods
@pytest.mark.parametrize("n", range(1, 6))
def test_a_straight_chain_reaches_targets_on_its_own_line(name, n):
    """Aiming vectors are collinear: the axis of a rotation, and the side to bend to, are undefined."""
    robot = rik.make_chain(n)
    for height in (n, -n, n - 0.5, 0.5 - n, 0.3, -0.3):
        solution = sound(name, robot, (0.0, 0.0, height), restarts=0)
        if n > 1 or abs(height) == n:
            assert solution.converged, height


@methods
@pytest.mark.parametrize("n", range(1, 6))
def test_a_target_at_the_root_is_reached_by_all_chains_but_a_single_link(name, n):
    robot = rik.make_chain(n)
    for start in (None, robot.sample(np.random.default_rng(n))):
        assert sound(name, robot, (0.0, 0.0, 0.0), start, restarts=0).converged == (n > 1)


@methods
def test_bones_of_no_length_are_no_bones(name):
    ball = '<joint name="b{}" type="ball"/>'
    robot = of_xml(links([ball.format(i) for i in range(5)], [0.0, 0.4, 0.0, 0.3, 0.0]))
    for position in [*targets(robot, 5), np.array([0.7, 0.0, 0.0]), np.array([0.0, 0.69, 0.0])]:
        assert sound(name, robot, position, robot.sample(np.random.default_rng(0)), restarts=0).converged
    still = of_xml(links([ball.format(i) for i in range(2)], [0.0, 0.0]))
    assert not sound(name, still, (0.1, 0.0, 0.0)).converged


@methods
def test_a_planar_arm_meets_targets_beside_its_plane_and_on_its_axes(name):
    robot = robot_named("planar")
    for position in [(0.5, 0.3, 0.1), (0.0, 0.0, 0.0), (0.0, 0.0, 0.4), (1.1, 0.0, 0.0), (-1.1, 0.0, 0.0)]:
        sound(name, robot, position, np.zeros(3))


@methods
def test_a_frame_that_nothing_moves(name):
    robot = of_xml(links([ELBOW], [0.4]) + '<site name="nail" pos="0.3 0.3 0"/>')
    there = Problem(robot, PositionGoal("nail", (0.3, 0.3, 0.0)), solver=name).solve()
    assert there.converged and there.iterations == 0
    never = Problem(robot, PositionGoal("nail", (0.5, 0.3, 0.0)), solver=name).solve()
    assert not never.converged and np.array_equal(never.q, robot.home)


# ------------------------------------------------------------------------------ refusals


@methods
def test_what_cannot_be_served_is_refused_with_the_methods_that_can(name):
    robot = robot_named("puma560")
    with pytest.raises(UnsupportedGoalError, match=rf"{name}.*orientation goal") as caught:
        Problem(robot, OrientationGoal(None, (1, 0, 0, 0)), solver=name).solve()
    assert "lm" in caught.value.able and name not in caught.value.able
    rotated = PoseGoal(None, (0.4, 0, 0.8), position_weight=0.0)
    with pytest.raises(UnsupportedGoalError, match="pose goal"):
        Problem(robot, rotated, solver=name).solve()


@pytest.mark.parametrize("name", ["triangulation", "recursive"])
def test_one_chain_one_position_only(name):
    robot = robot_named("puma560")
    goal = PositionGoal(None, (0.4, 0.0, 0.8))
    with pytest.raises(UnsupportedGoalError, match="several goals"):
        Problem(robot, [goal, PositionGoal("flange", (0.4, 0.0, 0.7))], solver=name).solve()
    with pytest.raises(UnsupportedGoalError, match="pose goal") as caught:
        Problem(robot, PoseGoal(None, (0.4, 0, 0.8)), solver=name).solve()
    assert "fabrik" in caught.value.able
    rail = of_xml(links(['<joint name="rail" type="slide" axis="1 0 0" range="0 1"/>', ELBOW], [0.1, 0.3]))
    with pytest.raises(UnsupportedJointError, match="slide joint 'rail'"):
        Problem(rail, PositionGoal(None, (0.4, 0.0, 0.0)), solver=name).solve()
