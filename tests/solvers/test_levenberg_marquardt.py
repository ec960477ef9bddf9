"""Levenberg-Marquardt: stride, wrapping around, the best of several draws, and the hot loop."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from robot_ik.bench.methods.growth import hinge_chain
from robot_ik.budget import Budget
from robot_ik.errors import InvalidGoalError, ModelError, UnsupportedGoalError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import make_solver
from tests.solvers.law_cases import supported_problem

# A lift, and on it a wrist with a range of nearly two revolutions; home is at one end of them.
ROUND = """<mujoco model="round"><compiler angle="radian"/><worldbody>
<body name="lift"><joint name="lift" type="slide" axis="0 0 1" range="0 1"/><geom size="0.02"/>
 <body name="hand"><joint name="wrist" axis="0 0 1" range="{low} {high}"/><geom size="0.02"/>
  <site name="tool" pos="0.3 0 0"/></body></body>
</worldbody><keyframe><key name="home" qpos="0 3.1"/></keyframe></mujoco>"""


def arm(tmp_path, low, high):
    path = tmp_path / "round.xml"
    path.write_text(ROUND.format(low=low, high=high))
    return load_robot(path)


@pytest.mark.parametrize(("low", "goal_angle", "wraps"), [(-3.4, -2.9, True), (-2.0, -1.9, False)])
def test_a_joint_with_a_full_turn_wraps_around_in_restarts(tmp_path, low, goal_angle, wraps):
    robot = arm(tmp_path, low, 3.2)
    goal = PoseGoal.at("tool", robot.forward([0.4, goal_angle], "tool"))
    # The shortest rotation from home to the goal exceeds the limit.
    stuck = Problem(robot, goal, budget=Budget(restarts=0), solver="lm").solve()
    assert not stuck.converged and stuck.q[1] == pytest.approx(3.2)
    # The result must not depend on the random start if the joint may wrap around.
    once = [
        Problem(
            robot, goal, budget=Budget(restarts=1), seed=seed, solver=make_solver("lm", draws=1)
        ).solve()
        for seed in range(20)
    ]
    assert all(low <= solution.q[1] <= 3.2 for solution in once)
    assert all(solution.converged for solution in once) == wraps


@pytest.mark.parametrize("stride", [0.05, 0.3])
def test_no_joint_moves_more_than_the_stride(near_problems, one_step, stride):
    lengths = []
    for problem, q in near_problems("puma560", "pose", distance=0.6):
        lengths.append(np.abs(one_step(make_solver("lm", stride=stride), problem, q)).max())
    assert max(lengths) == pytest.approx(stride, rel=1e-9)


@pytest.mark.parametrize("kind", ["position", "pose"])
@pytest.mark.parametrize("alternative", [False, True])
def test_the_options_of_every_jacobian_method(
    near_problems, linear_model, one_step, kind, alternative
):
    clamped_one = False
    for problem, q in near_problems("puma560", kind, distance=0.3):
        jacobian, e = linear_model(problem, q, alternative=alternative)
        size = np.linalg.norm(e)
        wanted = e * min(1.0, 0.2 / size)
        clamped_one = clamped_one or size > 0.2
        damped = jacobian.T @ jacobian + 0.5 * (0.5 * size**2) * np.eye(jacobian.shape[1])
        solver = make_solver(
            "lm", clamp=0.2, gain=0.5, alternative=alternative, damping=0.5, floor=0.0, stride=100
        )
        step = one_step(solver, problem, q)
        np.testing.assert_allclose(
            step, 0.5 * np.linalg.solve(damped, jacobian.T @ wanted), atol=1e-9
        )
    assert clamped_one


def test_these_options_are_refused_with_priorities(robots):
    robot = robots("puma560")
    goals = [
        PositionGoal(None, (0.4, 0.1, 0.3)),
        PositionGoal("flange", (0.4, 0.1, 0.3), priority=1),
    ]
    assert supported_problem(robot, goals, solver="lm") is not None
    with pytest.raises(UnsupportedGoalError, match="with clamp"):
        Problem(robot, goals, solver=make_solver("lm", gain=0.5)).solve()


def test_more_draws_need_fewer_restarts(robots, reachable):
    robot = robots("puma560")
    pose = robot.forward(robot.home)
    tolerance = Tolerance(1e-6, 1e-6)
    restarts = {}
    for draws in (1, 8):
        problem = Problem(robot, pose, solver="lm", draws=draws, tolerance=tolerance)
        solutions = [problem.solve(target=robot.forward(q)) for q in reachable(robot, 100)]
        restarts[draws] = sum(solution.restarts for solution in solutions)
    assert restarts[8] < 0.8 * restarts[1]


@pytest.mark.parametrize("name", ["lm", "auto"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_start_that_is_not_finite_is_refused(robots, name, wrong):
    robot = robots("puma560")
    problem = Problem(robot, PoseGoal.at(None, robot.forward(robot.home)), solver=name)
    start = robot.home.copy()
    start[3] = wrong
    with pytest.raises(ModelError, match="finite"):
        problem.solve(start)
    assert problem.solve(robot.home).converged


def targets(problem):
    """The targets (g, 4, 4) that the kernels read."""
    return problem.search.arrays["target"].reshape(-1, 4, 4).copy()


def test_matrices_of_all_memory_layouts_move_a_target_equally(robots, reachable):
    robot = robots("puma560")
    problem = Problem(robot, PoseGoal.at(None, robot.forward(robot.home)))
    matrix = robot.forward(reachable(robot, 1)[0]).matrix
    for same in (
        matrix,
        np.asfortranarray(matrix),
        matrix.tolist(),
        np.kron(matrix, np.ones((2, 2)))[::2, ::2],
    ):
        problem.retarget(robot.forward(robot.home))
        problem.retarget(same)
        np.testing.assert_allclose(targets(problem)[0], matrix, atol=1e-15)
    problem.retarget(matrix.astype(np.float32))
    np.testing.assert_allclose(targets(problem)[0], matrix, atol=1e-6)
    for wrong in (np.nan, np.inf):
        broken = matrix.copy()
        broken[1, 2] = wrong
        with pytest.raises(InvalidGoalError, match="finite"):
            problem.retarget(broken)


def test_each_goal_is_moved_by_its_own_index(robots, reachable):
    robot = robots("puma560")
    goals = [PoseGoal.at(None, robot.forward(robot.home)), PositionGoal(None, (0.1, 0.2, 0.3))]
    problem = Problem(robot, goals)
    matrix = robot.forward(reachable(robot, 1)[0]).matrix
    problem.retarget(matrix, 1)
    np.testing.assert_array_equal(targets(problem)[1, :3, 3], matrix[:3, 3])
    np.testing.assert_allclose(targets(problem)[0], goals[0].target.matrix)
    for wrong in (2, -1, True, "gripper"):
        with pytest.raises(InvalidGoalError, match="no goal"):
            problem.retarget(matrix, wrong)


def test_an_unreachable_target_stays_unreachable_in_later_solves(robots):
    robot = robots("puma560")
    goal_angle = robot.forward(robot.home).matrix
    far = robot.forward(robot.home).matrix
    far[:3, 3] = 3.0, 1.0, 1.0
    for name in ("lm", "auto", "dls"):
        problem = Problem(robot, robot.forward(robot.home), solver=name)
        for matrix, status in ((far, Status.UNREACHABLE), (goal_angle, Status.CONVERGED)) * 2:
            problem.retarget(matrix)
            assert problem.solve().status is status


def test_steps_of_the_systems_of_rows_and_columns_are_the_same():
    """A pose as two goals of half weight has more rows than joints, and the same solution."""
    robot = load_robot("panda")
    rng = np.random.default_rng(1)
    half = 0.5**0.5
    taken_back = 0
    for _ in range(20):
        pose = robot.forward(robot.sample(rng))
        share = replace(PoseGoal.at(None, pose), position_weight=half, angle_weight=half)
        costs = [
            [
                step.cost
                for step in solve(
                    robot, goals, solver="lm", trace=True, budget=Budget(restarts=0, iterations=8)
                ).trace
            ]
            for goals in (PoseGoal.at(None, pose), [share, share])
        ]
        np.testing.assert_allclose(*costs, rtol=1e-6, atol=1e-18)
        taken_back += sum(later > earlier for earlier, later in pairwise(costs[0][:-1]))
    assert taken_back > 5  # the step after an undone step starts at the last accepted point


def test_positions_of_all_types_move_a_target_equally():
    robot = load_robot("puma560")
    position = robot.forward(robot.home).position
    for goal in (PositionGoal(None, (0.0, 0.0, 0.0)), PoseGoal(None, (0.0, 0.0, 0.0))):
        problem = Problem(robot, [goal, goal])
        rotations = targets(problem)[:, :3, :3]
        for same in (
            position,
            position.tolist(),
            np.repeat(position, 2)[::2],
            position.astype(np.float32),
        ):
            problem.retarget((0.0, 0.0, 0.0), 1)
            problem.retarget(same, 1)
            np.testing.assert_allclose(targets(problem)[1, :3, 3], position, rtol=1e-6)
            assert not targets(problem)[0, :3, 3].any()
        for wrong in ((np.nan, 0, 0), (0, np.inf, 0)):
            with pytest.raises(InvalidGoalError, match="finite"):
                problem.retarget(np.array(wrong, dtype=float), 1)
        np.testing.assert_allclose(targets(problem)[1, :3, 3], position, rtol=1e-6)
        np.testing.assert_array_equal(targets(problem)[:, :3, :3], rotations)
    with pytest.raises(InvalidGoalError, match="no position"):
        Problem(robot, OrientationGoal(None, (1, 0, 0, 0))).retarget(position)


def test_the_polish_of_a_long_chain_does_not_cost_the_cube_of_its_joints():
    times = {}
    for joints in (50, 200):
        robot = hinge_chain(joints)
        goal = PoseGoal("tip", (2.6, 0, 0))
        never = Problem(robot, goal, solver="lm", budget=Budget(iterations=40, restarts=0))
        steps = []
        for _ in range(5):
            solution = never.solve()
            assert solution.status is Status.UNREACHABLE
            steps.append(solution.seconds / solution.iterations)
        times[joints] = min(steps)
    assert times[200] < 16 * times[50]
