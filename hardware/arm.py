"""An arm of servos: takes joint angles, gives joint angles, and is left in the way its owner chose.

``DISCONNECTED`` → connect → ``CONNECTED`` → enable → ``ENABLED`` ↔ ``HOLD``; ``PARKING`` on the way to a
pose; ``FAULT`` is latched until ``reset_fault``, ``reconnect`` or ``close``.  One thread drives an arm.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Self

from numpy.typing import ArrayLike

from robot_ik.errors import ArmStateError, HardwareError
from robot_ik.hardware.arm_base import MOVABLE
from robot_ik.hardware.calibration import require_calibrated
from robot_ik.hardware.currents import set_currents
from robot_ik.hardware.cycle import Cycle
from robot_ik.hardware.feedback import Feedback
from robot_ik.hardware.gripping import Gripping
from robot_ik.hardware.recovery import check_turns_kept, find_again, restart_faulty, verify
from robot_ik.hardware.registers import read_all
from robot_ik.hardware.shutdown import torque_off
from robot_ik.hardware.state import ArmState
from robot_ik.hardware.switch_on import torque_on
from robot_ik.ports import JointReading

__all__ = ["Arm", "ArmState"]

log = logging.getLogger(__name__)


class Arm(Gripping):
    """Servos of one arm file on one bus: a ``JointSink`` and a ``JointSource``.

    Args:
        config: The arm file.
        bus: Opened by ``connect``, closed by ``close``; one that is open before stays open, so that several arms
            can be on one wire.
        clock: The loop's clock; virtual where the servos are simulated in process.
        virtual_bus: The simulated servos behind ``bus``, for tests and demonstrations; None on metal.
        on_exit: ``torque_off``, ``hold`` or ``park`` (then torque off); the arm file's by default.
        park_at: (n,) rad; by default where the arm was enabled: there it had stood without torque.

    Attributes:
        state: See ``ArmState``.
        joints: Names; ``lower``, ``upper``, ``resolution``: (n,) rad.
        exit_report: How the arm was left; None before.
    """

    def connect(self) -> None:
        """Opens the bus, checks that these are the arm file's servos, sets them up.  Torque stays as it is.

        Raises:
            ArmStateError: Already connected, or torque is on and a setting must change.
            BusNotOpenError, ServoMismatchError, MotorFaultError, ConfigError, BusTimeoutError,
            BusCorruptError, BusDisconnectedError, ServoRefusedError: Nothing was switched on; the bus is
            closed again.
        """
        self._require("connect", ArmState.DISCONNECTED)
        self._shares_bus = self.bus.is_open
        try:
            self.bus.open()
            feedback = verify(self.bus, self.config, real=self.virtual_bus is None)
        except BaseException:
            self._close_bus()
            raise
        self._fault = None
        self._cycle = Cycle(self.config, self.bus, self.clock, feedback)
        self.state = ArmState.CONNECTED

    def enable(self) -> None:
        """Torque on where the arm stands; from here on signals and exceptions end in ``close``'s policy.

        Raises:
            ArmStateError, HardwareError, MotorFaultError, bus errors: Torque is off again.
            ConfigError: The arm file's zeros are placeholders and the servos real; nothing was switched on.
        """
        self._require("enable", ArmState.CONNECTED)
        if self.virtual_bus is None:
            require_calibrated(self.config)
        self._guard.install()
        first = not self._energised
        self._energised = True
        try:
            goals = torque_on(self.bus, self.config)
            self._cycle.stand(goals)
            self._cycle.samples.begin(goals, self.clock.now())
        except BaseException:
            with self._guard.shield():
                self.exit_report = torque_off(self.bus, self.config, clock=self.clock)
                self._energised = False
            self._guard.remove()
            raise
        if first:  # later it is somewhere it never stood without torque
            self._rest = self._cycle.limits.q[: len(self.joints)]  # a gripper keeps what it has
        self.state = ArmState.ENABLED
        self._start_heartbeat()

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
        with self._lock:
            self._require("send", *MOVABLE)
            self._commanded, self._streaming = self.clock.now(), True
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
        with self._lock:
            samples = self._cycle.samples
            if self.state is ArmState.DISCONNECTED:
                raise ArmStateError("cannot read: the arm is disconnected", hint="call connect() first")
            if self.state is ArmState.CONNECTED:
                ticks = read_all(self.bus, self.config, "present_position")
                samples.begin(ticks, self.clock.now())
            elif self.state is not ArmState.FAULT and self.ages.min() > 0.5 * self._cycle.period:
                self._latching(self._cycle.measure)
            return JointReading(samples.q[: len(self.joints)].copy(), float(samples.times.min()))

    def hold(self) -> None:
        """Stay where you are; the next ``send`` goes on from here, from rest.

        Raises:
            ArmStateError, MotorFaultError, BusTimeoutError, BusDisconnectedError.
        """
        with self._lock:
            self._require("hold", *MOVABLE)
            self._streaming = False
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
        with self._lock:
            self._require("park", *MOVABLE)
            self._streaming = False
            off = self._go(q, timeout, stop=lambda: False)
        if off.any():
            worst = self.config.whole.joints[int((off / self.config.whole.resolution).argmax())]
            way = worst.text(float(off[self.config.whole.names.index(worst.name)]))
            raise HardwareError(
                f"{worst.name!r} is still {way} from where it was sent",
                hint="is something in its way?",
            )

    def limit_current(self, currents: Mapping[str, float]) -> None:
        """How hard joints in current-based position mode press from here on: a gripper's grip.

        Args:
            currents: Joint name -> mA, positive; more than the arm file's ``current_ma`` is that.

        Raises:
            UnknownJointError, UnsafeCommandError: Not such a joint, no such current; nothing was sent.
            ArmStateError, bus errors.
        """
        with self._lock:
            self._require("limit the current", ArmState.CONNECTED, *MOVABLE)
            set_currents(self.bus, self.config, currents)

    def reset_fault(self) -> tuple[str, ...]:
        """Restarts the servos that have shut down and verifies everything; then ``enable`` goes on.

        The other joints keep their torque and hold; the restarted ones have none until ``enable``, which
        starts from where everything stands.

        Returns:
            Joints whose servos were restarted.

        Raises:
            ArmStateError: There is no fault, or the port is gone (``reconnect``).
            HardwareError: Still not as it should be, e.g. a servo has lost its turns.  The fault stays.
        """
        with self._lock:
            self._require("reset a fault", ArmState.FAULT)
            if not self.bus.is_open:
                raise ArmStateError("cannot reset the fault: the port is gone", hint="call reconnect()")
            joints = restart_faulty(self.bus, self.config, self.clock)
            self._begin_anew(verify(self.bus, self.config, real=self.virtual_bus is None))
            return joints

    def reconnect(self, timeout: float = 10.0) -> None:
        """Opens the port as soon as it is back, and verifies everything.  Never gives torque.

        Args:
            timeout: s to wait for the port.  Name it by what stays, e.g. ``/dev/serial/by-id/...``.

        Raises:
            ArmStateError: Nothing was connected, or the arm is in use.
            BusNotOpenError, BusDisconnectedError: The port did not come back.
            HardwareError: These are not the servos as they were left.  The fault stays.
        """
        with self._lock:
            self._require("reconnect", ArmState.FAULT, ArmState.CONNECTED)
            real = self.virtual_bus is None
            self._begin_anew(find_again(self.bus, self.config, self.clock, timeout, real=real))

    def _begin_anew(self, feedback: Feedback) -> None:
        """From a verified bus to ``CONNECTED``; torque stays as it is."""
        check_turns_kept(self.bus, self.config, self._cycle.samples)
        self._cycle = Cycle(self.config, self.bus, self.clock, feedback)
        self._fault = None
        self.state = ArmState.CONNECTED
