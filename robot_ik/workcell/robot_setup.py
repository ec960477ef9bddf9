"""Robot, servos and clock of a job."""

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
from robot_ik.kernels.tree import HINGE, SLIDE
from robot_ik.motion.recording import Recording, RecordingSink
from robot_ik.ports import Array, Clock, JointSink, RealClock, VirtualClock
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_arm import RobotArm, arm_collisions, open_robot, robot_of_arm
from robot_ik.schedule import Schedule
from robot_ik.workcell.arm_guard import guard_of

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.motion.trajectory import Trajectory
    from robot_ik.workcell.arm_guard import ArmGuard


_log = logging.getLogger(__name__)

_RATE_HZ = 100.0
"""Control cycles per second without servos, Hz."""

_HEADROOM = 1.3
"""Limits of a generic servo per limit of the plan.

A servo that fell behind on a busy machine must be faster than the plan to catch up.
"""

COUNT_ROUNDING = 1e-9
"""Rounding error of a number of control cycles."""


@dataclass(frozen=True)
class Rehearsal:
    """Faults to inject into simulated servos and the synthetic camera, to test their detection.

    Attributes:
        zero_offset_deg: Angle by which the shaft is ahead of the servo's registers, degrees, by
            joint name.
        stuck: Joints whose shaft does not move.
        cover_gripper: Whether the gripper's markers are hidden in the second picture.
        blank_marker: Whether the target's paper is left white.
        marker_at: Pose of the target as in ``Scene.with_marker_at``. None: the pose of the scene.
    """

    zero_offset_deg: Mapping[str, float] = field(default_factory=dict)
    stuck: tuple[str, ...] = ()
    cover_gripper: bool = False
    blank_marker: bool = False
    marker_at: tuple[float, ...] | None = None


@dataclass(frozen=True)
class ArmRequest:
    """Options that select a robot, its arm file and its bus.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        frame: Frame to move. None: the tool, or the frame that carries the scene's markers.
        bus: ``pty``, ``sim``, ``none`` or a serial port.
        arm_file: Arm file as in ``ArmConfig.load``. None: the file beside the model, else a generic
            arm; without a bus, no arm file.
        speed: Share of the joints' speed limits, from 0 to 1.
        seed: Seed of planning, restarts and simulated noise.
        view: Whether a window mirrors the motion.
        rehearsal: Faults to inject.
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
    """Position limits of one joint by their origin, each (lower, upper).

    Attributes:
        joint: Name of the joint.
        unit: Unit of all limits: ``rad``, or ``m`` for slides.
        model: Limits of the model.
        servo: Intersection of the limits of servo mode and arm file. None without servos.
        arm_file: Limits of the arm file. None without an arm file.
        used: Limits that apply.
    """

    joint: str
    unit: str
    model: tuple[float, float]
    servo: tuple[float, float] | None
    arm_file: tuple[float, float] | None
    used: tuple[float, float]


@dataclass(eq=False)
class RobotSetup:
    """A robot, and its servos if there is a bus.

    Attributes:
        robot: Robot with the intersection of the limits of model, servo mode and arm file.
        frame: Frame to move.
        limits: Limits of each joint by their origin.
        opened: Robot and arm. None without a bus.
        clock: Clock of the run. It is virtual if neither real servos nor a window need real time.
        guard: Collision check for motions. None if the arm file has no table ``[collisions]``.
        collisions: Collision condition for solutions. None without that table.
        dof: Number of joints that move the frame.
        recorder: Sinks that record commands and measurements. Empty if there is no recording.
        commanded: Last command (nq,).
        shown: Last measurement (nq,), for pictures and windows. Without a bus: the last command.
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
        """Whether the servos are real."""
        return self.opened is not None and self.opened.arm.bus.real

    def record(self, recording: Recording) -> None:
        """Record every further command with the last measurement of the servos."""
        measured = None if self.arm is None else self.arm.positions
        self.recorder = [RecordingSink(recording, self.robot.joints, measured)]

    @property
    def sinks(self) -> list[JointSink]:
        """Sinks for commands, in this order: the arm, the setup itself, the recorder."""
        if self.opened is None:
            return [self, *self.recorder]
        return [self.opened, self, *self.recorder]

    def begin_stream(self) -> list[JointSink]:
        """Return sinks for a stream of commands, which stop the arm before parts touch."""
        if self.guard is None or self.arm is None:
            return self.sinks
        self.guard.begin(self.arm.positions())
        return [_GuardedSink(self, self.guard, self.arm)]

    def send(self, q: Array, _now: float) -> None:
        """Store ``q`` (nq,) as the last command."""
        self.commanded = np.array(q, dtype=float)

    @property
    def q(self) -> Array:
        """Measured joint positions (nq,). Without a connected bus: the last command."""
        if self.opened is None:
            return self.commanded
        from robot_ik.hardware.arm import ArmState

        if self.opened.arm.state is ArmState.DISCONNECTED:
            return self.commanded
        self.shown = self.opened.read().q.copy()
        return self.shown

    def true_q(self) -> Array:
        """Return the joint positions (nq,) that a camera would see.

        With simulated servos these are the positions of the shafts, including faults.
        """
        true_q = None if self.opened is None else self.opened.true_q()
        return self.shown if true_q is None else true_q

    @property
    def resolution(self) -> Array:
        """Angle per servo tick (nv,), rad. Zeros without servos."""
        if self.config is None:
            return np.zeros(self.robot.nv)
        return np.asarray(self.config.resolution)

    def caps(self, speed: float) -> dict[str, Any]:
        """Return the keyword arguments of ``joint_move`` and ``line_move`` that limit the speed.

        Args:
            speed: Share of the speed limits of the arm file, from 0 to 1.
        """
        shared = {"rate": self.rate, "speed": speed}
        if self.config is None:
            return shared
        return {
            "velocity_limits": self.config.velocity,
            "acceleration_limits": self.config.acceleration,
            **shared,
        }

    def checked(self, trajectory: Trajectory) -> Trajectory:
        """Check a trajectory for collisions.

        Without the table ``[collisions]`` of an arm file every trajectory is allowed.

        Returns:
            A trajectory that the arm may execute.

        Raises:
            MotionBlockedError: Parts would come closer than the margin.
        """
        if self.guard is None:
            return trajectory
        positions = dict(zip(self.robot.joints, self.commanded.tolist(), strict=True))
        if self.arm is not None:
            positions = self.arm.positions()
        return self.guard.checked(trajectory, positions)

    @property
    def rate(self) -> float:
        """Control cycles per second, Hz."""
        return _RATE_HZ if self.config is None else self.config.rate_hz

    @contextlib.contextmanager
    def connected(self) -> Iterator[None]:
        """Check and configure the servos, and apply the exit policy after the block.

        After an error the result of the exit policy is logged.
        """
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
        """Set the last command to the measured position."""
        self.commanded = self.q.copy()

    def enable_torque(self) -> None:
        """Enable the torque, and set the last command to the measured position."""
        if self.arm is not None:
            self.arm.enable()
            self.stand()

    def repeat(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Send the last command in every control cycle. Return at once without servos.

        Args:
            seconds: Duration, seconds.
            until: Condition that ends the repetition earlier. It is checked after each cycle.
        """
        if self.arm is None:
            return
        end = self.clock.now() + seconds
        count = int(seconds * self.rate + COUNT_ROUNDING)
        # The last command has just been sent, so the first repetition is one period later.
        due = ((k / self.rate, k) for k in range(1, count + 1))
        for now, _ in Schedule(self.clock).ticks(due):
            for sink in self.sinks:
                sink.send(self.commanded, now)
            if until():
                return
            if now >= end:  # a busy machine was late
                break
        self.clock.sleep_until(end)

    def counters(self) -> dict[str, int]:
        """Return the counters of the bus by name. Empty without a bus."""
        if self.arm is None:
            return {}
        counters: dict[str, int] = asdict(self.arm.bus.counters)
        return counters


@dataclass(frozen=True)
class _GuardedSink:
    """A sink that sends the commands that the guard allows, also to setup and recorder."""

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
    """Return robot and arm of a request. The bus is not opened.

    Raises:
        ModelError: The robot cannot be loaded.
        ConfigError: The arm file is not valid, or it does not fit the robot.
        OptionError: Faults are requested for servos that are not simulated.
        UnsupportedJointError: No joint that moves the frame can be planned or driven.
    """
    robot = load_robot(request.robot)
    rehearsal = request.rehearsal
    frame = robot.frame(request.frame).name
    without_bus = request.bus == "none"
    is_simulated = not without_bus and bus_row(request.bus).virtual
    if not is_simulated and (rehearsal.zero_offset_deg or rehearsal.stuck):
        problem = "faults of servos are injected into simulated servos only"
        raise OptionError("--fault", problem, SIMULATED)
    clock: Clock = RealClock() if request.view else VirtualClock()
    if without_bus and request.arm_file is None:
        robot = _reduced_to_moving_joints(robot, request.robot, frame)
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
    """Return the limits of each joint by their origin.

    Args:
        robot: Robot with the limits of the model.
        limited: Robot with the limits that apply.
        config: Servos of the joints. None without servos.
    """
    servo_limits: dict[str, tuple[float, float]] = {}
    file_limits: dict[str, tuple[float, float]] = {}
    if config is not None:
        servo_limits = {joint.name: joint.limits for joint in config.joints}
        if config.file is not None:
            file_limits = {joint.name: (joint.lower, joint.upper) for joint in config.joints}
    return [
        JointLimits(
            joint=joint,
            unit="m" if kind == SLIDE else "rad",
            model=(float(robot.lower[k]), float(robot.upper[k])),
            servo=servo_limits.get(joint),
            arm_file=file_limits.get(joint),
            used=(float(limited.lower[k]), float(limited.upper[k])),
        )
        for joint, kind, k in zip(robot.joints, robot.tree.kind, robot.tree.vadr, strict=True)
    ]


def joints_that_move(robot: Robot, frame: str) -> tuple[str, ...]:
    """Return the active joints between the world and a frame, in the order of the robot.

    Joints beside that chain are left out, for example the fingers of a gripper for the tool.
    """
    model = robot.model
    body = robot.frame(frame).body
    moving_ids: set[int] = set()
    while body > 0:
        first_joint = int(model.body_jntadr[body])
        moving_ids |= {first_joint + k for k in range(int(model.body_jntnum[body]))}
        body = int(model.body_parentid[body])
    ids = robot.tree.joint_ids
    return tuple(
        joint for joint, id in zip(robot.joints, ids, strict=True) if int(id) in moving_ids
    )


def _reduced_to_moving_joints(robot: Robot, name: str, frame: str) -> Robot:
    """Return the robot with only the hinges and slides that move a frame.

    The other joints stay at home and need no servo. Ball and free joints stay at home too, because
    moves are planned only for hinges and slides.

    Args:
        robot: The robot.
        name: Name with which the robot is loaded again.
        frame: The frame.

    Raises:
        UnsupportedJointError: Only ball and free joints move the frame.
    """
    kinds = zip(robot.joints, robot.tree.kind, strict=True)
    plannable = {joint for joint, kind in kinds if kind in (HINGE, SLIDE)}
    moving = joints_that_move(robot, frame)
    chain = tuple(joint for joint in moving if joint in plannable)
    if not chain and len(plannable) < len(robot.joints):
        raise UnsupportedJointError(
            f"no hinge or slide moves {frame!r} of {robot.name}, and moves are planned for these "
            "alone",
            hint="robot-ik solve takes ball and free joints too",
        )
    held = [joint for joint in moving if joint not in plannable]
    if held:
        _log.warning(
            "%s stays as at home: moves are planned for hinges and slides", ", ".join(held)
        )
    if not chain or chain == robot.joints:
        return robot
    return load_robot(name, joints=chain)


def _arm_of(robot: Robot, name: str, frame: str, file: Path | None) -> tuple[Robot, ArmConfig]:
    """Return the arm, and the robot with only the joints of the arm that move the frame.

    Args:
        robot: The robot.
        name: Name with which the robot is loaded again.
        frame: Frame to move.
        file: Arm file. None: the robot's own, else a generic arm.

    Raises:
        ConfigError: The arm file is not valid, or it does not fit the robot.
        UnsupportedJointError: A generic arm would have to drive a joint that is no hinge.
    """
    from robot_ik.hardware.config import ArmConfig

    path = file or robot.arm_file
    if path is None:
        robot = _reduced_to_moving_joints(robot, name, frame)
        for k, joint in enumerate(robot.joints):
            if robot.tree.kind[k] != HINGE:
                raise UnsupportedJointError(
                    f"joint {joint!r} is no hinge, and a generic servo arm turns hinges only",
                    hint="give an arm file (--arm) for the joints with servos; "
                    "reach needs none: --bus none",
                )
        generic = ArmConfig.generic(
            robot.name,
            robot.joints,
            robot.lower,
            robot.upper,
            _HEADROOM * robot.velocity_limits,
            _HEADROOM * robot.acceleration_limits,
        )
        return robot, generic
    config = ArmConfig.load(path)
    return robot_of_arm(robot, config, name), config
