"""Servos that have shut down are restarted, and looked at again.  Nothing here switches torque on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robot_ik.errors import BusCorruptError, BusTimeoutError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import JointMap
from robot_ik.hardware.control_table import TICKS_PER_TURN, hardware_error_names
from robot_ik.ports import Clock

RESTART_TIME = 2.0
"""s a servo is given to answer after a reboot; it takes some tenths."""

TRIPPED = -1
"""Bus Watchdog of a servo that has stopped because the bus was silent."""

_POLL = 0.05  # s between two looks


@dataclass(frozen=True)
class Reset:
    """What became of one servo.

    Attributes:
        joint, id: Whose.
        before: Hardware errors, and ``bus_watchdog`` if that had tripped; empty: nothing to reset.
        after: The same now; None: it does not answer.
        turned: Ticks by which its reading changed: whole turns that it has forgotten.
    """

    joint: str
    id: int
    before: tuple[str, ...]
    after: tuple[str, ...] | None
    turned: int = 0

    @property
    def ok(self) -> bool:
        """Healthy now, and its angle is what it was."""
        return self.after == () and abs(self.turned) < TICKS_PER_TURN // 2


def reset_faults(bus: ServoBus, servos: Sequence[JointMap], clock: Clock) -> list[Reset]:
    """Reboots those with a hardware error, clears watchdogs that have tripped, and looks again.

    A rebooted servo has no torque and its RAM registers are at their defaults.

    Raises:
        BusDisconnectedError, BusNotOpenError, ServoRefusedError.
    """
    return [_reset(bus, servo, clock) for servo in servos]


def _reset(bus: ServoBus, servo: JointMap, clock: Clock) -> Reset:
    try:
        before = _troubles(bus, servo)
        if not before:
            return Reset(servo.name, servo.id, (), ())
        here = bus.read(servo.id, servo.table["present_position"]).data or 0
        if set(before) - {"bus_watchdog"}:
            bus.reboot(servo.id)
            _wait(bus, servo.id, clock)
        else:
            bus.write(servo.id, servo.table["bus_watchdog"], 0)
        there = bus.read(servo.id, servo.table["present_position"]).data or 0
        return Reset(servo.name, servo.id, before, _troubles(bus, servo), there - here)
    except (BusTimeoutError, BusCorruptError):
        return Reset(servo.name, servo.id, ("no_status",), None)


def _troubles(bus: ServoBus, servo: JointMap) -> tuple[str, ...]:
    found = hardware_error_names(bus.read(servo.id, servo.table["hardware_error_status"]).data or 0)
    if "bus_watchdog" in servo.table and bus.read(servo.id, servo.table["bus_watchdog"]).data == TRIPPED:
        found += ("bus_watchdog",)
    return found


def _wait(bus: ServoBus, id: int, clock: Clock) -> None:
    end = clock.now() + RESTART_TIME
    while True:
        clock.sleep_until(clock.now() + _POLL)
        try:
            bus.ping(id)
            return
        except (BusTimeoutError, BusCorruptError):
            if clock.now() > end:
                raise
