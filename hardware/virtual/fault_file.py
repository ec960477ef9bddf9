"""The TOML file of faults that ``sim-bus --faults`` and tests read, and what is said of a slip in it.

::

    schema = 1
    seed = 7

    [[faults]]
    kind = "silent"       # a name in fault_kinds.KINDS
    joint = "joint3"      # or id = 3; neither: every servo
    at_s = 2.0            # or at_packet = 100; neither: from the start
    for_s = 0.05          # or for_packets = 1; neither: for good

    [[faults]]
    kind = "corrupt"
    value = 0.001
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from robot_ik.errors import ConfigError, UnknownJointError, close_matches
from robot_ik.files import parse_toml, read_text, shown
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.config_file import first_slip
from robot_ik.hardware.virtual.fault_kinds import KINDS, Fault

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=1)]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    kind: str
    joint: str | None = None
    id: Annotated[int | None, Field(ge=0, le=252)] = None
    value: Annotated[float | None, Field(allow_inf_nan=False)] = None
    at_s: _Seconds | None = None
    at_packet: _Count | None = None
    for_s: _Seconds | None = None
    for_packets: _Count | None = None


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    # Named so because ``schema`` is taken in pydantic's base class.
    version: Annotated[int, Field(alias="schema", ge=1, le=1)]
    seed: int = 0
    faults: list[_Entry] = []


@dataclass(frozen=True)
class FaultScript:
    """Faults of one run.

    Attributes:
        seed: Of the wire's dice.
        faults: In the order of the file.
    """

    seed: int
    faults: tuple[Fault, ...]


def load_faults(path: Path | str, config: ArmConfig) -> FaultScript:
    """Reads a file of faults for an arm.

    Raises:
        ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    return parse_faults(read_text(path, "the file of faults"), config, path)


def parse_faults(text: str, config: ArmConfig, file: Path | str = "<text>") -> FaultScript:
    """The same from text; ``file`` appears in errors."""
    try:
        parsed = _File.model_validate(parse_toml(text, file))
    except ValidationError as error:
        raise _explain(first_slip(error), file) from None
    faults = tuple(_fault(entry, f"faults[{k}]", config, file) for k, entry in enumerate(parsed.faults))
    return FaultScript(parsed.seed, faults)


def _explain(detail: ErrorDetails, file: Path | str) -> ConfigError:
    key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in detail["loc"]).lstrip(".")
    if detail["type"] == "extra_forbidden":
        name = str(detail["loc"][-1])
        fields = (_Entry if len(detail["loc"]) > 1 else _File).model_fields
        known = [info.alias or field for field, info in fields.items()]
        close = close_matches(name, known)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        return ConfigError(
            f"unknown key {shown(name)}", file=file, key=key, allowed=", ".join(known), hint=hint
        )
    if detail["type"] == "missing":
        return ConfigError("this key is missing", file=file, key=key, allowed="a value")
    allowed = detail["msg"].removeprefix("Input should be a valid ").removeprefix("Input should be ")
    return ConfigError(f"{shown(detail['input'])} is not right", file=file, key=key, allowed=allowed)


def _fault(entry: _Entry, at: str, config: ArmConfig, file: Path | str) -> Fault:
    def wrong(text: str, key: str, allowed: str, hint: str = "") -> ConfigError:
        return ConfigError(text, file=file, key=f"{at}.{key}", allowed=allowed, hint=hint)

    kind = KINDS.get(entry.kind)
    if kind is None:
        close = close_matches(entry.kind, KINDS)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        raise wrong(f"no fault is called {shown(entry.kind)}", "kind", ", ".join(KINDS), hint)
    for one, other in (("joint", "id"), ("at_s", "at_packet"), ("for_s", "for_packets")):
        if getattr(entry, one) is not None and getattr(entry, other) is not None:
            raise wrong(f"{one} and {other} say the same", other, f"{one} or {other}")
    if not kind.servo and (entry.joint is not None or entry.id is not None):
        key = "joint" if entry.joint is not None else "id"
        raise wrong(f"{entry.kind} is not of one servo", key, "no joint and no id")
    return Fault(
        entry.kind,
        _servo_id(entry, config, wrong),
        _value(entry, wrong),
        entry.at_s,
        entry.at_packet,
        entry.for_s,
        entry.for_packets,
    )


def _servo_id(entry: _Entry, config: ArmConfig, wrong: Any) -> int | None:
    if entry.joint is not None:
        try:
            return config.joint(entry.joint).id
        except UnknownJointError:
            names = config.whole.names
            close = close_matches(entry.joint, names)
            hint = f"did you mean {' or '.join(close)}?" if close else ""
            raise wrong(f"no joint is called {shown(entry.joint)}", "joint", ", ".join(names), hint) from None
    if entry.id is not None and entry.id not in config.servo_ids:
        raise wrong(f"no servo has the id {entry.id}", "id", ", ".join(map(str, config.servo_ids)))
    return entry.id


def _value(entry: _Entry, wrong: Any) -> float:
    kind = KINDS[entry.kind]
    if kind.low is None or kind.high is None:
        if entry.value is not None:
            raise wrong(f"{entry.kind} takes no value", "value", "nothing")
        return 0.0
    span = f"{'a whole number, ' if kind.whole else ''}{kind.low:g}..{kind.high:g}"
    if entry.value is None:
        raise wrong("this key is missing", "value", span)
    if not kind.low <= entry.value <= kind.high or (kind.whole and entry.value != round(entry.value)):
        raise wrong(f"{entry.value:g} is not right", "value", span)
    return entry.value
