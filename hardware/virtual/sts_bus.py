"""A virtual Protocol 1 bus: instruction bytes in, status bytes out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.hardware.virtual.bus import start_values
from robot_ik.hardware.virtual.protocol1 import (
    BROADCAST,
    Instruction,
    InstructionPacket,
    InstructionParser,
    build_status,
)
from robot_ik.hardware.virtual.sts3215 import VirtualSts3215
from robot_ik.hardware.virtual.wire import VirtualWire, WireSchedule
from robot_ik.ports import Array, Clock
from robot_ik.reading import WrongKey

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.faults import Fault


TICKS_PER_DEGREE = 4096 / 360

MODELLED_FAULTS = ("zero_offset", "jammed", "stuck", "silent")
"""Kinds of faults that the virtual STS servos know.  Wire faults: ``VirtualStsBus.wire``."""


class VirtualStsBus:
    """STS servos on one wire.  Safe to call from any thread.

    Args:
        servos: Servos on the wire.
        clock: Gives the times at which bytes arrive.
        seed: Seed of the random wire faults.
    """

    def __init__(self, servos: Iterable[VirtualSts3215], clock: Clock, seed: int = 0) -> None:
        self.servos = tuple(servos)
        self.clock = clock
        self.lock = threading.RLock()
        self.world: Any = None
        self.echo = False
        self.unplugged = False
        self.latency = 0.0
        self.schedule = WireSchedule(clock)
        self.wire = VirtualWire((servo.id for servo in self.servos), seed)
        self._named: dict[int | str, VirtualSts3215] = {servo.id: servo for servo in self.servos}
        self._parser = InstructionParser()
        self._wakers: list[Callable[[], None]] = []

    @classmethod
    def from_config(
        cls, config: ArmConfig, clock: Clock, start: ArrayLike | Mapping[str, float] | None = None
    ) -> VirtualStsBus:
        """Return the servos of an arm file, without torque.

        Args:
            config: Arm file.
            clock: Clock of the servos.
            start: As for ``start_values``.
        """
        values = start_values(config, start)
        servos = []
        for joint, servo in config.drives:
            ticks = joint.nearest_ticks(values[joint.name], servo)
            servos.append(VirtualSts3215(servo.id, clock, position_ticks=ticks, baud=config.baud))
        bus = cls(servos, clock)
        bus._named |= {joint.name: bus.servo(joint.servo.id) for joint in config.joints}
        return bus

    def servo(self, key: int | str) -> VirtualSts3215:
        """Return the servo of an id or a joint name."""
        return self._named[key]

    def inject(self, *faults: Fault) -> None:
        """Let faults happen now.

        Raises:
            ConfigError: This family does not model the fault.
        """
        with self.lock:
            for fault in faults:
                servos = self.servos if fault.id is None else (self.servo(fault.id),)
                for servo in servos:
                    self._inject_one(fault, servo)

    def _inject_one(self, fault: Fault, servo: VirtualSts3215) -> None:
        match fault.kind:
            case "zero_offset":
                servo.zero_offset_ticks = (fault.value or 0.0) * TICKS_PER_DEGREE
            case "jammed" | "stuck":
                servo.jammed = True
            case "silent":
                servo.silent = True
            case _:
                raise WrongKey.unknown("fault", fault.kind, MODELLED_FAULTS, "kind").in_file(
                    "faults"
                )

    def true_angles(self, config: ArmConfig) -> Array:
        """Return the (n,) true joint angles in rad."""
        with self.lock:
            return np.array(
                [joint.value(self._named[joint.servo.id].true_ticks) for joint in config.joints]
            )

    def when_changed(self, wake: Callable[[], None]) -> None:
        """Call ``wake`` after faults change."""
        self._wakers.append(wake)

    def advance(self) -> None:
        """Bring scheduled events up to now."""
        with self.lock:
            self.schedule.run()

    def handle(self, data: bytes, baud: int | None = None) -> bytes:
        """Return the reply bytes."""
        return self.respond(data, baud)[0]

    def respond(self, data: bytes, baud: int | None = None) -> tuple[bytes, float]:
        """Return the reply bytes and the seconds that the servos waited before them.

        Args:
            data: Bytes from the host; any part of any number of packets.
            baud: bit/s of the host.  Servos with another rate do not hear it.  None: every servo
                hears.
        """
        with self.lock:
            self.advance()
            replies = [data] if self.echo else []
            delay = 0.0
            for packet in self._parser.feed(data, self.clock.now()):
                self.schedule.count()
                listeners = [s for s in self.servos if not s.silent and baud in (None, s.baud)]
                statuses = self._execute(packet, listeners)
                delay += sum(servo.return_delay for servo, _ in statuses)
                replies += self.wire.carry([status for _, status in statuses], self.clock.now())
            return b"".join(replies), delay + (self.latency if replies else 0.0)

    def _execute(
        self, packet: InstructionPacket, listeners: list[VirtualSts3215]
    ) -> list[tuple[VirtualSts3215, bytes]]:
        """Return the servo and its status packet, in the order on the wire."""
        params = packet.params
        if packet.instruction == Instruction.SYNC_READ:
            return self._sync_read(params, listeners)
        if packet.instruction == Instruction.SYNC_WRITE:
            self._sync_write(params, listeners)
            return []
        statuses = []
        for servo in sorted(listeners, key=lambda s: s.id):
            if packet.id not in (servo.id, BROADCAST):
                continue
            id = servo.id
            data = self._execute_one(servo, packet)
            pings = packet.instruction == Instruction.PING
            reads = packet.instruction == Instruction.READ
            answers = pings or (packet.id != BROADCAST and (reads or servo.answers_writes))
            if answers:
                statuses.append((servo, build_status(id, servo.status(), data)))
        return statuses

    def _execute_one(self, servo: VirtualSts3215, packet: InstructionPacket) -> bytes:
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
                servo.power_cycle()
        return b""

    def _sync_read(
        self, params: bytes, listeners: list[VirtualSts3215]
    ) -> list[tuple[VirtualSts3215, bytes]]:
        if len(params) < 3:
            return []
        address = params[0]
        length = params[1]
        by_id = {servo.id: servo for servo in listeners}
        return [
            (by_id[id], build_status(id, by_id[id].status(), by_id[id].read(address, length)))
            for id in params[2:]
            if id in by_id
        ]

    def _sync_write(self, params: bytes, listeners: list[VirtualSts3215]) -> None:
        address = params[0]
        length = params[1]
        by_id = {servo.id: servo for servo in listeners}
        for at in range(2, len(params) - length, length + 1):
            servo = by_id.get(params[at])
            if servo is not None:
                servo.write(address, params[at + 1 : at + 1 + length])
