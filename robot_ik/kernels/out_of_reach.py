"""Goals that are proven out of reach beside others that are not.

A goal for a place farther away than all links laid end to end cannot be met from any start.  The goals
beside it can: they are searched for without it, and all goals share the last descent, so that a goal of
vanishing weight costs the others nothing.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.partial_rows import ONE_SIDE, PLACE
from robot_ik.kernels.residuals import PARTIAL
from robot_ik.kernels.work import BEYOND, MAX_RESTARTS, RESTARTS, SEARCH, SEARCHING


@pure
def squared_way(goal, reach, g):
    """Squared metres from the centre of the ball that goal ``g`` cannot leave to the place it asks for."""
    target, square = goal.target, 0.0
    x, y, z = target[g, 0] - reach[g, 0], target[g, 1] - reach[g, 1], target[g, 2] - reach[g, 2]
    if goal.kind[g] != PARTIAL:
        return x * x + y * y + z * z
    for i in range(3):
        off = goal.mask[g, i] * (target[g, 3 + i] * x + target[g, 6 + i] * y + target[g, 9 + i] * z)
        if goal.how[g, PLACE] == ONE_SIDE:
            off = max(off, 0.0)
        square += off * off
    return square


@outlined
def mark_beyond(goal, work):
    """Marks in work.beyond the goals that are proven out of reach; returns whether there are any."""
    any_beyond = False
    ask_for_all(goal)
    for g in range(goal.kind.shape[0]):
        far = work.reach[g, 3] < math.inf
        far = far and squared_way(goal, work.reach, g) > work.reach[g, 3] * work.reach[g, 3]
        work.beyond[g] = 1 if far else 0
        any_beyond = any_beyond or far
    return any_beyond


@pure
def ask_for_all(goal):
    """All goals count as they were asked for."""
    for g in range(goal.kind.shape[0]):
        for i in range(2):
            goal.weight[g, i] = goal.asked[g, i]
            goal.tolerance[g, i] = goal.asked[g, 2 + i]


@outlined
def drop_beyond(goal, work):
    """Goals that are proven out of reach count nothing until ``ask_for_all``."""
    for g in range(goal.kind.shape[0]):
        for i in range(2):
            if work.beyond[g] == 1:
                goal.weight[g, i], goal.tolerance[g, i] = 0.0, math.inf


@outlined
def some_within_reach(goal, work):
    """Whether the first level needs something that is not proven out of reach."""
    found = False
    for g in range(goal.kind.shape[0]):
        needed = min(goal.asked[g, 2], goal.asked[g, 3]) < math.inf
        found = found or (needed and goal.level[g] == 0 and work.beyond[g] == 0)
    return found


@pure
def may_restart(state):
    """Whether another random start may help: not towards what is proven out of reach."""
    return state[RESTARTS] < state[MAX_RESTARTS] and (state[BEYOND] == 0 or state[SEARCH] == SEARCHING)
