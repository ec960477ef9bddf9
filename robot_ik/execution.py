"""The run-time loops: `execute` plays a trajectory, `follow` follows a goal.

Both run on absolute deadlines, so lateness below one period is caught up and never adds up.
Neither hurries: after a longer stall the rest of the schedule moves, because two samples sent at
once are a jump to a servo.  An exception (KeyboardInterrupt too) leaves the loop at once and nothing
more is sent; what the arm does then is its own exit policy.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import RobotIkError, TrajectoryError, apart
from robot_ik.geometry import is_real
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.motion.sources import Goals
from robot_ik.motion.trajectory import Trajectory, joint_vector, motion_limits, require_positive
from robot_ik.ports import Array, Clock, GoalSource, JointSink, JointSource, RealClock

if TYPE_CHECKING:
    from robot_ik.goals import Tolerance
    from robot_ik.robot import Robot
    from robot_ik.solution import Solution
    from robot_ik.solvers.base import Solver


@dataclass(frozen=True)
class Tick:
    """One tick of `execute`, for a progress display.

    Attributes:
        index: From 0; ``count`` ticks in all, settling included.
        time: Seconds since the first tick.
        commanded: (nq,) what was sent.
        measured: (nq,) what the source then read, or None without a source.
    """

    index: int
    count: int
    time: float
    commanded: Array
    measured: Array | None


@dataclass(frozen=True, eq=False, repr=False)
class Execution:
    """What happened while a trajectory was played.

    Attributes:
        joints: Column names.
        times: (n,) seconds since the first tick at which samples were really sent.
        commanded: (n, nq) what was sent.
        measured: (n, nq) what the source read after each, or None without a source.
        measured_times: (n,) seconds since the first tick at which those were sampled.
        overruns: Ticks that came a whole period late or more.
    """

    joints: tuple[str, ...]
    times: Array
    commanded: Array
    measured: Array | None
    measured_times: Array | None
    overruns: int

    def __repr__(self) -> str:
        error = self.tracking_error
        off = "" if error is None else f", at most {error.max():.3g} off"
        return (
            f"Execution({len(self.times)} ticks of {len(self.joints)} joints in {self.duration:.3g} s, "
            f"{self.overruns} overruns{off})"
        )

    @property
    def duration(self) -> float:
        """Seconds from the first tick to the last."""
        return float(self.times[-1] - self.times[0])

    @property
    def rate(self) -> float:
        """Achieved ticks a second; 0 for a single tick."""
        return (len(self.times) - 1) / self.duration if self.duration > 0.0 else 0.0

    @property
    def tracking_error(self) -> Array | None:
        """(nq,) largest distance of measured from commanded, rad or m; None without a source."""
        if self.measured is None:
            return None
        return np.asarray(np.abs(self.measured - self.commanded).max(axis=0))

    @property
    def final_error(self) -> Array | None:
        """(nq,) measured minus commanded at the last tick, rad or m; None without a source."""
        return None if self.measured is None else np.asarray(self.measured[-1] - self.commanded[-1])

    @property
    def measured_trajectory(self) -> Trajectory | None:
        """What the arm did, by its own sensors; None without a source."""
        if self.measured is None or self.measured_times is None:
            return None
        fresh = np.concatenate([[True], np.diff(self.measured_times) > 0.0])
        return Trajectory(self.measured_times[fresh], self.measured[fresh], self.joints)


@dataclass(frozen=True)
class FollowTick:
    """One tick of `follow`.

    Attributes:
        index: From 0.
        time: Seconds since the first tick.
        goal: What the source gave; None while holding.
        solution: What the solver found, None while holding.
        q: (nq,) what was sent: towards ``solution.q`` as far as the joints are allowed in one period.
        capped: True when that was less than the whole distance.
        measured: (nq,) what the source of joints then read, or None without one.
    """

    index: int
    time: float
    goal: Any
    solution: Solution | None
    q: Array
    capped: bool
    measured: Array | None


@dataclass(eq=False, repr=False)
class FollowReport:
    """What happened while a goal was followed.  Its size does not grow with time.

    Attributes:
        joints: Names for the vectors below.
        ticks: How many; each was either solved or held.
        held: Ticks without a goal: the last command was repeated.
        capped: Ticks on which a joint would have been too fast; the step was shortened.
        statuses: How often each `Status` came out, by its name.
        duration: Seconds from the first tick to the last.
        overruns: Ticks that came a whole period late or more.
        q: (nq,) last command.
        last: Last solution, None when there never was a goal.
        largest_step: (nq,) largest change of a command from one tick to the next, rad or m.
        tracking_error: (nq,) largest distance of measured from commanded, None without a source.
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
    tracking_error: Array | None = None

    def __repr__(self) -> str:
        ends = ", ".join(f"{count} {name}" for name, count in self.statuses.items())
        return (
            f"FollowReport({self.ticks} ticks in {self.duration:.3g} s: {ends or 'no goal'}; "
            f"{self.held} held, {self.capped} capped, {self.overruns} overruns)"
        )

    @property
    def rate(self) -> float:
        """Achieved ticks a second; 0 for fewer than two."""
        return (self.ticks - 1) / self.duration if self.duration > 0.0 else 0.0

    @property
    def solved(self) -> int:
        """Ticks whose solution met the tolerance."""
        return self.statuses.get("CONVERGED", 0)


class Schedule:
    """Deadlines a period apart that yield to a stall instead of bunching up.

    Attributes:
        overruns: Ticks that came a whole period late or more.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.origin = clock.now()
        self.overruns = 0

    def wait(self, due: float, period: float) -> float:
        """Sleeps until ``due`` seconds after the origin; the time on the clock then."""
        self.clock.sleep_until(self.origin + due)
        now = self.clock.now()
        late = now - (self.origin + due)
        if period > 0.0 and late >= period:
            self.overruns += 1
            self.origin += late
        return now


def clock_of(clock: Clock | None, source: JointSource | None, sinks: Sequence[JointSink]) -> Clock:
    """The given clock, else that of the arm: a simulated arm stands still on the machine's clock."""
    if clock is not None:
        return clock
    for part in (source, *sinks):
        own: Clock | None = getattr(part, "clock", None)
        if own is not None:
            return own
    return RealClock()


_LONGEST = 1e9
"""s that a run may be asked to last."""
START_TOLERANCE = 0.02
"""rad or m: how far the arm may be from a trajectory's first sample; a servo holding a load sags by less."""

# Steps a tick may take: a few are enough from the last command; the rest is for restarts out of a dead end.
_TICK_ITERATIONS, _TICK_RESTARTS = 1000, 100


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
    """Sends every sample of ``trajectory`` at its time to every sink.

    Args:
        trajectory: Its own sampling is the tick.
        sinks: Each gets each sample, in order; `q` is read-only.
        source: Usually the arm: read once before the start, and after every tick.
        clock: None takes the one that an arm among ``source`` and ``sinks`` runs on, else the machine's.
        on_tick: Called after each tick; must be quick.
        start_tolerance: How far the measured arm may be from the first sample, rad or m.
        settle: Seconds for which the last sample is repeated, so that servos can arrive.

    Raises:
        TrajectoryError: The arm is not where the trajectory begins; nothing was sent.
    """
    given: object = trajectory
    if not isinstance(given, Trajectory):
        raise TrajectoryError(f"not a trajectory: {trajectory!r}", hint="joint_move and line_move make one")
    _require_sinks(sinks)
    clock = clock_of(clock, source, sinks)
    if source is not None:
        _require_start(trajectory, source.read().q, start_tolerance)
    due, commanded = _with_settling(trajectory, settle)
    schedule = Schedule(clock)
    times, measured, measured_times = np.zeros(len(due)), np.zeros(commanded.shape), np.zeros(len(due))
    begin = schedule.origin
    for k, q in enumerate(commanded):
        now = schedule.wait(due[k], due[k] - due[k - 1] if k else 0.0)
        begin = now if k == 0 else begin
        times[k] = now - begin
        for sink in sinks:
            sink.send(q, now)
        if source is not None:
            reading = source.read()
            measured[k], measured_times[k] = reading.q, reading.time - begin
        if on_tick is not None:
            on_tick(Tick(k, len(due), times[k], q, measured[k].copy() if source is not None else None))
    return Execution(
        trajectory.joints,
        times,
        commanded,
        measured=None if source is None else measured,
        measured_times=None if source is None else measured_times,
        overruns=schedule.overruns,
    )


def _require_sinks(sinks: object) -> None:
    """Raises ``TrajectoryError`` unless they are a list of sinks: one alone is a likely mistake."""
    if not isinstance(sinks, Sequence) or not all(isinstance(sink, JointSink) for sink in sinks):
        raise TrajectoryError(f"not a list of sinks: {sinks!r}", hint="[arm]: each has send(q, now)")


def _with_settling(trajectory: Trajectory, settle: float) -> tuple[Array, Array]:
    """Due times (n,) from 0 and read-only samples (n, nq), the last one repeated for ``settle`` seconds."""
    if not is_real(settle, 0.0, _LONGEST):
        raise TrajectoryError(f"asked to settle for {settle!r} s", hint="give 0 or a finite time in seconds")
    due, commanded = trajectory.times - trajectory.times[0], trajectory.q
    period = float(due[-1] - due[-2]) if len(due) > 1 else 0.01  # a trajectory of one sample has no rate
    extra = int(np.ceil(settle / period - 1e-9))
    if extra:
        due = np.concatenate([due, due[-1] + period * np.arange(1, extra + 1)])
        commanded = np.concatenate([commanded, np.repeat(commanded[-1:], extra, axis=0)])
    commanded.flags.writeable = False
    return due, commanded


def _require_start(trajectory: Trajectory, q: Array, tolerance: float) -> None:
    """Raises `TrajectoryError` unless the measured ``q`` (nq,) is where ``trajectory`` begins."""
    if not is_real(tolerance, 0.0, math.inf):
        raise TrajectoryError(f"start_tolerance is {tolerance!r}", hint="0 or more, rad (m of slides)")
    first = trajectory.q[0]
    if np.shape(q) != first.shape or not np.isfinite(q).all():
        raise TrajectoryError(
            f"the arm measures {np.asarray(q).tolist()}; the trajectory has {len(first)} joints",
            hint="play a trajectory made for this arm",
        )
    away = np.abs(q - first)
    k = int(np.argmax(away))
    if away[k] > tolerance:
        planned, measured = apart(first[k], q[k], digits=4)
        raise TrajectoryError(
            f"the trajectory begins with {planned} of joint {trajectory.joints[k]!r}, but the arm "
            f"measures {measured}; at most {tolerance:g} apart is allowed; nothing was sent",
            hint="plan from where the arm is: joint_move(robot, arm.read().q, …)",
        )


def follow(
    goal_source: GoalSource[Goals],
    robot: Robot,
    solver: str | Solver,
    sinks: Sequence[JointSink],
    *,
    rate: float = 100.0,
    clock: Clock | None = None,
    duration: float | None = None,
    start: ArrayLike | None = None,
    tolerance: Tolerance | None = None,
    speed: float = 1.0,
    until: Callable[[FollowTick], bool] | None = None,
    source: JointSource | None = None,
    on_tick: Callable[[FollowTick], None] | None = None,
) -> FollowReport:
    """Asks for a goal, solves from the last command, sends; ``rate`` times a second.

    What goals of the tool may need, one out of reach included, is loaded before the loop starts.

    Each joint moves at most ``speed`` times its velocity limit; when one would be too fast all are
    slowed alike, so the path stays straight.  A solution that did not converge is followed too: it is
    the nearest that was found.  Runs until ``duration`` is over or ``until`` says so, else for ever.

    Args:
        goal_source: None from it means: hold, which repeats the last command.
        robot: Whose joints.
        solver: A name of `SOLVERS` or a solver.
        sinks: Each gets each command, in order; `q` is read-only.
        rate: Ticks a second, Hz.
        clock: None takes the one that an arm among ``source`` and ``sinks`` runs on, else the machine's.
        duration: Seconds, or None.
        start: (nq,) where the arm is; None reads it from ``source`` once, unclipped.
        tolerance: When a solution counts as converged.
        speed: Part of the velocity limits to use, above 0 and up to 1.
        until: Asked after each tick; True ends the loop.
        source: Usually the arm: read after every tick.
        on_tick: Called after each tick; must be quick.

    Raises:
        TrajectoryError: Neither ``start`` nor ``source``, or malformed options; nothing was sent.
    """
    _require_sinks(sinks)
    clock = clock_of(clock, source, sinks)
    require_positive("rate", rate, "Hz")
    if duration is not None and not is_real(duration, 0.0, _LONGEST):
        raise TrajectoryError(f"asked to follow for {duration!r} s", hint="0 or a finite time in seconds")
    if start is None:
        if source is None:
            raise TrajectoryError("follow does not know where the arm is", hint="give start=q or source=arm")
        start = source.read().q
    first = joint_vector(robot, start, "start")
    count = None if duration is None else max(1, int(np.ceil(duration * rate - 1e-9)))
    following = _FollowState(robot, solver, tolerance, first, motion_limits(robot, speed)[0] / rate)
    following.load()
    report, schedule = following.report, Schedule(clock)
    begin = schedule.origin
    while True:
        now = schedule.wait(report.ticks / rate, 1.0 / rate if report.ticks else 0.0)
        begin = now if report.ticks == 0 else begin
        goal = goal_source.poll(now)
        solution, capped = following.step(goal)
        for sink in sinks:
            sink.send(report.q, now)
        measured = None if source is None else following.compare(source.read().q)
        report.duration, report.overruns = now - begin, schedule.overruns
        tick = FollowTick(report.ticks - 1, now - begin, goal, solution, report.q, capped, measured)
        if on_tick is not None:
            on_tick(tick)
        if report.ticks == count or (until is not None and until(tick)):
            return report


class _FollowState:
    """State of `follow`: how it solves, and the report, whose ``q`` is the command."""

    def __init__(
        self, robot: Robot, solver: str | Solver, tolerance: Tolerance | None, start: Array, step: Array
    ) -> None:
        from robot_ik.problem import Budget, require_options  # here, because these load the compiler
        from robot_ik.solvers import make_solver

        require_options(robot, tolerance, None, 0)
        self.robot, self.tolerance, self.solver = robot, tolerance, make_solver(solver)
        self._budget = Budget(iterations=_TICK_ITERATIONS, restarts=_TICK_RESTARTS)
        self._largest_allowed = step
        self.report = FollowReport(robot.joints, _frozen(start), np.zeros_like(start))

    def load(self) -> None:
        """Loads what the method may need for goals of the tool, so that none of them stalls the loop.

        A goal on another chain of joints, or several at once, may need more: that is loaded with the first.
        """
        from robot_ik.inverse_kinematics import warm_up

        for goal in (PoseGoal(None, (0.0, 0.0, 0.0)), PositionGoal(None, (0.0, 0.0, 0.0))):
            with contextlib.suppress(RobotIkError):  # a kind of goal that the method does not serve
                warm_up(self.robot, goal, solver=self.solver, tolerance=self.tolerance)

    def step(self, goal: Goals | None) -> tuple[Solution | None, bool]:
        """Moves the command towards ``goal``: what was found for it, and whether the step was cut short."""
        from robot_ik.inverse_kinematics import borrowed_problem

        report = self.report
        report.ticks += 1
        if goal is None:
            report.held += 1
            return None, False
        goals = goal if isinstance(goal, Goal) else list(goal)
        borrowed = borrowed_problem(self.robot, goals, self.solver, {}, self.tolerance, self._budget, 0)
        with borrowed as (solver, problem):
            solution = report.last = solver.solve(problem, report.q)
        report.statuses[solution.status.name] += 1
        difference = solution.q - report.q
        if not np.isfinite(difference).all():  # NUMERICAL: nothing to go to
            return solution, False
        excess = float(np.max(np.abs(difference) / self._largest_allowed))
        q = report.q + difference / excess if excess > 1.0 else solution.q
        report.largest_step = np.maximum(report.largest_step, np.abs(q - report.q))
        report.q = _frozen(q)
        report.capped += excess > 1.0
        return solution, excess > 1.0

    def compare(self, measured: Array) -> Array:
        """Notes the distance of ``measured`` (nq,) from the command; a copy of it."""
        away, before = np.abs(measured - self.report.q), self.report.tracking_error
        self.report.tracking_error = away if before is None else np.maximum(before, away)
        return np.array(measured, dtype=float)


def _frozen(q: ArrayLike) -> Array:
    """A read-only copy: a sink that wrote into it would move the arm."""
    copy = np.array(q, dtype=float)
    copy.flags.writeable = False
    return copy
