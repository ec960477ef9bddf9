"""A motion that a hand has shown, made such that an arm can repeat it.

Whole ticks read at uneven times have steps in them that no hand has made, and a hand keeps no velocity caps:
``playable`` averages, clips and stretches.  ``approach`` leads to where the motion begins.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array

APPROACH = 0.25
"""Share of the caps on the approach to where a recording begins."""

SMOOTHING = 0.1
"""s over which a recording is averaged before it is played."""


class MotionCaps(Protocol):
    """What an arm allows, as its file says: names of joints, (n,) limits and caps, rad, rad/s, rad/s²."""

    @property
    def rate_hz(self) -> float: ...

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def lower(self) -> Array: ...

    @property
    def upper(self) -> Array: ...

    @property
    def velocity(self) -> Array: ...

    @property
    def acceleration(self) -> Array: ...


def playable(motion: Trajectory, caps: MotionCaps, speed: float) -> tuple[Trajectory, float]:
    """The motion within limits and velocity caps, at the arm's rate; and how much longer it takes."""
    smooth = smoothed(motion, caps.rate_hz)
    q = np.clip(smooth.q, caps.lower, caps.upper)
    needed = float((Trajectory(smooth.times, q, motion.joints).peak_velocity / caps.velocity).max())
    stretch = max(1.0 / speed, needed)
    return Trajectory(stretch * smooth.times, q, motion.joints).resampled(caps.rate_hz), stretch


def smoothed(motion: Trajectory, rate: float) -> Trajectory:
    """The running mean over ``SMOOTHING``, at ``rate`` Hz; it begins and ends where the motion does."""
    count = math.ceil(motion.duration * rate) + 1
    q = np.array([motion.at(motion.times[0] + k / rate) for k in range(count)])
    width = max(round(SMOOTHING * rate), 1)
    padded = np.pad(q, ((width - 1, width - 1), (0, 0)), "edge")
    mean = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0).mean(axis=-1)
    return Trajectory(np.arange(len(mean)) / rate, mean, motion.joints)


def approach(here: Array, there: Array, caps: MotionCaps) -> Trajectory:
    """From rest to rest by a quintic, at ``APPROACH`` of the caps; its peaks: 1.875 d/T and 5.774 d/T^2."""
    distance = np.abs(there - here)
    times = (
        1.875 * distance / (APPROACH * caps.velocity),
        np.sqrt(5.774 * distance / (APPROACH * caps.acceleration)),
    )
    seconds = max(float(np.max(times)), 2.0 / caps.rate_hz)
    t = np.linspace(0.0, seconds, math.ceil(seconds * caps.rate_hz) + 1)
    s = t / seconds
    return Trajectory(t, here + np.outer(10 * s**3 - 15 * s**4 + 6 * s**5, there - here), caps.names)
