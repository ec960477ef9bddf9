"""What is in the parameters of each instruction, and what one servo does with those meant for it alone.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0", Instruction Details.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from robot_ik.hardware.virtual.protocol2 import MAX_PACKET, ErrorCode, Instruction, build_fast_status
from robot_ik.hardware.virtual.servo import VirtualServo

ANSWERS_READ, ANSWERS_ALL = 1, 2
"""What a servo answers at each Status Return Level: 0 ping only, 1 also reads, 2 everything."""

Request = tuple[int, int, int]
"""(servo id, address, length) of one part of a sync or bulk read."""
Order = tuple[int, int, bytes]
"""(servo id, address, data) of one part of a sync or bulk write."""


def word(data: bytes, at: int) -> int:
    """Two bytes, little-endian; missing ones count as 0."""
    return int.from_bytes(data[at : at + 2], "little")


def sync_requests(params: bytes) -> list[Request]:
    """The reads of a sync read."""
    address, length = word(params, 0), word(params, 2)
    return [(id, address, length) for id in params[4:]]


def bulk_requests(params: bytes) -> list[Request]:
    """The reads of a bulk read."""
    return [(params[k], word(params, k + 1), word(params, k + 3)) for k in range(0, len(params) - 4, 5)]


def sync_writes(params: bytes) -> list[Order]:
    """The writes of a sync write; nothing at all if the lengths do not add up."""
    address, length, rest = word(params, 0), word(params, 2), params[4:]
    if length == 0 or len(rest) % (length + 1):
        return []
    return [(rest[k], address, rest[k + 1 : k + 1 + length]) for k in range(0, len(rest), length + 1)]


def bulk_writes(params: bytes) -> list[Order]:
    """The writes of a bulk write; a part that breaks off is left out."""
    found, at = [], 0
    while at + 5 <= len(params):
        length = word(params, at + 3)
        data = params[at + 5 : at + 5 + length]
        if len(data) == length:
            found.append((params[at], word(params, at + 1), data))
        at += 5 + length
    return found


def _ping(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    data, _ = servo.read(0, 2)
    firmware, _ = servo.read(6, 1)
    return ErrorCode.NONE, data + firmware


def _read(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    if len(params) != 4:
        return ErrorCode.DATA_LENGTH, b""
    data, error = servo.read(word(params, 0), word(params, 2))
    return error, data


def _factory_reset(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    return (servo.factory_reset(params[0]) if len(params) == 1 else ErrorCode.DATA_LENGTH), b""


def _reboot(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    servo.reboot()
    return ErrorCode.NONE, b""


SINGLE: Mapping[int, Callable[[VirtualServo, bytes], tuple[ErrorCode, bytes]]] = MappingProxyType(
    {
        Instruction.PING: _ping,
        Instruction.READ: _read,
        Instruction.WRITE: lambda servo, params: (servo.write(word(params, 0), params[2:]), b""),
        Instruction.REG_WRITE: lambda servo, params: (servo.reg_write(word(params, 0), params[2:]), b""),
        Instruction.ACTION: lambda servo, params: (servo.action(), b""),
        Instruction.FACTORY_RESET: _factory_reset,
        Instruction.REBOOT: _reboot,
        Instruction.CLEAR: lambda servo, params: (servo.clear(params), b""),
        Instruction.CONTROL_TABLE_BACKUP: lambda servo, params: (servo.control_table_backup(params), b""),
    }
)
"""Instruction to one servo, or to all -> what a servo does; gives its error number and data."""


def execute(
    servo: VirtualServo, instruction: int, params: bytes, *, broadcast: bool
) -> tuple[ErrorCode, bytes]:
    """What ``servo`` does on an instruction that is meant for it, and answers if it may."""
    guarded = broadcast and params == b"\xff" and "guarded_reset" in servo.table.abilities
    if instruction == Instruction.FACTORY_RESET and guarded:
        return ErrorCode.RESULT_FAIL, b""
    action = SINGLE.get(instruction)
    return action(servo, params) if action else (ErrorCode.INSTRUCTION, b"")


def answering(listeners: Sequence[VirtualServo]) -> dict[int, list[VirtualServo]]:
    """Servos that answer reads, by id."""
    found: dict[int, list[VirtualServo]] = {}
    for servo in listeners:
        if servo.memory.get("status_return_level") >= ANSWERS_READ:
            found.setdefault(servo.id, []).append(servo)
    return found


def fast_answers(requests: list[Request], able: Mapping[int, list[VirtualServo]]) -> list[bytes]:
    """The packet in which those asked answer together, ended before the first that is missing.

    Args:
        requests: Who is asked what.
        able: Servos that can answer so, by id.

    Returns:
        Nothing, one packet, or as many as there are servos with one id: they talk over each other.
    """
    expected = 8 + sum(length + 4 for _, _, length in requests)
    if expected > MAX_PACKET:
        return []
    columns = []
    for id, address, length in requests:
        if id not in able:
            break
        column = []
        for servo in able[id]:
            data, error = servo.read(address, length)
            column.append((servo.status_byte(error), id, data.ljust(length, b"\x00")))
        columns.append(column)
    deepest = max(map(len, columns), default=0)
    return [build_fast_status([c[min(k, len(c) - 1)] for c in columns], expected) for k in range(deepest)]
