"""The commands of the testbed, one frozen dataclass each, and the command log.

A log is a text file with one JSON object a line: what the session began with, each command with the
tick at which it took effect, and the digest of the view at the end. It replays to the same bits.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    Self,
    dataclass_transform,
    get_args,
    get_type_hints,
)

from pydantic import Field, create_model
from pydantic.alias_generators import to_snake

from robot_ik.config import Table, Wxyz, check_table, parse_json, read_text, shown
from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.files import write_atomically

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Point = Annotated[
    tuple[Number, Number, Number], Field(strict=False, description="3 numbers within 1e6")
]
Size = Annotated[
    tuple[Length, Length, Length],
    Field(strict=False, description="3 lengths above 0 and up to 100"),
]
Index = Annotated[int, Field(ge=0, le=3)]
Name = Annotated[str, Field(max_length=200)]
Seconds = Annotated[float, Field(ge=0.0, le=3600.0)]
Count = Literal[1, 2, 4]
BallMotion = Literal["curve", "random", "hand"]
Motion = Literal["curve", "random", "hand", "joints", "timeline", "plan", "course"]
GoalKind = Literal["pose", "position", "orientation", "aim", "line", "plane", "half_space"]
ArmMode = Literal["follow", "hold", "release", "teach", "replay"]
FigureMode = Literal["off", "active", "passive"]
OptionValue = bool | int | float | Name
Option = Annotated[tuple[Name, OptionValue], Field(strict=False)]
Options = Annotated[tuple[Option, ...], Field(strict=False, max_length=40)]
Weight = Annotated[float, Field(ge=0.0, le=1000.0)]
Priority = Annotated[int, Field(ge=0, le=9)]
Shape = Literal["box", "sphere", "cylinder"]

COUNTS: tuple[Count, ...] = get_args(Count)
MOTIONS: tuple[BallMotion, ...] = get_args(BallMotion)
GOAL_KINDS: tuple[GoalKind, ...] = get_args(GoalKind)

FORMAT = 1
"""Version of a log's lines."""

RATE = 60
"""Ticks a second."""

LAST_TICK = 1 << 40
"""Largest tick of a log."""

MAX_MESH_VERTICES = 2000
"""Vertices of the convex hull of a mesh obstacle."""

LONGEST_POSES = 200_000
"""Characters of a poses file that a page may load."""


class Checked:
    """A frozen dataclass whose values are checked as those of a file that people write."""

    def __post_init__(self) -> None:
        """Check the values and convert them to the types of the fields.

        Raises:
            ConfigError: A value is not allowed.
        """
        values = check_table(_table_of(type(self)), vars(self), to_snake(type(self).__name__))
        for name, value in values:
            object.__setattr__(self, name, value)

    @classmethod
    def read(cls, values: Mapping[str, Any], file: Path | str) -> Self:
        """Return the dataclass with the values of a table.

        Raises:
            ConfigError: A key or a value is not allowed.
        """
        return cls(**dict(check_table(_table_of(cls), dict(values), file)))


_TABLES: dict[type[Any], type[Table]] = {}
"""Tables of ``_table_of`` that were made before."""


def _table_of(kind: type[Any]) -> type[Table]:
    """Return the table whose keys are the fields of a dataclass."""
    if kind in _TABLES:
        return _TABLES[kind]
    hints = get_type_hints(kind, include_extras=True)
    keys: dict[str, Any] = {
        item.name: (hints[item.name], ... if item.default is MISSING else item.default)
        for item in fields(kind)
    }
    _TABLES[kind] = create_model(kind.__name__, __base__=Table, **keys)
    return _TABLES[kind]


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Command(Checked):
    """A command of a user. Every subclass is a frozen dataclass."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    @classmethod
    def key(cls) -> str:
        """Return its name in a log: ``SetMethod`` is ``set_method``."""
        return to_snake(cls.__name__)


class SetupCommand(Command):
    """A command that changes what is solved, so that kernels may have to be compiled.

    The session prepares it beside the loop and takes it when it is ready.
    """


class SetRobot(SetupCommand):
    """Show another robot: a name of the catalogue or the path of a model."""

    name: Annotated[str, Field(max_length=4096)]


class SetCount(SetupCommand):
    """Show one robot, or two or four side by side."""

    count: Count


class SetMethod(SetupCommand):
    """Give one instance a method. Options that are not named have their defaults."""

    instance: Index
    method: Name
    options: Options = ()


class SetOption(SetupCommand):
    """Set one option of an instance's method."""

    instance: Index
    name: Name
    value: OptionValue


class SetGoalKind(SetupCommand):
    """Set what the ball asks of the tool."""

    kind: GoalKind


class SetExtraGoal(SetupCommand):
    """Switch a goal beside the ball's on or off and set its weight and priority."""

    name: Name
    on: bool
    priority: Priority = 0
    """Goals of priority 0 are met first."""
    weight: Weight = 1.0
    """Against goals of the same priority; 0 ignores the goal."""


class SetLimits(SetupCommand):
    """Switch the joint limits of one instance on or off, or of all without an instance."""

    on: bool
    instance: Index | None = None


class SetTool(SetupCommand):
    """Let another frame follow the ball, such as a paw. The other goals become the default ones."""

    frame: Name


class SetBase(SetupCommand):
    """Let only the joints between a frame and the tool move. Empty: all joints move."""

    frame: Name = ""


class SetPin(SetupCommand):
    """Pin a frame to a place in the world. A second pin of a frame replaces the first."""

    frame: Name
    position: Point
    wxyz: Wxyz | None = None
    """Orientation that is kept, too. None: the frame may turn."""
    weight: Weight = 1.0
    priority: Priority = 0


class RemovePin(SetupCommand):
    """Remove the pin of a frame."""

    frame: Name


class SetStiffness(SetupCommand):
    """Set the cost of moving a joint; 1 is usual. A stiffer joint moves less."""

    joint: Name
    value: Annotated[float, Field(ge=0.01, le=100.0)]


class SetCourse(SetupCommand):
    """Show a test course of thesis A00: a chain whose goal makes a step in each frame."""

    number: Annotated[int, Field(ge=1, le=13)]


class ShowBranches(SetupCommand):
    """Show all branches of a closed form as ghosts, or none."""

    on: bool


class SetFigure(SetupCommand):
    """Let a figure decide by itself.

    Active: it follows the ball. Passive: it acts on demand. Off: its method solves.
    """

    mode: FigureMode


class SetMotion(Command):
    """Set how the ball moves."""

    motion: BallMotion


class SetPace(Command):
    """Set how long the ball stays at each random position; 0 moves it in every frame."""

    seconds: Annotated[float, Field(ge=0.0, le=60.0)]


class SetRunning(Command):
    """Run the session, or hold all robots still. False is STOP."""

    running: bool


class SetSpeed(Command):
    """Set the speed of the ball; 1 is real time."""

    speed: Annotated[float, Field(ge=0.0, le=3.0)]


class SetBudget(Command):
    """Limit the solves of one instance."""

    instance: Index
    iterations: Annotated[int, Field(ge=1, le=10_000)] = 200
    distance: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-4
    """Metres between tool and ball at which a solve counts as a success."""


class SetRestarts(Command):
    """Let methods restart at random joint angles while the ball is at random places, or not."""

    on: bool


class MoveGoal(Command):
    """Move the ball to a position (metres, world). It keeps its orientation if none is given."""

    position: Point
    wxyz: Wxyz | None = None


class Nudge(Command):
    """Move the ball by a step (metres, world)."""

    step: Point


class SetJoint(Command):
    """Set one joint of the first instance. The ball moves to the tool (forward kinematics)."""

    joint: Name
    value: Number
    """Radians of a hinge, metres of a slide."""


class DragLink(Command):
    """Let a grabbed point of a body follow the mouse.

    ``grip`` is the point in the body's own frame, ``to`` where it should be, world, metres.
    """

    instance: Index
    body: Name
    grip: Point
    to: Point


class Release(Command):
    """End the drag of a body. The ball goes to the tool."""


class Reset(Command):
    """Put robots and ball back to their starts and empty the statistics."""


class PickBranch(Command):
    """Put the first instance to a branch, from which it continues."""

    index: Annotated[int, Field(ge=0, le=63)]


class Act(Command):
    """Let a passive figure act on the ball where it is now."""


class SetArm(Command):
    """Set what the servo arm does.

    It follows the first instance, holds, has no torque, records a hand, or repeats the recording.
    """

    state: ArmMode


class RecordPose(Command):
    """Append the present pose to the timeline."""


class RemovePose(Command):
    """Remove a key pose from the timeline."""

    index: Annotated[int, Field(ge=0, le=999)]


class MovePose(Command):
    """Move a key pose to another time. Key poses are in the order of their times."""

    index: Annotated[int, Field(ge=0, le=999)]
    time: Seconds


class Scrub(Command):
    """Show the timeline at a time in seconds. Nothing is solved."""

    time: Seconds


class PlayTimeline(Command):
    """Play the timeline from its present time, or stop there. Nothing is solved."""

    playing: bool


class LoadPoses(Command):
    """Replace the timeline by the poses of a TOML text."""

    text: Annotated[str, Field(max_length=LONGEST_POSES)]


class AddObstacle(Command):
    """Add an obstacle beside the robot."""

    shape: Shape


class AddMesh(Command):
    """Add the convex hull of points (metres, frame of the obstacle) as an obstacle."""

    name: Annotated[str, Field(min_length=1, max_length=60)]
    vertices: Annotated[
        tuple[Point, ...], Field(strict=False, min_length=4, max_length=MAX_MESH_VERTICES)
    ]


class ResizeObstacle(Command):
    """Give the box around an obstacle other edge lengths (metres, frame of the obstacle).

    A sphere takes its diameter from the first length, a cylinder its diameter from the first and
    its height from the third.
    """

    index: Annotated[int, Field(ge=0, le=31)]
    size: Size


class MoveObstacle(Command):
    """Move an obstacle to a position (metres, world)."""

    index: Annotated[int, Field(ge=0, le=31)]
    position: Point


class RemoveObstacle(Command):
    """Remove an obstacle."""

    index: Annotated[int, Field(ge=0, le=31)]


class MarkPlanStart(Command):
    """Let planned motions start at the present posture of the first instance."""


class PlanMotion(Command):
    """Plan a motion of the first instance around the obstacles, to where the ball is.

    Without values the session takes the marked start and the ball. A log has the values, because
    the plan takes effect later than its command.
    """

    start: Annotated[tuple[Number, ...], Field(strict=False, max_length=1000)] = ()
    """Joint angles (nq,), rad or m."""
    position: Point | None = None
    wxyz: Wxyz | None = None


class PlayPlan(Command):
    """Play the planned motion from its present time, or stop there."""

    playing: bool


class ScrubPlan(Command):
    """Show the planned motion at a time in seconds."""

    time: Seconds


class RemovePlan(Command):
    """Remove the planned motion."""


COMMANDS: dict[str, type[Command]] = {
    kind.key(): kind
    for kind in (*SetupCommand.__subclasses__(), *Command.__subclasses__())
    if kind is not SetupCommand
}
"""Every command by its name in a log."""


def command_from(values: Mapping[str, Any], file: Path | str) -> Command:
    """Return the command of ``{"command": name, …}``.

    Raises:
        ConfigError: There is no such command, or it does not take a value.
    """
    arguments = dict(values)
    name = str(arguments.pop("command", ""))
    if name not in COMMANDS:
        raise ConfigError(
            f"there is no command {shown(name)}",
            file=file,
            key="command",
            allowed=", ".join(COMMANDS),
            hint=did_you_mean(name, COMMANDS),
        )
    return COMMANDS[name].read(arguments, file)


@dataclass(frozen=True)
class Start(Checked):
    """What a session begins with.

    Attributes:
        robot: A name of the catalogue or the path of a model.
        count: Instances side by side.
        methods: One for each instance. Empty for the usual ones.
        seed: Of the ball's random positions.
        tool: Frame that follows the ball. Empty for that of the model.
        base: Frame that carries the joints that move. Empty: all joints move.
        joints: Names of the joints that move. Empty: all.

    Raises:
        ConfigError: A value is not allowed.
    """

    robot: str = "puma560"
    count: Count = 1
    methods: Annotated[tuple[str, ...], Field(strict=False, max_length=4)] = ()
    seed: Annotated[int, Field(ge=0, le=1 << 62)] = 1
    tool: Name = ""
    base: Name = ""
    joints: Annotated[tuple[Name, ...], Field(strict=False, max_length=1000)] = ()


@dataclass(frozen=True)
class CommandLog:
    """The commands of a session. With the start they determine all its views.

    Attributes:
        start: What it began with.
        commands: Commands and the ticks before which they took effect, in order.
        ticks: Number of ticks that it ran. 0: unknown.
        digest: Digest of its last view. Empty: unknown.
    """

    start: Start
    commands: tuple[tuple[int, Command], ...]
    ticks: int = 0
    digest: str = ""

    def save(self, path: Path) -> None:
        """Write the file. It replaces an older one.

        Raises:
            OutputError: The file cannot be written.
        """
        write_atomically(path, self.text())

    def text(self) -> str:
        """Return the content of the file."""
        rows: list[dict[str, Any]] = [{"testbed_log": FORMAT, **asdict(self.start)}]
        for tick, command in self.commands:
            rows.append({"tick": tick, "command": command.key(), **asdict(command)})
        if self.ticks or self.digest:
            rows.append({"end": self.ticks, "digest": self.digest})
        return "".join(json.dumps(row) + "\n" for row in rows)

    @classmethod
    def load(cls, path: Path) -> CommandLog:
        """Read the file.

        Raises:
            ConfigError: With file, line and what is allowed.
        """
        return cls.parse(read_text(path, "command log").splitlines(), path)

    @classmethod
    def parse(cls, lines: Sequence[str], file: Path | str) -> CommandLog:
        """Read the lines of a file. Errors as for ``load``."""
        rows: list[tuple[str, dict[str, Any]]] = []
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            place = f"{file}:{number}"
            row = parse_json(line, place)
            if not isinstance(row, dict):
                raise ConfigError("not an object", file=place, allowed="one JSON object a line")
            rows.append((place, row))
        start = _start_of(rows, file)

        commands: list[tuple[int, Command]] = []
        ticks = 0
        digest = ""
        for place, row in rows[1:]:
            first_tick = commands[-1][0] if commands else 0
            if "end" in row:
                ticks = _checked_tick(row["end"], first_tick, place)
                digest = str(row.get("digest", ""))
            else:
                arguments = dict(row)
                tick = _checked_tick(arguments.pop("tick", None), first_tick, place)
                commands.append((tick, command_from(arguments, place)))
        return cls(start, tuple(commands), ticks, digest)


def _start_of(rows: Sequence[tuple[str, dict[str, Any]]], file: Path | str) -> Start:
    """Return the start of a session from the first line of its log."""
    first = dict(rows[0][1]) if rows else {}
    if first.pop("testbed_log", None) != FORMAT:
        raise ConfigError(
            "the first line is not that of a command log",
            file=file,
            key="testbed_log",
            allowed=f"{FORMAT}, as robot-ik view --log FILE writes it",
        )
    return Start.read(first, file)


def _checked_tick(tick: Any, first_tick: int, place: str) -> int:
    """Return a tick that is not before the last command's."""
    is_whole = isinstance(tick, int) and not isinstance(tick, bool)
    if not is_whole or not first_tick <= tick < LAST_TICK:
        allowed = f"whole numbers from {first_tick}"
        raise ConfigError(f"{tick!r} is not a tick", file=place, key="tick", allowed=allowed)
    return int(tick)
