"""Control tables of Dynamixel X servos, as data.

A control table is the memory of a servo: a register is a named, typed piece of it.  One shared table of the
X series plus the few differences of each model and firmware; a new model is one row in
``x_series``.  ROBOTIS e-manual, pages of the models; names are the manual's in snake_case.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property, lru_cache
from types import MappingProxyType

from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.hardware.x_series import (
    MODELS,
    REVERSE,
    SLAVE,
    TIME_BASED,
    TORQUE_BY_GOAL,
    Indirect,
    Model,
    Motor,
    Row,
)
from robot_ik.reading import WrongKey

TICKS_PER_REVOLUTION = 4096
RADIANS_PER_TICK = 2.0 * math.pi / TICKS_PER_REVOLUTION
VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""One unit of the velocity registers: 0.229 rev/min, in rad/s."""
ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0
"""One unit of the acceleration registers: 214.577 rev/min^2, in rad/s^2."""
MULTI_TURN_TICKS = 1_048_575
"""Largest goal in the extended modes: 256 revolutions either way."""

IDS = range(253)
"""Ids that a servo can have."""

BAUD_RATES: Mapping[int, int] = MappingProxyType(
    {0: 9_600, 1: 57_600, 2: 115_200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000}
)
"""Value of the Baud Rate register -> bits per second."""

BAUD_CODES: Mapping[int, int] = MappingProxyType({rate: code for code, rate in BAUD_RATES.items()})
"""Bits per second -> value of the Baud Rate register."""

HARDWARE_ERRORS: Mapping[int, str] = MappingProxyType(
    {0: "input_voltage", 2: "overheating", 3: "motor_encoder", 4: "electrical_shock", 5: "overload"}
)
"""Bit of Hardware Error Status and Shutdown -> name."""


TRIPPED = -1
"""What Bus Watchdog reads once it has run out."""
RETURN_READ, RETURN_ALL = 1, 2
"""What a servo answers at each Status Return Level: 0 ping only, 1 also reads, 2 everything."""


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
    """A named piece of a servo's memory, or a block of bytes that are read at once.

    Attributes:
        name: The manual's name in snake_case.
        address: Of its first byte.
        size: In bytes: 1, 2 or 4, little-endian.
        writable: It can be written, too.
        signed: Two's complement.
        unit: What one count means, as text.
        eeprom: Kept without power, and locked while torque is on.
        initial: Factory value; ``None`` where it depends on the state of the servo.
        minimum, maximum: Smallest and largest value a write may have; limits that depend on other registers
            are the servo's affair.
        sign_bit: Sign-magnitude coding: this bit is the sign and the bits below are the absolute value.
    """

    name: str
    address: int
    size: int
    writable: bool = False
    signed: bool = False
    unit: str = ""
    eeprom: bool = False
    initial: int | None = None
    minimum: int = 0
    maximum: int = 0
    sign_bit: int | None = None

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
        return self.decode_raw(int.from_bytes(data, "little"))

    def decode_raw(self, raw: int) -> int:
        """Return the value of the unsigned integer that the bytes form."""
        if self.sign_bit is not None:
            magnitude = raw & ((1 << self.sign_bit) - 1)
            return -magnitude if raw >> self.sign_bit & 1 else magnitude
        if self.signed and raw >> (8 * self.size - 1):
            return raw - (1 << 8 * self.size)
        return raw

    def take_apart(self, value: int, registers: Iterable[Register]) -> dict[str, int]:
        """Name -> value of registers that lie within this block, from its value."""
        data = value.to_bytes(self.size, "little", signed=self.signed)
        return {r.name: r.decode(data[r.address - self.address : r.end - self.address]) for r in registers}

    def encode(self, value: int) -> bytes:
        """``size`` little-endian bytes of a value.

        Raises:
            ValueError: The value does not fit into the register's bytes.
        """
        try:
            if self.sign_bit is not None:
                magnitude = abs(int(value))
                if magnitude >> self.sign_bit:
                    raise OverflowError
                sign = (1 << self.sign_bit) if value < 0 else 0
                return (magnitude | sign).to_bytes(self.size, "little")
            return int(value).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            kind = "signed" if self.signed else "unsigned"
            raise ValueError(f"{value} does not fit into {self.name} ({self.size} bytes, {kind})") from None


@dataclass(frozen=True)
class ControlTable:
    """All registers of one model with one firmware.

    Attributes:
        model: Name, e.g. ``"XM430-W350"``; ``number``: what Model Number reads.
        firmware: What Firmware Version reads.
        registers: By name, in order of address.
        modes: Operating modes the model has.
        supply: Nominal supply, V; ``motor``: what it can do.
        abilities: What this firmware can do: ``fast_read``, ``backup``, ``guarded_reset``, ``clear``.
    """

    model: str
    number: int
    firmware: int
    registers: Mapping[str, Register]
    modes: tuple[OperatingMode, ...]
    supply: float
    motor: Motor
    abilities: frozenset[str]
    family: str = "dynamixel_x"
    baud_codes: Mapping[int, int] = field(default_factory=lambda: BAUD_RATES)

    def __getitem__(self, name: str) -> Register:
        try:
            return self.registers[name]
        except KeyError:
            hint = did_you_mean(name, self.registers)
            raise KeyError(f"{self.model} has no register {name!r}; {hint}".removesuffix("; ")) from None

    def __contains__(self, name: object) -> bool:
        return name in self.registers

    def __iter__(self) -> Iterator[Register]:
        return iter(self.registers.values())

    @property
    def size(self) -> int:
        """Address after the last register."""
        return max(register.end for register in self)

    @property
    def baud_rates(self) -> tuple[int, ...]:
        """Bits per second the model can be set to."""
        return tuple(rate for code, rate in self.baud_codes.items() if code <= self["baud_rate"].maximum)

    @cached_property
    def current_unit(self) -> float:
        """mA of one count of the current registers; 0 where there are none."""
        return float(self["goal_current"].unit.split()[0]) if "goal_current" in self else 0.0

    def block(self, first: str, last: str) -> Register:
        """All bytes from one register to the end of another, to be read at once."""
        begin = self[first].address
        return Register(f"{first} to {last}", begin, self[last].end - begin)

    def values(self, block: Register, value: int) -> dict[str, int]:
        """Name -> value of the registers that lie within a block, from the value of the block."""
        return block.take_apart(value, (r for r in self if block.address <= r.address and r.end <= block.end))


def _register(row: Row) -> Register:
    name, address, size, flags, unit, initial, minimum, maximum = row
    writable, signed, eeprom = "r" not in flags, "s" in flags, address < 64
    return Register(name, address, size, writable, signed, unit, eeprom, initial, minimum, maximum)


def _indirect(blocks: list[Indirect]) -> Iterator[Register]:
    """Indirect Address k initially points at Indirect Data k (itself); it may point at RAM only."""
    last = max(block.data + block.count for block in blocks) - 1
    pairs = [(b.addresses + 2 * k, b.data + k) for b in blocks for k in range(b.count)]
    for number, (address, data) in enumerate(pairs, 1):
        yield _register((f"indirect_address_{number}", address, 2, "", "address", data, 64, last))
        yield _register((f"indirect_data_{number}", data, 1, "", "", 0, 0, 255))


_DRIVE_BITS = {"reverse": REVERSE, "slave": SLAVE, "time_based": TIME_BASED, "torque_by_goal": TORQUE_BY_GOAL}
_ABILITIES = ("fast_read", "backup", "guarded_reset", "clear")


def _build(model: str, row: Model, firmware: int | None = None) -> ControlTable:
    family = row.family
    firmware = family.firmware if firmware is None else firmware
    missing = {name for name, since in family.since.items() if firmware < since}
    registers = {r.name: r for r in map(_register, row.rows) if r.name not in missing}
    bits = sum(bit for name, bit in _DRIVE_BITS.items() if name in family.since and name not in missing)
    own: dict[str, Mapping[str, object]] = {
        "model_number": {"initial": row.number},
        "firmware_version": {"initial": firmware},
        "drive_mode": {"maximum": bits},
    }
    for name, change in (*row.changed.items(), *own.items()):
        if name in registers:
            registers[name] = replace(registers[name], **change)  # type: ignore[arg-type]
    blocks = [b for b in family.indirect if b.since <= firmware < b.below]
    every = sorted((*registers.values(), *_indirect(blocks)), key=lambda register: register.address)
    return ControlTable(
        model,
        row.number,
        firmware,
        MappingProxyType({register.name: register for register in every}),
        tuple(OperatingMode(mode) for mode in row.modes),
        row.supply,
        row.motor,
        frozenset(a for a in _ABILITIES if a not in missing),
    )


CONTROL_TABLES: Mapping[str, ControlTable] = MappingProxyType(
    {model: _build(model, row) for model, row in MODELS.items()}
)
"""Model name -> its control table with the firmware this project assumes."""

X_SERIES = CONTROL_TABLES["XM430-W350"]
"""For what lies at the same address in all of them: torque, errors, what is measured."""


def require_id(id: int, key: str) -> None:
    """Raises ``ConfigError`` for an id that no servo can have; ``key``: the option that names it."""
    if id not in IDS:
        raise ConfigError(f"{id} is no servo id", file="command line", key=key, allowed=f"0..{IDS[-1]}")


def model_by_number(number: int) -> ControlTable | None:
    """The table of the model whose Model Number register reads ``number``; ``None`` if unknown here."""
    return next((table for table in known_tables().values() if table.number == number), None)


def model_name(number: int) -> str:
    """Of the model whose Model Number register reads ``number``, or what is known of it."""
    table = model_by_number(number)
    return table.model if table else f"model number {number}"


@lru_cache(maxsize=1)
def known_tables() -> Mapping[str, ControlTable]:
    """Return model name -> control table, for the models of every servo family."""
    from robot_ik.hardware.families.feetech_sts_table import STS3215  # it imports this file

    return MappingProxyType({**CONTROL_TABLES, STS3215.model: STS3215})


@lru_cache(maxsize=64)
def control_table(model: str, firmware: int | None = None) -> ControlTable:
    """The table of a model by name, with another firmware if asked.

    Raises:
        ConfigError: No such model here, or no such firmware.
    """
    tables = known_tables()
    if model not in tables:
        raise WrongKey.unknown("servo model", model, tables).in_file("control_table")
    if firmware is None or model not in MODELS:
        return tables[model]
    if not 1 <= firmware <= 255:
        raise ConfigError(f"no firmware has the number {firmware}", file="control_table", allowed="1..255")
    return _build(model, MODELS[model], firmware)
