"""Timing along a path, as functions of numbers: profiles of straight lines, and curved paths.

A path is a curve ``q(s)`` with ``s`` from 0 to 1. A straight line in joint space needs one velocity
bound and one acceleration bound for ``s`` (``trapezoid``, ``quintic``). A curved path needs bounds
that vary along it (``fastest_timing``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.geometry import Array

QUINTIC_PEAK_VELOCITY = 15.0 / 8.0
"""Peak of ds/dx of the rest-to-rest quintic s = 10 x³ - 15 x⁴ + 6 x⁵ over x from 0 to 1."""

QUINTIC_PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)
"""Peak of d²s/dx² of the same quintic."""

STILL = 1e-9
"""A joint that moves less than this share of the fastest joint does not bound d²s/dt²."""

SLOWDOWN_MARGIN = 1.002
"""Additional factor of a slowdown, so that few rounds are needed."""

MAX_SLOWDOWNS = 12
"""Largest number of rounds that slow a sampled motion down until it keeps its bounds."""


def minimum_jerk(phase: ArrayLike) -> Array:
    """Return progress from 0 to 1, at rest at both ends (Flash & Hogan 1985)."""
    x = np.clip(phase, 0.0, 1.0)
    return np.asarray(x * x * x * (10.0 + x * (6.0 * x - 15.0)))


@dataclass(frozen=True)
class Profile:
    """Progress from 0 to 1, at rest at both ends.

    Attributes:
        duration: Shortest time that keeps the bounds, s.
        progress: Maps phases (n,) from 0 to 1, time over duration, to progress (n,) from 0 to 1.
    """

    duration: float
    progress: Callable[[Array], Array]


def trapezoid(velocity: float, acceleration: float) -> Profile:
    """Return the time-optimal profile of a unit distance: accelerate, cruise, brake.

    Args:
        velocity: Bound of progress per second. Infinite for none.
        acceleration: Bound of progress per second squared, finite.
    """
    peak = min(velocity, float(np.sqrt(acceleration)))  # the square root: without cruising
    ramp = peak / acceleration
    duration = 1.0 / peak + ramp
    ramp_share = ramp / duration  # above 0, at most 1/2

    def progress(phase: Array) -> Array:
        x = np.minimum(phase, 1.0 - phase)
        accelerating = 0.5 * x * x / ramp_share
        cruising = x - 0.5 * ramp_share
        first_half = np.where(x < ramp_share, accelerating, cruising) / (1.0 - ramp_share)
        return np.where(phase <= 0.5, first_half, 1.0 - first_half)

    return Profile(duration, progress)


def quintic(velocity: float, acceleration: float) -> Profile:
    """Return the profile with continuous acceleration, which is zero at both ends.

    It is up to 1.9 times slower than ``trapezoid`` and has a bounded jerk.

    Args:
        velocity: Bound of progress per second.
        acceleration: Bound of progress per second squared.
    """
    by_velocity = QUINTIC_PEAK_VELOCITY / velocity
    by_acceleration = float(np.sqrt(QUINTIC_PEAK_ACCELERATION / acceleration))
    return Profile(max(by_velocity, by_acceleration), minimum_jerk)


PROFILES: dict[str, Callable[[float, float], Profile]] = {
    "trapezoid": trapezoid,
    "quintic": quintic,
}
"""Profiles of ``joint_move`` by name."""


@dataclass(frozen=True)
class Timing:
    """Progress along a curved path as a function of time.

    Attributes:
        s: Increasing knots (n,) of the path.
        times: Times (n,) of the knots, s.
        speed: ds/dt (n,) at the knots, 1/s. It changes linearly with time between them.
    """

    s: Array
    times: Array
    speed: Array

    @property
    def duration(self) -> float:
        """Seconds from the first knot to the last."""
        return float(self.times[-1])

    def progress(self, times: Array) -> Array:
        """Return the path parameter (m,) at ``times`` (m,) in seconds."""
        t = np.clip(times, 0.0, self.times[-1])
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.s) - 2)
        elapsed = t - self.times[i]
        slope = (self.speed[i + 1] - self.speed[i]) / (self.times[i + 1] - self.times[i])
        s = self.s[i] + elapsed * (self.speed[i] + 0.5 * slope * elapsed)
        return np.clip(s, self.s[i], self.s[i + 1])


def fastest_timing(
    s: Array,
    q: Array,
    velocity_limits: Array,
    acceleration_limits: Array,
    speed: float,
) -> Timing:
    """Return the fastest run along ``q(s)`` from rest to rest within joint limits of motion.

    With x = (ds/dt)² and u = d²s/dt², the velocity of a joint is q' sqrt(x) and its acceleration is
    q' u + q'' x, both linear in (x, u). A backward pass finds the largest x at each knot from which
    the joints can still brake in time. A forward pass accelerates below it as much as allowed
    (Bobrow 1985; Pham & Pham 2018, "TOPP-RA", equations 8-12). The bounds hold at the knots. Dense
    knots approximate them between the knots, so the caller must check the samples.

    Args:
        s: Increasing knots (n,) from 0 to 1, n >= 2.
        q: Joint vectors (n, nq) at the knots, rad or m.
        velocity_limits: Positive bounds (nq,), rad/s or m/s.
        acceleration_limits: Positive bounds (nq,), rad/s² or m/s².
        speed: Bound of ds/dt, 1/s.
    """
    order: Literal[1, 2] = 2 if len(s) > 2 else 1  # of the differences at the ends
    first = np.gradient(q, s, axis=0, edge_order=order)
    second = np.gradient(first, s, axis=0, edge_order=order)
    bounds = _bounds(first, second, velocity_limits, acceleration_limits, speed)
    gaps = np.diff(s)
    rate = np.sqrt(_forward(_backward(bounds, gaps), bounds, gaps))
    times = np.concatenate([[0.0], np.cumsum(2.0 * gaps / (rate[:-1] + rate[1:]))])
    return Timing(s, times, rate)


@dataclass(frozen=True)
class _Bounds:
    """Bounds at each knot: -reserve - ratio x <= u <= reserve - ratio x, and x <= ceiling.

    Attributes:
        ratio: q'' / q' (n, nq).
        reserve: Acceleration limit over the size of q' (n, nq).
        ceiling: Largest x (n,).
    """

    ratio: Array
    reserve: Array
    ceiling: Array


def _bounds(
    first: Array,
    second: Array,
    velocity_limits: Array,
    acceleration_limits: Array,
    speed: float,
) -> _Bounds:
    """Return the bounds of x and u from the derivatives (n, nq) of the path."""
    size = np.abs(first)
    moves = size > STILL * max(float(size.max()), np.finfo(float).tiny)
    divisor = np.where(moves, first, 1.0)
    ratio = np.where(moves, second / divisor, 0.0)
    reserve = np.where(moves, acceleration_limits / np.abs(divisor), np.inf)
    with np.errstate(divide="ignore"):
        by_joint = np.where(moves, velocity_limits / np.abs(divisor), np.inf)
        by_velocity = np.min(by_joint, axis=1) ** 2
        by_joint = np.where(moves, np.inf, acceleration_limits / np.abs(second))
        by_curvature = np.min(by_joint, axis=1)
    # The intervals of u of two joints overlap while x (ratio_k - ratio_j) <= reserve_j + reserve_k.
    difference = ratio[:, None, :] - ratio[:, :, None]
    total = reserve[:, None, :] + reserve[:, :, None]
    positive = difference > 0.0
    by_pair = np.min(
        np.where(positive, total / np.where(positive, difference, 1.0), np.inf), (1, 2)
    )
    ceiling = np.minimum.reduce(
        [by_velocity, by_curvature, by_pair, np.full(len(by_pair), speed**2)]
    )
    return _Bounds(ratio, reserve, ceiling)


def _backward(bounds: _Bounds, gaps: Array) -> Array:
    """Return the largest x (n,) at each knot from which the joints can brake to a stop."""
    largest = bounds.ceiling.copy()
    largest[-1] = 0.0
    for i in range(len(gaps) - 1, -1, -1):
        slope = 1.0 - 2.0 * gaps[i] * bounds.ratio[i]
        braking = 2.0 * gaps[i] * bounds.reserve[i]
        # With a negative slope even the largest u leaves x negative at the next knot.
        limit = np.where(slope > 0.0, largest[i + 1] + braking, braking)
        by_braking = np.min(np.where(slope != 0.0, limit / np.abs(slope), np.inf))
        largest[i] = min(largest[i], float(by_braking))
    return largest


def _forward(largest: Array, bounds: _Bounds, gaps: Array) -> Array:
    """Return x (n,) of the fastest run from rest that never exceeds ``largest``."""
    x = np.zeros_like(largest)
    for i in range(len(gaps)):
        u = float(np.min(bounds.reserve[i] - bounds.ratio[i] * x[i]))
        x[i + 1] = max(0.0, min(largest[i + 1], x[i] + 2.0 * gaps[i] * u))
    return x
