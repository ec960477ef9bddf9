"""Control tables of Dynamixel X servos, as data.

A control table is the memory of a servo: a register is a named, typed piece of it.  One shared table of the
X series plus the few differences of each model; a new model is one row in ``control_table_data``.
Source: ROBOTIS e-manual, pages of the models named below; names are the manual's in snake_case.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType

from robot_ik.errors import ConfigError, close_matches
from robot_ik.hardware.control_table_data import MODELS, SHARED, Model, Row

TICKS_PER_TURN = 4096
RADIANS_PER_TICK = 2.0 * math.pi / TICKS_PER_TURN
VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""One unit of the velocity registers: 0.229 rev/min, in rad/s."""
ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0
"""One unit of the acceleration registers: 214.577 rev/min^2, in rad/s^2."""
WATCHDOG_UNIT = 0.020
"""One unit of Bus Watchdog, in s."""
MULTI_TURN_TICKS = 1_048_575
"""Largest goal in the extended modes: 256 turns either way."""

BAUD_RATES: Mapping[int, int] = MappingProxyType(
    {0: 9_600, 1: 57_600, 2: 115_200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000}
)
"""Value of the Baud Rate register -> bits per second."""

HARDWARE_ERRORS: Mapping[int, str] = MappingProxyType(
    {0: "input_voltage", 2: "overheating", 3: "motor_encoder", 4: "electrical_shock", 5: "overload"}
)
"""Bit of Hardware Error Status and Shutdown -> name."""


class OperatingMode(IntEnum):
    """Values of the Operating Mode register."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


def hardware_error_names(value: int) -> tuple[str, ...]:
    """Names of the bits set in Hardware Error Status; unused bits appear as ``bit1`` and so on."""
    return tuple(HARDWARE_ERRORS.get(bit, f"bit{bit}") for bit in range(8) if value >> bit & 1)


@dataclass(frozen=True)
class Register:
    """A named piece of a servo's memory.

    Attributes:
        name: The manual's name in snake_case.
        address: Of its first byte.
        size: In bytes: 1, 2 or 4, little-endian.
        access: ``"r"`` or ``"rw"``.
        signed: Two's complement.
        unit: What one count means, in words.
        eeprom: Kept without power, and locked while torque is on.
        initial: Factory value; ``None`` where it depends on the state of the servo.
        minimum, maximum: Smallest and largest value a write may have; limits that depend on other registers
            are the servo's affair.
    """

    name: str
    address: int
    size: int
    access: str
    signed: bool
    unit: str
    eeprom: bool
    initial: int | None
    minimum: int
    maximum: int

    @property
    def writable(self) -> bool:
        return self.access == "rw"

    @property
    def end(self) -> int:
        """Address after the last byte."""
        return self.address + self.size

    def decode(self, data: bytes) -> int:
        """The value of ``size`` little-endian bytes.

        Raises:
            ValueError: Another number of bytes.
        """
        if len(data) != self.size:
            raise ValueError(f"{self.name} has {self.size} bytes, not {len(data)}")
        return int.from_bytes(data, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """``size`` little-endian bytes of a value.

        Raises:
            ValueError: The value does not fit into the register's bytes.
        """
        try:
            return int(value).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            kind = "signed" if self.signed else "unsigned"
            raise ValueError(f"{value} does not fit into {self.name} ({self.size} bytes, {kind})") from None


@dataclass(frozen=True)
class ControlTable:
    """All registers of one model.

    Attributes:
        model: Name, e.g. ``"XM430-W350"``; ``number``: what Model Number reads.
        registers: By name, in order of address.
        modes: Operating modes the model has; ``baud_codes``: values its Baud Rate register takes.
        supply: Nominal supply, V.
    """

    model: str
    number: int
    registers: Mapping[str, Register]
    modes: tuple[OperatingMode, ...]
    baud_codes: tuple[int, ...]
    supply: float
    _sorted: tuple[Register, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ordered = tuple(sorted(self.registers.values(), key=lambda r: r.address))
        object.__setattr__(self, "_sorted", ordered)
        object.__setattr__(self, "registers", MappingProxyType({r.name: r for r in ordered}))

    def __getitem__(self, name: str) -> Register:
        try:
            return self.registers[name]
        except KeyError:
            close = close_matches(name, self.registers)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise KeyError(f"{self.model} has no register {name!r}{hint}") from None

    def __contains__(self, name: object) -> bool:
        return name in self.registers

    def __iter__(self) -> Iterator[Register]:
        return iter(self._sorted)

    @property
    def size(self) -> int:
        """Address after the last register."""
        return self._sorted[-1].end

    @property
    def baud_rates(self) -> tuple[int, ...]:
        """Bits per second the model can be set to."""
        return tuple(BAUD_RATES[code] for code in self.baud_codes)


def _register(row: Row) -> Register:
    name, address, size, flags, unit, initial, minimum, maximum = row
    access = "r" if "r" in flags else "rw"
    return Register(name, address, size, access, "s" in flags, unit, address < 64, initial, minimum, maximum)


def _indirect(blocks: tuple[tuple[int, int, int], ...]) -> Iterator[Register]:
    """Indirect Address k initially points at Indirect Data k (itself)."""
    number = 0
    for addresses, data, count in blocks:
        for k in range(count):
            number += 1
            pointer = (f"indirect_address_{number}", addresses + 2 * k, 2, "", "address", data + k, 0, 65535)
            yield _register(pointer)
            yield _register((f"indirect_data_{number}", data + k, 1, "", "", 0, 0, 255))


def _build(model: str, row: Model) -> ControlTable:
    registers = {r.name: r for r in map(_register, (*SHARED, *row.added)) if r.name not in row.removed}
    for name, change in {**row.changed, "model_number": {"initial": row.number}}.items():
        registers[name] = replace(registers[name], **change)  # type: ignore[arg-type]
    registers.update((r.name, r) for r in _indirect(row.indirect))
    modes = tuple(OperatingMode(mode) for mode in row.modes)
    return ControlTable(model, row.number, registers, modes, row.baud_codes, row.supply)


CONTROL_TABLES: Mapping[str, ControlTable] = MappingProxyType(
    {model: _build(model, row) for model, row in MODELS.items()}
)
"""Model name -> its control table."""

_BY_NUMBER = {table.number: table for table in CONTROL_TABLES.values()}


def model_by_number(number: int) -> ControlTable | None:
    """The table of the model whose Model Number register reads ``number``; ``None`` if unknown here."""
    return _BY_NUMBER.get(number)


def control_table(model: str) -> ControlTable:
    """The table of a model by name.

    Raises:
        ConfigError: No such model here.
    """
    try:
        return CONTROL_TABLES[model]
    except KeyError:
        close = close_matches(model, CONTROL_TABLES)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        raise ConfigError(
            f"unknown servo model {model!r}",
            file="control_table",
            allowed=", ".join(CONTROL_TABLES),
            hint=hint,
        ) from None
