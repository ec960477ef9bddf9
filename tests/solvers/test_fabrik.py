"""fabrik: the paper's points on balls, hinges of arms, trees, goals out of reach, poses."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.budget import Budget
from robot_ik.goals import PoseGoal, PositionGoal, Tolerance
from robot_ik.problem import Problem
from robot_ik.solution import Status


def positions(robot, q, names):
    return np.array([robot.measure(q, name).position for name in names])


def textbook(points, target):
    """One pass of Aristidou & Lasenby's algorithm 1 on bare points (n + 1, 3)."""
    p = points.copy()
    length = np.linalg.norm(np.diff(p, axis=0), axis=1)
    root = p[0].copy()
    p[-1] = target
    for i in reversed(range(len(length))):
        p[i] = p[i + 1] + length[i] * (p[i] - p[i + 1]) / np.linalg.norm(p[i] - p[i + 1])
    p[0] = root
    for i in range(len(length)):
        p[i + 1] = p[i] + length[i] * (p[i + 1] - p[i]) / np.linalg.norm(p[i + 1] - p[i])
    return p


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_on_unlimited_balls_each_pass_equals_that_of_the_paper(n):
    robot = rik.make_chain(n)
    names = [f"link{i}" for i in range(1, n + 1)] + ["tip"]
    rng = np.random.default_rng(n)
    compared = 0
    for _ in range(10):
        start = robot.sample(rng)
        target = rng.normal(size=3) * n / 4
        points = positions(robot, start, names)
        for passes in (1, 2, 3):
            points = textbook(points, target)
            # This is the last pass, not the best.
            problem = Problem(
                robot,
                PositionGoal(None, target),
                solver="fabrik",
                tolerance=Tolerance(1e-12, 1e-12),
                budget=Budget(iterations=passes),
                trace=True,
            )
            solution = problem.solve(start)
            if len(solution.trace) < passes:
                break
            error = np.linalg.norm(points[-1] - target)
            assert solution.trace[-1].position == pytest.approx(error, abs=1e-9)
            # The result is the best pass: mostly the last, whose points can then be compared.
            if error <= min(step.position for step in solution.trace) + 1e-12:
                np.testing.assert_allclose(positions(robot, solution.q, names), points, atol=1e-8)
                compared += 1
    assert compared >= 10


@pytest.mark.parametrize("n", range(2, 11))
def test_balls_reach_all_targets_in_reach_and_stretch_towards_others(n):
    robot = rik.make_chain(n, 0.5)
    rng = np.random.default_rng(n)
    for reach in rng.uniform(0.02, 0.98, 6):
        direction = rng.normal(size=3)
        target = direction / np.linalg.norm(direction) * reach * 0.5 * n
        problem = Problem(robot, PositionGoal(None, target), solver="fabrik")
        solution = problem.solve(robot.sample(rng))
        assert solution.converged and solution.restarts == 0
        far = target / reach * 1.3
        beyond = problem.solve(robot.sample(rng), target=far)
        assert beyond.status is Status.UNREACHABLE
        assert beyond.error.position == pytest.approx(0.3 * 0.5 * n, abs=1e-9)
        tip = robot.measure(beyond.q).position
        np.testing.assert_allclose(tip, far / 1.3, atol=1e-9)


@pytest.mark.parametrize("n", [3, 6])
def test_the_last_ball_takes_the_orientation(n):
    robot = rik.make_chain(n)
    rng = np.random.default_rng(n)
    tried = 0
    while tried < 8:
        pose = robot.forward(robot.sample(rng))
        start = robot.sample(rng)
        if np.linalg.norm(pose.position - pose.rotation[:, 2]) > 0.97 * (n - 1):
            continue  # nearly stretched: hundreds of passes
        tolerance = Tolerance(1e-6, 1e-6)
        problem = Problem(robot, PoseGoal.at(None, pose), solver="fabrik", tolerance=tolerance)
        solution = problem.solve(start)
        assert solution.converged and solution.restarts == 0
        tried += 1


def test_a_half_turn_of_the_last_link_is_solved():
    robot = rik.make_chain(3)
    goal = PoseGoal(None, (0.5, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0))
    assert Problem(robot, goal, solver="fabrik", budget=Budget(restarts=0)).solve().converged


Y = """<mujoco><compiler angle="radian"/><worldbody>
<body name="trunk"><joint type="ball"/><geom size="0.05"/>
 <body name="chest" pos="0 0 0.5"><joint name="waist" type="ball" range="0 0.9" limited="true"/>
  <geom size="0.05"/>
  <body name="left1" pos="0 0.2 0.3"><joint type="ball"/><geom size="0.05"/>
   <body name="left2" pos="0 0.3 0"><joint axis="0 0 1" range="-0.2 2.4"/><geom size="0.05"/>
    <site name="left" pos="0 0.3 0"/></body></body>
  <body name="right1" pos="0 -0.2 0.3"><joint type="ball"/><geom size="0.05"/>
   <body name="right2" pos="0 -0.3 0"><joint axis="0 0 1" range="-2.4 0.2"/><geom size="0.05"/>
    <site name="right" pos="0 -0.3 0"/></body></body>
</body></body></worldbody></mujoco>"""


def test_a_tree_meets_several_goals_through_its_sub_base():
    robot = rik.load_robot(Y, tool="left")
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(20):
        q = robot.sample(rng)
        goals = [PositionGoal(side, robot.forward(q, side).position) for side in ("left", "right")]
        solution = Problem(robot, goals, solver="fabrik").solve()
        assert np.abs(robot.clip(solution.q) - solution.q).max() < 1e-12
        assert solution.converged == (max(m.position for m in solution.errors) <= 1e-4)
        solved += solution.converged
    assert solved >= 18, solved


def test_a_goal_that_weighs_more_is_nearer_when_both_cannot_be_met():
    robot = rik.load_robot(Y, tool="left")
    errors = []
    for weight in (0.1, 10.0):
        goals = [
            PositionGoal("left", (0.0, 2.0, 0.5), weight=weight),
            PositionGoal("right", (0.0, -2.0, 0.5), weight=1.0),
        ]
        budget = Budget(restarts=0)
        solution = Problem(robot, goals, solver="fabrik", budget=budget).solve()
        assert not solution.converged
        errors.append(solution.errors[0].position)
    assert errors[1] < errors[0] - 0.05


def test_a_goal_out_of_reach_is_left_out_until_the_other_is_met():
    robot = rik.load_robot(Y, tool="left")
    rng = np.random.default_rng(0)
    far = np.array([0.0, -4.0, 1.0])
    for _ in range(5):
        left = PositionGoal("left", robot.forward(robot.sample(rng), "left").position)
        problem = Problem(robot, [left, PositionGoal("right", far)], solver="fabrik")
        solution = problem.solve()
        assert solution.status is Status.UNREACHABLE
        # In the end both count: the right hand is nearer than if it had no goal.
        alone = Problem(robot, left, solver="fabrik").solve()
        assert alone.converged
        distance = np.linalg.norm(robot.measure(alone.q, "right").position - far)
        assert solution.errors[1].position < distance - 0.01
        # A solve does not change the next solve.
        again = problem.solve()
        assert again.q.tobytes() == solution.q.tobytes()
        assert again.iterations == solution.iterations


def test_slides_and_floating_bases_move_too():
    slide = '<joint name="rail" type="slide" axis="1 0 0" range="-1 1"/>'
    rail = f"""<mujoco><worldbody><body name="car">{slide}<geom size="0.1"/>
     <body pos="0 0 0.1"><joint type="ball"/><geom size="0.1"/>
     <body pos="0 0 0.3"><joint type="ball"/><geom size="0.1"/><site name="tip" pos="0 0 0.3"/>
     </body></body></body></worldbody></mujoco>"""
    robot = rik.load_robot(rail, tool="tip")
    goal = PositionGoal(None, (1.2, 0.2, 0.3))
    solution = Problem(robot, goal, solver="fabrik").solve()
    assert solution.converged and -1.0 <= solution.q[0] <= 1.0
    floating = rail.replace(slide, "<freejoint/>")
    robot = rik.load_robot(floating, tool="tip")
    goals = [PositionGoal("tip", (3.0, 0.2, 0.3)), PositionGoal("car", (2.7, 0.0, 0.1))]
    assert Problem(robot, goals, solver="fabrik").solve().converged


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_solve_rate_on_the_puma(kind):
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(20)
    solved = 0
    for _ in range(40):
        pose = robot.forward(robot.sample(rng))
        goal = PositionGoal(None, pose.position) if kind == "position" else PoseGoal.at(None, pose)
        problem = Problem(robot, goal, solver="fabrik", tolerance=Tolerance(1e-5, 1e-4))
        solved += problem.solve().converged
    assert solved / 40 >= {"position": 0.95, "pose": 0.5}[kind], solved
