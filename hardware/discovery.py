"""The servos on a wire: every id at every rate, and ids that two servos share.

Replies of two servos with one id collide.  What arrives is damaged, and to a broadcast ping it
looks as if no servo had that id.  So a scan counts damaged bytes, and if there are some it asks
every id alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from robot_ik.errors import HardwareError
from robot_ik.hardware.bus import BROADCAST_ID
from robot_ik.hardware.family import ServoFamily, families
from robot_ik.hardware.models import BAUD_RATES, control_table, model_by_number, model_name
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
"""Rates in the order in which servos are likely to be found: set up, as bought, the others."""

SAME_RATES = 3
"""Number of rates. If the same ids answer at this many rates, the port has no baud rate."""

READ_BYTES = 25
"""Bytes of a read and its reply in Protocol 2, without the data.  Protocol 1 has fewer."""

CHANGING_READS = 4
"""Reads of registers that change.  Two servos with one id hardly ever answer all of them alike."""

DAMAGED_READS = 1
"""Damaged replies that noise may cause while one servo is read."""

BITS_PER_BYTE = 10.0
"""Bits of a byte on the wire: start bit, 8 data bits, stop bit."""

COUNTS_PER_VOLT = 10.0
"""Counts of the voltage registers for 1 V."""

DELAY_UNIT = 2
"""us of one count of Return Delay Time."""

Progress = Callable[[str, float], None]
"""Called with the present step and the share of the scan that is done."""


def no_progress(_what: str, _share: float) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class FoundServo:
    """One id that answers at one rate.  Fields that could not be read are None.

    Attributes:
        id: Servo id.
        baud: Rate, bit/s.
        family: Servo family.
        number: Model Number; None: the replies were too damaged.
        firmware: Firmware version.
        voltage: Supply, V.
        temperature: C.
        return_delay: us.
        torque: Torque is on.
        voltage_limits: The servo's own limits, V.
        temperature_limit: The servo's own limit, C.
        late: s by which its quickest reply came later than its bytes and ``return_delay`` need.
        errors: Names of latched hardware errors.
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
        """Control table; None for an unknown model."""
        model = None if self.number is None else model_by_number(self.number)
        return None if model is None else control_table(model.model, self.firmware or None)

    @property
    def model(self) -> str:
        """Name of the model; for an unknown one its number."""
        return "?" if self.number is None else model_name(self.number)


def scan(
    port: str,
    bauds: Sequence[int] = LIKELY,
    *,
    family: ServoFamily | None = None,
    progress: Progress = no_progress,
) -> list[FoundServo]:
    """Look for servos at every rate and read their state.  Writes nothing to any servo.

    Servos of two families do not share a wire: once one family has answered, the others are not
    tried.

    Args:
        port: Serial port.
        bauds: Rates to try, bit/s.
        family: The only family to look for; None: every family.
        progress: Called during the scan.

    Returns:
        Servos by rate, then by id.

    Raises:
        BusNotOpenError: The port cannot be opened, or does not support a rate.
        BusDisconnectedError: The port went away.
    """
    servos: list[FoundServo] = []
    for k, baud in enumerate(bauds):
        for candidate in _candidates(baud, servos, family):
            progress(f"{baud} baud", k / len(bauds))
            servos += _scan_rate(port, baud, candidate, progress)
    progress("done", 1.0)
    return servos


def _candidates(
    baud: int, servos: Sequence[FoundServo], family: ServoFamily | None
) -> list[ServoFamily]:
    """Return the families to look for at a rate: those that have it, or the one that answered."""
    answered = {servo.family.name for servo in servos if servo.number is not None}
    if family is not None:
        return [family] if baud in family.baud_rates else []
    return [
        candidate
        for candidate in families()
        if baud in candidate.baud_rates and (not answered or candidate.name in answered)
    ]


def _scan_rate(port: str, baud: int, family: ServoFamily, progress: Progress) -> list[FoundServo]:
    """Return the servos of one family at one rate, by id."""
    with closing(SerialBus(port, baud, family.protocol, retries=0)) as bus:
        bus.open()
        replies, damaged = bus.collect_pings(BROADCAST_ID, bus.listening_time)
        servos = [
            _with_state(bus, FoundServo(id, baud, family, *reply))
            for id, reply in sorted(replies.items())
        ]
        if damaged:
            other_ids = [id for id in IDS if id not in replies]
            servos += _scan_ids(bus, family, other_ids, progress)
    return sorted(servos, key=lambda servo: servo.id)


def _scan_ids(
    bus: SerialBus, family: ServoFamily, ids: Sequence[int], progress: Progress
) -> list[FoundServo]:
    """Ping every id alone, and return all servos, also ids with damaged replies only."""
    servos: dict[int, FoundServo] = {}
    for k, id in enumerate(ids):
        progress(f"{bus.baud} baud, id {id}", k / len(ids))
        replies, damaged = bus.collect_pings(id, RESPONSE_TIME)
        if damaged and id not in replies:
            replies, damaged = bus.collect_pings(id, RESPONSE_TIME)  # noise can hit one reply
        for other, reply in replies.items():
            servos[other] = _with_state(bus, FoundServo(other, bus.baud, family, *reply))
        if damaged and id not in replies:
            servos[id] = FoundServo(id, bus.baud, family, shared=True)
    return list(servos.values())


def _with_state(bus: SerialBus, servo: FoundServo) -> FoundServo:
    """Return a servo with its state, and whether its replies collide with those of another."""
    table = servo.table or servo.family.common_table
    corrupt_before = bus.counters.corrupt
    values: dict[str, int] = {}
    quickest = math.inf  # the quickest reply: a busy computer is not the adapter's fault
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
        *servo.family.changing_registers * (CHANGING_READS // 2),
    )
    for name in names:
        begin = time.perf_counter()
        try:
            values[name] = bus.read(servo.id, table[name]).data or 0
        except HardwareError:  # a timeout, a refusal or damage: the field stays None
            continue
        wire_time = BITS_PER_BYTE * (READ_BYTES + table[name].size) / servo.baud
        quickest = min(quickest, time.perf_counter() - begin - wire_time)

    voltage = values.get("present_input_voltage")
    delay = values.get("return_delay_time")
    torque = values.get("torque_enable")
    lowest = values.get("min_voltage_limit")
    highest = values.get("max_voltage_limit")
    return replace(
        servo,
        firmware=values.get("firmware_version", servo.firmware),
        voltage=None if voltage is None else voltage / COUNTS_PER_VOLT,
        temperature=values.get("present_temperature"),
        voltage_limits=(
            0.0 if lowest is None else lowest / COUNTS_PER_VOLT,
            math.inf if highest is None else highest / COUNTS_PER_VOLT,
        ),
        temperature_limit=values.get("temperature_limit"),
        return_delay=None if delay is None else DELAY_UNIT * delay,
        torque=None if torque is None else bool(torque),
        late=None if delay is None else max(quickest - 1e-6 * DELAY_UNIT * delay, 0.0),
        errors=servo.family.error_names(values.get("hardware_error_status", 0)),
        shared=bus.counters.corrupt - corrupt_before > DAMAGED_READS,
    )


def no_reply_hint(bauds: Iterable[int]) -> str:
    """Return what to check if no servo answered at these rates."""
    tried = set(bauds)
    text = "check: is the servos' supply on? the cable, and its direction? is it the right port?"
    others = [str(rate) for rate in BAUD_RATES if rate not in tried]
    return f"{text} rates not tried: {', '.join(others)}" if others else text


def scan_notes(servos: Sequence[FoundServo]) -> list[str]:
    """Return the problems that concern several servos of a scan."""
    if len(servos) > 1 and all(servo.shared for servo in servos):
        return ["every reply is damaged: check the cable, its contacts and the adapter"]
    notes = [
        f"id {servo.id} at {servo.baud}: damaged replies. Two servos with this id? Connect one "
        "alone and give it another: robot-ik servo setup --id N"
        for servo in servos
        if servo.shared
    ]
    rates: dict[int, list[str]] = {}
    for servo in servos:
        rates.setdefault(servo.baud, []).append(str(servo.id))
    if len(rates) >= SAME_RATES and len(set(map(tuple, rates.values()))) == 1:
        notes.append(
            "the servos answer at every rate: the port has no baud rate, like a pseudo terminal "
            "(with robot-ik sim-bus --match-baud each servo answers at its own rate only)"
        )
    elif len(rates) > 1:
        listed = "; ".join(f"{baud}: id {', '.join(ids)}" for baud, ids in rates.items())
        notes.append(
            f"the servos have different rates ({listed}). "
            "Connect one alone: robot-ik servo setup --id N --baud RATE"
        )
    return notes
