"""Reading a script, and what is said of a slip in it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from robot_ik.errors import ConfigError
from robot_ik.files import parse_toml, read_text, shown
from robot_ik.hardware.config_file import first_slip
from robot_ik.jobs.script.state import Script, did_you_mean, error_classes
from robot_ik.jobs.script.steps import (
    STEPS,
    AnyStep,
    ExpectStep,
    FollowStep,
    GripStep,
    JointsStep,
    LineStep,
    ScriptFile,
    Table,
    ThingTable,
)

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


def shipped() -> dict[str, Path]:
    """Name -> file of the scripts that come along."""
    folder = Path(str(resources.files("robot_ik.jobs.script") / "shipped"))
    return {file.stem: file for file in sorted(folder.glob("*.toml"))}


def find_script(name: str) -> Path:
    """The file of that path, or the script of that name that comes along.

    Raises:
        ConfigError: Neither.
    """
    path = Path(name).expanduser()
    known = shipped()
    if path.is_file() or path.suffix or path.name != name:
        return path
    if name not in known:
        hint = did_you_mean(name, list(known))
        raise ConfigError("there is no such script", file=name, allowed=", ".join(known), hint=hint)
    return known[name]


def load_script(path: Path | str) -> Script:
    """Reads a script.

    Raises:
        ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    hint = f"scripts that come along: {', '.join(shipped())}"
    return parse_script(read_text(path, "the script", hint), path)


def parse_script(text: str, file: Path | str = "<text>") -> Script:
    """The same from text; ``file`` appears in errors, and its folder is where paths are seen from."""
    try:
        content = ScriptFile.model_validate(parse_toml(text, file))
    except ValidationError as error:
        raise _explain(first_slip(error), file) from None
    script = Script(content, str(file), file.parent if isinstance(file, Path) else None)
    _check_things(script)
    for k, step in enumerate(content.steps):
        _check_step(script, step, f"steps[{k}]")
    return script


def _check_step(script: Script, step: AnyStep, at: str) -> None:
    """What no single key can tell."""
    classes = error_classes()
    for key in ("raises", "error"):
        name = getattr(step, key, None)
        if name is not None and name not in classes:
            raise script.unknown("error", name, list(classes), f"{at}.{key}")
    if isinstance(step, LineStep) and (step.position is None) == (step.by is None):
        raise script.wrong("a line goes to a position or by a vector", f"{at}.position", "position or by")
    if isinstance(step, FollowStep):
        _check_follow(script, step, at)
    if isinstance(step, ExpectStep):
        _check_expect(script, step, at)
    if isinstance(step, JointsStep) and step.joints_deg is None and step.joints_mm is None:
        raise script.wrong("no joint is named", f"{at}.joints_deg", "joints_deg, joints_mm (slides) or both")
    if isinstance(step, GripStep) and (step.opening is None) == (step.width_mm is None):
        raise script.wrong("a grip is to an opening or to a width", f"{at}.opening", "opening or width_mm")
    turn = getattr(step, "wxyz", None)
    if turn is not None and not any(turn):
        raise script.wrong("a quaternion of zeros is no orientation", f"{at}.wxyz", "w x y z, not all zero")


def _check_things(script: Script) -> None:
    names = [thing.name for thing in script.content.things]
    if names and not script.content.physics:
        raise script.wrong("things fall and are gripped in a world with physics only", "physics", "true")
    for k, name in enumerate(names):
        if name in names[:k]:
            raise script.wrong(
                f"there is a thing {shown(name)} already", f"things[{k}].name", "every name once"
            )


def _check_follow(script: Script, step: FollowStep, at: str) -> None:
    given = [key for key in ("center", "radius", "period") if getattr(step, key) is not None]
    if step.path == "marker":
        wrong = [*given, *(key for key in ("normal", "wxyz", "frame") if getattr(step, key) is not None)]
        if wrong:
            raise script.wrong(
                f"a marker goes its own way, so {wrong[0]} means nothing",
                f"{at}.{wrong[0]}",
                'nothing, or path = "circle" or "eight"',
            )
        return
    for key in ("center", "radius", "period"):
        if key not in given:
            raise script.wrong("this key is missing", f"{at}.{key}", f'a value, for path = "{step.path}"')


def _check_expect(script: Script, step: ExpectStep, at: str) -> None:
    places = ("position", "wxyz", "joints_deg", "joints_mm", "keyframe")
    rest = ("state", "error", "joint", "cause", "status", "step_seconds", "run_seconds")
    wanted = (*places, "width_mm", *rest)
    if all(getattr(step, key) is None for key in wanted):
        raise script.wrong("nothing is expected", at, f"one or more of {', '.join(wanted)}")
    names = [thing.name for thing in script.content.things]
    if step.thing is not None and step.thing not in names:
        raise script.unknown("thing", step.thing, names, f"{at}.thing")
    if step.thing is not None and step.position is None:
        raise script.wrong("this key is missing", f"{at}.position", "where the thing is to lie")
    for key in ("step_seconds", "run_seconds"):
        span = getattr(step, key)
        if span is not None and span[0] > span[1]:
            raise script.wrong(f"{span} is empty", f"{at}.{key}", "[from, to]")


# ------------------------------------------------------------------------------------- slips of pydantic


def _explain(detail: ErrorDetails, file: Path | str) -> ConfigError:
    where = detail["loc"]
    model: type[Table] = ThingTable if where[:1] == ("things",) and len(where) > 1 else ScriptFile
    if where[:1] == ("steps",) and len(where) > 2:  # pydantic puts the kind of step behind its number
        model = STEPS[str(where[2])]
        where = (*where[:2], *where[3:])
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).lstrip(".")
    if detail["type"] == "extra_forbidden":
        name = str(where[-1])
        known = [info.alias or field for field, info in model.model_fields.items()]
        return ConfigError(
            f"unknown key {shown(name)}",
            file=file,
            key=key,
            allowed=", ".join(known),
            hint=did_you_mean(name, known),
        )
    if detail["type"] == "missing":
        return ConfigError("this key is missing", file=file, key=key, allowed="a value")
    if detail["type"].startswith("union_tag"):
        return _explain_kind(detail, file, key)
    allowed = detail["msg"].removeprefix("Input should be a valid ").removeprefix("Input should be ")
    return ConfigError(f"{shown(detail['input'])} is not right", file=file, key=key, allowed=allowed)


def _explain_kind(detail: ErrorDetails, file: Path | str, key: str) -> ConfigError:
    allowed = ", ".join(STEPS)
    if detail["type"] == "union_tag_not_found":
        return ConfigError("this key is missing", file=file, key=f"{key}.do", allowed=allowed)
    name = str(detail["ctx"]["tag"])
    return ConfigError(
        f"no step is called {shown(name)}",
        file=file,
        key=f"{key}.do",
        allowed=allowed,
        hint=did_you_mean(name, list(STEPS)),
    )
