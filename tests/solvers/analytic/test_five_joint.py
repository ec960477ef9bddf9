"""Five joints: exact position, best orientation, proofs, against MuJoCo and other methods."""

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

import robot_ik as rik
from robot_ik.errors import InvalidGoalError, NotConvergedError
from robot_ik.geometry import quat_multiply, rotation_exp
from tests.five_joint_arms import NAMES, SO101, arm_joints, load, random_pose

GAP = np.radians(0.0091)
EXACT_POSITION = 1e-6
arms = pytest.mark.parametrize("name", NAMES)
free_axes = pytest.mark.parametrize("free_axis", [None, "z", (0.6, 0.0, 0.8)])


def best_goal(pose, **options):
    return rik.PoseGoal(None, pose.position, pose.wxyz, orientation="best", **options)


def configurations_at(robot, position, rng, count):
    """Yield joint angles inside the limits with the tool at a position, from random starts."""
    goal = rik.PositionGoal(None, position)
    problem = rik.Problem(robot, goal, solver="lm", tolerance=rik.Tolerance(position=1e-9))
    for _ in range(count):
        solution = problem.solve(robot.sample(rng))
        if solution.converged:
            yield solution.q


@free_axes
@arms
def test_no_other_method_finds_a_better_orientation(name, free_axis):
    robot = load(name)
    rng = np.random.default_rng(0)
    for _ in range(12):
        pose = random_pose(robot, rng)
        goal = best_goal(pose, free_axis=free_axis)
        solution = rik.solve(robot, goal)
        assert solution.converged and solution.solver == "analytic"
        assert solution.error.position < EXACT_POSITION
        assert -1e-9 < solution.error.angle - solution.angle_bound < GAP
        assert (robot.lower <= solution.q).all() and (solution.q <= robot.upper).all()
        others = rik.Problem(robot, goal, solver="lm")
        for q in configurations_at(robot, pose.position, rng, 8):
            # The tolerance is 0.1 mm and the bound is for the exact position, so it needs a margin.
            better = others.solve(q)
            if better.error.position < EXACT_POSITION:
                assert better.error.angle > solution.angle_bound - 1e-4
            assert goal.error(robot, q)[1] > solution.angle_bound - 1e-5


@arms
def test_reachable_poses_are_reached(name):
    robot = load(name)
    rng = np.random.default_rng(1)
    for k in range(100):
        q = robot.sample(rng)
        if k % 3 == 0:  # on the border of the workspace
            joint = rng.choice(arm_joints(robot), 2, replace=False)
            q[joint] = np.where(rng.random(2) < 0.5, robot.lower[joint], robot.upper[joint])
        pose = robot.forward(q)
        exact = rik.solve(robot, pose)
        assert exact.converged, (exact, exact.error)
        best = rik.solve(robot, best_goal(pose))
        assert best.converged and best.error.position < EXACT_POSITION
        assert best.error.angle < np.radians(0.1)
        assert best.angle_bound < GAP


@arms
def test_a_pose_that_cannot_be_reached_keeps_the_position(name):
    robot = load(name)
    rng = np.random.default_rng(2)
    pose = random_pose(robot, rng)
    plain = rik.solve(robot, pose)
    best = rik.solve(robot, best_goal(pose))
    assert plain.status is rik.Status.UNREACHABLE
    assert plain.error.position < EXACT_POSITION
    np.testing.assert_array_equal(plain.q, best.q)
    degrees = f"{np.degrees(plain.error.angle):.1f}°"
    sentence = (
        f"position reached; the orientation error of {degrees} "
        "is the smallest possible for this arm"
    )
    assert plain.meaning == sentence
    with pytest.raises(NotConvergedError, match=sentence):
        plain.require()


@arms
def test_a_best_goal_equals_goals_of_two_priorities(name):
    robot = load(name)
    rng = np.random.default_rng(3)
    pose = random_pose(robot, rng)
    best = rik.solve(robot, best_goal(pose))
    position = rik.PositionGoal(None, pose.position)
    for options in ({"soft": True}, {"priority": 1}):
        orientation = rik.OrientationGoal(None, pose.wxyz, **options)
        for goals in ([position, orientation], [orientation, position]):
            solution = rik.solve(robot, goals)
            np.testing.assert_array_equal(solution.q, best.q)
            assert solution.angle_bound == best.angle_bound
            assert solution.converged == ("soft" in options)


@arms
def test_a_position_out_of_reach_is_proven_and_the_nearest_is_kept(name):
    robot = load(name)
    rng = np.random.default_rng(4)
    center, radius = robot.reach()
    joints = arm_joints(robot)
    checked = 0
    while checked < 8:
        direction = rng.normal(size=3)
        position = center + direction * radius * rng.uniform(0.3, 1.4) / np.linalg.norm(direction)
        goal = best_goal(rik.Pose(position, rng.normal(size=4)))
        solution = rik.solve(robot, goal)
        if solution.converged:
            continue
        checked += 1
        assert solution.status is rik.Status.UNREACHABLE
        assert "out of reach" in solution.meaning
        # From a start near the goal ``auto`` tries lm first.
        plain = rik.solve(robot, goal.target, start=solution.q)
        assert plain.status is rik.Status.UNREACHABLE
        assert plain.error.position < solution.error.position + 1e-5
        for _ in range(6):
            q = robot.sample(rng)

            def residual(part, q=q, position=position):
                moved = q.copy()
                moved[joints] = part
                return np.asarray(robot.measure(moved).position) - position

            found = least_squares(
                residual, q[joints], bounds=(robot.lower[joints], robot.upper[joints])
            )
            assert solution.error.position < np.linalg.norm(found.fun) + 2e-6


@pytest.mark.parametrize("tolerance", [rik.Tolerance(1e-4, 1e-3), rik.Tolerance(1e-2, 5e-2)])
@arms
def test_a_goal_within_tolerance_of_a_reachable_pose_is_not_unreachable(name, tolerance):
    robot = load(name)
    rng = np.random.default_rng(5)
    problem = rik.Problem(robot, rik.Pose(), tolerance=tolerance, solver="analytic")
    for k in range(200):
        q = robot.sample(rng)
        if k % 2:
            joint = rng.choice(arm_joints(robot), 2, replace=False)
            q[joint] = np.where(rng.random(2) < 0.5, robot.lower[joint], robot.upper[joint])
        pose = robot.forward(q)
        shift, turn = rng.normal(size=(2, 3))
        shift *= 0.999 * tolerance.position / np.linalg.norm(shift)
        turn *= 0.999 * tolerance.angle / np.linalg.norm(turn)
        wxyz = quat_multiply(rotation_exp(turn), pose.wxyz)
        target = rik.Pose(np.array(pose.position) + shift, wxyz)
        assert problem.solve(target=target).status is not rik.Status.UNREACHABLE


@pytest.mark.parametrize("tool", ["marker", "on_roll_axis"])
def test_the_closed_form_supports_any_tool_frame(tool):
    robot = load("so101", tool)
    rng = np.random.default_rng(6)
    for _ in range(20):
        pose = random_pose(robot, rng)
        solution = rik.solve(robot, best_goal(pose))
        assert solution.converged and solution.error.position < EXACT_POSITION
        assert solution.error.angle - solution.angle_bound < GAP


def test_over_the_pan_axis_with_the_tool_on_the_roll_axis_a_solution_is_found_without_proof():
    text = """<mujoco><compiler angle="radian"/><worldbody><body>
    <joint axis="0 0 1" range="-2 2"/><geom size="0.01"/><body pos="0 0 0.1">
    <joint axis="0 1 0" range="-2 2"/><geom size="0.01"/><body pos="0 0 0.2">
    <joint axis="0 1 0" range="-2 2"/><geom size="0.01"/><body pos="0 0 0.2">
    <joint axis="0 1 0" range="-2 2"/><geom size="0.01"/><body pos="0 0 0.05">
    <joint axis="0 0 1" range="-3 3"/><geom size="0.01"/><site name="tool" pos="0 0 0.05"/>
    </body></body></body></body></body></worldbody></mujoco>"""
    robot = rik.load_robot(text, tool="tool")
    solution = rik.solve(robot, best_goal(rik.Pose((0.0, 0.0, 0.45), (0.9, 0.1, 0.3, 0.2))))
    assert solution.converged and solution.angle_bound is None


def test_the_closest_tool_axis_of_an_arm_without_limits_is_in_the_arm_plane():
    text = SO101.replace('range="-1.', 'limited="false" range="-1.').replace(
        'range="-2.', 'limited="false" range="-2.'
    )
    robot = rik.load_robot(text, tool="on_roll_axis")
    rng = np.random.default_rng(7)
    for _ in range(30):
        pose = random_pose(robot, rng)
        solution = rik.solve(robot, best_goal(pose, free_axis="z"))
        across = np.array(pose.position) - (0.0388353, 0.0, 0.0)
        if np.hypot(across[0], across[1]) < 0.05:
            continue
        normal = np.cross(across, (0.0, 0.0, 1.0))
        # The arm plane is beside the pan axis by less than a millimetre.
        expected = abs(np.arcsin(normal @ pose.rotation[:, 2] / np.linalg.norm(normal)))
        assert solution.error.angle > expected - 0.01


@arms
def test_solve_all_returns_the_optimum_of_each_branch(name):
    robot = load(name)
    rng = np.random.default_rng(8)
    for _ in range(10):
        goal = best_goal(random_pose(robot, rng))
        branches = rik.solve_all(robot, goal)
        assert 1 <= len(branches) <= 4
        assert len({branch.name for branch in branches}) == len(branches)
        best = rik.solve(robot, goal)
        assert abs(branches[0].angle - best.error.angle) < GAP
        for branch in branches:
            position, angle = goal.error(robot, branch.q)
            assert position < 5e-6 and branch.inside
            assert abs(angle - branch.angle) < 1e-4
            assert branch.angle - branch.angle_bound < GAP
        for first, second in itertools.pairwise(branches):
            assert first.angle < second.angle + 2e-4


@pytest.mark.parametrize("orientation", ["exact", "best"])
@arms
def test_a_batch_equals_single_solves(name, orientation):
    robot = load(name)
    rng = np.random.default_rng(9)
    poses = [random_pose(robot, rng) for _ in range(20)]
    poses += [robot.forward(robot.sample(rng)) for _ in range(5)]
    poses.append(rik.Pose((2.0, 0.0, 0.0)))
    batch = rik.solve_batch(robot, poses, orientation=orientation)
    for row, pose in enumerate(poses):
        goal = rik.PoseGoal(None, pose.position, pose.wxyz, orientation=orientation)
        single = rik.solve(robot, goal)
        assert single.status == batch.status[row]
        np.testing.assert_allclose(batch.q[row], single.q, atol=1e-12)
        assert abs(batch.angle_error[row] - single.error.angle) < 1e-7
        if single.angle_bound is None:
            assert np.isnan(batch.angle_bound[row])
        else:
            assert abs(batch.angle_bound[row] - single.angle_bound) < 1e-12


@arms
def test_tracking_stays_on_its_branch(name):
    robot = load(name)
    rng = np.random.default_rng(10)
    problem = rik.Problem(robot, best_goal(rik.Pose()), keep_branch=True)
    kept = 0
    for _ in range(10):
        pose = random_pose(robot, rng)
        goal = best_goal(pose)
        branches = rik.solve_all(robot, goal)
        for branch in branches:
            solution = problem.solve(branch.q, target=pose)
            assert solution.converged
            step = np.abs(solution.q - branch.q).max()
            kept += step < 0.05
            assert solution.error.position < EXACT_POSITION
            assert abs(solution.error.angle - branch.angle) < 0.01
    assert kept >= 10


@arms
def test_tracking_out_of_reach_settles_at_the_nearest_position(name):
    robot = load(name)
    rng = np.random.default_rng(17)
    problem = rik.Problem(robot, best_goal(rik.Pose()), keep_branch=True)
    center, radius = robot.reach()
    for _ in range(3):
        inside = random_pose(robot, rng)
        outwards = np.array(inside.position) - center
        outwards /= np.linalg.norm(outwards)
        far = rik.Pose(center + 1.3 * radius * outwards, inside.wxyz)
        q = problem.solve(target=inside).q
        for s in np.linspace(0.0, 1.0, 150):
            position = (1.0 - s) * np.array(inside.position) + s * np.array(far.position)
            solution = problem.solve(q, target=rik.Pose(position, inside.wxyz))
            q = solution.q
        assert solution.status is rik.Status.UNREACHABLE
        nearest = rik.solve(robot, best_goal(far))
        assert solution.error.position < nearest.error.position + 1e-4
        again = problem.solve(q, target=far)
        assert np.abs(again.q - q).max() < 1e-3


def test_follow_reports_a_better_branch():
    robot = load("koch_v11")
    rng = np.random.default_rng(11)
    while True:
        goal = best_goal(random_pose(robot, rng))
        branches = rik.solve_all(robot, goal)
        if len(branches) > 1 and branches[-1].angle > branches[0].angle + np.radians(5.0):
            break
    worst = branches[-1]
    commands = []

    class Sink:
        def send(self, q, now):
            commands.append(q)

    class Source:
        def poll(self, now):
            return goal

    report = rik.follow(
        robot, Source(), sinks=[Sink()], start=worst.q, duration=0.1, clock=rik.VirtualClock()
    )
    assert np.abs(np.array(commands) - worst.q).max() < 0.05
    assert report.better.error.angle < worst.angle - np.radians(1.0)


def test_a_joint_that_does_not_move_the_tool_keeps_its_value():
    robot = load("so101")
    rng = np.random.default_rng(12)
    start = robot.home.copy()
    start[5] = 0.7
    solution = rik.solve(robot, best_goal(random_pose(robot, rng)), start=start)
    assert solution.q[5] == 0.7


def test_a_start_at_the_goal_takes_no_iteration():
    robot = load("omx_f")
    rng = np.random.default_rng(13)
    q = robot.sample(rng)
    for orientation in ("exact", "best"):
        pose = robot.forward(q)
        goal = rik.PoseGoal(None, pose.position, pose.wxyz, orientation=orientation)
        solution = rik.solve(robot, goal, start=q)
        assert solution.converged and solution.iterations == 0
        np.testing.assert_array_equal(solution.q, q)


def test_the_same_call_gives_equal_bits():
    robot = load("so101")
    rng = np.random.default_rng(14)
    goals = [best_goal(random_pose(robot, rng)) for _ in range(5)]
    first = [rik.solve(robot, goal).q for goal in goals]
    second = [rik.solve(robot, goal).q for goal in goals]
    np.testing.assert_array_equal(first, second)


def test_arms_of_other_geometries_have_no_closed_form():
    text = SO101.replace('quat="0.5 -0.5 -0.5 -0.5"', 'quat="0.5 -0.5 -0.4 -0.5"')
    robot = rik.load_robot(text, tool="gripper")
    solution = rik.solve(robot, best_goal(robot.forward(robot.home)))
    assert solution.converged and solution.angle_bound is None


def test_six_joints_take_the_best_orientation_too():
    robot = rik.load_robot("puma560")
    rng = np.random.default_rng(15)
    pose = robot.forward(robot.sample(rng))
    solution = rik.solve(robot, best_goal(pose))
    assert solution.converged
    assert solution.error.position < 1e-4 and solution.error.angle < 1e-2


def test_moving_the_target_of_a_best_goal_moves_both_parts():
    robot = load("so101")
    rng = np.random.default_rng(16)
    first = random_pose(robot, rng)
    second = random_pose(robot, rng)
    for options in ({}, {"free_axis": "x"}):
        problem = rik.Problem(robot, best_goal(first, **options))
        for target in (second, second.matrix, best_goal(second, **options)):
            moved = problem.solve(target=target)
            expected = rik.solve(robot, best_goal(second, **options))
            np.testing.assert_allclose(moved.q, expected.q, atol=1e-9)
            assert moved.goals[0].target.distance(second)[0] < 1e-12
            assert problem.goals[0].target.distance(second)[1] < 1e-7
            problem.retarget(first)


def test_another_orientation_is_refused():
    with pytest.raises(InvalidGoalError, match='"exact" or "best"'):
        rik.PoseGoal(None, (0, 0, 0), orientation="nearest")
    with pytest.raises(InvalidGoalError, match='"exact" or "best"'):
        rik.solve_batch(load("koch_v11"), [rik.Pose()], orientation=True)
