"""Named poses of a robot and motions through them, kept in a TOML file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from robot_ik.config import (
    SchemaVersion,
    Several,
    Table,
    check_table,
    keys_of,
    parse_toml,
    read_text,
    shown,
)
from robot_ik.errors import ConfigError, TrajectoryError, did_you_mean
from robot_ik.files import write_atomically
from robot_ik.geometry import Array
from robot_ik.kernels.tree import Q_WIDTH
from robot_ik.model import qpos_addresses
from robot_ik.motion.keyframes import Keyframes
from robot_ik.robot import Robot


@dataclass(frozen=True)
class KeySequence:
    """A motion by the names of its poses.

    Attributes:
        poses: Names of the poses in order.
        durations: Seconds of each segment, one less than poses, or as many in a loop. Empty for the
            fastest motion.
        loop: Whether the motion is a loop.
    """

    poses: Annotated[Several[str], Field(description="names of poses")]
    durations: Annotated[Several[float], Field(description="seconds")] = ()
    loop: bool = False


class KeyPoses:
    """Named poses of one robot and motions through them. A TOML file keeps them.

    Attributes:
        robot: The robot.
        poses: Joint vectors (nq,) by name, in the order of recording.
        motions: Motions by name.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.poses: dict[str, Array] = {}
        self.motions: dict[str, KeySequence] = {}

    def __repr__(self) -> str:
        poses = ", ".join(self.poses)
        motions = ", ".join(self.motions)
        return f"KeyPoses({self.robot.name!r}, poses {poses}; motions {motions})"

    def __getitem__(self, name: str) -> Array:
        try:
            return self.poses[name].copy()
        except KeyError:
            raise _unknown("pose", name, self.poses) from None

    def record(self, name: str, q: ArrayLike, *, replace: bool = False) -> Array:
        """Store ``q`` (nq,) under a name, and return a copy.

        Raises:
            TrajectoryError: The name exists or is empty, or a joint is outside its limits.
            ModelError: Wrong length, or a number that is not finite.
        """
        if not name or not name.strip():
            raise TrajectoryError("a pose needs a name", hint="give one, such as 'stand'")
        if name in self.poses and not replace:
            hint = "give another name, or replace=True"
            raise TrajectoryError(f"there is already a pose {name!r}", hint=hint)
        self.poses[name] = Keyframes(self.robot, [0.0], [self.robot.check_q(q)]).q[0]
        return self[name]

    def record_motion(
        self,
        name: str,
        poses: Sequence[str],
        durations: Sequence[float] = (),
        *,
        loop: bool = False,
    ) -> KeySequence:
        """Store a motion through named poses. It replaces a motion of the same name.

        Raises:
            TrajectoryError: A pose does not exist, or the durations do not fit.
        """
        for pose in poses:
            if pose not in self.poses:
                raise _unknown("pose", pose, self.poses)
        segments = len(poses) if loop else len(poses) - 1
        wrong_count = bool(durations) and len(durations) != segments
        if len(poses) < 2 or wrong_count or not all(seconds > 0.0 for seconds in durations):
            raise TrajectoryError(
                f"motion {name!r} got {len(poses)} poses and the durations {list(durations)}",
                hint=f"give two or more poses, and no durations or {max(segments, 1)} above 0 s",
            )
        self.motions[name] = KeySequence(
            tuple(poses), tuple(float(d) for d in durations), bool(loop)
        )
        return self.motions[name]

    def motion(self, name: str, *, speed: float = 1.0) -> Keyframes:
        """Return a motion by name. Segments that are too fast for the robot take longer.

        For a motion with durations, only the limits in the file of the robot count. The limits of
        other joints are a cautious guess.

        Args:
            name: Name of a motion, or of a pose, which is a motion of one key.
            speed: As for ``Keyframes.through``.

        Raises:
            TrajectoryError: There is no such motion or pose.
        """
        if name in self.poses and name not in self.motions:
            return Keyframes(self.robot, [0.0], [self.poses[name]])
        if name not in self.motions:
            raise _unknown("motion", name, [*self.motions, *self.poses])
        sequence = self.motions[name]
        keys = [self[pose] for pose in sequence.poses]
        if sequence.loop:
            keys.append(keys[0])
        return Keyframes.through(
            self.robot,
            keys,
            durations=sequence.durations or 0.0,
            speed=speed,
            velocity_limits=_stated_limits(self.robot) if sequence.durations else None,
            loop=sequence.loop,
        )

    def save(self, path: Path | str) -> None:
        """Write poses and motions as TOML, joint by joint, rad and m in full precision.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        write_atomically(Path(path), self.text())

    def text(self) -> str:
        """Return the TOML text that ``save`` writes."""
        lines = ["schema = 1", f"robot = {_quoted(self.robot.name)}"]
        for name, q in self.poses.items():
            lines += ["", f"[poses.{_quoted(name)}]  # rad, m; quaternions w x y z"]
            for joint, numbers in _numbers_of_joints(self.robot).items():
                values = q[numbers].tolist()
                text = repr(values[0] if len(values) == 1 else values)
                lines.append(f"{_quoted(joint)} = {text}")
        for name, motion in self.motions.items():
            lines += ["", f"[motions.{_quoted(name)}]"]
            lines.append(f"poses = [{', '.join(map(_quoted, motion.poses))}]")
            if motion.durations:
                lines.append(f"durations = {list(motion.durations)!r}  # s")
            lines.append(f"loop = {str(motion.loop).lower()}")
        return "\n".join(lines) + "\n"

    @classmethod
    def load(cls, path: Path | str, robot: Robot) -> KeyPoses:
        """Read a file of ``save``. Joints that a pose does not name are as in the home pose.

        Raises:
            ConfigError: A key is wrong.
        """
        return cls.parse(_text(Path(path)), robot, path)

    @classmethod
    def parse(cls, text: str, robot: Robot, file: Path | str) -> KeyPoses:
        """Read the text of a file of ``save``. ``file`` is its name, for messages.

        Raises:
            ConfigError: A key is wrong.
        """
        file = Path(file)
        content = _content(text, file)
        book = cls(robot)
        for name, joints in content.poses.items():
            q = _pose_of(robot, joints, file, name)
            with _in_file(file, f"poses.{name}"):
                book.record(name, q)
        for name, motion in content.motions.items():
            with _in_file(file, f"motions.{name}"):
                book.record_motion(name, motion.poses, motion.durations, loop=motion.loop)
        return book


def _content(text: str, file: Path) -> _KeyPosesFile:
    """Return the checked content of a text, or raise ``ConfigError``."""
    return check_table(_KeyPosesFile, parse_toml(text, file), file)


def _text(file: Path) -> str:
    """Return the text of a file, or raise ``ConfigError``."""
    return read_text(file, "the key poses", "KeyPoses.save writes one")


class _KeyPosesFile(Table):
    version: SchemaVersion
    robot: str = ""
    poses: dict[str, dict[str, float | Several[float]]] = Field(default={})
    motions: dict[str, Annotated[KeySequence, keys_of(KeySequence)]] = Field(default={})


def _stated_limits(robot: Robot) -> Array:
    """Return the speed limits (nv,) in the file of the robot, infinite for other joints."""
    joints = [robot.joints[int(node)] for node in robot.tree.dof_node]
    is_stated = np.array([joint in robot.file.velocity_limits for joint in joints])
    return np.where(is_stated, robot.velocity_limits, np.inf)


@contextmanager
def _in_file(file: Path, key: str) -> Iterator[None]:
    """Raise a ``TrajectoryError`` of the block as a ``ConfigError`` with file and key."""
    try:
        yield
    except TrajectoryError as error:
        raise ConfigError(str(error.args[0]), file=file, key=key, hint=error.hint) from error


def _pose_of(
    robot: Robot, joints: Mapping[str, float | tuple[float, ...]], file: Path, name: str
) -> Array:
    """Return the home pose (nq,) with the joint values of a table, or raise ``ConfigError``."""
    q = np.array(robot.home)
    for joint, value in joints.items():
        key = f"poses.{name}.{joint}"
        if joint not in robot.joints:
            allowed = f"a joint of {robot.name!r}"
            hint = did_you_mean(joint, robot.joints)
            raise ConfigError("unknown joint", file=file, key=key, allowed=allowed, hint=hint)
        numbers = _numbers_of_joints(robot)[joint]
        width = numbers.stop - numbers.start
        values = [value] if isinstance(value, int | float) else list(value)
        if len(values) != width:
            allowed = "a number, rad or m" if width == 1 else f"{width} numbers"
            raise ConfigError(f"{shown(value)} is not right", file=file, key=key, allowed=allowed)
        q[numbers] = values
    return q


def _numbers_of_joints(robot: Robot) -> dict[str, slice]:
    """Return the slice of q with the numbers of each joint, by name."""
    rows = zip(robot.joints, robot.tree.kind.tolist(), robot.tree.qadr.tolist(), strict=True)
    return {joint: slice(start, start + Q_WIDTH[kind]) for joint, kind, start in rows}


def _quoted(name: str) -> str:
    """Return a TOML string, which can also be a key. TOML has the escapes of JSON."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")


def _unknown(what: str, name: str, known: Iterable[str]) -> TrajectoryError:
    """Return the error for an unknown name."""
    hint = did_you_mean(name, known) or f"known: {', '.join(known) or 'none'}"
    return TrajectoryError(f"there is no {what} {name!r}", hint=hint)


def named_poses(robot: Robot, book: KeyPoses) -> dict[str, Array]:
    """Return poses (nq,) by name: the keyframes of the model and the poses of the file.

    A pose of the file has priority over a keyframe of the same name.
    """
    addresses = qpos_addresses(robot.model, robot.tree)
    keys = [robot.model.key(k) for k in range(robot.model.nkey)]
    return {key.name: np.array(key.qpos[addresses]) for key in keys} | book.poses
