"""Laws of the safety limiter, also against trapezoids of an independent formula."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.errors import UnsafeCommandError
from robot_ik.hardware.limiter import LimiterState, SafetyLimiter

LOWER = -2.0
UPPER = 2.5
DT = 0.01
SETTLED = 60
"""Ticks in a row after which a law that holds is taken to hold on."""

caps = st.tuples(st.floats(0.1, 6.0), st.floats(0.2, 40.0))
inside = st.floats(LOWER, UPPER)
anywhere = st.one_of(st.floats(-10.0, 10.0), st.floats(allow_nan=False, allow_infinity=False))


def one_joint(velocity: float, acceleration: float) -> SafetyLimiter:
    return SafetyLimiter([LOWER], [UPPER], velocity, acceleration)


def step(limiter: SafetyLimiter, state: LimiterState, command: Any, dt: float) -> Any:
    """Check a command and return the new state, the values to send and the report."""
    state, report = limiter.step(state, limiter.command(command, state.command), dt)
    return state, np.array(state.q), report


def run(limiter: SafetyLimiter, start: float, commands: list[float], dt: float = DT) -> np.ndarray:
    """Outputs, with the resting start in front (twice, so that differences see it)."""
    state = LimiterState.at_rest([start])
    out = [start, start]
    for command in commands:
        state, q, _ = step(limiter, state, [command], dt)
        out.append(float(q[0]))
    return np.array(out)


def assert_caps(q: np.ndarray, velocity: float, acceleration: float, dt: float = DT) -> None:
    assert np.abs(np.diff(q)).max() <= velocity * dt * (1 + 3e-6) + 1e-12
    assert np.abs(np.diff(q, 2)).max() <= acceleration * dt * dt * (1 + 3e-6) + 1e-12


def trapezoid(
    start: float, end: float, velocity: float, acceleration: float, t: np.ndarray
) -> np.ndarray:
    """Rest to rest in the shortest time, from the textbook formula (velocity integral, three
    phases).
    """
    distance = abs(end - start)
    ramp = min(velocity / acceleration, math.sqrt(distance / acceleration))
    peak = acceleration * ramp
    total = ramp + (distance / peak if peak > 0 else 0.0)
    t = np.clip(t, 0.0, total)
    rising = 0.5 * acceleration * t**2
    cruise = 0.5 * acceleration * ramp**2 + peak * (t - ramp)
    falling = distance - 0.5 * acceleration * (total - t) ** 2
    s = np.where(t < ramp, rising, np.where(t < total - ramp, cruise, falling))
    return start + math.copysign(1.0, end - start) * s


@given(caps, inside, st.lists(anywhere, min_size=1, max_size=60))
def test_whatever_is_commanded_limits_and_caps_hold(cap, start, commands):
    q = run(one_joint(*cap), start, [x for c in commands for x in (c,) * 7])
    assert q.min() >= LOWER and q.max() <= UPPER
    assert_caps(q, *cap)


@given(
    caps,
    inside,
    st.lists(st.tuples(anywhere, st.sampled_from([0.004, 0.01, 0.013, 0.02])), max_size=80),
)
def test_with_uneven_ticks_position_and_velocity_still_hold(cap, start, ticks):
    limiter = one_joint(*cap)
    state = LimiterState.at_rest([start])
    for command, dt in ticks:
        before = state
        state, q, _ = step(limiter, state, [command], dt)
        assert LOWER <= q[0] <= UPPER
        assert abs(q[0] - before.q[0]) <= cap[0] * dt * (1 + 3e-6) + 1e-12


@settings(max_examples=40)
@given(caps, inside, inside, st.lists(anywhere, max_size=20))
def test_a_constant_command_is_reached_without_overshoot_or_hunting(cap, start, end, before):
    velocity, acceleration = cap
    limiter = one_joint(*cap)
    state = LimiterState.at_rest([start])
    for command in before:  # any past: the joint may be moving either way
        state, _, _ = step(limiter, state, [command], DT)
    speed = abs(state.velocity[0])
    stop = speed**2 / (2 * acceleration) + speed * DT
    # Stop, come back or go on: three trapezoids of at most the whole range bound the time.
    seconds = (UPPER - LOWER + 2 * stop + 2 * velocity**2 / acceleration) / velocity
    ticks = int(3 * seconds / DT) + 60
    out = []
    for _ in range(ticks):
        state, q, report = step(limiter, state, [end], DT)
        out.append(float(q[0]))
        if len(out) > 2 and out[-1] == out[-2] == out[-3] == end:
            break
    assert out[-1] == end and not report
    side = np.sign(np.array(out) - end)
    assert np.count_nonzero(np.diff(side[side != 0])) <= 1  # passes the command at most once
    if not before:
        assert np.count_nonzero(np.diff(side[side != 0])) == 0  # from rest: never


@settings(max_examples=40)
@given(caps, inside, inside, st.floats(0.0, 1.0), st.sampled_from([0.005, 0.01, 0.02]))
def test_a_trapezoid_exactly_at_the_caps_passes_unchanged(cap, start, end, phase, dt):
    velocity, acceleration = cap
    t = np.arange(-3, 60 / dt) * dt + phase * dt
    q = trapezoid(start, end, velocity, acceleration, t)
    q = q[: np.argmax(q == q[-1]) + 3]
    limiter = one_joint(*cap)
    state = LimiterState.at_rest([start])
    for wanted in q:
        state, out, report = step(limiter, state, [wanted], dt)
        assert abs(out[0] - wanted) <= 1e-9
        assert not report


@settings(max_examples=40)
@given(caps, inside, inside, st.integers(0, 2**32 - 1))
def test_a_trapezoid_passes_on_a_clock_that_jitters(cap, start, end, seed):
    rng = np.random.default_rng(seed)
    dts = rng.uniform(0.008, 0.012, 3000)
    q = trapezoid(start, end, cap[0], cap[1], np.cumsum(dts))
    arrived = int(np.argmax(q == q[-1])) + 10
    dts = dts[:arrived]
    q = q[:arrived]
    limiter = one_joint(*cap)
    state = LimiterState.at_rest([start])
    worst = 0.0
    for wanted, dt in zip(q, dts, strict=True):
        state, out, _ = step(limiter, state, [wanted], dt)
        worst = max(worst, abs(out[0] - wanted))
    # Only the last braking ticks may be shortened: the stop is planned for ticks of one length.
    assert worst <= cap[1] * 0.012**2


@settings(max_examples=25)
@given(caps, inside, st.floats(0.05, 1.5), st.floats(0.1, 1.0))
def test_a_late_start_catches_up_with_a_moving_command(cap, start, lag, amplitude):
    velocity, acceleration = cap
    omega = min(velocity / amplitude, math.sqrt(acceleration / amplitude)) * 0.5
    limiter = SafetyLimiter([-9.0], [9.0], velocity, acceleration)
    ticks = (
        int((4 * math.pi / omega + 10 * lag / velocity + 10 * velocity / acceleration) / DT) + 200
    )
    wanted = start + lag + amplitude * np.sin(omega * DT * np.arange(ticks))
    state = LimiterState.at_rest([start])
    error = []
    for command in wanted:
        state, q, _ = step(limiter, state, [command], DT)
        error.append(abs(q[0] - command))
        if len(error) > SETTLED and max(error[-SETTLED:]) <= 1e-9:
            return
    pytest.fail(f"still {error[-1]} behind after {ticks} ticks")


@given(caps, st.floats(1e-3, 3.0), st.booleans(), anywhere)
def test_a_start_outside_is_walked_back_never_jumped(cap, beyond, above, command):
    start = UPPER + beyond if above else LOWER - beyond
    velocity, acceleration = cap
    seconds = beyond / velocity + 2 * velocity / acceleration + 2 * math.sqrt(beyond / acceleration)
    limiter = one_joint(*cap)
    state = LimiterState.at_rest([start])
    out = [start, start]
    for _ in range(int(seconds / DT) + 20):
        state, moved, _ = step(limiter, state, [command], DT)
        out.append(float(moved[0]))
        if len(out) > SETTLED and all(LOWER <= x <= UPPER for x in out[-SETTLED:]):
            break
    q = np.array(out)
    assert_caps(q, *cap)
    assert LOWER <= q[-1] <= UPPER
    outside = q[(q > UPPER) | (q < LOWER)]
    # never further out
    assert (np.diff(outside) <= 0).all() if above else (np.diff(outside) >= 0).all()
    entered = np.argmax((q >= LOWER) & (q <= UPPER))
    assert ((q[entered:] >= LOWER) & (q[entered:] <= UPPER)).all()


@given(caps, st.floats(0.2, 1.0))
def test_running_into_a_limit_at_speed_stops_short_of_it(cap, share):
    speed = share * cap[0]
    start = max(LOWER, UPPER - speed**2 / cap[1] - 20 * speed * DT)  # room to get up to speed
    commands = np.arange(start, UPPER + 20 * speed * DT, speed * DT)
    q = run(one_joint(*cap), start, [*commands.tolist(), *([9.0] * 5)])
    assert q.max() <= UPPER
    assert_caps(q, *cap)


def test_clipped_and_capped_joints_are_named():
    limiter = SafetyLimiter([-1, -1, -1], [1, 1, 1], 1.0, 100.0, joints=("base", "elbow", "wrist"))
    state = LimiterState.at_rest([0.0, 1.0, 0.0])
    _, q, report = step(limiter, state, [0.005, 1.5, 0.9], DT)
    assert report.clipped == ("elbow",)
    assert report.capped == ("wrist",)
    assert q[0] == 0.005 and q[1] == 1.0 and 0.0 < q[2] < 0.9
    assert not step(limiter, state, [0.005, 1.0, 0.0], DT)[2]


def test_a_margin_keeps_clear_of_the_limits():
    limiter = SafetyLimiter([-1], [1], 50.0, 1e5, margin=0.1)
    _, q, report = step(limiter, LimiterState.at_rest([0.85]), [1.0], DT)
    assert q[0] == pytest.approx(0.9) and report.clipped == ("joint1",)


@pytest.mark.parametrize(
    "bad",
    [
        [math.nan, 0.0],
        [0.0, math.inf],
        [0.0],
        [0.0, 0.0, 0.0],
        [[0.0, 0.0]],
        0.0,
        "up",
        None,
        ["a", "b"],
        {"joint3": 0.0},
        {"joint1": math.nan},
        {"joint1": "x"},
        [1e309, 0.0],
    ],
    ids=repr,
)
def test_what_must_not_be_obeyed_is_refused(bad):
    limiter = SafetyLimiter([-1, -1], [1, 1], 1.0, 1.0)
    with pytest.raises(UnsafeCommandError) as caught:
        step(limiter, LimiterState.at_rest([0, 0]), bad, DT)
    assert caught.value.command and caught.value.allowed


@pytest.mark.parametrize("dt", [0.0, -0.01, math.nan, math.inf])
def test_a_tick_must_be_a_positive_time(dt):
    with pytest.raises(UnsafeCommandError):
        step(one_joint(1, 1), LimiterState.at_rest([0]), [0.0], dt)


def test_named_commands_keep_the_last_command_of_the_other_joints():
    limiter = SafetyLimiter([-1, -1], [1, 1], 100.0, 1e5, joints=("a", "b"))
    state, q, _ = step(limiter, LimiterState.at_rest([0.2, 0.3]), {"b": 0.4}, DT)
    assert q.tolist() == [0.2, 0.4]
    with pytest.raises(UnsafeCommandError, match="unknown joint 'A'"):
        step(limiter, state, {"A": 0.0}, DT)


@pytest.mark.parametrize(
    "arguments",
    [
        ([0], [1, 2], 1, 1),
        ([1], [0], 1, 1),
        ([0], [math.inf], 1, 1),
        ([0], [1], 0, 1),
        ([0], [1], 1, 1e400),
    ],
)
def test_senseless_caps_are_refused_at_once(arguments):
    with pytest.raises(ValueError):
        SafetyLimiter(*arguments)


def test_the_step_is_pure():
    limiter = one_joint(1, 10)
    state = LimiterState.at_rest([0.0])
    command = np.array([1.0])
    first = step(limiter, state, command, DT)
    step(limiter, first[0], command, DT)
    again = step(limiter, state, command, DT)
    assert first[0] == again[0] and first[1] == again[1] and command[0] == 1.0


def test_it_is_cheap_enough_for_any_control_rate():
    limiter = SafetyLimiter([-3] * 6, [3] * 6, 1.5, 6.0)
    state = LimiterState.at_rest([0] * 6)
    best = math.inf
    for k in range(300):
        begin = time.perf_counter()
        state, _, _ = step(limiter, state, [0.01 * k] * 6, DT)
        best = min(best, time.perf_counter() - begin)
    assert best < 1e-3  # about 20 us on an idle machine; the bound only catches a change of kind
