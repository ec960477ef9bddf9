"""Torque on without a jerk, and ``leave``: the only way out, each servo by itself and verified."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from robot_ik.config import KeyProblem
from robot_ik.errors import HardwareError, MotorFaultError
from robot_ik.hardware.bus import BROADCAST_ID, ServoBus, read_all, shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.register_access import sync_set
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import TWIST, Drive

log = logging.getLogger(__name__)

ON_EXIT = ("torque_off", "hold", "park")
"""Ways to leave an arm; ``park`` ends in torque off."""

PATIENCE = 1.0
"""s after which servos that still do not confirm are given up; leaving must not hang on a dead one."""

_PAUSE = 0.02  # s between two attempts; on a virtual clock asking takes no time, and patience would never end
_ATTEMPTS = 3  # a sync write has no reply: it is read back, and repeated if it was lost
_REBASE_TICKS = TICKS_PER_REVOLUTION // 8
"""Ticks; a shaft moves less while torque comes on, and a lost revolution is more."""


# ------------------------------------------------------------------------------------------------- on


def read_standing(bus: ServoBus, config: ArmConfig) -> dict[int, int]:
    """Servo id -> present position, ticks, where every servo may get torque.

    Raises:
        HardwareError: A servo restarted since it was set up, lost revolutions, or is too weak to hold the
            arm; nothing was switched on.
    """
    present = read_all(bus, config, "present_position")
    _check_set_up(bus, config, "nothing was switched on")
    config.family.check_strength(bus, config)
    _check_revolutions(config, present)
    _check_twins(config, present)
    return present


def torque_on(bus: ServoBus, config: ArmConfig, goals: Mapping[int, int]) -> None:
    """Goals where the arm stands (servo id -> ticks), the Bus Watchdog, then torque; each read back.

    A Bus Watchdog counts only while its servo has torque (ROBOTIS-GIT/emanual
    _includes/en/dxl/x/bus_watchdog.md).  Armed before, it stops a servo also if this program dies just then.

    Raises:
        HardwareError: A goal was not taken, or a servo counts anew or restarted meanwhile.  Torque may be on
            then: the caller switches it off.
        MotorFaultError: A servo refuses torque, by joint and with its hardware error.
    """
    missing = sync_set(bus, config, "goal_position", goals)
    if missing:
        raise HardwareError(
            f"{_names(missing)} did not take the present position as goal; nothing was switched on",
            hint="is the shaft outside the servo's own position limits? turn it back inside by hand",
        )
    arm_watchdog(bus, config)
    missing = sync_set(bus, config, "torque_enable", dict.fromkeys(config.servo_ids, 1))
    if missing:
        errors = read_all(bus, config, "hardware_error_status")
        names = config.family.error_names(errors[missing[0].id])
        raise MotorFaultError(missing[0].name, names or ("torque_refused",))
    present = read_all(bus, config, "present_position")
    for drive in config.drives:
        after = present[drive.id]
        if abs(after - goals[drive.id]) > _REBASE_TICKS:
            raise HardwareError(
                f"joint {drive.name!r} read {goals[drive.id]} ticks before torque came on and {after} after",
                hint="a servo may count its revolutions anew when torque comes on: check zero_ticks",
            )
    # A servo that restarted between the last look and its torque is on now, at any speed.
    _check_set_up(bus, config, "its torque goes off again")


def arm_watchdog(bus: ServoBus, config: ArmConfig) -> None:
    """Servos stop by themselves when the bus is silent for ``watchdog_ms`` (0: never)."""
    if config.watchdog_ms:
        config.family.arm_watchdog(bus, config)


def set_profiles(bus: ServoBus, config: ArmConfig) -> None:
    """How fast servos may follow their goals; see ``ServoFamily.limit_speed``."""
    config.family.limit_speed(bus, config)


def _names(drives: list[Drive]) -> str:
    return ", ".join(dict.fromkeys(drive.name for drive in drives))


def _check_set_up(bus: ServoBus, config: ArmConfig, then: str) -> None:
    """A servo that restarted since ``set_profiles`` has lost its profile, its gains and its goal current.

    ``then``: what becomes of the torque, for the error.
    """
    drive = config.family.forgot_speed(bus, config)
    if drive is not None:
        raise HardwareError(
            f"{drive.label} has restarted since it was set up: no limit of "
            f"speed or current is left in it; {then}",
            hint="check its supply; then connect again, in a program reconnect(), then enable()",
        )


def _check_revolutions(config: ArmConfig, present: dict[int, int]) -> None:
    """A servo that lost power counts its revolutions anew: then its angle is wrong by whole revolutions."""
    for joint, servo in config.drives:
        here = present[servo.id]
        if revolutions := joint.lost_revolutions(here, servo):
            lower, upper = joint.limits
            zero = servo.zero_ticks - TICKS_PER_REVOLUTION * revolutions
            raise HardwareError(
                f"joint {joint.name!r} reads {joint.text(joint.value(here, servo))}, outside "
                f"{joint.text(lower)} .. {joint.text(upper)}: the servo has lost count of its revolutions; "
                "nothing was switched on",
                hint="is it wound up? then turn it back by hand. Else, until its power goes again, "
                f"zero_ticks = {zero} in the arm file is right",
            )


def _check_twins(config: ArmConfig, present: dict[int, int]) -> None:
    """Two servos of one joint that do not agree where it is would fight each other."""
    for joint in config.joints:
        angles = [joint.value(present[servo.id], servo) for servo in joint.servos]
        if abs(angles[-1] - angles[0]) > TWIST * joint.lever_at(angles[0]):
            raise HardwareError(
                f"the two servos of joint {joint.name!r} read {joint.text(angles[0])} and "
                f"{joint.text(angles[-1])}; nothing was switched on",
                hint="correct direction or zero_ticks of joints.twin in the arm file",
            )


# -------------------------------------------------------------------------------------------- leaving


def checked_policy(name: str, file: Path | str, key: str) -> str:
    """``name`` if it is one of ``ON_EXIT``; else raises ``ConfigError``, with where it was said."""
    if name not in ON_EXIT:
        raise KeyProblem.unknown("way to leave an arm", name, ON_EXIT, key).in_file(file)
    return name


@dataclass(frozen=True)
class ExitReport:
    """How an arm was left.

    Attributes:
        done: ``torque_off``, ``hold`` or ``untouched`` (was never switched on here).
        verified: Joints of which every servo confirmed it.
        unverified: Joints that did not.  ``torque_off``: their torque may still be on; ``hold``: they may be
            limp, or have another goal.
        limp: Those of ``unverified`` that were to hold and say that they have no torque.
        parked: The way to the park pose was finished before.
        unparked: Why it was not, where the arm was to be parked; else empty.
    """

    done: str
    verified: tuple[str, ...] = ()
    unverified: tuple[str, ...] = ()
    parked: bool = False
    limp: tuple[str, ...] = ()
    unparked: str = ""

    @property
    def ok(self) -> bool:
        """Every servo confirmed it."""
        return not self.unverified

    @property
    def doubt(self) -> str:
        """Who did not confirm it, and what that may mean; empty where all did."""
        parts = [f"{', '.join(self.limp)} does NOT hold: no torque"] if self.limp else []
        if silent := [name for name in self.unverified if name not in self.limp]:
            danger = "torque may be ON, cut the power" if self.done == "torque_off" else "torque may be off"
            parts.append(f"not confirmed by {', '.join(silent)}: {danger}")
        return "; ".join(parts)

    @property
    def text(self) -> str:
        """One sentence for people."""
        what = {"torque_off": "torque is off", "hold": "it holds with torque ON", "untouched": "not touched"}
        way = " (parked first)" if self.parked else f" (not parked: {self.unparked})" if self.unparked else ""
        if self.ok:
            return what[self.done] + way
        if not self.verified:
            return self.doubt + way
        return f"{what[self.done]} at {', '.join(self.verified)}{way}; {self.doubt}"


def leave(
    bus: ServoBus,
    config: ArmConfig,
    policy: str,
    goals: Mapping[int, int],
    *,
    parked: bool = False,
    servos: Mapping[int, str] | None = None,
    everyone: bool = False,
) -> ExitReport:
    """The only way out of an arm: torque off or hold, written to the arm's own servos only, and read back.

    Nothing is asked of a servo before it is written.  Never raises on what the bus does: what failed is in
    the report and in the log.  Servos that confirm have no Bus Watchdog armed afterwards, so that the next
    program's goals are not refused.

    Args:
        bus: If it is not open, the report says that no servo confirmed.
        config: Of the arm; what it says of limits and health does not matter.
        policy: One of ``ON_EXIT``; ``park`` is torque off here.
        goals: Servo id -> goal position, ticks, for ``hold``; without them torque goes off.
        parked: For the report.
        servos: Servo id -> name of those that are left; the arm's.
        everyone: Torque goes off of all servos on the wire at once first, which needs no reply.
    """
    leaving = _Leaving(bus, config, servos or {drive.id: drive.name for drive in config.drives})
    left, names = leaving.left, dict.fromkeys(leaving.left.values())
    done = "hold" if policy == "hold" and set(left) <= set(goals) else "torque_off"
    if done == "hold":
        leaving.hold(goals)
    else:
        if everyone:
            with leaving.step("torque off for everyone"):
                bus.write(BROADCAST_ID, shared_register(config, "torque_enable"), 0)
        leaving.torque_off()
    unverified = tuple(dict.fromkeys(left.values()))
    verified = tuple(name for name in names if name not in unverified)
    limp = tuple(dict.fromkeys(name for id, name in left.items() if id in leaving.limp))
    return ExitReport(done, verified, unverified, parked, limp)


class _Leaving:
    """The servos that are left.

    Attributes:
        left: Servo id -> name of who has not confirmed; ``limp``: ids of those that say they have no torque.
    """

    def __init__(self, bus: ServoBus, config: ArmConfig, servos: Mapping[int, str]) -> None:
        self.left = dict(servos)
        self.limp: set[int] = set()
        self._bus, self._config = bus, config
        self._end = bus.clock.now() + PATIENCE
        self._reported: set[str] = set()

    def torque_off(self) -> None:
        """All at once, then each by itself, until register 64 reads 0."""
        bus, left = self._bus, self.left
        torque = shared_register(self._config, "torque_enable")
        # Needs no reply, so it works even where no reply arrives.  Twice: a signal may have cut off a packet,
        # and the torn head of that one can swallow the first.
        for _ in range(2 if bus.is_open else 0):
            with self.step("torque off for all"):
                bus.sync_write(torque, dict.fromkeys(left, 0))
        while left and bus.is_open:
            with self.step("reading torque"):
                off = [id for id, status in bus.sync_read(list(left), torque).items() if status.data == 0]
                self._disarm(off)
                for id in off:
                    del left[id]
            for id, name in left.items():
                if bus.clock.now() > self._end:
                    return
                with self.step(f"torque off for {name}"):
                    bus.write(id, torque, 0)
            if left:
                bus.clock.sleep_until(bus.clock.now() + _PAUSE)

    def _disarm(self, ids: list[int]) -> None:
        """Clears the Bus Watchdogs of who confirmed; where one has tripped, goals are refused until then."""
        for _ in range(_ATTEMPTS if self._config.watchdog_ms else 0):
            if not ids:
                return
            with self.step("bus watchdog"):
                watchdog = shared_register(self._config, "bus_watchdog")
                self._bus.sync_write(watchdog, dict.fromkeys(ids, 0))
                ids = [id for id, status in self._bus.sync_read(ids, watchdog).items() if status.data != 0]

    def hold(self, goals: Mapping[int, int]) -> None:
        """Goals as they are, and no Bus Watchdog: another program may take over."""
        bus, left = self._bus, self.left
        torque, goal = (shared_register(self._config, name) for name in ("torque_enable", "goal_position"))
        armed = self._config.family.capabilities.bus_watchdog
        goal_enables_torque = self._config.family.capabilities.goal_enables_torque
        while left and bus.is_open and bus.clock.now() < self._end:
            with self.step("hold"):
                if armed:
                    bus.sync_write(shared_register(self._config, "bus_watchdog"), dict.fromkeys(left, 0))
                if goal_enables_torque:
                    # A goal would give torque to a servo that has none, without its speed limit.
                    powered = bus.sync_read(list(left), torque)
                    self.limp = {id for id in left if powered[id].data == 0}
                bus.sync_write(goal, {id: goals[id] for id in left if id not in self.limp})
                there = bus.sync_read(list(left), goal)
                powered = bus.sync_read(list(left), torque)
                self.limp = {id for id in left if powered[id].data == 0}
                held = [id for id in left if there[id].data == goals[id] and powered[id].data == 1]
                self._disarm(held)
                for id in held:
                    del left[id]
            if left and self.limp.issuperset(left):
                break  # nothing that is written here gives them torque
            if left:
                bus.clock.sleep_until(bus.clock.now() + _PAUSE)

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """One step of leaving must not prevent the next.  What fails again and again is logged once."""
        try:
            yield
        except Exception as error:
            reason = error.args[0] if error.args else error  # the hint is the same for every servo
            log.log(logging.DEBUG if what in self._reported else logging.WARNING, "%s: %s", what, reason)
            self._reported.add(what)
