"""``GuardedStream``: a stream of commands that can always stop before parts touch.

    stream = GuardedStream(guard, velocity_limits, acceleration_limits, rate=100.0)
    stream.begin(q)                       # where the arm is, at rest
    command = stream.next(wanted)         # each tick; stream.contact is the pair that blocks it
    stream.was_sent(arm.send(command))    # the command after the limiter of the arm

An arm in motion needs a distance to stop. So a step is allowed only if straight braking from its
end is free. If it is not, the arm moves the joints that may move, and brakes the other joints.
Braking itself is free, because it was checked with the last step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.collision.scene import Clearance
from robot_ik.geometry import Array
from robot_ik.motion.guard import MotionGuard

SHARES = (0.5, 0.25)
"""Shares of the change from braking to a step that are tried if the step is not allowed."""

TICK_ROUNDING = 1e-6
"""Rounding error of a number of ticks. One tick more would lengthen the checked distance."""

CAP_SHARE = 0.98
"""Share of the limits to use, so that the limiter of an arm changes no command."""


class GuardedStream:
    """Follows joint angles within speed and acceleration limits, and stops before parts touch.

    Attributes:
        contact: The pair that limits the last command. None if the command is not limited.
    """

    def __init__(
        self,
        guard: MotionGuard,
        velocity_limits: ArrayLike,
        acceleration_limits: ArrayLike,
        rate: float,
    ) -> None:
        """Prepare a stream.

        Args:
            guard: Checks the steps.
            velocity_limits: (nv,) rad/s or m/s; 0 for joints that follow others.
            acceleration_limits: (nv,) rad/s² or m/s².
            rate: Commands a second, Hz.
        """
        self._guard = guard
        self._robot = guard.collisions.scene.robot
        self._largest_step = CAP_SHARE * np.asarray(velocity_limits, dtype=float) / rate
        # Largest change of a step from one tick to the next.
        self._largest_change = CAP_SHARE * np.asarray(acceleration_limits, dtype=float) / rate**2
        self._q = np.zeros_like(self._largest_step)
        self._step = np.zeros_like(self._largest_step)
        self._wanted = np.zeros_like(self._largest_step)
        self._lead = np.zeros_like(self._largest_step)
        self.contact: Clearance | None = None

    def begin(self, q: ArrayLike) -> None:
        """Begin at rest at ``q`` (nq,)."""
        self._q = np.array(q, dtype=float)
        self._step = np.zeros_like(self._q)
        self._wanted = self._q
        self._lead = np.zeros_like(self._q)
        self.contact = None

    def next(self, wanted: Array) -> Array:
        """Return the next command (nq,) towards ``wanted`` (nq,)."""
        step = self._wanted_step(wanted)
        self._guard.forget()
        blocked = self._guard.blocked_at(self._q, self._stop_after(step))
        self.contact = None
        if blocked is not None:
            self.contact = self._guard.collisions.clearance(blocked)
            step = self._slide(step)
        self._q = self._robot.apply_couplings(self._q + step)
        self._step = step
        return self._q

    def _slide(self, step: Array) -> Array:
        """Return an allowed step between braking and a step that is not allowed."""
        brake = self._braked(self._step)
        for share in SHARES:
            trial = brake + share * (step - brake)
            if self._is_allowed(trial):
                return trial
        # Joint by joint: the arm slides along the obstacle.
        allowed = brake
        for joint in np.argsort(-np.abs(step - brake), kind="stable"):
            trial = allowed.copy()
            trial[joint] = step[joint]
            if step[joint] != brake[joint] and self._is_allowed(trial):
                allowed = trial
        return allowed

    def _is_allowed(self, step: Array) -> bool:
        """Return whether a step and the braking after it are allowed."""
        return self._guard.blocked_at(self._q, self._stop_after(step)) is None

    def was_sent(self, q: Array) -> None:
        """Continue from the command (nq,) that was sent instead of the last command."""
        if np.array_equal(q, self._q):
            return
        before = self._q - self._step
        self._step = np.where(self._largest_step > 0.0, q - before, 0.0)
        self._q = np.array(q, dtype=float)

    def _wanted_step(self, wanted: Array) -> Array:
        """Return the longest step towards ``wanted`` within the limits that need not overshoot.

        The last change of ``wanted`` is added, within the limits of the joints. So the commands do
        not lag behind a motion.
        """
        change = self._largest_change
        lead = np.clip(wanted - self._wanted, self._lead - change, self._lead + change)
        self._lead = np.clip(lead, -self._largest_step, self._largest_step)
        self._wanted = np.array(wanted, dtype=float)
        way = wanted - self._lead - self._q
        distance = np.abs(way)
        # Steps that become shorter by ``change`` from tick to tick end at the goal after ``ticks``.
        ticks = np.maximum(1.0, np.ceil(0.5 * (np.sqrt(1.0 + 8.0 * distance / change) - 1.0)))
        longest = distance / ticks + 0.5 * change * (ticks - 1.0)
        step = self._lead + np.sign(way) * longest
        step = np.clip(step, -self._largest_step, self._largest_step)
        return np.asarray(np.clip(step, self._step - change, self._step + change))

    def _braked(self, step: Array) -> Array:
        """Return the next step of straight braking."""
        ticks = self._ticks_to_stop(step)
        return step * (1.0 - 1.0 / ticks) if ticks > 1.0 else np.zeros_like(step)

    def _stop_after(self, step: Array) -> Array:
        """Return the posture (nq,) after a step and straight braking."""
        ticks = self._ticks_to_stop(step)
        return self._robot.apply_couplings(self._q + step * 0.5 * (ticks + 1.0))

    def _ticks_to_stop(self, step: Array) -> float:
        """Return the number of ticks of straight braking, with the present tick; at least 1."""
        ticks = float(np.max(np.abs(step) / self._largest_change, initial=0.0))
        return max(1.0, math.ceil(ticks - TICK_ROUNDING))
