"""Recordings of commanded and measured joint positions as CSV tables or MCAP files.

Rows are written during the run. MCAP files contain ROS 2 messages (profile ``ros2``, encoding CDR).
``ros2 bag``, Foxglove, PlotJuggler and Rerun open them. ``mcap recover`` repairs a truncated file.
"""

from __future__ import annotations

import contextlib
import csv
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_ik.errors import ConfigError, MissingExtraError, OutputError
from robot_ik.motion.joint_table import JointTable, Moment
from robot_ik.ports import Array, Closing

SUFFIXES = (".csv", ".mcap")
"""Suffixes of the supported formats."""

FRAME = "world"
"""Frame of the goals in an MCAP file."""

Measured = Callable[[], Mapping[str, float]]
"""Returns the last measured joint positions by joint name, rad for hinges and metres for slides."""


class Recording(Closing):
    """A file to which moments are written until it is closed.

    If writing fails, as on a full disk, the file is removed, because a partial file is invalid.

    Args:
        path: The file.
        mode: Mode of ``open``.

    Raises:
        OutputError: The file cannot be written. All methods raise it.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self._path = path
        newline = "" if mode == "w" else None
        try:
            self._file: Any = open(path, mode, newline=newline)  # noqa: SIM115
        except OSError as error:
            raise self._write_error(error) from error

    def write(self, moment: Moment) -> None:
        """Append one moment."""
        with self._removed_on_error():
            self._write(moment)

    def close(self) -> None:
        """Complete the file and close it."""
        if not self._file.closed:
            with self._removed_on_error():
                self._finish()
                self._file.close()

    def _write(self, moment: Moment) -> None:
        raise NotImplementedError

    def _finish(self) -> None:
        """Write the end of the file."""

    @contextlib.contextmanager
    def _removed_on_error(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # close tries to flush the buffer again
                self._file.close()
            with contextlib.suppress(OSError):
                self._path.unlink()
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path} cannot be written: {error.strerror or error}")


class TableRecording(Recording):
    """A CSV file with one row per moment. Cells of unknown values are empty."""

    def __init__(self, path: Path, table: JointTable) -> None:
        super().__init__(path, "w")
        self._table = table
        self._rows = csv.writer(self._file, lineterminator="\n")
        with self._removed_on_error():
            self._rows.writerow(table.header)

    def _write(self, moment: Moment) -> None:
        self._rows.writerow(self._table.row(moment))


_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
"""Definitions of the messages that other messages contain."""


def _schema(text: str, *contained: str) -> str:
    """Return a ROS 2 message definition with the contained messages, as MCAP stores it."""
    names = ("builtin_interfaces/Time", *contained)
    parts = (f"{'=' * 80}\nMSG: {name}\n{_PARTS[name]}" for name in names)
    return "\n".join([text, *parts])


MESSAGES: Mapping[str, str] = {
    "sensor_msgs/msg/JointState": _schema(
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort",
        "std_msgs/Header",
    ),
    "geometry_msgs/msg/PoseStamped": _schema(
        "std_msgs/Header header\ngeometry_msgs/Pose pose",
        "std_msgs/Header",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ),
    "rcl_interfaces/msg/Log": _schema(
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\n"
        "string function\nuint32 line"
    ),
}
"""ROS 2 message definition by message type."""

_INFO = 20
"""Level INFO of ``rcl_interfaces/msg/Log``."""


class McapRecording(Recording):
    """An MCAP file with the topics ``/joint_commands``, ``/joint_states``, ``/goal``, ``/rosout``.

    If there are several robots side by side, the topics of robot 1 are below ``/robot_1``, and so
    on.
    """

    def __init__(self, path: Path, table: JointTable) -> None:
        from mcap_ros2.writer import Writer  # of the extra `record`

        super().__init__(path, "wb")
        self._joints = list(table.joints)
        self._begin = time.time_ns()
        with self._removed_on_error():
            self._writer: Any = Writer(self._file)
            self._schemas = {
                name: self._writer.register_msgdef(name, text) for name, text in MESSAGES.items()
            }

    def _write(self, moment: Moment) -> None:
        time_ns = self._begin + round(1e9 * moment.now)
        stamp = {"sec": time_ns // 1_000_000_000, "nanosec": time_ns % 1_000_000_000}
        header = {"stamp": stamp, "frame_id": FRAME}
        namespace = f"/robot_{moment.robot}" if moment.robot else ""

        topics = (("joint_commands", moment.commanded), ("joint_states", moment.measured))
        for topic, positions in topics:
            if positions is not None:
                state = {
                    "header": header,
                    "name": self._joints,
                    "position": positions.tolist(),
                    "velocity": [],
                    "effort": [],
                }
                self._put(f"{namespace}/{topic}", "sensor_msgs/msg/JointState", state, time_ns)

        if moment.goal is not None:
            pose = {
                "position": dict(zip("xyz", moment.goal.position.tolist(), strict=True)),
                "orientation": dict(zip("wxyz", moment.goal.wxyz.tolist(), strict=True)),
            }
            stamped = {"header": header, "pose": pose}
            self._put(f"{namespace}/goal", "geometry_msgs/msg/PoseStamped", stamped, time_ns)

        if moment.text:
            log = {
                "stamp": stamp,
                "level": _INFO,
                "name": "robot_ik",
                "msg": moment.text,
                "file": "",
                "function": "",
                "line": 0,
            }
            self._put("/rosout", "rcl_interfaces/msg/Log", log, time_ns)

    def _put(self, topic: str, kind: str, message: dict[str, Any], time_ns: int) -> None:
        schema = self._schemas[kind]
        self._writer.write_message(topic, schema, message, log_time=time_ns, publish_time=time_ns)

    def _finish(self) -> None:
        self._writer.finish()


def require_recording(path: Path) -> None:
    """Check that a recording of this name can be written.

    Call it before the work begins.

    Raises:
        ConfigError: The suffix belongs to no supported format.
        MissingExtraError: The suffix is ``.mcap``, but the extra ``record`` is not installed.
    """
    if path.suffix not in SUFFIXES:
        problem = f"the name {path.name!r} has no known suffix"
        allowed = " or ".join(SUFFIXES)
        raise ConfigError(problem, file="command line", key="--record", allowed=allowed)
    if path.suffix == ".mcap":
        try:
            import mcap_ros2  # noqa: F401
        except ImportError as reason:
            raise MissingExtraError("mcap_ros2", "record", "an MCAP file") from reason


def open_recording(path: Path, joints: Sequence[str], extra: Sequence[str] = ()) -> Recording:
    """Return a recording in the format of the file's suffix.

    The recording is a context manager, which closes the file.

    Args:
        path: The file, ``.csv`` or ``.mcap``.
        joints: Names of the positions, in the order of the vectors.
        extra: Names of further columns of a CSV file.

    Raises:
        ConfigError: The suffix belongs to no supported format.
        MissingExtraError: The suffix is ``.mcap``, but the extra ``record`` is not installed.
        OutputError: The file cannot be written.
    """
    require_recording(path)
    kind = TableRecording if path.suffix == ".csv" else McapRecording
    return kind(path, JointTable(joints, extra))


class RecordingSink:
    """A ``JointSink`` that records each command and the last measurement.

    Put it behind the arm among the sinks. Then command and measurement are of the same cycle.

    Args:
        recording: The open recording.
        joints: Names of the joints, in the order of the commands.
        measured: Returns the last measurement. None: only commands are recorded.
    """

    def __init__(
        self, recording: Recording, joints: Sequence[str], measured: Measured | None = None
    ) -> None:
        self._recording = recording
        self._joints = tuple(joints)
        self._measured = measured
        self._begin: float | None = None

    def send(self, q: Array, now: float) -> None:
        """Record the command ``q`` (n,) and the measurement at the time ``now``, seconds."""
        if self._begin is None:
            self._begin = now
        measured = None
        if self._measured is not None:
            positions = self._measured()
            measured = np.array([positions[name] for name in self._joints])
        moment = Moment(now - self._begin, commanded=np.asarray(q), measured=measured)
        self._recording.write(moment)
