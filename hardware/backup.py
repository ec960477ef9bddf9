"""Control tables as files: everything a servo remembers, saved and put back.

Only EEPROM is put back; RAM is gone at power-off anyway.  Id, baud rate and protocol are how the servo is
reached: they are saved, and changed by setting a servo up, not here.
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
from robot_ik.hardware.bus import ServoBus, require_models
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import family_of
from robot_ik.hardware.models import control_table, model_by_number, model_name
from robot_ik.hardware.registers import ControlTable, Register
from robot_ik.hardware.servo import ServoId

SCHEMA = 1
"""Of the JSON file; raised when a field changes its meaning."""

ADDRESS = ("id", "baud_rate", "protocol_type", "lock")
"""EEPROM registers that decide how a servo is reached."""

_BLOCK = 64  # bytes read at once


@dataclass(frozen=True)
class SavedServo:
    """One servo's control table, as a table of the file.

    Attributes:
        joint, id: Whose; ``firmware``: its version then.
        registers: Name -> value.
    """

    joint: str
    id: ServoId
    model: str
    model_number: int
    firmware: Annotated[int, Field(ge=1, le=255)]
    registers: dict[str, int]

    @property
    def table(self) -> ControlTable:
        """The model's registers with that firmware; of a model that is known here."""
        return control_table(model_name(self.model_number), self.firmware)


@dataclass(frozen=True)
class Change:
    """One register that differs from the file."""

    joint: str
    id: int
    register: str
    present: int
    saved: int


def read_tables(bus: ServoBus, config: ArmConfig) -> list[SavedServo]:
    """Reads every register of every servo of the arm.

    Raises:
        ServoMismatchError: Missing servos, or other models than the arm file's.  Errors of the bus, by joint.
    """
    require_models(
        bus, {drive.id: (drive.name, drive.servo.table.number) for drive in config.drives}, "the arm file"
    )
    found = []
    for name, servo in ((drive.name, drive.servo) for drive in config.drives):
        firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
        table = control_table(servo.model, firmware)
        registers = _read(bus, servo.id, table, [r for r in table if "indirect_data" not in r.name])
        found.append(SavedServo(name, servo.id, table.model, table.number, firmware, registers))
    return found


def save_backup(path: Path, arm: str, servos: Sequence[SavedServo]) -> None:
    """Writes the file whole or not at all; raises ``OutputError`` where it cannot."""
    rows = [asdict(servo) for servo in servos]
    content = {"schema": SCHEMA, "arm": arm, "created": timestamp(), "servos": rows}
    write_atomically(path, json.dumps(content, indent=1) + "\n")


def load_backup(path: Path) -> list[SavedServo]:
    """Reads and checks a file of ``save_backup``.

    Raises:
        ConfigError: Unreadable, not such a file, or a value that its register cannot have.
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
            at, number = f"servos[{k}]", servo.model_number
            if model_by_number(number) is None:
                raise KeyProblem(f"model number {number} is not known here", f"{at}.model_number")
            for name, value in servo.registers.items():
                if name not in servo.table:
                    raise KeyProblem(f"a {servo.table.model} has no register {name!r}", at)
                register = servo.table[name]
                low, high = (register.minimum, register.maximum) if _restored(register) else (-(2**31), 2**32)
                if not low <= value <= high:
                    raise KeyProblem(f"{value} is not right", f"{at}.registers.{name}", f"{low}..{high}")
        return self


def _restored(register: Register) -> bool:
    return register.eeprom and register.writable and register.name not in ADDRESS


def differences(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """EEPROM registers whose present value is not the saved one.  Writes nothing.

    Raises:
        ServoMismatchError: A servo is missing, or another model.  Errors of the bus.
    """
    require_models(bus, {s.id: (s.joint, s.model_number) for s in servos}, "the backup")
    found = []
    for servo in servos:
        firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
        table = control_table(servo.table.model, firmware)
        restored = [r for r in table if _restored(r) and r.name in servo.registers]
        present = _read(bus, servo.id, table, restored)
        found += [
            Change(servo.joint, servo.id, name, value, servo.registers[name])
            for name, value in present.items()
            if value != servo.registers[name]
        ]
    return found


def _read(bus: ServoBus, id: int, table: ControlTable, registers: Sequence[Register]) -> dict[str, int]:
    """Many registers, in order of address, in few reads; what lies between them is thrown away."""
    values: dict[str, int] = {}
    left = registers
    while left:
        block = [register for register in left if register.end <= left[0].address + _BLOCK]
        left = left[len(block) :]
        whole = table.block(block[0].name, block[-1].name)
        found = table.values(whole, bus.read(id, whole).data or 0)
        values |= {r.name: found[r.name] for r in block}
    return values


def restore(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """Puts EEPROM back where it differs, and reads it back.

    Returns:
        What was changed.

    Raises:
        ServoMismatchError: A servo is missing, or another model; nothing was written.
        ArmStateError: Torque is on somewhere; nothing was written.
        HardwareError: A register reads back otherwise.  Errors of the bus.
    """
    changes = differences(bus, servos)
    tables = {servo.id: servo.table for servo in servos}
    for servo in servos:
        if bus.read(servo.id, servo.table["torque_enable"]).data:
            raise ArmStateError(
                f"torque of {servo.joint!r} (id {servo.id}) is on: its EEPROM is locked; nothing was written",
                hint="support the arm, then: robot-ik servo torque off",
            )
    families = {table.family for table in tables.values()}
    with contextlib.ExitStack() as stack:
        for name in families:
            ids = [id for id, table in tables.items() if table.family == name]
            stack.enter_context(family_of(name).eeprom_unlocked(bus, ids))
        _write(bus, tables, changes)
    wrong = [c for c in changes if bus.read(c.id, tables[c.id][c.register]).data != c.saved]
    if wrong:
        names = ", ".join(f"{c.register} of {c.joint}" for c in wrong)
        raise HardwareError(f"written, and reads back otherwise: {names}")
    return changes


def _write(bus: ServoBus, tables: Mapping[int, ControlTable], changes: Sequence[Change]) -> None:
    """Write saved values.  A limit may be refused until the one at the other end is written."""
    # The operating mode first: changing it resets gains and limits that depend on it.
    left = sorted(changes, key=lambda change: change.register != "operating_mode")
    for is_last in (False, True):
        changing = left
        left = []
        for change in changing:
            try:
                bus.write(change.id, tables[change.id][change.register], change.saved)
            except ServoRefusedError:
                if is_last:
                    raise
                left.append(change)
