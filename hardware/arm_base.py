"""What every arm must be able to do at any moment: know its state, latch a fault, be left as its owner chose.

``Arm`` adds what it is for.  All methods may be called from one thread at a time; the heartbeat is the only
other one, and shares a lock with them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

from numpy.typing import ArrayLike

from robot_ik.errors import ArmStateError, HardwareError, UnsafeCommandError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle
from robot_ik.hardware.exit_guard import ExitGuard
from robot_ik.hardware.heartbeat import GIVE_UP, Heartbeat
from robot_ik.hardware.motion_report import MotionReport
from robot_ik.hardware.registers import shared_register
from robot_ik.hardware.shutdown import ExitReport, checked_policy, hold, torque_off
from robot_ik.hardware.state import ArmState
from robot_ik.ports import Array, Clock, VirtualClock

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus

log = logging.getLogger(__name__)

# rad/s (m/s): slower than this a joint stands still.
_AT_REST = 1e-3

T = TypeVar("T")

MOVABLE = (ArmState.ENABLED, ArmState.HOLD)
"""States in which an arm takes commands."""


class ArmBase:
    """State, fault, heartbeat and exit of an arm; see ``Arm`` for the arguments."""

    def __init__(
        self,
        config: ArmConfig,
        bus: ServoBus,
        clock: Clock,
        *,
        virtual_bus: VirtualBus | None = None,
        on_exit: str | None = None,
        park_at: ArrayLike | None = None,
    ) -> None:
        self.on_exit = checked_policy(on_exit or config.on_exit, config)
        self.config, self.bus, self.clock, self.virtual_bus = config, bus, clock, virtual_bus
        self.joints: tuple[str, ...] = config.names
        self.lower, self.upper, self.resolution = config.lower, config.upper, config.resolution
        self.state = ArmState.DISCONNECTED
        self.exit_report: ExitReport | None = None
        self._cycle = Cycle(config, bus, clock)
        self._park_at = park_at
        self._rest: tuple[float, ...] = ()
        self._fault: HardwareError | None = None
        self._shares_bus = False  # it was open when we came
        self._energised = False  # torque may be on because of us, whatever the state says
        self._guard = ExitGuard(self._last_resort)
        self._lock = threading.RLock()
        self._heartbeat = Heartbeat(self._look)
        self._streaming = False  # commands come one after the other, none of them meant to last
        self._commanded = 0.0  # when the last one came

    @property
    def reports(self) -> MotionReport:
        """What happened to the commands since ``enable``."""
        return self._cycle.reports

    @property
    def ages(self) -> Array:
        """(n,) s since each joint's last good sample; infinite before the first."""
        return self.clock.now() - self._cycle.samples.times[: len(self.joints)]

    @property
    def fault(self) -> HardwareError | None:
        """What put the arm into ``FAULT``."""
        return self._fault

    def _go(
        self, q: ArrayLike | Mapping[str, float], timeout: float | None, stop: Callable[[], bool]
    ) -> Array:
        """(n and joints aside,) rad still to go."""
        self.state = ArmState.PARKING
        try:
            return self._latching(lambda: self._cycle.go(q, timeout, stop))
        finally:
            if self.state is ArmState.PARKING:
                self.state = ArmState.HOLD

    def _require(self, what: str, *allowed: ArmState) -> None:
        if self.state in allowed:
            return
        if self.state is ArmState.FAULT and self._fault is not None and ArmState.FAULT not in allowed:
            raise self._fault.with_traceback(None)
        need = " or ".join(state.value for state in allowed)
        steps = "connect(), enable(), then send(); after a fault reset_fault() or close()"
        raise ArmStateError(f"cannot {what}: the arm is {self.state.value}, not {need}", hint=steps)

    def _latching(self, action: Callable[[], T]) -> T:
        """Runs one step of motion; what the servos or the bus raise becomes the arm's fault."""
        try:
            return action()
        except UnsafeCommandError:
            raise
        except HardwareError as error:
            self.state, self._fault = ArmState.FAULT, error
            log.info("fault: %s", error)  # whoever asked for the step is told by the error itself
            try:  # the others stay where they are; the one in fault cannot hear or will not obey
                if self.bus.is_open:
                    goal = shared_register(self.config, "goal_position")
                    self.bus.sync_write(goal, self._cycle.holding_goals())
            except HardwareError as second:
                log.warning("holding the other joints: %s", second)
            raise

    # ------------------------------------------------------------------------------- the heartbeat

    def _start_heartbeat(self) -> None:
        self._commanded, self._streaming = self.clock.now(), False
        if self.config.stale_ms and not isinstance(self.clock, VirtualClock):
            self._heartbeat.start()

    def _look(self) -> None:
        """One beat.  Whoever holds the lock is at work: then there is nothing to look after."""
        if not self._lock.acquire(blocking=False):
            return
        try:
            if self.state in MOVABLE:
                self._attend(self.clock.now() - self._commanded)
        except Exception as error:
            log.error("found while no command came: %s", error)  # the next command raises it
        finally:
            self._lock.release()

    def _attend(self, idle: float) -> None:
        """Looks after an arm that got no command for ``idle`` seconds."""
        stale = max(0.001 * self.config.stale_ms, 3.0 * self._cycle.period)
        if idle < stale:
            return
        if self.state is ArmState.ENABLED and self._streaming:
            # At rest after the last command of a motion this is nothing to be told of.
            moving = any(abs(speed) > _AT_REST for speed in self._cycle.limits.velocity)
            log.log(
                logging.WARNING if moving else logging.INFO, "no command for %.2f s: the arm is held", idle
            )
            self._cycle.reports.stale += 1
            self._latching(self._cycle.hold)
            self.state = ArmState.HOLD
        else:
            self._latching(self._cycle.measure)
        if self._streaming and self.config.on_stale != "hold" and idle > max(GIVE_UP, stale):
            self._give_up(idle)

    def _give_up(self, idle: float) -> None:
        """The program is as good as gone: the arm file says what to do then."""
        parked = self.config.on_stale == "park" and self._park(stop=self._heartbeat.stopping)
        report = torque_off(self.bus, self.config, parked=parked, clock=self.clock)
        done = "parked, torque off" if parked else "torque off"
        doubt = "" if report.ok else f", not confirmed by {', '.join(report.unverified)}"
        self._fault = HardwareError(
            f"no command came for {idle:.1f} s: {done}{doubt}",
            hint="reset_fault(), then enable(), or close(); on_stale and stale_ms are in the arm file",
        )
        self.state = ArmState.FAULT
        log.error("%s", self._fault)

    # ------------------------------------------------------------------------------------ the end

    def close(self) -> None:
        """Leaves the arm as ``on_exit`` says, then the bus; ``exit_report`` tells.  Call it at any time.

        A signal that arrives meanwhile waits until the arm is safe.  While parking, it ends the parking.

        Raises:
            KeyboardInterrupt, SystemExit: The signal that waited.
        """
        try:
            with self._guard.shield():
                self._heartbeat.stop()
                try:
                    if self._energised:
                        self.exit_report = self._leave()
                    elif self.state is not ArmState.DISCONNECTED:
                        self.exit_report = ExitReport("untouched")
                finally:
                    self._close_bus()
                    self.state = ArmState.DISCONNECTED
                    self._energised = False
        finally:
            self._guard.remove()
        waiting = self._guard.deferred()
        if waiting is not None:
            raise waiting

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        finally:
            if self._energised:  # a signal cut in before the shield was up
                self.close()

    def _close_bus(self) -> None:
        """Closes it, unless it was open before the arm came: others are on it."""
        if not self._shares_bus:
            self.bus.close()

    def _leave(self) -> ExitReport:
        parked = False
        if self.on_exit == "park":
            before = self._guard.received
            parked = self._park(stop=lambda: self._guard.received > before)
        if self.on_exit == "hold" and self._cycle.goals:
            return hold(self.bus, self.config, self._cycle.holding_goals(), self.clock)
        return torque_off(self.bus, self.config, parked=parked, clock=self.clock)

    def _park(self, stop: Callable[[], bool]) -> bool:
        """Whether the arm is where it is to be left; False where it cannot go there."""
        if self.state not in MOVABLE:
            return False
        there = self._rest if self._park_at is None else self._park_at
        try:
            return not self._go(there, None, stop).any()
        except Exception as error:
            log.error("not parked: %s", error)
            return False

    def _last_resort(self) -> None:
        """At the end of the interpreter: nobody closed the arm."""
        if self._energised:
            log.error("the program ended without closing its arm")
            try:
                self.close()
            except BaseException as error:
                log.error("closing it failed: %s", error)
