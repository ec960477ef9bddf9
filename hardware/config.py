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
from robot_ik.files import write_atomically
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
from robot_ik.hardware.control_table import TICKS_PER_REVOLUTION, ControlTable, OperatingMode, control_table
from robot_ik.hardware.joint_map import ARM, MODES, JointMap, SwingArm
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS, least_watchdog_ms
from robot_ik.reading import read_text

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
        auxiliary: Joints of other groups, as a gripper's: no part of q.  An arm holds them where they are,
            and moves them by name.
        file: Where it was read from; ``None`` when made by a program.
        stale_ms: Time without a command after which the arm is held and watched by itself, ms; 0: never.
            The Bus Watchdog must be longer by what ``watchdogs.least_watchdog_ms`` says.
        on_stale: What follows when no command comes for longer: ``hold``, ``park`` or ``torque_off``.
        uncalibrated: Its zeros are placeholders, so that real servos get no torque.
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
    auxiliary: tuple[JointMap, ...] = ()
    uncalibrated: bool = False

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
        """An arm for any robot of hinges: XM430-W350 servos, ids 1..n, direct drive, many revolutions.

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
            mode, middle = OperatingMode.EXTENDED_POSITION, TICKS_PER_REVOLUTION // 2
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
        """The same arm with all joints in its q: first ``joints``, then ``auxiliary``."""
        return replace(self, joints=self.joints + self.auxiliary, auxiliary=()) if self.auxiliary else self

    @cached_property
    def servos(self) -> tuple[JointMap, ...]:
        """Every servo as a map of its joint: ``joints`` in the order of q, ``auxiliary``, the second ones."""
        joints = self.joints + self.auxiliary
        return joints + tuple(other for joint in joints for other in joint.servos[1:])

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
        """Ids of ``servos``."""
        return tuple(servo.id for servo in self.servos)

    def spread(self, q: ArrayLike) -> Array:
        """(number of servos,) from (joints and auxiliary joints,): the value of each servo's joint."""
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
        for joint in (*self.joints, *self.auxiliary):
            if joint.name == name:
                return joint
        raise UnknownJointError(name, self.whole.names)

    def only(self, names: Sequence[str]) -> ArmConfig:
        """The arm with these joints, also those that are no part of q; as it is where none is named.

        Raises:
            UnknownJointError: No such joint; close ones are named.
        """
        wanted = {self.joint(name).name for name in names}
        kept = tuple(joint for joint in self.whole.joints if joint.name in wanted)
        return replace(self.whole, joints=kept) if names else self

    def slowed(self, share: float) -> ArmConfig:
        """The arm with a share of its speed and acceleration caps, above 0 and up to 1."""
        joints, auxiliary = (
            tuple(replace(j, velocity=share * j.velocity, acceleration=share * j.acceleration) for j in row)
            for row in (self.joints, self.auxiliary)
        )
        return replace(self, joints=joints, auxiliary=auxiliary)

    def auxiliary_of(self, name: str) -> tuple[JointMap, ...]:
        """The joints of a group that are no part of q."""
        return tuple(joint for joint in self.auxiliary if joint.group == name)

    def group(self, name: str) -> tuple[JointMap, ...]:
        """The joints of a group; none where there is no such group."""
        return tuple(joint for joint in (*self.joints, *self.auxiliary) if joint.group == name)


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
        arm.uncalibrated,
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
    profile = [getattr(j, f"profile_{key}_{unit}") for key in ("velocity", "acceleration")]
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
        twin=j.twin,
        pinion=1e-3 * j.pinion_mm if isinstance(j, SlideFile) and j.pinion_mm else None,
        group=j.group,
        reverse=j.reverse,
        swing=_swing(j) if isinstance(j, SlideFile) else None,
        gains=j.gains,
        current_limit=j.current_limit_ma,
        profile_velocity=None if profile[0] is None else one * profile[0],
        profile_acceleration=None if profile[1] is None else one * profile[1],
        stop_at=j.stop_at,
    )


def _swing(j: SlideFile) -> SwingArm | None:
    return SwingArm(1e-3 * j.horn_mm, 1e-3 * j.rod_mm) if j.horn_mm and j.rod_mm else None


# ------------------------------------------------------------------------------------------
# What no single key of an arm file shows: models, modes, rates, currents, duplicates, empty ranges.


def check_arm(config: ArmConfig, file: Path | str) -> None:
    """Checks an arm as a whole.

    Args:
        config: The arm.
        file: For messages.

    Raises:
        ConfigError: With file, key and what would be right.
    """
    _check_watchdogs(config, file)
    names: dict[str, int] = {}
    ids: dict[int, str] = {}
    for k, joint in enumerate((*config.joints, *config.auxiliary)):
        at = f"joints[{k}]"
        table = _table(joint, at, file)
        _check_model(config, joint, table, at, file)
        if joint.name in names:
            raise ConfigError(
                f"joint {joint.name!r} is already joints[{names[joint.name]}]", file=file, key=f"{at}.name"
            )
        names[joint.name] = k
        for prefix, servo in zip((at, f"{at}.twin"), joint.servos, strict=False):
            if servo.id in ids:
                raise ConfigError(f"id {servo.id} is already {ids[servo.id]}", file=file, key=f"{prefix}.id")
            ids[servo.id] = prefix
        _check_currents(joint, table, at, file)
        _check_stops(joint, table, at, file)
        _check_caps(joint, at, file)
        _check_range(joint, at, file)


def _check_watchdogs(config: ArmConfig, file: Path | str) -> None:
    """The heartbeat must act before the servos stop by themselves, or a held arm sinks a little each time."""
    if not config.watchdog_ms or not config.stale_ms:
        return
    period = 1.0 / config.rate_hz
    least = least_watchdog_ms(config.stale_ms, period)
    if config.watchdog_ms < least:
        if config.stale_ms == config.watchdog_ms // 2:  # not named: it grows with the watchdog
            while least < least_watchdog_ms(least // 2, period):
                least += WATCHDOG_UNIT_MS
        raise ConfigError(
            f"the servos would stop by themselves after {config.watchdog_ms} ms, before the program can hold "
            f"them (stale_ms = {config.stale_ms} at {config.rate_hz:g} Hz)",
            file=file,
            key="bus.watchdog_ms",
            allowed=f"{least} or more, or a shorter stale_ms; 0: no bus watchdog",
        )


def current_unit(table: ControlTable) -> float:
    """mA of one count of the current registers; 0 where there are none."""
    return float(table["goal_current"].unit.split()[0]) if "goal_current" in table else 0.0


def _table(joint: JointMap, at: str, file: Path | str) -> ControlTable:
    try:
        return control_table(joint.model)
    except ConfigError as error:
        raise ConfigError(
            f"unknown servo model {joint.model!r}",
            file=file,
            key=f"{at}.model",
            allowed=error.allowed,
            hint=error.hint,
        ) from None


def _check_model(config: ArmConfig, joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    if joint.mode not in table.modes:
        raise ConfigError(
            f"{joint.model} has no mode {joint.mode.name.lower()}",
            file=file,
            key=f"{at}.mode",
            allowed=", ".join(m.name.lower() for m in table.modes),
        )
    if config.baud not in table.baud_rates:
        raise ConfigError(
            f"{joint.model} ({joint.name}) cannot talk at {config.baud} bits/s",
            file=file,
            key="bus.baud",
            allowed=", ".join(map(str, table.baud_rates)),
        )


def _check_currents(joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    unit = current_unit(table)
    limits: tuple[tuple[str, float | None], ...] = (
        ("current_limit_ma", joint.current_limit),
        ("stop_at.current_ma", joint.stop_at.current_ma),
    )
    if not unit and any(value is not None for _, value in limits):
        raise ConfigError(
            f"{joint.model} measures no current",
            file=file,
            key=f"{at}.{next(key for key, value in limits if value is not None)}",
            allowed="a model that does; load_percent in [joints.stop_at] for this one",
        )
    maximum = table["goal_current"].maximum * unit if unit else 0.0
    if joint.current is not None:
        if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
            raise ConfigError(
                f"mode {joint.mode.name.lower()} of {joint.name!r} takes no current",
                file=file,
                key=f"{at}.current_ma",
                allowed='mode = "current_based_position"',
            )
        limits = (*limits, ("current_ma", joint.current))
    for key, value in limits:
        ceiling = maximum if key == "current_limit_ma" or joint.current_limit is None else joint.current_limit
        if value is not None and not unit <= value <= ceiling:
            raise ConfigError(
                f"{value:g} mA is no current of a {joint.model}"
                + (f" limited to {ceiling:g} mA" if ceiling < maximum else ""),
                file=file,
                key=f"{at}.{key}",
                allowed=f"{unit:g} to {ceiling:g}",
            )


def _check_stops(joint: JointMap, table: ControlTable, at: str, file: Path | str) -> None:
    """Thresholds that a servo can say something about, above what it may do and below what shuts it down."""
    stop = joint.stop_at
    if stop.current_ma is not None and joint.current is not None and stop.current_ma <= joint.current:
        raise ConfigError(
            f"{joint.name!r} may press with {joint.current:g} mA (current_ma) and would stop the arm by it",
            file=file,
            key=f"{at}.stop_at.current_ma",
            allowed=f"> {joint.current:g}",
        )
    if stop.load_percent is not None and "present_load" not in table:
        raise ConfigError(
            f"{joint.model} measures its current, and no load",
            file=file,
            key=f"{at}.stop_at.load_percent",
            allowed="current_ma",
        )
    hottest = table["temperature_limit"].initial or 0
    if stop.temperature_c is not None and not stop.temperature_c < hottest:
        raise ConfigError(
            f"a {joint.model} has shut down at {stop.temperature_c:g} C",
            file=file,
            key=f"{at}.stop_at.temperature_c",
            allowed=f"< {hottest}, its Temperature Limit",
        )


def _check_caps(joint: JointMap, at: str, file: Path | str) -> None:
    """Caps are finite, and the servo's own profile does not cut them."""
    for key in ("velocity", "acceleration"):
        cap, own = getattr(joint, key), getattr(joint, f"profile_{key}")
        if not 0.0 < cap < math.inf:
            at_key = f"{at}.{key}_{joint.unit}"
            raise ConfigError(f"{cap} is no cap", file=file, key=at_key, allowed="a number > 0")
        if own is not None and not cap <= own < math.inf:
            raise ConfigError(
                f"the servo of {joint.name!r} could not follow: its profile is slower than the joint's cap",
                file=file,
                key=f"{at}.profile_{key}_{joint.unit}",
                allowed=f">= {key}_{joint.unit} = {cap / joint.per_unit:g}",
            )


def _check_range(joint: JointMap, at: str, file: Path | str) -> None:
    if not joint.lower < joint.upper:
        raise ConfigError(
            f"the range of {joint.name!r} is empty: {joint.lower / joint.per_unit:g} to "
            f"{joint.upper / joint.per_unit:g} {joint.unit}",
            file=file,
            key=f"{at}.lower_{joint.unit}",
            allowed=f"lower_{joint.unit} < upper_{joint.unit}",
        )
    if joint.swing is not None and not joint.reach[0] <= joint.lower < joint.upper <= joint.reach[1]:
        raise ConfigError(
            f"a horn of {1e3 * joint.swing.horn:g} mm and a rod of {1e3 * joint.swing.rod:g} mm do not take "
            f"{joint.name!r} from {joint.text(joint.lower, 2)} to {joint.text(joint.upper, 2)}",
            file=file,
            key=f"{at}.lower_mm" if joint.lower < joint.reach[0] else f"{at}.upper_mm",
            allowed="{:.2f} to {:.2f} mm".format(*(q / joint.per_unit for q in joint.reach)),
        )
    lower, upper = joint.limits
    if not lower < upper:
        ends = [q / joint.per_unit for q in joint.reach]
        raise ConfigError(
            f"nothing of the range of {joint.name!r} can be reached in mode {joint.mode.name.lower()}",
            file=file,
            key=f"{at}.lower_{joint.unit}",
            allowed=f"{ends[0]:.1f} to {ends[1]:.1f} {joint.unit}",
            hint='use mode = "extended_position", or another zero_ticks',
        )
    for servo in joint.servos:
        first, last = servo.ticks_range
        if first > last or upper - lower < joint.resolution:
            raise ConfigError(
                f"the range of {joint.name!r} is narrower than one tick of its servo",
                file=file,
                key=f"{at}.lower_{joint.unit}",
                allowed=f"at least {joint.text(joint.resolution, 4)} from lower to upper",
            )
