"""The memory of a virtual servo: bytes behind a control table, and the checks before a write."""

from __future__ import annotations

from robot_ik.hardware.families.dynamixel_x_table import TIME_BASED, TRIPPED
from robot_ik.hardware.registers import ControlTable, OperatingMode, Register
from robot_ik.hardware.virtual.protocol import ErrorCode

PROFILE = ("profile_acceleration", "profile_velocity")
"""0 once the Bus Watchdog has tripped: "when it stops, [both] are set to 0" (ROBOTIS
e-manual, x/bus_watchdog; an older page: "applied as 0")."""
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
"""Gains and profile: another operating mode resets them, and a backup keeps them (Protocol 2.0 manual,
"Control Table Backup"; the indirect addresses come on top)."""

PROTOCOL_2, RC_PROTOCOLS = 2, 20
"""Protocol Type: the usual one, and the first of those of remote controls (20 to 22, of the 330 family)."""

_LONGEST_RAMP = 32_737  # ms; Profile Acceleration of a time-based profile


def _pointer(register: Register) -> bool:
    return register.name.startswith("indirect_address_")


class Memory:
    """Bytes of one servo.

    Attributes:
        first_indirect: Address of the first byte that may stand for another.
        values: Register name -> value; change it by ``set`` only.
    """

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self._bytes = bytearray(table.size)
        # The same once more, decoded: a servo asks itself far more often than it is asked.
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
        """Factory values: of RAM as after a power cycle, and of EEPROM too if asked."""
        for register in self.table:
            if (eeprom or not register.eeprom) and register.name not in keep:
                self.set(register.name, register.initial or 0)

    def backup(self) -> dict[str, int]:
        """What Control Table Backup keeps: EEPROM, gains, profile, indirect addresses."""
        kept = (r for r in self.table if r.writable and (r.eeprom or r.name in CONTROLLER or _pointer(r)))
        return {r.name: self.values[r.name] for r in kept}

    def drives(self, bit: int) -> bool:
        """Whether a bit of Drive Mode is set."""
        return bool(self.values.get("drive_mode", 0) & bit)

    def set(self, name: str, value: int) -> None:
        """Sets a register as the servo itself does: without any check but its size."""
        register = self._registers[name]
        first, size = register.address, register.size
        self._bytes[first : first + size] = value.to_bytes(size, "little", signed=register.signed)
        self.values[name] = value

    def read(self, address: int, length: int) -> tuple[bytes, ErrorCode]:
        """Bytes of any range; gaps between registers read 0.

        Nothing is readable behind the table or where no register is at all (access error).
        """
        end = address + length
        if length == 0 or end > len(self._bytes) or not any(self._defined[address:end]):
            return b"", ErrorCode.ACCESS if length else ErrorCode.DATA_LENGTH
        if end <= self.first_indirect:
            return bytes(self._bytes[address:end]), ErrorCode.NONE
        return bytes(self._bytes[self._resolve(a)] for a in range(address, end)), ErrorCode.NONE

    def spans(self, address: int, length: int) -> list[tuple[int, int]]:
        """Ranges (first, end) of real memory that a range stands for; indirect data point elsewhere."""
        if address + length <= self.first_indirect:
            return [(address, address + length)]
        found: list[tuple[int, int]] = []
        for a in range(address, address + length):
            real = self._resolve(a)
            if found and found[-1][1] == real:
                found[-1] = (found[-1][0], real + 1)
            else:
                found.append((real, real + 1))
        return found

    def parse_write(self, address: int, data: bytes) -> tuple[list[tuple[Register, int]], ErrorCode]:
        """What a write would set, after every check; all of it is good or none is done."""
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
                at, done = register.end, done + register.size
        return values, ErrorCode.NONE

    def _refusal(self, register: Register, value: int) -> ErrorCode:
        """Why a register does not take a value: its own access and range, then the other registers."""
        values, name = self.values, register.name
        if not register.writable or (register.eeprom and values["torque_enable"]):
            return ErrorCode.ACCESS
        if not register.minimum <= value <= register.maximum:
            return ErrorCode.DATA_RANGE
        tripped = values.get("bus_watchdog") == TRIPPED
        error, refused = ErrorCode.DATA_RANGE, False
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
        """Where the byte at an address really lives; a pointer out of the table is as good as none."""
        pointer = self._pointers.get(address)
        if pointer is None:
            return address
        target = self.values[pointer.name]
        return target if target < len(self._bytes) else address
