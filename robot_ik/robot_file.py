"""The robots that ship, and ``robot.toml``: what a model file cannot say."""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from robot_ik.errors import ConfigError, InvalidModelError, ModelError, UnknownRobotError, close_matches
from robot_ik.tables import Pair, Position, Positive, SchemaVersion, Several, Table, read_table

SHOWN_ROBOT = "puma560"
"""What the demonstrations move."""
SERVO_ROBOT = "tabletop_puma"
"""What stands at a servo bus where nothing else is said: X servos move it, and no real PUMA 560."""
DESCRIPTIONS = "robot_descriptions:"
"""What the name of a robot of that package begins with."""
_MODELS = {".xml", ".mjcf", ".urdf", "robot.toml"}
_WHAT_A_ROBOT_IS = (
    "a robot is a name of the catalogue, the path or text of an MJCF or URDF file, or an MjSpec or MjModel"
)


_PosQuat = Annotated[tuple[float, float, float, float, float, float, float], Field(strict=False)]


class Tool(Table):
    """A named end-effector frame: a site or a body of the model."""

    site: str | None = None
    body: str | None = None
    about: str = ""


class GalleryScene(Table):
    """What `robot-ik robots --gallery` draws beside the home pose.

    A goal is a position, or a position and a quaternion wxyz, in the world; frames of ``keep`` stay as at
    home.  ``view_deg``: azimuth (from x towards y) and elevation of the viewing direction.
    """

    about: str = "reaching"
    goals: dict[str, Position | _PosQuat] = Field(default={})
    keep: Several[str] = ()
    view_deg: Pair = (-55.0, 16.0)


class FigureParts(Table):
    """Frames that make a model a figure, by side where there are two; ``bend``: a keyframe."""

    hands: dict[str, str] = Field(default={})
    feet: dict[str, str] = Field(default={})
    gaze: str | None = None
    neck: Several[str] = ()
    pelvis: str
    trunk: str
    bend: str | None = None


class Coupled(Table):
    """A joint that follows another: joint = ratio · leader + offset, rad or m."""

    follows: str
    ratio: float
    offset: float = 0.0


class _MotionTable(Table):
    velocity_deg: Several[float] | None = None
    acceleration_deg: Several[float] | None = None
    velocity_mm: dict[str, Positive] = Field(default={})  # of slides, by name
    acceleration_mm: dict[str, Positive] = Field(default={})


class _Provenance(Table):
    sources: Several[str] = ()


class _Keys(Table):
    """Keys of ``robot.toml`` that count as they stand."""

    title: str = ""
    tool: str | None = None
    solver: str | None = None
    home: str | Several[float] | None = None
    tools: dict[str, Tool] = Field(default={})
    groups: dict[str, Several[str]] = Field(default={})
    stiffness: dict[str, Positive] = Field(default={})
    couplings: dict[str, Coupled] = Field(default={})
    figure: FigureParts | None = None
    reach: dict[str, Any] | None = None  # checked by whom it concerns: ``jobs/scene.py``
    gallery: GalleryScene | None = None


class _RobotTable(_Keys):
    version: SchemaVersion
    title: str
    model: str
    motion: _MotionTable = _MotionTable()
    speed_deg: dict[str, dict[str, Positive]] = Field(default={})
    provenance: _Provenance = _Provenance()


class RobotFile(_Keys):
    """What ``robot.toml`` says; for a bare model file everything but the name is empty.

    ``stiffness`` of joints by name: one of 4 moves half as far as one of 1 where both could serve.
    """

    name: str
    path: Path | None = None
    velocity: dict[str, float] = Field(default={})  # per joint, rad/s (m/s for slides)
    acceleration: dict[str, float] = Field(default={})  # … and rad/s²
    slides: tuple[str, ...] = ()  # joints with limits of motion in mm
    hinges: tuple[str, ...] = ()  # … and in degrees
    # Sets of joint speed limits, rad/s, by patterns of joint names; a later pattern wins.
    speeds: dict[str, dict[str, float]] = Field(default={})
    sources: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"RobotFile({self.name!r}, {self.title!r}, {self.path})"

    __str__ = __repr__


def catalogue() -> dict[str, Path]:
    """Folder of every robot that ships, by name."""
    found = importlib.util.find_spec("robot_ik.models")  # a folder of its own in a checkout
    if found is None or found.origin is None:
        raise RuntimeError("the package robot_ik.models is not installed")
    root = Path(found.origin).parent
    return {folder.name: folder for folder in sorted(root.iterdir()) if (folder / "robot.toml").is_file()}


def read_robot_file(path: Path) -> tuple[Path, RobotFile]:
    """Model file and contents of a ``robot.toml``; raises ``ConfigError`` as ``read_table``."""
    parsed = read_table(_RobotTable, path, "robot.toml")
    motion, model = parsed.motion, path.parent / parsed.model
    slides = tuple(motion.velocity_mm | motion.acceleration_mm)
    order = tuple(joint for joint in parsed.groups.get("arm", ()) if joint not in slides)
    if not model.is_file():
        beside = sorted(p.name for p in path.parent.glob("*") if p.suffix.lower() in _MODELS)
        raise ConfigError(
            f"there is no file {model}", file=path, key="model",
            allowed=f"a model file, such as {', '.join(beside)}" if beside else "an MJCF or URDF file",
        )  # fmt: skip
    return model, RobotFile(
        **{key: getattr(parsed, key) for key in _Keys.model_fields},
        name=path.resolve().parent.name,
        path=path,
        velocity=_per_joint(path, "motion.velocity_deg", motion.velocity_deg, order)
        | {joint: 1e-3 * value for joint, value in motion.velocity_mm.items()},
        acceleration=_per_joint(path, "motion.acceleration_deg", motion.acceleration_deg, order)
        | {joint: 1e-3 * value for joint, value in motion.acceleration_mm.items()},
        slides=slides,
        hinges=order if motion.velocity_deg or motion.acceleration_deg else (),
        speeds={
            name: {joint: math.radians(speed) for joint, speed in speeds.items()}
            for name, speeds in parsed.speed_deg.items()
        },
        sources=parsed.provenance.sources,
    )


def _per_joint(
    path: Path, key: str, values: tuple[float, ...] | None, joints: tuple[str, ...]
) -> dict[str, float]:
    if values is None:
        return {}
    wrong = [f"{v:g} of joint {j!r}" for j, v in zip(joints, values, strict=False) if not v > 0]
    if len(values) != len(joints) or wrong:
        allowed = "one positive number, deg/s or deg/s², for each joint of groups.arm that turns"
        problem = wrong[0] if wrong else f"{len(values)} numbers for {len(joints)} joints"
        raise ConfigError(problem, file=path, key=key, allowed=allowed)
    return {joint: math.radians(value) for joint, value in zip(joints, values, strict=True)}


def find_robot(name: str | os.PathLike[str]) -> tuple[Path, RobotFile]:
    """Model file and ``robot.toml`` contents for a catalogue name, a path or a robot_descriptions name.

    A ``robot.toml`` beside a model file counts when it names that file.  Raises as ``load_robot``;
    ``ConfigError`` where it is wrong, ``MissingExtraError`` without the package robot_descriptions.
    """
    known = catalogue()
    given: object = name
    if not isinstance(given, str | os.PathLike):
        raise InvalidModelError(f"{given!r} is no robot", hint=_WHAT_A_ROBOT_IS)
    if str(name).startswith(DESCRIPTIONS):
        from robot_ik.urdf import described_model  # which few robots need

        described = str(name).removeprefix(DESCRIPTIONS)
        return described_model(described), RobotFile(name=described)
    path = known.get(str(name)) or Path(name).expanduser()
    if path.is_dir() and (path / "robot.toml").is_file():
        path /= "robot.toml"
    if not path.is_file():
        _refuse_missing(path)
        raise UnknownRobotError(str(name), known, hint=_WHAT_A_ROBOT_IS)
    if path.name == "robot.toml":
        return read_robot_file(path)
    path = path.resolve()
    if (path.parent / "robot.toml").is_file():
        model, file = read_robot_file(path.parent / "robot.toml")
        if model.resolve() == path:
            return path, file
    return path, RobotFile(name=path.stem)


def _refuse_missing(path: Path) -> None:
    """Raises ``ModelError`` where ``path`` is meant as a path and not as a name."""
    if path.is_dir():
        hint = "name the MJCF or URDF file in it"
        raise ModelError(f"the folder {path} has no robot.toml", path=path, hint=hint)
    if len(path.parts) > 1 or path.suffix.lower() in _MODELS | {".toml"}:
        beside = [p.name for p in path.parent.glob("*") if {p.suffix.lower(), p.name} & _MODELS]
        close = close_matches(path.name, beside)
        hint = f"did you mean {path.parent / close[0]}?" if close else f"from {Path.cwd()}"
        raise ModelError(f"there is no file {path}", path=path, hint=hint)
