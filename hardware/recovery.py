"""After a fault: servos restarted, the port opened again, everything verified.

Torque stays unchanged.  Errors of the bus are raised by joint name.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
)
from robot_ik.hardware.arm_registers import read_all
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import Drive
from robot_ik.hardware.startup import verify
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

T = TypeVar("T")

RESTART_TIME = 2.0
"""s a servo is given to answer after a reboot; it takes some tenths."""

WATCHDOG = "bus_watchdog"
"""Name among the hardware errors of a servo whose bus watchdog has tripped."""

POLL_PERIOD = 0.05
"""s between two attempts."""

NO_REPLY = (BusTimeoutError, BusCorruptError)
"""Errors of a servo that does not answer."""


@dataclass(frozen=True)
class ServoReset:
    """The state of one servo before and after a reset.

    Attributes:
        joint: Joint of the servo.
        id: Servo id.
        before: Hardware errors, and ``WATCHDOG`` if that had tripped; empty: nothing to reset.
        after: The same now; None: the servo does not answer.
        turned: Ticks by which its reading changed: whole revolutions that it has forgotten.
        silence: Error of the bus, if the servo does not answer.
    """

    joint: str
    id: int
    before: tuple[str, ...]
    after: tuple[str, ...] | None
    turned: int = 0
    silence: BusTimeoutError | BusCorruptError | None = None

    @property
    def restarted(self) -> bool:
        """The servo was restarted: it has no torque, and its RAM registers have their defaults."""
        return bool(set(self.before) - {WATCHDOG})

    @property
    def ok(self) -> bool:
        """The servo is healthy now, and its angle is the same as before."""
        return self.after == () and abs(self.turned) < TICKS_PER_REVOLUTION // 2


class _ServoState(NamedTuple):
    """Position and errors of a servo.

    Attributes:
        ticks: Present position; 0 if it does not answer.
        errors: Hardware errors, and ``WATCHDOG``; None: it does not answer.
        silence: Error of the bus, if it does not answer.
    """

    ticks: int
    errors: tuple[str, ...] | None
    silence: BusTimeoutError | BusCorruptError | None = None


def reset_servos(bus: ServoBus, config: ArmConfig) -> list[ServoReset]:
    """Restart servos with a hardware error, clear tripped watchdogs, and read all states.

    Args:
        bus: Open bus.
        config: Arm file.

    Returns:
        A row for every servo of the arm, also for servos that do not answer.

    Raises:
        BusDisconnectedError, BusNotOpenError, ServoRefusedError: By joint name.
    """
    rows = []
    for drive in config.drives:
        state = _read_state(bus, config, drive)
        errors = state.errors or ()
        row = ServoReset(drive.name, drive.id, errors, state.errors, silence=state.silence)
        rows.append((drive, state.ticks, row))
    for drive, _, row in rows:
        if row.restarted:
            log.info("resetting servo %d (%s)", drive.id, drive.name)
            config.family.reset(bus, drive)
        elif row.before:
            config.family.clear_watchdog(bus, config, drive)
    reset = []
    for drive, ticks, row in rows:
        if row.before:
            state = _read_state(bus, config, drive, restarted=row.restarted)
            turned = 0 if state.errors is None else state.ticks - ticks
            row = replace(row, after=state.errors, turned=turned, silence=state.silence)
        reset.append(row)
    return reset


def _read_state(
    bus: ServoBus, config: ArmConfig, drive: Drive, *, restarted: bool = False
) -> _ServoState:
    """Read position and errors of a servo.

    Args:
        bus: Open bus.
        config: Arm file.
        drive: Servo.
        restarted: It was restarted just now, so wait until it answers.
    """
    servo = drive.servo
    try:
        if restarted:
            # Otherwise the servo answers before it restarts.
            bus.clock.sleep_until(bus.clock.now() + POLL_PERIOD)
            _retry(bus.clock, RESTART_TIME, NO_REPLY, lambda: bus.ping(servo.id))
        ticks = bus.read(servo.id, servo.table["present_position"]).data or 0
        value = bus.read(servo.id, servo.table["hardware_error_status"]).data or 0
        errors = config.family.error_names(value)
        if config.family.watchdog_tripped(bus, drive):
            errors += (WATCHDOG,)
    except NO_REPLY as error:
        return _ServoState(0, None, error)
    return _ServoState(ticks, errors)


def _retry(
    clock: Clock, timeout: float, errors: tuple[type[HardwareError], ...], action: Callable[[], T]
) -> T:
    """Return the result of ``action`` as soon as it raises none of ``errors``.

    Args:
        clock: Clock of the bus.
        timeout: s after which the error is raised.
        errors: Errors after which ``action`` is called again.
        action: What to try.
    """
    end = clock.now() + timeout
    while True:
        try:
            return action()
        except errors:
            if clock.now() >= end:
                raise
        clock.sleep_until(clock.now() + POLL_PERIOD)


def find_again(
    bus: ServoBus, config: ArmConfig, timeout: float, *, currents: Mapping[str, float]
) -> Feedback:
    """Open the port as soon as it is back, and verify the servos behind it.

    Args:
        bus: Bus of the arm.
        config: Arm file.
        timeout: s to wait for the port.
        currents: As of ``verify``.

    Raises:
        BusNotOpenError, BusDisconnectedError: The port did not come back.
        HardwareError: As ``verify``.
    """
    bus.close()

    def open_and_verify() -> Feedback:
        bus.open()
        return verify(bus, config, currents=currents)

    return _retry(bus.clock, timeout, (BusNotOpenError, BusDisconnectedError), open_and_verify)


def check_revolutions_kept(bus: ServoBus, config: ArmConfig, before: Mapping[int, int]) -> None:
    """Check that every servo has kept its count of revolutions.

    If a servo has lost it, its angle is wrong by whole revolutions.

    Args:
        bus: Open bus.
        config: Arm file.
        before: Servo id -> last known position, ticks.

    Raises:
        HardwareError: A shaft stands more than half a servo revolution from its last position.
    """
    present = read_all(bus, config, "present_position")
    for drive in config.drives:
        last = before.get(drive.id)
        ticks = present[drive.id]
        if last is None or abs(ticks - last) <= TICKS_PER_REVOLUTION / 2:
            continue
        old = drive.joint.text(drive.value(last))
        new = drive.joint.text(drive.value(ticks))
        raise HardwareError(
            f"joint {drive.name!r} was at {old} and reads {new} after the fault",
            hint="its servo has lost count of its revolutions: turn the joint by hand until it "
            "reads right, or close the arm and correct zero_ticks",
        )
