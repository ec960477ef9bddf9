"""``solve_all``: every solution (branch) of a goal, for arms with a closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.collision.avoidance import CollisionAvoidance, require_same_robot
from robot_ik.errors import UnsupportedGoalError
from robot_ik.geometry import Array, Pose
from robot_ik.goals import Goal
from robot_ik.model import qpos_addresses
from robot_ik.problem import Problem
from robot_ik.robot import Robot, require_robot
from robot_ik.solvers.analytic import SUPPORTED
from robot_ik.solvers.analytic.branch import Branch, listed_branches


def solve_all(
    robot: Robot,
    goal: Goal | Pose | ArrayLike,
    *,
    start: ArrayLike | None = None,
    limits: bool = True,
    collisions: CollisionAvoidance | None = None,
    fixed: Mapping[str, float] | None = None,
) -> tuple[Branch, ...]:
    """Return every branch with which the closed form meets a goal, nearest to ``start`` first.

    It supports arms of two parallel hinges for a position, arms of five hinges (pan, three parallel
    pitch axes, roll) for a pose, and arms of six hinges with a spherical wrist or shoulder, with
    three parallel axes, or with a spherical shoulder and two last axes that meet, for a pose. At a
    singular pose one joint angle is free; it stays as near to ``start`` as possible.

    An arm of seven hinges, such as the Panda, becomes an arm of six hinges with ``fixed``:
    ``solve_all(robot, pose, fixed={"panda_joint7": 0.8})``.

    An arm of five joints meets a position in infinitely many ways and a pose almost never. Each of
    its up to four branches has the best orientation at the position, and the smallest angle comes
    first.

    Args:
        robot: From ``load_robot``.
        goal: A pose goal, or a position goal for a planar arm. A ``Pose``, a matrix (4, 4) or a
            position (3,) is a goal of the tool.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.
        collisions: Measure the clearance of each branch. Free branches come first; the others are
            kept, with the pair of parts that touches in ``branch.clearance``.
        fixed: Joint name -> position of joints that must not move, rad or m. Each ``branch.q`` has
            these positions.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
        UnknownJointError, ModelError: As ``Robot.with_fixed``.
    """
    require_robot(robot)
    if collisions is not None:
        require_same_robot(robot, collisions)
    origin = robot.home if start is None else robot.check_q(start, "start")
    if fixed:
        return _with_fixed_joints(robot, goal, origin, fixed, limits, collisions)
    try:
        problem = Problem(robot, goal, solver="analytic")
    except UnsupportedGoalError as error:
        error.able = ()
        error.hint = f"solve_all supports {SUPPORTED}; solve(…) finds one solution for any arm"
        raise
    branches = listed_branches(robot, problem.branches(origin), origin, limits=limits)
    return branches if collisions is None else _measured(branches, collisions)


def _with_fixed_joints(
    robot: Robot,
    goal: Goal | Pose | ArrayLike,
    origin: Array,
    fixed: Mapping[str, float],
    limits: bool,
    collisions: CollisionAvoidance | None,
) -> tuple[Branch, ...]:
    """Return the branches of a robot with fixed joints. Each ``branch.q`` has all joints."""
    moving = robot.with_fixed(fixed)
    addresses = qpos_addresses(robot.model, robot.tree)
    moves = np.isin(addresses, qpos_addresses(moving.model, moving.tree))
    branches = []
    for branch in solve_all(moving, goal, start=origin[moves], limits=limits):
        q = moving.frozen_qpos[addresses]
        q[moves] = branch.q
        branches.append(replace(branch, q=q))
    return tuple(branches) if collisions is None else _measured(branches, collisions)


def _measured(branches: Sequence[Branch], collisions: CollisionAvoidance) -> tuple[Branch, ...]:
    """Return branches with their clearances, those inside the limits and free first."""
    measured = []
    for branch in branches:
        clearance = collisions.clearance(branch.q)
        free = clearance.distance >= collisions.margin
        measured.append(replace(branch, clearance=clearance, free=free))
    return tuple(sorted(measured, key=lambda branch: (not branch.inside, not branch.free)))
