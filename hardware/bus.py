"""What every servo bus can do, whatever lies behind it: a serial port, a pty or plain Python objects.

Values cross this interface decoded (signed where the register is signed) and in the servo's own units;
radians begin one layer up, in ``Joint``.  All methods are safe to call from any thread.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from robot_ik.errors import BusCorruptError, BusTimeoutError, ServoMismatchError, ServoRefusedError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.models import model_name
from robot_ik.hardware.registers import Register
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

ALERT_BIT = 0x80
"""Bit 7 of the ERR byte: the servo has a hardware error, see register 70 (Protocol 2.0 manual)."""

BROADCAST_ID = 254
"""Every servo listens to this id and none answers a write to it."""

GARBLED = 3
"""ERR number of a servo that received a damaged request: worth asking again."""

ERROR_REASONS: dict[int, str] = {
    1: "result fail",
    2: "unknown instruction",
    3: "checksum of the request was wrong",
    4: "data range (for goal registers also: bus watchdog has tripped)",
    5: "data length",
    6: "data limit (outside the servo's own limits)",
    7: "access (read-only, undefined, or EEPROM while torque is on)",
}
"""ERR byte, bits 0-6: a number, not a mask (Protocol 2.0 manual, "Status packet")."""


KEEPS_TORQUE = "a servo that hears nothing keeps its torque"
"""For errors of a line: true before the arm is left and after."""


class BusStatus(NamedTuple):
    """What one servo answered to one request.

    Attributes:
        id: Servo id.
        data: Decoded register value.  ``None`` in the reply to a read: the servo did not answer, or
            (``error`` not 0) answered without data.  Always ``None`` in the reply to a write.
        error: ERR number 0..7 (bits 0-6); 0 is good.
        alert: The servo reports a latched hardware error.  Information, not a failure: the data are good.
    """

    id: int
    data: int | None
    error: int = 0
    alert: bool = False


@dataclass
class Counters:
    """Running totals of one bus since it was made; they add up over reconnects.

    Attributes:
        cycles: Reads of many servos at once.
        asked: Measurements wanted in them, one per servo; always the sum of the next three.
        answered: … that came; ``refused``: … for which an error number came; ``timeouts``: … that never came.
            Single reads and writes without a reply count as ``asked`` and ``timeouts`` too.
        corrupt: Replies that came and could not be trusted (checksum, length).
        late: Replies that came after their request was given up; nothing of them was used.
        retries: Requests repeated because of the above.
        alerts: Replies that carried the alert bit.
        fallbacks: Times fast reads were given up.
        bytes_sent, bytes_received: On the wire, from the host's side.
    """

    cycles: int = 0
    asked: int = 0
    answered: int = 0
    refused: int = 0
    timeouts: int = 0
    corrupt: int = 0
    late: int = 0
    retries: int = 0
    alerts: int = 0
    fallbacks: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0


@runtime_checkable
class ServoBus(Protocol):
    """A bus of servos of one family.

    Errors: ``BusNotOpenError`` (open, or any call before it), ``BusTimeoutError`` (a single servo did
    not answer ``read``/``write``/``ping``), ``BusCorruptError`` (it answered nonsense every time),
    ``BusDisconnectedError`` (the port went away), ``ServoRefusedError`` (error number in the reply).
    ``sync_read`` never raises for a servo: the row of one that did not answer has ``data`` None.
    Every call returns within its time, whatever comes in: a line may never fall silent.
    """

    port: str
    real: bool  # whether the servos are made of metal; False: simulated
    counters: Counters
    clock: Clock  # on which an arm on this bus runs
    names: dict[int, str]  # servo id -> joint, for errors; each arm on this bus adds its own

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        ...

    def fileno(self) -> int | None:
        """Return the file descriptor of the open port; None if there is none."""
        ...

    def open(self) -> None:
        """Opens the port for this process alone."""
        ...

    def close(self) -> None:
        """Closes the port; may be called any number of times and never raises."""
        ...

    def ping(self, id: int) -> int:
        """Model number of one servo."""
        ...

    def broadcast_ping(self) -> dict[int, int]:
        """Servo id -> model number of everyone who answers; may take a second on a real wire."""
        ...

    def read(self, id: int, register: Register) -> BusStatus:
        """One register of one servo; ``data`` is never ``None`` in what is returned."""
        ...

    def write(self, id: int, register: Register, value: int) -> BusStatus:
        """One register of one servo.  No servo answers one to ``BROADCAST_ID``.

        Raises:
            ValueError: The value does not fit the register, as in all that write; nothing is sent.
        """
        ...

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, BusStatus]:
        """The same register of many servos in one cycle; a row for every id asked.

        Servos that do not answer are asked again, but only within a time and not if they were silent in the
        cycle before as well: one dead servo must not slow down the others.
        """
        ...

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """The same register of many servos in one packet (servo id -> value), which has no reply."""
        ...

    def exchange(
        self,
        register: Register,
        values: Mapping[int, int],
        reads: Mapping[int, Register],
        within: float | None = None,
    ) -> dict[int, BusStatus]:
        """A control cycle: goals and the request for measurements leave in one write.

        Late replies are distinguished from good ones: for a while after a miss, some bytes behind a register
        are read as well.  A servo that has not answered for several cycles is left out of some.

        Args:
            register: Written, the same of every servo.
            values: Servo id -> its value; may be empty.
            reads: Servo id -> register, each its own.
            within: s after which no servo is asked again.

        Returns:
            A row for every id of ``reads``; ``data`` is None where nothing usable came.
        """
        ...

    def use_fast_reads(self, ids: Collection[int]) -> None:
        """Only these servos may be asked to answer together in one packet (their firmware knows it)."""
        ...

    def reboot(self, id: int) -> None:
        """Restarts one servo: latched errors are gone, torque is off, RAM registers are at their defaults."""
        ...


# ------------------------------------------------------------------------------------------
# One register of all servos of an arm: where it lies, what it reads, whose fault an error is.


NO_ACCESS = 7
"""ERR number: no such register, read-only, or locked."""


def shared_register(config: ArmConfig, name: str) -> Register:
    """The register all servos of the arm have at one address: what sync read and write need.

    Raises:
        ConfigError: The models of the arm differ in it.
    """
    first = config.servos[0].table[name]
    for servo in config.servos:
        other = servo.table[name]
        if (other.address, other.size, other.signed) != (first.address, first.size, first.signed):
            problem = f"{name} lies elsewhere in {servo.model} than in {config.servos[0].model}"
            raise config.wrong(problem, "joints", "models with one layout on one bus")
    return first


def require_models(bus: ServoBus, wanted: Mapping[int, tuple[str, int]], source: str) -> None:
    """Every servo is there, and is the right model.

    ``wanted``: servo id -> its joint, and its Model Number; ``source``: who says so, "the arm file".

    Raises:
        ServoMismatchError: Missing or another model.
        BusDisconnectedError, BusNotOpenError.
    """
    found: dict[int, int] = {}
    damaged: set[int] = set()
    for id in wanted:
        try:
            found[id] = bus.ping(id)
        except BusCorruptError:
            damaged.add(id)
        except BusTimeoutError as error:
            log.debug("ping %d: %s", id, error)
    if all(found.get(id) == number for id, (_, number) in wanted.items()):
        return
    if len(found) < len(wanted):
        found |= bus.broadcast_ping()  # who else is there: a wrong id is the usual reason
        if all(found.get(id) == number for id, (_, number) in wanted.items()):
            return  # a ping was lost, and all have answered now
    hint = ""  # the error's own
    if damaged and found:
        hint = "do two servos have that id? connect one of them alone: robot-ik servo setup --id N"
    elif damaged:
        hint = "no reply arrives whole: check the cable, its contacts and the adapter"
    elif not found:
        hint = (
            "no servo answers at all: check the servos' power and the cable; "
            "robot-ik servo scan looks for them at every baud rate"
        )
    models = dict.fromkeys(damaged, "damaged replies") | {id: model_name(n) for id, n in found.items()}
    expected = {id: f"{joint}: {model_name(number)}" for id, (joint, number) in wanted.items()}
    raise ServoMismatchError(expected, models, port=bus.port, hint=hint, source=source)


def read_all(bus: ServoBus, config: ArmConfig, name: str, *, absent: int | None = None) -> dict[int, int]:
    """One register of every servo; who misses the common read is asked alone.

    ``absent``: what it is taken to read where older firmware does not have it.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint name.
    """
    if absent is not None and name not in config.servos[0].table:
        return dict.fromkeys(config.servo_ids, absent)
    register = shared_register(config, name)
    values: dict[int, int] = {}
    for id, status in bus.sync_read(config.servo_ids, register).items():
        value = status.data
        if value is None and (absent is None or status.error != NO_ACCESS):
            try:
                value = bus.read(id, register).data
            except ServoRefusedError as refused:
                if refused.code != NO_ACCESS or absent is None:
                    raise
        if value is None:
            value = absent
        if value is None:
            raise BusCorruptError(f"servo id {id} answered {name} without data")
        values[id] = value
    return values
