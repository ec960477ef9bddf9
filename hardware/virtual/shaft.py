"""Where the shaft of a virtual servo is at any time, and what its encoder makes of that."""

from __future__ import annotations

import math
from collections.abc import Callable

from robot_ik.hardware.control_table import TICKS_PER_TURN, OperatingMode
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.profile import (
    PHYSICAL_ACCELERATION,
    VELOCITY_TICKS,
    Motion,
    ProfileKind,
    brake,
    profiled_move,
    rest,
    turn,
)
from robot_ik.ports import Clock

REVERSE, TIME_BASED, TORQUE_BY_GOAL = 0b0001, 0b0100, 0b1000
"""Bits of Drive Mode."""

# Homing Offset beyond a quarter turn is ignored in the one-turn mode.
_HOMING_ONE_TURN = TICKS_PER_TURN // 4
_IN_POSITION_TICKS = 2.0
_FOLLOWING_ERROR_TICKS = 50.0


class Shaft:
    """The moving part of a servo.

    ``reading = sign * encoder + homing offset + whole turns``; the encoder counts from where the servo
    was built.

    Args:
        memory: Registers that say how to move and how to count.
        clock: The only source of time.
        position: Encoder ticks at first.

    Attributes:
        motion: What the profile wants, in encoder ticks.
        stuck_at: Encoder ticks where it is stuck, or ``None``.
    """

    def __init__(self, memory: Memory, clock: Clock, position: float) -> None:
        self.motion: Motion = rest(clock.now(), position)
        self.stuck_at: float | None = None
        self._memory = memory
        self._clock = clock
        self._turns = 0.0
        self._top = (memory.table["velocity_limit"].initial or 0) * VELOCITY_TICKS

    # ---------------------------------------------------------------- where it is

    @property
    def encoder(self) -> float:
        """Ticks as they are now, any number of turns."""
        return self._actual()[0]

    @property
    def reading(self) -> float:
        """Present Position before rounding, ticks."""
        return self._to_reading(self.encoder)

    @property
    def standing(self) -> bool:
        """It does not move at all."""
        return self._actual()[1] == 0.0

    def registers(self) -> dict[str, Callable[[], int]]:
        """Registers that follow the shaft, and how to ask for them."""
        return {
            "moving": lambda: int(abs(self.velocity_register()) > self._memory.get("moving_threshold")),
            "moving_status": self.moving_status,
            "present_velocity": self.velocity_register,
            "present_position": self.position_register,
            "velocity_trajectory": self.velocity_trajectory,
            "position_trajectory": self.position_trajectory,
        }

    def position_register(self) -> int:
        """Present Position."""
        return self._round(self.reading)

    def velocity_register(self) -> int:
        """Present Velocity, units of 0.229 rev/min."""
        return self._sign * round(self._actual()[1] / VELOCITY_TICKS)

    def position_trajectory(self) -> int:
        """Where the profile wants it, ticks."""
        return self._round(self._to_reading(self._planned()[0]))

    def velocity_trajectory(self) -> int:
        """How fast the profile wants it, units of 0.229 rev/min."""
        return self._sign * round(self._planned()[1] / VELOCITY_TICKS)

    def moving_status(self) -> int:
        """Bit 0 in position, 1 profile going on, 3 following error, 4-5 kind of profile."""
        ongoing = self._clock.now() < self.motion.end
        goal_error = abs(self._memory.get("goal_position") - self.reading)
        kind = self.motion.kind if ongoing else ProfileKind.STEP
        in_position = not ongoing and goal_error < _IN_POSITION_TICKS
        following = abs(self._planned()[0] - self.encoder) > _FOLLOWING_ERROR_TICKS
        return int(in_position) | ongoing << 1 | following << 3 | kind << 4

    # -------------------------------------------------------------------- moving

    def go(self) -> None:
        """Sets out for the goal registers from wherever the profile is, at whatever speed it has."""
        memory, now = self._memory, self._clock.now()
        position, velocity = self._planned()
        if self._mode == OperatingMode.VELOCITY:
            wanted = self._sign * memory.get("goal_velocity") * VELOCITY_TICKS
            self.motion = turn(now, position, velocity, wanted, PHYSICAL_ACCELERATION)
            return
        self.motion = profiled_move(
            now,
            position,
            velocity,
            self._sign * (memory.get("goal_position") - self._homing - self._turns),
            profile_velocity=memory.get("profile_velocity"),
            profile_acceleration=memory.get("profile_acceleration"),
            time_based=bool(memory.get("drive_mode") & TIME_BASED),
            physical_top=self._top,
        )

    def stop(self) -> None:
        """Stands still from now on, where it is."""
        self.motion = rest(self._clock.now(), self.encoder)

    def brake_at(self, t: float) -> None:
        """Slowed down from time ``t`` (s, past) on."""
        self.motion = brake(t, *self.motion.at(t), PHYSICAL_ACCELERATION)

    def turn_by(self, ticks: float) -> None:
        """Is turned from outside, at once."""
        self.motion = rest(self._clock.now(), self.encoder + ticks)
        if self.stuck_at is not None:
            self.stuck_at += ticks

    # ------------------------------------------------------------------ counting

    def fold(self) -> None:
        """The one-turn mode counts within one turn."""
        if self._mode == OperatingMode.POSITION:
            self._turns -= TICKS_PER_TURN * math.floor(self.reading / TICKS_PER_TURN)

    def forget_turns(self) -> None:
        """The encoder knows the angle within a turn, not how many turns there were."""
        self._turns -= TICKS_PER_TURN * math.floor((self.reading - self._homing) / TICKS_PER_TURN)
        self.fold()

    @property
    def _mode(self) -> int:
        return self._memory.get("operating_mode")

    @property
    def _sign(self) -> int:
        return -1 if self._memory.get("drive_mode") & REVERSE else 1

    @property
    def _homing(self) -> int:
        offset = self._memory.get("homing_offset")
        ignored = self._mode == OperatingMode.POSITION and abs(offset) > _HOMING_ONE_TURN
        return 0 if ignored else offset

    def _planned(self) -> tuple[float, float]:
        """Encoder ticks and ticks/s that the profile wants now."""
        return self.motion.at(self._clock.now())

    def _actual(self) -> tuple[float, float]:
        """Encoder ticks and ticks/s as they are now."""
        return self._planned() if self.stuck_at is None else (self.stuck_at, 0.0)

    def _to_reading(self, encoder: float) -> float:
        return self._sign * encoder + self._homing + self._turns

    def _round(self, reading: float) -> int:
        ticks = round(reading)
        return ticks % TICKS_PER_TURN if self._mode == OperatingMode.POSITION else ticks
