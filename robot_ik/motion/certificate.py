"""``certify``: prove that a motion keeps a margin from all collisions, also between its samples."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.scene import posture_rows
from robot_ik.errors import MotionBlockedError
from robot_ik.geometry import Array
from robot_ik.kernels import certificate, collision, jit
from robot_ik.kernels.block import Block
from robot_ik.robot import Robot

Ints = NDArray[np.int64]

MAX_CHECKS = 20_000
"""Largest number of postures that a proof checks: about a tenth of a second."""

MEASURED_POSTURES = 64
"""Largest number of touching samples whose depth MuJoCo measures for an error."""

SAME_DIRECTION = 1e-7
"""Largest difference of two unit directions on one straight line."""

STRAIGHT = 1e-10
"""rad or m. Largest distance of samples from a line that replaces them."""


@dataclass(frozen=True)
class Certificate:
    """Result of ``certify``.

    Attributes:
        certified: Whether the whole motion is proven to keep the margin. If False, no contact was
            found, but the distance of some parts is so close to the margin that nothing can be
            proven.
        clearance: Distance that is proven for the whole motion, m; nan if it is not certified.
        checks: Number of postures that were checked.
    """

    certified: bool
    clearance: float
    checks: int


def certify(
    q: ArrayLike,
    collisions: CollisionAvoidance,
    times: ArrayLike | None = None,
) -> Certificate:
    """Prove that straight lines between postures keep the margin.

    It works for every joint: balls rotate the shortest way, and a free base moves straight and
    rotates the shortest way. Coupled joints follow their leaders.

    Args:
        q: Postures (n, nq).
        collisions: The condition.
        times: Seconds (n,) of the postures, for the error. None counts the postures.

    Raises:
        MotionBlockedError: A pair comes nearer than the margin. The error has the time, the pair
            and the depth.
        ModelError: Another shape, or a number that is not finite.
    """
    robot = collisions.scene.robot
    rows = posture_rows(robot, q)
    if len(robot.tree.coupled):
        rows = np.array([robot.apply_couplings(row) for row in rows])
    seconds = np.arange(len(rows), dtype=float) if times is None else np.asarray(times, dtype=float)
    corners = straight_corners(robot, rows)
    changes = changes_between(robot, rows[corners])
    proof = proof_memory(collisions)
    starts = np.ascontiguousarray(rows[corners[:-1]] if len(changes) else rows[:1])
    verdict = certificate.prove_path(proof.address, starts, changes, collisions.margin)
    if verdict == collision.FREE:
        return Certificate(True, collisions.margin, proof["checks"])
    posture = proof.arrays["q"].copy()
    if collisions.clearance(posture).distance < collisions.margin:
        at = _time_of(rows, seconds, corners, proof["segment"], proof["share"])
        raise _blocked(rows, seconds, posture, at, collisions)
    return Certificate(False, float("nan"), proof["checks"])


def is_certified(q: ArrayLike, collisions: CollisionAvoidance) -> bool:
    """Return whether straight lines between postures (n, nq) are proven to keep the margin."""
    try:
        return certify(q, collisions).certified
    except MotionBlockedError:
        return False


def proof_memory(collisions: CollisionAvoidance) -> Block:
    """Return memory for one proof at a time (``certificate.PROOF``)."""
    robot = collisions.scene.robot
    memory = collisions.memory()
    sizes = {
        "nq": robot.nq,
        "nv": robot.nv,
        "l": len(memory.nested["shapes"].arrays["node"]),
        "n": robot.tree.size,
        "h": certificate.STACK_DEPTH,
    }
    proof = certificate.PROOF.allocate(sizes, {"collision": memory})
    proof["max_checks"] = MAX_CHECKS
    jit.announce(certificate.prove_path, "proofs of motions")
    return proof


def straight_corners(robot: Robot, rows: Array) -> Ints:
    """Return the indices (k,) of the corners of a path (n, nq); the rows between lie on lines."""
    if len(rows) < 3 or robot.nq != robot.nv:
        return np.arange(len(rows))
    steps = np.diff(rows, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    bends = np.linalg.norm(np.diff(directions, axis=0), axis=1) > SAME_DIRECTION
    corners = np.concatenate([[0], np.flatnonzero(bends) + 1, [len(rows) - 1]])
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    if along[-1] == 0.0:
        return np.array([0, len(rows) - 1])
    columns = [np.interp(along, along[corners], rows[corners, j]) for j in range(rows.shape[1])]
    if np.abs(np.column_stack(columns) - rows).max() > STRAIGHT:
        return np.arange(len(rows))
    return corners


def changes_between(robot: Robot, rows: Array) -> Array:
    """Return the changes (k - 1, nv) from each posture to the next; zeros for one posture."""
    if len(rows) < 2:
        return np.zeros((1, robot.nv))
    if robot.nq == robot.nv:
        return np.ascontiguousarray(np.diff(rows, axis=0))
    return np.array([robot.difference(a, b) for a, b in itertools.pairwise(rows)])


def _time_of(rows: Array, seconds: Array, corners: Ints, segment: int, share: float) -> float:
    """Return the time of a share of a line between two corners."""
    if len(corners) < 2:
        return float(seconds[0])
    first = int(corners[segment])
    last = int(corners[segment + 1])
    part = rows[first : last + 1]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(part, axis=0), axis=1))])
    if along[-1] == 0.0:
        return float(seconds[first])
    return float(np.interp(share * along[-1], along, seconds[first : last + 1]))


def _blocked(
    rows: Array, seconds: Array, posture: Array, at: float, collisions: CollisionAvoidance
) -> MotionBlockedError:
    """Return the error: the first contact that is known, and the deepest of the same pair."""
    touching = np.flatnonzero(~collisions.free(rows))
    if len(touching) and seconds[touching[0]] <= at:
        posture = rows[touching[0]]
        at = float(seconds[touching[0]])
    first = collisions.clearance(posture)
    deepest = first.distance
    chosen = np.linspace(0, len(touching) - 1, min(MEASURED_POSTURES, len(touching))).astype(int)
    for row in touching[chosen]:
        clearance = collisions.clearance(rows[row])
        if clearance.pair == first.pair:
            deepest = min(deepest, clearance.distance)
    pair = first.pair or ("", "")  # there is a pair: it was nearer than the margin
    return MotionBlockedError(at, pair, deepest, collisions.margin, posture)
