"""Moving a target in compiled code: a loop does it before every solve."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import entry, kernel

MOVE = Layout(
    "Move",
    matrix="table",  # (4, 4) homogeneous, the wanted pose
    target="table",  # (g, 12) rows of all goals
)
open_move = MOVE.open


@kernel
def take_matrix(move, index):
    """target[index] = matrix; False, and nothing is done, when a number is not finite.

    With ~index in place of index the position alone is taken, and asked about.
    """
    move = open_move(move)
    matrix, target = move.matrix, move.target
    first = 0 if index >= 0 else 3
    row = index if index >= 0 else ~index
    size = 0.0
    for i in range(4 if index >= 0 else 3):
        for j in range(first, 4):
            x = matrix[i, j]
            size = max(size, abs(x)) if x == x else math.inf
    if not size < math.inf:
        return False
    for i in range(3):
        target[row, i] = matrix[i, 3]
        for j in range(first, 3):
            target[row, 3 + 3 * i + j] = matrix[i, j]
    return True


class Mover:
    """Takes matrices and positions as targets: fill the array of their shape, then take them.

        array, flip = mover.buffers[shape]
        array[...] = target
        mover.take(mover.move, index ^ flip)      # False when it is not finite; nothing is done then

    Attributes:
        buffers: For (4, 4) and (3,): the array to fill, and the mask that gives the index of ``take_matrix``.
        dtype: What a target must be of to need no conversion that may fail.
        take, move: The compiled code, and what it takes before the goal's index.
    """

    __slots__ = ("_table", "buffers", "dtype", "move", "take")

    def __init__(self, target: NDArray[np.float64]) -> None:
        matrix = np.zeros((4, 4))
        self.buffers: dict[Any, tuple[Any, int]] = {(4, 4): (matrix, 0), (3,): (matrix[:3, 3], -1)}
        self.dtype = matrix.dtype
        self._table = MOVE.pack({"matrix": matrix, "target": target})
        self.move: int = self._table.ctypes.data
        self.take: Any = entry(take_matrix, self.move, 0)
