"""The arrays that a closed form works on, and what all of them share: the look at the start, the answer."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import outlined
from robot_ik.kernels.kinematics import clip
from robot_ik.kernels.loop import copy, keep_best, measure
from robot_ik.kernels.work import BEST_COST, BLOCKED, CONVERGED, COST, ITERATIONS, STALLED, STATUS

# n numbers of q belong to the chain: one for a hinge, four for a ball.
FORM = Layout(
    "Form",
    place="ints",  # (n,) where they stand in q
    axes="table",  # (joints, 6)
    extra="table",  # (5, 3)
    lower="floats",  # (n,) limits; of a ball joint the cone angle stands in ``upper`` of its first number
    upper="floats",  # (n,)
    start="floats",  # (n,)
    best="floats",  # (n,)
    branches="table",  # (8, n)
    target="table",  # (1, 12) the goal in the world
    inverse="table",  # (1, 12) its inverse, for arms that are solved from the tool
    # Of limbs only:
    groups="int_table",  # (2, 2) how shoulder and wrist are joined, column of their first number
    turns="table",  # (2, 3) ``edges.middle_turns``
    edges="table",  # (m, 8) ``edges.limit_edges``
    least="floats",  # (n,) -inf: no limits at all
    most="floats",  # (n,) inf
    matrices="table",  # (7, 9) rotations in use
    parts="table",  # (2, 27) rotations of shoulder and wrist by swivel angle: constant, cosine's, sine's
    cuts="floats",  # (64,) swivel angles at which something changes
    tally="table",  # (4, 4) best of each combination of flips: squared distance, angle, cell's ends
    trial="table",  # (2, n) angles by flip
    scores="floats",  # (6,) squared distances: shoulder's two flips, wrist's two; their slope and speed
    spin="table",  # (2, 3) by the swivel angle: angular velocity of shoulder and wrist
    speeds="floats",  # (2,) of ball joints: growth of their turn
)
open_form = FORM.open

# What a run is for: the answer; every branch, even for a start at the goal; only a look at the start.
SOLVE, EVERY, LOOK = range(3)


@outlined
def look(tree, goal, work, form, mode):
    """Measures the start, which is the answer if it is at the goal; whether there is more to do."""
    state, q = work.state, work.q
    state[ITERATIONS] = 0
    copy(work.start, q)
    clip(tree, work.nodes, q)
    within = measure(tree, goal, work)
    keep_best(work)
    state[STATUS] = CONVERGED if within else STALLED
    if mode == LOOK or (within and mode == SOLVE):
        return False
    place, start = form.place, form.start
    for j in range(place.shape[0]):
        start[j] = q[place[j]]
    state[ITERATIONS] = 1
    return True


@outlined
def settle(tree, goal, work, form, row, found):
    """Takes ``form.best`` for the answer, where some branch ``row`` is inside the limits."""
    state, q, place, best = work.state, work.q, form.place, form.best
    if row < 0:
        state[STATUS] = BLOCKED if found > 0 else STALLED
        return
    for j in range(place.shape[0]):
        q[place[j]] = best[j]
    clip(tree, work.nodes, q)
    state[STATUS] = CONVERGED if measure(tree, goal, work) else STALLED
    if state[STATUS] == CONVERGED or work.value[COST] < work.value[BEST_COST]:
        keep_best(work)
    else:
        copy(work.best, q)
        measure(tree, goal, work)  # so that the miss is the answer's


@outlined
def invert(target, inverse):
    """The inverse of the pose row target[0] into inverse[0]."""
    for i in range(3):
        inverse[0, i] = -(
            target[0, 3 + i] * target[0, 0]
            + target[0, 6 + i] * target[0, 1]
            + target[0, 9 + i] * target[0, 2]
        )
        for j in range(3):
            inverse[0, 3 + 3 * i + j] = target[0, 3 + 3 * j + i]
