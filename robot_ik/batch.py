"""Many poses at once: arrays in, arrays out, all cores, no Python for each pose."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import INTEGER, LARGEST, ROUNDING, Pose, numbers, off_rotation, rotation_entries
from robot_ik.goals import PoseGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import ORIGIN, borrowed_problem
from robot_ik.problem import Budget, require_options
from robot_ik.robot import Robot
from robot_ik.solution import Status
from robot_ik.solvers.base import BatchResult, Solver

Array = NDArray[np.float64]

# So many matrices are checked one by one.
_FEW = 8
# Below this many poses for each thread, starting threads costs more than it gains.
_LEAST_PER_THREAD = 256


@dataclass(frozen=True, eq=False)
class BatchSolution(BatchResult):
    """Results for many poses; row i belongs to pose i.

    Attributes:
        q: (n, nq) best found, inside the limits.
        status: (n,) numbers of ``Status``.
        miss: (n, 2) metres and radians, by the compiled forward pass (which the tests hold to MuJoCo's);
            0 for a part that was not asked for.
        iterations, restarts: (n,) steps of all tries of each pose; random restarts used.
        seconds: Wall-clock time of all.
        solver: Name of the method.
    """

    seconds: float
    solver: str

    @property
    def position_miss(self) -> Array:
        """(n,) metres."""
        return self.miss[:, 0]

    @property
    def angle_miss(self) -> Array:
        """(n,) radians."""
        return self.miss[:, 1]

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(n,) whether each goal is within tolerance."""
        return np.asarray(self.status == Status.CONVERGED)

    def __len__(self) -> int:
        return len(self.status)

    def __repr__(self) -> str:
        numbers, counts = np.unique(self.status, return_counts=True)
        ends = ", ".join(f"{n} {Status(k).name}" for k, n in zip(numbers, counts, strict=True))
        return f"BatchSolution({len(self)} poses: {ends or 'none'}; {self.solver!r}, {self.seconds:.2g} s)"


def usable_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def target_rows(poses: ArrayLike | Pose | Sequence[Pose]) -> tuple[Array, bool]:
    """Targets as pose rows (n, 12), and whether their orientation counts; raises as ``solve_batch``."""
    several: Any = [poses] if isinstance(poses, Pose) else poses
    if isinstance(several, Sequence) and several and all(isinstance(pose, Pose) for pose in several):
        return np.array([pose.row for pose in several]), True
    array = numbers(several, "poses")
    if not (array.size == 0 or np.abs(array).max() <= LARGEST):  # NaN too
        bad = int((~(np.abs(array) <= LARGEST)).sum())
        raise InvalidGoalError(f"{bad} numbers of the poses are not finite and below {LARGEST:g}")
    rows = np.zeros((array.shape[0] if array.ndim else 0, 12))
    shape = array.shape[1:]
    if shape == (3,):
        rows[:, :3] = array
        rows[:, [3, 7, 11]] = 1.0
        return rows, False
    if shape == (4, 4):
        rows[:, :3] = array[:, :3, 3]
        rows[:, 3:] = array[:, :3, :3].reshape(-1, 9)
        _require_rotations(rows)
        return rows, True
    if shape == (7,):
        rows[:, :3] = array[:, :3]
        norm = np.linalg.norm(array[:, 3:], axis=1)
        if (norm < 1e-9).any():
            raise InvalidGoalError(
                f"pose {int(np.argmin(norm))} has a zero quaternion, which is no orientation"
            )
        rows[:, 3:] = np.stack(rotation_entries(*(array[:, 3:] / norm[:, None]).T), axis=1)
        return rows, True
    raise InvalidGoalError(
        f"poses have shape {array.shape}",
        hint="give poses, (n, 4, 4) matrices, (n, 7) position and wxyz, or (n, 3) positions",
    )


def _require_rotations(rows: Array) -> None:
    """Raises ``InvalidGoalError`` unless all matrices in pose rows (n, 12) are rotation matrices."""
    rotations = rows[:, 3:]
    if len(rows) <= _FEW:  # Python's own numbers are quicker for so few
        off: Any = [off_rotation(*row) for row in rotations.tolist()]
    else:  # row by row; one copy, then quick sums
        off = off_rotation(*np.ascontiguousarray(rotations.T))
    if len(off) and np.max(off) > ROUNDING:
        raise InvalidGoalError(
            f"the matrix of pose {int(np.argmax(off))} is not a rotation: it scales or mirrors"
        )


def solve_batch(
    robot: Robot,
    poses: ArrayLike | Pose | Sequence[Pose],
    *,
    frame: str | None = None,
    starts: ArrayLike | None = None,
    solver: str | Solver = "auto",
    tolerance: Tolerance | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> BatchSolution:
    """Solves each pose on its own, the same results as ``solve`` one by one.

    Args:
        robot: From ``load_robot``.
        poses: ``Pose`` objects, (n, 4, 4) homogeneous matrices, (n, 7) position and quaternion wxyz, or
            (n, 3) positions whose orientation is free.
        frame: What shall get there; default the tool.
        starts: (nq,) for all or (n, nq); default ``robot.home``.
        solver: Name or instance; ``auto`` and ``lm`` run compiled from end to end.
        tolerance: As in ``solve``.
        budget: For each pose.
        seed: Of the restarts, the same for each pose.
        threads: Default: one for each core this process may use.

    Raises:
        InvalidGoalError: Wrong shape, a pose or start that is not finite, a matrix that is no rotation, or
            no thread at all.
        UnsupportedGoalError: As in ``solve``.
    """
    require_options(robot, tolerance, budget, seed)
    wanted: object = 1 if threads is None else threads
    if not (isinstance(wanted, INTEGER) and wanted >= 1):
        raise InvalidGoalError(f"threads must be a whole number, 1 or more, not {threads!r}")
    targets, with_angle = target_rows(poses)
    begin = np.empty((len(targets), robot.nq))
    given = robot.home if starts is None else numbers(starts, "starts")
    if given.shape not in ((robot.nq,), begin.shape) or not np.isfinite(given).all():
        hint = f"give finite ({robot.nq},) for all or {begin.shape}"
        raise InvalidGoalError(f"starts have shape {given.shape}", hint=hint)
    begin[...] = given
    goal = PoseGoal(frame, ORIGIN) if with_angle else PositionGoal(frame, ORIGIN)
    results = BatchResult.empty(len(targets), robot.nq)
    most = len(targets) // _LEAST_PER_THREAD
    count = min(threads or usable_cores(), most) if most > 1 else 1

    def solve_part(targets: Array, starts: Array, results: BatchResult) -> str:
        borrowed = borrowed_problem(robot, goal, solver, {}, tolerance, budget, seed)
        with borrowed as (method, problem), problem.in_use():
            method.attempt_many(problem, targets, starts, results, problem.budget)
        return method.name

    began = time.perf_counter()
    if count == 1:
        name = solve_part(targets, begin, results)
    else:
        edges = [len(targets) * k // count for k in range(count + 1)]
        shares = list(itertools.starmap(slice, itertools.pairwise(edges)))
        with ThreadPoolExecutor(count) as pool:
            name, *_ = pool.map(lambda s: solve_part(targets[s], begin[s], results.part(s)), shares)
    return BatchSolution(**vars(results), seconds=time.perf_counter() - began, solver=name)
