"""After a fault: servos restarted, the port opened again, everything verified anew.  Torque is left alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
)
from robot_ik.hardware.bus import ServoBus, joint_named, read_all
from robot_ik.hardware.calibration import check_beside
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import TICKS_PER_REVOLUTION, hardware_error_names
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.joint_map import JointMap
from robot_ik.hardware.startup import check_servos, set_up_servos
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

T = TypeVar("T")

RESTART_TIME = 2.0
"""s a servo is given to answer after a reboot; it takes some tenths."""

TRIPPED = -1
"""Bus Watchdog of a servo that has stopped because the bus was silent."""

WATCHDOG = "bus_watchdog"
"""What a servo whose watchdog has tripped is said to have, beside hardware errors."""

_POLL = 0.05  # s between two looks
_NO_REPLY = (BusTimeoutError, BusCorruptError)


def verify(bus: ServoBus, config: ArmConfig, *, real: bool = True) -> Feedback:
    """These are the arm file's servos, healthy and set up; what a control cycle reads from them.

    ``real``: not made from the arm file; they are compared with the calibration beside it as well.
    """
    check_servos(bus, config)
    if real:
        check_beside(bus, config)
    set_up_servos(bus, config)
    feedback = Feedback(config)
    feedback.prepare(bus, read_all(bus, config, "firmware_version"))
    return feedback


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


def reset_servos(bus: ServoBus, config: ArmConfig, clock: Clock) -> list[ServoReset]:
    """Reboots servos with a hardware error, clears watchdogs that have tripped, and looks at all again.

    Returns:
        A row for every servo of the arm, also where it does not answer.

    Raises:
        BusDisconnectedError, BusNotOpenError, ServoRefusedError: By joint name.
    """
    found = [_state_before(bus, config, servo) for servo in config.servos]
    with joint_named(config):
        for row, servo in zip(found, config.servos, strict=True):
            if row.restarted:
                log.info("rebooting servo %d (%s)", servo.id, servo.name)
                bus.reboot(servo.id)
            elif row.before:
                bus.write(servo.id, servo.table["bus_watchdog"], 0)
    return [
        _state_after(bus, config, servo, row, clock) if row.before else row
        for row, servo in zip(found, config.servos, strict=True)
    ]


def _state_before(bus: ServoBus, config: ArmConfig, servo: JointMap) -> ServoReset:
    """Its troubles; ``turned`` is where it stands, in ticks."""
    try:
        here, before = _look(bus, config, servo)
    except _NO_REPLY as error:
        return ServoReset(servo.name, servo.id, (), None, silence=error)
    return ServoReset(servo.name, servo.id, before, before, here if before else 0)


def _state_after(
    bus: ServoBus, config: ArmConfig, servo: JointMap, row: ServoReset, clock: Clock
) -> ServoReset:
    try:
        if row.restarted:
            clock.sleep_until(clock.now() + _POLL)  # or it answers before it goes
            with joint_named(config):
                _until(clock, RESTART_TIME, _NO_REPLY, lambda: bus.ping(servo.id))
        there, after = _look(bus, config, servo)
    except _NO_REPLY as error:
        return replace(row, after=None, turned=0, silence=error)
    return replace(row, after=after, turned=there - row.turned)


def _look(bus: ServoBus, config: ArmConfig, servo: JointMap) -> tuple[int, tuple[str, ...]]:
    """Where it stands, ticks, and its troubles."""
    with joint_named(config):
        here = bus.read(servo.id, servo.table["present_position"]).data or 0
        found = hardware_error_names(bus.read(servo.id, servo.table["hardware_error_status"]).data or 0)
        if WATCHDOG in servo.table and bus.read(servo.id, servo.table[WATCHDOG]).data == TRIPPED:
            found += (WATCHDOG,)
    return here, found


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


def restart_faulty(bus: ServoBus, config: ArmConfig, clock: Clock) -> tuple[str, ...]:
    """``reset_servos`` where all must answer afterwards; the joints of those that were rebooted."""
    rows = reset_servos(bus, config, clock)
    for row in rows:
        if row.silence is not None:
            raise row.silence
    return tuple(dict.fromkeys(row.joint for row in rows if row.restarted))


def find_again(
    bus: ServoBus, config: ArmConfig, clock: Clock, timeout: float, *, real: bool = True
) -> Feedback:
    """Opens the port as soon as it is there again and stays, and verifies what is behind it.

    Raises:
        BusNotOpenError, BusDisconnectedError: It was not there for ``timeout`` s.  As ``verify``.
    """
    bus.close()

    def there() -> Feedback:
        bus.open()
        return verify(bus, config, real=real)

    return _until(clock, timeout, (BusNotOpenError, BusDisconnectedError), there)


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
