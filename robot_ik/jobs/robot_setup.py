"""The arm's side of a job: robot, servos, clock, and the joint angles read back."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.errors import OptionError, UnsupportedJointError
from robot_ik.hardware import SIMULATED, bus_row
from robot_ik.jobs.recording import Recording, RecordingSink
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.ports import Array, Clock, JointSink, RealClock, VirtualClock
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_arm import RobotArm, arm_collisions, open_robot, robot_of_arm
from robot_ik.workcell.arm_guard import guard_of

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.motion.trajectory import Trajectory
    from robot_ik.workcell.arm_guard import ArmGuard


_log = logging.getLogger(__name__)

_RATE_HZ = 100.0
# A generic servo is this much faster than the plan, so that what fell behind on a busy machine catches up.
_HEADROOM = 1.3


@dataclass(frozen=True)
class Rehearsal:
    """What shall go wrong, to see that it is noticed; for simulated servos and the synthetic camera.

    Attributes:
        zero_offset_deg: Joint -> degrees by which its servo's shaft is ahead of what its registers say.
        stuck: Joints whose shaft does not move.
        cover_gripper: Hide the gripper's markers in the second picture.
        blank_marker: Leave the target's paper white.
        marker_at: As for ``Scene.with_marker_at``; None: the scene's own.
    """

    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
    stuck: tuple[str, ...] = ()
    cover_gripper: bool = False
    blank_marker: bool = False
    marker_at: tuple[float, ...] | None = None


@dataclass(frozen=True)
class ArmRequest:
    """An arm on a bus.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        frame: What shall be moved; None: the tool, or what carries the scene's markers.
        bus: ``pty``, ``sim``, ``none`` or a serial port.
        arm_file: As for ``ArmConfig.load``; None: the one beside the model, else a generic one; without a
            bus none.
        speed: Share of the joints' speed limits.
        seed: Of planning, restarts and simulated noise.
        view: Mirror the motion in a window.
    """

    robot: str = "puma560"
    frame: str | None = None
    bus: str = "sim"
    arm_file: Path | None = None
    speed: float = 1.0
    seed: int = 0
    view: bool = False
    rehearsal: Rehearsal = Rehearsal()


@dataclass(frozen=True)
class JointLimits:
    """Where the limits of one joint come from: rad (m for slides).

    Attributes:
        servo: What the servo's mode and the arm file leave together; None without servos.
        arm_file: What the arm file alone says; None without one.
    """

    joint: str
    unit: str
    model: tuple[float, float]
    servo: tuple[float, float] | None
    arm_file: tuple[float, float] | None
    used: tuple[float, float]


@dataclass(eq=False)
class RobotSetup:
    """A robot and, with a bus, its servos.

    Attributes:
        robot: Inside the intersection of model, servo mode and joint map.
        frame: What shall be moved.
        limits: How that intersection came about.
        guard: Checks the motions of the arm; None if its file has no table ``[collisions]``.
        collisions: The condition of that table, for solutions; None without the table.
        opened: Robot and arm; None without a bus.
        clock: Of the run; virtual where nothing real waits.
        dof: How many joints move the frame.
        shown: (nq,) what was read back last (what was commanded, without a bus): for pictures and windows.
        recorder: Writes what is commanded and measured; empty: nothing does.
        commanded: (nq,) what was sent last.
    """

    robot: Robot
    frame: str
    limits: list[JointLimits]
    opened: RobotArm | None
    clock: Clock
    guard: ArmGuard | None = None
    collisions: CollisionAvoidance | None = None

    def __post_init__(self) -> None:
        self.dof = len(joints_that_move(self.robot, self.frame))
        self.recorder: list[JointSink] = []
        self.commanded: Array = self.robot.home.copy()
        self.shown = self.commanded

    @property
    def arm(self) -> Arm | None:
        """The servos; None without a bus."""
        return None if self.opened is None else self.opened.arm

    @property
    def config(self) -> ArmConfig | None:
        """The arm file with the joints of the robot, in its order; None without a bus."""
        return None if self.opened is None else self.opened.chain

    @property
    def has_real_servos(self) -> bool:
        """Whether metal moves."""
        return self.opened is not None and self.opened.arm.bus.real

    def record(self, recording: Recording) -> None:
        """From here on every command is written, with what the servos measured last."""
        measured = None if self.arm is None else self.arm.positions
        self.recorder = [RecordingSink(recording, self.robot.joints, measured)]

    @property
    def sinks(self) -> list[JointSink]:
        """Who takes commands; the setup itself keeps the last one."""
        return [*([] if self.opened is None else [self.opened]), self, *self.recorder]

    def begin_stream(self) -> list[JointSink]:
        """Return sinks for a stream of commands, which stop the arm before parts touch."""
        if self.guard is None or self.arm is None:
            return self.sinks
        self.guard.begin(self.arm.positions())
        return [_GuardedSink(self, self.guard, self.arm)]

    def send(self, q: Array, now: float) -> None:
        """Keeps ``q`` (nq,) as what was sent last."""
        self.commanded = np.array(q, dtype=float)

    @property
    def q(self) -> Array:
        """(nq,) where the joints are: measured, or as commanded without a bus."""
        if self.opened is None:
            return self.commanded
        from robot_ik.hardware.arm import ArmState

        if self.opened.arm.state is ArmState.DISCONNECTED:
            return self.commanded
        self.shown = self.opened.read().q.copy()
        return self.shown

    def true_q(self) -> Array:
        """(nq,) where a camera would see the joints: with virtual servos their shafts, faults included."""
        true_q = None if self.opened is None else self.opened.true_q()
        return self.shown if true_q is None else true_q

    @property
    def resolution(self) -> Array:
        """(nv,) rad per servo tick; zeros without servos."""
        return np.zeros(self.robot.nv) if self.config is None else np.asarray(self.config.resolution)

    def caps(self, speed: float) -> dict[str, Any]:
        """Speed limits, as ``joint_move`` and ``line_move`` take them: a share of the arm file's."""
        shared = {"rate": self.rate, "speed": speed}
        if self.config is None:
            return shared
        return {
            "velocity_limits": self.config.velocity,
            "acceleration_limits": self.config.acceleration,
            **shared,
        }

    def checked(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory that the arm may play.

        Without the table ``[collisions]`` of an arm file each one is allowed.

        Raises:
            MotionBlockedError: It would bring parts nearer than the margin.
        """
        if self.guard is None:
            return trajectory
        positions = dict(zip(self.robot.joints, self.commanded.tolist(), strict=True))
        if self.arm is not None:
            positions = self.arm.positions()
        return self.guard.checked(trajectory, positions)

    @property
    def rate(self) -> float:
        """Control cycles a second, Hz."""
        return _RATE_HZ if self.config is None else self.config.rate_hz

    @contextlib.contextmanager
    def connected(self) -> Iterator[None]:
        """Checks and sets up the servos; leaves them as the exit policy says, and logs how after an error."""
        if self.arm is None:
            yield
            return
        try:
            with self.arm:
                self.stand()
                yield
        except BaseException:
            if self.arm.exit_report is not None:
                _log.warning(self.arm.exit_report.text)
            raise

    def stand(self) -> None:
        """From here on the arm counts as sent to where it is."""
        self.commanded = self.q.copy()

    def enable_torque(self) -> None:
        """Torque on, where the arm stands."""
        if self.arm is not None:
            self.arm.enable()
            self.stand()

    def repeat(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Sends the last command again and again, for ``seconds`` or ``until`` it says so."""
        if self.arm is None:
            return
        clock, period = self.clock, 1.0 / self.rate
        begin, tick = clock.now(), 1
        while tick * period <= seconds + 1e-9:
            clock.sleep_until(begin + tick * period)
            now = clock.now()
            for sink in self.sinks:
                sink.send(self.commanded, now)
            if until():
                return
            tick = max(tick + 1, int((now - begin) / period))
        clock.sleep_until(begin + seconds)

    def counters(self) -> dict[str, int]:
        """Totals of the bus; empty without one."""
        if self.arm is None:
            return {}
        found: dict[str, int] = asdict(self.arm.bus.counters)
        return found


@dataclass(frozen=True)
class _GuardedSink:
    """Sends the commands that the guard allows, and gives them to setup and recorder."""

    setup: RobotSetup
    guard: ArmGuard
    arm: Arm

    def send(self, q: Array, now: float) -> None:
        """Send joint angles (nq,) of the robot."""
        joints = self.setup.robot.joints
        sent = self.guard.send(self.arm, dict(zip(joints, q.tolist(), strict=True)))
        command = np.array([sent[joint] for joint in joints])
        for sink in (self.setup, *self.setup.recorder):
            sink.send(command, now)


def prepare_robot(request: ArmRequest) -> RobotSetup:
    """Robot and arm of a request; nothing is opened yet.

    Raises:
        ModelError, ConfigError: Robot or arm file is wrong, or they do not belong together.
    """
    robot, rehearsal = load_robot(request.robot), request.rehearsal
    frame = robot.frame(request.frame).name
    without_bus = request.bus == "none"
    virtual = not without_bus and bus_row(request.bus).virtual
    if not virtual and (rehearsal.zero_offset_deg or rehearsal.stuck):
        problem = "faults of servos are injected into simulated servos only"
        raise OptionError("--fault", problem, SIMULATED)
    clock: Clock = RealClock() if request.view else VirtualClock()
    if without_bus and request.arm_file is None:
        robot = _only_what_moves(robot, request.robot, frame)
        return RobotSetup(robot, frame, _joint_limits(robot, robot, None), None, clock)
    robot, config = _arm_of(robot, request.robot, frame, request.arm_file)
    if without_bus:
        chain = config.only(robot.joints)
        limited = robot.with_limits(chain.lower, chain.upper)
        return RobotSetup(
            limited,
            frame,
            _joint_limits(robot, limited, chain),
            None,
            clock,
            guard=guard_of(chain, request.robot),
            collisions=arm_collisions(chain, limited),
        )
    from robot_ik.hardware.virtual.faults import Fault, joint_offset

    opened = open_robot(robot, config, request.bus)
    if opened.virtual_bus is not None:
        offsets = rehearsal.zero_offset_deg.items()
        opened.virtual_bus.inject(
            *(joint_offset(config.joint(name), degrees) for name, degrees in offsets),
            *(Fault("stuck", config.joint(name).servo.id) for name in rehearsal.stuck),
        )
    limits = _joint_limits(robot, opened.robot, opened.chain)
    return RobotSetup(
        opened.robot,
        frame,
        limits,
        opened,
        opened.clock,
        guard=guard_of(opened.config, request.robot),
        collisions=opened.collisions,
    )


def _joint_limits(robot: Robot, limited: Robot, config: ArmConfig | None) -> list[JointLimits]:
    joints = () if config is None else config.joints
    servos = {joint.name: joint.limits for joint in joints}
    file = {j.name: (j.lower, j.upper) for j in joints if config is not None and config.file is not None}
    return [
        JointLimits(
            joint, "m" if kind == SLIDE else "rad", (float(robot.lower[k]), float(robot.upper[k])),
            servos.get(joint), file.get(joint), (float(limited.lower[k]), float(limited.upper[k])),
        )
        for joint, kind, k in zip(robot.joints, robot.tree.kind, robot.tree.vadr, strict=True)
    ]  # fmt: skip


def joints_that_move(robot: Robot, frame: str) -> tuple[str, ...]:
    """The active joints between the world and ``frame``: fingers beside it are none of them."""
    model, body, found = robot.model, robot.frame(frame).body, set()
    while body > 0:
        found |= {int(model.body_jntadr[body]) + k for k in range(int(model.body_jntnum[body]))}
        body = int(model.body_parentid[body])
    ids = robot.tree.joint_ids
    return tuple(joint for joint, id in zip(robot.joints, ids, strict=True) if int(id) in found)


def _only_what_moves(robot: Robot, name: str, frame: str) -> Robot:
    """The robot without the joints that do not move ``frame``: they stay at home and need no servo.

    Ball and free joints stay there too: moves are planned for hinges and slides.
    """
    planned = {
        joint for joint, kind in zip(robot.joints, robot.tree.kind, strict=True) if kind in (HINGE, SLIDE)
    }
    chain = tuple(joint for joint in joints_that_move(robot, frame) if joint in planned)
    if not chain and len(planned) < len(robot.joints):
        raise UnsupportedJointError(
            f"no hinge or slide moves {frame!r} of {robot.name}, and moves are planned for these alone",
            hint="robot-ik solve takes ball and free joints too",
        )
    held = [joint for joint in joints_that_move(robot, frame) if joint not in planned]
    if held:
        _log.warning("%s stays as at home: moves are planned for hinges and slides", ", ".join(held))
    return robot if not chain or chain == robot.joints else load_robot(name, joints=chain)


def _arm_of(robot: Robot, name: str, frame: str, file: Path | None) -> tuple[Robot, ArmConfig]:
    """The robot with only the joints of its arm that carry the tool, and the arm."""
    from robot_ik.hardware.config import ArmConfig

    path = file or robot.arm_file
    if path is None:
        robot = _only_what_moves(robot, name, frame)
        for k, joint in enumerate(robot.joints):
            if robot.tree.kind[k] != HINGE:
                raise UnsupportedJointError(
                    f"joint {joint!r} is no hinge, and a generic servo arm turns hinges only",
                    hint="give an arm file (--arm) for the joints with servos; reach needs none: --bus none",
                )
        return robot, ArmConfig.generic(
            robot.name, robot.joints, robot.lower, robot.upper,
            _HEADROOM * robot.velocity_limits, _HEADROOM * robot.acceleration_limits,
        )  # fmt: skip
    config = ArmConfig.load(path)
    return robot_of_arm(robot, config, name), config
