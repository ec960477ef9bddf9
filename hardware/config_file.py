"""The TOML side of ``config``: what the keys of an arm file are, and what is said when one is wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from robot_ik.hardware.control_table import BAUD_RATES, MULTI_TURN_TICKS
from robot_ik.hardware.joint_map import ARM, Gains, JointMap, Sign, StopAt, Twin
from robot_ik.hardware.watchdogs import WATCHDOG_UNIT_MS
from robot_ik.reading import parse_toml
from robot_ik.tables import Table, WrongKey, check_table, chosen, keys_of

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig

WATCHDOG_MS, STALE_MS = 400, 200
"""Where the arm file does not say."""
WATCHDOG_MAX_MS = 127 * WATCHDOG_UNIT_MS

_Positive = Annotated[float, Field(gt=0.0)]
_Word = Annotated[str, Field(min_length=1)]


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


class JointFile(Table):
    """What both kinds of table of ``[[joints]]`` have."""

    name: _Word
    id: Annotated[int, Field(ge=0, le=252)]
    model: _Word
    mode: Literal["position", "extended_position", "current_based_position"] = "extended_position"
    direction: Sign = 1
    zero_ticks: Annotated[int, Field(ge=-MULTI_TURN_TICKS, le=MULTI_TURN_TICKS)] = 2048
    ratio: _Positive = 1.0
    reverse: bool = False
    current_ma: _Positive | None = None
    current_limit_ma: _Positive | None = None
    group: _Word = ARM
    twin: Annotated[Twin | None, keys_of(Twin)] = None
    gains: Annotated[Gains, keys_of(Gains)] = Gains()
    stop_at: Annotated[StopAt, keys_of(StopAt)] = StopAt()


class HingeFile(JointFile):
    """A joint that turns."""

    lower_deg: float
    upper_deg: float
    velocity_deg: _Positive
    acceleration_deg: _Positive
    profile_velocity_deg: _Positive | None = None
    profile_acceleration_deg: _Positive | None = None


class SlideFile(JointFile):
    """A joint that slides: a pinion of this radius moves it on a rack, or a horn and a rod do."""

    pinion_mm: _Positive | None = None
    horn_mm: _Positive | None = None
    rod_mm: _Positive | None = None
    lower_mm: float
    upper_mm: float
    velocity_mm: _Positive
    acceleration_mm: _Positive
    profile_velocity_mm: _Positive | None = None
    profile_acceleration_mm: _Positive | None = None

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

    # The schema number is named here because ``schema`` is taken in pydantic's base class.
    version: Annotated[Literal[1], Field(alias="schema", description="1")]
    name: _Word
    robot: _Word
    uncalibrated: bool = False
    bus: BusFile = BusFile()
    joints: Annotated[
        list[Annotated[JointFile, chosen(_kind)]],
        Field(min_length=1, max_length=252, description="at least one [[joints]] table"),
    ]


def parse_arm_file(text: str, file: Path | str) -> ArmFile:
    """Checks the text of an arm file key by key.

    Raises:
        ConfigError: Not TOML, or a key is unknown, missing, of another type or out of range.
    """
    return check_table(ArmFile, parse_toml(text, file), file)


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
    for joint in (*config.joints, *config.auxiliary):
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
        for name in ("twin", "gains", "stop_at"):
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
