"""CCD: single rotations against brute force, the textbook's form in NumPy, limits."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from robot_ik.budget import Budget
from robot_ik.chain import make_chain
from robot_ik.errors import OptionError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Problem
from robot_ik.robot import load_robot

both_axes = pytest.mark.parametrize("axis", ["joint", "free"])


def after_sweeps(robot, goal, start, sweeps=1, **options):
    """Return q after the last sweep, which may be worse than the best q."""
    budget = Budget(iterations=sweeps, restarts=0)
    problem = Problem(robot, goal, solver="ccd", budget=budget, **options)
    assert problem.solve(start).iterations <= sweeps
    return problem.search.arrays["q"].copy()


def test_a_sweep_moves_each_joint_to_its_best_angle_from_tip_to_root(robots, reachable):
    """Each joint's best angle by search over MuJoCo's forward pass."""
    robot = robots("planar")
    for start, wanted in zip(reachable(robot, 3, 70), reachable(robot, 3, 71), strict=True):
        goal = PositionGoal(None, robot.forward(wanted).position)
        expected = start.copy()
        for joint in (2, 1, 0):

            def error(angle, joint=joint, expected=expected, goal=goal):
                q = expected.copy()
                q[joint] = angle
                return np.linalg.norm(robot.measure(q).position - goal.target.position)

            angles = np.linspace(robot.lower[joint], robot.upper[joint], 101)
            near = min(angles, key=error)
            bounds = np.clip([near - 0.1, near + 0.1], angles[0], angles[-1])
            search = minimize_scalar(
                error, bounds=bounds, method="bounded", options={"xatol": 1e-9}
            )
            expected[joint] = search.x
        np.testing.assert_allclose(after_sweeps(robot, goal, start), expected, atol=1e-5)


def textbook(pivot, tip, target):
    """Rotation vector about (s − p) × (t − p) by the angle between the two."""
    a = tip - pivot
    b = target - pivot
    axis = np.cross(a, b)
    return axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), a @ b)


def test_free_bones_rotate_as_in_the_textbook():
    """Each ball of a chain about the cross product, by the angle between; no limits matter."""
    chain = make_chain(4, length=0.3)
    rng = np.random.default_rng(5)
    names = [chain.model.body(int(chain.model.jnt_bodyid[j])).name for j in range(chain.model.njnt)]
    for _ in range(4):
        start = chain.sample(rng)
        target = chain.forward(chain.sample(rng)).position
        q = start.copy()
        for k in (3, 2, 1, 0):
            pose = chain.measure(q, names[k])
            rotation = textbook(pose.position, chain.measure(q).position, target)
            dq = np.zeros(chain.nv)
            dq[3 * k : 3 * k + 3] = pose.rotation.T @ rotation  # MuJoCo: in the ball's own axes
            q = chain.integrate(q, dq)
        result = after_sweeps(chain, PositionGoal(None, target), start, axis="free")
        np.testing.assert_allclose(result, q, atol=1e-9)


def test_hinges_take_their_part_of_the_free_rotation():
    """The bones of this arm are three hinges through one point. Each takes its own twist."""
    arm = load_robot("seven_segment")
    rng = np.random.default_rng(6)
    bend = np.array([np.inf if name.endswith("twist") else 0.8 for name in arm.joints])
    arm = arm.with_limits(-bend, bend)
    clipped = 0
    for _ in range(3):
        start = arm.sample(rng)
        target = arm.forward(arm.sample(rng)).position
        q = start.copy()
        for v in reversed(range(arm.nv)):
            segment = f"segment{v // 3 + 1}"
            axis = arm.jacobian(q, segment)[3:, v]
            rotation = textbook(arm.measure(q, segment).position, arm.measure(q).position, target)
            x, y, z, w = Rotation.from_rotvec(rotation).as_quat()
            wanted = q[v] + 2.0 * np.arctan2(axis @ [x, y, z], w)
            q[v] = np.clip(wanted, arm.lower[v], arm.upper[v])
            clipped += q[v] != wanted
        result = after_sweeps(arm, PositionGoal(None, target), start, axis="free")
        np.testing.assert_allclose(result, q, atol=1e-9)
    assert clipped > 3


@both_axes
@pytest.mark.parametrize("factor", [0.5, 3.0, -0.7])
def test_collinear_vectors_have_no_axis_and_give_finite_angles(axis, factor):
    """Straight chain, target on its line: no rotation is better than another, nothing is NaN."""
    chain = make_chain(4, length=0.3)
    tip = chain.forward(chain.home).position
    goal = PositionGoal(None, factor * tip)
    stuck = after_sweeps(chain, goal, chain.home, axis=axis)
    assert np.isfinite(stuck).all()
    if axis == "free" or factor > 1.0:  # a real axis has a best angle behind the bone: π
        np.testing.assert_array_equal(stuck, chain.home)
    solution = Problem(chain, goal, solver="ccd", axis=axis).solve()
    assert solution.converged == (abs(factor) <= 1.0)
    assert np.isfinite(solution.q).all()
    if factor > 1.0:
        beyond = (factor - 1) * np.linalg.norm(tip)
        assert solution.error.position == pytest.approx(beyond, abs=1e-6)


@both_axes
@pytest.mark.parametrize("robot_name", ["puma560", "tree"])
def test_limits_hold_after_every_sweep_and_are_reached_exactly(axis, robot_name, robots, reachable):
    robot = robots(robot_name)
    at_limits = 0
    for start, wanted in zip(reachable(robot, 3, 80), reachable(robot, 3, 81), strict=True):
        goal = PositionGoal(None, 2.0 * robot.forward(wanted).position)
        for sweeps in (1, 2, 3, 10):
            q = after_sweeps(robot, goal, start, sweeps, axis=axis)
            if robot_name == "puma560":
                assert (q >= robot.lower).all()
                assert (q <= robot.upper).all()
                at_limits += ((q == robot.lower) | (q == robot.upper)).any()
            # The cone of a ball holds to rounding.
            np.testing.assert_allclose(robot.clip(q), q, atol=1e-14)
    assert at_limits > 3 or robot_name == "tree"


# A single hinge takes less of a free rotation than its optimum, and converges slowly.
@pytest.mark.parametrize(("axis", "puma_rate"), [("joint", 1.0), ("free", 0.8)])
def test_both_axes_reach_positions(axis, puma_rate, robots, reachable):
    for robot in (robots("puma560"), robots("tree"), make_chain(5)):
        problem = Problem(robot, PositionGoal(None, (0, 0, 0)), solver="ccd", axis=axis)
        solved = 0
        for q in reachable(robot, 20, 90):
            solved += problem.solve(target=robot.forward(q).position).converged
        rate = puma_rate if robot.name == "puma560" else 1.0
        assert solved >= 20 * rate, robot.name


@both_axes
def test_orientations_and_poses_rotate_free_bones_too(axis):
    chain = make_chain(5)
    rng = np.random.default_rng(9)
    for _ in range(5):
        pose = chain.forward(chain.sample(rng))
        for goal in (OrientationGoal(None, pose.wxyz), PoseGoal.at(None, pose)):
            assert Problem(chain, goal, solver="ccd", axis=axis).solve().converged, goal


def test_an_unknown_axis_is_refused(robots):
    goal = PositionGoal(None, (0.4, 0.0, 0.8))
    with pytest.raises(OptionError, match=r"axis.*joint, free"):
        Problem(robots("puma560"), goal, solver="ccd", axis="none")
