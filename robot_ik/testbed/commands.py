"""What people ask of the testbed: one frozen dataclass a command, and the log that keeps them.

A log is a text file, one JSON object a line: what the session began with, each command with the tick at
which it took effect, and the digest of the view at the end.  It replays to the same bits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, dataclass_transform, get_args

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.alias_generators import to_snake

import robot_ik as rik
from robot_ik.config import Wxyz, config_error, keys_of, parse_json, read_text, shown
from robot_ik.errors import ConfigError, did_you_mean
from robot_ik.files import write_atomically

if TYPE_CHECKING:
    from robot_ik.testbed.session import View

_Value = TypeVar("_Value")
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Point = Annotated[tuple[Number, Number, Number], Field(strict=False, description="3 numbers within 1e6")]
Index = Annotated[int, Field(ge=0, le=3)]
Count = Literal[1, 2, 4]
Motion = Literal["curve", "random", "hand"]
GoalKind = Literal["pose", "position", "aim", "line", "plane"]
ArmMode = Literal["follow", "hold", "release", "teach", "replay"]

COUNTS: tuple[Count, ...] = get_args(Count)
MOTIONS: tuple[Motion, ...] = get_args(Motion)
GOAL_KINDS: tuple[GoalKind, ...] = get_args(GoalKind)
FORMAT = 1
RATE = 60
"""Ticks a second."""


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Command:
    """Something that a person asked for: a frozen dataclass, as every subclass; a log holds its fields."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    @classmethod
    def key(cls) -> str:
        """Its name in a log: ``SetMethod`` is ``set_method``."""
        return to_snake(cls.__name__)


class SetupCommand(Command):
    """A command that changes what is solved, so that kernels may have to be compiled.

    The session prepares it beside the loop and takes it when it is ready.
    """


class SetRobot(SetupCommand):
    """Another robot: a name of the catalogue or the path of a model."""

    name: Annotated[str, Field(max_length=4096)]


class SetCount(SetupCommand):
    """One robot, or two or four side by side."""

    count: Count


class SetMethod(SetupCommand):
    """The method of one instance, with its default options."""

    instance: Index
    method: Annotated[str, Field(max_length=100)]


class SetOption(SetupCommand):
    """One option of an instance's method."""

    instance: Index
    name: Annotated[str, Field(max_length=100)]
    value: bool | int | float | Annotated[str, Field(max_length=100)]


class SetGoalKind(SetupCommand):
    """What the ball asks of the tool."""

    kind: GoalKind


class SetExtraGoal(SetupCommand):
    """A goal beside the ball's on or off, and its priority: 0 is served first."""

    name: Annotated[str, Field(max_length=100)]
    on: bool
    priority: Annotated[int, Field(ge=0, le=9)] = 0


class SetLimits(SetupCommand):
    """Joint limits on or off."""

    on: bool


class SetMotion(Command):
    """How the ball moves."""

    motion: Motion


class SetRunning(Command):
    """Goes on, or holds still."""

    running: bool


class SetSpeed(Command):
    """Speed of the ball: 1 is real time."""

    speed: Annotated[float, Field(ge=0.0, le=3.0)]


class MoveGoal(Command):
    """The ball to a position (metres, world), oriented as before or as given; it then moves by hand."""

    position: Point
    wxyz: Wxyz | None = None


class Nudge(Command):
    """The ball by a step (metres, world)."""

    step: Point


class DragLink(Command):
    """A grabbed point of a body follows the mouse.

    ``grip`` is the point in the body's own frame, ``to`` where it should be, world, metres.
    """

    instance: Index
    body: Annotated[str, Field(max_length=200)]
    grip: Point
    to: Point


class Release(Command):
    """The grabbed body is let go; the ball goes to where the tool is now."""


class Reset(Command):
    """Robots home, ball on the curve, statistics empty."""


class ShowBranches(SetupCommand):
    """All branches of a closed form as ghosts, on or off."""

    on: bool


class PickBranch(Command):
    """The first instance goes on from the branch of that number."""

    index: Annotated[int, Field(ge=0, le=63)]


class SetFigure(SetupCommand):
    """A figure decides by itself: it follows the ball (active), acts on demand (passive), or not."""

    mode: Literal["off", "active", "passive"]


class Act(Command):
    """A passive figure acts on the ball where it is now."""


class SetArm(Command):
    """The servo arm: follow the first instance, hold, let go (torque off), record a hand, or repeat that."""

    state: ArmMode


COMMANDS: dict[str, type[Command]] = {
    kind.key(): kind
    for kind in (*SetupCommand.__subclasses__(), *Command.__subclasses__())
    if kind is not SetupCommand
}
"""Every command by its name in a log."""
_CHECKED: dict[type[Any], TypeAdapter[Any]] = {}


def _checked(made: type[Any], values: Mapping[str, Any], file: Path | str) -> Any:
    """A dataclass of values whose names and types are checked as those of any file that people write."""
    checked = _CHECKED.setdefault(made, TypeAdapter(Annotated[Any, keys_of(made)]))
    try:
        return checked.validate_python(dict(values))
    except ValidationError as error:
        raise config_error(error, file) from None


def command_from(values: Mapping[str, Any], file: Path | str) -> Command:
    """The command of ``{"command": name, …}``.

    Raises:
        ConfigError: No such command, or a value that it does not take.
    """
    rest = dict(values)
    name = str(rest.pop("command", ""))
    if name not in COMMANDS:
        raise ConfigError(
            f"there is no command {shown(name)}",
            file=file, key="command", allowed=", ".join(COMMANDS), hint=did_you_mean(name, COMMANDS),
        )  # fmt: skip
    command: Command = _checked(COMMANDS[name], rest, file)
    return command


def checked_command(command: Command) -> Command:
    """The command with its values checked as those of a file are, or ``ConfigError``."""
    return command_from({"command": command.key(), **asdict(command)}, "command")


@dataclass(frozen=True)
class Start:
    """What a session begins with."""

    robot: str = "puma560"  # a name of the catalogue or the path of a model
    count: Count = 1  # instances side by side
    # One for each instance; empty: the usual ones.
    methods: Annotated[tuple[str, ...], Field(strict=False, max_length=4)] = ()
    seed: Annotated[int, Field(ge=0, le=1 << 62)] = 1  # of the ball's random positions


def checked_start(start: Start) -> Start:
    """What a session begins with, checked as the first line of a log is, or ``ConfigError``."""
    made: Start = _checked(Start, asdict(start), "start")
    return made


@dataclass(frozen=True)
class CommandLog:
    """Everything that decides what a session does."""

    start: Start  # what it began with
    commands: tuple[tuple[int, Command], ...]  # which took effect before which tick, in order
    ticks: int = 0  # how many it ran; 0 when the file does not say
    digest: str = ""  # of its last view; empty when the file does not say

    def save(self, path: Path) -> None:
        """Writes the file, or raises ``OutputError``; what was there is replaced."""
        write_atomically(path, self.text())

    def text(self) -> str:
        """The file's contents."""
        rows: list[dict[str, Any]] = [{"testbed_log": FORMAT, **asdict(self.start)}]
        rows += [{"tick": tick, "command": one.key(), **asdict(one)} for tick, one in self.commands]
        if self.ticks or self.digest:
            rows.append({"end": self.ticks, "digest": self.digest})
        return "".join(json.dumps(row) + "\n" for row in rows)

    @classmethod
    def load(cls, path: Path) -> CommandLog:
        """Reads the file.

        Raises:
            ConfigError: With file, line and what is allowed.
        """
        return cls.parse(read_text(path, "command log").splitlines(), path)

    @classmethod
    def parse(cls, lines: Sequence[str], file: Path | str) -> CommandLog:
        """As ``load``, of the file's lines."""
        rows = [(k, parse_json(line, f"{file}:{k}")) for k, line in enumerate(lines, 1) if line.strip()]
        for k, row in rows:
            if not isinstance(row, dict):
                raise ConfigError("not an object", file=f"{file}:{k}", allowed="one JSON object a line")
        first = dict(rows[0][1]) if rows else {}
        if first.pop("testbed_log", None) != FORMAT:
            raise ConfigError(
                "the first line is not that of a command log",
                file=file, key="testbed_log", allowed=f"{FORMAT}, as robot-ik view --log FILE writes it",
            )  # fmt: skip
        start: Start = _checked(Start, first, file)
        commands: list[tuple[int, Command]] = []
        ticks, digest = 0, ""
        for k, row in rows[1:]:
            here, values = f"{file}:{k}", dict(row)
            tick = values.pop("end" if "end" in values else "tick", None)
            last = commands[-1][0] if commands else 0
            if not isinstance(tick, int) or isinstance(tick, bool) or not last <= tick < 1 << 40:
                raise ConfigError(
                    f"{tick!r} is no tick", file=here, key="tick", allowed=f"whole numbers from {last}"
                )
            if "end" in row:
                ticks, digest = tick, str(values.get("digest", ""))
            else:
                commands.append((tick, command_from(values, here)))
        return cls(start, tuple(commands), ticks, digest)


# ---------------------------------------------------------------------------------------------- keys

STEP = 0.02
"""Metres of one nudge of the ball."""


@dataclass(frozen=True)
class Key:
    """One row of ``KEYMAP``.

    The window has the keys of the first thesis.  The page cannot: its 3D view moves the camera with
    W A S D Q E and the arrows, and has no switch for that.
    """

    about: str  # what it does, as text
    browser: str  # the key on the page; empty: none, because a control is there
    window: str  # the key in MuJoCo's window; empty: none
    command: Callable[[View], Command] | None  # in this state; None: shows or hides the overlay


def _next(values: tuple[_Value, ...], value: object) -> _Value:
    return values[(values.index(value) + 1) % len(values) if value in values else 0]


def _next_method(view: View) -> str:
    return _next(tuple(rik.SOLVERS), view.instances[0].method)


KEYMAP: tuple[Key, ...] = (
    Key("start / pause", "space", "Space", lambda view: SetRunning(not view.running)),
    Key("reset", "R", "R", lambda view: Reset()),
    Key("ball: curve, random, by hand", "I", "I", lambda view: SetMotion(_next(MOTIONS, view.motion))),
    Key("one robot", "1", "1", lambda view: SetCount(COUNTS[0])),
    Key("compare two", "2", "2", lambda view: SetCount(COUNTS[1])),
    Key("compare four", "4", "4", lambda view: SetCount(COUNTS[2])),
    Key("next method of robot 1", "M", "M", lambda view: SetMethod(0, _next_method(view))),
    Key("next kind of goal", "K", "K", lambda view: SetGoalKind(_next(GOAL_KINDS, view.kind))),
    Key("joint limits on / off", "O", "O", lambda view: SetLimits(not view.limits)),
    Key("branches of robot 1", "B", "B", lambda view: ShowBranches(not view.show_branches)),
    Key("ball along +x", "T", "Up", lambda view: Nudge((STEP, 0.0, 0.0))),
    Key("ball along -x", "G", "Down", lambda view: Nudge((-STEP, 0.0, 0.0))),
    Key("ball along +y", "F", "Left", lambda view: Nudge((0.0, STEP, 0.0))),
    Key("ball along -y", "H", "Right", lambda view: Nudge((0.0, -STEP, 0.0))),
    Key("ball up", "Y", "W", lambda view: Nudge((0.0, 0.0, STEP))),
    Key("ball down", "N", "S", lambda view: Nudge((0.0, 0.0, -STEP))),
    Key("trails and labels / overlay on, off", "L", "L", None),
)
"""Every key, once."""
