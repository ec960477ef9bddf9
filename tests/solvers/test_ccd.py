"""CCD: single rotations against brute force, the textbook's form in NumPy, both orders, limits."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from robot_ik.chain import make_chain
from robot_ik.errors import ConfigError
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.problem import Budget, Problem
from robot_ik.robot import load_robot
from robot_ik.solvers.ccd import AXES, ORDERS, CyclicCoordinateDescent

both_orders = pytest.mark.parametrize("order", ORDERS)
both_axes = pytest.mark.parametrize("axis", AXES)


def one_sweep(robot, goal, start, **options):
    problem = Problem(robot, goal, budget=Budget(iterations=1, restarts=0), solver=CyclicCoordinateDescent(**options))
    solution = problem.solve(start)
    assert solution.iterations == 1
    return problem.arrays["q"].copy()


@both_orders
def test_a_sweep_takes_each_joint_to_its_best_angle_in_that_order(order, robots, reachable):
    """Each joint's best angle by search over MuJoCo's forward pass."""
    robot = robots("planar")
    for start, there in zip(reachable(robot, 3, 70), reachable(robot, 3, 71), strict=True):
        goal = PositionGoal(None, robot.forward(there).position)
        expected = start.copy()
        for joint in range(3) if order == "root_to_tip" else (2, 1, 0):

            def miss(angle, joint=joint, expected=expected, goal=goal):
                q = expected.copy()
                q[joint] = angle
                return np.linalg.norm(robot.measure(q).position - goal.target.position)

            angles = np.linspace(robot.lower[joint], robot.upper[joint], 101)
            near = min(angles, key=miss)
            bounds = np.clip([near - 0.1, near + 0.1], angles[0], angles[-1])
            expected[joint] = minimize_scalar(
                miss, bounds=bounds, method="bounded", options={"xatol": 1e-9}
            ).x
        np.testing.assert_allclose(one_sweep(robot, goal, start, order=order), expected, atol=1e-5)


def textbook(pivot, tip, target):
    """Rotation vector about (s − p) × (t − p) by the angle between the two."""
    a, b = tip - pivot, target - pivot
    axis = np.cross(a, b)
    return axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), a @ b)


@both_orders
def test_free_bones_turn_as_the_textbook_has_it(order):
    """P11: each ball of a chain about the cross product, by the angle between; limits do not matter here."""
    chain, rng = make_chain(4, length=0.3), np.random.default_rng(5)
    names = [chain.model.body(int(chain.model.jnt_bodyid[j])).name for j in range(chain.model.njnt)]
    for _ in range(4):
        start, target = chain.sample(rng), chain.forward(chain.sample(rng)).position
        q = start.copy()
        for k in range(4) if order == "root_to_tip" else (3, 2, 1, 0):
            pose = chain.measure(q, names[k])
            rotation = textbook(pose.position, chain.measure(q).position, target)
            way = np.zeros(chain.nv)
            way[3 * k : 3 * k + 3] = pose.rotation.T @ rotation  # MuJoCo rotates balls in their own axes
            q = chain.integrate(q, way)
        found = one_sweep(chain, PositionGoal(None, target), start, order=order, axis="free")
        np.testing.assert_allclose(found, q, atol=1e-9)


def test_hinges_take_their_part_of_the_free_turn():
    """S12's bones are three hinges through one point; a hinge takes its twist about its axis."""
    arm, rng = load_robot("seven_segment"), np.random.default_rng(6)
    bend = np.array([np.inf if name.endswith("twist") else 0.8 for name in arm.joints])
    arm = arm.with_limits(-bend, bend)
    clipped = 0
    for _ in range(3):
        start, target = arm.sample(rng), arm.forward(arm.sample(rng)).position
        q = start.copy()
        for v in reversed(range(arm.nv)):
            jacobian = arm.jacobian(q, f"segment{v // 3 + 1}")
            axis, pivot = jacobian[3:, v], arm.measure(q, f"segment{v // 3 + 1}").position
            x, y, z, w = Rotation.from_rotvec(textbook(pivot, arm.measure(q).position, target)).as_quat()
            wanted = q[v] + 2.0 * np.arctan2(axis @ [x, y, z], w)
            q[v] = np.clip(wanted, arm.lower[v], arm.upper[v])
            clipped += q[v] != wanted
        np.testing.assert_allclose(
            one_sweep(arm, PositionGoal(None, target), start, axis="free"), q, atol=1e-9
        )
    assert clipped > 3


@both_axes
@both_orders
@pytest.mark.parametrize("factor", [0.5, 3.0, -0.7])
def test_collinear_vectors_have_no_axis_and_do_no_harm(axis, order, factor):
    """Straight chain, target on its line: no bone rotation is better than another, and nothing is NaN."""
    chain = make_chain(4, length=0.3)
    tip = chain.forward(chain.home).position
    goal = PositionGoal(None, factor * tip)
    stuck = one_sweep(chain, goal, chain.home, axis=axis, order=order)
    assert np.isfinite(stuck).all()
    if axis == "free" or factor > 1.0:  # real axes have a best angle behind the bone: π
        np.testing.assert_array_equal(stuck, chain.home)
    found = Problem(chain, goal, solver=CyclicCoordinateDescent(axis=axis, order=order)).solve()
    assert found.converged == (abs(factor) <= 1.0) and np.isfinite(found.q).all()
    if factor > 1.0:
        assert found.miss.position == pytest.approx((factor - 1) * np.linalg.norm(tip), abs=1e-6)


@both_axes
@both_orders
@pytest.mark.parametrize("robot_name", ["puma560", "tree"])
def test_limits_are_kept_at_every_sweep_and_reached_exactly(axis, order, robot_name, robots, reachable):
    robot, at_limits = robots(robot_name), 0
    for start, there in zip(reachable(robot, 3, 80), reachable(robot, 3, 81), strict=True):
        problem = Problem(robot, PositionGoal(None, 2.0 * robot.forward(there).position), solver=CyclicCoordinateDescent(axis=axis, order=order))
        for sweeps in (1, 2, 3, 10):
            problem.budget = Budget(iterations=sweeps, restarts=0)
            problem.solve(start)
            q = problem.arrays["q"]
            if robot_name == "puma560":
                assert (q >= robot.lower).all() and (q <= robot.upper).all()
                at_limits += ((q == robot.lower) | (q == robot.upper)).any()
            np.testing.assert_allclose(robot.clip(q), q, atol=1e-14)  # a ball's cone is kept to rounding
    assert at_limits > 3 or robot_name == "tree"


@both_orders
@pytest.mark.parametrize(("axis", "least"), [("joint", 1.0), ("free", 0.8)])
def test_every_option_reaches_positions(order, axis, least, robots, reachable):
    for robot in (robots("puma560"), robots("tree"), make_chain(5)):
        solver, solved, count = CyclicCoordinateDescent(order=order, axis=axis), 0, 20
        problem = Problem(robot, PositionGoal(None, (0, 0, 0)), solver=solver)
        for there in reachable(robot, count, 90):
            problem.retarget(robot.forward(there).position)
            solved += problem.solve().converged
        # A single hinge takes less of a free rotation than would be best for it, and creeps.
        assert solved >= (least if robot.name == "puma560" else 1.0) * count, robot.name


@both_axes
def test_orientations_and_poses_turn_free_bones_too(axis):
    chain, rng = make_chain(5), np.random.default_rng(9)
    for _ in range(5):
        pose = chain.forward(chain.sample(rng))
        for goal in (OrientationGoal(None, pose.wxyz), PoseGoal.at(None, pose)):
            found = Problem(chain, goal, solver=CyclicCoordinateDescent(axis=axis)).solve()
            assert found.converged, goal


def test_there_are_no_other_orders_and_axes():
    for options in ({"order": "sideways"}, {"axis": "none"}):
        with pytest.raises(ConfigError, match="is no choice"):
            CyclicCoordinateDescent(**options)
