"""Torque modes, and what a load does to current, PWM, temperature and shutdown."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.virtual.electrics import Load
from robot_ik.hardware.virtual.protocol import ErrorCode

CURRENT = OperatingMode.CURRENT
PWM = OperatingMode.PWM
HOLDING = OperatingMode.CURRENT_BASED_POSITION
VELOCITY = OperatingMode.VELOCITY
EXTENDED = OperatingMode.EXTENDED_POSITION
HEAVY = Load(gravity=1.0, friction=0.1)  # N m; XM430-W350: 4.1 N m at 2.3 A and 12 V
MILLIAMPERES_PER_NM = 1000 * 2.3 / 4.1

Make = Callable[..., Any]


def test_a_held_load_shows_as_current_and_its_sign_turns_with_the_lever(make_bench: Make) -> None:
    bench = make_bench(mode=EXTENDED, load=HEAVY)
    assert bench.read("present_current") == bench.read("present_pwm") == 0  # no torque, no current
    bench.set(torque_enable=1)
    for goal, share in ((2048, 1.0), (2048 + 1024, 0.0), (2048 + 2048, -1.0), (2048 + 683, 0.5)):
        bench.set(goal_position=goal)
        bench.wait(5.0)
        expected = share * MILLIAMPERES_PER_NM / 2.69
        assert bench.read("present_current") == pytest.approx(expected, abs=1.0)
        assert bench.read("present_pwm") == pytest.approx(885 * share * 1.0 / 4.1, abs=1.0)


def test_turning_costs_friction_and_voltage(make_bench: Make) -> None:
    bench = make_bench(mode=VELOCITY, load=Load(friction=0.41))
    bench.set(torque_enable=1, goal_velocity=100)
    assert bench.read("moving_status") == 0  # of goal positions
    bench.wait(2.0)
    assert bench.read("present_current") * 2.69 == pytest.approx(0.41 * MILLIAMPERES_PER_NM, abs=3)
    # a tenth of the voltage for the friction, the rest for the speed: 22.9 of 46 rev/min
    assert bench.read("present_pwm") == pytest.approx(885 * (0.1 + 22.9 / 46.0), abs=2)


def test_reverse_turns_the_sign_of_the_current_too(make_bench: Make) -> None:
    bench = make_bench(mode=EXTENDED, load=HEAVY)
    bench.set(drive_mode=1)
    bench.set(torque_enable=1)
    assert bench.read("present_current") == pytest.approx(-MILLIAMPERES_PER_NM / 2.69, abs=1.5)


def test_a_model_without_current_sensor_reports_load(make_bench: Make) -> None:
    bench = make_bench("XL430-W250", load=Load(gravity=0.7))
    bench.set(torque_enable=1)
    assert bench.read("present_load") == pytest.approx(500, abs=1)  # of 1.4 N m, 0.1 %


def test_the_xc330_measures_at_its_supply(make_bench: Make) -> None:
    """Less than what flows through the motor, which gets only a share of the supply voltage."""
    found = {}
    for model in ("XC330-M288", "XL330-M288"):
        motor = X_TABLES[model].motor
        bench = make_bench(model, load=Load(gravity=0.5 * motor.stall_torque))
        bench.set(torque_enable=1)
        found[model] = bench.read("present_current") / (1000.0 * motor.stall_current)
    assert found["XL330-M288"] == pytest.approx(0.5, abs=0.01)
    assert found["XC330-M288"] == pytest.approx(0.25, abs=0.01)


def test_current_mode_lifts_what_the_current_can_and_stands_between(make_bench: Make) -> None:
    def speed(amperes: float) -> int:
        bench = make_bench(mode=EXTENDED, load=HEAVY)
        bench.set(operating_mode=CURRENT)
        bench.set(goal_current=round(1000 * amperes / 2.69), torque_enable=1)
        bench.wait(1.0)
        return bench.read("present_velocity")

    hold = MILLIAMPERES_PER_NM / 1000  # A that hold the load; friction is a tenth of it
    assert speed(1.2 * hold) > 0 > speed(0.8 * hold)
    assert speed(1.05 * hold) == speed(0.95 * hold) == 0


def test_pwm_mode_without_load_turns_at_its_share_of_the_no_load_speed(make_bench: Make) -> None:
    bench = make_bench(mode=EXTENDED, load=Load())
    bench.set(operating_mode=PWM)
    bench.set(goal_pwm=-442, torque_enable=1)
    bench.wait(2.0)
    assert bench.read("present_velocity") == pytest.approx(-0.5 * 46.0 / 0.229, abs=2)
    bench.set(goal_pwm=0)
    bench.wait(2.0)
    assert bench.read("present_velocity") == 0


def test_the_mode_change_opens_the_limits_as_the_manual_says(make_bench: Make) -> None:
    bench = make_bench(load=Load())
    bench.set(goal_pwm=100, goal_current=100, operating_mode=CURRENT)
    assert (bench.read("goal_pwm"), bench.read("goal_current")) == (885, 1193)
    bench.set(goal_position=3000)  # taken, and of no consequence in this mode
    bench.set(goal_current=0, torque_enable=1)
    bench.wait(2.0)
    assert bench.read("present_position") == 2048


def test_a_gripper_in_current_based_position_presses_with_its_current_and_no_more(
    make_bench: Make,
) -> None:
    bench = make_bench("XL330-M288", load=Load())
    bench.set(operating_mode=HOLDING)
    bench.set(goal_current=300, torque_enable=1)
    bench.servo.shaft.stops = (-math.inf, 2500.0)  # an object
    bench.set(goal_position=3000)
    bench.wait(3.0)
    assert bench.read("present_position") == 2500
    assert bench.read("present_current") == pytest.approx(300, abs=2)
    bench.wait(60.0)
    # A fifth of the stall current never overloads the servo.
    assert bench.read("hardware_error_status") == 0
    bench.set(goal_position=2000)
    bench.wait(2.0)
    assert bench.read("present_position") == 2000


def test_limits_too_small_for_the_load_leave_it_where_it_is(make_bench: Make) -> None:
    bench = make_bench(load=Load(friction=0.5))  # of 4.1 N m: 108 of 885 counts
    bench.set(goal_pwm=100, torque_enable=1, goal_position=3000)
    bench.wait(2.0)
    assert bench.read("present_position") == 2048 and bench.read("present_pwm") == 100
    bench.set(goal_pwm=120)
    bench.wait(2.0)
    assert bench.read("present_position") == 3000


def test_a_jammed_servo_in_position_mode_shuts_down(make_bench: Make) -> None:
    bench = make_bench(load=Load())
    bench.set(torque_enable=1)
    bench.servo.jammed = True
    bench.set(goal_position=2048 + 50)  # a third of what it has: it holds
    for _ in range(100):
        bench.wait(0.05)
        bench.read("present_current")
    assert bench.read("torque_enable") == 1
    bench.set(goal_position=3000)
    bench.wait(0.1)
    assert bench.read("present_current") == pytest.approx(2300 / 2.69, abs=2)  # all it has
    for _ in range(25):
        bench.wait(0.05)
        bench.read("present_current")
    assert (bench.read("torque_enable"), bench.read("hardware_error_status")) == (0, 0b100000)
    bench.servo.jammed = False
    bench.servo.reboot()
    bench.set(torque_enable=1, goal_position=3000)
    bench.wait(3.0)
    assert (bench.read("present_position"), bench.read("hardware_error_status")) == (3000, 0)


def test_a_long_heavy_load_heats_until_the_limit_and_shuts_down(make_bench: Make) -> None:
    bench = make_bench(load=Load(gravity=0.8 * 4.1))
    bench.set(torque_enable=1)
    before = bench.read("present_temperature")
    bench.wait(20.0)
    warm = bench.read("present_temperature")
    assert before < warm < 80
    bench.wait(120.0)
    assert bench.read("present_temperature") > 80
    assert (bench.read("torque_enable"), bench.read("hardware_error_status")) == (0, 0b100)
    bench.wait(600.0)
    assert bench.read("present_temperature") < warm  # it cools; the error stays
    assert bench.read("hardware_error_status") == 0b100
    light = make_bench()  # what a servo carries where nothing is said
    light.set(torque_enable=1)
    light.wait(3600.0)
    assert light.read("present_temperature") < 35 and light.read("torque_enable") == 1


def test_a_supply_out_of_range_is_an_error_that_shutdown_decides_about(make_bench: Make) -> None:
    metal = make_bench("XM430-W350")
    small = make_bench("XL330-M288")
    for bench, volts in ((metal, 9.0), (small, 12.0)):
        bench.set(torque_enable=1)
        bench.servo.set_supply(volts)
        assert bench.read("present_input_voltage") == 10 * volts
        assert bench.read("hardware_error_status") == 1
    assert metal.read("torque_enable") == 1  # 52 does not name it
    assert small.read("torque_enable") == 0  # 53 does


def test_velocity_mode_minds_profile_acceleration(make_bench: Make) -> None:
    bench = make_bench(mode=VELOCITY)
    bench.set(profile_acceleration=20, torque_enable=1, goal_velocity=100)
    bench.wait(0.064 * 100 / 20 / 2)
    assert bench.read("present_velocity") == pytest.approx(50, abs=1)
    timed = make_bench(mode=VELOCITY)
    timed.set(drive_mode=4)
    timed.set(profile_acceleration=1000, torque_enable=1, goal_velocity=100)
    timed.wait(0.25)
    assert timed.read("present_velocity") == pytest.approx(25, abs=1)


def test_a_time_based_ramp_has_its_own_range(make_bench: Make) -> None:
    bench = make_bench()
    assert bench.write("profile_acceleration", 32767) == ErrorCode.NONE
    bench.set(drive_mode=4)
    assert bench.write("profile_acceleration", 32738) == ErrorCode.DATA_RANGE
    assert bench.write("profile_acceleration", 32737) == ErrorCode.NONE


def test_a_slave_of_a_dual_joint_follows_no_goal(make_bench: Make) -> None:
    slave = make_bench("XM540-W270")
    slave.set(drive_mode=2)
    slave.set(torque_enable=1, goal_position=3000)
    slave.wait(5.0)
    assert slave.read("present_position") == 2048


def test_without_torque_one_turn_mode_counts_on_and_torque_folds_it(make_bench: Make) -> None:
    """By the manual the count is continuous while torque is off.

    In position mode it is in one revolution as soon as torque goes on.
    """
    bench = make_bench(position_ticks=4000)
    bench.servo.rotate_by_hand(200.0)
    assert bench.read("present_position") == 4200
    bench.set(goal_position=104, torque_enable=1)
    assert bench.read("present_position") == 104
    bench.wait(1.0)
    assert bench.servo.true_ticks == 4200.0


def test_lost_turns_show_in_the_registers_only(make_bench: Make) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.servo.shaft.lose_revolutions(-2)
    assert bench.read("present_position") == 2048 - 2 * 4096
    assert bench.servo.true_ticks == 2048.0
