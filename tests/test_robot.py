"""Robots from names, files and folders; joints, frames and limits by name; wrong input."""

import copy
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest

from robot_ik.errors import (
    ModelError,
    UnknownFrameError,
    UnknownJointError,
    UnknownRobotError,
    UnsupportedJointError,
)
from robot_ik.kernels import kinematics
from robot_ik.robot import load_robot

ARM = """<mujoco model="arm"><compiler angle="radian"/><worldbody>
<body name="link"><joint name="shoulder" axis="0 0 1" range="-1 2"/><geom size="0.1"/>
 <body name="rod" pos="1 0 0"><joint name="rail" type="slide" axis="1 0 0" range="-0.1 0.4"/>
  <geom size="0.1"/>
  <body name="hand" pos="0.5 0 0"><joint name="wrist" type="ball"/><geom size="0.1"/>
   <site name="tcp" pos="0 0.2 0"/></body></body></body>
</worldbody>
<keyframe><key name="rest" qpos="0.1 0.2 1 0 0 0"/>
 <key name="home" qpos="0.5 0.3 1 0 0 0"/></keyframe></mujoco>"""
INERTIA = """<inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="two"><link name="base"/><link name="arm">{INERTIA}</link>
<link name="tip">{INERTIA}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 1"/>
 <axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="bend" type="continuous"><parent link="arm"/><child link="tip"/><origin xyz="0.5 0 0"/>
 <axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def test_a_file_is_a_robot(arm_file):
    robot = load_robot(arm_file)
    assert (robot.name, robot.path, robot.folder) == ("arm", arm_file, arm_file.parent)
    assert robot.joints == ("shoulder", "rail", "wrist") and (robot.nq, robot.nv) == (6, 5)
    assert robot.tool == "tcp" and robot.frames == ("tcp", "link", "rod", "hand")
    assert robot.lower.tolist() == [-1, -0.1, *[-np.inf] * 3] and robot.upper[:2].tolist() == [
        2,
        0.4,
    ]
    # The keyframe "home" comes before the first keyframe.
    assert robot.home.tolist() == [0.5, 0.3, 1, 0, 0, 0]
    assert (
        robot.velocity_limits.shape == robot.acceleration_limits.shape == (5,)
        and (robot.velocity_limits > 0).all()
    )
    assert robot.arm_file is None
    assert load_robot(str(arm_file)).joints == robot.joints


def test_a_urdf_is_a_robot(tmp_path):
    (tmp_path / "two.urdf").write_text(URDF)
    robot = load_robot(tmp_path / "two.urdf")
    assert robot.joints == ("turn", "bend") and robot.lower.tolist() == [-1.5, -np.inf]
    np.testing.assert_allclose(
        robot.forward([np.pi / 2, 0.3], "tip").position, [0, 0, 0.5], atol=1e-12
    )


def test_frozen_joints_are_at_home(arm_file):
    whole = load_robot(arm_file)
    part = load_robot(arm_file, joints=["wrist", "shoulder"])
    # The joints are in the order of the model.
    assert part.joints == ("shoulder", "wrist")
    assert (part.nq, part.nv) == (5, 4)
    q = part.sample(np.random.default_rng(0))
    full = part.qpos(q)
    assert full[1] == 0.3
    assert part.forward(q).distance(whole.forward(full)) == pytest.approx((0, 0), abs=1e-12)
    np.testing.assert_allclose(part.jacobian(q), whole.jacobian(full)[:, [0, 2, 3, 4]], atol=1e-12)


def test_measure_equals_mujoco(arm_file):
    robot = load_robot(arm_file)
    q = robot.sample(np.random.default_rng(1))
    data = mujoco.MjData(robot.model)
    data.qpos[:] = q
    mujoco.mj_forward(robot.model, data)
    np.testing.assert_allclose(robot.measure(q).position, data.site_xpos[0], atol=1e-15)
    np.testing.assert_allclose(robot.measure(q, "rod").position, data.xpos[2], atol=1e-15)


def test_limits_intersect_and_home_moves_inside(arm_file):
    robot = load_robot(arm_file)
    wide = np.full(5, np.inf)
    lower = -wide
    upper = wide.copy()
    lower[0] = -3.0
    upper[0] = 0.4
    upper[1] = 0.2
    narrow = robot.with_limits(lower, upper)
    assert narrow.lower[:2].tolist() == [-1, -0.1] and narrow.upper[:2].tolist() == [0.4, 0.2]
    assert narrow.home.tolist() == [0.4, 0.2, 1, 0, 0, 0] and robot.home[0] == 0.5
    assert narrow.clip([9, 9, 1, 0, 0, 0])[:2].tolist() == [0.4, 0.2]
    assert narrow.outside([0.5, 0.1, 1, 0, 0, 0]) == ["shoulder"] and not robot.outside(robot.home)
    rng = np.random.default_rng(0)
    samples = np.array([narrow.sample(rng) for _ in range(300)])
    assert samples[:, 0].max() <= 0.4 and samples[:, 0].max() > 0.3 and samples[:, 0].min() < -0.9
    for low, high in ((0.2, 0.1), (np.nan, 1.0)):
        with pytest.raises(ModelError, match=f"lower <= upper, not .{low}.*{high}"):
            robot.with_limits(low, high)
    lower[1] = 0.5
    upper[1] = 0.6
    with pytest.raises(ModelError, match=r"no range is left for joint 'rail'.*0\.5"):
        robot.with_limits(lower, upper)


def test_no_position_is_beyond_the_reach(arm_file):
    robot = load_robot(arm_file)
    center, radius = robot.reach()
    assert center.tolist() == [0, 0, 0] and radius == pytest.approx(1.0 + 0.4 + 0.5 + 0.2)
    rng = np.random.default_rng(0)
    for name in robot.frames:
        center, radius = robot.reach(name)
        for _ in range(100):
            assert (
                np.linalg.norm(robot.forward(robot.sample(rng), name).position - center)
                <= radius + 1e-12
            )


def test_the_reach_of_slides_and_floating_bases(tmp_path):
    body = '<body name="b" pos="1 0 0">{}<geom size="1"/><site name="tip" pos="0 0 2"/></body>'
    for joint, expected in [
        ('<joint name="rail" type="slide" axis="0 1 0" range="-3 1" limited="true"/>', 5.0),
        ('<joint name="rail" type="slide" axis="0 1 0"/>', None),
        ('<freejoint name="free"/>', None),
    ]:
        path = tmp_path / "m.xml"
        path.write_text(f"<mujoco><worldbody>{body.format(joint)}</worldbody></mujoco>")
        ball = load_robot(path).reach()
        assert ball is None if expected is None else ball[1] == pytest.approx(expected)


def test_copies_and_pickles_are_independent(arm_file):
    robot = load_robot(arm_file)
    q = robot.sample(np.random.default_rng(2))
    expected = robot.forward(q).matrix
    others = [copy.deepcopy(robot), pickle.loads(pickle.dumps(robot))]
    del robot
    for other in others:
        assert np.array_equal(other.forward(q).matrix, expected)


# Wrong input


def test_an_unknown_robot_lists_close_names():
    with pytest.raises(UnknownRobotError, match="did you mean 'puma560'") as caught:
        load_robot("pumma560")
    assert "the path or text of an MJCF or URDF file" in str(caught.value)


def test_malformed_xml_is_refused_with_the_file_and_the_reason(tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><body><joint type='hinge'></body></worldbody></mujoco>")
    with pytest.raises(ModelError, match=r"broken\.xml") as caught:
        load_robot(path)
    assert caught.value.path == path and caught.value.reason and "XML" in caught.value.reason
    path.write_text(
        "<mujoco><worldbody><body><geom type='mesh' mesh='none'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ModelError, match="mesh"):
        load_robot(path)


def test_unknown_joints_groups_and_frames_list_close_names(arm_file):
    with pytest.raises(UnknownJointError, match="did you mean 'shoulder'"):
        load_robot(arm_file, joints=["sholder"])
    with pytest.raises(UnknownJointError, match="joint group"):
        load_robot(arm_file, joints="shoulder")
    with pytest.raises(UnknownFrameError, match="did you mean 'tcp'"):
        load_robot(arm_file, tool="tcpp")
    robot = load_robot(arm_file)
    for ask in (robot.forward, robot.jacobian, robot.measure):
        with pytest.raises(UnknownFrameError, match="did you mean 'hand'"):
            ask(robot.home, "hnd")


def test_wrong_joint_angles_are_refused(arm_file):
    robot = load_robot(arm_file)
    with pytest.raises(
        ModelError, match=r"q must be 6 numbers, not 3 (.|\n)*shoulder, rail, wrist"
    ):
        robot.forward([1, 2, 3])
    with pytest.raises(ModelError, match="finite"):
        robot.forward([np.nan, 0, 1, 0, 0, 0])


def test_a_model_without_moving_joints_is_refused(tmp_path):
    path = tmp_path / "stone.xml"
    path.write_text(
        "<mujoco><worldbody><body name='b'><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(UnsupportedJointError, match="no joint that may move"):
        load_robot(path)
    path.write_text("<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>")
    with pytest.raises(ModelError, match="no named site"):
        load_robot(path)


def test_a_robot_is_read_only(arm_file):
    robot = load_robot(arm_file)
    narrow = robot.with_limits(-0.5, 0.5)
    copies = (copy.copy(robot), copy.deepcopy(robot), pickle.loads(pickle.dumps(robot)))
    for other in (robot, narrow, *copies):
        for name in (
            "home",
            "lower",
            "upper",
            "velocity_limits",
            "acceleration_limits",
            "stiffness",
            "frozen_qpos",
        ):
            array = getattr(other, name)
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0.5
    q = robot.home.copy()
    q += 0.1  # a copy is writable
    node, local = robot.attachment("tcp")
    local[:] = 7.0
    assert robot.attachment("tcp")[0] == node and not (robot.attachment("tcp")[1] == 7.0).any()


def test_the_repr_of_a_robot_is_one_line(arm_file):
    text = repr(load_robot(arm_file))
    assert text == "Robot('arm', 3 joints: shoulder, rail, wrist; tool 'tcp', 4 frames; arm.xml)"
    figure = repr(load_robot("humanoid"))
    assert (
        "37 joints" in figure and "29 more" in figure and len(figure) < 300 and "\n" not in figure
    )


def test_a_step_is_checked_and_compiled_once():
    robot = load_robot("puma560")
    step = np.linspace(0.1, 0.6, 6)
    moved = robot.integrate(robot.home, step)
    compiled = len(kinematics.tree_integrate.signatures)
    column = np.column_stack([step, step])[:, 0]  # not contiguous: another type for numba
    assert np.array_equal(robot.integrate(robot.home, column), moved)
    assert len(kinematics.tree_integrate.signatures) == compiled
    with pytest.raises(ModelError, match="dq must be 6 numbers, not 3"):
        robot.integrate(robot.home, [0.1, 0.2, 0.3])
    with pytest.raises(ModelError, match="dq must be finite"):
        robot.integrate(robot.home, step * np.nan)
