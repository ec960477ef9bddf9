"""Options that several commands share, and the types of option values.

Each option is defined once here, so that it has the same name, help and range in every command.
The bases are ``kw_only``: cyclopts makes a positional argument of every other field.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from cyclopts import Group, Parameter
from cyclopts.validators import Number

from robot_ik.errors import OptionError
from robot_ik.hardware import BUSES

if TYPE_CHECKING:
    from robot_ik.commands.terminal import Terminal
    from robot_ik.geometry import Pose
    from robot_ik.goals import PoseGoal, PositionGoal

NO_BUS = "none"
"""Value of ``--bus`` for a robot without servos."""

OUTPUT_GROUP = Group("Output", sort_key=9)
"""Panel of the help for files and formats, below all other panels."""

OUTPUT = "output file"
"""Annotation of an option that names a file to write. ``main`` reserves the file before the run."""

BUS_METAVAR = "|".join(BUSES)
"""The values of ``--bus``."""

BUS_HELP = "; ".join(f"{bus.name}: {bus.title}" for bus in BUSES.values())
"""The values of ``--bus``, explained."""

DICTIONARY_HELP = "Dictionary of the markers, for example DICT_APRILTAG_36H11."
"""Help of ``--dictionary``."""

INTRINSICS_HELP = "Calibration of a real camera (OpenCV or ROS YAML)."
"""Help of ``--intrinsics``."""

RobotName = Annotated[
    str,
    Parameter(metavar="NAME|FILE", help="Robot name (see `robot-ik robots`), MJCF or URDF file."),
]
FrameName = Annotated[
    str | None,
    Parameter(metavar="NAME", help="Tool, site or body to move. Default: the robot's tool."),
]
BaseName = Annotated[
    str | None,
    Parameter(
        metavar="NAME",
        help="Frame that stays: only joints between it and the frame to move are active.",
    ),
]
JointNames = Annotated[
    tuple[str, ...],
    Parameter(metavar="NAME …", consume_multiple=True, help="Active joints. Default: all joints."),
]
FreeFeet = Annotated[
    bool,
    Parameter(help="Let the feet of a figure move. Default: they stay where they are."),
]
SolverName = Annotated[
    str,
    Parameter(metavar="NAME", help="Solver (see `robot-ik solvers`). Default: the robot's own."),
]
GoalNumbers = Annotated[
    tuple[float, ...],
    Parameter(
        metavar="X Y Z [W X Y Z]",
        consume_multiple=True,
        help="Goal in the world: position in metres and, optionally, a quaternion.",
    ),
]
StartNumbers = Annotated[
    tuple[float, ...],
    Parameter(
        metavar="Q …",
        consume_multiple=True,
        help="Start configuration in rad (slides: m). Default: the home pose.",
    ),
]
Iterations = Annotated[
    int,
    Parameter(
        metavar="N",
        validator=Number(gte=1),
        help="Iteration budget of all restarts together.",
    ),
]
SceneFile = Annotated[
    Path | None,
    Parameter(
        metavar="FILE.xml",
        help="Obstacles around the robot: an MJCF file without joints. The robot must not touch "
        "them.",
    ),
]
Margin = Annotated[
    float,
    Parameter(
        metavar="M",
        validator=Number(gte=0, lt=math.inf),
        help="Smallest allowed distance between parts, in metres.",
    ),
]
Seed = Annotated[
    int, Parameter(metavar="N", help="Random seed. The same seed gives the same result.")
]
Speed = Annotated[
    float,
    Parameter(
        metavar="SHARE",
        validator=Number(gt=0, lte=1),
        help="Share of the speed limits, above 0 and at most 1.",
    ),
]
Seconds = Annotated[float, Parameter(metavar="S", validator=Number(gt=0, lt=math.inf))]
ArmName = Annotated[
    str,
    Parameter(
        metavar="NAME|FILE",
        help="Arm file (TOML) with servo ids, zeros and limits, or a robot that has one.",
    ),
]
ExitPolicy = Annotated[
    Literal["torque_off", "hold", "park"] | None,
    Parameter(
        metavar="POLICY",
        help="State of the arm at the end. park: back to the start pose, then torque off. "
        "Default: on_exit of the arm file.",
    ),
]
MarkerIds = Annotated[
    tuple[int, ...],
    Parameter(
        metavar="N …",
        consume_multiple=True,
        allow_repeating=True,
        help="Ids of markers or servos. Default: all.",
    ),
]
MarkerSize = Annotated[
    float | None,
    Parameter(
        metavar="M",
        help="Side of the black square in metres. Required for poses from a real camera.",
    ),
]
Dictionary = Annotated[str, Parameter(metavar="NAME", help=DICTIONARY_HELP)]
BoardName = Annotated[
    str,
    Parameter(
        metavar="BOARD",
        help="Board in front of a real camera. Forms: marker:ID:MM, grid:COLUMNSxROWS:MM:GAP_MM, "
        "charuco:COLUMNSxROWS:SQUARE_MM:MARKER_MM, chessboard:COLUMNSxROWS:SQUARE_MM or "
        "FILE.toml[:NAME].",
    ),
]
BoardPose = Annotated[
    tuple[float, ...],
    Parameter(
        metavar="X Y Z [W X Y Z]",
        consume_multiple=True,
        help="Pose of the board. Position in metres and, optionally, a quaternion.",
    ),
]
IntrinsicsFile = Annotated[Path | None, Parameter(metavar="FILE", help=INTRINSICS_HELP)]
ViewCount = Annotated[int, Parameter(metavar="N", help="Number of views to take.")]
PatternColumns = Annotated[
    int | None,
    Parameter(
        metavar="N",
        help="Columns of the board or pattern. Board: markers (default 2). charuco: squares (8). "
        "chessboard: inner corners, as OpenCV and ROS count (9).",
    ),
]
PatternRows = Annotated[
    int | None,
    Parameter(
        metavar="N",
        help="Rows of the board or pattern. Default: 2 for a board, 6 for a pattern.",
    ),
]
CharucoMarkerMm = Annotated[
    float | None,
    Parameter(
        metavar="MM",
        help="Side of the markers of a ChArUco board in mm. Default: 0.73 squares.",
    ),
]
ResultFile = Annotated[
    Path, Parameter(metavar="FILE", group=OUTPUT_GROUP, help="Destination of the results."), OUTPUT
]
RecordFile = Annotated[
    Path | None,
    Parameter(
        metavar="FILE.csv|.mcap",
        group=OUTPUT_GROUP,
        help="Record every command and measurement. A .mcap file needs the extra `record`.",
    ),
    OUTPUT,
]
VideoFile = Annotated[
    Path | None,
    Parameter(
        metavar="FILE.mp4",
        group=OUTPUT_GROUP,
        help="Write a video of the motion (extra `video`).",
    ),
    OUTPUT,
]

CameraSource = Annotated[
    str, Parameter(metavar="synthetic|INDEX|FILE|FOLDER|URL", help="Image source.")
]
ExtrinsicsFile = Annotated[
    Path | None,
    Parameter(
        metavar="FILE",
        help="Pose of a real camera, from `robot-ik camera locate` or `camera handeye`.",
    ),
]
TargetMarker = Annotated[int, Parameter(metavar="ID", help="Id of the target marker.")]
RobotPose = Annotated[
    tuple[float, ...],
    Parameter(
        metavar="X Y Z [YAW_DEG]",
        consume_multiple=True,
        help="Pose of the robot on the board or the floor. Metres; x right, y up, z out of the "
        "print.",
    ),
]
DrawnScale = Annotated[
    float | None,
    Parameter(
        metavar="FACTOR",
        validator=Number(gt=0, lt=math.inf),
        help="Scale factor. Drawn size over true size. Default: 1; synthetic: as large as fits.",
    ),
]
DrawnVideo = Annotated[
    Path | None,
    Parameter(
        metavar="FILE.mp4|FILE.png|FOLDER",
        group=OUTPUT_GROUP,
        help="Write a video of the motion (extra `video`). Or the last picture, or a folder of "
        "pictures. Default: ar.mp4, or the folder ar.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """Base of the commands that print a report."""

    json: Annotated[
        bool, Parameter(group=OUTPUT_GROUP, help="Print one JSON object instead of tables.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class OverwriteOption:
    """Base of the commands that write files."""

    overwrite: Annotated[
        bool, Parameter(group=OUTPUT_GROUP, help="Replace files of an earlier run.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class FolderOption(OverwriteOption):
    """Base of the commands that write a folder of results.

    Attributes:
        FILES: Patterns of the names of the files. ``--overwrite`` replaces these and no others.
    """

    FILES: ClassVar[tuple[str, ...]] = ()

    out: Annotated[
        Path | None,
        Parameter(
            metavar="FOLDER",
            group=OUTPUT_GROUP,
            help="Destination of the results. A folder; default: runs/<time>-<command>.",
        ),
    ] = None

    def result_folder(self, terminal: Terminal) -> Path | None:
        """Return the folder that ``main`` has reserved.

        A call from Python writes files only if the class was given ``out``.
        """
        if terminal.folder is None and self.out is not None:
            from robot_ik.files import make_folder  # not for --help

            return make_folder(self.out)
        return terminal.folder


@dataclass(frozen=True, kw_only=True)
class BusOptions:
    """Base of the commands that read servos. Without ``--bus`` they take the only port."""

    bus: Annotated[
        str,
        Parameter(
            alias="--port",
            metavar=BUS_METAVAR,
            help=f"Servo bus. {BUS_HELP}. Default: the only USB serial port.",
        ),
    ] = ""
    arm: ArmName = "tabletop_puma"


@dataclass(frozen=True, kw_only=True)
class MovingBusOptions:
    """Base of the commands that move real servos. Without ``--bus`` nothing real moves."""

    bus: Annotated[
        str, Parameter(alias="--port", metavar=BUS_METAVAR, help=f"Servo bus. {BUS_HELP}.")
    ]
    arm: ArmName = "tabletop_puma"


def parse_pairs(option: str, items: Iterable[str], form: str) -> dict[str, float]:
    """Return name -> number of ``NAME=NUMBER`` arguments.

    Raises:
        OptionError: An argument has another form, or its number is not finite.
    """
    from robot_ik.config import is_number  # pydantic, 0.1 s: not for --help

    pairs: dict[str, float] = {}
    for item in items:
        name, _, text = item.partition("=")
        value = float(text) if is_number(text) else math.nan
        if not name or not math.isfinite(value):
            raise OptionError(option, f"cannot read {item!r}", form)
        if name in pairs:
            raise OptionError(option, f"{name} is given twice", "each name once")
        pairs[name] = value
    return pairs


def parse_goal(numbers: tuple[float, ...], frame: str | None) -> PositionGoal | PoseGoal:
    """Return the goal of ``--goal``: a position, or a pose.

    Raises:
        OptionError, InvalidGoalError: The count is wrong, or a number cannot be used.
    """
    from robot_ik.goals import PoseGoal, PositionGoal  # NumPy: not for --help

    if len(numbers) == 3:
        return PositionGoal(frame, numbers)
    if len(numbers) == 7:
        return PoseGoal(frame, numbers[:3], numbers[3:])
    raise OptionError(
        "--goal",
        f"{len(numbers)} numbers" if numbers else "no goal is given",
        "3 (x y z in metres) or 7 (x y z, then quaternion w x y z)",
        hint="for example: --goal -0.4 -0.1 0.7",
    )


def parse_pose(option: str, numbers: tuple[float, ...]) -> Pose | None:
    """Return the pose of an option: a position in metres, or a position and a quaternion.

    None: the option is not given.

    Raises:
        OptionError: The count is wrong, or a number cannot be used.
    """
    from robot_ik.geometry import Pose  # NumPy: not for --help

    if not numbers:
        return None
    allowed = "3 (x y z in metres) or 7 (x y z, then quaternion w x y z)"
    if len(numbers) not in (3, 7):
        raise OptionError(option, f"{len(numbers)} numbers", allowed)
    try:
        return Pose(numbers[:3], numbers[3:] or (1.0, 0.0, 0.0, 0.0))
    except ValueError as error:
        raise OptionError(option, str(error), allowed) from error
