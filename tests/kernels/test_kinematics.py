"""Forward kinematics, Jacobian, integration and limits against MuJoCo, on random trees."""

import copy
import gc
import pickle

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.geometry import Pose
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue

# Rounding grows with the numbers: relative to the largest position.
EXACT = 1e-12


def check_against_mujoco(robot, q, data, columns):
    scale = max(
        1.0, np.abs(data.xpos).max(), np.abs(data.site_xpos).max() if robot.model.nsite else 0.0
    )
    sites = {robot.model.site(site).name for site in range(robot.model.nsite)}
    for body in range(1, robot.model.nbody):
        if robot.model.body(body).name in sites.union(robot.file.tools):
            continue  # a site or tool has this name
        pose = robot.forward(q, robot.model.body(body).name)
        np.testing.assert_allclose(pose.position, data.xpos[body], atol=EXACT * scale)
        np.testing.assert_allclose(pose.rotation.ravel(), data.xmat[body], atol=EXACT)
    for site in range(robot.model.nsite):
        name = robot.model.site(site).name
        if name in robot.file.tools and robot.file.tools[name].site != name:
            continue
        pose = robot.forward(q, name)
        np.testing.assert_allclose(pose.position, data.site_xpos[site], atol=EXACT * scale)
        np.testing.assert_allclose(pose.rotation.ravel(), data.site_xmat[site], atol=EXACT)
        linear = np.zeros((3, robot.model.nv))
        angular = np.zeros((3, robot.model.nv))
        mujoco.mj_jacSite(robot.model, data, linear, angular, site)
        jacobian = robot.jacobian(q, name)
        np.testing.assert_allclose(jacobian[:3], linear[:, columns], atol=EXACT * scale)
        np.testing.assert_allclose(jacobian[3:], angular[:, columns], atol=EXACT)


@settings(max_examples=50)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_random_trees_move_as_in_mujoco(
    any_model, load_xml, mujoco_at, dof_addresses, draw_q, data, seed
):
    drawn = data.draw(any_model)
    robot = load_xml(drawn.xml, drawn.joints)
    rng = np.random.default_rng(seed)
    q = draw_q(robot, rng)
    columns = dof_addresses(robot)
    check_against_mujoco(robot, q, mujoco_at(robot, q), columns)

    step = rng.normal(size=robot.nv)
    whole_step = np.zeros(robot.model.nv)
    whole_step[columns] = step
    expected = robot.qpos(q)
    mujoco.mj_integratePos(robot.model, expected, whole_step, 1.0)
    moved = robot.qpos(robot.integrate(q, step))
    frozen = np.setdiff1d(np.arange(robot.model.nq), robot._addresses)
    mujoco.mj_normalizeQuat(robot.model, expected)
    mujoco.mj_normalizeQuat(robot.model, moved)
    np.testing.assert_allclose(moved, expected, atol=EXACT * max(1.0, np.abs(expected).max()))
    assert np.array_equal(robot.qpos(q)[frozen], robot.frozen_qpos[frozen])


@settings(max_examples=40)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_clip_gives_the_nearest_q_inside_the_limits(any_model, load_xml, draw_q, data, seed):
    drawn = data.draw(any_model)
    robot = load_xml(drawn.xml, drawn.joints)
    rng = np.random.default_rng(seed)
    q = draw_q(robot, rng)
    inside = robot.clip(q)
    tree = robot.tree
    for k, a, v in zip(tree.kind, tree.qadr, tree.vadr, strict=True):
        if k in (0, 1):  # hinge, slide
            assert inside[a] == min(max(q[a], robot.lower[v]), robot.upper[v])
        elif k == 2:
            vector = np.zeros(3)
            mujoco.mju_quat2Vel(vector, inside[a : a + 4] / np.linalg.norm(inside[a : a + 4]), 1.0)
            assert np.linalg.norm(vector) <= robot.upper[v] + 1e-12
            before = np.zeros(3)
            mujoco.mju_quat2Vel(before, q[a : a + 4] / np.linalg.norm(q[a : a + 4]), 1.0)
            if np.linalg.norm(before) <= robot.upper[v]:
                assert np.array_equal(inside[a : a + 4], q[a : a + 4])
            else:  # moved back to the cone by the shortest rotation, about the same axis
                assert np.linalg.norm(vector) == pytest.approx(robot.upper[v], abs=1e-12)
                assert np.linalg.norm(np.cross(vector, before)) < 1e-9 and vector @ before > 0
        else:
            assert np.array_equal(inside[a : a + 7], q[a : a + 7])
    np.testing.assert_allclose(robot.clip(inside), inside, atol=1e-15)
    assert not robot.outside(inside)
    drawn_inside = robot.sample(rng)
    np.testing.assert_allclose(robot.clip(drawn_inside), drawn_inside, atol=1e-12)


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_bundled_models_move_as_in_mujoco(name, mujoco_at, dof_addresses):
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    for q in [robot.home, *(robot.sample(rng) for _ in range(20))]:
        check_against_mujoco(robot, q, mujoco_at(robot, q), dof_addresses(robot))


BALL = """<mujoco><worldbody><body name="arm"><joint name="ball" type="ball"/><geom size="0.1"/>
<site name="tip" pos="1 0 0"/></body></worldbody></mujoco>"""


def test_a_zero_quaternion_is_the_identity_as_in_mujoco(load_xml, mujoco_at):
    robot = load_xml(BALL)
    zero = np.zeros(4)
    check_against_mujoco(robot, zero, mujoco_at(robot, zero), np.arange(3))
    np.testing.assert_allclose(robot.integrate(zero, [0.0, 0.0, 0.0]), [1, 0, 0, 0])


@settings(max_examples=30)
@given(
    vector=st.tuples(*[st.floats(-1e-5, 1e-5)] * 3), scale=st.sampled_from([1e-6, 1e-3, 1.0, 1e5])
)
def test_small_and_large_rotations_integrate_as_in_mujoco(load_xml, vector, scale):
    robot = load_xml(BALL)
    step = np.array(vector) * scale
    expected = np.array([0.5, 0.5, -0.5, 0.5])
    moved = robot.integrate(expected, step)
    mujoco.mju_quatIntegrate(expected, step, 1.0)
    np.testing.assert_allclose(moved, expected, atol=EXACT)


def test_a_rotated_tool_is_a_valid_frame(load_xml):
    robot = load_xml(
        """<mujoco><worldbody>
 <body name="arm" pos="0 0 1"><joint name="turn" axis="0 0 2"/><geom size="0.1"/>
        <site name="tool" pos="0.5 0 0" quat="0.70710678118654752 0 0.70710678118654752 0"/></body>
        <site name="fixed" pos="1 2 3"/></worldbody></mujoco>"""
    )
    assert robot.tool == "tool"
    pose = robot.forward([np.pi / 2])
    np.testing.assert_allclose(pose.position, [0, 0.5, 1], atol=1e-15)
    np.testing.assert_allclose(pose.rotation[:, 2], [0, 1, 0], atol=1e-15)  # z along the arm
    np.testing.assert_allclose(robot.jacobian([0.0])[:, 0], [0, 0.5, 0, 0, 0, 1], atol=1e-15)
    world = robot.forward([0.3], "fixed")
    assert world.distance(Pose((1, 2, 3))) == (0.0, 0.0)
    assert not robot.jacobian([0.3], "fixed").any()


def test_copies_have_separate_arrays(load_xml):
    robot = load_xml(BALL)
    q = robot.sample(np.random.default_rng(0))
    expected = robot.forward(q).matrix
    copies = [
        copy.copy(robot.tree),
        copy.deepcopy(robot.tree),
        pickle.loads(pickle.dumps(robot.tree)),
    ]
    deep = copy.deepcopy(robot)
    assert len({tree.block.address for tree in [*copies, robot.tree, deep.tree]}) == 5
    del robot, copies
    gc.collect()
    rubbish = [np.full(64, 7.0) for _ in range(1000)]
    np.testing.assert_array_equal(deep.forward(q).matrix, expected)
    del rubbish
