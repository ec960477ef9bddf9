"""Faults that can be made to happen on a virtual bus while it runs: one row a kind.

``Fault("silent", id=3, at=2.0, lasts=0.05)`` is one of them; ``VirtualBus.inject`` books it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from robot_ik.hardware.control_table import BAUD_RATES, CONTROL_TABLES, HARDWARE_ERRORS, model_by_number
from robot_ik.hardware.virtual.faults import TICKS_PER_DEGREE
from robot_ik.hardware.virtual.rules import TRIPPED
from robot_ik.hardware.virtual.servo import VirtualServo

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus

Undo = Callable[[], None] | None


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        help: One line for people.
        on_servo: (servo, value) -> how to take it back, or ``None`` where it cannot be.
        on_bus: The same of the wire, the supply or the port.
        low, high: Range of its value; both ``None``: it takes none.
        whole: The value is a whole number.
    """

    help: str
    on_servo: Callable[[VirtualServo, float], Undo] | None = None
    on_bus: Callable[[VirtualBus, float], Undo] | None = None
    low: float | None = None
    high: float | None = None
    whole: bool = False

    @property
    def servo(self) -> bool:
        """It befalls a servo, not the bus."""
        return self.on_servo is not None


@dataclass(frozen=True)
class Fault:
    """A fault to be.

    Attributes:
        kind: A name in ``KINDS``.
        id: Servo; ``None``: every servo, or none where the kind is not of a servo.
        value: As the kind wants it.
        at: Seconds after the bus was made; ``at_packet``: instead, before that many packets are handled.
        lasts: Seconds until it is taken back; ``lasts_packets``: instead, so many packets; both ``None``:
            for good.
    """

    kind: str
    id: int | None = None
    value: float = 0.0
    at: float | None = None
    at_packet: int | None = None
    lasts: float | None = None
    lasts_packets: int | None = None

    def __post_init__(self) -> None:
        kind = KINDS.get(self.kind)
        if kind is None:
            raise ValueError(f"no fault is called {self.kind!r}; there are: {', '.join(KINDS)}")
        if kind.low is not None and kind.high is not None and not kind.low <= self.value <= kind.high:
            raise ValueError(f"{self.kind} takes {kind.low:g}..{kind.high:g}, not {self.value:g}")

    def book(self, bus: VirtualBus) -> None:
        """Puts it into the schedule of ``bus``; what is due happens at once.

        Raises:
            KeyError: There is no servo with this id.
        """
        if self.id is not None:
            bus.servo(self.id)
        if self.at_packet is not None:
            bus.schedule.at_packet(self.at_packet, lambda: self._begin(bus, bus.clock.now()))
        elif self.at is not None:
            when = bus.schedule.start + self.at
            bus.schedule.at(when, lambda: self._begin(bus, when))
            bus.schedule.run()
        else:
            self._begin(bus, bus.clock.now())

    def _begin(self, bus: VirtualBus, when: float) -> None:
        """Happens; ``when`` it should have, for that is when its end is counted from."""
        kind = KINDS[self.kind]
        undos: list[Undo] = []
        if kind.on_servo is not None:
            servos = bus.servos if self.id is None else (bus.servo(self.id),)
            undos += [kind.on_servo(servo, self.value) for servo in servos]
        if kind.on_bus is not None:
            undos.append(kind.on_bus(bus, self.value))

        def end() -> None:
            for undo in undos:
                if undo is not None:
                    undo()

        if self.lasts is not None:
            bus.schedule.at(when + self.lasts, end)
        elif self.lasts_packets is not None:
            bus.schedule.at_packet(bus.schedule.upcoming + self.lasts_packets, end)


# ------------------------------------------------------------------------------------- to servos


def _attribute(name: str) -> Callable[[VirtualServo, float], Undo]:
    """Sets a yes/no attribute of a servo."""

    def begin(servo: VirtualServo, value: float) -> Undo:
        setattr(servo, name, True)
        return lambda: setattr(servo, name, False)

    return begin


def _register(name: str, convert: Callable[[float], int] = int) -> Callable[[VirtualServo, float], Undo]:
    """Sets a register behind the host's back and puts the old value back."""

    def begin(servo: VirtualServo, value: float) -> Undo:
        before = servo.memory.get(name)
        servo.memory.set(name, convert(value))
        return lambda: servo.memory.set(name, before)

    return begin


def _baud_code(rate: float) -> int:
    codes = {bits: code for code, bits in BAUD_RATES.items()}
    return codes[min(codes, key=lambda bits: abs(bits - rate))]


def _error(name: str) -> Callable[[VirtualServo, float], Undo]:
    def begin(servo: VirtualServo, value: float) -> Undo:
        servo.inject_error(name)
        return None

    return begin


def _reboot(servo: VirtualServo, value: float) -> Undo:
    servo.reboot()
    return None


def _jam(servo: VirtualServo, value: float) -> Undo:
    servo.jam()
    return lambda: servo.jam(False)


def _unplug_servo(servo: VirtualServo, value: float) -> Undo:
    servo.switch_off()
    return servo.switch_on


def _zero_offset(servo: VirtualServo, value: float) -> Undo:
    before, servo.zero_offset_ticks = servo.zero_offset_ticks, value * TICKS_PER_DEGREE
    return lambda: setattr(servo, "zero_offset_ticks", before)


def _push(servo: VirtualServo, value: float) -> Undo:
    before = servo.shaft.load
    servo.shaft.load = dataclasses.replace(before, push=value)
    return lambda: setattr(servo.shaft, "load", before)


def _turn(servo: VirtualServo, value: float) -> Undo:
    servo.turn_by_hand(value * TICKS_PER_DEGREE)
    return lambda: servo.turn_by_hand(-value * TICKS_PER_DEGREE)


def _hot(servo: VirtualServo, value: float) -> Undo:
    servo.controller.electrics.temperature = value
    servo.memory.set("present_temperature", round(value))
    return None


def _turns(servo: VirtualServo, value: float) -> Undo:
    servo.shaft.lose_turns(round(value))
    return None


# ---------------------------------------------------------------------- to wire, supply and port


def _rate(name: str) -> Callable[[VirtualBus, float], Undo]:
    """Sets a probability of the wire."""

    def begin(bus: VirtualBus, value: float) -> Undo:
        before = getattr(bus.faults, name)
        bus.change_wire(**{name: value if isinstance(before, float) else True})
        return lambda: bus.change_wire(**{name: before})

    return begin


def _supply(bus: VirtualBus, value: float) -> Undo:
    return bus.supply_faults.begin(bus.servos, value)


def _port(name: str, scale: float | None = None) -> Callable[[VirtualBus, float], Undo]:
    def begin(bus: VirtualBus, value: float) -> Undo:
        before = getattr(bus, name)
        setattr(bus, name, True if scale is None else scale * value)
        return lambda: setattr(bus, name, before)

    return begin


def _extra(bus: VirtualBus, value: float) -> Undo:
    known = bus.servos[0] if bus.servos else None
    model = known.table.model if known else next(iter(CONTROL_TABLES))
    more = VirtualServo(model, int(value), bus.clock, baud=known.baud if known else 1_000_000)
    bus.add(more)
    return lambda: bus.remove(more)


def _wrong_model(servo: VirtualServo, value: float) -> Undo:
    if model_by_number(int(value)) is None:
        raise ValueError(f"no model has the number {value:g}")
    return _register("model_number")(servo, value)


def _whole(help: str, begin: Callable[[VirtualServo, float], Undo], low: int, high: int) -> Kind:
    """A kind of a servo whose value is a whole number."""
    return Kind(help, begin, None, low, high, True)


def _chance(name: str, help: str) -> dict[str, Kind]:
    """A kind of the wire whose value is a probability per answer."""
    return {name: Kind(help, on_bus=_rate(name), low=0.0, high=1.0)}


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "silent": Kind("neither hears nor answers", _attribute("silent")),
        "unplugged": Kind("has no power; it starts anew when plugged in", _unplug_servo),
        "stuck": Kind("the gear is stripped: the shaft rests and feels no load", _attribute("stuck")),
        "jammed": Kind("something holds the shaft: the motor presses against it", _jam),
        "push": Kind("a steady torque on the shaft, N m", _push, None, -100.0, 100.0),
        "zero_offset": Kind("shaft ahead of its registers, degrees", _zero_offset, None, -360.0, 360.0),
        "turn": Kind("a hand turns the shaft, degrees; not against torque", _turn, None, -3600.0, 3600.0),
        "lost_turns": _whole("counts wrong by so many turns", _turns, -255, 255),
        "reboot": Kind("restarts by itself", _reboot),
        "hot": Kind("is so warm, C", _hot, None, 0.0, 150.0),
        **{name: Kind(f"hardware error: {name}", _error(name)) for name in HARDWARE_ERRORS.values()},
        "watchdog_tripped": Kind("its watchdog has run out", _register("bus_watchdog", lambda _: TRIPPED)),
        "return_delay": _whole("waits, 2 us a count", _register("return_delay_time"), 0, 254),
        "status_level": _whole("Status Return Level", _register("status_return_level"), 0, 2),
        "baud": _whole("its baud rate, bits/s", _register("baud_rate", _baud_code), 9_600, 4_500_000),
        "id": _whole("its id; one that is taken makes answers collide", _register("id"), 0, 252),
        "model": _whole("says it is this model number", _wrong_model, 0, 65_535),
        "extra": Kind("one servo more, with this id", on_bus=_extra, low=0, high=252, whole=True),
        "supply": Kind("volts of all servos; far too low: they restart", on_bus=_supply, low=0.0, high=30.0),
        **_chance("drop", "an answer is lost"),
        **_chance("corrupt", "one bit of an answer flips"),
        **_chance("truncate", "an answer breaks off"),
        **_chance("short", "an answer has fewer data than asked, checksum right"),
        **_chance("error", "an answer has an error number and no data"),
        **_chance("garbage", "bytes before an answer"),
        **_chance("duplicate", "an answer comes twice"),
        **_chance("wrong_id", "an answer of a stranger comes first"),
        **_chance("reorder", "an answer comes after the next one"),
        **_chance("late", "an answer comes before those to the next request"),
        "echo": Kind("the adapter returns what was sent", on_bus=_rate("echo")),
        "latency": Kind("answers come so much later, ms", on_bus=_port("latency", 1e-3), low=0.0, high=1e3),
        "port_unplugged": Kind("the port is gone", on_bus=_port("unplugged")),
    }
)
"""Every kind of fault, by name; the only place of registration."""
