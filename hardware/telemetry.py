"""How every servo is, in two reads: position, velocity, current, supply, temperature, torque and errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import JointMap
from robot_ik.hardware.control_table import (
    VELOCITY_UNIT,
    ControlTable,
    Register,
    control_table,
    hardware_error_names,
)


@dataclass(frozen=True)
class ServoState:
    """One servo at one moment.

    Attributes:
        joint, id: Whose; everything else is None where it did not answer.
        position_deg, velocity_deg: At the joint, deg and deg/s; ``ticks``: Present Position.
        position_mm, velocity_mm: Instead, where the joint slides.
        current_ma: Motor current, mA; ``load_percent``: what an XL430 has in its place.
        voltage: V; ``temperature``: C; ``torque``: on or off; ``errors``: latched hardware errors.
    """

    joint: str
    id: int
    position_deg: float | None = None
    velocity_deg: float | None = None
    ticks: int | None = None
    current_ma: float | None = None
    load_percent: float | None = None
    voltage: float | None = None
    temperature: int | None = None
    torque: bool | None = None
    errors: tuple[str, ...] = ()
    position_mm: float | None = None
    velocity_mm: float | None = None

    @property
    def answered(self) -> bool:
        """Both reads came back."""
        return self.ticks is not None and self.torque is not None


def _block(name: str, table: ControlTable, first: str, last: str) -> Register:
    begin, end = table[first].address, table[last].end
    return Register(name, begin, end - begin, "r", False, "", False, None, 0, 0)


_X = control_table("XM430-W350")  # all X servos have these at the same addresses
_HEALTH = _block("torque and errors", _X, "torque_enable", "hardware_error_status")
_MOTION = _block("current to temperature", _X, "present_current", "present_temperature")


def read_states(bus: ServoBus, servos: Sequence[JointMap]) -> list[ServoState]:
    """Asks all servos.

    Args:
        bus: Open.
        servos: Rows of an arm file; a second servo of a joint is a row of its own.

    Returns:
        A row for each, in the same order; one that did not answer is told by ``answered``.

    Raises:
        BusDisconnectedError, BusNotOpenError.
    """
    ids = [servo.id for servo in servos]
    motion, health = bus.sync_read(ids, _MOTION), bus.sync_read(ids, _HEALTH)
    return [_state(servo, motion[servo.id].data, health[servo.id].data) for servo in servos]


def _state(servo: JointMap, motion: int | None, health: int | None) -> ServoState:
    table = servo.table
    values: dict[str, int] = {}
    for block, value in ((_MOTION, motion), (_HEALTH, health)):
        if value is None:
            continue
        data = value.to_bytes(block.size, "little")
        for r in table:
            if block.address <= r.address and r.end <= block.end:
                values[r.name] = r.decode(data[r.address - block.address : r.end - block.address])
    if motion is None and health is None:
        return ServoState(servo.name, servo.id)
    unit = float(table["present_current"].unit.split()[0]) if "present_current" in table else 0.0

    def scaled(name: str, factor: float) -> float | None:
        return values[name] * factor if name in values else None

    position = servo.to_radians(values["present_position"]) if "present_position" in values else None
    lever = servo.lever_at(servo.lower if position is None else position)
    speed = VELOCITY_UNIT / (servo.direction * servo.ratio) * lever / servo.per_unit
    place = None if position is None else position / servo.per_unit
    return ServoState(
        servo.name,
        servo.id,
        ticks=values.get("present_position"),
        current_ma=scaled("present_current", unit),
        load_percent=scaled("present_load", 0.1),
        voltage=scaled("present_input_voltage", 0.1),
        temperature=values.get("present_temperature"),
        torque=bool(values["torque_enable"]) if "torque_enable" in values else None,
        errors=hardware_error_names(values.get("hardware_error_status", 0)),
        **{f"position_{servo.unit}": place, f"velocity_{servo.unit}": scaled("present_velocity", speed)},
    )
