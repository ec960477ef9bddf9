"""A00's Jacobian update, rewritten from the thesis to find the reason for its lost goals.

The thesis defines: ball joints with Euler increments; Δq = Jᵀ(JJᵀ)⁻¹e; a step that does not end
within 0.5 length units of its subgoal is undone and the way halved, with at most 16 iterations.

It does not define the following values, so this file chooses them: links of 1 unit, circles of half
the reach, 0.5 rad for orientations, the starts (``aho_courses.py``), and no step while the goal is
within tolerance.

The thesis does not state the axes of the columns of J, and the axes about which the increments are
applied. They are fields of ``Update``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import matrix_to_quat, quat_to_matrix, rotation_exp, rotation_log

Array = NDArray[np.float64]
Frame = tuple[Array, Array]
"""A goal: position (3,) and rotation (3, 3)."""

X, Y, Z = np.eye(3)
DIAGONAL = (X + Y) / math.sqrt(2.0)
CLOSE = 0.5  # length units, and rad


def rotation_matrix(axis: Array, degrees: float) -> Array:
    """Rotation matrix about a unit vector."""
    return quat_to_matrix(rotation_exp(np.asarray(axis) * math.radians(degrees)))


def euler(angles: Array) -> Array:
    """Rx Ry Rz, angles in rad: the increments of a joint."""
    a, b, c = np.degrees(angles)
    return rotation_matrix(X, a) @ rotation_matrix(Y, b) @ rotation_matrix(Z, c)


def euler_angles(rotation: Array) -> Array:
    """The three angles (rad) of ``euler``."""
    return np.array(
        [
            math.atan2(-rotation[1, 2], rotation[2, 2]),
            math.asin(max(-1.0, min(1.0, rotation[0, 2]))),
            math.atan2(-rotation[0, 1], rotation[0, 0]),
        ]
    )


@dataclass(frozen=True)
class Update:
    """One version of the update.

    Attributes:
        columns: Axes of J's columns: ``world``, ``parent``, ``body`` (those of the joint), or
            ``euler`` (those of the current Euler angles).
        applied: Axes about which the increments rotate the joint: ``world``, ``parent``, ``body``;
            or ``angles``: they are added to its Euler angles.
        iterations: Largest number of iterations of a frame.
        exact: Increments as one rotation vector, not one Euler angle after the other.
        svd: Singular values below 1e-4 of the largest are left out, in place of (JJᵀ)⁻¹.
    """

    columns: str
    applied: str
    iterations: int = 16
    exact: bool = False
    svd: bool = False


@dataclass(eq=False)
class Chain:
    """Ball joints, one unit apart along ``link``."""

    link: Array
    rotations: list[Array]
    angles: list[Array] = field(default_factory=list)

    def frames(self) -> tuple[list[Array], list[Array], Array]:
        """World rotation of the base and of each link; each joint's position; the tip."""
        worlds = [np.eye(3)]
        positions = []
        at = np.zeros(3)
        for local in self.rotations:
            positions.append(at)
            worlds.append(worlds[-1] @ local)
            at = at + worlds[-1] @ self.link
        return worlds, positions, at

    def jacobian(self, columns: str, oriented: bool) -> Array:
        """(3 or 6, 3 joints): v × (s − p) over v."""
        worlds, positions, tip = self.frames()
        blocks = []
        for k, position in enumerate(positions):
            axes = {"world": np.eye(3), "parent": worlds[k], "body": worlds[k + 1]}.get(columns)
            if axes is None:
                a, b, _ = np.degrees(euler_angles(self.rotations[k]))
                axes = worlds[k] @ np.column_stack(
                    [
                        X,
                        rotation_matrix(X, a) @ Y,
                        rotation_matrix(X, a) @ rotation_matrix(Y, b) @ Z,
                    ]
                )
            linear = np.cross(axes.T, tip - position).T
            blocks.append(np.vstack([linear, axes]) if oriented else linear)
        return np.hstack(blocks)

    def moved(self, update: Update, step: Array) -> Chain:
        """The chain after a step (3 joints,), applied as ``update`` says."""
        worlds, _, _ = self.frames()
        rotations = []
        angles = [*self.angles] or [euler_angles(local) for local in self.rotations]
        for k, local in enumerate(self.rotations):
            increment = step[3 * k : 3 * k + 3]
            delta = quat_to_matrix(rotation_exp(increment)) if update.exact else euler(increment)
            if update.applied == "body":
                rotations.append(local @ delta)
            elif update.applied == "parent":
                rotations.append(delta @ local)
            elif update.applied == "world":
                rotations.append(worlds[k].T @ delta @ worlds[k] @ local)
            else:
                angles[k] = angles[k] + increment
                rotations.append(euler(angles[k]))
        return Chain(self.link, rotations, angles)

    def off(self, goal: Frame, oriented: bool) -> Array:
        """Return the error e, goal minus current pose, (3,) or (6,)."""
        worlds, _, tip = self.frames()
        if not oriented:
            return goal[0] - tip
        return np.concatenate([goal[0] - tip, rotation_log(matrix_to_quat(goal[1] @ worlds[-1].T))])


def close(e: Array) -> bool:
    """Return whether an error is within the tolerance of the thesis."""
    return bool(np.linalg.norm(e[:3]) <= CLOSE and np.linalg.norm(e[3:]) <= CLOSE)


def step_of(jacobian: Array, e: Array, svd: bool) -> Array:
    """Δq = J⁺e. Raises LinAlgError where JJᵀ has no inverse."""
    if svd:
        return np.linalg.pinv(jacobian, rcond=1e-4) @ e
    square = jacobian @ jacobian.T
    if np.linalg.matrix_rank(square) < len(square):  # rounding would pass as a number
        raise np.linalg.LinAlgError("JJᵀ has no inverse")
    return jacobian.T @ np.linalg.solve(square, e)


def reach(chain: Chain, update: Update, goal: Frame, oriented: bool) -> tuple[Chain, bool]:
    """Take the steps of one frame. A step that ends far from its subgoal is halved."""
    share = 1.0
    if close(chain.off(goal, oriented)):
        return chain, True
    for _ in range(update.iterations):
        e = chain.off(goal, oriented)
        jacobian = chain.jacobian(update.columns, oriented)
        try:
            after = chain.moved(update, step_of(jacobian, share * e, update.svd))
        except np.linalg.LinAlgError:
            return chain, False
        left = after.off(goal, oriented)
        if not close(left - (1.0 - share) * e):
            share *= 0.5
            continue
        chain = after
        if close(left):
            return chain, True
        share = 1.0
    return chain, False


def follow(
    chain: Chain, goals: Iterable[Frame], update: Update, *, oriented: bool
) -> tuple[int | None, list[float]]:
    """Return the frame in which the goal is lost (None: never), and the distances until then."""
    distances: list[float] = []
    for k, goal in enumerate(goals):
        chain, met = reach(chain, update, goal, oriented)
        distances.append(float(np.linalg.norm(chain.off(goal, False))))
        if not met:
            return k, distances
    return None, distances


MIXED = Update("world", "body")
"""Loses the goals as in the thesis: columns about world axes, increments about joint axes."""
ALIKE = Update("world", "world")
"""The same axes for both. This is the only change."""

UPDATES = (
    ALIKE,
    Update("parent", "parent"),
    Update("body", "body"),
    MIXED,
    Update("body", "world"),
    Update("world", "parent"),
    Update("parent", "world"),
    Update("world", "angles"),
    Update("body", "parent"),
    Update("parent", "body"),
    Update("parent", "angles"),
    Update("body", "angles"),
    Update("euler", "angles"),
)
