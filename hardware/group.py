"""Many servos in one go: goals out, measurements back, within the time a control cycle has.

Goals and the question for measurements leave in one piece.  Servos whose firmware allows it answer together
in one packet (fast read); where that fails, they are asked the plain way, after ``FAST_PATIENCE`` failures in
a row for good.  Who does not answer is asked again while there is time, and hides nobody.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import NamedTuple

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
    write_request,
)
from robot_ik.hardware.quiet_port import QuietPortHandler
from robot_ik.hardware.wire import Wire

log = logging.getLogger(__name__)

CYCLE_TIME = 0.100
"""s after which a read is not tried again, whoever is still missing, where the caller names no time."""

FAST_PATIENCE = 5
"""Fast reads in a row that fail before they are given up until the port is opened again."""

SHORTEST_WAIT = 0.005
"""s; a servo has at least so long to answer, however quick it used to be: computers pause."""

SLOWNESS = 3.0
"""A servo has so many times the longest recent answer time."""

_FORGET = 0.98  # share of the longest answer time kept from one cycle to the next


class _Plan(NamedTuple):
    """A question to many servos, as bytes."""

    asks: str
    request: bytes
    bytes_back: int
    fast: bool


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
        self._fast_misses = 0
        self._longest: float | None = None

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
    ) -> dict[int, Status]:
        """One register of each servo, after ``writes`` have left.

        Args:
            registers: Servo id -> what is read from it.
            writes: As for ``write``; leave in the same piece as the question.
            within: s; after that nobody is asked again.  The first question always gets its full time.

        Returns:
            A row for every id; ``data`` is None where nothing usable came.

        Raises:
            ValueError: A value does not fit its register; nothing is sent.
            BusDisconnectedError, BusNotOpenError.
        """
        before = write_request(writes) if writes else b""
        plan = self._plan(registers)
        found: dict[int, Status] = {}
        # A servo waits for the answers of those named before it: silent ones go last and hide nobody.
        missing = sorted(registers, key=self._silent.__contains__) if self._silent else list(registers)
        with self._wire.transaction(plan.asks) as port:
            end = self._wire.now() + (CYCLE_TIME if within is None else within)
            self._counters.cycles += 1
            self._counters.asked += len(registers)
            for attempt in range(1 + self._retries):
                self._counters.retries += attempt > 0
                if attempt or self._silent or (plan.fast and not self.fast):
                    plan = self._plan({id: registers[id] for id in missing}, plain=True)
                self._once(port, plan, before, registers, missing, found)
                before = b""
                missing = [id for id in missing if id not in found]
                if not missing or self._silent.issuperset(missing):
                    break
                if self._wire.now() + self._patience(plan, port) > end:
                    break
            if missing:
                self._wire.missed()
        self._close_books(registers, missing, found)
        return {id: found.get(id) or Status(id, None) for id in registers}

    def _close_books(
        self, registers: Mapping[int, Register], missing: list[int], found: Mapping[int, Status]
    ) -> None:
        refused = sum(status.data is None for status in found.values())
        self._counters.refused += refused
        self._counters.answered += len(found) - refused
        self._counters.timeouts += len(missing)
        if missing or self._silent:
            self._silent = self._silent.difference(registers).union(missing)

    def _plan(self, registers: Mapping[int, Register], *, plain: bool = False) -> _Plan:
        fast = not plain and len(registers) > 1 and self.fast and self.fast_ids.issuperset(registers)
        key = (fast, *((id, r.address, r.size) for id, r in registers.items()))
        plan = self._plans.get(key)
        if plan is None:
            sizes = [register.size for register in registers.values()]
            back = (
                FAST_HEAD + sum(sizes) + FAST_FRAME * len(sizes)
                if fast
                else sum(sizes) + SHORTEST_STATUS * len(sizes)
            )
            names = ", ".join(sorted({register.name for register in registers.values()}))
            if len(self._plans) > 1000:  # questions about changing sets of servos
                self._plans.clear()
            plan = _Plan(f"read of {names}", read_request(registers, fast=fast), back, fast)
            self._plans[key] = plan
        return plan

    def _patience(self, plan: _Plan, port: QuietPortHandler) -> float:
        """s from sending the question to giving up the answers."""
        wait = self._wire.answer_time
        if self._longest is not None:
            wait = min(max(SLOWNESS * self._longest, SHORTEST_WAIT), wait)
        return wait + (len(plan.request) + plan.bytes_back) * port.seconds_per_byte

    def _once(
        self,
        port: QuietPortHandler,
        plan: _Plan,
        before: bytes,
        registers: Mapping[int, Register],
        ids: list[int],
        found: dict[int, Status],
    ) -> None:
        """One request and the answers to it; puts the usable ones into ``found``."""
        parser: StatusParser | FastParser = (
            FastParser([(id, registers[id].size) for id in ids]) if plan.fast else StatusParser()
        )
        port.clear()
        port.send(before + plan.request)
        sent = self._wire.now()
        deadline = sent + len(before) * port.seconds_per_byte + self._patience(plan, port)
        waiting = set(ids)
        # As many damaged packets as servos are missing: nothing more will come, ask again at once.
        damaged = 0
        while len(waiting) > damaged:
            data = port.receive(deadline)
            for answer in parser.feed(data, last=not data):
                damaged += not self._take(answer, registers, waiting, found)
            damaged += parser.damaged
            self._counters.corrupt += parser.damaged
            if not data or (plan.fast and parser.damaged):
                break
            parser.damaged = 0
        if waiting:
            self._wire.missed()
        else:
            took = self._wire.now() - sent - (len(before) + plan.bytes_back) * port.seconds_per_byte
            self._longest = max(took, _FORGET * (self._longest or 0.0))
        if plan.fast:
            self._judge_fast(failed=bool(waiting))

    def _take(
        self,
        answer: Answer,
        registers: Mapping[int, Register],
        waiting: set[int],
        found: dict[int, Status],
    ) -> bool:
        """Whether the answer may be what was asked; puts it into ``found`` if somebody waits for it."""
        id, code, alert, data = answer
        if id not in waiting:
            return True
        register = registers[id]
        if len(data) != register.size and not code:
            self._counters.corrupt += 1  # a late answer to something else, or short
            return False
        self._counters.alerts += alert
        value = register.decode(data) if len(data) == register.size and not code else None
        found[id] = Status(id, value, code, alert)
        self._wire.last_good[id] = self._wire.now()
        waiting.discard(id)
        return True

    def _judge_fast(self, *, failed: bool) -> None:
        self._fast_misses = self._fast_misses + 1 if failed else 0
        if failed and self._fast_misses == FAST_PATIENCE:
            self._counters.fallbacks += 1
            log.warning("fast reads on %s fail: from here on every servo answers by itself", self._wire.port)
