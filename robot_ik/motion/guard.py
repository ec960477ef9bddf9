"""``MotionGuard``: allows only motions that keep away from collisions, or that lead out of one.

    guard = MotionGuard(avoid)
    trajectory = guard.checked(joint_move(robot, q, goal))    # or MotionBlockedError
    guard.blocking(q, q + step)                               # None, or what is in the way

An arm often stands in contact: it rests on the table, or its model is not exact. So the parts that
are nearer than the margin at the start of a motion may stay so near. They must not come nearer.
"""

from __future__ import annotations

import numpy as np

from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.collision.pairs import Ints
from robot_ik.collision.scene import Clearance
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

STEP_SAMPLES = 4
"""Postures of one step that are checked while parts touch."""


class MotionGuard:
    """Checks motions of a robot against a condition on collisions.

    Attributes:
        collisions: The condition.
    """

    def __init__(self, collisions: CollisionAvoidance) -> None:
        self.collisions = collisions
        self._proof = proof_memory(collisions)

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
            nearest.pair or ("", ""),  # there is a pair: its distance was measured
            float(distances[:, pair].min()),
            margin,
            trajectory.q[row],
        )

    def blocking(self, q: Array, end: Array) -> Clearance | None:
        """Return what is in the way of a short straight step; None if the step is allowed.

        Args:
            q: The last command (nq,).
            end: The next command (nq,), a few millimetres away.

        Returns:
            The clearance where the step is blocked.
        """
        change = end - q
        if not change.any():
            return None
        condition = self.collisions
        self._proof["checks"] = 0
        arguments = self._proof.address, q[None], change[None], condition.margin
        if certificate.prove_path(*arguments) == collision.FREE:
            return None
        if not len(condition.near(q)):
            return condition.clearance(self._proof.arrays["q"].copy())
        margin = condition.margin
        geoms = condition.tables.geoms
        before = condition.scene.pair_distances(q, geoms, margin)
        for share in np.arange(1, STEP_SAMPLES + 1) / STEP_SAMPLES:
            posture = q + share * change
            after = condition.scene.pair_distances(posture, geoms, margin)
            nearer = after < before - STEP_ROUNDING
            if nearer.any():
                return condition.scene.clearance(posture, geoms[nearer])
        return None


def parts_of(trajectory: Trajectory) -> list[Trajectory]:
    """Return a trajectory in parts of ``LONGEST_PART`` samples, with times from its start.

    The last sample of a part is the first of the next one.
    """
    times = trajectory.times - trajectory.times[0]
    firsts = range(0, max(1, len(times) - 1), LONGEST_PART)
    slices = [slice(first, first + LONGEST_PART + 1) for first in firsts]
    return [Trajectory(times[part], trajectory.q[part], trajectory.joints) for part in slices]
