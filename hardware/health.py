"""The state of every servo, and the doctor's check of a port. Writes nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from robot_ik.errors import HardwareError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.checks import NOTE, OK, PROBLEM, CheckRow
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.discovery import (
    BITS_PER_BYTE,
    LIKELY,
    FoundServo,
    no_reply_hint,
    scan,
)
from robot_ik.hardware.family import family_of
from robot_ik.hardware.ports import quicker, serial_row
from robot_ik.hardware.servo import Drive


@dataclass(frozen=True)
class ServoState:
    """One servo at one moment. Values that the servo does not give are None.

    Attributes:
        joint: Name of the joint.
        id: Servo id.
        position_deg: Joint value, deg.
        velocity_deg: Joint velocity, deg/s.
        ticks: Present Position.
        current_ma: Motor current, mA.
        load_percent: Load of a servo that measures no current.
        voltage: Supply, V.
        temperature: C.
        torque: Torque is on.
        errors: Latched hardware errors.
        position_mm: Joint value of a sliding joint, mm, instead of ``position_deg``.
        velocity_mm: Velocity of a sliding joint, mm/s.
    """

    joint: str
    id: int
    position_deg: float | None = None
    velocity_deg: float | None = None
    ticks: int | None = None
    current_ma: float | None = None
    load_percent: float | None = None
    voltage: float | None = None
    temperature: int | None = None
    torque: bool | None = None
    errors: tuple[str, ...] = ()
    position_mm: float | None = None
    velocity_mm: float | None = None

    @property
    def answered(self) -> bool:
        """Every block of the servo was read."""
        return self.ticks is not None and self.torque is not None


def read_states(bus: ServoBus, drives: Sequence[Drive]) -> list[ServoState]:
    """Return the state of servos of one family, in the same order.

    Raises:
        BusDisconnectedError, BusNotOpenError: The port went away or is not open.
    """
    if not drives:
        return []
    table = drives[0].servo.table
    ids = [drive.id for drive in drives]
    values: dict[int, dict[str, int]] = {id: {} for id in ids}
    for block in family_of(table.family).state_blocks(table):
        for drive, status in zip(drives, bus.sync_read(ids, block).values(), strict=True):
            if status.data is not None:
                values[drive.id] |= drive.servo.table.values(block, status.data)
    return [_state(drive, values[drive.id]) for drive in drives]


def _state(drive: Drive, values: Mapping[str, int]) -> ServoState:
    joint, servo = drive
    table = servo.table
    family = family_of(table.family)
    if not values:
        return ServoState(joint.name, servo.id)

    def scaled(name: str, factor: float) -> float | None:
        return values[name] * factor if name in values else None

    position = drive.value(values["present_position"]) if "present_position" in values else None
    lever = joint.gear.lever(joint.lower if position is None else position)
    speed = family.velocity_unit * servo.direction * lever / joint.per_unit
    shown = None if position is None else position / joint.per_unit
    return ServoState(
        joint.name,
        servo.id,
        ticks=values.get("present_position"),
        current_ma=scaled("present_current", table.current_unit),
        load_percent=scaled("present_load", 0.1),
        voltage=scaled("present_input_voltage", 0.1),
        temperature=values.get("present_temperature"),
        torque=bool(values["torque_enable"]) if "torque_enable" in values else None,
        errors=family.error_names(values.get("hardware_error_status", 0)),
        **{
            f"position_{joint.unit}": shown,
            f"velocity_{joint.unit}": scaled("present_velocity", speed),
        },
    )


WATCHDOG_FIRMWARE = 38
"""First firmware of X servos with a Bus Watchdog."""

_LATE = 4e-3
"""s. Largest usual lateness of a reply.

A latency timer of 1 ms, the computer and its USB are below it.
"""

_CYCLE_BYTES = 14 + 14
"""Bytes of a cycle besides those of its servos: a sync write and a sync read."""
_CYCLE_BYTES_EACH = 5 + 1 + 16
"""Bytes of each servo in a cycle: goal, id, status packet."""

_WARM = 10
"""C below the temperature limit from which a servo counts as warm."""


def servo_rows(port: str, config: ArmConfig) -> list[CheckRow]:
    """Return checks of the port, of every servo of the arm file, and of other servos.

    All rates are tried only if a servo does not answer at the arm file's rate.
    """
    try:
        servos = scan(port, [config.baud], family=config.family)
        answered_ids = {servo.id for servo in servos}
        if not answered_ids.issuperset(config.servo_ids):
            servos += scan(
                port, [rate for rate in LIKELY if rate != config.baud], family=config.family
            )
    except HardwareError as error:
        return [CheckRow("servos", PROBLEM, str(error.args[0]), error.hint.splitlines()[0])]
    rows = [serial_row(port, "servos")]
    if not servos:
        return [
            *rows,
            CheckRow("servos", PROBLEM, f"no servo answers on {port}", no_reply_hint(LIKELY)),
        ]
    rows += _speed_rows(port, config, servos)
    for drive in config.drives:
        rows.append(_joint_row(drive, [f for f in servos if f.id == drive.id], config))
    known = set(config.servo_ids)
    for f in (f for f in servos if f.id not in known):
        problem = f"{f.model} at {f.baud}: not in the arm file"
        rows.append(CheckRow(f"servo {f.id}", NOTE, problem, "unplug it, or add its joint"))
    return rows


def _speed_rows(port: str, config: ArmConfig, servos: Sequence[FoundServo]) -> list[CheckRow]:
    """Return the check of how late replies come, and of the cycle rate that this allows."""
    lates = [
        f.late for f in servos if f.baud == config.baud and not f.shared and f.late is not None
    ]
    if not lates:
        return []
    late = min(lates)
    byte_time = BITS_PER_BYTE / config.baud
    cycle_bytes = _CYCLE_BYTES + _CYCLE_BYTES_EACH * len(config.servo_ids)
    rate = 1.0 / (late + cycle_bytes * byte_time)
    text = f"a reply comes {1e3 * late:.1f} ms late: about {rate:.0f} cycles a second"
    if rate >= config.rate_hz and late < _LATE:
        return [CheckRow("servo speed", OK, text)]
    return [
        CheckRow(
            "servo speed",
            NOTE,
            f"{text}; rate_hz of the arm file is {config.rate_hz:g}",
            quicker(port),
        )
    ]


def _joint_row(drive: Drive, servos: Sequence[FoundServo], config: ArmConfig) -> CheckRow:
    servo = drive.servo
    what = f"servo {servo.id} {drive.name}"
    if not servos:
        do = (
            "check its cable and power; from the factory it has id 1: "
            f"robot-ik servo setup --joint {drive.name}"
        )
        return CheckRow(what, PROBLEM, f"no {servo.model} answers with this id at any rate", do)
    if len(servos) > 1 or servos[0].shared:
        do = "connect one of them alone and give it another id: robot-ik servo setup --id N"
        return CheckRow(what, PROBLEM, "replies collide: two servos with this id", do)
    f = servos[0]
    supply = "" if f.voltage is None else f", {f.voltage:.1f} V"
    warm = "" if f.temperature is None else f", {f.temperature} C"
    about = f"{f.family.title} {f.model}, firmware {f.firmware}{supply}{warm}"
    for status, problem, do in _findings(drive, f, config):
        return CheckRow(what, status, f"{about}: {problem}", do)
    return CheckRow(what, OK, about)


def _findings(drive: Drive, f: FoundServo, config: ArmConfig) -> Iterator[tuple[str, str, str]]:
    """Yield (status, problem, what to do), the worst first."""
    servo = drive.servo
    capabilities = config.family.capabilities
    setup = f"connect it alone: robot-ik servo setup --joint {drive.name}"
    if f.model != servo.model:
        yield PROBLEM, f"the arm file says {servo.model}", "correct the arm file, or the servo's id"
    if f.baud != config.baud:
        yield PROBLEM, f"its baud rate is {f.baud}, that of the arm file {config.baud}", setup
    low, high = f.voltage_limits
    if f.voltage is not None and not low <= f.voltage <= high:
        text = f"its supply must be {low:.1f} to {high:.1f} V"
        yield PROBLEM, text, "check the power supply and the voltage drop along the cables"
    if f.errors:
        do = "remove the cause, support the arm, then: robot-ik servo reset-fault"
        yield PROBLEM, f"it has shut down or warns: {', '.join(f.errors)}", do
    if (
        capabilities.bus_watchdog
        and f.firmware is not None
        and "bus_watchdog" not in (f.table or servo.table)
    ):
        text = (
            f"no Bus Watchdog before firmware {WATCHDOG_FIRMWARE}: it does not stop when the cable "
            "is pulled"
        )
        do = "update it with DYNAMIXEL Wizard 2, or set watchdog_ms = 0 and stay beside the arm"
        yield PROBLEM, text, do
    hottest = f.temperature_limit
    if f.temperature is not None and hottest is not None and f.temperature > hottest - _WARM:
        yield NOTE, f"it shuts down at {hottest} C", "let it cool; lighten its load"
    if f.torque is None:
        text = "it answers pings only: its Status Return Level is 0"
        yield NOTE, text, "nothing: every start of the arm sets 2"
    if f.torque:
        yield NOTE, "its torque is on", "switch it off with: robot-ik servo torque off"
    if f.table is not None and "fast_read" in servo.table.abilities - f.table.abilities:
        yield (
            NOTE,
            "its firmware has no fast reads: cycles take longer",
            "update it when convenient",
        )
    if f.return_delay:
        text = f"it waits {f.return_delay} us before each reply"
        yield NOTE, text, "nothing: every start of the arm sets 0"
