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
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import GoalError, InvalidGoalError, UnsupportedJointError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal
from robot_ik.kernels import residuals, work
from robot_ik.model_tree import pose_row
from robot_ik.robot import Robot

Array = NDArray[np.float64]

# A pose goal weighs metres against radians: one reach-radius times this counts as much as one radian.
# 0.35 solved cold poses of PUMA 560, UR5e and Panda in the fewest steps (0.25, 0.3, 0.42, 0.5, 0.7, 1 tried).
_LENGTH_PER_REACH = 0.35


@dataclass(frozen=True)
class Tolerance:
    """What counts as reached: every goal within ``position`` metres and ``angle`` radians."""

    position: float = 1e-4
    angle: float = 1e-3

    def __post_init__(self) -> None:
        if not (self.position > 0 and self.angle > 0):
            raise InvalidGoalError(f"a tolerance must be positive, not {self.position} m, {self.angle} rad")


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
        if self.iterations < 0 or (self.restarts is not None and self.restarts < 0):
            raise InvalidGoalError("a budget of iterations or restarts must be zero or more")
        if self.seconds is not None and not self.seconds >= 0:
            raise InvalidGoalError(f"a budget of seconds must be zero or more, not {self.seconds}")


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
            UnsupportedJointError: An equality of the model ties a joint that the goals would move.
        """
        self.robot = robot
        # Asked at run time too: a bare Pose or array is a likely slip, and deserves a sentence.
        several = [goals] if isinstance(goals, Goal) else list(goals) if hasattr(goals, "__iter__") else []
        if not several or not all(isinstance(g, Goal) for g in several):
            raise GoalError(
                f"a problem needs one or more goals, not {goals!r}",
                hint="for example PoseGoal.at(frame, pose) or PositionGoal(frame, (x, y, z))",
            )
        self.goals: list[Goal] = several
        self.tolerance = tolerance or Tolerance()
        self.budget = budget or Budget()
        self.seed = int(seed)
        self.trace = trace
        self.prepared: dict[str, Any] = {}
        self._compile_goals()
        _refuse_coupled(robot, self.nodes)
        self._reach: list[tuple[int, float, float, float, float]] = []
        for g, goal in enumerate(self.goals):
            ball = robot.reach(goal.frame) if goal.weights[0] > 0.0 else None
            if ball is not None:
                self._reach.append((g, *ball[0].tolist(), ball[1] + self.tolerance.position))
        self._make_work(self.budget.iterations + 1 if trace else 0)

    def _compile_goals(self) -> None:
        robot, tree, count = self.robot, self.robot.tree, len(self.goals)
        self.kind = np.empty(count, dtype=np.int64)
        row = np.empty(count, dtype=np.int64)
        self.node = np.empty(count, dtype=np.int64)
        local = np.empty((count, 12))
        self.target = np.empty((count, 12))
        weight = np.empty((count, 2))
        tolerance = np.tile([self.tolerance.position, self.tolerance.angle], (count, 1))
        self.rows = 0
        ancestors: list[list[int]] = []
        for g, goal in enumerate(self.goals):
            self.kind[g] = goal_kind(goal)
            row[g] = self.rows
            self.rows += residuals.ROWS_OF[int(self.kind[g])]
            node, local[g] = robot.attachment(goal.frame)
            self.node[g] = node
            self.target[g] = pose_row(goal.target)
            weight[g] = goal.weights
            tolerance[g, weight[g] == 0.0] = np.inf  # what weighs nothing is not asked for
            weight[g, 0] /= self.length(goal)
            ancestors.append(tree.ancestors(node))
        self.nodes = np.array(sorted({k for chain in ancestors for k in chain}), dtype=np.int64)
        used = np.isin(tree.dof_node, self.nodes)
        self.dofs = np.flatnonzero(used).astype(np.int64)
        moves = np.array(
            [[int(k in chain) for k in tree.dof_node[self.dofs]] for chain in ancestors], dtype=np.int64
        ).reshape(count, len(self.dofs))
        self.weights = weight  # (g, 2) on metres (over the length scale) and on radians
        self._goal_arrays = {
            "kind": self.kind, "row": row, "node": self.node, "local": local, "target": self.target,
            "weight": weight, "tolerance": tolerance, "dofs": self.dofs, "moves": moves,
        }  # fmt: skip
        self.handle = residuals.GOALS.pack(self._goal_arrays)

    def length(self, goal: Goal) -> float:
        """Metres that count as much as one radian: scales position rows, so that all rows are angles."""
        ball = self.robot.reach(goal.frame)
        if ball is None or ball[1] < 1e-6:
            return 1.0
        return _LENGTH_PER_REACH * ball[1]

    def _make_work(self, trace_rows: int) -> None:
        robot, count, m, nu = self.robot, len(self.goals), self.rows, len(self.dofs)
        nq, k, p = robot.nq, max(self.rows, len(self.dofs), 1), min(self.rows, len(self.dofs))
        shapes: dict[str, Any] = {
            "state": (work.STATE_SIZE,), "value": (work.VALUE_SIZE,), "start": (nq,), "q": (nq,),
            "best": (nq,), "accepted": (nq,), "world": (robot.tree.size, 12), "scratch": (2, 12),
            "frames": (count, 12),
            "residual": (m,), "miss": (count, 2), "jacobian": (m, nu), "normal": (nu, nu), "damped": (nu, nu),
            "factor": (k, k), "gradient": (nu,), "step": (nu,), "low": (nu,), "high": (nu,), "rhs": (k,),
            "free": (k,), "side": (k,), "dq": (robot.nv,), "trace": (trace_rows, len(work.TRACE_COLUMNS)),
            "wanted": (m,), "left": (p, m), "sigma": (p,), "right": (p, nu), "aim": (nu,),
            "rest": (nq,),
        }  # fmt: skip
        self.arrays: dict[str, Any] = {
            name: np.zeros(shape, dtype=np.int64 if name in ("state", "free", "side") else float)
            for name, shape in shapes.items()
        }
        self.arrays["nodes"] = self.nodes
        self.arrays["rest"][:] = robot.home
        self.work = work.WORK.pack(self.arrays)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy has work space of its own, and so is compiled anew.
        options = (self.robot, self.goals, self.tolerance, self.budget, self.seed, self.trace)
        return _rebuilt, (*options, self.target.copy())

    def retarget(self, target: Pose | Goal | ArrayLike, index: int = 0) -> None:
        """Moves the target of one goal.

        Args:
            target: A ``Pose``, a homogeneous matrix (4, 4), a position (3,), or a goal of the same kind,
                frame and weights.
            index: Which goal.

        Raises:
            InvalidGoalError: Not finite, or another kind of goal.
        """
        if isinstance(target, Pose):
            row = self.target[index]
            row[:3] = target.position
            row[3:] = target.rotation.ravel()
            return
        if isinstance(target, Goal):
            mine = self.goals[index]
            tool = self.robot.tool
            same_frame = (target.frame or tool) == (mine.frame or tool)
            if type(target) is not type(mine) or target.weights != mine.weights or not same_frame:
                raise InvalidGoalError(
                    f"this problem was built for a {mine.name} of {mine.frame or tool!r}, "
                    f"not for a {target.name} of {target.frame or tool!r} or for other weights",
                    hint="another kind of goal, frame or weight needs a new Problem",
                )
            self.target[index] = pose_row(target.target)
            return
        position = np.asarray(target, dtype=float)
        if position.shape == (4, 4):
            numbers = position.ravel()
            if math.isfinite(numbers.dot(numbers)):
                row = self.target[index]
                row[:3] = position[:3, 3]
                row[3:].reshape(3, 3)[:] = position[:3, :3]
                return
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InvalidGoalError(
                f"a target is a Pose, a finite matrix (4, 4) or a finite position (3,), not {target!r}"
            )
        if not self.goals[index].has_position:
            raise InvalidGoalError(f"a {self.goals[index].name} has no position to move")
        self.target[index, :3] = position

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
        """Whether some position goal is proven unreachable: farther than all links laid end to end."""
        for g, x, y, z, radius in self._reach:
            # As Python's own numbers, which are quicker one by one than NumPy's.
            a, b, c = self.target[g, :3].tolist()
            if (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2 > radius * radius:
                return True
        return False


def _rebuilt(
    robot: Robot,
    goals: list[Goal],
    tolerance: Tolerance,
    budget: Budget,
    seed: int,
    trace: bool,
    target: Array,
) -> Problem:
    problem = Problem(robot, goals, tolerance=tolerance, budget=budget, seed=seed, trace=trace)
    problem.target[:] = target
    return problem


def _refuse_coupled(robot: Robot, nodes: NDArray[np.int64]) -> None:
    """Raises ``UnsupportedJointError`` if an equality of the model ties one of the moved joints."""
    model = robot.model
    moved = {robot.tree.joint_ids[k] for k in nodes}
    joint_equality = int(mujoco.mjtEq.mjEQ_JOINT)
    for e in range(model.neq):
        if int(model.eq_type[e]) != joint_equality or not model.eq_active0[e]:
            continue
        tied = [int(j) for j in (model.eq_obj1id[e], model.eq_obj2id[e]) if j >= 0]
        if moved.isdisjoint(tied):
            continue
        names = [repr(model.joint(j).name or f"joint_{j}") for j in tied]
        what = f"joints {names[0]} and {names[1]}" if len(names) == 2 else f"joint {names[0]}"
        raise UnsupportedJointError(
            f"{robot.path.name} ties {what} by an equality constraint, which a solve would break",
            path=robot.path,
            hint="freeze them with load_robot(…, joints=[…]), or aim at a frame that they do not move",
        )


def goal_kind(goal: Goal) -> int:
    """The kernel's code for a goal."""
    if goal.has_position and goal.has_angle:
        return residuals.POSE
    return residuals.POSITION if goal.has_position else residuals.ORIENTATION
