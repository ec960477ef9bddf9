"""``NumericMemory``: the sweep of arms without a closed form, by ``lm`` with restarts.

A pose without a solution is not proven out of reach. An arm of fewer than six joints cannot choose
the roll of its frame, so its map has one roll, and a solution with any roll counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot_ik.budget import Budget
from robot_ik.errors import ModelError
from robot_ik.geometry import Array
from robot_ik.goals import PoseGoal
from robot_ik.kernels import collision
from robot_ik.problem import Problem
from robot_ik.reachability import cells
from robot_ik.robot import Robot
from robot_ik.solution import COLLIDING, Status
from robot_ik.solvers.base import BatchResult

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance

RESTARTS = 10
"""Random starts of a pose after the first. With more, a few more poses are found, more slowly."""

POSE_JOINTS = 6
"""Number of joints that a frame needs to reach any pose."""

Bytes = NDArray[np.uint8]


def has_free_roll(robot: Robot, frame: str | None) -> bool:
    """Return whether a frame has too few joints to choose its roll."""
    node, _ = robot.attachment(frame)
    return len(robot.tree.ancestors(node)) < POSE_JOINTS


class NumericMemory:
    """The memory of one thread's sweep of one block.

    Args:
        robot: The arm.
        frame: Frame that should reach the poses; None for the tool.
        rotations: (o, 3, 3) orientations of the frame.
        collisions: Condition that a solution must keep; None for no condition.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str | None,
        rotations: Array,
        collisions: CollisionAvoidance | None,
    ) -> None:
        free_axis = "z" if has_free_roll(robot, frame) else None
        goal = PoseGoal(frame, np.zeros(3), free_axis=free_axis)
        budget = Budget(restarts=RESTARTS)
        self._problem = Problem(robot, goal, solver="lm", budget=budget, collisions=collisions)
        self._robot = robot
        self._frame = frame
        self._dofs = robot.tree.vadr[robot.tree.ancestors(robot.attachment(frame)[0])]
        self._collisions = collisions
        self._memory = None if collisions is None else collisions.memory()
        node, local = robot.attachment(frame)
        reach = robot.tree.reach(node, local)
        if reach is None:
            raise ModelError(f"the reach of {robot.name!r} is not bounded")
        self._centre, self._radius = reach
        self._targets = np.tile(np.eye(4), (len(rotations), 1, 1))
        self._targets[:, :3, :3] = rotations

    def sweep(
        self,
        positions: Array,
        status: Bytes,
        branches: Bytes,
        manipulability: NDArray[np.float32],
        clearance: NDArray[np.float32],
    ) -> None:
        """Write the results of ``cells.sweep_cells`` for the cells at ``positions`` (c, 3)."""
        for cell, position in enumerate(positions):
            status[cell] = cells.UNREACHABLE
            clearance[cell] = np.nan
            if np.linalg.norm(position - self._centre) > self._radius:
                continue
            solutions = self._solve(position)
            reached = solutions.status == Status.CONVERGED
            status[cell] = cells.NOT_FOUND
            status[cell, np.isin(solutions.status, [int(s) for s in COLLIDING])] = cells.TOUCHING
            status[cell, reached] = cells.REACHED
            branches[cell] = reached
            postures = np.ascontiguousarray(solutions.q[reached])
            if len(postures):
                manipulability[cell] = max(self._manipulability(q) for q in postures)
                clearance[cell] = self._clearance(postures)

    def _solve(self, position: Array) -> BatchResult:
        """Return the solutions of all orientations at a position (3,)."""
        count = len(self._targets)
        self._targets[:, :3, 3] = position
        results = BatchResult.empty(count, self._robot.nq)
        starts = np.tile(self._robot.home, (count, 1))
        self._problem.solve_many(self._targets, starts, results)
        return results

    def _manipulability(self, q: Array) -> float:
        """Return the product of the singular values of the Jacobian at ``q`` (nq,)."""
        jacobian = self._robot.jacobian(q, self._frame)[:, self._dofs]
        return float(np.prod(np.linalg.svd(jacobian, compute_uv=False)))

    def _clearance(self, postures: Array) -> float:
        """Return the largest clearance of postures (n, nq), m; NaN without a condition."""
        if self._memory is None:
            return np.nan
        distances = np.zeros(len(postures))
        nearest = np.zeros(len(postures), dtype=np.int64)
        reach = cells.FARTHEST_CLEARANCE
        collision.smallest_distances(self._memory.address, postures, reach, distances, nearest)
        return float(distances.max())
