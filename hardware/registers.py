"""Registers and control tables: the memory of a servo, as data.

A control table is the memory of one servo model.  A register is a named, typed piece of it.
Register names mean the same in every servo family.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

from robot_ik.errors import did_you_mean

TICKS_PER_REVOLUTION = 4096
"""Ticks of a servo revolution."""

RADIANS_PER_TICK = 2.0 * math.pi / TICKS_PER_REVOLUTION
"""Shaft angle of one tick, rad."""

MULTI_TURN_TICKS = 1_048_575
"""Largest goal in the modes of many revolutions: 256 revolutions in each direction."""

IDS = range(253)
"""Ids that a servo can have."""


class OperatingMode(IntEnum):
    """How a servo moves.  The values are those of the Operating Mode register of Dynamixel X."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


@dataclass(frozen=True)
class Motor:
    """A motor with its gear, seen at the output shaft.

    Attributes:
        stall_torque: N m, and ``stall_current``, A, at ``volts``.
        no_load_rpm: rev/min at ``volts``.
        volts: At which these were measured, V.
        sensed_at_supply: Present Current is the current of the supply, not of the motor.
    """

    stall_torque: float
    stall_current: float
    no_load_rpm: float
    volts: float
    sensed_at_supply: bool = False

    @property
    def torque_per_ampere(self) -> float:
        """N m at the shaft for an ampere through the motor; gear friction is in it."""
        return self.stall_torque / self.stall_current

    def stall_at(self, volts: float) -> float:
        """Stall torque, N m, at another supply."""
        return self.stall_torque * volts / self.volts

    @property
    def no_load_speed(self) -> float:
        """rad/s at ``volts``."""
        return self.no_load_rpm * (2.0 * math.pi / 60.0)


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
        minimum: Smallest value that a write may have.  The servo checks limits that depend on other
            registers.
        maximum: Largest value that a write may have.
        sign_bit: Sign-magnitude coding: this bit is the sign and the bits below are the absolute
            value.
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
        return {
            r.name: r.decode(data[r.address - self.address : r.end - self.address])
            for r in registers
        }

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
            raise ValueError(
                f"{value} does not fit into {self.name} ({self.size} bytes, {kind})"
            ) from None


@dataclass(frozen=True)
class ControlTable:
    """All registers of one model with one firmware.

    Attributes:
        model: Name, e.g. ``"XM430-W350"``; ``number``: what Model Number reads.
        firmware: What Firmware Version reads.
        registers: By name, in order of address.
        modes: Operating modes the model has.
        supply: Nominal supply, V; ``motor``: what it can do.
        abilities: What this firmware can do: ``fast_read``, ``backup``, ``guarded_reset``,
            ``clear``.
        family: Name of the servo family.
        baud_codes: Value of the Baud Rate register -> bit/s.
        position_mode_homing: Largest Homing Offset that counts in position mode, ticks; None: any.
    """

    model: str
    number: int
    firmware: int
    registers: Mapping[str, Register]
    modes: tuple[OperatingMode, ...]
    supply: float
    motor: Motor
    abilities: frozenset[str]
    family: str
    baud_codes: Mapping[int, int]
    position_mode_homing: int | None = None

    def __getitem__(self, name: str) -> Register:
        try:
            return self.registers[name]
        except KeyError:
            hint = did_you_mean(name, self.registers)
            raise KeyError(
                f"{self.model} has no register {name!r}; {hint}".removesuffix("; ")
            ) from None

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
        return tuple(
            rate for code, rate in self.baud_codes.items() if code <= self["baud_rate"].maximum
        )

    def baud_code(self, rate: int) -> int:
        """Return the value of the Baud Rate register for a rate of ``baud_rates``, bit/s."""
        return next(code for code, known in self.baud_codes.items() if known == rate)

    @cached_property
    def current_unit(self) -> float:
        """mA of one count of the current registers; 0 if the servo measures no current."""
        if "present_current" not in self:
            return 0.0
        return float(self["present_current"].unit.split()[0])

    @property
    def largest_current(self) -> float:
        """Largest current that can be asked for, mA; 0 if the servo measures no current."""
        if not self.current_unit:
            return 0.0
        name = "goal_current" if "goal_current" in self else "present_current"
        return self[name].maximum * self.current_unit

    def block(self, first: str, last: str) -> Register:
        """All bytes from one register to the end of another, to be read at once."""
        begin = self[first].address
        return Register(f"{first} to {last}", begin, self[last].end - begin)

    def values(self, block: Register, value: int) -> dict[str, int]:
        """Name -> value of the registers that lie within a block, from the value of the block."""
        return block.take_apart(
            value, (r for r in self if block.address <= r.address and r.end <= block.end)
        )
