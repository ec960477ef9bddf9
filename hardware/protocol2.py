"""Protocol 2 of Dynamixel servos, on the host's side, as a ``WireProtocol``.

The Dynamixel SDK builds the requests to a single servo.  ``robot_ik.hardware.packets`` builds the
requests of a control cycle and takes every reply apart.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from dynamixel_sdk import Protocol2PacketHandler

from robot_ik.hardware import packets
from robot_ik.hardware.bus import ERROR_REASONS, GARBLED
from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import GroupRead, StatusParser

PING = 0x01
REBOOT = 0x08


class _RequestRecorder:
    """A port of the Dynamixel SDK that keeps a request instead of sending it."""

    is_using = False

    def __init__(self) -> None:
        self.request = b""

    def clearPort(self) -> None:
        """Do nothing: nothing was received."""

    def writePort(self, packet: list[int]) -> int:
        self.request = bytes(packet)
        return len(packet)

    def setPacketTimeout(self, _size: int) -> None:
        """Do nothing: the bus knows how long to wait."""


class Protocol2:
    """Protocol 2; implements ``WireProtocol``."""

    name = "Protocol 2"
    ping_data_size = 3  # model number 2, firmware 1
    model_number = None
    shortest_status = packets.SHORTEST_STATUS
    error_reasons = ERROR_REASONS
    damaged_request_code = GARBLED
    uniform_group_reads = False

    def __init__(self) -> None:
        self._sdk = Protocol2PacketHandler()

    def ping(self, id: int) -> bytes:
        return self._bare(id, PING)

    def read(self, id: int, register: Register) -> bytes:
        recorder = _RequestRecorder()
        self._sdk.readTx(recorder, id, register.address, register.size)
        return recorder.request

    def write(self, id: int, register: Register, value: int) -> bytes:
        recorder = _RequestRecorder()
        data = list(register.encode(value))
        self._sdk.writeTxOnly(recorder, id, register.address, register.size, data)
        return recorder.request

    def reboot(self, id: int) -> bytes:
        return self._bare(id, REBOOT)

    def _bare(self, id: int, instruction: int) -> bytes:
        """Return an instruction without parameters."""
        recorder = _RequestRecorder()
        self._sdk.txPacket(recorder, [0, 0, 0, 0, id, 3, 0, instruction, 0, 0])
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
        if read is not None and read.fast:
            return packets.FastParser(sizes)
        return packets.StatusParser()

    def take_at_once(
        self, data: bytes, read: GroupRead, sizes: tuple[tuple[int, int], ...]
    ) -> list[bytes] | None:
        return packets.whole_fast_status(data, sizes) if read.fast else None


PROTOCOL_2 = Protocol2()
