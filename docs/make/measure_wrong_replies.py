"""Count late, short, foreign and damaged replies that become values, on both protocols.

    python docs/make/measure_wrong_replies.py                    100,000 values a protocol
    python docs/make/measure_wrong_replies.py --values 10000     fewer

A bus drives six simulated servos on virtual time.  Their registers hold other numbers before every
call.  In the first scenario a share of the status packets is late, short, foreign, damaged, lost or
out of order.  In the others a quarter of the requests is answered late, by all servos or by one of
them, and a later request may be answered before.

A value is wrong if its register did not hold it during the call.  A read without a value is not
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
"""s between two calls of every other pair.

The others follow at once, as while an arm is connected.
"""

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


@dataclass(frozen=True)
class Scenario:
    """The errors of the replies.

    Attributes:
        lateness_ms: Shortest and longest lateness.  The bus guards against replies that are up to
            160 ms late.
        late_share: Share of the requests that are answered late.
        spoil_share: Share of the status packets that are spoilt, for each way of spoiling.
    """

    lateness_ms: tuple[float, float]
    late_share: float = 0.25
    spoil_share: float = 0.0

    @property
    def title(self) -> str:
        """Text for the table."""
        shortest, longest = self.lateness_ms
        late = f"{shortest:g} to {longest:g} ms late"
        return f"{late}; short, foreign, damaged, lost" if self.spoil_share else late


SCENARIOS = (
    Scenario((2, 150), late_share=0.1, spoil_share=0.02),
    Scenario((34, 150)),
    Scenario((40, 40)),
    Scenario((60, 60)),
    Scenario((80, 80)),
    Scenario((120, 120)),
    Scenario((150, 150)),
)


class WrongPort(InProcessPort):
    """Waits as a serial port does, on the servos' clock.  Some replies are late.

    Args:
        bus: Driver.
        servos: Virtual bus.
        scenario: Lateness of the replies, and the share of late replies.
        rng: Selects the late replies.
    """

    def __init__(
        self, bus: SerialBus, servos: VirtualBus, scenario: Scenario, rng: random.Random
    ) -> None:
        super().__init__(servos, "wrong", bus.baud, bus.counters)
        self.seconds_per_byte = 10.0 / bus.baud
        self._clock = servos.clock
        self._scenario = scenario
        self._rng = rng
        self._coming: list[tuple[float, bytes]] = []
        self._packets: list[bytes] = []
        self._carry = servos.wire.carry
        servos.wire.carry = self._note_packets  # type: ignore[method-assign]

    def _note_packets(self, packets: list[bytes], now: float) -> list[bytes]:
        self._packets = self._carry(packets, now)
        return self._packets

    def _wait_until(self, time: float) -> None:
        """Wait until ``time`` or the next bytes.  Put what has come into the buffer."""
        arrivals = [arrival for arrival, _ in self._coming]
        if not self._buffer:
            self._clock.sleep_until(min([time, *arrivals]))
        now = self._clock.now()
        self._buffer += b"".join(data for arrival, data in sorted(self._coming) if arrival <= now)
        self._coming = [row for row in self._coming if row[0] > now]

    def _lateness(self) -> list[float]:
        """Return the lateness of every packet, s: of all, or of one of them by chance."""
        rng = self._rng
        late = 0.0
        if rng.random() < self._scenario.late_share:
            late = 1e-3 * rng.uniform(*self._scenario.lateness_ms)
        count = len(self._packets)
        only = rng.randrange(count or 1) if rng.random() < 0.5 else None
        return [late if only in (None, number) else 0.0 for number in range(count)]

    def getCurrentTime(self) -> float:
        return 1000.0 * self._clock.now()

    def writePort(self, packet: Sequence[int] | bytes) -> int:
        self._clock.sleep_until(self._clock.now() + len(packet) * self.seconds_per_byte)
        before = self._buffer
        self._packets = []
        super().writePort(packet)
        self._buffer = before
        arrival = self._clock.now()
        for reply, late in zip(self._packets, self._lateness(), strict=True):
            arrival += len(reply) * self.seconds_per_byte
            self._coming.append((arrival + late, reply))
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
    """The driver of real servos, on virtual servos with wrong replies.

    Args:
        servos: Virtual bus.
        scenario: Errors of the replies.
        rng: Selects the late replies.
    """

    def __init__(self, servos: VirtualBus, scenario: Scenario, rng: random.Random) -> None:
        protocol = family_of(servos.family).protocol
        super().__init__("wrong", BAUD, protocol, clock=servos.clock)
        self._servos = servos
        self._scenario = scenario
        self._rng = rng
        for name in SPOILS:
            spoilt = 0.0 if name in EXCLUDED else scenario.spoil_share
            servos.wire.chances[name] = spoilt

    def _make_handler(self) -> WrongPort:
        return WrongPort(self, self._servos, self._scenario, self._rng)


@dataclass
class WrongReplies:
    """The values that were read.

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
        """Count the values of one call.

        Args:
            what: Name of the call.
            right: Servo id -> true values of its register during the call.
            read: Servo id -> value that was read.
        """
        for id, value in read.items():
            self.values += value is not None
            self.refused += value is None
            if value not in (None, right[id]):
                self.wrong += 1
                self.examples.append(f"{what} of {id}: {value}, not {right[id]}")


def measure(family: str, values: int, scenario: Scenario, seed: int = 0) -> WrongReplies:
    """Read servos and groups, write, and run control cycles until enough values have come.

    Args:
        family: Servo family.
        values: Number of values.
        scenario: Errors of the replies.
        seed: Seed of all random choices.
    """
    rng = random.Random(seed)
    clock = VirtualClock()
    another = VIRTUAL_FAMILIES[family].another
    servos = VirtualBus([another(MODELS[family], id, clock, BAUD) for id in IDS], clock, seed)
    bus = WrongBus(servos, scenario, rng)
    bus.open()
    bus.use_fast_reads(IDS)
    table = control_table(MODELS[family])
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
    """Make one call. Return its name, the true values and the read values, by id."""
    names = NAMES[table.family]
    name = rng.choice(names)
    register = table[name]
    kind = rng.choice(("read", "write", "sync_read", "sync_read", "exchange", "exchange"))
    right = {servo.id: servo.register(name) for servo in servos.servos}
    if kind == "sync_read":
        statuses = bus.sync_read(IDS, register)
        return kind, right, {id: status.data for id, status in statuses.items()}
    if kind == "exchange":
        reads = dict.fromkeys(IDS, register)
        if not bus.protocol.uniform_group_reads:
            # One servo in turn is asked for another register, as servos with thresholds are.
            other = names[0]
            turn = rng.choice(IDS)
            reads[turn] = table[other]
            right[turn] = servos.servo(turn).register(other)
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
    """Measure both protocols and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--values", type=int, default=100_000, help="values of each protocol")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random choices")
    options = parser.parse_args()
    table = Table("protocol", "replies", "values", "wrong values", "reads without a value")
    console = Console()
    values = -(-options.values // len(SCENARIOS))
    wrong = 0
    for family in FAMILY_MODULES:
        for scenario in SCENARIOS:
            result = measure(family, values, scenario, options.seed)
            wrong += result.wrong
            numbers = (result.values, result.wrong, result.refused)
            protocol = family_of(family).protocol.name
            table.add_row(protocol, scenario.title, *(f"{number:,}" for number in numbers))
            for text in result.examples[:10]:
                console.print(text)
    console.print(table)
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
