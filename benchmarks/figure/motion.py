"""Frames of a figure judged by MuJoCo: its shapes, its inverse dynamics and its contacts.

The judge uses the model, the frames, their rate and the contact that each foot claims. It does not
use how the frames were planned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.figure.balance import derivatives, zero_moment_points
from robot_ik.figure.figure import GRAVITY, SIDES, Figure
from robot_ik.figure.gait import AIR, FLAT
from robot_ik.figure.hull import hull_margin
from robot_ik.figure.poses import touches_itself
from robot_ik.figure.soles import lowest_points, shape_points
from robot_ik.ports import Array

_SUPPORT_HEIGHT = 0.003
"""A shape lower than this supports the figure, m."""

_MIN_FORCE = 0.2
"""Share of the weight above which a zero-moment point counts."""

_NEAR_MARGIN = -0.01
"""Margin of a zero-moment point that is nearly inside, m."""

_ROUNDING = 1e-6
"""Radians and shares by which a limit may be exceeded."""


@dataclass(frozen=True)
class MotionMeasure:
    """Measures of some frames by MuJoCo.

    Attributes:
        frames: Number of frames.
        slip_mm: Largest slip of the touching point of a sole from frame to frame.
        drift_mm: Largest drift of a foot that claims to be flat.
        penetration_mm: Largest depth of the feet's shapes in the floor.
        inside: Share of supported frames with the zero-moment point inside the soles.
        nearly_inside: Share with the point at most 10 mm outside.
        worst_margin_mm: Smallest margin of the zero-moment point, negative outside.
        least_force: Smallest vertical force of the floor, body weights.
        largest_force: Largest vertical force of the floor, body weights.
        outside_limits: Frames with a joint outside its limits.
        too_fast: Frames with a joint above its speed limit.
        self_contact: Frames with a self-contact.
        speed_change: Largest change of a joint's speed from frame to frame, rad/s.
        knee_speed: Largest speed of a knee, rad/s.
    """

    frames: int
    slip_mm: float
    drift_mm: float
    penetration_mm: float
    inside: float
    nearly_inside: float
    worst_margin_mm: float
    least_force: float
    largest_force: float
    outside_limits: int
    too_fast: int
    self_contact: int
    speed_change: float
    knee_speed: float


@dataclass(frozen=True, eq=False)
class Soles:
    """Both feet's shapes in all frames, in the world. Lists have one entry per side.

    Attributes:
        heights: (n, g) heights of the lowest points of the shapes.
        points: (n, g, 3) these points.
        bodies: (g,) bodies of the shapes.
        ends: (n, k, 3) all points that may touch the floor.
        positions: (n, nbody, 3) positions of all bodies.
        rotations: (n, nbody, 3, 3) rotations of all bodies.
    """

    heights: list[Array]
    points: list[Array]
    bodies: list[NDArray[np.int64]]
    ends: list[Array]
    positions: Array
    rotations: Array


def soles_in(figure: Figure, q: Array) -> Soles:
    """Return the soles in frames (n, nq)."""
    model = figure.model
    positions = np.empty((len(q), model.nbody, 3))
    rotations = np.empty((len(q), model.nbody, 3, 3))
    for i, row in enumerate(q):
        data = figure.data_at(row)
        positions[i] = data.xpos
        rotations[i] = data.xmat.reshape(-1, 3, 3)
    soles = Soles([], [], [], [], positions, rotations)
    for name in SIDES:
        heights = []
        points = []
        bodies: list[int] = []
        ends = []
        for body, geoms in figure.feet[name].parts:
            rotation = rotations[:, body]
            position = positions[:, body]
            lowest, local = lowest_points(model, list(geoms), rotation[:, 2, :])
            heights.append(lowest + position[:, 2:3])
            points.append(np.einsum("nij,ngj->ngi", rotation, local) + position[:, None])
            bodies += [body] * len(geoms)
            shapes = np.concatenate([shape_points(model, g, rotation[:, 2, :]) for g in geoms])
            ends.append(np.einsum("nij,knj->nki", rotation, shapes) + position[:, None])
        soles.heights.append(np.concatenate(heights, axis=1))
        soles.points.append(np.concatenate(points, axis=1))
        soles.bodies.append(np.array(bodies))
        soles.ends.append(np.concatenate(ends, axis=1))
    return soles


def measure_motion(
    figure: Figure, q: Array, contact: NDArray[np.int64], speeds: str = "daily"
) -> MotionMeasure:
    """Judge frames.

    Args:
        figure: The figure.
        q: (n, nq) frames.
        contact: (n, 2) contacts that they claim.
        speeds: Set of joint speed limits that they must keep.
    """
    soles = soles_in(figure, q)
    points, force = zero_moment_points(figure, q)
    weights = force / (figure.mass * GRAVITY)
    margins = _margins(soles, contact, points, weights)
    slip, drift = _slip_and_drift(soles, contact)
    lowest = min(float(heights.min()) for heights in soles.heights)

    _, _, velocity = derivatives(figure, q)
    hinges = q[:, 7:]
    is_below = hinges < figure.robot.lower[6:] - _ROUNDING
    is_above = hinges > figure.robot.upper[6:] + _ROUNDING
    limits = figure.speeds[speeds] * (1 + _ROUNDING)
    knees = [figure.addresses(joint)[1] for joint in figure.robot.joints if "knee" in joint]
    changes = np.abs(np.diff(velocity[:-1, 6:], axis=0))
    return MotionMeasure(
        frames=len(q),
        slip_mm=1e3 * slip,
        drift_mm=1e3 * drift,
        penetration_mm=1e3 * max(0.0, -lowest),
        inside=float((margins >= 0).mean()),
        nearly_inside=float((margins >= _NEAR_MARGIN).mean()),
        worst_margin_mm=1e3 * float(margins.min()),
        least_force=float(weights[1:-1].min()),
        largest_force=float(weights[1:-1].max()),
        outside_limits=int((is_below | is_above).any(axis=1).sum()),
        too_fast=int((np.abs(velocity) > limits).any(axis=1).sum()),
        self_contact=sum(touches_itself(figure, row[None]) for row in q),
        speed_change=float(changes.max(initial=0.0)),
        knee_speed=float(np.abs(velocity[:, knees]).max(initial=0.0)),
    )


def _margins(soles: Soles, contact: NDArray[np.int64], points: Array, weights: Array) -> Array:
    """Return the margins of the zero-moment points of supported frames, m.

    Args:
        soles: The soles.
        contact: (n, 2) contacts.
        points: (n, 2) zero-moment points.
        weights: (n,) vertical forces, body weights.
    """
    margins: list[float] = []
    for i in range(1, len(points) - 1):
        supports = [
            ends[i][ends[i, :, 2] < _SUPPORT_HEIGHT, :2]
            for side, ends in enumerate(soles.ends)
            if contact[i, side] != AIR
        ]
        corners = np.concatenate(supports) if supports else np.zeros((0, 2))
        if len(corners) and weights[i] > _MIN_FORCE:
            margins.append(hull_margin(corners, points[i]))
    return np.array(margins) if margins else np.array([np.inf])


def _slip_and_drift(soles: Soles, contact: NDArray[np.int64]) -> tuple[float, float]:
    """Return the largest slip of a touching point and the largest drift of a flat foot, m."""
    slip = 0.0
    drift = 0.0
    positions = soles.positions
    rotations = soles.rotations
    for side in (0, 1):
        foot = int(soles.bodies[side][0])
        flat_position = None
        for i in range(len(positions) - 1):
            if contact[i, side] == AIR or contact[i + 1, side] == AIR:
                flat_position = None
                continue
            lowest = int(soles.heights[side][i].argmin())
            body = int(soles.bodies[side][lowest])
            point = soles.points[side][i, lowest]
            local = rotations[i, body].T @ (point - positions[i, body])
            moved = positions[i + 1, body] + rotations[i + 1, body] @ local
            slip = max(slip, float(np.linalg.norm((moved - point)[:2])))
            if contact[i, side] != FLAT:
                flat_position = None
            elif flat_position is None:
                flat_position = positions[i, foot, :2]
            else:
                way = float(np.linalg.norm(positions[i, foot, :2] - flat_position))
                drift = max(drift, way)
    return slip, drift
