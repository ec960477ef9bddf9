"""``Problem``: all that a solver may see: compiled goals, limits, tolerance, budget, seed.

Building one takes some hundred microseconds; the hot loop builds it once and then moves its target:

    problem = Problem(robot, PoseGoal("gripper", position, wxyz))
    for pose in path:
        problem.retarget(pose)
        q = solver.solve(problem, q).q
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import GoalError, InvalidGoalError, ProblemInUseError
from robot_ik.geometry import INTEGER, REAL, Array, Pose
from robot_ik.goals import Goal, Tolerance
from robot_ik.kernels import residuals, workspace
from robot_ik.kernels.residuals import (
    NO_ORIENTATION,
    NO_POSITION,
    OF_FRAME,
    OF_JOINTS,
    OF_PRIOR,
    ONE_SIDE,
    SOME_AXES,
    WHOLE,
)
from robot_ik.problem import Budget
from robot_ik.robot import Robot, require_robot

if TYPE_CHECKING:
    from robot_ik.targets import Mover

Ints = NDArray[np.int64]

# What the compiled loops can count to.
_MOST = 1 << 62
# A pose goal weighs metres against radians: one reach-radius times this counts as much as one radian.
# With 0.15 `lm` solved cold poses of PUMA 560, UR5e and Panda with the least work (0.06 … 0.35 tried).
_LENGTH_PER_REACH = 0.15


def checked_goals(goals: object) -> list[Goal]:
    """One goal or several as a list; raises ``GoalError`` for none, or what is not a goal."""
    # Asked at run time too: a bare Pose or array is a likely mistake, and deserves a sentence.
    several = [goals] if isinstance(goals, Goal) else list(goals) if hasattr(goals, "__iter__") else []
    if not several or not all(isinstance(g, Goal) for g in several):
        raise GoalError(
            f"a problem needs one or more goals, not {goals!r}",
            hint="for example PoseGoal.at(frame, pose) or PositionGoal(frame, (x, y, z))",
        )
    return several


class LegacyProblem:
    """Goals of one robot in compiled form, with the work space of the solve: the one owner of all of it.

    Threads may use it in turn; a call that begins while another is under way is refused.
    No array is ever replaced, so an address of one is good for as long as its holder, who holds the table
    too, lives (``kernels/bundle.py``).

    Attributes:
        robot, tolerance, budget, seed: As given.
        trace: Whether to keep a row for every step.
        given: The goals as they were last given; ``target`` has what moved since, ``goals`` both together.
        whole: Which goals are a whole position, orientation or pose of a frame.
        has_levels: Whether goals are served one after the other: of several priorities, or some of them soft.
        goal_arrays, arrays: What the goals are for kernels, and the work space: by their names in
            ``residuals.GOALS`` and ``workspace.WORK``.
        tables: Tables of addresses: of the robot's tree, of ``goal_arrays``, of ``arrays``.
        nodes: Joints that move any goal and those that lead them, parents first.
        made: What solvers made for this problem, by their ``id``: (solver, what it made).
        token: A list of one item, which a call removes while it uses the arrays; else it is refused.
            (``list.pop`` is one step for all threads, and costs a fifth of a lock.)
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
        shared: dict[str, Any],
    ) -> None:
        """Compiles the goals.

        Raises:
            GoalError, UnknownFrameError: No goal, something that is none, or a frame that does not exist.
            UnsupportedJointError: A frozen joint should follow one that the goals would move.
        """
        require_options(robot, tolerance, budget, seed)
        self.robot = robot
        self.given = tuple(checked_goals(goals))
        self.tolerance = tolerance or Tolerance()
        self.budget = budget or Budget()
        self.seed = int(seed)
        self.trace = trace
        self.made: dict[int, tuple[object, Any]] = {}
        self.token = [None]
        self.whole = [goal.rows.whole for goal in self.given]
        levels = 1 + max(_levels(self.given))
        self.has_levels = levels > 1 or any(goal.soft for goal in self.given)
        self.goal_arrays, rows, self.nodes = _compile_goals(robot, self.given, self.tolerance)
        self.goal_arrays["target"] = shared["target"]
        self.target, self.dofs = self.goal_arrays["target"], self.goal_arrays["dofs"]
        self.weights = self.goal_arrays["asked"][:, :2]  # on metres (over the length) and on radians
        count, nu = len(self.given), len(self.dofs)
        sizes = {
            "g": count, "m": rows, "nu": nu, "nq": robot.nq, "nv": robot.nv, "n": robot.tree.size,
            "k": max(rows, nu, 1), "p": min(rows, nu), "trace": workspace.TRACE_CAPACITY if trace else 0,
            "levels": levels if self.has_levels else 0, "dense": rows if self.has_levels else 0,
            "free": min(rows, nu) if self.has_levels else 0,
        }  # fmt: skip
        reach = np.array([_reach_row(robot, goal, self.tolerance) for goal in self.given])
        known = {"start": shared["start"], "nodes": self.nodes, "rest": robot.home.copy(), "reach": reach}
        self.arrays: dict[str, Any] = workspace.WORK.zeros(sizes) | known
        goal_table, work_table = residuals.GOALS.pack(self.goal_arrays), workspace.WORK.pack(self.arrays)
        self.tables = robot.tree.handle, goal_table, work_table

    def run_table(self, options: Array) -> Ints:
        """One table of all that a kernel takes: ``tables``, and its options."""
        tree, goals, work = self.tables
        return workspace.RUN.pack({"tree": tree, "goals": goals, "work": work, "options": options})

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goals, with the targets they have now."""
        return tuple(goal.at_row(row) for goal, row in zip(self.given, self.target, strict=True))

    def __repr__(self) -> str:
        goals = ", ".join(map(repr, self.goals[:4]))
        more = f", … {len(self.given) - 4} more" if len(self.given) > 4 else ""
        rest = f"{self.tolerance!r}, {self.budget!r}, seed={self.seed}, trace={self.trace}"
        return f"Problem({self.robot.name!r}, [{goals}{more}], {rest})"

    def length(self, goal: Goal) -> float:
        """Metres that count as much as one radian for a goal."""
        return _length(self.robot, goal)

    @property
    def features(self) -> frozenset[str]:
        """What the problem asks for beyond goals: ``couplings``, ``stiffness``, ``priorities``, ``soft``."""
        arrays, soft = self.goal_arrays, any(goal.soft for goal in self.given)
        found = {
            "couplings": (self.robot.tree.coupled[:, 1] >= 0).any() and len(arrays["coupled"]),
            "soft": soft,
            "priorities": self.has_levels and not soft,
            "stiffness": (arrays["joint_scale"] != 1.0).any(),
        }
        return frozenset(name for name, asked in found.items() if asked)

    @cached_property
    def mover(self) -> Mover:
        """What takes matrices and positions; loads compiled code when it is first asked for."""
        from robot_ik.targets import Mover  # which a single solve does not need

        return Mover(self.target)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy has work space of its own, and so is compiled anew.
        options = {name: getattr(self, name) for name in ("tolerance", "budget", "seed", "trace")}
        return partial(Problem, self.robot, self.given, **options), (), self.target.copy()

    def __setstate__(self, target: Array) -> None:
        self.target[:] = target

    def retarget(
        self, target: Pose | Goal | ArrayLike | Mapping[str | int, Pose | Goal | ArrayLike], index: int = 0
    ) -> None:
        """Moves the target of one goal, or of several at once.

        Args:
            target: A ``Pose``, a homogeneous matrix (4, 4), a position (3,), or a goal of the same kind,
                frame and weights.  A matrix is taken to be one: this is the hot loop.  A mapping moves
                several, all or none: its keys are a frame that only one goal has, or a goal's index.
            index: Which goal.

        Raises:
            InvalidGoalError: Not finite, another kind of goal, or a key that names no goal or several.
            ProblemInUseError: Another thread's call is under way.
        """
        token = self.token
        try:
            token.pop()
        except IndexError:
            raise ProblemInUseError from None
        try:
            mover = self.mover
            if index != 0:
                mover.require_index(self, index)
            if self.whole[index] and type(target) is np.ndarray and target.dtype is mover.dtype:
                array, flip = mover.buffers.get(target.shape, (None, 0))
                if array is not None and (flip == 0 or self.given[index].has_position):
                    array[...] = target
                    if mover.take(mover.address, index ^ flip):
                        return
            mover.move(self, target, index)
        finally:
            token.append(None)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Refuses other calls meanwhile (``ProblemInUseError``); the hot loop has these lines itself."""
        try:
            self.token.pop()
        except IndexError:
            raise ProblemInUseError from None
        try:
            yield
        finally:
            self.token.append(None)

    def replace_goal(self, index: int, goal: Goal) -> None:
        """Takes a goal of the same kind in place of one."""
        self._put(index, goal)
        self.given = (*self.given[:index], goal, *self.given[index + 1 :])

    def _put(self, index: int, goal: Goal) -> None:
        if goal.rows.of == OF_JOINTS:
            goal.fill(self.goal_arrays, index, self.robot)
        self.target[index] = goal.target_row

    def exchange(self, goals: Sequence[Goal]) -> None:
        """Takes goals with the same ``goal_kind`` in place of all: other targets, other sizes of weights."""
        for index, (mine, goal) in enumerate(zip(self.given, goals, strict=True)):
            if goal.weights != mine.weights:
                metres, radians = goal.weights
                weight = metres / self.length(goal), radians
                self.weights[index] = self.goal_arrays["weight"][index] = weight
            self._put(index, goal)
        self.given = tuple(goals)


def goal_kind(goal: Goal) -> Hashable:
    """What a problem is compiled for; goals that agree in it differ only in target and size of weights."""
    kind, _, *others = goal.signature  # the second part is the weights
    metres, radians = goal.weights
    return goal.frame, kind, metres > 0.0, radians > 0.0, *others


# Made once: ``solve`` asks in every call.
_TOLERANCE, _BUDGET = Tolerance | None, Budget | None


def require_options(robot: object, tolerance: object, budget: object, seed: object) -> None:
    """Raises for likely mistakes: a name in place of a robot, a number in place of a tolerance."""
    require_robot(robot)
    if not isinstance(tolerance, _TOLERANCE):
        raise InvalidGoalError(f"not a tolerance: {tolerance!r}", hint="Tolerance(position=1e-4, angle=1e-3)")
    if not isinstance(budget, _BUDGET):
        raise InvalidGoalError(f"not a budget: {budget!r}", hint="Budget(iterations=2000, seconds=0.1)")
    if not isinstance(seed, INTEGER):
        raise InvalidGoalError(f"a seed is a whole number, not {seed!r}")


def _length(robot: Robot, goal: Goal) -> float:
    """Metres that count as much as one radian: scales position rows, so that all rows are angles."""
    if goal.length is not None:
        return goal.length
    ball = robot.reach(goal.frame) if goal.rows.of == OF_FRAME else None
    return 1.0 if ball is None or ball[1] < 1e-6 else _LENGTH_PER_REACH * ball[1]


def _kind_code(goal: Goal) -> int:
    """The kernel's code: a whole position, orientation or pose, a pose prior, or PARTIAL for all the rest."""
    rows = goal.rows
    if not rows.whole:
        return residuals.PRIOR if rows.of == OF_PRIOR else residuals.PARTIAL
    if rows.orientation == NO_ORIENTATION:
        return residuals.POSITION
    return residuals.POSE if rows.position == WHOLE else residuals.ORIENTATION


def _compile_goals(
    robot: Robot, goals: Sequence[Goal], tolerance: Tolerance
) -> tuple[dict[str, Any], int, Ints]:
    """Arrays by their names in ``residuals.GOALS``, length of the residual, nodes; raises as ``Problem``."""
    tree, count = robot.tree, len(goals)
    moved = [goal.moved_nodes(robot) for goal in goals]
    coupled_to = {int(node): int(leader) for node, leader in tree.coupled}
    used = set().union(*moved)
    leaders = {coupled_to.get(k, k) for k in used} - {-1}
    if robot.couplings:
        from robot_ik.couplings import refuse_broken  # which few arms have

        refuse_broken(robot, leaders)
    dofs = np.array([v for v in range(tree.nv) if int(tree.dof_node[v]) in leaders], dtype=np.int64)
    coupled = [
        (c, int(np.flatnonzero(dofs == tree.vadr[leader])[0]), int(tree.vadr[node]))
        for c, (node, leader) in enumerate(tree.coupled)
        if leader in leaders and node in used
    ]
    movers = np.append(dofs, [v for _, _, v in coupled]).astype(np.int64)
    moves = [[int(tree.dof_node[v]) in nodes for v in movers] for nodes in moved]
    stiffness = robot.stiffness[dofs]
    arrays: dict[str, Any] = residuals.GOALS.zeros({"g": count, "nq": robot.nq, "nv": robot.nv}) | {
        "kind": np.array([_kind_code(goal) for goal in goals], dtype=np.int64),
        "row_codes": np.array([(g.rows.position, g.rows.orientation, g.rows.of, 0) for g in goals]),
        "level": np.array(_levels(goals), dtype=np.int64),
        "soft": np.array([goal.soft for goal in goals], dtype=np.int64),
        "node": np.full(count, -1, dtype=np.int64),
        "target": np.array([goal.target_row for goal in goals]),
        "mask": np.array([goal.rows.mask for goal in goals], dtype=float),
        "weight": np.array([goal.weights for goal in goals], dtype=float),
        "tolerance": np.array([_tolerance_row(goal, tolerance) for goal in goals]),
        "dofs": dofs,
        "column": np.append(np.arange(len(dofs)), [u for _, u, _ in coupled]).astype(np.int64),
        "moved": movers,
        "moves": np.array(moves, dtype=np.int64).reshape(count, len(movers)),
        "joint_scale": np.sqrt(stiffness.min(initial=np.inf) / stiffness),
        "coupled": np.array(coupled, dtype=np.int64).reshape(-1, 3),
    }  # fmt: skip
    rows = 0
    for g, goal in enumerate(goals):
        arrays["row"][g], asked = rows, goal.rows
        arrays["weight"][g, 0] /= _length(robot, goal)
        rows += 3 * ((asked.position != NO_POSITION) + (asked.orientation != NO_ORIENTATION))
        rows += goal.fill(arrays, g, robot)
    arrays["moments"] = np.zeros_like(arrays["masses"])
    arrays["asked"] = np.hstack([arrays["weight"], arrays["tolerance"]])
    arrays |= _pattern(arrays, rows)
    return arrays, rows, np.array(sorted(used | leaders), dtype=np.int64)


def _levels(goals: Sequence[Goal]) -> list[int]:
    """The rank of each goal in the order in which they are served: by priority, the soft ones last."""
    ranks = sorted({(goal.soft, goal.priority) for goal in goals})
    return [ranks.index((goal.soft, goal.priority)) for goal in goals]


def _pattern(arrays: dict[str, Any], rows: int) -> dict[str, Ints]:
    """Where the Jacobian may not be zero: the columns of every goal, and the rows of every column."""
    count = len(arrays["dofs"])
    moves = arrays["moves"][:, :count].astype(bool)
    for c, (_, leader, _) in enumerate(arrays["coupled"]):
        moves[:, leader] |= arrays["moves"][:, count + c].astype(bool)
    coupled = np.tile(np.arange(count, len(arrays["column"])), (len(moves), 1))
    ends = np.append(arrays["row"][1:], rows)
    hit = np.repeat(moves, ends - arrays["row"], axis=0).T
    return {
        "movers": np.ascontiguousarray(np.hstack([_listed(moves), coupled]), dtype=np.int64),
        "mover_count": moves.sum(axis=1),
        "hits": _listed(hit),
        "hit_count": hit.sum(axis=1),
    }


def _listed(marks: NDArray[np.bool_]) -> Ints:
    """In each row, where the marks stand, first."""
    return np.ascontiguousarray(np.argsort(~marks, axis=1, kind="stable"), dtype=np.int64)


def _tolerance_row(goal: Goal, tolerance: Tolerance) -> tuple[float, float]:
    """What weighs nothing is not asked for, and so always met; of a soft goal nothing is needed."""
    if goal.soft:
        return np.inf, np.inf
    mine = goal.tolerance or tolerance
    metres, radians = goal.weights
    return (mine.position if metres > 0.0 else np.inf, mine.angle if radians > 0.0 else np.inf)


def _reach_row(robot: Robot, goal: Goal, tolerance: Tolerance) -> tuple[float, ...]:
    """Centre and radius of a ball that the goal's frame cannot leave, where a position is needed."""
    # Of other rows ``loop.squared_distance`` does not know how far off the frame is.
    proven = goal.rows.position in (WHOLE, SOME_AXES, ONE_SIDE) and goal.rows.of == OF_FRAME
    asks = proven and goal.weights[0] > 0.0
    ball = robot.reach(goal.frame) if asks and not goal.soft else None
    if ball is None:
        return 0.0, 0.0, 0.0, np.inf
    return *ball[0].tolist(), ball[1] + (goal.tolerance or tolerance).position
