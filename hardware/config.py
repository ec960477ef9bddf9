"""An arm of servos: its joints, its bus and how it is left.  Usually read from an arm file."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import tomlkit
from numpy.typing import ArrayLike

from robot_ik.config import KeyProblem, read_text
from robot_ik.errors import ConfigError, UnknownJointError
from robot_ik.files import write_atomically
from robot_ik.hardware.arm_checks import check_arm
from robot_ik.hardware.arm_file import (
    MAX_SERVOS,
    STALE_MS,
    WATCHDOG_MS,
    ArmFile,
    BusTable,
    CollisionTable,
    find_arm_file,
    joint_keys,
    parse_arm_file,
)
from robot_ik.hardware.family import ServoFamily, family_of
from robot_ik.hardware.servo import ARM, Direct, Drive, Joint, Servo
from robot_ik.ports import Array
from robot_ik.robot_file import catalogue

GENERIC_MODEL = "XM430-W350"
"""Servo model of ``ArmConfig.generic``."""


@dataclass(frozen=True)
class ArmConfig:
    """An arm of servos on one bus.

    Every vector of the arm has one value per joint, in the order of ``joints``, grippers included.

    Attributes:
        name: Name for messages.
        robot: Catalogue name or path of the robot's model. A relative path counts from the folder
            of the arm file, or from the working folder if it does not exist there.
        baud: bit/s.
        rate_hz: Control cycles per second.
        watchdog_ms: Bus Watchdog of every servo, ms, a multiple of 20; 0: off.
        on_exit: ``torque_off``, ``hold`` or ``park``.
        joints: Joints of every group.
        file: Arm file; None if a program made the arm.
        stale_ms: ms without a command after which the arm is held and watched; 0: never.  The Bus
            Watchdog must be longer, see ``watchdogs.min_watchdog_ms``.
        on_stale: What follows without a command for longer: ``hold``, ``park`` or ``torque_off``.
        uncalibrated: The zeros are placeholders, so real servos get no torque.
        on_orphan: What happens if the program is killed: ``hold`` (nothing, the servos keep their
            torque) or ``torque_off`` (a second process switches torque off).
        collisions: What the commands that move the arm must not touch. None: collisions are not
            checked.
    """

    name: str
    robot: str
    baud: int
    rate_hz: float
    watchdog_ms: int
    on_exit: str
    joints: tuple[Joint, ...]
    file: Path | None = field(default=None, compare=False)
    stale_ms: int = STALE_MS
    on_stale: str = "hold"
    uncalibrated: bool = False
    on_orphan: str = "hold"
    collisions: CollisionTable | None = None

    def __post_init__(self) -> None:
        check_arm(self)

    @classmethod
    def load(cls, path: Path | str | None) -> ArmConfig:
        """Read an arm file, given by its path or by the name of a robot that has one.

        Raises:
            ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of
                range; or the robot has none, so its ``arm_file`` is None.
            UnknownRobotError: Neither a robot of the catalogue nor a file.
        """
        if path is None:
            hint = (
                "a robot without arm.toml beside its model has arm_file None; "
                "ArmConfig.generic needs no file"
            )
            raise ConfigError(
                "there is no arm file to read", file="ArmConfig.load(None)", hint=hint
            )
        path = find_arm_file(str(path))
        return cls.parse(read_text(path, "the arm file"), path)

    @classmethod
    def parse(cls, text: str, file: Path | str = "<text>") -> ArmConfig:
        """Return the arm of the text of an arm file.

        Args:
            text: TOML.
            file: Name for errors.

        Raises:
            ConfigError: As ``load``.
        """
        content = parse_arm_file(text, file)
        return cls._from_file(content, Path(file))

    @classmethod
    def _from_file(cls, content: ArmFile, file: Path) -> ArmConfig:
        bus = dict(content.bus)
        if bus["stale_ms"] is None:
            bus["stale_ms"] = content.bus.watchdog_ms // 2 or STALE_MS
        collisions = content.collisions
        if collisions is not None and collisions.scene:
            # The path in the file is relative to the file.
            scene = file.parent / Path(collisions.scene).expanduser()
            collisions = collisions.model_copy(update={"scene": str(scene)})
        return cls(
            name=content.name,
            robot=content.robot,
            joints=tuple(table.joint() for table in content.joints),
            file=file,
            uncalibrated=content.uncalibrated,
            collisions=collisions,
            **bus,
        )

    @classmethod
    def generic(
        cls,
        robot_name: str,
        joints: Sequence[str],
        lower: ArrayLike,
        upper: ArrayLike,
        velocity: ArrayLike = math.pi / 2,
        acceleration: ArrayLike = 2.0 * math.pi,
    ) -> ArmConfig:
        """Return an arm for any robot of hinges: XM430-W350 servos, ids 1..n, direct drive.

        Args:
            robot_name: Robot.
            joints: n joint names.
            lower: (n,) rad, infinite for a joint without a limit.
            upper: The same.
            velocity: (n,) or one, rad/s.
            acceleration: (n,) or one, rad/s^2.

        Raises:
            ConfigError: More than 252 joints, or limits that make no sense.
        """
        n = len(joints)
        if not 1 <= n <= MAX_SERVOS:
            raise ConfigError(
                f"{n} joints on one bus",
                file=robot_name,
                key="joints",
                allowed=f"1..{MAX_SERVOS}",
            )
        given = (lower, upper, velocity, acceleration)
        columns = [np.broadcast_to(np.asarray(column, dtype=float), n) for column in given]
        generic_joints = tuple(
            Joint(
                name,
                Direct(),
                (Servo(k + 1, GENERIC_MODEL),),
                lower=float(columns[0][k]),
                upper=float(columns[1][k]),
                velocity=float(columns[2][k]),
                acceleration=float(columns[3][k]),
            )
            for k, name in enumerate(joints)
        )
        title = f"{robot_name} with {n} virtual servos"
        return cls(title, robot_name, 1_000_000, 100.0, WATCHDOG_MS, "torque_off", generic_joints)

    def save(self, path: Path | str) -> None:
        """Write the arm file completely or not at all."""
        config = self
        if self.collisions is not None and self.collisions.scene:
            scene = os.path.relpath(self.collisions.scene, Path(path).parent)
            collisions = self.collisions.model_copy(update={"scene": scene})
            config = replace(self, collisions=collisions)
        write_atomically(Path(path), config.to_toml())

    def to_toml(self) -> str:
        """Return the text of the arm file.

        ``parse`` reads the same arm back, angles to 1e-12 degrees.
        """
        content: dict[str, object] = {"schema": 1, "name": self.name, "robot": self.robot}
        if self.uncalibrated:
            content["uncalibrated"] = True
        content["bus"] = {key: getattr(self, key) for key in BusTable.model_fields}
        if self.collisions is not None:
            content["collisions"] = self.collisions.model_dump(exclude_none=True)
        content["joints"] = [joint_keys(joint) for joint in self.joints]
        return tomlkit.dumps(content)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Joint names in the order of every vector of the arm."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        """Every servo with its joint. The servos that measure ``joints`` are first."""
        first = tuple(Drive(joint, joint.servo) for joint in self.joints)
        others = tuple(Drive(joint, servo) for joint in self.joints for servo in joint.servos[1:])
        return first + others

    @cached_property
    def servos(self) -> tuple[Servo, ...]:
        """Every servo, in the order of ``drives``."""
        return tuple(drive.servo for drive in self.drives)

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
        """Id of every servo, in the order of ``drives``."""
        return tuple(servo.id for servo in self.servos)

    @property
    def family(self) -> ServoFamily:
        """The family of every servo of the arm."""
        return family_of(self.joints[0].servo.table.family)

    @cached_property
    def lower(self) -> Array:
        """Smallest joint values (n,) of arm file and operating mode together, rad or m."""
        return _read_only([joint.limits[0] for joint in self.joints])

    @cached_property
    def upper(self) -> Array:
        """Largest joint values (n,) of arm file and operating mode together, rad or m."""
        return _read_only([joint.limits[1] for joint in self.joints])

    @cached_property
    def velocity(self) -> Array:
        """(n,) speed limits, rad/s or m/s."""
        return _read_only([joint.velocity for joint in self.joints])

    @cached_property
    def acceleration(self) -> Array:
        """(n,) acceleration limits, rad/s^2 or m/s^2."""
        return _read_only([joint.acceleration for joint in self.joints])

    @cached_property
    def resolution(self) -> Array:
        """(n,) rad or m per tick."""
        return _read_only([joint.resolution for joint in self.joints])

    def wrong(self, problem: str, key: str, allowed: str = "", hint: str = "") -> ConfigError:
        """Return the error of a key of this arm's file."""
        return KeyProblem(problem, key, allowed, hint).in_file(self.file or self.name)

    def wrong_joint(
        self, joint: Joint, problem: str, key: str = "", allowed: str = "", hint: str = ""
    ) -> ConfigError:
        """Return the error of a key of a joint."""
        where = f"joints[{self.names.index(joint.name)}]"
        return self.wrong(problem, f"{where}.{key}" if key else where, allowed, hint)

    def joint(self, name: str) -> Joint:
        """Return a joint by name.

        Raises:
            UnknownJointError: No such joint; close ones are named.
        """
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise UnknownJointError(name, self.names)

    def only(self, names: Sequence[str]) -> ArmConfig:
        """Return the arm with these joints only, in the order of ``names``.

        Without names the arm is returned as it is.

        Raises:
            UnknownJointError: No such joint; close ones are named.
        """
        if not names or tuple(names) == self.names:
            return self
        return replace(self, joints=tuple(self.joint(name) for name in dict.fromkeys(names)))

    def slowed(self, share: float) -> ArmConfig:
        """Return the arm with a share of its speed and acceleration limits.

        Args:
            share: Above 0 and up to 1.
        """
        joints = tuple(
            replace(joint, velocity=share * joint.velocity, acceleration=share * joint.acceleration)
            for joint in self.joints
        )
        return replace(self, joints=joints)

    def group(self, name: str) -> tuple[Joint, ...]:
        """Return the joints of a group; empty if there is no such group."""
        return tuple(joint for joint in self.joints if joint.group == name)

    @property
    def robot_source(self) -> str:
        """Name or path from which ``load_robot`` loads the robot.

        It is the path beside the arm file if there is one, else ``robot`` as it is written.
        """
        if self.file is None or self.robot in catalogue():
            return self.robot
        beside = self.file.parent / self.robot
        return str(beside) if beside.exists() else self.robot

    @property
    def chain(self) -> ArmConfig:
        """The arm with the joints that carry the tool only, without grippers."""
        return self.only([joint.name for joint in self.group(ARM)])


def _read_only(values: list[float]) -> Array:
    array = np.array(values)
    array.flags.writeable = False
    return array
