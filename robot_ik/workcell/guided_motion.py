"""Motions that a person has shown by guiding an arm, prepared so that the arm can repeat them.

Ticks are read at uneven times, so a recording has steps that the person did not make. A person also
does not keep the velocity caps of the arm. A recording is therefore smoothed, clipped and slowed.
"""

from __future__ import annotations

import math

import numpy as np

from robot_ik.geometry import Array
from robot_ik.hardware.config import ArmConfig
from robot_ik.motion.timing import Profile, quintic
from robot_ik.motion.trajectory import Trajectory

APPROACH = 0.25
"""Share of the velocity and acceleration caps on the way to the start of a recording."""

SMOOTHING = 0.1
"""Seconds over which a recording is averaged."""


def playable(motion: Trajectory, caps: ArmConfig, speed: float) -> tuple[Trajectory, float]:
    """Return a motion within limits and velocity caps, at the rate of the arm, and its stretch.

    With a table ``[collisions]`` the motion is within the acceleration caps too.

    Args:
        motion: The recording.
        caps: Limits, velocity caps and rate of the arm.
        speed: Requested speed as a share of the recorded speed.

    Returns:
        The motion, and the factor by which its time is longer than recorded.
    """
    smooth = smoothed(motion, caps.rate_hz)
    q = np.clip(smooth.q, caps.lower, caps.upper)
    clipped = Trajectory(smooth.times, q, motion.joints)
    stretch = max(1.0 / speed, float((clipped.peak_velocity / caps.velocity).max()))
    if caps.collisions is not None:
        # The limiter would leave the path that is checked if it had to cap an acceleration.
        excess = float((clipped.peak_acceleration / caps.acceleration).max())
        stretch = max(stretch, math.sqrt(excess))
    stretched = Trajectory(stretch * smooth.times, q, motion.joints)
    return stretched.resampled(caps.rate_hz), stretch


def smoothed(motion: Trajectory, rate: float) -> Trajectory:
    """Return the running mean over ``SMOOTHING`` at ``rate`` Hz, with the same start and end."""
    width = max(round(SMOOTHING * rate), 1)
    padding = ((width - 1, width - 1), (0, 0))
    padded = np.pad(motion.resampled(rate).q, padding, "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
    mean = windows.mean(axis=-1)
    return Trajectory(np.arange(len(mean)) / rate, mean, motion.joints)


def approach_profile(distance: Array, caps: ArmConfig, share: float = APPROACH) -> Profile:
    """Return a quintic over the distances (n,) at a share of the caps.

    Its duration is zero if all distances are zero.
    """
    limits = share * np.array([caps.velocity, caps.acceleration])
    with np.errstate(divide="ignore"):  # a joint with no distance needs no time
        velocity, acceleration = np.min(limits / np.abs(distance), axis=1)
    return quintic(float(velocity), float(acceleration))


def approach(start: Array, end: Array, caps: ArmConfig, share: float = APPROACH) -> Trajectory:
    """Return the straight motion from rest to rest by a quintic, at a share of the caps."""
    profile = approach_profile(end - start, caps, share)
    seconds = max(profile.duration, 2.0 / caps.rate_hz)
    times = np.linspace(0.0, seconds, math.ceil(seconds * caps.rate_hz) + 1)
    q = start + np.outer(profile.progress(times / seconds), end - start)
    return Trajectory(times, q, caps.names)
