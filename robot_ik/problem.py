"""``Problem``: all that a solver may see: compiled goals, limits, tolerance, budget, seed.

Building one costs a few microseconds times ten; the hot loop builds it once and then moves its target:

    problem = Problem(robot, PoseGoal("gripper", position, wxyz))
    for pose in path:
        problem.retarget(pose)
        q = solver.solve(problem, q).q
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.compiled_goals import (
    checked_goals,
    compile_goals,
    length_of,
    levels_of,
    set_posture,
    target_row,
)
from robot_ik.errors import InvalidGoalError, ModelError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PostureGoal, Tolerance
from robot_ik.goals.base import numbers, rotation_matrix, vector
from robot_ik.kernels import residuals, work
from robot_ik.kernels.partial_rows import NO_PLACE, OF_FRAME
from robot_ik.kernels.targets import Mover
from robot_ik.model_tree import pose_row
from robot_ik.robot import Robot

__all__ = ["Budget", "Problem", "Tolerance"]

Array = NDArray[np.float64]


# What the compiled loops can count to.
_MOST = 1 << 62


@dataclass(frozen=True)
class Budget:
    """How long a solver may try.  An iteration budget gives bit-equal results for a seed; seconds do not.

    Attributes:
        iterations: Steps in all tries together.
        seconds: Wall-clock limit; None = none.
        restarts: Random restarts after the first try; None = as the solver says.
    """

    iterations: int = 20_000
    seconds: float | None = None
    restarts: int | None = None

    def __post_init__(self) -> None:
        for count in (self.iterations, 0 if self.restarts is None else self.restarts):
            whole = isinstance(count, int | np.integer)
            if not (whole and 0 <= count <= _MOST):
                raise InvalidGoalError(
                    f"a budget of iterations or restarts must be zero or more, at most 2^62, not {count!r}"
                )
        seconds: Any = self.seconds
        if seconds is not None and not (isinstance(seconds, int | float | np.number) and seconds >= 0):
            raise InvalidGoalError(f"a budget of seconds must be zero or more, not {self.seconds!r}")


class Problem:
    """Goals of one robot in compiled form, with the work space of the solve.

    Not to be shared between threads: the arrays in it are the solver's.

    Attributes:
        robot, goals, tolerance, budget, seed: As given.
        trace: Whether to keep a row for every step.
        prepared: What solvers worked out for this problem once, by their name.
    """

    def __init__(
        self,
        robot: Robot,
        goals: Goal | Sequence[Goal],
        *,
        tolerance: Tolerance | None = None,
        budget: Budget | None = None,
        seed: int = 0,
        trace: bool = False,
    ) -> None:
        """Compiles the goals.

        Raises:
            GoalError: No goal at all, or something that is not a goal.
            UnknownFrameError: A goal names a frame that the robot does not have.
            UnsupportedJointError: A frozen joint should follow one that the goals would move.
        """
        _require_options(robot, tolerance, budget, seed)
        self.robot = robot
        self.goals = checked_goals(goals)
        self.tolerance = tolerance or Tolerance()
        self.budget = budget or Budget()
        self.seed = int(seed)
        self.trace = trace
        self.prepared: dict[str, Any] = {}
        self._compiled = compile_goals(robot, self.goals, self.tolerance)
        arrays = self._compiled.arrays
        self.rows, self.nodes = self._compiled.rows, self._compiled.nodes
        self.target, self.dofs = arrays["target"], arrays["dofs"]
        self.weights = arrays["weight"]  # (g, 2) on metres (over the length scale) and on radians
        self.handle = residuals.GOALS.pack(arrays)
        self._whole = [goal.rows.whole for goal in self.goals]
        self._reach: list[tuple[int, float, float, float, float]] = []
        for g, goal in enumerate(self.goals):
            asks = goal.rows.place != NO_PLACE and goal.rows.of == OF_FRAME and goal.weights[0] > 0.0
            asks = asks and not goal.soft
            ball = robot.reach(goal.frame) if asks else None
            if ball is not None:
                slack = (goal.tolerance or self.tolerance).position
                self._reach.append((g, *ball[0].tolist(), ball[1] + slack))
        self._make_work(work.TRACE_ROOM if trace else 0)

    def length(self, goal: Goal) -> float:
        """Metres that count as much as one radian for a goal."""
        return length_of(self.robot, goal)

    @property
    def features(self) -> frozenset[str]:
        """What the problem asks for beyond goals: ``couplings``, ``stiffness``, ``priorities``, ``soft``."""
        arrays, found = self._compiled.arrays, set()
        if (self.robot.tree.tied[:, 1] >= 0).any() and len(arrays["tied"]):
            found.add("couplings")
        if any(goal.soft for goal in self.goals):
            found.add("soft")
        elif len({goal.priority for goal in self.goals}) > 1:
            found.add("priorities")
        if (arrays["ease"] != 1.0).any():
            found.add("stiffness")
        return frozenset(found)

    def _make_work(self, trace_rows: int) -> None:
        robot, count, m, nu = self.robot, len(self.goals), self.rows, len(self.dofs)
        levels = 1 + max(levels_of(self.goals))
        several = levels > 1 or any(goal.soft for goal in self.goals)
        levels, dense = (levels, m) if several else (0, 0)  # what only priorities need
        nq, k, p = robot.nq, max(self.rows, len(self.dofs), 1), min(self.rows, len(self.dofs))
        shapes: dict[str, Any] = {
            "state": (work.STATE_SIZE,), "value": (work.VALUE_SIZE,), "start": (nq,), "q": (nq,),
            "best": (nq,), "nearby": (nq,), "rival": (nq,), "accepted": (nq,), "candidate": (nq,),
            "reach": (count, 4), "beyond": (count,), "world": (robot.tree.size, 12), "scratch": (2, 12), "frames": (count, 12),
            "residual": (m,), "miss": (count, 2), "jacobian": (m, nu), "column": (m,), "factor": (k, k),
            "normal": (nu, nu), "damped": (nu, nu), "gradient": (nu,), "step": (nu,), "low": (nu,),
            "high": (nu,), "rhs": (k,), "free": (k,), "side": (k,), "dq": (robot.nv,),
            "trace": (trace_rows, len(work.TRACE_COLUMNS)), "wanted": (m,), "left": (p, m), "sigma": (p,),
            "right": (p, nu), "aim": (nu,), "rest": (nq,), "level_cost": (levels,), "level_bar": (levels,),
            "level_best": (levels,), "basis": (min(dense, nu), nu), "own": (dense, nu),
            "gram": (dense, dense), "metric": (nu, nu), "way": (nu,), "before": (nu,), "moved": (nu,),
            "outward": (nu,),
        }  # fmt: skip
        self.arrays: dict[str, Any] = {
            name: np.zeros(shape, dtype=np.int64 if name in ("state", "beyond", "free", "side") else float)
            for name, shape in shapes.items()
        }
        self.arrays["nodes"] = self.nodes
        self.arrays["rest"][:] = robot.home
        self.arrays["reach"][:, 3] = np.inf
        for g, *ball in self._reach:
            self.arrays["reach"][g] = ball
        self.work = work.WORK.pack(self.arrays)

    @cached_property
    def _mover(self) -> Mover:
        return Mover(self.target)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy has work space of its own, and so is compiled anew.
        options = {name: getattr(self, name) for name in ("tolerance", "budget", "seed", "trace")}
        return partial(Problem, self.robot, self.goals, **options), (), self.target.copy()

    def __setstate__(self, target: Array) -> None:
        self.target[:] = target

    def retarget(self, target: Pose | Goal | ArrayLike, index: int = 0) -> None:
        """Moves the target of one goal.

        Args:
            target: A ``Pose``, a homogeneous matrix (4, 4), a position (3,), or a goal of the same kind,
                frame and weights.  A matrix is taken to be one: this is the hot loop.
            index: Which goal.

        Raises:
            InvalidGoalError: Not finite, or another kind of goal.
        """
        mover = self._mover
        if self._whole[index] and type(target) is np.ndarray and target.dtype is mover.dtype:
            place, flip = mover.places.get(target.shape, (None, 0))
            if place is not None and (flip == 0 or self.goals[index].has_position):
                place[...] = target
                if mover.take(mover.move, index ^ flip):
                    return
        if not self._whole[index]:
            self._retarget_partial(target, index)
            return
        if isinstance(target, Pose):
            row = self.target[index]
            row[:3] = target.position
            row[3:] = target.rotation.ravel()
            return
        if isinstance(target, Goal):
            self._require_same(target, index)
            self.target[index] = pose_row(target.target)
            return
        try:
            position = np.asarray(target, dtype=float)
        except (TypeError, ValueError):
            position = np.empty(0)
        if position.shape == (4, 4) and np.isfinite(position).all():
            self.retarget(position, index)
            return
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InvalidGoalError(
                f"a target is a Pose, a finite matrix (4, 4) or a finite position (3,), not {target!r}"
            )
        if not self.goals[index].has_position:
            raise InvalidGoalError(f"a {self.goals[index].name} has no position to move")
        self.target[index, :3] = position

    def _retarget_partial(self, target: Any, index: int) -> None:
        """As ``retarget`` for a goal that is no whole position, orientation or pose: it is replaced."""
        mine = self.goals[index]
        if isinstance(target, Goal):
            self._require_same(target, index)
            moved = target
        elif isinstance(mine, PostureGoal):
            moved = mine.moved_to_q(target)
        elif isinstance(target, Pose):
            moved = mine.moved_to(target)
        else:
            given = numbers(target, "a target")
            place, turn = (
                vector(given.ravel(), 16 if given.shape == (4, 4) else 3, "a target"),
                mine.target.rotation,
            )
            if len(place) == 16:
                place, turn = given[:3, 3], rotation_matrix(given[:3, :3], "a target")
            moved = mine.moved_to(Pose.from_rotation(turn, place))
        if isinstance(moved, PostureGoal):
            set_posture(self.robot, self._compiled.arrays, index, moved)
        self.target[index] = target_row(moved)
        self.goals[index] = moved

    def _require_same(self, target: Goal, index: int) -> None:
        """Raises ``InvalidGoalError`` unless ``target`` differs from the goal in its target only."""
        mine, tool = self.goals[index], self.robot.tool
        if target.signature != mine.signature or (target.frame or tool) != (mine.frame or tool):
            raise InvalidGoalError(
                f"this problem was built for a {mine.name} of {mine.frame or tool!r}, "
                f"not for a {target.name} of {target.frame or tool!r} or for other weights",
                hint="another kind of goal, frame or weight needs a new Problem",
            )

    def target_pose(self, index: int = 0) -> Pose:
        """The wanted pose of one goal, world."""
        row = self.target[index]
        return Pose.from_rotation(row[3:].reshape(3, 3), row[:3])

    def rows_out_of_reach(self, targets: Array) -> NDArray[np.bool_]:
        """(n,) the same as ``out_of_reach`` for other targets (n, 12) of the first goal."""
        beyond = np.zeros(len(targets), dtype=bool)
        for g, *centre, radius in self._reach:
            if g == 0:
                beyond |= np.linalg.norm(targets[:, :3] - centre, axis=1) > radius
        return beyond

    def out_of_reach(self) -> bool:
        """Whether a whole position is proven unreachable: farther than all links laid end to end.

        The compiled loops find that out by themselves, and of parts of a position as well.
        """
        for g, x, y, z, radius in self._reach:
            # As Python's own numbers, which are quicker one by one than NumPy's.
            a, b, c = self.target[g, :3].tolist()
            if math.hypot(a - x, b - y, c - z) > radius:
                return True
        return False


def _require_options(robot: object, tolerance: object, budget: object, seed: object) -> None:
    """Raises in words for the likely slips: a name in place of a robot, a number in place of a tolerance."""
    if not isinstance(robot, Robot):
        raise ModelError(f"a problem needs a robot, not {robot!r}", hint='rik.load_robot("puma560")')
    if not isinstance(tolerance, Tolerance | None):
        raise InvalidGoalError(f"not a tolerance: {tolerance!r}", hint="Tolerance(position=1e-4, angle=1e-3)")
    if not isinstance(budget, Budget | None):
        raise InvalidGoalError(f"not a budget: {budget!r}", hint="Budget(iterations=2000, seconds=0.1)")
    if not isinstance(seed, int | np.integer):
        raise InvalidGoalError(f"a seed is a whole number, not {seed!r}")
