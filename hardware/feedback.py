"""What a control cycle reads from every servo: torque and position, in five bytes.

Torque and position are 68 bytes apart. Indirect addresses put them side by side. For one byte more
than the position, a servo that has lost its torque, by a restart or by another program, shows in
the same cycle. After a restart the indirect addresses are reset as well and the torque byte reads
0, so such a reply is not used. A servo without indirect addresses is read plainly: all registers
from torque to temperature.

If joints have thresholds (``[joints.stop_at]``), each cycle reads one of their servos in full:
current or load, temperature and supply as well. The block of that servo is longer by more bytes
than the lengths by which requests differ (``serial_bus``), so a late reply is still recognised by
its length.
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
"""s for which every sample of a servo must be beyond its threshold.

Starting and stopping take a motor near its stall current for some tens of ms, and one sample may be
noise. A servo's own overload shutdown takes longer.
"""

LEAST_SAMPLES = 3
"""Samples in a row beyond a threshold, for slow rates and many servos in turn."""

_FORGOTTEN = 2.0
"""s without a sample of a servo after which older samples do not count."""


class Measurement(NamedTuple):
    """One servo in one cycle.

    Attributes:
        ticks: Present position; None if there is no valid one.
        torque: The servo has torque; None if it did not answer.
    """

    ticks: int | None
    torque: bool | None


_Block = tuple[Register, list[Register]]
"""Bytes of one servo that are read at once, and the registers in them."""


class Feedback:
    """Which register is read from each servo, and what its value means.

    Attributes:
        registers: Servo id -> register. A register of ``size`` 5 holds torque in its lowest byte
            and position above it.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._family = config.family
        self._servos = {servo.id: servo for servo in config.servos}
        self.registers: dict[int, Register] = {}
        self._tables = {id: servo.table for id, servo in self._servos.items()}
        self._blocks: dict[int, _Block] = {}  # blocks longer than torque and position
        self._thresholds = {
            drive.id: Thresholds(drive)
            for drive in config.drives
            if drive.joint.stop_at != StopAt()
        }
        self._turns = itertools.cycle(self._thresholds)
        self._asked: Mapping[int, Register] = self.registers
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
        for id, table in self._tables.items():
            try:
                parts = _PARTS + (_health_of(table) if id in self._thresholds else ())
                block = _indirect_block(bus, id, table, parts)
                size = sum(table[name].size for name in _PARTS)  # first bytes of the block
                self.registers[id] = Register(_BLOCK, block[0].address, size, signed=True)
                if id in self._thresholds:
                    self._blocks[id] = block
            except (HardwareError, KeyError) as error:
                if not bus.is_open:
                    raise
                log.info("servo %d takes no indirect addresses and is read plainly: %s", id, error)
                self.read_plainly(id)
        bus.use_fast_reads(
            [id for id, table in self._tables.items() if "fast_read" in table.abilities]
        )

    def read_plainly(self, id: int) -> None:
        """Read this servo without its indirect addresses from now on. That takes more bytes."""
        register, parts = self._family.plain_block(self._tables[id])
        self._blocks[id] = register, list(parts)
        self.registers[id] = self._blocks[id][0]

    def asked(self) -> Mapping[int, Register]:
        """Return servo id -> register of the next cycle, with the full block of one servo."""
        if not self._thresholds:
            return self.registers
        turn = next(self._turns)
        self._asked = {**self.registers, turn: self._blocks[turn][0]}
        return self._asked

    def measurement(self, status: BusStatus, now: float) -> Measurement:
        """Return what a reply means. ``now`` is the time of the reply in s, for thresholds."""
        value = status.data
        id = status.id
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
            spent = now - since
            if spent >= SUSTAINED and count + 1 >= LEAST_SAMPLES:
                return MotorFaultError(
                    self._drive.name,
                    (status,),
                    hint=f"servo id {self._drive.id} was at {value:.4g} {unit} for {spent:.1f} s; "
                    f"stop_at of the arm file is {limit:g}. All joints hold. Remove its load or "
                    "let it cool. Then run robot-ik servo reset-fault, or call Arm.reset_fault()",
                )
        return None


def _health_of(table: ControlTable) -> tuple[str, ...]:
    """Return the registers read beyond torque and position: five bytes, so the block has ten."""
    effort = "present_current" if "present_current" in table else "present_load"
    return (effort, "present_temperature", "present_input_voltage")


def _indirect_block(bus: ServoBus, id: int, table: ControlTable, parts: tuple[str, ...]) -> _Block:
    """Return the block of a servo after its indirect addresses point at the parts.

    Raises:
        HardwareError: The servo does not take the addresses or does not answer.
        KeyError: The servo has no indirect addresses.
    """
    addresses = [a for name in parts for a in range(table[name].address, table[name].end)]
    first = table["indirect_address_1"]
    data = table["indirect_data_1"]
    size = 2 * len(addresses)
    pointers = Register("indirect addresses", first.address, size, writable=True)
    wanted = int.from_bytes(b"".join(a.to_bytes(2, "little") for a in addresses), "little")
    if bus.read(id, pointers).data != wanted:
        bus.write(id, pointers, wanted)
        if bus.read(id, pointers).data != wanted:
            raise HardwareError("the indirect addresses read back otherwise")
    block = Register("torque, position and health", data.address, len(addresses), signed=True)
    registers = [table[name] for name in parts]
    return block, [replace(r, address=data.address + addresses.index(r.address)) for r in registers]
