"""Count the late replies that are taken for values, on a bus in virtual time.

    python docs/make/measure_late_replies.py                5,000 values and more for each case
    python docs/make/measure_late_replies.py --values 500   fewer

Six simulated servos have other numbers in their registers before every call.  A quarter of the
requests is answered late.  A value that is not what its register held during the call is wrong.  A
refused read has no value: the program learns that it has none.  A late request is answered late by
all its servos or by one of them, by chance, and a later request may be answered before it.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from robot_ik.errors import HardwareError
from robot_ik.hardware.family import family_of
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import ControlTable
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.serial_port import LONGEST_DRAIN, SleepingPortHandler
from robot_ik.hardware.simulated import InProcessPort
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.families import VIRTUAL_FAMILIES
from robot_ik.ports import VirtualClock

IDS = tuple(range(1, 7))
BAUD = 1_000_000
PERIOD = 0.01
"""s between two calls of every other pair.

The others follow at once, as while an arm is connected.
"""
LATE_SHARE = 0.25
"""Share of the requests that are answered late."""

LATENESS_MS = ((40, 40), (60, 60), (80, 80), (120, 120), (150, 150), (34, 150))
"""Shortest and longest lateness of a row of the table."""


@dataclass(frozen=True)
class Case:
    """Servos of one family whose replies come late.

    Attributes:
        family: Name of the family.
        model: Servo model.
        names: Registers of different sizes.  Questions of one length are most easily mistaken.
        written: Register that is written in a control cycle.
    """

    family: str
    model: str
    names: tuple[str, ...]
    written: str

    @property
    def table(self) -> ControlTable:
        """Control table of the model."""
        return control_table(self.model)

    def replies(self, data: bytes) -> list[bytes]:
        """Return the status packets in the bytes of several servos."""
        if self.family == "dynamixel_x":
            return [HEADER_2 + reply for reply in data.split(HEADER_2)[1:]]
        packets = []
        while data:
            size = 4 + data[3]  # header, id, length; the length counts what follows it
            packets.append(data[:size])
            data = data[size:]
        return packets

    def set(self, servo: Any, name: str, value: int) -> None:
        """Put a value into a register of a simulated servo, without the bus."""
        if self.family == "dynamixel_x":
            servo.memory.set(name, value)
        else:
            servo.values[name] = value

    def get(self, servo: Any, name: str) -> int:
        """Return what a register of a simulated servo holds."""
        values = servo.memory.values if self.family == "dynamixel_x" else servo.values
        return int(values[name])


HEADER_2 = b"\xff\xff\xfd\x00"
"""Header of a Protocol 2 packet."""

CASES = (
    Case(
        "dynamixel_x",
        "XM430-W350",
        ("goal_position", "profile_velocity", "profile_acceleration", "goal_current", "led"),
        "goal_velocity",
    ),
    Case(
        "feetech_sts",
        "STS3215",
        ("goal_time", "torque_limit", "minimum_startup_force", "acceleration", "position_p_gain"),
        "goal_velocity",
    ),
)


class LatePort(InProcessPort):
    """Waits as a serial port does, on the servos' clock; some replies are late.

    Args:
        bus: The servos.
        lateness: Gives the lateness of the next request's replies, s, one for each status packet.
    """

    def __init__(
        self,
        bus: SerialBus,
        servos: VirtualBus,
        lateness: Callable[[int], list[float]],
        case: Case,
    ) -> None:
        super().__init__(servos, "late", bus.baud, bus.counters)
        self.seconds_per_byte = 10.0 / bus.baud
        self._clock = servos.clock
        self._lateness = lateness
        self._case = case
        self._coming: list[tuple[float, bytes]] = []

    def _wait_until(self, time: float) -> None:
        """Until then, or until the next bytes come in; they are put into the buffer."""
        arrivals = [arrival for arrival, _ in self._coming]
        if not self._buffer:
            self._clock.sleep_until(min([time, *arrivals]))
        now = self._clock.now()
        self._buffer += b"".join(data for arrival, data in sorted(self._coming) if arrival <= now)
        self._coming = [row for row in self._coming if row[0] > now]

    def getCurrentTime(self) -> float:
        return 1000.0 * self._clock.now()

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        self._clock.sleep_until(self._clock.now() + len(packet) * self.seconds_per_byte)
        before = self._buffer
        self._buffer = b""
        super().writePort(packet)
        replies = self._case.replies(self._buffer)
        self._buffer = before
        at = self._clock.now()
        for reply, late in zip(replies, self._lateness(len(replies)), strict=True):
            at += len(reply) * self.seconds_per_byte
            self._coming.append((at + late, reply))
        return len(packet)

    def receive(self, deadline: float, _expected: float | None = None) -> bytes:
        self._wait_until(deadline)
        return super().readPort(len(self._buffer))

    def readPort(self, length: int) -> bytes:
        if length <= 0:
            return b""
        left = (self.packet_timeout - self.getTimeSinceStart()) / 1000.0
        self._wait_until(self._clock.now() + max(left, 0.0) + 1e-6)
        return super().readPort(length)

    def clear(self) -> None:
        self._wait_until(self._clock.now())
        self._buffer = b""

    clearPort = clear

    def drain(self, quiet: float) -> None:
        end = self._clock.now() + LONGEST_DRAIN
        while (now := self._clock.now()) < end and self.receive(now + quiet):
            pass

    setPacketTimeout = SleepingPortHandler.setPacketTimeout
    setPacketTimeoutMillis = SleepingPortHandler.setPacketTimeoutMillis
    isPacketTimeout = SleepingPortHandler.isPacketTimeout


def late_bus(
    servos: VirtualBus,
    rng: random.Random,
    lateness_ms: tuple[float, float],
    share: float = LATE_SHARE,
    case: Case | None = None,
) -> SerialBus:
    """Return the driver of real servos on simulated ones, with a share of late replies."""

    def lateness(packets: int) -> list[float]:
        late = 1e-3 * rng.uniform(*lateness_ms) if rng.random() < share else 0.0
        one = rng.randrange(packets) if packets and rng.random() < 0.5 else None
        return [late if one in (None, k) else 0.0 for k in range(packets)]

    class LateBus(SerialBus):
        def _make_handler(self) -> LatePort:
            return LatePort(self, servos, lateness, case or CASES[0])

    return LateBus("late", BAUD, family_of((case or CASES[0]).family).protocol, clock=servos.clock)


@dataclass
class LateReplies:
    """What came of reads: values, those of them that are wrong, and reads without a value."""

    values: int = 0
    wrong: int = 0
    refused: int = 0

    def take(self, right: dict[int, int], said: dict[int, int | None]) -> None:
        """Servo id -> what its register held, and what the bus said."""
        for id, value in said.items():
            self.values += value is not None
            self.refused += value is None
            self.wrong += value not in (None, right[id])


def measure(
    values: int, lateness_ms: tuple[float, float], seed: int = 0, case: Case = CASES[0]
) -> LateReplies:
    """Read, write and run control cycles in turn until enough values have come.

    Args:
        values: How many.
        lateness_ms: Shortest and longest lateness.
        seed: Of the random calls and delays.
        case: Servos.
    """
    rng = random.Random(seed)
    clock = VirtualClock()
    another = VIRTUAL_FAMILIES[case.family].another
    servos = VirtualBus([another(case.model, id, clock, BAUD) for id in IDS], clock)
    bus = late_bus(servos, rng, lateness_ms, case=case)
    bus.open()
    bus.use_fast_reads(IDS)
    found = LateReplies()
    while found.values < values:
        clock.sleep_until(clock.now() + rng.choice((0.0, PERIOD)))
        for servo in servos.servos:
            for name in case.names:
                case.set(servo, name, rng.randrange(2 if case.table[name].size == 1 else 1000))
        found.take(*_call(bus, servos, rng, case))
    bus.close()
    return found


def _call(
    bus: SerialBus, servos: VirtualBus, rng: random.Random, case: Case
) -> tuple[dict[int, int], dict[int, int | None]]:
    """One call, by chance: servo id -> what its register held, and what the bus said."""
    name = rng.choice(case.names)
    register = case.table[name]
    ids: Iterable[int] = IDS
    kind = rng.choice(("read", "write", "sync_read", "sync_read", "exchange", "exchange"))
    right = {servo.id: case.get(servo, name) for servo in servos.servos}
    said: dict[int, int | None]
    if kind in ("read", "write"):
        id = rng.choice(IDS)
        ids = (id,)
        said = {}
        try:
            if kind == "write":
                right[id] = rng.randrange(2)
                bus.write(id, register, right[id])
            said[id] = bus.read(id, register).data
        except HardwareError:
            said[id] = None
    elif kind == "sync_read":
        said = {id: status.data for id, status in bus.sync_read(IDS, register).items()}
    else:
        turn = rng.choice(IDS)
        # A Protocol 1 bus reads the same register of every servo in one request.
        other = name if bus.protocol.uniform_group_reads else case.names[0]
        reads = {id: case.table[other if id == turn else name] for id in IDS}
        right = {s.id: case.get(s, reads[s.id].name) for s in servos.servos}
        statuses = bus.exchange(case.table[case.written], {}, reads, within=PERIOD)
        said = {id: status.data for id, status in statuses.items()}
    return right, {id: said[id] for id in ids}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--values", type=int, default=5000, help="values of each line")
    options = parser.parse_args()
    table = Table("servos", "lateness, ms", "values", "wrong values", "refused reads")
    total = 0
    for case in CASES:
        for lateness_ms in LATENESS_MS:
            found = measure(options.values, lateness_ms, case=case)
            total += found.wrong
            row = (found.values, found.wrong, found.refused)
            span = "{} to {}".format(*lateness_ms)
            table.add_row(case.model, span, *(f"{number:,}" for number in row))
    Console().print(table)
    raise SystemExit(total > 0)


if __name__ == "__main__":
    main()
