"""Random starts, the same for the same seed."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import turn_quat
from robot_ik.kernels.tree import BALL, FREE
from robot_ik.kernels.work import SEED


@pure
def uniform(state):
    """Next number in [0, 1): xorshift64* (Vigna 2016), so that a seed gives the same bits everywhere."""
    x = types.uint64(state[SEED])
    x ^= x >> types.uint64(12)
    x ^= x << types.uint64(25)
    x ^= x >> types.uint64(27)
    state[SEED] = types.int64(x)
    return types.float64((x * types.uint64(2685821657736338717)) >> types.uint64(11)) * (
        1.0 / 9007199254740992.0
    )


@outlined
def draw(tree, nodes, start, state, q):
    """A random start for the joints that matter, inside their limits, into q; floats roam round ``start``."""
    kind, qadr, vadr, low, high = tree.kind, tree.qadr, tree.vadr, tree.low, tree.high
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a, v = qadr[k], vadr[k]
        joint = kind[k]
        if joint < BALL:
            q[a] = low[v] + (high[v] - low[v]) * uniform(state)
            continue
        if joint == FREE:
            for i in range(3):
                spread = low[v + i] + (high[v + i] - low[v + i]) * uniform(state)
                q[a + i] = start[a + i] + spread
            a, v = a + 3, v + 3
        q[a], q[a + 1], q[a + 2], q[a + 3] = 1.0, 0.0, 0.0, 0.0
        # A direction on the sphere and an angle in the cone.
        z = 2.0 * uniform(state) - 1.0
        around = 2.0 * math.pi * uniform(state)
        angle = min(high[v], math.pi) * uniform(state)
        r = angle * math.sqrt(max(0.0, 1.0 - z * z))
        turn_quat(q, a, r * math.cos(around), r * math.sin(around), angle * z)
