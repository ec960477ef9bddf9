"""Protocol 1 as Feetech STS servos answer it: one instruction packet in, status packets out."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence

from robot_ik.hardware.virtual.protocol1 import (
    BROADCAST,
    SHORTEST_PACKET,
    Instruction,
    InstructionPacket,
    InstructionParser,
    build_status,
)
from robot_ik.hardware.virtual.servo_side import Answer
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.hardware.virtual.wire import collide

ERROR_BITS = 6
"""Bits of the error byte that a servo can set."""


class Protocol1Side:
    """Protocol 1 of virtual Feetech servos; implements ``ServoSide``."""

    name = "Protocol 1.0"

    def parser(self) -> InstructionParser:
        return InstructionParser()

    def execute(
        self, packet: InstructionPacket, listeners: Sequence[VirtualSts3215], rng: random.Random, /
    ) -> Answer:
        params = packet.params
        if packet.instruction == Instruction.SYNC_READ:
            return self._sync_read(params, listeners, rng)
        if packet.instruction == Instruction.SYNC_WRITE:
            self._sync_write(params, listeners)
            return Answer([], 0.0)
        replies: dict[int, list[bytes]] = {}
        delay = 0.0
        for servo in sorted(listeners, key=lambda s: s.id):
            if packet.id not in (servo.id, BROADCAST):
                continue
            id = servo.id  # the instruction may change it
            data = self._execute_single(servo, packet)
            if self._is_answered(servo, packet):
                delay += servo.return_delay
                replies.setdefault(id, []).append(build_status(id, servo.status(), data))
        return Answer([_on_wire(packets, rng) for packets in replies.values()], delay)

    def _is_answered(self, servo: VirtualSts3215, packet: InstructionPacket) -> bool:
        if packet.instruction == Instruction.PING:
            return True
        if packet.id == BROADCAST:
            return False
        return packet.instruction == Instruction.READ or servo.answers_writes

    def _execute_single(self, servo: VirtualSts3215, packet: InstructionPacket) -> bytes:
        """Carry out an instruction and return the data of the status packet."""
        params = packet.params
        match packet.instruction:
            case Instruction.READ if len(params) == 2:
                return servo.read(params[0], params[1])
            case Instruction.WRITE if len(params) >= 2:
                servo.write(params[0], params[1:])
            case Instruction.REG_WRITE if len(params) >= 2:
                servo.register_write(params[0], params[1:])
            case Instruction.ACTION:
                servo.action()
            case Instruction.RECOVER:
                servo.restore_factory_values()
            case Instruction.REBOOT:
                servo.reboot()
        return b""

    def _sync_read(
        self, params: bytes, listeners: Sequence[VirtualSts3215], rng: random.Random
    ) -> Answer:
        if len(params) < 3:
            return Answer([], 0.0)
        address = params[0]
        length = params[1]
        by_id = _by_id(listeners)
        replies = []
        delay = 0.0
        for id in params[2:]:
            packets = []
            for servo in by_id.get(id, ()):
                delay += servo.return_delay
                packets.append(build_status(id, servo.status(), servo.read(address, length)))
            if packets:
                replies.append(_on_wire(packets, rng))
        return Answer(replies, delay)

    def _sync_write(self, params: bytes, listeners: Sequence[VirtualSts3215]) -> None:
        if len(params) < 2:
            return
        address = params[0]
        length = params[1]
        by_id = _by_id(listeners)
        for start in range(2, len(params) - length, length + 1):
            for servo in by_id.get(params[start], ()):
                servo.write(address, params[start + 1 : start + 1 + length])

    def shortened(self, packet: bytes, /) -> bytes:
        if len(packet) <= SHORTEST_PACKET or len(packet) != packet[3] + 4:
            return packet
        return build_status(packet[2], packet[4], packet[5:-2])

    def refused(self, packet: bytes, rng: random.Random, /) -> bytes:
        """Return a status packet with error bits and without data."""
        return build_status(packet[2], 1 << rng.randrange(ERROR_BITS))

    def foreign(self, id: int, rng: random.Random, /) -> bytes:
        return build_status(id, 0, rng.randbytes(4))


def _by_id(servos: Sequence[VirtualSts3215]) -> Mapping[int, list[VirtualSts3215]]:
    groups: dict[int, list[VirtualSts3215]] = {}
    for servo in servos:
        groups.setdefault(servo.id, []).append(servo)
    return groups


def _on_wire(packets: list[bytes], rng: random.Random) -> bytes:
    return packets[0] if len(packets) == 1 else collide(packets, rng)
