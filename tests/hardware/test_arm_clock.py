"""No clock of a caller makes an arm faster than its caps."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_ik.hardware import open_arm

PERIOD = 0.01
FAR = 2.0  # rad; further than any of these motions gets


class Goals:
    """What is sent, and when: rows of time on the arm's clock and rad at the joints."""

    def __init__(self, arm) -> None:
        self.rows: list[tuple[float, np.ndarray]] = []
        exchange = arm.bus.exchange
        servos = arm.config.drives

        def recorded(register, values, reads, within=None):
            if values:
                q = [servo.value(values[servo.id]) for servo in servos]
                self.rows.append((arm.clock.now(), np.array(q)))
            return exchange(register, values, reads, within)

        arm.bus.exchange = recorded

    def worst(self, caps: np.ndarray, resolution: np.ndarray, window: float = 0.1) -> float:
        """Largest travel between two goals ``window`` s or more apart, over what the caps allow in
        that time and one period.
        """
        worst = 0.0
        for (t0, q0), (t1, q1) in itertools.combinations(self.rows, 2):
            if t1 - t0 >= window - 1e-9:
                allowed = caps * (t1 - t0 + PERIOD) * (1 + 1e-6) + resolution
                worst = max(worst, float((np.abs(q1 - q0) / allowed).max()))
        return worst


@pytest.fixture
def moving(arm_config):
    """An enabled arm at its home, its recorded goals, and a command far away."""
    with open_arm(arm_config, "sim", start=np.zeros(6)) as arm:
        arm.enable()
        yield arm, Goals(arm), np.full(6, FAR)


def test_a_caller_whose_clock_runs_ahead_moves_nothing_faster(moving):
    arm, goals, far = moving
    for k in range(60):
        arm.clock.sleep_until(arm.clock.now() + PERIOD)
        arm.send(far, 0.2 * k)
    travel = np.abs(goals.rows[-1][1] - goals.rows[0][1])
    elapsed = goals.rows[-1][0] - goals.rows[0][0]
    assert (travel <= arm.config.velocity * elapsed + arm.resolution).all()
    assert (travel > 0.5 * arm.config.velocity * elapsed).any()  # and it does move
    assert goals.worst(arm.config.velocity, arm.resolution) <= 1.0


def test_a_burst_after_a_stop_is_no_faster_than_the_clock(moving):
    arm, goals, far = moving
    begin = arm.clock.now()
    for k in range(40):
        arm.clock.sleep_until(begin + PERIOD * (k + 1))
        arm.send(far, PERIOD * (k + 1))
    before = goals.rows[-1][1]
    arm.clock.sleep_until(arm.clock.now() + 1.5)  # the program was stopped
    for k in range(40, 190):  # and catches up at once
        arm.send(far, PERIOD * (k + 1))
    assert (
        np.abs(goals.rows[-1][1] - before) <= arm.config.velocity * 2.2 * PERIOD + arm.resolution
    ).all()


def test_a_stall_between_two_right_times_is_a_step_of_two_periods_at_most(moving):
    arm, goals, far = moving
    begin = arm.clock.now()
    for k in range(40):
        arm.clock.sleep_until(begin + PERIOD * (k + 1))
        arm.send(far, arm.clock.now())
    before = goals.rows[-1][1]
    arm.clock.sleep_until(arm.clock.now() + 0.2)
    arm.send(far, arm.clock.now())
    step = np.abs(goals.rows[-1][1] - before)
    assert (step <= arm.config.velocity * 2.0 * PERIOD + arm.resolution).all()


def test_commands_at_the_right_time_are_not_slowed_down(moving, stream, smooth):
    arm, _, _ = moving
    begin = arm.clock.now()
    jitter = np.random.default_rng(3).uniform(-4e-4, 4e-4, 200)
    path = smooth(np.zeros(6), np.full(6, 0.5), 2.0)
    for k, (q, late) in enumerate(zip(path, jitter, strict=True)):
        arm.clock.sleep_until(begin + PERIOD * (k + 1) + late)
        arm.send(q, PERIOD * (k + 1))
    assert not arm.reports.capped
    assert np.abs(arm._cycle.limits.q - path[-1]).max() < 1e-9


steps = st.tuples(
    st.one_of(st.just(PERIOD), st.floats(-0.5, 0.5), st.just(0.0)),  # the caller's
    st.one_of(st.just(PERIOD), st.floats(0.0, 0.3)),  # the arm's
)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None
)
@given(st.lists(steps, min_size=20, max_size=80), st.sampled_from([1.0, -1.0]))
def test_over_any_window_travel_is_within_the_cap(arm_config, steps, way):
    with open_arm(arm_config, "sim", start=np.zeros(6)) as arm:
        arm.enable()
        goals = Goals(arm)
        now = 0.0
        for theirs, ours in steps:
            now += theirs
            arm.clock.sleep_until(arm.clock.now() + ours)
            arm.send(np.full(6, way * FAR), now)
        assert goals.worst(arm.config.velocity, arm.resolution) <= 1.0


def test_a_clock_that_is_set_in_the_middle_of_a_motion_does_not_stop_it_dead(moving):
    arm, _, far = moving
    for k in range(40):
        arm.clock.sleep_until(arm.clock.now() + PERIOD)
        arm.send(far, PERIOD * k)
    before = np.array(arm._cycle.limits.velocity)
    for jump in (1.0, 1.01, -5.0):
        arm.clock.sleep_until(arm.clock.now() + PERIOD)
        arm.send(far, 40 * PERIOD + jump)
        change = np.abs(np.array(arm._cycle.limits.velocity) - before)
        assert (change <= arm.config.acceleration * PERIOD * (1 + 1e-5)).all()
        before = np.array(arm._cycle.limits.velocity)


def test_after_a_stall_an_arm_starts_from_rest_whatever_time_its_program_says(arm_config):
    """Nothing has tripped that would say so: the servos have no Bus Watchdog."""
    with open_arm(dataclasses.replace(arm_config, watchdog_ms=0), "sim", start=np.zeros(6)) as arm:
        arm.enable()
        for k in range(41):
            arm.clock.sleep_until(arm.clock.now() + (0.3 if k == 40 else PERIOD))
            arm.send(np.full(6, FAR), PERIOD * k)
        speed = np.abs(arm._cycle.limits.velocity)
        assert (speed <= arm.config.acceleration * PERIOD * (1 + 1e-5)).all()


@pytest.mark.parametrize("stall", [0.025, 0.05, 0.1, 0.2])
def test_after_a_short_stall_the_shafts_start_from_rest_within_their_acceleration(moving, stall):
    """The servos have come to their last goals and stand: at the old speed they would jump."""
    arm, _, far = moving
    for _ in range(40):
        arm.clock.sleep_until(arm.clock.now() + PERIOD)
        arm.send(far, arm.clock.now())
    arm.clock.sleep_until(arm.clock.now() + stall)
    at = [arm.bus.virtual_bus.true_angles(arm.config)]
    for _ in range(40):
        arm.send(far, arm.clock.now())
        arm.clock.sleep_until(arm.clock.now() + PERIOD)
        at.append(arm.bus.virtual_bus.true_angles(arm.config))
    speed = np.diff(at, axis=0, prepend=at[:1]) / PERIOD
    change = np.abs(np.diff(speed, axis=0)).max(axis=0)
    assert (change <= arm.config.acceleration * PERIOD + 2.0 * arm.resolution / PERIOD).all()
    assert speed[-1] == pytest.approx(arm.config.velocity, rel=0.1)


@pytest.mark.parametrize("period", [0.02, 1 / 30, 0.1])
def test_a_program_that_sends_slowly_is_not_taken_to_stall(moving, period):
    """Two control periods a command at most, and not a start from rest each time."""
    arm, goals, far = moving
    begin = arm.clock.now()
    jitter = np.random.default_rng(5).uniform(-0.2, 0.2, 60) * period
    for k, late in enumerate(jitter):
        arm.clock.sleep_until(begin + period * (k + 1) + late)
        arm.send(far, arm.clock.now())
    steps = np.diff([q for _, q in goals.rows], axis=0)[-15:]
    assert (steps.mean(axis=0) >= 0.9 * arm.config.velocity * 2.0 * PERIOD - arm.resolution).all()


def test_a_time_that_is_no_number_is_refused(moving):
    arm, goals, far = moving
    sent = len(goals.rows)
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError):
            arm.send(far, bad)
    assert len(goals.rows) == sent
