"""What a problem is for the compiled code: its goals as flat arrays, its work space, and who owns them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import rotation_z_to
from robot_ik.goals import Array, Goal, Tolerance
from robot_ik.kernels import residuals, workspace
from robot_ik.kernels.residuals import (
    NO_ORIENTATION,
    NO_POSITION,
    OF_FRAME,
    OF_PRIOR,
    ONE_SIDE,
    SOME_AXES,
    WHOLE,
)
from robot_ik.model import pose_row, row_pose
from robot_ik.robot import Robot

T = TypeVar("T")
Ints = NDArray[np.int64]

# A pose goal weighs metres against radians: one reach-radius times this counts as much as one radian.
# With 0.15 `lm` solved cold poses of PUMA 560, UR5e and Panda with the least work (0.06 … 0.35 tried).
_LENGTH_PER_REACH = 0.15


def length_of(robot: Robot, goal: Goal) -> float:
    """Metres that count as much as one radian: scales position rows, so that all rows are angles."""
    if goal.length is not None:
        return goal.length
    ball = robot.reach(goal.frame) if goal.rows.of == OF_FRAME else None
    return 1.0 if ball is None or ball[1] < 1e-6 else _LENGTH_PER_REACH * ball[1]


def target_row(goal: Goal) -> Array:
    """(12,) the wanted pose with the axis that counts along z."""
    pose = goal.target
    row = pose_row(pose)
    if not goal.rows.whole:
        row[3:] = (pose.rotation @ rotation_z_to(goal.rows.axis)).ravel()
    return row


def moved_goal(goal: Goal, row: Array) -> Goal:
    """``goal`` with the target row (12,) that it has now; goals for parts are replaced when they move."""
    if not goal.rows.whole or np.array_equal(target_row(goal), row):
        return goal
    return goal.moved_to(row_pose(row))


def kind_of(goal: Goal) -> int:
    """The kernel's code: a whole position, orientation or pose, a pose prior, or PARTIAL for all the rest."""
    rows = goal.rows
    if not rows.whole:
        return residuals.PRIOR if rows.of == OF_PRIOR else residuals.PARTIAL
    if rows.orientation == NO_ORIENTATION:
        return residuals.POSITION
    return residuals.POSE if rows.position == WHOLE else residuals.ORIENTATION


def compile_goals(
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
        "kind": np.array([kind_of(goal) for goal in goals], dtype=np.int64),
        "row_codes": np.array([(g.rows.position, g.rows.orientation, g.rows.of, 0) for g in goals]),
        "level": np.array(levels_of(goals), dtype=np.int64),
        "soft": np.array([goal.soft for goal in goals], dtype=np.int64),
        "node": np.full(count, -1, dtype=np.int64),
        "target": np.array([target_row(goal) for goal in goals]),
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
        arrays["weight"][g, 0] /= length_of(robot, goal)
        rows += 3 * ((asked.position != NO_POSITION) + (asked.orientation != NO_ORIENTATION))
        rows += goal.fill(arrays, g, robot)
    arrays["moments"] = np.zeros_like(arrays["masses"])
    arrays["asked"] = np.hstack([arrays["weight"], arrays["tolerance"]])
    arrays |= _pattern(arrays, rows)
    return arrays, rows, np.array(sorted(used | leaders), dtype=np.int64)


def levels_of(goals: Sequence[Goal]) -> list[int]:
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


# Solvers whose tables one problem keeps: a slider makes a new one at each of its stops.
_SOLVERS_KEPT = 16


class CompiledProblem:
    """The one owner of all that kernels see of a problem; nothing of it is ever replaced.

    So an address is good for as long as its holder, who holds the table too, lives (``kernels/bundle.py``).

    Attributes:
        tree, goals, work: Tables of addresses: of the robot's tree, of ``goal_arrays``, of ``arrays``.
        goal_arrays, arrays: By their names in ``residuals.GOALS`` and ``workspace.WORK``.
        rows: Length of the residual.
        nodes: Joints that move any goal and those that lead them, parents first.
        made: What solvers made for this problem, by their ``id``: (solver, what it made).
        token: A list of one item, which a call removes while it uses the arrays; else it is refused.
            (``list.pop`` is one step for all threads, and costs a fifth of a lock.)
    """

    __slots__ = ("arrays", "goal_arrays", "goals", "made", "nodes", "rows", "token", "tree", "work")

    def __init__(self, robot: Robot, goals: Sequence[Goal], tolerance: Tolerance, trace_rows: int) -> None:
        self.goal_arrays, self.rows, self.nodes = compile_goals(robot, goals, tolerance)
        self.arrays = self._work_arrays(robot, goals, trace_rows)
        for row, goal in zip(self.arrays["reach"], goals, strict=True):
            row[:] = _reach_row(robot, goal, tolerance)
        self.tree = robot.tree.handle
        self.goals, self.work = residuals.GOALS.pack(self.goal_arrays), workspace.WORK.pack(self.arrays)
        self.made: dict[int, tuple[object, Any]] = {}
        self.token = [None]

    def made_for(self, solver: object, make: Callable[[], T]) -> T:
        """What ``make`` returns: made once for each solver, which is kept with it: its ``id`` is the key."""
        kept: tuple[object, T] | None = self.made.get(id(solver))
        if kept is None:
            made = make()
            if len(self.made) >= _SOLVERS_KEPT:
                self.made.clear()
            kept = self.made[id(solver)] = solver, made
        return kept[1]

    def run_table(self, options: Array) -> Ints:
        """One table of all that a kernel takes."""
        tables = {"tree": self.tree, "goals": self.goals, "work": self.work, "options": options}
        return workspace.RUN.pack(tables)

    def _work_arrays(self, robot: Robot, goals: Sequence[Goal], trace_rows: int) -> dict[str, Any]:
        """The work space of a solve."""
        levels = 1 + max(levels_of(goals))
        several = levels > 1 or any(goal.soft for goal in goals)
        m, nu = self.rows, len(self.goal_arrays["dofs"])
        sizes = {
            "g": len(goals), "m": m, "nu": nu, "nq": robot.nq, "nv": robot.nv, "n": robot.tree.size,
            "k": max(m, nu, 1), "p": min(m, nu), "trace": trace_rows,
            "levels": levels if several else 0, "dense": m if several else 0,  # priorities, soft goals
            "free": min(m, nu) if several else 0,
        }  # fmt: skip
        return workspace.WORK.zeros(sizes) | {"nodes": self.nodes, "rest": robot.home.copy()}
