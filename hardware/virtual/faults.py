"""Faults of a virtual bus.

A ``Fault`` has a kind, a servo or none, a value and a time. Each kind is one row of ``FAULTS``.
Files, scripts, the command line and the table in the docs take names, values and help from it. The
file of faults is described in ``docs/how-to/virtual_bus.md``.
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
"""Takes a fault back; None: the fault cannot be taken back."""
Apply = Callable[[Any, float], Undo]
"""(servo or bus, value): begins the fault."""


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        help: One line for the user.
        apply: Begins the fault on a servo or on the bus.
        low: Smallest value; None: the fault takes no value.
        high: Largest value; None: the fault takes no value.
        whole: The value is a whole number.
        servo: The fault is of servos; otherwise of the bus, its wire or its port.
        families: Servo families that have the fault; empty: every family.
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
        """Allowed values as text; empty if the fault takes no value."""
        whole = "a whole number, " if self.whole else ""
        if self.low is None or self.high is None:
            return ""
        return f"{whole}{self.low:.10g}..{self.high:.10g}"

    def require(self, value: float | None) -> None:
        """Raise ``KeyProblem`` for a value that is missing, out of range or not expected."""
        if not self.span:
            if value is not None:
                raise KeyProblem(
                    f"{value:g} is given to a fault that takes no value", "value", "no value"
                )
        elif value is None:
            raise KeyProblem("this key is missing", "value", self.span)
        elif not (self.low or 0.0) <= value <= (self.high or 0.0) or (
            self.whole and value != round(value)
        ):
            raise KeyProblem(f"{value:g} is not right", "value", self.span)


_Seconds = Annotated[float | None, Field(ge=0.0)]
_Count = Annotated[int | None, Field(ge=1)]


@dataclass(frozen=True)
class Fault:
    """A fault to be injected. A table of a file of faults has these keys.

    Attributes:
        kind: A name in ``FAULTS``.
        id: Id of the servo.
        value: Value of the fault, see ``Kind``.
        joint: Name of the joint, instead of ``id``. Without id and joint the fault is of every
            servo, or of the bus.
        at_s: s after the injection at which the fault begins.
        at_packet: Instead: the fault begins before this number of packets is handled.
        for_s: s until the fault is taken back.
        for_packets: Instead: packets until the fault is taken back. Without both it lasts.

    Raises:
        KeyProblem: No such kind, a value that the kind does not take, or two keys with one meaning.
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
        for key, other in (("joint", "id"), ("at_s", "at_packet"), ("for_s", "for_packets")):
            if getattr(self, key) is not None and getattr(self, other) is not None:
                raise KeyProblem(
                    f"{key} and {other} exclude each other", other, f"{key} or {other}"
                )
        kind = FAULTS[self.kind]
        servo_key = next((key for key in ("joint", "id") if getattr(self, key) is not None), None)
        if servo_key is not None and not kind.servo:
            raise KeyProblem(f"{self.kind} is not of one servo", servo_key, "no joint and no id")
        kind.require(self.value)

    def require_family(self, family: str) -> None:
        """Raise ``KeyProblem`` if servos of this family do not have the fault."""
        families = FAULTS[self.kind].families
        if families and family not in families:
            kinds = [name for name, row in FAULTS.items() if family in (row.families or (family,))]
            raise KeyProblem(
                f"{family} servos have no fault {self.kind!r}", "kind", ", ".join(kinds)
            )

    def require_servo(self, config: ArmConfig) -> None:
        """Raise ``KeyProblem`` if the arm has no such servo."""
        self.require_family(config.family.name)
        names = config.names
        ids = config.servo_ids
        if self.joint is not None and self.joint not in names:
            raise KeyProblem.unknown("joint", self.joint, names, "joint")
        if self.id is not None and self.id not in ids:
            raise KeyProblem(f"no servo has the id {self.id}", "id", ", ".join(map(str, ids)))


def joint_offset(joint: Joint, degrees: float) -> Fault:
    """Return the ``zero_offset`` that moves a joint by ``degrees`` in its own direction."""
    return Fault("zero_offset", joint.servo.id, degrees * joint.servo.direction * joint.gear.ratio)


class Injected:
    """A fault on a bus: scheduled, active or over. Times and packets count from the injection.

    The caller holds the lock of the bus.

    Raises:
        KeyError: The bus has no such servo.
    """

    def __init__(self, fault: Fault, bus: VirtualBus) -> None:
        self.fault = fault
        self.over = False
        self._bus = bus
        self._undos: list[Undo] = []
        name = fault.id if fault.joint is None else fault.joint
        self._servos = bus.servos if name is None else (bus.servo(name),)
        now = bus.clock.now()
        if fault.at_packet is not None:
            bus.schedule.at_packet(
                bus.schedule.packets + fault.at_packet, lambda: self._begin(bus.clock.now())
            )
        elif fault.at_s:
            when = now + fault.at_s  # the end is counted from here, however late the bus is
            bus.schedule.at(when, lambda: self._begin(when))
        else:
            self._begin(now)

    def _begin(self, when: float) -> None:
        if self.over:
            return
        fault = self.fault
        bus = self._bus
        kind = FAULTS[fault.kind]
        for target in self._servos if kind.servo else (bus,):
            self._undos.append(kind.apply(target, fault.value or 0.0))
        if fault.for_s is not None:
            bus.schedule.at(when + fault.for_s, self.end)
        elif fault.for_packets is not None:
            bus.schedule.at_packet(bus.schedule.upcoming + fault.for_packets, self.end)

    def end(self) -> None:
        """Take the fault back, or remove it from the schedule."""
        if not self.over:
            self.over = True
            for undo in filter(None, reversed(self._undos)):
                undo()


class _Override:
    """A value laid over the value of a servo or of the bus.

    The override that began last counts. When it ends, the one before it counts again.

    Args:
        read: Reads the value.
        write: Writes the value.
        convert: Value of the fault -> value to write.
    """

    def __init__(
        self,
        read: Callable[[Any], Any],
        write: Callable[[Any, Any], None],
        convert: Callable[[float], Any] = lambda value: value,
    ) -> None:
        self._read = read
        self._write = write
        self._convert = convert
        self._laid: WeakKeyDictionary[Any, tuple[Any, list[tuple[object, Any]]]] = (
            WeakKeyDictionary()
        )

    def __call__(self, target: Any, value: float) -> Undo:
        original, layers = self._laid.setdefault(target, (self._read(target), []))
        layer = (object(), self._convert(value))
        layers.append(layer)
        self._write(target, layer[1])

        def undo() -> None:
            was_last = layers[-1] is layer
            layers.remove(layer)
            if was_last:
                self._write(target, layers[-1][1] if layers else original)
            if not layers:
                del self._laid[target]

        return undo


def _attribute(name: str, convert: Callable[[float], Any] = lambda _: True) -> _Override:
    """Return the override of an attribute of a servo or of the bus; by default set to True."""
    return _Override(
        lambda target: getattr(target, name),
        lambda target, value: setattr(target, name, value),
        convert,
    )


def _register(name: str, convert: Callable[[float], int] = int) -> _Override:
    """Return the override of a register, without a request of the host."""
    return _Override(
        lambda servo: servo.register(name),
        lambda servo, value: servo.set_register(name, value),
        convert,
    )


def _chance(name: str) -> _Override:
    return _Override(
        lambda bus: bus.wire.chances[name], lambda bus, p: bus.wire.chances.update({name: p})
    )


def _shutdown(name: str) -> Apply:
    """Return the function that sets a hardware error, which only a restart takes back."""

    def apply(servo: Any, _value: float) -> Undo:
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
        "unplugged": Kind("has no power; it restarts when plugged in", _OFF),
        "stuck": Kind(
            "the gear is stripped: the shaft rests and feels no load", _attribute("stuck")
        ),
        "jammed": Kind(
            "something holds the shaft: the motor presses against it", _attribute("jammed")
        ),
        "push": Kind("a steady torque on the shaft, N m", _PUSH, -100, 100),
        "zero_offset": Kind("shaft ahead of its registers, degrees", _ZERO_OFFSET, -3600, 3600),
        "turn": Kind("a hand turns the shaft, degrees; not against torque", _turn, -3600, 3600),
        "lost_turns": Kind(
            "counts wrong by this number of revolutions",
            _lose_revolutions,
            -255,
            255,
            whole=True,
            families=("dynamixel_x",),
        ),
        "reboot": Kind("restarts by itself", lambda servo, _: servo.reboot()),
        "hot": Kind("temperature of the motor, C", _heat, 0, 150),
        **{
            name: Kind(f"hardware error: {name}", _shutdown(name), families=families)
            for name, families in _ERROR_FAMILIES.items()
        },
        "watchdog_tripped": Kind(
            "its Bus Watchdog has tripped",
            _register("bus_watchdog", lambda _: TRIPPED),
            families=("dynamixel_x",),
        ),
        "backlash": Kind("play between motor and shaft, degrees", _BACKLASH, 0, 20, families=STS),
        "homing_offset": Kind(
            "its Homing Offset, ticks", _register("homing_offset"), -2047, 2047, whole=True
        ),
        "firmware": Kind(
            "another firmware version", _register("firmware_version"), 1, 255, whole=True
        ),
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
        "return_delay": Kind(
            "waits, 2 us a count", _register("return_delay_time"), 0, 254, whole=True
        ),
        "status_level": Kind(
            "Status Return Level", _register("status_return_level"), 0, 2, whole=True
        ),
        "baud": Kind("its baud rate, bit/s", _BAUD, 9600, 4_500_000, whole=True),
        "id": Kind(
            "its id; if it is in use, status packets collide",
            _register("id"),
            *_ID_RANGE,
            whole=True,
        ),
        "model": Kind("reports this model number", _register("model_number"), 0, 65535, whole=True),
        "supply": Kind("supply, V; far too low: it restarts", _SUPPLY, 0, 30),
        "extra": Kind(
            "an additional servo with this id", _add_servo, *_ID_RANGE, whole=True, servo=False
        ),
        **{name: Kind(row.help, _chance(name), 0, 1, servo=False) for name, row in SPOILS.items()},
        "echo": Kind("the adapter returns what was sent", _attribute("echo"), servo=False),
        "latency": Kind("delay of all status packets, ms", _LATENCY, 0, 1000, servo=False),
        "port_unplugged": Kind("the port is gone", _attribute("unplugged"), servo=False),
    }
)
"""Every kind of fault, by name. The only place of registration."""


class FaultFile(Table):
    """A file of faults.

    Attributes:
        version: Schema of the file.
        seed: Seed of the random faults of the wire.
        faults: The faults.
    """

    version: SchemaVersion
    seed: int = 0
    faults: Annotated[tuple[Annotated[Fault, keys_of(Fault)], ...], Field(strict=False)] = ()


def load_faults(path: Path | str, config: ArmConfig) -> FaultFile:
    """Return the faults of a file for an arm.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or a key is unknown, missing or out of
            range.
    """
    path = Path(path)
    return parse_faults(read_text(path, "the file of faults"), config, path)


def parse_faults(text: str, config: ArmConfig, file: Path | str = "<text>") -> FaultFile:
    """Return the faults of a text. ``file`` is its name in errors."""
    fault_file = check_table(FaultFile, parse_toml(text, file), file)
    for k, fault in enumerate(fault_file.faults):
        make_fault(config, file, f"faults[{k}]", **dataclasses.asdict(fault))
    return fault_file


def make_fault(
    config: ArmConfig, file: Path | str = "<text>", at: str = "fault", **keys: Any
) -> Fault:
    """Return a fault, checked as in a file of faults.

    Args:
        config: Arm.
        file: Name of the file for errors.
        at: Place in that file for errors.
        **keys: Keys of ``Fault``. A key that is None is left out.

    Raises:
        ConfigError: No such kind, servo or value. The error names file and place.
    """
    try:
        fault = Fault(**{name: value for name, value in keys.items() if value is not None})
        fault.require_servo(config)
    except KeyProblem as wrong:
        raise wrong.within((), at).in_file(file) from None
    return fault
