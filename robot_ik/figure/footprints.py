"""Footprints: poses of the feet on the floor, and plans of steps along a curve or on the spot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_ik.figure.figure import SIDES, Figure
from robot_ik.figure.gait import WALK, Gait
from robot_ik.ports import Array

_CURVE_POINTS = 400
"""Points of a curve between two stances."""

_STEP_TURN = np.radians(22.0)
"""Largest rotation of a foot in one step of a walk, rad. Above it legs cross and the outer knee
stretches."""

_FIRST_SHARE = 0.55
"""Share of the remainder of the way that the first step covers."""

_LAST_SHARE = 0.45
"""Share of the remainder of the way that the last step covers."""

_SPARE_STEPS = 0.2
"""Steps that are added before the count of steps is rounded up."""

_SMALL_TURN = np.radians(30.0)
"""Largest rotation of the body in one small step, rad."""

_SMALL_FORWARD = 0.3
"""Largest small step forward, m."""

_SMALL_LATERAL = 0.2
"""Largest small step to the side, m."""

_ROUNDING = 1e-6
"""Steps. A count that exceeds a whole number by less is that number."""

_SIDEWAYS = 0.03
"""Smallest motion to the side, m, whose side determines the first foot. Else the turn does."""


@dataclass(frozen=True)
class Footprint:
    """The pose of a foot's frame on the floor.

    Attributes:
        side: 0 for left, 1 for right.
        x: Position, m.
        y: Position, m.
        yaw: Heading, rad.
    """

    side: int
    x: float
    y: float
    yaw: float

    def ahead(self, distance: float) -> Array:
        """Return the point (2,) at a distance in front of the ankle."""
        return np.array(
            [self.x + distance * np.cos(self.yaw), self.y + distance * np.sin(self.yaw)]
        )


def footprint_beside(
    stance: Array, side: int, half_width: float, toe_out: float = 0.0
) -> Footprint:
    """Return the footprint beside a stance (x, y, heading).

    Args:
        stance: (3,) middle between the feet.
        side: 0 for left, 1 for right.
        half_width: Distance of the foot from the middle, m.
        toe_out: Rotation of the toes outwards, rad.
    """
    sign = 1 - 2 * side
    x, y, heading = stance
    return Footprint(
        side,
        x - sign * half_width * np.sin(heading),
        y + sign * half_width * np.cos(heading),
        heading + sign * toe_out,
    )


def prints_of(figure: Figure, q: Array) -> tuple[Footprint, Footprint]:
    """Return the footprints at ``q`` (nq,), left and right.

    Their yaws differ by at most π, also for a figure that faces backwards.
    """
    prints: list[Footprint] = []
    for side, name in enumerate(SIDES):
        (x, y, _), rotation = figure.pose(q, figure.feet[name].frame)
        yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
        if prints:
            yaw += 2 * np.pi * round((prints[0].yaw - yaw) / (2 * np.pi))
        prints.append(Footprint(side, float(x), float(y), yaw))
    return prints[0], prints[1]


def stance_of(left: Footprint, right: Footprint) -> Array:
    """Return x, y and heading (3,) of the middle between two footprints."""
    heading = left.yaw + wrapped(right.yaw - left.yaw) / 2
    return np.array([(left.x + right.x) / 2, (left.y + right.y) / 2, heading])


def wrapped(angle: float) -> float:
    """Return the same angle between -π and π."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def walk_prints(
    figure: Figure, start: tuple[Footprint, Footprint], goal: Array, gait: Gait = WALK
) -> list[Footprint]:
    """Return footsteps along a curve to a stance at a metre or more, rotated by at most 90 degrees.

    The first and the last step are shorter. The foot inside the turn goes first, so that legs do
    not cross.

    Args:
        figure: The figure.
        start: Footprints at the start, left and right.
        goal: (3,) x, y and heading at the end.
        gait: Parameters of the gait.

    Returns:
        The two footprints of the start, then one for each step.
    """
    first = stance_of(*start)
    last = np.array([goal[0], goal[1], first[2] + wrapped(goal[2] - first[2])])
    curve = _hermite_way(first, last)
    lengths = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    tangent = np.gradient(curve, axis=0)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    yaw += first[2] - yaw[0]

    # All steps are as long or rotated as far as allowed, except the first and the last. These two
    # make up the remainder of the way: 0.8 to 1.8 steps together.
    paces = np.maximum(np.diff(way) / gait.length, np.abs(np.diff(yaw)) / _STEP_TURN)
    pace = np.concatenate([[0.0], np.cumsum(paces)])
    count = max(2, int(np.ceil(pace[-1] + _SPARE_STEPS)))
    share = np.ones(count)
    remainder = pace[-1] - (count - 2)
    share[0] = _FIRST_SHARE * remainder
    share[-1] = _LAST_SHARE * remainder
    share = np.cumsum(share) / share.sum() * pace[-1]
    step_lengths = np.diff(np.interp(share, pace, way), prepend=0.0)

    foot = 0 if np.interp(share[0], pace, yaw) > yaw[0] else 1
    half_width = figure.half_width
    prints = list(start)
    for k in range(count):
        if k == count - 1:
            prints.append(footprint_beside(last, foot, half_width))
        else:
            middle = np.array([np.interp(share[k], pace, v) for v in (*curve.T, yaw)])
            # Feet that hardly pass each other keep a larger distance.
            passing = min(1.0, (step_lengths[k] / gait.length) ** 2)
            lateral = half_width + (gait.width / 2 - half_width) * passing
            prints.append(footprint_beside(middle, foot, lateral, np.radians(gait.toe_out_deg)))
        foot = 1 - foot
    prints.append(footprint_beside(last, foot, half_width))
    return prints


def _hermite_way(first: Array, last: Array) -> Array:
    """Return points (k, 2) of a Hermite curve between two stances (x, y, heading)."""
    distance = float(np.linalg.norm(last[:2] - first[:2]))
    u = np.linspace(0.0, 1.0, _CURVE_POINTS)[:, None]
    first_tangent = distance * np.array([np.cos(first[2]), np.sin(first[2])])
    last_tangent = distance * np.array([np.cos(last[2]), np.sin(last[2])])
    curve = (2 * u**3 - 3 * u**2 + 1) * first[:2] + (u**3 - 2 * u**2 + u) * first_tangent
    curve += (3 * u**2 - 2 * u**3) * last[:2] + (u**3 - u**2) * last_tangent
    return np.asarray(curve)


def shuffle_prints(
    figure: Figure, start: tuple[Footprint, Footprint], goal: Array
) -> list[Footprint]:
    """Return small steps to a stance nearby: to any side, or a turn on the spot.

    The foot on the side of the motion goes first and the other follows beside it, so that legs
    never cross.

    Args:
        figure: The figure.
        start: Footprints at the start, left and right.
        goal: (3,) x, y and heading at the end.
    """
    first = stance_of(*start)
    angle = wrapped(goal[2] - first[2])
    displacement = np.asarray(goal[:2]) - first[:2]
    cosine = np.cos(first[2])
    sine = np.sin(first[2])
    forward = cosine * displacement[0] + sine * displacement[1]
    lateral = -sine * displacement[0] + cosine * displacement[1]
    paces = max(
        abs(angle) / _SMALL_TURN,
        float(np.hypot(forward / _SMALL_FORWARD, lateral / _SMALL_LATERAL)),
    )
    count = max(1, int(np.ceil(paces - _ROUNDING)))
    side_of_motion = lateral if abs(lateral) > _SIDEWAYS else angle
    foot = 0 if side_of_motion > 0 else 1
    prints = list(start)
    for k in range(1, count + 1):
        position = first[:2] + displacement * k / count
        middle = np.array([*position, first[2] + angle * k / count])
        for side in (foot, 1 - foot):
            prints.append(footprint_beside(middle, side, figure.half_width))
    return prints
