"""Position of the shaft of a virtual servo over time, and how its encoder counts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from robot_ik.hardware.families.dynamixel_x_table import POSITION_MODE_HOMING, REVERSE
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION, OperatingMode
from robot_ik.hardware.virtual import motor
from robot_ik.hardware.virtual.electrics import PWM_FULL, Load
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.profiles import (
    PHYSICAL_ACCELERATION,
    VELOCITY_TICKS,
    MotorMotion,
    ProfileKind,
    brake,
    rest,
)
from robot_ik.ports import Clock

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.world import JointMotor

_IN_POSITION_TICKS = 2.0
"""Ticks from its goal within which a shaft is in position."""
_FOLLOWING_ERROR_TICKS = 50.0
"""Ticks from its profile beyond which a shaft has a following error."""
_EFFORT_OF_GAIN = 1.0 / 128.0
"""PWM counts (of 885) for each tick of error and each count of Position P Gain."""


class Shaft:
    """The moving part of a servo.

    ``reading = sign * encoder + homing offset + whole revolutions``. The encoder counts from where
    the servo was built.

    Args:
        memory: Registers that determine motion and counting.
        clock: The only source of time.
        position: Encoder ticks at first.

    Attributes:
        load: Load of the shaft if there is no ``body``; at first a light one.
        motion: Motion of the profile, in encoder ticks.
        stuck_at: Encoder ticks at which a broken gear keeps the shaft without load; None: not
            broken.
        stops: Encoder ticks between which the shaft can turn. It presses against them.
        body: Moves the shaft instead of the profile; None: the profile moves it.
        powered: Torque is on.
    """

    def __init__(self, memory: Memory, clock: Clock, position: float) -> None:
        self.motion: MotorMotion = rest(clock.now(), position)
        self.stuck_at: float | None = None
        self.stops = (-math.inf, math.inf)
        self.body: JointMotor | None = None
        self.load = Load.light(memory.table.motor)
        self.powered = False
        self._memory = memory
        self._values = memory.values
        self._clock = clock
        self._revolutions = 0.0
        self._unreached: float | None = None

    @property
    def encoder(self) -> float:
        """Present encoder ticks, over any number of revolutions."""
        return self._actual()[0]

    @property
    def reading(self) -> float:
        """Present Position before rounding, ticks."""
        return self._to_reading(self.encoder)

    @property
    def speed(self) -> float:
        """ticks/s in encoder direction."""
        return self._actual()[1]

    def torque(self) -> float:
        """Return the present torque of the motor, N m in encoder direction."""
        if not self.powered or self.stuck_at is not None:
            return 0.0
        if self.body is not None:
            return self.body.torque
        volts = self.volts
        position, velocity = self._actual()
        if self._mode in motor.TORQUE_MODES:
            return self.sign * motor.effort(self._memory, volts)
        limit = motor.torque_limit(self._memory, volts)
        torque = self.load.holding(position)
        if velocity:
            torque += math.copysign(self.load.friction, velocity)
        # Against a stop, or against too much load, the error raises the torque.
        target = self._planned()[0] if self._unreached is None else self._unreached
        missing = target - position
        effort = missing * self._values["position_p_gain"] * _EFFORT_OF_GAIN / PWM_FULL
        torque += effort * self._memory.table.motor.stall_torque
        return max(-limit, min(limit, torque))

    @property
    def volts(self) -> float:
        """Supply, V."""
        return self._memory.values["present_input_voltage"] / 10.0

    @property
    def top(self) -> float:
        """Top speed in position modes, ticks/s: that of the motor, within Velocity Limit."""
        unloaded = motor.unloaded_speed(self._memory.table.motor, self.volts)
        return min(unloaded, self._values["velocity_limit"] * VELOCITY_TICKS)

    def registers(self) -> dict[str, Callable[[], int]]:
        """Return register -> function that reads it, for registers that follow the shaft."""
        return {
            "moving": lambda: int(
                abs(self.velocity_register()) > self._memory.values["moving_threshold"]
            ),
            "moving_status": self.moving_status,
            "present_velocity": self.velocity_register,
            "present_position": self.position_register,
            "velocity_trajectory": lambda: self.sign * round(self._planned()[1] / VELOCITY_TICKS),
            "position_trajectory": lambda: round(self._to_reading(self._planned()[0])),
        }

    def position_register(self) -> int:
        """Return Present Position."""
        return round(self.reading)

    def velocity_register(self) -> int:
        """Return Present Velocity."""
        return self.sign * round(self._actual()[1] / VELOCITY_TICKS)

    def moving_status(self) -> int:
        """Return Moving Status of a goal position.

        Bit 0: in position. Bit 1: profile in progress. Bit 3: following error. Bits 4 and 5:
        profile kind.
        """
        if self._mode == OperatingMode.VELOCITY or self._mode in motor.TORQUE_MODES:
            return 0
        ongoing = self._clock.now() < self.motion.end
        goal_error = abs(self._memory.values["goal_position"] - self.reading)
        kind = self.motion.kind if ongoing else ProfileKind.STEP
        in_position = not ongoing and goal_error < _IN_POSITION_TICKS
        following = abs(self._planned()[0] - self.encoder) > _FOLLOWING_ERROR_TICKS
        return int(in_position) | ongoing << 1 | following << 3 | kind << 4

    def go(self) -> None:
        """Start a motion to the goal registers from the position and speed of the profile."""
        memory = self._memory
        now = self._clock.now()
        position, velocity = self._planned()
        if self._mode == OperatingMode.VELOCITY:
            self.motion = motor.velocity_control(now, position, velocity, memory, self.sign)
        elif self._mode in motor.TORQUE_MODES:
            torque = self.sign * motor.effort(memory, self.volts)
            self.motion = motor.torque_control(
                now, *self._actual(), torque, self.load, memory, self.volts
            )
        else:
            goal = self.sign * (memory.values["goal_position"] - self._homing - self._revolutions)
            if self._too_weak(goal - position):
                self.stop()
                self._unreached = goal
                return
            self._unreached = None
            self.motion = motor.position_control(now, position, velocity, goal, memory, self.top)

    def _too_weak(self, way: float) -> bool:
        """Return whether Goal PWM or Goal Current is too small for load and friction."""
        values = self._values
        limited = (
            abs(values["goal_pwm"]) < PWM_FULL or self._mode == OperatingMode.CURRENT_BASED_POSITION
        )
        if not limited or not way or self.body is not None:
            return False
        needed = abs(self.load.holding(self.encoder) + math.copysign(self.load.friction, way))
        return motor.torque_limit(self._memory, self.volts) < needed

    def stop(self) -> None:
        """Stop at the present position."""
        self.motion = rest(self._clock.now(), self.encoder)
        self._unreached = None

    def brake_at(self, t: float) -> None:
        """Slow down from time ``t`` in s, which is in the past."""
        self.motion = brake(t, *self.motion.at(t), PHYSICAL_ACCELERATION)

    def rotate_by(self, ticks: float) -> None:
        """Turn the shaft from outside, at once."""
        if self.body is not None:
            self.body.rotate_by(ticks)
            ticks = 0.0
        self.motion = rest(self._clock.now(), self.encoder + ticks)
        if self.stuck_at is not None:
            self.stuck_at += ticks

    def fold(self) -> None:
        """Count within one revolution from now on.

        The encoder does not measure the number of revolutions. The manual names four occasions: the
        mode becomes Position, torque goes on in that mode, power on, and Clear. The homing offset
        is added.
        """
        self._revolutions = -TICKS_PER_REVOLUTION * math.floor(
            round(self.sign * self.encoder) / TICKS_PER_REVOLUTION
        )

    def lose_revolutions(self, revolutions: int) -> None:
        """Make the count wrong by this number of revolutions, as after a power cycle."""
        self._revolutions += TICKS_PER_REVOLUTION * revolutions

    @property
    def _mode(self) -> int:
        return self._values["operating_mode"]

    @property
    def sign(self) -> int:
        """-1 if Drive Mode reverses the servo, else 1."""
        return -1 if self._memory.drives(REVERSE) else 1

    @property
    def _homing(self) -> int:
        offset = self._values["homing_offset"]
        if not offset:
            return 0
        ignored = self._mode == OperatingMode.POSITION and abs(offset) > POSITION_MODE_HOMING
        return 0 if ignored else offset

    def _planned(self) -> tuple[float, float]:
        """Return the encoder ticks and ticks/s of the profile now.

        A shaft of a world that has no torque is where the world has moved it.
        """
        if self.body is not None and not self.powered:
            return self.body.position, self.body.velocity
        return self.motion.at(self._clock.now())

    def _actual(self) -> tuple[float, float]:
        """Return the present encoder ticks and ticks/s."""
        if self.stuck_at is not None:
            return self.stuck_at, 0.0
        if self.body is not None:
            return self.body.position, self.body.velocity
        position, velocity = self._planned()
        low, high = self.stops
        if low <= position <= high:
            return position, velocity
        return min(max(position, low), high), 0.0

    def _to_reading(self, encoder: float) -> float:
        return self.sign * encoder + self._homing + self._revolutions
