"""Input of the laws: bytes of a fuzzer become pieces on a wire.

A reference decoder, ``checked``, finds the packets in those pieces.
"""

from __future__ import annotations

import random
from pathlib import Path

from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.packets import crc as host_crc
from robot_ik.hardware.virtual.protocol import (
    HEADER,
    Instruction,
    build,
    build_fast_status,
    build_status,
    unstuff,
)

INPUTS = Path(__file__).with_name("inputs.txt")
"""Inputs of earlier failures."""

PAUSE = 0.06
"""Length of a pause, s. A servo waits less time for the rest of a packet."""

TABLE = X_TABLES["XM430-W350"]
PRESENT = TABLE["present_position"]
GOAL = TABLE["goal_position"]

HARMLESS = frozenset(
    Instruction[name]
    for name in (
        "PING",
        "READ",
        "SYNC_READ",
        "BULK_READ",
        "FAST_SYNC_READ",
        "FAST_BULK_READ",
        "STATUS",
    )
)
"""Instructions that change neither the position nor the registers of a servo."""

TRUNCATED = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
"""Instructions whose reply ends at the first missing servo, and then is incomplete."""


def known_inputs() -> list[tuple[str, bytes]]:
    """Return name of the law and input of each earlier failure, from ``inputs.txt``."""
    lines = INPUTS.read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    return [(name, bytes.fromhex(digits)) for name, digits in rows]


def random_input(rng: random.Random) -> bytes:
    """Return a random input for ``pieces``.

    It has pieces of all kinds and many lengths. Bytes of headers and addresses are frequent.
    """
    frequent = b"\x00\x01\x02\x03\xff\xfd\x55\x40\x74"
    data = bytearray()
    for _ in range(rng.randint(1, 10)):
        size = rng.choice((0, 2, 3, 6, 7, 10, 20, 31))
        data.append(rng.randrange(8) | size << 3)
        data += bytes(rng.choice((*frequent, rng.randrange(256))) for _ in range(size))
    return bytes(data)


def pieces(data: bytes) -> list[bytes | None]:
    """Return the pieces on the wire that the bytes of a fuzzer stand for.

    In the input each piece begins with one byte: the low three bits are its kind, the other bits
    are the length of its content. The content follows.

    Args:
        data: Bytes of a fuzzer.

    Returns:
        Bytes of each piece. None stands for a pause.
    """
    result: list[bytes | None] = []
    start = 0
    while start < len(data):
        kind = data[start] & 7
        size = data[start] >> 3
        result.append(_piece(kind, data[start + 1 : start + 1 + size]))
        start += 1 + size
    return result


def _piece(kind: int, content: bytes) -> bytes | None:
    """Return the bytes of one piece, or None for a pause.

    Kinds 0 and 1 are noise, 2 to 5 are packets with a correct checksum, 6 is a damaged packet, and
    7 is a pause.
    """
    if kind == 7:
        return None
    if kind <= 1 or len(content) < 2:
        return content
    id = content[0] % 5 if content[0] < 0xF0 else content[0]
    code = content[1]
    rest = content[2:]
    instructions = list(Instruction)
    if kind == 2:
        return build(id, code, rest)
    if kind == 3:
        return build(id, instructions[code % len(instructions)], rest)
    if kind == 4:
        return build_status(id, code, rest)
    if kind == 5:
        rows = [
            (rest[k], k // 5 + 1, rest[k + 1 : k + 5].ljust(4, b"\0"))
            for k in range(0, len(rest), 5)
        ]
        return build_fast_status(rows, 8 + 8 * code % 8)

    complete = build_status(id, 0, rest) if code & 1 else build(id, Instruction.WRITE, rest)
    packet = bytearray(complete)
    damage = code >> 1
    position = damage % len(packet)
    if damage & 1:
        return bytes(packet[:position])
    packet[position] ^= 1 << (damage & 7)
    return bytes(packet)


def checked(stream: bytes) -> list[tuple[int, int, bytes]]:
    """Return id, instruction and parameters of each packet in a stream.

    Every header is tried, also inside another packet. It begins a packet if the checksum is
    correct.
    """
    packets = []
    start = stream.find(HEADER)
    while start >= 0:
        size = 7 + int.from_bytes(stream[start + 5 : start + 7], "little")
        raw = stream[start : start + size]
        checksum = int.from_bytes(raw[-2:], "little")
        if 10 <= size <= len(raw) and host_crc(raw[:-2]) == checksum:
            body = unstuff(raw[7:-2])
            packets.append((raw[4], body[0], body[1:]))
        start = stream.find(HEADER, start + 1)
    return packets
