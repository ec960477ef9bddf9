"""``MotionGuard``: allows only motions that keep away from collisions, or that move out of one.

    guard = MotionGuard(avoid)
    trajectory = guard.checked(joint_move(robot, q, goal))    # or MotionBlockedError
    guard.blocked_at(q, q + step)                             # None, or the blocked posture

An arm is often in contact at rest: it lies on the table, or its model is not exact. So parts that
are nearer than the margin at the start of a motion may keep their distance. They must not come
nearer.
"""

from __future__ import annotations

import math

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.pairs import Ints
from robot_ik.errors import MotionBlockedError
from robot_ik.geometry import Array
from robot_ik.kernels import certificate, collision
from robot_ik.motion.certificate import certify, proof_memory
from robot_ik.motion.trajectory import Trajectory

SLACK = 1e-4
"""m. Parts that touch at the start of a trajectory may come nearer by this: less than a tick."""

LONGEST_PART = 1000
"""Samples of a trajectory that one proof covers. A proof checks a limited number of postures."""

STEP_ROUNDING = 1e-9
"""m. Parts that touch may come nearer by this in one step of a stream, through rounding."""

NEAR = 1e-3
"""m. Parts nearer than the margin plus this may move apart without a proof of the margin."""

PROVEN_SHARE = 0.9
"""Share of the margin that is proven while parts move apart."""

LONGEST_SAMPLE = 0.01
"""rad or m. Distance of the postures of a step that are checked while parts touch.

A part at 0.5 m moves 5 mm between them: past a ball of 20 mm it comes 0.16 mm nearer at most.
"""


class MotionGuard:
    """Checks motions of a robot against a condition on collisions.

    Attributes:
        collisions: The condition.
    """

    def __init__(self, collisions: CollisionAvoidance) -> None:
        self.collisions = collisions
        self._proof = proof_memory(collisions)
        self._near_q = np.full(collisions.scene.robot.nq, np.nan)
        self._near_pairs = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
        # The first proof on a machine compiles, which must not happen while an arm moves.
        home = collisions.scene.robot.home
        self._is_proven(home, np.zeros(collisions.scene.robot.nv), 0.0)
        self._near(home)

    def checked(self, trajectory: Trajectory) -> Trajectory:
        """Return an allowed trajectory, certified if that is proven.

        It is not certified if parts are nearer than the margin at its start: these parts are
        compared at its samples only.

        Raises:
            MotionBlockedError: Parts would come nearer than the margin, or than at the start.
        """
        condition = self.collisions
        near = condition.near(trajectory.q[0])
        rest = condition.without(near) if len(near) else condition
        certified = [self._is_certified(part, rest) for part in parts_of(trajectory)]
        if len(near):
            self._require_no_nearer(trajectory, near)
            return trajectory
        clearance = condition.margin if all(certified) else None
        return Trajectory(trajectory.times, trajectory.q, trajectory.joints, clearance=clearance)

    def _is_certified(self, part: Trajectory, condition: CollisionAvoidance) -> bool:
        """Return whether a part of a trajectory is certified; raise if a contact is found."""
        if certify(part.q, condition, part.times).certified:
            return True
        blocked = np.flatnonzero(~condition.free(part.q))
        if len(blocked):
            row = int(blocked[0])
            nearest = condition.clearance(part.q[row])
            raise MotionBlockedError(
                float(part.times[row]),
                nearest.pair or ("", ""),
                nearest.distance,
                condition.margin,
                part.q[row],
            )
        return False

    def _require_no_nearer(self, trajectory: Trajectory, near: Ints) -> None:
        """Raise ``MotionBlockedError`` if one of some pairs (p, 2) comes nearer than at the start.

        A pair that has left the margin must keep it.
        """
        condition = self.collisions
        margin = condition.margin
        distances = np.array(
            [condition.scene.pair_distances(q, near, margin) for q in trajectory.q]
        )
        has_left = np.maximum.accumulate(distances >= margin, axis=0)
        allowed = np.where(has_left, margin, distances[0]) - SLACK
        blocked = np.argwhere(distances < allowed)
        if not len(blocked):
            return
        row, pair = blocked[0].tolist()
        nearest = condition.scene.clearance(trajectory.q[row], near[pair : pair + 1])
        raise MotionBlockedError(
            float(trajectory.times[row] - trajectory.times[0]),
            nearest.pair or ("", ""),  # never None here: its distance was measured
            float(distances[:, pair].min()),
            margin,
            trajectory.q[row],
        )

    def blocked_at(self, q: Array, end: Array) -> Array | None:
        """Return the posture at which a straight step is blocked; None if it is allowed.

        Args:
            q: The last command (nq,).
            end: Posture at the end of the step (nq,).

        Returns:
            The posture (nq,) at which parts would be nearer than allowed.
        """
        change = end - q
        if not change.any():
            return None
        margin = self.collisions.margin
        if self._is_proven(q, change, margin):
            return None
        blocked = self._proof.arrays["q"].copy()
        geoms, distances = self._near(q)
        if not len(geoms):
            return blocked
        smaller_margin = PROVEN_SHARE * margin
        if 0.0 < smaller_margin < distances.min():
            # For a motion that starts at the margin only a part of the margin can be proven.
            if not self._is_proven(q, change, smaller_margin):
                return self._proof.arrays["q"].copy()
        else:
            geoms = self.collisions.tables.geoms
            distances = self.collisions.scene.pair_distances(q, geoms, margin)
        return self._nearer_at(q, change, geoms, np.minimum(distances, margin))

    def forget(self) -> None:
        """Discard the stored distances, because obstacles may have moved."""
        self._near_q.fill(np.nan)

    def _is_proven(self, q: Array, change: Array, margin: float) -> bool:
        """Return whether a straight step is proven to keep a margin."""
        self._proof["checks"] = 0
        verdict = certificate.prove_path(self._proof.address, q[None], change[None], margin)
        return bool(verdict == collision.FREE)

    def _near(self, q: Array) -> tuple[Ints, Array]:
        """Return the pairs (p, 2) that are near the margin at ``q``, and their distances (p,)."""
        if np.array_equal(q, self._near_q):
            return self._near_pairs
        condition = self.collisions
        reach = condition.margin + NEAR
        run = self._proof.nested["collision"]
        collision.near_pairs(run.address, q, reach)
        check = run.nested["check"]
        count = check["near_count"]
        geoms = condition.tables.geoms
        if count < len(check.arrays["near_pair"]):
            geoms = geoms[check.arrays["near_pair"][:count]]
        distances = condition.scene.pair_distances(q, geoms, reach)
        is_near = distances < reach
        self._near_q = q.copy()
        self._near_pairs = geoms[is_near], distances[is_near]
        return self._near_pairs

    def _nearer_at(self, q: Array, change: Array, geoms: Ints, allowed: Array) -> Array | None:
        """Return the posture at which a pair (p, 2) is nearer than allowed (p,), or None."""
        scene = self.collisions.scene
        reach = float(allowed.max())
        count = max(2, math.ceil(float(np.abs(change).max()) / LONGEST_SAMPLE))
        for share in np.arange(1, count + 1) / count:
            posture = q + share * change
            if (scene.pair_distances(posture, geoms, reach) < allowed - STEP_ROUNDING).any():
                return np.asarray(posture)
        return None


def parts_of(trajectory: Trajectory) -> list[Trajectory]:
    """Return a trajectory in parts of ``LONGEST_PART`` samples, with times from its start.

    The last sample of a part is the first of the next one.
    """
    times = trajectory.times - trajectory.times[0]
    firsts = range(0, max(1, len(times) - 1), LONGEST_PART)
    slices = [slice(first, first + LONGEST_PART + 1) for first in firsts]
    return [Trajectory(times[part], trajectory.q[part], trajectory.joints) for part in slices]
