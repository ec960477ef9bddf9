"""Protocol 2 as Dynamixel servos answer it: one instruction packet in, status packets out."""

from __future__ import annotations

import random
from collections.abc import Sequence

from robot_ik.hardware.families.dynamixel_x_table import RETURN_ALL, RETURN_READ
from robot_ik.hardware.virtual import instructions
from robot_ik.hardware.virtual.instructions import ReadRequest, fast_status_packets, responding
from robot_ik.hardware.virtual.protocol import (
    BROADCAST,
    ErrorCode,
    Instruction,
    Packet,
    Parser,
    build_status,
)
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.hardware.virtual.servo_side import Answer
from robot_ik.hardware.virtual.wire import collide

FAST_READS = (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)


class Protocol2Side:
    """Protocol 2 of virtual Dynamixel servos; implements ``ServoSide``."""

    name = "Protocol 2.0"

    def parser(self) -> Parser:
        return Parser()

    def execute(
        self, packet: Packet, listeners: Sequence[VirtualServo], rng: random.Random, /
    ) -> Answer:
        for servo in listeners:
            servo.hear()
        instruction = packet.instruction
        if not packet.valid:
            return self._execute_single(packet, listeners, rng)
        if instruction in instructions.READS:
            requests = instructions.READS[instruction](packet.params)
            read = self._read_fast if instruction in FAST_READS else self._read_many
            return read(requests, listeners, rng)
        if instruction in instructions.WRITES:
            self._write_many(packet, listeners)
            return Answer([], 0.0)
        if instruction == Instruction.STATUS:
            return Answer([], 0.0)
        return self._execute_single(packet, listeners, rng)

    def _write_many(self, packet: Packet, listeners: Sequence[VirtualServo]) -> None:
        orders = instructions.WRITES[packet.instruction](packet.params)
        for servo in listeners:
            primary = servo.id
            secondary = servo.secondary_id
            for id, address, data in orders:
                if id in (primary, secondary):
                    servo.write(address, data, secondary=id == secondary)

    def _execute_single(
        self, packet: Packet, listeners: Sequence[VirtualServo], rng: random.Random
    ) -> Answer:
        """Carry out an instruction to one servo, or to all."""
        broadcast = packet.id == BROADCAST
        ping = packet.instruction == Instruction.PING
        needed_level = RETURN_READ if packet.instruction == Instruction.READ else RETURN_ALL
        replies: dict[int, list[bytes]] = {}
        total_delay = 0.0
        for servo in sorted(listeners, key=lambda s: s.id):
            # The instruction may change all four.
            id = servo.id
            level = servo.memory.values["status_return_level"]
            alert = servo.status_byte(0)
            delay = servo.return_delay
            if not (broadcast or packet.id == id):
                if packet.valid and packet.id == servo.secondary_id:
                    instructions.execute(servo, packet.instruction, packet.params, packet.id)
                continue
            error = ErrorCode.CRC
            data = b""
            if packet.valid:
                error, data = instructions.execute(
                    servo, packet.instruction, packet.params, packet.id
                )
            if ping or (not broadcast and level >= needed_level):
                total_delay += delay
                status = build_status(id, error | alert | servo.status_byte(0), data)
                replies.setdefault(id, []).append(status)
        return Answer([_on_wire(packets, rng) for packets in replies.values()], total_delay)

    def _read_many(
        self, requests: list[ReadRequest], listeners: Sequence[VirtualServo], rng: random.Random
    ) -> Answer:
        """Return a status packet of each servo asked.  Missing servos send nothing."""
        replies = []
        delay = 0.0
        by_id = responding(listeners)
        for id, address, length in requests:
            packets = []
            for servo in by_id.get(id, ()):
                delay += servo.return_delay
                data, error = servo.read(address, length)
                packets.append(build_status(id, servo.status_byte(error), data))
            if packets:
                replies.append(_on_wire(packets, rng))
        return Answer(replies, delay)

    def _read_fast(
        self, requests: list[ReadRequest], listeners: Sequence[VirtualServo], rng: random.Random
    ) -> Answer:
        """Return one packet to which each servo adds; it ends before the first missing servo."""
        able = responding([s for s in listeners if "fast_read" in s.table.abilities])
        first = able.get(requests[0][0]) if requests else None
        delay = first[0].return_delay if first else 0.0
        packets = fast_status_packets(requests, able)
        return Answer([_on_wire(packets, rng)] if packets else [], delay)

    def shortened(self, packet: bytes, /) -> bytes:
        if packet[4] == BROADCAST:  # of a fast read
            return packet
        parsed = Parser().feed(packet, 0.0)
        if not parsed or not parsed[0].is_status:
            return packet
        status = parsed[0]
        return build_status(status.id, status.params[0], status.data[:-1])

    def refused(self, packet: bytes, rng: random.Random, /) -> bytes:
        id = packet[4]
        return packet if id == BROADCAST else build_status(id, rng.randrange(1, 8))

    def foreign(self, id: int, rng: random.Random, /) -> bytes:
        return build_status(id, 0, rng.randbytes(4))


def _on_wire(packets: list[bytes], rng: random.Random) -> bytes:
    return packets[0] if len(packets) == 1 else collide(packets, rng)
