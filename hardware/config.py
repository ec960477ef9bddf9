"""The arm file: which servo turns which joint, within which limits, on what bus."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field, model_validator

from robot_ik.errors import ConfigError, UnknownJointError, UnknownRobotError
from robot_ik.files import write_atomically
from robot_ik.hardware.control_table import (
    BAUD_RATES,
    IDS,
    TICKS_PER_REVOLUTION,
    ControlTable,
    OperatingMode,
    known_tables,
)
from robot_ik.hardware.family import ServoFamily, family_of
from robot_ik.hardware.joint_map import ARM, Gains, JointMap, ServoId, Sign, StopAt, Ticks, Twin
from robot_ik.hardware.servo import Joint
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS, least_watchdog_ms
from robot_ik.ports import Array
from robot_ik.reading import WrongKey, parse_toml, read_text
from robot_ik.robot_file import catalogue
from robot_ik.tables import Positive, SchemaVersion, Table, Word, check_table, chosen, keys_of

MAX_SERVOS = IDS[-1]

LONGEST_FILE = 1_000_000
"""Characters of an arm file; 252 joints with every key take a quarter of it."""
LONGEST_NAME = 100
"""Characters of the name of a joint or a group."""

SLOWEST = 1e-3
"""deg/s (mm/s): a velocity cap below it is a mistake of units."""
FASTEST = 1e5
"""deg/s (mm/s); the Profile Velocity register ends at 45,000 deg/s of the servo."""
GENTLEST = 1e-3
"""deg/s^2 (mm/s^2): an acceleration cap below it is a mistake of units."""
HARDEST = 1e6
"""deg/s^2 (mm/s^2); the Profile Acceleration register ends at 700,000 deg/s^2 of the servo."""

# ------------------------------------------------------------------------------------------
# The keys of the file.


WATCHDOG_MS, STALE_MS = 400, 200
"""Where the arm file does not say."""
WATCHDOG_MAX_MS = 127 * WATCHDOG_UNIT_MS


def _known_rate(baud: int) -> int:
    if baud not in BAUD_RATES.values():
        raise WrongKey(f"no servo talks at {baud} bits/s", allowed=", ".join(map(str, BAUD_RATES.values())))
    return baud


class BusFile(Table):
    """Table ``[bus]``."""

    baud: Annotated[int, AfterValidator(_known_rate)] = 1_000_000
    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    watchdog_ms: Annotated[int, Field(ge=0, le=WATCHDOG_MAX_MS, multiple_of=WATCHDOG_UNIT_MS)] = WATCHDOG_MS
    on_exit: Literal["torque_off", "hold", "park"] = "torque_off"
    stale_ms: Annotated[int | None, Field(ge=0, le=60_000)] = None  # half of watchdog_ms
    on_stale: Literal["hold", "park", "torque_off"] = "hold"
    on_orphan: Literal["hold", "torque_off"] = "hold"


class JointFile(Table):
    """What both kinds of table of ``[[joints]]`` have."""

    name: Word
    id: ServoId
    model: Word
    mode: Literal["position", "extended_position", "current_based_position"] = "extended_position"
    direction: Sign = 1
    zero_ticks: Ticks = 2048
    ratio: Positive = 1.0
    reverse: bool = False
    current_ma: Positive | None = None
    current_limit_ma: Positive | None = None
    group: Word = ARM
    twin: Annotated[Twin | None, keys_of(Twin)] = None
    gains: Annotated[Gains, keys_of(Gains)] = Gains()
    stop_at: Annotated[StopAt, keys_of(StopAt)] = StopAt()


class HingeFile(JointFile):
    """A joint that turns."""

    lower_deg: float
    upper_deg: float
    velocity_deg: Positive
    acceleration_deg: Positive
    profile_velocity_deg: Positive | None = None
    profile_acceleration_deg: Positive | None = None


class SlideFile(JointFile):
    """A joint that slides: a pinion of this radius moves it on a rack, or a horn and a rod do."""

    pinion_mm: Positive | None = None
    horn_mm: Positive | None = None
    rod_mm: Positive | None = None
    lower_mm: float
    upper_mm: float
    velocity_mm: Positive
    acceleration_mm: Positive
    profile_velocity_mm: Positive | None = None
    profile_acceleration_mm: Positive | None = None

    @model_validator(mode="after")
    def _one_gear(self) -> SlideFile:
        """A pinion, or a horn and a rod that is at least as long."""
        pair = (self.horn_mm, self.rod_mm)
        allowed = "pinion_mm alone (a rack), or horn_mm and rod_mm (a swing arm)"
        if self.pinion_mm is not None and pair != (None, None):
            raise WrongKey(f"two gears move {self.name!r}", "pinion_mm", allowed)
        if self.pinion_mm is None and None in pair:
            key = "rod_mm" if self.horn_mm else "horn_mm" if self.rod_mm else "pinion_mm"
            raise WrongKey("this key is missing", key, allowed)
        if self.horn_mm and self.rod_mm and self.rod_mm < self.horn_mm:
            problem = f"a rod of {self.rod_mm:g} mm on a horn of {self.horn_mm:g} mm gets stuck"
            raise WrongKey(problem, "rod_mm", f">= {self.horn_mm:g}")
        return self


def _kind(table: Mapping[str, Any]) -> type[JointFile]:
    """A slide where anything is said in millimetres, else a hinge."""
    return SlideFile if any(key.endswith("_mm") for key in table) else HingeFile


class ArmFile(Table):
    """A whole arm file."""

    version: SchemaVersion
    name: Word
    robot: Word
    uncalibrated: bool = False
    bus: BusFile = BusFile()
    joints: Annotated[
        list[Annotated[JointFile, chosen(_kind)]],
        Field(min_length=1, max_length=MAX_SERVOS, description="at least one [[joints]] table"),
    ]


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
        on_orphan: What happens if the program is killed: ``hold`` (nothing, the servos keep their torque), or
            ``torque_off`` (a second process switches torque off).
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
    on_orphan: str = "hold"

    def __post_init__(self) -> None:
        _check_arm(self)

    @classmethod
    def load(cls, path: Path | str | None) -> ArmConfig:
        """Reads an arm file: that of a path (such as ``robot.arm_file``), or the one of a robot's name.

        Raises:
            ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range; or the
                robot has none, whose ``arm_file`` is None.
            UnknownRobotError: A mere name, and neither a robot of the catalogue nor a file.
        """
        if path is None:
            hint = (
                "a robot without arm.toml beside its model has arm_file None; ArmConfig.generic needs no file"
            )
            raise ConfigError("there is no arm file to read", file="ArmConfig.load(None)", hint=hint)
        path = _find_arm_file(str(path))
        return cls.parse(read_text(path, "the arm file"), path)

    @classmethod
    def parse(cls, text: str, file: Path | str = "<text>") -> ArmConfig:
        """The same from the text of an arm file; ``file`` appears in errors."""
        if len(text) > LONGEST_FILE:  # a parser takes a second and more for a million
            problem = f"{len(text):,} characters are no arm file; allowed: up to {LONGEST_FILE:,}"
            raise ConfigError(problem, file=file, hint=f"one bus has up to {MAX_SERVOS} servos")
        return _from_file(check_table(ArmFile, parse_toml(text, file), file), Path(file))

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

        ``lower`` and ``upper``: (n,) rad, infinite where the joint has no limit; ``velocity``, rad/s, and
        ``acceleration``, rad/s^2: (n,) or one number.

        Raises:
            ConfigError: More than 252 joints, or limits that make no sense.
        """
        n = len(joints)
        if not 1 <= n <= MAX_SERVOS:
            raise ConfigError(
                f"{n} joints on one bus", file=robot_name, key="joints", allowed=f"1..{MAX_SERVOS}"
            )
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
        """Writes the arm file whole or not at all."""
        write_atomically(Path(path), self.to_toml())

    def to_toml(self) -> str:
        """Text of the arm file; ``parse`` reads the same arm back (angles to 1e-12 degrees)."""
        head = {
            "schema": 1,
            "name": self.name,
            "robot": self.robot,
            "uncalibrated": self.uncalibrated or None,
        }
        bus = {key: getattr(self, key) for key in BusFile.model_fields}
        lines = [*toml_rows(head), "", "[bus]", *toml_rows(bus)]
        for joint in self.whole.joints:
            values = _keys(joint)
            parts = {name: values.pop(name) for name in ("twin", "gains", "stop_at")}
            lines += ["", "[[joints]]", *toml_rows(values)]
            for name, part in parts.items():
                if part is not None and (rows := toml_rows(asdict(part))):
                    lines += ["", f"[joints.{name}]", *rows]
        return "\n".join(lines) + "\n"

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

    @property
    def family(self) -> ServoFamily:
        """The family of every servo of the arm."""
        return family_of(self.joints[0].table.family)

    @cached_property
    def all_joints(self) -> tuple[Joint, ...]:
        """Every joint in one order: the joints of q, then the grippers."""
        return tuple(row.joint for row in self.whole.joints)

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
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

    def wrong(self, problem: str, key: str, allowed: str = "", hint: str = "") -> ConfigError:
        """The error of a key of this arm's file."""
        return WrongKey(problem, key, allowed, hint).in_file(self.file or self.name)

    def joint(self, name: str) -> JointMap:
        """A joint by name, also one that is no part of q.

        Raises:
            UnknownJointError: No such joint; close ones are named.
        """
        for joint in self.whole.joints:
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

    def group(self, name: str) -> tuple[JointMap, ...]:
        """The joints of a group; none where there is no such group."""
        return tuple(joint for joint in self.whole.joints if joint.group == name)


# ------------------------------------------------------------------------------------------
# From the keys to an arm, and from an arm to the keys.


def _find_arm_file(name: str) -> Path:
    """The file of that path, or the one beside a robot of the catalogue."""
    known, path = catalogue(), Path(name).expanduser()
    hint = "an arm is an arm file (TOML), or the name of a robot that has one"
    if name in known:
        path = known[name] / "arm.toml"
        if not path.is_file():
            raise ConfigError("this robot comes without an arm file", file=path, hint=hint)
    elif not name or not (path.suffix or path.exists() or path.name != name):
        raise UnknownRobotError(name, known, hint=hint)
    return path


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
    bus = dict(arm.bus)
    if bus["stale_ms"] is None:
        bus["stale_ms"] = arm.bus.watchdog_ms // 2 or STALE_MS
    return ArmConfig(
        arm.name,
        arm.robot,
        joints=joints,
        file=file,
        auxiliary=tuple(maps[len(joints) :]),
        uncalibrated=arm.uncalibrated,
        **bus,
    )


_UNITS = {"deg": math.radians(1.0), "mm": 1e-3, "ma": 1.0}
"""End of a key of ``[[joints]]`` -> one of it in the field of ``JointMap``."""


def _field(key: str) -> tuple[str, float | None]:
    """The field of ``JointMap`` that has the value of a key, and its unit there."""
    name, _, unit = key.rpartition("_")
    return (name, _UNITS[unit]) if unit in _UNITS else (key, None)


def _joint_map(table: JointFile) -> JointMap:
    values: dict[str, Any] = {}
    for key, value in table:
        name, one = _field(key)
        values[name] = value if one is None or value is None else one * value
    return JointMap(**values | {"mode": OperatingMode[table.mode.upper()]})


def _keys(joint: JointMap) -> dict[str, Any]:
    """Keys of ``[[joints]]`` and their values, None where a key need not be there."""
    lower, upper = joint.limits
    joint = replace(joint, lower=max(joint.lower, lower), upper=min(joint.upper, upper))
    values: dict[str, Any] = {}
    for key in (SlideFile if joint.slides else HingeFile).model_fields:
        name, one = _field(key)
        value = getattr(joint, name)
        # Without the tail of a binary conversion (160.00000000000003).
        values[key] = value if one is None or value is None else round(value / one, 12)
    mode, group = joint.mode.name.lower(), None if joint.group == ARM else joint.group
    return values | {"mode": mode, "group": group, "reverse": joint.reverse or None}


def toml_rows(values: Mapping[str, Any]) -> list[str]:
    """Lines of a TOML table; None is left out."""
    return [f"{key} = {json.dumps(value)}" for key, value in values.items() if value is not None]


# ------------------------------------------------------------------------------------------
# What no single key of an arm file shows: models, modes, rates, currents, duplicates, empty ranges.


def _check_arm(config: ArmConfig) -> None:
    """Checks an arm as a whole; raises ``ConfigError`` with file, key and what would be right."""
    at = ""
    try:
        names: dict[str, str] = {}
        ids: dict[int, str] = {}
        for k, joint in enumerate(config.joints + config.auxiliary):
            at = f"joints[{k}]"
            if joint.model not in known_tables():
                raise WrongKey.unknown("servo model", joint.model, known_tables(), "model")
            _check_names(joint)
            table = joint.table
            first = config.joints[0]
            if table.family != first.table.family:
                problem = f"{joint.model} and {first.model} speak different protocols"
                raise WrongKey(problem, "model", "servos of one family on one bus")
            if joint.mode not in table.modes:
                modes = ", ".join(mode.name.lower() for mode in table.modes)
                raise WrongKey(f"{joint.model} has no mode {joint.mode.name.lower()}", "mode", modes)
            if config.baud not in table.baud_rates:
                at, rates = "", ", ".join(map(str, table.baud_rates))
                problem = f"{joint.model} ({joint.name}) cannot talk at {config.baud} bits/s"
                raise WrongKey(problem, "bus.baud", rates)
            if joint.name in names:
                raise WrongKey(f"joint {joint.name!r} is already {names[joint.name]}", "name")
            names[joint.name] = at
            for key, servo in zip(("id", "twin.id"), joint.servos, strict=False):
                if servo.id in ids:
                    raise WrongKey(f"id {servo.id} is already {ids[servo.id]}", key)
                ids[servo.id] = f"{at}.{key}".removesuffix(".id")
            _check_currents(joint, table)
            _check_stops(joint, table)
            _check_caps(joint)
            _check_range(joint)
        at = ""
        if config.watchdog_ms and not config.family.capabilities.bus_watchdog:
            why = config.family.unprotected_exit
            problem = f"{config.joints[0].model} servos have no bus watchdog: {why}"
            raise WrongKey(problem, "bus.watchdog_ms", "0: no bus watchdog")
        _check_watchdogs(config)
    except WrongKey as wrong:
        raise wrong.within((), at).in_file(config.file or config.name) from None


def _check_watchdogs(config: ArmConfig) -> None:
    """The heartbeat must act before the servos stop by themselves, or a held arm sinks a little each time."""
    if not config.watchdog_ms or not config.stale_ms:
        return
    period = 1.0 / config.rate_hz
    least = least_watchdog_ms(config.stale_ms, period)
    if config.watchdog_ms < least:
        if config.stale_ms == config.watchdog_ms // 2:  # not named: it grows with the watchdog
            while least < least_watchdog_ms(least // 2, period):
                least += WATCHDOG_UNIT_MS
        raise WrongKey(
            f"the servos would stop by themselves after {config.watchdog_ms} ms, before the program can hold "
            f"them (stale_ms = {config.stale_ms} at {config.rate_hz:g} Hz)",
            "bus.watchdog_ms",
            f"{least} or more, or a shorter stale_ms; 0: no bus watchdog",
        )


def _check_currents(joint: JointMap, table: ControlTable) -> None:
    unit = table.current_unit
    limits = {"current_limit_ma": joint.current_limit, "stop_at.current_ma": joint.stop_at.current_ma}
    named = [key for key, value in limits.items() if value is not None]
    if not unit and named:
        allowed = "a model that does; load_percent in [joints.stop_at] for this one"
        raise WrongKey(f"{joint.model} measures no current", named[0], allowed)
    maximum = table["goal_current"].maximum * unit if unit else 0.0
    if joint.current is not None:
        if joint.mode != OperatingMode.CURRENT_BASED_POSITION:
            problem = f"mode {joint.mode.name.lower()} of {joint.name!r} takes no current"
            raise WrongKey(problem, "current_ma", 'mode = "current_based_position"')
        limits["current_ma"] = joint.current
    for key, value in limits.items():
        ceiling = maximum if key == "current_limit_ma" or joint.current_limit is None else joint.current_limit
        if value is not None and not unit <= value <= ceiling:
            limited = f" limited to {ceiling:g} mA" if ceiling < maximum else ""
            problem = f"{value:g} mA is no current of a {joint.model}{limited}"
            raise WrongKey(problem, key, f"{unit:g} to {ceiling:g}")


def _check_stops(joint: JointMap, table: ControlTable) -> None:
    """Thresholds that a servo can say something about, above what it may do and below what shuts it down."""
    stop = joint.stop_at
    if stop.current_ma is not None and joint.current is not None and stop.current_ma <= joint.current:
        raise WrongKey(
            f"{joint.name!r} may press with {joint.current:g} mA (current_ma) and would stop the arm by it",
            "stop_at.current_ma",
            f"> {joint.current:g}",
        )
    if stop.load_percent is not None and "present_load" not in table:
        problem = f"{joint.model} measures its current, and no load"
        raise WrongKey(problem, "stop_at.load_percent", "current_ma")
    hottest = table["temperature_limit"].initial or 0
    if stop.temperature_c is not None and not stop.temperature_c < hottest:
        problem = f"a {joint.model} has shut down at {stop.temperature_c:g} C"
        raise WrongKey(problem, "stop_at.temperature_c", f"< {hottest}, its Temperature Limit")


def _check_names(joint: JointMap) -> None:
    """Names are shown in terminals, so they have no control characters and fit on a line."""
    for key in ("name", "group"):
        name = getattr(joint, key)
        if len(name) > LONGEST_NAME:
            problem = f"{name[:20]!r}… has {len(name):,} characters"
            raise WrongKey(problem, key, f"up to {LONGEST_NAME}")
        if not name.isprintable():
            raise WrongKey(f"{name!r} has characters that cannot be printed", key, "printable characters")


def _check_caps(joint: JointMap) -> None:
    """Caps are what a servo can do, and its own profile does not cut them."""
    ends = {"velocity": (SLOWEST, FASTEST), "acceleration": (GENTLEST, HARDEST)}
    for key, (least, most) in ends.items():
        cap, own = getattr(joint, key), getattr(joint, f"profile_{key}")
        if not least <= cap / joint.per_unit <= most:
            asked = f"{cap / joint.per_unit:g} is no cap"
            raise WrongKey(asked, f"{key}_{joint.unit}", f"{least:g} to {most:g}")
        if own is not None and not cap <= own < math.inf:
            raise WrongKey(
                f"the servo of {joint.name!r} could not follow: its profile is slower than the joint's cap",
                f"profile_{key}_{joint.unit}",
                f">= {key}_{joint.unit} = {cap / joint.per_unit:g}",
            )


def _check_range(joint: JointMap) -> None:
    unit, one = joint.unit, joint.per_unit
    if not joint.lower < joint.upper:
        span = f"{joint.lower / one:g} to {joint.upper / one:g} {unit}"
        problem = f"the range of {joint.name!r} is empty: {span}"
        raise WrongKey(problem, f"lower_{unit}", f"lower_{unit} < upper_{unit}")
    ends = [q / one for q in joint.reach]
    if joint.swing is not None and not joint.reach[0] <= joint.lower < joint.upper <= joint.reach[1]:
        raise WrongKey(
            f"a horn of {1e3 * joint.swing.horn:g} mm and a rod of {1e3 * joint.swing.rod:g} mm do not take "
            f"{joint.name!r} from {joint.text(joint.lower, 2)} to {joint.text(joint.upper, 2)}",
            "lower_mm" if joint.lower < joint.reach[0] else "upper_mm",
            f"{ends[0]:.2f} to {ends[1]:.2f} mm",
        )
    lower, upper = joint.limits
    if not lower < upper:
        raise WrongKey(
            f"nothing of the range of {joint.name!r} can be reached in mode {joint.mode.name.lower()}",
            f"lower_{unit}",
            f"{ends[0]:.1f} to {ends[1]:.1f} {unit}",
            'use mode = "extended_position", or another zero_ticks',
        )
    for servo in joint.servos:
        first, last = servo.ticks_range
        if first > last or upper - lower < joint.resolution:
            problem = f"the range of {joint.name!r} is narrower than one tick of its servo"
            allowed = f"at least {joint.text(joint.resolution, 4)} from lower to upper"
            raise WrongKey(problem, f"lower_{unit}", allowed)
