"""Residuals are zero at the goal, Jacobians exact, errors unweighted, for every kind of goal."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import (
    GOALS,
    AimGoal,
    CenterOfMassGoal,
    OrientationGoal,
    PoseGoal,
    PosePriorGoal,
    PositionGoal,
    PostureGoal,
    axis_vector,
)
from robot_ik.kernels import so3
from robot_ik.kernels.frame_goals import orientation_error
from robot_ik.kernels.jit import kernel
from robot_ik.problem import Problem
from tests.residual_rows import rows_at


@kernel
def compiled_orientation_error(target, current, out):
    error, angle = orientation_error(so3.read_rotation(target, 0), so3.read_rotation(current, 0))
    so3.write_vector(out, 0, error)
    return angle


AXIS = st.sampled_from(["x", "-y", "z", (1.0, -2.0, 0.5)])
AXES = st.sampled_from(["x", "xy", "zy", "xyz"])


def make_goal(data, kind, robot, there, weights):
    """A goal that is met at ``there``."""
    frame = data.draw(st.sampled_from(robot.frames))
    pose = robot.forward(there, frame)
    extra = {"length": data.draw(st.sampled_from([None, 0.7]))}
    if kind is PositionGoal:
        return kind(frame, pose.position, weight=weights[0], axes=data.draw(AXES), **extra)
    free = data.draw(st.one_of(st.none(), AXIS))
    if kind is OrientationGoal:
        return OrientationGoal(frame, pose.wxyz, weight=weights[1], free_axis=free, **extra)
    if kind is PoseGoal:
        return PoseGoal(
            frame,
            pose.position,
            pose.wxyz,
            position_weight=weights[0],
            angle_weight=weights[1],
            free_axis=free,
            **extra,
        )
    if kind is CenterOfMassGoal:
        body = data.draw(st.sampled_from([None, robot.model.body(robot.model.nbody - 1).name]))
        com = robot.center_of_mass(there, body)
        return CenterOfMassGoal(body, com, weight=weights[0], axes=data.draw(AXES), **extra)
    if kind is PostureGoal:
        joint_weights = {robot.joints[0]: weights[1]}
        return PostureGoal(
            q=there, weight=weights[0], joints=joint_weights, only_named=data.draw(st.booleans())
        )
    axis = data.draw(AXIS)
    if kind is AimGoal:
        point = pose.position + pose.rotation @ axis_vector(axis) * 0.4
        return AimGoal(frame, point, axis=axis, weight=weights[1])
    return kind(frame, pose.position, axis, weight=weights[0])


def differences(problem, q, step=1e-6):
    """-d residual / d dq by central differences, columns as in the problem."""
    robot = problem.robot
    columns = []
    for v in problem.compiled.block.arrays["dofs"]:
        dq = np.zeros(robot.nv)
        dq[v] = step
        forward = rows_at(problem, robot.integrate(q, dq)).residual
        backward = rows_at(problem, robot.integrate(q, -dq)).residual
        columns.append((backward - forward) / (2 * step))
    return np.array(columns).T.reshape(problem.compiled.rows, problem.compiled.columns)


# A pose prior is never met: see tests/figure/motion/test_pose_prior.py.
KIND = st.sampled_from([kind for kind in GOALS if kind is not PosePriorGoal])
WEIGHT = st.sampled_from([0.0, 0.3, 1.0, 5.0])


@settings(max_examples=40, phases=(Phase.generate,))
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_the_residual_is_zero_at_the_goal_and_the_jacobian_is_exact(
    any_model, load_xml, data, seed
):
    drawn = data.draw(any_model)
    robot = load_xml(drawn.xml, drawn.joints)
    rng = np.random.default_rng(seed)
    there = robot.sample(rng)
    here = robot.sample(rng)
    kinds = data.draw(st.lists(KIND, min_size=1, max_size=3))
    goals = [
        make_goal(data, kind, robot, there, data.draw(st.tuples(WEIGHT, WEIGHT))) for kind in kinds
    ]
    problem = Problem(robot, goals)
    met = rows_at(problem, there)
    assert met.cost < 1e-20
    assert np.abs(met.residual).max(initial=0) < 1e-10
    assert np.abs(met.error).max() < 1e-10

    rows = rows_at(problem, here)
    assert rows.cost == pytest.approx(0.5 * rows.residual @ rows.residual, rel=1e-12)
    for goal, row in zip(goals, rows.error, strict=True):
        metres, radians = goal.error(robot, here)  # MuJoCo's forward pass
        goal_weights = goal.weights
        assert row[0] == pytest.approx(metres, abs=1e-9) or goal_weights[0] == 0.0
        assert row[1] == pytest.approx(radians, abs=2e-8) or goal_weights[1] == 0.0
        if radians > np.pi - 1e-3:
            return  # near pi the residual jumps, so differences are not valid; see below
    largest = np.abs(rows.jacobian).max(initial=0)
    np.testing.assert_allclose(
        rows.jacobian, differences(problem, here), atol=2e-6 * max(1, largest)
    )


ONE_BALL = """<mujoco><worldbody><body name="b"><joint name="ball" type="ball"/><geom size="0.1"/>
<site name="tip" pos="0.3 0.1 0.2"/></body></worldbody></mujoco>"""


@settings(max_examples=40)
@given(
    axis=st.tuples(*[st.integers(-5, 5)] * 3).filter(any),
    angle=st.sampled_from(
        [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 2.0, 2.69, 2.7, 3.0, 3.14, np.pi - 1e-4]
    ),
)
def test_rotation_rows_are_exact_from_zero_to_a_half_turn(load_xml, axis, angle):
    robot = load_xml(ONE_BALL)
    vector = angle * np.array(axis) / np.linalg.norm(axis)
    problem = Problem(robot, OrientationGoal(None, rotation_exp(vector)))
    start = np.array([1.0, 0, 0, 0])
    rows = rows_at(problem, start)
    np.testing.assert_allclose(rows.residual, vector, atol=2e-12)
    assert rows.error[0, 1] == pytest.approx(angle, abs=1e-12)
    np.testing.assert_allclose(rows.jacobian, differences(problem, start), atol=1e-5)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 2, -3), (-1, 1e-9, 0)])
@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-9, 1e-6])
def test_a_half_turn_has_a_finite_axis_and_the_full_angle(axis, short):
    vector = (np.pi - short) * np.array(axis, dtype=float) / np.linalg.norm(axis)
    current = Pose((0, 0, 0), (0.4, -0.3, 0.8, 0.2))
    target = Pose((0, 0, 0), quat_multiply(rotation_exp(vector), current.wxyz))
    out = np.zeros(3)
    angle = compiled_orientation_error(target.row[None], current.row[None], out)
    assert angle == pytest.approx(np.pi - short, abs=1e-9)
    assert min(np.abs(out - vector).max(), np.abs(out + vector).max()) < 1e-7
    if short >= 1e-6:
        np.testing.assert_allclose(out, vector, atol=1e-7)


def test_a_part_with_weight_zero_has_no_rows(load_xml):
    robot = load_xml(ONE_BALL)
    far = PoseGoal(None, (9, 9, 9), (1, 0, 0, 0), position_weight=0.0)
    problem = Problem(robot, far, solver="lm")
    rows = rows_at(problem, [1.0, 0, 0, 0])
    assert rows.cost == 0.0
    assert not rows.residual.any()
    assert problem.solve().converged
