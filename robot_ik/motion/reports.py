"""What the run-time loops tell: one tick while they run, one report when they end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.solution import Solution


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
        slipped: Seconds by which the schedule was moved because of them.
        samples: How many ticks belong to the trajectory; the rest is settling.
    """

    joints: tuple[str, ...]
    times: Array
    commanded: Array
    measured: Array | None
    measured_times: Array | None
    overruns: int
    slipped: float
    samples: int

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
        capped: True when that was less than the whole way.
        measured: (nq,) what the source of joints then read, or None without one.
    """

    index: int
    time: float
    goal: Any
    solution: Solution | None
    q: Array
    capped: bool
    measured: Array | None


@dataclass(frozen=True, eq=False, repr=False)
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
        slipped: Seconds by which the schedule was moved because of them.
        q: (nq,) last command.
        last: Last solution, None when there never was a goal.
        largest_step: (nq,) largest change of a command from one tick to the next, rad or m.
        tracking_error: (nq,) largest distance of measured from commanded, None without a source.
    """

    joints: tuple[str, ...]
    ticks: int
    held: int
    capped: int
    statuses: Mapping[str, int]
    duration: float
    overruns: int
    slipped: float
    q: Array
    last: Solution | None
    largest_step: Array
    tracking_error: Array | None

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
