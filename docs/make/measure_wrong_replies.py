"""How many wrong replies become values: late, short, foreign and damaged ones, on both protocols.

    python docs/make/measure_wrong_replies.py                    100,000 values per protocol
    python docs/make/measure_wrong_replies.py --values 5000      fewer

A bus drives six simulated servos on virtual time. Their registers hold other numbers before every
call. A share of the status packets is late, short, foreign, damaged, lost, doubled or out of order.
A value is wrong if its register did not hold it during the call. A read without a value is not
wrong: the program learns that it has none.

The two copies of a doubled reply arrive together, in time or late, as an adapter delivers them. A
copy that arrives while the next request is sent is not covered: on a half-duplex wire it would
collide with that request.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

from robot_ik.errors import HardwareError
from robot_ik.hardware.family import FAMILY_MODULES, family_of
from robot_ik.hardware.models import control_table
from robot_ik.hardware.registers import ControlTable
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.serial_port import LONGEST_DRAIN, SleepingPortHandler
from robot_ik.hardware.simulated import InProcessPort
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.families import VIRTUAL_FAMILIES
from robot_ik.hardware.virtual.wire import SPOILS
from robot_ik.ports import VirtualClock

IDS = tuple(range(1, 7))
BAUD = 1_000_000

PERIOD = 0.01
"""s between two calls of every other pair. The others follow at once."""

LATE_SHARE = 0.1
"""Share of the requests that are answered late."""

LATENESS = (0.002, 0.15)
"""Shortest and longest lateness, s. The bus guards against replies that are up to 0.16 s late."""

SPOIL_SHARE = 0.02
"""Share of the status packets that are spoilt, for each way of spoiling."""

EXCLUDED = ("late",)
"""Ways of spoiling that are not used: the port itself makes replies late."""

MODELS = {"dynamixel_x": "XM430-W350", "feetech_sts": "STS3215"}
"""Servo family -> model that is measured."""

NAMES = {
    "dynamixel_x": (
        "goal_position",
        "profile_velocity",
        "profile_acceleration",
        "goal_current",
        "led",
    ),
    "feetech_sts": ("goal_position", "goal_velocity", "goal_time", "torque_limit", "acceleration"),
}
"""Servo family -> registers of different and equal lengths.

A reply to a question of the same length is the one that is most easily mistaken.
"""

BYTE_LIMIT = 2
"""Registers of one byte hold numbers below this."""

WORD_LIMIT = 1000
"""Longer registers hold numbers below this."""


class WrongPort(InProcessPort):
    """Waits as a serial port does, on the servos' clock. Some replies are late.

    Args:
        bus: Driver.
        servos: Virtual bus.
        rng: Decides which replies are late.
    """

    def __init__(self, bus: SerialBus, servos: VirtualBus, rng: random.Random) -> None:
        super().__init__(servos, "wrong", bus.baud, bus.counters)
        self.seconds_per_byte = 10.0 / bus.baud
        self._servos = servos
        self._clock = servos.clock
        self._rng = rng
        self._coming: list[tuple[float, bytes]] = []
        self._packets: list[bytes] = []
        self._carry = servos.wire.carry
        servos.wire.carry = self._note_packets  # type: ignore[method-assign]

    def _note_packets(self, packets: list[bytes], now: float) -> list[bytes]:
        self._packets = self._carry(packets, now)
        return self._packets

    def _wait_until(self, time: float) -> None:
        """Wait until ``time`` or the next bytes. Put what has come into the buffer."""
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
        self._packets = []
        super().writePort(packet)
        self._buffer = before
        late = self._rng.uniform(*LATENESS) if self._rng.random() < LATE_SHARE else 0.0
        only = self._rng.randrange(len(self._packets) or 1) if self._rng.random() < 0.5 else None
        at = self._clock.now()
        for number, reply in enumerate(self._packets):
            at += len(reply) * self.seconds_per_byte
            self._coming.append((at + (late if only in (None, number) else 0.0), reply))
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


class WrongBus(SerialBus):
    """The driver of real servos on virtual ones that answer wrongly."""

    def __init__(self, servos: VirtualBus, family: str, rng: random.Random) -> None:
        super().__init__("wrong", BAUD, family_of(family).protocol, clock=servos.clock)
        self._servos = servos
        self._rng = rng

    def _make_handler(self) -> WrongPort:
        return WrongPort(self, self._servos, self._rng)


@dataclass
class WrongReplies:
    """What came of the reads.

    Attributes:
        values: Number of values.
        wrong: Number of wrong values.
        refused: Number of reads without a value.
        examples: Text of the first wrong values.
    """

    values: int = 0
    wrong: int = 0
    refused: int = 0
    examples: list[str] = field(default_factory=list)

    def take(self, what: str, right: Mapping[int, int], read: Mapping[int, int | None]) -> None:
        """Count the values of one call: servo id -> what its register held, and what was read."""
        for id, value in read.items():
            self.values += value is not None
            self.refused += value is None
            if value not in (None, right[id]):
                self.wrong += 1
                self.examples.append(f"{what} of {id}: {value}, not {right[id]}")


def measure(family: str, values: int, seed: int = 0) -> WrongReplies:
    """Read servos and groups, write, and run control cycles until enough values have come."""
    rng = random.Random(seed)
    clock = VirtualClock()
    model = MODELS[family]
    another = VIRTUAL_FAMILIES[family].another
    servos = VirtualBus([another(model, id, clock, BAUD) for id in IDS], clock, seed)
    bus = WrongBus(servos, family, rng)
    bus.open()
    bus.use_fast_reads(IDS)
    for name in SPOILS:
        servos.wire.chances[name] = 0.0 if name in EXCLUDED else SPOIL_SHARE
    table = control_table(model)
    result = WrongReplies()
    while result.values < values:
        clock.sleep_until(clock.now() + rng.choice((0.0, PERIOD)))
        for servo in servos.servos:
            for name in NAMES[family]:
                limit = BYTE_LIMIT if table[name].size == 1 else WORD_LIMIT
                servo.set_register(name, rng.randrange(limit))
        result.take(*_call(bus, servos, table, rng))
    bus.close()
    return result


def _call(
    bus: WrongBus, servos: VirtualBus, table: ControlTable, rng: random.Random
) -> tuple[str, dict[int, int], dict[int, int | None]]:
    """Make one call: return what it was, what the registers held, and what was read (by id)."""
    name = rng.choice(NAMES[table.family])
    register = table[name]
    kind = rng.choice(("read", "write", "sync_read", "sync_read", "exchange", "exchange"))
    right = {servo.id: servo.register(name) for servo in servos.servos}
    if kind == "sync_read":
        statuses = bus.sync_read(IDS, register)
        return kind, right, {id: status.data for id, status in statuses.items()}
    if kind == "exchange":
        reads = dict.fromkeys(IDS, register)
        statuses = bus.exchange(table["torque_enable"], {}, reads, within=PERIOD)
        return kind, right, {id: status.data for id, status in statuses.items()}
    id = rng.choice(IDS)
    try:
        if kind == "write":
            value = rng.randrange(BYTE_LIMIT)
            bus.write(id, register, value)
            right[id] = value
        return kind, right, {id: bus.read(id, register).data}
    except HardwareError:
        return kind, right, {id: None}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--values", type=int, default=100_000, help="values of each protocol")
    parser.add_argument("--seed", type=int, default=0, help="seed of all chances")
    options = parser.parse_args()
    table = Table("protocol", "values", "wrong values", "reads without a value")
    console = Console()
    wrong = 0
    for family in FAMILY_MODULES:
        result = measure(family, options.values, options.seed)
        wrong += result.wrong
        numbers = (result.values, result.wrong, result.refused)
        table.add_row(family_of(family).protocol.name, *(f"{number:,}" for number in numbers))
        for text in result.examples[:10]:
            console.print(text)
    console.print(table)
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
