"""The lion: every paw reaches balls in its reach set on the other three, and he comes back to rest."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik import load_robot
from robot_ik.errors import ModelError, TrajectoryError
from robot_ik.figure.balance import hull, hull_edges, hull_margin, inset
from robot_ik.figure.lion import MARGIN, Lion

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
    robot, ball = lion.robot, np.array(BALLS[paw])
    decision = lion.decide(ball)
    assert decision.arm == paw and "reaches it" in decision.reason
    motion = lion.reach(ball, rate=RATE)
    prints = {p: robot.measure(lion.relaxed, p) for p in lion.paws}
    corners = lion.support(paw)
    nearest, aims, lifted_frames = np.inf, [], 0
    for q in motion.q:
        assert not robot.outside(q)
        here = robot.measure(q, paw)
        assert here.position[2] > -1e-6
        lifted = here.distance(prints[paw])[0] > 1e-3
        lifted_frames += lifted
        for p in lion.paws:
            if p != paw:
                metres, radians = robot.measure(q, p).distance(prints[p])
                assert metres < 1e-4 and radians < 1e-3
        if lifted:  # the centre of mass is inside the triangle of the paws that stand
            mass = robot.center_of_mass(q)[:2]
            assert hull_margin(corners, mass) > 0.9 * MARGIN
        nearest = min(nearest, float(np.linalg.norm(here.position - ball)))
        gaze = robot.measure(q, "gaze")
        way = ball - gaze.position
        aims.append(float(np.degrees(np.arccos(gaze.rotation[:, 0] @ way / np.linalg.norm(way)))))
    assert nearest < 2e-3 and lifted_frames > len(motion) // 3
    # He looks at it when it lies before him, else to its side.
    assert min(aims) < (5.0 if ball[0] > 0.5 else aims[0] - 20.0)
    assert (motion.q[0] == lion.relaxed).all() and (motion.q[-1] == lion.relaxed).all()
    steps = [np.abs(robot.difference(a, b)).max() for a, b in zip(motion.q[:-1], motion.q[1:], strict=True)]
    assert max(steps) * RATE < 4.0 and steps[-1] < 0.02  # no jump, the last frame is no exception


@pytest.mark.parametrize(
    ("ball", "reason"),
    [
        ((3.0, 0.0, 1.0), "no paw reaches it"),
        ((0.5, 0.0, -0.2), "200 mm under the floor"),
        ((np.nan, 0.0, 0.0), "no ball"),
    ],
)
def test_a_ball_that_no_paw_reaches_is_left_alone(lion: Lion, ball: tuple[float, ...], reason: str) -> None:
    decision = lion.decide(ball)
    assert decision.arm is None and reason in decision.reason
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
    assert moved.min() >= 0.05 and (1.0 - moved.sum()) / np.sqrt(2.0) == pytest.approx(0.05)
