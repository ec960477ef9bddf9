"""Dynamixel Protocol 2.0 on the servo's side: packets to bytes and bytes to packets.

The host's side uses the official SDK and ``hardware/packets.py``. This codec is written
independently of both, so that the two sides check each other. Source: ROBOTIS e-manual, "DYNAMIXEL
Protocol 2.0".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
ALERT = 0x80
MAX_PACKET = 1024
"""Bytes of the longest packet (the SDK's buffer). A longer length field is damaged."""
PACKET_GAP = 0.050
"""s. A packet is dropped if its bytes stop for longer than this."""

_PAIR = struct.Struct(">H")

_SHORTEST = 10
"""Bytes of the shortest packet: header 4, id 1, length 2, instruction 1, CRC 2."""

_STUFFED = b"\xff\xff\xfd"


class Instruction(IntEnum):
    """Instruction byte of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class ErrorCode(IntEnum):
    """Bits 0-6 of the error byte of a status packet: a number, not a mask."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE = _crc_table()
# Remainders of two bytes at once: one entry for each value of 16 bits.
_CRC_PAIRS = tuple(
    ((_CRC_TABLE[high] << 8) & 0xFF00) ^ _CRC_TABLE[(_CRC_TABLE[high] >> 8) ^ low]
    for high in range(256)
    for low in range(256)
)


def crc16(data: bytes) -> int:
    """Return the CRC-16 with polynomial 0x8005, initial value 0, not reflected, no final XOR."""
    crc = 0
    for (pair,) in _PAIR.iter_unpack(data[: len(data) & ~1]):
        crc = _CRC_PAIRS[crc ^ pair]
    if len(data) & 1:
        crc = ((crc << 8) & 0xFF00) ^ _CRC_TABLE[(crc >> 8) ^ data[-1]]
    return crc


def stuff(body: bytes) -> bytes:
    """Insert FD after each FF FF FD, so that no header can appear inside a packet."""
    return body.replace(_STUFFED, _STUFFED + b"\xfd")


def unstuff(body: bytes) -> bytes:
    """Remove the FD after each FF FF FD."""
    return body.replace(_STUFFED + b"\xfd", _STUFFED)


@dataclass(frozen=True)
class Packet:
    """A packet as it arrived.

    Attributes:
        id: Servo id.
        instruction: Instruction byte. It may be a number that no ``Instruction`` has.
        params: Parameters without stuffing. Those of a status packet begin with its error byte.
        valid: The checksum was correct. If not, none of the other fields can be trusted.
    """

    id: int
    instruction: int
    params: bytes
    valid: bool = True

    @property
    def is_status(self) -> bool:
        """A reply of a servo, with at least its error byte."""
        return self.valid and self.instruction == Instruction.STATUS and len(self.params) > 0

    @property
    def data(self) -> bytes:
        return self.params[1:]


def build(id: int, instruction: int, params: bytes = b"") -> bytes:
    """Return an instruction packet: stuffed, with length and checksum."""
    body = stuff(bytes([instruction]) + params)
    packet = HEADER + bytes([id]) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def build_status(id: int, error: int, data: bytes = b"") -> bytes:
    """Return a status packet. ``error`` is the whole error byte, including the alert bit."""
    return build(id, Instruction.STATUS, bytes([error]) + data)


def build_fast_status(parts: Sequence[tuple[int, int, bytes]], expected: int) -> bytes:
    """Return the packet in which several servos answer a fast read, part by part.

    Args:
        parts: (error byte, id, data) of every servo that answers, in the order of the request.
        expected: Length of the packet if every servo answers. The first servo writes it into the
            header. A silent servo silences all servos behind it, so the packet may be incomplete.
    """
    packet = (
        HEADER
        + bytes([BROADCAST])
        + (expected - 7).to_bytes(2, "little")
        + bytes([Instruction.STATUS])
    )
    for error, id, data in parts:
        packet += bytes([error, id]) + data
        packet += crc16(packet).to_bytes(2, "little")
    return packet


class Parser:
    """Cuts a byte stream into packets and finds the next header after garbage."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._last = 0.0

    def feed(self, data: bytes, now: float) -> list[Packet]:
        """Return the packets that ``data``, received at time ``now`` in s, completes."""
        if self._buffer and now - self._last > PACKET_GAP:
            self._buffer.clear()
        self._last = now
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            self._seek(0)
            if len(buffer) < _SHORTEST - 3:
                return None
            size = 7 + int.from_bytes(buffer[5:7], "little")
            if not _SHORTEST <= size <= MAX_PACKET or buffer[4] in (0xFD, 0xFF):
                self._seek(1)
                continue
            if len(buffer) >= size:
                return self._take(size)
            # Stuffing keeps headers out of a packet: a new header means that this one broke off.
            if buffer.find(HEADER, 1) < 0:
                return None
            self._seek(1)

    def _seek(self, start: int) -> None:
        """Drop everything before the next header at or after ``start``; keep what may begin one."""
        at = self._buffer.find(HEADER, start)
        if at < 0:
            at = max(len(self._buffer) - len(HEADER) + 1, start)
        del self._buffer[:at]

    def _take(self, size: int) -> Packet:
        raw = bytes(self._buffer[:size])
        valid = crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little")
        if valid:
            del self._buffer[:size]
        else:
            # A byte may be lost: the next packet may begin inside this one.
            self._seek(1)
        body = unstuff(raw[7:-2])
        return Packet(raw[4], body[0], body[1:], valid)
