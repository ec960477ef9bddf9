"""Interface of every servo bus: a serial port, a pty or plain Python objects.

Values cross this interface decoded (signed if the register is signed) and in the servo's own units.
Radians begin one layer up, in ``Joint``.  All methods are safe to call from any thread.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from robot_ik.hardware.registers import Register
from robot_ik.ports import Clock

ALERT_BIT = 0x80
"""Bit 7 of the ERR byte: the servo has a hardware error, see register 70 (Protocol 2.0 manual)."""

BROADCAST_ID = 254
"""Every servo obeys a write to this id and none answers it."""

GARBLED = 3
"""ERR number of a servo that received a damaged request: the request is worth repeating."""

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
"""Hint of errors of a line.  It is true before the arm is left and after."""


class BusStatus(NamedTuple):
    """What one servo answered to one request.

    Attributes:
        id: Servo id.
        data: Decoded register value.  ``None`` in the reply to a read: the servo did not answer, or
            (``error`` not 0) answered without data.  Always ``None`` in the reply to a write.
        error: ERR number 0..7 (bits 0-6); 0 is good.
        alert: The servo reports a latched hardware error.  The data are good all the same.
    """

    id: int
    data: int | None
    error: int = 0
    alert: bool = False


@dataclass
class Counters:
    """Running totals of one bus since it was made; they add up over reconnects.

    Single reads and writes without a reply count as ``asked`` and ``timeouts`` too.

    Attributes:
        cycles: Reads of several servos at once.
        asked: Measurements asked for in them, one a servo: the sum of the next three.
        answered: Measurements that came.
        refused: Measurements for which an error number came.
        timeouts: Measurements that never came.
        corrupt: Replies that came and could not be trusted (checksum, length).
        late: Replies that came after their request was given up.  None of them was used.
        retries: Requests that were repeated.
        alerts: Replies that carried the alert bit.
        fallbacks: Times fast reads were given up.
        bytes_sent: Bytes sent by the host.
        bytes_received: Bytes received by the host.
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

    Every call returns within its time, whatever comes in: a line may never fall silent.
    ``sync_read`` raises no error of a servo: the row of a servo that did not answer has ``data``
    None.

    Raises:
        BusNotOpenError: By ``open``, and by every call before it.
        BusTimeoutError: A single servo did not answer ``read``, ``write`` or ``ping``.
        BusCorruptError: The replies of a single servo were damaged every time.
        BusDisconnectedError: The port went away.
        ServoRefusedError: The reply has an error number.

    Attributes:
        port: Name of the port.
        real: Whether the servos are real; False: simulated.
        counters: Running totals.
        clock: Clock of an arm on this bus.
        names: Servo id -> joint, for errors.  Each arm on this bus adds its own.
    """

    port: str
    real: bool
    counters: Counters
    clock: Clock
    names: dict[int, str]

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        ...

    def fileno(self) -> int | None:
        """Return the file descriptor of the open port; None if there is none."""
        ...

    def open(self) -> None:
        """Open the port for this process alone."""
        ...

    def close(self) -> None:
        """Close the port.  May be called any number of times and never raises."""
        ...

    def ping(self, id: int) -> int:
        """Return the model number of one servo."""
        ...

    def broadcast_ping(self) -> dict[int, int]:
        """Return servo id -> model number of every servo that answers; may take a second."""
        ...

    def read(self, id: int, register: Register) -> BusStatus:
        """Return one register of one servo; ``data`` is never ``None``."""
        ...

    def write(self, id: int, register: Register, value: int) -> BusStatus:
        """Write one register of one servo.  No servo answers a write to ``BROADCAST_ID``.

        Raises:
            ValueError: The value does not fit the register, as in every write.  Nothing is sent.
        """
        ...

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, BusStatus]:
        """Return the same register of several servos; a row for every id.

        Servos that do not answer are read again, within a time and unless they were silent in the
        cycle before as well.  So a dead servo does not slow down the others.
        """
        ...

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write the same register of several servos (id -> value) in a packet without a reply."""
        ...

    def exchange(
        self,
        register: Register,
        values: Mapping[int, int],
        reads: Mapping[int, Register],
        within: float | None = None,
    ) -> dict[int, BusStatus]:
        """Run a control cycle: goals and the request for measurements leave in one write.

        Late replies are distinguished from good ones: for a while after a miss, some bytes behind a
        register are read as well.  A servo that has not answered for several cycles is left out of
        some.

        Args:
            register: Register to write, the same of every servo.
            values: Servo id -> value to write; may be empty.
            reads: Servo id -> register to read, each its own.
            within: s after which no servo is asked again.

        Returns:
            A row for every id of ``reads``; ``data`` is None if nothing usable came.
        """
        ...

    def use_fast_reads(self, ids: Collection[int]) -> None:
        """Allow these servos to answer together in one packet.  Their firmware must support it."""
        ...

    def reboot(self, id: int) -> None:
        """Restart one servo.

        Its latched errors are cleared, its torque is off, and its RAM registers have their
        defaults.
        """
        ...
