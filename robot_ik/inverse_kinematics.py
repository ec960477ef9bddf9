"""The front door: ``solve``, ``solve_all``, ``solve_batch``, and the problems that they keep."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.goals import LARGEST, Goal, PoseGoal, PositionGoal, Tolerance, numbers
from robot_ik.model import pose_row
from robot_ik.problem import Budget, Problem, checked_goals, goal_kind, require_options
from robot_ik.robot import Robot
from robot_ik.solution import Solution, Status, short_numbers
from robot_ik.solvers import make_solver
from robot_ik.solvers.base import BatchResult, Solver

# ------------------------------------------------------------------------------------------
# Many poses at once: arrays in, arrays out, all cores, no Python for each pose (``solve_batch``).


Array = NDArray[np.float64]

# How far a matrix may be from a rotation: what six written digits leave.
_ROUNDING = 1e-5
# So many matrices are checked one by one.
_FEW = 8
# Below this many poses for each thread, starting threads costs more than it gains.
_LEAST_PER_THREAD = 256


@dataclass(frozen=True, eq=False)
class BatchSolution:
    """Answers to many poses; row i belongs to pose i.

    Attributes:
        q: (n, nq) best found, inside the limits.
        status: (n,) numbers of ``Status``.
        position_miss, angle_miss: (n,) metres and radians, by the compiled forward pass (which the tests
            hold to MuJoCo's); 0 for a part that was not asked for.
        iterations, restarts: (n,) steps of all tries of each pose; random restarts used.
        seconds: Wall-clock time of all.
        solver: Name of the method.
    """

    q: Array
    status: NDArray[np.int64]
    position_miss: Array
    angle_miss: Array
    iterations: NDArray[np.int64]
    restarts: NDArray[np.int64]
    seconds: float
    solver: str

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


def run_batch(
    parts: Callable[[], AbstractContextManager[tuple[Solver, Problem]]],
    targets: Array,
    starts: Array,
    threads: int | None,
) -> BatchSolution:
    """Solves each row of ``targets`` (n, 12) from its row of ``starts`` (n, nq), on so many threads.

    Args:
        parts: Lends a method and a problem of one goal to each thread.
        targets: Pose rows (n, 12).
        starts: (n, nq).
        threads: None = one for each core this process may use.

    Raises:
        InvalidGoalError: No thread at all.
    """
    if threads is not None and threads < 1:
        raise InvalidGoalError(f"threads must be 1 or more, not {threads}")
    answers = BatchResult.empty(len(targets), starts.shape[1])
    most = len(targets) // _LEAST_PER_THREAD
    count = min(threads or usable_cores(), most) if most > 1 else 1

    def part(targets: Array, starts: Array, answers: BatchResult) -> str:
        with parts() as (method, problem):
            method.solve_many(problem, targets, starts, answers)
        return method.name

    began = time.perf_counter()
    if count == 1:
        name = part(targets, starts, answers)
    else:
        edges = [len(targets) * k // count for k in range(count + 1)]
        shares = [slice(first, last) for first, last in itertools.pairwise(edges)]
        with ThreadPoolExecutor(count) as pool:
            done = [pool.submit(part, targets[s], starts[s], answers.part(s)) for s in shares]
            name, *_ = [one.result() for one in done]
    miss, seconds = answers.miss, time.perf_counter() - began
    return BatchSolution(
        answers.q, answers.status, miss[:, 0], miss[:, 1], answers.iterations, answers.restarts, seconds, name
    )


def usable_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def target_rows(poses: ArrayLike | Pose | Sequence[Pose]) -> tuple[Array, bool]:
    """Targets as pose rows (n, 12), and whether their orientation counts.

    Raises:
        InvalidGoalError: Wrong shape, a number that is not finite, a zero quaternion, a matrix that is no
            rotation.
    """
    several: Any = [poses] if isinstance(poses, Pose) else poses
    if isinstance(several, Sequence) and several and all(isinstance(pose, Pose) for pose in several):
        return np.array([pose_row(pose) for pose in several]), True
    array = numbers(several, "poses")
    if not (array.size == 0 or np.abs(array).max() <= LARGEST):  # NaN too
        bad = int((~(np.abs(array) <= LARGEST)).sum())
        raise InvalidGoalError(f"{bad} numbers of the poses are not finite and below {LARGEST:g}")
    rows = np.zeros((array.shape[0] if array.ndim else 0, 12))
    if array.ndim == 2 and array.shape[1] == 3:
        rows[:, :3] = array
        rows[:, [3, 7, 11]] = 1.0
        return rows, False
    if array.ndim == 3 and array.shape[1:] == (4, 4):
        rows[:, :3] = array[:, :3, 3]
        rows[:, 3:] = array[:, :3, :3].reshape(-1, 9)
        _require_rotations(rows)
        return rows, True
    if array.ndim == 2 and array.shape[1] == 7:
        rows[:, :3] = array[:, :3]
        norm = np.linalg.norm(array[:, 3:], axis=1)
        if (norm < 1e-9).any():
            raise InvalidGoalError(
                f"pose {int(np.argmin(norm))} has a zero quaternion, which is no orientation"
            )
        w, x, y, z = (array[:, 3:] / norm[:, None]).T
        rows[:, 3:] = np.stack(
            [
                1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
            ],
            axis=1,
        )  # fmt: skip
        return rows, True
    raise InvalidGoalError(
        f"poses have shape {array.shape}",
        hint="give poses, (n, 4, 4) matrices, (n, 7) position and wxyz, or (n, 3) positions",
    )


def _require_rotations(rows: Array) -> None:
    """Raises ``InvalidGoalError`` unless all matrices in pose rows (n, 12) turn and do nothing else."""
    turns = rows[:, 3:]
    if len(rows) <= _FEW:  # Python's own numbers are quicker for so few
        off: Any = [_from_rotation(*row) for row in turns.tolist()]
    else:  # row by row; one copy, then quick sums
        off = _from_rotation(*np.ascontiguousarray(turns.T))
    if len(off) and np.max(off) > _ROUNDING:
        raise InvalidGoalError(
            f"the matrix of pose {int(np.argmax(off))} does not turn: it scales or mirrors"
        )


def _from_rotation(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any, i: Any) -> Any:
    """How far a matrix, row by row, is from unit columns of which the third is the others' cross product."""
    off = abs(a * a + d * d + g * g - 1.0) + abs(b * b + e * e + h * h - 1.0)
    return off + abs(d * h - g * e - c) + abs(g * b - a * h - f) + abs(a * e - d * b - i)


def start_rows(robot: Robot, starts: ArrayLike | None, count: int) -> Array:
    """Starts (n, nq); one start (nq,), or home, counts for all.

    Raises:
        InvalidGoalError: Wrong shape, or not finite.
    """
    array = robot.home if starts is None else numbers(starts, "starts")
    if array.shape not in ((robot.nq,), (count, robot.nq)) or not np.isfinite(array).all():
        raise InvalidGoalError(
            f"starts have shape {array.shape}",
            hint=f"give finite ({robot.nq},) for all or ({count}, {robot.nq})",
        )
    rows = np.empty((count, robot.nq))
    rows[...] = array
    return rows


# Branches nearer than this in every joint (rad) are one.
_SAME = 1e-6
# rad, m: so far beyond a limit a joint still counts as inside.
_SLACK = 1e-9
# Kinds of problems that are kept for a robot, and problems of a kind: one for each thread that asks at once.
_KINDS_KEPT, _EACH_KEPT = 16, 8
_BUDGET = Budget()
_ORIGIN = (0.0, 0.0, 0.0)


class _Shelf:
    """Compiled problems of one kind that wait for their next use, each with its method."""

    __slots__ = ("idle", "used")

    def __init__(self) -> None:
        self.idle: list[tuple[Solver, Problem]] = []
        self.used = 0


class _Shelves:
    """The problems that were compiled for one robot, by their kind; of too many the oldest goes.

    A problem is on its shelf or in one call's hands: calls of several threads never meet in one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shelves: dict[Hashable, _Shelf] = {}
        self._uses = itertools.count(1)

    def __getitem__(self, kind: Hashable) -> _Shelf:
        shelf = self._shelves.get(kind)
        if shelf is None:
            with self._lock:
                while len(self._shelves) >= _KINDS_KEPT:
                    del self._shelves[min(self._shelves, key=lambda k: self._shelves[k].used)]
                shelf = self._shelves.setdefault(kind, _Shelf())
        shelf.used = next(self._uses)
        return shelf


@contextmanager
def _lent(
    robot: Robot,
    goal: Goal | Sequence[Goal],
    solver: str | Solver,
    options: Mapping[str, Any],
    tolerance: Tolerance | None,
    budget: Budget | None,
    seed: int,
) -> Iterator[tuple[Solver, Problem]]:
    """A method, and a problem for the goals: one that is at hand, or a new one.

    Targets, weights, budget and seed are set each time, and answers are not remembered.  A problem in whose
    use something is raised is not used again.
    """
    require_options(robot, tolerance, budget, seed)
    goals = checked_goals(goal)
    method = make_solver(solver, **options) if options else solver
    shelves: _Shelves | None = robot.memory.get("problems")
    if shelves is None:
        shelves = robot.memory.setdefault("problems", _Shelves())
    try:
        shelf = shelves[method, tolerance, tuple(map(goal_kind, goals))]
    except TypeError:  # a method or goal of somebody's own that cannot be a key
        shelf = _Shelf()
    try:
        lent = shelf.idle.pop()
    except IndexError:
        lent = make_solver(method), Problem(robot, goals, tolerance=tolerance, budget=budget, seed=seed)
    else:
        problem = lent[1]
        problem.exchange(goals)
        problem.budget, problem.seed = budget or _BUDGET, int(seed)
    yield lent
    if len(shelf.idle) < _EACH_KEPT:
        shelf.idle.append(lent)


def warm_up(
    robot: Robot,
    goal: Goal | Sequence[Goal] | None = None,
    *,
    solver: str | Solver = "auto",
    tolerance: Tolerance | None = None,
    **options: Any,
) -> None:
    """Loads, or on a new machine compiles, all that solving such goals may need.

    For loops that must not stall: after it, not even the first goal out of reach does.  The first solve of a
    kind does the same.

    Args:
        robot: From ``load_robot``.
        goal: One goal or several at once, as the loop will ask for them; only their kinds and frames matter.
            Default: a pose of the tool.
        solver: As in ``solve``.
        tolerance: As in ``solve``.
        **options: As in ``solve``.

    Raises:
        As ``solve``.
    """
    goals = PoseGoal(None, _ORIGIN) if goal is None else goal
    with _lent(robot, goals, solver, options, tolerance, None, 0) as (method, problem):
        method.load(problem)
        _ = problem.mover


@dataclass(frozen=True, eq=False)
class Branch:
    """One of the ways in which an arm can meet a goal.

    Attributes:
        name: The choice made at each fork, such as ``shoulder+ elbow- wrist+``.
        q: (nq,) joint angles; each turned by whole turns to lie inside its limits next to the start.
        inside: Whether all joints are inside their limits.
    """

    name: str
    q: NDArray[np.float64]
    inside: bool

    def __repr__(self) -> str:
        return f"Branch({self.name!r}, q={short_numbers(self.q)}, inside={self.inside})"


Branches = tuple[Branch, ...]


@overload
def solve_all(
    robot: Robot, goal: Goal | Pose, *, start: ArrayLike | None = None, limits: bool = True
) -> Branches: ...


@overload
def solve_all(
    robot: Robot, goal: Sequence[Goal | Pose], *, start: ArrayLike | None = None, limits: bool = True
) -> tuple[Branches, ...]: ...


@overload
def solve_all(
    robot: Robot, goal: NDArray[np.float64], *, start: ArrayLike | None = None, limits: bool = True
) -> Branches | tuple[Branches, ...]: ...


def solve_all(
    robot: Robot,
    goal: Goal | Pose | NDArray[np.float64] | Sequence[Goal | Pose],
    *,
    start: ArrayLike | None = None,
    limits: bool = True,
) -> Branches | tuple[Branches, ...]:
    """Every way of meeting a goal that the closed form knows, the nearest to ``start`` first.

    At a singular pose one joint angle is free; it is kept as near to ``start`` as can be.

    Args:
        robot: From ``load_robot``.
        goal: A pose for six axes or a limb of seven (each branch at the swivel nearest to ``start``), a
            position for a planar two-link or the wrist's centre of a limb.  A ``Pose`` or a
            matrix (4, 4) is the tool's.  Of a list, or of matrices (n, 4, 4), each on its own.
        start: (nq,); default home.
        limits: Leave out branches outside the joint limits.

    Returns:
        The branches; for a list, those of each.

    Raises:
        UnsupportedGoalError: No closed form is known for this robot and goal.
    """
    if isinstance(goal, Goal | Pose) or (isinstance(goal, np.ndarray) and goal.ndim == 2):
        return _branches(robot, goal, start, limits)
    return tuple(_branches(robot, one, start, limits) for one in goal)


def _branches(
    robot: Robot, goal: Goal | Pose | NDArray[np.float64], start: ArrayLike | None, limits: bool
) -> Branches:
    """``solve_all`` for one."""
    from robot_ik.solvers.analytic import Analytic

    wanted = goal if isinstance(goal, Goal) else PoseGoal.at(None, _pose_of(goal))
    with _lent(robot, wanted, "analytic", {}, None, None, 0) as (solver, problem):
        origin = robot.home if start is None else robot.check_q(start, "start")
        branches = cast(Analytic, solver).branches(problem, origin)
    if not branches:
        return ()
    qs = np.array([q for _, q in branches])
    same = np.abs(qs[:, None] - qs).max(axis=2) < _SAME
    far = ((qs - origin) ** 2).sum(axis=1).tolist()
    first = [k for k, row in enumerate(same.tolist()) if row.index(True) == k]
    inside = _inside(robot, qs)
    found = [(far[k], Branch(*branches[k], inside=inside[k])) for k in first]
    ordered = sorted(found, key=lambda one: (not one[1].inside, one[0]))
    return tuple(branch for _, branch in ordered if branch.inside or not limits)


def _inside(robot: Robot, qs: NDArray[np.float64]) -> list[bool]:
    """Which rows of ``qs`` (n, nq) are inside the limits, as ``Robot.outside`` has it."""
    if robot.nq > robot.nv:  # balls and floating bases have limits of their own
        return [not robot.outside(q) for q in qs]
    near = (qs >= robot.lower - _SLACK) & (qs <= robot.upper + _SLACK)
    return cast(list[bool], near.all(axis=1).tolist())


def _pose_of(pose: Pose | NDArray[np.float64]) -> Pose:
    return pose if isinstance(pose, Pose) else Pose.from_matrix(pose)


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
    """Solves each pose on its own, the same answers as ``solve`` one by one.

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
    targets, with_angle = target_rows(poses)
    begin = start_rows(robot, starts, len(targets))
    goal = PoseGoal(frame, _ORIGIN) if with_angle else PositionGoal(frame, _ORIGIN)
    return run_batch(lambda: _lent(robot, goal, solver, {}, tolerance, budget, seed), targets, begin, threads)


def solve(
    robot: Robot,
    goal: Goal | Sequence[Goal],
    *,
    solver: str | Solver = "auto",
    start: ArrayLike | None = None,
    tolerance: Tolerance | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    trace: bool = False,
    **options: Any,
) -> Solution:
    """Joint angles that bring the robot's frames to the goals, inside the joint limits.

    What it compiles for a kind of goal it keeps for the next call with this robot: a loop of calls costs
    little more than one over a ``Problem``.

    Args:
        robot: From ``load_robot``.
        goal: One goal, or several at once on any frames.
        solver: A name of ``SOLVERS``, ``"auto"``, or a solver instance.
        start: (nq,) where to begin; default ``robot.home``.  The answer tends to stay near it.
        tolerance: Default 0.1 mm and 1 mrad.
        budget: Iterations, seconds, restarts.
        seed: Of the random restarts; the same seed gives bit-equal answers.
        trace: Keep a row for every step in ``solution.trace``.
        **options: Of the solver, by field name.

    Returns:
        A ``Solution``; whether it converged is in its status, never an exception.

    Raises:
        GoalError, UnknownFrameError: The goal makes no sense for this robot.
        UnsupportedGoalError: The solver cannot serve this kind of goal; names those that can.
        UnknownSolverError, ConfigError: No such solver or option.
    """
    if trace:  # rows for a whole budget are not kept for the next call
        problem = Problem(robot, goal, tolerance=tolerance, budget=budget, seed=seed, trace=True)
        return make_solver(solver, **options).solve(problem, start)
    with _lent(robot, goal, solver, options, tolerance, budget, seed) as (method, problem):
        return method.solve(problem, start)
