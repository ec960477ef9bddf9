"""An arm whose program stalled until the bus watchdogs tripped, and that continues."""

from __future__ import annotations

import numpy as np

from robot_ik.hardware.bus import BusStatus


def test_after_a_pause_the_tripped_watchdog_is_cleared_and_the_arm_goes_on(
    arm, stream, smooth, registers, start
):
    arm.enable()
    stream(arm, smooth(start, start + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    assert all(servo.torque for servo in arm.bus.virtual_bus.servos)
    assert registers(arm, "bus_watchdog") == [-1] * 6
    stream(arm, smooth(start + 0.1, start + 0.2, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.1)
    assert np.allclose(arm.read().q, start + 0.2, atol=0.01)
    assert registers(arm, "bus_watchdog") == [10] * 6


def test_servos_that_stopped_by_themselves_get_their_profiles_back(
    arm, stream, smooth, registers, start
):
    names = ("profile_velocity", "profile_acceleration")
    arm.enable()
    stream(arm, [start] * 3)
    before = [registers(arm, name) for name in names]
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    assert all(servo.torque for servo in arm.bus.virtual_bus.servos)
    assert [registers(arm, name) for name in names] == [[0] * 6] * 2  # as fast as they can
    stream(arm, smooth(start, start + 0.1, 0.3))
    assert [registers(arm, name) for name in names] == before


def test_a_read_after_a_pause_does_not_hide_the_tripped_watchdog(arm, stream, smooth, start):
    arm.enable()
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    arm.read()
    stream(arm, smooth(start, start + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.05)
    assert np.allclose(arm.read().q, start + 0.1, atol=0.01)


def test_a_stall_inside_a_cycle_is_noticed_as_well(arm, stream, smooth, registers, start):
    """The process is suspended after the arm has read the clock, before its packet is out."""
    arm.enable()
    stream(arm, [start] * 3)
    original = arm.bus.exchange

    def stalled(register, values, reads, within=None):
        arm.clock.sleep_until(arm.clock.now() + 0.3)
        return original(register, values, reads, within)

    arm.bus.exchange = stalled
    stream(arm, [start])
    arm.bus.exchange = original
    stream(arm, [start])
    assert registers(arm, "bus_watchdog") == [10] * 6
    stream(arm, smooth(start, start + 0.1, 0.3))
    arm.clock.sleep_until(arm.clock.now() + 0.05)
    assert np.allclose(arm.read().q, start + 0.1, atol=0.01)


def test_a_tripped_watchdog_whose_reply_is_lost_is_noticed_once_it_is_heard(
    arm, stream, smooth, registers, start
):
    """Its servo refuses goals, and nothing else says so: it would stand while the others go."""
    arm.enable()
    stream(arm, [start] * 3)
    arm.clock.sleep_until(arm.clock.now() + 5.0)
    for servo in arm.bus.virtual_bus.servos[:-1]:
        servo.heard = arm.clock.now()  # only the last one trips
    original = arm.bus.sync_read
    lost = []

    def loses_a_reply(ids, register):
        statuses = original(ids, register)
        if register.name == "bus_watchdog" and not lost:
            lost.append(statuses[6].data)
            statuses[6] = BusStatus(6, None)
        return statuses

    arm.bus.sync_read = loses_a_reply
    stream(arm, smooth(start, start + 0.1, 0.3))
    assert lost == [-1] and registers(arm, "bus_watchdog") == [10] * 6
    arm.clock.sleep_until(arm.clock.now() + 0.05)
    assert np.allclose(arm.read().q, start + 0.1, atol=0.01)
