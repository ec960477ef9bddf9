"""Where the shaft of a virtual servo is at any time, and what its encoder makes of that."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from robot_ik.hardware.families.dynamixel_x_table import POSITION_MODE_HOMING, REVERSE
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION, OperatingMode
from robot_ik.hardware.virtual import motor as drive
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.motor import (
    PHYSICAL_ACCELERATION,
    PWM_FULL,
    VELOCITY_TICKS,
    Load,
    MotorMotion,
    ProfileKind,
    brake,
    rest,
)
from robot_ik.ports import Clock

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.world import JointMotor

_IN_POSITION_TICKS = 2.0
_FOLLOWING_ERROR_TICKS = 50.0
# PWM counts of 885 that a tick of error gives, for each count of Position P Gain.
_EFFORT_OF_GAIN = 1.0 / 128.0


class Shaft:
    """The moving part of a servo.

    ``reading = sign * encoder + homing offset + whole revolutions``; the encoder counts from where the servo
    was built.

    Args:
        memory: Registers that say how to move and how to count.
        clock: The only source of time.
        position: Encoder ticks at first.

    Attributes:
        load: What it carries, where no ``body`` says better; at first a light one.
        motion: What the profile wants, in encoder ticks.
        stuck_at: Encoder ticks where a broken gear lets it rest without load, or ``None``.
        stops: Encoder ticks between which it can turn; it presses against them.
        body: Moves it instead of the profile; ``None``: the profile does.
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

    # ---------------------------------------------------------------- where it is

    @property
    def encoder(self) -> float:
        """Ticks as they are now, any number of revolutions."""
        return self._actual()[0]

    @property
    def reading(self) -> float:
        """Present Position before rounding, ticks."""
        return self._to_reading(self.encoder)

    @property
    def speed(self) -> float:
        """Ticks/s in encoder direction."""
        return self._actual()[1]

    def torque(self) -> float:
        """What the motor gives now, N m in encoder direction."""
        if not self.powered or self.stuck_at is not None:
            return 0.0
        if self.body is not None:
            return self.body.torque
        volts = self.volts
        position, velocity = self._actual()
        if self._mode in drive.TORQUE_MODES:
            return self.sign * drive.effort(self._memory, volts)
        limit = drive.torque_limit(self._memory, volts)
        torque = self.load.holding(position)
        if velocity:
            torque += math.copysign(self.load.friction, velocity)
        # Against a stop, and where the load is too much, the controller pushes with what it has.
        wanted = self._planned()[0] if self._unreached is None else self._unreached
        missing = wanted - position
        effort = missing * self._values["position_p_gain"] * _EFFORT_OF_GAIN / PWM_FULL
        torque += effort * self._memory.table.motor.stall_torque
        return max(-limit, min(limit, torque))

    @property
    def volts(self) -> float:
        """Supply, V."""
        return self._memory.values["present_input_voltage"] / 10.0

    @property
    def top(self) -> float:
        """Ticks/s in position modes: what the motor does at its supply, and no more than Velocity Limit."""
        unloaded = drive.unloaded_speed(self._memory.table.motor, self.volts)
        return min(unloaded, self._values["velocity_limit"] * VELOCITY_TICKS)

    def registers(self) -> dict[str, Callable[[], int]]:
        """Registers that follow the shaft, and how to ask for them."""
        return {
            "moving": lambda: int(abs(self.velocity_register()) > self._memory.values["moving_threshold"]),
            "moving_status": self.moving_status,
            "present_velocity": self.velocity_register,
            "present_position": self.position_register,
            "velocity_trajectory": lambda: self.sign * round(self._planned()[1] / VELOCITY_TICKS),
            "position_trajectory": lambda: round(self._to_reading(self._planned()[0])),
        }

    def position_register(self) -> int:
        return round(self.reading)

    def velocity_register(self) -> int:
        return self.sign * round(self._actual()[1] / VELOCITY_TICKS)

    def moving_status(self) -> int:
        """Of a goal position. Bit 0: in position, 1: profile going on, 3: following error, 4-5: its kind."""
        if self._mode == OperatingMode.VELOCITY or self._mode in drive.TORQUE_MODES:
            return 0
        ongoing = self._clock.now() < self.motion.end
        goal_error = abs(self._memory.values["goal_position"] - self.reading)
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
            self.motion = drive.velocity_control(now, position, velocity, memory, self.sign)
        elif self._mode in drive.TORQUE_MODES:
            torque = self.sign * drive.effort(memory, self.volts)
            self.motion = drive.torque_control(now, *self._actual(), torque, self.load, memory, self.volts)
        else:
            goal = self.sign * (memory.values["goal_position"] - self._homing - self._revolutions)
            if self._too_weak(goal - position):
                self.stop()
                self._unreached = goal
                return
            self._unreached = None
            self.motion = drive.position_control(now, position, velocity, goal, memory, self.top)

    def _too_weak(self, way: float) -> bool:
        """Goal PWM or Goal Current is too small for the load and the friction that way."""
        values = self._values
        limited = abs(values["goal_pwm"]) < PWM_FULL or self._mode == OperatingMode.CURRENT_BASED_POSITION
        if not limited or not way or self.body is not None:
            return False
        needed = abs(self.load.holding(self.encoder) + math.copysign(self.load.friction, way))
        return drive.torque_limit(self._memory, self.volts) < needed

    def stop(self) -> None:
        """Stands still from now on, where it is."""
        self.motion = rest(self._clock.now(), self.encoder)
        self._unreached = None

    def brake_at(self, t: float) -> None:
        """Slowed down from time ``t`` (s, past) on."""
        self.motion = brake(t, *self.motion.at(t), PHYSICAL_ACCELERATION)

    def rotate_by(self, ticks: float) -> None:
        """Is rotated from outside, at once."""
        if self.body is not None:
            self.body.rotate_by(ticks)
            ticks = 0.0
        self.motion = rest(self._clock.now(), self.encoder + ticks)
        if self.stuck_at is not None:
            self.stuck_at += ticks

    # ------------------------------------------------------------------ counting

    def fold(self) -> None:
        """Counts within one revolution from here on: the encoder knows the angle, not the number of them.

        The manual: when the mode becomes Position, when torque goes on in that mode, at power on and by
        Clear.  The homing offset comes on top.
        """
        self._revolutions = -TICKS_PER_REVOLUTION * math.floor(
            round(self.sign * self.encoder) / TICKS_PER_REVOLUTION
        )

    def lose_revolutions(self, revolutions: int) -> None:
        """The count is wrong by so many revolutions from here on, as after a power cycle."""
        self._revolutions += TICKS_PER_REVOLUTION * revolutions

    @property
    def _mode(self) -> int:
        return self._values["operating_mode"]

    @property
    def sign(self) -> int:
        """-1 where Drive Mode reverses."""
        return -1 if self._memory.drives(REVERSE) else 1

    @property
    def _homing(self) -> int:
        offset = self._values["homing_offset"]
        if not offset:
            return 0
        ignored = self._mode == OperatingMode.POSITION and abs(offset) > POSITION_MODE_HOMING
        return 0 if ignored else offset

    def _planned(self) -> tuple[float, float]:
        """Encoder ticks and ticks/s that the profile wants now; without torque it wants nothing."""
        if self.body is not None and not self.powered:
            return self.body.position, self.body.velocity
        return self.motion.at(self._clock.now())

    def _actual(self) -> tuple[float, float]:
        """Encoder ticks and ticks/s as they are now."""
        if self.stuck_at is not None:
            return self.stuck_at, 0.0
        if self.body is not None:
            return self.body.position, self.body.velocity
        position, velocity = self._planned()
        low, high = self.stops
        return (position, velocity) if low <= position <= high else (min(max(position, low), high), 0.0)

    def _to_reading(self, encoder: float) -> float:
        return self.sign * encoder + self._homing + self._revolutions
