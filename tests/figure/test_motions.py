"""Walk, reach, bend, jump and interruptions, judged by MuJoCo on the true shapes (``bench.figure``)."""

import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.bench.figure import MotionMeasure, measure_gait, measure_motion
from robot_ik.errors import InvalidGoalError
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import take
from robot_ik.figure.balance import derivatives, hull_margin, plan_center
from robot_ik.figure.figure import Figure
from robot_ik.figure.gait import SHUFFLE, Walk, prints_of, shuffle_prints, walk, walk_prints
from robot_ik.figure.jump import jump, jump_slices
from robot_ik.geometry import axis_rotations

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def straight(figure: Figure) -> Walk:
    return walk(
        figure, figure.home, walk_prints(figure, prints_of(figure, figure.home), np.array([5.0, 0, 0]))
    )


def require_feet(measure: MotionMeasure) -> None:
    assert measure.slip <= 0.1 and measure.drift <= 0.1 and measure.penetration <= 0.5
    assert measure.outside_limits == 0 and measure.too_fast == 0


def test_a_walk_neither_slips_nor_falls(figure: Figure, straight: Walk) -> None:
    measure = measure_motion(figure, straight.frames.q, straight.contact)
    require_feet(measure)
    assert measure.self_contact == 0 and straight.frames.error.max() < 1e-5
    assert measure.inside >= 0.95 and measure.close >= 0.98 and measure.worst >= -60
    assert measure.force[0] >= 0.7 and measure.force[1] <= 1.3
    assert measure.jump <= 2.0  # heel strikes, too


def test_a_walk_is_a_mans(figure: Figure, straight: Walk) -> None:
    """Schwartz et al. 2008 for the curves."""
    gait = measure_gait(figure, straight)
    assert (
        gait.correlation["hip"] >= 0.97
        and gait.correlation["knee"] >= 0.96
        and gait.correlation["ankle"] >= 0.94
    )
    assert gait.rms_deg["hip"] <= 6 and gait.rms_deg["knee"] <= 8 and gait.rms_deg["ankle"] <= 7
    assert 1.1 <= gait.speed <= 1.25 and 0.62 <= gait.step <= 0.72 and 100 <= gait.cadence <= 113
    assert 0.58 <= gait.stance <= 0.65 and 25 <= gait.vertical <= 50 and 30 <= gait.lateral <= 65
    assert 10 <= gait.clearance <= 25


@pytest.mark.parametrize(
    ("far", "course_deg", "turn_deg"),
    [(3.6, 33.7, 26.3), (1.7, 48.0, 48.0), (1.4, -20.0, 48.0), (1.05, -48.0, 48.0)],
)
def test_a_walk_along_a_curve_keeps_its_balance(
    figure: Figure, far: float, course_deg: float, turn_deg: float
) -> None:
    """Sharp ones, too, within a metre: no joint's speed changes at once, no foot misses its print."""
    course, end = np.radians([course_deg, course_deg + turn_deg])
    goal = np.array([far * np.cos(course), far * np.sin(course), end])
    found = walk(figure, figure.home, walk_prints(figure, prints_of(figure, figure.home), goal))
    measure = measure_motion(figure, found.frames.q, found.contact)
    require_feet(measure)
    assert measure.self_contact == 0 and measure.inside >= 0.95 and measure.close >= 0.98
    assert measure.jump <= 2.02 and found.frames.error.max() < 1e-5


def test_a_walk_ends_exactly_where_it_shall(figure: Figure, straight: Walk) -> None:
    assert figure.stance(straight.frames.q[-1]) == pytest.approx([5.0, 0.0, 0.0], abs=1e-6)
    still = figure.robot.difference(straight.frames.q[-2], straight.frames.q[-1])
    assert np.abs(still).max() < 2e-3


@pytest.mark.parametrize("goal", [(0.0, 0.0, np.pi), (0.0, 0.4, 0.0), (-0.3, 0.0, 0.0)])
def test_small_steps_lead_anywhere_without_crossing_legs(
    figure: Figure, goal: tuple[float, float, float]
) -> None:
    prints = shuffle_prints(figure, prints_of(figure, figure.home), np.array(goal))
    found = walk(figure, figure.home, prints, SHUFFLE)
    measure = measure_motion(figure, found.frames.q, found.contact)
    require_feet(measure)
    assert measure.self_contact == 0 and measure.inside >= 0.95
    end = figure.stance(found.frames.q[-1])
    assert end[:2] == pytest.approx(goal[:2], abs=1e-6) and abs(np.cos(end[2] - goal[2])) > 1 - 1e-9


@pytest.mark.parametrize(
    ("kind", "ball"),
    [
        ("reach", (0.45, -0.25, 1.35)),
        ("reach", (0.3, -0.15, 1.85)),
        ("bend", (0.45, -0.25, 0.25)),
        ("bend", (0.5, 0.0, 0.4)),
        ("reach", (0.31, -0.07, 0.87)),  # so near that the fastest way changes a joint's speed at once
        ("reach", (0.21, -0.17, 1.65)),  # straight there the forearm would touch the belly
        ("reach", (0.475, -0.025, 0.845)),  # as fast as the hand may, the weight would be beside the soles
    ],
)
def test_the_hand_ends_at_the_ball_in_balance(figure: Figure, kind: str, ball: tuple[float, ...]) -> None:
    """Anywhere in the world: the same motion, placed."""
    stance = (1.0, 2.0, 0.7)
    there = axis_rotations("z", stance[2]) @ np.array(ball) + [stance[0], stance[1], 0.0]
    motion = take(figure, figure.placed(figure.home, *stance), there, "right", kind)
    assert figure.robot.measure(motion.q[-1], "right_hand").position == pytest.approx(there, abs=1e-3)
    measure = measure_motion(figure, motion.q, motion.contact)
    require_feet(measure)
    assert measure.inside == 1.0 and measure.self_contact == 0 and motion.error.max() < 1e-5
    assert measure.jump <= 2.0


def test_a_bend_found_from_a_random_pose_keeps_its_toes_on_the_floor(figure: Figure) -> None:
    motion = take(figure, figure.home, np.array([0.28, -0.08, 0.17]), "right", "bend")
    measure = measure_motion(figure, motion.q, motion.contact)
    require_feet(measure)
    assert measure.inside == 1.0


@pytest.mark.parametrize("ball", [(0.2, -0.2, 2.3), (0.42, -0.15, 2.5)])
def test_a_jump_flies_by_its_own_momentum(
    figure: Figure, abilities: Abilities, ball: tuple[float, ...]
) -> None:
    """Also to the rim, as fast as a man's: soles that neither slip nor flail, the palm on the ball."""
    speed = abilities.take_off(np.array(ball), "right")
    assert speed is not None
    motion = jump(figure, figure.home, np.array(ball), "right", speed)
    near = min(float(np.linalg.norm(figure.pose(row, "right_hand")[0] - ball)) for row in motion.q)
    assert near <= 0.005
    measure = measure_motion(figure, motion.q, motion.contact, speeds="jump")
    require_feet(measure)
    assert measure.self_contact == 0 and measure.inside >= 0.8
    air = np.flatnonzero(motion.contact[:, 0] == 0)
    height = np.array([figure.center(row)[2] for row in motion.q[air]])
    fall = np.diff(height, n=2) * 60.0**2
    assert fall == pytest.approx(np.full(len(fall), -9.81), abs=0.15)
    _, _, forward = derivatives(figure, motion.q)
    whip = np.abs(np.diff(forward[air[0] : air[-1], 6:], axis=0)).max()
    assert whip <= 9.0, "a joint's speed changes about the apex"


@pytest.mark.parametrize(
    "ball",
    [(0.51, -0.01, 2.47), (0.08, -0.02, 2.39)],
    ids=["other arm at the belly", "acting arm at the head"],
)
def test_a_jump_in_which_bodies_would_touch_is_made_another_way(
    figure: Figure, abilities: Abilities, ball: tuple[float, ...]
) -> None:
    speed = abilities.take_off(np.array(ball), "right")
    assert speed is not None
    motion = jump(figure, figure.home, np.array(ball), "right", speed)
    near = min(float(np.linalg.norm(figure.pose(row, "right_hand")[0] - ball)) for row in motion.q)
    measure = measure_motion(figure, motion.q, motion.contact, speeds="jump")
    require_feet(measure)
    assert near <= 0.005 and measure.self_contact == 0


def test_no_jump_is_tried_twice(figure: Figure) -> None:
    """At the fastest take-off bodies touch, and there is one other way: the arm aside, no faster."""

    def slices(ball: tuple[float, float, float], speed: float) -> int:
        return sum(1 for _ in jump_slices(figure, figure.home, np.array(ball), "right", speed))

    assert slices((0.024, -0.028, 2.582), 2.6) < 2.5 * slices((0.2, -0.2, 2.35), 2.5)


def test_a_jump_too_high_is_refused(figure: Figure) -> None:
    with pytest.raises(InvalidGoalError, match=r"more than 2\.6 m/s"):
        jump(figure, figure.home, np.array([0.2, 0.0, 3.0]), "right", 3.5)


def test_feet_either_side_of_backwards_walk_on(figure: Figure) -> None:
    """Yaws of π less and −π more than a little: as numbers a whole turn apart, which a foot would make."""
    turned = figure.posture({"left_hip_yaw": 1e-6, "right_hip_yaw": 1e-6})
    q = figure.placed(turned, 0.0, 0.0, np.pi)
    found = walk(figure, q, walk_prints(figure, prints_of(figure, q), np.array([-2.0, 0.0, np.pi])))
    assert found.frames.error.max() < 1e-5


def test_the_center_of_mass_follows_its_zero_moment_point() -> None:
    """x'' = ω² (x − p) by finite differences, at rest at both ends."""
    nodes = [
        (0.0, np.zeros(2)),
        (0.5, np.array([0.0, 0.1])),
        (1.0, np.array([0.1, -0.1])),
        (1.4, np.array([0.1, 0.0])),
        (3.5, np.array([0.1, 0.0])),
    ]
    omega = 3.2
    t = np.linspace(0.0, 3.5, 7001)
    x, p = plan_center(nodes, np.array([0.02, 0.0]), omega, t)
    h = t[1] - t[0]
    force = np.diff(x, n=2, axis=0) / h**2 - omega**2 * (x - p)[1:-1]
    smooth = np.all([np.abs(t[1:-1] - at) > 2 * h for at, _ in nodes], axis=0)
    assert np.abs(force[smooth]).max() < 1e-3
    assert x[0] == pytest.approx([0.02, 0.0]) and np.abs(x[1] - x[0]).max() / h < 1e-2
    assert np.abs((x[-1] - x[-2]) / h).max() < 1e-2


def test_the_margin_of_a_hull() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    assert hull_margin(square, np.array([0.5, 0.25])) == pytest.approx(0.25)
    assert hull_margin(square, np.array([1.3, 1.4])) == pytest.approx(-0.5)
    assert hull_margin(square[:2], np.array([0.5, 0.1])) == pytest.approx(-0.1)
