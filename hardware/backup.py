"""Control tables as files: registers of servos, saved and restored.

Only EEPROM is restored, because RAM is lost at power-off anyway.  Registers that decide how a servo
is reached are saved and never restored: ``servo_setup`` changes them.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from robot_ik.config import (
    KeyProblem,
    SchemaVersion,
    Several,
    Table,
    check_table,
    keys_of,
    read_json,
)
from robot_ik.errors import ArmStateError, HardwareError, ServoRefusedError
from robot_ik.files import timestamp, write_atomically
from robot_ik.hardware.arm_registers import require_models
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import family_of
from robot_ik.hardware.models import control_table, model_by_number, model_name
from robot_ik.hardware.registers import ControlTable, Register
from robot_ik.hardware.servo import ServoId

SCHEMA = 1
"""Version of the JSON file; raised when a field changes its meaning."""

ADDRESS = ("id", "baud_rate", "protocol_type", "lock")
"""EEPROM registers that decide how a servo is reached."""

BLOCK_BYTES = 64
"""Bytes read at once."""

SMALLEST_VALUE = -(2**31)
"""Smallest value of a saved register that is not restored: a signed register of four bytes."""

LARGEST_VALUE = 2**32
"""Upper bound of a saved register that is not restored: an unsigned register of four bytes."""


@dataclass(frozen=True)
class SavedServo:
    """Control table of one servo, as a table of the file.

    Attributes:
        joint: Joint of the servo.
        id: Servo id.
        model: Name of the model.
        model_number: Model Number.
        firmware: Firmware version when it was saved.
        registers: Register name -> value.
    """

    joint: str
    id: ServoId
    model: str
    model_number: int
    firmware: Annotated[int, Field(ge=1, le=255)]
    registers: dict[str, int]

    @property
    def table(self) -> ControlTable:
        """Control table of the model, which is known, with that firmware."""
        return control_table(model_name(self.model_number), self.firmware)


@dataclass(frozen=True)
class Change:
    """One register that differs from the file.

    Attributes:
        joint: Joint of the servo.
        id: Servo id.
        register: Register name.
        present: Value in the servo.
        saved: Value in the file.
    """

    joint: str
    id: int
    register: str
    present: int
    saved: int


def read_tables(bus: ServoBus, config: ArmConfig) -> list[SavedServo]:
    """Read every register of every servo of an arm.

    Raises:
        ServoMismatchError: A servo is missing or is another model.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint.
    """
    expected = {drive.id: (drive.name, drive.servo.table.number) for drive in config.drives}
    require_models(bus, expected, "the arm file")
    saved = []
    for drive in config.drives:
        servo = drive.servo
        firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
        table = control_table(servo.model, firmware)
        # Indirect data repeat other registers.
        registers = [register for register in table if "indirect_data" not in register.name]
        values = _read(bus, servo.id, table, registers)
        saved.append(SavedServo(drive.name, servo.id, table.model, table.number, firmware, values))
    return saved


def save_backup(path: Path, arm: str, servos: Sequence[SavedServo]) -> None:
    """Write a backup completely or not at all.

    Raises:
        OutputError: It cannot be written.
    """
    rows = [asdict(servo) for servo in servos]
    content = {"schema": SCHEMA, "arm": arm, "created": timestamp(), "servos": rows}
    write_atomically(path, json.dumps(content, indent=1) + "\n")


def load_backup(path: Path) -> list[SavedServo]:
    """Read and check a file of ``save_backup``.

    Raises:
        ConfigError: It cannot be read, is no backup, or has a value that its register cannot have.
    """
    return list(check_table(_BackupFile, read_json(path, "the backup"), path).servos)


_Saved = Annotated[SavedServo, keys_of(SavedServo)]


class _BackupFile(Table):
    version: SchemaVersion
    arm: str = ""
    created: str = ""
    servos: Annotated[Several[_Saved], Field(min_length=1, description="a list of servos")]

    @model_validator(mode="after")
    def _known_registers(self) -> _BackupFile:
        for k, servo in enumerate(self.servos):
            key = f"servos[{k}]"
            number = servo.model_number
            if model_by_number(number) is None:
                raise KeyProblem(f"model number {number} is unknown", f"{key}.model_number")
            for name, value in servo.registers.items():
                if name not in servo.table:
                    raise KeyProblem(f"a {servo.table.model} has no register {name!r}", key)
                lowest, highest = _value_range(servo.table[name])
                if not lowest <= value <= highest:
                    raise KeyProblem(
                        f"{value} is not right", f"{key}.registers.{name}", f"{lowest}..{highest}"
                    )
        return self


def _value_range(register: Register) -> tuple[int, int]:
    """Return the smallest and the largest value of a register in a backup."""
    if _is_restored(register):
        return register.minimum, register.maximum
    return SMALLEST_VALUE, LARGEST_VALUE


def _is_restored(register: Register) -> bool:
    return register.eeprom and register.writable and register.name not in ADDRESS


def differences(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """Return the EEPROM registers whose present value is not the saved one.  Writes nothing.

    Raises:
        ServoMismatchError: A servo is missing or is another model.  Errors of the bus.
    """
    expected = {servo.id: (servo.joint, servo.model_number) for servo in servos}
    require_models(bus, expected, "the backup")
    changes = []
    for servo in servos:
        firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
        table = control_table(servo.table.model, firmware)
        restored = [r for r in table if _is_restored(r) and r.name in servo.registers]
        present = _read(bus, servo.id, table, restored)
        changes += [
            Change(servo.joint, servo.id, name, value, servo.registers[name])
            for name, value in present.items()
            if value != servo.registers[name]
        ]
    return changes


def _read(
    bus: ServoBus, id: int, table: ControlTable, registers: Sequence[Register]
) -> dict[str, int]:
    """Return register name -> value, in few reads.

    Args:
        bus: Open bus.
        id: Servo id.
        table: Control table.
        registers: In order of address.  Bytes between them are read and dropped.
    """
    values: dict[str, int] = {}
    remaining = registers
    while remaining:
        end = remaining[0].address + BLOCK_BYTES
        group = [register for register in remaining if register.end <= end]
        remaining = remaining[len(group) :]
        block = table.block(group[0].name, group[-1].name)
        block_values = table.values(block, bus.read(id, block).data or 0)
        values |= {register.name: block_values[register.name] for register in group}
    return values


def restore(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """Restore EEPROM registers that differ, and read them back.

    Returns:
        The registers that were changed.

    Raises:
        ServoMismatchError: A servo is missing or is another model.  Nothing was written.
        ArmStateError: The torque of a servo is on.  Nothing was written.
        HardwareError: A register has another value than was written.  Errors of the bus.
    """
    changes = differences(bus, servos)
    tables = {servo.id: servo.table for servo in servos}
    for servo in servos:
        if bus.read(servo.id, servo.table["torque_enable"]).data:
            raise ArmStateError(
                f"torque of {servo.joint!r} (id {servo.id}) is on: its EEPROM is locked; nothing "
                "was written",
                hint="support the arm, then: robot-ik servo torque off",
            )
    with contextlib.ExitStack() as stack:
        for name in {table.family for table in tables.values()}:
            ids = [id for id, table in tables.items() if table.family == name]
            stack.enter_context(family_of(name).eeprom_unlocked(bus, ids))
        _write(bus, tables, changes)
    failed = [
        change
        for change in changes
        if bus.read(change.id, tables[change.id][change.register]).data != change.saved
    ]
    if failed:
        names = ", ".join(f"{change.register} of {change.joint}" for change in failed)
        raise HardwareError(
            f"these registers were written and read back with other values: {names}",
            hint="check supply and cable, and restore again",
        )
    return changes


def _write(bus: ServoBus, tables: Mapping[int, ControlTable], changes: Sequence[Change]) -> None:
    """Write saved values.  A limit may be refused until the limit at the other end is written."""
    # The operating mode first: changing it resets gains and limits that depend on it.
    remaining = sorted(changes, key=lambda change: change.register != "operating_mode")
    for is_last in (False, True):
        batch = remaining
        remaining = []
        for change in batch:
            try:
                bus.write(change.id, tables[change.id][change.register], change.saved)
            except ServoRefusedError:
                if is_last:
                    raise
                remaining.append(change)
