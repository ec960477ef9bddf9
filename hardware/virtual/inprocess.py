"""A servo bus without a wire: the virtual bus called as a function, in no time at all."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    ServoRefusedError,
)
from robot_ik.hardware.bus import BROADCAST_ID, ERROR_REASONS, Counters, Status
from robot_ik.hardware.control_table import Register
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.protocol2 import Instruction, Packet, Parser, build


class SimBus:
    """Implements ``ServoBus`` on a ``VirtualBus``, usually on a ``VirtualClock``.

    Every request still becomes a packet and every answer is parsed from bytes, so that faults of the
    wire and of the servos show here as they do behind a port.  Requests take no time on the clock.

    Args:
        virtual_bus: The servos.
        retries: How often an unanswered or corrupt request is repeated.
    """

    def __init__(self, virtual_bus: VirtualBus, *, retries: int = 2) -> None:
        self.port = "sim"
        self.counters = Counters()
        self.virtual_bus = virtual_bus
        self._retries = retries
        self._open = False
        self._lock = threading.RLock()
        self._last_good: dict[int, float] = {}

    @property
    def is_open(self) -> bool:
        """Whether ``open`` was called."""
        return self._open

    def open(self) -> None:
        """Nothing can be in the way."""
        self._open = True

    def close(self) -> None:
        """May be called any number of times."""
        self._open = False

    def ping(self, id: int) -> int:
        """Model number of one servo.

        Raises:
            BusTimeoutError, BusCorruptError, BusNotOpenError.
        """
        return int.from_bytes(self._ask(id, "ping", Instruction.PING, b"", 3).data[:2], "little")

    def broadcast_ping(self) -> dict[int, int]:
        """Servo id -> model number of everyone who answers.

        Raises:
            BusNotOpenError.
        """
        answers = self._exchange(build(BROADCAST_ID, Instruction.PING), "broadcast ping")
        found = {
            a.id: int.from_bytes(a.data[:2], "little") for a in answers if a.is_status and len(a.data) == 3
        }
        return dict(sorted(found.items()))

    def read(self, id: int, register: Register) -> Status:
        """One register of one servo.

        Raises:
            BusTimeoutError, BusCorruptError, BusNotOpenError, ServoRefusedError.
        """
        where = _word(register.address) + _word(register.size)
        answer = self._ask(id, register.name, Instruction.READ, where, register.size)
        return Status(id, register.decode(answer.data), 0, answer.alert)

    def write(self, id: int, register: Register, value: int) -> Status:
        """One register of one servo; to ``BROADCAST_ID`` nobody answers.

        Raises:
            ValueError: The value does not fit the register; nothing is sent.
            BusTimeoutError, BusCorruptError, BusNotOpenError, ServoRefusedError.
        """
        params = _word(register.address) + register.encode(value)
        if id == BROADCAST_ID:
            self._exchange(build(id, Instruction.WRITE, params), register.name)
            return Status(id, None)
        return Status(id, None, 0, self._ask(id, register.name, Instruction.WRITE, params, 0).alert)

    def reboot(self, id: int) -> None:
        """Restarts one servo.

        Raises:
            BusTimeoutError, BusCorruptError, BusNotOpenError, ServoRefusedError.
        """
        self._ask(id, "reboot", Instruction.REBOOT, b"", 0)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """The same register of many servos in one packet; nobody answers.

        Raises:
            ValueError: A value does not fit the register; nothing is sent.
            BusNotOpenError.
        """
        body = b"".join(bytes([id]) + register.encode(value) for id, value in values.items())
        params = _word(register.address) + _word(register.size) + body
        self._exchange(build(BROADCAST_ID, Instruction.SYNC_WRITE, params), register.name)

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, Status]:
        """The same register of many servos; a row for every id, ``data`` None where nothing usable came.

        Raises:
            BusNotOpenError.
        """
        found: dict[int, Status] = {}
        missing = list(ids)
        with self._lock:
            self.counters.cycles += 1
            for attempt in range(1 + self._retries):
                self.counters.retries += attempt > 0
                self._sync_read_once(register, missing, found)
                missing = [id for id in missing if id not in found]
                if not missing:
                    break
            self.counters.timeouts += len(missing)
        return {id: found.get(id) or Status(id, None) for id in ids}

    def _sync_read_once(self, register: Register, ids: Sequence[int], found: dict[int, Status]) -> None:
        params = _word(register.address) + _word(register.size) + bytes(ids)
        for answer in self._exchange(build(BROADCAST_ID, Instruction.SYNC_READ, params), register.name):
            if not answer.is_status or answer.id not in ids:
                continue
            usable = len(answer.data) == register.size and not answer.error
            if not usable and not answer.error:
                self.counters.corrupt += 1
                continue
            data = register.decode(answer.data) if usable else None
            found[answer.id] = Status(answer.id, data, answer.error, answer.alert)
            self._last_good[answer.id] = self.virtual_bus.clock.now()

    def _ask(self, id: int, what: str, instruction: Instruction, params: bytes, size: int) -> Packet:
        """Sends until servo ``id`` answers with ``size`` bytes of data or an error number."""
        now = self.virtual_bus.clock.now
        with self._lock:
            corrupt = self.counters.corrupt
            for attempt in range(1 + self._retries):
                self.counters.retries += attempt > 0
                for answer in self._exchange(build(id, instruction, params), what):
                    if not answer.is_status or answer.id != id:
                        continue
                    if answer.error:
                        self._last_good[id] = now()
                        reason = ERROR_REASONS.get(answer.error, "unknown error")
                        raise ServoRefusedError(id=id, register=what, code=answer.error, reason=reason)
                    if len(answer.data) == size:
                        self._last_good[id] = now()
                        return answer
                    self.counters.corrupt += 1
            if self.counters.corrupt > corrupt:
                raise BusCorruptError(
                    f"answers of servo id {id} on {self.port} ({what}) are damaged: checksum or length wrong",
                    hint="two servos may have this id",
                )
            self.counters.timeouts += 1
            since = self._last_good.get(id)
            age = None if since is None else now() - since
            raise BusTimeoutError(id=id, register=what, port=self.port, last_good=age)

    def _exchange(self, request: bytes, what: str) -> list[Packet]:
        """What comes back on a request, the damaged counted and left out."""
        with self._lock:
            if not self._open:
                raise BusNotOpenError(
                    f"{what} was asked of {self.port}, which is not open", hint="call open()"
                )
            self.counters.bytes_sent += len(request)
            self.virtual_bus.advance()
            if self.virtual_bus.unplugged:
                raise BusDisconnectedError(f"{self.port} went away while {what} was asked")
            reply = self.virtual_bus.handle(request)
            self.counters.bytes_received += len(reply)
            # A new parser each time: an answer that broke off must not run into the next one.
            packets = Parser().feed(reply, 0.0)
            # Bytes without any packet in them are an answer too: somebody spoke, and not to be understood.
            nonsense = bool(reply) and not packets
            self.counters.corrupt += nonsense + sum(not p.valid for p in packets)
            self.counters.alerts += sum(p.is_status and p.alert for p in packets)
            return [p for p in packets if p.valid]


def _word(value: int) -> bytes:
    return value.to_bytes(2, "little")
