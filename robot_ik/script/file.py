"""The content of a script file, and functions that read it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from robot_ik.config import (
    KeyProblem,
    Position,
    Positive,
    SchemaVersion,
    Several,
    Table,
    Word,
    check_table,
    chosen,
    parse_toml,
    read_text,
    shown,
)
from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.robot_file import catalogue
from robot_ik.script.steps import ScriptStep, step_class
from robot_ik.script.steps.expect import ExpectStep


class ObjectTable(Table):
    """A box that the gripper can grip. It needs ``physics``.

    Attributes:
        name: Name of the object, unique in the script.
        position: Centre of the box in the world frame, metres.
        yaw_deg: Rotation about the world's z axis, degrees.
        size_mm: Edge lengths along x, y and z, millimetres.
        mass_g: Mass, grams.
    """

    name: Word
    position: Position
    yaw_deg: float = 0.0
    size_mm: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)]
    mass_g: Positive = 50.0


class Script(Table):
    """A script.

    Attributes:
        version: Key ``schema`` of the file. Pydantic's base class reserves that name.
        name: Name of the script in the report.
        about: One line about the purpose of the script.
        robot: Name in the catalogue, or a path relative to the script.
        arm: Path of an arm file, relative to the script.
        seed: Random seed of the faults, the restarts and the noise of the synthetic camera.
        speed: Default speed of the moves, as a share of the speed limits.
        marker_at: Position x, y, z in metres and yaw in degrees of the printed marker. The default
            is the pose in the scene.
        physics: Whether the robot's MuJoCo model moves the simulated shafts.
        objects: Boxes on the plane z = 0. They need ``physics``.
        steps: The steps in the order of the run.
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
    def _check_objects(self) -> Script:
        names = [box.name for box in self.objects]
        if names and not self.physics:
            raise KeyProblem("objects need a world with physics", "physics", "true")
        for index, name in enumerate(names):
            if name in names[:index]:
                problem = f"the name {shown(name)} is used twice"
                raise KeyProblem(problem, f"objects[{index}].name", "a unique name for each object")
        for index, step in enumerate(self.steps):
            if not isinstance(step, ExpectStep) or step.object is None:
                continue
            if step.object not in names:
                raise KeyProblem.unknown("object", step.object, names, f"steps[{index}].object")
        return self

    @property
    def file(self) -> str:
        """File of the script. Errors name it."""
        return self._file

    def resolved(self, name: str) -> str:
        """Return a catalogue name unchanged, and a path relative to the script's folder."""
        if name in catalogue() or self._folder is None:
            return name
        return str(self._folder / Path(name).expanduser())

    def wrong(self, problem: str, key: str, allowed: str = "") -> ConfigError:
        """Return the error for a problem at a key of this script."""
        return ConfigError(problem, file=self.file, key=key, allowed=allowed)


def shipped() -> dict[str, Path]:
    """Return the files of the bundled scripts by name."""
    folder = Path(str(resources.files("robot_ik.script") / "shipped"))
    return {file.stem: file for file in sorted(folder.glob("*.toml"))}


def _script_path(name: str) -> Path:
    """Return the file of a bundled script's name or of a path."""
    path = Path(name).expanduser()
    bundled = shipped()
    if path.is_dir() and name not in bundled:
        example = next(iter(sorted(path.glob("*.toml"))), None)
        hint = "" if example is None else f"a script in it: robot-ik run {example}"
        raise ConfigError("this is a folder", file=name, allowed="one script", hint=hint)
    if path.is_file() or path.suffix or path.name != name:
        return path
    if name not in bundled:
        hint = did_you_mean(name, bundled)
        allowed = ", ".join(bundled)
        raise ConfigError("there is no such script", file=name, allowed=allowed, hint=hint)
    return bundled[name]


def load_script(path: Path | str) -> Script:
    """Read a script.

    Args:
        path: Path of a TOML file, or name of a bundled script.

    Raises:
        ConfigError: The file cannot be read or is not TOML, or a key is unknown, missing or out of
            range.
    """
    path = _script_path(str(path))
    hint = f"bundled scripts: {', '.join(shipped())}"
    return parse_script(read_text(path, "the script", hint), path)


def parse_script(text: str, file: Path | str = "<text>") -> Script:
    """Read a script from text.

    Args:
        text: The script as TOML.
        file: File that errors name. Paths in the script are relative to the folder of a ``Path``.

    Raises:
        ConfigError: The text is not TOML, or a key is unknown, missing or out of range.
    """
    script = check_table(Script, parse_toml(text, file), file)
    script._file = str(file)
    script._folder = file.parent if isinstance(file, Path) else None
    return script
