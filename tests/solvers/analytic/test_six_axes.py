"""Closed forms of random arms whose names and frames are arbitrary."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.branches import solve_all
from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers import make_solver

TIGHT = Tolerance(position=1e-6, angle=1e-6)
ARMS = ("spherical", "parallel", "shoulder", "crossed")


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def across(rng, axis):
    v = np.cross(axis, unit(rng))
    return v / np.linalg.norm(v)


def spherical_axes(rng):
    """Return six lines: 2 and 3 parallel or opposite, the last three through one point."""
    u = unit(rng)
    wrist = rng.normal(size=3)
    h = [unit(rng), u, u * rng.choice([-1, 1]), unit(rng), unit(rng), unit(rng)]
    p = [rng.normal(size=3) * 0.3, rng.normal(size=3) * 0.3, rng.normal(size=3) * 0.5]
    return h, [*p, *(wrist + axis * rng.normal() for axis in h[3:])]


def parallel_axes(rng):
    """Six lines: 2, 3 and 4 parallel, the last two meet."""
    u = unit(rng)
    h = [unit(rng), u, u * rng.choice([-1, 1]), u * rng.choice([-1, 1]), across(rng, u), unit(rng)]
    meet = rng.normal(size=3) * 0.4
    p = [rng.normal(size=3) * 0.4 for _ in range(4)]
    return h, [*p, meet + h[4] * rng.normal(), meet + h[5] * rng.normal()]


def crossed_axes(rng):
    """Six lines: the first three through one point, the last two through another."""
    shoulder = rng.normal(size=3) * 0.3
    wrist = shoulder + rng.normal(size=3)
    h = [unit(rng) for _ in range(6)]
    p = [shoulder + axis * rng.normal() for axis in h[:3]]
    return h, [*p, rng.normal(size=3) * 0.5, *(wrist + axis * rng.normal() for axis in h[4:])]


def axes_of(rng, family):
    """Directions and points of six axes; a spherical shoulder is a reversed spherical wrist."""
    if family == "crossed":
        return crossed_axes(rng)
    h, p = parallel_axes(rng) if family == "parallel" else spherical_axes(rng)
    return (h[::-1], p[::-1]) if family == "shoulder" else (h, p)


def arm_from_axes(rng, path, h, p, limit=None):
    """Write an MJCF with these joint axes. Names and frames of its bodies are arbitrary."""
    base = Pose(rng.normal(size=3), rng.normal(size=4))
    limits = "" if limit is None else f' limited="true" range="{-limit} {limit}"'
    text = ""
    world = Pose()
    for axis, point in zip(h, p, strict=True):
        body = Pose(rng.normal(size=3) * 0.2, rng.normal(size=4))
        local = world.inverse().compose(body)
        a = body.inverse().rotation @ axis
        x = body.inverse().apply(point)
        name = "".join(rng.choice(list("abcdefgh"), 12))
        text += (
            f'<body name="b_{name}" pos="{row(local.position)}" quat="{row(local.wxyz)}">'
            f'<joint name="j_{name}" axis="{row(a)}" pos="{row(x)}"{limits}/><geom size="0.01"/>'
        )
        world = body
    tool = Pose(rng.normal(size=3) * 0.2, rng.normal(size=4))
    text += (
        f'<site name="tool" pos="{row(tool.position)}" quat="{row(tool.wxyz)}"/>'
        + "</body>" * len(h)
    )
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><body pos="{row(base.position)}" '
        f'quat="{row(base.wxyz)}"><geom size="0.01"/>{text}</body></worldbody></mujoco>'
    )
    return load_robot(path)


def row(values):
    return " ".join(repr(float(v)) for v in values)


def random_arm(rng, tmp_path, family, **options):
    return arm_from_axes(rng, tmp_path / "arm.xml", *axes_of(rng, family), **options)


@pytest.mark.parametrize("family", ARMS)
@pytest.mark.parametrize("seed", range(8))
def test_every_branch_meets_the_goal_and_the_sampled_branch_is_listed(family, seed, tmp_path):
    rng = np.random.default_rng([seed, ARMS.index(family)])
    robot = random_arm(rng, tmp_path, family)
    for _ in range(6):
        q = rng.uniform(-np.pi, np.pi, 6)
        goal = PoseGoal.at("tool", robot.forward(q))
        found = solve_all(robot, goal, start=q)
        assert 1 <= len(found) <= 8
        for branch in found:
            assert max(robot.measure(branch.q, "tool").distance(goal.target)) < 1e-7
        assert np.abs(found[0].q - q).max() < 1e-6  # the nearest branch is the start
        distances = [np.sum((b.q - q) ** 2) for b in found]
        assert distances == sorted(distances)
        assert len({b.name for b in found}) == len(found)


@pytest.mark.parametrize("family", ARMS)
def test_a_geometry_with_a_millimetre_of_offset_is_not_recognised(family, tmp_path):
    rng = np.random.default_rng(5)
    h, p = axes_of(rng, family)
    moved = 0 if family == "shoulder" else 5
    p[moved] = p[moved] + 1e-3 * across(rng, h[moved])
    robot = arm_from_axes(rng, tmp_path / "arm.xml", h, p)
    goal = PoseGoal.at("tool", robot.forward(rng.uniform(-2, 2, 6)))
    with pytest.raises(UnsupportedGoalError, match="no closed form"):
        solve(robot, goal, solver="analytic")
    assert solve(robot, goal).solver == "lm"  # and auto does not need it


def test_goals_without_a_closed_form_are_refused_with_their_name():
    robot = load_robot("puma560")
    for goal in (OrientationGoal("gripper", (1, 0, 0, 0)), PositionGoal("gripper", (-0.4, 0, 0.8))):
        with pytest.raises(UnsupportedGoalError, match="lm"):
            solve(robot, goal, solver="analytic")
        assert solve(robot, goal).converged
    with pytest.raises(
        UnsupportedGoalError, match=r"its closed form is for one pose: give .*\n.*lm"
    ):
        solve(robot, goal, solver="analytic")
    with pytest.raises(
        UnsupportedGoalError, match="\nsolve_all supports two parallel hinges"
    ) as caught:
        solve_all(robot, goal)
    assert caught.value.able == ()


@pytest.mark.parametrize("robot_name", ["puma560", "ur5e"])
def test_exactly_singular_poses_are_solved_and_keep_the_free_angle(robot_name):
    robot = load_robot(robot_name)
    rng = np.random.default_rng(3)
    solver = make_solver("analytic")
    problem = Problem(
        robot, PoseGoal.at(None, robot.forward(robot.home)), tolerance=TIGHT, solver=solver
    )
    for _ in range(60):
        q = robot.sample(rng)
        q[4] = 0.0  # axes 4 and 6 in line (PUMA), axis 6 parallel to 2, 3 and 4 (UR)
        problem.retarget(robot.forward(q))
        assert problem.solve().converged
        near = problem.solve(q + 1e-3 * rng.normal(size=6))
        assert near.converged and np.abs(near.q - q).max() < 0.02


@pytest.mark.parametrize("off", [1e-9, 1e-7, 2e-7, 1e-6, 1e-5])
@pytest.mark.parametrize("robot_name", ["puma560", "ur5e"])
def test_next_to_a_singular_wrist_every_branch_meets_the_goal(robot_name, off):
    robot = load_robot(robot_name)
    rng = np.random.default_rng(7)
    for _ in range(40):
        q = robot.sample(rng)
        q[4] = off
        goal = PoseGoal.at(None, robot.forward(q))
        branches = solve_all(robot, goal, start=robot.sample(rng))
        assert branches
        assert max(max(goal.error(robot, branch.q)) for branch in branches) < 1e-6
        assert solve(robot, goal, solver="analytic", tolerance=TIGHT).converged


# Six hinges without offset at the shoulder: the wrist's centre can be on the first axis.
UPRIGHT = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint axis="0 0 1" range="-2 2"/><geom size="0.01"/>
<body pos="0 0 0.3"><joint axis="0 1 0" range="-1.5 1.5"/><geom size="0.01"/>
<body pos="0 0 0.4"><joint axis="0 1 0" range="-2.4 2.4"/><geom size="0.01"/>
<body pos="0 0 0.35"><joint axis="0 0 1" range="-1 1"/><joint axis="0 1 0" range="-1.2 1.2"/>
<joint axis="0 0 1" range="-2 2"/><geom size="0.01"/><site name="tip" pos="0.02 0 0.1"/>
</body></body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["ur5e", "upright"])
def test_a_free_angle_is_chosen_so_that_the_other_joints_keep_their_limits(name):
    robot = load_robot(UPRIGHT if name == "upright" else name)
    if name == "ur5e":
        robot = robot.with_limits([-3, -3, -2.5, -1.5, -2, -1.5], [3, 0, 2.5, 1.5, 2, 1.5])
    rng = np.random.default_rng(9)
    for _ in range(60):
        q = robot.sample(rng)
        if name == "ur5e":
            q[4] = 0.0  # axis 6 parallel to 2, 3 and 4
        else:
            # A triangle with one side on axis 1.
            height = rng.uniform(0.2, 0.7)
            q[1] = np.arccos((0.4**2 + height**2 - 0.35**2) / (0.8 * height))
            q[2] = -np.arctan2(0.4 * np.sin(q[1]), height - 0.4 * np.cos(q[1])) - q[1]
        q = robot.clip(q)
        goal = PoseGoal.at(None, robot.forward(q))
        start = robot.sample(rng)
        branches = solve_all(robot, goal, start=start)
        assert branches
        assert max(max(goal.error(robot, branch.q)) for branch in branches) < 1e-7
        solution = solve(robot, goal, solver="analytic", start=start, tolerance=TIGHT)
        assert solution.converged and np.abs(solution.q - branches[0].q).max() < 1e-6


def test_a_stretched_elbow_is_solved():
    robot = load_robot("puma560")
    rng = np.random.default_rng(4)
    stretched = np.arctan2(-0.0203, 0.4318) - np.pi / 2
    for _ in range(40):
        q = robot.sample(rng)
        q[2] = stretched
        solution = solve(
            robot, PoseGoal.at("gripper", robot.forward(q)), solver="analytic", tolerance=TIGHT
        )
        assert solution.converged, (q, solution)


def test_an_arm_stretched_to_the_limit_of_its_elbow_has_a_branch():
    elbow = 2
    rng = np.random.default_rng(5)
    free = load_robot("ur5e")
    lower = free.lower.copy()
    lower[elbow] = 0.0
    robot = free.with_limits(lower, free.upper)
    for _ in range(60):
        q = robot.sample(rng)
        q[elbow] = 0.0
        goal = PoseGoal.at(None, robot.forward(q))
        branches = solve_all(robot, goal, start=q)
        assert branches and not any(robot.outside(branch.q, 0.0) for branch in branches)
        errors = [goal.error(robot, branch.q) for branch in branches]
        assert np.max(errors) < 2e-6


def test_a_goal_with_all_branches_outside_the_limits_is_proven_and_approached(tmp_path):
    rng = np.random.default_rng(6)
    robot = random_arm(rng, tmp_path, "spherical", limit=0.4)
    beyond = np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    free = random_arm(np.random.default_rng(6), tmp_path, "spherical")
    goal = PoseGoal.at("tool", free.forward(beyond))
    assert solve_all(robot, goal) == ()
    assert len(solve_all(robot, goal, limits=False)) >= 1
    alone = solve(robot, goal, solver="analytic")
    assert alone.status is Status.UNREACHABLE and np.array_equal(alone.q, robot.home)
    nearest = solve(robot, goal)
    assert nearest.status is Status.UNREACHABLE
    assert nearest.errors[0].position < alone.errors[0].position and not robot.outside(nearest.q)


# Near the goal auto tries lm first, which ends within tolerance. The closed form is exact.
@pytest.mark.parametrize(("name", "off"), [("auto", 1e-4), ("analytic", 1e-6)])
def test_a_path_through_half_a_turn_does_not_jump(tmp_path, name, off):
    rng = np.random.default_rng(8)
    robot = random_arm(rng, tmp_path, "spherical", limit=6.2)
    q0 = rng.uniform(-0.5, 0.5, 6)
    problem = Problem(robot, PoseGoal.at("tool", robot.forward(q0)), tolerance=TIGHT, solver=name)
    _solver = make_solver(name)
    q = q0
    for t in np.linspace(0.0, 1.0, 400):
        wanted = q0 + t * np.array([5.0, 0.3, -0.3, 0.2, 0.2, 5.0])
        problem.retarget(robot.forward(wanted))
        solution = problem.solve(q)
        assert solution.converged and np.abs(solution.q - wanted).max() < off
        q = solution.q


@pytest.mark.parametrize("seed", range(4))
def test_two_links_in_a_plane_have_two_branches_and_none_off_the_plane(seed, tmp_path):
    rng = np.random.default_rng(seed)
    u = unit(rng)
    robot = arm_from_axes(
        rng,
        tmp_path / "arm.xml",
        [u, u * (-1) ** seed],
        [rng.normal(size=3) * 0.3] * 1 + [rng.normal(size=3)],
    )
    q = rng.uniform(-2, 2, 2)
    position = robot.forward(q, "tool").position
    found = solve_all(robot, PositionGoal("tool", position), start=q)
    assert len(found) == 2 and np.abs(found[0].q - q).max() < 1e-6
    for branch in found:
        assert np.linalg.norm(robot.measure(branch.q, "tool").position - position) < 1e-9
    normal = robot.forward(q, "tool")  # any motion of the joints keeps the height over the plane
    axis = np.cross(*(robot.jacobian(a, "tool")[:3, 0] for a in ((0.0, 0.0), (1.0, 0.7))))
    axis /= np.linalg.norm(axis)
    for height, status in (
        (0.05, Status.UNREACHABLE),
        (1.1e-4, Status.UNREACHABLE),
        (0.9e-4, Status.CONVERGED),
    ):
        off = PositionGoal("tool", normal.position + height * axis)
        assert (
            solve(robot, off, solver="analytic", tolerance=Tolerance(position=1e-4)).status
            is status
        )


def test_a_goal_slightly_beyond_a_limit_is_reached_within_its_tolerance():
    # The exact target has no branch inside the limits, but a target within its tolerance has one.
    robot = load_robot("puma560")
    rng = np.random.default_rng(0)
    for i in range(90):
        q = robot.sample(rng)
        q[i % 6] = robot.upper[i % 6] + 2e-5
        goal = PoseGoal.at("gripper", robot.forward(q))
        near = robot.forward(robot.clip(q)).distance(goal.target)
        assert near[0] < 1e-4 and near[1] < 1e-3
        solution = solve(robot, goal)
        assert solution.converged and not robot.outside(solution.q)


def test_a_target_beyond_all_links_is_proven_out_of_reach(tmp_path):
    robot = load_robot("puma560")
    far = solve(robot, PoseGoal("gripper", (3.0, 0.0, 1.0)), solver="analytic")
    assert far.status is Status.UNREACHABLE and np.array_equal(far.q, robot.home)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32), family=st.sampled_from(ARMS))
def test_a_goal_within_tolerance_of_a_reachable_pose_is_never_unreachable(
    seed, family, tmp_path_factory
):
    rng = np.random.default_rng(seed)
    robot = random_arm(rng, tmp_path_factory.mktemp("arm"), family, limit=rng.uniform(0.5, 3.1))
    solver = make_solver("analytic")
    tolerance = Tolerance(*10 ** rng.uniform(-5, -1, 2))
    problem = Problem(
        robot, PoseGoal.at("tool", robot.forward(robot.home)), tolerance=tolerance, solver=solver
    )
    for _ in range(40):
        luck = rng.random(6)
        q = np.where(luck < 0.2, robot.upper, np.where(luck > 0.8, robot.lower, robot.sample(rng)))
        pose = robot.forward(q)
        rotated = quat_multiply(rotation_exp(0.9999 * tolerance.angle * unit(rng)), pose.wxyz)
        problem.retarget(Pose(pose.position + 0.9999 * tolerance.position * unit(rng), rotated))
        assert problem.solve().status is not Status.UNREACHABLE
