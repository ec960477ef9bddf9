"""Vectors of three numbers, as tuples: what compiled geometry is written with.

A tuple of numbers costs nothing in compiled code: each number has a register of its own.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import pure


@pure
def dot(a, b):
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@pure
def cross(a, b):
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@pure
def plus(a, b):
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@pure
def minus(a, b):
    """a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@pure
def scaled(s, a):
    """s · a."""
    return s * a[0], s * a[1], s * a[2]


@pure
def over(a, s):
    """a / s."""
    return a[0] / s, a[1] / s, a[2] / s


@pure
def length(a):
    """|a|."""
    return math.sqrt(dot(a, a))


@pure
def rotate(k, c, s, a):
    """``a`` rotated about the unit axis ``k`` by the angle with cosine ``c`` and sine ``s`` (Rodrigues)."""
    x, y, z = cross(k, a)
    d = dot(k, a) * (1.0 - c)
    return c * a[0] + s * x + d * k[0], c * a[1] + s * y + d * k[1], c * a[2] + s * z + d * k[2]


@pure
def three(table, r, c):
    """Three numbers of row ``r`` of a table, from column ``c`` on."""
    return table[r, c], table[r, c + 1], table[r, c + 2]


@pure
def put(table, r, a):
    """``a`` in place of the first three numbers of row ``r``."""
    table[r, 0], table[r, 1], table[r, 2] = a


@pure
def apply(table, r, c, a):
    """The matrix (3, 3), row by row from column ``c`` of row ``r``, times ``a``."""
    return dot(three(table, r, c), a), dot(three(table, r, c + 3), a), dot(three(table, r, c + 6), a)


@pure
def apply_back(table, r, c, a):
    """The transpose of that matrix times ``a``."""
    return (
        table[r, c] * a[0] + table[r, c + 3] * a[1] + table[r, c + 6] * a[2],
        table[r, c + 1] * a[0] + table[r, c + 4] * a[1] + table[r, c + 7] * a[2],
        table[r, c + 2] * a[0] + table[r, c + 5] * a[1] + table[r, c + 8] * a[2],
    )


@pure
def from_frame(axes, r, a):
    """Where ``a`` points that is measured along the three axes in rows ``r`` to ``r + 2``."""
    return (
        axes[r, 0] * a[0] + axes[r + 1, 0] * a[1] + axes[r + 2, 0] * a[2],
        axes[r, 1] * a[0] + axes[r + 1, 1] * a[1] + axes[r + 2, 1] * a[2],
        axes[r, 2] * a[0] + axes[r + 1, 2] * a[1] + axes[r + 2, 2] * a[2],
    )


@pure
def into_frame(axes, r, a):
    """The inverse of ``from_frame``."""
    return dot(three(axes, r, 0), a), dot(three(axes, r + 1, 0), a), dot(three(axes, r + 2, 0), a)
