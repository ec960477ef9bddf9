"""Arms of seven hinges with one joint fixed: all branches, compared with MuJoCo."""

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    ModelError,
    UnknownJointError,
    UnsupportedGoalError,
    UnsupportedJointError,
)
from tests.solvers.analytic.test_six_axes import arm_from_axes, crossed_axes, unit

LAST = "panda_joint7"
EXACT = 1e-7


def panda_class_arm(rng, path):
    """An arm of the Panda class: crossed wrist, then a last hinge anywhere."""
    h, p = crossed_axes(rng)
    return arm_from_axes(rng, path, [*h, unit(rng)], [*p, rng.normal(size=3) * 0.3])


@pytest.mark.parametrize("seed", range(8))
def test_random_arms_of_the_panda_class_have_all_branches(seed, tmp_path):
    rng = np.random.default_rng(seed)
    robot = panda_class_arm(rng, tmp_path / "arm.xml")
    for _ in range(6):
        q = rng.uniform(-np.pi, np.pi, 7)
        pose = robot.measure(q, "tool")
        goal = rik.PoseGoal.at("tool", pose)
        branches = rik.solve_all(robot, goal, start=q, fixed={robot.joints[-1]: q[-1]})
        assert 2 <= len(branches) <= 8
        for branch in branches:
            assert branch.q[-1] == q[-1]
            assert max(robot.measure(branch.q, "tool").distance(pose)) < EXACT
        assert np.abs(branches[0].q - q).max() < 1e-6
        assert len({branch.name for branch in branches}) == len(branches)


@pytest.mark.parametrize(("name", "joint"), [("panda", LAST), ("srs_arm", -1)])
def test_solve_all_lists_every_branch_that_lm_finds(name, joint):
    robot = rik.load_robot(name)
    joint = joint if isinstance(joint, str) else robot.joints[joint]
    rng = np.random.default_rng(2)
    tight = rik.Tolerance(position=1e-9, angle=1e-9)
    seen = 0
    for _ in range(12):
        sampled = robot.sample(rng)
        value = sampled[robot.joints.index(joint)]
        pose = robot.measure(sampled)
        branches = rik.solve_all(robot, pose, fixed={joint: value})
        assert min(np.abs(branch.q - sampled).max() for branch in branches) < 1e-6
        held = robot.with_fixed({joint: value})
        problem = rik.Problem(held, pose, solver="lm", tolerance=tight)
        problem.budget = rik.Budget(restarts=0)
        for _ in range(30):
            solution = problem.solve(held.sample(rng))
            if not solution.converged:
                continue
            seen += 1
            known = [np.delete(branch.q, robot.joints.index(joint)) for branch in branches]
            assert min(np.abs(q - solution.q).max() for q in known) < 1e-4
    assert seen > 30


def test_the_panda_with_a_fixed_joint_has_a_closed_form():
    robot = rik.load_robot("panda")
    pose = robot.forward(robot.home)
    with pytest.raises(UnsupportedGoalError):
        rik.solve_all(robot, pose)
    with pytest.raises(UnsupportedGoalError):
        rik.solve_all(robot, pose, fixed={"panda_joint4": -1.5})
    held = robot.with_fixed({LAST: 0.3})
    solution = rik.solve(held, held.forward(held.home), start=held.home + 0.1)
    assert solution.converged
    assert solution.solver == "analytic"


def test_branches_of_a_fixed_joint_are_measured_on_the_whole_robot():
    robot = rik.load_robot("panda")
    avoid = rik.CollisionAvoidance(rik.Scene(robot), margin=0.005)
    rng = np.random.default_rng(4)
    touching = 0
    for _ in range(30):
        q = robot.sample(rng)
        branches = rik.solve_all(robot, robot.forward(q), fixed={LAST: q[-1]}, collisions=avoid)
        assert [branch.free for branch in branches] == sorted(
            (branch.free for branch in branches), reverse=True
        )
        for branch in branches:
            distance = avoid.scene.clearance(branch.q).distance
            assert branch.clearance.distance == distance
            assert branch.free == (distance >= avoid.margin)
            touching += not branch.free
    assert touching > 0


def test_aligned_shoulder_axes_keep_the_angle_of_the_start():
    robot = rik.load_robot("panda")
    rng = np.random.default_rng(5)
    for _ in range(30):
        q = robot.sample(rng)
        q[1] = 0.0  # axes 1 and 3 are aligned, so only q1 + q3 counts
        pose = robot.measure(q)
        branches = rik.solve_all(robot, pose, start=q, fixed={LAST: q[-1]})
        assert np.abs(branches[0].q - q).max() < 1e-6
        for branch in branches:
            assert max(robot.measure(branch.q).distance(pose)) < 1e-6


def test_a_pose_beyond_the_range_of_the_elbow_is_proven_out_of_reach():
    robot = rik.load_robot("panda").with_fixed({LAST: 0.5})
    rng = np.random.default_rng(6)
    far = rik.Pose((0.9, 0.0, 0.9))
    assert rik.solve(robot, far, solver="analytic").status is rik.Status.UNREACHABLE
    for _ in range(200):
        pose = robot.forward(robot.sample(rng))
        moved = rik.Pose(pose.position + 0.9e-4 * unit(rng), pose.wxyz)
        solution = rik.solve(robot, moved, solver="analytic")
        assert solution.status is not rik.Status.UNREACHABLE


def test_fixed_joints_are_removed_from_q_and_keep_the_poses():
    robot = rik.load_robot("panda")
    rng = np.random.default_rng(7)
    for _ in range(10):
        q = robot.sample(rng)
        held = robot.with_fixed({LAST: q[6], "panda_joint3": q[2]})
        rest = np.delete(q, [2, 6])
        assert held.joints == tuple(np.delete(robot.joints, [2, 6]))
        assert max(held.measure(rest).distance(robot.measure(q))) < 1e-12
        assert max(held.forward(rest).distance(robot.measure(q))) < 1e-9
        np.testing.assert_array_equal(held.lower, np.delete(robot.lower, [2, 6]))
        limits = np.delete(robot.velocity_limits, [2, 6])
        np.testing.assert_array_equal(held.velocity_limits, limits)
    narrow = robot.with_limits(0.5 * robot.lower, 0.5 * robot.upper)
    held = narrow.with_fixed({LAST: 0.1})
    np.testing.assert_array_equal(held.lower, narrow.lower[:6])
    np.testing.assert_array_equal(held.upper, narrow.upper[:6])


def test_wrong_fixed_joints_are_refused():
    robot = rik.load_robot("panda")
    with pytest.raises(UnknownJointError, match="panda_joint7"):
        robot.with_fixed({"panda_joint_7": 0.0})
    for value in (3.0, np.nan, "0"):
        with pytest.raises(ModelError, match="cannot be fixed"):
            robot.with_fixed({LAST: value})
    with pytest.raises(UnsupportedJointError):
        robot.with_fixed(dict(zip(robot.joints, robot.home, strict=True)))
    humanoid = rik.load_robot("humanoid")
    with pytest.raises(UnsupportedJointError, match="single value"):
        humanoid.with_fixed({humanoid.joints[0]: 0.0})
