"""One servo without a motor: its memory, its rules and what its registers do.

What a register does follows the ROBOTIS e-manual (X series).  Where the manual is silent the choice is
the less comfortable one for the host: Goal Position keeps its value while torque is off, so that
switching torque on moves the shaft to a stale goal; a reboot forgets revolutions; a servo that has shut down
takes Torque Enable = 1 without an error and does not obey.  Without a world a limp shaft stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from robot_ik.hardware.families.dynamixel_x_table import (
    BAUD_RATES,
    HARDWARE_ERRORS,
    RETURN_READ,
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
from robot_ik.hardware.virtual.memory import CONTROLLER, PROFILE, Memory
from robot_ik.hardware.virtual.motor import (
    PWM_FULL,
    TORQUE_MODES,
    VELOCITY_TICKS,
    Electrics,
    torque_limit,
)
from robot_ik.hardware.virtual.protocol import (
    ALERT,
    BROADCAST,
    MAX_PACKET,
    ErrorCode,
    Instruction,
    build_fast_status,
)
from robot_ik.hardware.virtual.shaft import Shaft
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.ports import Clock

CLEAR_MULTI_TURN = b"\x01\x44\x58\x4c\x22"
PROTOCOL_1 = 1
"""Protocol Type of a servo that understands Protocol 1.0 only."""
_STORE, _RESTORE = b"\x01CTRL", b"\x02CTRL"
_TORQUE_AT_START, _RAM_FROM_BACKUP = 0b01, 0b10  # bits of Startup Configuration
BROWN_OUT = 0.4
"""Share of the nominal supply below which a servo loses its memory and starts anew when power is back."""


_ERROR_BITS = {name: 1 << bit for bit, name in HARDWARE_ERRORS.items()}
# Heat and strain change slowly: they are updated no more often than this, s.
_ELECTRICS_PERIOD = 0.02
_SUPPLY = ("present_input_voltage",)  # outlasts every start
_NO_POSITION = frozenset(map(int, (OperatingMode.VELOCITY, *TORQUE_MODES)))


class VirtualServo:
    """A servo on a virtual bus.  Not locked by itself: the bus does that.

    Args:
        model: Name of a control table.
        id: 0..252.
        clock: The only source of time.
        position_ticks: What Present Position reads at first.
        mode: Operating mode; ``baud``: bits/s.
        firmware: Another than the model's usual one.
        reverse: Bit 0 of its Drive Mode, set when it was built in: it counts against its encoder.
        shadow_of: Its Secondary ID; ``None``: none.

    Attributes:
        stuck: The shaft does not move, whatever the goal, and feels no load (a stripped gear); registers
            report where it really is.
        silent: Hears nothing and answers nothing, as without a data line.
        off: Has no power.
        zero_offset_ticks: Hidden from the registers: the shaft is this far from where they say.
        reboot_time: Seconds after a reboot in which it is deaf; some tenths on a real one.
        ready_at: When the last of these is over, s.
        electrics: Temperature and strain of the motor.
        booted: When power came, s; ``heard``: when the last instruction packet went over the bus, s.
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
        self.silent = self.off = False
        self.reboot_time = self.ready_at = 0.0
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
        """Another id to which it listens, in silence."""
        id = self.memory.values["secondary_id"]
        return id if id in IDS and id != self.id else None

    @property
    def baud(self) -> int:
        return BAUD_RATES[self.memory.values["baud_rate"]]

    @property
    def return_delay(self) -> float:
        """Seconds it waits before it answers."""
        return 2e-6 * self.memory.values["return_delay_time"]

    @property
    def deaf(self) -> bool:
        """Silent, off, still starting up, or set to Protocol 1.0, which nobody speaks here."""
        other = self.memory.values["protocol_type"] == PROTOCOL_1
        return self.silent or self.off or other or self._clock.now() < self.ready_at

    @property
    def torque(self) -> bool:
        """Torque Enable, after the bus watchdog and shutdown had their say."""
        self.update()
        return bool(self.memory.values["torque_enable"])

    @property
    def tripped(self) -> bool:
        """The bus watchdog has run out and was not cleared."""
        return self.memory.values.get("bus_watchdog") == TRIPPED

    def status_byte(self, error: int) -> int:
        """The error byte of a reply: number, and the alert bit while Hardware Error Status is not 0."""
        return error | (ALERT if self.memory.values["hardware_error_status"] else 0)

    @property
    def true_ticks(self) -> float:
        """True shaft position: with the hidden offset, without homing offset, reverse, lost revolutions."""
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
        """Something holds the shaft where it is: the motor presses against it, unlike ``stuck``."""
        return self.shaft.stops[0] == self.shaft.stops[1]

    @jammed.setter
    def jammed(self, value: bool) -> None:
        self.update()
        here = self.shaft.encoder
        if not value:
            self.shaft.stop()
        self.shaft.stops = (here, here) if value else (-math.inf, math.inf)
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
        """Turns the shaft of a servo without torque by so many ticks; with torque it does not give."""
        if not self.torque:
            self.shaft.rotate_by(ticks)

    def read(self, address: int, length: int) -> tuple[bytes, ErrorCode]:
        """Bytes of the control table as they are now."""
        self.update()
        memory = self.memory
        live = self._plans.get((address, length))
        if live is None:
            spans = memory.spans(address, length)
            live = [(r.name, v) for r, v in self._live if any(f < r.end and e > r.address for f, e in spans)]
            if address + length <= memory.first_indirect:  # else the pointers may change
                self._plans[address, length] = live
        for name, value in live:
            memory.set(name, value())
        return memory.read(address, length)

    def write(self, address: int, data: bytes, *, secondary: bool = False) -> ErrorCode:
        """Sets registers if all of them may be set; then does what they say.

        ``secondary``: sent to the Secondary ID, by which EEPROM cannot be changed.
        """
        self.update()
        had_torque = bool(self.memory.values["torque_enable"])
        values, error = self._parse_write(address, data, secondary)
        for register, value in values:
            self.memory.set(register.name, value)
            self._written(register.name, had_torque)
        return error

    def reg_write(self, address: int, data: bytes, *, secondary: bool = False) -> ErrorCode:
        """Checks a write and keeps it for ``action``."""
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
        """Does the kept write; an instruction error if there is none."""
        if self._registered is None:
            return ErrorCode.INSTRUCTION
        (address, data), self._registered = self._registered, None
        self.memory.set("registered_instruction", 0)
        return self.write(address, data)

    def clear(self, params: bytes) -> ErrorCode:
        """Clear multi-turn: the reading falls back into one revolution; only while the shaft stands."""
        self.update()
        if "clear" not in self.table.abilities:
            return ErrorCode.INSTRUCTION
        if params != CLEAR_MULTI_TURN:
            return ErrorCode.DATA_RANGE
        if abs(self.shaft.speed) >= 0.5 * VELOCITY_TICKS:  # it can be seen to move
            return ErrorCode.RESULT_FAIL
        self.shaft.fold()
        self.memory.set("goal_position", self.shaft.position_register())
        return ErrorCode.NONE

    def reboot(self) -> None:
        """RAM at its defaults, torque off, errors gone, revolutions forgotten; as when power comes back."""
        memory = self.memory
        memory.reset(eeprom=False, keep=_SUPPLY)
        if "backup_ready" in self.table:
            memory.set("backup_ready", int(bool(self._backup)))
        self._registered = None
        startup = memory.values["startup_configuration"] if "startup_configuration" in self.table else 0
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
        """0xFF: everything; 1: all but the id; 2: all but id and baud rate.  Then a reboot."""
        keep = {0xFF: (), 1: ("id",), 2: ("id", "baud_rate")}.get(option)
        if keep is None:
            return ErrorCode.DATA_RANGE
        self.memory.reset(eeprom=True, keep=keep + _SUPPLY)
        self.reboot()
        return ErrorCode.NONE

    def control_table_backup(self, params: bytes) -> ErrorCode:
        """Stores what a backup keeps, or restores its EEPROM part and reboots; only without torque."""
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
        """Another supply voltage; outside the limits of the servo it is an input voltage error.

        So low that it cannot run, it starts anew once power is back.
        """
        self.update()
        self.memory.set("present_input_voltage", max(0, round(10.0 * volts)))
        low, high = self.memory.values["min_voltage_limit"], self.memory.values["max_voltage_limit"]
        if not low <= 10.0 * volts <= high:
            self.inject_error("input_voltage")
        starved = volts < BROWN_OUT * self.table.supply
        if starved != self.off:
            self.switch(not starved)

    def switch(self, on: bool) -> None:
        """Gives it power, so that it starts up, or takes it away: no torque, no replies, RAM lost."""
        self.update()
        self.off = not on
        self.reboot()

    # ------------------------------------------------------------------------ by itself

    def _start(self) -> None:
        """Power came: heat of the motor stays, everything else begins anew."""
        memory = self.memory
        self.booted = self.heard = self._clock.now()
        self.electrics.strain = 0.0
        self.shaft.powered = False
        self.shaft.stop()
        memory.set("present_temperature", min(255, round(self.electrics.temperature)))
        self._stand()

    def _stand(self) -> None:
        """Goals as after a start: Goal Position where it stands, the others at their limits or 0."""
        memory = self.memory
        memory.set("goal_position", self.shaft.position_register())
        memory.set("goal_velocity", 0)
        for goal, limit in (("goal_pwm", "pwm_limit"), ("goal_current", "current_limit")):
            if goal in self.table:
                memory.set(goal, memory.values[limit])

    def update(self) -> None:
        """Lets watchdog and motor act at the time when they do, however late anyone asks."""
        now = self._clock.now()
        if self._values.get("bus_watchdog", 0) > 0:
            self.watch(now)
        if now - self.electrics.at >= _ELECTRICS_PERIOD:
            self._warm(now)

    def hear(self) -> None:
        """An instruction packet went over the bus: feeds the bus watchdog unless it has tripped before."""
        self.update()
        self.heard = self._clock.now()

    def watch(self, now: float) -> None:
        """Lets the bus watchdog run out if it has by ``now``, s."""
        limit = self._values.get("bus_watchdog", 0) if self._values["torque_enable"] else 0
        trip = self.heard + limit * (0.001 * WATCHDOG_UNIT_MS)
        if limit > 0 and now > trip:
            self.shaft.brake_at(trip)
            self.memory.set("bus_watchdog", TRIPPED)
            for name in PROFILE:
                self.memory.set(name, 0)

    def _warm(self, now: float) -> None:
        electrics, memory = self.electrics, self.memory
        shown = memory.values["present_temperature"]
        if shown != min(255, round(electrics.temperature)):
            electrics.temperature = float(shown)  # somebody set it from outside
        electrics.advance(now, self.shaft.torque(), self.shaft.volts)
        memory.set("present_temperature", min(255, round(electrics.temperature)))
        if electrics.strain >= 1.0:
            self.inject_error("overload")
        if electrics.temperature > memory.values["temperature_limit"]:
            self.inject_error("overheating")

    def inject_error(self, name: str) -> None:
        """A hardware error, kept until a reboot: ``overload``, …  Shutdown says whether torque goes off."""
        self.update()
        memory = self.memory
        memory.set("hardware_error_status", memory.values["hardware_error_status"] | _ERROR_BITS[name])
        if self._shut_down():
            self.shaft.stop()
            self.shaft.powered = False
            memory.set("torque_enable", 0)

    def _readings(self) -> dict[str, Callable[[], int]]:
        """Registers that are measured, and how."""
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

    # ------------------------------------------------------------------- by its registers

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
                # In the other modes it is a limit: what was too weak may be strong enough now.
                self._goal_written(bool(self._values["torque_enable"]) or mode in TORQUE_MODES)
            case "operating_mode":
                for register in CONTROLLER:
                    self.memory.set(register, self.table[register].initial or 0)
                self._count_anew()
                self._stand()
            case "drive_mode":
                self._count_anew()

    def _torque_on(self) -> None:
        """The motor takes over where the shaft stands."""
        self.memory.set("torque_enable", 1)
        self.shaft.powered = True
        self.shaft.stop()

    def _torque_written(self, had_torque: bool) -> None:
        memory, shaft = self.memory, self.shaft
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
        if not values["torque_enable"] and self.memory.drives(TORQUE_BY_GOAL) and not self._shut_down():
            self._torque_on()
        if values["torque_enable"]:
            self.shaft.go()

    def _count_anew(self) -> None:
        if self.memory.values["operating_mode"] == OperatingMode.POSITION:
            self.shaft.fold()

    def _shut_down(self) -> bool:
        return bool(self.memory.values["hardware_error_status"] & self.memory.values["shutdown"])


# ------------------------------------------------------------------------------------------
# What is in the parameters of each instruction, and what one servo does with those meant for it alone.
#
# Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0", Instruction Details.


Request = tuple[int, int, int]
"""(servo id, address, length) of one part of a sync or bulk read."""
Order = tuple[int, int, bytes]
"""(servo id, address, data) of one part of a sync or bulk write."""


def word(data: bytes, at: int) -> int:
    """Two bytes, little-endian; missing ones count as 0."""
    return int.from_bytes(data[at : at + 2], "little")


def sync_requests(params: bytes) -> list[Request]:
    """The reads of a sync read."""
    address, length = word(params, 0), word(params, 2)
    return [(id, address, length) for id in params[4:]]


def bulk_requests(params: bytes) -> list[Request]:
    """The reads of a bulk read."""
    return [(params[k], word(params, k + 1), word(params, k + 3)) for k in range(0, len(params) - 4, 5)]


def sync_writes(params: bytes) -> list[Order]:
    """The writes of a sync write; nothing at all if the lengths do not add up."""
    address, length, rest = word(params, 0), word(params, 2), params[4:]
    if length == 0 or len(rest) % (length + 1):
        return []
    return [(rest[k], address, rest[k + 1 : k + 1 + length]) for k in range(0, len(rest), length + 1)]


def bulk_writes(params: bytes) -> list[Order]:
    """The writes of a bulk write; a part that breaks off is left out."""
    found, at = [], 0
    while at + 5 <= len(params):
        length = word(params, at + 3)
        data = params[at + 5 : at + 5 + length]
        if len(data) == length:
            found.append((params[at], word(params, at + 1), data))
        at += 5 + length
    return found


READS: Mapping[int, Callable[[bytes], list[Request]]] = {
    Instruction.SYNC_READ: sync_requests,
    Instruction.FAST_SYNC_READ: sync_requests,
    Instruction.BULK_READ: bulk_requests,
    Instruction.FAST_BULK_READ: bulk_requests,
}
WRITES: Mapping[int, Callable[[bytes], list[Order]]] = {
    Instruction.SYNC_WRITE: sync_writes,
    Instruction.BULK_WRITE: bulk_writes,
}
"""Instructions to many servos -> what is in their parameters."""


def execute(servo: VirtualServo, instruction: int, params: bytes, to: int) -> tuple[ErrorCode, bytes]:
    """What ``servo`` does on an instruction to its id, its Secondary ID or to all: error and data."""
    secondary = to == servo.secondary_id
    error = ErrorCode.NONE
    match instruction:
        case Instruction.PING:
            return error, servo.read(0, 2)[0] + servo.read(6, 1)[0]
        case Instruction.READ if len(params) == 4:
            data, error = servo.read(word(params, 0), word(params, 2))
            return error, data
        case Instruction.WRITE:
            error = servo.write(word(params, 0), params[2:], secondary=secondary)
        case Instruction.REG_WRITE:
            error = servo.reg_write(word(params, 0), params[2:], secondary=secondary)
        case Instruction.ACTION:
            error = servo.action()
        case Instruction.FACTORY_RESET if len(params) == 1:
            guarded = to == BROADCAST and params == b"\xff" and "guarded_reset" in servo.table.abilities
            error = ErrorCode.RESULT_FAIL if guarded or secondary else servo.factory_reset(params[0])
        case Instruction.READ | Instruction.FACTORY_RESET:
            error = ErrorCode.DATA_LENGTH
        case Instruction.REBOOT:
            servo.reboot()
        case Instruction.CLEAR:
            error = servo.clear(params)
        case Instruction.CONTROL_TABLE_BACKUP:
            error = ErrorCode.RESULT_FAIL if secondary else servo.control_table_backup(params)
        case _:
            error = ErrorCode.INSTRUCTION
    return error, b""


def responding(listeners: Sequence[VirtualServo]) -> dict[int, list[VirtualServo]]:
    """Servos that answer reads, by id."""
    found: dict[int, list[VirtualServo]] = {}
    for servo in listeners:
        if servo.memory.values["status_return_level"] >= RETURN_READ:
            found.setdefault(servo.id, []).append(servo)
    return found


def fast_status_packets(requests: list[Request], able: Mapping[int, list[VirtualServo]]) -> list[bytes]:
    """The packet in which those asked answer together, ended before the first that is not ``able`` (by id).

    Nothing, one packet, or as many as there are servos with one id: they talk over each other.
    """
    expected = 8 + sum(length + 4 for _, _, length in requests)
    if expected > MAX_PACKET:
        return []
    columns = []
    for id, address, length in requests:
        if id not in able:
            break
        column = []
        for servo in able[id]:
            data, error = servo.read(address, length)
            column.append((servo.status_byte(error), id, data.ljust(length, b"\x00")))
        columns.append(column)
    deepest = max(map(len, columns), default=0)
    return [build_fast_status([c[min(k, len(c) - 1)] for c in columns], expected) for k in range(deepest)]
