"""Actions of a page: requests that are not session commands and not in the command log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, dataclass_transform

from pydantic import Field
from pydantic.alias_generators import to_snake

from robot_ik.config import shown
from robot_ik.errors import ConfigError
from robot_ik.testbed.ar.setup import LONGEST_DELAY, ArBall, Sync
from robot_ik.testbed.commands import Checked

ArPlace = Literal["whole", "corner"]
"""Where the pictures of augmented reality are: over the whole 3D view, or in its corner."""

ReachPicture = Literal["none", "space", "cloud", "shell"]
"""What is shown of the space that the tool reaches, see ``ShowReach``."""

LONGEST_MESH = 950_000
"""Base64 characters of a mesh file: some 700 kB."""

_Path = Annotated[str, Field(max_length=4096)]
_Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Action(Checked):
    """A request of a page. Every subclass is a frozen dataclass.

    Attributes:
        for_all: Whether a page that only watches may send it.
    """

    for_all: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    @classmethod
    def key(cls) -> str:
        """Return its name in a message: ``SetTheme`` is ``set_theme``."""
        return to_snake(cls.__name__)


class PressKey(Action):
    """Execute the command of a key."""

    code: Annotated[str, Field(max_length=40)]


class SetTheme(Action):
    """Use dark or light colours on all pages."""

    dark: bool


class ShowOverlay(Action):
    """Show trails and labels over the scene, or none."""

    on: bool


class ShowHandles(Action):
    """Show the arrows that move the ball along one axis, or none."""

    on: bool


class ShowTurnHandles(Action):
    """Show the arcs that turn the ball's pose, or none."""

    on: bool


class ShowToolFrames(Action):
    """Show the tool's frame of each instance, or none."""

    on: bool


class ShowReach(Action):
    """Show where the tool can be.

    ``space`` is the surface of the space that the tool reaches. ``cloud`` and ``shell`` are a
    reachability map, which is computed among the present obstacles.
    """

    picture: ReachPicture


class ShowRegions(Action):
    """Show where a figure reaches, bends and jumps, or none."""

    on: bool


class ShowCube(Action):
    """Show the test environment of thesis A00: a cube with projections of ball and tool."""

    on: bool


class PickPart(Action):
    """Let the next click on a part of the robot choose it. Off ends that."""

    role: Literal["tool", "base", "pin", "off"]


class PinFrame(Action):
    """Pin a frame of the first instance where it is."""

    frame: Annotated[str, Field(max_length=200)]
    turns: bool = True
    """Whether the frame may turn about its place."""


class RunCases(Action):
    """Run the four cases of table 4.1 of thesis S12."""

    frames: Annotated[int, Field(ge=60, le=1000)] = 1000


class ShowCamera(Action):
    """Take pictures of the camera, or none."""

    on: bool


class ShowWire(Action):
    """Draw robots as wire, or solid."""

    on: bool


class BeginPreset(Action):
    """Begin a preset: the program of a thesis."""

    name: Annotated[str, Field(max_length=40)]


class ShowAr(Action):
    """Draw robot 1 into the pictures of a camera, or take no pictures."""

    on: bool


class PlaceAr(Action):
    """Show these pictures over the whole 3D view, or in its corner."""

    place: ArPlace


class SetArCamera(Action):
    """Choose the camera, its calibration, and the board that the robot stands on."""

    camera: _Path
    intrinsics: _Path
    board: _Path
    dictionary: Annotated[str, Field(max_length=40)] = ""


class SetArBall(Action):
    """Let keys and mouse move the ball, or a marker beside the board."""

    ball: ArBall
    marker: Annotated[int, Field(ge=0, le=1023)]
    marker_size: Annotated[float, Field(ge=0.005, le=1.0)]
    """Side of the marker's black square, metres."""


class SetArDelay(Action):
    """Delay the tracker, and choose the measures against the delay."""

    seconds: Annotated[float, Field(ge=0.0, le=LONGEST_DELAY)]
    sync: Sync
    predict: bool
    shift: bool


class DragArBall(Action):
    """Drag the ball to a pixel of the picture."""

    u: _Pixel
    v: _Pixel
    begins: bool = False
    """Whether the mouse was pressed here. A press near the ball grabs the ball."""


class HandOver(Action):
    """Let the next page that acts drive."""


class FitCamera(Action):
    """Put the camera of this page back to its first place."""

    for_all = True


class ReportGraphics(Action):
    """Report whether this browser draws without a GPU."""

    for_all = True
    software: bool


class LoadMesh(Action):
    """Add the convex hull of a mesh file as an obstacle. Its lengths are metres."""

    file: Annotated[str, Field(max_length=200)]
    base64: Annotated[str, Field(max_length=LONGEST_MESH)]


class SaveLog(Action):
    """Save the command log as a file of this browser."""

    for_all = True


class SaveRecording(Action):
    """Save the arm's recording as a file of this browser."""

    for_all = True


class SavePoses(Action):
    """Save the timeline as ``poses.toml``, a file of this browser."""

    for_all = True


class SaveMotion(Action):
    """Save the timeline's motion as CSV or BVH, a file of this browser."""

    for_all = True
    format: Annotated[str, Field(pattern="^(csv|bvh)$")]


class ShareMotion(Action):
    """Save the scene and the timeline's motion as one HTML file of this browser."""

    for_all = True


class FilmSession(Action):
    """Film the command log as a file of this browser."""

    for_all = True


ACTIONS: dict[str, type[Action]] = {kind.key(): kind for kind in Action.__subclasses__()}
"""Every action by its name in a message."""


def action_from(values: Mapping[str, Any], place: str) -> Action:
    """Return the action of ``{"action": name, …}``.

    Raises:
        ConfigError: There is no such action, or it does not take a value.
    """
    arguments = dict(values)
    name = str(arguments.pop("action", ""))
    if name not in ACTIONS:
        problem = f"there is no action {shown(name)}"
        raise ConfigError(problem, file=place, key="action", allowed=", ".join(ACTIONS))
    return ACTIONS[name].read(arguments, place)
