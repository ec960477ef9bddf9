"""Protocol 1 of Dynamixel and Feetech servos, on the host's side.

Packet: FF FF, id, length (parameters + 2), instruction or error byte, parameters, checksum.
The checksum is the inverted low byte of the sum of everything between the header and the checksum.

Sources: ROBOTIS e-manual, Protocol 1.0.  Feetech, Communication Protocol User Manual (191218): the
    same packets
and Sync Read (0x82), which Dynamixel Protocol 1.0 does not have.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import BROADCAST_ID, GroupRead, StatusPacket

HEADER = b"\xff\xff"
PING = 0x01
READ = 0x02
WRITE = 0x03
REBOOT = 0x08
SYNC_READ = 0x82
SYNC_WRITE = 0x83

SHORTEST_STATUS = 6
"""Bytes of a status packet without data: header 2, id 1, length 1, error 1, checksum 1."""

MAX_PACKET = 250
"""Bytes.  A longer length field is damaged (Feetech SDK, RXPACKET_MAX_LEN)."""


def checksum(body: bytes) -> int:
    """Return the checksum of everything between the header and the checksum."""
    return ~sum(body) & 0xFF


def build(id: int, instruction: int, params: bytes = b"") -> bytes:
    """Return an instruction packet."""
    body = bytes((id, len(params) + 2, instruction)) + params
    return HEADER + body + bytes((checksum(body),))


@dataclass(frozen=True)
class Protocol1:
    """Protocol 1 of one servo family; implements ``WireProtocol``.

    Attributes:
        model_number: Register that tells the model.
        refusal_bits: Bits of the error byte that mean "request refused".  The other bits are
            hardware errors.
    """

    model_number: Register
    refusal_bits: int = 0

    name = "Protocol 1"
    ping_data_size = 0
    shortest_status = SHORTEST_STATUS
    damaged_request_code = None
    uniform_group_reads = True

    @property
    def error_reasons(self) -> Mapping[int, str]:
        return {}

    def ping(self, id: int) -> bytes:
        return build(id, PING)

    def read(self, id: int, register: Register) -> bytes:
        return build(id, READ, bytes((register.address, register.size)))

    def write(self, id: int, register: Register, value: int) -> bytes:
        return build(id, WRITE, bytes((register.address,)) + register.encode(value))

    def reboot(self, id: int) -> bytes:
        return build(id, REBOOT)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> bytes:
        """Return a write of one register of several servos.  No servo answers it."""
        params = bytes((register.address, register.size))
        for id, value in values.items():
            params += bytes((id,)) + register.encode(value)
        return build(BROADCAST_ID, SYNC_WRITE, params)

    def group_read(
        self, registers: Mapping[int, Register], _fast_ids: Collection[int], /
    ) -> GroupRead:
        """Return a sync read.

        Raises:
            ValueError: The registers differ in address or size.
        """
        first = next(iter(registers.values()))
        if any((r.address, r.size) != (first.address, first.size) for r in registers.values()):
            raise ValueError("Protocol 1 reads one address and size of all servos in one request")
        params = bytes((first.address, first.size)) + bytes(registers)
        reply_size = len(registers) * (SHORTEST_STATUS + first.size)
        return GroupRead(build(BROADCAST_ID, SYNC_READ, params), reply_size)

    def parser(
        self, _read: GroupRead | None, _sizes: tuple[tuple[int, int], ...], /
    ) -> Protocol1Parser:
        return Protocol1Parser(self.refusal_bits)

    def take_at_once(
        self, data: bytes, read: GroupRead, sizes: tuple[tuple[int, int], ...]
    ) -> list[bytes] | None:
        """Return the data of every servo if ``data`` are all replies without an error."""
        if len(data) != read.reply_size:
            return None
        values = []
        start = 0
        for id, size in sizes:
            end = start + SHORTEST_STATUS + size
            packet = data[start:end]
            head = bytes((0xFF, 0xFF, id, size + 2, 0))
            if not packet.startswith(head) or checksum(packet[2:-1]) != packet[-1]:
                return None
            values.append(packet[5:-1])
            start = end
        return values


class Protocol1Parser:
    """Finds Protocol 1 status packets in a byte stream.

    Attributes:
        damaged: Number of packets found so far that had a wrong checksum or length.
    """

    def __init__(self, refusal_bits: int) -> None:
        self._refusal_bits = refusal_bits
        self._buffer = b""
        self.damaged = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[StatusPacket]:
        """Return the packets that ``data`` completes.

        Args:
            data: New bytes.
            last: No more bytes will come.  An incomplete packet is skipped: it may be noise before
                a packet.
        """
        buffer = self._buffer + data
        packets = []
        start = 0
        while True:
            start = buffer.find(HEADER, start)
            if start < 0:
                start = len(buffer) - 1 if buffer.endswith(b"\xff") else len(buffer)
                break
            # In a run of FF the header is the last pair.
            while buffer[start + 2 : start + 3] == b"\xff":
                start += 1
            if len(buffer) < start + 4:
                break
            length = buffer[start + 3]
            end = start + 4 + length
            plausible = 2 <= length <= MAX_PACKET
            if plausible and len(buffer) < end and not last:
                break
            packet = buffer[start:end]
            complete = plausible and len(buffer) >= end
            if not complete or checksum(packet[2:-1]) != packet[-1]:
                self.damaged += 1
                start += len(HEADER)
                continue
            inner = _inner_packet(buffer, start, end)
            if inner is None and not last:
                break
            if inner:
                # The packet broke off and the head of the next one completed it by chance.
                self.damaged += 1
                start += len(HEADER)
                continue
            packets.append(self._status(packet))
            start = end
        self._buffer = buffer[start:]
        return packets

    def _status(self, packet: bytes) -> StatusPacket:
        error = packet[4]
        code = error & self._refusal_bits
        alert = bool(error & ~self._refusal_bits)
        return StatusPacket(packet[2], code, alert, packet[5:-1])


def _inner_packet(buffer: bytes, start: int, end: int) -> bool | None:
    """Return whether a packet begins inside another one and extends beyond its end.

    A checksum of 8 bits cannot exclude that a packet which broke off is completed by the bytes of
    the next one. Then the next one is a packet, too.

    Args:
        buffer: Received bytes.
        start: Index of the outer packet.
        end: Index after the outer packet.

    Returns:
        None if more bytes are needed.
    """
    # The header may begin with the last byte of the outer packet, its checksum.
    first = buffer.find(HEADER, start + SHORTEST_STATUS - 1, end + 1)
    while first >= 0:
        if len(buffer) < first + 4:
            return None
        length = buffer[first + 3]
        inner_end = first + 4 + length
        if buffer[first + 2] != 0xFF and 2 <= length <= MAX_PACKET and inner_end > end:
            if len(buffer) < inner_end:
                return None
            inner = buffer[first:inner_end]
            if checksum(inner[2:-1]) == inner[-1]:
                return True
        first = buffer.find(HEADER, first + 1, end + 1)
    return False
