"""Bytes of the control cycle, on the host's side: group requests, and the replies to them; the ping to all.

Only a cycle must be quick; requests to one servo are left to the Dynamixel SDK.  That takes
a reply apart byte by byte in Python; here whole replies are found and checked at once.  The tests hold the
requests to the SDK's own.  Protocol 2.0 manual: "Packet", "Sync Read" and those after it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from robot_ik.hardware.bus import ALERT_BIT, BROADCAST_ID
from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import StatusPacket

HEADER = b"\xff\xff\xfd\x00"
STATUS = 0x55
SYNC_READ, SYNC_WRITE, FAST_SYNC_READ = 0x82, 0x83, 0x8A
BULK_READ, FAST_BULK_READ = 0x92, 0x9A

SHORTEST_STATUS = 11
"""Bytes of a status packet without data: header 4, id 1, length 2, instruction 1, error 1, CRC 2."""

FAST_HEAD = 8
"""Bytes of a fast status before the first servo: header 4, id 1, length 2, instruction 1."""
FAST_FRAME = 4
"""Bytes of a fast status that each servo adds to its data: error 1, id 1, CRC 2."""

MAX_PACKET = 1024
"""Bytes of a packet; a length field that says more is damaged."""

_STATUS = bytes((STATUS,))
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"


def _crc_table() -> list[int]:
    """CRC-16, polynomial 0x8005, most significant bit first, of every pair of bytes."""
    value = np.arange(65_536)
    for _ in range(16):
        value = np.where(value & 0x8000, value << 1 ^ 0x8005, value << 1) & 0xFFFF
    return value.tolist()


_CRC = _crc_table()


def crc(data: bytes, value: int = 0) -> int:
    """Checksum of bytes that follow bytes with checksum ``value``."""
    table, size = _CRC, len(data)
    for pair in struct.unpack(f">{size >> 1}H", data[:-1] if size & 1 else data):
        value = table[value ^ pair]
    return (value << 8 & 0xFF00) ^ table[value >> 8 ^ data[-1]] if size & 1 else value


def build(id: int, instruction: int, params: bytes) -> bytes:
    """An instruction packet: stuffed, measured, signed with its checksum."""
    body = (bytes((instruction,)) + params).replace(_PLAIN, _STUFFED)
    head = HEADER + bytes((id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc(head).to_bytes(2, "little")


def _where(register: Register) -> bytes:
    return register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")


def write_request(register: Register, values: Mapping[int, int]) -> bytes:
    """Sync write of one register, servo id -> value.

    Raises:
        ValueError: A value does not fit the register.
    """
    body = [bytes((id,)) + register.encode(value) for id, value in values.items()]
    return build(BROADCAST_ID, SYNC_WRITE, _where(register) + b"".join(body))


def read_request(registers: Mapping[int, Register], *, fast: bool) -> bytes:
    """Sync read if all registers have one address, else bulk read; fast: one status packet for all."""
    first = next(iter(registers.values()))
    if all((r.address, r.size) == (first.address, first.size) for r in registers.values()):
        return build(BROADCAST_ID, FAST_SYNC_READ if fast else SYNC_READ, _where(first) + bytes(registers))
    body = b"".join(bytes((id,)) + _where(register) for id, register in registers.items())
    return build(BROADCAST_ID, FAST_BULK_READ if fast else BULK_READ, body)


class StatusParser:
    """Status packets out of bytes that come in pieces, with anything between them.

    Attributes:
        damaged: Packets seen so far that could not be trusted.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.damaged = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:
        """Replies that are complete with these bytes.

        ``last``: nothing more will come: what looks like the head of a packet that is not all there is
        passed over, for it may be noise with packets behind it.
        """
        buffer = self._buffer + data
        packets = []
        at = 0
        while True:
            at = buffer.find(HEADER, at)
            if at < 0:
                at = max(len(buffer) - len(HEADER) + 1, 0)  # it may end in a part of a header
                break
            if len(buffer) < at + 7:
                break
            length = buffer[at + 5] | buffer[at + 6] << 8
            end = at + 7 + length
            if not last and length <= MAX_PACKET and len(buffer) < end:
                break
            packet = _status(buffer[at:end]) if len(buffer) >= end else None
            if packet is None:
                if len(buffer) < end or buffer.startswith(_STATUS, at + 7):
                    self.damaged += 1
                at += len(HEADER)
                continue
            packets.append(packet)
            at = end
        self._buffer = buffer[at:]
        return packets


def _status(packet: bytes) -> StatusPacket | None:
    """A whole packet, taken apart; None if it is damaged or no status."""
    if len(packet) < SHORTEST_STATUS or packet[7] != STATUS:
        return None
    if crc(packet[:-2]) != packet[-2] | packet[-1] << 8:
        return None
    body = packet[8:-2]
    if _STUFFED in body:
        body = body.replace(_STUFFED, _PLAIN)
    return StatusPacket(packet[4], body[0] & ~ALERT_BIT, bool(body[0] & ALERT_BIT), body[1:])


@lru_cache(maxsize=256)
def _fast_layout(
    expected: tuple[tuple[int, int], ...],
) -> tuple[bytes, tuple[tuple[int, int, int], ...], int]:
    """Of a fast status in which all servos asked have their part: its head, the servos, bytes in all.

    Of each servo: its id, the first byte of its data, the first behind them; error and id lie before.
    """
    spans, at = [], FAST_HEAD
    for id, size in expected:
        spans.append((id, at + 2, at + 2 + size))
        at += size + FAST_FRAME
    head = HEADER + bytes((BROADCAST_ID,)) + (at - 7).to_bytes(2, "little") + _STATUS
    return head, tuple(spans), at


def whole_fast_status(data: bytes, expected: tuple[tuple[int, int], ...]) -> list[bytes] | None:
    """Data of each servo where ``data`` are just one fast status with nothing wrong; the usual case, quickly.

    ``expected``: (id, bytes of data), in the order asked.  None where anything is wrong, an error or an alert
    among it: then ``FastParser`` says what.
    """
    head, spans, total = _fast_layout(expected)
    # The last checksum runs over all bytes before it.
    if len(data) != total or not data.startswith(head) or crc(data[:-2]) != data[-2] | data[-1] << 8:
        return None
    values = []
    for id, first, end in spans:
        if data[first - 2] or data[first - 1] != id:
            return None
        values.append(data[first:end])
    return values


class FastParser:
    """The one status in which all servos answer a fast read; gives each as soon as its checksum is there.

    Every servo's checksum runs over all bytes before it, so behind a damaged byte no servo can be trusted,
    and behind a servo that is missing none answers.  What comes before is good.

    Attributes:
        damaged: 1 when there is no use in waiting for more.
    """

    def __init__(self, expected: Sequence[tuple[int, int]]) -> None:
        self._expected = expected
        self._total = _fast_layout(tuple(expected))[2]
        self._buffer = b""
        self._next = self._at = self._crc = 0
        self.damaged = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:
        """Replies that are complete now; ``last``: nothing more will come."""
        packets: list[StatusPacket] = []
        if self.damaged:
            return packets
        buffer = self._buffer + data
        if not self._at:
            buffer = self._from_head(buffer)
        self._buffer = buffer = buffer[: self._total]
        if not self._at:
            return packets
        while self._next < len(self._expected) and not self.damaged:
            id, size = self._expected[self._next]
            end = self._at + size + FAST_FRAME
            if len(buffer) < end:
                break
            frame = buffer[self._at : end]
            value = crc(frame[:-2], self._crc)
            if value != frame[-2] | frame[-1] << 8 or frame[1] != id:
                self.damaged = 1
                break
            packets.append(StatusPacket(id, frame[0] & ~ALERT_BIT, bool(frame[0] & ALERT_BIT), frame[2:-2]))
            self._crc = crc(frame[-2:], value)
            self._at = end
            self._next += 1
        return packets

    def _from_head(self, buffer: bytes) -> bytes:
        """The bytes from the head of a fast status on, or what may begin one; sets ``_at`` behind it."""
        at = buffer.find(HEADER)
        while 0 <= at <= len(buffer) - FAST_HEAD:
            if buffer[at + 4] == BROADCAST_ID and buffer[at + 7] == STATUS:
                # Stuffing would make it longer; clients differ on whether there is any: not to be trusted.
                if (buffer[at + 5] | buffer[at + 6] << 8) + 7 != self._total:
                    self.damaged = 1
                    return b""
                self._at = FAST_HEAD
                self._crc = crc(buffer[at : at + FAST_HEAD])
                return buffer[at:]
            at = buffer.find(HEADER, at + 1)
        return buffer[at if at >= 0 else 1 - len(HEADER) :]
