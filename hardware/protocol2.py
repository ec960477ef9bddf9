"""Protocol 2 of Dynamixel servos, on the host's side, as a ``WireProtocol``.

The codec itself is ``robot_ik.hardware.packets``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from robot_ik.hardware import packets
from robot_ik.hardware.bus import ERROR_REASONS, GARBLED
from robot_ik.hardware.registers import Register
from robot_ik.hardware.wire_protocol import GroupRead, StatusParser

PING = 0x01
READ = 0x02
WRITE = 0x03
REBOOT = 0x08


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
        return packets.build(id, PING, b"")

    def read(self, id: int, register: Register) -> bytes:
        return packets.build(id, READ, _address_and_size(register))

    def write(self, id: int, register: Register, value: int) -> bytes:
        return packets.build(
            id, WRITE, register.address.to_bytes(2, "little") + register.encode(value)
        )

    def reboot(self, id: int) -> bytes:
        return packets.build(id, REBOOT, b"")

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


def _address_and_size(register: Register) -> bytes:
    return register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")


PROTOCOL_2 = Protocol2()
