"""The virtual bus: instruction packets in, status packets out, with virtual servos in between."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from itertools import zip_longest

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.faults import TICKS_PER_DEGREE, Faults, Wire
from robot_ik.hardware.virtual.protocol2 import (
    BROADCAST,
    MAX_PACKET,
    ErrorCode,
    Instruction,
    Packet,
    Parser,
    build_fast_status,
    build_status,
)
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import Clock

# What a servo answers at each Status Return Level: 0 ping only, 1 also reads, 2 everything.
_ANSWERS_READ, _ANSWERS_ALL = 1, 2

# (servo id, address, length) of one part of a sync or bulk read
_Request = tuple[int, int, int]


class VirtualBus:
    """Servos on one wire.  Safe to call from any thread.

    Args:
        servos: Ids may repeat, as they may by mistake on a real bus: answers then collide.
        clock: Tells when bytes arrive.
        faults: What is wrong from the start.
    """

    def __init__(self, servos: Iterable[VirtualServo], clock: Clock, faults: Faults | None = None) -> None:
        self.servos = tuple(servos)
        self.clock = clock
        self.lock = threading.RLock()
        self._built = {servo.id: servo for servo in self.servos}
        self._parser = Parser()
        self._single: dict[int, Callable[[VirtualServo, bytes], tuple[ErrorCode, bytes]]] = {
            Instruction.PING: _ping,
            Instruction.READ: _read,
            Instruction.WRITE: _write,
            Instruction.REG_WRITE: _reg_write,
            Instruction.ACTION: lambda servo, params: (servo.action(), b""),
            Instruction.FACTORY_RESET: _factory_reset,
            Instruction.REBOOT: _reboot,
            Instruction.CLEAR: lambda servo, params: (servo.clear(params), b""),
        }
        self.set_faults(faults or Faults())

    @classmethod
    def from_config(
        cls, config: ArmConfig, clock: Clock, start: ArrayLike | None = None, faults: Faults | None = None
    ) -> VirtualBus:
        """The servos an arm file names, set up as it says (id, model, mode, baud rate), without torque.

        Args:
            config: The arm.
            clock: Time of the servos.
            start: (n,) joint angles at first, rad; default 0, or the limit next to it.
            faults: What is wrong from the start.

        Raises:
            ConfigError: ``start`` has another shape or is not finite.
        """
        n = len(config.joints)
        q = np.zeros(n) if start is None else np.asarray(start, dtype=float)
        if q.shape != (n,) or not np.isfinite(q).all():
            raise ConfigError(
                f"start {q.tolist()} is no pose", file=config.file or config.name, allowed=f"{n} angles, rad"
            )
        q = np.clip(q, config.lower, config.upper)
        servos = [
            VirtualServo(
                joint.model,
                joint.id,
                clock,
                position_ticks=joint.to_ticks(float(angle)),
                mode=joint.mode,
                baud=config.baud,
            )
            for joint, angle in zip(config.joints, q, strict=True)
        ]
        return cls(servos, clock, faults)

    def servo(self, id: int) -> VirtualServo:
        """The servo that was put on the bus with this id.

        Raises:
            KeyError: There is none.
        """
        return self._built[id]

    def set_faults(self, faults: Faults) -> None:
        """Replaces all faults; ``Faults()`` heals everything but a shutdown, which wants a reboot.

        Raises:
            KeyError: A fault names an id that is not on the bus.
        """
        if missing := faults.servo_ids() - set(self._built):
            raise KeyError(f"no servo with id {sorted(missing)}; there are {sorted(self._built)}")
        with self.lock:
            self.faults = faults
            self._wire = Wire(faults)
            for id, servo in self._built.items():
                servo.zero_offset_ticks = faults.zero_offset_deg.get(id, 0.0) * TICKS_PER_DEGREE
                servo.stuck = id in faults.stuck
                servo.silent = id in faults.silent
                if id in faults.overload:
                    servo.inject_error("overload")

    def true_angles(self, config: ArmConfig) -> NDArray[np.float64]:
        """(n,) rad where the shafts really are, hidden offsets included: what a camera would see."""
        with self.lock:
            return np.array([j.to_radians(self._built[j.id].true_ticks) for j in config.joints])

    def handle(self, data: bytes, baud: int | None = None) -> bytes:
        """Takes bytes from the host, gives back what the servos send.

        Args:
            data: Any piece of any number of packets.
            baud: Bits/s of the host; servos set to another rate hear nothing.  ``None``: all hear.
        """
        with self.lock:
            replies = [data] if self.faults.echo else []
            for packet in self._parser.feed(data, self.clock.now()):
                listeners = [s for s in self.servos if not s.deaf and baud in (None, s.baud)]
                for servo in listeners:
                    servo.hear()
                replies += [self._wire.spoil(reply) for reply in self._answer(packet, listeners)]
            return b"".join(replies)

    # --------------------------------------------------------------- instructions

    def _answer(self, packet: Packet, listeners: Sequence[VirtualServo]) -> list[bytes]:
        """Status packets that a packet causes, in the order they go over the wire."""
        params = packet.params
        match packet.instruction if packet.valid else None:
            case Instruction.STATUS:
                return []
            case Instruction.SYNC_READ:
                return self._read_many(_sync_requests(params), listeners)
            case Instruction.BULK_READ:
                return self._read_many(_bulk_requests(params), listeners)
            case Instruction.FAST_SYNC_READ:
                return self._read_fast(_sync_requests(params), listeners)
            case Instruction.FAST_BULK_READ:
                return self._read_fast(_bulk_requests(params), listeners)
            case Instruction.SYNC_WRITE:
                writes = _sync_writes(params)
            case Instruction.BULK_WRITE:
                writes = _bulk_writes(params)
            case _:
                return self._execute(packet, listeners)
        for id, address, data in writes:
            for servo in listeners:
                if id in (servo.id, servo.memory.get("secondary_id")):
                    servo.write(address, data)
        return []

    def _execute(self, packet: Packet, listeners: Sequence[VirtualServo]) -> list[bytes]:
        """An instruction to one servo, or to all."""
        broadcast = packet.id == BROADCAST
        replies = []
        for servo in sorted(listeners, key=lambda s: s.id):
            id, level, alert = servo.id, servo.memory.get("status_return_level"), servo.status_byte(0)
            if not (broadcast or packet.id == id):
                if packet.valid and packet.id == servo.memory.get("secondary_id"):
                    self._do(servo, packet, broadcast=True)
                continue
            error, data = self._do(servo, packet, broadcast)
            ping, read = packet.instruction == Instruction.PING, packet.instruction == Instruction.READ
            if ping or (not broadcast and level >= (_ANSWERS_READ if read else _ANSWERS_ALL)):
                replies.append(build_status(id, error | alert | servo.status_byte(0), data))
        return replies if broadcast or len(replies) < 2 else [_collide(replies)]

    def _do(self, servo: VirtualServo, packet: Packet, broadcast: bool) -> tuple[ErrorCode, bytes]:
        if not packet.valid:
            return ErrorCode.CRC, b""
        if packet.instruction == Instruction.FACTORY_RESET and broadcast and packet.params == b"\xff":
            return ErrorCode.RESULT_FAIL, b""
        action = self._single.get(packet.instruction)
        return action(servo, packet.params) if action else (ErrorCode.INSTRUCTION, b"")

    def _read_many(self, requests: list[_Request], listeners: Sequence[VirtualServo]) -> list[bytes]:
        """A status packet from each servo asked; those that are missing leave a gap in time only."""
        replies = []
        for id, address, length in requests:
            answers = []
            for servo in _answering(id, listeners):
                data, error = servo.read(address, length)
                answers.append(build_status(id, servo.status_byte(error), data))
            replies += answers if len(answers) < 2 else [_collide(answers)]
        return replies

    def _read_fast(self, requests: list[_Request], listeners: Sequence[VirtualServo]) -> list[bytes]:
        """One status packet to which each servo adds; it ends before the first that is missing."""
        answers: list[tuple[int, int, bytes]] = []
        expected = 8 + sum(length + 4 for _, _, length in requests)
        for id, address, length in requests if expected <= MAX_PACKET else []:
            servos = _answering(id, listeners)
            if not servos:
                break
            data, error = servos[0].read(address, length)
            answers.append((servos[0].status_byte(error), id, data.ljust(length, b"\x00")))
        return [build_fast_status(answers, expected)] if answers else []


def _answering(id: int, listeners: Sequence[VirtualServo]) -> list[VirtualServo]:
    return [s for s in listeners if s.id == id and s.memory.get("status_return_level") >= _ANSWERS_READ]


def _collide(replies: Sequence[bytes]) -> bytes:
    """Servos that talk at once: a line pulled low by one is low (equal answers cannot be told from one)."""
    columns = zip_longest(*replies, fillvalue=0xFF)
    overlaid = bytearray()
    for column in columns:
        byte = 0xFF
        for value in column:
            byte &= value
        overlaid.append(byte)
    return bytes(overlaid)


def _word(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 2], "little")


def _sync_requests(params: bytes) -> list[_Request]:
    return [(id, _word(params, 0), _word(params, 2)) for id in params[4:]]


def _bulk_requests(params: bytes) -> list[_Request]:
    return [(params[k], _word(params, k + 1), _word(params, k + 3)) for k in range(0, len(params) - 4, 5)]


def _sync_writes(params: bytes) -> list[tuple[int, int, bytes]]:
    """(id, address, data) of each servo; nothing at all if the lengths do not add up."""
    address, length, rest = _word(params, 0), _word(params, 2), params[4:]
    if length == 0 or len(rest) % (length + 1):
        return []
    return [(rest[k], address, rest[k + 1 : k + 1 + length]) for k in range(0, len(rest), length + 1)]


def _bulk_writes(params: bytes) -> list[tuple[int, int, bytes]]:
    found, at = [], 0
    while at + 5 <= len(params):
        length = _word(params, at + 3)
        data = params[at + 5 : at + 5 + length]
        if len(data) == length:
            found.append((params[at], _word(params, at + 1), data))
        at += 5 + length
    return found


def _ping(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    data, _ = servo.read(0, 2)
    firmware, _ = servo.read(6, 1)
    return ErrorCode.NONE, data + firmware


def _read(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    if len(params) != 4:
        return ErrorCode.DATA_LENGTH, b""
    data, error = servo.read(_word(params, 0), _word(params, 2))
    return error, data


def _write(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    return servo.write(_word(params, 0), params[2:]), b""


def _reg_write(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    return servo.reg_write(_word(params, 0), params[2:]), b""


def _factory_reset(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    return (servo.factory_reset(params[0]) if len(params) == 1 else ErrorCode.DATA_LENGTH), b""


def _reboot(servo: VirtualServo, params: bytes) -> tuple[ErrorCode, bytes]:
    servo.reboot()
    return ErrorCode.NONE, b""
