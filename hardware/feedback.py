"""What is read from every servo in a control cycle: its torque and its position, in five bytes.

The two lie 68 bytes apart.  Indirect addresses put them side by side: one byte more than the position, and a
servo that has lost its torque, by a restart of its own or by another's doing, shows in the same cycle.  After
a restart the indirect addresses are gone too and the torque byte reads 0: such a reply is not believed.
A servo that does not take indirect addresses is read plainly: all registers from torque to temperature.

Of joints with thresholds (``[joints.stop_at]``) one servo a cycle, in turn, is asked for more in the same
request: current or load, temperature and supply as well.  Its block is longer by more than the bytes by
which requests differ (``dynamixel``), so that a late reply is still known by its length.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from robot_ik.errors import ConfigError, HardwareError, MotorFaultError
from robot_ik.hardware.bus import BusStatus, ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import ControlTable, Register
from robot_ik.hardware.servo import Drive, StopAt

log = logging.getLogger(__name__)

_PARTS = ("torque_enable", "present_position")
_BLOCK = "torque and position"

SUSTAINED = 0.5
"""s for which every sample of a servo must lie beyond its threshold.  Setting out and stopping take a motor
near its stall current for some tens of ms, and one sample may be noise; a servo's own overload
shutdown takes longer."""

LEAST_SAMPLES = 3
"""Samples in a row beyond a threshold, whatever time they took: with a slow rate or many servos in turn."""

_FORGOTTEN = 2.0  # s without a sample of a servo after which those before it say nothing any more


class Measurement(NamedTuple):
    """One servo in one cycle."""

    ticks: int | None  # present position; None if there is none to be believed
    torque: bool | None  # whether it has torque; None where it did not answer


_Block = tuple[Register, list[Register]]
"""Bytes of one servo that are read at once, and what lies in them."""


class Feedback:
    """Which register is read from whom, and what its value says.

    Attributes:
        registers: Servo id -> register.  One of ``size`` 5 holds both parts: torque in the lowest byte.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._family = config.family
        self._servos = {servo.id: servo for servo in config.servos}
        self.registers: dict[int, Register] = {}
        self._tables = {id: servo.table for id, servo in self._servos.items()}
        self._blocks: dict[int, _Block] = {}  # those longer than torque and position
        self._thresholds = {
            drive.id: Thresholds(drive) for drive in config.drives if drive.joint.stop_at != StopAt()
        }
        self._turns = itertools.cycle(self._thresholds)
        self._asked: Mapping[int, Register] = self.registers
        self._beyond: MotorFaultError | None = None
        for id in self._servos:
            self.read_plainly(id)

    def prepare(self, bus: ServoBus, firmware: Mapping[int, int]) -> None:
        """Points the servos' indirect addresses, and says to the bus who may be read fast.

        ``firmware``: servo id -> version.

        Raises:
            BusDisconnectedError, BusNotOpenError: Anything else only means: read plainly.
        """
        for id, servo in self._servos.items():
            with contextlib.suppress(ConfigError):  # no firmware has this number: the usual table
                self._tables[id] = control_table(servo.model, firmware[id])
        for id, table in self._tables.items():
            try:
                parts = _PARTS + (_health_of(table) if id in self._thresholds else ())
                block = _indirect_block(bus, id, table, parts)
                size = sum(table[name].size for name in _PARTS)  # at the head of the block
                self.registers[id] = Register(_BLOCK, block[0].address, size, signed=True)
                if id in self._thresholds:
                    self._blocks[id] = block
            except (HardwareError, KeyError) as error:
                if not bus.is_open:
                    raise
                log.info("servo %d takes no indirect addresses and is read plainly: %s", id, error)
                self.read_plainly(id)
        bus.use_fast_reads([id for id, table in self._tables.items() if "fast_read" in table.abilities])

    def read_plainly(self, id: int) -> None:
        """This servo without its indirect addresses from here on: more bytes, and the same is seen."""
        register, parts = self._family.plain_block(self._tables[id])
        self._blocks[id] = register, list(parts)
        self.registers[id] = self._blocks[id][0]

    def asked(self) -> Mapping[int, Register]:
        """Servo id -> register of the next cycle: ``registers``, with more of the servo whose turn it is."""
        if not self._thresholds:
            return self.registers
        turn = next(self._turns)
        self._asked = {**self.registers, turn: self._blocks[turn][0]}
        return self._asked

    def measurement(self, status: BusStatus, now: float) -> Measurement:
        """What a reply says; ``now``: when it came, s, for thresholds."""
        value, id = status.data, status.id
        if value is None:
            return Measurement(None, None)
        if self._asked[id].name == _BLOCK:
            torque = bool(value & 0xFF)
            return Measurement(value >> 8 if torque else None, torque)
        block, parts = self._blocks[id]
        values = block.take_apart(value, parts)
        if not self._family.is_in_control(values):
            return Measurement(None, False)
        if id in self._thresholds:
            self._beyond = self._beyond or self._thresholds[id].take(values, now)
        return Measurement(values["present_position"], True)

    def check_thresholds(self) -> None:
        """Raises ``MotorFaultError`` where a servo has been beyond a threshold of its joint for too long."""
        if self._beyond is not None:
            raise self._beyond


class Thresholds:
    """Watches one servo against ``[joints.stop_at]``: the arm stops before the servo shuts itself down."""

    def __init__(self, drive: Drive) -> None:
        stop, unit = drive.joint.stop_at, drive.servo.table.current_unit
        rows = (
            ("load_limit", "present_load", 0.1, stop.load_percent, "%"),
            ("current_limit", "present_current", unit, stop.current_ma, "mA"),
            ("temperature_limit", "present_temperature", 1.0, stop.temperature_c, "C"),
        )
        self._drive = drive
        self._rows = [(*row[:3], most, row[4]) for row in rows if (most := row[3]) is not None]
        self._beyond: dict[str, tuple[float, int]] = {}  # status -> since when, and how many samples
        self._last = -math.inf

    def take(self, values: Mapping[str, int], now: float) -> MotorFaultError | None:
        """The fault, once every sample has been beyond a threshold for ``SUSTAINED``.

        ``values``: the next one, by register name, of time ``now``, s.
        """
        if now - self._last > _FORGOTTEN:
            self._beyond.clear()
        self._last = now
        for status, register, scale, most, unit in self._rows:
            value = abs(values[register]) * scale
            if value <= most:
                self._beyond.pop(status, None)
                continue
            since, count = self._beyond.get(status, (now, 0))
            self._beyond[status] = since, count + 1
            spent = now - since
            if spent >= SUSTAINED and count + 1 >= LEAST_SAMPLES:
                return MotorFaultError(
                    self._drive.name,
                    (status,),
                    hint=f"servo id {self._drive.id} at {value:.4g} {unit} for {spent:.1f} s, and stop_at of "
                    f"the arm file is {most:g}: all hold. Take its load away or let it cool, then: "
                    "robot-ik servo reset-fault, or Arm.reset_fault()",
                )
        return None


def _health_of(table: ControlTable) -> tuple[str, ...]:
    """What is read beyond torque and position: five bytes, so that the block is ten long."""
    effort = "present_current" if "present_current" in table else "present_load"
    return (effort, "present_temperature", "present_input_voltage")


def _indirect_block(bus: ServoBus, id: int, table: ControlTable, parts: tuple[str, ...]) -> _Block:
    """The block of a servo, after its indirect addresses point at the parts.

    Raises:
        HardwareError, KeyError: It has none, does not take them, or does not answer.
    """
    addresses = [a for name in parts for a in range(table[name].address, table[name].end)]
    first, data = table["indirect_address_1"], table["indirect_data_1"]
    size = 2 * len(addresses)
    pointers = Register("indirect addresses", first.address, size, writable=True)
    wanted = int.from_bytes(b"".join(a.to_bytes(2, "little") for a in addresses), "little")
    if bus.read(id, pointers).data != wanted:
        bus.write(id, pointers, wanted)
        if bus.read(id, pointers).data != wanted:
            raise HardwareError("they read back otherwise")
    block = Register("torque, position and health", data.address, len(addresses), signed=True)
    registers = [table[name] for name in parts]
    return block, [replace(r, address=data.address + addresses.index(r.address)) for r in registers]
