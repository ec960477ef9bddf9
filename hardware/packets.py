"""Protocol 2 packets of the control cycle: group requests and their replies.

A cycle must be quick.  The Dynamixel SDK takes a reply apart byte by byte in Python.  The code here
finds and checks complete replies at once.  The SDK builds and parses the requests to a single
servo, see ``protocol2``.  The tests compare the requests with the SDK's own.  Source: Protocol 2.0
manual, "Packet", "Sync Read" and the sections after it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from robot_ik.hardware.bus import ALERT_BIT, BROADCAST_ID
from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import StatusPacket

HEADER = b"\xff\xff\xfd\x00"
"""First bytes of every packet."""

STATUS = 0x55
"""Instruction byte of a status packet."""

SYNC_READ = 0x82
SYNC_WRITE = 0x83
FAST_SYNC_READ = 0x8A
BULK_READ = 0x92
FAST_BULK_READ = 0x9A

SHORTEST_STATUS = 11
"""Bytes of a status packet without data: header 4, id 1, length 2, instruction 1, error 1, CRC 2.
"""

LENGTH_END = 7
"""Bytes up to the end of the length field.  The length counts the bytes after it."""

FAST_HEAD = 8
"""Bytes of a fast status before the first servo: header 4, id 1, length 2, instruction 1."""

FAST_FRAME = 4
"""Bytes of a fast status that each servo adds to its data: error 1, id 1, CRC 2."""

MAX_PACKET = 1024
"""Bytes of a packet.  A longer length field is damaged."""

POLYNOMIAL = 0x8005
"""Polynomial of the CRC-16, most significant bit first."""

_STATUS = bytes((STATUS,))
_PLAIN = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"


def _crc_table() -> list[int]:
    """Return the CRC-16 of every pair of bytes."""
    value = np.arange(65_536)
    for _ in range(16):
        value = np.where(value & 0x8000, value << 1 ^ POLYNOMIAL, value << 1) & 0xFFFF
    return value.tolist()


_CRC = _crc_table()


def crc(data: bytes, value: int = 0) -> int:
    """Return the checksum of bytes that follow bytes with the checksum ``value``."""
    table = _CRC
    size = len(data)
    is_odd = size & 1
    for pair in struct.unpack(f">{size >> 1}H", data[:-1] if is_odd else data):
        value = table[value ^ pair]
    return (value << 8 & 0xFF00) ^ table[value >> 8 ^ data[-1]] if is_odd else value


def build(id: int, instruction: int, params: bytes) -> bytes:
    """Return an instruction packet, with byte stuffing, length and checksum."""
    body = (bytes((instruction,)) + params).replace(_PLAIN, _STUFFED)
    packet = HEADER + bytes((id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc(packet).to_bytes(2, "little")


def needs_stuffing(data: bytes) -> bool:
    """Return whether data contain the first bytes of a header."""
    return _PLAIN in data


def _address_and_size(register: Register) -> bytes:
    return register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")


def write_request(register: Register, values: Mapping[int, int]) -> bytes:
    """Return a sync write of one register.

    Args:
        register: Register.
        values: Servo id -> value.

    Raises:
        ValueError: A value does not fit the register.
    """
    body = [bytes((id,)) + register.encode(value) for id, value in values.items()]
    return build(BROADCAST_ID, SYNC_WRITE, _address_and_size(register) + b"".join(body))


def read_request(registers: Mapping[int, Register], *, fast: bool) -> bytes:
    """Return a sync read if all registers have one address, else a bulk read.

    Args:
        registers: Servo id -> register.
        fast: The servos answer together in one status packet.
    """
    first = next(iter(registers.values()))
    if all((r.address, r.size) == (first.address, first.size) for r in registers.values()):
        instruction = FAST_SYNC_READ if fast else SYNC_READ
        return build(BROADCAST_ID, instruction, _address_and_size(first) + bytes(registers))
    body = b"".join(
        bytes((id,)) + _address_and_size(register) for id, register in registers.items()
    )
    return build(BROADCAST_ID, FAST_BULK_READ if fast else BULK_READ, body)


def has_right_checksum(packet: bytes) -> bool:
    """Return whether the last two bytes of a packet are the checksum of the others."""
    return crc(packet[:-2]) == packet[-2] | packet[-1] << 8


def parse_status(packet: bytes) -> StatusPacket | None:
    """Return a complete status packet; None if it is damaged or another packet."""
    if len(packet) < SHORTEST_STATUS or packet[7] != STATUS or not has_right_checksum(packet):
        return None
    body = packet[8:-2]
    if _STUFFED in body:
        body = body.replace(_STUFFED, _PLAIN)
    return StatusPacket(packet[4], body[0] & ~ALERT_BIT, bool(body[0] & ALERT_BIT), body[1:])


class StatusParser:
    """Finds status packets in a byte stream with anything between them.

    Args:
        parse: Takes a packet apart.  Returns None if it is damaged or no status packet.

    Attributes:
        damaged: Number of packets found so far that could not be trusted.
    """

    def __init__(self, parse: Callable[[bytes], StatusPacket | None] = parse_status) -> None:
        self.damaged = 0
        self._parse = parse
        self._buffer = b""

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:
        """Return the packets that ``data`` completes.

        Args:
            data: New bytes.
            last: No more bytes will come.  The head of an incomplete packet is skipped: it may be
                noise before a packet.
        """
        buffer = self._buffer + data
        packets = []
        start = 0
        while True:
            start = buffer.find(HEADER, start)
            if start < 0:
                start = max(len(buffer) - len(HEADER) + 1, 0)  # keep a part of a header
                break
            if len(buffer) < start + LENGTH_END:
                break
            length = buffer[start + 5] | buffer[start + 6] << 8
            end = start + LENGTH_END + length
            if not last and length <= MAX_PACKET and len(buffer) < end:
                break
            packet = self._parse(buffer[start:end]) if len(buffer) >= end else None
            if packet is None:
                if len(buffer) < end or buffer.startswith(_STATUS, start + LENGTH_END):
                    self.damaged += 1
                start += len(HEADER)
                continue
            packets.append(packet)
            start = end
        self._buffer = buffer[start:]
        return packets


class _FastLayout(NamedTuple):
    """Layout of a fast status in which every servo has its part.

    Attributes:
        head: First bytes of the packet.
        spans: (servo id, index of its first byte of data, index after its data).  Its error and id
            lie before the data.
        size: Bytes of the packet.
    """

    head: bytes
    spans: tuple[tuple[int, int, int], ...]
    size: int


@lru_cache(maxsize=256)
def _fast_layout(expected: tuple[tuple[int, int], ...]) -> _FastLayout:
    spans = []
    size = FAST_HEAD
    for id, data_size in expected:
        spans.append((id, size + 2, size + 2 + data_size))
        size += data_size + FAST_FRAME
    length = (size - LENGTH_END).to_bytes(2, "little")
    return _FastLayout(HEADER + bytes((BROADCAST_ID,)) + length + _STATUS, tuple(spans), size)


def complete_fast_status(data: bytes, expected: tuple[tuple[int, int], ...]) -> list[bytes] | None:
    """Return the data of each servo if ``data`` are one fast status without any error.

    This is the usual case and must be quick.  In every other case the result is None, and
    ``FastParser`` finds the replies.

    Args:
        data: Received bytes.
        expected: (id, bytes of data) in the order of the request.
    """
    head, spans, size = _fast_layout(expected)
    if len(data) != size or not data.startswith(head):
        return None
    # The last checksum covers all bytes before it.
    if crc(data[:-2]) != data[-2] | data[-1] << 8:
        return None
    values = []
    for id, begin, end in spans:
        if data[begin - 2] or data[begin - 1] != id:
            return None
        values.append(data[begin:end])
    return values


class FastParser:
    """Finds the reply of each servo in the one status packet of a fast read.

    A reply is complete as soon as its checksum is there.  The checksum of each servo covers all
    bytes before it.  So no servo after a damaged byte can be trusted, and no servo after a missing
    one answers.  Replies before that are good.

    Args:
        expected: (id, bytes of data) in the order of the request.

    Attributes:
        damaged: 1 if no more replies can come.
    """

    def __init__(self, expected: Sequence[tuple[int, int]]) -> None:
        self.damaged = 0
        self._expected = expected
        self._size = _fast_layout(tuple(expected)).size
        self._buffer = b""
        # Number of the next servo.
        self._next = 0
        # Index of its first byte; 0 until the head of the packet was found.
        self._start = 0
        # Checksum of the bytes before it.
        self._crc = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:  # noqa: ARG002
        """Return the replies that ``data`` completes.

        Args:
            data: New bytes.
            last: Not used: an incomplete reply of a fast status is never used.
        """
        packets: list[StatusPacket] = []
        if self.damaged:
            return packets
        buffer = self._buffer + data
        if not self._start:
            buffer = self._from_head(buffer)
        buffer = buffer[: self._size]
        self._buffer = buffer
        if not self._start:
            return packets
        while self._next < len(self._expected) and not self.damaged:
            id, size = self._expected[self._next]
            end = self._start + size + FAST_FRAME
            if len(buffer) < end:
                break
            frame = buffer[self._start : end]
            value = crc(frame[:-2], self._crc)
            if value != frame[-2] | frame[-1] << 8 or frame[1] != id:
                self.damaged = 1
                break
            error = frame[0]
            packets.append(
                StatusPacket(id, error & ~ALERT_BIT, bool(error & ALERT_BIT), frame[2:-2])
            )
            self._crc = crc(frame[-2:], value)
            self._start = end
            self._next += 1
        return packets

    def _from_head(self, buffer: bytes) -> bytes:
        """Return the bytes from the head of a fast status on, or what may be the start of one."""
        start = buffer.find(HEADER)
        while 0 <= start <= len(buffer) - FAST_HEAD:
            if buffer[start + 4] == BROADCAST_ID and buffer[start + 7] == STATUS:
                # Byte stuffing would make it longer.  Clients differ on whether there is any, so
                # such a packet is not used.
                length = buffer[start + 5] | buffer[start + 6] << 8
                if length + LENGTH_END != self._size:
                    self.damaged = 1
                    return b""
                self._start = FAST_HEAD
                self._crc = crc(buffer[start : start + FAST_HEAD])
                return buffer[start:]
            start = buffer.find(HEADER, start + 1)
        return buffer[start if start >= 0 else 1 - len(HEADER) :]
