"""An arm of servos: it takes joint values, measures them, and is left by its exit policy.

One thread drives an arm.  The heartbeat is the only other thread, and shares a lock with it.  Every
method that uses the bus holds that lock.  ``request_stop`` and ``close`` may be called from
any thread.  The states are in ``arm_state``.  What acts if no command comes is in ``watchdogs``.
"""

from __future__ import annotations

import logging
import math
import reprlib
import threading
from collections.abc import Callable, Mapping
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ArmStateError, HardwareError, StopRequestedError, UnsafeCommandError
from robot_ik.hardware.arm_exit import ArmExit
from robot_ik.hardware.arm_registers import read_motion
from robot_ik.hardware.arm_state import IN_USE, ArmState, possible, state_after
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.calibration import require_calibrated
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle, MotionReport
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.goal_currents import check_currents, set_currents
from robot_ik.hardware.gripper import Fingers, Grip
from robot_ik.hardware.guardian import Guardian, guardian_for
from robot_ik.hardware.leaving import ExitReport, checked_policy
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.recovery import check_revolutions_kept, find_again, reset_servos
from robot_ik.hardware.servo import GRIPPER
from robot_ik.hardware.startup import verify
from robot_ik.hardware.stop_requests import StopRequests
from robot_ik.hardware.torque import read_standing, torque_on
from robot_ik.hardware.watchdogs import GIVE_UP, Heartbeat, stale_time
from robot_ik.ports import Array, Closing, JointReading, VirtualClock
from robot_ik.signals import ExitGuard, deferred_signals

__all__ = ["Arm", "ArmState"]

log = logging.getLogger(__name__)

LOCK_PATIENCE = 1.0
"""s for which ``close`` waits for another thread to end its motion.  Then it leaves the arm."""

AT_REST = 1e-3
"""rad/s (m/s) below which a joint counts as standing still."""

FRESH_SHARE = 0.5
"""Share of a control period for which the samples of ``send`` are fresh enough for ``read``."""

GO_ON_HINT = (
    "to go on give the command again; in a program reset_fault(), then enable(), or close()"
)

T = TypeVar("T")


class Arm(Closing):
    """Servos of one arm file on one bus: a ``JointSink`` and a ``JointSource``.

    Args:
        config: Arm file.
        bus: Opened by ``connect`` and closed by ``close``.  A bus that is open before stays open,
            so that several arms can be on one wire.  Its clock is the arm's.
        on_exit: ``torque_off``, ``hold`` or ``park`` (then torque off).  None: as in the arm file.
        park_at: (n,) rad or m, or joint -> value.  None: the pose at which the arm was enabled,
            because the arm stood there without torque.

    Attributes:
        config: Arm file.
        bus: Bus.
        clock: Clock of the bus.
        on_exit: Exit policy.
        state: State of the arm.
        fault: Error that put the arm into ``FAULT``.
        joints: n joint names.
        lower: (n,) smallest joint values, rad or m.
        upper: (n,) largest joint values, rad or m.
        resolution: (n,) rad or m per tick.
    """

    def __init__(
        self,
        config: ArmConfig,
        bus: ServoBus,
        *,
        on_exit: str | None = None,
        park_at: ArrayLike | Mapping[str, float] | None = None,
    ) -> None:
        policy = on_exit or config.on_exit
        self.on_exit = checked_policy(policy, config.file or config.name, "bus.on_exit")
        self.config = config
        self.bus = bus
        self.clock = bus.clock
        bus.names |= {drive.id: drive.name for drive in config.drives}
        self.joints: tuple[str, ...] = config.names
        self.lower = config.lower
        self.upper = config.upper
        self.resolution = config.resolution
        self.state = ArmState.DISCONNECTED
        self.fault: HardwareError | None = None
        self._cycle = Cycle(config, bus)
        self._park_at = park_at
        # The bus was open before ``connect``.
        self._shares_bus = False
        # Joint -> value at which the arm was enabled.  Joints of a gripper are not in it: parking
        # must not open a grip.
        self._rest: dict[str, float] = {}
        # Joint -> mA that the program has set since ``connect``.
        self._currents: dict[str, float] = {}
        # The program streams commands, so a pause is a reason to hold.
        self._streaming = False
        # Time of the last command, s.
        self._commanded = 0.0
        # Ident of the thread that closes or has closed the arm, until ``connect``.
        self._closing_thread: int | None = None
        self._exit = ArmExit(bus, config)
        self._guard = ExitGuard(self._last_resort)
        self._guardian: Guardian | None = None
        self._heartbeat = Heartbeat(self._beat)
        self._lock = threading.RLock()
        self._close_lock = threading.RLock()
        self._stop_requests = StopRequests(config.name)

    @property
    def reports(self) -> MotionReport:
        """What happened to the commands since ``enable``."""
        return self._cycle.reports

    @property
    def exit_report(self) -> ExitReport | None:
        """How the arm was left.  None before."""
        return self._exit.report

    @property
    def ages(self) -> Array:
        """(n,) s since the last good sample of each joint; infinite before the first."""
        return self.clock.now() - self._cycle.samples.times

    def connect(self) -> None:
        """Open the bus, check that these are the arm file's servos, and set them up.

        Torque stays unchanged.

        Raises:
            ArmStateError: Already connected, or torque is on and a setting must change.
            BusNotOpenError, ServoMismatchError, MotorFaultError, ConfigError, BusTimeoutError,
            BusCorruptError, BusDisconnectedError, ServoRefusedError: No torque was switched on.
                The bus is closed again.
        """
        with self._lock:
            with self._close_lock:  # a close that another thread has begun ends first
                self._closing_thread = None
            after = self._after("connect")
            self._shares_bus = self.bus.is_open
            try:
                self.bus.open()
                feedback = verify(self.bus, self.config)
                self._currents.clear()
                self._require_not_closed()
            except BaseException:
                self._close_bus()
                raise
            self.fault = None
            self._exit.report = None
            self._stop_requests.forget()
            self._cycle = Cycle(self.config, self.bus, feedback)
            self.state = after

    @deferred_signals()
    def enable(self, *, handle_signals: bool = True) -> None:
        """Switch torque on at the present pose.

        From here on signals and exceptions leave the arm by its exit policy.  A signal that comes
        during this call is raised at its end, and torque is off again.  A request to stop is
        carried out before torque comes on, or as soon as it is on.

        Args:
            handle_signals: False: the program keeps its own handlers of SIGINT and SIGTERM, and
                calls ``close`` itself when they come.

        Raises:
            ArmStateError, HardwareError, MotorFaultError, bus errors: Torque is off again, if
                ``exit_report`` confirms it.  Joints that held before, after a fault, hold if
                ``on_exit`` is ``hold``.
            StopRequestedError: The arm was left as the request asked.  Latched.
            ConfigError: The arm file's zeros are placeholders and the servos are real.  No torque
                was switched on.
            KeyboardInterrupt, SystemExit: The signal.
        """
        with self._lock:
            after = self._after("enable")
            if self.bus.real:
                require_calibrated(self.config)
            if not self.config.stale_ms:
                log.warning(
                    "stale_ms = 0: nothing holds the arm in a pause, and a loaded joint sinks"
                )
            self._obey_stop(look_into_file=True)
            self._guard.install(handle_signals=handle_signals)
            first = not self._exit.energised
            try:
                self._give_torque(first=first)
                self.state = after
                self._obey_stop(look_into_file=True)
                self._require_not_closed()
            except StopRequestedError:
                raise  # the arm was left as the request asked
            except BaseException:
                self._undo_enable(first=first)
                raise
            if self._guard.received:
                self._undo_enable(first=first)

    def _give_torque(self, *, first: bool) -> None:
        """Switch torque on at the present pose.  From here on other programs can stop the arm.

        Args:
            first: No servo has torque because of this arm yet.
        """
        if self._guardian is None:
            self._guardian = guardian_for(self.bus, self.config)
        if not isinstance(self.clock, VirtualClock):
            self._stop_requests.open(self.bus.port)
            self._heartbeat.start()
        standing, velocities = read_standing(self.bus, self.config)
        self._cycle.samples.begin(standing, self.clock.now(), velocities)
        # Before torque: if that fails, no servo is sent to the goals of an earlier motion.
        self._cycle.stand(standing)
        self._obey_stop(look_into_file=True)
        self._require_not_closed()
        self._exit.energised = True
        try:
            torque_on(self.bus, self.config, standing)
        finally:
            self._exit.energised = True  # also if another thread has left the arm meanwhile
        if first:
            # After a later enable, the present pose is no pose the arm held without torque.
            values = dict(zip(self.joints, self._cycle.limits.q, strict=True))
            grippers = {joint.name for joint in self.config.group(GRIPPER)}
            self._rest = {name: q for name, q in values.items() if name not in grippers}
        self._commanded = self.clock.now()
        self._streaming = False

    def _undo_enable(self, *, first: bool) -> None:
        """Leave the arm as it was before ``enable``; keep watching it if that was not confirmed.

        If joints held before, a request to stop comes first: it may ask to hold them.
        """
        held_before = not first and not self._closed_elsewhere()
        if held_before and self._stop_requests.pending(look_into_file=True):
            self._stop_requests.unraised = self._carry_out_stop()
            return
        confirmed = True
        if self._exit.energised:
            policy = "torque_off" if first or self.on_exit != "hold" else "hold"
            confirmed = self._exit.leave(policy, self._cycle).ok
        self.state = ArmState.DISCONNECTED if self._closed_elsewhere() else ArmState.CONNECTED
        if first and confirmed:
            self._exit.energised = False
            self._heartbeat.dismiss()
            self._release_guardian()
            self._stop_requests.close()
            self._guard.remove()

    def __enter__(self) -> Self:
        if self.state is ArmState.DISCONNECTED:
            self.connect()
        return self

    def send(self, q: ArrayLike | Mapping[str, float], now: float) -> Array:
        """Run one bus cycle: goals within limits and caps to all servos, positions of all back.

        Args:
            q: (n,) rad or m, or joint name -> value (the other joints stay).
            now: Time for which ``q`` is meant, s.  The arm never moves faster than its own clock
                allows.

        Returns:
            (n,) rad or m that were sent: ``q`` within limits and caps.

        Raises:
            UnsafeCommandError: NaN, wrong length or unknown joint.  Nothing was sent.
            ArmStateError: Not enabled.
            MotorFaultError: A servo shut down or went silent, by joint.  The others hold.  Latched.
            BusTimeoutError: All servos went silent.  Latched.
            BusDisconnectedError: The port went away.  Latched.
            StopRequestedError: A stop was requested.  Latched.
        """
        with self._lock:
            after = self._after("send")
            self._obey_stop()
            arrival = self.clock.now()
            self._latching(lambda: self._cycle.drive(q, now))
            # A refused command does not come here: the arm goes stale as without it.
            self._commanded = arrival
            self._streaming = True
            self.state = after
            return np.array(self._cycle.limits.q)

    def read(self) -> JointReading:
        """Return the measured joint values and velocities.

        If ``send`` has measured in this cycle, its samples are returned and no servo is read.  A
        joint that missed a cycle keeps its last sample, and ``time`` is that of the oldest sample.
        In ``FAULT`` the last samples are returned and no servo is read.

        Raises:
            ArmStateError: Not connected.
            MotorFaultError, BusTimeoutError, BusDisconnectedError: As ``send``.
        """
        with self._lock:
            self._require_not_closed()
            samples = self._cycle.samples
            if self.state is ArmState.DISCONNECTED:
                raise ArmStateError(
                    "cannot read: the arm is disconnected", hint="call connect() first"
                )
            if self.state is ArmState.CONNECTED:
                ticks, velocities = read_motion(self.bus, self.config)
                samples.begin(ticks, self.clock.now(), velocities)
            elif self.state is not ArmState.FAULT and self._is_stale():
                self._latching(self._cycle.measure)
            return JointReading(samples.q.copy(), float(samples.times.min()), samples.dq.copy())

    def _is_stale(self) -> bool:
        """Return whether every sample is older than this cycle."""
        return bool(self.ages.min() > FRESH_SHARE * self._cycle.period)

    def velocities(self) -> dict[str, float]:
        """Return joint -> last measured velocity, rad/s or m/s; NaN before the first sample."""
        with self._lock:
            return self._cycle.velocities()

    def positions(self) -> dict[str, float]:
        """Return joint -> last measured value, rad or m; NaN before the first sample."""
        with self._lock:
            return self._cycle.positions()

    def hold(self) -> None:
        """Hold the present pose.  The next ``send`` starts from rest there.

        A joint that is pushed further than ``cycle.SAG`` from its goal yields, once, when holding
        begins.

        Raises:
            ArmStateError, MotorFaultError, BusTimeoutError, BusDisconnectedError: As ``send``.
        """
        with self._lock:
            after = self._after("hold")
            self._streaming = False
            self._latching(self._cycle.hold)
            self.state = after

    def move_to(self, q: ArrayLike | Mapping[str, float], timeout: float | None = None) -> None:
        """Go to ``q`` within the caps and hold there.  Return when the shafts have arrived.

        Args:
            q: As of ``send``.
            timeout: s.  None: the time that the caps need and 2 s.

        Raises:
            HardwareError: Not arrived in time.  The arm is held as by ``hold``.
            UnsafeCommandError, ArmStateError, bus errors: As ``send``.
        """
        with self._lock:
            self._streaming = False
            distance = self._go(q, timeout, stop=self._closed_elsewhere)
            self._require_not_closed()
            if distance.any():
                # Holding ends the pressure of the joints on an obstacle.
                self._latching(self._cycle.hold)
        if distance.any():
            k = int((distance / self.config.resolution).argmax())
            worst = self.config.joints[k]
            remaining = worst.text(float(distance[k]))
            raise HardwareError(
                f"{worst.name!r} is still {remaining} from its goal",
                hint="check whether an obstacle blocks it, or give a longer timeout",
            )

    def grip(
        self,
        q: float | Mapping[str, float],
        *,
        current: float | None = None,
        timeout: float | None = None,
    ) -> tuple[Grip, ...]:
        """Move the fingers until they arrive or something stops them.  Other joints are held.

        Fingers in current-based position mode press on from here, no harder than ``current``.
        Other fingers push with full torque, and an object that they cannot close on overloads them.

        Args:
            q: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> value.
            current: mA, at most the arm file's ``current_ma``.  None: as before.
            timeout: s.  None: the time that the caps need and 2 s.

        Raises:
            UnknownJointError, UnsafeCommandError: No gripper, no such joint or current.  Nothing
                was sent.
            ArmStateError, MotorFaultError, bus errors: As ``send``.
        """
        with self._lock:
            after = self._after("grip")
            fingers = Fingers(self.config, q)
            if current is not None:
                self._set_currents(dict.fromkeys(fingers.goals, current))
            self._streaming = False

            def stop() -> bool:
                return self._closed_elsewhere() or fingers.at_rest(self.clock.now(), self._cycle)

            self._go(fingers.goals, timeout, stop)
            self._require_not_closed()
            self.state = after
            return fingers.report(self.bus, self._cycle)

    def limit_current(self, currents: Mapping[str, float]) -> None:
        """Limit the current of joints in current-based position mode from here on.

        Args:
            currents: Joint name -> mA, positive.  More than the arm file's ``current_ma`` counts as
                that.

        Raises:
            UnknownJointError, UnsafeCommandError: Not such a joint, or no such current.  Nothing
                was sent.
            ArmStateError, bus errors: As ``send``.  Latched if torque is on.
        """
        with self._lock:
            self._after("limit the current")
            self._set_currents(currents)

    def _set_currents(self, currents: Mapping[str, float]) -> None:
        check_currents(self.config, currents)
        self._currents |= currents
        if self.state is ArmState.CONNECTED:
            set_currents(self.bus, self.config, currents)
            return

        def step() -> None:
            self._cycle.stay_alive()  # a servo whose Bus Watchdog has tripped takes no current
            set_currents(self.bus, self.config, currents)

        self._latching(step)

    def _go(
        self,
        q: ArrayLike | Mapping[str, float],
        timeout: float | None,
        stop: Callable[[], bool],
    ) -> Array:
        """Drive to ``q`` and return the distance (n,) that is left, rad or m."""
        _check_timeout(timeout)
        self.state = self._after("move")

        def must_stop() -> bool:
            return stop() or self._stop_requests.pending()

        try:
            distance = self._latching(lambda: self._cycle.go(q, timeout, must_stop))
            self._obey_stop()
            return distance
        finally:
            if self.state is ArmState.MOVING:
                self.state = ArmState.HOLD

    def _after(self, event: str) -> ArmState:
        """Return the state after ``event``.

        Raises:
            ArmStateError: The event is not possible now.
            HardwareError: The latched fault, if the arm is in fault.
        """
        self._require_not_closed()
        fault = self.fault
        if self.state is ArmState.FAULT and fault is not None and not possible(event, self.state):
            if fault is self._stop_requests.unraised:
                self._stop_requests.unraised = None
            raise fault.with_traceback(None)
        return state_after(event, self.state)

    def _latching(self, action: Callable[[], T]) -> T:
        """Run one step of motion.  An error of the servos or the bus becomes the arm's fault."""
        try:
            return action()
        except UnsafeCommandError:
            raise
        except HardwareError as error:
            self.state = ArmState.FAULT
            self.fault = error
            log.info("fault: %s", error)  # the caller gets the error itself
            try:
                if self.bus.is_open:
                    self._cycle.hold_others()
            except HardwareError as second:
                log.warning("holding the other joints: %s", second)
            raise

    def reset_fault(self) -> tuple[str, ...]:
        """Restart the servos that have shut down and verify everything; then call ``enable``.

        The other joints keep their torque and hold.  Restarted servos have no torque until
        ``enable``, which starts from the present pose.

        Returns:
            Joints whose servos were restarted.

        Raises:
            ArmStateError: There is no fault, or the port is gone (``reconnect``).
            StopRequestedError: A request to stop that no call has raised yet.  It is carried out,
                the fault stays, and the next ``reset_fault`` goes on.
            HardwareError: The arm is still not in order, e.g. a servo has lost its revolutions.
                The fault stays.
        """
        with self._lock:
            after = self._after("reset a fault")
            self._raise_stop()
            if not self.bus.is_open:
                raise ArmStateError(
                    "cannot reset the fault: the port is gone", hint="call reconnect()"
                )
            rows = reset_servos(self.bus, self.config)
            for row in rows:
                if row.silence is not None:
                    raise row.silence
            feedback = verify(self.bus, self.config, currents=self._currents)
            self._resume(feedback, after)
            return tuple(dict.fromkeys(row.joint for row in rows if row.restarted))

    def reconnect(self, timeout: float = 10.0) -> None:
        """Open the port as soon as it is back, and verify everything.  Torque stays unchanged.

        Args:
            timeout: s to wait for the port.  Use a name of the port that stays, e.g.
                ``/dev/serial/by-id/...``.

        Raises:
            ArmStateError: Not connected before, or the arm is in use.
            StopRequestedError: As ``reset_fault``.
            BusNotOpenError, BusDisconnectedError: The port did not come back.
            HardwareError: The servos are not those that were left.  The fault stays.
        """
        with self._lock:
            after = self._after("reconnect")
            self._raise_stop()
            _check_timeout(timeout)
            self._release_guardian()  # it has the file descriptor of the port that went away
            feedback = find_again(self.bus, self.config, timeout, currents=self._currents)
            if self._exit.energised:
                self._guardian = guardian_for(self.bus, self.config)
            self._resume(feedback, after)

    def _release_guardian(self) -> None:
        guardian = self._guardian
        self._guardian = None
        if guardian is not None:
            guardian.release()

    def _resume(self, feedback: Feedback, after: ArmState) -> None:
        """Go on after a fault with a verified bus.  Torque and goals stay as they are."""
        last_ticks = self._cycle.samples.ticks | self._cycle.samples.jumped
        check_revolutions_kept(self.bus, self.config, last_ticks)
        cycle = Cycle(self.config, self.bus, feedback)
        cycle.hold_goals(self._cycle.goals)
        self._cycle = cycle
        self.fault = None
        self._stop_requests.policy = None
        self.state = after

    def _beat(self) -> None:
        """Do one beat of the heartbeat.  If another thread has the lock, it drives the arm."""
        self._stop_requests.look_into_file()
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self._heartbeat.stopping():
                return
            if self._stop_requests.pending():
                self._stop_requests.unraised = self._carry_out_stop()
            elif self.state in IN_USE and self.config.stale_ms:
                self._attend(self.clock.now() - self._commanded)
        except Exception as error:
            log.error("found while no command came: %s", error)  # the next command raises it
        finally:
            self._lock.release()

    def _attend(self, idle: float) -> None:
        """Watch an arm that got no command for ``idle`` s: hold it, measure it, or give up."""
        stale = stale_time(self.config.stale_ms, self._cycle.period)
        if idle < stale:
            return
        if self.state is ArmState.ENABLED and self._streaming:
            # At rest after the last command of a motion there is nothing to warn of.
            moving = any(abs(speed) > AT_REST for speed in self._cycle.limits.velocity)
            level = logging.WARNING if moving else logging.INFO
            log.log(level, "no command for %.2f s: the arm is held", idle)
            self._cycle.reports.stale += 1
            self._latching(self._cycle.hold)
            self.state = ArmState.HOLD
        else:
            self._latching(self._cycle.measure)
        if self._streaming and self.config.on_stale != "hold" and idle > max(GIVE_UP, stale):
            self._give_up(idle)

    def _give_up(self, idle: float) -> None:
        """Carry out ``on_stale`` of the arm file: the program does not command any more."""
        unparked = None
        if self.config.on_stale == "park":
            unparked = self._park(stop=self._heartbeat.stopping)
            if self._closed_elsewhere():
                return  # close leaves the arm by on_exit
        report = self._exit.leave("torque_off", self._cycle, unparked)
        self.fault = HardwareError(
            f"no command came for {idle:.1f} s: {report.text}",
            hint=f"{GO_ON_HINT}; on_stale and stale_ms are in the arm file",
        )
        self.state = ArmState.FAULT
        log.error("%s", self.fault)

    def request_stop(self, policy: str = "hold") -> None:
        """Ask the arm to stop, from any thread: the next cycle or beat holds it, as a fault.

        A request is kept until it is carried out, also if it comes before ``connect``, in ``FAULT``
        or during ``enable``.  Afterwards ``close`` leaves the arm by ``policy`` instead of
        ``on_exit``.  Once a call has raised ``StopRequestedError``, ``reset_fault`` and ``enable``
        go on.

        Args:
            policy: ``hold`` or ``torque_off``.
        """
        self._stop_requests.add(policy)

    def _obey_stop(self, *, look_into_file: bool = False) -> None:
        """Carry out a request to stop, if there is one, and raise it."""
        if self._stop_requests.pending(look_into_file=look_into_file):
            raise self._carry_out_stop()

    def _raise_stop(self) -> None:
        """Do as ``_obey_stop``; also raise a stop that the heartbeat carried out."""
        self._obey_stop(look_into_file=True)
        stopped = self._stop_requests.unraised
        if stopped is not None:
            self._stop_requests.unraised = None
            raise stopped.with_traceback(None)

    def _carry_out_stop(self) -> StopRequestedError:
        """Leave the arm by the policy of the last request, and latch it as a fault."""
        policy = self._stop_requests.take()
        report = self._exit.leave(policy, self._cycle)
        self._stop_requests.acknowledge(ok=report.ok, text=report.text)
        stopped = StopRequestedError(f"stopped on request: {report.text}", hint=GO_ON_HINT)
        if self.state is not ArmState.FAULT:  # an earlier fault stays
            self.state = ArmState.FAULT
            self.fault = stopped
        log.info("%s", stopped)
        return stopped

    def _close_bus(self) -> None:
        """Close the bus, unless it was open before: then other arms are on it."""
        if not self._shares_bus:
            self.bus.close()

    @deferred_signals()
    def close(self) -> None:
        """Leave the arm by ``on_exit``, and close the bus; ``exit_report`` is the result.

        May be called at any time.  A signal that comes during this call waits until the arm is
        left.  The second signal since ``enable`` ends a parking.  A motion of another thread ends
        first, with ``ArmStateError`` there.

        Raises:
            KeyboardInterrupt, SystemExit: The signal that waited.
        """
        with self._close_lock:  # a second thread waits until the first has left the arm
            self._closing_thread = threading.get_ident()
            self._heartbeat.dismiss()
            locked = self._lock.acquire(timeout=LOCK_PATIENCE)
            try:
                self._leave_for_good(alone=locked)
            finally:
                # No step prevents the next.
                for step in (
                    self._heartbeat.stop,
                    self._release_guardian,
                    self._close_bus,
                    self._stop_requests.close,
                ):
                    try:
                        step()
                    except Exception as error:
                        log.error("closing the arm: %s", error)
                self.state = ArmState.DISCONNECTED
                self._exit.energised = False
                if locked:
                    self._lock.release()
                # Last, because from here on signals are no longer deferred.
                self._guard.remove()

    def _closed_elsewhere(self) -> bool:
        """Return whether another thread leaves the arm, or has left it since ``connect``."""
        thread = self._closing_thread
        return thread is not None and thread != threading.get_ident()

    def _require_not_closed(self) -> None:
        """Raise an error if another thread leaves the arm: this thread must not move it."""
        if self._closed_elsewhere():
            raise ArmStateError(
                "another thread has closed the arm", hint="connect() and enable() to go on"
            )

    def _leave_for_good(self, *, alone: bool) -> None:
        """Leave the arm by the last request to stop, else by ``on_exit``.

        Args:
            alone: This thread has the lock, so no other thread uses the bus.
        """
        if not self._exit.energised:
            if self.state is not ArmState.DISCONNECTED:
                self._exit.leave_untouched()
            return
        unparked = None
        if self.on_exit == "park":
            unparked = "another thread keeps the arm busy"
            if alone:
                unparked = self._park(stop=lambda: self._guard.received > 1)
        if self._stop_requests.pending(look_into_file=True):  # too late for a cycle
            report = self._exit.leave(self._stop_requests.take(), self._cycle, unparked)
            self._stop_requests.acknowledge(ok=report.ok, text=report.text)
        else:
            policy = self._stop_requests.policy or self.on_exit
            self._exit.leave(policy, self._cycle, unparked)

    def _park(self, stop: Callable[[], bool]) -> str:
        """Go to the park pose.  Return why the arm did not arrive; empty if it did.

        Args:
            stop: Ends the parking.
        """
        reason = ""
        try:
            if self._stop_requests.pending(look_into_file=True):
                reason = "a stop was requested"
            elif self.state is ArmState.FAULT:
                reason = "the arm is in fault"
            elif self.state not in IN_USE:
                reason = "the arm is not enabled"
            elif self._go(self._rest if self._park_at is None else self._park_at, None, stop).any():
                reason = "it was interrupted" if stop() else "it did not arrive in time"
        except StopRequestedError:
            reason = "a stop was requested"
        except Exception as error:
            reason = str(error).partition("\n")[0]
        if reason:
            log.warning("not parked: %s", reason)
        return reason

    def _last_resort(self) -> None:
        """Close an arm that was not closed before the interpreter ends."""
        if not self._exit.energised:
            return
        log.error("the program ended without closing its arm")
        try:
            self.close()
        except (KeyboardInterrupt, SystemExit):
            log.info("a signal came meanwhile: the arm was left, and the program ends anyway")
        except BaseException as error:
            log.error("closing it failed: %s", error)


def _check_timeout(timeout: float | None) -> None:
    """Raise ``UnsafeCommandError`` for NaN and for values that are no number.

    A motion with such a timeout would never end.
    """
    if timeout is not None and timeout != math.inf and finite(timeout) is None:
        raise UnsafeCommandError(f"a timeout of {reprlib.repr(timeout)}", "a number of seconds")
