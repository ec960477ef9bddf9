"""A servo as bought gets its id and baud rate: alone on the wire, without torque, and read back."""

from __future__ import annotations

from collections.abc import Sequence

from robot_ik.errors import ArmStateError, ConfigError, HardwareError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.control_table import BAUD_RATES, ControlTable
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.scan import FoundServo

_CODES = {rate: code for code, rate in BAUD_RATES.items()}


def the_only_one(found: Sequence[FoundServo]) -> FoundServo:
    """The servo that may be set up, of those (at least one) that answer.

    Raises:
        HardwareError: More than one answers, two share an id, or the model is not known.
    """
    shared = [servo for servo in found if servo.shared]
    if shared:
        raise HardwareError(
            f"id {shared[0].id} gives damaged answers: two servos with one id, or a bad cable",
            hint="connect one servo alone and try again",
        )
    if len(found) > 1:
        names = ", ".join(f"id {s.id} {s.model} at {s.baud}" for s in found)
        raise HardwareError(
            f"{len(found)} servos answer ({names}); exactly one may be connected, nothing was written",
            hint="unplug the others: an id that is taken would make both of them unreachable",
        )
    if found[0].table is None:
        raise HardwareError(f"{found[0].model} is not a servo that is known here; nothing was written")
    return found[0]


def set_up(port: str, servo: FoundServo, id: int, baud: int) -> None:
    """Writes id and baud rate into a servo's EEPROM and asks it for both under its new address.

    Args:
        port: With this servo alone on it.
        servo: As a scan found it.
        id: 0..252.
        baud: bits/s.

    Raises:
        ConfigError: The model cannot have this id or rate.
        ArmStateError: Its torque is on.
        HardwareError: It does not answer under the new address as it should.
        BusNotOpenError, BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    table = servo.table
    assert table is not None  # the_only_one has looked
    if not 0 <= id <= 252:
        raise ConfigError(f"{id} is no servo id", file="command line", key="--id", allowed="0..252")
    if baud not in table.baud_rates:
        allowed = ", ".join(map(str, table.baud_rates))
        raise ConfigError(
            f"{servo.model} cannot talk at {baud} bits/s", file="command line", key="--baud", allowed=allowed
        )
    bus = DynamixelBus(port, servo.baud)
    bus.open()
    try:
        _write(bus, servo, table, id, baud)
    finally:
        bus.close()
    bus = DynamixelBus(port, baud)
    bus.open()
    try:
        names = ("model_number", "id", "baud_rate", "return_delay_time")
        said = tuple(bus.read(id, table[name]).data for name in names)
    finally:
        bus.close()
    if said != (servo.number, id, _CODES[baud], 0):
        raise HardwareError(f"id {id} at {baud} baud reads back model, id, rate, delay = {said}")


def _write(bus: ServoBus, servo: FoundServo, table: ControlTable, id: int, baud: int) -> None:
    """Id before rate: if the line breaks between, the servo is where it was, under its new id."""
    at = servo.id
    if bus.read(at, table["torque_enable"]).data:
        raise ArmStateError(
            f"torque of the servo (id {at}) is on, so its EEPROM is locked; nothing was written",
            hint="support what hangs on it and switch it off: robot-ik servo torque off --ids "
            f"{at} --baud {servo.baud}",
        )
    if bus.read(at, table["return_delay_time"]).data:
        bus.write(at, table["return_delay_time"], 0)
    if at != id:
        bus.write(at, table["id"], id)
        bus.ping(id)
    if servo.baud != baud:
        bus.write(id, table["baud_rate"], _CODES[baud])
