"""Bases, tools, chosen joints, stiffness and supports of robots, measured by MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import (
    InvalidModelError,
    ModelError,
    UnknownFrameError,
    UnknownJointError,
    UnsupportedJointError,
)
from robot_ik.goals import PositionGoal
from robot_ik.robot_file import find_robot
from robot_ik.support import supported_frames


def body_positions(robot: rik.Robot, q: np.ndarray) -> dict[str, np.ndarray]:
    data = robot.data_at(q)
    names = [robot.model.body(b).name for b in range(1, robot.model.nbody)]
    return {name: data.body(name).xpos.copy() for name in names}


def test_only_joints_between_base_and_tool_move() -> None:
    figure = rik.load_robot("humanoid").with_tool("left_hand")
    arm = figure.with_base("left_upper_arm")
    assert arm.model is figure.model and arm.tool == "left_hand"
    assert set(arm.joints) == {"left_elbow_pitch", "left_wrist_pitch", "left_wrist_yaw"}
    home = body_positions(arm, arm.home)
    turned = body_positions(arm, arm.sample(np.random.default_rng(0)))
    moved = {name for name in home if not np.allclose(home[name], turned[name])}
    assert moved == {"left_hand"}, "the forearm only rotates, and no other body moves"
    assert np.allclose(arm.measure(arm.home).position, figure.measure(figure.home).position)
    q = arm.sample(np.random.default_rng(1))
    assert np.allclose(arm.forward(q).matrix, arm.measure(q).matrix, atol=1e-12)


def test_a_base_that_does_not_carry_the_tool_is_refused() -> None:
    figure = rik.load_robot("humanoid")
    assert figure.joints_between("head") == ()
    with pytest.raises(UnsupportedJointError, match="right_hand"):
        figure.with_base("head")
    with pytest.raises(UnknownFrameError):
        figure.with_base("wing")
    with pytest.raises(UnknownFrameError, match="left_hand"):
        figure.with_tool("left_hnd")


def test_chosen_joints_keep_their_order_limits_and_stiffness() -> None:
    robot = rik.load_robot("puma560").with_stiffness({"joint3": 4.0})
    some = robot.with_joints(["joint5", "joint3"])
    assert some.joints == ("joint3", "joint5")
    assert np.array_equal(some.lower, robot.lower[[2, 4]])
    assert some.stiffness.tolist() == [4.0, 1.0]
    assert robot.with_joints(robot.joints) is robot
    with pytest.raises(UnknownJointError):
        robot.with_joints(["joint9"])
    with pytest.raises(UnsupportedJointError):
        robot.with_joints([])


def test_a_stiff_joint_moves_less() -> None:
    robot = rik.load_robot("puma560")
    goal = PositionGoal(None, robot.measure(robot.home).position + np.array((0.0, 0.05, 0.0)))
    stiff = robot.with_stiffness({"joint1": 100.0})
    changes = [
        abs(rik.solve(one, goal, solver="dls", start=robot.home).q[0] - robot.home[0])
        for one in (robot, stiff)
    ]
    assert changes[1] < 0.2 * changes[0]
    for wrong in (0.0, -1.0, np.nan, "much"):
        with pytest.raises(ModelError, match="joint1"):
            robot.with_stiffness({"joint1": wrong})


def test_a_chain_is_named_by_its_number_of_links() -> None:
    chain = rik.load_robot("chain:5")
    assert chain.name == "chain5" and chain.tool == "tip" and chain.nv == 15
    assert np.allclose(chain.measure(chain.home).position, (0.0, 0.0, 5.0))
    assert chain.with_base("link2").joints == ("joint3", "joint4", "joint5")
    assert find_robot("chain:3")[1].title.startswith("Chain of 3")
    for wrong in ("chain:", "chain:0", "chain:-2", "chain:501", "chain:five"):
        with pytest.raises(InvalidModelError, match="links"):
            rik.load_robot(wrong)


def test_optional_limits_hold_on_request_only() -> None:
    arm = rik.load_robot("seven_segment")
    limited = arm.with_optional_limits()
    for name, lower, upper in zip(arm.joints, limited.lower, limited.upper, strict=True):
        bound = np.inf if name.endswith("twist") else np.radians(45.0)
        assert lower == -bound and upper == bound
    assert np.isinf(arm.upper).all()
    puma = rik.load_robot("puma560")
    assert puma.with_optional_limits() is puma


def test_feet_stay_while_a_hand_reaches() -> None:
    figure = rik.load_robot("humanoid")
    assert supported_frames(figure, ["right_hand"]) == ("left_foot", "right_foot")
    target = figure.measure(figure.home).position + np.array((0.25, 0.0, 0.3))
    goal = PositionGoal("right_hand", target, priority=1)
    solution = rik.solve(figure, [*rik.support_goals(figure, ["right_hand"]), goal])
    assert np.linalg.norm(figure.measure(solution.q).position - target) < 1e-3
    for foot in ("left_foot", "right_foot"):
        home = figure.measure(figure.home, foot)
        metres, radians = figure.measure(solution.q, foot).distance(home)
        assert metres < 1e-4 and radians < 1e-3


def test_a_moved_foot_is_no_support() -> None:
    lion = rik.load_robot("lion")
    assert "front_right_paw" not in supported_frames(lion, ["front_right_paw"])
    assert len(supported_frames(lion, ["nose"])) == 4
    neck = lion.with_joints(["neck", "head"])
    assert supported_frames(neck, ["nose"]) == (), "no joint moves the paws"
    assert rik.support_goals(rik.load_robot("puma560"), ["gripper"]) == []


def test_held_joints_stay_in_q_and_do_not_move() -> None:
    robot = rik.load_robot("puma560")
    q = robot.sample(np.random.default_rng(3))
    held = robot.with_held(["joint1", "joint4"], q)
    assert held.joints == robot.joints
    wanted = q.copy()
    wanted[[1, 2]] += (0.1, -0.2)
    goal = PositionGoal(None, robot.measure(wanted).position)
    for solver in ("lm", "dls", "auto"):
        solution = rik.solve(held, goal, solver=solver, start=q)
        assert solution.converged, solver
        assert np.allclose(solution.q[[0, 3]], q[[0, 3]], atol=1e-9), solver
    with pytest.raises(UnknownJointError):
        robot.with_held(["joint7"], q)
    figure = rik.load_robot("humanoid")
    with pytest.raises(UnsupportedJointError, match="root"):
        figure.with_held(["root"], figure.home)
