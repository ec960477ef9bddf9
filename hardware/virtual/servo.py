"""One Dynamixel X servo without a motor: its memory, its rules and what its registers do.

The registers follow the ROBOTIS e-manual (X series). Where the manual says nothing, the servo
behaves in the way that is harder for the host:

* Goal Position keeps its value while torque is off, so torque on moves the shaft to a stale goal.
* A reboot forgets revolutions.
* A servo that has shut down accepts Torque Enable = 1 without an error and does not obey.

Without a world a shaft without torque stays where it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from robot_ik.hardware.families.dynamixel_x_table import (
    BAUD_RATES,
    HARDWARE_ERRORS,
    REVERSE,
    SLAVE,
    TORQUE_BY_GOAL,
    TRIPPED,
)
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import (
    IDS,
    RADIANS_PER_TICK,
    TICKS_PER_REVOLUTION,
    OperatingMode,
    Register,
)
from robot_ik.hardware.virtual.electrics import PWM_FULL, Electrics
from robot_ik.hardware.virtual.memory import CONTROLLER, PROFILE, Memory
from robot_ik.hardware.virtual.motor import TORQUE_MODES, torque_limit
from robot_ik.hardware.virtual.profiles import VELOCITY_TICKS
from robot_ik.hardware.virtual.protocol import ALERT, ErrorCode
from robot_ik.hardware.virtual.shaft import Shaft
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.ports import Clock

CLEAR_MULTI_TURN = b"\x01\x44\x58\x4c\x22"
"""Parameters of the Clear instruction."""
PROTOCOL_1 = 1
"""Protocol Type of a servo that understands Protocol 1.0 only."""
_STORE = b"\x01CTRL"
"""Parameters of Control Table Backup that store."""
_RESTORE = b"\x02CTRL"
"""Parameters of Control Table Backup that restore."""
_TORQUE_AT_START = 0b01
"""Bit of Startup Configuration."""
_RAM_FROM_BACKUP = 0b10
"""Bit of Startup Configuration."""
BROWN_OUT = 0.4
"""Share of the nominal supply below which a servo loses its memory.

It restarts when power is back.
"""


_ERROR_BITS = {name: 1 << bit for bit, name in HARDWARE_ERRORS.items()}
"""Hardware error -> its bit in Hardware Error Status."""
_ELECTRICS_PERIOD = 0.02
"""s. Heat and strain change slowly and are updated no more often than this."""
_SUPPLY = ("present_input_voltage",)
"""Registers that keep their value over every start."""
_NO_POSITION = frozenset(map(int, (OperatingMode.VELOCITY, *TORQUE_MODES)))
"""Operating modes without a goal position."""


class VirtualServo:
    """A servo on a virtual bus. Not locked: the bus holds its lock.

    Args:
        model: Name of a control table.
        id: 0..252.
        clock: The only source of time.
        position_ticks: Present Position at first.
        mode: Operating mode.
        baud: bit/s.
        firmware: Firmware version; None: the usual one of the model.
        reverse: Bit 0 of Drive Mode, set when the servo was built in: it counts against its
            encoder.
        shadow_of: Secondary ID; None: it has none.

    Attributes:
        stuck: The shaft does not move and feels no load (a stripped gear). Registers show where it
            is.
        silent: The servo receives and sends nothing, as without a data line.
        off: The servo has no power.
        zero_offset_ticks: Hidden distance of the shaft from where its registers show it.
        reboot_time: s after a reboot in which the servo receives nothing; tenths on a real servo.
        ready_at: Time at which the last reboot is over, s.
        electrics: Temperature and strain of the motor.
        booted: Time at which power came, s.
        heard: Time of the last instruction packet on the bus, s.
    """

    def __init__(
        self,
        model: str,
        id: int,
        clock: Clock,
        *,
        position_ticks: float = TICKS_PER_REVOLUTION // 2,
        mode: OperatingMode = OperatingMode.POSITION,
        baud: int = 1_000_000,
        firmware: int | None = None,
        reverse: bool = False,
        shadow_of: int | None = None,
    ) -> None:
        self.table = control_table(model, firmware)
        self.memory = Memory(self.table)
        self.zero_offset_ticks = 0.0
        self.silent = False
        self.off = False
        self.reboot_time = 0.0
        self.ready_at = 0.0
        if reverse:
            self.memory.set("drive_mode", REVERSE)
        if shadow_of is not None:
            self.memory.set("secondary_id", shadow_of)
        encoder = -float(position_ticks) if reverse else float(position_ticks)
        self.shaft = Shaft(self.memory, clock, encoder)
        self.electrics = Electrics(self.table.motor, clock.now())
        self._clock = clock
        self._values = self.memory.values
        self._current_unit = self.table.current_unit
        self._registered: tuple[int, bytes] | None = None
        self._backup: dict[str, int] = {}
        self.memory.set("id", id)
        self.memory.set("operating_mode", mode)
        self.memory.set("baud_rate", self.table.baud_code(baud))
        self.memory.set("present_input_voltage", round(10.0 * self.table.supply))
        self._plans: dict[tuple[int, int], list[tuple[str, Callable[[], int]]]] = {}
        self._live = [(self.table[name], value) for name, value in self._readings().items()]
        if mode == OperatingMode.POSITION:
            self.shaft.fold()
        self._start()

    @property
    def id(self) -> int:
        return self.memory.values["id"]

    @property
    def secondary_id(self) -> int | None:
        """A second id that the servo obeys without replies; None: it has none."""
        id = self.memory.values["secondary_id"]
        return id if id in IDS and id != self.id else None

    @property
    def baud(self) -> int:
        return BAUD_RATES[self.memory.values["baud_rate"]]

    @property
    def return_delay(self) -> float:
        """s that the servo waits before it answers."""
        return 2e-6 * self.memory.values["return_delay_time"]

    @property
    def deaf(self) -> bool:
        """The servo is silent, off, starting up, or set to Protocol 1.0."""
        other = self.memory.values["protocol_type"] == PROTOCOL_1
        return self.silent or self.off or other or self._clock.now() < self.ready_at

    @property
    def torque(self) -> bool:
        """Torque Enable, after Bus Watchdog and shutdown were brought up to date."""
        self.update()
        return bool(self.memory.values["torque_enable"])

    @property
    def tripped(self) -> bool:
        """The Bus Watchdog has tripped and was not cleared."""
        return self.memory.values.get("bus_watchdog") == TRIPPED

    def status_byte(self, error: int) -> int:
        """Return the error byte of a reply: error number and alert bit."""
        return error | (ALERT if self.memory.values["hardware_error_status"] else 0)

    @property
    def true_ticks(self) -> float:
        """True shaft position, ticks.

        The hidden offset is included. Homing offset, reverse and lost revolutions are not.
        """
        self.update()
        return self.shaft.encoder + self.zero_offset_ticks

    @property
    def stuck(self) -> bool:
        return self.shaft.stuck_at is not None

    @stuck.setter
    def stuck(self, value: bool) -> None:
        self.update()
        if value and not self.stuck:
            self.shaft.stuck_at = self.shaft.encoder
        elif not value and self.stuck:
            self.shaft.stop()
            self.shaft.stuck_at = None
            self._set_out()

    @property
    def jammed(self) -> bool:
        """The shaft is held and the motor presses against that, unlike ``stuck``."""
        return self.shaft.stops[0] == self.shaft.stops[1]

    @jammed.setter
    def jammed(self, value: bool) -> None:
        self.update()
        position = self.shaft.encoder
        if not value:
            self.shaft.stop()
        self.shaft.stops = (position, position) if value else (-math.inf, math.inf)
        if not value:
            self._set_out()

    def _set_out(self) -> None:
        if self.torque and not self.tripped:
            self.shaft.go()

    def register(self, name: str) -> int:
        """Return the value of a register without a request of the host."""
        return self.memory.values[name]

    def set_register(self, name: str, value: int) -> None:
        """Set a register without a request of the host."""
        self.memory.set(name, value)

    def set_baud(self, baud: float) -> None:
        """Set the nearest baud rate of the table, bit/s."""
        self.memory.set("baud_rate", min(BAUD_RATES, key=lambda code: abs(BAUD_RATES[code] - baud)))

    @property
    def mode(self) -> int:
        """Operating mode."""
        return self.memory.values["operating_mode"]

    def torque_limit(self, volts: float) -> float:
        """Return the largest torque that mode, limits and supply allow, N m."""
        return torque_limit(self.memory, volts)

    @property
    def volts(self) -> float:
        """Supply, V."""
        return self.shaft.volts

    @property
    def push(self) -> float:
        """A steady torque on the shaft, N m."""
        return self.shaft.load.push

    @push.setter
    def push(self, torque: float) -> None:
        self.shaft.load = replace(self.shaft.load, push=torque)

    def heat_to(self, temperature: float) -> None:
        """Set the temperature of the motor, C."""
        self.electrics.temperature = temperature
        self.memory.set("present_temperature", round(temperature))

    def lose_revolutions(self, revolutions: int) -> None:
        """Count wrong by this number of revolutions from here on."""
        self.shaft.lose_revolutions(revolutions)

    def rotate_by_hand(self, ticks: float) -> None:
        """Turn the shaft by ticks if torque is off. With torque it does not move."""
        if not self.torque:
            self.shaft.rotate_by(ticks)

    def read(self, address: int, length: int) -> tuple[bytes, ErrorCode]:
        """Return present bytes of the control table."""
        self.update()
        memory = self.memory
        live = self._plans.get((address, length))
        if live is None:
            spans = memory.spans(address, length)
            live = [
                (r.name, v)
                for r, v in self._live
                if any(f < r.end and e > r.address for f, e in spans)
            ]
            if address + length <= memory.first_indirect:  # pointers may change
                self._plans[address, length] = live
        for name, value in live:
            memory.set(name, value())
        return memory.read(address, length)

    def write(self, address: int, data: bytes, *, secondary: bool = False) -> ErrorCode:
        """Set registers if all of them may be set, and carry out their effects.

        Args:
            address: First address.
            data: Bytes.
            secondary: The write came to the Secondary ID, which cannot change EEPROM.
        """
        self.update()
        had_torque = bool(self.memory.values["torque_enable"])
        values, error = self._parse_write(address, data, secondary)
        for register, value in values:
            self.memory.set(register.name, value)
            self._written(register.name, had_torque)
        return error

    def reg_write(self, address: int, data: bytes, *, secondary: bool = False) -> ErrorCode:
        """Check a write and keep it for ``action``."""
        self.update()
        _, error = self._parse_write(address, data, secondary)
        if not error:
            self._registered = (address, data)
            self.memory.set("registered_instruction", 1)
        return error

    def _parse_write(
        self, address: int, data: bytes, secondary: bool
    ) -> tuple[list[tuple[Register, int]], ErrorCode]:
        values, error = self.memory.parse_write(address, data)
        if secondary and any(register.eeprom for register, _ in values):
            return [], ErrorCode.ACCESS
        return values, error

    def action(self) -> ErrorCode:
        """Do the kept write; an instruction error if there is none."""
        if self._registered is None:
            return ErrorCode.INSTRUCTION
        address, data = self._registered
        self._registered = None
        self.memory.set("registered_instruction", 0)
        return self.write(address, data)

    def clear(self, params: bytes) -> ErrorCode:
        """Clear multi-turn: fold the reading into one revolution.

        This works only while the shaft stands still.
        """
        self.update()
        if "clear" not in self.table.abilities:
            return ErrorCode.INSTRUCTION
        if params != CLEAR_MULTI_TURN:
            return ErrorCode.DATA_RANGE
        if abs(self.shaft.speed) >= 0.5 * VELOCITY_TICKS:  # Present Velocity is not 0
            return ErrorCode.RESULT_FAIL
        self.shaft.fold()
        self.memory.set("goal_position", self.shaft.position_register())
        return ErrorCode.NONE

    def reboot(self) -> None:
        """Restart: RAM to its defaults, torque off, errors and revolutions forgotten.

        The same happens when power comes back.
        """
        memory = self.memory
        memory.reset(eeprom=False, keep=_SUPPLY)
        if "backup_ready" in self.table:
            memory.set("backup_ready", int(bool(self._backup)))
        self._registered = None
        startup = (
            memory.values["startup_configuration"] if "startup_configuration" in self.table else 0
        )
        if startup & _RAM_FROM_BACKUP:
            for name, value in self._backup.items():
                if not self.table[name].eeprom:
                    memory.set(name, value)
        self.shaft.fold()
        self._start()
        self.ready_at = self.booted + self.reboot_time
        if startup & _TORQUE_AT_START and not self.off:
            self._torque_on()

    def factory_reset(self, option: int) -> ErrorCode:
        """Reset EEPROM and reboot.

        Args:
            option: 0xFF: everything. 1: all but the id. 2: all but id and baud rate.
        """
        keep = {0xFF: (), 1: ("id",), 2: ("id", "baud_rate")}.get(option)
        if keep is None:
            return ErrorCode.DATA_RANGE
        self.memory.reset(eeprom=True, keep=keep + _SUPPLY)
        self.reboot()
        return ErrorCode.NONE

    def control_table_backup(self, params: bytes) -> ErrorCode:
        """Store a backup, or restore its EEPROM part and reboot.

        This works only without torque.
        """
        if "backup" not in self.table.abilities:
            return ErrorCode.INSTRUCTION
        if params not in (_STORE, _RESTORE):
            return ErrorCode.DATA_RANGE
        if self.torque or (params == _RESTORE and not self._backup):
            return ErrorCode.RESULT_FAIL
        if params == _STORE:
            self._backup = self.memory.backup()
            self.memory.set("backup_ready", 1)
            return ErrorCode.NONE
        for name, value in self._backup.items():
            if self.table[name].eeprom:
                self.memory.set(name, value)
        self.reboot()
        return ErrorCode.NONE

    def set_supply(self, volts: float) -> None:
        """Set the supply voltage. Outside the limits of the servo it is an input voltage error.

        A servo whose supply is too low to run restarts when power is back.
        """
        self.update()
        self.memory.set("present_input_voltage", max(0, round(10.0 * volts)))
        low = self.memory.values["min_voltage_limit"]
        high = self.memory.values["max_voltage_limit"]
        if not low <= 10.0 * volts <= high:
            self.inject_error("input_voltage")
        starved = volts < BROWN_OUT * self.table.supply
        if starved != self.off:
            self.switch(not starved)

    def switch(self, on: bool) -> None:
        """Switch the power on or off. Without power: no torque, no replies, RAM lost."""
        self.update()
        self.off = not on
        self.reboot()

    def _start(self) -> None:
        """Start with power: the motor keeps its heat, everything else is reset."""
        memory = self.memory
        self.booted = self._clock.now()
        self.heard = self.booted
        self.electrics.strain = 0.0
        self.shaft.powered = False
        self.shaft.stop()
        memory.set("present_temperature", min(255, round(self.electrics.temperature)))
        self._stand()

    def _stand(self) -> None:
        """Set the goals as after a start: the present position, limits, or 0."""
        memory = self.memory
        memory.set("goal_position", self.shaft.position_register())
        memory.set("goal_velocity", 0)
        for goal, limit in (("goal_pwm", "pwm_limit"), ("goal_current", "current_limit")):
            if goal in self.table:
                memory.set(goal, memory.values[limit])

    def update(self) -> None:
        """Bring watchdog and motor up to the present time."""
        now = self._clock.now()
        if self._values.get("bus_watchdog", 0) > 0:
            self.watch(now)
        if now - self.electrics.at >= _ELECTRICS_PERIOD:
            self._warm(now)

    def hear(self) -> None:
        """Note an instruction packet on the bus. It feeds a Bus Watchdog that has not tripped."""
        self.update()
        self.heard = self._clock.now()

    def watch(self, now: float) -> None:
        """Trip the Bus Watchdog if its time was over by ``now`` in s."""
        limit = self._values.get("bus_watchdog", 0) if self._values["torque_enable"] else 0
        trip = self.heard + limit * (0.001 * WATCHDOG_UNIT_MS)
        if limit > 0 and now > trip:
            self.shaft.brake_at(trip)
            self.memory.set("bus_watchdog", TRIPPED)
            for name in PROFILE:
                self.memory.set(name, 0)

    def _warm(self, now: float) -> None:
        electrics = self.electrics
        memory = self.memory
        shown = memory.values["present_temperature"]
        if shown != min(255, round(electrics.temperature)):
            electrics.temperature = float(shown)  # a test or a fault has set it
        electrics.advance(now, self.shaft.torque(), self.shaft.volts)
        memory.set("present_temperature", min(255, round(electrics.temperature)))
        if electrics.strain >= 1.0:
            self.inject_error("overload")
        if electrics.temperature > memory.values["temperature_limit"]:
            self.inject_error("overheating")

    def inject_error(self, name: str) -> None:
        """Set a hardware error such as ``overload``, which lasts until a reboot.

        Shutdown decides whether torque goes off.
        """
        self.update()
        memory = self.memory
        memory.set(
            "hardware_error_status", memory.values["hardware_error_status"] | _ERROR_BITS[name]
        )
        if self._shut_down():
            self.shaft.stop()
            self.shaft.powered = False
            memory.set("torque_enable", 0)

    def _readings(self) -> dict[str, Callable[[], int]]:
        """Return register -> function that measures it."""
        live = {
            **self.shaft.registers(),
            "realtime_tick": lambda: int((self._clock.now() - self.booted) * 1000.0) % 32768,
            "present_pwm": lambda: self.shaft.sign * round(PWM_FULL * self._duty()),
            "present_current": self._current,
            "present_load": self._load,
        }
        return {name: read for name, read in live.items() if name in self.table}

    def _load(self) -> int:
        share = self.shaft.torque() / self.table.motor.stall_torque
        return self.shaft.sign * round(1000.0 * max(-1.0, min(1.0, share)))

    def _duty(self) -> float:
        shaft = self.shaft
        if not shaft.powered:
            return 0.0
        return self.electrics.duty(shaft.torque(), shaft.speed * RADIANS_PER_TICK, shaft.volts)

    def _current(self) -> int:
        amount = self.electrics.milliamperes(self.shaft.torque(), self._duty()) / self._current_unit
        return self.shaft.sign * max(-32768, min(32767, round(amount)))

    def _written(self, name: str, had_torque: bool) -> None:
        mode = self._values["operating_mode"]
        match name:
            case "torque_enable":
                self._torque_written(had_torque)
            case "goal_position":
                self._goal_written(mode not in _NO_POSITION)
            case "goal_velocity":
                self._goal_written(mode == OperatingMode.VELOCITY)
            case "goal_current" | "goal_pwm":
                # In the other modes it is a limit: a servo that was too weak may move now.
                self._goal_written(bool(self._values["torque_enable"]) or mode in TORQUE_MODES)
            case "operating_mode":
                for register in CONTROLLER:
                    self.memory.set(register, self.table[register].initial or 0)
                self._count_anew()
                self._stand()
            case "drive_mode":
                self._count_anew()

    def _torque_on(self) -> None:
        """Switch the motor on where the shaft stands."""
        self.memory.set("torque_enable", 1)
        self.shaft.powered = True
        self.shaft.stop()

    def _torque_written(self, had_torque: bool) -> None:
        memory = self.memory
        shaft = self.shaft
        if self._shut_down():
            memory.set("torque_enable", 0)
        if not memory.values["torque_enable"]:
            shaft.powered = False
            shaft.stop()
        elif not had_torque and not self.tripped:
            self._count_anew()
            self.heard = self._clock.now()
            if not self.memory.drives(SLAVE):
                self._torque_on()
                shaft.go()

    def _goal_written(self, of_this_mode: bool) -> None:
        if not of_this_mode or self.memory.drives(SLAVE):
            return
        values = self._values
        if (
            not values["torque_enable"]
            and self.memory.drives(TORQUE_BY_GOAL)
            and not self._shut_down()
        ):
            self._torque_on()
        if values["torque_enable"]:
            self.shaft.go()

    def _count_anew(self) -> None:
        if self.memory.values["operating_mode"] == OperatingMode.POSITION:
            self.shaft.fold()

    def _shut_down(self) -> bool:
        return bool(self.memory.values["hardware_error_status"] & self.memory.values["shutdown"])
