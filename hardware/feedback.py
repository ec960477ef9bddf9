"""What is read from every servo in a control cycle: its torque and its position, in five bytes.

The two lie 68 bytes apart.  Indirect addresses put them side by side: one byte more than the position, and a
servo that has lost its torque, by a restart of its own or by another's doing, shows in the same cycle.  After
a restart the indirect addresses are gone too and the torque byte reads 0: such an answer is not believed.
Servos that do not take indirect addresses are read plainly.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import NamedTuple

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.hardware.bus import ServoBus, Status
from robot_ik.hardware.config import ArmConfig, JointMap
from robot_ik.hardware.control_table import ControlTable, Register, control_table

log = logging.getLogger(__name__)

_PARTS = ("torque_enable", "present_position")


class Measurement(NamedTuple):
    """One servo in one cycle.

    Attributes:
        ticks: Present position; None if there is none to be believed.
        torque: Whether it has torque; None where that was not asked or not answered.
    """

    ticks: int | None
    torque: bool | None


class Feedback:
    """Which register is read from whom, and what its value says.

    Args:
        config: The arm.

    Attributes:
        registers: Servo id -> register.  One of ``size`` 5 holds both parts: torque in the lowest byte.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._servos = {servo.id: servo for servo in config.servos}
        self.registers: dict[int, Register] = {}
        for id in self._servos:
            self.read_plainly(id)

    def prepare(self, bus: ServoBus, firmware: Mapping[int, int]) -> None:
        """Points the servos' indirect addresses, and tells the bus who may be read fast.

        Args:
            bus: Open.
            firmware: Servo id -> firmware version.

        Raises:
            BusDisconnectedError, BusNotOpenError: Anything else only means: read plainly.
        """
        tables = {id: _table(servo, firmware[id]) for id, servo in self._servos.items()}
        for id, table in tables.items():
            try:
                self.registers[id] = _point(bus, id, table)
            except (HardwareError, KeyError) as error:
                if not bus.is_open:
                    raise
                log.info("servo %d takes no indirect addresses, its torque is not watched: %s", id, error)
                self.read_plainly(id)
        bus.use_fast_reads([id for id, table in tables.items() if "fast_read" in table.abilities])

    def read_plainly(self, id: int) -> None:
        """Only the position of this servo from here on."""
        self.registers[id] = self._servos[id].table["present_position"]

    def measurement(self, status: Status) -> Measurement:
        """What an answer says."""
        value = status.data
        if value is None or self.registers[status.id].name != _BLOCK:
            return Measurement(value, None)
        torque = bool(value & 0xFF)
        return Measurement(value >> 8 if torque else None, torque)

    @property
    def watched(self) -> bool:
        """Whether every servo's torque is seen in every cycle."""
        return all(register.name == _BLOCK for register in self.registers.values())


_BLOCK = "torque and position"


def _table(servo: JointMap, firmware: int) -> ControlTable:
    try:
        return control_table(servo.model, firmware)
    except ConfigError:
        return servo.table


def _point(bus: ServoBus, id: int, table: ControlTable) -> Register:
    """The block of a servo, after its indirect addresses point at the parts.

    Raises:
        HardwareError, KeyError: It has none, does not take them, or does not answer.
    """
    places = [a for name in _PARTS for a in range(table[name].address, table[name].end)]
    first, data = table["indirect_address_1"], table["indirect_data_1"]
    size = 2 * len(places)
    pointers = Register(
        "indirect addresses", first.address, size, "rw", False, "", False, None, 0, 256**size - 1
    )
    wanted = int.from_bytes(b"".join(a.to_bytes(2, "little") for a in places), "little")
    if bus.read(id, pointers).data != wanted:
        bus.write(id, pointers, wanted)
        if bus.read(id, pointers).data != wanted:
            raise HardwareError("they read back otherwise")
    return Register(_BLOCK, data.address, len(places), "r", True, "", False, None, 0, 0)
