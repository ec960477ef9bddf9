"""How a virtual servo moves: the profiles of the manual, on virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.virtual.profiles import ProfileKind

EXTENDED = OperatingMode.EXTENDED_POSITION


def test_trapezoid_of_the_manual(make_bench: Callable[..., Any]) -> None:
    """Ramp time t1 = 64 V / A ms and duration d / V + t1, from the manual's profile section."""
    bench = make_bench(mode=EXTENDED)
    bench.set(
        profile_velocity=100, profile_acceleration=20, torque_enable=1, goal_position=2048 + 4096
    )
    ramp = 0.064 * 100 / 20
    start = bench.clock.now()
    bench.wait(ramp / 2)
    assert bench.read("present_velocity") == pytest.approx(50, abs=1)
    assert bench.read("moving") == 1
    assert bench.read("moving_status") == 0b110010  # trapezoidal, going on
    bench.wait(ramp / 2)
    assert bench.read("present_velocity") == pytest.approx(100, abs=1)
    assert bench.servo.shaft.reading - 2048 == pytest.approx(
        0.5 * 100 * bench.V_UNIT * ramp, rel=2e-3
    )
    end = start + 4096 / (100 * bench.V_UNIT) + ramp
    bench.clock.sleep_until(end - 0.01)
    assert bench.read("moving_status") & 0b11 == 0b10
    bench.clock.sleep_until(end + 0.01)
    assert bench.read("moving_status") == 0b000001
    assert (bench.read("present_position"), bench.read("moving")) == (6144, 0)


def test_a_short_way_is_a_triangle_and_no_profile_a_step(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(profile_velocity=100, profile_acceleration=10, torque_enable=1, goal_position=2100)
    assert bench.read("moving_status") >> 4 == ProfileKind.TRIANGULAR
    bench.wait(5.0)
    bench.set(profile_acceleration=0, goal_position=3000)
    assert bench.read("moving_status") >> 4 == ProfileKind.RECTANGULAR
    bench.wait(5.0)
    bench.set(profile_velocity=0, goal_position=1000)
    assert bench.read("moving_status") >> 4 == ProfileKind.STEP
    # Even a step is no faster than the motor: half a revolution at 200 * 0.229 rev/min.
    bench.wait(2000 / (200 * bench.V_UNIT))
    assert 1000 < bench.servo.shaft.reading < 1150
    bench.wait(0.1)
    assert bench.read("present_position") == 1000


def test_the_speed_is_that_of_the_motor_at_its_supply_and_of_the_velocity_limit(
    make_bench: Callable[..., Any],
) -> None:
    """XM430-W350: 46 rev/min at 12 V (200.9 units), Velocity Limit 200 of 0.229 rev/min."""
    bench = make_bench(mode=EXTENDED)

    def cruising(**registers: int) -> float:
        bench.set(torque_enable=0)
        bench.set(**registers)
        bench.set(torque_enable=1, goal_position=bench.read("present_position") + 9000)
        bench.wait(1.0)
        return bench.read("present_velocity")

    assert cruising(velocity_limit=200) == pytest.approx(200, abs=1)
    # Velocity Limit and profile of Interbotix
    assert cruising(velocity_limit=131, profile_velocity=180) == pytest.approx(131, abs=1)
    assert cruising(velocity_limit=1023) == pytest.approx(180, abs=1)  # the profile's
    assert cruising(profile_velocity=0) == pytest.approx(46 / 0.229, abs=1)  # what the motor does
    bench.servo.set_supply(10.0)
    assert cruising(velocity_limit=1023) == pytest.approx(46 / 0.229 * 10 / 12, abs=1)


def test_time_based_profile_takes_its_time(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(drive_mode=4)
    bench.set(profile_velocity=2000, profile_acceleration=500, torque_enable=1, goal_position=4000)
    bench.wait(1.0)
    assert bench.servo.shaft.reading == pytest.approx((2048 + 4000) / 2)
    bench.wait(0.99)
    assert bench.read("moving_status") & 2
    bench.wait(0.011)
    assert (bench.read("moving_status") & 3, bench.read("present_position")) == (1, 4000)


def test_a_ramp_is_at_most_half_the_time(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(drive_mode=4)
    bench.set(profile_velocity=2000, profile_acceleration=1900, torque_enable=1, goal_position=4000)
    bench.wait(1.0)
    assert bench.servo.shaft.reading == pytest.approx((2048 + 4000) / 2)
    assert bench.read("present_velocity") == pytest.approx(2 * 1952 / 2.0 / bench.V_UNIT, abs=1)
    bench.wait(1.001)
    assert bench.read("moving_status") & 3 == 1


def test_how_often_it_is_asked_changes_nothing(make_bench: Callable[..., Any]) -> None:
    often = make_bench(mode=EXTENDED)
    rarely = make_bench(mode=EXTENDED)
    for bench in (often, rarely):
        bench.set(profile_velocity=60, profile_acceleration=5, torque_enable=1, goal_position=9000)
    for _ in range(1000):
        often.wait(0.001)
        often.read("present_position")
    rarely.clock.sleep_until(often.clock.now())
    assert often.servo.shaft.reading == rarely.servo.shaft.reading


def test_a_new_goal_on_the_way_keeps_the_speed(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.set(profile_velocity=100, profile_acceleration=20, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    before = bench.servo.shaft.reading
    bench.set(goal_position=0)
    assert (bench.servo.shaft.reading, bench.read("present_velocity")) == (before, 100)
    bench.wait(0.1)
    assert bench.servo.shaft.reading > before  # it cannot turn back at once
    bench.wait(30.0)
    assert bench.read("present_position") == 0


def test_velocity_mode_turns_until_the_next_goal(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(operating_mode=OperatingMode.VELOCITY, torque_enable=1, goal_velocity=-100)
    bench.wait(10.0)
    assert bench.read("present_velocity") == -100
    assert bench.servo.shaft.reading == pytest.approx(2048 - 1000 * bench.V_UNIT, rel=1e-2)
    bench.set(goal_velocity=0)
    bench.wait(1.0)
    assert bench.read("present_velocity") == 0
