"""The arm file: which servo turns which joint, within which limits, on what bus."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import ConfigError, UnknownJointError
from robot_ik.files import read_text, write_atomically
from robot_ik.hardware.config_check import check_arm
from robot_ik.hardware.config_file import (
    STALE_MS,
    WATCHDOG_MS,
    ArmFile,
    BusFile,
    JointFile,
    SlideFile,
    arm_file_text,
    parse_arm_file,
)
from robot_ik.hardware.control_table import TICKS_PER_TURN, OperatingMode
from robot_ik.hardware.joint_map import ARM, MODES, JointMap, Twin

__all__ = ["MAX_SERVOS", "MODES", "ArmConfig", "JointMap", "Twin"]

Array = NDArray[np.float64]

MAX_SERVOS = 252


@dataclass(frozen=True)
class ArmConfig:
    """An arm of servos on one bus.

    Attributes:
        name: For people; ``robot``: catalogue name or path of the model it is an arm of.
        baud: Bits/s; ``rate_hz``: control cycles per second.
        watchdog_ms: Bus Watchdog of every servo, ms, a multiple of 20; 0 = off.
        on_exit: ``torque_off``, ``hold`` or ``park``.
        joints: In the order of q.
        aside: Joints of other groups, such as a gripper's: no part of q.  An arm holds them where they are,
            and moves them by name.
        file: Where it was read from; ``None`` when made by a program.
        stale_ms: Time without a command after which the arm is held and watched by itself, ms; 0: never.
            The Bus Watchdog must be longer by what ``watchdogs.least_watchdog_ms`` says.
        on_stale: What follows when no command comes for longer: ``hold``, ``park`` or ``torque_off``.
    """

    name: str
    robot: str
    baud: int
    rate_hz: float
    watchdog_ms: int
    on_exit: str
    joints: tuple[JointMap, ...]
    file: Path | None = field(default=None, compare=False)
    stale_ms: int = STALE_MS
    on_stale: str = "hold"
    aside: tuple[JointMap, ...] = ()

    def __post_init__(self) -> None:
        check_arm(self, self.file or self.name)

    @classmethod
    def load(cls, path: Path | str) -> ArmConfig:
        """Reads an arm file.

        Raises:
            ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
        """
        path = Path(path)
        return cls.parse(read_text(path, "the arm file"), path)

    @classmethod
    def parse(cls, text: str, file: Path | str = "<text>") -> ArmConfig:
        """The same from the text of an arm file; ``file`` appears in errors."""
        return _from_file(parse_arm_file(text, file), Path(file))

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
        """An arm for any robot of hinges: XM430-W350 servos, ids 1..n, direct drive, many turns.

        Args:
            robot_name: Name or path of the robot.
            joints: Joint names in the order of q.
            lower: (n,) rad; infinite where the joint has no limit.
            upper: (n,) rad.
            velocity: (n,) or one number, rad/s.
            acceleration: (n,) or one number, rad/s^2.

        Raises:
            ConfigError: More than 252 joints, or limits that make no sense.
        """
        n = len(joints)
        if not 1 <= n <= MAX_SERVOS:
            raise ConfigError(f"{n} joints on one bus", file=robot_name, key="joints", allowed="1..252")
        given = (lower, upper, velocity, acceleration)
        columns = [np.broadcast_to(np.asarray(c, dtype=float), n) for c in given]
        maps = []
        for k, name in enumerate(joints):
            low, high, speed, ramp = (float(column[k]) for column in columns)
            mode, middle = OperatingMode.EXTENDED_POSITION, TICKS_PER_TURN // 2
            maps.append(JointMap(name, k + 1, "XM430-W350", mode, 1, middle, 1.0, low, high, speed, ramp))
        title = f"{robot_name} with {n} virtual servos"
        return cls(title, robot_name, 1_000_000, 100.0, WATCHDOG_MS, "torque_off", tuple(maps))

    def save(self, path: Path | str) -> None:
        """Writes the arm file whole or not at all (beside it first, then renamed over it)."""
        write_atomically(Path(path), self.to_toml())

    def to_toml(self) -> str:
        """Text of the arm file; ``parse`` reads the same arm back (angles to 1e-12 degrees)."""
        return arm_file_text(self)

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names in the order of q."""
        return tuple(joint.name for joint in self.joints)

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the joints' (first) servos in the order of q."""
        return tuple(joint.id for joint in self.joints)

    @cached_property
    def whole(self) -> ArmConfig:
        """The same arm with all joints in its q: first ``joints``, then ``aside``."""
        return replace(self, joints=self.joints + self.aside, aside=()) if self.aside else self

    @cached_property
    def servos(self) -> tuple[JointMap, ...]:
        """Every servo as a map of its joint: of ``joints`` in the order of q, ``aside``, the second ones."""
        joints = self.joints + self.aside
        return joints + tuple(other for joint in joints for other in joint.servos[1:])

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
        """Ids of ``servos``."""
        return tuple(servo.id for servo in self.servos)

    def spread(self, q: ArrayLike) -> Array:
        """(number of servos,) from (joints and joints aside,): the value of each servo's joint."""
        where = {name: k for k, name in enumerate(self.whole.names)}
        return np.asarray(q, dtype=float)[[where[servo.name] for servo in self.servos]]

    @property
    def lower(self) -> Array:
        """(n,) rad: software range and what the mode can reach."""
        return np.array([joint.limits[0] for joint in self.joints])

    @property
    def upper(self) -> Array:
        """(n,) rad: software range and what the mode can reach."""
        return np.array([joint.limits[1] for joint in self.joints])

    @property
    def velocity(self) -> Array:
        """(n,) caps, rad/s."""
        return np.array([joint.velocity for joint in self.joints])

    @property
    def acceleration(self) -> Array:
        """(n,) caps, rad/s^2."""
        return np.array([joint.acceleration for joint in self.joints])

    @property
    def resolution(self) -> Array:
        """(n,) rad per tick."""
        return np.array([joint.resolution for joint in self.joints])

    def joint(self, name: str) -> JointMap:
        """A joint by name, also one that is no part of q.

        Raises:
            UnknownJointError: No such joint; close ones are named.
        """
        for joint in (*self.joints, *self.aside):
            if joint.name == name:
                return joint
        raise UnknownJointError(name, self.whole.names)

    def aside_of(self, name: str) -> tuple[JointMap, ...]:
        """The joints of a group that are no part of q."""
        return tuple(joint for joint in self.aside if joint.group == name)

    def group(self, name: str) -> tuple[JointMap, ...]:
        """The joints of a group; none where there is no such group."""
        return tuple(joint for joint in (*self.joints, *self.aside) if joint.group == name)


def _from_file(arm: ArmFile, file: Path) -> ArmConfig:
    maps = [_joint_map(table) for table in arm.joints]
    joints = tuple(joint for joint in maps if joint.group == ARM)
    if maps[: len(joints)] != list(joints) or not joints:
        raise ConfigError(
            f"joints of the group {ARM!r} come first, and there is at least one",
            file=file,
            key=f"joints[{next((k for k, joint in enumerate(maps) if joint.group != ARM), 0)}].group",
            allowed=f"{ARM} (the default)",
        )
    bus = arm.bus
    return ArmConfig(
        arm.name,
        arm.robot,
        bus.baud,
        float(bus.rate_hz),
        bus.watchdog_ms,
        bus.on_exit,
        joints,
        file,
        _stale_ms(bus),
        bus.on_stale,
        tuple(maps[len(joints) :]),
    )


def _stale_ms(bus: BusFile) -> int:
    """What the file says, else half of ``watchdog_ms``."""
    if bus.stale_ms is not None:
        return bus.stale_ms
    return bus.watchdog_ms // 2 or STALE_MS


def _joint_map(j: JointFile) -> JointMap:
    slide = isinstance(j, SlideFile)
    unit, one = ("mm", 1e-3) if slide else ("deg", math.radians(1.0))
    lower, upper, velocity, acceleration = (
        one * getattr(j, f"{key}_{unit}") for key in ("lower", "upper", "velocity", "acceleration")
    )
    return JointMap(
        name=j.name,
        id=j.id,
        model=j.model,
        mode=MODES[j.mode],
        direction=j.direction,
        zero_ticks=j.zero_ticks,
        ratio=float(j.ratio),
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        current=j.current_ma,
        twin=None if j.twin is None else Twin(**j.twin.model_dump()),
        pinion=1e-3 * j.pinion_mm if isinstance(j, SlideFile) else None,
        group=j.group,
    )
