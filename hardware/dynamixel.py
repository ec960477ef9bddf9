"""Servo bus over a serial port or pty: single requests by the Dynamixel SDK, the rest by ``packets``.

The SDK builds, stuffs, finds and checks the packets of ``ping``, ``read``, ``write`` and ``reboot``.  What it
leaves open is closed here: a lock, a length check before any byte is decoded, retries with a bound.
``packets`` builds and takes apart requests to many servos: quickly, and so that the replies which did arrive
are kept, with their alert bits.
"""

from __future__ import annotations

import logging
import threading
from builtins import id as identity
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS, Protocol2PacketHandler

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    ServoRefusedError,
)
from robot_ik.hardware.bus import (
    ALERT_BIT,
    BROADCAST_ID,
    ERROR_REASONS,
    GARBLED,
    KEEPS_TORQUE,
    BusStatus,
    Counters,
)
from robot_ik.hardware.control_table import BAUD_RATES, IDS, Register
from robot_ik.hardware.packets import (
    FAST_FRAME,
    FAST_HEAD,
    SHORTEST_STATUS,
    FastParser,
    StatusPacket,
    StatusParser,
    build,
    read_request,
    whole_fast_status,
    write_request,
)
from robot_ik.hardware.serial_port import (
    OPEN_ERRORS,
    PORT_ERRORS,
    QUIET,
    RESPONSE_TIME,
    RoundTripEstimator,
    SleepingPortHandler,
    describe_failure,
)
from robot_ik.ports import Clock, RealClock

# ------------------------------------------------------------------------------------------
# Many servos in one go: goals out, measurements back, within the time a control cycle has.
#
# Goals and the request for measurements leave in one write.  Servos whose firmware allows it answer together
# in one packet (fast read); where that fails, they are asked the plain way, after ``MAX_FAST_FAILURES`` in a
# row for good.  A servo that does not answer is asked again while there is time, and hides no other.
#
# A reply says from which servo it is, and not which request it answers.  ``_Unanswered`` keeps what was asked
# in vain: while a reply to it may still come, that servo is not asked for as many bytes again.  A control
# cycle asks for some bytes more, so that a late reply is known by its length.  Other calls wait.


log = logging.getLogger(__name__)

CYCLE_TIME = 0.100
"""s after which a read is not tried again, whoever is still missing, where the caller names no time."""

MAX_FAST_FAILURES = 5
"""Fast reads in a row that fail before they are given up until the port is opened again."""

LATEST_REPLY = 0.16
"""s after a request was given up in which a reply to it may still come: 150 ms, and some for the bytes.  A
busy computer and a USB adapter together hold a reply back for some tens of ms."""

LENGTHS = 8
"""Lengths that a control cycle chooses from.  At 100 Hz and one lost packet in ten a servo has two requests
unanswered in ``LATEST_REPLY``, and eight once in a thousand cycles: then it is left out of one."""


class _ReadPlan(NamedTuple):
    """A request to many servos: its bytes, and what comes back."""

    request: bytes
    bytes_back: int
    fast: bool
    sizes: tuple[tuple[int, int], ...]  # (id, bytes of data)
    registers: tuple[Register, ...]  # kept alive: plans are found by their identity


class _Wanted(NamedTuple):
    """What a request is for: servo id -> register, the same as asked (perhaps longer), what is there.

    ``doubtful``: ids of which an error number may answer a request of an earlier call.
    """

    registers: Mapping[int, Register]
    asked: Mapping[int, Register]
    found: dict[int, BusStatus]
    doubtful: frozenset[int]


@lru_cache(maxsize=1024)
def _widened(register: Register, by: int) -> Register:
    return replace(register, size=register.size + by)


class _Unanswered(dict[tuple[int, int], float]):
    """Requests to which a reply may still come: (servo id, bytes of data) of it -> until when, s.

    Usually there are none.
    """

    @property
    def ids(self) -> frozenset[int]:
        return frozenset(id for id, _ in self)

    def add(self, keys: Iterable[tuple[int, int]], now: float) -> None:
        """A reply to these was given up, or the reply that came may be that to an earlier request."""
        self.update(dict.fromkeys(keys, now + LATEST_REPLY))

    def forget(self, now: float) -> None:
        """Forgets those to which no reply comes any more."""
        for key in [key for key, until in self.items() if until <= now]:
            del self[key]

    def end(self, keys: Iterable[tuple[int, int]]) -> float:
        """Until when a reply to one of these may come, s; 0 where none may."""
        return max((self.get(key, 0.0) for key in keys), default=0.0)

    def other_length(self, id: int, register: Register) -> Register | None:
        """The register, or more bytes from its address on, so that no late reply is as long.

        None: there are late replies of every length.
        """
        for extra in range(LENGTHS):
            if (id, register.size + extra) not in self:
                return _widened(register, extra) if extra else register
        return None


_NO_IDS: frozenset[int] = frozenset()

PING, _REBOOT = 0x01, 0x08
PING_DATA = 3
"""Bytes of data: model number 2, firmware 1."""
PING_BYTES = SHORTEST_STATUS + PING_DATA
"""Of the reply to a ping."""

_SLOT = 0.003  # s that each id may take to answer a ping to all (as the Dynamixel SDK waits)
_LATENESS = 0.016  # s, a USB adapter as it comes


def listening_time(baud: int) -> float:
    """s in which all 253 ids could have answered a ping at this rate."""
    return len(IDS) * (_SLOT + 10.0 * PING_BYTES / baud) + _LATENESS


class DynamixelBus:
    """Protocol 2.0 servos on one port.  Thread-safe; implements ``ServoBus``.

    What is guaranteed: a reply to a request of an earlier call is never taken for an answer, if it comes
    within ``LATEST_REPLY`` after that request was given up, in whatever order replies come.  One that comes
    later is not recognised.  A reply to an earlier attempt of the same call is an answer: the servo read the
    register after the call began.  Requests of a program that had the port before are covered by
    ``RESPONSE_TIME`` of silence after it was opened.

    The SDK marks a port busy while a transaction runs and forgets to clear the mark when an exception
    (Ctrl-C, a pulled cable) ends it; every later write, torque off among them, is then refused.  Here the
    mark is cleared whatever happens, and a line on which replies may still be under way is emptied before the
    next request.

    Args:
        port: Path or name of the serial port.
        baud: bit/s, one the servos know.
        retries: How often an unanswered or corrupt request is repeated.
        clock: Of ages and deadlines; virtual where the port is a function call.
    """

    def __init__(
        self,
        port: str,
        baud: int = 1_000_000,
        *,
        retries: int = 2,
        clock: Clock | None = None,
    ) -> None:
        self.port = port
        self.baud = baud
        self.counters = Counters()
        self.names: dict[int, str] = {}
        self._packet = Protocol2PacketHandler()
        self.clock = clock or RealClock()
        self._retries = retries
        self._now = self.clock.now
        self._sleep_until = self.clock.sleep_until
        self._lock = threading.RLock()
        self._handler: SleepingPortHandler | None = None
        self._silence = 0.0  # s for which the line must be silent before the next request
        self._unanswered = _Unanswered()
        self._last_good: dict[int, float] = {}  # servo id -> when it last answered
        self._fast_ids: frozenset[int] = frozenset()
        self._plans: dict[tuple[object, ...], _ReadPlan] = {}
        self._forget()

    @property
    def is_open(self) -> bool:
        return self._handler is not None

    def _make_handler(self) -> SleepingPortHandler:
        return SleepingPortHandler(self.port, self.baud, self.counters)

    def open(self) -> None:
        with self._lock:
            if self._handler is not None:
                return
            handler = self._make_handler()
            if handler.getCFlagBaud(self.baud) <= 0:
                rates = ", ".join(str(rate) for rate in BAUD_RATES.values())
                raise BusNotOpenError(f"cannot open {self.port} at {self.baud} baud; possible: {rates}")
            try:
                handler.openPort()
            except OPEN_ERRORS as error:
                handler.closePort()
                raise describe_failure(self.port, error) from error
            self._handler = handler
            self._silence = RESPONSE_TIME
            self._forget()

    def _forget(self) -> None:
        """What was learned about the servos: the port is opened anew."""
        self._silent: frozenset[int] = frozenset()
        self._fast_misses = 0
        self._times = RoundTripEstimator()

    def close(self) -> None:
        with self._lock:
            handler, self._handler = self._handler, None
            if handler is not None:
                try:
                    handler.closePort()
                except PORT_ERRORS as error:
                    log.warning("closing %s: %s", self.port, error)

    @contextmanager
    def _transaction(self, keys: Iterable[tuple[int, int]] | None) -> Iterator[SleepingPortHandler]:
        """The open port, for one request and its replies.

        Args:
            keys: (servo id, bytes of data) of the replies that must not be mistaken: waits until no late
                reply is like them.  None where there is no reply.

        Raises:
            BusNotOpenError, BusDisconnectedError: Not open; the port went away (it is closed then).
        """
        with self._lock:
            handler = self._handler
            if handler is None:
                raise BusNotOpenError(f"the bus on {self.port} is not open", hint="call open() first")
            clean = False
            try:
                handler.is_using = False
                if keys is not None:
                    if self._unanswered:
                        self._wait(handler, self._unanswered.end(keys))
                    if self._silence:
                        handler.drain(self._silence)
                        self._silence = 0.0
                yield handler
                clean = True
            except PORT_ERRORS as error:
                DynamixelBus.close(self)  # the port alone: what else a bus has stays, it may come back
                raise BusDisconnectedError(
                    f"the port {self.port} went away: {error}",
                    hint=f"check cable and adapter, then connect again; {KEEPS_TORQUE}",
                ) from error
            finally:
                handler.is_using = False
                if not clean:
                    self._be_quiet()

    def _be_quiet(self) -> None:
        """Bytes may still be under way: the next request must not meet them."""
        self._silence = max(self._silence, QUIET)

    def _wait(self, port: SleepingPortHandler, until: float) -> None:
        """Throws away what comes in until that time, s; nothing where it has passed."""
        if until > self._now():
            self._sleep_until(until)
            port.clear()
        self._unanswered.forget(self._now())

    # ---------------------------------------------------------------------------- single servos

    def ping(self, id: int) -> int:
        packet = self._ask(id, "ping", PING_DATA, lambda port: self._bare(port, id, PING))
        return packet.data[0] | packet.data[1] << 8

    def broadcast_ping(self) -> dict[int, int]:
        """Servo id -> model number of everyone who answers; takes about a second, whoever answers."""
        found, _ = self.collect_pings(BROADCAST_ID, listening_time(self.baud))
        return {id: number for id, (number, _) in sorted(found.items())}

    def collect_pings(self, id: int, listen: float) -> tuple[dict[int, tuple[int, int]], int]:
        """A ping to ``id``, one servo's or ``BROADCAST_ID``.

        Not by the SDK: it takes any packet of 14 bytes for a reply, an echoed request among them.

        Returns:
            Servo id -> (model number, firmware) of all who answered within ``listen`` s, late replies of
            others among them, and how many bytes belong to no packet.

        Raises:
            BusDisconnectedError, BusNotOpenError.
        """
        parser, found, useful, received = StatusParser(), {}, 0, 0
        with self._transaction(()) as port:  # a late reply to a ping says what this one would
            port.clear()
            port.writePort(build(id, PING, b""))
            end = self._now() + listen
            over, data = False, b"begin"
            while data and not over and id not in found:
                over = self._now() > end  # a line may never fall silent: this is the last look
                data = port.receive(end)
                received += len(data)
                for packet in parser.feed(data):
                    useful += PING_BYTES
                    if len(packet.data) == PING_DATA:
                        found[packet.id] = (packet.data[0] | packet.data[1] << 8, packet.data[2])
            if id not in found:
                self._be_quiet()
                late = set(IDS if id == BROADCAST_ID else (id,)).difference(found)
                self._unanswered.add(((id, PING_DATA) for id in late), self._now())
        self.counters.corrupt += parser.damaged
        return found, received - useful

    def read(self, id: int, register: Register) -> BusStatus:
        packet = self._ask(
            id,
            register.name,
            register.size,
            lambda port: self._packet.readTx(port, id, register.address, register.size),
        )
        return BusStatus(id, register.decode(packet.data), 0, packet.alert)

    def write(self, id: int, register: Register, value: int) -> BusStatus:
        data = list(register.encode(value))

        def send(port: SleepingPortHandler) -> object:
            return self._packet.writeTxOnly(port, id, register.address, register.size, data)

        if id == BROADCAST_ID:
            with self._transaction(None) as port:
                send(port)
            return BusStatus(id, None)
        packet = self._ask(id, register.name, 0, send)
        return BusStatus(id, None, 0, packet.alert)

    def reboot(self, id: int) -> None:
        """Restarts one servo; it is deaf for some tenths of a second after."""
        self._ask(id, "reboot", 0, lambda port: self._bare(port, id, _REBOOT))

    # ------------------------------------------------------------------------- many servos at once

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        request = write_request(register, values) if values else b""
        # It has no reply, so a reply still outstanding keeps belonging to the request before.
        with self._transaction(None) as port:
            if request:
                port.writePort(request)

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, BusStatus]:
        return self._read_many(dict.fromkeys(ids, register))

    def exchange(
        self,
        register: Register,
        values: Mapping[int, int],
        reads: Mapping[int, Register],
        within: float | None = None,
    ) -> dict[int, BusStatus]:
        before = write_request(register, values) if values else b""
        return self._read_many(reads, before, within, guarded=True)

    def use_fast_reads(self, ids: Collection[int]) -> None:
        self._fast_ids = frozenset(ids)

    def _read_many(
        self,
        registers: Mapping[int, Register],
        before: bytes = b"",
        within: float | None = None,
        *,
        guarded: bool = False,
    ) -> dict[int, BusStatus]:
        """``exchange``; the first request always gets its full time.

        ``before``: leaves with it, in one write.  ``guarded``: never waits for late replies, but asks for
        another length; ``LENGTHS`` - 1 bytes behind each register must be readable as well.
        """
        found: dict[int, BusStatus] = {}
        # A servo waits for the replies of those named before it: silent ones go last and hide no other.
        missing = sorted(registers, key=self._silent.__contains__) if self._silent else list(registers)
        keys = () if guarded else ((id, register.size) for id, register in registers.items())
        with self._transaction(keys) as port:
            doubtful = self._unanswered.ids if self._unanswered else _NO_IDS
            end = self._now() + (CYCLE_TIME if within is None else within)
            self.counters.cycles += 1
            self.counters.asked += len(registers)
            asked: Mapping[int, Register] = registers
            if self._silent or doubtful:
                asked = self._asked(registers, missing, guarded=guarded)
            plan = self._plan(asked, plain=asked is not registers)
            try:
                for attempt in range(1 + self._retries):
                    self.counters.retries += attempt > 0
                    if attempt:
                        asked = {id: asked[id] for id in missing if id in asked}
                        plan = self._plan(asked, plain=True)
                    self._once(port, plan, before, _Wanted(registers, asked, found, doubtful))
                    before = b""
                    if len(found) == len(registers) and not attempt:
                        missing = []
                        break
                    # Asked twice: the first reply may have come, and the second be late.
                    late = [(id, r.size) for id, r in asked.items() if attempt or id not in found]
                    self._unanswered.add(late, self._now())
                    missing = [id for id in missing if id not in found]
                    if self._silent.issuperset(missing):
                        break
                    if self._now() + self._timeout(plan, port) > end:
                        break
            except BaseException:  # the port went, or a signal came: who has not answered never will
                self.counters.timeouts += len(registers) - len(found)
                self._unanswered.add([(id, register.size) for id, register in asked.items()], self._now())
                raise
            if missing:
                self._be_quiet()
        self.counters.timeouts += len(missing)
        if missing or self._silent:
            self._silent = self._silent.difference(registers).union(missing)
            found.update((id, BusStatus(id, None)) for id in missing)
        return {id: found[id] for id in registers}  # they may have answered in another order

    def _asked(
        self, registers: Mapping[int, Register], ids: Iterable[int], *, guarded: bool
    ) -> dict[int, Register]:
        """What these servos are asked for; ``guarded``: for a length of which no late reply is."""
        if not (guarded and self._unanswered):
            return {id: registers[id] for id in ids}
        self._unanswered.forget(self._now())
        asked = {id: self._unanswered.other_length(id, registers[id]) for id in ids}
        return {id: register for id, register in asked.items() if register is not None}

    def _plan(self, registers: Mapping[int, Register], *, plain: bool = False) -> _ReadPlan:
        fast = not plain and self._fast_misses < MAX_FAST_FAILURES and len(registers) > 1
        fast = fast and self._fast_ids.issuperset(registers)
        rows = tuple(registers.values())
        key = (fast, *registers, *map(identity, rows))
        plan = self._plans.get(key)
        if plan is None:
            sizes = tuple((id, register.size) for id, register in registers.items())
            each = FAST_FRAME if fast else SHORTEST_STATUS
            back = FAST_HEAD * fast + sum(size + each for _, size in sizes)
            if len(self._plans) > 1000:  # requests to changing sets of servos
                self._plans.clear()
            request = read_request(registers, fast=fast) if registers else b""
            plan = _ReadPlan(request, back, fast, sizes, rows)
            self._plans[key] = plan
        return plan

    def _timeout(self, plan: _ReadPlan, port: SleepingPortHandler) -> float:
        """s from sending the request to giving up the replies."""
        wait = self._times.timeout(RESPONSE_TIME)
        return wait + (len(plan.request) + plan.bytes_back) * port.seconds_per_byte

    def _once(self, port: SleepingPortHandler, plan: _ReadPlan, before: bytes, wanted: _Wanted) -> None:
        """One request and the replies to it; puts the usable ones into ``wanted.found``."""
        port.clear()
        port.writePort(before + plan.request)
        sent = self._now()
        # From here on the wire is busy: what is done now costs nothing.
        parser: StatusParser | FastParser = FastParser(plan.sizes) if plan.fast else StatusParser()
        bytes_over = sent + (len(before) + len(plan.request) + plan.bytes_back) * port.seconds_per_byte
        deadline = bytes_over + self._times.timeout(RESPONSE_TIME)
        usual = self._times.expected
        expected = None if usual is None else bytes_over + usual
        waiting = set(wanted.asked)
        # As many damaged packets as servos are missing: nothing more will come, ask again at once.
        damaged = 0
        while len(waiting) > damaged:
            over = self._now() > deadline  # a line may never fall silent: this is the last look
            data = port.receive(deadline, expected)
            if plan.fast and self._take_whole(data, plan, wanted):
                waiting.clear()
                break
            damaged += self._take(parser.feed(data, last=over or not data), wanted, waiting) + parser.damaged
            self.counters.corrupt += parser.damaged
            if over or not data or (plan.fast and parser.damaged):
                break
            parser.damaged = 0
        if waiting:
            self._be_quiet()
        elif wanted.asked:
            self._times.add(self._now() - bytes_over)
        if plan.fast:
            self._fast_misses = self._fast_misses + 1 if waiting else 0
            if self._fast_misses == MAX_FAST_FAILURES:
                self.counters.fallbacks += 1
                log.warning("fast reads on %s fail: from here on every servo answers by itself", self.port)

    def _take_whole(self, data: bytes, plan: _ReadPlan, wanted: _Wanted) -> bool:
        """Takes the replies of a fast read where nothing is wrong with any of them; else takes nothing."""
        registers, asked, found, _ = wanted
        if asked is not registers or (values := whole_fast_status(data, plan.sizes)) is None:
            return False
        for (id, register), value in zip(registers.items(), values, strict=True):
            found[id] = BusStatus(id, int.from_bytes(value, "little", signed=register.signed))
        self._last_good.update(dict.fromkeys(registers, self._now()))
        self.counters.answered += len(values)
        return True

    def _take(self, packets: Iterable[StatusPacket], wanted: _Wanted, waiting: set[int]) -> int:
        """Takes the replies that somebody waits for; how many of them cannot be what was asked."""
        registers, asked, found, doubtful = wanted
        last_good, now = self._last_good, self._now()
        strange = 0
        for id, code, alert, data in packets:
            if id not in waiting:
                continue
            register, value = registers[id], None
            if code:
                if id in doubtful:
                    self.counters.late += 1
                    continue
            else:
                least, size = register.size, asked[id].size
                if len(data) != size:
                    late = (id, len(data)) in self._unanswered
                    self.counters.late += late
                    self.counters.corrupt += not late
                    strange += not late
                    continue
                value = register.decode(data if size == least else data[:least])
            self.counters.answered += value is not None
            self.counters.refused += value is None
            self.counters.alerts += alert
            found[id] = BusStatus(id, value, code, alert)
            last_good[id] = now
            waiting.discard(id)
        return strange

    # --------------------------------------------------------------------------------- one packet

    def _bare(self, port: SleepingPortHandler, id: int, instruction: int) -> object:
        """An instruction without parameters."""
        return self._packet.txPacket(port, [0, 0, 0, 0, id, 3, 0, instruction, 0, 0])

    def _ask(
        self, id: int, what: str, size: int, send: Callable[[SleepingPortHandler], object]
    ) -> StatusPacket:
        """Sends until servo ``id`` answers with ``size`` bytes of data or an error number."""
        corrupt = self.counters.corrupt
        key = (id, size)
        with self._transaction((key,)) as port:
            doubtful = id in self._unanswered.ids
            for attempt in range(1 + self._retries):
                late = self.counters.late
                if attempt:
                    self.counters.retries += 1
                    port.drain(QUIET)
                packet = None
                try:
                    send(port)
                    port.setPacketTimeout(SHORTEST_STATUS + size)
                    packet = self._receive_status(port, id, size, doubtful=doubtful)
                finally:
                    # Asked twice: the first reply may have come, and the second be late.
                    if packet is None or attempt:
                        self._unanswered.add((key,), self._now())
                if packet is not None and packet.code != GARBLED:
                    break
                self._be_quiet()
                if doubtful and self.counters.late > late:  # an error number among them may be the answer
                    self._wait(port, self._unanswered.end(key for key in self._unanswered if key[0] == id))
                    doubtful = False
        joint = self.names.get(id, "")
        if packet is not None:
            self._last_good[id] = self._now()
            if packet.code:
                reason = ERROR_REASONS.get(packet.code, "unknown error")
                raise ServoRefusedError(id=id, register=what, code=packet.code, reason=reason, joint=joint)
            return packet
        if self.counters.corrupt > corrupt:
            raise BusCorruptError(
                f"replies of servo id {id} on {self.port} ({what}) are damaged: checksum or length wrong",
                hint="check the cable, the baud rate and whether two servos have this id",
            )
        self.counters.asked += 1
        self.counters.timeouts += 1
        since = self._last_good.get(id)
        age = None if since is None else self._now() - since
        raise BusTimeoutError(id=id, register=what, port=self.port, joint=joint, last_good=age)

    def _receive_status(
        self, port: SleepingPortHandler, id: int, size: int, *, doubtful: bool
    ) -> StatusPacket | None:
        """What servo ``id`` says within the packet's time; None if nothing, or only damaged packets.

        ``doubtful``: an error number may answer a request of an earlier call, and is passed over.
        """
        while True:
            packet, result = self._packet.rxPacket(port, False)
            whole = result == COMM_SUCCESS and len(packet) >= SHORTEST_STATUS
            # End of the data; the length field is that after unstuffing.
            end = 5 + (packet[5] | packet[6] << 8) if whole else 0
            if not 9 <= end <= len(packet):
                self.counters.corrupt += result in (COMM_SUCCESS, COMM_RX_CORRUPT)
                return None
            code, alert = packet[8] & ~ALERT_BIT, bool(packet[8] & ALERT_BIT)
            self.counters.alerts += alert
            if packet[4] == id:
                if not doubtful if code else end - 9 == size:
                    return StatusPacket(id, code, alert, bytes(packet[9:end]))
                if not code and (id, end - 9) not in self._unanswered:
                    self.counters.corrupt += 1
                    return None
                self.counters.late += 1
            if port.isPacketTimeout():
                return None
