"""Torque of a virtual servo: how it is lost and restored, and what a reset forgets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.virtual.protocol import ErrorCode
from robot_ik.hardware.virtual.servo import CLEAR_MULTI_TURN

EXTENDED = OperatingMode.EXTENDED_POSITION


def test_without_torque_nothing_moves_and_torque_on_goes_to_the_stale_goal(
    make_bench: Callable[..., Any],
) -> None:
    bench = make_bench()
    bench.set(goal_position=3000)
    bench.wait(5.0)
    assert bench.read("present_position") == 2048
    bench.set(torque_enable=1)
    bench.wait(5.0)
    assert bench.read("present_position") == 3000


def test_torque_off_stops_on_the_way(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.set(profile_velocity=50, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    bench.set(torque_enable=0)
    held = bench.read("present_position")
    bench.wait(5.0)
    assert 2048 < bench.read("present_position") == held < 20_000
    assert bench.read("moving") == 0


def test_a_hand_turns_it_only_without_torque(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.servo.rotate_by_hand(-3000.0)
    assert bench.read("present_position") == -952
    bench.set(goal_position=-952, torque_enable=1)
    bench.servo.rotate_by_hand(500.0)
    assert bench.read("present_position") == -952


def test_bus_watchdog_counts_silence_with_torque_only(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.set(bus_watchdog=5)
    bench.wait(10.0)
    assert bench.read("bus_watchdog") == 5  # torque is off
    bench.set(torque_enable=1, profile_velocity=50, goal_position=20_000)
    for _ in range(20):
        bench.wait(0.09)
        bench.servo.hear()  # any instruction keeps it quiet
    assert bench.read("bus_watchdog") == 5
    before = bench.servo.true_ticks
    bench.wait(60.0)
    at_trip = before + 0.1 * 50 * bench.V_UNIT
    # it stopped then, not when it was asked
    assert bench.servo.true_ticks == pytest.approx(at_trip, abs=3.0)
    assert bench.read("bus_watchdog") == -1
    assert bench.read("torque_enable") == 1
    assert bench.read("profile_velocity") == bench.read("profile_acceleration") == 0
    for goal in ("goal_position", "goal_velocity", "goal_pwm", "goal_current"):
        assert bench.write(goal, 1) == ErrorCode.DATA_RANGE
    assert bench.write("bus_watchdog", 5) == ErrorCode.DATA_RANGE
    bench.set(bus_watchdog=0, goal_position=3000)
    bench.wait(20.0)
    assert bench.read("present_position") == 3000


def test_overload_shuts_down_until_reboot(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED)
    bench.set(profile_velocity=50, torque_enable=1, goal_position=20_000)
    bench.wait(1.0)
    bench.servo.inject_error("overload")
    held = bench.read("present_position")
    bench.wait(1.0)
    assert bench.read("present_position") == held
    assert (bench.read("torque_enable"), bench.read("hardware_error_status")) == (0, 32)
    assert bench.servo.status_byte(0) == 0x80
    bench.write("torque_enable", 1)
    assert bench.read("torque_enable") == 0
    bench.servo.reboot()
    assert bench.servo.status_byte(0) == 0
    bench.set(torque_enable=1)
    assert bench.read("torque_enable") == 1


def test_an_error_that_shutdown_does_not_name_only_alerts(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.set(torque_enable=1)
    bench.servo.inject_error("input_voltage")  # bit 0 is not in 52
    assert (bench.read("torque_enable"), bench.servo.status_byte(0)) == (1, 0x80)


def test_reboot_forgets_turns_and_ram_but_not_eeprom(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED, position_ticks=10_000)
    bench.set(return_delay_time=7, profile_velocity=50, led=1, torque_enable=1)
    bench.wait(1.0)
    bench.servo.reboot()
    assert bench.read("present_position") == bench.read("goal_position") == 10_000 % 4096
    names = ("profile_velocity", "led", "torque_enable", "realtime_tick", "return_delay_time")
    assert [bench.read(n) for n in names] == [0, 0, 0, 0, 7]
    assert bench.servo.true_ticks == 10_000.0


@pytest.mark.parametrize("option,kept", [(0xFF, (1, 1)), (1, (9, 1)), (2, (9, 3))])
def test_factory_reset_keeps_what_is_asked(
    option: int, kept: tuple[int, int], make_bench: Callable[..., Any]
) -> None:
    bench = make_bench()
    bench.set(id=9, return_delay_time=3)
    assert bench.servo.factory_reset(option) == ErrorCode.NONE
    assert (bench.read("id"), bench.read("baud_rate")) == kept
    assert bench.read("return_delay_time") == 250
    assert bench.servo.factory_reset(77) == ErrorCode.DATA_RANGE


def test_clear_multi_turn_only_at_a_stand(make_bench: Callable[..., Any]) -> None:
    bench = make_bench(mode=EXTENDED, position_ticks=-5000)
    bench.set(torque_enable=1, profile_velocity=50, goal_position=-4000)
    bench.wait(0.2)
    assert bench.servo.clear(CLEAR_MULTI_TURN) == ErrorCode.RESULT_FAIL
    bench.wait(10.0)
    assert bench.servo.clear(b"\x01") == ErrorCode.DATA_RANGE
    assert bench.servo.clear(CLEAR_MULTI_TURN) == ErrorCode.NONE
    assert bench.read("present_position") == 96
    bench.wait(1.0)
    assert bench.servo.true_ticks == -4000.0


def test_older_firmware_has_no_clear(make_bench: Callable[..., Any]) -> None:
    assert make_bench(firmware=41).servo.clear(CLEAR_MULTI_TURN) == ErrorCode.INSTRUCTION


def test_realtime_tick_wraps(make_bench: Callable[..., Any]) -> None:
    bench = make_bench()
    bench.wait(1.25)
    assert bench.read("realtime_tick") == 1250
    bench.wait(32.0)
    assert bench.read("realtime_tick") == 33250 - 32768
