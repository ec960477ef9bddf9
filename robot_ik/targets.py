"""New targets for the goals of a ``Problem``: all that its ``retarget`` takes."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import entry, kernel
from robot_ik.kernels.residuals import OF_FRAME, OF_JOINTS, OF_MASS

if TYPE_CHECKING:
    from robot_ik.problem import Problem

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
    """Takes targets: matrices and positions in compiled code, since a loop does it before every solve.

        array, flip = mover.buffers[shape]
        array[...] = target
        mover.take(mover.address, index ^ flip)      # False when it is not finite; nothing is done then

    Attributes:
        buffers: For (4, 4) and (3,): the array to fill, and the mask that gives the index of ``take_matrix``.
        dtype: What a target must be of to need no conversion that may fail.
        take, address: The compiled code, and what it takes before the goal's index.
    """

    __slots__ = ("_table", "address", "buffers", "dtype", "take")

    def __init__(self, target: NDArray[np.float64]) -> None:
        matrix = np.zeros((4, 4))
        self.buffers: dict[Any, tuple[Any, int]] = {(4, 4): (matrix, 0), (3,): (matrix[:3, 3], -1)}
        self.dtype = matrix.dtype
        self._table = MOVE.pack({"matrix": matrix, "target": target})
        self.address: int = self._table.ctypes.data
        self.take: Any = entry(take_matrix, self.address, 0)

    def move(self, problem: Problem, target: Any, index: int) -> None:
        """All other targets, and what is wrong with them; raises as ``Problem.retarget``."""
        if isinstance(target, Mapping):
            _move_several(problem, target)
        else:
            _move(problem, target, index)

    @staticmethod
    def require_index(problem: Problem, index: object) -> int:
        """``index``; raises ``InvalidGoalError`` unless the problem has such a goal."""
        if isinstance(index, bool) or not isinstance(index, int | np.integer):
            raise InvalidGoalError(f"a goal is named by its frame or its index, not by {index!r}")
        count = len(problem.given)
        if not 0 <= index < count:
            raise InvalidGoalError(f"there is no goal {index}: this problem has 0 … {count - 1}")
        return int(index)


def _move(problem: Problem, target: Any, index: int) -> None:
    goal: Any = problem.given[index]
    if isinstance(target, Goal):
        problem.replace_goal(index, _require_same(problem, target, index))
    elif goal.rows.of == OF_JOINTS:
        problem.replace_goal(index, replace(goal, q=target))
    elif problem.whole[index]:
        _move_whole(goal, problem.target[index], target)
    else:  # a goal for a part of a pose is replaced
        problem.replace_goal(index, goal.moved_to(_pose_for(goal, target)))


def _move_several(problem: Problem, targets: Mapping[str | int, Any]) -> None:
    """All of ``targets`` or, if one of them is refused, none."""
    moves = [(_index_of(problem, key), target) for key, target in targets.items()]
    if len({index for index, _ in moves}) < len(moves):
        raise InvalidGoalError(f"two of the keys {list(targets)!r} mean the same goal")
    given, arrays = problem.given, problem.goal_arrays
    before = {name: arrays[name].copy() for name in ("target", "posture", "joint_weight")}
    try:
        for index, target in moves:
            _move(problem, target, index)
    except InvalidGoalError:
        problem.given = given
        for name, array in before.items():
            arrays[name][...] = array
        raise


def _index_of(problem: Problem, key: object) -> int:
    """The goal that a key of ``retarget`` means."""
    if not isinstance(key, str):
        return Mover.require_index(problem, key)
    own: dict[int, str | None] = {OF_FRAME: problem.robot.tool, OF_MASS: None}
    frames = [goal.frame or own.get(goal.rows.of) for goal in problem.given]
    found = [g for g, frame in enumerate(frames) if frame == key]
    if len(found) != 1:
        raise InvalidGoalError(
            f"{len(found) or 'no'} goals of this problem have the frame {key!r}",
            hint=f"its goals' frames: {', '.join(map(repr, frames))}; or give the goal's index",
        )
    return found[0]


def _matrix_or_position(target: Any) -> NDArray[np.float64]:
    try:
        given = np.asarray(target, dtype=float)
    except (TypeError, ValueError, OverflowError):
        given = np.empty(0)
    if given.shape not in ((4, 4), (3,)) or not np.isfinite(given).all():
        raise InvalidGoalError(
            f"a target is a Pose, a finite matrix (4, 4) or a finite position (3,), not {target!r}"
        )
    return given


def _move_whole(goal: Goal, row: NDArray[np.float64], target: Any) -> None:
    """Moves the target row (12,) of a whole position, orientation or pose."""
    if isinstance(target, Pose):
        row[:] = target.row
        return
    given = _matrix_or_position(target)
    if given.shape == (4, 4):
        row[:3], row[3:] = given[:3, 3], given[:3, :3].ravel()
    elif goal.has_position:
        row[:3] = given
    else:
        raise InvalidGoalError(f"{goal.with_article} has no position to move")


def _pose_for(goal: Goal, target: Any) -> Pose:
    """A target as a pose; one that is a position leaves the orientation as it is."""
    if isinstance(target, Pose):
        return target
    given = _matrix_or_position(target)
    rotation, position = (given[:3, :3], given[:3, 3]) if given.ndim == 2 else (goal.target.rotation, given)
    if not (np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-5 and np.linalg.det(rotation) > 0.0):
        raise InvalidGoalError("a target has a matrix that is not a rotation: it scales or mirrors")
    return Pose.from_rotation(rotation, position)


def _require_same(problem: Problem, target: Goal, index: int) -> Goal:
    """``target``; raises ``InvalidGoalError`` unless it differs from the goal in its target only."""
    mine, tool = problem.given[index], problem.robot.tool
    if target.signature != mine.signature or (target.frame or tool) != (mine.frame or tool):
        raise InvalidGoalError(
            f"this problem was built for a {mine.name} of {mine.frame or tool!r}, "
            f"not for a {target.name} of {target.frame or tool!r} or for other weights",
            hint="another kind of goal, frame or weight needs a new Problem",
        )
    return target
