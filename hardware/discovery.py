"""Who is on a wire: every id at every rate, with what it says of itself, and ids that two servos share.

Replies of two servos with one id collide: what arrives is damaged, and to a ping that everybody hears it
looks as if no servo had that id.  So a scan counts damaged bytes, and where it saw some it asks
every id alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from robot_ik.errors import ArmStateError, ConfigError, HardwareError
from robot_ik.hardware.bus import BROADCAST_ID
from robot_ik.hardware.family import ServoFamily, families
from robot_ik.hardware.models import (
    BAUD_RATES,
    control_table,
    model_by_number,
    model_name,
    require_id,
)
from robot_ik.hardware.registers import IDS, ControlTable
from robot_ik.hardware.serial_bus import SerialBus
from robot_ik.hardware.serial_port import RESPONSE_TIME

LIKELY = (
    1_000_000,
    57_600,
    2_000_000,
    3_000_000,
    4_000_000,
    115_200,
    4_500_000,
    9_600,
    500_000,
    250_000,
    128_000,
    76_800,
    38_400,
)
"""Rates in the order in which servos are likely to be found: set up, as bought, the rest."""

_MANY = 3  # rates at which no servos are all found again, but where a port has no rate
_READ_BYTES = 25  # of a read and its reply in Protocol 2, without the data; Protocol 1 has fewer
_READS = 4  # reads of changing registers that two servos with one id would have to answer alike


@dataclass(frozen=True)
class FoundServo:
    """One id that answers at one rate.

    Attributes:
        id, baud: Where; ``family``: how it talks.
        number: Model Number, None where replies were too damaged to tell.
        firmware: Version; ``voltage``, V; ``temperature``, C; ``return_delay``, us; ``torque``: on or off;
            each None if it could not be read.
        voltage_limits: The servo's own, V.
        temperature_limit: The servo's own, C; None if it could not be read.
        late: s by which its quickest reply came later than its bytes and ``return_delay`` ask for, or None.
        errors: Latched hardware errors by name.
        shared: Replies collide: two servos seem to have this id.
    """

    id: int
    baud: int
    family: ServoFamily
    number: int | None = None
    firmware: int | None = None
    voltage: float | None = None
    temperature: int | None = None
    return_delay: int | None = None
    torque: bool | None = None
    voltage_limits: tuple[float, float] = (0.0, math.inf)
    temperature_limit: int | None = None
    late: float | None = None
    errors: tuple[str, ...] = ()
    shared: bool = False

    @property
    def table(self) -> ControlTable | None:
        """Its registers; None for a model that is not known here."""
        known = None if self.number is None else model_by_number(self.number)
        return known and control_table(known.model, self.firmware or None)

    @property
    def model(self) -> str:
        """Its model's name, or what is known of it."""
        return "?" if self.number is None else model_name(self.number)


def scan(
    port: str,
    bauds: Sequence[int] = LIKELY,
    *,
    family: ServoFamily | None = None,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> list[FoundServo]:
    """Look for servos at every rate and read their state.  Writes nothing to any servo.

    Servos of two families do not share a wire: once one family has answered, the others are not tried.

    Args:
        port: Serial port.
        bauds: Rates to try, bit/s.
        family: The only family to look for; None: every family.
        progress: Called with what is going on and the share that is done.

    Returns:
        Servos by rate, then by id.

    Raises:
        BusNotOpenError, BusDisconnectedError: Or no servo talks at such a rate.
    """
    found: list[FoundServo] = []
    for k, baud in enumerate(bauds):
        for candidate in _candidates(baud, found, family):
            progress(f"{baud} baud", k / len(bauds))
            found += _scan_rate(port, baud, candidate, progress)
    progress("done", 1.0)
    return found


def _candidates(baud: int, found: Sequence[FoundServo], family: ServoFamily | None) -> list[ServoFamily]:
    """Return the families to look for at a rate: those that know it, or the one that has answered."""
    known = {servo.family.name for servo in found if servo.number is not None}
    if family is not None:
        return [family] if baud in family.baud_rates else []
    return [
        candidate
        for candidate in families()
        if baud in candidate.baud_rates and (not known or candidate.name in known)
    ]


def _scan_rate(
    port: str, baud: int, family: ServoFamily, progress: Callable[[str, float], None]
) -> list[FoundServo]:
    """Return the servos of one family at one rate, by id."""
    with closing(SerialBus(port, baud, family.protocol, retries=0)) as bus:
        bus.open()
        responses, damaged = bus.collect_pings(BROADCAST_ID, bus.listening_time)
        servos = [_details(bus, FoundServo(id, baud, family, *who)) for id, who in sorted(responses.items())]
        if damaged:
            rest = [id for id in IDS if id not in responses]
            servos += _one_by_one(bus, family, rest, progress)
    return sorted(servos, key=lambda servo: servo.id)


def no_reply_hint(bauds: Iterable[int]) -> str:
    """What to check when no servo answered."""
    rates = set(bauds)
    text = "check: is the servos' supply on? the cable, and its direction? is it the right port?"
    left = [rate for rate in BAUD_RATES if rate not in rates]
    return text + (f" rates not tried: {', '.join(map(str, left))}" if left else "")


def scan_notes(found: Sequence[FoundServo]) -> list[str]:
    """What is wrong with all of them together."""
    if len(found) > 1 and all(servo.shared for servo in found):
        return ["every reply is damaged: check the cable, its contacts and the adapter"]
    notes = [
        f"id {servo.id} at {servo.baud}: damaged replies. Two servos with this id? Connect one alone "
        "and give it another: robot-ik servo setup --id N"
        for servo in found
        if servo.shared
    ]
    rates: dict[int, list[str]] = {}
    for servo in found:
        rates.setdefault(servo.baud, []).append(str(servo.id))
    if len(rates) >= _MANY and len(set(map(tuple, rates.values()))) == 1:
        notes.append(
            "they answer at every rate: the port has none of its own, as a pseudo terminal "
            "(robot-ik sim-bus --match-baud serves servos that hear one rate only)"
        )
    elif len(rates) > 1:
        listed = "; ".join(f"{baud}: id {', '.join(ids)}" for baud, ids in rates.items())
        notes.append(
            f"they talk at different rates ({listed}). "
            "Connect one alone: robot-ik servo setup --id N --baud RATE"
        )
    return notes


def _one_by_one(
    bus: SerialBus, family: ServoFamily, ids: Sequence[int], progress: Callable[[str, float], None]
) -> list[FoundServo]:
    """Servos that the ping to all did not find, and ids from which only damaged replies come."""
    found: dict[int, FoundServo] = {}
    for k, id in enumerate(ids):
        progress(f"{bus.baud} baud, id {id}", k / len(ids))
        responses, damaged = bus.collect_pings(id, RESPONSE_TIME)
        if damaged and id not in responses:
            responses, damaged = bus.collect_pings(id, RESPONSE_TIME)  # noise can hit one reply
        for other, who in responses.items():
            found[other] = _details(bus, FoundServo(other, bus.baud, family, *who))
        if damaged and id not in responses:
            found[id] = FoundServo(id, bus.baud, family, shared=True)
    return list(found.values())


def _details(bus: SerialBus, servo: FoundServo) -> FoundServo:
    """The same servo with its state, and whether its replies collide with another's."""
    table = servo.table or servo.family.common_table
    before = bus.counters.corrupt
    values: dict[str, int] = {}
    quickest = math.inf  # a busy computer is not the adapter's fault
    names = (
        "firmware_version",
        "return_delay_time",
        "torque_enable",
        "hardware_error_status",
        "present_input_voltage",
        "present_temperature",
        "min_voltage_limit",
        "max_voltage_limit",
        "temperature_limit",
        *servo.family.changing_registers * (_READS // 2),
    )
    for name in names:
        begin = time.perf_counter()
        try:
            values[name] = bus.read(servo.id, table[name]).data or 0
        except HardwareError:  # a timeout, a refusal or damage: what is not known stays None
            continue
        bytes_of_both = _READ_BYTES + table[name].size
        quickest = min(quickest, time.perf_counter() - begin - bytes_of_both * 10.0 / servo.baud)
    volts, delay, torque = (values.get(name) for name in ("present_input_voltage", *names[1:3]))
    low, high = (values.get(f"{end}_voltage_limit") for end in ("min", "max"))
    return replace(
        servo,
        firmware=values.get("firmware_version", servo.firmware),
        voltage=None if volts is None else volts / 10.0,
        temperature=values.get("present_temperature"),
        voltage_limits=(0.0 if low is None else low / 10.0, math.inf if high is None else high / 10.0),
        temperature_limit=values.get("temperature_limit"),
        return_delay=None if delay is None else 2 * delay,
        torque=None if torque is None else bool(torque),
        late=None if delay is None else max(quickest - 2e-6 * delay, 0.0),
        errors=servo.family.error_names(values.get("hardware_error_status", 0)),
        shared=bus.counters.corrupt - before > 1,
    )


# ------------------------------------------------------------------------------------------
# A servo as bought gets its id and baud rate: alone on the wire, without torque, and read back.


def _only_one(found: Sequence[FoundServo]) -> FoundServo:
    """The servo that may be set up, of those (at least one) that answer; else raises ``HardwareError``."""
    shared = [servo for servo in found if servo.shared]
    if shared:
        raise HardwareError(
            f"id {shared[0].id} gives damaged replies: two servos with one id, or a bad cable",
            hint="connect one servo alone and try again",
        )
    if len(found) > 1:
        names = ", ".join(f"id {s.id} {s.model} at {s.baud}" for s in found)
        raise HardwareError(
            f"{len(found)} servos answer ({names}); exactly one may be connected, nothing was written",
            hint="unplug the others: an id that is taken would make both of them unreachable",
        )
    if found[0].table is None:
        raise HardwareError(f"{found[0].model} is not a servo that is known here; nothing was written")
    return found[0]


def set_up(
    port: str,
    id: int,
    baud: int,
    *,
    model: str = "",
    bauds: Sequence[int] = LIKELY,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> FoundServo | None:
    """Writes id and baud rate into the EEPROM of the only servo on a port, and asks it for both there.

    ``model`` it must have, if any; ``bauds`` and ``progress`` as for ``scan``.

    Returns:
        The servo as it was found; None where none answers.

    Raises:
        ConfigError: The model is another, or cannot have this id or rate.
        ArmStateError: Its torque is on.
        HardwareError: More than one answers, two share an id, the model is not known, or it does not answer
            under the new address as it should; errors of the bus.
    """
    require_id(id, "--id")
    found = scan(port, bauds, progress=progress)
    if not found:
        return None
    servo = _only_one(found)
    table = servo.table
    if table is None:
        raise HardwareError("the control table of this model is not known")
    if model and servo.model != model:
        raise ConfigError(
            f"this servo is a {servo.model}", file="command line", key="--joint", allowed=f"a {model}"
        )
    if baud not in table.baud_rates:
        allowed = ", ".join(map(str, table.baud_rates))
        raise ConfigError(
            f"{servo.model} cannot talk at {baud} bits/s", file="command line", key="--baud", allowed=allowed
        )
    family = servo.family
    with closing(SerialBus(port, servo.baud, family.protocol)) as bus:
        bus.open()
        at = servo.id
        if bus.read(at, table["torque_enable"]).data:
            raise ArmStateError(
                f"torque of the servo (id {at}) is on, so its EEPROM is locked; nothing was written",
                hint="support what hangs on it and switch it off: robot-ik servo torque off --ids "
                f"{at} --baud {servo.baud}",
            )
        family.write_address(bus, table, at, id, baud)
    with closing(SerialBus(port, baud, family.protocol)) as bus:
        bus.open()
        with family.eeprom_unlocked(bus, [id]):
            names = ("model_number", "id", "baud_rate", "return_delay_time")
            said = tuple(bus.read(id, table[name]).data for name in names)
    if said != (servo.number, id, table.baud_code(baud), 0):
        raise HardwareError(f"id {id} at {baud} baud reads back model, id, rate, delay = {said}")
    return servo
