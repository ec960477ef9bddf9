"""How fast to run along a path: pure functions of numbers, nothing of robots or time loops.

A path is a curve ``q(s)``, ``s`` from 0 to 1.  A straight line in joint space needs one velocity and
one acceleration bound for ``s`` (`trapezoid`, `quintic`); a curved path needs bounds that vary
along it (`fastest_timing`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.ports import Array

# Peaks of the rest-to-rest quintic s = 10 x^3 - 15 x^4 + 6 x^5 over x in [0, 1].
_QUINTIC_PEAK_VELOCITY = 15.0 / 8.0
_QUINTIC_PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)

# A joint that moves less than this part of the fastest joint does not limit u, only x (see fastest_timing).
_STILL = 1e-9


def minimum_jerk(phase: ArrayLike) -> Array:
    """Progress from 0 to 1 with no speed and no acceleration at both ends (Flash & Hogan 1985)."""
    x = np.clip(phase, 0.0, 1.0)
    return np.asarray(x * x * x * (10.0 + x * (6.0 * x - 15.0)))


@dataclass(frozen=True)
class Profile:
    """Progress from 0 to 1, at rest at both ends.

    Attributes:
        duration: Shortest time in seconds that keeps the bounds it was made for.
        progress: Phase (n,) in [0, 1] (time over duration) to progress (n,) in [0, 1].
    """

    duration: float
    progress: Callable[[Array], Array]


def trapezoid(velocity: float, acceleration: float) -> Profile:
    """Time-optimal profile for a unit distance: accelerate, cruise, brake.

    Args:
        velocity: Bound of progress per second; infinite means none.
        acceleration: Bound of progress per second squared, finite.
    """
    peak = min(velocity, float(np.sqrt(acceleration)))  # sqrt: the triangle, which never cruises
    ramp = peak / acceleration
    duration = 1.0 / peak + ramp
    share = ramp / duration  # in (0, 1/2]

    def progress(phase: Array) -> Array:
        x = np.minimum(phase, 1.0 - phase)
        near_end = np.where(x < share, 0.5 * x * x / share, x - 0.5 * share) / (1.0 - share)
        return np.where(phase <= 0.5, near_end, 1.0 - near_end)

    return Profile(duration, progress)


def quintic(velocity: float, acceleration: float) -> Profile:
    """Smoothest common profile: acceleration is continuous and zero at both ends.

    Same arguments as `trapezoid`; up to 1.9 times slower in exchange for bounded jerk.
    """
    slow = _QUINTIC_PEAK_VELOCITY / velocity
    heavy = float(np.sqrt(_QUINTIC_PEAK_ACCELERATION / acceleration))
    return Profile(max(slow, heavy), minimum_jerk)


PROFILES: dict[str, Callable[[float, float], Profile]] = {"trapezoid": trapezoid, "quintic": quintic}
"""The shapes that `joint_move` offers, by name."""


@dataclass(frozen=True)
class Timing:
    """Progress along a curved path as a function of time.

    Attributes:
        s: (n,) increasing knots of the path.
        times: (n,) seconds at which they are passed.
        speed: (n,) ds/dt at the knots, 1/s; constant ds/dt slope between them.
    """

    s: Array
    times: Array
    speed: Array

    @property
    def duration(self) -> float:
        """Seconds from the first knot to the last."""
        return float(self.times[-1])

    def progress(self, times: Array) -> Array:
        """Path parameter (m,) at ``times`` (m,) in seconds."""
        t = np.clip(times, 0.0, self.times[-1])
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.s) - 2)
        into = t - self.times[i]
        slope = (self.speed[i + 1] - self.speed[i]) / (self.times[i + 1] - self.times[i])
        s = self.s[i] + into * (self.speed[i] + 0.5 * slope * into)
        return np.clip(s, self.s[i], self.s[i + 1])


def fastest_timing(s: Array, q: Array, velocity: Array, acceleration: Array, speed: float) -> Timing:
    """Fastest run along ``q(s)`` from rest to rest within joint velocity and acceleration bounds.

    With x = (ds/dt)^2 and u = d2s/dt2 a joint's velocity is q' sqrt(x) and its acceleration
    q' u + q'' x, both linear in (x, u); a backward pass finds the largest x at each knot from which
    one can still brake in time, a forward pass accelerates as hard as allowed below it
    (Bobrow 1985; Pham & Pham 2018, "TOPP-RA", equations 8-12).  The bounds hold at the knots;
    between them only as well as the knots are dense, so the caller checks the sampled result.

    Args:
        s: (n,) increasing knots from 0 to 1, n >= 2.
        q: (n, nq) joint vectors at the knots, rad or m.
        velocity: (nq,) bounds, positive, rad/s or m/s.
        acceleration: (nq,) bounds, positive, rad/s^2 or m/s^2.
        speed: Bound of ds/dt, 1/s.
    """
    order: Literal[1, 2] = 2 if len(s) > 2 else 1  # of the differences at the ends
    first = np.gradient(q, s, axis=0, edge_order=order)
    second = np.gradient(first, s, axis=0, edge_order=order)
    ratio, reserve, ceiling = _bounds(first, second, velocity, acceleration, speed)
    x = _forward(_backward(ceiling, ratio, reserve, np.diff(s)), ratio, reserve, np.diff(s))
    rate = np.sqrt(x)
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(s) / (rate[:-1] + rate[1:]))])
    return Timing(s, times, rate)


def _bounds(
    first: Array, second: Array, velocity: Array, acceleration: Array, speed: float
) -> tuple[Array, Array, Array]:
    """Bounds -reserve - ratio x <= u <= reserve - ratio x per knot and joint, and the ceiling of x (n,)."""
    size = np.abs(first)
    moves = size > _STILL * max(float(size.max()), np.finfo(float).tiny)
    divisor = np.where(moves, first, 1.0)
    ratio = np.where(moves, second / divisor, 0.0)
    reserve = np.where(moves, acceleration / np.abs(divisor), np.inf)
    with np.errstate(divide="ignore"):
        by_velocity = np.min(np.where(moves, velocity / np.abs(divisor), np.inf), axis=1) ** 2
        by_curvature = np.min(np.where(moves, np.inf, acceleration / np.abs(second)), axis=1)
    # Two joints whose intervals of u stop overlapping: x (ratio_k - ratio_j) <= reserve_j + reserve_k.
    apart = ratio[:, None, :] - ratio[:, :, None]
    together = reserve[:, None, :] + reserve[:, :, None]
    by_pair = np.min(np.where(apart > 0.0, together / np.where(apart > 0.0, apart, 1.0), np.inf), axis=(1, 2))
    return ratio, reserve, np.minimum(np.minimum(by_velocity, by_curvature), np.minimum(by_pair, speed**2))


def _backward(ceiling: Array, ratio: Array, reserve: Array, gaps: Array) -> Array:
    """Largest x (n,) at each knot from which the rest of the path can be braked to a stop."""
    best = ceiling.copy()
    best[-1] = 0.0
    for i in range(len(gaps) - 1, -1, -1):
        slope, push = 1.0 - 2.0 * gaps[i] * ratio[i], 2.0 * gaps[i] * reserve[i]
        # A slope below zero: even the hardest push leaves x negative at the next knot.
        limit = np.where(slope > 0.0, best[i + 1] + push, push)
        most = np.min(np.where(slope != 0.0, limit / np.abs(slope), np.inf))
        best[i] = min(best[i], float(most))
    return best


def _forward(best: Array, ratio: Array, reserve: Array, gaps: Array) -> Array:
    """The x (n,) of the fastest run from rest that never exceeds ``best``."""
    x = np.zeros_like(best)
    for i in range(len(gaps)):
        push = float(np.min(reserve[i] - ratio[i] * x[i]))
        x[i + 1] = max(0.0, min(best[i + 1], x[i] + 2.0 * gaps[i] * push))
    return x
