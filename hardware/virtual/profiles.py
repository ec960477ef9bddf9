"""Motions of a shaft in closed form: pieces of constant acceleration.

Positions are encoder ticks, velocities ticks/s, accelerations ticks/s^2. A motion is a formula and
not an integration, so the result does not depend on how often the position is read.
Source: ROBOTIS e-manual, "Profile Acceleration", "Profile Velocity" and "Moving Status" of the X
series.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

from robot_ik.hardware.families.dynamixel_x_table import ACCELERATION_UNIT, VELOCITY_UNIT
from robot_ik.hardware.registers import RADIANS_PER_TICK

VELOCITY_TICKS = VELOCITY_UNIT / RADIANS_PER_TICK
"""ticks/s of one count of the velocity registers."""
ACCELERATION_TICKS = ACCELERATION_UNIT / RADIANS_PER_TICK
"""ticks/s^2 of one count of the acceleration registers."""
PHYSICAL_ACCELERATION = 800.0 * ACCELERATION_TICKS
"""ticks/s^2 (300 rad/s^2). Limit of an unloaded shaft, also where a register says "unlimited"."""


class ProfileKind(IntEnum):
    """Bits 4 and 5 of Moving Status."""

    STEP = 0
    RECTANGULAR = 1
    TRIANGULAR = 2
    TRAPEZOIDAL = 3


_Piece = tuple[float, float, float, float]
"""Start time (s), position and velocity there, and the constant acceleration from there on."""


def _at(piece: _Piece, t: float) -> tuple[float, float]:
    start, position, velocity, acceleration = piece
    dt = t - start
    return position + (velocity + 0.5 * acceleration * dt) * dt, velocity + acceleration * dt


class MotorMotion(NamedTuple):
    """A planned motion.

    Attributes:
        pieces: In order of time. The last one has no end.
        end: Time at which the motion is over, s; infinite for turning at a velocity.
        kind: As Moving Status reports it.
    """

    pieces: tuple[_Piece, ...]
    end: float
    kind: ProfileKind = ProfileKind.STEP

    def at(self, t: float) -> tuple[float, float]:
        """Return (position, velocity) at time ``t`` in s, which is not before the start."""
        for piece in reversed(self.pieces):
            if t >= piece[0]:
                return _at(piece, t)
        first = self.pieces[0]
        return first[1], first[2]


def rest(t: float, position: float) -> MotorMotion:
    """Return the motion of a shaft that stands still."""
    return MotorMotion(((t, position, 0.0, 0.0),), t)


def brake(t: float, position: float, velocity: float, acceleration: float) -> MotorMotion:
    """Return the motion that slows down to a stop, wherever that is."""
    seconds = abs(velocity) / acceleration
    stop = position + 0.5 * velocity * seconds
    slowing = (t, position, velocity, -math.copysign(acceleration, velocity))
    return MotorMotion(
        (slowing, (t + seconds, stop, 0.0, 0.0)), t + seconds, ProfileKind.TRIANGULAR
    )


def constant_velocity(
    t: float, position: float, velocity: float, target: float, acceleration: float
) -> MotorMotion:
    """Return the motion that ramps to the ``target`` velocity and keeps it."""
    seconds = abs(target - velocity) / acceleration
    ramp = (t, position, velocity, math.copysign(acceleration, target - velocity))
    return MotorMotion((ramp, (t + seconds, _at(ramp, t + seconds)[0], target, 0.0)), math.inf)


def move(
    t: float,
    position: float,
    velocity: float,
    goal: float,
    top: float,
    acceleration: float,
    kind: ProfileKind | None = None,
) -> MotorMotion:
    """Return the fastest motion to a stop at ``goal`` within ``top`` and ``acceleration``.

    A shaft that starts faster than ``top`` first slows down to ``top``. A shaft that can no longer
    stop in time overshoots and comes back.

    Args:
        t: Start time, s.
        position: Encoder ticks at the start.
        velocity: ticks/s at the start.
        goal: Encoder ticks.
        top: Cruising speed, > 0, ticks/s.
        acceleration: Acceleration of both ramps, > 0, ticks/s^2.
        kind: Kind to report. None: triangular or trapezoidal, as the motion results.
    """
    distance = goal - position
    excess = distance - 0.5 * velocity * abs(velocity) / acceleration
    sign = math.copysign(1.0, excess)
    peak = min(top, math.sqrt(max(0.0, sign * acceleration * distance + 0.5 * velocity**2)))
    cruise = sign * peak
    ramp_time = abs(cruise - velocity) / acceleration
    brake_time = peak / acceleration
    cruise_way = distance - 0.5 * (velocity + cruise) * ramp_time - 0.5 * cruise * brake_time
    cruise_time = max(0.0, sign * cruise_way / peak) if peak > 0.0 else 0.0
    ramp = (t, position, velocity, math.copysign(acceleration, cruise - velocity))
    cruise_start = t + ramp_time
    cruise_position = _at(ramp, cruise_start)[0]
    brake_start = cruise_start + cruise_time
    brake_position = cruise_position + cruise * cruise_time
    end = brake_start + brake_time
    steady = (cruise_start, cruise_position, cruise, 0.0)
    slowing = (brake_start, brake_position, cruise, -sign * acceleration)
    if kind is None:
        kind = ProfileKind.TRAPEZOIDAL if peak >= top else ProfileKind.TRIANGULAR
    return MotorMotion((ramp, steady, slowing, (end, goal, 0.0, 0.0)), end, kind)
