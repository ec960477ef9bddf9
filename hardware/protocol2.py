"""Protocol 2 of Dynamixel servos, on the host's side, as a ``WireProtocol``.

The Dynamixel SDK builds the requests to a single servo and parses their replies.
``robot_ik.hardware.packets`` builds the requests of a control cycle and parses their replies.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache
from typing import TYPE_CHECKING

from robot_ik.hardware import packets
from robot_ik.hardware.bus import ALERT_BIT, ERROR_REASONS, GARBLED
from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import GroupRead, StatusPacket, StatusParser

if TYPE_CHECKING:
    from dynamixel_sdk import Protocol2PacketHandler

PING = 0x01
"""Instruction byte of a ping."""

WRITE = 0x03
"""Instruction byte of a write."""

REBOOT = 0x08
"""Instruction byte of a reboot."""

ID = 4
"""Index of the id in a packet."""

LENGTH = 5
"""Index of the length in a packet, two bytes.  It counts the bytes after it."""

ERROR = 8
"""Index of the error byte in a status packet.  The data follow it."""

CRC_BYTES = 2
"""Bytes of the checksum at the end of a packet."""

COMM_SUCCESS = 0
"""Result of the SDK for a packet that is complete and has the right checksum."""


@cache
def _packet_handler() -> Protocol2PacketHandler:
    """Return the packet handler of the SDK.

    The SDK is imported here: it loads pyserial and takes 30 ms, and neither help pages nor
    simulated servos need it.
    """
    from dynamixel_sdk import Protocol2PacketHandler

    return Protocol2PacketHandler()


class _RequestRecorder:
    """A port of the Dynamixel SDK that keeps a request instead of sending it."""

    is_using = False

    def __init__(self) -> None:
        self.request = b""

    def clearPort(self) -> None:
        """Do nothing: nothing was received."""

    def writePort(self, packet: list[int]) -> int:
        """Keep a request."""
        self.request = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, _size: int) -> None:
        """Do nothing: the bus knows how long to wait."""


class _ReceivedBytes:
    """A port of the Dynamixel SDK that gives bytes that were received already."""

    is_using = False

    def __init__(self, data: bytes) -> None:
        self._data = data

    def readPort(self, length: int) -> bytes:
        """Return the next bytes."""
        data = self._data[:length]
        self._data = self._data[length:]
        return data

    def isPacketTimeout(self) -> bool:
        """Return whether all bytes were read."""
        return not self._data


def parse_status(packet: bytes) -> StatusPacket | None:
    """Return a status packet as the Dynamixel SDK parses it; None if the SDK refuses it.

    The SDK computes the checksum byte by byte in Python.  A line may be full of headers that are
    none, so a packet with a wrong checksum does not come to the SDK.
    """
    if not packets.has_right_checksum(packet):
        return None
    content, result = _packet_handler().rxPacket(_ReceivedBytes(packet), False)
    if result != COMM_SUCCESS:
        return None
    # The SDK has removed the byte stuffing and corrected the length.
    length = content[LENGTH] | content[LENGTH + 1] << 8
    error = content[ERROR]
    data = bytes(content[ERROR + 1 : packets.LENGTH_END + length - CRC_BYTES])
    return StatusPacket(content[ID], error & ~ALERT_BIT, bool(error & ALERT_BIT), data)


class Protocol2:
    """Protocol 2; implements ``WireProtocol``."""

    name = "Protocol 2"
    ping_data_size = 3  # model number 2, firmware 1
    model_number = None
    shortest_status = packets.SHORTEST_STATUS
    error_reasons = ERROR_REASONS
    damaged_request_code = GARBLED
    uniform_group_reads = False

    def ping(self, id: int) -> bytes:
        return self._bare(id, PING)

    def read(self, id: int, register: Register) -> bytes:
        recorder = _RequestRecorder()
        _packet_handler().readTx(recorder, id, register.address, register.size)
        return recorder.request

    def write(self, id: int, register: Register, value: int) -> bytes:
        data = register.encode(value)
        if packets.needs_stuffing(data):
            # The SDK (4.1.0) computes the byte stuffing and sends the packet without it.
            return packets.build(id, WRITE, register.address.to_bytes(2, "little") + data)
        recorder = _RequestRecorder()
        _packet_handler().writeTxOnly(recorder, id, register.address, register.size, list(data))
        return recorder.request

    def reboot(self, id: int) -> bytes:
        return self._bare(id, REBOOT)

    def _bare(self, id: int, instruction: int) -> bytes:
        """Return an instruction without parameters."""
        recorder = _RequestRecorder()
        _packet_handler().txPacket(recorder, [0, 0, 0, 0, id, 3, 0, instruction, 0, 0])
        return recorder.request

    def sync_write(self, register: Register, values: Mapping[int, int]) -> bytes:
        return packets.write_request(register, values)

    def group_read(
        self, registers: Mapping[int, Register], fast_ids: Collection[int], /
    ) -> GroupRead:
        fast = len(registers) > 1 and set(registers).issubset(fast_ids)
        overhead = packets.FAST_FRAME if fast else packets.SHORTEST_STATUS
        reply_size = sum(register.size + overhead for register in registers.values())
        if fast:
            reply_size += packets.FAST_HEAD
        return GroupRead(packets.read_request(registers, fast=fast), reply_size, fast)

    def parser(self, read: GroupRead | None, sizes: tuple[tuple[int, int], ...], /) -> StatusParser:
        if read is None:
            return packets.StatusParser(parse_status)
        return packets.FastParser(sizes) if read.fast else packets.StatusParser()

    def take_at_once(
        self, data: bytes, read: GroupRead, sizes: tuple[tuple[int, int], ...]
    ) -> list[bytes] | None:
        return packets.complete_fast_status(data, sizes) if read.fast else None


PROTOCOL_2 = Protocol2()
