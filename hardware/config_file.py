"""The TOML side of ``config``: what the keys of an arm file are, and what is said when one is wrong."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError

from robot_ik.errors import ConfigError, close_matches
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


class _Table(BaseModel):
    # Strict: a number in quotes or a yes/no for a number is a slip worth hearing about.
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class BusFile(_Table):
    """Table ``[bus]``."""

    baud: int = 1_000_000
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 100.0
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


class JointFile(_Table):
    """What both kinds of table of ``[[joints]]`` have."""

    name: _Word
    id: Annotated[int, Field(ge=0, le=252)]
    model: _Word
    mode: Literal["position", "extended_position", "current_based_position"] = "extended_position"
    direction: Literal[1, -1] = 1
    zero_ticks: Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)] = 2048
    ratio: _Positive = 1.0
    current_ma: _Positive | None = None
    group: _Word = ARM
    twin: TwinFile | None = None


class HingeFile(JointFile):
    """A joint that turns."""

    lower_deg: _Finite
    upper_deg: _Finite
    velocity_deg: _Positive
    acceleration_deg: _Positive


class SlideFile(JointFile):
    """A joint that slides on a rack: a pinion of this radius moves it."""

    pinion_mm: _Positive
    lower_mm: _Finite
    upper_mm: _Finite
    velocity_mm: _Positive
    acceleration_mm: _Positive


def _kind(table: Any) -> str:
    """``slide`` where anything is said in millimetres, else ``hinge``."""
    return "slide" if isinstance(table, dict) and any(key.endswith("_mm") for key in table) else "hinge"


_JOINT_FILES: Mapping[str, type[JointFile]] = {"hinge": HingeFile, "slide": SlideFile}
_AnyJoint = Annotated[
    Annotated[HingeFile, Tag("hinge")] | Annotated[SlideFile, Tag("slide")], Discriminator(_kind)
]


class ArmFile(_Table):
    """A whole arm file."""

    # The schema number is named here because ``schema`` is taken in pydantic's base class.
    version: Annotated[Literal[1], Field(alias="schema")]
    name: _Word
    robot: _Word
    bus: BusFile = BusFile()
    joints: Annotated[list[_AnyJoint], Field(min_length=1, max_length=252)]


def parse_arm_file(text: str, file: Path | str) -> ArmFile:
    """Checks the text of an arm file key by key.

    Raises:
        ConfigError: Not TOML, or a key is unknown, missing, of another type or out of range.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}", file=file) from None
    try:
        arm = ArmFile.model_validate(raw)
    except ValidationError as error:
        raise _explain(error, file) from None
    if arm.bus.baud not in BAUD_RATES.values():
        raise ConfigError(
            f"no servo talks at {arm.bus.baud} bits/s",
            file=file,
            key="bus.baud",
            allowed=", ".join(map(str, BAUD_RATES.values())),
        )
    return arm


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
        text = f"unknown key {name!r}" + (f": did you mean {' or '.join(close)}?" if close else "")
        return ConfigError(text, file=file, key=key, allowed=", ".join(known), hint=hint)
    if first["type"] == "missing":
        return ConfigError("this key is missing", file=file, key=key, allowed=_allowed(first), hint=hint)
    given = first["input"]
    return ConfigError(f"{given!r} is not right", file=file, key=key, allowed=_allowed(first), hint=hint)


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
        return TwinFile if "twin" in location else _JOINT_FILES[str((*location, "", "hinge")[2] or "hinge")]
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
    for item in field.metadata if field else ():
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
            **({} if joint.group == ARM else {"group": joint.group}),
            **({} if joint.pinion is None else {"pinion_mm": round(1e3 * joint.pinion, 9)}),
            f"lower_{unit}": _number(joint, max(joint.lower, joint.limits[0])),
            f"upper_{unit}": _number(joint, min(joint.upper, joint.limits[1])),
            f"velocity_{unit}": _number(joint, joint.velocity),
            f"acceleration_{unit}": _number(joint, joint.acceleration),
        }
        if joint.current is not None:
            values["current_ma"] = joint.current
        lines += ["", "[[joints]]", *_rows(values)]
        if joint.twin is not None:
            lines += ["", "[joints.twin]", *_rows(asdict(joint.twin))]
    return "\n".join(lines) + "\n"


def _rows(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in values.items()]


def _number(joint: JointMap, value: float) -> float:
    """Degrees or millimetres without the tail of a binary conversion (160.00000000000003)."""
    return round(math.degrees(value) if joint.pinion is None else 1e3 * value, 12)
