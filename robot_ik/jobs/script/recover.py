"""The step that gets an arm out of a fault."""

from __future__ import annotations

from robot_ik.errors import BusTimeoutError
from robot_ik.jobs.script.situation import Situation

RESTART = 1.0
"""s in which a servo that was restarted must answer again."""

_PAUSE = 0.02


def recover(now: Situation) -> None:
    """Leaves the arm, restarts what has shut down, checks everything anew, and gives torque where it stands.

    Raises:
        HardwareError: The cause is still there; the arm is without torque or was left as far as could be.
    """
    now.arm.close()
    _restart_servos(now)
    now.arm.connect()
    now.arm.enable()
    now.stand()


def _restart_servos(now: Situation) -> None:
    bus = now.arm.bus
    bus.open()
    try:
        shut = []
        for servo in now.config.servos:
            if bus.read(servo.id, servo.table["hardware_error_status"]).data:
                bus.reboot(servo.id)
                shut.append(servo.id)
        for id in shut:
            _wait_for(now, id)
    finally:
        bus.close()


def _wait_for(now: Situation, id: int) -> None:
    clock = now.limbs.clock
    end = clock.now() + RESTART
    while True:
        try:
            now.arm.bus.ping(id)
            return
        except BusTimeoutError:  # it takes some tenths of a second
            if clock.now() > end:
                raise
        clock.sleep_until(clock.now() + _PAUSE)
