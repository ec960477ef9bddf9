"""Joint values to ticks and back for hinges, racks and swing arms, within the range."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import RANGE_TOLERANCE_TICKS, Direct, Gear, Joint, Pinion, SwingArm
from tests.hardware.joints import Twin, make_joint, with_servo, with_twin

POSITION = OperatingMode.POSITION
EXTENDED = OperatingMode.EXTENDED_POSITION
WX250S = SwingArm(0.014, 0.024)
VX300S = SwingArm(0.022, 0.036)
ALOHA_LEADER = SwingArm(0.020, 0.020)


def finger(swing: SwingArm = WX250S, **changes: object) -> Joint:
    """The gripper of a wx250s, its servo as the maker mounts it."""
    made = make_joint(
        "finger", 9, "XL430-W250", POSITION, 1, 2048, 0.015, 0.037, 0.05, 0.5, gear=swing
    )
    return with_servo(made, **changes)


@st.composite
def maps(draw: st.DrawFn) -> Joint:
    """Hinges, racks and swing arms whose range meets that of their mode."""
    kind = draw(st.sampled_from(["hinge", "rack", "swing"]))
    direction = draw(st.sampled_from([1, -1]))
    zero = draw(st.integers(0, 4095))
    ratio = draw(st.floats(0.05, 20.0))
    mode = draw(st.sampled_from([POSITION, EXTENDED]))
    gear: Gear = Direct(ratio)
    scale = 1.0
    if kind == "rack":
        scale = draw(st.floats(0.002, 0.05))
        gear = Pinion(scale, ratio)
    low = -7.0 * scale
    high = 7.0 * scale
    if kind == "swing":
        horn = draw(st.floats(0.005, 0.05))
        gear = SwingArm(horn, horn * draw(st.floats(1.0, 4.0)), ratio)
        low, high = gear.value_range
    lower = low + draw(st.floats(0.0, 0.9)) * (high - low)
    upper = lower + draw(st.floats(0.01, 1.0)) * (high - lower)
    joint = make_joint(
        "j", 1, "XM430-W350", mode, direction, zero, lower, upper, scale, scale, gear=gear
    )
    low, high = joint.limits
    assume(high - low >= joint.resolution)
    return joint


@given(maps(), st.floats(0, 1))
def test_what_is_sent_lies_within_the_range_in_ticks_and_in_angles(
    joint: Joint, part: float
) -> None:
    low, high = joint.limits
    assert joint.lower <= low < high <= joint.upper
    first, last = joint.ticks_range()
    goal = joint.goal(low + part * (high - low))
    assert first <= goal <= last
    assert low <= joint.value(goal) <= high
    if joint.servo.mode == POSITION:
        assert 0 <= first <= last <= 4095


@given(maps(), st.floats(0, 1))
def test_a_goal_is_within_a_tick_of_what_was_asked(joint: Joint, part: float) -> None:
    low, high = joint.limits
    q = low + part * (high - low)
    assert abs(joint.goal(q) - joint.position(q)) < 1.0 + 1e-6
    # The range is not cut by more than it must: a tick further out is outside.
    first, last = joint.ticks_range()
    for ticks in (first - 1, last + 1):
        assert not low + 1e-12 <= joint.value(ticks) <= high - 1e-12


@given(maps(), st.floats(1e-3, 2.0))
def test_on_the_way_back_from_outside_goals_are_not_pulled_in(joint: Joint, beyond: float) -> None:
    """An arm outside its range moves back at the caps: no goal jumps to the range."""
    for q in (joint.limits[0] - beyond * joint.lever, joint.limits[1] + beyond * joint.lever):
        assert joint.goal(q) == joint.nearest_ticks(q)


@given(maps(), st.floats(-10, 10))
def test_there_and_back_is_half_a_tick(joint: Joint, angle: float) -> None:
    q = angle * joint.lever
    assert joint.position(joint.value(joint.nearest_ticks(q))) == pytest.approx(
        joint.nearest_ticks(q), abs=1e-5
    )
    assert joint.ticks_between(joint.value(joint.nearest_ticks(q)), q) <= 0.5 + 1e-5


@given(maps(), st.floats(0.02, 0.98))
def test_the_slope_is_that_of_the_law(joint: Joint, part: float) -> None:
    low, high = joint.limits
    q = low + part * (high - low)
    step = 1e-4 * (high - low)
    slope = (joint.position(q + step) - joint.position(q - step)) / (2.0 * step)
    assert joint.ticks_per(q) == pytest.approx(slope, rel=1e-3)
    # Samples of the range find the steepest place to a thousandth: it has headroom of a half.
    assert abs(slope) <= joint.ticks_per_unit * 1.001
    assert 1.0 / abs(slope) <= joint.resolution * 1.001


@pytest.mark.parametrize(
    ("swing", "distance", "angle"),
    [
        # h, L and ranges of the fingers from the maker's files
        # (Interbotix/interbotix_ros_manipulators, URDF and config of wx250s, vx300s, aloha_wx250s);
        # the horn at their ends, rad, three digits.
        (WX250S, 0.015, -0.378),
        (WX250S, 0.037, 1.268),
        (VX300S, 0.021, -0.413),
        (VX300S, 0.057, 1.332),
        (ALOHA_LEADER, 0.0295, 0.830),
        (ALOHA_LEADER, 0.0, 0.0),
    ],
)
def test_swing_arms_of_the_makers(swing: SwingArm, distance: float, angle: float) -> None:
    assert swing.horn_angle(distance) == pytest.approx(angle, abs=7e-4)
    assert swing.distance(angle) == pytest.approx(distance, abs=2e-5)
    assert swing.distance(swing.horn_angle(distance)) == pytest.approx(distance, abs=1e-12)
    h = swing.horn
    length = swing.rod
    a = swing.horn_angle(distance)
    law = h * math.sin(a) + math.sqrt(max(length**2 - (h * math.cos(a)) ** 2, 0.0))
    assert law == pytest.approx(distance, abs=1e-12)


@given(st.floats(0.005, 0.05), st.floats(1.0, 4.0), st.floats(-4.0, 4.0), st.floats(1e-3, 1.0))
def test_a_swing_arm_goes_on_straight_beyond_its_dead_centres(
    horn: float, longer: float, angle: float, more: float
) -> None:
    """Every reading has one value, and a larger reading has a larger value."""
    swing = SwingArm(horn, horn * longer)
    assert swing.horn_angle(swing.distance(angle)) == pytest.approx(angle, abs=1e-7)
    assert swing.distance(angle + more) > swing.distance(angle)
    assert -math.pi / 2 < swing.horn_range[0] <= 0.0 < swing.horn_range[1] < math.pi / 2


def test_a_rack_that_fits_best_is_millimetres_off_where_the_swing_arm_is_exact() -> None:
    rack = replace(finger(zero_ticks=2048 - round(0.0199 / 0.0145 * 651.9)), gear=Pinion(0.0145))
    off = [abs(rack.value(finger().position(d)) - d) for d in (0.015, 0.020, 0.026, 0.032, 0.037)]
    assert 1.0e-3 < max(off) < 1.4e-3
    assert max(abs(finger().value(finger().position(d)) - d) for d in (0.015, 0.026, 0.037)) < 1e-12


def test_the_two_servos_of_a_swing_arm_share_its_law() -> None:
    joint = with_twin(finger(), Twin(10, -1, 1000))
    first, second = joint.servos
    for d in (0.016, 0.03):
        assert joint.position(d, second) - 1000 == pytest.approx(-(joint.position(d, first) - 2048))
    assert joint.limits == (0.015, 0.037)


def test_a_twin_has_its_own_reverse() -> None:
    first, second = with_twin(finger(reverse=True), Twin(10)).servos
    assert (first.reverse, second.reverse) == (True, False)
    assert with_twin(finger(), Twin(10, shadow=True)).servos[1].reverse is None
    assert with_twin(finger(), Twin(10, shadow=True, reverse=True)).servos[1].reverse is True


@settings(
    suppress_health_check=[HealthCheck.filter_too_much]
)  # most random ranges are wider than a revolution
@given(maps(), st.floats(0, 1), st.integers(-3, 3))
def test_a_reading_that_is_turns_off_is_found_where_the_range_is_under_a_turn(
    joint: Joint, part: float, turns: int
) -> None:
    """Wherever such a joint stands, it is never led back to its range from the wrong side."""
    first, last = joint.ticks_range()
    assume(joint.servo.mode == EXTENDED and last - first < 4096 - 2 * RANGE_TOLERANCE_TICKS)
    true = round(first + part * (last - first))
    assert joint.lost_revolutions(true - 4096 * turns) == turns


@given(maps(), st.integers(0, RANGE_TOLERANCE_TICKS))
def test_backlash_beyond_the_range_is_no_lost_turn(joint: Joint, beside: int) -> None:
    first, last = joint.ticks_range()
    assert joint.lost_revolutions(first - beside) == joint.lost_revolutions(last + beside) == 0


def test_a_joint_found_outside_a_small_range_is_led_back() -> None:
    joint = finger(mode=EXTENDED)
    assert joint.lost_revolutions(joint.ticks_range()[1] + 1000) == 0
    assert (
        with_servo(joint, mode=POSITION).lost_revolutions(joint.ticks_range()[1] + 3000) == 0
    )  # it cannot lose any
