"""What was commanded and measured, written while it happens: a table (CSV), or MCAP for other people's tools.

MCAP files hold ROS 2 messages (profile ``ros2``, CDR): ``ros2 bag``, Foxglove, PlotJuggler and Rerun open
them.  A file that was cut off is mended by ``mcap recover``.
"""

from __future__ import annotations

import contextlib
import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.errors import ConfigError, MissingExtraError, OutputError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Closing

SUFFIXES = (".csv", ".mcap")
FRAME = "world"
"""Of goals in an MCAP file."""
_GOAL = ("goal_x", "goal_y", "goal_z", "goal_qw", "goal_qx", "goal_qy", "goal_qz")


@dataclass(frozen=True, eq=False)
class Moment:
    """One row of a recording: s since it began, (n,) rad (m of slides), a goal in the world, what happened.

    ``robot``: of several side by side, which.
    """

    now: float
    _: KW_ONLY
    commanded: Array | None = None
    measured: Array | None = None
    goal: Pose | None = None
    text: str = ""
    robot: int = 0


class Recording(Closing):
    """Takes moments as they come, and is closed at the end.

    Where the file cannot be written any more, as on a full disk, it is removed: a part of it would be torn.

    Args:
        path: The file.
        mode: As of ``open``.

    Raises:
        OutputError: It cannot be written; all methods raise it.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self._path = path
        try:
            self._file: Any = open(path, mode, newline="" if mode == "w" else None)  # noqa: SIM115
        except OSError as error:
            raise self._unwritable(error) from error

    def write(self, moment: Moment) -> None:
        """One more."""
        with self._whole_or_removed():
            self._write(moment)

    def close(self) -> None:
        if not self._file.closed:
            with self._whole_or_removed():
                self._finish()
                self._file.close()

    def _write(self, moment: Moment) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        """Writes what belongs at the end of the file."""

    @contextlib.contextmanager
    def _whole_or_removed(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # it tries to write the rest once more
                self._file.close()
            with contextlib.suppress(OSError):
                self._path.unlink()
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path} cannot be written: {error.strerror or error}")


class TableRecording(Recording):
    """A CSV file: a row a moment; what is not known stays empty."""

    def __init__(self, path: Path, joints: Sequence[str]) -> None:
        super().__init__(path, "w")
        self._blank = [""] * len(joints)
        self._rows = csv.writer(self._file, lineterminator="\n")
        names = [f"{kind}.{joint}" for kind in ("commanded", "measured") for joint in joints]
        with self._whole_or_removed():
            self._rows.writerow(["time_s", "robot", *names, *_GOAL, "text"])

    def _write(self, moment: Moment) -> None:
        both, goal = (moment.commanded, moment.measured), moment.goal
        sides = [self._blank if q is None else q.tolist() for q in both]
        aim = [""] * len(_GOAL) if goal is None else [*goal.position.tolist(), *goal.wxyz.tolist()]
        self._rows.writerow([float(moment.now), moment.robot, *sides[0], *sides[1], *aim, moment.text])


_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}


def _schema(text: str, *contained: str) -> str:
    """A message with the messages that it contains, as MCAP keeps ROS 2's."""
    parts = (f"{'=' * 80}\nMSG: {name}\n{_PARTS[name]}" for name in ("builtin_interfaces/Time", *contained))
    return "\n".join([text, *parts])


MESSAGES: Mapping[str, str] = {
    "sensor_msgs/msg/JointState": _schema(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
        "std_msgs/Header",
    ),
    "geometry_msgs/msg/PoseStamped": _schema(
        "std_msgs/Header header\ngeometry_msgs/Pose pose", *list(_PARTS)[1:]
    ),
    "rcl_interfaces/msg/Log": _schema(
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
        "uint32 line"
    ),
}
"""Message type -> its definition, as ROS 2 has it."""
_INFO = 20  # of rcl_interfaces/msg/Log


class McapRecording(Recording):
    """An MCAP file: ``/joint_commands``, ``/joint_states``, ``/goal`` and ``/rosout``.

    Of several robots side by side each has its topics below ``/robot_1`` and so on.
    """

    def __init__(self, path: Path, joints: Sequence[str]) -> None:
        from mcap_ros2.writer import Writer

        super().__init__(path, "wb")
        self._joints, self._begin = list(joints), time.time_ns()
        with self._whole_or_removed():
            self._writer: Any = Writer(self._file)
            self._schemas = {
                name: self._writer.register_msgdef(name, text) for name, text in MESSAGES.items()
            }

    def _write(self, moment: Moment) -> None:
        stamp = self._begin + round(1e9 * moment.now)
        when = {"sec": stamp // 1_000_000_000, "nanosec": stamp % 1_000_000_000}
        head = {"stamp": when, "frame_id": FRAME}
        place = f"/robot_{moment.robot}" if moment.robot else ""
        for topic, q in (("joint_commands", moment.commanded), ("joint_states", moment.measured)):
            if q is not None:
                state = {"name": self._joints, "position": q.tolist(), "velocity": [], "effort": []}
                self._put(f"{place}/{topic}", "sensor_msgs/msg/JointState", {"header": head, **state}, stamp)
        if (goal := moment.goal) is not None:
            position = dict(zip("xyz", goal.position.tolist(), strict=True))
            orientation = dict(zip("wxyz", goal.wxyz.tolist(), strict=True))
            pose = {"position": position, "orientation": orientation}
            self._put(f"{place}/goal", "geometry_msgs/msg/PoseStamped", {"header": head, "pose": pose}, stamp)
        if moment.text:
            empty = {"file": "", "function": "", "line": 0}
            row = {"stamp": when, "level": _INFO, "name": "robot_ik", "msg": moment.text, **empty}
            self._put("/rosout", "rcl_interfaces/msg/Log", row, stamp)

    def _put(self, topic: str, kind: str, message: dict[str, Any], stamp: int) -> None:
        self._writer.write_message(topic, self._schemas[kind], message, log_time=stamp, publish_time=stamp)

    def _finish(self) -> None:
        self._writer.finish()


def require_recording(path: Path) -> None:
    """Whether recordings of this name can be made at all, asked before anything else is.

    Raises:
        ConfigError: Another ending.
        MissingExtraError: ``.mcap`` without the extra ``record``.
    """
    if path.suffix not in SUFFIXES:
        problem = f"the format is not clear from the name {path.name!r}"
        raise ConfigError(problem, file="command line", key="--record", allowed=" or ".join(SUFFIXES))
    if path.suffix == ".mcap":
        try:
            import mcap_ros2  # noqa: F401
        except ImportError as reason:
            raise MissingExtraError("mcap_ros2", "record", "an MCAP file") from reason


def open_recording(path: Path, joints: Sequence[str]) -> Recording:
    """A recording by the ending of its name; a context manager.

    Raises as ``require_recording``, and ``OutputError`` where it cannot be written.
    """
    require_recording(path)
    return TableRecording(path, joints) if path.suffix == ".csv" else McapRecording(path, joints)


class RecordingSink:
    """A ``JointSink`` that writes what was commanded, and what an arm ``measured`` last, joint -> rad.

    Put it behind the arm among the sinks: then the measurement is that of the same cycle.
    """

    def __init__(self, recording: Recording, joints: Sequence[str], measured: Any = None) -> None:
        self._recording, self._joints, self._measured = recording, tuple(joints), measured
        self._begin: float | None = None

    def send(self, q: Array, now: float) -> None:
        self._begin = now if self._begin is None else self._begin
        here = None
        if self._measured is not None:
            angles = self._measured()
            here = np.array([angles[name] for name in self._joints])
        self._recording.write(Moment(now - self._begin, commanded=np.asarray(q), measured=here))
