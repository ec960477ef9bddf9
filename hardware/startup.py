"""Before an arm may move: are these the servos of the arm file, healthy, and set up as the program assumes?

Nothing here switches torque on.  EEPROM is written only where it differs (it wears out), with torque off.
After a fault: servos restarted, the port opened again, everything verified anew; torque is left alone.
What asks servos raises the errors of the bus too, by joint name.
"""

from __future__ import annotations

import logging
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
    UnsafeCommandError,
)
from robot_ik.hardware.bus import ServoBus, read_all, require_models
from robot_ik.hardware.calibration import check_calibration, own_calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import TRIPPED
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.register_access import write_register
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import Drive
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

T = TypeVar("T")

RESTART_TIME = 2.0
"""s a servo is given to answer after a reboot; it takes some tenths."""

WATCHDOG = "bus_watchdog"
"""What a servo whose watchdog has tripped is said to have, beside hardware errors."""

_POLL = 0.05  # s between two looks
_NO_REPLY = (BusTimeoutError, BusCorruptError)


def verify(
    bus: ServoBus, config: ArmConfig, *, real: bool, currents: Mapping[str, float] | None = None
) -> Feedback:
    """These are the arm file's servos, healthy and set up; what a control cycle reads from them.

    ``real``: not made from the arm file; they are compared with the calibration beside it as well.
    ``currents``: see ``set_up_servos``.

    Raises:
        ServoMismatchError: Missing or another model.
        MotorFaultError: A latched hardware error, or a supply outside the servo's limits.
        CalibrationMismatchError: With a table of what differs.  Otherwise as ``set_up_servos``.
    """
    wanted = {drive.id: (drive.name, drive.servo.table.number) for drive in config.drives}
    require_models(bus, wanted, "the arm file")
    family = config.family
    family.prepare(bus, config)
    errors = read_all(bus, config, "hardware_error_status")
    faulty = [(drive.name, family.error_names(errors[drive.id])) for drive in config.drives]
    faulty = [row for row in faulty if row[1]]
    if faulty:
        others = ", ".join(f"{name} ({', '.join(names)})" for name, names in faulty[1:])
        hint = "remove the cause, support the arm, then: robot-ik servo reset-fault"
        raise MotorFaultError(*faulty[0], hint=(f"likewise {others}; " if others else "") + hint)
    _check_voltage(bus, config)
    for drive in config.drives:
        family.clear_watchdog(bus, config, drive)
    if real and (found := own_calibration(config)) is not None:
        check_calibration(bus, config, found)
    set_up_servos(bus, config, currents or {})
    family.check_strength(bus, config)
    family.check_protection(bus, config)
    feedback = Feedback(config)
    feedback.prepare(bus, read_all(bus, config, "firmware_version"))
    return feedback


def _check_voltage(bus: ServoBus, config: ArmConfig) -> None:
    low, high = (read_all(bus, config, f"{end}_voltage_limit") for end in ("min", "max"))
    volts = read_all(bus, config, "present_input_voltage")
    for drive in config.drives:
        value = volts[drive.id]
        if not low[drive.id] <= value <= high[drive.id]:
            raise MotorFaultError(
                drive.name,
                ("input_voltage",),
                hint=f"its supply is {value / 10:.1f} V, allowed are {low[drive.id] / 10:.1f} to "
                f"{high[drive.id] / 10:.1f} V",
            )


def set_up_servos(bus: ServoBus, config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Set up every servo as program and arm file need it; see ``ServoFamily.set_up``.

    What lies in RAM (currents, gains, profile) is lost when a servo restarts: this is called again then.

    Args:
        bus: Open bus.
        config: Arm file.
        currents: Joint name -> mA that the program asked for.  Other joints get what the arm file says.
    """
    config.family.set_up(bus, config)
    if config.family.capabilities.current_goal:
        for drive in config.drives:
            if drive.servo.presses:
                _set_current(bus, drive, currents.get(drive.name))


def set_currents(bus: ServoBus, config: ArmConfig, wanted: Mapping[str, float]) -> None:
    """Goal Current of joints: joint name -> mA, at most ``current_ma`` of the arm file and Current Limit.

    Raises:
        UnknownJointError, UnsafeCommandError: As ``check_currents``; nothing was sent.
        HardwareError: A servo reads back otherwise.  Errors of the bus.
    """
    check_currents(config, wanted)
    for drive in config.drives:
        if drive.name in wanted:
            _set_current(bus, drive, wanted[drive.name])


def check_currents(config: ArmConfig, wanted: Mapping[str, float]) -> None:
    """``wanted``: joint name -> mA.

    Raises:
        UnknownJointError, UnsafeCommandError: Not a joint in current-based position mode, or no current.
    """
    for name, current in wanted.items():
        joint = config.joint(name)
        servo = joint.servo
        if not servo.presses:
            raise UnsafeCommandError(
                f"a current for {name!r} in mode {servo.mode.name.lower()}", "current_based_position"
            )
        number = finite(current)
        if number is None or number < servo.table.current_unit:
            raise UnsafeCommandError(
                f"{reprlib.repr(current)} mA for {name!r}", f"{servo.table.current_unit:g} mA and more"
            )


def _set_current(bus: ServoBus, drive: Drive, wanted: float | None) -> None:
    """Goal Current of one servo, which lies in RAM; ``wanted``: mA, None: as much as the arm file allows."""
    joint, servo = drive
    limit = bus.read(servo.id, servo.table["current_limit"]).data or 0
    given = [mA for mA in (joint.current, wanted) if mA is not None]
    counts = min([limit, *(int(mA / servo.table.current_unit) for mA in given)])
    write_register(bus, drive, "goal_current", counts)


# ------------------------------------------------------------------------------------------
# After a fault.


@dataclass(frozen=True)
class ServoReset:
    """What became of one servo.

    Attributes:
        joint, id: Whose.
        before: Hardware errors, and ``WATCHDOG`` if that had tripped; empty: nothing to reset.
        after: The same now; None: it does not answer.
        turned: Ticks by which its reading changed: whole revolutions that it has forgotten.
        silence: The error of the bus, where it does not answer.
    """

    joint: str
    id: int
    before: tuple[str, ...]
    after: tuple[str, ...] | None
    turned: int = 0
    silence: BusTimeoutError | BusCorruptError | None = None

    @property
    def restarted(self) -> bool:
        """It was rebooted: it has no torque, and its RAM registers are at their defaults."""
        return bool(set(self.before) - {WATCHDOG})

    @property
    def ok(self) -> bool:
        """Healthy now, and its angle is what it was."""
        return self.after == () and abs(self.turned) < TICKS_PER_REVOLUTION // 2


def reset_servos(bus: ServoBus, config: ArmConfig) -> list[ServoReset]:
    """Reboots servos with a hardware error, clears watchdogs that have tripped, and looks at all again.

    Returns:
        A row for every servo of the arm, also where it does not answer.

    Raises:
        BusDisconnectedError, BusNotOpenError, ServoRefusedError: By joint name.
    """
    rows = []
    for drive in config.drives:
        ticks, found, silence = _look(bus, config, drive)
        rows.append((drive, ticks, ServoReset(drive.name, drive.id, found or (), found, silence=silence)))
    for drive, _, row in rows:
        if row.restarted:
            log.info("resetting servo %d (%s)", drive.id, drive.name)
            config.family.reset(bus, drive)
        elif row.before:
            bus.write(drive.id, drive.servo.table["bus_watchdog"], 0)
    reset = []
    for drive, ticks, row in rows:
        if row.before:
            here, after, silence = _look(bus, config, drive, restarted=row.restarted)
            turned = 0 if after is None else here - ticks
            row = replace(row, after=after, turned=turned, silence=silence)
        reset.append(row)
    return reset


def _look(
    bus: ServoBus, config: ArmConfig, drive: Drive, *, restarted: bool = False
) -> tuple[int, tuple[str, ...] | None, BusTimeoutError | BusCorruptError | None]:
    """Where it stands, ticks, and its troubles; None and the error where it does not answer."""
    servo = drive.servo
    try:
        if restarted:
            bus.clock.sleep_until(bus.clock.now() + _POLL)  # or it answers before it goes
            _until(bus.clock, RESTART_TIME, _NO_REPLY, lambda: bus.ping(servo.id))
        here = bus.read(servo.id, servo.table["present_position"]).data or 0
        value = bus.read(servo.id, servo.table["hardware_error_status"]).data or 0
        found = config.family.error_names(value)
        if WATCHDOG in servo.table and bus.read(servo.id, servo.table[WATCHDOG]).data == TRIPPED:
            found += (WATCHDOG,)
    except _NO_REPLY as error:
        return 0, None, error
    return here, found, None


def _until(
    clock: Clock, timeout: float, errors: tuple[type[HardwareError], ...], action: Callable[[], T]
) -> T:
    """What ``action`` gives as soon as it raises none of ``errors``; the last one after ``timeout`` s."""
    end = clock.now() + timeout
    while True:
        try:
            return action()
        except errors:
            if clock.now() >= end:
                raise
        clock.sleep_until(clock.now() + _POLL)


def find_again(
    bus: ServoBus, config: ArmConfig, timeout: float, *, real: bool, currents: Mapping[str, float]
) -> Feedback:
    """Opens the port as soon as it is there again and stays, and verifies what is behind it.

    Raises:
        BusNotOpenError, BusDisconnectedError: It was not there for ``timeout`` s.  As ``verify``.
    """
    bus.close()

    def there() -> Feedback:
        bus.open()
        return verify(bus, config, real=real, currents=currents)

    return _until(bus.clock, timeout, (BusNotOpenError, BusDisconnectedError), there)


def check_revolutions_kept(bus: ServoBus, config: ArmConfig, before: Mapping[int, int]) -> None:
    """A servo that restarted counts its revolutions anew: then its angle is wrong by whole revolutions.

    ``before``: servo id -> ticks where it was last seen.

    Raises:
        HardwareError: A shaft stands more than half a servo revolution from where it was last seen.
    """
    for id, ticks in read_all(bus, config, "present_position").items():
        last = before.get(id)
        if last is not None and abs(ticks - last) > TICKS_PER_REVOLUTION / 2:
            drive = next(drive for drive in config.drives if drive.id == id)
            there, here = (drive.joint.text(drive.value(t)) for t in (last, ticks))
            raise HardwareError(
                f"joint {drive.name!r} was at {there} and reads {here} after the fault",
                hint="its servo has lost count of its revolutions: turn the joint by hand until it reads "
                "right, or close the arm and correct zero_ticks",
            )
