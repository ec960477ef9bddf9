"""Dragging: pins hold, changes of the dragged or pinned frames cause no jump, weight shifts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.errors import InvalidGoalError, UnknownFrameError
from robot_ik.figure.motion.drag import Drag

Array = NDArray[np.float64]
RATE = 30.0
PAWS = ("front_left_paw", "front_right_paw", "hind_left_paw", "hind_right_paw")
SOLES = ("left_foot", "right_foot")
# What is dragged one after the other, and where to; what is pinned meanwhile.
CASES: dict[str, tuple[dict[str, tuple[float, float, float]], tuple[str, ...]]] = {
    "humanoid": (
        {"left_forearm": (0.15, 0.1, 0.2), "head": (0.1, 0.05, -0.1), "left_hand": (0.1, 0, 0.2)},
        SOLES,
    ),
    "lion": (
        {"head": (0.1, 0.1, -0.1), "tail_tip": (0, 0.2, 0.1), PAWS[0]: (0.1, 0.05, 0.1)},
        PAWS[1:],
    ),
    "puma560": ({"link5": (0.1, 0.2, 0.1), "gripper": (-0.1, 0.1, -0.1)}, ()),
}


def speeds(robot: rik.Robot, one: Array, two: Array) -> float:
    return float((np.abs(robot.difference(one, two)) * RATE / robot.velocity_limits).max())


@pytest.mark.parametrize("name", CASES)
def test_any_body_is_dragged_and_the_dragged_body_changes_without_a_jump(name: str) -> None:
    frames, pins = CASES[name]
    robot = rik.load_robot(name)
    drag = Drag(robot, pinned=pins, rate=RATE, speed=2.0)
    placed = {pin: robot.measure(drag.q, pin) for pin in pins}
    for frame, way in frames.items():
        before = drag.q
        drag.take(frame)
        assert speeds(robot, before, drag.step()) < 0.02  # taken where it is: it stays there
        begin = robot.measure(drag.q, frame).position
        for k in range(30):
            last = drag.q
            q = drag.step(begin + np.array(way) * min(1.0, k / 20))
            assert speeds(robot, last, q) <= 2.0 + 1e-9
            assert not robot.outside(q)
        assert np.linalg.norm(robot.measure(q, frame).position - begin - way) < 5e-3
        for pin in pins:
            metres, radians = robot.measure(q, pin).distance(placed[pin])
            assert metres < 1e-4 and radians < 1e-3


def test_the_pinned_base_changes_while_it_runs() -> None:
    robot = rik.load_robot("humanoid")
    drag = Drag(robot, "pelvis", pinned=["left_foot", "right_foot"], rate=RATE, speed=2.0)
    begin = robot.measure(drag.q, "pelvis").position
    for k in range(10):
        drag.step(begin - [0.0, 0.0, 0.01 * k])
    drag.pin("right_hand")
    drag.release("left_foot")
    hand = robot.measure(drag.q, "right_hand")
    assert speeds(robot, drag.q, drag.step()) < 0.1
    drag.take("left_foot")
    foot = robot.measure(drag.q, "left_foot").position
    for k in range(20):
        q = drag.step(foot + np.array([0.0, 0.0, 0.01 * k]))
    assert robot.measure(q, "left_foot").position[2] - foot[2] == pytest.approx(0.19, abs=5e-3)
    assert robot.measure(q, "right_hand").distance(hand)[0] < 1e-4


def test_a_target_out_of_reach_gives_the_nearest_pose_and_keeps_the_pins() -> None:
    robot = rik.load_robot("humanoid")
    drag = Drag(robot, "right_hand", pinned=["left_foot", "right_foot"], rate=RATE, speed=6.0)
    feet = [robot.measure(drag.q, foot) for foot in drag.pinned]
    begin = robot.measure(drag.q, "right_hand").position
    for k in range(60):
        last = drag.q
        q = drag.step(begin + np.array([3.0, 0.0, 1.0]) * min(1.0, k / 30))
        assert speeds(robot, last, q) <= 6.0 + 1e-9
    for foot, pose in zip(drag.pinned, feet, strict=True):
        assert robot.measure(q, foot).distance(pose)[0] < 1e-4
    assert robot.measure(q, "right_hand").position[0] > begin[0] + 0.4


@pytest.mark.parametrize(
    ("name", "onto", "free"),
    [("humanoid", ["left_foot"], "right_foot"), ("lion", PAWS[1:], PAWS[0])],
)
def test_weight_shifts_and_the_free_foot_lifts(name: str, onto: list[str], free: str) -> None:
    robot = rik.load_robot(name)
    drag = Drag(robot, pinned=[*onto, free], rate=RATE, speed=2.0, balance=True)
    middle = np.mean([robot.measure(drag.q, foot).position[:2] for foot in onto], axis=0)
    away = np.linalg.norm(robot.center_of_mass(drag.q)[:2] - middle)
    last = drag.q
    fastest = 0.0
    for q in drag.shift_weight(onto, 0.8):
        fastest = max(fastest, speeds(robot, last, q))
        last = q
    assert away > 0.03 and np.abs(robot.center_of_mass(drag.q)[:2] - middle).max() < 2e-4
    assert fastest <= 2.0 + 1e-9
    drag.release(free)
    drag.take(free)
    begin = robot.measure(drag.q, free).position
    for k in range(20):
        q = drag.step(begin + np.array([0.0, 0.0, 0.005 * k]))
    assert robot.measure(q, free).position[2] > begin[2] + 0.08
    assert np.abs(robot.center_of_mass(q)[:2] - middle).max() < 2e-4


def test_impossible_input_is_rejected() -> None:
    drag = Drag(rik.load_robot("puma560"), "gripper", pinned=["link2"])
    with pytest.raises(UnknownFrameError, match="gripper"):
        drag.take("griper")
    with pytest.raises(InvalidGoalError, match="'link2' is pinned"):
        drag.take("link2")
    with pytest.raises(InvalidGoalError, match="'gripper' is dragged"):
        drag.pin("gripper")
    with pytest.raises(UnknownFrameError):
        drag.release("link3")
    with pytest.raises(UnknownFrameError):
        list(drag.shift_weight("link3"))
    with pytest.raises(InvalidGoalError, match="finite"):
        drag.step((0.0, np.nan, 0.0))
