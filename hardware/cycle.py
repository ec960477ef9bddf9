"""One control cycle: a command in, one sync write, one sync read, samples and faults out."""

from __future__ import annotations

import logging
import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import (
    BusCorruptError,
    BusTimeoutError,
    HardwareError,
    MotorFaultError,
    UnsafeCommandError,
)
from robot_ik.hardware.bus import KEEPS_TORQUE, ServoBus, read_all, shared_register
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import family_of
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.following import Following
from robot_ik.hardware.limiter import LimiterReport, LimiterState, SafetyLimiter, finite
from robot_ik.hardware.registers import TICKS_PER_REVOLUTION
from robot_ik.hardware.servo import TWIST, Drive
from robot_ik.hardware.torque import arm_watchdog, set_profiles
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.ports import Array

log = logging.getLogger(__name__)

PAUSE = 0.25
"""s on the arm's own clock between two commands after which it starts from rest, however slowly they came."""

LONGEST_TICK = 2.0
"""Control periods that one command may move the arm by, however long ago the last one was.  After more of
them, or more of the program's own where it sends more slowly, the shafts stand: the arm starts from rest."""

SHORTEST_TICK = 0.01
"""Control periods below which a command moves nothing: over shorter times velocities are rounding."""

JITTER = 0.1
"""Control periods of unused time left to the next commands: the clock is read a little early or late."""

SAG = 0.05
"""rad (of a slide's pinion) between goal and shaft up to which holding keeps the goal.  Beyond, something
pushes: it yields, once."""

ARRIVED_TICKS = 3
"""Servo ticks between goal and shaft at which a joint counts as arrived."""

GRACE = 2.0
"""s allowed on the way to a pose beyond what the caps ask for."""

SILENCE = 0.13
"""s without a sample after which a servo is asked by itself, three times.  It shows in the next cycle (0.14 s
after the last reply, at 100 Hz); without a reply it is given up 0.11 s later at 1 Mbit/s."""

SILENT_CYCLES = 3
"""Cycles in a row a servo must have missed as well: a program that paused is no fault of a servo."""


@dataclass
class MotionReport:
    """What happened to the commands since torque came on.

    Attributes:
        sent: Commands sent.
        stale: Times no command came for too long and the arm was held by itself.
        clipped: Joint -> number of ticks in which its command lay outside the limits.
        capped: Joint -> number of ticks in which a cap held it back.
    """

    sent: int = 0
    stale: int = 0
    clipped: dict[str, int] = field(default_factory=dict)
    capped: dict[str, int] = field(default_factory=dict)

    def count(self, report: LimiterReport) -> None:
        self.sent += 1
        for counts, names in ((self.clipped, report.clipped), (self.capped, report.capped)):
            for name in names:
                counts[name] = counts.get(name, 0) + 1


class Samples:
    """Measured positions of an arm.

    Attributes:
        ticks: Servo id -> last present position.
        q: (n,) the same as joint values, by the servos that measure the joints; NaN before the first sample.
        times: (n,) when each was taken, s on the arm's clock: of two servos the older one.
        jumped: Servo id -> ticks before it jumped further than it can have moved.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._drives = config.drives
        self._joints = len(config.joints)
        self._twins = [
            (k, config.names.index(drive.name)) for k, drive in enumerate(self._drives) if k >= self._joints
        ]
        self._speeds = [drive.joint.velocity * drive.joint.ticks_per_unit for drive in self._drives]
        self.ticks: dict[int, int] = {}
        self.jumped: dict[int, int] = {}
        self._values = np.full(len(self._drives), np.nan)
        self._times = np.full(len(self._drives), -np.inf)
        self._missed = [0] * len(self._drives)

    @property
    def q(self) -> Array:
        return self._values[: self._joints]

    @property
    def times(self) -> Array:
        times = self._times[: self._joints]
        if self._twins:
            times = times.copy()
            for k, joint in self._twins:
                times[joint] = min(times[joint], self._times[k])
        return times

    def begin(self, ticks: Mapping[int, int], now: float) -> None:
        """Take the first samples of an arm without torque: a hand may have turned it since the last one."""
        self.ticks.clear()
        self.jumped.clear()
        self.take(ticks, now)

    def take(self, ticks: Mapping[int, int | None], now: float) -> None:
        """Take the samples of a cycle (servo id -> ticks).  A servo without one keeps its old sample."""
        for k, drive in enumerate(self._drives):
            id = drive.servo.id
            value = ticks[id]
            if value is None:
                self._missed[k] += 1
                continue
            self._missed[k] = 0
            before = self.ticks.get(id, value)
            if abs(value - before) > TICKS_PER_REVOLUTION / 2 + self._speeds[k] * (now - self._times[k]):
                self.jumped.setdefault(id, before)
            self.ticks[id] = value
            self._values[k] = drive.joint.value(value, drive.servo)
            self._times[k] = now

    def age(self, drive: Drive, now: float) -> float:
        """Return the s since the last sample of a servo; infinite before the first."""
        return float(now - self._times[self._drives.index(drive)])

    def silent(self, now: float) -> list[Drive]:
        """Return the servos that have not answered for ``SILENCE`` and ``SILENT_CYCLES``."""
        return [
            drive
            for k, drive in enumerate(self._drives)
            if self._missed[k] >= SILENT_CYCLES and now - self._times[k] >= SILENCE
        ]

    def twisted(self) -> Drive | None:
        """Return a servo that stands more than ``TWIST`` apart from the other one of its joint."""
        for k, joint in self._twins:
            drive = self._drives[k]
            value = self._values[joint]
            if abs(self._values[k] - value) > TWIST * drive.joint.lever_at(value):
                return drive
        return None


def shutdown_fault(bus: ServoBus, drive: Drive) -> MotorFaultError:
    """The fault of a servo whose replies carry the alert bit, with what its register says."""
    try:
        value = bus.read(drive.id, drive.servo.table["hardware_error_status"]).data or 0
    except HardwareError as error:
        log.warning("hardware error status of %s: %s", drive.name, error)
        value = 0
    return MotorFaultError(
        drive.name,
        family_of(drive.servo.table.family).error_names(value) or ("hardware_error",),
        hint="the others hold; remove the cause, then: robot-ik servo reset-fault, or Arm.reset_fault()",
    )


def jump_fault(drive: Drive, before: int, now: int) -> MotorFaultError:
    """The fault of a servo whose position changed by more than it can have moved, in ticks.

    It goes on to where its goal seems to be by then, and takes the joint there: it must be held at once.
    """
    there, here = (drive.joint.text(drive.value(ticks)) for ticks in (before, now))
    return MotorFaultError(
        drive.name,
        ("position_jump",),
        hint=f"it read {there}, now {here}: it lost count of its revolutions, or a horn is loose: "
        "all hold. Check it, then: robot-ik servo reset-fault, or Arm.reset_fault()",
    )


def has_torque(bus: ServoBus, drive: Drive) -> bool:
    """Whether a servo says so itself; False where it cannot be heard.

    Raises:
        MotorFaultError: It has none.
        BusDisconnectedError: The port went away.
    """
    family = family_of(drive.servo.table.family)
    names = [part.name for part in family.plain_block(drive.servo.table).parts[:2]]
    try:
        values = {name: bus.read(drive.id, drive.servo.table[name]).data or 0 for name in names}
    except (BusTimeoutError, BusCorruptError):
        return False
    if not family.is_in_control(values):
        hint = "the servo has probably restarted: check its supply; the other joints hold"
        raise MotorFaultError(drive.name, ("torque_lost",), hint=hint)
    return True


class Cycle:
    """The inner loop of an arm whose servos have torque.  Raises what it finds; the arm decides what follows.

    Commands are of all joints, or by name: joints that are not named keep their last command.

    Attributes:
        samples: Measured positions; ``limits``: state of the limiter; ``goals``: servo id -> ticks last sent.
        held: The goals are those of an arm that holds; only the next command changes them.
        reports: See ``MotionReport``.
    """

    def __init__(self, config: ArmConfig, bus: ServoBus, feedback: Feedback | None = None) -> None:
        self.samples = Samples(config)
        self.limits = LimiterState.at_rest(np.zeros(len(config.joints)))
        self.goals: dict[int, int] = {}
        self.held = False
        self.reports = MotionReport()
        self.period = 1.0 / config.rate_hz
        self._config = config
        self._bus = bus
        self._clock = bus.clock
        self._limiter = SafetyLimiter(
            config.lower, config.upper, config.velocity, config.acceleration, joints=config.names
        )
        self._goal = shared_register(config, "goal_position")
        self.feedback = feedback or Feedback(config)
        self._following = Following(config, longest_tick=LONGEST_TICK * self.period, pause=PAUSE)
        # A shadow hears what is written to its first servo.
        self._written = [drive for drive in config.drives if not drive.is_shadow]
        # A pause of half the bus watchdog: from there on it may have tripped.
        self._trust = 0.0005 * config.watchdog_ms if config.watchdog_ms else math.inf
        self._last_now: float | None = None
        self._rhythm = self.period  # s between the last two commands
        self._moved_until = -math.inf  # time on our own clock that the commands so far have used
        self._last_traffic = -math.inf
        self._unheard: set[int] = set()  # ids whose bus watchdogs may have tripped unseen

    def positions(self) -> dict[str, float]:
        """Joint -> last measured rad (m of a slide); NaN before the first sample."""
        return dict(zip(self._config.names, self.samples.q.tolist(), strict=True))

    def stand(self, goals: Mapping[int, int], *, held: bool = False) -> None:
        """The arm stands at these goals (servo id -> ticks): the next command starts from rest there."""
        self.goals = dict(goals)
        self.limits = LimiterState.at_rest([j.value(goals[j.servo.id]) for j in self._config.joints])
        self._last_now, self.held = None, held
        self._last_traffic = self._moved_until = self._clock.now()

    def drive(self, q: ArrayLike | Mapping[str, float], now: float) -> None:
        """Limits and caps, then goals to all servos and positions of all back in one exchange.

        Raises:
            UnsafeCommandError: Nothing was sent.
            MotorFaultError, BusTimeoutError, BusDisconnectedError: See ``measure``; a joint does not follow.
        """
        self._drive(self._limiter.command(q, self.limits.command), now)
        self._following.check(self.goals, self.samples.ticks, self._clock.now())

    def _drive(self, command: tuple[float, ...], now: float) -> None:
        """``drive`` for a command of all joints."""
        time = finite(now)
        if time is None:
            raise UnsafeCommandError(
                f"a command for the time {reprlib.repr(now)}", "a finite time in seconds"
            )
        # The time before the packet, and before the clock was last read: this process may be stalled
        # anywhere between, and the next reading must show that.
        start = self._clock.now()
        self.stay_alive()
        self.held = False
        dt = self._tick(time)
        if dt > 0.0:
            self.limits, report = self._limiter.step(self.limits, command, dt)
            self.goals = {
                servo.id: joint.goal(value, servo)
                for joint, value in zip(self._config.joints, self.limits.q, strict=True)
                for servo in joint.servos
            }
            self.reports.count(report)
        self._measure(start, {drive.servo.id: self.goals[drive.servo.id] for drive in self._written})

    def measure(self) -> None:
        """Positions of all, without new goals.

        Raises:
            MotorFaultError: A servo reports a hardware error, has lost its torque, jumps further than it can
                move, stands apart from the other one of its joint, or is silent for too long.
            BusTimeoutError: All are silent.
            BusDisconnectedError: The port went away.
        """
        start = self._clock.now()
        self.stay_alive()
        self._measure(start, {})

    def _measure(self, start: float, goals: Mapping[int, int]) -> None:
        """``goals`` (servo id -> ticks) to the servos, then their measurements.

        ``start``: since when no packet was sent.
        """
        statuses = self._bus.exchange(self._goal, goals, self.feedback.asked(), within=self.period)
        heard_again = any(statuses[id].data is not None for id in self._unheard)
        self._last_traffic = -math.inf if heard_again else start
        now = self._clock.now()
        measured = {id: self.feedback.measurement(status, now) for id, status in statuses.items()}
        self.samples.take({id: m.ticks for id, m in measured.items()}, now)
        for drive in self._config.drives:
            id = drive.servo.id
            if statuses[id].alert:
                raise shutdown_fault(self._bus, drive)
            # Not heard: if it stays so, it is a silent servo.
            if measured[id].torque is False and has_torque(self._bus, drive):
                log.warning("servo %d has torque, which its feedback denies: read plainly now", id)
                self.feedback.read_plainly(id)
            if id in self.samples.jumped:
                has_torque(self._bus, drive)
                raise jump_fault(drive, self.samples.jumped[id], self.samples.ticks[id])
        twisted = self.samples.twisted()
        if twisted is not None:
            raise MotorFaultError(twisted.name, ("twisted",), hint="its two servos do not stand together")
        self.feedback.check_thresholds()
        silent = self.samples.silent(now)
        if silent:
            self._confirm_silence(silent, everyone=len(silent) == len(statuses))

    def go(
        self, q: ArrayLike | Mapping[str, float], timeout: float | None, stop: Callable[[], bool]
    ) -> Array:
        """Drives to a constant ``q`` within the caps until the shafts are there, time is over or ``stop()``.

        Args:
            q: As of ``drive``.
            timeout: s; None: what the caps ask for and ``GRACE``.
            stop: Asked in every cycle.

        Returns:
            (all joints,) rad still to go; 0 where arrived, and where it was not sent.

        Raises:
            UnsafeCommandError, MotorFaultError, BusTimeoutError, BusDisconnectedError: As ``drive``.
        """
        now = self._clock.now()
        wanted = self._limiter.command(q, self.limits.command)
        command = np.clip(wanted, self._config.lower, self._config.upper)
        self._drive(tuple(command.tolist()), now)
        names = self._limiter.joints
        asked = np.array([name in (q if isinstance(q, Mapping) else names) for name in names])
        velocity, acceleration = self._config.velocity, self._config.acceleration
        needed = np.abs(command - self.samples.q) / velocity + 2.0 * velocity / acceleration
        end = now + (float(needed.max()) + GRACE if timeout is None else timeout)
        while True:
            off = np.abs(self.samples.q - command)
            off[~asked | (off <= ARRIVED_TICKS * self._config.resolution)] = 0.0
            if stop() or now > end or (self.limits.q == tuple(command) and not off.any()):
                return off
            now = max(now + self.period, self._clock.now())
            self._clock.sleep_until(now)
            self._drive(tuple(command.tolist()), now)

    def hold(self) -> None:
        """Holds every joint at its last goal, or yields where it was pushed away; see ``begin_hold``.

        Of an arm that holds already nothing changes.
        """
        self.stay_alive()
        goals = self.begin_hold()
        self._bus.sync_write(self._goal, goals)
        self.stand(goals, held=True)

    def begin_hold(self) -> dict[int, int]:
        """Servo id -> ticks where the arm is held from here on: its last goals, or the shafts far off them.

        Nothing is sent.  It is decided once, when holding begins: again and again of a loaded joint, each
        goal would be a little lower than the last, and the arm would creep down.  But a servo that has jumped
        since is held where it says it is: it would go to its goal by a revolution.
        """
        goals = dict(self.goals)
        for joint, servo in self._config.drives:
            # What a gripper holds keeps it from its goal: yielding would let go of it.
            if servo.id not in self.samples.jumped and (servo.presses or self.held):
                continue
            present = self.samples.ticks.get(servo.id)
            if present is not None and abs(present - goals[servo.id]) * joint.resolution > SAG * joint.lever:
                goals[servo.id] = present
        self.goals, self.held = goals, True
        return goals

    def stay_alive(self) -> None:
        """Where a bus watchdog may have tripped, sees to it that the arm goes on from its goals, from rest.

        A servo whose watchdog has tripped refuses goals, and a sync write has no reply to say so.  One whose
        reply is lost here is asked again as soon as it is heard.

        Raises:
            BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError, HardwareError.
        """
        start = self._clock.now()
        if start - self._last_traffic < self._trust:
            return
        self._last_traffic = start
        armed = self._config.watchdog_ms // WATCHDOG_UNIT_MS
        watchdog = shared_register(self._config, "bus_watchdog")
        statuses = self._bus.sync_read(self._config.servo_ids, watchdog)
        self._unheard = {id for id, status in statuses.items() if status.data is None}
        if all(status.data in (armed, None) for status in statuses.values()):
            return
        log.info("a bus watchdog tripped in a pause of the commands; the arm is held")
        self._bus.sync_write(watchdog, dict.fromkeys(self._config.servo_ids, 0))
        set_profiles(self._bus, self._config)
        self.samples.take(dict(read_all(self._bus, self._config, "present_position")), self._clock.now())
        goals = self.begin_hold()
        self._bus.sync_write(self._goal, goals)
        arm_watchdog(self._bus, self._config)
        self.stand(goals, held=True)

    def _tick(self, now: float) -> float:
        """Seconds by which this command may move the arm; 0: no time has passed.

        The least of what the caller says has passed, of what has passed on our own clock, and of
        ``LONGEST_TICK`` periods: a caller's clock may jump, and a program that was stopped may send in one
        burst what it missed.
        """
        last, self._last_now = self._last_now, now
        here = self._clock.now()
        if last is None:
            self._moved_until, self._rhythm = here, self.period
            return self.period
        asked, spent = now - last, here - self._moved_until
        usual, self._rhythm = max(self._rhythm, self.period), spent
        if spent > min(LONGEST_TICK * usual + JITTER * self.period, PAUSE):
            self.limits = LimiterState.at_rest(self.limits.q)
            asked = self.period
        elif not 0.0 < asked <= PAUSE:
            # The same time again, another loop's zero of time, or a clock that was set: our own decides.
            asked = self.period if spent >= 0.5 * self.period else 0.0
        dt = min(asked, spent, LONGEST_TICK * self.period)
        if dt < SHORTEST_TICK * self.period:
            return 0.0  # what has passed is left to the next command
        self._moved_until = max(self._moved_until + dt, here - JITTER * self.period)
        return dt

    def _confirm_silence(self, silent: list[Drive], everyone: bool) -> None:
        """Who is about to be given up is asked once more, by itself and with all patience.

        ``everyone``: all are silent.
        """
        for drive in silent:
            servo = drive.servo
            age = self.samples.age(drive, self._clock.now())
            try:
                ticks = self._bus.read(servo.id, servo.table["present_position"]).data
            except BusTimeoutError:
                status, cause = "no_status", "its cable and power"
            except BusCorruptError:
                status, cause = "corrupt", "whether another servo has this id"
            else:
                missing: dict[int, int | None] = dict.fromkeys(self._config.servo_ids)
                self.samples.take(missing | {servo.id: ticks}, self._clock.now())
                continue
            if everyone:
                raise BusTimeoutError(
                    id=servo.id,
                    register="present_position",
                    port=self._bus.port,
                    joint=drive.name,
                    last_good=age if math.isfinite(age) else None,
                    everyone=True,
                    hint=f"check their power, the cable and the adapter; {KEEPS_TORQUE}",
                )
            hint = f"no good reply of servo id {servo.id} for {age:.2f} s: check {cause}; the others hold"
            raise MotorFaultError(drive.name, (status,), hint=hint)
