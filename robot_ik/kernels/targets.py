"""Moving a target in compiled code: the hot loop does it before every solve."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import kernel

MOVE = Layout(
    "Move",
    matrix="table",  # (4, 4) homogeneous, the wanted pose
    target="table",  # (g, 12) rows of all goals
)
open_move = MOVE.open


@kernel
def take_matrix(move, index):
    """target[index] = matrix; False, and nothing is done, when a number is not finite."""
    move = open_move(move)
    matrix, target = move.matrix, move.target
    size = 0.0
    for i in range(4):
        for j in range(4):
            x = matrix[i, j]
            size = max(size, abs(x)) if x == x else math.inf
    if not size < math.inf:
        return False
    for i in range(3):
        target[index, i] = matrix[i, 3]
        for j in range(3):
            target[index, 3 + 3 * i + j] = matrix[i, j]
    return True
