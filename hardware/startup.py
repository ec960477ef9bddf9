"""Before an arm may move: are these the servos of the arm file, healthy, and set up as the program assumes?

Nothing here switches torque on.  EEPROM is written only where it differs (it wears out), with torque off.
After a fault: servos restarted, the port opened again, everything verified anew; torque is left alone.
What asks servos raises the errors of the bus too, by joint name.
"""

from __future__ import annotations

import contextlib
import logging
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from robot_ik.errors import (
    ArmStateError,
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
    ServoRefusedError,
    UnsafeCommandError,
)
from robot_ik.hardware.bus import ServoBus, read_all, require_models
from robot_ik.hardware.calibration import check_calibration, own_calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import (
    RETURN_ALL,
    TICKS_PER_REVOLUTION,
    TRIPPED,
    OperatingMode,
    hardware_error_names,
)
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.joint_map import HOMING_FIXES, POSITION_MODE_HOMING, JointMap
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.torque import check_strength, set_profiles
from robot_ik.hardware.x_series import REVERSE
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

T = TypeVar("T")

NO_SECONDARY_ID = 255
"""Secondary ID of a servo that takes no other servo's packets."""

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
    wanted = {servo.id: (servo.name, servo.table.number) for servo in config.servos}
    require_models(bus, wanted, "the arm file")
    for joint in config.servos:
        _return_all(bus, joint)
    errors = read_all(bus, config, "hardware_error_status")
    faulty = [(joint.name, hardware_error_names(errors[joint.id])) for joint in config.servos]
    faulty = [row for row in faulty if row[1]]
    if faulty:
        others = ", ".join(f"{name} ({', '.join(names)})" for name, names in faulty[1:])
        hint = "remove the cause, support the arm, then: robot-ik servo reset-fault"
        raise MotorFaultError(*faulty[0], hint=(f"likewise {others}; " if others else "") + hint)
    _check_voltage(bus, config)
    for joint in config.servos:
        _clear_watchdog(bus, config, joint)
    if real and (found := own_calibration(config)) is not None:
        check_calibration(bus, config, found)
    set_up_servos(bus, config, currents or {})
    check_strength(bus, config)
    _warn_of_shutdown(bus, config)
    feedback = Feedback(config)
    feedback.prepare(bus, read_all(bus, config, "firmware_version"))
    return feedback


def _clear_watchdog(bus: ServoBus, config: ArmConfig, joint: JointMap) -> None:
    """One that is armed, or has tripped: then goals are refused until it is cleared."""
    watchdog = joint.table["bus_watchdog"]
    try:
        if bus.read(joint.id, watchdog).data != 0:
            bus.write(joint.id, watchdog, 0)
    except ServoRefusedError:
        if config.watchdog_ms:
            raise HardwareError(
                f"servo id {joint.id} (joint {joint.name!r}) has no bus watchdog; nothing was switched on",
                hint="firmware before 38 has none: update it, or set watchdog_ms = 0 and stay beside the arm",
            ) from None


def _warn_of_shutdown(bus: ServoBus, config: ArmConfig) -> None:
    """A servo whose Shutdown is 0 goes on under overload and heat until it is damaged."""
    masks = read_all(bus, config, "shutdown")
    if names := [servo.name for servo in config.servos if not masks[servo.id]]:
        log.warning("%s: Shutdown is 0, so no overload and no heat switches torque off", ", ".join(names))


def set_up_servos(bus: ServoBus, config: ArmConfig, currents: Mapping[str, float]) -> None:
    """Mode, return delay, drive mode, current limit, gains and profile as program and arm file need them.

    What lies in RAM (currents, gains, profile) is lost when a servo restarts: this is called again then.
    ``currents``: joint name -> mA that the program asked for; other joints get what the arm file says.

    Raises:
        ArmStateError: An EEPROM setting must change and torque is on (left so by another program).
        ConfigError: A servo in position mode has limits narrower than the arm file's, or ignores its offset.
        HardwareError: A servo is reversed by its own setting and not by the arm file, or the other way round.
    """
    torque = read_all(bus, config, "torque_enable")
    drive = read_all(bus, config, "drive_mode", absent=0)
    for joint in config.servos:
        _check_reverse(joint, bool(drive[joint.id] & REVERSE))
    _check_homing(bus, config)
    wanted = {
        "return_delay_time": dict.fromkeys(config.servo_ids, 0),
        "drive_mode": {id: value & REVERSE for id, value in drive.items()},
        "operating_mode": {joint.id: int(joint.mode) for joint in config.servos},
        # Else one that restarts may have torque at once, with nothing of what is set below.
        "startup_configuration": dict.fromkeys(config.servo_ids, 0),
    }
    for name, values in wanted.items():
        _set_eeprom(bus, config, name, values, torque)
    _check_shadows(bus, config)
    _check_servo_limits(bus, config)
    if named := [joint.name for joint in config.whole.joints if joint.current_limit is not None]:
        limited = config.only(named)
        units = {s.id: s.table.current_unit for s in limited.servos}
        counts = {s.id: int((s.current_limit or 0.0) / units[s.id]) for s in limited.servos}
        _set_eeprom(bus, limited, "current_limit", counts, torque)
    for servo in config.servos:
        if servo.mode == OperatingMode.CURRENT_BASED_POSITION:
            _set_current(bus, servo, currents.get(servo.name))
    for servo in config.servos:
        for name, value in servo.gains.registers.items():
            _write_register(bus, servo, name, value)
    set_profiles(bus, config)


def _check_reverse(servo: JointMap, found: bool) -> None:
    """Bit 0 of Drive Mode turns round position, goal and position limits: it is accepted, never changed here.

    Clearing it would give the limits in EEPROM another meaning, and the arm's own program sets it again.
    """
    if servo.reverse is None or servo.reverse == found:
        return
    where = f"joint {servo.name!r} (servo id {servo.id})"
    table = "[[joints]]" if servo.twin is not None or servo.shadow_of is None else "[joints.twin]"
    if found:
        raise HardwareError(
            f"{where} is set to turn in reverse (Drive Mode bit 0), and the arm file says nothing of it",
            hint=f"if the arm's maker has set it: reverse = true in its {table} table, usually with "
            "direction = 1 and zero_ticks = 2048; else clear it in the servo",
        )
    raise HardwareError(
        f"{where} has reverse = true in the arm file, and bit 0 of its Drive Mode is clear",
        hint=f"reverse = false in its {table} table and another `direction`; or set the bit in the servo, "
        "as its maker does",
    )


def _check_homing(bus: ServoBus, config: ArmConfig) -> None:
    """In position mode a servo ignores a Homing Offset beyond a quarter revolution: its zero is elsewhere.

    ROBOTIS-GIT/emanual _includes/en/dxl/control_table_homingoffset.md.  LeRobot writes such offsets.
    """
    offsets = read_all(bus, config, "homing_offset")
    for servo in config.servos:
        if servo.mode == OperatingMode.POSITION and abs(offsets[servo.id]) > POSITION_MODE_HOMING:
            problem = (
                f"{servo.name!r} (servo id {servo.id}) has a Homing Offset of {offsets[servo.id]} ticks, "
                "which servos in position mode ignore"
            )
            key = f"joints[{config.whole.names.index(servo.name)}].mode"
            raise config.wrong(problem, key, HOMING_FIXES)


def _return_all(bus: ServoBus, joint: JointMap) -> None:
    """Status Return Level 2: a servo at 0 or 1 would look dead."""
    register = joint.table["status_return_level"]
    with contextlib.suppress(BusTimeoutError):  # at level 0 it answers no reads …
        if bus.read(joint.id, register).data == RETURN_ALL:
            return
    with contextlib.suppress(BusTimeoutError):  # … and below 2 no writes
        bus.write(joint.id, register, RETURN_ALL)
    if bus.read(joint.id, register).data != RETURN_ALL:
        raise HardwareError(f"servo id {joint.id} (joint {joint.name!r}) keeps its status return level")


def _check_voltage(bus: ServoBus, config: ArmConfig) -> None:
    low, high = (read_all(bus, config, f"{end}_voltage_limit") for end in ("min", "max"))
    volts = read_all(bus, config, "present_input_voltage")
    for joint in config.servos:
        if not low[joint.id] <= (value := volts[joint.id]) <= high[joint.id]:
            raise MotorFaultError(
                joint.name,
                ("input_voltage",),
                hint=f"its supply is {value / 10:.1f} V, allowed are {low[joint.id] / 10:.1f} to "
                f"{high[joint.id] / 10:.1f} V",
            )


def _set_eeprom(
    bus: ServoBus, config: ArmConfig, name: str, wanted: Mapping[int, int], torque: Mapping[int, int]
) -> None:
    """A register of all servos, written only where it differs."""
    present = read_all(bus, config, name, absent=0)
    wrong = [joint for joint in config.servos if present[joint.id] != wanted[joint.id]]
    for joint in wrong:
        if torque[joint.id]:
            raise ArmStateError(
                f"{name} of joint {joint.name!r} must change, but its torque is on (left on by a program)",
                hint="support the arm, switch its torque off, and connect again",
            )
    for joint in wrong:
        log.info("%s of %s: %d -> %d", name, joint.name, present[joint.id], wanted[joint.id])
        _write_register(bus, joint, name, wanted[joint.id])


def _write_register(bus: ServoBus, servo: JointMap, name: str, value: int) -> None:
    """One register of one servo, read back."""
    register = servo.table[name]
    bus.write(servo.id, register, value)
    if bus.read(servo.id, register).data != value:
        raise HardwareError(
            f"{name} of joint {servo.name!r} (servo id {servo.id}) was written and reads back otherwise; "
            "no torque was changed"
        )


def _check_shadows(bus: ServoBus, config: ArmConfig) -> None:
    """A shadow must take its servo's goals, and no other servo may: it would move along."""
    heard = read_all(bus, config, "secondary_id", absent=NO_SECONDARY_ID)
    for joint in config.servos:
        value, wanted = heard[joint.id], joint.shadow_of
        if value != wanted and (wanted is not None or value in config.servo_ids):
            raise HardwareError(
                f"servo id {joint.id} (joint {joint.name!r}) has secondary id {value}, "
                + (
                    "which is no shadow's" if wanted is None else f"the arm file says a shadow of id {wanted}"
                ),
                hint=f"set its Secondary ID to {255 if wanted is None else wanted}, or correct the arm file",
            )


def _check_servo_limits(bus: ServoBus, config: ArmConfig) -> None:
    """In position mode a servo refuses goals outside its limits, and a sync write has no reply to say so."""
    lowest, highest = (read_all(bus, config, f"{end}_position_limit") for end in ("min", "max"))
    for joint in config.servos:
        first, last = joint.ticks_range
        low, high = lowest[joint.id], highest[joint.id]
        if joint.mode == OperatingMode.POSITION and not low <= first <= last <= high:
            ends = sorted(joint.to_radians(ticks) / joint.per_unit for ticks in (low, high))
            raise config.wrong(
                f"the servo's own limits (ticks {low} to {high}) are narrower than "
                f"lower_{joint.unit} .. upper_{joint.unit}",
                f"joints[{config.whole.names.index(joint.name)}]",
                f"{ends[0]:.1f} to {ends[1]:.1f} {joint.unit}, or other limits in the servo",
            )


def set_currents(bus: ServoBus, config: ArmConfig, wanted: Mapping[str, float]) -> None:
    """Goal Current of joints: joint name -> mA, at most ``current_ma`` of the arm file and Current Limit.

    Raises:
        UnknownJointError, UnsafeCommandError: As ``check_currents``; nothing was sent.
        HardwareError: A servo reads back otherwise.  Errors of the bus.
    """
    check_currents(config, wanted)
    for servo in config.servos:
        if servo.name in wanted:
            _set_current(bus, servo, wanted[servo.name])


def check_currents(config: ArmConfig, wanted: Mapping[str, float]) -> None:
    """``wanted``: joint name -> mA.

    Raises:
        UnknownJointError, UnsafeCommandError: Not a joint in current-based position mode, or no current.
    """
    for name, current in wanted.items():
        joint = config.joint(name)
        if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
            raise UnsafeCommandError(
                f"a current for {name!r} in mode {joint.mode.name.lower()}", "current_based_position"
            )
        number = finite(current)
        if number is None or number < joint.table.current_unit:
            raise UnsafeCommandError(
                f"{reprlib.repr(current)} mA for {name!r}", f"{joint.table.current_unit:g} mA and more"
            )


def _set_current(bus: ServoBus, servo: JointMap, wanted: float | None) -> None:
    """Goal Current of one servo, which lies in RAM; ``wanted``: mA, None: as much as the arm file allows."""
    limit = bus.read(servo.id, servo.table["current_limit"]).data or 0
    given = [mA for mA in (servo.current, wanted) if mA is not None]
    counts = min([limit, *(int(mA / servo.table.current_unit) for mA in given)])
    _write_register(bus, servo, "goal_current", counts)


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
    for servo in config.servos:
        ticks, found, silence = _look(bus, servo)
        rows.append((servo, ticks, ServoReset(servo.name, servo.id, found or (), found, silence=silence)))
    for servo, _, row in rows:
        if row.restarted:
            log.info("rebooting servo %d (%s)", servo.id, servo.name)
            bus.reboot(servo.id)
        elif row.before:
            bus.write(servo.id, servo.table["bus_watchdog"], 0)
    reset = []
    for servo, ticks, row in rows:
        if row.before:
            here, after, silence = _look(bus, servo, restarted=row.restarted)
            turned = 0 if after is None else here - ticks
            row = replace(row, after=after, turned=turned, silence=silence)
        reset.append(row)
    return reset


def _look(
    bus: ServoBus, servo: JointMap, *, restarted: bool = False
) -> tuple[int, tuple[str, ...] | None, BusTimeoutError | BusCorruptError | None]:
    """Where it stands, ticks, and its troubles; None and the error where it does not answer."""
    try:
        if restarted:
            bus.clock.sleep_until(bus.clock.now() + _POLL)  # or it answers before it goes
            _until(bus.clock, RESTART_TIME, _NO_REPLY, lambda: bus.ping(servo.id))
        here = bus.read(servo.id, servo.table["present_position"]).data or 0
        found = hardware_error_names(bus.read(servo.id, servo.table["hardware_error_status"]).data or 0)
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
            servo = next(s for s in config.servos if s.id == id)
            there, here = (servo.text(servo.to_radians(t)) for t in (last, ticks))
            raise HardwareError(
                f"joint {servo.name!r} was at {there} and reads {here} after the fault",
                hint="its servo has lost count of its revolutions: turn the joint by hand until it reads "
                "right, or close the arm and correct zero_ticks",
            )
