"""Stories for the laws: bytes of a fuzzer read as pieces on a wire, and who tells a packet from noise."""

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

PAUSE = 0.06
"""s; longer than a servo waits for the rest of a packet."""

TABLE = X_TABLES["XM430-W350"]
PRESENT, GOAL = TABLE["present_position"], TABLE["goal_position"]

HARMLESS = frozenset(
    Instruction[name]
    for name in ("PING", "READ", "SYNC_READ", "BULK_READ", "FAST_SYNC_READ", "FAST_BULK_READ", "STATUS")
)
"""Instructions after which a servo stands where it stood."""

TORSO = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
"""Instructions to which the answer breaks off at the first servo that is missing."""


def known_inputs() -> list[tuple[str, bytes]]:
    """(law, bytes) that once broke it: lines of ``inputs.txt``."""
    lines = INPUTS.read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    return [(name, bytes.fromhex(digits)) for name, digits in rows]


def random_input(rng: random.Random) -> bytes:
    """A story for ``pieces``: of all kinds and lengths, full of what headers and addresses are made of."""
    data = bytearray()
    for _ in range(rng.randint(1, 10)):
        size = rng.choice((0, 2, 3, 6, 7, 10, 20, 31))
        data.append(rng.randrange(8) | size << 3)
        data += bytes(
            rng.choice((*b"\x00\x01\x02\x03\xff\xfd\x55\x40\x74", rng.randrange(256))) for _ in range(size)
        )
    return bytes(data)


def pieces(data: bytes) -> list[bytes | None]:
    """Bytes of a fuzzer -> what comes over the wire, piece by piece; None is a pause.

    A piece is a byte (kind: low three bits; length: the rest) and so many bytes of content.
    """
    found: list[bytes | None] = []
    at = 0
    while at < len(data):
        kind, size = data[at] & 7, data[at] >> 3
        found.append(_piece(kind, data[at + 1 : at + 1 + size]))
        at += 1 + size
    return found


def _piece(kind: int, content: bytes) -> bytes | None:
    if kind == 7:
        return None
    if kind <= 1 or len(content) < 2:
        return content
    id, code, rest = content[0] % 5 if content[0] < 0xF0 else content[0], content[1], content[2:]
    instructions = list(Instruction)
    if kind == 2:
        return build(id, code, rest)
    if kind == 3:
        return build(id, instructions[code % len(instructions)], rest)
    if kind == 4:
        return build_status(id, code, rest)
    if kind == 5:
        rows = [(rest[k], k // 5 + 1, rest[k + 1 : k + 5].ljust(4, b"\0")) for k in range(0, len(rest), 5)]
        return build_fast_status(rows, 8 + 8 * code % 8)
    packet = bytearray(build_status(id, 0, rest) if code & 1 else build(id, Instruction.WRITE, rest))
    where = code >> 1
    if where & 1:
        return bytes(packet[: where % len(packet)])
    packet[where % len(packet)] ^= 1 << (where & 7)
    return bytes(packet)


def checked(stream: bytes) -> list[tuple[int, int, bytes]]:
    """(id, instruction, parameters) of every stretch of bytes that is a packet with a right checksum."""
    found, at = [], stream.find(HEADER)
    while at >= 0:
        size = 7 + int.from_bytes(stream[at + 5 : at + 7], "little")
        raw = stream[at : at + size]
        if 10 <= size <= len(raw) and host_crc(raw[:-2]) == int.from_bytes(raw[-2:], "little"):
            body = unstuff(raw[7:-2])
            found.append((raw[4], body[0], body[1:]))
        at = stream.find(HEADER, at + 1)
    return found


# ------------------------------------------------------------------------------ codec and parsers
