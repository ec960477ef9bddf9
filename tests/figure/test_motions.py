"""Walk, reach, bend and jump, judged by MuJoCo on the true shapes (``benchmarks.figure``)."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.figure.gait import measure_gait
from benchmarks.figure.motion import MotionMeasure, measure_motion
from robot_ik.errors import InvalidGoalError
from robot_ik.figure import jump as jump_module
from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import reach_ball
from robot_ik.figure.balance import derivatives, plan_center
from robot_ik.figure.figure import Figure
from robot_ik.figure.footprints import prints_of, shuffle_prints, walk_prints
from robot_ik.figure.gait import AIR, SHUFFLE
from robot_ik.figure.hull import hull_margin
from robot_ik.figure.jump import jump
from robot_ik.figure.walk import Walk, walk
from robot_ik.geometry import axis_rotations

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def straight(figure: Figure) -> Walk:
    start = prints_of(figure, figure.home)
    return walk(figure, figure.home, walk_prints(figure, start, np.array([5.0, 0, 0])))


def require_feet(measure: MotionMeasure) -> None:
    """The feet neither slip nor sink, and no joint breaks its limits."""
    assert measure.slip_mm <= 0.1
    assert measure.drift_mm <= 0.1
    assert measure.penetration_mm <= 0.5
    assert measure.outside_limits == 0
    assert measure.too_fast == 0


def palm_error(figure: Figure, q: Array, ball: tuple[float, ...]) -> float:
    """Return the least distance of the right palm from a ball in frames, m."""
    return min(float(np.linalg.norm(figure.pose(row, "right_hand")[0] - ball)) for row in q)


def test_a_walk_neither_slips_nor_falls(figure: Figure, straight: Walk) -> None:
    measure = measure_motion(figure, straight.frames.q, straight.contact)
    require_feet(measure)
    assert measure.self_contact == 0
    assert straight.frames.error.max() < 1e-5
    assert measure.inside >= 0.95
    assert measure.nearly_inside >= 0.98
    assert measure.worst_margin_mm >= -60
    assert measure.least_force >= 0.7
    assert measure.largest_force <= 1.3
    assert measure.speed_change <= 2.0  # heel strikes, too


def test_a_walk_is_human(figure: Figure, straight: Walk) -> None:
    """The norm of the curves is that of Schwartz et al. 2008."""
    gait = measure_gait(figure, straight)
    assert gait.correlation["hip"] >= 0.97
    assert gait.correlation["knee"] >= 0.96
    assert gait.correlation["ankle"] >= 0.94
    assert gait.rms_deg["hip"] <= 6
    assert gait.rms_deg["knee"] <= 8
    assert gait.rms_deg["ankle"] <= 7
    assert 1.1 <= gait.speed <= 1.25
    assert 0.62 <= gait.step <= 0.72
    assert 100 <= gait.cadence <= 113
    assert 0.58 <= gait.stance <= 0.65
    assert 25 <= gait.vertical_mm <= 50
    assert 30 <= gait.lateral_mm <= 65
    assert 10 <= gait.clearance_mm <= 25


@pytest.mark.parametrize(
    ("distance", "course_deg", "turn_deg"),
    [(3.6, 33.7, 26.3), (1.7, 48.0, 48.0), (1.4, -20.0, 48.0), (1.05, -48.0, 48.0)],
)
def test_a_walk_along_a_curve_keeps_its_balance(
    figure: Figure, distance: float, course_deg: float, turn_deg: float
) -> None:
    """No joint's speed changes suddenly and no foot misses its print, also within a metre."""
    course, heading = np.radians([course_deg, course_deg + turn_deg])
    goal = np.array([distance * np.cos(course), distance * np.sin(course), heading])
    prints = walk_prints(figure, prints_of(figure, figure.home), goal)
    curve = walk(figure, figure.home, prints)
    measure = measure_motion(figure, curve.frames.q, curve.contact)
    require_feet(measure)
    assert measure.self_contact == 0
    assert measure.inside >= 0.95
    assert measure.nearly_inside >= 0.98
    assert measure.speed_change <= 2.02
    assert curve.frames.error.max() < 1e-5


def test_a_walk_ends_exactly_at_its_goal(figure: Figure, straight: Walk) -> None:
    assert figure.stance(straight.frames.q[-1]) == pytest.approx([5.0, 0.0, 0.0], abs=1e-6)
    last_change = figure.robot.difference(straight.frames.q[-2], straight.frames.q[-1])
    assert np.abs(last_change).max() < 2e-3


@pytest.mark.parametrize("goal", [(0.0, 0.0, np.pi), (0.0, 0.4, 0.0), (-0.3, 0.0, 0.0)])
def test_small_steps_reach_every_stance_without_crossing_legs(
    figure: Figure, goal: tuple[float, float, float]
) -> None:
    prints = shuffle_prints(figure, prints_of(figure, figure.home), np.array(goal))
    steps = walk(figure, figure.home, prints, SHUFFLE)
    measure = measure_motion(figure, steps.frames.q, steps.contact)
    require_feet(measure)
    assert measure.self_contact == 0
    assert measure.inside >= 0.95
    end = figure.stance(steps.frames.q[-1])
    assert end[:2] == pytest.approx(goal[:2], abs=1e-6)
    assert abs(np.cos(end[2] - goal[2])) > 1 - 1e-9


@pytest.mark.parametrize(
    ("kind", "ball"),
    [
        ("reach", (0.45, -0.25, 1.35)),
        ("reach", (0.3, -0.15, 1.85)),
        ("bend", (0.45, -0.25, 0.25)),
        ("bend", (0.5, 0.0, 0.4)),
        # So near that the fastest motion changes a joint's speed suddenly.
        ("reach", (0.31, -0.07, 0.87)),
        # On the straight path the forearm would touch the belly.
        ("reach", (0.21, -0.17, 1.65)),
        # With the fastest hand the zero-moment point would be beside the soles.
        ("reach", (0.475, -0.025, 0.845)),
    ],
)
def test_the_hand_ends_at_the_ball_in_balance(
    figure: Figure, kind: str, ball: tuple[float, ...]
) -> None:
    """The motion is the same anywhere in the world."""
    stance = (1.0, 2.0, 0.7)
    world_ball = axis_rotations("z", stance[2]) @ np.array(ball) + [stance[0], stance[1], 0.0]
    start = figure.placed(figure.home, *stance)
    motion = reach_ball(figure, start, world_ball, "right", kind)
    hand = figure.robot.measure(motion.q[-1], "right_hand").position
    assert hand == pytest.approx(world_ball, abs=1e-3)
    measure = measure_motion(figure, motion.q, motion.contact)
    require_feet(measure)
    assert measure.inside == 1.0
    assert measure.self_contact == 0
    assert motion.error.max() < 1e-5
    assert measure.speed_change <= 2.0


def test_a_bend_from_a_random_start_keeps_its_toes_on_the_floor(figure: Figure) -> None:
    motion = reach_ball(figure, figure.home, np.array([0.28, -0.08, 0.17]), "right", "bend")
    measure = measure_motion(figure, motion.q, motion.contact)
    require_feet(measure)
    assert measure.inside == 1.0


@pytest.mark.parametrize("ball", [(0.2, -0.2, 2.3), (0.42, -0.15, 2.5)])
def test_a_jump_flies_by_its_own_momentum(
    figure: Figure, abilities: Abilities, ball: tuple[float, ...]
) -> None:
    """The second ball is at the rim and needs the fastest jump."""
    speed = abilities.take_off(np.array(ball), "right")
    assert speed is not None
    motion = jump(figure, figure.home, np.array(ball), "right", speed)
    assert palm_error(figure, motion.q, ball) <= 0.005
    measure = measure_motion(figure, motion.q, motion.contact, speeds="jump")
    require_feet(measure)
    assert measure.self_contact == 0
    assert measure.inside >= 0.8
    in_air = np.flatnonzero(motion.contact[:, 0] == AIR)
    heights = figure.centers(motion.q[in_air])[:, 2]
    acceleration = np.diff(heights, n=2) * 60.0**2
    assert acceleration == pytest.approx(np.full(len(acceleration), -9.81), abs=0.15)
    _, _, velocity = derivatives(figure, motion.q)
    changes = np.abs(np.diff(velocity[in_air[0] : in_air[-1], 6:], axis=0))
    assert changes.max() <= 9.0, "a joint's speed changes suddenly about the apex"


@pytest.mark.parametrize(
    "ball",
    [(0.51, -0.01, 2.47), (0.08, -0.02, 2.39)],
    ids=["other arm at the belly", "acting arm at the head"],
)
def test_a_jump_with_self_contact_is_replaced_by_a_variant(
    figure: Figure, abilities: Abilities, ball: tuple[float, ...]
) -> None:
    speed = abilities.take_off(np.array(ball), "right")
    assert speed is not None
    motion = jump(figure, figure.home, np.array(ball), "right", speed)
    measure = measure_motion(figure, motion.q, motion.contact, speeds="jump")
    require_feet(measure)
    assert palm_error(figure, motion.q, ball) <= 0.005
    assert measure.self_contact == 0


def test_no_jump_is_tried_twice(figure: Figure, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies touch at the fastest take-off. The only variant moves the arm aside, at this speed."""
    plans = []
    plan_jump = jump_module.plan_jump

    def counted(*arguments: Any) -> jump_module.JumpPlan:
        plans.append(arguments)
        return plan_jump(*arguments)

    monkeypatch.setattr(jump_module, "plan_jump", counted)
    jump(figure, figure.home, np.array([0.024, -0.028, 2.582]), "right", 2.6)
    assert len(plans) == 2


def test_a_jump_too_high_is_refused(figure: Figure) -> None:
    with pytest.raises(InvalidGoalError, match=r"more than 2\.6 m/s"):
        jump(figure, figure.home, np.array([0.2, 0.0, 3.0]), "right", 3.5)


def test_a_figure_that_faces_backwards_walks_on(figure: Figure) -> None:
    """The yaws of the feet are a little less than π and a little more than −π."""
    turned = figure.posture({"left_hip_yaw": 1e-6, "right_hip_yaw": 1e-6})
    q = figure.placed(turned, 0.0, 0.0, np.pi)
    prints = walk_prints(figure, prints_of(figure, q), np.array([-2.0, 0.0, np.pi]))
    assert walk(figure, q, prints).frames.error.max() < 1e-5


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
    residual = np.diff(x, n=2, axis=0) / h**2 - omega**2 * (x - p)[1:-1]
    is_smooth = np.all([np.abs(t[1:-1] - time) > 2 * h for time, _ in nodes], axis=0)
    assert np.abs(residual[is_smooth]).max() < 1e-3
    assert x[0] == pytest.approx([0.02, 0.0])
    assert np.abs(x[1] - x[0]).max() / h < 1e-2
    assert np.abs((x[-1] - x[-2]) / h).max() < 1e-2


def test_the_margin_of_a_hull() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5]])
    assert hull_margin(square, np.array([0.5, 0.25])) == pytest.approx(0.25)
    assert hull_margin(square, np.array([1.3, 1.4])) == pytest.approx(-0.5)
    assert hull_margin(square[:2], np.array([0.5, 0.1])) == pytest.approx(-0.1)
