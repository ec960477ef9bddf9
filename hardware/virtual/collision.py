"""What a host receives when several servos answer at once: bits, as a UART sees them.

The line is high at rest and low as soon as anybody pulls it low; a byte is a low start bit, eight data bits
from the lowest and a high stop bit.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

_SPREAD_BITS = 12
"""Two servos begin within so many bit times of each other: they do not share a clock."""


def collide(answers: Sequence[bytes], dice: random.Random) -> bytes:
    """The bytes received when ``answers`` are on the wire at once, each a little late by chance."""
    starts = [0, *(dice.randrange(1, _SPREAD_BITS) for _ in answers[1:])]
    dice.shuffle(starts)
    lines = [[1] * start + _bits(answer) for start, answer in zip(starts, answers, strict=True)]
    length = max(map(len, lines))
    wire = [min(line[k] if k < len(line) else 1 for line in lines) for k in range(length)]
    return _received(wire)


def _bits(data: bytes) -> list[int]:
    return [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]


def _received(wire: list[int]) -> bytes:
    """A start bit, then the eight bits after it, whatever the stop bit says."""
    found, at = bytearray(), 0
    while at < len(wire):
        if wire[at]:
            at += 1
            continue
        data = (*wire[at + 1 : at + 9], *[1] * 8)[:8]
        found.append(sum(bit << k for k, bit in enumerate(data)))
        at += 10
    return bytes(found)
