"""``plan``: a motion around obstacles.

    avoid = CollisionAvoidance(scene, margin=0.005)
    result = plan(robot, start, goal, collisions=avoid)
    trajectory = result.require()

Two trees of free postures grow from the start and from the goal until they meet (RRT-Connect). The
path is proven free, shortened, timed within the joint limits, and proven again as it is timed.
"""

from __future__ import annotations

import enum
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.budget import Budget
from robot_ik.collision.avoidance import CollisionAvoidance, require_same_robot
from robot_ik.collision.scene import Clearance
from robot_ik.errors import GoalError, OptionError, PlanningError
from robot_ik.geometry import Array, Pose
from robot_ik.goals import Goal, Tolerance
from robot_ik.motion.plan_ends import Contacts, goal_postures
from robot_ik.motion.plan_search import SearchResult, search_path
from robot_ik.motion.trajectory import (
    Trajectory,
    joint_vector,
    motion_limits,
    require_inside,
    require_positive,
)
from robot_ik.motion.waypoints import joined, waypoint_move
from robot_ik.problem import as_goals, check_arguments
from robot_ik.robot import Robot
from robot_ik.solution import COLLIDING, Solution, Status
from robot_ik.solvers.base import Solver

Ints = NDArray[np.int64]


class PlanStatus(enum.Enum):
    """How a plan ended. The value is a description for messages."""

    FOUND = "a path was found"
    NO_PATH = "no path was found within the budget"
    START_BLOCKED = "the start is in collision"
    GOAL_BLOCKED = "the goal is in collision"
    GOAL_UNREACHABLE = "the goal is proven out of reach"
    GOAL_NOT_SOLVED = "no joint angles were found for the goal"


_BUDGET = Budget()
# NumPy takes seeds from 0: a negative seed counts from the end.
_SEEDS = 1 << 62


@dataclass(frozen=True, eq=False)
class Plan:
    """Result of ``plan``.

    Attributes:
        status: How it ended.
        trajectory: The motion; None without a path. Its ``certified`` is True if it is proven.
        corners: (k, nq) the path, straight between its corners; None without a path.
        blocked: The nearest pair at the start or at the goal, by MuJoCo, if that is in collision.
        margin: The required distance, m.
        solution: The solution of a goal in task space that was not met. None otherwise.
        goal_postures: Number of postures of the goal that the search could end at.
        iterations: Random postures that were drawn.
        restarts: Number of searches after the first.
        nodes: Nodes of the last trees: of the start, and of the goal.
        out_of_time: Whether the seconds of the budget ended before its iterations.
        seconds: Wall-clock time of the whole call.
    """

    status: PlanStatus
    margin: float
    trajectory: Trajectory | None = None
    corners: Array | None = None
    blocked: Clearance | None = None
    solution: Solution | None = None
    goal_postures: int = 0
    iterations: int = 0
    restarts: int = 0
    nodes: tuple[int, int] = (0, 0)
    out_of_time: bool = False
    seconds: float = 0.0

    @property
    def found(self) -> bool:
        """Whether there is a path."""
        return self.status is PlanStatus.FOUND

    @property
    def meaning(self) -> str:
        """Description of the status, with pair and distance or with the numbers of the search."""
        if self.blocked is not None and self.blocked.pair is not None:
            first, second = self.blocked.pair
            distance_mm = 1e3 * self.blocked.distance
            if distance_mm < 0.0:
                return f"{self.status.value}: {first} touches {second} by {-distance_mm:.1f} mm"
            return (
                f"{self.status.value}: {first} is {distance_mm:.1f} mm from {second} "
                f"(margin {1e3 * self.margin:.1f} mm)"
            )
        if self.solution is not None and self.status is PlanStatus.GOAL_UNREACHABLE:
            error = self.solution.error
            return (
                f"{self.status.value}; the nearest pose is {1e3 * error.position:.1f} mm and "
                f"{math.degrees(error.angle):.1f} deg from it"
            )
        if self.solution is not None:
            return f"{self.status.value}: {self.solution.meaning}"
        if self.status is PlanStatus.NO_PATH:
            end = "the seconds ended" if self.out_of_time else "the iterations ended"
            return (
                f"{self.status.value}: {end} after {self.iterations} iterations and "
                f"{self.restarts} restarts; the last trees have {self.nodes[0]} nodes from the "
                f"start and {self.nodes[1]} from {self.goal_postures} goal postures"
            )
        return self.status.value

    def require(self) -> Trajectory:
        """Return the motion.

        Raises:
            PlanningError: No motion was found. The message has the reason.
        """
        if self.trajectory is None:
            raise PlanningError(self.meaning, self, hint=_HINTS.get(self.status, ""))
        return self.trajectory

    def __repr__(self) -> str:
        return f"Plan({self.status.name}: {self.meaning}; {1e3 * self.seconds:.1f} ms)"


_HINTS = {
    PlanStatus.NO_PATH: "give a larger budget, another seed, or a smaller margin",
    PlanStatus.START_BLOCKED: "move the arm away first, give the pair as allowed if it may touch "
    "there, or give a smaller margin",
    PlanStatus.GOAL_BLOCKED: "give another goal, give the pair as allowed if it may touch there, "
    "or give a smaller margin",
    PlanStatus.GOAL_NOT_SOLVED: "give another goal or another solver",
}


def plan(
    robot: Robot,
    start: ArrayLike,
    goal: Goal | Sequence[Goal] | Pose | ArrayLike,
    *,
    collisions: CollisionAvoidance,
    allowed: Sequence[Sequence[str]] = (),
    solver: str | Solver = "auto",
    tolerance: Tolerance | None = None,
    budget: Budget | None = None,
    seed: int = 0,
    speed: float = 1.0,
    rate: float = 100.0,
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
) -> Plan:
    """Return a motion from ``start`` to ``goal`` that keeps a margin from all collisions.

    Joints that do not move the tool, such as those of a gripper, move straight from their value at
    the start to that at the goal. Attach a grasped part with ``scene.attached``.

    Args:
        robot: A robot of hinges and slides.
        start: Joint angles (nq,), rad or m for slides.
        goal: Joint angles (nq,), or a goal in task space: a goal, several goals, or a ``Pose`` of
            the tool. In task space any free posture that meets the goal may be the end: all
            branches of a closed form, several solutions of other arms.
        collisions: The condition: the scene, the margin and the pairs.
        allowed: Pairs of names that may touch at the start and at the goal, such as gripper and
            part. They are left and entered by a straight move of the tool.
        solver: Method for a goal in task space: a name in ``SOLVERS`` or a solver.
        tolerance: Of a goal in task space. Default 0.1 mm and 1 mrad.
        budget: Its iterations are random postures. A budget without seconds gives bit-equal
            results for a seed. Its restarts are the searches after the first.
        seed: Seed of the random postures.
        speed: Share of the velocity and acceleration limits to use, above 0 and up to 1.
        rate: Samples a second, Hz.
        velocity_limits: Further limits (nv,), rad/s or m/s. The lower limit counts.
        acceleration_limits: Further limits (nv,), rad/s² or m/s².

    Returns:
        A plan. Its status is FOUND if there is a path. A failure raises no exception.

    Raises:
        UnsupportedJointError: The robot has ball or free joints.
        TrajectoryError: Wrong length, a number that is not finite, or joint angles of the goal
            outside the limits.
        OptionError: The condition is for another robot, or a wrong budget, seed or pair.
        GoalError: The goal does not fit the robot.
        UnknownPartError: A pair names a part that does not exist.
    """
    began = time.perf_counter()
    check_arguments(robot, tolerance, budget, seed)
    require_same_robot(robot, collisions)
    first = joint_vector(robot, start, "start")
    limits = motion_limits(robot, speed, velocity_limits, acceleration_limits)
    require_positive("rate", rate, "Hz")
    contacts = Contacts.of(collisions, _checked_pairs(allowed))
    task_goals = _task_goals(goal)
    goal_q = None
    if task_goals is None:
        goal_q = joint_vector(robot, goal, "goal")  # type: ignore[arg-type]
        require_inside(robot, goal_q)
    seed = int(seed) % _SEEDS
    planner = _Planner(robot, contacts, limits, rate, budget or _BUDGET, seed)
    if not contacts.rest.free(first):
        result = planner.blocked(PlanStatus.START_BLOCKED, first)
    elif task_goals is None:
        result = planner.to_postures(first, np.array([goal_q]), np.zeros(0, dtype=np.int64))
    else:
        ends = goal_postures(
            robot, task_goals, first, contacts.rest, solver, tolerance or Tolerance(), seed
        )
        if len(ends.rows):
            result = planner.to_postures(first, ends.rows, ends.moved)
        else:
            result = planner.unmet(ends.solution)
    return replace(result, seconds=time.perf_counter() - began)


def _checked_pairs(allowed: Any) -> tuple[tuple[str, str], ...]:
    """Return the pairs as tuples; ``CollisionAvoidance`` checks the names."""
    is_list = np.iterable(allowed) and not isinstance(allowed, str)
    pairs = list(allowed) if is_list else [allowed]
    if any(isinstance(pair, str) or np.size(pair) != 2 for pair in pairs):
        raise OptionError("allowed", f"{allowed!r}", 'pairs of names: [("gripper", "part")]')
    return tuple((first, second) for first, second in pairs)


def _task_goals(goal: Any) -> list[Goal] | None:
    """Return the goals of a goal in task space; None for joint angles."""
    if isinstance(goal, Goal | Pose):
        return as_goals(goal)
    listed = list(goal) if np.iterable(goal) and not isinstance(goal, str) else [goal]
    if listed and all(isinstance(item, Goal) for item in listed):
        return listed
    if any(isinstance(item, Goal | Pose) for item in listed) or goal is None:
        raise GoalError(
            f"the goal is {goal!r}", hint="give joint angles (nq,), a Pose of the tool or goals"
        )
    return None


@dataclass(frozen=True, eq=False)
class _Planner:
    """Arguments shared by the steps of one call of ``plan``.

    Attributes:
        robot: The robot.
        contacts: The conditions at the ends and between them.
        limits: Velocity and acceleration limits (nv,).
        rate: Samples a second, Hz.
        budget: The budget.
        seed: The seed.
    """

    robot: Robot
    contacts: Contacts
    limits: tuple[Array, Array]
    rate: float
    budget: Budget
    seed: int

    def blocked(self, status: PlanStatus, q: Array, solution: Solution | None = None) -> Plan:
        """Return the result for an end (nq,) that is in collision."""
        rest = self.contacts.rest
        clearance = rest.clearance(q)
        if clearance.distance >= rest.margin:
            # Only the pairs that may touch are in contact, and no retreat was found.
            clearance = self.contacts.collisions.clearance(q)
        return Plan(status, rest.margin, blocked=clearance, solution=solution)

    def unmet(self, solution: Solution) -> Plan:
        """Return the result for a goal in task space that no free posture meets."""
        if solution.status in COLLIDING:
            return self.blocked(PlanStatus.GOAL_BLOCKED, solution.q, solution)
        proven = solution.status is Status.UNREACHABLE
        status = PlanStatus.GOAL_UNREACHABLE if proven else PlanStatus.GOAL_NOT_SOLVED
        return Plan(status, self.contacts.collisions.margin, solution=solution)

    def to_postures(self, start: Array, postures: Array, moved: Ints) -> Plan:
        """Return a plan to one of some postures.

        Args:
            start: Joint angles (nq,).
            postures: Postures (g, nq) of the goal, the preferred one first.
            moved: Indices in q (m,) of joints that move the goal, beside those of the tool.
        """
        free = self.contacts.rest.free(postures)
        if not free.any():
            return self.blocked(PlanStatus.GOAL_BLOCKED, postures[0])
        departure = self.contacts.way_out(start)
        if departure is None:
            return self.blocked(PlanStatus.START_BLOCKED, start)
        arrivals = [self.contacts.way_out(q) for q in postures[free]]
        ways = [way for way in arrivals if way is not None]
        if not ways:
            return self.blocked(PlanStatus.GOAL_BLOCKED, postures[free][0])
        begin = departure[-1]
        roots = np.array([way[-1] for way in ways])
        box = self._box(np.vstack([begin, roots]), moved)
        collisions = self.contacts.collisions
        search = search_path(collisions, begin, roots, box, self.budget, self.seed)
        path = search.corners
        if path is None:
            return self._result(PlanStatus.NO_PATH, search, len(roots))
        reached = int(np.argmin(np.abs(roots - path[-1]).max(axis=1)))
        result = self._result(PlanStatus.FOUND, search, len(roots))
        return self._with_motion(result, departure, path, ways[reached][::-1])

    def _box(self, ends: Array, moved: Ints) -> tuple[Array, Array]:
        """Return the limits (nq,) of the postures of the search.

        Joints that move neither the tool nor the goal stay between their values at the ends (n,
        nq).
        """
        tree = self.robot.tree
        node, _ = self.robot.attachment()
        is_moved = np.zeros(tree.nq, dtype=bool)
        is_moved[tree.qadr[tree.ancestors(node)]] = True
        is_moved[moved] = True
        lower = np.where(is_moved, tree.sample_lower, ends.min(axis=0))
        upper = np.where(is_moved, tree.sample_upper, ends.max(axis=0))
        return lower, upper

    def _with_motion(self, result: Plan, departure: Array, path: Array, arrival: Array) -> Plan:
        """Return a plan with its trajectory: out of a contact, along the path, into a contact."""
        rest = self.contacts.rest
        stages = [(path, self.contacts.collisions)]
        if len(departure) > 1:
            stages.insert(0, (departure, rest))
        if len(arrival) > 1:
            stages.append((arrival, rest))
        moves = [
            waypoint_move(self.robot, corners, condition, self.limits, self.rate)
            for corners, condition in stages
        ]
        trajectory = joined(moves, certified=all(move.certified for move in moves))
        corners = np.vstack([departure[:-1], path, arrival[1:]])
        return replace(result, trajectory=trajectory, corners=corners)

    def _result(self, status: PlanStatus, search: SearchResult, roots: int) -> Plan:
        """Return a plan with the numbers of a search."""
        return Plan(
            status,
            self.contacts.collisions.margin,
            goal_postures=roots,
            iterations=search.iterations,
            restarts=search.restarts,
            nodes=search.nodes,
            out_of_time=search.out_of_time,
        )
