"""An arm of servos: takes joint angles, gives joint angles, and is left in the way its owner chose.

``DISCONNECTED`` → connect → ``CONNECTED`` → enable → ``ENABLED`` ↔ ``HOLD``; ``MOVING`` on the way to a
pose; ``FAULT`` is latched until ``reset_fault``, ``reconnect`` or ``close``.  One thread drives an arm; the
heartbeat is the only other one, and shares a lock with it.  Every method that talks to the servos holds that
lock.  ``request_stop`` and ``close`` may be called from any thread.  What acts when no command comes:
``watchdogs``.
"""

from __future__ import annotations

import enum
import logging
import math
import reprlib
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ArmStateError, HardwareError, StopRequestedError, UnsafeCommandError
from robot_ik.hardware.bus import ServoBus, read_all, shared_register
from robot_ik.hardware.calibration import require_calibrated
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle, MotionReport
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.gripper import Fingers, Grip
from robot_ik.hardware.guardian import Guardian, guardian_for
from robot_ik.hardware.limiter import finite
from robot_ik.hardware.servo import GRIPPER
from robot_ik.hardware.startup import (
    check_currents,
    check_revolutions_kept,
    find_again,
    reset_servos,
    set_currents,
    verify,
)
from robot_ik.hardware.stop_file import StopFile
from robot_ik.hardware.torque import ExitReport, checked_policy, leave, read_standing, torque_on
from robot_ik.hardware.watchdogs import GIVE_UP, ExitGuard, Heartbeat, stale_time, uninterrupted
from robot_ik.ports import Array, Closing, JointReading, VirtualClock

__all__ = ["Arm", "ArmState"]

log = logging.getLogger(__name__)

LOCK_PATIENCE = 1.0
"""s for which leaving waits for another thread to end its motion; then the arm is left all the same."""

_AT_REST = 1e-3  # rad/s (m/s): slower than this a joint stands still
_GO_ON = "to go on give the command again; in a program reset_fault(), then enable(), or close()"

T = TypeVar("T")


def _check_timeout(timeout: float | None) -> None:
    """Raises ``UnsafeCommandError`` for a time that would never be over by mistake."""
    if timeout is not None and timeout != math.inf and finite(timeout) is None:
        raise UnsafeCommandError(f"a timeout of {reprlib.repr(timeout)}", "a number of seconds")


class ArmState(enum.Enum):
    """What an arm is doing."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    ENABLED = "enabled"
    HOLD = "hold"
    MOVING = "moving"
    FAULT = "fault"


_S = ArmState
# Whoever moves the arm to a pose holds the lock: seen with the lock in hand, MOVING is a move cut short.
_IN_USE: Mapping[ArmState, ArmState] = dict.fromkeys((_S.ENABLED, _S.HOLD, _S.MOVING), _S.ENABLED)

EVENTS: Mapping[str, Mapping[ArmState, ArmState]] = {
    "connect": {_S.DISCONNECTED: _S.CONNECTED},
    "enable": {_S.CONNECTED: _S.ENABLED},
    "send": _IN_USE,
    "grip": _IN_USE,
    "hold": dict.fromkeys(_IN_USE, _S.HOLD),
    "move": dict.fromkeys(_IN_USE, _S.MOVING),
    "limit the current": {state: state for state in (_S.CONNECTED, *_IN_USE)},
    "reset a fault": {_S.FAULT: _S.CONNECTED},
    "reconnect": {_S.FAULT: _S.CONNECTED, _S.CONNECTED: _S.CONNECTED},
}
"""The life of an arm: event -> state before -> state after.  ``close`` and a fault come in every state."""


class Arm(Closing):
    """Servos of one arm file on one bus: a ``JointSink`` and a ``JointSource``.

    Args:
        config: The arm file.
        bus: Opened by ``connect``, closed by ``close``; one that is open before stays open,
            so that several arms can be on one wire.  Its clock is the arm's.
        on_exit: ``torque_off``, ``hold`` or ``park`` (then torque off); the arm file's by default.
        park_at: (n,) rad; by default where the arm was enabled: there it had stood without torque.

    Attributes:
        state: See ``ArmState``; ``fault``: what put the arm into ``FAULT``.
        joints: Names; ``lower``, ``upper``, ``resolution``: (n,) rad.
        exit_report: How the arm was left; None before.
    """

    def __init__(
        self,
        config: ArmConfig,
        bus: ServoBus,
        *,
        on_exit: str | None = None,
        park_at: ArrayLike | Mapping[str, float] | None = None,
    ) -> None:
        said = on_exit or config.on_exit
        self.on_exit = checked_policy(said, config.file or config.name, "bus.on_exit")
        self.config = config
        self.bus = bus
        self.clock = bus.clock
        bus.names |= {drive.id: drive.name for drive in config.drives}
        self.joints: tuple[str, ...] = config.names
        self.lower, self.upper, self.resolution = config.lower, config.upper, config.resolution
        self.state = ArmState.DISCONNECTED
        self.fault: HardwareError | None = None
        self.exit_report: ExitReport | None = None
        self._shares_bus = False  # it was open when we came
        self._cycle = Cycle(config, bus)
        self._park_at = park_at
        self._rest: dict[str, float] = {}  # joint -> where it was enabled; a gripper keeps what it has
        self._currents: dict[str, float] = {}  # joint -> mA asked for since connect
        self._energised = False  # torque may be on because of us, whatever the state says
        self._guard = ExitGuard(self._last_resort)
        self._lock = threading.RLock()
        self._heartbeat = Heartbeat(self._beat)
        self._streaming = False  # commands come one after the other, none of them meant to last
        self._commanded = 0.0  # when the last one came
        self._stop_file = StopFile(config.name)
        self._stop_requests: deque[str] = deque()  # policies of requests that were not carried out yet
        self._stop_lock = threading.Lock()
        self._stopping = False  # a request was taken and is not acknowledged yet
        self._stop_policy: str | None = None  # of the request carried out last: close leaves the arm so
        self._unraised_stop: StopRequestedError | None = None  # carried out by the heartbeat, not raised yet
        self._close_lock = threading.RLock()
        self._guardian: Guardian | None = None  # of [bus] on_orphan
        self._closing_thread: int | None = None  # its ident; from the begin of close until connect

    @property
    def reports(self) -> MotionReport:
        """What happened to the commands since ``enable``."""
        return self._cycle.reports

    @property
    def ages(self) -> Array:
        """(n,) s since each joint's last good sample; infinite before the first."""
        return self.clock.now() - self._cycle.samples.times

    # ------------------------------------------------------------------------------ from off to on

    def connect(self) -> None:
        """Opens the bus, checks that these are the arm file's servos, sets them up.  Torque stays as it is.

        Raises:
            ArmStateError: Already connected, or torque is on and a setting must change.
            BusNotOpenError, ServoMismatchError, MotorFaultError, ConfigError, BusTimeoutError,
            BusCorruptError, BusDisconnectedError, ServoRefusedError: Nothing was switched on; the bus is
            closed again.
        """
        with self._lock:
            with self._close_lock:  # a close that another thread has begun ends first
                self._closing_thread = None
            after = self._after("connect")
            self._shares_bus = self.bus.is_open
            try:
                self.bus.open()
                feedback = verify(self.bus, self.config, real=self.bus.real)
                self._currents.clear()
                self._require_not_closed()
            except BaseException:
                self._close_bus()
                raise
            self.fault = self.exit_report = self._stop_policy = self._unraised_stop = None
            self._cycle = Cycle(self.config, self.bus, feedback)
            self.state = after

    @uninterrupted
    def enable(self, *, handle_signals: bool = True) -> None:
        """Torque on where the arm stands; from here on signals and exceptions end in ``close``'s policy.

        A signal that comes meanwhile is raised at the end, and torque is off again.  A request to stop is
        carried out before torque comes on, or as soon as it is on.

        Args:
            handle_signals: False: the program keeps its own handlers of SIGINT and SIGTERM, and calls
                ``close`` itself when they come.

        Raises:
            ArmStateError, HardwareError, MotorFaultError, bus errors: Torque is off again where
                ``exit_report`` says so.  Joints that held before, after a fault, hold where ``on_exit`` is
                ``hold``.
            StopRequestedError: The arm was left as the request asked.  Latched.
            ConfigError: The arm file's zeros are placeholders and the servos real; nothing was switched on.
            KeyboardInterrupt, SystemExit: The signal.
        """
        with self._lock:
            after = self._after("enable")
            if self.bus.real:
                require_calibrated(self.config)
            if not self.config.stale_ms:
                log.warning(
                    "stale_ms = 0: in a pause of commands nothing holds the arm, a loaded joint sinks"
                )
            self._obey_stop(poll_now=True)
            self._guard.install(handle_signals=handle_signals)
            first = not self._energised
            try:
                self._give_torque(first)
                self.state = after
                self._obey_stop(poll_now=True)
                self._require_not_closed()
            except StopRequestedError:
                raise  # the arm was left as the request asked
            except BaseException:
                self._undo_enable(first)
                raise
            if self._guard.received:
                self._undo_enable(first)

    def _give_torque(self, first: bool) -> None:
        """Torque on where the arm stands.  From here on other processes can ask the arm to stop.

        ``first``: no servo has torque because of this arm yet.
        """
        if self._guardian is None:
            self._guardian = guardian_for(self.bus, self.config)
        if not isinstance(self.clock, VirtualClock):
            self._stop_file.open(self.bus.port)
            self._heartbeat.start()
        here = read_standing(self.bus, self.config)
        self._cycle.samples.begin(here, self.clock.now())
        self._cycle.stand(here)  # before torque: where it fails, nobody is sent to goals from before
        self._obey_stop(poll_now=True)
        self._require_not_closed()
        self._energised = True
        try:
            torque_on(self.bus, self.config, here)
        finally:
            self._energised = True  # also where another thread has left the arm meanwhile
        if first:  # After a later enable the arm stands where it never stood without torque.
            standing = dict(zip(self.joints, self._cycle.limits.q, strict=True))
            grippers = {joint.name for joint in self.config.group(GRIPPER)}
            self._rest = {name: q for name, q in standing.items() if name not in grippers}
        self._commanded, self._streaming = self.clock.now(), False

    def _undo_enable(self, first: bool) -> None:
        """Leaves the arm as it was before ``enable``, and remembers where that was not confirmed.

        Where joints held before, a request to stop comes first: it may ask to hold them.
        """
        if not first and not self._closed_elsewhere() and self._stop_pending(poll_now=True):
            self._unraised_stop = self._carry_out_stop()
            return
        confirmed = True
        if self._energised:
            confirmed = self._leave("torque_off" if first or self.on_exit != "hold" else "hold").ok
        self.state = ArmState.DISCONNECTED if self._closed_elsewhere() else ArmState.CONNECTED
        if first and confirmed:
            self._energised = False
            self._heartbeat.dismiss()
            self._release_guardian()
            self._stop_file.close()
            self._guard.remove()

    def __enter__(self) -> Self:
        if self.state is ArmState.DISCONNECTED:
            self.connect()
        return self

    # --------------------------------------------------------------------------------- in motion

    def send(self, q: ArrayLike | Mapping[str, float], now: float) -> Array:
        """One bus cycle: goals within limits and caps to all servos, positions of all back.

        Args:
            q: (n,) rad, or joint name -> rad (the others stay).
            now: Time for which ``q`` is meant, s.  The arm never moves faster than its own clock allows.

        Returns:
            (n,) rad that were sent: ``q`` within limits and caps.

        Raises:
            UnsafeCommandError: NaN, wrong length, unknown joint; nothing was sent.
            ArmStateError: Not enabled.
            MotorFaultError: A servo shut down or went silent, by joint; the others hold.  Latched.
            BusTimeoutError: All servos went silent.  BusDisconnectedError: The port went away.  Latched.
            StopRequestedError: Somebody asked the arm to stop.  Latched.
        """
        with self._lock:
            after = self._after("send")
            self._obey_stop()
            came = self.clock.now()
            self._latching(lambda: self._cycle.drive(q, now))
            self._commanded, self._streaming = came, True  # one that is refused is none: the arm goes stale
            self.state = after
            return np.array(self._cycle.limits.q)

    def read(self) -> JointReading:
        """Measured joint angles; those of this cycle's ``send`` cost nothing, otherwise the servos are asked.

        A joint that missed a cycle keeps its last sample; ``time`` is that of the oldest.  In ``FAULT`` the
        last samples are returned and no servo is asked.

        Raises:
            ArmStateError: Not connected.
            MotorFaultError, BusTimeoutError, BusDisconnectedError: As in ``send``.
        """
        with self._lock:
            self._require_not_closed()
            samples = self._cycle.samples
            if self.state is ArmState.DISCONNECTED:
                raise ArmStateError("cannot read: the arm is disconnected", hint="call connect() first")
            if self.state is ArmState.CONNECTED:
                ticks = read_all(self.bus, self.config, "present_position")
                samples.begin(ticks, self.clock.now())
            elif self.state is not ArmState.FAULT and self.ages.min() > 0.5 * self._cycle.period:
                self._latching(self._cycle.measure)
            return JointReading(samples.q.copy(), float(samples.times.min()))

    def positions(self) -> dict[str, float]:
        """Joint -> last measured rad (m of a slide), those of a gripper too; NaN before the first sample."""
        with self._lock:
            return self._cycle.positions()

    def hold(self) -> None:
        """Stay where you are; the next ``send`` goes on from here, from rest.

        A joint that is pushed further than ``cycle.SAG`` from its goal yields, once, when holding begins.

        Raises:
            ArmStateError, MotorFaultError, BusTimeoutError, BusDisconnectedError.
        """
        with self._lock:
            after = self._after("hold")
            self._streaming = False
            self._latching(self._cycle.hold)
            self.state = after

    def move_to(self, q: ArrayLike | Mapping[str, float], timeout: float | None = None) -> None:
        """Goes to ``q`` within the caps and holds there; returns when the shafts have arrived.

        Args:
            q: As of ``send``.
            timeout: s; by default what the caps ask for and 2 s.

        Raises:
            HardwareError: Not arrived in time; held as by ``hold``.  Otherwise as ``send``.
        """
        with self._lock:
            self._streaming = False
            off = self._go(q, timeout, stop=self._closed_elsewhere)
            self._require_not_closed()
            if off.any():
                self._latching(self._cycle.hold)  # it presses no longer on what is in its way
        if off.any():
            k = int((off / self.config.resolution).argmax())
            worst = self.config.joints[k]
            way = worst.text(float(off[k]))
            problem = f"{worst.name!r} is still {way} from where it was sent"
            raise HardwareError(problem, hint="is something in its way?")

    def grip(
        self, q: float | Mapping[str, float], *, current: float | None = None, timeout: float | None = None
    ) -> tuple[Grip, ...]:
        """Moves the fingers until they are there or something stops them; the other joints are held.

        Fingers in current-based position mode press on from here, no harder than ``current``, whatever the
        arm does meanwhile; others push with all they have, and what they cannot close on is an overload.

        Args:
            q: m (rad of a hinge) for every joint of the group ``gripper``, or joint name -> m.
            current: mA, at most the arm file's ``current_ma``; None: as it was.
            timeout: s; by default what the caps ask for and 2 s.

        Raises:
            UnknownJointError, UnsafeCommandError: No gripper, no such joint or current; nothing was sent.
            ArmStateError, MotorFaultError, bus errors: As ``send``.
        """
        with self._lock:
            after = self._after("grip")
            fingers = Fingers(self.config, q)
            if current is not None:
                self._set_currents(dict.fromkeys(fingers.goals, current))
            self._streaming = False
            self._go(
                fingers.goals,
                timeout,
                lambda: self._closed_elsewhere() or fingers.at_rest(self.clock.now(), self._cycle),
            )
            self._require_not_closed()
            self.state = after
            return fingers.report(self.bus, self._cycle)

    def limit_current(self, currents: Mapping[str, float]) -> None:
        """How hard joints in current-based position mode press from here on: a gripper's grip.

        Args:
            currents: Joint name -> mA, positive; more than the arm file's ``current_ma`` is that.

        Raises:
            UnknownJointError, UnsafeCommandError: Not such a joint, no such current; nothing was sent.
            ArmStateError, bus errors: With torque on latched, as of ``send``.
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
        self, q: ArrayLike | Mapping[str, float], timeout: float | None, stop: Callable[[], bool]
    ) -> Array:
        """(joints of q and of the gripper,) rad still to go."""
        _check_timeout(timeout)
        self.state = self._after("move")
        try:
            off = self._latching(lambda: self._cycle.go(q, timeout, lambda: stop() or self._stop_pending()))
            self._obey_stop()
            return off
        finally:
            if self.state is ArmState.MOVING:
                self.state = ArmState.HOLD

    def _after(self, event: str) -> ArmState:
        """The state after ``event``; raises where it may not come now."""
        self._require_not_closed()
        allowed = EVENTS[event]
        if self.state in allowed:
            return allowed[self.state]
        if self.state is ArmState.FAULT and self.fault is not None:
            if self.fault is self._unraised_stop:
                self._unraised_stop = None
            raise self.fault.with_traceback(None)
        need = ", ".join(state.value for state in allowed)
        steps = "connect(), enable(), then send(); after a fault reset_fault() or close()"
        raise ArmStateError(f"cannot {event}: the arm is {self.state.value}; allowed: {need}", hint=steps)

    # ----------------------------------------------------------------------------- what goes wrong

    def _latching(self, action: Callable[[], T]) -> T:
        """Runs one step of motion; what the servos or the bus raise becomes the arm's fault."""
        try:
            return action()
        except UnsafeCommandError:
            raise
        except HardwareError as error:
            self.state, self.fault = ArmState.FAULT, error
            log.info("fault: %s", error)  # whoever asked for the step gets the error itself
            try:  # the others stay where they are; the one in fault cannot hear or will not obey
                if self.bus.is_open:
                    goals = self._cycle.begin_hold()
                    if self.config.family.capabilities.goal_enables_torque:
                        goals = self._only_with_torque(goals)
                    self.bus.sync_write(shared_register(self.config, "goal_position"), goals)
            except HardwareError as second:
                log.warning("holding the other joints: %s", second)
            raise

    def _only_with_torque(self, goals: Mapping[int, int]) -> dict[int, int]:
        """Goals of the servos that have torque and no error: a goal would switch the others on again."""
        errors = self.bus.sync_read(list(goals), shared_register(self.config, "hardware_error_status"))
        torque = self.bus.sync_read(list(goals), shared_register(self.config, "torque_enable"))
        return {id: goal for id, goal in goals.items() if torque[id].data and errors[id].data == 0}

    def reset_fault(self) -> tuple[str, ...]:
        """Restarts the servos that have shut down and verifies everything; then ``enable`` goes on.

        The other joints keep their torque and hold; the restarted ones have none until ``enable``, which
        starts from where everything stands.

        Returns:
            Joints whose servos were restarted.

        Raises:
            ArmStateError: There is no fault, or the port is gone (``reconnect``).
            StopRequestedError: A request to stop that no call has raised yet.  It is carried out, the fault
                stays, and the next ``reset_fault`` goes on.
            HardwareError: Still not as it should be, e.g. a servo has lost its revolutions.  The fault stays.
        """
        with self._lock:
            after = self._after("reset a fault")
            self._raise_stop()
            if not self.bus.is_open:
                raise ArmStateError("cannot reset the fault: the port is gone", hint="call reconnect()")
            rows = reset_servos(self.bus, self.config)
            for row in rows:
                if row.silence is not None:
                    raise row.silence
            feedback = verify(self.bus, self.config, real=self.bus.real, currents=self._currents)
            self._begin_anew(feedback, after)
            return tuple(dict.fromkeys(row.joint for row in rows if row.restarted))

    def reconnect(self, timeout: float = 10.0) -> None:
        """Opens the port as soon as it is back, and verifies everything.  Never gives torque.

        Args:
            timeout: s to wait for the port.  Name it by what stays, e.g. ``/dev/serial/by-id/...``.

        Raises:
            ArmStateError: Nothing was connected, or the arm is in use.
            StopRequestedError: As of ``reset_fault``.
            BusNotOpenError, BusDisconnectedError: The port did not come back.
            HardwareError: These are not the servos as they were left.  The fault stays.
        """
        with self._lock:
            after = self._after("reconnect")
            self._raise_stop()
            _check_timeout(timeout)
            self._release_guardian()  # it has the file descriptor of the port that went away
            feedback = find_again(self.bus, self.config, timeout, real=self.bus.real, currents=self._currents)
            if self._energised:
                self._guardian = guardian_for(self.bus, self.config)
            self._begin_anew(feedback, after)

    def _release_guardian(self) -> None:
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.release()

    def _begin_anew(self, feedback: Feedback, after: ArmState) -> None:
        """From a verified bus to ``CONNECTED``; torque stays as it is, and so do the goals."""
        seen = self._cycle.samples.ticks | self._cycle.samples.jumped
        check_revolutions_kept(self.bus, self.config, seen)
        goals = self._cycle.goals
        self._cycle = Cycle(self.config, self.bus, feedback)
        self._cycle.goals, self._cycle.held = goals, True
        self.fault = self._stop_policy = None
        self.state = after

    # ----------------------------------------------------------------- while the program does not command

    def _beat(self) -> None:
        """One beat.  Whoever holds the lock is at work: then there is nothing to check."""
        self._poll_stop_file()
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self._heartbeat.stopping():
                return
            if self._stop_pending():
                self._unraised_stop = self._carry_out_stop()
            elif self.state in _IN_USE and self.config.stale_ms:
                self._attend(self.clock.now() - self._commanded)
        except Exception as error:
            log.error("found while no command came: %s", error)  # the next command raises it
        finally:
            self._lock.release()

    def _attend(self, idle: float) -> None:
        """Looks after an arm that got no command for ``idle`` seconds."""
        stale = stale_time(self.config.stale_ms, self._cycle.period)
        if idle < stale:
            return
        if self.state is ArmState.ENABLED and self._streaming:
            # At rest after the last command of a motion this is nothing to report.
            moving = any(abs(speed) > _AT_REST for speed in self._cycle.limits.velocity)
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
        """The program is as good as gone: the arm file says what to do then."""
        unparked = None
        if self.config.on_stale == "park":
            unparked = self._park(stop=self._heartbeat.stopping)
            if self._closed_elsewhere():
                return  # close leaves it, as on_exit says
        report = self._leave("torque_off", unparked)
        self.fault = HardwareError(
            f"no command came for {idle:.1f} s: {report.text}",
            hint=f"{_GO_ON}; on_stale and stale_ms are in the arm file",
        )
        self.state = ArmState.FAULT
        log.error("%s", self.fault)

    # --------------------------------------------------------------------------- somebody asks to stop

    def request_stop(self, policy: str = "hold") -> None:
        """Asks the arm to stop, from any thread: the next cycle or beat holds it and latches a fault.

        A request is kept until it is carried out, also one that comes before ``connect``, in ``FAULT`` or
        during ``enable``.  Afterwards ``close`` leaves the arm so, whatever ``on_exit`` says.  Once a call
        has raised ``StopRequestedError``, ``reset_fault`` and ``enable`` go on.

        Args:
            policy: ``hold`` or ``torque_off``.
        """
        self._stop_requests.append("torque_off" if policy == "torque_off" else "hold")

    def _stop_pending(self, *, poll_now: bool = False) -> bool:
        """Whether a request of this process or of another one waits to be carried out.

        The heartbeat looks for requests of other processes, beside the control cycle.  ``poll_now``: look
        for them here as well.
        """
        if poll_now:
            self._poll_stop_file()
        return bool(self._stop_requests)

    def _poll_stop_file(self) -> None:
        """Take over a request of another process, once: not while it is being carried out."""
        with self._stop_lock:
            if self._stop_requests or self._stopping:
                return
            policy = self._stop_file.requested()
            if policy is not None:
                self.request_stop(policy)

    def _obey_stop(self, *, poll_now: bool = False) -> None:
        """Carries out a request to stop, if there is one, and raises it."""
        if self._stop_pending(poll_now=poll_now):
            raise self._carry_out_stop()

    def _raise_stop(self) -> None:
        """As ``_obey_stop``; also raises one that the heartbeat carried out, which no call has raised."""
        self._obey_stop(poll_now=True)
        if self._unraised_stop is not None:
            stopped, self._unraised_stop = self._unraised_stop, None
            raise stopped.with_traceback(None)

    def _carry_out_stop(self) -> StopRequestedError:
        """Leaves the arm as the last request asks, and latches it as a fault."""
        policy = self._take_stop()
        report = self._leave(policy) if self._energised else self._leave_untouched()
        self._acknowledge_stop(report)
        stopped = StopRequestedError(f"stopped on request: {report.text}", hint=_GO_ON)
        if self.state is not ArmState.FAULT:  # an earlier one says more
            self.state, self.fault = ArmState.FAULT, stopped
        log.info("%s", stopped)
        return stopped

    def _take_stop(self) -> str:
        """The policy of the last request; there is one.  Requests that come meanwhile stay."""
        with self._stop_lock:
            self._stopping = True
            while self._stop_requests:
                self._stop_policy = self._stop_requests.popleft()
        return self._stop_policy or "hold"

    def _acknowledge_stop(self, report: ExitReport) -> None:
        """Tell the process that asked how the arm was left."""
        with self._stop_lock:
            self._stop_file.acknowledge(ok=report.ok, text=report.text)
            self._stopping = False

    # ------------------------------------------------------------------------------------ the end

    def _close_bus(self) -> None:
        """Closes it, unless it was open before the arm came: others are on it."""
        if not self._shares_bus:
            self.bus.close()

    @uninterrupted
    def close(self) -> None:
        """Leaves the arm as ``on_exit`` says, then the bus; ``exit_report`` says how.  Call it at any time.

        A signal that arrives meanwhile waits until the arm is left; the second one since ``enable`` ends a
        parking.  A motion that another thread has begun ends first, with ``ArmStateError`` there.

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
                # Each whatever becomes of the others; the handlers last, for then signals are no longer kept.
                for step in (
                    self._heartbeat.stop,
                    self._release_guardian,
                    self._close_bus,
                    self._stop_file.close,
                ):
                    try:
                        step()
                    except Exception as error:
                        log.error("closing the arm: %s", error)
                self.state, self._energised = ArmState.DISCONNECTED, False
                if locked:
                    self._lock.release()
                self._guard.remove()

    def _closed_elsewhere(self) -> bool:
        """Whether another thread leaves the arm, or has left it since ``connect``."""
        thread = self._closing_thread
        return thread is not None and thread != threading.get_ident()

    def _require_not_closed(self) -> None:
        """Raises where another thread leaves the arm: this one must move it no further."""
        if self._closed_elsewhere():
            raise ArmStateError("another thread has closed the arm", hint="connect() and enable() to go on")

    @uninterrupted
    def _leave_for_good(self, *, alone: bool) -> None:
        """``alone``: this thread has the lock, no other one talks to the servos."""
        if not self._energised:
            if self.state is not ArmState.DISCONNECTED:
                self._leave_untouched()
            return
        unparked = None
        if self.on_exit == "park":
            unparked = "another thread keeps the arm busy"
            if alone:
                unparked = self._park(stop=lambda: self._guard.received > 1)
        if self._stop_pending(poll_now=True):  # it came too late for a cycle
            self._acknowledge_stop(self._leave(self._take_stop(), unparked))
        else:
            self._leave(self._stop_policy or self.on_exit, unparked)

    def _leave_untouched(self) -> ExitReport:
        """No servo has torque because of this arm: each is left as it is, and an earlier report stays."""
        report = ExitReport("untouched")
        if self.exit_report is None:
            self.exit_report = report
        return report

    def _leave(self, policy: str, unparked: str | None = None) -> ExitReport:
        """Every way out goes through here; torque goes off where even that fails.

        ``unparked``: what ``_park`` gave; None: the arm was not to be parked.
        """
        goals: dict[int, int] = {}
        try:
            if policy == "hold" and self._cycle.goals:
                goals = self._cycle.begin_hold()
        except Exception as error:
            log.error("the goals to hold are not known: %s", error)
        begin = self.clock.now()
        report = leave(self.bus, self.config, policy, goals, parked=unparked == "")
        report = self.exit_report = replace(report, unparked=unparked or "")
        if report.ok:
            log.info("%s confirmed by all servos in %.3f s", report.done, self.clock.now() - begin)
        else:
            log.error("%s %s", report.done, report.doubt)
        return report

    def _park(self, stop: Callable[[], bool]) -> str:
        """Goes to where the arm is to be left; gives the reason where it does not arrive, else nothing."""
        there = self._rest if self._park_at is None else self._park_at
        reason = ""
        try:
            if self._stop_pending(poll_now=True):
                reason = "a stop was requested"
            elif self.state not in _IN_USE:
                reason = "the arm is in fault" if self.state is ArmState.FAULT else "the arm is not enabled"
            elif self._go(there, None, stop).any():
                reason = "it was interrupted" if stop() else "it did not arrive in time"
        except StopRequestedError:
            reason = "a stop was requested"
        except Exception as error:
            reason = str(error).partition("\n")[0]
        if reason:
            log.warning("not parked: %s", reason)
        return reason

    def _last_resort(self) -> None:
        """At the end of the interpreter, where the arm was not closed."""
        if not self._energised:
            return
        log.error("the program ended without closing its arm")
        try:
            self.close()
        except (KeyboardInterrupt, SystemExit):
            log.info("a signal came meanwhile: the arm was left, and the program ends anyway")
        except BaseException as error:
            log.error("closing it failed: %s", error)
