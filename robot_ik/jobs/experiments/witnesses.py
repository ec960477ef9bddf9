"""Witnesses: joint angles of a ball-joint chain that meet a goal, made by drawing the chain, not by solving.

All links but those that an orientation fixes are laid on one circular arc from the base to where they
have to end; each joint then turns its link from the direction of the one before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose, quat_multiply

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
# Nearer than this (metres) a point is the base itself and has no direction.
_AT_BASE = 1e-9


def chain_witness(links: int, target: Pose, *, oriented: bool) -> Array:
    """q (4 · links,) of a chain of links of 1 m whose tip is at ``target``.

    Args:
        links: How many.
        target: Pose of the tip, world; of its orientation nothing is heeded unless ``oriented``.
        oriented: Whether the last link has to be turned as ``target`` says.

    Raises:
        ValueError: The links cannot get there.
    """
    if not oriented:
        return chain_from_world([_turn_up_to(d) for d in _arc(links, target.position)])
    wrist = target.position - target.rotation @ _UP
    turns = [_turn_up_to(d) for d in _arc(links - 1, wrist)]
    return chain_from_world([*turns, target.wxyz])


def chain_from_world(turns: Sequence[Array]) -> Array:
    """q of the chain whose links are turned in the world as the unit quaternions ``turns`` (4,) say."""
    q, before = [], np.array([1.0, 0.0, 0.0, 0.0])
    for turn in turns:
        q.append(quat_multiply(before * [1.0, -1.0, -1.0, -1.0], turn))
        before = turn
    return np.concatenate(q)


def _arc(links: int, end: Array) -> list[Array]:
    """Directions (3,) of links of 1 m on a circular arc from the origin to ``end`` (3,)."""
    chord = float(np.linalg.norm(end))
    bend = arc_bend(links, chord)
    along = end / chord if chord > _AT_BASE else np.array([1.0, 0.0, 0.0])
    # The arc lies in the upright plane through its end; where that end is right above, in the xz plane.
    aside = np.cross(np.cross(along, _UP), along)
    if float(np.linalg.norm(aside)) < 1e-6:
        aside = np.array([1.0, 0.0, 0.0])
    aside = aside - along * (aside @ along)
    aside /= np.linalg.norm(aside)
    angles = [0.5 * bend * (links - 1 - 2 * k) for k in range(links)]
    return [math.cos(a) * along + math.sin(a) * aside for a in angles]


def arc_bend(links: int, chord: float) -> float:
    """Angle from one link to the next, rad, for which the arc's ends are ``chord`` metres apart."""
    if links == 1:
        if abs(chord - 1.0) > _AT_BASE:
            raise ValueError(f"one link of 1 m cannot span {chord:.6g} m")
        return 0.0
    if chord > links + _AT_BASE:
        raise ValueError(f"{links} links of 1 m cannot span {chord:.6g} m")
    low, high = 0.0, 2.0 * math.pi / links  # straight … closed to a polygon
    for _ in range(54):  # as many halvings as a double has bits, and one
        middle = 0.5 * (low + high)
        spanned = math.sin(0.5 * links * middle) / math.sin(0.5 * middle) if middle > 0.0 else float(links)
        low, high = (middle, high) if spanned > chord else (low, middle)
    return 0.5 * (low + high)


def _turn_up_to(direction: Array) -> Array:
    """Shortest turn, wxyz, of the z axis to a unit vector (3,)."""
    w = 1.0 + float(direction[2])
    if w < 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn = np.array([w, -direction[1], direction[0], 0.0])
    return np.asarray(turn / np.linalg.norm(turn))
