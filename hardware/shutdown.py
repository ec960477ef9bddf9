"""The end of motion: torque off or hold, each servo on its own, and verified."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from robot_ik.errors import ConfigError
from robot_ik.hardware.bus import BROADCAST_ID, ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import shared_register
from robot_ik.ports import Clock, RealClock

log = logging.getLogger(__name__)

PATIENCE = 1.0
"""s after which servos that still do not confirm are given up; leaving must not hang on a dead one."""

PAUSE = 0.02
"""s between two attempts.  On a virtual clock asking takes no time: without it patience would never end."""


ON_EXIT = ("torque_off", "hold", "park")
"""Ways to leave an arm; ``park`` ends in torque off."""


def checked_policy(name: str, config: ArmConfig) -> str:
    """``name`` if it is one of ``ON_EXIT``.

    Raises:
        ConfigError: It is not.
    """
    if name not in ON_EXIT:
        raise ConfigError(
            f"{name!r} is no way to leave an arm",
            file=config.file or config.name,
            key="bus.on_exit",
            allowed=", ".join(ON_EXIT),
        )
    return name


@dataclass(frozen=True)
class ExitReport:
    """How an arm was left.

    Attributes:
        done: ``torque_off``, ``hold`` or ``untouched`` (was never switched on here).
        verified: Joints that confirmed it.
        unverified: Joints that did not: silent, or the port is gone.  Their torque may still be on.
        parked: The way to the park pose was finished before.
        seconds: How long it took on the arm's clock, parking not counted.
    """

    done: str
    verified: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    parked: bool = False
    seconds: float = 0.0

    @property
    def ok(self) -> bool:
        """Everybody confirmed."""
        return not self.unverified


def torque_off(
    bus: ServoBus, config: ArmConfig, *, parked: bool = False, clock: Clock | None = None
) -> ExitReport:
    """Switches every servo off: all at once first, then each by itself, until register 64 reads 0.

    Args:
        bus: If it is not open, the report says that nothing was done.
        config: Of the arm.
        parked: For the report.
        clock: The arm's, by which patience is counted; the machine's by default.

    Never raises on what the bus does: what failed is in the report and in the log.
    """
    clock = clock or RealClock()
    begin = clock.now()
    register = shared_register(config, "torque_enable")
    left = {servo.id: servo.name for servo in config.servos}
    told: set[str] = set()
    # Needs no answer, so it works even where nobody can be heard.  Twice: a signal may have cut off a packet,
    # and the torn head of that one can swallow the first.
    for _ in range(2 if bus.is_open else 0):
        with _tolerant("torque off for all", told):
            bus.write(BROADCAST_ID, register, 0)
    while left and bus.is_open:
        with _tolerant("reading torque", told):
            for id, status in bus.sync_read(list(left), register).items():
                if status.data == 0:
                    del left[id]
        for id, name in list(left.items()):
            if clock.now() - begin > PATIENCE:
                return _report("torque_off", config, left, clock.now() - begin, parked)
            with _tolerant(f"torque off for {name}", told):
                bus.write(id, register, 0)
        if left:
            clock.sleep_until(clock.now() + PAUSE)
    return _report("torque_off", config, left, clock.now() - begin, parked)


def hold(
    bus: ServoBus, config: ArmConfig, goals: Mapping[int, int], clock: Clock | None = None
) -> ExitReport:
    """Leaves torque on and the shafts at their goals.

    The Bus Watchdog is disarmed: the goals stand, and another program may take over.

    Args:
        bus: If it is not open, the report says that nothing was done.
        config: Of the arm.
        goals: Servo id -> goal position, ticks.
        clock: As for ``torque_off``.
    """
    clock = clock or RealClock()
    begin = clock.now()
    goal, watchdog = (shared_register(config, name) for name in ("goal_position", "bus_watchdog"))
    left = {servo.id: servo.name for servo in config.servos}
    told: set[str] = set()
    while left and bus.is_open and clock.now() - begin < PATIENCE:
        with _tolerant("hold", told):
            bus.sync_write(watchdog, dict.fromkeys(left, 0))
            bus.sync_write(goal, {id: goals[id] for id in left})
            for id, status in bus.sync_read(list(left), goal).items():
                if status.data == goals[id]:
                    del left[id]
        if left:
            clock.sleep_until(clock.now() + PAUSE)
    return _report("hold", config, left, clock.now() - begin)


def _report(
    done: str, config: ArmConfig, left: Mapping[int, str], seconds: float, parked: bool = False
) -> ExitReport:
    if left:
        log.error("%s not confirmed by %s: torque may be ON, cut the power", done, ", ".join(left.values()))
    else:
        log.info("%s confirmed by all %d servos in %.3f s", done, len(config.servos), seconds)
    names = dict.fromkeys(servo.name for servo in config.servos)
    verified = tuple(name for name in names if name not in left.values())
    return ExitReport(done, verified, tuple(dict.fromkeys(left.values())), parked, seconds)


@contextmanager
def _tolerant(what: str, told: set[str]) -> Iterator[None]:
    """One step of leaving must not prevent the next.  What fails again and again is told once."""
    try:
        yield
    except Exception as error:
        reason = error.args[0] if error.args else error  # the hint is the same for every servo
        log.log(logging.DEBUG if what in told else logging.WARNING, "%s: %s", what, reason)
        told.add(what)
