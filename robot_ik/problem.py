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
from numpy.typing import ArrayLike

from robot_ik.compiled_problem import CompiledProblem, length_of, moved_goal, target_row
from robot_ik.errors import GoalError, InvalidGoalError, ProblemInUseError
from robot_ik.geometry import REAL, Pose
from robot_ik.goals import Array, Goal, Tolerance
from robot_ik.kernels import workspace
from robot_ik.kernels.residuals import OF_JOINTS
from robot_ik.robot import Robot, require_robot

if TYPE_CHECKING:
    from robot_ik.targets import Mover

# What the compiled loops can count to.
_MOST = 1 << 62
WHOLE = int | np.integer


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
        counts: list[Any] = [self.iterations, 0 if self.restarts is None else self.restarts]
        for count in counts:
            if not (isinstance(count, WHOLE) and 0 <= count <= _MOST):
                raise InvalidGoalError(
                    f"a budget of iterations or restarts must be zero or more, at most 2^62, not {count!r}"
                )
        seconds: Any = self.seconds
        if seconds is not None and not (isinstance(seconds, REAL) and seconds >= 0):
            raise InvalidGoalError(f"a budget of seconds must be zero or more, not {self.seconds!r}")


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


class Problem:
    """Goals of one robot in compiled form, with the work space of the solve.

    Threads may use it in turn; a call that begins while another is under way is refused.

    Attributes:
        robot, tolerance, budget, seed: As given.
        trace: Whether to keep a row for every step.
        given: The goals as they were last given; ``target`` has what moved since, ``goals`` both together.
        compiled: The owner of all arrays that kernels see.
        whole: Which goals are a whole position, orientation or pose of a frame.
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
        rows = workspace.TRACE_CAPACITY if trace else 0
        compiled = self.compiled = CompiledProblem(robot, self.given, self.tolerance, rows)
        self.made, self.token = compiled.made, compiled.token
        self.arrays, self.nodes = compiled.arrays, compiled.nodes
        self.target, self.dofs = compiled.goal_arrays["target"], compiled.goal_arrays["dofs"]
        self.weights = compiled.goal_arrays["asked"][:, :2]  # on metres (over the length) and on radians
        self.whole = [goal.rows.whole for goal in self.given]

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goals, with the targets they have now."""
        return tuple(moved_goal(goal, row) for goal, row in zip(self.given, self.target, strict=True))

    def __repr__(self) -> str:
        goals = ", ".join(map(repr, self.goals[:4]))
        more = f", … {len(self.given) - 4} more" if len(self.given) > 4 else ""
        rest = f"{self.tolerance!r}, {self.budget!r}, seed={self.seed}, trace={self.trace}"
        return f"Problem({self.robot.name!r}, [{goals}{more}], {rest})"

    def length(self, goal: Goal) -> float:
        """Metres that count as much as one radian for a goal."""
        return length_of(self.robot, goal)

    @property
    def features(self) -> frozenset[str]:
        """What the problem asks for beyond goals: ``couplings``, ``stiffness``, ``priorities``, ``soft``."""
        arrays, soft = self.compiled.goal_arrays, any(goal.soft for goal in self.given)
        found = {
            "couplings": (self.robot.tree.coupled[:, 1] >= 0).any() and len(arrays["coupled"]),
            "soft": soft,
            "priorities": not soft and len({goal.priority for goal in self.given}) > 1,
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
        if goal.rows.of == OF_JOINTS:
            goal.fill(self.compiled.goal_arrays, index, self.robot)
        self.target[index] = target_row(goal)
        self.given = (*self.given[:index], goal, *self.given[index + 1 :])

    def exchange(self, goals: Sequence[Goal]) -> None:
        """Takes goals with the same ``goal_kind`` in place of all: other targets, other sizes of weights."""
        for index, (mine, goal) in enumerate(zip(self.given, goals, strict=True)):
            if goal.weights != mine.weights:
                metres, radians = goal.weights
                weight = metres / self.length(goal), radians
                self.weights[index] = self.compiled.goal_arrays["weight"][index] = weight
            self.replace_goal(index, goal)


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
    if not isinstance(seed, WHOLE):
        raise InvalidGoalError(f"a seed is a whole number, not {seed!r}")
