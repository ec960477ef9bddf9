"""``make_chain``: ball-joint chains of any number of links; robots of models built in memory."""

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ModelError, UnknownFrameError, UnknownJointError
from robot_ik.kernels.tree import BALL


@pytest.mark.parametrize("n", range(1, 11))
def test_a_chain_has_its_links_and_lengths(n):
    robot = rik.make_chain(n, 0.3)
    assert robot.joints == tuple(f"joint{i}" for i in range(1, n + 1))
    assert robot.tree.kind.tolist() == [BALL] * n and (robot.nq, robot.nv) == (4 * n, 3 * n)
    assert np.isinf(robot.lower).all() and np.isinf(robot.upper).all()
    assert robot.tool == "tip" and robot.arm_file is None
    np.testing.assert_allclose(robot.measure(robot.home).position, [0, 0, 0.3 * n], atol=1e-12)
    centre, radius = robot.reach()
    np.testing.assert_allclose(centre, 0, atol=1e-15)
    assert radius == pytest.approx(0.3 * n)
    q = robot.sample(np.random.default_rng(n))
    positions = [robot.measure(q, f"link{i}").position for i in range(1, n + 1)] + [
        robot.measure(q).position
    ]
    np.testing.assert_allclose(np.linalg.norm(np.diff(positions, axis=0), axis=1), 0.3, atol=1e-12)
    np.testing.assert_allclose(robot.forward(q).matrix, robot.measure(q).matrix, atol=1e-12)


def test_a_ball_joint_rotates_about_three_axes():
    robot = rik.make_chain(2, 1.0)
    jacobian = robot.jacobian(robot.home)
    assert np.linalg.matrix_rank(jacobian[3:, :3]) == 3
    rotated = robot.integrate(robot.home, [np.pi / 2, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(robot.measure(rotated).position, [0, -2, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("n", "length"), [(0, 1.0), (-3, 1.0), (2, 0.0), (2, -1.0), (2, np.inf), (2, np.nan)]
)
def test_a_chain_without_links_is_refused(n, length):
    with pytest.raises(ModelError, match="link"):
        rik.make_chain(n, length)


ARM = """<mujoco model="arm"><worldbody><body name="a"><joint name="one"/><geom size="0.1"/>
<body name="b" pos="1 0 0"><joint name="two"/><geom size="0.1"/><site name="end" pos="1 0 0"/>
</body></body>
</worldbody></mujoco>"""


def test_a_model_built_in_memory_is_a_robot(tmp_path, monkeypatch):
    (tmp_path / "arm.toml").write_text("not for this robot")
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(ARM)
    robot = rik.load_robot(model, joints=["two"], tool="end")
    assert robot.model is model and robot.name == "arm" and robot.joints == ("two",)
    assert robot.arm_file is None and not robot.path.exists()
    np.testing.assert_allclose(robot.forward([np.pi / 2]).position, [1, 1, 0], atol=1e-12)
    with pytest.raises(UnknownJointError, match="'two'"):
        rik.load_robot(model, joints=["tow"])
    with pytest.raises(UnknownFrameError, match="'end'"):
        rik.load_robot(model, tool="edn")
