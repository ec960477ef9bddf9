"""A servo arm that follows the first instance of the testbed, or repeats a recorded motion.

One thread drives the arm at the arm's own rate. The session only stores the newest joint angles for
it. So a slow page does not delay a bus cycle, and a silent session makes the arm hold.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robot_ik.errors import ArmStateError, HardwareError, MotionBlockedError, RobotIkError
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.health import ServoState, read_states
from robot_ik.motion.trajectory import RecorderSink, Trajectory
from robot_ik.ports import Array, VirtualClock
from robot_ik.robot import Robot
from robot_ik.robot_arm import RobotArm
from robot_ik.schedule import Schedule, StoppableClock, regular
from robot_ik.signals import ExitGuard
from robot_ik.testbed.commands import ArmMode
from robot_ik.testbed.problem_text import problem_text
from robot_ik.workcell.arm_guard import guard_of
from robot_ik.workcell.guided_motion import approach, playable

STALE = 0.5
"""Seconds without new joint angles after which the arm holds."""

TEACH_LIMIT = 600.0
"""Seconds that a recording may take."""

_SETTLE = 1.0
"""Seconds for which the end of a recording is sent: after a fast motion the limiter lags."""

_TELEMETRY_PERIOD = 0.5
"""Seconds between two readings of currents and temperatures."""

_CLOSE_LIMIT = 10.0
"""Seconds to wait for the thread to end."""


@dataclass(frozen=True, eq=False)
class ArmView:
    """The arm at one moment.

    Attributes:
        robot: The arm's robot. ``xpos`` and ``xquat`` are of its bodies.
        is_shown: Whether the session shows this robot.
        state: State of the arm's life cycle.
        mode: The last mode that was set.
        port: Name of its bus.
        q: (nq,) measured joint angles in the robot's order. None before the first reading.
        xpos: (nbody, 3) positions of bodies at the measured angles. None before the first reading.
        xquat: (nbody, 4) their orientations, wxyz.
        apart: Largest distance of a joint from the session's value, rad or m.
        servos: Currents, temperatures, errors.
        recorded: Length of the recording in seconds, also while it is made. 0: none.
        limp: Whether the torque of a joint is off, so that nothing holds the arm.
        message: An error in one sentence. Empty: none.
    """

    robot: Robot
    is_shown: bool
    state: str
    mode: ArmMode
    port: str
    q: Array | None
    xpos: Array | None
    xquat: Array | None
    apart: float
    servos: tuple[ServoState, ...]
    recorded: float
    limp: bool
    message: str


class ArmLink:
    """The arm and the thread that drives it. The first "follow" switches torque on.

    Args:
        opened: Robot and arm, connected by ``open``.
        robot: The robot of the session whose angles the arm gets.
        port: Name of its bus.

    Attributes:
        recording: The last recording. None without one.
    """

    def __init__(self, opened: RobotArm, robot: Robot, port: str) -> None:
        self._opened = opened
        self._arm = opened.arm
        self._robot = robot
        self._port = port
        self._order = [robot.joints.index(joint) for joint in opened.robot.joints]
        self._mode: ArmMode = "hold"
        self._wanted: tuple[Array, float] | None = None
        self._measured: Array | None = None
        self._servos: Sequence[ServoState] = ()
        self._message = ""
        self._running = True  # the session runs
        self._alive = -np.inf  # time of its last tick
        self._is_shown = True  # the session's robot is the arm's
        self._recorder = RecorderSink(opened.robot.joints)
        self.recording: Trajectory | None = None
        self._plan: Iterator[Array] | None = None
        self._collision_guard = guard_of(opened.config, robot.path)
        self._streaming = False  # whether the last cycle sent joint angles of the session
        self._guard = ExitGuard(self.close)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._drive, name="testbed-arm", daemon=True)

    def open(self) -> None:
        """Connect the arm. Torque stays as it is.

        From here on signals raise an exception in the main thread, which leaves the arm.

        Raises:
            HardwareError: As ``Arm.connect``.
        """
        self._arm.connect()
        self._guard.install()
        self._thread.start()

    # Called by the session's loop

    def ask(self, mode: ArmMode) -> None:
        """Follow the session, hold, let go, record a hand, or repeat the recording."""
        if mode == "replay" and self._mode != "teach" and self.recording is None:
            self._message = "nothing was recorded yet: press Teach, guide the arm, press Replay"
            return
        if mode in ("follow", "replay") and not self._is_shown:
            self._message = f"the arm is a {self._robot.name}: choose that robot first"
            return
        waits = mode in ("follow", "replay") and not self._running
        self._message = "the session holds still: press Start to move the arm" if waits else ""
        self._mode = mode

    def stop(self, reason: str) -> None:
        """Make a moving arm hold, until a person presses Follow or Replay again.

        Args:
            reason: Why it holds, for the message on the page.
        """
        if self._mode in ("follow", "replay"):
            self._message = f"{reason}, and press {self._mode.capitalize()} to move the arm again"
            self._mode = "hold"

    def follow(self, robot: Robot, q: Array, running: bool) -> None:
        """Take the newest joint angles of the session's first robot, which the arm follows.

        Another robot than the arm's stops the arm.

        Args:
            robot: The session's robot.
            q: (nq,) its joint angles, rad or m.
            running: Whether the session runs. The arm holds while it does not run.
        """
        self._is_shown = robot.joints == self._robot.joints and robot.path == self._robot.path
        if not self._is_shown:
            self.stop(f"the arm is a {self._robot.name}: it holds. Choose that robot")
            return
        self._running = running
        if running:
            self._alive = time.monotonic()
            self._wanted = q[self._order].copy(), self._alive

    def view(self) -> ArmView:
        """Return what a front end shows."""
        measured = self._measured
        q = None
        xpos = None
        xquat = None
        apart = 0.0
        if measured is not None:
            q = self._robot.home.copy()
            q[self._order] = measured
            data = self._robot.data_at(q)
            xpos = data.xpos.copy()
            xquat = data.xquat.copy()
            if self._wanted is not None:
                apart = float(np.abs(measured - self._wanted[0]).max())
        state = self._arm.state
        servos = tuple(self._servos)
        return ArmView(
            robot=self._robot,
            is_shown=self._is_shown,
            state=state.value,
            mode=self._mode,
            port=self._port,
            q=q,
            xpos=xpos,
            xquat=xquat,
            apart=apart,
            servos=servos,
            recorded=self._recorded_seconds(),
            limp=state is ArmState.CONNECTED and not _all_have_torque(servos),
            message=self._message,
        )

    def _recorded_seconds(self) -> float:
        """Return the length of the recording that is made now, else of the last one."""
        if samples := len(self._recorder):
            return (samples - 1) / self._arm.config.rate_hz
        return self.recording.duration if self.recording is not None else 0.0

    def close(self) -> None:
        """Leave the arm by its exit policy."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(_CLOSE_LIMIT)
        self._arm.close()
        self._guard.remove()

    @property
    def left(self) -> str:
        """How the arm was left."""
        return self._arm.exit_report.text if self._arm.exit_report is not None else ""

    # Called by the arm's thread

    def _drive(self) -> None:
        period = 1.0 / self._arm.config.rate_hz
        last_reading = 0.0
        schedule = Schedule(StoppableClock(self._over))
        for _ in schedule.ticks(regular(self._arm.config.rate_hz)):
            if self._over.is_set():
                break
            try:
                self._cycle(period)
                if time.monotonic() - last_reading > _TELEMETRY_PERIOD:
                    last_reading = time.monotonic()
                    self._servos = read_states(self._arm.bus, self._arm.config.drives)
            except RobotIkError as error:
                self._message = problem_text(error)
                if isinstance(error, ArmStateError | HardwareError | MotionBlockedError):
                    self._mode = "hold"

    def _cycle(self, period: float) -> None:
        """Run one cycle of the bus with the newest joint angles."""
        arm = self._arm
        mode = self._mode
        if isinstance(arm.clock, VirtualClock):  # its time passes only in ``sleep_until``
            arm.clock.sleep_until(arm.clock.now() + period)
        if arm.state is ArmState.FAULT:
            return
        if mode != "teach":
            self._end_recording()
        if mode != "replay":
            self._plan = None
        was_streaming = self._streaming
        self._streaming = False
        fresh = self._running and time.monotonic() - self._alive < STALE
        if mode in ("release", "teach"):
            if arm.state is not ArmState.CONNECTED:
                self._let_go()
        elif arm.state is ArmState.CONNECTED:
            if mode in ("follow", "replay"):
                arm.enable()
        elif mode == "follow" and fresh and self._wanted is not None:
            self._follow(self._wanted[0], was_streaming)
        elif mode == "replay" and fresh:
            self._replay()
        elif arm.state is ArmState.ENABLED:
            arm.hold()
        self._measured = self._opened.read().q
        if mode == "teach" and arm.state is ArmState.CONNECTED:
            self._record(self._measured)

    def _follow(self, q: Array, is_continued: bool) -> None:
        """Send joint angles of the session, or hold where the next step would be in collision.

        Args:
            q: Joint angles (n,) of the session, rad or m.
            is_continued: Whether the last cycle followed the session too.
        """
        self._streaming = True
        guard = self._collision_guard
        if guard is None:
            self._opened.send(q, self._arm.clock.now())
            return
        if not is_continued:
            guard.begin(self._arm.positions())
        before = guard.contact
        wanted = dict(zip(self._opened.robot.joints, q.tolist(), strict=True))
        guard.send(self._arm, wanted)
        if guard.contact or before:
            self._message = f"the arm holds: {guard.contact}" if guard.contact else ""

    def _replay(self) -> None:
        """Send the next sample of the recording, after a slow approach to its start. Then hold."""
        arm = self._arm
        shown = self.recording
        if shown is None:
            self._mode = "hold"
            return
        if self._plan is None:
            chain = self._opened.chain
            motion, _ = playable(shown, chain, 1.0)
            path = approach(self._opened.read().q, motion.q[0], chain)
            if self._collision_guard is not None:
                for part in (path, motion):
                    self._collision_guard.checked(part, arm.positions())
            rest = np.repeat(motion.q[-1:], round(_SETTLE * arm.config.rate_hz), axis=0)
            self._plan = iter([*path.q, *motion.q, *rest])
        q = next(self._plan, None)
        if q is None:
            self._mode = "hold"
            self._plan = None
        else:
            self._opened.send(q, arm.clock.now())

    def _record(self, q: Array) -> None:
        """Record one sample (n,). The first instance moves simulated servos as a hand would."""
        arm = self._arm
        self._recorder.send(q, arm.clock.now())
        servos = self._opened.virtual_bus
        if servos is not None and self._wanted is not None:
            chain = self._opened.chain
            limit = chain.velocity / chain.rate_hz  # the hand is not faster than the arm
            moved = q + np.clip(self._wanted[0] - q, -limit, limit)
            ends = zip(q.tolist(), moved.tolist(), strict=True)
            moves = dict(zip(chain.names, ends, strict=True))
            with servos.lock:
                for drive in chain.drives:
                    begin, end = moves[drive.name]
                    turn = drive.position(end) - drive.position(begin)
                    servos.servo(drive.id).rotate_by_hand(turn)
        if len(self._recorder) > TEACH_LIMIT * arm.config.rate_hz:
            self._mode = "release"
            self._message = f"the recording ended at its limit of {TEACH_LIMIT:.0f} s"

    def _end_recording(self) -> None:
        """Keep the samples as the motion to repeat."""
        if len(self._recorder) > 1:
            self.recording = self._recorder.trajectory()
        if len(self._recorder):
            self._recorder = RecorderSink(self._opened.robot.joints)

    def _let_go(self) -> None:
        """Switch torque off and connect again."""
        self._servos = ()  # in the last reading torque is on
        policy = self._arm.on_exit
        self._arm.on_exit = "torque_off"
        try:
            self._arm.close()
        finally:
            self._arm.on_exit = policy
        self._arm.connect()


def _all_have_torque(servos: Sequence[ServoState]) -> bool:
    """Return whether every servo has torque. An earlier program may have left it on."""
    return bool(servos) and all(servo.torque for servo in servos)
