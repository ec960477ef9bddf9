"""What a virtual bus needs from the servos' side of a wire protocol."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol


class Answer(NamedTuple):
    """What the servos send after one instruction packet.

    Attributes:
        packets: Status packets in the order on the wire.
        delay: Time that the servos waited before their status packets, s (Return Delay Time).
    """

    packets: list[bytes]
    delay: float


class RequestParser(Protocol):
    """Cuts a byte stream into instruction packets."""

    def feed(self, data: bytes, now: float, /) -> Sequence[Any]:
        """Return the packets that ``data``, received at time ``now`` (s), completes."""
        ...


class ServoSide(Protocol):
    """The servos' side of one wire protocol.

    Attributes:
        name: For messages, e.g. ``"Protocol 2.0"``.
    """

    @property
    def name(self) -> str: ...

    def parser(self) -> RequestParser:
        """Return a parser of instruction packets."""
        ...

    def execute(self, packet: Any, listeners: Sequence[Any], rng: random.Random, /) -> Answer:
        """Carry out one instruction packet.

        Args:
            packet: Packet from the parser.
            listeners: Servos that hear it.
            rng: Decides what the host receives when two servos answer at once.
        """
        ...

    def shortened(self, packet: bytes, /) -> bytes:
        """Return a status packet with one byte of data less and a correct checksum.

        A packet without data is returned as it is.
        """
        ...

    def refused(self, packet: bytes, rng: random.Random, /) -> bytes:
        """Return a status packet of the same servo with an error and without data."""
        ...

    def foreign(self, id: int, rng: random.Random, /) -> bytes:
        """Return a status packet with an id that no servo has."""
        ...
