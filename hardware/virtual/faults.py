"""What can go wrong on a virtual bus: a ``Fault`` is of a kind of ``FAULTS``, on a servo or bus, for a time.

A row of ``FAULTS`` is all there is of a kind: files, scripts, the command line and the table in the docs
take names, values and help from it.  A file of faults: ``docs/how-to/virtual_bus.md``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any
from weakref import WeakKeyDictionary

from pydantic import Field

from robot_ik.config import (
    KeyProblem,
    SchemaVersion,
    Table,
    check_table,
    keys_of,
    parse_toml,
    read_text,
)
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import TRIPPED
from robot_ik.hardware.family import FAMILY_MODULES, family_of
from robot_ik.hardware.registers import IDS, TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import Joint, ServoId
from robot_ik.hardware.virtual.wire import SPOILS

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus

TICKS_PER_DEGREE = TICKS_PER_REVOLUTION / 360.0

Undo = Callable[[], None] | None
"""How to take it back; None where there is no way."""
Apply = Callable[[Any, float], Undo]
"""(servo or bus, value): lets it happen."""


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        help: One line for people.
        apply: What it does, to a servo or to the bus.
        low, high: Range of its value; without one it takes none.
        whole: The value is a whole number.
        servo: It befalls servos; else the bus, wire and port among it.
        families: Servo families that have it; empty: every family.
    """

    help: str
    apply: Apply
    low: float | None = None
    high: float | None = None
    whole: bool = False
    servo: bool = True
    families: tuple[str, ...] = ()

    @property
    def span(self) -> str:
        """What its value may be, as text; empty where it takes none."""
        whole = "a whole number, " if self.whole else ""
        return "" if self.low is None or self.high is None else f"{whole}{self.low:.10g}..{self.high:.10g}"

    def require(self, value: float | None) -> None:
        """Raises ``KeyProblem`` for a value that is missing, out of range, or none of its own."""
        if not self.span:
            if value is not None:
                raise KeyProblem(f"{value:g} is given to a fault that takes no value", "value", "nothing")
        elif value is None:
            raise KeyProblem("this key is missing", "value", self.span)
        elif not (self.low or 0.0) <= value <= (self.high or 0.0) or (self.whole and value != round(value)):
            raise KeyProblem(f"{value:g} is not right", "value", self.span)


_Seconds = Annotated[float | None, Field(ge=0.0)]
_Count = Annotated[int | None, Field(ge=1)]


@dataclass(frozen=True)
class Fault:
    """A fault to be; a table of a file of faults has these keys.

    Attributes:
        kind: A name in ``FAULTS``.
        id: Servo, or ``joint``: its name; neither: every servo, or none where the kind is not of servos.
        value: As the kind wants it.
        at_s: Seconds after it was injected; ``at_packet``: instead, before that many packets are handled.
        for_s: Seconds until it is taken back; ``for_packets``: instead, so many packets; neither: for good.

    Raises:
        KeyProblem: No such kind, a value that it does not take, or two keys that say the same.
    """

    kind: str
    id: ServoId | None = None
    value: float | None = None
    joint: str | None = dataclasses.field(default=None, kw_only=True)
    at_s: _Seconds = dataclasses.field(default=None, kw_only=True)
    at_packet: _Count = dataclasses.field(default=None, kw_only=True)
    for_s: _Seconds = dataclasses.field(default=None, kw_only=True)
    for_packets: _Count = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise KeyProblem.unknown("fault", self.kind, FAULTS, "kind")
        for one, other in (("joint", "id"), ("at_s", "at_packet"), ("for_s", "for_packets")):
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise KeyProblem(f"{one} and {other} say the same", other, f"{one} or {other}")
        kind = FAULTS[self.kind]
        whom = next((key for key in ("joint", "id") if getattr(self, key) is not None), None)
        if whom is not None and not kind.servo:
            raise KeyProblem(f"{self.kind} is not of one servo", whom, "no joint and no id")
        kind.require(self.value)

    def require_family(self, family: str) -> None:
        """Raise ``KeyProblem`` if servos of this family do not have the fault."""
        families = FAULTS[self.kind].families
        if families and family not in families:
            kinds = [name for name, row in FAULTS.items() if family in (row.families or (family,))]
            raise KeyProblem(f"{family} servos have no fault {self.kind!r}", "kind", ", ".join(kinds))

    def require_servo(self, config: ArmConfig) -> None:
        """Raises ``KeyProblem`` where the arm has no such servo."""
        self.require_family(config.family.name)
        names, ids = config.names, config.servo_ids
        if self.joint is not None and self.joint not in names:
            raise KeyProblem.unknown("joint", self.joint, names, "joint")
        if self.id is not None and self.id not in ids:
            raise KeyProblem(f"no servo has the id {self.id}", "id", ", ".join(map(str, ids)))


def joint_offset(joint: Joint, degrees: float) -> Fault:
    """The ``zero_offset`` by which a joint is so many degrees further, in its own direction."""
    return Fault("zero_offset", joint.servo.id, degrees * joint.servo.direction * joint.gear.ratio)


class Injected:
    """A fault on a bus: on its way, happening or over.  Times and packets count from now.

    The bus holds its lock; raises its ``KeyError`` where there is no such servo.
    """

    def __init__(self, fault: Fault, bus: VirtualBus) -> None:
        self.fault = fault
        self.over = False
        self._bus = bus
        self._undos: list[Undo] = []
        whom = fault.id if fault.joint is None else fault.joint
        self._servos = bus.servos if whom is None else (bus.servo(whom),)
        now = bus.clock.now()
        if fault.at_packet is not None:
            bus.schedule.at_packet(
                bus.schedule.packets + fault.at_packet, lambda: self._begin(bus.clock.now())
            )
        elif fault.at_s:
            when = now + fault.at_s  # from when it should have begun its end is counted
            bus.schedule.at(when, lambda: self._begin(when))
        else:
            self._begin(now)

    def _begin(self, when: float) -> None:
        if self.over:
            return
        fault, bus = self.fault, self._bus
        kind = FAULTS[fault.kind]
        for target in self._servos if kind.servo else (bus,):
            self._undos.append(kind.apply(target, fault.value or 0.0))
        if fault.for_s is not None:
            bus.schedule.at(when + fault.for_s, self.end)
        elif fault.for_packets is not None:
            bus.schedule.at_packet(bus.schedule.upcoming + fault.for_packets, self.end)

    def end(self) -> None:
        """Takes it back, or off the schedule."""
        if not self.over:
            self.over = True
            for undo in filter(None, reversed(self._undos)):
                undo()


# ------------------------------------------------------------------------------------------
# What the kinds do.


class _Override:
    """A value laid over a target's own: of several the one that began last, while it lasts.

    ``read`` and ``write`` the value of a servo or bus; ``convert`` makes it of the fault's value.
    """

    def __init__(
        self,
        read: Callable[[Any], Any],
        write: Callable[[Any, Any], None],
        convert: Callable[[float], Any] = lambda value: value,
    ) -> None:
        self._read, self._write, self._convert = read, write, convert
        self._laid: WeakKeyDictionary[Any, tuple[Any, list[tuple[object, Any]]]] = WeakKeyDictionary()

    def __call__(self, target: Any, value: float) -> Undo:
        own, layers = self._laid.setdefault(target, (self._read(target), []))
        layer = (object(), self._convert(value))
        layers.append(layer)
        self._write(target, layer[1])

        def undo() -> None:
            was_last = layers[-1] is layer
            layers.remove(layer)
            if was_last:
                self._write(target, layers[-1][1] if layers else own)
            if not layers:
                del self._laid[target]

        return undo


def _attribute(name: str, convert: Callable[[float], Any] = lambda _: True) -> _Override:
    """An attribute of a servo or of the bus; by default one that is yes or no."""
    return _Override(lambda it: getattr(it, name), lambda it, value: setattr(it, name, value), convert)


def _register(name: str, convert: Callable[[float], int] = int) -> _Override:
    """A register, behind the host's back."""
    return _Override(
        lambda servo: servo.register(name),
        lambda servo, value: servo.set_register(name, value),
        convert,
    )


def _chance(name: str) -> _Override:
    return _Override(lambda bus: bus.wire.chances[name], lambda bus, p: bus.wire.chances.update({name: p}))


def _shutdown(name: str) -> Apply:
    """A hardware error, which only a restart takes back."""

    def apply(servo: Any, value: float) -> Undo:
        servo.inject_error(name)
        return servo.reboot

    return apply


def _turn(servo: Any, value: float) -> Undo:
    servo.rotate_by_hand(value * TICKS_PER_DEGREE)
    return lambda: servo.rotate_by_hand(-value * TICKS_PER_DEGREE)


def _heat(servo: Any, value: float) -> Undo:
    servo.heat_to(value)
    return None


def _lose_revolutions(servo: Any, value: float) -> Undo:
    servo.lose_revolutions(round(value))
    return None


def _add_servo(bus: VirtualBus, value: float) -> Undo:
    more = bus.another(int(value))
    bus.add(more)
    return lambda: bus.remove(more)


_ID_RANGE = IDS[0], IDS[-1]
_OFF = _Override(lambda servo: servo.off, lambda servo, off: servo.switch(not off), lambda _: True)
_PUSH = _attribute("push", float)
_SUPPLY = _Override(lambda servo: servo.volts, lambda servo, volts: servo.set_supply(volts))
_ZERO_OFFSET = _attribute("zero_offset_ticks", lambda degrees: degrees * TICKS_PER_DEGREE)
_BAUD = _Override(lambda servo: servo.baud, lambda servo, rate: servo.set_baud(rate))
_BACKLASH = _attribute("backlash_ticks", lambda degrees: degrees * TICKS_PER_DEGREE)
_LATENCY = _attribute("latency", lambda ms: 1e-3 * ms)

STS = ("feetech_sts",)


def _error_families() -> dict[str, tuple[str, ...]]:
    """Return name of a hardware error -> families that have it."""
    families: dict[str, tuple[str, ...]] = {}
    for family in FAMILY_MODULES:
        for name in family_of(family).error_names(0xFF):
            if not name.startswith("bit"):
                families[name] = (*families.get(name, ()), family)
    return families


_ERROR_FAMILIES = _error_families()

FAULTS: Mapping[str, Kind] = MappingProxyType(
    {
        "silent": Kind("neither hears nor answers", _attribute("silent")),
        "unplugged": Kind("has no power; it starts anew when plugged in", _OFF),
        "stuck": Kind("the gear is stripped: the shaft rests and feels no load", _attribute("stuck")),
        "jammed": Kind("something holds the shaft: the motor presses against it", _attribute("jammed")),
        "push": Kind("a steady torque on the shaft, N m", _PUSH, -100, 100),
        "zero_offset": Kind("shaft ahead of its registers, degrees", _ZERO_OFFSET, -3600, 3600),
        "turn": Kind("a hand turns the shaft, degrees; not against torque", _turn, -3600, 3600),
        "lost_turns": Kind(
            "counts wrong by so many revolutions",
            _lose_revolutions,
            -255,
            255,
            whole=True,
            families=("dynamixel_x",),
        ),
        "reboot": Kind("restarts by itself", lambda it, _: it.reboot()),
        "hot": Kind("is so warm, C", _heat, 0, 150),
        **{
            name: Kind(f"hardware error: {name}", _shutdown(name), families=families)
            for name, families in _ERROR_FAMILIES.items()
        },
        "watchdog_tripped": Kind(
            "its watchdog has run out",
            _register("bus_watchdog", lambda _: TRIPPED),
            families=("dynamixel_x",),
        ),
        "backlash": Kind("play between motor and shaft, degrees", _BACKLASH, 0, 20, families=STS),
        "homing_offset": Kind(
            "its Homing Offset, ticks", _register("homing_offset"), -2047, 2047, whole=True
        ),
        "firmware": Kind("another firmware version", _register("firmware_version"), 1, 255, whole=True),
        "latched_overload": Kind(
            "an overload stays until a power cycle", _attribute("latches_overload"), families=STS
        ),
        "goal_keeps_torque": Kind(
            "a goal position does not switch torque on",
            _attribute("goal_enables_torque", lambda _: False),
            families=STS,
        ),
        "drops_locked_writes": Kind(
            "an EEPROM write while Lock is 1 has no effect",
            _attribute("drops_locked_writes"),
            families=STS,
        ),
        "return_delay": Kind("waits, 2 us a count", _register("return_delay_time"), 0, 254, whole=True),
        "status_level": Kind("Status Return Level", _register("status_return_level"), 0, 2, whole=True),
        "baud": Kind("its baud rate, bits/s", _BAUD, 9600, 4_500_000, whole=True),
        "id": Kind(
            "its id; one that is taken makes status packets collide", _register("id"), *_ID_RANGE, whole=True
        ),
        "model": Kind("says it is this model number", _register("model_number"), 0, 65535, whole=True),
        "supply": Kind("volts it gets; far too low: it restarts", _SUPPLY, 0, 30),
        "extra": Kind("one servo more, with this id", _add_servo, *_ID_RANGE, whole=True, servo=False),
        **{name: Kind(row.help, _chance(name), 0, 1, servo=False) for name, row in SPOILS.items()},
        "echo": Kind("the adapter returns what was sent", _attribute("echo"), servo=False),
        "latency": Kind("status packets come so much later, ms", _LATENCY, 0, 1000, servo=False),
        "port_unplugged": Kind("the port is gone", _attribute("unplugged"), servo=False),
    }
)
"""Every kind of fault, by name; the only place of registration."""


# ------------------------------------------------------------------------------------------
# The file.


class FaultFile(Table):
    """A file of faults; ``seed``: of the wire's random ones."""

    version: SchemaVersion
    seed: int = 0
    faults: Annotated[tuple[Annotated[Fault, keys_of(Fault)], ...], Field(strict=False)] = ()


def load_faults(path: Path | str, config: ArmConfig) -> FaultFile:
    """Reads a file of faults for an arm.

    Raises:
        ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    return parse_faults(read_text(path, "the file of faults"), config, path)


def parse_faults(text: str, config: ArmConfig, file: Path | str = "<text>") -> FaultFile:
    """The same from text; ``file`` appears in errors."""
    found = check_table(FaultFile, parse_toml(text, file), file)
    for k, fault in enumerate(found.faults):
        make_fault(config, file, f"faults[{k}]", **dataclasses.asdict(fault))
    return found


def make_fault(config: ArmConfig, file: Path | str = "<text>", at: str = "fault", **keys: Any) -> Fault:
    """The fault of these keys of ``Fault``, None left out, checked as in a file of faults.

    Raises:
        ConfigError: No such kind, servo or value; ``file`` and where the fault stands ``at`` in it are named.
    """
    try:
        fault = Fault(**{name: value for name, value in keys.items() if value is not None})
        fault.require_servo(config)
    except KeyProblem as wrong:
        raise wrong.within((), at).in_file(file) from None
    return fault
