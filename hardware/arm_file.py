"""The keys of an arm file: TOML text to joints and back.

``ArmFile`` is the only list of keys.  ``ArmConfig`` is the arm that they describe.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import tomlkit
from pydantic import AfterValidator, Field, model_validator

from robot_ik.collision import DEFAULT_MARGIN, LARGEST_MARGIN
from robot_ik.config import (
    KeyProblem,
    Positive,
    SchemaVersion,
    Several,
    Table,
    Word,
    check_table,
    chosen,
    keys_of,
    parse_toml,
)
from robot_ik.errors import ConfigError, UnknownRobotError
from robot_ik.hardware.models import BAUD_RATES
from robot_ik.hardware.registers import IDS, OperatingMode
from robot_ik.hardware.servo import (
    ARM,
    GRIPPER,
    Direct,
    Gains,
    Gear,
    Joint,
    OpenEnd,
    Pinion,
    Servo,
    ServoId,
    Sign,
    StopAt,
    SwingArm,
    Ticks,
)
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.robot_file import catalogue

MAX_SERVOS = IDS[-1]
"""Largest number of servos on one bus."""

LONGEST_FILE = 1_000_000
"""Characters of an arm file; 252 joints with every key take a quarter of it."""

WATCHDOG_MS = 400
"""ms of ``bus.watchdog_ms`` if the arm file does not say."""

STALE_MS = 200
"""ms of ``bus.stale_ms`` if neither it nor a bus watchdog is given."""

WATCHDOG_MAX_MS = 127 * WATCHDOG_UNIT_MS
"""ms; the register of the bus watchdog has seven bits."""

DEGREE = math.radians(1.0)
"""One degree in rad."""

MILLIMETRE = 1e-3
"""One millimetre in m."""

FILE_DIGITS = 12
"""Decimals of a number in the file.

They leave out the tail of a binary conversion such as 160.00000000000003.
"""

SCALED = ("lower", "upper", "velocity", "acceleration", "profile_velocity", "profile_acceleration")
"""Fields of ``Joint`` whose keys end in the unit of the joint: ``lower_deg``, ``lower_mm``."""


def _known_rate(baud: int) -> int:
    rates = BAUD_RATES
    if baud not in rates:
        raise KeyProblem(f"no servo talks at {baud} bits/s", allowed=", ".join(map(str, rates)))
    return baud


class BusTable(Table):
    """Table ``[bus]``."""

    baud: Annotated[int, AfterValidator(_known_rate)] = 1_000_000
    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    watchdog_ms: Annotated[int, Field(ge=0, le=WATCHDOG_MAX_MS, multiple_of=WATCHDOG_UNIT_MS)] = (
        WATCHDOG_MS
    )
    on_exit: Literal["torque_off", "hold", "park"] = "torque_off"
    stale_ms: Annotated[int | None, Field(ge=0, le=60_000)] = None  # half of watchdog_ms
    on_stale: Literal["hold", "park", "torque_off"] = "hold"
    on_orphan: Literal["hold", "torque_off"] = "hold"


def _two_names(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(names) != 2:
        raise KeyProblem(f"{len(names)} names are not a pair", allowed="2 names of bodies or geoms")
    return names


NamePair = Annotated[Several[Word], AfterValidator(_two_names)]


class CollisionTable(Table):
    """Table ``[collisions]``: what the commands that move the arm must not touch.

    An empty table asks for self-collisions only.

    Attributes:
        scene: MJCF file of the obstacles around the arm, in the world of its model. Empty: none.
        margin: Smallest allowed distance of two parts, m.
        ground: Height of a floor in the world of the model, m. None: no floor.
        ignore: Pairs of names of bodies or geoms that may touch.
    """

    scene: str = ""
    margin: Annotated[float, Field(ge=0.0, le=LARGEST_MARGIN)] = DEFAULT_MARGIN
    ground: float | None = None
    ignore: Several[NamePair] = ()


class TwinTable(Table):
    """Table ``[joints.twin]``: the other servo of a joint that two servos turn.

    With ``shadow`` the servo's Secondary ID is the id of the first servo.  It obeys the goals of
    the first servo, so direction and zero are those of the first servo.
    """

    id: ServoId
    direction: Sign = 1
    zero_ticks: Ticks = 2048
    shadow: bool = False
    reverse: bool | None = None


class JointTable(Table):
    """Keys that both kinds of ``[[joints]]`` tables have."""

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
    open_end: OpenEnd | None = None
    twin: TwinTable | None = None
    gains: Annotated[Gains, keys_of(Gains)] = Gains()
    stop_at: Annotated[StopAt, keys_of(StopAt)] = StopAt()

    @model_validator(mode="after")
    def _only_grippers_open(self) -> JointTable:
        if self.open_end is not None and self.group != GRIPPER:
            problem = f"{self.name!r} is of the group {self.group!r} and does not open"
            raise KeyProblem(problem, "open_end", f'a joint with group = "{GRIPPER}"')
        return self

    def gear(self) -> Gear:
        """Return the gear between servo and joint."""
        return Direct(self.ratio)

    def joint(self) -> Joint:
        """Return the joint that the table describes."""
        suffix, unit = _unit_of(self.gear())
        values: dict[str, Any] = {}
        if self.open_end is not None:
            values["open_end"] = self.open_end
        for name in SCALED:
            value = getattr(self, f"{name}_{suffix}")
            values[name] = None if value is None else unit * value
        return Joint(
            name=self.name,
            gear=self.gear(),
            servos=self._servos(),
            group=self.group,
            current=self.current_ma,
            stop_at=self.stop_at,
            **values,
        )

    def _servos(self) -> tuple[Servo, ...]:
        first = Servo(
            id=self.id,
            model=self.model,
            mode=OperatingMode[self.mode.upper()],
            direction=self.direction,
            zero_ticks=self.zero_ticks,
            reverse=self.reverse,
            current_limit=self.current_limit_ma,
            gains=self.gains,
        )
        return (first,) if self.twin is None else (first, second_servo(first, self.twin))


class HingeTable(JointTable):
    """A joint that turns."""

    lower_deg: float
    upper_deg: float
    velocity_deg: Positive
    acceleration_deg: Positive
    profile_velocity_deg: Positive | None = None
    profile_acceleration_deg: Positive | None = None


class SlideTable(JointTable):
    """A joint that slides, moved by a pinion on a rack or by a horn and a rod."""

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
    def _one_gear(self) -> SlideTable:
        """Check that there is a pinion, or a horn and a rod that is at least as long."""
        pair = (self.horn_mm, self.rod_mm)
        allowed = "pinion_mm alone (a rack), or horn_mm and rod_mm (a swing arm)"
        if self.pinion_mm is not None and pair != (None, None):
            raise KeyProblem(f"two gears move {self.name!r}", "pinion_mm", allowed)
        if self.pinion_mm is None and None in pair:
            key = "rod_mm" if self.horn_mm else "horn_mm" if self.rod_mm else "pinion_mm"
            raise KeyProblem("this key is missing", key, allowed)
        if self.horn_mm and self.rod_mm and self.rod_mm < self.horn_mm:
            problem = f"a rod of {self.rod_mm:g} mm on a horn of {self.horn_mm:g} mm gets stuck"
            raise KeyProblem(problem, "rod_mm", f">= {self.horn_mm:g}")
        return self

    def gear(self) -> Gear:
        """Return the gear between servo and joint."""
        if self.pinion_mm is not None:
            return Pinion(MILLIMETRE * self.pinion_mm, self.ratio)
        if self.horn_mm is None or self.rod_mm is None:
            raise KeyProblem("this key is missing", "pinion_mm")
        return SwingArm(MILLIMETRE * self.horn_mm, MILLIMETRE * self.rod_mm, self.ratio)


def _kind(table: Mapping[str, Any]) -> type[JointTable]:
    """Return the slide table if a key is in millimetres, else the hinge table."""
    return SlideTable if any(key.endswith("_mm") for key in table) else HingeTable


class ArmFile(Table):
    """A whole arm file."""

    version: SchemaVersion
    name: Word
    robot: Word
    uncalibrated: bool = False
    bus: BusTable = BusTable()
    collisions: CollisionTable | None = None
    joints: Annotated[
        list[Annotated[JointTable, chosen(_kind)]],
        Field(min_length=1, max_length=MAX_SERVOS, description="at least one [[joints]] table"),
    ]


def parse_arm_file(text: str, file: Path | str) -> ArmFile:
    """Return the checked content of an arm file.

    Args:
        text: TOML.
        file: Name for errors.

    Raises:
        ConfigError: Not TOML, or a key is unknown, missing or out of range.
    """
    if len(text) > LONGEST_FILE:  # a parser takes a second and more for a million characters
        problem = f"{len(text):,} characters are no arm file; allowed: up to {LONGEST_FILE:,}"
        raise ConfigError(problem, file=file, hint=f"one bus has up to {MAX_SERVOS} servos")
    return check_table(ArmFile, parse_toml(text, file), file)


def find_arm_file(name: str) -> Path:
    """Return the path of an arm file, given as a path or as a robot of the catalogue.

    Raises:
        ConfigError: The robot has no arm file.
        UnknownRobotError: Neither a file nor a robot of the catalogue.
    """
    known = catalogue()
    path = Path(name).expanduser()
    hint = "an arm is an arm file (TOML), or the name of a robot that has one"
    if name in known:
        path = known[name] / "arm.toml"
        if not path.is_file():
            raise ConfigError("this robot comes without an arm file", file=path, hint=hint)
    elif not name or not (path.suffix or path.exists() or path.name != name):
        raise UnknownRobotError(name, known, hint=hint)
    return path


def second_servo(first: Servo, twin: TwinTable) -> Servo:
    """Return the second servo of a joint.

    Args:
        first: First servo; the second one has the same model, mode and settings.
        twin: Its table.
    """
    if twin.shadow:
        direction = first.direction
        zero_ticks = first.zero_ticks
        reverse = twin.reverse
    else:
        direction = twin.direction
        zero_ticks = twin.zero_ticks
        reverse = bool(twin.reverse)
    return Servo(
        id=twin.id,
        model=first.model,
        mode=first.mode,
        direction=direction,
        zero_ticks=zero_ticks,
        reverse=reverse,
        primary_id=first.id if twin.shadow else None,
        current_limit=first.current_limit,
        gains=first.gains,
    )


def joint_keys(joint: Joint) -> dict[str, Any]:
    """Return the ``[[joints]]`` table of a joint, without keys that need not be there."""
    servo = joint.servo
    suffix, unit = _unit_of(joint.gear)
    lower, upper = joint.limits
    limits = {"lower": max(joint.lower, lower), "upper": min(joint.upper, upper)}
    values: dict[str, Any] = {
        "name": joint.name,
        "id": servo.id,
        "model": servo.model,
        "mode": servo.mode.name.lower(),
        "direction": servo.direction,
        "zero_ticks": servo.zero_ticks,
        "ratio": joint.gear.ratio,
        "reverse": servo.reverse or None,
        "current_ma": joint.current,
        "current_limit_ma": servo.current_limit,
        "group": None if joint.group == ARM else joint.group,
        "open_end": joint.open_end if joint.group == GRIPPER else None,
        **_gear_keys(joint.gear),
    }
    for name in SCALED:
        value = limits.get(name, getattr(joint, name))
        values[f"{name}_{suffix}"] = None if value is None else round(value / unit, FILE_DIGITS)
    tables = {
        "twin": _twin_keys(joint.servos[1]) if len(joint.servos) > 1 else {},
        "gains": _given(asdict(servo.gains)),
        "stop_at": _given(asdict(joint.stop_at)),
    }
    return _given(values) | {name: keys for name, keys in tables.items() if keys}


def _gear_keys(gear: Gear) -> dict[str, float]:
    lengths: dict[str, float] = {}
    if isinstance(gear, Pinion):
        lengths = {"pinion_mm": gear.radius}
    elif isinstance(gear, SwingArm):
        lengths = {"horn_mm": gear.horn, "rod_mm": gear.rod}
    return {key: round(length / MILLIMETRE, FILE_DIGITS) for key, length in lengths.items()}


def _twin_keys(servo: Servo) -> dict[str, Any]:
    values = {"id": servo.id, "shadow": servo.primary_id is not None, "reverse": servo.reverse}
    if servo.primary_id is None:
        values |= {"direction": servo.direction, "zero_ticks": servo.zero_ticks}
    return _given(values)


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}


def _unit_of(gear: Gear) -> tuple[str, float]:
    """Return the end of a key in the unit of the joint, and one unit in rad or m."""
    return ("mm", MILLIMETRE) if gear.unit == "m" else ("deg", DEGREE)


def with_zeros(text: str, zeros: Mapping[int, int]) -> str:
    """Return an arm file with other zeros.  Comments and everything else stay as they are.

    Args:
        text: TOML of a correct arm file.
        zeros: Servo id -> ``zero_ticks``.
    """
    document: Any = tomlkit.parse(text)
    for joint in document["joints"]:
        for table in (joint, joint.get("twin")):
            if table is None or table["id"] not in zeros or table.get("shadow"):
                continue
            zero = zeros[table["id"]]
            if table.get("zero_ticks", TwinTable.model_fields["zero_ticks"].default) != zero:
                table["zero_ticks"] = zero
    return tomlkit.dumps(document)
