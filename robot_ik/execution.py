"""The run-time loops: ``execute`` plays a trajectory, ``follow`` follows goals.

Both wait with a ``Schedule``, so delays do not add up. An exception, KeyboardInterrupt too, leaves
the loop at once and nothing more is sent. The exit policy of the arm decides what the arm then
does.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.budget import Budget
from robot_ik.errors import TrajectoryError, distinct_texts
from robot_ik.geometry import is_real
from robot_ik.goals import Goal
from robot_ik.motion.sources import Goals
from robot_ik.motion.trajectory import Trajectory, joint_vector, motion_limits, require_positive
from robot_ik.ports import Array, Clock, GoalSource, JointSink, JointSource, RealClock
from robot_ik.problem import Problem, check_arguments
from robot_ik.schedule import Schedule, regular
from robot_ik.solvers import make_solver

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.goals import Tolerance
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution
    from robot_ik.solvers.base import Solver
    from robot_ik.solvers.limited_step import LimitedStep


LONGEST_RUN = 1e9
"""Seconds that a run may be requested to last."""

START_TOLERANCE = 0.02
"""rad or m. Largest distance of the arm from the first sample. A loaded servo sags by less."""

TICK_ITERATIONS = 1000
"""Iterations of a tick. A few are enough from the last command; the rest is for restarts."""

TICK_RESTARTS = 100
"""Random restarts of a tick."""

BETTER_PERIOD = 0.2
"""Seconds between searches for a branch with a better orientation."""

BETTER_ANGLE = math.radians(1.0)
"""rad. A branch is better if its orientation error is smaller by this."""

SAME_POSITION = 1e-6
"""m. Positions whose errors differ by less are equally near."""

SINGLE_SAMPLE_PERIOD = 0.01
"""Seconds between the repeated samples of a trajectory of one sample, which has no rate."""

COUNT_ROUNDING = 1e-9
"""Rounding error of a number of ticks."""


@dataclass(frozen=True)
class Tick:
    """One tick of ``execute``, for a progress display.

    Attributes:
        index: Index of the tick, from 0.
        count: Number of ticks, with those for settling.
        time: Seconds since the first tick.
        commanded: The command (nq,).
        measured: The measured joint angles (nq,) after the command. None without a source.
    """

    index: int
    count: int
    time: float
    commanded: Array
    measured: Array | None


@dataclass(frozen=True, eq=False, repr=False)
class Execution:
    """Record of a trajectory that was played.

    Attributes:
        joints: Names of the columns.
        times: Times (n,) at which the samples were sent, seconds since the first tick.
        commanded: The commands (n, nq).
        measured: The measured joint angles (n, nq) after each command. None without a source.
        measured_times: Times (n,) of the measurements, seconds since the first tick.
        overruns: Number of ticks that were late by a period or more.
    """

    joints: tuple[str, ...]
    times: Array
    commanded: Array
    measured: Array | None
    measured_times: Array | None
    overruns: int

    def __repr__(self) -> str:
        error = self.tracking_error
        largest = "" if error is None else f", tracking error up to {error.max():.3g}"
        return (
            f"Execution({len(self.times)} ticks of {len(self.joints)} joints in "
            f"{self.duration:.3g} s, {self.overruns} overruns{largest})"
        )

    @property
    def duration(self) -> float:
        """Seconds from the first tick to the last."""
        return float(self.times[-1] - self.times[0])

    @property
    def rate(self) -> float:
        """Achieved ticks a second. 0 for a single tick."""
        return (len(self.times) - 1) / self.duration if self.duration > 0.0 else 0.0

    @property
    def tracking_error(self) -> Array | None:
        """Largest distance (nq,) of measured from commanded, rad or m. None without a source."""
        if self.measured is None:
            return None
        return np.asarray(np.abs(self.measured - self.commanded).max(axis=0))

    @property
    def final_error(self) -> Array | None:
        """Measured minus commanded (nq,) at the last tick, rad or m. None without a source."""
        if self.measured is None:
            return None
        return np.asarray(self.measured[-1] - self.commanded[-1])

    @property
    def measured_trajectory(self) -> Trajectory | None:
        """The motion of the arm by its own sensors. None without a source."""
        if self.measured is None or self.measured_times is None:
            return None
        is_new = np.concatenate([[True], np.diff(self.measured_times) > 0.0])
        return Trajectory(self.measured_times[is_new], self.measured[is_new], self.joints)


@dataclass(frozen=True)
class FollowTick:
    """One tick of ``follow``.

    Attributes:
        index: Index of the tick, from 0.
        time: Seconds since the first tick.
        goal: The goal of the source. None while the position is kept.
        solution: The solution. None while the position is kept.
        q: The command (nq,): towards ``solution.q``, as far as the joints may move in one period.
        capped: Whether the command stopped short of ``solution.q``.
        better: A solution on another branch whose orientation error is smaller by
            ``BETTER_ANGLE`` or more. It is searched a few times a second, and only for arms with
            five joints.
        measured: The measured joint angles (nq,) after the command. None without a source.
    """

    index: int
    time: float
    goal: Any
    solution: Solution | None
    q: Array
    capped: bool
    measured: Array | None
    better: Solution | None = None


@dataclass(eq=False, repr=False)
class FollowReport:
    """Record of a run of ``follow``. Its size does not grow with time.

    Attributes:
        joints: Names for the vectors below.
        q: The last command (nq,).
        largest_step: Largest change (nq,) of the command from one tick to the next, rad or m.
        ticks: Number of ticks.
        held: Number of ticks without a goal, in which the last command was repeated.
        capped: Number of ticks whose step was shortened by a speed limit.
        statuses: Number of solutions by the name of their ``Status``.
        duration: Seconds from the first tick to the last.
        overruns: Number of ticks that were late by a period or more.
        last: The last solution. None if the source never gave a goal.
        better: The last ``FollowTick.better`` that is not None.
        tracking_error: Largest distance (nq,) of measured from commanded. None without a source.
    """

    joints: tuple[str, ...]
    q: Array
    largest_step: Array
    ticks: int = 0
    held: int = 0
    capped: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    duration: float = 0.0
    overruns: int = 0
    last: Solution | None = None
    better: Solution | None = None
    tracking_error: Array | None = None

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in self.statuses.items())
        return (
            f"FollowReport({self.ticks} ticks in {self.duration:.3g} s: {counts or 'no goal'}; "
            f"{self.held} held, {self.capped} capped, {self.overruns} overruns)"
        )

    @property
    def rate(self) -> float:
        """Achieved ticks a second. 0 for fewer than two ticks."""
        return (self.ticks - 1) / self.duration if self.duration > 0.0 else 0.0

    @property
    def solved(self) -> int:
        """Number of ticks whose solution was within tolerance."""
        return self.statuses.get("CONVERGED", 0)


def clock_of(clock: Clock | None, source: JointSource | None, sinks: Sequence[JointSink]) -> Clock:
    """Return the given clock, else the clock of the arm, else the clock of the machine.

    A simulated arm runs on its own clock and would not move on the clock of the machine.
    """
    if clock is not None:
        return clock
    for part in (source, *sinks):
        arm_clock: Clock | None = getattr(part, "clock", None)
        if arm_clock is not None:
            return arm_clock
    return RealClock()


def execute(
    trajectory: Trajectory,
    sinks: Sequence[JointSink],
    *,
    source: JointSource | None = None,
    clock: Clock | None = None,
    on_tick: Callable[[Tick], None] | None = None,
    start_tolerance: float = START_TOLERANCE,
    settle: float = 0.0,
) -> Execution:
    """Send every sample of a trajectory at its time to every sink.

    Args:
        trajectory: The trajectory. Each sample is one tick.
        sinks: Each sink receives each sample, in order. ``q`` is read-only.
        source: Usually the arm. It is read once before the start and after every tick.
        clock: None takes the clock of an arm among ``source`` and ``sinks``, else the machine's.
        on_tick: Called after each tick. It must be quick.
        start_tolerance: Largest distance of the arm from the first sample, rad or m.
        settle: Seconds for which the last sample is repeated, so that servos can arrive.

    Raises:
        TrajectoryError: The arm is not at the start of the trajectory, or an argument is wrong.
            Nothing was sent.
    """
    given: object = trajectory
    if not isinstance(given, Trajectory):
        hint = "joint_move and line_move return one"
        raise TrajectoryError(f"{trajectory!r} is not a trajectory", hint=hint)
    _require_sinks(sinks)
    clock = clock_of(clock, source, sinks)
    if source is not None:
        _require_start(trajectory, source.read().q, start_tolerance)
    due, commanded = _with_settling(trajectory, settle)
    count = len(due)
    schedule = Schedule(clock)
    times = np.zeros(count)
    measured = np.zeros(commanded.shape)
    measured_times = np.zeros(count)
    begin = 0.0
    samples = zip(due.tolist(), commanded, strict=True)
    for k, (now, q) in enumerate(schedule.ticks(samples)):
        if k == 0:
            begin = now
        times[k] = now - begin
        for sink in sinks:
            sink.send(q, now)
        if source is not None:
            reading = source.read()
            measured[k] = reading.q
            measured_times[k] = reading.time - begin
        if on_tick is not None:
            sample = measured[k].copy() if source is not None else None
            on_tick(Tick(k, count, times[k], q, sample))
    return Execution(
        trajectory.joints,
        times,
        commanded,
        measured=None if source is None else measured,
        measured_times=None if source is None else measured_times,
        overruns=schedule.overruns,
    )


def _require_sinks(sinks: object) -> None:
    """Raise ``TrajectoryError`` unless they are a list of sinks; a single sink is not one."""
    if not isinstance(sinks, Sequence) or not all(isinstance(sink, JointSink) for sink in sinks):
        hint = "[arm]: each has send(q, now)"
        raise TrajectoryError(f"{sinks!r} is not a list of sinks", hint=hint)


def _with_settling(trajectory: Trajectory, settle: float) -> tuple[Array, Array]:
    """Return due times (n,) from 0 and read-only samples (n, nq), with the last one repeated."""
    if not is_real(settle, 0.0, LONGEST_RUN):
        hint = "give 0 or a finite time in seconds"
        raise TrajectoryError(f"settle is {settle!r} s", hint=hint)
    due = trajectory.times - trajectory.times[0]
    commanded = trajectory.q
    period = float(due[-1] - due[-2]) if len(due) > 1 else SINGLE_SAMPLE_PERIOD
    extra = int(np.ceil(settle / period - COUNT_ROUNDING))
    if extra:
        due = np.concatenate([due, due[-1] + period * np.arange(1, extra + 1)])
        commanded = np.concatenate([commanded, np.repeat(commanded[-1:], extra, axis=0)])
    commanded.flags.writeable = False
    return due, commanded


def _require_start(trajectory: Trajectory, q: Array, tolerance: float) -> None:
    """Raise ``TrajectoryError`` unless the measured ``q`` (nq,) is at the start of a trajectory."""
    if not is_real(tolerance, 0.0, math.inf):
        hint = "give 0 or more, rad (m for slides)"
        raise TrajectoryError(f"start_tolerance is {tolerance!r}", hint=hint)
    first = trajectory.q[0]
    if np.shape(q) != first.shape or not np.isfinite(q).all():
        raise TrajectoryError(
            f"the arm measures {np.asarray(q).tolist()}; the trajectory has {len(first)} joints",
            hint="play a trajectory that was planned for this arm",
        )
    distance = np.abs(q - first)
    k = int(np.argmax(distance))
    if distance[k] > tolerance:
        planned, measured = distinct_texts(first[k], q[k], digits=4)
        raise TrajectoryError(
            f"the trajectory starts at {planned} of joint {trajectory.joints[k]!r}, but the arm "
            f"measures {measured}; the largest allowed distance is {tolerance:g}; nothing was sent",
            hint="plan from the measured position: joint_move(robot, arm.read().q, …)",
        )


def follow(
    robot: Robot,
    goals: GoalSource[Goals],
    *,
    sinks: Sequence[JointSink],
    solver: str | Solver = "auto",
    start: ArrayLike | None = None,
    tolerance: Tolerance | None = None,
    rate: float = 100.0,
    clock: Clock | None = None,
    duration: float | None = None,
    speed: float = 1.0,
    until: Callable[[FollowTick], bool] | None = None,
    source: JointSource | None = None,
    on_tick: Callable[[FollowTick], None] | None = None,
    collisions: CollisionAvoidance | None = None,
    **options: Any,
) -> FollowReport:
    """Poll a goal, solve it from the last command and send the result, ``rate`` times a second.

    Each joint moves at most ``speed`` times its velocity limit. If one joint would be too fast, all
    are slowed by the same factor, so the path stays straight. A solution that did not converge is
    followed too, because it is the nearest solution known. The loop ends when ``duration`` is over
    or ``until`` returns True.

    An arm with five joints stays on its branch while the branch goes on, even if another branch
    has a better orientation. ``FollowTick.better`` is the pose of that branch.

    With ``collisions`` each tick is one step of differential inverse kinematics that keeps the
    margin: the joints slow down in front of an obstacle and slide along it, and move away from an
    obstacle that comes nearer (``scene.move``). ``solver`` is not used then. The status of a tick
    is CONVERGED at the goal, BLOCKED_BY_COLLISION if collisions hold every step back, and otherwise
    ITERATION_LIMIT.

    Goals may change their targets and weights in each tick. A goal of another kind or frame, or
    with a weight that becomes zero or was zero, builds a new problem, which compiles its method
    once on a machine. Call ``warm_up`` before the loop to avoid this pause.

    Args:
        robot: From ``load_robot``.
        goals: Where goals come from. None from it repeats the last command.
        sinks: Each sink receives each command, in order. ``q`` is read-only.
        solver: A name in ``SOLVERS`` or a solver.
        start: (nq,) where the arm is; None reads it from ``source`` once, unclipped.
        tolerance: When a solution counts as converged.
        rate: Ticks a second, Hz.
        clock: None takes the clock of an arm among ``source`` and ``sinks``, else the machine's.
        duration: Seconds, or None.
        speed: Part of the velocity limits to use, above 0 and up to 1.
        until: Called after each tick; True ends the loop.
        source: Usually the arm: read after every tick.
        on_tick: Called after each tick. It must be quick.
        collisions: Condition that every command must keep.
        **options: Options of the solver by name.

    Raises:
        TrajectoryError: Neither ``start`` nor ``source``, or malformed options; nothing was sent.
        UnknownSolverError, OptionError: There is no such solver or option; nothing was sent.
    """
    check_arguments(robot, tolerance, None, 0)
    method = make_solver(solver, **options)
    _require_sinks(sinks)
    clock = clock_of(clock, source, sinks)
    require_positive("rate", rate, "Hz")
    if duration is not None and not is_real(duration, 0.0, LONGEST_RUN):
        hint = "give 0 or a finite time in seconds"
        raise TrajectoryError(f"duration is {duration!r} s", hint=hint)
    if start is None:
        if source is None:
            hint = "give start=q or source=arm"
            raise TrajectoryError("the start of the arm is unknown", hint=hint)
        start = source.read().q
    first = joint_vector(robot, start, "start")
    count = None
    if duration is not None:
        count = max(1, int(np.ceil(duration * rate - COUNT_ROUNDING)))
    largest_step = motion_limits(robot, speed)[0] / rate
    following = _FollowState(robot, method, tolerance, first, largest_step, rate, collisions)
    report = following.report
    schedule = Schedule(clock)
    begin = 0.0
    for now, k in schedule.ticks(regular(rate, count)):
        if k == 0:
            begin = now
        goal = goals.poll(now)
        solution, capped = following.step(goal)
        better = following.better_branch(solution)
        for sink in sinks:
            sink.send(report.q, now)
        measured = None if source is None else following.compare(source.read().q)
        report.duration = now - begin
        report.overruns = schedule.overruns
        tick = FollowTick(k, now - begin, goal, solution, report.q, capped, measured, better)
        if on_tick is not None:
            on_tick(tick)
        if until is not None and until(tick):
            break
    return report


class _FollowState:
    """State of ``follow``: its problem, and the report, whose ``q`` is the command."""

    def __init__(
        self,
        robot: Robot,
        solver: Solver,
        tolerance: Tolerance | None,
        start: Array,
        step: Array,
        rate: float,
        collisions: CollisionAvoidance | None,
    ) -> None:
        self._robot = robot
        self._collisions = collisions
        self._limited: LimitedStep | None = None
        if collisions is not None:
            # Imported here, because it loads the compiled collision checks: 0.05 s.
            from robot_ik.collision.avoidance import require_same_robot

            require_same_robot(robot, collisions)
        self._solver = solver
        self._tolerance = tolerance
        self._largest_allowed = step
        self._ticks_between_searches = max(1, round(rate * BETTER_PERIOD))
        self._problem: Problem | None = None
        self._search: Problem | None = None
        self._kinds: Sequence[object] = []
        self.report = FollowReport(robot.joints, _frozen(start), np.zeros_like(start))

    def problem_for(self, goals: Sequence[Goal]) -> Problem:
        """Return a problem with these goals: the last one, if targets and weights alone differ."""
        budget = Budget(iterations=TICK_ITERATIONS, restarts=TICK_RESTARTS)
        kinds = [goal.kind for goal in goals]
        if self._problem is not None and kinds == self._kinds:
            self._problem.replace_goals(goals)
            return self._problem
        self._problem = Problem(
            self._robot,
            goals,
            solver=self._solver,
            tolerance=self._tolerance,
            budget=budget,
            keep_branch=True,
        )
        self._search = None
        if self._problem.has_branches:
            self._search = Problem(
                self._robot, goals, solver=self._solver, tolerance=self._tolerance, budget=budget
            )
        self._kinds = kinds
        if self._collisions is not None:
            # Imported here, because it loads the compiled collision checks: 0.05 s.
            from robot_ik.solvers.limited_step import LimitedStep

            self._limited = LimitedStep(self._problem, self._collisions, self._largest_allowed)
        return self._problem

    def step(self, goal: Goals | None) -> tuple[Solution | None, bool]:
        """Move the command towards ``goal``; return the solution, and if the step was capped."""
        report = self.report
        report.ticks += 1
        if goal is None:
            report.held += 1
            return None, False
        problem = self.problem_for([goal] if isinstance(goal, Goal) else list(goal))
        if self._limited is not None:
            solution = self._limited.solve(problem, report.q)
        else:
            solution = problem.solve(report.q)
        report.last = solution
        report.statuses[solution.status.name] += 1
        difference = solution.q - report.q
        change = np.abs(difference)
        excess = float((change / self._largest_allowed).max())
        if not math.isfinite(excess):  # NUMERICAL
            return solution, False
        q = solution.q
        is_capped = excess > 1.0
        if is_capped:
            q = report.q + difference / excess
            change = np.abs(q - report.q)
        report.largest_step = np.maximum(report.largest_step, change)
        report.q = _frozen(q)
        report.capped += is_capped
        return solution, is_capped

    def better_branch(self, solution: Solution | None) -> Solution | None:
        """Return a solution on another branch with a smaller orientation error, or None."""
        report = self.report
        if self._search is None or solution is None:
            return None
        if (report.ticks - 1) % self._ticks_between_searches:
            return None
        self._search.replace_goals(solution.goals)
        other = self._search.solve(report.q)
        is_better = other.error.angle < solution.error.angle - BETTER_ANGLE
        if not is_better or other.error.position > solution.error.position + SAME_POSITION:
            return None
        report.better = other
        return other

    def compare(self, measured: Array) -> Array:
        """Record the distance of ``measured`` (nq,) from the command, and return a copy."""
        distance = np.abs(measured - self.report.q)
        largest = self.report.tracking_error
        self.report.tracking_error = distance if largest is None else np.maximum(largest, distance)
        return np.array(measured, dtype=float)


def _frozen(q: ArrayLike) -> Array:
    """Return a read-only copy. A sink that wrote into the command would move the arm."""
    copy = np.array(q, dtype=float)
    copy.flags.writeable = False
    return copy
