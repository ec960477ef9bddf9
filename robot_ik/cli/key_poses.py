"""``robot-ik poses``: key poses and motions through them: record, list, play, export, import."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    Json,
    Overwrite,
    Range,
    Speed,
    positive,
    require,
    several,
    single,
    wrong,
)
from robot_ik.errors import TrajectoryError, did_you_mean
from robot_ik.jobs.results import claimed

if TYPE_CHECKING:
    from robot_ik.motion import Keyframes, KeyPoses
    from robot_ik.ports import Array
    from robot_ik.robot import Robot

#: Version of the JSON object; raised when a field changes its meaning.
SCHEMA = 1
_FIGURE = "humanoid"

_RobotName = Annotated[str, single("NAME|PATH", f"that of the file, else {_FIGURE}")]
_BookName = Annotated[str, single(None, "the file beside the robot's model", "Key poses, TOML.")]


@dataclass(frozen=True)
class PosesListOptions:
    """Shows the poses and motions of a file.

    robot-ik poses list
    """

    file: Positional[_BookName] = ""
    robot: _RobotName = ""
    """Whose poses."""
    json: Json = False


@dataclass(frozen=True)
class PosesRecordOptions:
    """Adds a pose to a file, which is made where there is none.

    It starts from another pose, changes joints, and brings frames to positions by inverse kinematics while
    the feet, if there are any, stay where they are.

        robot-ik poses record my.toml wave --set left_elbow_pitch=90
        robot-ik poses record my.toml up --reach right_hand 0.3 -0.3 1.6

    Exit code 0: recorded. 1: a position is out of reach, and nothing is recorded. 2: wrong input.
    """

    file: Annotated[Positional[str], arg(metavar="FILE")]
    """Key poses, TOML."""
    name: Annotated[Positional[str], arg(metavar="NAME")]
    """What the pose is called."""
    robot: _RobotName = ""
    """Whose pose."""
    begin: Annotated[str, single("POSE", "home")] = ""
    """A pose of the file or a keyframe of the model."""
    frames: Annotated[str, single("FRAMES.csv")] = ""
    """Start from a frame of a recorded motion instead."""
    at: Annotated[float, arg(metavar="S")] = 0.0
    """Of --frames: at which time."""
    set: Annotated[tuple[str, ...], several("JOINT=DEGREES")] = ()
    """Joints at other angles (metres for slides)."""
    reach: Annotated[tuple[str, ...], several("FRAME X Y Z")] = ()
    """Frames at positions, metres, world."""
    replace: bool = False
    """Replace a pose of that name."""


@dataclass(frozen=True, kw_only=True)
class _MotionOptions:
    """Which motion, and how it is sampled."""

    motion: Annotated[Positional[str], arg(metavar="MOTION")]
    """A motion or pose of the file, or a file of frames (.csv)."""
    file: _BookName = ""
    robot: _RobotName = ""
    """Whose motion."""
    speed: Speed = 1.0
    rate: Annotated[float, arg(metavar="HZ"), positive(what=" Hz")] = 60.0
    """Frames a second."""


@dataclass(frozen=True)
class PosesPlayOptions(_MotionOptions):
    """Shows a motion in MuJoCo's window, without inverse kinematics.

    robot-ik poses play walk --times 3
    """

    times: Annotated[int, Range(1)] = 1
    """How often a loop runs round."""


@dataclass(frozen=True)
class PosesExportOptions(_MotionOptions):
    """Writes a motion as frames: CSV for `robot-ik servo replay` and others, BVH for animation programs.

    robot-ik poses export walk walk.bvh
    """

    out: Annotated[Positional[str], arg(metavar="OUT")]
    """FILE.csv or FILE.bvh."""
    overwrite: Overwrite = False


@dataclass(frozen=True)
class PosesImportOptions:
    """Takes motion capture over onto a figure: by inverse kinematics on hands, feet and head.

    robot-ik poses import clip.bvh clip.csv
    """

    bvh: Annotated[Positional[str], arg(metavar="BVH")]
    """The motion: any skeleton whose joints the map names."""
    out: Annotated[Positional[str], arg(metavar="OUT")]
    """FILE.csv: frames of the figure."""
    robot: Annotated[str, arg(metavar="NAME|PATH")] = _FIGURE
    """Who shall move."""
    map: Annotated[str, single(None, "bvh.toml beside the robot's model")] = ""
    """Which joint of the file is which part of the figure."""
    rate: Annotated[float, single("HZ", "the file's"), Range(0.0, what=" Hz")] = 0.0
    """Frames a second; frames are left out, none are made up."""
    up: Annotated[Literal["y", "z"], arg(metavar="y|z")] = "y"
    """The file's axis that points up."""
    overwrite: Overwrite = False


def run_list(options: PosesListOptions) -> int:
    """Prints them."""
    robot = _load(options.robot, options.file)
    book = _book(robot, options.file)
    motions = {name: (motion, book.motion(name)) for name, motion in book.motions.items()}
    if options.json:
        shown = {
            name: {"poses": motion.poses, "loop": motion.loop, "seconds": made.duration}
            for name, (motion, made) in motions.items()
        }
        poses = {name: q.tolist() for name, q in book.poses.items()}
        console.print_json({"schema": SCHEMA, "robot": robot.name, "poses": poses, "motions": shown})
        return console.DONE
    rows = [
        (name, f"{made.duration:.2f}", "yes" if motion.loop else "", ", ".join(motion.poses))
        for name, (motion, made) in motions.items()
    ]
    console.show(console.table("motion", "seconds", "loop", "poses", rows=rows))
    console.result(f"poses: {', '.join(book.poses)}")
    return console.DONE


def run_record(options: PosesRecordOptions) -> int:
    """Records it; 1 when a position is out of reach."""
    from robot_ik.motion import KeyPoses

    robot = _load(options.robot, options.file)
    path = Path(options.file)
    book = KeyPoses.load(path, robot) if path.exists() else KeyPoses(robot)
    taken = options.name in book.poses and not options.replace
    require(not taken, "NAME", f"there is a pose {options.name!r} already", hint="another name, or --replace")
    q = _changed(robot, _start(robot, book, options), options.set)
    if options.reach:
        found = _reached(robot, q, options.reach)
        if found is None:
            hint = "a nearer position, or another pose to start from: --begin"
            return console.refused("a position is out of reach, so nothing is recorded", hint)
        q = found
    try:
        book.record(options.name, q, replace=options.replace)
    except TrajectoryError as error:
        raise wrong("pose", str(error.args[0]), hint=error.hint) from error
    book.save(path)
    console.say(f"{options.name} is in {path}, which has {console.count_of(len(book.poses), 'pose')}")
    return console.DONE


def run_play(options: PosesPlayOptions) -> int:
    """Plays it in a window."""
    robot = _load(options.robot, options.file)
    motion = _motion(robot, options)
    from robot_ik.execution import execute
    from robot_ik.testbed.frontends.window import WindowSink

    seconds = options.times * motion.duration if motion.loop else None
    frames = motion.sampled(options.rate, seconds)
    start, instead = np.array(frames.q[0]), "write its frames into a file: robot-ik poses export"
    with WindowSink(robot, start=start, instead=instead) as window, console.busy("playing", frames.duration):
        execute(frames, [window])
        window.wait()
    return console.DONE


def run_export(options: PosesExportOptions) -> int:
    """Writes it."""
    from robot_ik.figure.motion.bvh import export_bvh

    out = _out(options.out, ".csv", ".bvh")
    with claimed(out, overwrite=options.overwrite):
        motion = _motion(_load(options.robot, options.file), options)
        if out.suffix == ".bvh":
            export_bvh(motion, options.rate).save(out)
        else:
            motion.sampled(options.rate).save_csv(out)
    console.say(f"{out}: {motion.duration:.2f} s at {options.rate:g} Hz")
    return console.DONE


def run_import(options: PosesImportOptions) -> int:
    """Takes it over."""
    from robot_ik.figure.motion.bvh import Bvh
    from robot_ik.figure.motion.retarget import SkeletonMap, retarget

    out = _out(options.out, ".csv")
    with claimed(out, overwrite=options.overwrite):
        robot = _load(options.robot)
        joints = SkeletonMap.load(options.map) if options.map else None
        bvh = Bvh.load(options.bvh)
        with console.busy(f"taking over {len(bvh.values)} frames"):
            found = retarget(bvh, robot, joints, rate=options.rate or None, up=options.up)
        found.motion.save_csv(out)
    hands = 1e3 * np.quantile(found.hand_error, (0.5, 0.99))
    console.say(
        f"{out}: {len(found.motion)} frames; hands off {hands[0]:.1f} mm (median), {hands[1]:.1f} mm (99 %); "
        f"feet at rest {100 * found.rests.mean():.0f} % of the time"
    )
    return console.DONE


# ------------------------------------------------------------------------------ parts


def _load(name: str, file: str = "") -> Robot:
    """The robot of that name, else that of the file of key poses, else the figure."""
    from robot_ik.motion.key_poses import robot_named_in
    from robot_ik.robot import load_robot

    return load_robot(name or (Path(file).is_file() and robot_named_in(file)) or _FIGURE)


def _book(robot: Robot, file: str) -> KeyPoses:
    """The poses of a file, or those that ship with the robot."""
    from robot_ik.motion import KeyPoses

    path = Path(file) if file else robot.folder / "poses.toml"
    none = f"no key poses ship with {robot.name!r}"
    require(bool(file) or path.is_file(), "--file", none, "a file", "robot-ik poses record makes one")
    return KeyPoses.load(path, robot)


def _motion(robot: Robot, options: _MotionOptions) -> Keyframes:
    from robot_ik.motion import Keyframes

    name = options.motion
    if name.endswith(".csv"):
        return Keyframes.load_csv(name, robot)
    book = _book(robot, options.file)
    known = [*book.motions, *book.poses]
    allowed = f"{', '.join(known[:20])}, or a .csv file"
    require(name in known, "MOTION", f"there is no {name!r}", allowed, did_you_mean(name, known))
    return book.motion(name, speed=options.speed)


def _start(robot: Robot, book: KeyPoses, options: PosesRecordOptions) -> Array:
    """Where recording begins."""
    from robot_ik.motion import Keyframes
    from robot_ik.motion.key_poses import named_poses

    if options.frames:
        return Keyframes.load_csv(options.frames, robot).at(options.at)
    if not options.begin:
        return np.array(robot.home)
    known, name = named_poses(robot, book), options.begin
    require(
        name in known, "--begin", f"there is no pose {name!r}", ", ".join(known), did_you_mean(name, known)
    )
    return known[name]


def _reached(robot: Robot, q: Array, arguments: Sequence[str]) -> Array | None:
    """The pose that brings frames to the positions of ``FRAME X Y Z`` arguments; None: out of reach."""
    from robot_ik.motion.key_poses import pose_reaching

    if not arguments or len(arguments) % 4:
        raise wrong("--reach", f"{len(arguments)} arguments", "FRAME X Y Z, once or more")
    positions = {}
    for first in range(0, len(arguments), 4):
        try:
            x, y, z = (float(number) for number in arguments[first + 1 : first + 4])
        except ValueError:
            raise wrong("--reach", " ".join(arguments[first : first + 4]), "FRAME X Y Z, metres") from None
        positions[arguments[first]] = (x, y, z)
    return pose_reaching(robot, q, positions)


def _changed(robot: Robot, q: Array, items: Sequence[str]) -> Array:
    """The pose with the joints of ``JOINT=DEGREES`` arguments."""
    from robot_ik.motion.key_poses import with_joint

    for item in items:
        joint, _, text = item.partition("=")
        try:
            q = with_joint(robot, q, joint, float(text))
        except ValueError:
            raise wrong("--set", repr(item), "HINGE=DEGREES or SLIDE=METRES") from None
    return q


def _out(name: str, *endings: str) -> Path:
    path = Path(name)
    require(path.suffix in endings, "OUT", f"no format is known by the name {name!r}", " or ".join(endings))
    return path
