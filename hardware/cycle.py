"""One control cycle: a command in, one sync write, one sync read, samples and faults out."""

from __future__ import annotations

import logging
import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import BusCorruptError, BusTimeoutError, MotorFaultError, UnsafeCommandError
from robot_ik.hardware.arm_registers import read_all, shared_register
from robot_ik.hardware.bus import KEEPS_TORQUE, BusStatus, ServoBus
from robot_ik.hardware.command_clock import LONGEST_TICK, PAUSE, CommandClock
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.following import Following
from robot_ik.hardware.limiter import LimiterReport, LimiterState, SafetyLimiter, finite
from robot_ik.hardware.samples import Samples
from robot_ik.hardware.servo import Drive
from robot_ik.hardware.servo_faults import (
    confirm_torque,
    jump_fault,
    shutdown_fault,
    silence_fault,
)
from robot_ik.hardware.torque import arm_watchdog, set_profiles
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.ports import Array

log = logging.getLogger(__name__)

SAG = 0.05
"""rad (of a slide's pinion) between goal and shaft up to which holding keeps the goal.

At a larger distance a force pushes the shaft, and the goal becomes its present position, once.
"""

ARRIVED_TICKS = 3
"""Servo ticks between goal and shaft at which a joint counts as arrived."""

GRACE = 2.0
"""s allowed on the way to a pose beyond the time that the caps need."""

WATCHDOG_TRUST = 0.5
"""Share of ``watchdog_ms`` without a packet after which a bus watchdog may have tripped."""


@dataclass
class MotionReport:
    """Counts of the commands since torque came on.

    Attributes:
        sent: Commands sent.
        stale: Times no command came for too long and the heartbeat held the arm.
        clipped: Joint -> number of ticks in which its command was outside the limits.
        capped: Joint -> number of ticks in which a cap reduced its command.
    """

    sent: int = 0
    stale: int = 0
    clipped: dict[str, int] = field(default_factory=dict)
    capped: dict[str, int] = field(default_factory=dict)

    def count(self, report: LimiterReport) -> None:
        """Add one command."""
        self.sent += 1
        for counts, names in ((self.clipped, report.clipped), (self.capped, report.capped)):
            for name in names:
                counts[name] = counts.get(name, 0) + 1


class Cycle:
    """The inner loop of an arm whose servos have torque.

    It raises the faults that it finds, and the arm handles them.  A command has all joints, or some
    by name.  Joints that are not named keep their last command.

    Args:
        config: Arm file.
        bus: Bus of the arm.
        feedback: What is read from every servo.  None: the plain blocks.

    Attributes:
        samples: Measured positions and velocities.
        limits: State of the limiter.
        goals: Servo id -> ticks sent last.
        held: The goals are those of an arm that holds.  Only the next command changes them.
        reports: Counts of the commands.
        feedback: What is read from every servo.
        period: Control period, s.
    """

    def __init__(self, config: ArmConfig, bus: ServoBus, feedback: Feedback | None = None) -> None:
        self.samples = Samples(config)
        self.limits = LimiterState.at_rest(np.zeros(len(config.joints)))
        self.goals: dict[int, int] = {}
        self.held = False
        self.reports = MotionReport()
        self.feedback = feedback or Feedback(config)
        self.period = 1.0 / config.rate_hz
        self._config = config
        self._bus = bus
        self._clock = bus.clock
        self._limiter = SafetyLimiter(
            config.lower,
            config.upper,
            config.velocity,
            config.acceleration,
            joints=config.names,
        )
        self._goal_register = shared_register(config, "goal_position")
        self._following = Following(config, longest_tick=LONGEST_TICK * self.period, pause=PAUSE)
        self._command_clock = CommandClock(self._clock, self.period)
        # A shadow servo obeys writes to the first servo of its joint.
        self._written_ids = [drive.id for drive in config.drives if not drive.is_shadow]
        self._trusted_pause = math.inf
        if config.watchdog_ms:
            self._trusted_pause = WATCHDOG_TRUST * 0.001 * config.watchdog_ms
        # Time of the last packet, s.
        self._last_traffic = -math.inf
        # Servos whose bus watchdog register could not be read.
        self._unheard_ids: set[int] = set()

    def positions(self) -> dict[str, float]:
        """Return joint -> last measured value, rad or m; NaN before the first sample."""
        return dict(zip(self._config.names, self.samples.q.tolist(), strict=True))

    def velocities(self) -> dict[str, float]:
        """Return joint -> last measured velocity, rad/s or m/s; NaN before the first sample."""
        return dict(zip(self._config.names, self.samples.dq.tolist(), strict=True))

    def stand(self, goals: Mapping[int, int], *, held: bool = False) -> None:
        """Take the arm as standing at goals: the next command starts from rest there.

        Args:
            goals: Servo id -> ticks.
            held: The arm holds.
        """
        self.goals = dict(goals)
        values = [joint.value(goals[joint.servo.id]) for joint in self._config.joints]
        self.limits = LimiterState.at_rest(values)
        self.held = held
        self._command_clock.restart()
        self._last_traffic = self._clock.now()

    def hold_goals(self, goals: Mapping[int, int]) -> None:
        """Take over the goals of an arm that holds.

        Args:
            goals: Servo id -> ticks.
        """
        self.goals = dict(goals)
        self.held = True

    def drive(self, q: ArrayLike | Mapping[str, float], now: float) -> None:
        """Send a command within limits and caps, and read the positions, in one exchange.

        Args:
            q: (n,) rad or m, or joint name -> value.
            now: Time for which ``q`` is meant, s.

        Raises:
            UnsafeCommandError: Nothing was sent.
            MotorFaultError, BusTimeoutError, BusDisconnectedError: See ``measure``; or a joint does
                not follow.
        """
        self._drive(self._limiter.command(q, self.limits.command), now)
        self._following.check(self.goals, self.samples.ticks, self._clock.now())

    def _drive(self, command: tuple[float, ...], now: float) -> None:
        """Do as ``drive`` for a checked command of all joints."""
        time = finite(now)
        if time is None:
            raise UnsafeCommandError(
                f"a command for the time {reprlib.repr(now)}", "a finite time in seconds"
            )
        # Before the packet, and before the command's own look at the clock: this process may be
        # stalled anywhere between, and the next reading must show that.
        start = self._clock.now()
        self.stay_alive()
        self.held = False
        tick = self._command_clock.tick(time)
        if tick.from_rest:
            self.limits = LimiterState.at_rest(self.limits.q)
        if tick.dt > 0.0:
            self.limits, report = self._limiter.step(self.limits, command, tick.dt)
            self.goals = {
                servo.id: joint.goal(value, servo)
                for joint, value in zip(self._config.joints, self.limits.q, strict=True)
                for servo in joint.servos
            }
            self.reports.count(report)
        self._measure(start, {id: self.goals[id] for id in self._written_ids})

    def measure(self) -> None:
        """Read the positions without sending goals.

        Raises:
            MotorFaultError: A servo reports a hardware error, has lost its torque, jumps further
                than it can move, stands apart from the other servo of its joint, or is silent for
                too long.
            BusTimeoutError: All servos are silent.
            BusDisconnectedError: The port went away.
        """
        start = self._clock.now()
        self.stay_alive()
        self._measure(start, {})

    def _measure(self, start: float, goals: Mapping[int, int]) -> None:
        """Send goals, take the measurements, and raise the faults that they show.

        Args:
            start: Time of the last moment at which no packet of this cycle was sent yet, s.
            goals: Servo id -> ticks; may be empty.
        """
        statuses = self._bus.exchange(
            self._goal_register, goals, self.feedback.requested(), within=self.period
        )
        heard_again = any(statuses[id].data is not None for id in self._unheard_ids)
        self._last_traffic = -math.inf if heard_again else start
        now = self._clock.now()
        measured = {id: self.feedback.measurement(status, now) for id, status in statuses.items()}
        self.samples.take(
            {id: row.ticks for id, row in measured.items()},
            now,
            {id: row.velocity for id, row in measured.items()},
        )
        for drive in self._config.drives:
            id = drive.servo.id
            has_no_torque = measured[id].torque is False
            if statuses[id].alert or has_no_torque or id in self.samples.jumped:
                self._check_servo(drive, statuses[id], has_no_torque=has_no_torque)
        twisted = self.samples.twisted()
        if twisted is not None:
            raise MotorFaultError(
                twisted.name, ("twisted",), hint="its two servos do not stand together"
            )
        self.feedback.check_thresholds()
        silent = self.samples.silent(now)
        if silent:
            self._confirm_silence(silent, all_silent=len(silent) == len(statuses))

    def _check_servo(self, drive: Drive, status: BusStatus, *, has_no_torque: bool) -> None:
        """Raise the fault of a servo whose reply shows one.

        Args:
            drive: Servo.
            status: Its reply in this cycle.
            has_no_torque: Its feedback shows no torque.
        """
        if status.alert:
            raise shutdown_fault(self._bus, drive)
        if has_no_torque and confirm_torque(self._bus, drive):
            log.warning(
                "the feedback of servo %d is wrong about its torque: it is read plainly now",
                drive.id,
            )
            self.feedback.read_plainly(drive.id)
        if drive.id in self.samples.jumped:
            confirm_torque(self._bus, drive)
            raise jump_fault(drive, self.samples.jumped[drive.id], self.samples.ticks[drive.id])

    def go(
        self,
        q: ArrayLike | Mapping[str, float],
        timeout: float | None,
        stop: Callable[[], bool],
    ) -> Array:
        """Drive to ``q`` within the caps until the shafts arrive, time is over or ``stop()``.

        Args:
            q: As of ``drive``.
            timeout: s.  None: the time that the caps need and ``GRACE``.
            stop: Called in every cycle.

        Returns:
            (n,) distance that is left, rad or m; 0 of joints that arrived or were not sent.

        Raises:
            UnsafeCommandError, MotorFaultError, BusTimeoutError, BusDisconnectedError: As
                ``drive``.
        """
        now = self._clock.now()
        target = self._limiter.command(q, self.limits.command)
        clipped = np.clip(target, self._config.lower, self._config.upper)
        command = tuple(clipped.tolist())
        self._drive(command, now)

        names = self._limiter.joints
        named = q if isinstance(q, Mapping) else names
        is_sent = np.array([name in named for name in names])
        if timeout is None:
            timeout = self._needed_time(clipped) + GRACE
        end = now + timeout
        while True:
            distance = np.abs(self.samples.q - clipped)
            arrived = distance <= ARRIVED_TICKS * self._config.resolution
            distance[~is_sent | arrived] = 0.0
            at_goal = self.limits.q == command and not distance.any()
            if stop() or now > end or at_goal:
                return distance
            now = max(now + self.period, self._clock.now())
            self._clock.sleep_until(now)
            self._drive(command, now)

    def _needed_time(self, target: Array) -> float:
        """Return the time in s that the caps need from the measured pose to ``target`` (n,)."""
        velocity = self._config.velocity
        travel = np.abs(target - self.samples.q) / velocity
        ramps = 2.0 * velocity / self._config.acceleration
        return float((travel + ramps).max())

    def hold(self) -> None:
        """Hold every joint at the goals of ``begin_hold``.

        Nothing changes if the arm holds already.
        """
        self.stay_alive()
        goals = self.begin_hold()
        self._bus.sync_write(self._goal_register, goals)
        self.stand(goals, held=True)

    def hold_others(self) -> None:
        """Hold every joint after a fault.  The servo in fault does not obey."""
        goals = self.begin_hold()
        if self._config.family.capabilities.goal_enables_torque:
            goals = self._only_with_torque(goals)
        self._bus.sync_write(self._goal_register, goals)

    def _only_with_torque(self, goals: Mapping[int, int]) -> dict[int, int]:
        """Return the goals of servos that have torque and no error.

        A goal would switch the torque of the others on again.
        """
        ids = list(goals)
        error_register = shared_register(self._config, "hardware_error_status")
        errors = self._bus.sync_read(ids, error_register)
        torque = self._bus.sync_read(ids, shared_register(self._config, "torque_enable"))
        return {id: goal for id, goal in goals.items() if torque[id].data and errors[id].data == 0}

    def begin_hold(self) -> dict[int, int]:
        """Return servo id -> ticks at which the arm is held, and take them as the goals.

        These are the last goals, or the position of a shaft that is far from its goal.  Nothing is
        sent.  The goals are chosen once, when holding begins.  If they were chosen repeatedly for a
        loaded joint, each goal would be a little lower than the last, and the arm would creep down.
        A servo whose position has jumped is held at its present position.  Its last goal is a
        revolution away.
        """
        goals = dict(self.goals)
        for joint, servo in self._config.drives:
            # An object keeps a gripper from its goal.  Yielding would release the object.
            if servo.id not in self.samples.jumped and (servo.presses or self.held):
                continue
            present = self.samples.ticks.get(servo.id)
            if present is None:
                continue
            if abs(present - goals[servo.id]) * joint.resolution > SAG * joint.lever:
                goals[servo.id] = present
        self.hold_goals(goals)
        return goals

    def stay_alive(self) -> None:
        """After a long pause, check the bus watchdogs, and hold the arm if one has tripped.

        A servo whose watchdog has tripped refuses goals, and a sync write has no reply that would
        show it.  A servo whose reply is lost here is read again as soon as it answers.

        Raises:
            BusTimeoutError, BusCorruptError, BusDisconnectedError, ServoRefusedError,
            HardwareError.
        """
        start = self._clock.now()
        if start - self._last_traffic < self._trusted_pause:
            return
        self._last_traffic = start
        armed = self._config.watchdog_ms // WATCHDOG_UNIT_MS
        watchdog = shared_register(self._config, "bus_watchdog")
        ids = self._config.servo_ids
        statuses = self._bus.sync_read(ids, watchdog)
        self._unheard_ids = {id for id, status in statuses.items() if status.data is None}
        if all(status.data in (armed, None) for status in statuses.values()):
            return
        log.info("a bus watchdog tripped in a pause of the commands; the arm is held")
        self._bus.sync_write(watchdog, dict.fromkeys(ids, 0))
        set_profiles(self._bus, self._config)
        present = read_all(self._bus, self._config, "present_position")
        self.samples.take(dict(present), self._clock.now())
        goals = self.begin_hold()
        self._bus.sync_write(self._goal_register, goals)
        arm_watchdog(self._bus, self._config)
        self.stand(goals, held=True)

    def _confirm_silence(self, silent: list[Drive], *, all_silent: bool) -> None:
        """Ask every silent servo once more, by itself, before it is given up.

        Args:
            silent: Servos.
            all_silent: No servo of the arm answers.
        """
        for drive in silent:
            servo = drive.servo
            age = self.samples.age(drive, self._clock.now())
            try:
                ticks = self._bus.read(servo.id, servo.table["present_position"]).data
            except (BusTimeoutError, BusCorruptError) as error:
                if all_silent:
                    raise self._all_silent_error(drive, age) from error
                corrupt = isinstance(error, BusCorruptError)
                raise silence_fault(drive, age, corrupt=corrupt) from error
            missing: dict[int, int | None] = dict.fromkeys(self._config.servo_ids)
            self.samples.take(missing | {servo.id: ticks}, self._clock.now())

    def _all_silent_error(self, drive: Drive, age: float) -> BusTimeoutError:
        """Return the error of an arm whose servos are all silent.

        Args:
            drive: First of them.
            age: s since its last sample.
        """
        return BusTimeoutError(
            id=drive.id,
            register="present_position",
            port=self._bus.port,
            joint=drive.name,
            last_good=age if math.isfinite(age) else None,
            all_servos=True,
            hint=f"check their power, the cable and the adapter; {KEEPS_TORQUE}",
        )
