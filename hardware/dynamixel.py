"""Servo bus over a serial port or pty: single requests by the Dynamixel SDK, the rest by ``packets``.

The SDK builds, stuffs, finds and checks the packets of ``ping``, ``read``, ``write`` and ``reboot``.  What it
leaves open is closed here and in ``wire``: a lock, a length check before any byte is decoded, retries with a
bound.  Requests to many servos and their answers, those of a ping to all among them, are built and taken
apart in ``packets``: quickly, and so that the answers which did arrive are kept, with their alert bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence

from robot_ik.errors import BusCorruptError, BusTimeoutError, ServoRefusedError
from robot_ik.hardware.bus import BROADCAST_ID, ERROR_REASONS, GARBLED, Counters, Status
from robot_ik.hardware.control_table import Register
from robot_ik.hardware.group import GroupTraffic
from robot_ik.hardware.packets import SHORTEST_STATUS, Answer, StatusParser, build
from robot_ik.hardware.quiet_port import ANSWER_TIME, QuietPortHandler
from robot_ik.hardware.wire import QUIET, Wire

PING, _REBOOT = 0x01, 0x08
PING_DATA = 3
"""Bytes of data: model number 2, firmware 1."""
PING_BYTES = SHORTEST_STATUS + PING_DATA
"""Of the answer to a ping."""

_IDS = 253
_SLOT = 0.003  # s that each id may take to answer a ping to all (as the Dynamixel SDK waits)
_LATENESS = 0.016  # s, a USB adapter as it comes


def listening_time(baud: int) -> float:
    """s in which all 253 ids could have answered a ping at this rate."""
    return _IDS * (_SLOT + 10.0 * PING_BYTES / baud) + _LATENESS


class DynamixelBus:
    """Protocol 2.0 servos on one port.  Thread-safe; implements ``ServoBus``.

    Args:
        port: Path or name of the serial port.
        baud: bit/s, one the servos know.
        retries: How often an unanswered or corrupt request is repeated.
        answer_time: s a servo is given to answer, beyond the time of the bytes.
        make_handler: Makes what reads and writes the port; takes name, rate, counters and answer time.
        now: The clock of ages and deadlines, s.
    """

    def __init__(
        self,
        port: str,
        baud: int = 1_000_000,
        *,
        retries: int = 2,
        answer_time: float = ANSWER_TIME,
        make_handler: Callable[..., QuietPortHandler] = QuietPortHandler,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.port = port
        self.baud = baud
        self.counters = Counters()
        self._wire = Wire(port, baud, self.counters, answer_time, make_handler, now)
        self._packet = self._wire.packet
        self._retries = retries
        self._group = GroupTraffic(self._wire, retries)

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._wire.is_open

    def open(self) -> None:
        """Opens the port for this process alone.

        Raises:
            BusNotOpenError: Missing, not a serial port, not permitted, in use, or an impossible rate.
        """
        self._wire.open()
        self._group.reset()

    def close(self) -> None:
        """Closes the port; may be called any number of times and never raises."""
        self._wire.close()

    # ---------------------------------------------------------------------------- single servos

    def ping(self, id: int) -> int:
        """Model number of one servo.

        Raises:
            BusTimeoutError, BusCorruptError, BusDisconnectedError, BusNotOpenError.
        """
        answer = self._ask(id, "ping", PING_DATA, lambda port: self._bare(port, id, PING))
        return answer.data[0] | answer.data[1] << 8

    def broadcast_ping(self) -> dict[int, int]:
        """Servo id -> model number of everyone who answers; takes about a second, whoever answers.

        Not by the SDK: it takes any packet of 14 bytes for an answer, an echoed request among them.

        Raises:
            BusDisconnectedError, BusNotOpenError.
        """
        parser, found = StatusParser(), {}
        with self._wire.transaction("broadcast ping") as port:
            port.clear()
            port.send(build(BROADCAST_ID, PING, b""))
            end = self._wire.now() + listening_time(self.baud)
            over, data = False, b"begin"
            while data and not over:
                over = self._wire.now() > end  # a line may never fall silent: this is the last look
                data = port.receive(end)
                for answer in parser.feed(data):
                    if len(answer.data) == PING_DATA:
                        found[answer.id] = answer.data[0] | answer.data[1] << 8
        self.counters.corrupt += parser.damaged
        return dict(sorted(found.items()))

    def read(self, id: int, register: Register) -> Status:
        """One register of one servo.

        Raises:
            BusTimeoutError, BusCorruptError, BusDisconnectedError, BusNotOpenError, ServoRefusedError.
        """
        answer = self._ask(
            id,
            register.name,
            register.size,
            lambda port: self._packet.readTx(port, id, register.address, register.size),
        )
        return Status(id, register.decode(answer.data), 0, answer.alert)

    def write(self, id: int, register: Register, value: int) -> Status:
        """One register of one servo; to ``BROADCAST_ID`` nobody answers.

        Raises:
            ValueError: The value does not fit the register; nothing is sent.
            BusTimeoutError, BusCorruptError, BusDisconnectedError, BusNotOpenError, ServoRefusedError.
        """
        data = list(register.encode(value))

        def send(port: QuietPortHandler) -> object:
            return self._packet.writeTxOnly(port, id, register.address, register.size, data)

        if id == BROADCAST_ID:
            with self._wire.transaction(None) as port:
                send(port)
            return Status(id, None)
        answer = self._ask(id, register.name, 0, send)
        return Status(id, None, 0, answer.alert)

    def reboot(self, id: int) -> None:
        """Restarts one servo; it is deaf for some tenths of a second after.

        Raises:
            BusTimeoutError, BusCorruptError, BusDisconnectedError, BusNotOpenError, ServoRefusedError.
        """
        self._ask(id, "reboot", 0, lambda port: self._bare(port, id, _REBOOT))

    # ------------------------------------------------------------------------- many servos at once

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """The same register of many servos in one packet; nobody answers.

        Raises:
            ValueError: A value does not fit the register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        self._group.write({id: (register, value) for id, value in values.items()})

    def bulk_write(self, values: Mapping[int, tuple[Register, int]]) -> None:
        """A register of its own of every servo in one packet; nobody answers.

        Raises:
            ValueError: A value does not fit its register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        self._group.write(values)

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, Status]:
        """The same register of many servos in one cycle.

        Servos that do not answer are asked again, but only within a time and not if they were silent in the
        cycle before as well: one dead servo must not slow down the others.

        Returns:
            A row for every id; ``data`` is None where nothing usable came.

        Raises:
            BusDisconnectedError, BusNotOpenError.
        """
        return self._group.read(dict.fromkeys(ids, register))

    def bulk_read(self, registers: Mapping[int, Register]) -> dict[int, Status]:
        """A register of its own from every servo in one cycle; otherwise as ``sync_read``."""
        return self._group.read(registers)

    def exchange(
        self,
        writes: Mapping[int, tuple[Register, int]],
        reads: Mapping[int, Register],
        within: float | None = None,
    ) -> dict[int, Status]:
        """A control cycle: goals and the question for measurements leave in one piece.

        Args:
            writes: Servo id -> register and value.
            reads: Servo id -> register.
            within: s after which nobody is asked again.

        Returns:
            A row for every id of ``reads``; ``data`` is None where nothing usable came.

        Raises:
            ValueError: A value does not fit its register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        return self._group.read(reads, writes, within, guarded=True)

    def use_fast_reads(self, ids: Collection[int]) -> None:
        """Only these servos may be asked to answer together in one packet; at first nobody."""
        self._group.fast_ids = frozenset(ids)

    # ---------------------------------------------------------------------------------- packets

    def _bare(self, port: QuietPortHandler, id: int, instruction: int) -> object:
        """An instruction without parameters."""
        return self._packet.txPacket(port, [0, 0, 0, 0, id, 3, 0, instruction, 0, 0])

    def _ask(self, id: int, what: str, size: int, send: Callable[[QuietPortHandler], object]) -> Answer:
        """Sends until servo ``id`` answers with ``size`` bytes of data or an error number."""
        corrupt = self.counters.corrupt
        with self._wire.transaction(f"{what} of {id}") as port:
            for attempt in range(1 + self._retries):
                if attempt:
                    self.counters.retries += 1
                    port.drain(QUIET)
                send(port)
                port.setPacketTimeout(SHORTEST_STATUS + size)
                answer = self._answer(port, id, size)
                if answer is not None and answer.code != GARBLED:
                    break
                self._wire.missed()
        if answer is not None:
            self._wire.last_good[id] = self._wire.now()
            if answer.code:
                reason = ERROR_REASONS.get(answer.code, "unknown error")
                raise ServoRefusedError(id=id, register=what, code=answer.code, reason=reason)
            return answer
        if self.counters.corrupt > corrupt:
            raise BusCorruptError(
                f"answers of servo id {id} on {self.port} ({what}) are damaged: checksum or length wrong",
                hint="check the cable, the baud rate and whether two servos have this id",
            )
        self.counters.asked += 1
        self.counters.timeouts += 1
        since = self._wire.last_good.get(id)
        age = None if since is None else self._wire.now() - since
        raise BusTimeoutError(id=id, register=what, port=self.port, last_good=age)

    def _answer(self, port: QuietPortHandler, id: int, size: int) -> Answer | None:
        """What servo ``id`` says within the packet's time; None if nothing, or only damaged packets."""
        while True:
            answer = self._wire.receive(port)
            if answer is None:
                return None
            if answer.id == id:
                if answer.code or len(answer.data) == size:
                    return answer
                self.counters.corrupt += 1
                return None
            if port.isPacketTimeout():
                return None
