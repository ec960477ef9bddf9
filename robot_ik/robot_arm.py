"""``open_robot``: a robot with servos, from a model, an arm file and a bus that fit together."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import CollisionError, ConfigError, ModelError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.hardware import bus_row, open_arm, virtual_servos
from robot_ik.hardware.arm_part import ArmPart
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import Array, Clock, Closing, JointReading
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_file import catalogue, find_robot

if TYPE_CHECKING:
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.virtual.bus import VirtualBus

GROUND = "ground"
"""Name of the floor that ``[collisions] ground`` of an arm file adds to the scene."""


@dataclass(frozen=True)
class RobotArm(Closing):
    """A robot model and the arm of servos that moves it: a ``JointSink`` and a ``JointSource``.

    Vectors are those of the robot. The arm may have more joints, such as a gripper, which keep
    their last command. Used in a ``with`` block: entering connects the arm, leaving applies the
    exit policy.

    Attributes:
        robot: Model with the joints that carry the tool, limited to what the servos reach.
        arm: Servos; disconnected until the ``with`` block.
    """

    robot: Robot
    arm: Arm

    @property
    def config(self) -> ArmConfig:
        """Arm file, with every joint."""
        return self.arm.config

    @cached_property
    def part(self) -> ArmPart:
        """The joints of the robot, in the robot's order."""
        return ArmPart(self.arm, self.robot.joints)

    @property
    def chain(self) -> ArmConfig:
        """Arm file with the joints of the robot only, in the robot's order."""
        return self.part.config

    @cached_property
    def collisions(self) -> CollisionAvoidance | None:
        """Condition on collisions of the arm file, for the robot; None if it has none.

        Joints that the robot does not have, such as those of a gripper, are at home.

        Raises:
            ConfigError: As ``arm_collisions``.
        """
        return arm_collisions(self.config, self.robot)

    @property
    def clock(self) -> Clock:
        """Clock on which the arm runs; virtual on the bus ``sim``."""
        return self.arm.clock

    @property
    def virtual_bus(self) -> VirtualBus | None:
        """Simulated servos behind the bus; None if the servos are real."""
        return virtual_servos(self.arm.bus)

    def enable(self) -> None:
        """Switch torque on at the present pose; see ``Arm.enable``."""
        self.arm.enable()

    def send(self, q: ArrayLike, now: float) -> Array:
        """Send joint values to the servos; see ``Arm.send``.

        Args:
            q: (n,) joint values of the robot, rad or m.
            now: Time for which ``q`` is meant, s.

        Returns:
            (n,) the joint values that were sent: ``q`` within limits and caps.
        """
        return self.part.send(q, now)

    def read(self) -> JointReading:
        """Return the measured joint values of the robot, (n,) rad or m; see ``Arm.read``."""
        return self.part.read()

    def true_q(self) -> Array | None:
        """Return the true values of simulated joints, (n,) rad or m; None if servos are real."""
        servos = self.virtual_bus
        return None if servos is None else servos.true_angles(self.chain)

    def __enter__(self) -> Self:
        self.arm.__enter__()
        return self

    def close(self) -> None:
        """Apply the exit policy of the arm, and close the bus."""
        self.arm.close()


def open_robot(
    name: str | os.PathLike[str] | Robot,
    arm: Path | str | ArmConfig | None = None,
    bus: str = "sim",
    *,
    on_exit: str | None = None,
    start: ArrayLike | Mapping[str, float] | None = None,
    virtual_bus: VirtualBus | None = None,
    clock: Clock | None = None,
) -> RobotArm:
    """Return a robot and its arm on a bus. Nothing is connected and no torque changes.

    If there is a calibration beside the arm file, the model must be the one that was calibrated.
    This check cannot be skipped.

    Args:
        name: Robot of the catalogue, path of a model, or a loaded robot.
        arm: Arm file or its content. None: the arm file beside the model.
        bus: ``"sim"``, ``"pty"`` or a serial port such as ``"/dev/ttyUSB0"``.
        on_exit: ``"torque_off"``, ``"hold"`` or ``"park"``. None: as in the arm file.
        start: (n,) initial values of the robot's joints, or joint name -> value, for simulated
            servos. None: home of the robot.
        virtual_bus: Simulated servos to use instead of new ones.
        clock: Clock of new simulated servos. None: virtual time on ``"sim"``, real time on
            ``"pty"``.

    Raises:
        ConfigError: There is no arm file, or it does not fit the model.
        CalibrationMismatchError: The calibration belongs to another model.
        ModelError: The model cannot be read.
    """
    robot = name if isinstance(name, Robot) else load_robot(name)
    config = arm if isinstance(arm, ArmConfig) else ArmConfig.load(arm or _arm_file_beside(robot))
    source = robot.path if isinstance(name, Robot) else name
    robot = robot_of_arm(robot, config, source)
    if start is None and virtual_bus is None and bus_row(bus).virtual:
        start = robot.home
    if start is not None and not isinstance(start, Mapping):
        start = dict(zip(robot.joints, np.asarray(start, dtype=float).tolist(), strict=True))
    opened = open_arm(
        config,
        bus,
        on_exit=on_exit,
        virtual_bus=virtual_bus,
        start=start,
        robot=robot,
        clock=clock,
    )
    chain = config.only(robot.joints)
    return RobotArm(robot.with_limits(chain.lower, chain.upper), opened)


def arm_collisions(config: ArmConfig, robot: Robot) -> CollisionAvoidance | None:
    """Return the collision condition of the table ``[collisions]``; None without the table.

    Args:
        config: Arm.
        robot: Its model, with any of its joints.

    Raises:
        ConfigError: The scene cannot be read or built, a name is unknown, or some parts are always
            nearer than the margin.
    """
    table = config.collisions
    if table is None:
        return None
    # Imported here, because they load the compiled collision checks, 0.05 s that few arms need.
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.collision.obstacle_file import load_obstacles
    from robot_ik.collision.obstacles import Obstacle, Plane
    from robot_ik.collision.scene import Scene

    obstacles: list[Obstacle] = []
    key = "collisions.scene"
    try:
        if table.scene:
            obstacles += load_obstacles(table.scene)
        if table.ground is not None:
            key = "collisions.ground"
            obstacles.append(Plane(GROUND, pose=Pose((0.0, 0.0, table.ground))))
        key = "collisions.scene"
        scene = Scene(robot, obstacles)
        key = "collisions.ignore"
        collisions = CollisionAvoidance(scene, table.margin, ignore=table.ignore)
    except (CollisionError, ModelError) as error:
        raise config.wrong(str(error.args[0]), key, hint=error.hint) from error
    if always_near := collisions.always_near:
        names = ", ".join(f'["{a}", "{b}"]' for a, b in (item.pair for item in always_near))
        raise config.wrong(
            "these parts are nearer than the margin in every posture, so no motion is free",
            "collisions.ignore",
            hint=f"use a smaller margin, or set ignore = [{names}]",
        )
    return collisions


def robot_of_arm(robot: Robot, config: ArmConfig, source: str | os.PathLike[str]) -> Robot:
    """Return the robot with exactly the joints of an arm that carry the tool, in its own order.

    Args:
        robot: Robot with any of its joints.
        config: Arm.
        source: Name or path from which the robot was loaded.

    Raises:
        ConfigError: The model does not have these joints.
    """
    names = config.chain.names
    if set(names) != set(robot.joints):
        with contextlib.suppress(UnknownJointError):
            robot = load_robot(source, joints=names)
    _require_joints(robot, names, config)
    return robot


def _arm_file_beside(robot: Robot) -> Path:
    if robot.arm_file is not None:
        return robot.arm_file
    robots = [name for name, folder in catalogue().items() if (folder / "arm.toml").is_file()]
    raise ConfigError(
        "comes without an arm file",
        file=robot.name,
        allowed=f"--arm FILE, or a robot that has one: {', '.join(robots)}",
    )


def _require_joints(robot: Robot, names: Sequence[str], config: ArmConfig) -> None:
    unknown = [name for name in names if name not in robot.joints]
    if unknown:
        raise ConfigError(
            f"{robot.name} has no joint {', '.join(map(repr, unknown))}",
            file=config.file or config.name,
            key="joints",
            allowed=", ".join(robot.joints),
        )


def robot_named_in(config: ArmConfig) -> str:
    """Return the name or path of the robot that an arm file names.

    Raises:
        ConfigError: The arm file names no robot, or the robot does not exist.
    """
    try:
        find_robot(config.robot_source)
    except ModelError as error:
        raise ConfigError(
            str(error.args[0]), file=config.file or config.name, key="robot", hint=error.hint
        ) from error
    return config.robot_source
