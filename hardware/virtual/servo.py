"""One servo without a motor: its memory, its rules and where its shaft is at any time.

What a register does follows the ROBOTIS e-manual (X series).  Where the manual is silent the choice is
the less comfortable one for the host: Goal Position keeps its value while torque is off, so that
switching torque on moves the shaft to a stale goal; a reboot forgets turns; a servo that has shut down
takes Torque Enable = 1 without an error and does not obey.  There is no load: a shaft without torque
stays where it is.
"""

from __future__ import annotations

from robot_ik.hardware.control_table import (
    BAUD_RATES,
    HARDWARE_ERRORS,
    TICKS_PER_TURN,
    WATCHDOG_UNIT,
    OperatingMode,
    Register,
    control_table,
)
from robot_ik.hardware.virtual.memory import Memory
from robot_ik.hardware.virtual.protocol2 import ALERT, ErrorCode
from robot_ik.hardware.virtual.shaft import REVERSE, TIME_BASED, TORQUE_BY_GOAL, Shaft
from robot_ik.ports import Clock

TRIPPED = -1
"""What Bus Watchdog reads once it has tripped."""
CLEAR_MULTI_TURN = b"\x01\x44\x58\x4c\x22"
ROOM_TEMPERATURE = 32

_OBEYED_MODES = {
    OperatingMode.VELOCITY,
    OperatingMode.POSITION,
    OperatingMode.EXTENDED_POSITION,
    OperatingMode.CURRENT_BASED_POSITION,
}
_GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
_GAINS = ("velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain")
_RESET_BY_MODE = (*_GAINS, "profile_acceleration", "profile_velocity")
_DRIVE_BITS = REVERSE | TIME_BASED | TORQUE_BY_GOAL


class VirtualServo:
    """A servo on a virtual bus.  Not locked by itself: the bus does that.

    Args:
        model: Name of a control table.
        id: 0..252.
        clock: The only source of time.
        position_ticks: What Present Position reads at first.
        mode: Operating mode; ``baud``: bits/s.
        zero_offset_ticks: Hidden from the registers: the shaft is this far from where they say.

    Attributes:
        stuck: The shaft does not move, whatever the goal; registers report where it really is.
        silent: Hears nothing and answers nothing, as without a cable.
        zero_offset_ticks: May be changed at any time.
        reboot_time: Seconds after a reboot in which it is deaf; some tenths on a real one.
    """

    def __init__(
        self,
        model: str,
        id: int,
        clock: Clock,
        *,
        position_ticks: float = TICKS_PER_TURN // 2,
        mode: OperatingMode = OperatingMode.POSITION,
        baud: int = 1_000_000,
        zero_offset_ticks: float = 0.0,
    ) -> None:
        self.table = control_table(model)
        self.memory = Memory(self.table)
        self.zero_offset_ticks = zero_offset_ticks
        self.silent = False
        self.reboot_time = 0.0
        self._clock = clock
        self._registered: tuple[int, bytes] | None = None
        self._shaft = Shaft(self.memory, clock, float(position_ticks))
        self._booted = self._heard = clock.now()
        self.memory.set("id", id)
        self.memory.set("operating_mode", mode)
        self.memory.set("baud_rate", {rate: code for code, rate in BAUD_RATES.items()}[baud])
        live = {
            **self._shaft.registers(),
            "realtime_tick": lambda: int((clock.now() - self._booted) * 1000.0) % 32768,
        }
        self._live = [(self.table[name], value) for name, value in live.items()]
        self._power_on()

    @property
    def id(self) -> int:
        """The ID register."""
        return self.memory.get("id")

    @property
    def baud(self) -> int:
        """Bits/s by the Baud Rate register."""
        return BAUD_RATES[self.memory.get("baud_rate")]

    @property
    def deaf(self) -> bool:
        """Silent, or still starting up."""
        return self.silent or self._clock.now() < self._booted + self.reboot_time

    @property
    def torque(self) -> bool:
        """Torque Enable, after the bus watchdog and shutdown had their say."""
        self._update()
        return bool(self.memory.get("torque_enable"))

    def status_byte(self, error: int) -> int:
        """The error byte of an answer: number, and the alert bit while Hardware Error Status is not 0."""
        return error | (ALERT if self.memory.get("hardware_error_status") else 0)

    @property
    def reading(self) -> float:
        """Present Position before rounding, ticks."""
        self._update()
        return self._shaft.reading

    @property
    def true_ticks(self) -> float:
        """Where the shaft really is: hidden offset included, homing offset, reverse and lost turns not."""
        self._update()
        return self._shaft.encoder + self.zero_offset_ticks

    @property
    def stuck(self) -> bool:
        """See the class."""
        return self._shaft.stuck_at is not None

    @stuck.setter
    def stuck(self, value: bool) -> None:
        self._update()
        if value and not self.stuck:
            self._shaft.stuck_at = self._shaft.encoder
        elif not value and self.stuck:
            self._shaft.stop()
            self._shaft.stuck_at = None
            if self.torque and not self._tripped:
                self._shaft.go()

    def turn_by_hand(self, ticks: float) -> None:
        """Turns the shaft of a servo without torque by so many ticks; with torque it does not give."""
        if not self.torque:
            self._shaft.turn_by(ticks)

    def hear(self) -> None:
        """An instruction packet went over the bus: feeds the bus watchdog unless it has tripped before."""
        self._update()
        self._heard = self._clock.now()

    def read(self, address: int, length: int) -> tuple[bytes, ErrorCode]:
        """Bytes of the control table as they are now."""
        self._update()
        for first, end in self.memory.spans(address, length):
            for register, value in self._live:
                if first < register.end and end > register.address:
                    self.memory.set(register.name, value())
        return self.memory.read(address, length)

    def write(self, address: int, data: bytes) -> ErrorCode:
        """Sets registers if all of them may be set; then does what they say."""
        self._update()
        locked = bool(self.memory.get("torque_enable"))
        values, error = self.memory.parse_write(address, data, locked=locked, check=self._check)
        for register, value in values:
            self.memory.set(register.name, value)
            self._written(register.name, locked)
        return error

    def reg_write(self, address: int, data: bytes) -> ErrorCode:
        """Checks a write and keeps it for ``action``."""
        self._update()
        locked = bool(self.memory.get("torque_enable"))
        _, error = self.memory.parse_write(address, data, locked=locked, check=self._check)
        if not error:
            self._registered = (address, data)
            self.memory.set("registered_instruction", 1)
        return error

    def action(self) -> ErrorCode:
        """Does the kept write; an instruction error if there is none."""
        if self._registered is None:
            return ErrorCode.INSTRUCTION
        (address, data), self._registered = self._registered, None
        self.memory.set("registered_instruction", 0)
        return self.write(address, data)

    def clear(self, params: bytes) -> ErrorCode:
        """Clear multi-turn: the reading falls back into one turn; only while the shaft stands."""
        self._update()
        if params != CLEAR_MULTI_TURN:
            return ErrorCode.DATA_RANGE
        if not self._shaft.standing:
            return ErrorCode.RESULT_FAIL
        self._shaft.forget_turns()
        self.memory.set("goal_position", self._shaft.position_register())
        return ErrorCode.NONE

    def reboot(self) -> None:
        """RAM at its defaults, torque off, errors gone, turns forgotten."""
        self._shaft.stop()
        self.memory.reset(eeprom=False)
        self._booted = self._clock.now()
        self._shaft.forget_turns()
        self._power_on()

    def factory_reset(self, option: int) -> ErrorCode:
        """0xFF: everything; 1: all but the id; 2: all but id and baud rate.  Then a reboot."""
        keep = {0xFF: (), 1: ("id",), 2: ("id", "baud_rate")}.get(option)
        if keep is None:
            return ErrorCode.DATA_RANGE
        self.memory.reset(eeprom=True, keep=keep)
        self.reboot()
        return ErrorCode.NONE

    def inject_error(self, name: str) -> None:
        """Makes a hardware error happen, e.g. ``"overload"``; Shutdown says whether torque goes off."""
        bit = 1 << {text: bit for bit, text in HARDWARE_ERRORS.items()}[name]
        self._update()
        self.memory.set("hardware_error_status", self.memory.get("hardware_error_status") | bit)
        if self._shut_down():
            self._shaft.stop()
            self.memory.set("torque_enable", 0)

    def _check(self, register: Register, value: int) -> ErrorCode:
        """Rules that hang on other registers."""
        name, memory = register.name, self.memory
        if self._tripped and (name in _GOALS or (name == "bus_watchdog" and value != 0)):
            return ErrorCode.DATA_RANGE
        if name == "operating_mode" and (value not in _OBEYED_MODES or value not in self.table.modes):
            return ErrorCode.DATA_RANGE
        if name == "drive_mode" and value & ~_DRIVE_BITS:
            return ErrorCode.DATA_RANGE
        if name == "goal_position" and memory.get("operating_mode") == OperatingMode.POSITION:
            low, high = memory.get("min_position_limit"), memory.get("max_position_limit")
            return ErrorCode.NONE if low <= value <= high else ErrorCode.DATA_LIMIT
        if name in ("goal_velocity", "goal_current", "goal_pwm"):
            limit = memory.get(name.removeprefix("goal_") + "_limit")
            return ErrorCode.NONE if abs(value) <= limit else ErrorCode.DATA_LIMIT
        return ErrorCode.NONE

    def _written(self, name: str, had_torque: bool) -> None:
        """What a write sets off."""
        memory = self.memory
        turning = memory.get("operating_mode") == OperatingMode.VELOCITY
        if name == "torque_enable":
            if self._shut_down():
                memory.set(name, 0)
            on = bool(memory.get(name))
            if on and not had_torque and not self._tripped:
                self._shaft.go()
            elif not on:
                self._shaft.stop()
        elif name == "goal_position" and not turning:
            if memory.get("drive_mode") & TORQUE_BY_GOAL and not self._shut_down():
                memory.set("torque_enable", 1)
            if memory.get("torque_enable"):
                self._shaft.go()
        elif name == "goal_velocity" and turning and had_torque:
            self._shaft.go()
        elif name == "operating_mode":
            for register in _RESET_BY_MODE:
                memory.set(register, self.table[register].initial or 0)
            self._power_on()
        elif name in ("homing_offset", "drive_mode"):
            self._shaft.fold()

    def _update(self) -> None:
        """Lets the bus watchdog act at the time when it ran out, however late anyone asks."""
        limit = self.memory.get("bus_watchdog")
        if limit <= 0 or not self.memory.get("torque_enable"):
            return
        trip = self._heard + limit * WATCHDOG_UNIT
        if self._clock.now() > trip:
            self._shaft.brake_at(trip)
            self.memory.set("bus_watchdog", TRIPPED)

    @property
    def _tripped(self) -> bool:
        return self.memory.get("bus_watchdog") == TRIPPED

    def _shut_down(self) -> bool:
        return bool(self.memory.get("hardware_error_status") & self.memory.get("shutdown"))

    def _power_on(self) -> None:
        """Registers that start with the state of the servo."""
        self._shaft.fold()
        self._registered = None
        memory = self.memory
        memory.set("goal_position", self._shaft.position_register())
        memory.set("goal_velocity", 0)
        for goal, limit in (("goal_pwm", "pwm_limit"), ("goal_current", "current_limit")):
            if goal in self.table:
                memory.set(goal, memory.get(limit))
        memory.set("present_input_voltage", round(10.0 * self.table.supply))
        memory.set("present_temperature", ROOM_TEMPERATURE)
