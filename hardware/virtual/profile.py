"""How a shaft gets to its goal: pieces of constant acceleration, known in closed form at any time.

Positions are encoder ticks, velocities ticks/s, accelerations ticks/s^2.  Because a motion is a formula
and not an integration, asking for the position often or rarely gives the same answer.
Source: ROBOTIS e-manual, "Profile Acceleration", "Profile Velocity" and "Moving Status" of the X series.
"""

from __future__ import annotations

import math
from enum import IntEnum

from robot_ik.hardware.control_table import ACCELERATION_UNIT, RADIANS_PER_TICK, VELOCITY_UNIT

VELOCITY_TICKS = VELOCITY_UNIT / RADIANS_PER_TICK
"""One unit of the velocity registers, ticks/s."""
ACCELERATION_TICKS = ACCELERATION_UNIT / RADIANS_PER_TICK
"""One unit of the acceleration registers, ticks/s^2."""
PHYSICAL_ACCELERATION = 800.0 * ACCELERATION_TICKS
"""What an unloaded shaft can do, ticks/s^2 (300 rad/s^2): "unlimited" is still a motor with a rotor."""


class ProfileKind(IntEnum):
    """Bits 4-5 of Moving Status."""

    STEP = 0
    RECTANGULAR = 1
    TRIANGULAR = 2
    TRAPEZOIDAL = 3


_Piece = tuple[float, float, float, float]
"""From a time (s) on: position and velocity there, and the constant acceleration."""


def _at(piece: _Piece, t: float) -> tuple[float, float]:
    start, position, velocity, acceleration = piece
    dt = t - start
    return position + (velocity + 0.5 * acceleration * dt) * dt, velocity + acceleration * dt


class Motion:
    """A planned motion.  Plain, for one is made for every goal that comes over the bus.

    Args:
        pieces: In order of time; the last one goes on for ever.
        end: When it is over, s; infinite for turning at a velocity.
        kind: As Moving Status reports it.
    """

    __slots__ = ("end", "kind", "pieces")

    def __init__(self, pieces: tuple[_Piece, ...], end: float, kind: ProfileKind = ProfileKind.STEP) -> None:
        self.pieces = pieces
        self.end = end
        self.kind = kind

    def at(self, t: float) -> tuple[float, float]:
        """(position, velocity) at time ``t``, s, not before the start."""
        for piece in reversed(self.pieces):
            if t >= piece[0]:
                return _at(piece, t)
        first = self.pieces[0]
        return first[1], first[2]


def rest(t: float, position: float) -> Motion:
    """Standing still."""
    return Motion(((t, position, 0.0, 0.0),), t)


def brake(t: float, position: float, velocity: float, acceleration: float) -> Motion:
    """Slowing down to a stand, wherever that is."""
    seconds = abs(velocity) / acceleration
    stop = position + 0.5 * velocity * seconds
    slowing = (t, position, velocity, -math.copysign(acceleration, velocity))
    return Motion((slowing, (t + seconds, stop, 0.0, 0.0)), t + seconds, ProfileKind.TRIANGULAR)


def turn(t: float, position: float, velocity: float, wanted: float, acceleration: float) -> Motion:
    """Ramp to the ``wanted`` velocity and keep it."""
    seconds = abs(wanted - velocity) / acceleration
    ramp = (t, position, velocity, math.copysign(acceleration, wanted - velocity))
    return Motion((ramp, (t + seconds, _at(ramp, t + seconds)[0], wanted, 0.0)), math.inf)


def move(
    t: float,
    position: float,
    velocity: float,
    goal: float,
    top: float,
    acceleration: float,
    kind: ProfileKind | None = None,
) -> Motion:
    """The fastest motion to a stand at ``goal`` with ``|velocity| <= top`` and the given acceleration.

    A start that is faster than ``top`` first slows down to it; one that can no longer stop in time overshoots
    and comes back.

    Args:
        t: Start, s.
        position: There.
        velocity: There.
        goal: Where it ends.
        top: Cruising speed, > 0.
        acceleration: Of both ramps, > 0.
        kind: What to report; ``None``: triangular or trapezoidal, as it comes out.
    """
    distance = goal - position
    room = distance - 0.5 * velocity * abs(velocity) / acceleration
    side = math.copysign(1.0, room)
    peak = min(top, math.sqrt(max(0.0, side * acceleration * distance + 0.5 * velocity**2)))
    cruise = side * peak
    first = abs(cruise - velocity) / acceleration
    last = peak / acceleration
    rest_of_way = distance - 0.5 * (velocity + cruise) * first - 0.5 * cruise * last
    middle = max(0.0, side * rest_of_way / peak) if peak > 0.0 else 0.0
    ramp = (t, position, velocity, math.copysign(acceleration, cruise - velocity))
    cruising = t + first
    there = _at(ramp, cruising)[0]
    braking = cruising + middle
    end = braking + last
    steady = (cruising, there, cruise, 0.0)
    slowing = (braking, there + cruise * middle, cruise, -side * acceleration)
    if kind is None:
        kind = ProfileKind.TRAPEZOIDAL if peak >= top else ProfileKind.TRIANGULAR
    return Motion((ramp, steady, slowing, (end, goal, 0.0, 0.0)), end, kind)


def profiled_move(
    t: float,
    position: float,
    velocity: float,
    goal: float,
    *,
    profile_velocity: int,
    profile_acceleration: int,
    time_based: bool,
    physical_top: float,
) -> Motion:
    """The motion that the profile registers ask for, within what the motor can do.

    Profile Velocity 0 is a step, Profile Acceleration 0 a rectangle: both are as steep as the motor allows.
    Time-based profiles (Drive Mode bit 2) keep their times from a stand; a new goal on the fly uses the same
    cruising speed and ramps.

    Args:
        t: Start, s.
        position: There, ticks.
        velocity: There, ticks/s.
        goal: Ticks.
        profile_velocity: The register; units of 0.229 rev/min, or the total time in ms.
        profile_acceleration: The register; units of 214.577 rev/min^2, or the ramp time in ms.
        time_based: Which of the two.
        physical_top: Speed of the motor, ticks/s.
    """
    if profile_velocity == 0:
        return move(t, position, velocity, goal, physical_top, PHYSICAL_ACCELERATION, ProfileKind.STEP)
    kind = None if profile_acceleration else ProfileKind.RECTANGULAR
    top, acceleration = profile_velocity * VELOCITY_TICKS, profile_acceleration * ACCELERATION_TICKS
    if time_based:
        total = profile_velocity / 1000.0
        ramp = min(profile_acceleration / 1000.0, 0.5 * total)
        top = abs(goal - position) / (total - ramp)
        acceleration = top / ramp if ramp > 0.0 else 0.0
    # 0 is "as the motor can"; so is a time for no way at all.
    top = min(top or math.inf, physical_top)
    acceleration = min(acceleration or math.inf, PHYSICAL_ACCELERATION)
    return move(t, position, velocity, goal, top, acceleration, kind)
