"""Cones of balls as constraints of a variable metric (``metric.py``).

A ball whose turn is as large as its cone allows would leave it along the axis n of that turn, body axes:
``work.outward``.  Held there, it moves along the edge, and n moves with it: the metric is carried from one
edge point to the next by the shortest rotation between their axes, and slopes are compared without their
parts along n, which the edge takes up.  (The edge is curved: the parts along n, whose size does not go to
zero at the minimum, would spoil what the metric learns.)
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.tree import BALL
from robot_ik.kernels.work import SCALE

# A ball this near to the edge of its cone, rad, is on it; one with a smaller cone does not move at all.
AT_CONE = 1e-9


@pure
def is_cone(tree, goal, u):
    """Whether ``u`` is the first coordinate of a ball that has a cone."""
    v = goal.dofs[u]
    k = tree.dof_node[v]
    return tree.kind[k] == BALL and tree.vadr[k] == v and tree.upper[v] < math.pi


@pure
def edge_axis(tree, goal, q, u):
    """Axis of the ball's turn where that is as large as its cone allows, else zero."""
    v = goal.dofs[u]
    a = tree.qadr[tree.dof_node[v]]
    sine = math.sqrt(q[a + 1] ** 2 + q[a + 2] ** 2 + q[a + 3] ** 2)
    if not sine > 0.0 or 2.0 * math.atan2(sine, abs(q[a])) < tree.upper[v] - AT_CONE:
        return 0.0, 0.0, 0.0
    inverse = math.copysign(1.0, q[a]) / sine
    return inverse * q[a + 1], inverse * q[a + 2], inverse * q[a + 3]


@pure
def along(vector, u, x, y, z):
    """Part of the ball's three coordinates along an axis."""
    return x * vector[u] + y * vector[u + 1] + z * vector[u + 2]


@pure
def leaves_cone(work, vector, u):
    """Whether ``vector`` would take the ball out of the cone at whose edge it stands."""
    normal = work.outward
    return along(vector, u, normal[u], normal[u + 1], normal[u + 2]) > 0.0


@outlined
def hold_cone(work, u):
    """Makes the cone of the ball whose first coordinate is ``u`` active."""
    metric, normal, image = work.metric, work.outward, work.rhs
    n, square = metric.shape[0], 0.0
    x, y, z = normal[u], normal[u + 1], normal[u + 2]
    for i in range(n):
        image[i] = x * metric[i, u] + y * metric[i, u + 1] + z * metric[i, u + 2]
    square = along(image, u, x, y, z)
    inverse = 1.0 / square if square > 0.0 else 0.0
    for i in range(n):
        for j in range(n):
            metric[i, j] -= inverse * image[i] * image[j]
    work.side[u] = 1


@outlined
def release_cone(work, u):
    """Gives the direction of a cone back to the metric."""
    normal = work.outward
    for i in range(u, u + 3):
        for j in range(u, u + 3):
            work.metric[i, j] += work.value[SCALE] * normal[i] * normal[j]
    work.side[u] = 0


@outlined
def slope_left(tree, goal, work):
    """The slope at work.q along work.way, less what the edges of the held cones take up."""
    gradient, way = work.gradient, work.way
    left = 0.0
    for u in range(way.shape[0]):
        left += gradient[u] * way[u]
        if work.side[u] != 0 and is_cone(tree, goal, u):
            x, y, z = edge_axis(tree, goal, work.q, u)
            left -= along(gradient, u, x, y, z) * along(way, u, x, y, z)
    return left


@pure
def turned(x, y, z, vx, vy, vz, k):
    """w + v × w + k v × (v × w): Rodrigues' rotation with v = sine · axis, k = 1 / (1 + cosine)."""
    cx, cy, cz = vy * z - vz * y, vz * x - vx * z, vx * y - vy * x
    return (
        x + cx + k * (vy * cz - vz * cy),
        y + cy + k * (vz * cx - vx * cz),
        z + cz + k * (vx * cy - vy * cx),
    )


@outlined
def carry(tree, goal, work):
    """Takes metric, work.moved and work.before of the held cones from work.accepted along to work.q."""
    metric, normal, moved, before = work.metric, work.outward, work.moved, work.before
    n = metric.shape[0]
    for u in range(n):
        if work.side[u] == 0 or not is_cone(tree, goal, u):
            continue
        x, y, z = normal[u], normal[u + 1], normal[u + 2]
        px, py, pz = edge_axis(tree, goal, work.q, u)
        cosine = x * px + y * py + z * pz
        if cosine < 0.5:  # off the edge, or too far along it to be the same constraint
            release_cone(work, u)
            continue
        for vector in (moved, before):
            out = along(vector, u, x, y, z)
            vector[u] -= out * x
            vector[u + 1] -= out * y
            vector[u + 2] -= out * z
        vx, vy, vz, k = y * pz - z * py, z * px - x * pz, x * py - y * px, 1.0 / (1.0 + cosine)
        for vector in (moved, before):
            vector[u], vector[u + 1], vector[u + 2] = turned(
                vector[u], vector[u + 1], vector[u + 2], vx, vy, vz, k
            )
        for i in range(n):
            metric[u, i], metric[u + 1, i], metric[u + 2, i] = turned(
                metric[u, i], metric[u + 1, i], metric[u + 2, i], vx, vy, vz, k
            )
        for i in range(n):
            metric[i, u], metric[i, u + 1], metric[i, u + 2] = turned(
                metric[i, u], metric[i, u + 1], metric[i, u + 2], vx, vy, vz, k
            )
        normal[u], normal[u + 1], normal[u + 2] = px, py, pz
        # So that before − gradient is without its part along the axis here, too.
        out = along(work.gradient, u, px, py, pz)
        before[u] += out * px
        before[u + 1] += out * py
        before[u + 2] += out * pz
