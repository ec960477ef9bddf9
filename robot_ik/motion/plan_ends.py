"""Start and goal of a plan: postures of a goal in task space, and the retreat from a contact.

A gripper that holds a part touches it. The pairs that may touch at an end (``allowed``) are left by
a straight move of the tool, in which they come no nearer to each other than at the end. The search
begins where that move ends: there all pairs keep the margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.branches import solve_all
from robot_ik.collision.avoidance import CollisionAvoidance
from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Array
from robot_ik.goals import Goal, Tolerance
from robot_ik.motion.certificate import is_certified
from robot_ik.problem import Problem
from robot_ik.robot import Robot
from robot_ik.solution import Solution
from robot_ik.solvers.avoiding import moved_coordinates
from robot_ik.solvers.base import Solver

MAX_STARTS = 12
"""Largest number of random starts from which other postures of a goal are searched."""

MAX_POSTURES = 8
"""Largest number of postures of a goal."""

SAME_POSTURE = 0.1
"""rad or m. Postures that differ by less in each joint are the same posture."""

RETREAT_STEP = 0.005
"""m. Length of a step of the tool out of a contact."""

LONGEST_RETREAT = 0.2
"""m. Longest retreat in one direction."""

DEEPENING = 5e-4
"""m. Pairs that may touch come at most this much nearer to each other during a retreat."""

ROTATION_WEIGHT = 0.2
"""m/rad. Weight of the rotation of the tool. It is small, because arms with few joints cannot keep
the orientation."""

DAMPING = 1e-3
"""m. Damping of the steps, beside the singular values of the Jacobian."""

RETREATS = (
    ("tool", (0.0, 0.0, -1.0)),
    ("world", (0.0, 0.0, 1.0)),
    ("tool", (1.0, 0.0, 0.0)),
    ("tool", (-1.0, 0.0, 0.0)),
    ("tool", (0.0, 1.0, 0.0)),
    ("tool", (0.0, -1.0, 0.0)),
)
"""Directions of the retreat, in axes of the tool or of the world: first back along the tool, then
up, then to the sides."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """The conditions at the ends of a plan.

    Attributes:
        collisions: The condition of the plan.
        rest: The condition without the pairs that may touch at the ends.
        allowed: The pairs that may touch at the ends only, without a margin. None without such
            pairs.
    """

    collisions: CollisionAvoidance
    rest: CollisionAvoidance
    allowed: CollisionAvoidance | None

    @classmethod
    def of(cls, collisions: CollisionAvoidance, allowed: Sequence[Sequence[str]]) -> Contacts:
        """Split the pairs of a condition."""
        if not allowed:
            return cls(collisions, collisions, None)
        scene = collisions.scene
        ignore = (*collisions.ignore, *allowed)
        rest = CollisionAvoidance(scene, collisions.margin, collisions.pairs, ignore)
        return cls(collisions, rest, CollisionAvoidance(scene, 0.0, allowed))

    def way_out(self, end: Array) -> Array | None:
        """Return postures (k, nq) from an end to a posture that keeps the margin of all pairs.

        It is the end alone if that keeps the margin, and None if no retreat was found.
        """
        if self.collisions.free(end):
            return end[None]
        if self.allowed is None:
            return None
        for axes, direction in RETREATS:
            rows = self._retreat(end, axes, np.array(direction))
            if rows is not None:
                return rows
        return None

    def _retreat(self, end: Array, axes: str, direction: Array) -> Array | None:
        """Move the tool straight in one direction until all pairs keep the margin."""
        robot = self.collisions.scene.robot
        tool = robot.forward(end)
        velocity = tool.rotation @ direction if axes == "tool" else direction
        rows = [end]
        for _ in range(round(LONGEST_RETREAT / RETREAT_STEP)):
            q = self._moved(robot, rows[-1], RETREAT_STEP * velocity)
            if not self.rest.free(q) or self._is_deeper(end, q):
                return None
            rows.append(q)
            if self.collisions.free(q):
                return self._simplified(np.array(rows))
        return None

    @staticmethod
    def _moved(robot: Robot, q: Array, shift: Array) -> Array:
        """Return ``q`` (nq,) after a small shift of the tool (3,), world."""
        weights = np.array([1.0, 1.0, 1.0, ROTATION_WEIGHT, ROTATION_WEIGHT, ROTATION_WEIGHT])
        jacobian = weights[:, None] * robot.jacobian(q)
        square = jacobian @ jacobian.T + DAMPING**2 * np.eye(6)
        change = jacobian.T @ np.linalg.solve(square, np.concatenate([shift, np.zeros(3)]))
        return robot.apply_couplings(robot.clip(q + change))

    def _is_deeper(self, end: Array, q: Array) -> bool:
        """Return whether the pairs that may touch are nearer at ``q`` than at the end."""
        if self.allowed is None:
            return False
        before = min(self.allowed.clearance(end).distance, self.collisions.margin)
        return bool(self.allowed.clearance(q).distance < before - DEEPENING)

    def _simplified(self, rows: Array) -> Array | None:
        """Return a proven path (k, nq), of its ends alone if possible; None without a proof."""
        shares = np.linspace(0.0, 1.0, len(rows))[1:-1, None]
        between = rows[0] + shares * (rows[-1] - rows[0])
        ends = rows[[0, -1]]
        deeper = any(self._is_deeper(rows[0], q) for q in between)
        if not deeper and is_certified(ends, self.rest):
            return ends
        return rows if is_certified(rows, self.rest) else None


@dataclass(frozen=True, eq=False)
class GoalPostures:
    """Postures that meet goals in task space.

    Attributes:
        rows: (g, nq) free postures, nearest to the start first. Empty if the first solve failed.
        solution: The first solution.
        moved: Indices in q (m,) of the joints that move a goal.
    """

    rows: Array
    solution: Solution
    moved: NDArray[np.int64]


def goal_postures(
    robot: Robot,
    goals: Sequence[Goal],
    start: Array,
    rest: CollisionAvoidance,
    solver: str | Solver,
    tolerance: Tolerance,
    seed: int,
) -> GoalPostures:
    """Return free postures that meet goals.

    If a closed form is known, they are all its free branches. Other arms are solved from several
    starts.

    Args:
        robot: The robot.
        goals: Goals on any frames.
        start: Start (nq,) of the first solve.
        rest: The condition on collisions, without the pairs that may touch at the goal.
        solver: A name in ``SOLVERS`` or a solver.
        tolerance: Position and angle within which the goals are met.
        seed: Seed of the other starts.
    """
    problem = Problem(robot, goals, solver=solver, tolerance=tolerance, seed=seed, collisions=rest)
    moved = np.asarray(moved_coordinates(problem), dtype=np.int64)
    solution = problem.solve(start)
    if not solution.converged:
        return GoalPostures(np.empty((0, robot.nq)), solution, moved)
    postures = [solution.q]
    others = _branches(robot, goals, start, rest, tolerance)
    if others is None:
        others = _other_solutions(problem, start, moved, seed)
    for q in others:
        if len(postures) == MAX_POSTURES:
            break
        if all(np.abs(q - known).max() > SAME_POSTURE for known in postures):
            postures.append(q)
    rows = np.array(postures)
    order = np.argsort(np.linalg.norm(rows - start, axis=1), kind="stable")
    return GoalPostures(rows[order], solution, moved)


def _other_solutions(
    problem: Problem, start: Array, moved: NDArray[np.int64], seed: int
) -> list[Array]:
    """Return solutions from random starts. Joints that move no goal stay as at ``start`` (nq,)."""
    rng = np.random.default_rng(seed)
    solutions = []
    for _ in range(MAX_STARTS):
        problem.seed = int(rng.integers(1 << 31))  # otherwise all solves draw the same postures
        other_start = start.copy()
        other_start[moved] = problem.robot.sample(rng)[moved]
        solution = problem.solve(problem.robot.apply_couplings(other_start))
        if solution.converged:
            solutions.append(solution.q)
    return solutions


def _branches(
    robot: Robot,
    goals: Sequence[Goal],
    start: Array,
    rest: CollisionAvoidance,
    tolerance: Tolerance,
) -> list[Array] | None:
    """Return the free branches of a closed form; None if no closed form is known."""
    if len(goals) != 1:
        return None
    try:
        branches = solve_all(robot, goals[0], start=start)
    except UnsupportedGoalError:
        return None
    rows = np.array([branch.q for branch in branches if branch.angle <= tolerance.angle])
    rows = rows.reshape(-1, robot.nq)
    return list(rows[rest.free(rows)])
