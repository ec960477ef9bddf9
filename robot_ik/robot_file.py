"""``robot.toml``, with data that a model file cannot hold, and the catalogue of bundled robots."""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path
from typing import Any

from pydantic import Field

from robot_ik.config import Positive, SchemaVersion, Several, Table, read_table
from robot_ik.errors import (
    ConfigError,
    InvalidModelError,
    ModelError,
    UnknownRobotError,
    close_matches,
)

SHOWN_ROBOT = "puma560"
"""Default robot of the demonstrations."""

SERVO_ROBOT = "tabletop_puma"
"""Default robot of the commands with servos: X servos move it. A real PUMA 560 has no servo bus."""

CHAIN = "chain:"
"""Prefix of the name of a chain of ball joints; the number of links follows."""

LONGEST_CHAIN = 500
"""Links of a chain. MuJoCo's compile time grows with the cube of the links: 10 s for 400."""

DESCRIPTIONS = "robot_descriptions:"
"""Prefix of the name of a robot in the package robot_descriptions."""

_CHAIN_SIDE = 0.45
"""Horizontal distance of the first ball of a chain, as a share of its length: it can be reached."""

_CHAIN_HEIGHT = 0.45
"""Height of that ball, as a share of the length of the chain."""

_MODEL_SUFFIXES = {".xml", ".mjcf", ".urdf", "robot.toml"}
_EXPECTED = (
    "a robot is a name of the catalogue, the path or text of an MJCF or URDF file, "
    "or an MjSpec or MjModel"
)


class Tool(Table):
    """A named end-effector frame: a site or a body of the model."""

    site: str | None = None
    body: str | None = None
    about: str = ""


class Coupled(Table):
    """A joint that follows another joint: value = ratio · leader + offset, rad or m."""

    follows: str
    ratio: float
    offset: float = 0.0


class _MotionTable(Table):
    velocity_deg: Several[float] | None = None
    acceleration_deg: Several[float] | None = None
    velocity_mm: dict[str, Positive] = Field(default={})  # slides by name
    acceleration_mm: dict[str, Positive] = Field(default={})


class _Provenance(Table):
    sources: Several[str] = ()


class _Keys(Table):
    """Keys of ``robot.toml`` that ``RobotFile`` has unchanged."""

    title: str = ""
    tool: str | None = None
    solver: str | None = None
    home: str | Several[float] | None = None
    tools: dict[str, Tool] = Field(default={})
    groups: dict[str, Several[str]] = Field(default={})
    stiffness: dict[str, Positive] = Field(default={})
    couplings: dict[str, Coupled] = Field(default={})
    keep: Several[str] = ()
    figure: dict[str, Any] | None = None  # figure/parts.py checks it
    reach: dict[str, Any] | None = None  # workcell/scene.py checks it
    gallery: dict[str, Any] | None = None  # testbed/gallery_scene.py checks it


class _RobotTable(_Keys):
    version: SchemaVersion
    title: str
    model: str
    motion: _MotionTable = _MotionTable()
    speed_deg: dict[str, dict[str, Positive]] = Field(default={})
    optional_limits_deg: dict[str, Positive] = Field(default={})
    provenance: _Provenance = _Provenance()


class RobotFile(_Keys):
    """Content of a ``robot.toml``. For a model file without one, only the name is set.

    Attributes:
        name: Name of the robot.
        path: The file, None without one.
        velocity_limits: Speed limits by joint, rad/s or m/s.
        acceleration_limits: Acceleration limits by joint, rad/s² or m/s².
        slides: Joints whose limits are written in millimetres.
        hinges: Joints whose limits are written in degrees.
        speeds: Sets of speed limits, rad/s, by patterns of joint names. A later pattern has
            priority.
        sources: Sources of the numbers.
        stiffness: Stiffness by joint. A joint of stiffness 4 moves half as far as a joint of
            stiffness 1 where both have the same effect.
        keep: Frames that stay at their home poses unless other goals are given: the feet.
        optional_limits: Limits in radians to both sides of zero, by patterns of joint names, that
            hold only on request.
    """

    name: str
    path: Path | None = None
    velocity_limits: dict[str, float] = Field(default={})
    acceleration_limits: dict[str, float] = Field(default={})
    slides: tuple[str, ...] = ()
    hinges: tuple[str, ...] = ()
    speeds: dict[str, dict[str, float]] = Field(default={})
    sources: tuple[str, ...] = ()
    optional_limits: dict[str, float] = Field(default={})

    def __repr__(self) -> str:
        return f"RobotFile({self.name!r}, {self.title!r}, {self.path})"

    __str__ = __repr__


def catalogue() -> dict[str, Path]:
    """Return the folders of the bundled robots by name."""
    package = importlib.util.find_spec("robot_ik.models")  # in a checkout it is another folder
    if package is None or package.origin is None:
        raise RuntimeError("the package robot_ik.models is not installed")
    root = Path(package.origin).parent
    folders = [path for path in sorted(root.iterdir()) if (path / "robot.toml").is_file()]
    return {folder.name: folder for folder in folders}


def read_robot_file(path: Path) -> tuple[Path, RobotFile]:
    """Return the model file and the content of a ``robot.toml``.

    Raises:
        ConfigError: A key is wrong, or there is no such model file.
    """
    table = read_table(_RobotTable, path, "robot.toml")
    motion = table.motion
    model = path.parent / table.model
    if not model.is_file():
        models = _models_in(path.parent)
        allowed = f"a model file, such as {', '.join(models)}" if models else "an MJCF or URDF file"
        raise ConfigError(f"there is no file {model}", file=path, key="model", allowed=allowed)
    slides = tuple(motion.velocity_mm | motion.acceleration_mm)
    hinges = tuple(joint for joint in table.groups.get("arm", ()) if joint not in slides)
    velocity = _radians_by_joint(path, "motion.velocity_deg", motion.velocity_deg, hinges)
    velocity |= {joint: 1e-3 * value for joint, value in motion.velocity_mm.items()}
    acceleration = _radians_by_joint(
        path, "motion.acceleration_deg", motion.acceleration_deg, hinges
    )
    acceleration |= {joint: 1e-3 * value for joint, value in motion.acceleration_mm.items()}
    speeds = {
        name: {pattern: math.radians(speed) for pattern, speed in rows.items()}
        for name, rows in table.speed_deg.items()
    }
    file = RobotFile(
        **{key: getattr(table, key) for key in _Keys.model_fields},
        name=path.resolve().parent.name,
        path=path,
        velocity_limits=velocity,
        acceleration_limits=acceleration,
        slides=slides,
        hinges=hinges if motion.velocity_deg or motion.acceleration_deg else (),
        speeds=speeds,
        optional_limits={
            pattern: math.radians(width) for pattern, width in table.optional_limits_deg.items()
        },
        sources=table.provenance.sources,
    )
    return model, file


def _radians_by_joint(
    path: Path, key: str, degrees: tuple[float, ...] | None, joints: tuple[str, ...]
) -> dict[str, float]:
    """Return limits in rad/s or rad/s² by joint, or raise ``ConfigError``."""
    if degrees is None:
        return {}
    pairs = list(zip(joints, degrees, strict=False))
    problem = ""
    if len(degrees) != len(joints):
        problem = f"{len(degrees)} numbers for {len(joints)} joints"
    for joint, value in pairs:
        if not value > 0:
            problem = f"{value:g} of joint {joint!r}"
            break
    if problem:
        allowed = "one positive number, deg/s or deg/s², for each joint of groups.arm that turns"
        raise ConfigError(problem, file=path, key=key, allowed=allowed)
    return {joint: math.radians(value) for joint, value in pairs}


def _models_in(folder: Path) -> list[str]:
    """Return the names of the model files and of robot.toml in a folder."""
    names = sorted(path.name for path in folder.glob("*"))
    return [name for name in names if {Path(name).suffix.lower(), name} & _MODEL_SUFFIXES]


def find_robot(name: str | os.PathLike[str]) -> tuple[Path, RobotFile]:
    """Return the model file and ``robot.toml`` of a robot.

    A ``robot.toml`` beside a model file counts if it names this file. The path of a chain is not a
    file.

    Args:
        name: A catalogue name, a path, ``chain:5``, or a name of the package robot_descriptions.

    Raises:
        UnknownRobotError: There is no such robot.
        InvalidModelError: A chain cannot have so many links.
        ModelError: There is no such file.
        ConfigError: A key of robot.toml is wrong.
        MissingExtraError: The package robot_descriptions is not installed.
    """
    known = catalogue()
    given: object = name
    if not isinstance(given, str | os.PathLike):
        raise InvalidModelError(f"{given!r} is not a robot", hint=_EXPECTED)
    if str(name).startswith(CHAIN):
        links = chain_links(str(name))
        return Path(f"<memory>/chain{links}"), _chain_file(links)
    if str(name).startswith(DESCRIPTIONS):
        from robot_ik.urdf import described_model  # imported here: it takes 6 ms, rarely needed

        description = str(name).removeprefix(DESCRIPTIONS)
        return described_model(description), RobotFile(name=description)
    path = known.get(str(name)) or Path(name).expanduser()
    if path.is_dir() and (path / "robot.toml").is_file():
        path /= "robot.toml"
    if not path.is_file():
        _refuse_missing_file(path)
        raise UnknownRobotError(str(name), known, hint=_EXPECTED)
    if path.name == "robot.toml":
        return read_robot_file(path)
    path = path.resolve()
    if (path.parent / "robot.toml").is_file():
        model, file = read_robot_file(path.parent / "robot.toml")
        if model.resolve() == path:
            return path, file
    return path, RobotFile(name=path.stem)


def chain_links(name: str) -> int:
    """Return the number of links of ``chain:5``.

    Raises:
        InvalidModelError: It is not a number from 1 to ``LONGEST_CHAIN``.
    """
    text = name.removeprefix(CHAIN)
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= LONGEST_CHAIN):
        raise InvalidModelError(
            f"a chain has 1 to {LONGEST_CHAIN} links, not {text!r}",
            hint=f"for example {CHAIN}5",
        )
    return int(text)


def _chain_file(links: int) -> RobotFile:
    """Return the ``RobotFile`` of a chain of links of 1 m, which has no ``robot.toml``."""
    ball = [_CHAIN_SIDE * links, 0.0, _CHAIN_HEIGHT * links]
    return RobotFile(
        name=f"chain{links}",
        title=f"Chain of {links} ball joints, links of 1 m",
        tool="tip",
        gallery={"about": "bent to one side", "goals": {"tip": ball}},
    )


def _refuse_missing_file(path: Path) -> None:
    """Raise ``ModelError`` if ``path`` looks like a path and not like a name."""
    if path.is_dir():
        hint = "name the MJCF or URDF file in it"
        raise ModelError(f"the folder {path} has no robot.toml", path=path, hint=hint)
    if len(path.parts) > 1 or path.suffix.lower() in _MODEL_SUFFIXES | {".toml"}:
        close = close_matches(path.name, _models_in(path.parent))
        hint = f"did you mean {path.parent / close[0]}?" if close else f"from {Path.cwd()}"
        raise ModelError(f"there is no file {path}", path=path, hint=hint)
