"""The last check before the servos: caps of position, velocity and acceleration.

The law, per joint and per tick (all displacements of one tick; ``A = a dt²``):

* A move of ``u`` can be followed by ``u - A``, ``u - 2A`` and so on, so the shortest way to stop
  after it is ``D(u) = Σ max(0, u - iA)``. ``_longest_stoppable`` inverts ``u + D(u) = distance``:
  it returns the longest move after which the joint can still stop within ``distance``. It bounds
  every move towards a limit, so a limit is never passed. ``D`` is the shortest stop there is, so a
  trajectory that keeps the caps is not changed.
* The command is a target that moves with its own velocity ``w``: the command difference, with its
  change limited by the acceleration cap. The move is ``w`` plus the longest stoppable move along
  the remaining lag. In step with the command the lag is 0, and the command passes unchanged. At a
  constant command ``w`` is 0, and the joint brakes into it without overshoot or oscillation (the
  discrete law is dead-beat and has no gains).

This is the discrete-time form of time-optimal (trapezoidal) motion; compare Kröger, "On-Line
Trajectory Generation in Robotic Systems" (2010), type II.
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
"""Relative slack of the caps. It covers the rounding of a trajectory planned exactly at them."""

PLAN_SLACK = 0.5 * CAP_SLACK
"""Relative slack of planned stops. It is smaller, so that rounding never exceeds the cap."""

TOUCHED = 1e-9
"""rad. A smaller difference between command and output is rounding and is not reported."""


@dataclass(frozen=True)
class LimiterState:
    """Memory of the limiter: tuples of floats, one per joint.

    Attributes:
        q: Last output, rad.
        velocity: Mean velocity of the last tick, rad/s.
        command: Last command after clipping to the limits, rad.
        command_velocity: Slew-limited velocity of the command, rad/s.
        dt: Length of the last tick, s; 0 before the first tick.
    """

    q: tuple[float, ...]
    velocity: tuple[float, ...]
    command: tuple[float, ...]
    command_velocity: tuple[float, ...]
    dt: float = 0.0

    @classmethod
    def at_rest(cls, q: ArrayLike) -> LimiterState:
        """Return the state of an arm at rest at ``q`` (n,) rad, inside or outside its limits."""
        values = tuple(float(x) for x in np.asarray(q, dtype=float).ravel())
        if not all(math.isfinite(x) for x in values):
            raise UnsafeCommandError(f"a start at {values}", "finite angles")
        zeros = (0.0,) * len(values)
        return cls(q=values, velocity=zeros, command=values, command_velocity=zeros)


@dataclass(frozen=True)
class LimiterReport:
    """Changes of one tick, by joint name. False if the tick changed nothing.

    Attributes:
        clipped: Joints whose command was outside the limits.
        capped: Joints whose move was shortened or delayed by the velocity or acceleration cap.
    """

    clipped: tuple[str, ...]
    capped: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.clipped or self.capped)


class SafetyLimiter:
    """Pure function of (state, command, dt). One object may serve several equal arms."""

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
        """Check the caps.

        Args:
            lower: (n,) rad.
            upper: (n,) rad.
            velocity: (n,) or one cap, rad/s, positive.
            acceleration: (n,) or one cap, rad/s², positive.
            margin: rad kept free at both ends of the range.
            joints: n names for reports and named commands; "joint1", "joint2", … by default.

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
            raise ValueError(
                f"nothing is left between lower {low} and upper {high} (margin {margin} rad)"
            )
        if not all(
            np.isfinite(caps).all() and (caps > 0.0).all()
            for caps in (max_velocity, max_acceleration)
        ):
            raise ValueError("velocity and acceleration caps must be positive and finite")
        self.joints = (
            tuple(joints) if joints is not None else tuple(f"joint{i + 1}" for i in range(size))
        )
        if len(self.joints) != size:
            raise ValueError(f"{len(self.joints)} joint names for {size} joints")
        self.size = size
        self._caps = tuple(
            zip(
                low.tolist(),
                high.tolist(),
                max_velocity.tolist(),
                max_acceleration.tolist(),
                strict=True,
            )
        )

    def command(
        self, q: ArrayLike | Mapping[str, float], fill: Sequence[float]
    ) -> tuple[float, ...]:
        """Return a checked command. The limits are not checked.

        Args:
            q: (n,) rad, or joint name -> rad. Joints that are not named take their value from
                ``fill``.
            fill: n joint values, rad.

        Raises:
            UnsafeCommandError: NaN, infinity, wrong length, not numbers, unknown joint.
        """
        if isinstance(q, Mapping):
            q = self._from_names(q, fill)
        array = _numbers(q)
        if array is None:
            raise UnsafeCommandError(
                f"a command of {reprlib.repr(q)}", f"{self.size} angles in radians"
            )
        if array.shape != (self.size,):
            raise UnsafeCommandError(
                f"a command of shape {array.shape}",
                f"{self.size} angles, one for each of {', '.join(self.joints)}",
            )
        values = tuple(array.tolist())
        if not all(map(math.isfinite, values)):
            bad = [n for n, x in zip(self.joints, values, strict=True) if not math.isfinite(x)]
            raise UnsafeCommandError(
                f"NaN or infinity for {', '.join(bad)}", "finite angles in radians"
            )
        return values

    def step(
        self, state: LimiterState, command: Sequence[float], dt: float
    ) -> tuple[LimiterState, LimiterReport]:
        """Return the next state and what was changed.

        With a constant ``dt`` every law holds exactly. With a varying ``dt`` the acceleration
        between two ticks is bounded over the mean of their lengths, and the position limits take
        precedence over the acceleration cap.

        Args:
            state: State of the last tick, or ``LimiterState.at_rest``.
            command: n values that ``command`` has checked.
            dt: Time since the last tick, s.

        Returns:
            New state, whose ``q`` is to be sent, and the report. ``q`` is inside the limits unless
            the start was outside. Then it moves back within the caps.

        Raises:
            UnsafeCommandError: ``dt`` is not positive and finite, or the state is of other joints.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise UnsafeCommandError(f"a tick of {dt} s", "a positive time")
        if len(state.q) != self.size:
            raise UnsafeCommandError(f"a state of {len(state.q)} joints", f"{self.size} joints")
        mean_dt = 0.5 * (dt + (state.dt or dt))
        past = zip(
            state.q, state.velocity, state.command, state.command_velocity, self._caps, strict=True
        )
        rows = [
            _step_joint(goal, q, v, command, lead, caps, dt, mean_dt)
            for goal, (q, v, command, lead, caps) in zip(command, past, strict=True)
        ]
        out, velocity, target, target_velocity, clipped, capped = zip(*rows, strict=True)
        report = LimiterReport(
            tuple(compress(self.joints, clipped)), tuple(compress(self.joints, capped))
        )
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
    """Return a number as a float; None for a value that is no number, NaN or too large."""
    if not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _numbers(q: object) -> Array | None:
    """Return real numbers as floats; None for masked values and for types that are no numbers."""
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
    """Return the longest move u ≥ 0 of one tick with u + D(u) ≤ distance.

    Each later move is shorter by ``brake``. With n = ⌈u / brake⌉ moves in all, u + D(u) = n u -
    brake n (n - 1) / 2. This is piecewise linear and solved exactly.

    Args:
        distance: rad.
        brake: rad.
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
    """Return one tick of one joint. The law is at the head of this file.

    Args:
        wanted: Command, rad.
        q: Last output, rad.
        velocity: Velocity of the last tick, rad/s.
        command: Last command after clipping, rad.
        command_velocity: Slew-limited velocity of the command, rad/s.
        caps: Lower and upper limit (rad), velocity (rad/s) and acceleration cap (rad/s²).
        dt: Length of this tick, s.
        mean_dt: Mean of this tick and the last, s.

    Returns:
        q, velocity, command, velocity of the command, clipped, capped.
    """
    lower, upper, max_velocity, max_acceleration = caps
    target = min(max(wanted, lower), upper)
    longest = max_velocity * dt * (1.0 + CAP_SLACK)
    brake = max_acceleration * dt * dt * (1.0 + PLAN_SLACK)
    change = max_acceleration * dt * mean_dt * (1.0 + CAP_SLACK)
    last = velocity * dt  # the last move at this tick's length

    # Move of the command, limited to what the joint could follow: a jump is not a velocity.
    lead = target - command
    if lead != 0.0:
        before = command_velocity * dt
        lead = min(max(lead, before - change, -longest), before + change, longest)
    lag = target - lead - q
    move = lead + math.copysign(_longest_stoppable(abs(lag), brake), lag)

    move = min(max(move, last - change, -longest), last + change, longest)
    # Inside the limits the joint can always stop before them. Outside it moves no further out.
    move = min(move, _longest_stoppable(upper - q, brake))
    move = max(move, -_longest_stoppable(q - lower, brake))

    out = q + move
    if abs(out - target) <= 1e-12:
        out = target
    if lower <= q <= upper:
        out = min(max(out, lower), upper)  # rounding and varying tick lengths
    return (
        out,
        (out - q) / dt,
        target,
        lead / dt,
        abs(target - wanted) > TOUCHED,
        abs(out - target) > TOUCHED,
    )
