"""An arm of servos: takes joint angles, gives joint angles, and is left in the way its owner chose.

``DISCONNECTED`` → connect → ``CONNECTED`` → enable → ``ENABLED`` ↔ ``HOLD``; ``PARKING`` on the way to a
pose; ``FAULT`` is latched until the arm is closed.  One thread drives an arm.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import ArmStateError, HardwareError, UnsafeCommandError
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.cycle import Cycle, MotionReport
from robot_ik.hardware.exit_guard import ExitGuard
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.shutdown import ExitReport, checked_policy, hold, torque_off
from robot_ik.hardware.startup import check_servos, read_all, set_up_servos, shared_register
from robot_ik.hardware.state import ArmState
from robot_ik.hardware.switch_on import torque_on
from robot_ik.ports import Array, Clock, JointReading

if TYPE_CHECKING:
    from robot_ik.hardware.virtual.bus import VirtualBus

__all__ = ["Arm", "ArmState"]

log = logging.getLogger(__name__)

T = TypeVar("T")


_MOVABLE = (ArmState.ENABLED, ArmState.HOLD)


class Arm:
    """Servos of one arm file on one bus: a ``JointSink`` and a ``JointSource``.

    Args:
        config: The arm file.
        bus: Opened by ``connect``, closed by ``close``.
        clock: The loop's clock; virtual where the servos are simulated in process.
        virtual_bus: The simulated servos behind ``bus``, for tests and demonstrations; None on metal.
        on_exit: ``torque_off``, ``hold`` or ``park`` (then torque off); the arm file's by default.
        park_at: (n,) rad; by default where the arm was enabled: there it had stood without torque.

    Attributes:
        state: See ``ArmState``.
        joints: Names; ``lower``, ``upper``, ``resolution``: (n,) rad.
        exit_report: How the arm was left; None before.
    """

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
        self._energised = False  # torque may be on because of us, whatever the state says
        self._guard = ExitGuard(self._last_resort)

    @property
    def reports(self) -> MotionReport:
        """What happened to the commands since ``enable``."""
        return self._cycle.reports

    @property
    def ages(self) -> Array:
        """(n,) s since each joint's last good sample; infinite before the first."""
        return self.clock.now() - self._cycle.samples.times

    @property
    def fault(self) -> HardwareError | None:
        """What put the arm into ``FAULT``."""
        return self._fault

    def connect(self) -> None:
        """Opens the bus, checks that these are the arm file's servos, sets them up.  Torque stays as it is.

        Raises:
            ArmStateError: Already connected, or torque is on and a setting must change.
            BusNotOpenError, ServoMismatchError, MotorFaultError, ConfigError, BusTimeoutError,
            BusCorruptError, BusDisconnectedError, ServoRefusedError: Nothing was switched on; the bus is
            closed again.
        """
        self._require("connect", ArmState.DISCONNECTED)
        try:
            self.bus.open()
            check_servos(self.bus, self.config)
            set_up_servos(self.bus, self.config)
            feedback = Feedback(self.config)
            feedback.prepare(self.bus, read_all(self.bus, self.config, "firmware_version"))
        except BaseException:
            self.bus.close()
            raise
        self._fault = None
        self._cycle = Cycle(self.config, self.bus, self.clock, feedback)
        self.state = ArmState.CONNECTED

    def enable(self) -> None:
        """Torque on where the arm stands; from here on signals and exceptions end in ``close``'s policy.

        Raises:
            ArmStateError, HardwareError, MotorFaultError, bus errors: Torque is off again.
        """
        self._require("enable", ArmState.CONNECTED)
        self._guard.install()
        self._energised = True
        try:
            goals = torque_on(self.bus, self.config)
            self._cycle.stand(goals)
            self._cycle.samples.take(goals, self.clock.now())
        except BaseException:
            with self._guard.shield():
                self.exit_report = torque_off(self.bus, self.config)
                self._energised = False
            self._guard.remove()
            raise
        self._rest = self._cycle.limits.q
        self.state = ArmState.ENABLED

    def __enter__(self) -> Self:
        if self.state is ArmState.DISCONNECTED:
            self.connect()
        return self

    def send(self, q: ArrayLike | Mapping[str, float], now: float) -> None:
        """One bus cycle: goals within limits and caps to all servos, positions of all back.

        Args:
            q: (n,) rad, or joint name -> rad (the others stay).
            now: Time for which ``q`` is meant, s.

        Raises:
            UnsafeCommandError: NaN, wrong length, unknown joint; nothing was sent.
            ArmStateError: Not enabled.
            MotorFaultError: A servo shut down or went silent, by joint; the others hold.  Latched.
            BusTimeoutError: All servos went silent.  BusDisconnectedError: The port went away.  Latched.
        """
        self._require("send", *_MOVABLE)
        self._latching(lambda: self._cycle.drive(q, now))
        self.state = ArmState.ENABLED

    def read(self) -> JointReading:
        """Measured joint angles; those of this cycle's ``send`` cost nothing, otherwise the servos are asked.

        A joint that missed a cycle keeps its last sample; ``time`` is that of the oldest.  In ``FAULT`` the
        last samples are returned and nobody is asked.

        Raises:
            ArmStateError: Not connected.
            MotorFaultError, BusTimeoutError, BusDisconnectedError: As in ``send``.
        """
        samples = self._cycle.samples
        if self.state is ArmState.DISCONNECTED:
            raise ArmStateError("cannot read: the arm is disconnected", hint="call connect() first")
        if self.state is ArmState.CONNECTED:
            ticks = read_all(self.bus, self.config, "present_position")
            samples.take(ticks, self.clock.now())
        elif self.state is not ArmState.FAULT and self.ages.min() > 0.5 * self._cycle.period:
            self._latching(self._cycle.measure)
        return JointReading(samples.q.copy(), float(samples.times.min()))

    def hold(self) -> None:
        """Stay where you are; the next ``send`` goes on from here, from rest.

        Raises:
            ArmStateError, MotorFaultError, BusTimeoutError, BusDisconnectedError.
        """
        self._require("hold", *_MOVABLE)
        self._latching(self._cycle.hold)
        self.state = ArmState.HOLD

    def park(self, q: ArrayLike | Mapping[str, float], timeout: float | None = None) -> None:
        """Goes to ``q`` within the caps and holds there; returns when the shafts have arrived.

        Args:
            q: (n,) rad, or joint name -> rad.
            timeout: s; by default what the caps ask for and 2 s.

        Raises:
            HardwareError: Not arrived in time.  Otherwise as ``send``.
        """
        self._require("park", *_MOVABLE)
        off = self._go(q, timeout, stop=lambda: False)
        if off.any():
            worst = int(off.argmax())
            raise HardwareError(
                f"{self.joints[worst]!r} is still {np.degrees(off[worst]):.1f} deg from where it was sent",
                hint="is something in its way?",
            )

    def _go(
        self, q: ArrayLike | Mapping[str, float], timeout: float | None, stop: Callable[[], bool]
    ) -> Array:
        """(n,) rad still to go."""
        self.state = ArmState.PARKING
        try:
            return self._latching(lambda: self._cycle.go(q, timeout, stop))
        finally:
            if self.state is ArmState.PARKING:
                self.state = ArmState.HOLD

    def close(self) -> None:
        """Leaves the arm as ``on_exit`` says, then the bus; ``exit_report`` tells.  Call it at any time.

        A signal that arrives meanwhile waits until the arm is safe.  While parking, it ends the parking.

        Raises:
            KeyboardInterrupt, SystemExit: The signal that waited.
        """
        try:
            with self._guard.shield():
                try:
                    if self._energised:
                        self.exit_report = self._leave()
                    elif self.state is not ArmState.DISCONNECTED:
                        self.exit_report = ExitReport("untouched")
                finally:
                    self.bus.close()
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

    def _leave(self) -> ExitReport:
        parked = False
        if self.on_exit == "park" and self.state in _MOVABLE:
            before = self._guard.received
            there = self._rest if self._park_at is None else self._park_at
            try:
                parked = not self._go(there, None, stop=lambda: self._guard.received > before).any()
            except Exception as error:
                log.error("not parked: %s", error)
        if self.on_exit == "hold" and self._cycle.goals:
            return hold(self.bus, self.config, self._cycle.holding_goals())
        return torque_off(self.bus, self.config, parked=parked)

    def _require(self, what: str, *allowed: ArmState) -> None:
        if self.state in allowed:
            return
        if self.state is ArmState.FAULT and self._fault is not None:
            raise self._fault.with_traceback(None)
        need = " or ".join(state.value for state in allowed)
        steps = "connect(), enable(), then send(); after a fault close() and start again"
        raise ArmStateError(f"cannot {what}: the arm is {self.state.value}, not {need}", hint=steps)

    def _latching(self, action: Callable[[], T]) -> T:
        """Runs one step of motion; what the servos or the bus raise becomes the arm's fault."""
        try:
            return action()
        except UnsafeCommandError:
            raise
        except HardwareError as error:
            self.state, self._fault = ArmState.FAULT, error
            log.error("fault: %s", error)
            try:  # the others stay where they are; the one in fault cannot hear or will not obey
                goal = shared_register(self.config, "goal_position")
                self.bus.sync_write(goal, self._cycle.holding_goals())
            except HardwareError as second:
                log.warning("holding the other joints: %s", second)
            raise

    def _last_resort(self) -> None:
        """At the end of the interpreter: nobody closed the arm."""
        if self._energised:
            log.error("the program ended without closing its arm")
            try:
                self.close()
            except BaseException as error:
                log.error("closing it failed: %s", error)
