"""The last gate before the servos: position, velocity and acceleration caps on a stream of joint angles.

The law, per joint and per tick (all displacements of one tick; ``A = a dt²``):

* A move of ``u`` can be followed by ``u - A``, ``u - 2A``, … so the shortest way to stop after it is
  ``D(u) = Σ max(0, u - iA)``.  ``_longest_stoppable`` inverts ``u + D(u) = distance``: the longest move after
  which the joint can still stop within ``distance``.  It bounds every move towards a limit, so a limit is
  never passed; and as ``D`` is the shortest stop there is, a trajectory that keeps the caps is never touched.
* The command is a target moving with its own velocity ``w`` (command difference, slew-limited by the cap):
  the move is ``w`` plus the longest stoppable move along the remaining lag.  In step with the command the
  lag is 0 and the command passes unchanged; at a constant command ``w`` is 0 and the joint brakes into it
  without overshoot and without hunting (the discrete law is dead-beat: no gains, nothing to tune).

This is the discrete-time form of time-optimal (trapezoidal) motion; compare Kröger, "On-Line Trajectory
Generation in Robotic Systems" (2010), type II.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import UnsafeCommandError, close_matches
from robot_ik.ports import Array

CAP_SLACK = 1e-6
"""Relative slack on the caps: a trajectory planned exactly at them is not touched for its rounding."""

PLAN_SLACK = 0.5 * CAP_SLACK
"""Stops are planned with a little less than the cap, so that rounding never asks for more than it."""

TOUCHED = 1e-9
"""rad; a smaller difference between command and output is rounding and is neither made nor reported."""


@dataclass(frozen=True)
class LimiterState:
    """Everything the limiter remembers.  Tuples of floats, one per joint.

    Attributes:
        q: Last output, rad.
        velocity: Mean velocity of the last tick, rad/s.
        command: Last command after clipping to the limits, rad.
        command_velocity: Slew-limited velocity of the command, rad/s.
        dt: Length of the last tick, s; 0 = there was none.
    """

    q: tuple[float, ...]
    velocity: tuple[float, ...]
    command: tuple[float, ...]
    command_velocity: tuple[float, ...]
    dt: float = 0.0

    @classmethod
    def at_rest(cls, q: ArrayLike) -> LimiterState:
        """The arm stands still at ``q`` (n,) rad, inside or outside its limits."""
        here = tuple(float(x) for x in np.asarray(q, dtype=float).ravel())
        if not all(math.isfinite(x) for x in here):
            raise UnsafeCommandError(f"a start at {here}", "finite angles")
        still = (0.0,) * len(here)
        return cls(q=here, velocity=still, command=here, command_velocity=still)


@dataclass(frozen=True)
class LimiterReport:
    """What was changed in one tick, by joint name; false when nothing was.

    Attributes:
        clipped: Joints whose command lay outside the limits.
        capped: Joints whose move was shortened or delayed by the velocity or acceleration cap.
    """

    clipped: tuple[str, ...]
    capped: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.clipped or self.capped)


class SafetyLimiter:
    """Pure function of (state, command, dt); one object may serve any number of arms of one kind."""

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        margin: float = 0.0,
        joints: Sequence[str] | None = None,
    ) -> None:
        """Checks the caps once, so that no step need.

        Args:
            lower: (n,) rad.
            upper: (n,) rad.
            velocity: (n,) or one cap, rad/s, positive.
            acceleration: (n,) or one cap, rad/s², positive.
            margin: rad kept free at both ends of the range.
            joints: n names for reports and named commands; "joint1" … by default.

        Raises:
            ValueError: Shapes, signs or an empty range.
        """
        low = np.array(lower, dtype=float).ravel() + margin
        high = np.array(upper, dtype=float).ravel() - margin
        size = low.size
        max_velocity = np.broadcast_to(np.asarray(velocity, dtype=float), (size,))
        max_acceleration = np.broadcast_to(np.asarray(acceleration, dtype=float), (size,))
        if high.shape != low.shape or not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError("lower and upper must be finite and of one length")
        if (low > high).any() or margin < 0.0:
            raise ValueError(f"nothing is left between lower {low} and upper {high} (margin {margin} rad)")
        if not all(
            np.isfinite(caps).all() and (caps > 0.0).all() for caps in (max_velocity, max_acceleration)
        ):
            raise ValueError("velocity and acceleration caps must be positive and finite")
        self.joints = tuple(joints) if joints is not None else tuple(f"joint{i + 1}" for i in range(size))
        if len(self.joints) != size:
            raise ValueError(f"{len(self.joints)} joint names for {size} joints")
        self.size = size
        self._caps = tuple(
            zip(low.tolist(), high.tolist(), max_velocity.tolist(), max_acceleration.tolist(), strict=True)
        )

    def command(self, q: ArrayLike | Mapping[str, float], fill: Sequence[float]) -> tuple[float, ...]:
        """Checks a command without looking at the limits.

        Args:
            q: (n,) rad, or joint name -> rad; joints not named keep their value of ``fill``.
            fill: n angles, rad.

        Raises:
            UnsafeCommandError: NaN, infinity, wrong length, not numbers, unknown joint.
        """
        if isinstance(q, Mapping):
            q = self._from_names(q, fill)
        array = _numbers(q)
        if array is None:
            raise UnsafeCommandError(f"a command of {reprlib.repr(q)}", f"{self.size} angles in radians")
        if array.shape != (self.size,):
            raise UnsafeCommandError(
                f"a command of shape {array.shape}",
                f"{self.size} angles, one for each of {', '.join(self.joints)}",
            )
        values = tuple(array.tolist())
        if not all(map(math.isfinite, values)):
            bad = [n for n, x in zip(self.joints, values, strict=True) if not math.isfinite(x)]
            raise UnsafeCommandError(f"NaN or infinity for {', '.join(bad)}", "finite angles in radians")
        return values

    def step(
        self, state: LimiterState, command: Sequence[float], dt: float
    ) -> tuple[LimiterState, LimiterReport]:
        """One tick.

        Args:
            state: What the last tick returned, or ``LimiterState.at_rest``.
            command: n values of ``command``, which has checked them.
            dt: Seconds since the last tick.  With a constant dt every law holds exactly; where dt varies,
                the acceleration between two ticks is bounded over the mean of their lengths, and the
                position limits win over the acceleration cap.

        Returns:
            New state, whose ``q`` is to be sent: inside the limits unless the start was outside (then walked
            back within the caps); what was changed.

        Raises:
            UnsafeCommandError: dt not positive and finite, or a state of other joints.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise UnsafeCommandError(f"a tick of {dt} s", "a positive time")
        if len(state.q) != self.size:
            raise UnsafeCommandError(f"a state of {len(state.q)} joints", f"{self.size} joints")
        mean_dt = 0.5 * (dt + (state.dt or dt))
        past = zip(state.q, state.velocity, state.command, state.command_velocity, self._caps, strict=True)
        rows = [
            _step_joint(goal, q, v, command, lead, caps, dt, mean_dt)
            for goal, (q, v, command, lead, caps) in zip(command, past, strict=True)
        ]
        out, velocity, target, target_velocity, clipped, capped = zip(*rows, strict=True)
        report = LimiterReport(tuple(compress(self.joints, clipped)), tuple(compress(self.joints, capped)))
        return LimiterState(out, velocity, target, target_velocity, dt), report

    def _from_names(self, named: Mapping[str, float], fill: Sequence[float]) -> list[float]:
        values = list(fill)
        for name, value in named.items():
            if name not in self.joints:
                close = close_matches(name, self.joints)
                raise UnsafeCommandError(
                    f"a command for unknown joint {name!r}"
                    + (f" (did you mean {close[0]!r}?)" if close else ""),
                    ", ".join(self.joints),
                )
            values[self.joints.index(name)] = value
        return values


def finite(value: object) -> float | None:
    """A number as a float; None where it is no number, or NaN, or too large for one."""
    if not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _numbers(q: object) -> Array | None:
    """Real numbers as an array of floats; None where numpy would guess, and for values that are masked."""
    if np.ma.is_masked(q):
        return None
    try:
        array = np.asarray(q)
        if array.dtype.kind == "O" and all(isinstance(value, Real) for value in array.flat):
            array = array.astype(float)
    except (TypeError, ValueError, OverflowError):
        return None
    return array.astype(float, copy=False) if array.dtype.kind in "fiu" else None


def _longest_stoppable(distance: float, brake: float) -> float:
    """Longest move u ≥ 0 of one tick with u + D(u) ≤ distance, where each later move is shorter by ``brake``.

    With n = ⌈u / brake⌉ moves in all, u + D(u) = n u - brake n (n - 1) / 2: piecewise linear, solved exactly.
    """
    if distance <= brake:
        return max(distance, 0.0)
    moves = math.ceil(0.5 * (math.sqrt(1.0 + 8.0 * distance / brake) - 1.0))
    return distance / moves + 0.5 * brake * (moves - 1)


def _step_joint(
    wanted: float,
    q: float,
    velocity: float,
    command: float,
    command_velocity: float,
    caps: tuple[float, float, float, float],
    dt: float,
    mean_dt: float,
) -> tuple[float, float, float, float, bool, bool]:
    """One joint, one tick; the law is at the head of this file.

    Returns:
        q, velocity, command, velocity of the command, clipped, capped.
    """
    lower, upper, max_velocity, max_acceleration = caps
    target = min(max(wanted, lower), upper)
    longest = max_velocity * dt * (1.0 + CAP_SLACK)
    brake = max_acceleration * dt * dt * (1.0 + PLAN_SLACK)
    change = max_acceleration * dt * mean_dt * (1.0 + CAP_SLACK)
    last = velocity * dt  # the last move at this tick's length

    # The command's own move, believed only as far as the joint could follow it: a jump is not a velocity.
    lead = target - command
    if lead != 0.0:
        before = command_velocity * dt
        lead = min(max(lead, before - change, -longest), before + change, longest)
    lag = target - lead - q
    move = lead + math.copysign(_longest_stoppable(abs(lag), brake), lag)

    move = min(max(move, last - change, -longest), last + change, longest)
    # Outside the limits (a start there) no further outwards; inside, always able to stop before the limit.
    move = min(move, _longest_stoppable(upper - q, brake))
    move = max(move, -_longest_stoppable(q - lower, brake))

    out = q + move
    if abs(out - target) <= 1e-12:
        out = target
    if lower <= q <= upper:
        out = min(max(out, lower), upper)  # rounding, and ticks of uneven length
    return out, (out - q) / dt, target, lead / dt, abs(target - wanted) > TOUCHED, abs(out - target) > TOUCHED
