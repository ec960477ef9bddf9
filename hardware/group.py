"""Many servos in one go: goals out, measurements back, within the time a control cycle has.

Goals and the question for measurements leave in one piece.  Servos whose firmware allows it answer together
in one packet (fast read); where that fails, they are asked the plain way, after ``FAST_PATIENCE`` failures in
a row for good.  Who does not answer is asked again while there is time, and hides nobody.

An answer does not say which question it answers.  So in a control cycle, after an answer was missed, the next
question asks for a byte more than the last: an answer that comes late has another length, and is known.
"""

from __future__ import annotations

import logging
from builtins import id as identity
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from robot_ik.hardware.answer_times import AnswerTimes
from robot_ik.hardware.bus import Counters, Status
from robot_ik.hardware.control_table import Register
from robot_ik.hardware.packets import (
    FAST_FRAME,
    FAST_HEAD,
    SHORTEST_STATUS,
    Answer,
    FastParser,
    StatusParser,
    read_request,
    whole_fast_status,
    write_request,
)
from robot_ik.hardware.quiet_port import QuietPortHandler
from robot_ik.hardware.wire import Wire

log = logging.getLogger(__name__)

CYCLE_TIME = 0.100
"""s after which a read is not tried again, whoever is still missing, where the caller names no time."""

FAST_PATIENCE = 5
"""Fast reads in a row that fail before they are given up until the port is opened again."""

PHASES = 4
"""Lengths in turn: an answer is known to be late unless it comes just so many questions after its own."""


class _Plan(NamedTuple):
    """A question to many servos: in words, as bytes, and what comes back."""

    asks: str
    request: bytes
    bytes_back: int
    fast: bool
    sizes: tuple[tuple[int, int], ...]  # (id, bytes of data)
    registers: tuple[Register, ...]  # kept alive: plans are found by their identity


class _Wanted(NamedTuple):
    """What a question is for: servo id -> register, the same as asked (perhaps longer), what is there."""

    registers: Mapping[int, Register]
    asked: Mapping[int, Register]
    found: dict[int, Status]


def _question(registers: Mapping[int, Register]) -> str:
    return "read of " + ", ".join({register.name: None for register in registers.values()})


@lru_cache(maxsize=1024)
def _widened(register: Register, by: int) -> Register:
    return replace(register, size=register.size + by)


class GroupTraffic:
    """Writes to and reads from many servos on one wire.

    Args:
        wire: The port.
        retries: How often the question is repeated to those that did not answer.

    Attributes:
        fast_ids: Servos that may be asked by fast reads.
    """

    def __init__(self, wire: Wire, retries: int) -> None:
        self.fast_ids: frozenset[int] = frozenset()
        self._wire = wire
        self._counters: Counters = wire.counters
        self._retries = retries
        self._plans: dict[tuple[object, ...], _Plan] = {}
        self.reset()

    def reset(self) -> None:
        """Forgets what was learned about the servos: the port was opened anew."""
        self._silent: frozenset[int] = frozenset()
        self._missed: dict[int, int] = {}  # servo id -> bytes it was last asked for in vain
        self._fast_misses = 0
        self._phase = 0
        self._times = AnswerTimes()

    @property
    def fast(self) -> bool:
        """Whether fast reads are in use, or would be if all asked could do them."""
        return bool(self.fast_ids) and self._fast_misses < FAST_PATIENCE

    def write(self, values: Mapping[int, tuple[Register, int]]) -> None:
        """Servo id -> register and value, in one packet; nobody answers.

        Raises:
            ValueError: A value does not fit its register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        request = write_request(values) if values else b""
        # Nobody answers, so an answer still outstanding keeps belonging to the question before.
        with self._wire.transaction(None) as port:
            if request:
                port.send(request)

    def read(
        self,
        registers: Mapping[int, Register],
        writes: Mapping[int, tuple[Register, int]] | None = None,
        within: float | None = None,
        *,
        guarded: bool = False,
    ) -> dict[int, Status]:
        """One register of each servo, after ``writes`` have left.

        Args:
            registers: Servo id -> what is read from it.
            writes: As for ``write``; leave in the same piece as the question.
            within: s; after that nobody is asked again.  The first question always gets its full time.
            guarded: Late answers are told by their length; ``PHASES`` - 1 bytes behind each register must be
                readable as well.

        Returns:
            A row for every id; ``data`` is None where nothing usable came.

        Raises:
            ValueError: A value does not fit its register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        before = write_request(writes) if writes else b""
        found: dict[int, Status] = {}
        # A servo waits for the answers of those named before it: silent ones go last and hide nobody.
        missing = sorted(registers, key=self._silent.__contains__) if self._silent else list(registers)
        plan = self._plan(registers, plain=bool(self._silent))
        with self._wire.transaction(plan.asks) as port:
            end = self._wire.now() + (CYCLE_TIME if within is None else within)
            self._counters.cycles += 1
            self._counters.asked += len(registers)
            try:
                for attempt in range(1 + self._retries):
                    self._counters.retries += attempt > 0
                    extra = self._phase if guarded else 0
                    asked = registers
                    if extra or attempt or self._silent:
                        asked = {
                            id: _widened(registers[id], extra) if extra else registers[id] for id in missing
                        }
                        plan = self._plan(asked, plain=attempt > 0 or bool(self._silent))
                    self._once(port, plan, before, _Wanted(registers, asked, found))
                    before = b""
                    if len(found) == len(registers):
                        missing = []
                        break
                    missing = [id for id in missing if id not in found]
                    self._missed.update((id, asked[id].size) for id in missing)
                    if guarded:
                        self._phase = (self._phase + 1) % PHASES
                    if self._silent.issuperset(missing):
                        break
                    if self._wire.now() + self._patience(plan, port) > end:
                        break
            except BaseException:  # the port went, or a signal came: who has not answered never will
                self._counters.timeouts += len(registers) - len(found)
                raise
            if missing:
                self._wire.missed()
        self._counters.timeouts += len(missing)
        if missing or self._silent:
            self._silent = self._silent.difference(registers).union(missing)
            found.update((id, Status(id, None)) for id in missing)
        return {id: found[id] for id in registers}  # they may have answered in another order

    def _plan(self, registers: Mapping[int, Register], *, plain: bool = False) -> _Plan:
        fast = not plain and len(registers) > 1 and self.fast and self.fast_ids.issuperset(registers)
        rows = tuple(registers.values())
        key = (fast, *registers, *map(identity, rows))
        plan = self._plans.get(key)
        if plan is None:
            sizes = tuple((id, register.size) for id, register in registers.items())
            each = FAST_FRAME if fast else SHORTEST_STATUS
            back = FAST_HEAD * fast + sum(size + each for _, size in sizes)
            if len(self._plans) > 1000:  # questions about changing sets of servos
                self._plans.clear()
            request = read_request(registers, fast=fast)
            plan = _Plan(_question(registers), request, back, fast, sizes, rows)
            self._plans[key] = plan
        return plan

    def _patience(self, plan: _Plan, port: QuietPortHandler) -> float:
        """s from sending the question to giving up the answers."""
        wait = self._times.patience(self._wire.answer_time)
        return wait + (len(plan.request) + plan.bytes_back) * port.seconds_per_byte

    def _once(self, port: QuietPortHandler, plan: _Plan, before: bytes, wanted: _Wanted) -> None:
        """One request and the answers to it; puts the usable ones into ``wanted.found``."""
        port.clear()
        port.send(before + plan.request)
        sent = self._wire.now()
        # From here on the wire is busy: what is done now costs nothing.
        parser: StatusParser | FastParser = FastParser(plan.sizes) if plan.fast else StatusParser()
        deadline = sent + len(before) * port.seconds_per_byte + self._patience(plan, port)
        bytes_over = sent + (len(before) + len(plan.request) + plan.bytes_back) * port.seconds_per_byte
        usual = self._times.expected
        expected = None if usual is None else bytes_over + usual
        waiting = set(wanted.asked)
        # As many damaged packets as servos are missing: nothing more will come, ask again at once.
        damaged = 0
        while len(waiting) > damaged:
            data = port.receive(deadline, expected)
            if plan.fast and self._take_whole(data, plan, wanted):
                waiting.clear()
                break
            damaged += self._take(parser.feed(data, last=not data), wanted, waiting) + parser.damaged
            self._counters.corrupt += parser.damaged
            if not data or (plan.fast and parser.damaged):
                break
            parser.damaged = 0
        if waiting:
            self._wire.missed()
        else:
            self._times.add(self._wire.now() - bytes_over)
        if plan.fast:
            self._judge_fast(failed=bool(waiting))

    def _take_whole(self, data: bytes, plan: _Plan, wanted: _Wanted) -> bool:
        """Takes the answers of a fast read where nothing is wrong with any of them; else takes nothing."""
        registers, asked, found = wanted
        if asked is not registers or (values := whole_fast_status(data, plan.sizes)) is None:
            return False
        for (id, register), value in zip(registers.items(), values, strict=True):
            found[id] = Status(id, int.from_bytes(value, "little", signed=register.signed))
        self._wire.last_good.update(dict.fromkeys(registers, self._wire.now()))
        self._counters.answered += len(values)
        return True

    def _take(self, answers: Iterable[Answer], wanted: _Wanted, waiting: set[int]) -> int:
        """Takes the answers that somebody waits for; how many of them cannot be what was asked."""
        registers, asked, found = wanted
        last_good, now = self._wire.last_good, self._wire.now()
        strange = 0
        for id, code, alert, data in answers:
            if id not in waiting:
                continue
            register, value = registers[id], None
            if not code:
                least, size = register.size, asked[id].size
                if len(data) != size:
                    late = least <= len(data) < least + PHASES and size > least
                    late = late or len(data) == self._missed.get(id)  # of a block of another length
                    self._counters.late += late
                    self._counters.corrupt += not late
                    strange += not late
                    continue
                value = register.decode(data if size == least else data[:least])
            self._counters.answered += value is not None
            self._counters.refused += value is None
            self._counters.alerts += alert
            found[id] = Status(id, value, code, alert)
            last_good[id] = now
            waiting.discard(id)
        return strange

    def _judge_fast(self, *, failed: bool) -> None:
        self._fast_misses = self._fast_misses + 1 if failed else 0
        if failed and self._fast_misses == FAST_PATIENCE:
            self._counters.fallbacks += 1
            log.warning("fast reads on %s fail: from here on every servo answers by itself", self._wire.port)
