"""Servos on one serial port, in any wire protocol.

This file holds transactions, retries and silent servos.

``late_replies`` keeps the requests whose replies did not come.  A control cycle recognises late
replies by their length.  Every other call waits until no late reply can come.
"""

from __future__ import annotations

import logging
import threading
from builtins import id as identity
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    ServoRefusedError,
)
from robot_ik.hardware.bus import KEEPS_TORQUE, BusStatus, Counters
from robot_ik.hardware.late_replies import UnansweredRequests
from robot_ik.hardware.models import BAUD_RATES
from robot_ik.hardware.registers import IDS, Register
from robot_ik.hardware.serial_port import (
    OPEN_ERRORS,
    PORT_ERRORS,
    QUIET,
    RESPONSE_TIME,
    RoundTripEstimator,
    SleepingPortHandler,
    describe_failure,
)
from robot_ik.hardware.wire_protocol import BROADCAST_ID, GroupRead, StatusPacket, WireProtocol
from robot_ik.ports import Clock, RealClock

log = logging.getLogger(__name__)

CYCLE_TIME = 0.100
"""s.  A group read is not repeated after this time unless the caller names another time."""

MAX_FAST_FAILURES = 5
"""Failed fast reads in a row after which the bus asks every servo for its own packet until it is
reopened.
"""

MAX_PLANS = 1000
"""Number of group reads whose bytes are kept."""

NO_READ = GroupRead(b"", 0)
"""Request to no servo at all: every servo may have late replies of every length."""

PING_SLOT = 0.003
"""s that each id may take to answer a broadcast ping (as the Dynamixel SDK waits)."""

ADAPTER_LATENCY = 0.016
"""s, the default latency timer of an FTDI adapter."""


class _ReadPlan(NamedTuple):
    """A group read, ready to send."""

    read: GroupRead
    sizes: tuple[tuple[int, int], ...]  # (id, bytes of data)
    registers: tuple[Register, ...]  # keeps the registers alive: plans are found by their identity


class _Pending(NamedTuple):
    """What a group read is for.

    Attributes:
        registers: Servo id -> register that the caller wants.
        requested: Servo id -> the same register, possibly with extra bytes behind it.
        statuses: Replies so far.
        doubtful: Ids of servos whose error number may answer a request of an earlier call.
    """

    registers: Mapping[int, Register]
    requested: Mapping[int, Register]
    statuses: dict[int, BusStatus]
    doubtful: frozenset[int]


_NO_IDS: frozenset[int] = frozenset()


class SerialBus:
    """Servos of one wire protocol on one serial port.  Thread-safe; implements ``ServoBus``.

    A reply to a request of an earlier call is never taken for an answer if it comes within
    ``LATEST_REPLY`` after that request was given up, in whatever order replies come.  A later reply
    is not recognised.  A reply to an earlier attempt of the same call is an answer, because the
    servo read the register after the call began.  ``RESPONSE_TIME`` of silence after opening covers
    requests of a program that had the port before.

    Args:
        port: Path or name of the serial port.
        baud: bit/s.
        protocol: Wire protocol of every servo on the port.
        retries: How often an unanswered or damaged request is repeated.
        clock: Clock of ages and deadlines; virtual if the port is a function call.
    """

    real = True

    def __init__(
        self,
        port: str,
        baud: int,
        protocol: WireProtocol,
        *,
        retries: int = 2,
        clock: Clock | None = None,
    ) -> None:
        self.port = port
        self.baud = baud
        self.protocol = protocol
        self.counters = Counters()
        self.names: dict[int, str] = {}
        self.clock = clock or RealClock()
        self._retries = retries
        self._now = self.clock.now
        self._lock = threading.RLock()
        self._handler: SleepingPortHandler | None = None
        self._sleep_until = self.clock.sleep_until
        self._silence = 0.0  # s for which the line must be silent before the next request
        self._unanswered = UnansweredRequests()
        self._last_reply: dict[int, float] = {}
        self._fast_ids: frozenset[int] = frozenset()
        self._plans: dict[tuple[object, ...], _ReadPlan] = {}
        self._forget_servos()

    @property
    def is_open(self) -> bool:
        return self._handler is not None

    def fileno(self) -> int | None:
        """Return the file descriptor of the open port; None if there is none."""
        handler = self._handler
        return None if handler is None else handler.fileno()

    def _make_handler(self) -> SleepingPortHandler:
        return SleepingPortHandler(self.port, self.baud, self.counters)

    def open(self) -> None:
        """Open the port.

        Raises:
            BusNotOpenError: The port is missing, in use, forbidden, or does not know the baud rate.
        """
        with self._lock:
            if self._handler is not None:
                return
            handler = self._make_handler()
            if handler.getCFlagBaud(self.baud) <= 0:
                rates = ", ".join(str(rate) for rate in BAUD_RATES)
                raise BusNotOpenError(
                    f"cannot open {self.port} at {self.baud} baud; possible: {rates}"
                )
            try:
                handler.openPort()
            except OPEN_ERRORS as error:
                handler.closePort()
                raise describe_failure(self.port, error) from error
            self._handler = handler
            self._silence = RESPONSE_TIME
            self._forget_servos()

    def _forget_servos(self) -> None:
        """Reset what was learned about the servos' replies."""
        self._silent: frozenset[int] = frozenset()
        self._fast_failures = 0
        self._round_trip = RoundTripEstimator()

    def close(self) -> None:
        """Close the port.  May be called at any time."""
        with self._lock:
            handler = self._handler
            self._handler = None
            if handler is not None:
                try:
                    handler.closePort()
                except PORT_ERRORS as error:
                    log.warning("closing %s: %s", self.port, error)

    @contextmanager
    def _transaction(self, keys: Iterable[tuple[int, int]] | None) -> Iterator[SleepingPortHandler]:
        """Yield the open port for one request and its replies.

        Waits until no late reply can be mistaken for a reply to this request.

        Args:
            keys: (servo id, bytes of data) of the replies; None if the request has no reply.

        Raises:
            BusNotOpenError: The bus is not open.
            BusDisconnectedError: The port went away.  It is closed.
        """
        with self._lock:
            handler = self._handler
            if handler is None:
                raise BusNotOpenError(
                    f"the bus on {self.port} is not open", hint="call open() first"
                )
            completed = False
            try:
                if keys is not None:
                    if self._unanswered:
                        self._discard_until(handler, self._unanswered.end(keys))
                    if self._silence:
                        handler.drain(self._silence)
                        self._silence = 0.0
                yield handler
                completed = True
            except PORT_ERRORS as error:
                # Only the port is closed.  A subclass may own more, and the port may come back.
                SerialBus.close(self)
                raise BusDisconnectedError(
                    f"the port {self.port} went away: {error}",
                    hint=f"check cable and adapter, then connect again; {KEEPS_TORQUE}",
                ) from error
            finally:
                if not completed:
                    self._require_silence()

    def _require_silence(self) -> None:
        """Make the next request wait for a silent line: bytes may still be under way."""
        self._silence = max(self._silence, QUIET)

    def _discard_until(self, port: SleepingPortHandler, until: float) -> None:
        """Discard everything that is received until the time ``until`` in s."""
        if until > self._now():
            self._sleep_until(until)
            port.clear()
        self._unanswered.forget(self._now())

    def ping(self, id: int) -> int:
        """Return the model number of a servo."""
        packet = self._ask(id, "ping", self.protocol.ping(id), self.protocol.ping_data_size)
        if self.protocol.model_number is not None:
            return self.read(id, self.protocol.model_number).data or 0
        return packet.data[0] | packet.data[1] << 8

    def broadcast_ping(self) -> dict[int, int]:
        """Return servo id -> model number of every servo that answers.  Takes about a second."""
        found, _ = self.collect_pings(BROADCAST_ID, self.listening_time)
        return {id: number for id, (number, _) in sorted(found.items())}

    @property
    def listening_time(self) -> float:
        """Time in which every possible id could have answered a broadcast ping, s."""
        reply = self.protocol.shortest_status + self.protocol.ping_data_size
        return len(IDS) * (PING_SLOT + 10.0 * reply / self.baud) + ADAPTER_LATENCY

    def collect_pings(self, id: int, listen: float) -> tuple[dict[int, tuple[int, int]], int]:
        """Ping ``id`` or ``BROADCAST_ID`` and listen for ``listen`` s.

        Returns:
            Servo id -> (model number, firmware), and the number of bytes that belong to no packet.
        """
        protocol = self.protocol
        parser = protocol.parser(None, ())
        packets: dict[int, StatusPacket] = {}
        received = 0
        useful = 0
        with self._transaction(()) as port:  # a late reply to a ping has the same content
            port.clear()
            port.writePort(protocol.ping(id))
            deadline = self._now() + listen
            last_look = False
            data = b"first"
            while data and not last_look and id not in packets:
                last_look = self._now() > deadline
                data = port.receive(deadline)
                received += len(data)
                for packet in parser.feed(data):
                    useful += protocol.shortest_status + protocol.ping_data_size
                    if len(packet.data) == protocol.ping_data_size:
                        packets[packet.id] = packet
            if id not in packets:
                self._require_silence()
                late = set(IDS if id == BROADCAST_ID else (id,)).difference(packets)
                keys = ((number, protocol.ping_data_size) for number in late)
                self._unanswered.add(keys, self._now())
        self.counters.corrupt += parser.damaged
        found = {}
        for number, packet in packets.items():
            if protocol.model_number is not None:
                found[number] = (self.read(number, protocol.model_number).data or 0, 0)
            else:
                found[number] = (packet.data[0] | packet.data[1] << 8, packet.data[2])
        return found, received - useful

    def read(self, id: int, register: Register) -> BusStatus:
        """Return one register of one servo."""
        request = self.protocol.read(id, register)
        packet = self._ask(id, register.name, request, register.size)
        return BusStatus(id, register.decode(packet.data), 0, packet.alert)

    def write(self, id: int, register: Register, value: int) -> BusStatus:
        """Write one register of one servo, or of every servo (``BROADCAST_ID``, no reply)."""
        request = self.protocol.write(id, register, value)
        if id == BROADCAST_ID:
            with self._transaction(None) as port:
                port.writePort(request)
            return BusStatus(id, None)
        packet = self._ask(id, register.name, request, 0)
        return BusStatus(id, None, 0, packet.alert)

    def reboot(self, id: int) -> None:
        """Restart one servo.  It does not answer for some tenths of a second."""
        self._ask(id, "reboot", self.protocol.reboot(id), 0)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write one register of several servos (id -> value).  There is no reply."""
        if not values:
            with self._transaction(None):
                return
        request = self.protocol.sync_write(register, values)
        with self._transaction(None) as port:
            port.writePort(request)

    def sync_read(self, ids: Sequence[int], register: Register) -> dict[int, BusStatus]:
        """Return the same register of several servos."""
        return self._read_group(dict.fromkeys(ids, register))

    def exchange(
        self,
        register: Register,
        values: Mapping[int, int],
        reads: Mapping[int, Register],
        within: float | None = None,
    ) -> dict[int, BusStatus]:
        """Send goals and read measurements in one control cycle; see ``ServoBus.exchange``."""
        goals = self.protocol.sync_write(register, values) if values else b""
        return self._read_group(reads, goals, within, guarded=True)

    def use_fast_reads(self, ids: Collection[int]) -> None:
        """Allow these servos to answer together in one packet."""
        self._fast_ids = frozenset(ids)

    def _read_group(
        self,
        registers: Mapping[int, Register],
        before: bytes = b"",
        within: float | None = None,
        *,
        guarded: bool = False,
    ) -> dict[int, BusStatus]:
        """Read several servos.  The first request always gets its full time.

        Args:
            registers: Servo id -> register.
            before: Bytes that leave in the same write before the request.
            within: s after which the request is not repeated.
            guarded: Recognise late replies by their length instead of waiting for them.
                LENGTHS - 1 bytes behind each register must be readable.
        """
        statuses: dict[int, BusStatus] = {}
        # A servo waits for the replies of the servos named before it, so silent servos go last.
        missing = (
            sorted(registers, key=self._silent.__contains__) if self._silent else list(registers)
        )
        keys = () if guarded else ((id, register.size) for id, register in registers.items())
        with self._transaction(keys) as port:
            doubtful = self._unanswered.ids if self._unanswered else _NO_IDS
            end = self._now() + (CYCLE_TIME if within is None else within)
            self.counters.cycles += 1
            self.counters.asked += len(registers)
            requested: Mapping[int, Register] = registers
            if self._silent or doubtful:
                requested = self._requested({id: registers[id] for id in missing}, guarded=guarded)
            plan = self._plan(requested, plain=requested is not registers)
            try:
                for attempt in range(1 + self._retries):
                    self.counters.retries += attempt > 0
                    if attempt:
                        requested = {id: requested[id] for id in missing if id in requested}
                        plan = self._plan(requested, plain=True)
                    self._request(
                        port, plan, before, _Pending(registers, requested, statuses, doubtful)
                    )
                    before = b""
                    if len(statuses) == len(registers) and not attempt:
                        missing = []
                        break
                    # After a second request, the reply may be that to the first.
                    late = [
                        (id, register.size)
                        for id, register in requested.items()
                        if attempt or id not in statuses
                    ]
                    self._unanswered.add(late, self._now())
                    missing = [id for id in missing if id not in statuses]
                    if self._silent.issuperset(missing):
                        break
                    if self._now() + self._timeout(plan, port) > end:
                        break
            except BaseException:
                self.counters.timeouts += len(registers) - len(statuses)
                cut_off = [(id, register.size) for id, register in requested.items()]
                self._unanswered.add(cut_off, self._now())
                raise
            if missing:
                self._require_silence()
        self.counters.timeouts += len(missing)
        if missing or self._silent:
            self._silent = self._silent.difference(registers).union(missing)
            statuses.update((id, BusStatus(id, None)) for id in missing)
        return {id: statuses[id] for id in registers}

    def _requested(
        self, registers: dict[int, Register], *, guarded: bool
    ) -> Mapping[int, Register]:
        """Return the registers to ask for.

        Args:
            registers: Servo id -> register.
            guarded: Choose lengths that no late reply has.
        """
        if not (guarded and self._unanswered):
            return registers
        self._unanswered.forget(self._now())
        return self._unanswered.widen(registers, uniform=self.protocol.uniform_group_reads)

    def _plan(self, registers: Mapping[int, Register], *, plain: bool) -> _ReadPlan:
        fast_allowed = not plain and self._fast_failures < MAX_FAST_FAILURES
        rows = tuple(registers.values())
        key = (fast_allowed, self._fast_ids, *registers, *map(identity, rows))
        plan = self._plans.get(key)
        if plan is None:
            if len(self._plans) >= MAX_PLANS:
                self._plans.clear()
            fast_ids = self._fast_ids if fast_allowed else ()
            read = self.protocol.group_read(registers, fast_ids) if rows else NO_READ
            sizes = tuple((id, register.size) for id, register in registers.items())
            plan = _ReadPlan(read, sizes, rows)
            self._plans[key] = plan
        return plan

    def _timeout(self, plan: _ReadPlan, port: SleepingPortHandler) -> float:
        """Return the s from sending a request to giving up its replies."""
        wire_bytes = len(plan.read.request) + plan.read.reply_size
        return self._round_trip.timeout(RESPONSE_TIME) + wire_bytes * port.seconds_per_byte

    def _request(
        self, port: SleepingPortHandler, plan: _ReadPlan, before: bytes, pending: _Pending
    ) -> None:
        """Send one group read and put the usable replies into ``pending.statuses``."""
        read = plan.read
        port.clear()
        port.writePort(before + read.request)
        sent = self._now()
        # The wire is busy from here on, so the next lines cost no time.
        parser = self.protocol.parser(read, plan.sizes)
        wire_bytes = len(before) + len(read.request) + read.reply_size
        bytes_over = sent + wire_bytes * port.seconds_per_byte
        deadline = bytes_over + self._round_trip.timeout(RESPONSE_TIME)
        usual_delay = self._round_trip.expected
        expected = None if usual_delay is None else bytes_over + usual_delay
        waiting = set(pending.requested)
        # As many damaged packets as missing servos: no more replies will come.
        damaged = 0
        first = True
        while len(waiting) > damaged:
            last_look = self._now() > deadline
            data = port.receive(deadline, expected)
            if first and self._take_at_once(data, plan, pending):
                waiting.clear()
                break
            first = False
            packets = parser.feed(data, last=last_look or not data)
            damaged += self._take(packets, pending, waiting) + parser.damaged
            self.counters.corrupt += parser.damaged
            if last_look or not data or (read.fast and parser.damaged):
                break
            parser.damaged = 0
        if waiting:
            self._require_silence()
        elif pending.requested:
            self._round_trip.add(self._now() - bytes_over)
        if read.fast:
            self._fast_failures = self._fast_failures + 1 if waiting else 0
            if self._fast_failures == MAX_FAST_FAILURES:
                self.counters.fallbacks += 1
                log.warning(
                    "fast reads on %s fail: from here on every servo answers by itself", self.port
                )

    def _take_at_once(self, data: bytes, plan: _ReadPlan, pending: _Pending) -> bool:
        """Take the replies of all servos if none has an error; else take nothing."""
        if pending.requested is not pending.registers:
            return False
        values = self.protocol.take_at_once(data, plan.read, plan.sizes)
        if values is None:
            return False
        for (id, register), value in zip(pending.registers.items(), values, strict=True):
            pending.statuses[id] = BusStatus(id, register.decode(value))
        self._last_reply.update(dict.fromkeys(pending.registers, self._now()))
        self.counters.answered += len(values)
        return True

    def _take(self, packets: Sequence[StatusPacket], pending: _Pending, waiting: set[int]) -> int:
        """Take the replies that are waited for.

        Return the number of replies with a wrong length.
        """
        now = self._now()
        wrong_lengths = 0
        for id, code, alert, data in packets:
            if id not in waiting:
                continue
            register = pending.registers[id]
            value = None
            if code:
                if id in pending.doubtful:
                    self.counters.late += 1
                    continue
            else:
                size = pending.requested[id].size
                if len(data) != size:
                    late = (id, len(data)) in self._unanswered
                    self.counters.late += late
                    self.counters.corrupt += not late
                    wrong_lengths += not late
                    continue
                value = register.decode(data[: register.size])
            self.counters.answered += value is not None
            self.counters.refused += value is None
            self.counters.alerts += alert
            pending.statuses[id] = BusStatus(id, value, code, alert)
            self._last_reply[id] = now
            waiting.discard(id)
        return wrong_lengths

    def _ask(self, id: int, what: str, request: bytes, size: int) -> StatusPacket:
        """Send ``request`` until servo ``id`` answers with ``size`` bytes of data or refuses.

        Raises:
            ServoRefusedError, BusCorruptError, BusTimeoutError: See ``ServoBus``.
        """
        corrupt_before = self.counters.corrupt
        key = (id, size)
        packet: StatusPacket | None = None
        with self._transaction((key,)) as port:
            doubtful = id in self._unanswered.ids
            for attempt in range(1 + self._retries):
                late_before = self.counters.late
                packet = None
                if attempt:
                    self.counters.retries += 1
                    port.drain(QUIET)
                try:
                    port.clear()
                    port.writePort(request)
                    packet = self._receive(port, id, len(request), size, doubtful=doubtful)
                finally:
                    # After a second request, the reply may be that to the first.
                    if packet is None or attempt:
                        self._unanswered.add((key,), self._now())
                if packet is not None and packet.code != self.protocol.damaged_request_code:
                    break
                self._require_silence()
                if doubtful and self.counters.late > late_before:
                    # An error number that was skipped may have been the reply.
                    own_keys = (key for key in self._unanswered if key[0] == id)
                    self._discard_until(port, self._unanswered.end(own_keys))
                    doubtful = False
        joint = self.names.get(id, "")
        if packet is not None:
            self._last_reply[id] = self._now()
            if packet.code:
                reason = self.protocol.error_reasons.get(packet.code, "unknown error")
                raise ServoRefusedError(
                    id=id, register=what, code=packet.code, reason=reason, joint=joint
                )
            return packet
        if self.counters.corrupt > corrupt_before:
            raise BusCorruptError(
                f"replies of servo id {id} on {self.port} ({what}) are damaged: checksum or length "
                f"wrong",
                hint="check the cable, the baud rate and whether two servos have this id",
            )
        self.counters.asked += 1
        self.counters.timeouts += 1
        last_reply = self._last_reply.get(id)
        age = None if last_reply is None else self._now() - last_reply
        raise BusTimeoutError(id=id, register=what, port=self.port, joint=joint, last_good=age)

    def _receive(
        self, port: SleepingPortHandler, id: int, request_size: int, size: int, *, doubtful: bool
    ) -> StatusPacket | None:
        """Return the reply of servo ``id``; None if no good one comes in time.

        Args:
            port: Open port.
            id: Servo id.
            request_size: Bytes of the request.
            size: Bytes of data in the reply.
            doubtful: An error number may answer a request of an earlier call and is skipped.
        """
        parser = self.protocol.parser(None, ())
        wire_bytes = request_size + self.protocol.shortest_status + size
        deadline = self._now() + wire_bytes * port.seconds_per_byte + RESPONSE_TIME
        received_noise = False
        while True:
            last_look = self._now() > deadline
            data = port.receive(deadline)
            packets = parser.feed(data, last=last_look or not data)
            received_noise = received_noise or (bool(data) and not packets)
            for packet in packets:
                self.counters.alerts += packet.alert
                if packet.id != id:
                    continue
                if not doubtful if packet.code else len(packet.data) == size:
                    return packet
                if not packet.code and (id, len(packet.data)) not in self._unanswered:
                    self.counters.corrupt += 1
                    return None
                self.counters.late += 1
            if parser.damaged or last_look or not data:
                # Bytes that form no packet are a damaged reply.
                self.counters.corrupt += max(parser.damaged, int(received_noise))
                return None
