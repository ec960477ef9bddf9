"""Feedback of a control cycle: torque, velocity and position of every servo, in seven bytes.

Torque and position are 68 bytes apart. Indirect addresses put them side by side. The torque byte
shows in the same cycle that a servo has lost its torque, by a restart or by another program. A
restart also resets the indirect addresses. Then the torque byte reads 0, and the reply is not used.
A servo without indirect addresses is read plainly: all registers from torque to temperature.

If joints have thresholds (``[joints.stop_at]``), each cycle reads one of their servos in full:
current or load, temperature and supply as well.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections.abc import Mapping
from typing import NamedTuple

from robot_ik.errors import ConfigError, HardwareError, MotorFaultError
from robot_ik.hardware.bus import BusStatus, ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import CycleBlock
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import Register
from robot_ik.hardware.servo import Drive, StopAt

log = logging.getLogger(__name__)

_SHORT = "torque, velocity and position"
"""Name of the register that holds torque, velocity and position only."""

_VELOCITY_SHIFT = 8
"""Bits below the velocity in the short register: one byte of torque."""

_POSITION_SHIFT = 24
"""Bits below the position in the short register: torque and two bytes of velocity."""

_VELOCITY_MASK = 0xFFFF
"""Bits of the velocity in the short register, shifted down."""

_VELOCITY_SIGN = 0x8000
"""Sign bit of the velocity in the short register, shifted down."""

SUSTAINED = 0.5
"""s for which every sample of a servo must be beyond its threshold.

Starting and stopping take a motor near its stall current for some tens of ms, and one sample may be
noise. A servo's own overload shutdown takes longer.
"""

MIN_SAMPLES = 3
"""Samples in a row beyond a threshold, for slow rates and many servos in turn."""

_FORGOTTEN = 2.0
"""s without a sample of a servo after which older samples do not count."""


class Measurement(NamedTuple):
    """One servo in one cycle.

    Attributes:
        ticks: Present position; None if there is no valid one.
        torque: The servo has torque; None if it did not answer.
        velocity: Velocity of the shaft, rad/s, positive if the ticks increase; None without
            ``ticks``.
    """

    ticks: int | None
    torque: bool | None
    velocity: float | None = None


class Feedback:
    """Which register is read from each servo, and what its value means.

    Attributes:
        registers: Servo id -> register. A register of ``size`` 7 holds torque in its lowest byte,
            velocity in the two bytes above it, and position in the upper four.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._family = config.family
        self._velocity_unit = config.family.velocity_unit
        self._servos = {servo.id: servo for servo in config.servos}
        self.registers: dict[int, Register] = {}
        self._tables = {id: servo.table for id, servo in self._servos.items()}
        # Blocks longer than the short register.
        self._blocks: dict[int, CycleBlock] = {}
        self._thresholds = {
            drive.id: Thresholds(drive)
            for drive in config.drives
            if drive.joint.stop_at != StopAt()
        }
        self._turns = itertools.cycle(self._thresholds)
        self._requested: Mapping[int, Register] = self.registers
        self._beyond: MotorFaultError | None = None
        for id in self._servos:
            self.read_plainly(id)

    def prepare(self, bus: ServoBus, firmware: Mapping[int, int]) -> None:
        """Set the indirect addresses of the servos and enable fast reads on the bus.

        A servo that refuses indirect addresses is read plainly.

        Args:
            bus: Open bus.
            firmware: Servo id -> firmware version.

        Raises:
            BusDisconnectedError, BusNotOpenError: The port went away or is not open.
        """
        for id, servo in self._servos.items():
            with contextlib.suppress(ConfigError):  # unknown firmware: keep the usual table
                self._tables[id] = control_table(servo.model, firmware[id])
        if self._family.capabilities.indirect_addresses:
            for id in self._tables:
                self._read_indirectly(bus, id)
        bus.use_fast_reads(
            [id for id, table in self._tables.items() if "fast_read" in table.abilities]
        )

    def _read_indirectly(self, bus: ServoBus, id: int) -> None:
        """Read this servo by its indirect addresses if it has them, otherwise plainly."""
        with_health = id in self._thresholds
        try:
            block = self._family.short_block(bus, id, self._tables[id], with_health=with_health)
        except HardwareError as error:
            if not bus.is_open:
                raise
            log.info("servo %d takes no indirect addresses and is read plainly: %s", id, error)
            self.read_plainly(id)
            return
        size = sum(part.size for part in block.parts[:3])  # torque, velocity and position
        self.registers[id] = Register(_SHORT, block.register.address, size, signed=True)
        if with_health:
            self._blocks[id] = block

    def read_plainly(self, id: int) -> None:
        """Read this servo without its indirect addresses from now on. That takes more bytes."""
        block = self._family.plain_block(self._tables[id])
        self._blocks[id] = block
        self.registers[id] = block.register

    def requested(self) -> Mapping[int, Register]:
        """Return servo id -> register of the next cycle, with the full block of one servo."""
        if not self._thresholds:
            return self.registers
        id = next(self._turns)
        self._requested = {**self.registers, id: self._blocks[id].register}
        return self._requested

    def measurement(self, status: BusStatus, now: float) -> Measurement:
        """Return the measurement of a reply. ``now`` is the time of the reply, s."""
        value = status.data
        id = status.id
        if value is None:
            return Measurement(None, None)
        if self._requested[id].name == _SHORT:
            if not value & 0xFF:
                return Measurement(None, False)
            raw = value >> _VELOCITY_SHIFT & _VELOCITY_MASK
            counts = (raw ^ _VELOCITY_SIGN) - _VELOCITY_SIGN
            velocity = counts * self._velocity_unit
            return Measurement(value >> _POSITION_SHIFT, True, velocity)
        block = self._blocks[id]
        values = block.register.take_apart(value, block.parts)
        if not self._family.is_in_control(values):
            return Measurement(None, False)
        if id in self._thresholds:
            self._beyond = self._beyond or self._thresholds[id].take(values, now)
        velocity = values["present_velocity"] * self._velocity_unit
        return Measurement(values["present_position"], True, velocity)

    def check_thresholds(self) -> None:
        """Raise ``MotorFaultError`` if a servo was beyond a threshold for too long."""
        if self._beyond is not None:
            raise self._beyond


class Thresholds:
    """Watches one servo against ``[joints.stop_at]``.

    The arm stops before the servo shuts itself down.
    """

    def __init__(self, drive: Drive) -> None:
        stop = drive.joint.stop_at
        unit = drive.servo.table.current_unit
        rows = (
            ("load_limit", "present_load", 0.1, stop.load_percent, "%"),
            ("current_limit", "present_current", unit, stop.current_ma, "mA"),
            ("temperature_limit", "present_temperature", 1.0, stop.temperature_c, "C"),
        )
        self._drive = drive
        self._rows = [(*row[:3], limit, row[4]) for row in rows if (limit := row[3]) is not None]
        # status -> time of the first sample beyond the threshold (s), and number of samples
        self._beyond: dict[str, tuple[float, int]] = {}
        self._last = -math.inf

    def take(self, values: Mapping[str, int], now: float) -> MotorFaultError | None:
        """Return a fault once every sample has been beyond a threshold for ``SUSTAINED``.

        Args:
            values: Register name -> value of a new sample.
            now: Time of the sample, s.
        """
        if now - self._last > _FORGOTTEN:
            self._beyond.clear()
        self._last = now
        for status, register, scale, limit, unit in self._rows:
            value = abs(values[register]) * scale
            if value <= limit:
                self._beyond.pop(status, None)
                continue
            since, count = self._beyond.get(status, (now, 0))
            self._beyond[status] = since, count + 1
            duration = now - since
            if duration >= SUSTAINED and count + 1 >= MIN_SAMPLES:
                return MotorFaultError(
                    self._drive.name,
                    (status,),
                    hint=f"servo id {self._drive.id} was at {value:.4g} {unit} for "
                    f"{duration:.1f} s; stop_at of the arm file is {limit:g}. All joints hold. "
                    "Remove its load or let it cool. Then run robot-ik servo reset-fault, or call "
                    "Arm.reset_fault()",
                )
        return None
