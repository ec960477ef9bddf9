"""Coupled joints: every solution satisfies the coupling in MuJoCo, or the method refuses."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from robot_ik.errors import (
    ConfigError,
    ModelError,
    UnknownJointError,
    UnsupportedGoalError,
    UnsupportedJointError,
)
from robot_ik.goals import PositionGoal, PostureGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solvers import SOLVERS
from tests.residual_rows import rows_at

ARM = """<mujoco><compiler angle="radian"/><worldbody>
<body name="a"><joint name="j1" axis="0 0 1" range="-2 2"/><geom size="0.05"/>
 <body name="b" pos="0.4 0 0"><joint name="j2" axis="0 1 0" ref="0.2" range="-1.5 1.5"/>
 <geom size="0.05"/>
  <body name="c" pos="0.4 0 0"><joint name="j3" axis="0 1 0" range="-0.9 1.2"/><geom size="0.05"/>
   <body name="d" pos="0.3 0 0.1"><joint name="j4" axis="1 0 0" range="-2 2"/><geom size="0.05"/>
    <body name="e" pos="0.2 0.1 0"><joint name="j5" type="slide" axis="0 0 1" range="-.2 .2"/>
     <geom size="0.05"/><site name="tip" pos="0.1 0 0.1"/></body></body></body></body></body>
</worldbody><equality>{}</equality></mujoco>"""
LAWS = {
    "linear": '<joint joint1="j3" joint2="j2" polycoef="0.1 -0.6 0 0 0"/>',
    "curved": '<joint joint1="j3" joint2="j2" polycoef="0.1 0.5 0.2 -0.05 0.01"/>',
    "slide follows hinge": '<joint joint1="j5" joint2="j4" polycoef="0 0.08 0 0 0"/>',
    "still": '<joint joint1="j4" polycoef="0.3 0 0 0 0"/>',
    "chain": (
        '<joint joint1="j3" joint2="j2" polycoef="0 -0.5 0 0 0"/><joint joint1="j4" joint2="j3"/>'
    ),
}
_EXACT = Tolerance(1e-9, 1e-9)
HONOUR = [
    name
    for name, kind in SOLVERS.items()
    if "couplings" in kind.capabilities and name != "combined"
]


def arm(folder: Path, equality: str, **options):
    path = folder / "arm.xml"
    path.write_text(ARM.format(equality))
    return load_robot(path, tool="tip", **options)


def broken(robot, q):
    """Largest violation of the model's equalities at q, by MuJoCo's own constraint solver."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_forward(robot.model, data)
    return np.abs(data.efc_pos[: data.ne]).max(initial=0.0)


@pytest.mark.parametrize("law", LAWS)
def test_every_solution_satisfies_the_coupling_in_mujoco(tmp_path, law):
    robot = arm(tmp_path, LAWS[law])
    rng = np.random.default_rng(3)
    for _ in range(5):
        there = robot.sample(rng)
        assert broken(robot, there) < 1e-12 and not robot.outside(there)
        for name in HONOUR:
            solution = solve(robot, PositionGoal(None, robot.forward(there).position), solver=name)
            assert broken(robot, solution.q) < 1e-12 and not robot.outside(solution.q), name
            if name == "lm":
                assert solution.converged, solution
    assert broken(robot, robot.home) < 1e-12


@pytest.mark.parametrize("law", [law for law in LAWS if law != "still"])
def test_the_jacobian_contains_the_motion_of_followers(tmp_path, law):
    robot = arm(tmp_path, LAWS[law])
    rng = np.random.default_rng(5)
    problem = Problem(
        robot, [PositionGoal(None, (0.3, 0.2, 0.1)), PositionGoal("d", (1, 0, 0), axes="xz")]
    )

    for _ in range(5):
        q = robot.clip(robot.sample(rng))
        rows = rows_at(problem, q)
        for u, v in enumerate(rows.dofs):
            step = np.zeros(robot.nv)
            step[v] = 1e-6
            forward = rows_at(problem, robot.apply_couplings(robot.integrate(q, step)))
            backward = rows_at(problem, robot.apply_couplings(robot.integrate(q, -step)))
            slope = (backward.residual - forward.residual) / 2e-6
            np.testing.assert_allclose(rows.jacobian[:, u], slope, atol=1e-7)


def test_a_leader_stops_at_the_limit_of_its_follower(tmp_path):
    robot = arm(tmp_path, LAWS["linear"])
    # j3 = 0.1 - 0.6 (j2 - 0.2) is inside -0.9 … 1.2. The limits of j2 are ±1.5.
    assert robot.lower[1] == pytest.approx(-1.5) and robot.upper[1] == pytest.approx(1.5)
    tight = arm(tmp_path, LAWS["linear"].replace("-0.6", "-3"))
    assert tight.lower[1] == pytest.approx(0.2 - 1.1 / 3) and tight.upper[1] == pytest.approx(
        0.2 + 1.0 / 3
    )
    narrower = tight.with_limits(np.full(5, -0.05), np.full(5, 10.0))
    assert narrower.upper[1] == pytest.approx(0.25)
    with pytest.raises(
        ModelError, match=r"joint 'j3' has no position inside its limits .* leader 'j2' is"
    ):
        arm(tmp_path, LAWS["linear"].replace("0.1 -0.6", "7 0.1"))


@pytest.mark.parametrize(
    "name", [name for name in SOLVERS if name not in HONOUR and name not in ("auto", "combined")]
)
def test_a_method_without_couplings_refuses_and_names_methods_with_them(tmp_path, name):
    with pytest.raises(UnsupportedGoalError, match=f"'{name}' does not support") as caught:
        solve(arm(tmp_path, LAWS["linear"]), PositionGoal(None, (0.5, 0.5, 0)), solver=name)
    assert "lm" in caught.value.able and "ccd" not in caught.value.able


def test_frozen_followers_and_leaders_hold_the_coupled_joint(tmp_path):
    goal = PositionGoal(None, (0.8, 0.3, 0.2))
    with pytest.raises(UnsupportedJointError, match=r"'j3', which is frozen, to 'j2'"):
        Problem(arm(tmp_path, LAWS["linear"], joints=["j1", "j2"]), goal)
    robot = arm(tmp_path, LAWS["linear"], joints=["j1", "j3", "j4"])
    q = solve(robot, goal, solver="lm").q
    assert q[1] == pytest.approx(robot.home[1]) and broken(robot, q) < 1e-12


@pytest.mark.parametrize(
    ("equality", "message"),
    [
        (LAWS["linear"] + '<joint joint1="j3" joint2="j1"/>', "'j3' is coupled twice"),
        ('<joint joint1="j3" joint2="j2"/><joint joint1="j2" joint2="j3"/>', "in a circle"),
        (
            '<joint joint1="j3" joint2="j2" polycoef="0 0 1 1 1"/>'
            '<joint joint1="j4" joint2="j3" polycoef="0 0 1 0 0"/>',
            "degree 8",
        ),
    ],
)
def test_contradictory_couplings_are_refused(tmp_path, equality, message):
    with pytest.raises(UnsupportedJointError, match=message):
        arm(tmp_path, equality)


TOML = """schema = 1
title = "coupled"
model = "arm.xml"
tool = "tip"
{}
"""


def described(folder: Path, text: str):
    (folder / "arm.xml").write_text(ARM.format(""))
    (folder / "robot.toml").write_text(TOML.format(text))
    return load_robot(folder)


def test_robot_toml_can_couple_joints(tmp_path):
    robot = described(tmp_path, "[couplings]\nj3 = { follows = 'j2', ratio = -0.5, offset = 0.1 }")
    solution = solve(robot, PositionGoal(None, (0.7, 0.5, 0.1)), solver="lm")
    assert solution.q[2] == pytest.approx(0.1 - 0.5 * solution.q[1], abs=1e-12)
    with pytest.raises(UnknownJointError, match="j9"):
        described(tmp_path, "[couplings]\nj3 = { follows = 'j9', ratio = 1.0 }")
    with pytest.raises(ConfigError, match="couplings"):
        described(tmp_path, "[couplings]\nj3 = { follow = 'j2', ratio = 1.0 }")


def test_a_stiff_joint_moves_less_as_in_weighted_least_squares(tmp_path):
    soft = described(tmp_path, "")
    stiff = described(tmp_path, "[stiffness]\nj1 = 25.0\nj3 = 4.0")
    assert stiff.stiffness.tolist() == [25.0, 1.0, 4.0, 1.0, 1.0]
    goal = PostureGoal(q=soft.home)  # all joints count, so all are columns
    assert np.allclose(
        Problem(stiff, goal).compiled.block.arrays["joint_scale"], [0.2, 1.0, 0.5, 1.0, 1.0]
    )
    start = np.array([0.4, 0.5, 0.3, 0.2, 0.0])
    position = soft.forward(start).position
    near = PositionGoal(None, position + np.array([0.0, 1e-4, 1e-4]))
    for name in ("lm", "dls", "pseudoinverse", "bfgs"):
        moved = {
            robot.stiffness[0]: Problem(robot, near, solver=name, tolerance=_EXACT).solve(start).q
            - start
            for robot in (soft, stiff)
        }
        jacobian = soft.jacobian(start)[:3]
        for weight, step in moved.items():
            inverse = np.diag(1.0 / (stiff if weight > 1 else soft).stiffness)
            wanted = (
                inverse
                @ jacobian.T
                @ np.linalg.solve(jacobian @ inverse @ jacobian.T, near.target.position - position)
            )
            np.testing.assert_allclose(step, wanted, atol=2e-7, err_msg=name)
        assert abs(moved[25.0][0]) < 0.95 * abs(moved[1.0][0])
    with pytest.raises(UnsupportedGoalError, match="stiffness"):
        solve(stiff, near, solver="ccd")
    for bad, message in (("j1 = 0.0", "stiffness"), ("j9 = 2.0", "j9")):
        with pytest.raises((ConfigError, UnknownJointError), match=message):
            described(tmp_path, "[stiffness]\n" + bad)


@pytest.mark.parametrize(
    ("equality", "kind"),
    [
        ('<connect body1="d" body2="a" anchor="0 0 0"/>', "connect"),
        ('<weld body1="d" body2="a"/><connect body1="d" anchor="0 0 0"/>', "connect and weld"),
        ('<connect body1="d" active="false" anchor="0 0 0"/>', ""),
        (LAWS["linear"], ""),
    ],
)
def test_equalities_that_no_solver_satisfies_are_named_at_loading(tmp_path, caplog, equality, kind):
    arm(tmp_path, equality)
    messages = [record.getMessage() for record in caplog.records]
    assert (
        (len(messages) == 1 and f"of the kind {kind} are not kept" in messages[0])
        if kind
        else not messages
    )
