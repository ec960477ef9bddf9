"""After a fault: servos restarted, the port opened again, everything verified anew.  Torque is left alone."""

from __future__ import annotations

import logging
import math

from robot_ik.errors import (
    BusCorruptError,
    BusDisconnectedError,
    BusNotOpenError,
    BusTimeoutError,
    HardwareError,
)
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.control_table import TICKS_PER_TURN
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.registers import joint_named, read_all
from robot_ik.hardware.samples import Samples
from robot_ik.hardware.startup import check_servos, set_up_servos
from robot_ik.ports import Clock

log = logging.getLogger(__name__)

RESTART_TIME = 2.0
"""s a servo is given to answer after a reboot; it takes some tenths."""

_POLL = 0.05  # s between two looks


def verify(bus: ServoBus, config: ArmConfig) -> Feedback:
    """These are the arm file's servos, healthy and set up; what a control cycle reads from them.

    Raises:
        ArmStateError, ServoMismatchError, MotorFaultError, ConfigError, HardwareError and those of the bus.
    """
    check_servos(bus, config)
    set_up_servos(bus, config)
    feedback = Feedback(config)
    feedback.prepare(bus, read_all(bus, config, "firmware_version"))
    return feedback


def restart_faulty(bus: ServoBus, config: ArmConfig, clock: Clock) -> tuple[str, ...]:
    """Reboots the servos that report a hardware error, and waits until they answer.

    Returns:
        Their joints.

    Raises:
        BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError: By joint name.
    """
    errors = read_all(bus, config, "hardware_error_status")
    faulty = [servo for servo in config.servos if errors[servo.id]]
    with joint_named(config):
        for servo in faulty:
            log.info("rebooting servo %d (%s)", servo.id, servo.name)
            bus.reboot(servo.id)
        end = clock.now() + RESTART_TIME
        for servo in faulty:
            while True:
                clock.sleep_until(clock.now() + _POLL)
                try:
                    bus.ping(servo.id)
                    break
                except (BusTimeoutError, BusCorruptError):
                    if clock.now() > end:
                        raise
    return tuple(dict.fromkeys(servo.name for servo in faulty))


def find_again(bus: ServoBus, config: ArmConfig, clock: Clock, timeout: float) -> Feedback:
    """Opens the port as soon as it is there again and stays, and verifies what is behind it.

    Raises:
        BusNotOpenError, BusDisconnectedError: It was not there for ``timeout`` s.  As ``verify``.
    """
    bus.close()
    end = clock.now() + timeout
    while True:
        try:
            bus.open()
            return verify(bus, config)
        except (BusNotOpenError, BusDisconnectedError):
            if clock.now() >= end:
                raise
        clock.sleep_until(clock.now() + _POLL)


def check_turns_kept(bus: ServoBus, config: ArmConfig, before: Samples) -> None:
    """A servo that restarted counts its turns anew: then its angle is wrong by whole turns.

    Args:
        bus: Open.
        config: The arm.
        before: The samples until the fault.

    Raises:
        HardwareError: A shaft stands more than half a servo turn from where it was last seen.
    """
    for id, ticks in read_all(bus, config, "present_position").items():
        last = before.ticks.get(id)
        if last is not None and abs(ticks - last) > TICKS_PER_TURN / 2:
            servo = next(s for s in config.servos if s.id == id)
            there, here = (math.degrees(servo.to_radians(t)) for t in (last, ticks))
            raise HardwareError(
                f"joint {servo.name!r} was at {there:.1f} deg and reads {here:.1f} deg after the fault",
                hint="its servo has lost count of its turns: turn the joint by hand until it reads right, or "
                "close the arm and correct zero_ticks",
            )
