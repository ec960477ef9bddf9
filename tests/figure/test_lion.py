"""The lion: every paw reaches balls on the other three, and the lion returns to its pose."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik import load_robot
from robot_ik.errors import ModelError, TrajectoryError
from robot_ik.figure.hull import hull, hull_edges, hull_margin, inset
from robot_ik.figure.lion import MARGIN, Lion
from robot_ik.motion import Keyframes

Array = NDArray[np.float64]

BALLS = {
    "front_left_paw": (0.85, 0.25, 0.35),
    "front_right_paw": (0.9, -0.2, 0.6),
    "hind_left_paw": (-0.95, 0.25, 0.35),
    "hind_right_paw": (-0.9, -0.3, 0.2),
}
RATE = 15.0


@pytest.fixture(scope="module")
def lion() -> Lion:
    return Lion()


@pytest.mark.parametrize("paw", BALLS)
def test_a_paw_reaches_its_ball_on_the_other_three(lion: Lion, paw: str) -> None:
    ball = np.array(BALLS[paw])
    decision = lion.decide(ball)
    assert decision.arm == paw
    assert "reaches it" in decision.reason
    motion = lion.reach(ball, rate=RATE)
    require_standing(lion, motion, paw)
    require_rest_at_the_ends(lion, motion)

    robot = lion.robot
    distances = [float(np.linalg.norm(robot.measure(q, paw).position - ball)) for q in motion.q]
    assert min(distances) < 2e-3

    # The lion looks at a ball in front of it, and to the side of a ball behind it.
    angles_deg = [gaze_error_deg(lion, q, ball) for q in motion.q]
    is_in_front = ball[0] > 0.5
    assert min(angles_deg) < (5.0 if is_in_front else angles_deg[0] - 20.0)


def require_standing(lion: Lion, motion: Keyframes, paw: str) -> None:
    """The other paws stay, and the centre of mass is above their triangle."""
    robot = lion.robot
    prints = {name: robot.measure(lion.relaxed, name) for name in lion.paws}
    lifted_frames = 0
    for q in motion.q:
        assert not robot.outside(q)
        pose = robot.measure(q, paw)
        assert pose.position[2] > -1e-6
        for other in lion.paws:
            if other != paw:
                distance, angle = robot.measure(q, other).distance(prints[other])
                assert distance < 1e-4
                assert angle < 1e-3
        if pose.distance(prints[paw])[0] > 1e-3:
            lifted_frames += 1
            center = robot.center_of_mass(q)[:2]
            assert hull_margin(lion.support(paw), center) > 0.9 * MARGIN
    assert lifted_frames > len(motion.q) // 3


def require_rest_at_the_ends(lion: Lion, motion: Keyframes) -> None:
    """The motion begins and ends relaxed, and has no jump."""
    assert (motion.q[0] == lion.relaxed).all()
    assert (motion.q[-1] == lion.relaxed).all()
    changes = [np.abs(lion.robot.difference(a, b)).max() for a, b in pairwise(motion.q)]
    assert max(changes) * RATE < 4.0
    assert changes[-1] < 0.02


def gaze_error_deg(lion: Lion, q: Array, ball: Array) -> float:
    """Return the angle between the gaze and the direction to a ball, degrees."""
    gaze = lion.robot.measure(q, "gaze")
    to_ball = ball - gaze.position
    cosine = gaze.rotation[:, 0] @ to_ball / np.linalg.norm(to_ball)
    return float(np.degrees(np.arccos(cosine)))


@pytest.mark.parametrize(
    ("ball", "reason"),
    [
        ((3.0, 0.0, 1.0), "no paw reaches it"),
        ((0.5, 0.0, -0.2), "200 mm under the floor"),
        ((np.nan, 0.0, 0.0), "no ball"),
    ],
)
def test_nothing_is_done_for_a_ball_out_of_reach(
    lion: Lion, ball: tuple[float, ...], reason: str
) -> None:
    decision = lion.decide(ball)
    assert decision.arm is None
    assert reason in decision.reason
    with pytest.raises(TrajectoryError, match="does not reach"):
        lion.reach(ball)


def test_a_model_without_paws_is_refused() -> None:
    with pytest.raises(ModelError, match="has the paws none"):
        Lion(load_robot("puma560"))
    with pytest.raises(TrajectoryError, match="there is no paw 'left'"):
        Lion().reach((0.9, -0.2, 0.6), "left")


def test_a_point_comes_inside_the_support() -> None:
    edges = hull_edges(hull(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])))
    inside = np.array([0.2, 0.3])
    assert (inset(*edges, inside, 0.05) == inside).all()
    moved = inset(*edges, np.array([0.8, 0.8]), 0.05)
    assert moved.min() >= 0.05
    assert (1.0 - moved.sum()) / np.sqrt(2.0) == pytest.approx(0.05)
