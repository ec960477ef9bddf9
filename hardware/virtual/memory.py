"""The memory of a virtual servo: bytes of a control table, and checks before a write."""

from __future__ import annotations

from robot_ik.hardware.families.dynamixel_x_table import TIME_BASED, TRIPPED
from robot_ik.hardware.registers import ControlTable, OperatingMode, Register
from robot_ik.hardware.virtual.protocol import ErrorCode

PROFILE = ("profile_acceleration", "profile_velocity")
"""Registers that are 0 after the Bus Watchdog has tripped.

ROBOTIS e-manual, x/bus_watchdog: "when it stops, [both] are set to 0". An older page: "applied as
0".
"""
CONTROLLER = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
    *PROFILE,
)
"""Gains and profile: another operating mode resets them, and a backup keeps them.

Protocol 2.0 manual, "Control Table Backup". The backup also keeps the indirect addresses.
"""

PROTOCOL_2 = 2
"""Protocol Type of a servo that speaks Protocol 2.0."""
RC_PROTOCOLS = 20
"""First Protocol Type of a remote control (20 to 22, of the 330 family)."""

_LONGEST_RAMP = 32_737
"""ms. Largest Profile Acceleration of a time-based profile."""


def _pointer(register: Register) -> bool:
    return register.name.startswith("indirect_address_")


class Memory:
    """Bytes of one servo.

    Attributes:
        first_indirect: Address of the first byte that may stand for another byte.
        values: Register name -> value. Only ``set`` changes it.
    """

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self._bytes = bytearray(table.size)
        # The same values decoded: the servo itself reads registers far more often than the host.
        self.values: dict[str, int] = {}
        self._registers = dict(table.registers)
        self._at = {register.address: register for register in table}
        self._defined = bytearray(table.size)
        for register in table:
            self._defined[register.address : register.end] = b"\x01" * register.size
        self._pointers = {
            table[name.replace("address", "data")].address: table[name]
            for name in table.registers
            if _pointer(table[name])
        }
        self.first_indirect = min(self._pointers, default=table.size)
        self.reset(eeprom=True)

    def reset(self, *, eeprom: bool, keep: tuple[str, ...] = ()) -> None:
        """Set RAM to its values after a power cycle.

        Args:
            eeprom: Also set EEPROM to its factory values.
            keep: Names of registers that keep their values.
        """
        for register in self.table:
            if (eeprom or not register.eeprom) and register.name not in keep:
                self.set(register.name, register.initial or 0)

    def backup(self) -> dict[str, int]:
        """Return what Control Table Backup keeps: EEPROM, gains, profile, indirect addresses."""
        kept = (
            r
            for r in self.table
            if r.writable and (r.eeprom or r.name in CONTROLLER or _pointer(r))
        )
        return {r.name: self.values[r.name] for r in kept}

    def drives(self, bit: int) -> bool:
        """Return whether a bit of Drive Mode is set."""
        return bool(self.values.get("drive_mode", 0) & bit)

    def set(self, name: str, value: int) -> None:
        """Set a register without any check except its size."""
        register = self._registers[name]
        first = register.address
        size = register.size
        self._bytes[first : first + size] = value.to_bytes(size, "little", signed=register.signed)
        self.values[name] = value

    def read(self, address: int, length: int) -> tuple[bytes, ErrorCode]:
        """Return the bytes of any range. Gaps between registers read 0.

        A range that ends beyond the table or contains no register is an access error.
        """
        end = address + length
        if length == 0 or end > len(self._bytes) or not any(self._defined[address:end]):
            return b"", ErrorCode.ACCESS if length else ErrorCode.DATA_LENGTH
        if end <= self.first_indirect:
            return bytes(self._bytes[address:end]), ErrorCode.NONE
        return bytes(self._bytes[self._resolve(a)] for a in range(address, end)), ErrorCode.NONE

    def spans(self, address: int, length: int) -> list[tuple[int, int]]:
        """Return the ranges (first, end) of memory that a range stands for.

        Indirect data stand for bytes at other addresses.
        """
        if address + length <= self.first_indirect:
            return [(address, address + length)]
        spans: list[tuple[int, int]] = []
        for a in range(address, address + length):
            real = self._resolve(a)
            if spans and spans[-1][1] == real:
                spans[-1] = (spans[-1][0], real + 1)
            else:
                spans.append((real, real + 1))
        return spans

    def parse_write(
        self, address: int, data: bytes
    ) -> tuple[list[tuple[Register, int]], ErrorCode]:
        """Return what a write would set, after every check.

        If one register refuses its value, the write sets nothing.
        """
        register = self._at.get(address)
        if register is not None and register.size == len(data) and address not in self._pointers:
            error = self._refusal(register, value := register.decode(data))
            return ([], error) if error else ([(register, value)], ErrorCode.NONE)
        values: list[tuple[Register, int]] = []
        if not data:
            return [], ErrorCode.DATA_LENGTH
        if address + len(data) > len(self._bytes):
            return [], ErrorCode.ACCESS
        done = 0
        for first, end in self.spans(address, len(data)):
            at = first
            while at < end:
                register = self._at.get(at)
                if register is None:
                    return [], ErrorCode.DATA_LENGTH if self._defined[at] else ErrorCode.ACCESS
                if register.end > end:
                    return [], ErrorCode.DATA_LENGTH
                value = register.decode(data[done : done + register.size])
                error = self._refusal(register, value)
                if error:
                    return [], error
                values.append((register, value))
                at = register.end
                done = done + register.size
        return values, ErrorCode.NONE

    def _refusal(self, register: Register, value: int) -> ErrorCode:
        """Return why a register refuses a value: access, range, or the state of other registers."""
        values = self.values
        name = register.name
        if not register.writable or (register.eeprom and values["torque_enable"]):
            return ErrorCode.ACCESS
        if not register.minimum <= value <= register.maximum:
            return ErrorCode.DATA_RANGE
        tripped = values.get("bus_watchdog") == TRIPPED
        error = ErrorCode.DATA_RANGE
        refused = False
        match name:
            case "bus_watchdog":
                refused = tripped and value != 0
            case "operating_mode":
                refused = value not in self.table.modes
            case "protocol_type":
                refused = PROTOCOL_2 < value < RC_PROTOCOLS
            case "drive_mode":
                refused = bool(value & ~register.maximum)
            case "profile_acceleration":
                refused = self.drives(TIME_BASED) and value > _LONGEST_RAMP
            case "goal_position" | "goal_velocity" | "goal_current" | "goal_pwm" if tripped:
                refused = True
            case "goal_position" if values["operating_mode"] == OperatingMode.POSITION:
                error = ErrorCode.DATA_LIMIT
                refused = not values["min_position_limit"] <= value <= values["max_position_limit"]
            case "goal_velocity" | "goal_current" | "goal_pwm":
                error = ErrorCode.DATA_LIMIT
                refused = abs(value) > values[name.removeprefix("goal_") + "_limit"]
        return error if refused else ErrorCode.NONE

    def _resolve(self, address: int) -> int:
        """Return the real address of a byte.

        A pointer that leads out of the table has no effect.
        """
        pointer = self._pointers.get(address)
        if pointer is None:
            return address
        target = self.values[pointer.name]
        return target if target < len(self._bytes) else address
