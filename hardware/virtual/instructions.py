"""Parameters of the Protocol 2.0 instructions, and what one servo does with them.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0", Instruction Details.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from robot_ik.hardware.families.dynamixel_x_table import RETURN_READ
from robot_ik.hardware.virtual.protocol import (
    BROADCAST,
    MAX_PACKET,
    ErrorCode,
    Instruction,
    build_fast_status,
)
from robot_ik.hardware.virtual.servo import VirtualServo

ReadRequest = tuple[int, int, int]
"""(servo id, address, length) of one part of a sync or bulk read."""
WriteRequest = tuple[int, int, bytes]
"""(servo id, address, data) of one part of a sync or bulk write."""


def word(data: bytes, at: int) -> int:
    """Return two bytes as a little-endian number. Missing bytes count as 0."""
    return int.from_bytes(data[at : at + 2], "little")


def sync_requests(params: bytes) -> list[ReadRequest]:
    """Return the reads of a sync read."""
    address = word(params, 0)
    length = word(params, 2)
    return [(id, address, length) for id in params[4:]]


def bulk_requests(params: bytes) -> list[ReadRequest]:
    """Return the reads of a bulk read."""
    return [
        (params[k], word(params, k + 1), word(params, k + 3)) for k in range(0, len(params) - 4, 5)
    ]


def sync_writes(params: bytes) -> list[WriteRequest]:
    """Return the writes of a sync write; none if the lengths do not add up."""
    address = word(params, 0)
    length = word(params, 2)
    rest = params[4:]
    if length == 0 or len(rest) % (length + 1):
        return []
    return [
        (rest[k], address, rest[k + 1 : k + 1 + length]) for k in range(0, len(rest), length + 1)
    ]


def bulk_writes(params: bytes) -> list[WriteRequest]:
    """Return the writes of a bulk write. An incomplete part is left out."""
    writes = []
    at = 0
    while at + 5 <= len(params):
        length = word(params, at + 3)
        data = params[at + 5 : at + 5 + length]
        if len(data) == length:
            writes.append((params[at], word(params, at + 1), data))
        at += 5 + length
    return writes


READS: Mapping[int, Callable[[bytes], list[ReadRequest]]] = {
    Instruction.SYNC_READ: sync_requests,
    Instruction.FAST_SYNC_READ: sync_requests,
    Instruction.BULK_READ: bulk_requests,
    Instruction.FAST_BULK_READ: bulk_requests,
}
"""Read instruction -> parser of its parameters."""
WRITES: Mapping[int, Callable[[bytes], list[WriteRequest]]] = {
    Instruction.SYNC_WRITE: sync_writes,
    Instruction.BULK_WRITE: bulk_writes,
}
"""Write instruction -> parser of its parameters."""


def execute(
    servo: VirtualServo, instruction: int, params: bytes, to: int
) -> tuple[ErrorCode, bytes]:
    """Carry out an instruction on one servo and return error and data.

    Args:
        servo: Servo.
        instruction: Instruction byte.
        params: Parameters.
        to: Id in the packet: the servo's id, its Secondary ID or the broadcast id.
    """
    secondary = to == servo.secondary_id
    error = ErrorCode.NONE
    match instruction:
        case Instruction.PING:
            return error, servo.read(0, 2)[0] + servo.read(6, 1)[0]
        case Instruction.READ if len(params) == 4:
            data, error = servo.read(word(params, 0), word(params, 2))
            return error, data
        case Instruction.WRITE:
            error = servo.write(word(params, 0), params[2:], secondary=secondary)
        case Instruction.REG_WRITE:
            error = servo.reg_write(word(params, 0), params[2:], secondary=secondary)
        case Instruction.ACTION:
            error = servo.action()
        case Instruction.FACTORY_RESET if len(params) == 1:
            guarded = (
                to == BROADCAST and params == b"\xff" and "guarded_reset" in servo.table.abilities
            )
            error = (
                ErrorCode.RESULT_FAIL if guarded or secondary else servo.factory_reset(params[0])
            )
        case Instruction.READ | Instruction.FACTORY_RESET:
            error = ErrorCode.DATA_LENGTH
        case Instruction.REBOOT:
            servo.reboot()
        case Instruction.CLEAR:
            error = servo.clear(params)
        case Instruction.CONTROL_TABLE_BACKUP:
            error = ErrorCode.RESULT_FAIL if secondary else servo.control_table_backup(params)
        case _:
            error = ErrorCode.INSTRUCTION
    return error, b""


def responding(listeners: Sequence[VirtualServo]) -> dict[int, list[VirtualServo]]:
    """Return the servos that answer reads, by id."""
    servos: dict[int, list[VirtualServo]] = {}
    for servo in listeners:
        if servo.memory.values["status_return_level"] >= RETURN_READ:
            servos.setdefault(servo.id, []).append(servo)
    return servos


def fast_status_packets(
    requests: list[ReadRequest], servos: Mapping[int, list[VirtualServo]]
) -> list[bytes]:
    """Return the packets in which servos answer a fast read together.

    A packet ends before the first requested servo that does not answer.

    Args:
        requests: The parts of the fast read.
        servos: Id -> servos that answer.

    Returns:
        No packet, one packet, or one packet for each servo with the same id: these collide.
    """
    expected = 8 + sum(length + 4 for _, _, length in requests)
    if expected > MAX_PACKET:
        return []
    columns = []
    for id, address, length in requests:
        if id not in servos:
            break
        column = []
        for servo in servos[id]:
            data, error = servo.read(address, length)
            column.append((servo.status_byte(error), id, data.ljust(length, b"\x00")))
        columns.append(column)
    packet_count = max(map(len, columns), default=0)
    return [
        build_fast_status([c[min(k, len(c) - 1)] for c in columns], expected)
        for k in range(packet_count)
    ]
