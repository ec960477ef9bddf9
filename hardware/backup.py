"""Control tables as files: everything a servo remembers, saved and put back.

Only EEPROM is put back; RAM is gone at power-off anyway.  Id, baud rate and protocol are how the servo is
reached: they are saved, and changed by setting a servo up, not here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_ik.errors import ArmStateError, ConfigError, HardwareError, ServoMismatchError, ServoRefusedError
from robot_ik.files import timestamp, write_atomically
from robot_ik.hardware.bus import ServoBus, joint_named
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import ControlTable, Register, control_table, model_by_number
from robot_ik.reading import read_json, shown

SCHEMA = 1
"""Of the JSON file; raised when a field changes its meaning."""

ADDRESS = ("id", "baud_rate", "protocol_type")
"""EEPROM registers that decide how a servo is reached."""

_BLOCK = 64  # bytes read at once
_PASSES = 2  # a limit may be refused until the one at the other end is written


@dataclass(frozen=True)
class SavedServo:
    """One servo's control table.

    Attributes:
        joint, id: Whose; ``number``: Model Number; ``firmware``: its version then.
        registers: Name -> value.
    """

    joint: str
    id: int
    number: int
    firmware: int
    registers: Mapping[str, int]

    @property
    def table(self) -> ControlTable:
        """The model's registers with that firmware; ``load_backup`` knows the model."""
        known = model_by_number(self.number)
        assert known is not None
        return control_table(known.model, self.firmware)


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
        ServoMismatchError: Missing servos, or other models than the arm file's.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint.
    """
    _require_models(bus, {s.id: (s.name, s.table.number) for s in config.servos})
    found = []
    with joint_named(config):
        for servo in config.servos:
            firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
            table = control_table(servo.model, firmware)
            registers = _read(bus, servo.id, [r for r in table if not r.name.startswith("indirect_data")])
            found.append(SavedServo(servo.name, servo.id, table.number, firmware, registers))
    return found


def save_backup(path: Path, arm: str, servos: Sequence[SavedServo]) -> None:
    """Writes the file whole or not at all.

    Raises:
        OutputError: It cannot be written.
    """
    rows = [
        {
            "joint": s.joint,
            "id": s.id,
            "model": s.table.model,
            "model_number": s.number,
            "firmware": s.firmware,
            "registers": dict(s.registers),
        }
        for s in servos
    ]
    content = {"schema": SCHEMA, "arm": arm, "created": timestamp(), "servos": rows}
    write_atomically(path, json.dumps(content, indent=1) + "\n")


def load_backup(path: Path) -> list[SavedServo]:
    """Reads and checks a file of ``save_backup``.

    Raises:
        ConfigError: Unreadable, not such a file, or a value that its register cannot have.
    """
    content = read_json(path, "the backup")
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise ConfigError("this is no backup of control tables", file=path, key="schema", allowed=str(SCHEMA))
    rows = content.get("servos")
    if not isinstance(rows, list) or not rows:
        raise ConfigError("no servos in it", file=path, key="servos", allowed="a list of servos")
    return [_saved(row, path, f"servos[{k}]") for k, row in enumerate(rows)]


def _saved(row: Any, path: Path, at: str) -> SavedServo:
    try:
        numbers = [row[name] for name in ("id", "model_number", "firmware")]
        registers: dict[str, Any] = dict(row["registers"])
        joint = str(row["joint"])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{error} is missing or not right", file=path, key=at, allowed="what backup has written"
        ) from None
    if not all(_whole(n) for n in numbers) or not 0 <= numbers[0] <= 252 or not 1 <= numbers[2] <= 255:
        raise ConfigError(f"{numbers} is no id, model number and firmware", file=path, key=at)
    if model_by_number(numbers[1]) is None:
        raise ConfigError(f"model number {numbers[1]} is not known here", file=path, key=f"{at}.model_number")
    servo = SavedServo(joint, numbers[0], numbers[1], numbers[2], registers)
    for name, value in registers.items():
        if name not in servo.table:
            raise ConfigError(f"a {servo.table.model} has no register {name!r}", file=path, key=at)
        register = servo.table[name]
        low, high = (register.minimum, register.maximum) if _restored(register) else (-(2**31), 2**32)
        if not _whole(value) or not low <= value <= high:
            key, allowed = f"{at}.registers.{name}", f"{low}..{high}"
            raise ConfigError(f"{shown(value)} is not right", file=path, key=key, allowed=allowed)
    return servo


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _restored(register: Register) -> bool:
    return register.eeprom and register.writable and register.name not in ADDRESS


def differences(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """EEPROM registers whose present value is not the saved one.  Writes nothing.

    Raises:
        ServoMismatchError: A servo is missing, or another model.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    _require_models(bus, {s.id: (s.joint, s.number) for s in servos})
    found = []
    for servo in servos:
        firmware = bus.read(servo.id, servo.table["firmware_version"]).data or 0
        table = control_table(servo.table.model, firmware)
        present = _read(bus, servo.id, [r for r in table if _restored(r) and r.name in servo.registers])
        found += [
            Change(servo.joint, servo.id, name, value, servo.registers[name])
            for name, value in present.items()
            if value != servo.registers[name]
        ]
    return found


def _read(bus: ServoBus, id: int, registers: Sequence[Register]) -> dict[str, int]:
    """Many registers in few reads; what lies between them is read along and thrown away."""
    values: dict[str, int] = {}
    left = sorted(registers, key=lambda register: register.address)
    while left:
        begin = left[0].address
        block = [register for register in left if register.end <= begin + _BLOCK]
        left = left[len(block) :]
        size = block[-1].end - begin
        whole = Register(f"{block[0].name} ...", begin, size, "r", False, "", False, None, 0, 0)
        data = (bus.read(id, whole).data or 0).to_bytes(size, "little")
        values |= {r.name: r.decode(data[r.address - begin : r.end - begin]) for r in block}
    return values


def restore(bus: ServoBus, servos: Sequence[SavedServo]) -> list[Change]:
    """Puts EEPROM back where it differs, and reads it back.

    Returns:
        What was changed.

    Raises:
        ServoMismatchError: A servo is missing, or another model; nothing was written.
        ArmStateError: Torque is on somewhere; nothing was written.
        HardwareError: A register reads back otherwise.
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError.
    """
    changes = differences(bus, servos)
    tables = {servo.id: servo.table for servo in servos}
    for servo in servos:
        if bus.read(servo.id, servo.table["torque_enable"]).data:
            raise ArmStateError(
                f"torque of {servo.joint!r} (id {servo.id}) is on: its EEPROM is locked; nothing was written",
                hint="support the arm, then: robot-ik servo torque off",
            )
    # The operating mode first: changing it resets gains and limits that depend on it.
    left = sorted(changes, key=lambda change: change.register != "operating_mode")
    for last in [False] * (_PASSES - 1) + [True]:
        left = [change for change in left if not _write(bus, tables[change.id], change, last)]
    wrong = [
        c
        for c in changes
        if c.register in tables[c.id] and bus.read(c.id, tables[c.id][c.register]).data != c.saved
    ]
    if wrong:
        names = ", ".join(f"{c.register} of {c.joint}" for c in wrong)
        raise HardwareError(f"written, and reads back otherwise: {names}")
    return changes


def _write(bus: ServoBus, table: ControlTable, change: Change, last: bool) -> bool:
    try:
        bus.write(change.id, table[change.register], change.saved)
    except ServoRefusedError:
        if last:
            raise
        return False
    return True


def _require_models(bus: ServoBus, wanted: Mapping[int, tuple[str, int]]) -> None:
    found: dict[int, int] = {}
    for id in wanted:
        try:
            found[id] = bus.ping(id)
        except HardwareError:
            if not bus.is_open:
                raise
    if all(found.get(id) == number for id, (_, number) in wanted.items()):
        return

    def name(number: int) -> str:
        table = model_by_number(number)
        return table.model if table else f"model number {number}"

    raise ServoMismatchError(
        {id: f"{joint}: {name(number)}" for id, (joint, number) in wanted.items()},
        {id: name(number) for id, number in found.items()},
        port=bus.port,
        source="the backup",
    )
