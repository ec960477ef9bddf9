"""When faults happen on a virtual bus, and what becomes of status packets on their way to the host."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from robot_ik.hardware.registers import IDS
from robot_ik.hardware.virtual.servo_side import ServoSide
from robot_ik.hardware.wire_protocol import BROADCAST_ID
from robot_ik.ports import Clock

Action = Callable[[], None]


class WireSchedule:
    """Actions in the order of their time.  Not locked by itself: the bus does that.

    Attributes:
        packets: Instruction packets so far.
        upcoming: Number of the packet that is handled next; within ``count`` that is the one counted.
    """

    def __init__(self, clock: Clock) -> None:
        self.packets = 0
        self.upcoming = 1
        self._clock = clock
        self._timed: list[tuple[float, int, Action]] = []
        self._counted: list[tuple[int, int, Action]] = []
        self._numbers = itertools.count()

    @property
    def next_time(self) -> float | None:
        """Time of the next timed action, s; ``None`` if there is none."""
        return self._timed[0][0] if self._timed else None

    def at(self, time: float, action: Action) -> None:
        """Books ``action`` for ``time``, s on the clock; a time that has passed is the next ``run``."""
        heapq.heappush(self._timed, (time, next(self._numbers), action))

    def at_packet(self, number: int, action: Action) -> None:
        """Books ``action`` for just before the packet with this number (the first is 1) is handled."""
        heapq.heappush(self._counted, (number, next(self._numbers), action))

    def run(self) -> None:
        while self._timed and self._timed[0][0] <= self._clock.now():
            heapq.heappop(self._timed)[2]()

    def count(self) -> None:
        self.packets += 1
        while self._counted and self._counted[0][0] <= self.packets:
            heapq.heappop(self._counted)[2]()
        self.upcoming = self.packets + 1


# ------------------------------------------------------------------------------------------
# What a host receives when several servos answer at once: bits, as a UART sees them.
#
# The line is high at rest and low as soon as anybody pulls it low; a byte is a low start bit, eight data bits
# from the lowest and a high stop bit.


_SPREAD_BITS = 12
"""Two servos begin within so many bit times of each other: they do not share a clock."""


def collide(packets: Sequence[bytes], rng: random.Random) -> bytes:
    """The bytes received when ``packets`` are on the wire at once, each a little late by chance."""
    starts = [0, *(rng.randrange(1, _SPREAD_BITS) for _ in packets[1:])]
    rng.shuffle(starts)
    lines = [
        [1] * start + [bit for byte in packet for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
        for start, packet in zip(starts, packets, strict=True)
    ]
    wire = [min(bits) for bits in itertools.zip_longest(*lines, fillvalue=1)]
    # A start bit, then the eight bits after it, whatever the stop bit says.
    found, at = bytearray(), 0
    while at < len(wire):
        if wire[at]:
            at += 1
            continue
        data = (*wire[at + 1 : at + 9], *[1] * 8)[:8]
        found.append(sum(bit << k for k, bit in enumerate(data)))
        at += 10
    return bytes(found)


# ------------------------------------------------------------------------------------------
# Packets that are lost, spoiled, doubled or late: by chance, one row a kind.


LATEST = 0.15
"""s by which a late packet comes late at most."""


class Spoil(NamedTuple):
    """One way in which a status packet can be spoilt; ``apply``: the bytes that arrive instead of it now."""

    help: str
    apply: Callable[[VirtualWire, bytes], bytes]


class VirtualWire:
    """The transmission of status packets to the host.

    Attributes:
        side: Builds the status packets that replace others.
        chances: Row of ``SPOILS`` -> its probability per status packet.
        now: Time of the replies, s.
        rng: Random generator of all faults; equal seeds and equal traffic give equal faults.
        foreign: Ids that no servo has: none of those ``taken``.
        held: Packets that come before the replies to the next request, and when they were sent, s.
        behind: A packet that comes after the next one.
    """

    def __init__(self, taken: Iterable[int], seed: int, side: ServoSide) -> None:
        self.side = side
        self.foreign = sorted(set(IDS).difference(taken)) or [BROADCAST_ID]
        self.reseed(seed)
        self.chances = dict.fromkeys(SPOILS, 0.0)

    def reseed(self, seed: int) -> None:
        """A new random generator, and nothing on its way."""
        self.rng = random.Random(seed)
        self.held: list[tuple[bytes, float]] = []
        self.now = 0.0
        self.behind = b""

    def carry(self, packets: list[bytes], now: float) -> list[bytes]:
        """What of the replies to one request arrives at the host, in the order in which it does.

        ``now``: time of the request, s.  Packets that were sent more than ``LATEST`` before are not among
        them: they came while no request was answered.
        """
        if not self.held and not any(self.chances.values()):
            return packets
        arriving = [packet for packet, since in self.held if now - since <= LATEST]
        self.held, self.now = [], now
        for packet in packets:
            waiting, self.behind = self.behind, b""
            arriving += [self._spoil(packet), waiting]
        last, self.behind = self.behind, b""
        return [*arriving, last]

    def _spoil(self, packet: bytes) -> bytes:
        for name, probability in self.chances.items():
            if packet and probability > 0.0 and self.rng.random() < probability:
                packet = SPOILS[name].apply(self, packet)
        return packet


def _late(wire: VirtualWire, packet: bytes) -> bytes:
    wire.held.append((packet, wire.now))
    return b""


def _flip(wire: VirtualWire, packet: bytes) -> bytes:
    bit = wire.rng.randrange(8 * len(packet))
    spoiled = bytearray(packet)
    spoiled[bit // 8] ^= 1 << bit % 8
    return bytes(spoiled)


def _swap(wire: VirtualWire, packet: bytes) -> bytes:
    wire.behind = packet
    return b""


SPOILS: Mapping[str, Spoil] = MappingProxyType(
    {
        "late": Spoil("a status packet comes up to 0.15 s late, before those to the next request", _late),
        "drop": Spoil("a status packet is lost", lambda wire, packet: b""),
        "short": Spoil(
            "a status packet has fewer data than asked, checksum right", lambda w, p: w.side.shortened(p)
        ),
        "error": Spoil("a status packet has an error and no data", lambda w, p: w.side.refused(p, w.rng)),
        "corrupt": Spoil("one bit of a status packet flips", _flip),
        "truncate": Spoil("a status packet breaks off", lambda w, p: p[: w.rng.randrange(1, len(p))]),
        "duplicate": Spoil("a status packet comes twice", lambda wire, packet: 2 * packet),
        "wrong_id": Spoil(
            "a status packet with a foreign id comes first",
            lambda w, p: w.side.foreign(w.rng.choice(w.foreign), w.rng) + p,
        ),
        "garbage": Spoil(
            "bytes before a status packet", lambda w, p: w.rng.randbytes(w.rng.randrange(1, 9)) + p
        ),
        "reorder": Spoil("a status packet comes after the next one", _swap),
    }
)
"""What the faults of the wire do, in the order in which they are tried on a packet."""
