"""What can be wrong with a virtual bus, as data: on the way, in the supply, in files and in scripts."""

from __future__ import annotations

import dataclasses
import json
import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robot_ik.errors import ConfigError, UnknownJointError, close_matches
from robot_ik.files import parse_toml, read_text, shown
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.config_file import first_slip
from robot_ik.hardware.control_table import (
    BAUD_RATES,
    CONTROL_TABLES,
    HARDWARE_ERRORS,
    TICKS_PER_TURN,
    model_by_number,
)
from robot_ik.hardware.virtual.memory import TRIPPED
from robot_ik.hardware.virtual.protocol import BROADCAST, Parser, build_status
from robot_ik.hardware.virtual.servo import VirtualServo

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from robot_ik.hardware.virtual.bus import VirtualBus


TICKS_PER_DEGREE = TICKS_PER_TURN / 360.0
RATES = (
    "corrupt",
    "truncate",
    "drop",
    "garbage",
    "short",
    "error",
    "duplicate",
    "wrong_id",
    "reorder",
    "late",
)
"""Fields of ``Faults`` that are probabilities per status packet."""


@dataclass(frozen=True)
class Faults:
    """Faults of servos, by id, and of the wire, by probability per status packet.

    Attributes:
        zero_offset_deg: Servo id -> degrees by which its shaft is ahead of what its registers say.
        stuck: Ids whose shaft does not move.
        silent: Ids that neither hear nor answer.
        overload: Ids that shut down with an overload when the faults are set.
        corrupt: One bit of the packet flips.
        truncate: The packet breaks off.
        drop: The packet is lost.
        garbage: One to eight random bytes come before the packet.
        short: The packet has fewer data than asked for, and a right checksum.
        error: The packet has an error number and no data.
        duplicate: The packet comes twice.
        wrong_id: A packet of a servo that nobody asked comes first.
        reorder: The packet comes after the next one.
        late: The packet comes before the answers to the next request.
        echo: The adapter returns what was sent.
        seed: Of the wire's dice; equal seeds and equal traffic give equal faults.
    """

    zero_offset_deg: Mapping[int, float] = field(default_factory=dict)
    stuck: frozenset[int] = frozenset()
    silent: frozenset[int] = frozenset()
    overload: frozenset[int] = frozenset()
    corrupt: float = 0.0
    truncate: float = 0.0
    drop: float = 0.0
    garbage: float = 0.0
    short: float = 0.0
    error: float = 0.0
    duplicate: float = 0.0
    wrong_id: float = 0.0
    reorder: float = 0.0
    late: float = 0.0
    echo: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in RATES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is a probability, 0..1, not {getattr(self, name)}")

    @classmethod
    def for_joints(
        cls,
        config: ArmConfig,
        *,
        zero_offset_deg: Mapping[str, float] | None = None,
        stuck: Iterable[str] = (),
        silent: Iterable[str] = (),
        overload: Iterable[str] = (),
        **wire: float,
    ) -> Faults:
        """The same by joint name; offsets are degrees of the joint, in its own direction.

        Args:
            config: The arm.
            zero_offset_deg: Joint name -> degrees.
            stuck: Joint names.
            silent: Joint names.
            overload: Joint names.
            **wire: Fields of ``Faults`` that concern the wire.

        Raises:
            UnknownJointError: The arm has no such joint.
        """
        offsets = {}
        for name, degrees in (zero_offset_deg or {}).items():
            joint = config.joint(name)
            offsets[joint.id] = degrees * joint.direction * joint.ratio
        known = {f.name for f in fields(cls)}
        if unknown := set(wire) - known:
            raise TypeError(f"no such faults: {sorted(unknown)}; there are: {sorted(known)}")

        def ids(names: Iterable[str]) -> frozenset[int]:
            return frozenset(config.joint(name).id for name in names)

        return cls(offsets, ids(stuck), ids(silent), ids(overload), **wire)  # type: ignore[arg-type]

    def servo_ids(self) -> frozenset[int]:
        """Every id that a fault names."""
        return frozenset(self.zero_offset_deg) | self.stuck | self.silent | self.overload


class Wire:
    """Applies the faults of the wire to status packets.

    Args:
        faults: Which, how often, and the seed.
        taken: Ids on the wire: a stranger has none of them, for nobody could tell its answer from theirs.

    Attributes:
        faults: The ones in force.
    """

    def __init__(self, faults: Faults, taken: Iterable[int] = ()) -> None:
        self._strangers = sorted(set(range(253)).difference(taken)) or [BROADCAST]
        self.change(faults)
        self._dice = random.Random(faults.seed)
        self._late: list[bytes] = []

    def change(self, faults: Faults) -> None:
        """Other faults from here on; the dice go on."""
        self.faults = faults
        self._clean = not any(getattr(faults, rate) for rate in RATES)

    def carry(self, packets: list[bytes]) -> list[bytes]:
        """What of the answers to one request arrives at the host, in the order in which it does."""
        if self._clean and not self._late:
            return packets
        arriving, self._late = self._late, []
        behind: bytes | None = None
        for packet in packets:
            if self._happens(self.faults.late):
                self._late.append(packet)
                continue
            spoiled = self._spoil(packet)
            if behind is None and self._happens(self.faults.reorder):
                behind = spoiled
                continue
            arriving.append(spoiled)
            if behind is not None:
                arriving.append(behind)
                behind = None
        return arriving if behind is None else [*arriving, behind]

    def _spoil(self, packet: bytes) -> bytes:
        """One packet, as it arrives."""
        faults, dice = self.faults, self._dice
        if self._happens(faults.drop):
            return b""
        id = packet[4]
        whole = id != BROADCAST  # the torso of a fast read is no status of its own
        if whole and self._happens(faults.short):
            packet = _shortened(packet)
        if whole and self._happens(faults.error):
            packet = build_status(id, dice.randrange(1, 8))
        if self._happens(faults.corrupt):
            bit = dice.randrange(8 * len(packet))
            spoiled = bytearray(packet)
            spoiled[bit // 8] ^= 1 << bit % 8
            packet = bytes(spoiled)
        if self._happens(faults.truncate):
            packet = packet[: dice.randrange(1, len(packet))]
        if self._happens(faults.duplicate):
            packet += packet
        if self._happens(faults.wrong_id):
            packet = build_status(dice.choice(self._strangers), 0, dice.randbytes(4)) + packet
        if self._happens(faults.garbage):
            packet = dice.randbytes(dice.randrange(1, 9)) + packet
        return packet

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._dice.random() < probability


def _shortened(packet: bytes) -> bytes:
    """The same status with one byte of data less; one without data, or no status at all, stays."""
    answers = Parser().feed(packet, 0.0)
    if not answers or not answers[0].is_status:  # servos that talk over each other
        return packet
    answer = answers[0]
    return build_status(answer.id, answer.params[0], answer.data[:-1])


# ------------------------------------------------------------------------------------------
# Faults that can be made to happen on a virtual bus while it runs: one row a kind.
#
# ``Fault("silent", id=3, at=2.0, lasts=0.05)`` is one of them; ``VirtualBus.inject`` books it.


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


# ------------------------------------------------------------------------------------------
# The TOML file of faults that ``sim-bus --faults`` and tests read, and what is said of a slip in it.
#
# ::
#
#     schema = 1
#     seed = 7
#
#     [[faults]]
#     kind = "silent"       # a name in fault_kinds.KINDS
#     joint = "joint3"      # or id = 3; neither: every servo
#     at_s = 2.0            # or at_packet = 100; neither: from the start
#     for_s = 0.05          # or for_packets = 1; neither: for good
#
#     [[faults]]
#     kind = "corrupt"
#     value = 0.001


_Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=1)]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    kind: str
    joint: str | None = None
    id: Annotated[int | None, Field(ge=0, le=252)] = None
    value: Annotated[float | None, Field(allow_inf_nan=False)] = None
    at_s: _Seconds | None = None
    at_packet: _Count | None = None
    for_s: _Seconds | None = None
    for_packets: _Count | None = None


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    # Named so because ``schema`` is taken in pydantic's base class.
    version: Annotated[int, Field(alias="schema", ge=1, le=1)]
    seed: int = 0
    faults: list[_Entry] = []


@dataclass(frozen=True)
class FaultScript:
    """Faults of one run.

    Attributes:
        seed: Of the wire's dice.
        faults: In the order of the file.
    """

    seed: int
    faults: tuple[Fault, ...]


def load_faults(path: Path | str, config: ArmConfig) -> FaultScript:
    """Reads a file of faults for an arm.

    Raises:
        ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    return parse_faults(read_text(path, "the file of faults"), config, path)


def parse_faults(text: str, config: ArmConfig, file: Path | str = "<text>") -> FaultScript:
    """The same from text; ``file`` appears in errors."""
    try:
        parsed = _File.model_validate(parse_toml(text, file))
    except ValidationError as error:
        raise _explain(first_slip(error), file) from None
    faults = tuple(_fault(entry, f"faults[{k}]", config, file) for k, entry in enumerate(parsed.faults))
    return FaultScript(parsed.seed, faults)


def _explain(detail: ErrorDetails, file: Path | str) -> ConfigError:
    key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in detail["loc"]).lstrip(".")
    if detail["type"] == "extra_forbidden":
        name = str(detail["loc"][-1])
        fields = (_Entry if len(detail["loc"]) > 1 else _File).model_fields
        known = [info.alias or field for field, info in fields.items()]
        close = close_matches(name, known)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        return ConfigError(
            f"unknown key {shown(name)}", file=file, key=key, allowed=", ".join(known), hint=hint
        )
    if detail["type"] == "missing":
        return ConfigError("this key is missing", file=file, key=key, allowed="a value")
    allowed = detail["msg"].removeprefix("Input should be a valid ").removeprefix("Input should be ")
    return ConfigError(f"{shown(detail['input'])} is not right", file=file, key=key, allowed=allowed)


def _fault(entry: _Entry, at: str, config: ArmConfig, file: Path | str) -> Fault:
    def wrong(text: str, key: str, allowed: str, hint: str = "") -> ConfigError:
        return ConfigError(text, file=file, key=f"{at}.{key}", allowed=allowed, hint=hint)

    kind = KINDS.get(entry.kind)
    if kind is None:
        close = close_matches(entry.kind, KINDS)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        raise wrong(f"no fault is called {shown(entry.kind)}", "kind", ", ".join(KINDS), hint)
    for one, other in (("joint", "id"), ("at_s", "at_packet"), ("for_s", "for_packets")):
        if getattr(entry, one) is not None and getattr(entry, other) is not None:
            raise wrong(f"{one} and {other} say the same", other, f"{one} or {other}")
    if not kind.servo and (entry.joint is not None or entry.id is not None):
        key = "joint" if entry.joint is not None else "id"
        raise wrong(f"{entry.kind} is not of one servo", key, "no joint and no id")
    return Fault(
        entry.kind,
        _servo_id(entry, config, wrong),
        _value(entry, wrong),
        entry.at_s,
        entry.at_packet,
        entry.for_s,
        entry.for_packets,
    )


def _servo_id(entry: _Entry, config: ArmConfig, wrong: Any) -> int | None:
    if entry.joint is not None:
        try:
            return config.joint(entry.joint).id
        except UnknownJointError:
            names = config.whole.names
            close = close_matches(entry.joint, names)
            hint = f"did you mean {' or '.join(close)}?" if close else ""
            raise wrong(f"no joint is called {shown(entry.joint)}", "joint", ", ".join(names), hint) from None
    if entry.id is not None and entry.id not in config.servo_ids:
        raise wrong(f"no servo has the id {entry.id}", "id", ", ".join(map(str, config.servo_ids)))
    return entry.id


def _value(entry: _Entry, wrong: Any) -> float:
    kind = KINDS[entry.kind]
    if kind.low is None or kind.high is None:
        if entry.value is not None:
            raise wrong(f"{entry.kind} takes no value", "value", "nothing")
        return 0.0
    span = f"{'a whole number, ' if kind.whole else ''}{kind.low:g}..{kind.high:g}"
    if entry.value is None:
        raise wrong("this key is missing", "value", span)
    if not kind.low <= entry.value <= kind.high or (kind.whole and entry.value != round(entry.value)):
        raise wrong(f"{entry.value:g} is not right", "value", span)
    return entry.value


# ------------------------------------------------------------------------------------------
# What feeds the servos of a virtual bus, and faults of that which come, overlap and go.


BROWN_OUT = 0.4
"""Share of the nominal supply below which a servo loses its mind and starts anew when power is back."""


def feed(servo: VirtualServo, volts: float) -> None:
    """This supply for one servo; so low that it cannot run, it starts anew once power is back."""
    servo.set_supply(volts)
    starved = volts < BROWN_OUT * servo.table.supply
    if starved != servo.off:
        (servo.switch_off if starved else servo.switch_on)()


class SupplyFaults:
    """Voltages that all servos get instead of their own, the one that began last while it lasts."""

    def __init__(self) -> None:
        self._volts: list[list[float]] = []  # a list each, so that two of one voltage are told apart
        self._own: dict[VirtualServo, float] = {}

    def begin(self, servos: Iterable[VirtualServo], volts: float) -> Callable[[], None]:
        """Feeds all ``servos`` with ``volts``; the way back gives each what it had when none was wrong."""
        fault = [volts]
        self._volts.append(fault)
        for servo in servos:
            self._own.setdefault(servo, servo.shaft.volts)
            feed(servo, volts)
        return lambda: self._end(fault)

    def _end(self, fault: list[float]) -> None:
        left = [other for other in self._volts if other is not fault]
        if len(left) == len(self._volts):
            return  # it is over
        was_last, self._volts = self._volts[-1] is fault, left
        if was_last:
            for servo, own in self._own.items():
                feed(servo, left[-1][0] if left else own)
        if not left:
            self._own.clear()


# ------------------------------------------------------------------------------------------
# Faults of a script: they begin when the script says so, counted from there, and can be taken back.


def fault_for(
    config: ArmConfig,
    kind: str,
    *,
    joint: str | None = None,
    id: int | None = None,
    value: float | None = None,
    file: Path | str = "<text>",
    key: str = "fault",
) -> Fault:
    """The fault of these parameters, as a file of faults would say it.

    Raises:
        ConfigError: No such kind, joint or value; ``file`` and ``key`` say where it stands.
    """
    given = {"kind": kind, "joint": joint, "id": id, "value": value}
    rows = [f"{name} = {json.dumps(entry)}" for name, entry in given.items() if entry is not None]
    try:
        (fault,) = parse_faults("schema = 1\n[[faults]]\n" + "\n".join(rows), config, file).faults
    except ConfigError as error:
        problem = str(error.args[0]).removeprefix(f"{file}: {error.key}: ")
        problem = problem.removesuffix(f"; allowed: {error.allowed}")
        there = error.key.replace("faults[0]", key)
        raise ConfigError(problem, file=file, key=there, allowed=error.allowed, hint=error.hint) from None
    if kind == "model" and model_by_number(int(fault.value)) is None:
        known = ", ".join(str(table.number) for table in CONTROL_TABLES.values())
        raise ConfigError(
            f"no model has the number {fault.value:g}", file=file, key=f"{key}.value", allowed=known
        )
    return fault


@dataclass
class _Booking:
    """One fault on its way: what ``VirtualBus.inject`` takes for a ``Fault``."""

    fault: Fault
    delay: float
    lasts: float | None
    undos: list[Callable[[], None]] = field(default_factory=list)
    over: bool = False

    def book(self, bus: VirtualBus) -> None:
        """Puts it into the schedule; without delay it happens at once."""
        if self.fault.id is not None:
            bus.servo(self.fault.id)
        if self.fault.at_packet is not None:
            bus.schedule.at_packet(bus.schedule.packets + self.fault.at_packet, lambda: self._begin(bus))
        elif self.delay > 0.0:
            bus.schedule.at(bus.clock.now() + self.delay, lambda: self._begin(bus))
        else:
            self._begin(bus)

    def end(self) -> None:
        """Takes it back, or off the schedule."""
        if not self.over:
            self.over = True
            for undo in reversed(self.undos):
                undo()

    def _begin(self, bus: VirtualBus) -> None:
        if self.over:
            return
        kind, id = KINDS[self.fault.kind], self.fault.id
        if kind.on_servo is not None:
            for servo in bus.servos if id is None else (bus.servo(id),):
                undo = kind.on_servo(servo, self.fault.value)
                self.undos.append(undo or _restart(servo, self.fault.kind))
        if kind.on_bus is not None and (undo := kind.on_bus(bus, self.fault.value)) is not None:
            self.undos.append(undo)
        if self.lasts is not None:
            bus.schedule.at(bus.clock.now() + self.lasts, self.end)
        elif self.fault.lasts_packets is not None:
            bus.schedule.at_packet(bus.schedule.upcoming + self.fault.lasts_packets, self.end)


def _restart(servo: VirtualServo, kind: str) -> Callable[[], None]:
    """A servo that shut down is well again after a restart; what else has no way back stays."""
    return servo.reboot if kind in HARDWARE_ERRORS.values() else lambda: None


@dataclass
class _Healing:
    """Ends bookings where ``VirtualBus.inject`` holds the lock and wakes whoever sleeps."""

    bookings: list[_Booking]

    def book(self, bus: VirtualBus) -> None:
        for booking in reversed(self.bookings):
            booking.end()


class ScriptFaults:
    """Faults injected into one virtual bus, and the way back."""

    def __init__(self, bus: VirtualBus) -> None:
        self._bus = bus
        self._booked: list[_Booking] = []

    def inject(self, fault: Fault, delay: float = 0.0, lasts: float | None = None) -> None:
        """Lets ``fault`` happen in ``delay`` s, for ``lasts`` s or for good.

        Packets, where the fault counts those instead, are counted from here, too.
        """
        booking = _Booking(fault, delay, lasts)
        self._booked.append(booking)
        self._bus.inject(cast(Fault, booking))

    def clear(self, kind: str | None = None) -> int:
        """Takes back what was injected, the last first; of one kind, or all.  How many there were."""
        chosen = [b for b in self._booked if kind in (None, b.fault.kind)]
        self._booked = [b for b in self._booked if b not in chosen]
        running = [b for b in chosen if not b.over]
        self._bus.inject(cast(Fault, _Healing(chosen)))
        return len(running)
