"""What a script says, and reading one."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.jobs.script.steps import ScriptStep, step_class
from robot_ik.jobs.script.steps.expect import ExpectStep
from robot_ik.reading import WrongKey, parse_toml, read_text, shown
from robot_ik.robot_file import catalogue
from robot_ik.tables import Position, Positive, SchemaVersion, Several, Table, Word, check_table, chosen


class ObjectTable(Table):
    """A box that lies about and can be gripped, in a world with ``physics``; ``position``: its centre."""

    name: Word
    position: Position
    yaw_deg: float = 0.0
    size_mm: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)]
    mass_g: Positive = 50.0


class Script(Table):
    """A whole script; ``file`` is where it came from, for errors.

    Attributes:
        version: ``schema`` in the file (the name is taken in pydantic's base class).
        robot: Catalogue name, or a path seen from the script; ``arm``: path of an arm file, likewise.
        seed: Of random faults, restarts and the synthetic camera's noise.
        speed: Share of the speed limits of all moves that do not say it themselves.
        marker_at: x, y, z in metres and yaw in degrees of the printed marker; by default the scene's own.
        physics: The robot's MuJoCo model moves the simulated shafts; ``objects`` lie on its plane z = 0.
    """

    version: SchemaVersion
    name: Word
    about: str = ""
    robot: Word = "tabletop_puma"
    arm: str | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    speed: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    marker_at: Annotated[Several[float], Field(min_length=3, max_length=4)] | None = None
    physics: bool = False
    objects: Several[ObjectTable] = ()
    steps: Annotated[Several[Annotated[ScriptStep, chosen(step_class)]], Field(min_length=1)]
    _file: str
    _folder: Path | None

    @model_validator(mode="after")
    def _known_objects(self) -> Script:
        names = [one.name for one in self.objects]
        if names and not self.physics:
            raise WrongKey("objects fall and are gripped in a world with physics only", "physics", "true")
        for k, name in enumerate(names):
            if name in names[:k]:
                problem = f"there is an object {shown(name)} already"
                raise WrongKey(problem, f"objects[{k}].name", "every name once")
        for k, step in enumerate(self.steps):
            if isinstance(step, ExpectStep) and step.object is not None and step.object not in names:
                raise WrongKey.unknown("object", step.object, names, f"steps[{k}].object")
        return self

    @property
    def file(self) -> str:
        return self._file

    def resolved(self, name: str) -> str:
        """A robot of the catalogue, or a path as seen from the script's folder."""
        if name in catalogue() or self._folder is None:
            return name
        return str(self._folder / Path(name).expanduser())

    def wrong(self, problem: str, key: str, allowed: str = "") -> ConfigError:
        """The error for something in this script."""
        return ConfigError(problem, file=self.file, key=key, allowed=allowed)


def shipped() -> dict[str, Path]:
    """Name -> file of the scripts that come along."""
    folder = Path(str(resources.files("robot_ik.jobs.script") / "shipped"))
    return {file.stem: file for file in sorted(folder.glob("*.toml"))}


def _found(name: str) -> Path:
    path = Path(name).expanduser()
    known = shipped()
    if path.is_dir() and name not in known:
        own = next(iter(sorted(path.glob("*.toml"))), None)
        hint = "" if own is None else f"a script in it: robot-ik run {own}"
        raise ConfigError("this is a folder", file=name, allowed="one script", hint=hint)
    if path.is_file() or path.suffix or path.name != name:
        return path
    if name not in known:
        hint = did_you_mean(name, known)
        raise ConfigError("there is no such script", file=name, allowed=", ".join(known), hint=hint)
    return known[name]


def load_script(path: Path | str) -> Script:
    """Reads a script: the file of that path, or the one of that name that comes along.

    Raises:
        ConfigError: It cannot be read, is not TOML, or a key is unknown, missing or out of range.
    """
    path = _found(str(path))
    hint = f"scripts that come along: {', '.join(shipped())}"
    return parse_script(read_text(path, "the script", hint), path)


def parse_script(text: str, file: Path | str = "<text>") -> Script:
    """The same from text; ``file`` appears in errors, and its folder is where paths are seen from."""
    script = check_table(Script, parse_toml(text, file), file)
    script._file, script._folder = str(file), file.parent if isinstance(file, Path) else None
    return script
