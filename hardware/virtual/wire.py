"""The wire from the virtual servos to the host: collisions, late and spoilt status packets."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from robot_ik.hardware.registers import IDS
from robot_ik.hardware.virtual.servo_side import ServoSide
from robot_ik.hardware.wire_protocol import BROADCAST_ID

_SPREAD_BITS = 12
"""Bit times within which two servos begin to answer: they do not share a clock."""


def collide(packets: Sequence[bytes], rng: random.Random) -> bytes:
    """Return the bytes that a UART receives when ``packets`` are on the wire at once.

    The line is high at rest and low as soon as one servo pulls it low. A byte is a low start bit,
    eight data bits from the lowest, and a high stop bit. Every servo begins a little late by
    chance.
    """
    starts = [0, *(rng.randrange(1, _SPREAD_BITS) for _ in packets[1:])]
    rng.shuffle(starts)
    lines = [
        [1] * start + [bit for byte in packet for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
        for start, packet in zip(starts, packets, strict=True)
    ]
    wire = [min(bits) for bits in itertools.zip_longest(*lines, fillvalue=1)]
    # A start bit and the eight bits after it. The stop bit is not checked.
    received = bytearray()
    at = 0
    while at < len(wire):
        if wire[at]:
            at += 1
            continue
        data = (*wire[at + 1 : at + 9], *[1] * 8)[:8]
        received.append(sum(bit << k for k, bit in enumerate(data)))
        at += 10
    return bytes(received)


LATEST = 0.15
"""s. Largest lateness of a late packet."""


class Spoil(NamedTuple):
    """One way in which a status packet can be spoilt.

    Attributes:
        help: One line for the user.
        apply: (wire, packet) -> bytes that arrive now instead of the packet.
    """

    help: str
    apply: Callable[[VirtualWire, bytes], bytes]


class VirtualWire:
    """The transmission of status packets to the host.

    Attributes:
        side: Builds the status packets that replace others.
        chances: Row of ``SPOILS`` -> its probability for a status packet.
        now: Time of the replies, s.
        rng: Random generator of all faults. Equal seeds and equal traffic give equal faults.
        foreign: Ids that no servo has.
        held: Packets that arrive before the replies to the next request, with the time in s at
            which they were sent.
        behind: Packet that arrives after the next one.
    """

    def __init__(self, taken: Iterable[int], seed: int, side: ServoSide) -> None:
        self.side = side
        self.foreign = sorted(set(IDS).difference(taken)) or [BROADCAST_ID]
        self.reseed(seed)
        self.chances = dict.fromkeys(SPOILS, 0.0)

    def reseed(self, seed: int) -> None:
        """Start a new random generator and discard packets that have not arrived."""
        self.rng = random.Random(seed)
        self.held: list[tuple[bytes, float]] = []
        self.now = 0.0
        self.behind = b""

    def carry(self, packets: list[bytes], now: float) -> list[bytes]:
        """Return the packets that arrive at the host, in the order in which they arrive.

        Packets that were held for more than ``LATEST`` are dropped: they came while no request was
        answered.

        Args:
            packets: Replies to one request.
            now: Time of the request, s.
        """
        if not self.held and not any(self.chances.values()):
            return packets
        arriving = [packet for packet, since in self.held if now - since <= LATEST]
        self.held = []
        self.now = now
        for packet in packets:
            waiting = self.behind
            self.behind = b""
            arriving += [self._spoil(packet), waiting]
        last = self.behind
        self.behind = b""
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
        "late": Spoil(
            "a status packet comes up to 0.15 s late, before those to the next request", _late
        ),
        "drop": Spoil("a status packet is lost", lambda _wire, _packet: b""),
        "short": Spoil(
            "a status packet has less data than requested, with a correct checksum",
            lambda wire, packet: wire.side.shortened(packet),
        ),
        "error": Spoil(
            "a status packet has an error and no data",
            lambda wire, packet: wire.side.refused(packet, wire.rng),
        ),
        "corrupt": Spoil("one bit of a status packet flips", _flip),
        "truncate": Spoil(
            "a status packet breaks off",
            lambda wire, packet: packet[: wire.rng.randrange(1, len(packet))],
        ),
        "duplicate": Spoil("a status packet comes twice", lambda _wire, packet: 2 * packet),
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
"""What the faults of the wire do, in the order in which they are applied to a packet."""
