"""How many late replies are taken for values: a bus on virtual time, a quarter of its requests answered late.

    python docs/make/measure_late_replies.py                5,000 values and more, a line for each lateness
    python docs/make/measure_late_replies.py --values 500   fewer

Six simulated servos hold other numbers in their registers before every call.  A value that is not what its
register held during the call is wrong.  A refused read is one without a value: the program learns that it
has none.  A late request is answered late by all its servos or by one of them, by chance, and a later request
may be answered before it.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from robot_ik.errors import HardwareError
from robot_ik.hardware.dynamixel import DynamixelBus
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.registers import Register
from robot_ik.hardware.serial_port import LONGEST_DRAIN, SleepingPortHandler
from robot_ik.hardware.simulated import InProcessPort
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.servo import VirtualServo
from robot_ik.ports import VirtualClock

IDS = tuple(range(1, 7))
BAUD = 1_000_000
PERIOD = 0.01
"""s between two calls of every other pair; the others follow at once, as while an arm is connected."""
LATE_SHARE = 0.25
LATENESS_MS = ((40, 40), (60, 60), (80, 80), (120, 120), (150, 150), (34, 150))
"""Shortest and longest lateness of a row of the table."""

MODEL = "XM430-W350"
TABLE = X_TABLES[MODEL]
GOAL = TABLE["goal_position"]
NAMES = ("goal_position", "profile_velocity", "profile_acceleration", "goal_current", "led")
"""Registers of one, two and four bytes: questions of one length are most easily mistaken."""
HEADER = b"\xff\xff\xfd\x00"


class LatePort(InProcessPort):
    """Waits as a serial port does, on the servos' clock; some replies are late.

    Args:
        bus: The servos.
        lateness: Gives the lateness of the next request's replies, s, one for each status packet.
    """

    def __init__(self, bus: DynamixelBus, servos: VirtualBus, lateness: Callable[[int], list[float]]) -> None:
        super().__init__(servos, "late", bus.baud, bus.counters)
        self.seconds_per_byte = 10.0 / bus.baud
        self._clock = servos.clock
        self._lateness = lateness
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
        before, self._buffer = self._buffer, b""
        super().writePort(packet)
        replies, self._buffer = self._buffer.split(HEADER)[1:], before
        at = self._clock.now()
        for reply, late in zip(replies, self._lateness(len(replies)), strict=True):
            at += (len(HEADER) + len(reply)) * self.seconds_per_byte
            self._coming.append((at + late, HEADER + reply))
        return len(packet)

    def receive(self, deadline: float, expected: float | None = None) -> bytes:
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
    servos: VirtualBus, rng: random.Random, lateness_ms: tuple[float, float], share: float = LATE_SHARE
) -> DynamixelBus:
    """The driver of real servos on these, on their clock, with a share of the requests answered late."""

    def lateness(packets: int) -> list[float]:
        late = 1e-3 * rng.uniform(*lateness_ms) if rng.random() < share else 0.0
        one = rng.randrange(packets) if packets and rng.random() < 0.5 else None
        return [late if one in (None, k) else 0.0 for k in range(packets)]

    class LateBus(DynamixelBus):
        def _make_handler(self) -> LatePort:
            return LatePort(self, servos, lateness)

    return LateBus("late", BAUD, clock=servos.clock)


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


def measure(values: int, lateness_ms: tuple[float, float], seed: int = 0) -> LateReplies:
    """Reads of one servo and of many, writes and control cycles in turn, until so many values have come."""
    rng = random.Random(seed)
    clock = VirtualClock()
    servos = VirtualBus([VirtualServo(MODEL, id, clock) for id in IDS], clock)
    bus = late_bus(servos, rng, lateness_ms)
    bus.open()
    bus.use_fast_reads(IDS)
    found = LateReplies()
    while found.values < values:
        clock.sleep_until(clock.now() + rng.choice((0.0, PERIOD)))
        for servo in servos.servos:
            for name in NAMES:
                servo.memory.set(name, rng.randrange(2 if TABLE[name].size == 1 else 30_000))
        found.take(*_call(bus, servos, rng))
    bus.close()
    return found


def _call(
    bus: DynamixelBus, servos: VirtualBus, rng: random.Random
) -> tuple[dict[int, int], dict[int, int | None]]:
    """One call, by chance: servo id -> what its register held, and what the bus said."""
    name = rng.choice(NAMES)
    register: Register = TABLE[name]
    ids: Iterable[int] = IDS
    kind = rng.choice(("read", "write", "sync_read", "sync_read", "exchange", "exchange"))
    right = {servo.id: servo.memory.values[name] for servo in servos.servos}
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
        reads = {id: TABLE["goal_position" if id == turn else name] for id in IDS}
        right = {s.id: s.memory.values[reads[s.id].name] for s in servos.servos}
        statuses = bus.exchange(TABLE["goal_velocity"], {}, reads, within=PERIOD)
        said = {id: status.data for id, status in statuses.items()}
    return right, {id: said[id] for id in ids}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--values", type=int, default=5000, help="values of each line")
    options = parser.parse_args()
    table = Table("lateness, ms", "values", "wrong values", "refused reads")
    total = 0
    for lateness_ms in LATENESS_MS:
        found = measure(options.values, lateness_ms)
        total += found.wrong
        row = (found.values, found.wrong, found.refused)
        table.add_row("{} to {}".format(*lateness_ms), *(f"{number:,}" for number in row))
    Console().print(table)
    raise SystemExit(total > 0)


if __name__ == "__main__":
    main()
