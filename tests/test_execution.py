"""`execute` and `follow` in virtual time, with small sinks and arms."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot_ik.errors import TrajectoryError
from robot_ik.execution import START_TOLERANCE, execute
from robot_ik.motion import RecorderSink, Trajectory
from robot_ik.ports import JointReading, JointSink, JointSource, RealClock, VirtualClock

JOINTS = ("a", "b")


def ramp(count=101, rate=100.0):
    times = np.arange(count) / rate
    return Trajectory(times, np.column_stack([0.5 * times, -times]), JOINTS)


class LaggingArm:
    """Sink and source with a lag of one tick, an offset ``bias``, and ``busy`` seconds a tick."""

    def __init__(self, clock, q, bias=0.0, busy=0.0):
        self.clock = clock
        self.bias = bias
        self.busy = busy
        self.q = self.next = np.array(q, dtype=float)
        self.sent = []

    def send(self, q, now):
        self.sent.append((now, q))
        self.q = self.next
        self.next = np.array(q)
        self.clock.sleep_until(self.clock.now() + self.busy)

    def read(self):
        return JointReading(self.q + self.bias, self.clock.now())


def test_every_sample_goes_to_every_sink_at_its_time():
    clock = VirtualClock(5.0)
    path = ramp()
    first = RecorderSink(JOINTS)
    second = RecorderSink(JOINTS)
    done = execute(path, [first, second], clock=clock)
    for sink in (first, second):
        assert (sink.trajectory().q == path.q).all()
        np.testing.assert_allclose(sink.trajectory().times, path.times, atol=1e-12)
    assert clock.now() == pytest.approx(6.0)
    assert done.rate == pytest.approx(100.0) and done.duration == pytest.approx(1.0)
    assert done.overruns == 0 and len(done.times) == 101
    assert done.measured is None and done.tracking_error is None and done.final_error is None
    assert done.measured_trajectory is None


def test_measured_and_commanded_angles_are_recorded_together():
    clock = VirtualClock()
    path = ramp()
    arm = LaggingArm(clock, path.q[0])
    assert isinstance(arm, JointSink) and isinstance(arm, JointSource)
    done = execute(path, [arm], source=arm, clock=clock)
    np.testing.assert_allclose(done.measured[1:], path.q[:-1])
    np.testing.assert_allclose(done.tracking_error, [0.005, 0.01])
    np.testing.assert_allclose(done.final_error, [-0.005, 0.01])
    assert len(done.measured_trajectory) == 101


def test_settling_repeats_the_last_sample_until_the_arm_arrives():
    clock = VirtualClock()
    path = ramp()
    arm = LaggingArm(clock, path.q[0])
    done = execute(path, [arm], source=arm, clock=clock, settle=0.1)
    assert len(done.times) == 111
    np.testing.assert_allclose(np.diff(done.times), 0.01)
    np.testing.assert_allclose(done.final_error, 0.0)
    assert done.tracking_error[1] == pytest.approx(0.01)


def test_an_arm_away_from_the_start_is_refused_before_a_command_is_sent():
    clock = VirtualClock()
    path = ramp()
    arm = LaggingArm(clock, path.q[0], bias=np.array([0.0, 1.5 * START_TOLERANCE]))
    with pytest.raises(TrajectoryError, match=r"joint 'b', but the arm measures 0\.0300") as caught:
        execute(path, [arm], source=arm, clock=clock)
    assert "nothing was sent" in str(caught.value) and arm.sent == []
    execute(path, [arm], source=arm, clock=clock, start_tolerance=0.05)
    assert len(arm.sent) == 101


@pytest.mark.parametrize("q", [[np.nan, 0.0], [0.0]])
def test_an_arm_with_invalid_measurements_is_refused(q):
    arm = LaggingArm(VirtualClock(), q)
    with pytest.raises(TrajectoryError):
        execute(ramp(), [arm], source=arm, clock=arm.clock)
    assert arm.sent == []


def test_a_small_delay_is_caught_up():
    """Busy for 4 ms of each 10 ms: no drift over a hundred ticks."""
    clock = VirtualClock()
    done = execute(ramp(), [LaggingArm(clock, [0.0, 0.0], busy=0.004)], clock=clock)
    np.testing.assert_allclose(done.times, ramp().times, atol=1e-12)
    assert done.overruns == 0


def test_a_late_tick_shorter_than_a_period_does_not_move_the_schedule():
    clock = VirtualClock()
    path = ramp()

    def stall(tick):
        if tick.index == 50:
            clock.sleep_until(clock.now() + 0.017)

    done = execute(path, [RecorderSink(JOINTS)], clock=clock, on_tick=stall)
    assert done.overruns == 0 and done.duration == pytest.approx(1.0)
    assert done.times[51] == pytest.approx(0.517)
    np.testing.assert_allclose(done.times[52:], path.times[52:])


def test_a_stall_is_counted_and_moves_the_schedule():
    clock = VirtualClock()
    path = ramp()

    def stall(tick):
        if tick.index == 50:
            clock.sleep_until(clock.now() + 0.2)

    done = execute(path, [RecorderSink(JOINTS)], clock=clock, on_tick=stall)
    assert done.overruns == 1
    assert np.diff(done.times).min() == pytest.approx(0.01)
    assert done.duration == pytest.approx(1.19)
    assert (done.commanded == path.q).all()


def test_a_bus_slower_than_the_rate_is_reported():
    clock = VirtualClock()
    done = execute(ramp(), [LaggingArm(clock, [0.0, 0.0], busy=0.025)], clock=clock)
    assert done.rate == pytest.approx(40.0, rel=0.01) and done.overruns >= 99


def test_an_interrupt_propagates_and_ends_the_commands():
    clock = VirtualClock()
    recorder = RecorderSink(JOINTS)

    def interrupt(tick):
        if tick.index == 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(ramp(), [recorder], clock=clock, on_tick=interrupt)
    assert len(recorder) == 31


def test_a_sink_that_fails_stops_the_sinks_after_it_too():
    clock = VirtualClock()
    recorder = RecorderSink(JOINTS)

    class Failing:
        def send(self, q, now):
            if now > 0.3:
                raise OSError("cable")

    with pytest.raises(OSError, match="cable"):
        execute(ramp(), [Failing(), recorder], clock=clock)
    assert len(recorder) == 31


def test_no_sink_can_change_the_command():
    class Bender:
        def send(self, q, now):
            q[0] = 1e3

    with pytest.raises(ValueError, match="read-only"):
        execute(ramp(), [Bender()], clock=VirtualClock())
    with pytest.raises(ValueError, match="read-only"):
        execute(ramp(), [Bender()], clock=VirtualClock(), settle=0.1)


def test_progress_ends_at_the_number_of_ticks():
    seen = []
    execute(ramp(), [], clock=VirtualClock(), on_tick=seen.append, settle=0.05)
    assert [tick.index for tick in seen] == list(range(106))
    assert {tick.count for tick in seen} == {106}
    assert seen[-1].time == pytest.approx(1.05) and seen[0].measured is None


def test_a_trajectory_of_one_sample_is_sent_once():
    recorder = RecorderSink(JOINTS)
    done = execute(Trajectory([0.0], [[1.0, 2.0]], JOINTS), [recorder], clock=VirtualClock())
    assert len(recorder) == 1 and done.rate == 0.0 and done.duration == 0.0


def test_times_that_begin_late_do_not_delay_the_start():
    clock = VirtualClock()
    execute(Trajectory([7.0, 7.01], [[0.0, 0.0], [0.1, 0.1]], JOINTS), [], clock=clock)
    assert clock.now() == pytest.approx(0.01)


@pytest.mark.parametrize("settle", [-1.0, np.nan, np.inf])
def test_malformed_settling_is_refused(settle):
    with pytest.raises(TrajectoryError, match="settle"):
        execute(ramp(), [], clock=VirtualClock(), settle=settle)


def test_the_real_clock_is_the_default():
    recorder = RecorderSink(JOINTS)
    done = execute(ramp(6), [recorder])
    assert isinstance(RealClock().now(), float)
    assert done.duration >= 0.05 * 0.99 and (np.diff(done.times) > 0.0).all()


def test_the_clock_of_the_arm_is_used_by_default(real_time):
    arm = LaggingArm(VirtualClock(), [0.0, 0.0])
    began = time.monotonic()
    by_source = execute(ramp(301), [arm], source=arm)
    by_sink = execute(ramp(301), [arm])
    assert arm.clock.now() == pytest.approx(6.0) and len(arm.sent) == 602
    assert by_source.duration == by_sink.duration == pytest.approx(3.0)
    assert time.monotonic() - began < 3.0  # two runs of 3 s on the real clock would take 6
