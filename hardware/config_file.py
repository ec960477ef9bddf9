"""The TOML side of ``config``: what the keys of an arm file are, and what is said when one is wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError

from robot_ik.errors import ConfigError, close_matches
from robot_ik.files import parse_toml, shown
from robot_ik.hardware.control_table import BAUD_RATES, MULTI_TURN_TICKS
from robot_ik.hardware.joint_map import ARM, JointMap
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from robot_ik.hardware.config import ArmConfig

WATCHDOG_MS, STALE_MS = 400, 200
"""Where the arm file does not say."""
WATCHDOG_MAX_MS = 127 * WATCHDOG_UNIT_MS

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Word = Annotated[str, Field(min_length=1)]
_Gain = Annotated[int, Field(ge=0, le=16383)]


class _Table(BaseModel):
    # Strict: a number in quotes or a yes/no for a number is a slip worth hearing about.
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class BusFile(_Table):
    """Table ``[bus]``."""

    baud: int = 1_000_000
    rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    watchdog_ms: Annotated[int, Field(ge=0, le=WATCHDOG_MAX_MS, multiple_of=WATCHDOG_UNIT_MS)] = WATCHDOG_MS
    on_exit: Literal["torque_off", "hold", "park"] = "torque_off"
    stale_ms: Annotated[int | None, Field(ge=0, le=60_000)] = None  # half of watchdog_ms
    on_stale: Literal["hold", "park", "torque_off"] = "hold"


class TwinFile(_Table):
    """Table ``[joints.twin]``: the other servo of the joint above."""

    id: Annotated[int, Field(ge=0, le=252)]
    direction: Literal[1, -1] = 1
    zero_ticks: Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)] = 2048
    shadow: bool = False
    reverse: bool | None = None


class GainsFile(_Table):
    """Table ``[joints.gains]``: register values of the servo's position controller."""

    position_p: _Gain | None = None
    position_i: _Gain | None = None
    position_d: _Gain | None = None
    velocity_p: _Gain | None = None
    velocity_i: _Gain | None = None
    feedforward_1: _Gain | None = None
    feedforward_2: _Gain | None = None


class StopAtFile(_Table):
    """Table ``[joints.stop_at]``: where the arm stops before the servo shuts down."""

    load_percent: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    current_ma: _Positive | None = None
    temperature_c: _Positive | None = None


class JointFile(_Table):
    """What both kinds of table of ``[[joints]]`` have."""

    name: _Word
    id: Annotated[int, Field(ge=0, le=252)]
    model: _Word
    mode: Literal["position", "extended_position", "current_based_position"] = "extended_position"
    direction: Literal[1, -1] = 1
    zero_ticks: Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)] = 2048
    ratio: _Positive = 1.0
    reverse: bool = False
    current_ma: _Positive | None = None
    current_limit_ma: _Positive | None = None
    group: _Word = ARM
    twin: TwinFile | None = None
    gains: GainsFile = GainsFile()
    stop_at: StopAtFile = StopAtFile()


class HingeFile(JointFile):
    """A joint that turns."""

    lower_deg: _Finite
    upper_deg: _Finite
    velocity_deg: _Positive
    acceleration_deg: _Positive
    profile_velocity_deg: _Positive | None = None
    profile_acceleration_deg: _Positive | None = None


class SlideFile(JointFile):
    """A joint that slides: a pinion of this radius moves it on a rack, or a horn and a rod do."""

    pinion_mm: _Positive | None = None
    horn_mm: _Positive | None = None
    rod_mm: _Positive | None = None
    lower_mm: _Finite
    upper_mm: _Finite
    velocity_mm: _Positive
    acceleration_mm: _Positive
    profile_velocity_mm: _Positive | None = None
    profile_acceleration_mm: _Positive | None = None


def _kind(table: Any) -> str:
    """``slide`` where anything is said in millimetres, else ``hinge``."""
    return "slide" if isinstance(table, dict) and any(key.endswith("_mm") for key in table) else "hinge"


_JOINT_FILES: Mapping[str, type[JointFile]] = {"hinge": HingeFile, "slide": SlideFile}
_PART_FILES: Mapping[str, type[_Table]] = {"twin": TwinFile, "gains": GainsFile, "stop_at": StopAtFile}
_AnyJoint = Annotated[
    Annotated[HingeFile, Tag("hinge")] | Annotated[SlideFile, Tag("slide")], Discriminator(_kind)
]


class ArmFile(_Table):
    """A whole arm file."""

    # The schema number is named here because ``schema`` is taken in pydantic's base class.
    version: Annotated[Literal[1], Field(alias="schema")]
    name: _Word
    robot: _Word
    uncalibrated: bool = False
    bus: BusFile = BusFile()
    joints: Annotated[list[_AnyJoint], Field(min_length=1, max_length=252)]


def parse_arm_file(text: str, file: Path | str) -> ArmFile:
    """Checks the text of an arm file key by key.

    Raises:
        ConfigError: Not TOML, or a key is unknown, missing, of another type or out of range.
    """
    try:
        arm = ArmFile.model_validate(parse_toml(text, file))
    except ValidationError as error:
        raise _explain(error, file) from None
    if arm.bus.baud not in BAUD_RATES.values():
        raise ConfigError(
            f"no servo talks at {arm.bus.baud} bits/s",
            file=file,
            key="bus.baud",
            allowed=", ".join(map(str, BAUD_RATES.values())),
        )
    for k, joint in enumerate(arm.joints):
        if isinstance(joint, SlideFile):
            _check_gear(joint, f"joints[{k}]", file)
    return arm


def _check_gear(slide: SlideFile, at: str, file: Path | str) -> None:
    """A pinion, or a horn and a rod that is at least as long."""
    pair = (slide.horn_mm, slide.rod_mm)
    allowed = "pinion_mm alone (a rack), or horn_mm and rod_mm (a swing arm)"
    if slide.pinion_mm is not None and pair != (None, None):
        raise ConfigError(f"two gears move {slide.name!r}", file=file, key=f"{at}.pinion_mm", allowed=allowed)
    if slide.pinion_mm is None and None in pair:
        key = "rod_mm" if slide.horn_mm else "horn_mm" if slide.rod_mm else "pinion_mm"
        raise ConfigError("this key is missing", file=file, key=f"{at}.{key}", allowed=allowed)
    if slide.horn_mm and slide.rod_mm and slide.rod_mm < slide.horn_mm:
        raise ConfigError(
            f"a rod of {slide.rod_mm:g} mm on a horn of {slide.horn_mm:g} mm gets stuck",
            file=file,
            key=f"{at}.rod_mm",
            allowed=f">= {slide.horn_mm:g}",
        )


def first_slip(error: ValidationError) -> ErrorDetails:
    """The one to tell: an unknown key before a missing one, for the first often explains the second."""
    return min(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")


def _explain(error: ValidationError, file: Path | str) -> ConfigError:
    first, more = first_slip(error), error.error_count() - 1
    hint = f"and {more} more to correct after this" if more else ""
    key = _key(first["loc"])
    if first["type"] == "extra_forbidden":
        name = str(first["loc"][-1])
        known = _known_keys(first["loc"][:-1])  # in degrees or in millimetres
        close = close_matches(name, known)
        text = f"unknown key {shown(name)}" + (f": did you mean {' or '.join(close)}?" if close else "")
        return ConfigError(text, file=file, key=key, allowed=", ".join(known), hint=hint)
    if first["type"] == "missing":
        return ConfigError("this key is missing", file=file, key=key, allowed=_allowed(first), hint=hint)
    given = shown(first["input"])
    return ConfigError(f"{given} is not right", file=file, key=key, allowed=_allowed(first), hint=hint)


def _key(location: tuple[int | str, ...]) -> str:
    """``("joints", 2, "id")`` -> ``joints[2].id``."""
    text = ""
    for k, part in enumerate(location):
        if k == 2 and part in _JOINT_FILES:
            continue  # the kind, which pydantic puts there
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text


def _model(location: tuple[int | str, ...]) -> type[_Table]:
    if not location:
        return ArmFile
    if location[0] == "joints":
        parts = [_PART_FILES[part] for part in location[3:4] if isinstance(part, str) and part in _PART_FILES]
        return parts[0] if parts else _JOINT_FILES[str((*location, "", "hinge")[2] or "hinge")]
    return BusFile if location[0] == "bus" else ArmFile


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    return [info.alias or name for name, info in _model(location).model_fields.items()]


def _allowed(detail: ErrorDetails) -> str:
    """Pydantic's sentence, shortened to what would be right: "Input should be 1 or -1" -> "1 or -1"."""
    if detail["type"] == "missing":
        examples = {"schema": "1", "joints": "at least one [[joints]] table"}
        return examples.get(str(detail["loc"][-1]), "a value, e.g. as in the arm.toml of a shipped robot")
    limits = _limits(detail["loc"])
    if limits:
        return limits
    text = detail["msg"]
    for start in ("Input should be a valid ", "Input should be ", "String should have ", "Value should "):
        text = text.removeprefix(start)
    return text


def _limits(location: tuple[int | str, ...]) -> str:
    """The range of a numeric key in words, e.g. ``0..252``; empty for other keys."""
    field = _model(location[:-1]).model_fields.get(str(location[-1]))
    found: dict[str, Any] = {}
    metadata = list(field.metadata) if field else []
    for choice in get_args(field.annotation) if field else ():  # of a key that may be left out
        for info in getattr(choice, "__metadata__", ()):
            metadata += getattr(info, "metadata", ())
    for item in metadata:
        for name in ("gt", "ge", "le", "multiple_of"):
            if getattr(item, name, None) is not None:
                found[name] = getattr(item, name)
    text = f"> {found['gt']:g}" if "gt" in found else ""
    if "ge" in found and "le" in found:
        text = f"{found['ge']}..{found['le']}"
    elif "le" in found:
        text += f" and <= {found['le']:g}"
    if "multiple_of" in found:
        text += f", a multiple of {found['multiple_of']}"
    return text


def arm_file_text(config: ArmConfig) -> str:
    """The TOML text of an arm, angles in degrees."""
    lines = [
        "schema = 1",
        f"name = {json.dumps(config.name)}",
        f"robot = {json.dumps(config.robot)}",
        *(["uncalibrated = true"] if config.uncalibrated else []),
        "",
        "[bus]",
        f"baud = {config.baud:_}",
        f"rate_hz = {config.rate_hz:g}",
        f"watchdog_ms = {config.watchdog_ms}",
        f"on_exit = {json.dumps(config.on_exit)}",
        f"stale_ms = {config.stale_ms}",
        f"on_stale = {json.dumps(config.on_stale)}",
    ]
    for joint in (*config.joints, *config.aside):
        unit = joint.unit
        values: dict[str, Any] = {
            "name": joint.name,
            "id": joint.id,
            "model": joint.model,
            "mode": joint.mode.name.lower(),
            "direction": joint.direction,
            "zero_ticks": joint.zero_ticks,
            "ratio": joint.ratio,
            **({"reverse": True} if joint.reverse else {}),
            **({} if joint.group == ARM else {"group": joint.group}),
            **_gear(joint),
            f"lower_{unit}": _number(joint, max(joint.lower, joint.limits[0])),
            f"upper_{unit}": _number(joint, min(joint.upper, joint.limits[1])),
            f"velocity_{unit}": _number(joint, joint.velocity),
            f"acceleration_{unit}": _number(joint, joint.acceleration),
        }
        for key in ("velocity", "acceleration"):
            if (own := getattr(joint, f"profile_{key}")) is not None:
                values[f"profile_{key}_{unit}"] = _number(joint, own)
        values |= {"current_ma": joint.current, "current_limit_ma": joint.current_limit}
        lines += ["", "[[joints]]", *_rows(values)]
        for name in _PART_FILES:
            part = getattr(joint, name)
            if part is not None and (rows := _rows(asdict(part))):
                lines += ["", f"[joints.{name}]", *rows]
    return "\n".join(lines) + "\n"


def _gear(joint: JointMap) -> dict[str, float]:
    gear = {"pinion_mm": joint.pinion} if joint.pinion is not None else {}
    if joint.swing is not None:
        gear = {"horn_mm": joint.swing.horn, "rod_mm": joint.swing.rod}
    return {key: round(1e3 * metres, 9) for key, metres in gear.items()}


def _rows(values: Mapping[str, Any]) -> list[str]:
    """Those that are given."""
    return [f"{key} = {json.dumps(value)}" for key, value in values.items() if value is not None]


def _number(joint: JointMap, value: float) -> float:
    """Degrees or millimetres without the tail of a binary conversion (160.00000000000003)."""
    return round(1e3 * value if joint.slides else math.degrees(value), 12)
