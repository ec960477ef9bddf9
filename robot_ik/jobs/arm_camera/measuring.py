"""What every job says that moves an arm before a camera."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError

from robot_ik.camera.boards.board import Board, BoardView
from robot_ik.camera.calibration.extrinsics import today
from robot_ik.camera.calibration.handeye import LEAST_VIEWS, HandEyeSample, Mounting
from robot_ik.camera.calibration.kinematic import KnownPose
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame
from robot_ik.errors import CameraError, ConfigError, MarkerNotFoundError, RobotIkError
from robot_ik.execution import execute
from robot_ik.files import plain, write_atomically
from robot_ik.geometry import Pose
from robot_ik.hardware.config import ArmConfig
from robot_ik.jobs.reach import ReachRequest, Rehearsal
from robot_ik.jobs.robot_setup import RobotSetup
from robot_ik.motion.trajectory import joint_move
from robot_ik.reading import parse_json, read_text, shown
from robot_ik.robot import Robot, load_robot
from robot_ik.tables import Pair, Position, Several, Table, Wxyz, config_error


@dataclass(frozen=True)
class ArmCameraRequest:
    """An arm, a camera, a board, and how many pictures to take of it.

    Attributes:
        robot: Catalogue name, or path of an MJCF or URDF file.
        bus: ``sim``, ``pty`` or a serial port.
        arm_file: None: the one beside the model, else a generic one.
        frame: What carries camera or board; None: the tool, or what carries the scene's markers.
        camera: ``synthetic``, or what ``open_source`` opens.
        intrinsics: Calibration file; needed for a real camera.
        board: None: the simulated one.
        views: How many pictures.
        speed: Share of the joints' speed limits.
        seed: Of planning and of the simulated noise.
    """

    robot: str = "puma560"
    bus: str = "sim"
    arm_file: Path | None = None
    frame: str | None = None
    camera: str = "synthetic"
    intrinsics: Path | None = None
    board: Board | None = None
    views: int = 15
    speed: float = 1.0
    seed: int = 0

    @property
    def shared(self) -> dict[str, Any]:
        """These attributes by name, for a request of another kind."""
        return {one.name: getattr(self, one.name) for one in fields(ArmCameraRequest)}

    def setup(self, rehearsal: Rehearsal | None = None) -> ReachRequest:
        """What ``prepare_robot`` is asked for."""
        return ReachRequest(
            robot=self.robot, frame=self.frame, bus=self.bus, arm_file=self.arm_file,
            speed=self.speed, seed=self.seed, rehearsal=rehearsal or Rehearsal(),
        )  # fmt: skip


# ------------------------------------------------------------------------------------------
# Drives an arm from station to station; at each it stands still, its joints are read and a picture is taken.


Array = NDArray[np.float64]

# Servos may take this long to arrive after the last command, and then to come to rest.
_SETTLE_SECONDS, _REST_CHECK_SECONDS, _REST_CHECKS = 0.3, 0.1, 20
# Two readings that differ by no more than this many ticks are of an arm at rest.
_STILL_TICKS = 1.01


@dataclass(frozen=True, eq=False)
class Station:
    """The arm at one station.

    Attributes:
        number: From 0.
        asked: (nq,) where it was sent.
        q: (nq,) where its servos say it is: mean of the readings before and after the picture.
        still: Whether it had come to rest.
        frame: The picture.
    """

    number: int
    asked: Array
    q: Array
    still: bool
    frame: Frame


def visit_stations(
    setup: RobotSetup,
    stations: Sequence[Array],
    take: Callable[[], Frame],
    *,
    speed: float = 1.0,
    progress: Callable[[int, float], None] = lambda number, share: None,
) -> Iterator[Station]:
    """Goes to each station in turn; a generator, so that what was seen before an interruption is kept.

    Args:
        setup: Connected, with torque on (``setup.connected()``, ``setup.enable_torque()``).
        stations: (nq,) each, inside the limits; see ``plan_views``.
        take: Takes a picture.
        speed: Share of the joints' speed limits.
        progress: Called with the number of the station and the share of the way to it.

    Raises:
        TrajectoryError, HardwareError: As ``joint_move`` and ``execute``; the arm is left as its exit policy
            says.
    """
    for number, asked in enumerate(stations):
        trajectory = joint_move(
            setup.robot, setup.q, asked, speed=speed, rate=setup.rate,
            velocity=setup.velocity, acceleration=setup.acceleration,
        )  # fmt: skip
        count = max(1, len(trajectory))

        def show(tick: Any, number: int = number, count: int = count) -> None:
            progress(number, min(1.0, tick.index / count))

        execute(
            trajectory, setup.sinks, source=setup.source, clock=setup.clock, on_tick=show,
            settle=0.0 if setup.source is None else _SETTLE_SECONDS,
        )  # fmt: skip
        before, still = _come_to_rest(setup)
        frame = take()
        yield Station(number, np.array(asked), 0.5 * (before + setup.q), still, frame)


def _come_to_rest(setup: RobotSetup) -> tuple[Array, bool]:
    """Reads until two readings agree: the last one (nq,), and whether they did."""
    last = setup.q
    if setup.arm is None:
        setup.scene.send(last, setup.clock.now())
        return last, True
    for _ in range(_REST_CHECKS):
        setup.settle(_REST_CHECK_SECONDS)
        now = setup.q
        if bool(np.all(np.abs(now - last) <= _STILL_TICKS * setup.resolution)):
            return now, True
        last = now
    return last, False


# ------------------------------------------------------------------------------------------
# What was measured for a hand-eye calibration, in a file: it can be solved again without moving the arm.


_SCHEMA = 1


@dataclass(eq=False)
class SampleSet:
    """Joint angles read from the servos, and the board's corners in the picture taken there.

    Attributes:
        robot: As for ``load_robot``; ``joints`` are the active ones, in the order of ``q``.
        frame: What carries camera or board.
        mounting: Which of the two.
        intrinsics: Of the pictures.
        date: ISO 8601.
        q: (nq,) of each station; ``views``: what was seen there.
    """

    robot: str
    joints: tuple[str, ...]
    frame: str
    mounting: Mounting
    intrinsics: CameraIntrinsics
    date: str = field(default_factory=today)
    q: list[Array] = field(default_factory=list)
    views: list[BoardView] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.q)

    def add(self, q: Array, view: BoardView) -> None:
        """One station more."""
        self.q.append(np.array(q, dtype=float))
        self.views.append(view)

    def require(self, stations: int, hint: str) -> None:
        """Nothing where there are samples enough of so many stations.

        Raises:
            MarkerNotFoundError: There are not; ``hint`` says what may help beside board and light.
        """
        if len(self) < LEAST_VIEWS:
            raise MarkerNotFoundError(
                f"the board was seen at {len(self)} of {stations} stations; {LEAST_VIEWS} are the least",
                hint=f"check board, dictionary and light, and {hint}",
            )

    def load_robot(self) -> Robot:
        """The robot with the joints that ``q`` is of."""
        return load_robot(self.robot, joints=self.joints)

    def samples(self, robot: Robot) -> list[HandEyeSample]:
        """For ``solve_handeye``: the hand where the joint angles put it."""
        return [
            HandEyeSample(robot.forward(q, self.frame), view)
            for q, view in zip(self.q, self.views, strict=True)
        ]

    def as_values(self) -> dict[str, Any]:
        """For JSON."""
        lens = self.intrinsics
        return {
            "schema": _SCHEMA,
            "job": "handeye",
            "date": self.date,
            "robot": self.robot,
            "joints": self.joints,
            "frame": self.frame,
            "mounting": self.mounting,
            "intrinsics": {
                "width": lens.width, "height": lens.height, "fx": lens.fx, "fy": lens.fy,
                "cx": lens.cx, "cy": lens.cy, "distortion": lens.distortion, "model": lens.model,
            },
            "samples": [
                {
                    "q": q,
                    "points": view.points,
                    "pixels": view.pixels,
                    "sigma": view.sigma,
                    "position": view.pose_camera_board.position,
                    "wxyz": view.pose_camera_board.wxyz,
                }
                for q, view in zip(self.q, self.views, strict=True)
            ],
        }  # fmt: skip

    @classmethod
    def of_values(cls, data: Any) -> SampleSet:
        """What ``as_values`` gave, through JSON.

        Raises:
            ValueError (pydantic's ValidationError among them), RobotIkError: It is something else.
        """
        of_verify = isinstance(data, dict) and data.get("job") == "verify"
        return cls.of_file((_VerifyFile if of_verify else _SampleFile).model_validate(data))

    @classmethod
    def of_file(cls, file: _SampleFile) -> SampleSet:
        """What the file says.

        Raises:
            ValueError, RobotIkError: It says something impossible.
        """
        lens = CameraIntrinsics(**file.intrinsics.model_dump())
        found = cls(file.robot, file.joints, file.frame, file.mounting, lens, file.date)
        for k, one in enumerate(file.samples):
            if len(one.q) != len(file.joints):
                raise ValueError(f"samples[{k}].q: {len(one.q)} angles of {len(file.joints)} joints")
            points, pixels = np.array(one.points), np.array(one.pixels)
            view = BoardView(points, pixels, Pose(one.position, one.wxyz), one.sigma)
            found.add(np.array(one.q), view)
        return found

    def save(self, path: Path) -> None:
        """Writes JSON, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(path, json.dumps(plain(self.as_values())) + "\n")

    @classmethod
    def load(cls, path: Path) -> SampleSet:
        """Reads what ``save`` wrote.

        Raises:
            CameraError: Missing, or no such file.
        """
        return read_samples(path, cls.of_values, "a hand-eye calibration", "handeye")


class _Lens(Table):
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Several[float]
    model: str


class _Sample(Table):
    q: Several[float]
    points: Several[Position]
    pixels: Several[Pair]
    sigma: float
    position: Position
    wxyz: Wxyz


class _SampleFile(Table):
    version: Annotated[Literal[1], Field(alias="schema")]
    job: str
    robot: str
    joints: Several[str]
    frame: str
    mounting: Mounting
    intrinsics: _Lens
    date: str
    samples: Several[_Sample]


Made = TypeVar("Made")


def read_samples(path: Path, made: Callable[[Any], Made], of: str, command: str) -> Made:
    """What ``made`` makes of a JSON file.

    Raises:
        CameraError: It is missing, or ``made`` can make nothing of it.
    """
    hint = f"give the file that robot-ik camera {command} leaves beside its result"
    try:
        text = read_text(path, "the file of samples")
    except ConfigError as error:
        raise CameraError(str(error.args[0]), hint=hint) from error
    try:
        return made(parse_json(text, path))
    except (ValueError, RobotIkError) as error:
        found = config_error(error, path) if isinstance(error, ValidationError) else error
        reason = str(found.args[0]).removeprefix(f"{path}: ")
        raise CameraError(f"{path} holds no samples of {of} ({reason})", hint=hint) from error


# ------------------------------------------------------------------------------------------
# What was measured of an arm before a camera, in a file: it can be judged again without moving.


@dataclass(frozen=True, eq=False)
class VerifySamples:
    """Samples, and what was known when they were taken.

    Attributes:
        samples: Joint angles and what was seen there.
        camera, board: Their poses as they were known.
        by_arm: Whether the camera's pose was found by moving the arm.
        true_offsets: (nv,) rad; None where it is unknown.
        servos: Each joint's row of the arm file, as JSON holds it: what ``q`` was read with.
    """

    samples: SampleSet
    camera: KnownPose
    board: KnownPose
    by_arm: bool
    true_offsets: Array | None = None
    servos: tuple[dict[str, Any], ...] = ()

    def __len__(self) -> int:
        return len(self.samples)

    def save(self, path: Path) -> None:
        """Writes JSON, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        values = self.samples.as_values() | {
            "job": "verify",
            "camera": _pose_values(self.camera),
            "board": _pose_values(self.board),
            "by_arm": self.by_arm,
            "true_offsets": self.true_offsets,
            "servos": self.servos,
        }
        write_atomically(path, json.dumps(plain(values)) + "\n")

    @classmethod
    def load(cls, path: Path) -> VerifySamples:
        """Reads what ``save`` wrote.

        Raises:
            CameraError: Missing, or no such file.
        """
        return read_samples(path, cls._of_values, "an arm before a standing camera", "verify")

    @classmethod
    def _of_values(cls, data: Any) -> VerifySamples:
        job = data.get("job") if isinstance(data, dict) else None
        if isinstance(job, str) and job != "verify":
            raise ValueError(f"they are of {shown(job, str)}, which does not know the camera's pose")
        file = _VerifyFile.model_validate(data)
        offsets = file.true_offsets
        return cls(
            SampleSet.of_file(file),
            _pose_of(file.camera),
            _pose_of(file.board),
            file.by_arm,
            None if offsets is None else np.array(offsets, dtype=float),
            tuple(row.model_dump() for row in file.servos),
        )

    def arm(self, file: Path) -> ArmConfig:
        """The arm of a file, if the joints were read with it.

        Raises:
            ConfigError: It has other joints, or one has been changed since.
        """
        config = ArmConfig.load(file)
        by_name = {joint.name: joint for joint in config.joints}
        for row in self.servos:
            joint = by_name.get(row["name"])
            if joint is None or servo_values(joint) != row:
                what = "is not there" if joint is None else "has been changed since the arm was measured"
                raise ConfigError(
                    f"joint {row['name']!r} {what}, so these samples say nothing of this arm",
                    file=file, key="joints", hint="measure again",
                )  # fmt: skip
        if unknown := [name for name in self.samples.joints if name not in by_name]:
            raise ConfigError(
                f"there is no joint {unknown[0]!r}, of which the samples are",
                file=file, key="joints", allowed=", ".join(by_name),
            )  # fmt: skip
        return replace(config, joints=tuple(by_name[name] for name in self.samples.joints))


def servo_values(joint: Any) -> dict[str, Any]:
    """One joint's row as JSON gives it back."""
    values: dict[str, Any] = json.loads(json.dumps(plain(asdict(joint))))
    return values


def _pose_values(known: KnownPose) -> dict[str, Any]:
    return {"position": known.pose.position, "wxyz": known.pose.wxyz, "covariance": known.covariance}


def _pose_of(data: _Known) -> KnownPose:
    return KnownPose(Pose(data.position, data.wxyz), np.array(data.covariance))


_Six = Annotated[Several[float], Field(min_length=6, max_length=6)]


class _Known(Table):
    position: Position
    wxyz: Wxyz
    covariance: Annotated[Several[_Six], Field(min_length=6, max_length=6)]


class _Servo(Table):
    model_config = ConfigDict(extra="allow")

    name: str


class _VerifyFile(_SampleFile):
    camera: _Known
    board: _Known
    by_arm: bool
    true_offsets: Several[float] | None
    servos: Several[_Servo]
