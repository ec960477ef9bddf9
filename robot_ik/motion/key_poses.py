"""Named poses of a robot and motions through them, in a TOML file that people can edit."""

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

from robot_ik.config import SchemaVersion, Several, Table, keys_of, read_table, shown
from robot_ik.errors import ConfigError, TrajectoryError, UnknownJointError, did_you_mean
from robot_ik.files import write_atomically
from robot_ik.goals import Goal, PoseGoal, PositionGoal, PostureGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.kernels.tree import HINGE, Q_WIDTH, SLIDE
from robot_ik.model import qpos_addresses
from robot_ik.motion.keyframes import Keyframes
from robot_ik.ports import Array
from robot_ik.robot import Robot
from robot_ik.robot_file import catalogue


@dataclass(frozen=True)
class KeySequence:
    """A motion by the names of its poses.

    Attributes:
        poses: Names, in order.
        durations: Seconds of each segment, one less than poses (in a loop: as many); empty: the fastest.
        loop: Whether it runs round.
    """

    poses: Annotated[Several[str], Field(description="names of poses")]
    durations: Annotated[Several[float], Field(description="seconds")] = ()
    loop: bool = False


class KeyPoses:
    """Named poses of one robot and motions through them; kept in a TOML file that people can edit.

    Attributes:
        robot: Whose.
        poses: (nq,) by name, in the order in which they were recorded.
        motions: By name.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.poses: dict[str, Array] = {}
        self.motions: dict[str, KeySequence] = {}

    def __repr__(self) -> str:
        return (
            f"KeyPoses({self.robot.name!r}, poses {', '.join(self.poses)}; motions {', '.join(self.motions)})"
        )

    def __getitem__(self, name: str) -> Array:
        try:
            return self.poses[name].copy()
        except KeyError:
            raise _unknown("pose", name, self.poses) from None

    def record(self, name: str, q: ArrayLike, *, replace: bool = False) -> Array:
        """Keeps ``q`` (nq,) under a name.

        Raises:
            TrajectoryError: The name is taken or empty, or a joint stands outside its limits.
            ModelError: Wrong length, or a number that is not finite.
        """
        if not name or not name.strip():
            raise TrajectoryError("a pose needs a name", hint="such as 'stand'")
        if name in self.poses and not replace:
            raise TrajectoryError(f"there is a pose {name!r} already", hint="another name, or replace=True")
        self.poses[name] = Keyframes(self.robot, [0.0], [self.robot.check_q(q)]).q[0]
        return self[name]

    def record_motion(
        self, name: str, poses: Sequence[str], durations: Sequence[float] = (), *, loop: bool = False
    ) -> KeySequence:
        """Keeps a motion through named poses; another of that name is replaced.

        Raises:
            TrajectoryError: A pose that is not there, or durations that do not fit.
        """
        for pose in poses:
            _ = self[pose]
        ways = len(poses) if loop else len(poses) - 1
        if len(poses) < 2 or (durations and len(durations) != ways) or not all(d > 0.0 for d in durations):
            raise TrajectoryError(
                f"motion {name!r} got {len(poses)} poses and the durations {list(durations)}",
                hint=f"two or more poses, and no durations or {max(ways, 1)}, each above 0 s",
            )
        self.motions[name] = KeySequence(tuple(poses), tuple(float(d) for d in durations), bool(loop))
        return self.motions[name]

    def motion(self, name: str, *, speed: float = 1.0) -> Keyframes:
        """The motion of that name; ways that are too short for the robot's speed limits take longer.

        Where a motion has durations, only limits that the robot's file states count: those of other joints
        are a cautious guess.

        Args:
            name: Of a motion; that of a pose is the pose, held.
            speed: As in ``Keyframes.through``.
        """
        if name in self.poses and name not in self.motions:
            return Keyframes(self.robot, [0.0], [self.poses[name]])
        try:
            wanted = self.motions[name]
        except KeyError:
            raise _unknown("motion", name, [*self.motions, *self.poses]) from None
        velocity_limits = _stated_limits(self.robot) if wanted.durations else None
        keys = [self[pose] for pose in wanted.poses]
        if wanted.loop:
            keys.append(keys[0])
        durations, loop = wanted.durations or 0.0, wanted.loop
        return Keyframes.through(
            self.robot, keys, durations=durations, speed=speed, velocity_limits=velocity_limits, loop=loop
        )

    def save(self, path: Path | str) -> None:
        """Writes poses and motions as TOML, joint by joint, rad and m in full precision.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        lines = ["schema = 1", f"robot = {_quoted(self.robot.name)}"]
        for name, q in self.poses.items():
            lines += ["", f"[poses.{_quoted(name)}]  # rad, m; quaternions w x y z"]
            for joint, numbers in _numbers_of_joints(self.robot).items():
                values = q[numbers].tolist()
                lines.append(f"{_quoted(joint)} = {values[0] if len(values) == 1 else values!r}")
        for name, motion in self.motions.items():
            lines += ["", f"[motions.{_quoted(name)}]"]
            lines.append(f"poses = [{', '.join(map(_quoted, motion.poses))}]")
            if motion.durations:
                lines.append(f"durations = {list(motion.durations)!r}  # s")
            lines.append(f"loop = {str(motion.loop).lower()}")
        write_atomically(Path(path), "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: Path | str, robot: Robot) -> KeyPoses:
        """Reads what ``save`` wrote; joints that a pose does not name are as in the home pose.

        Raises:
            ConfigError: With file, key and what is allowed.
        """
        file = Path(path)
        content = _content(file)
        book = cls(robot)
        for name, joints in content.poses.items():
            q = _pose_of(robot, joints, file, name)
            with _in_file(file, f"poses.{name}"):
                book.record(name, q)
        for name, motion in content.motions.items():
            with _in_file(file, f"motions.{name}"):
                book.record_motion(name, motion.poses, motion.durations, loop=motion.loop)
        return book


def _content(file: Path) -> _KeyPosesFile:
    return read_table(_KeyPosesFile, file, "the key poses", "robot-ik poses record makes one")


def robot_named_in(path: Path | str) -> str:
    """The robot of the catalogue that a file of key poses names; empty: it names none.

    Raises:
        ConfigError: It names another one, or as ``KeyPoses.load``.
    """
    name = _content(Path(path)).robot
    known = catalogue()
    if name and name not in known:
        raise ConfigError(
            f"no robot of the catalogue is called {name!r}", file=path, key="robot", allowed=", ".join(known),
            hint="of a model of your own say which file it is: --robot PATH",
        )  # fmt: skip
    return name


class _KeyPosesFile(Table):
    version: SchemaVersion
    robot: str = ""
    poses: dict[str, dict[str, float | Several[float]]] = Field(default={})
    motions: dict[str, Annotated[KeySequence, keys_of(KeySequence)]] = Field(default={})


def _stated_limits(robot: Robot) -> Array:
    """(nv,) the robot's speed limits, none for joints of which its file says nothing."""
    stated = np.array([robot.joints[int(node)] in robot.file.velocity_limits for node in robot.tree.dof_node])
    return np.where(stated, robot.velocity_limits, np.inf)


@contextmanager
def _in_file(file: Path, key: str) -> Iterator[None]:
    """Says where in a file it was that something was wrong."""
    try:
        yield
    except TrajectoryError as error:
        raise ConfigError(str(error.args[0]), file=file, key=key, hint=error.hint) from error


def _pose_of(robot: Robot, joints: Mapping[str, float | tuple[float, ...]], file: Path, name: str) -> Array:
    """(nq,) home with the joints that a table names."""
    q = np.array(robot.home)
    for joint, value in joints.items():
        key = f"poses.{name}.{joint}"
        if joint not in robot.joints:
            hint = did_you_mean(joint, robot.joints)
            raise ConfigError(
                "unknown joint", file=file, key=key, allowed=f"a joint of {robot.name!r}", hint=hint
            )
        numbers = _numbers_of_joints(robot)[joint]
        width = numbers.stop - numbers.start
        values = [value] if isinstance(value, int | float) else list(value)
        if len(values) != width:
            allowed = "a number, rad or m" if width == 1 else f"{width} numbers"
            raise ConfigError(f"{shown(value)} is not right", file=file, key=key, allowed=allowed)
        q[numbers] = values
    return q


def _numbers_of_joints(robot: Robot) -> dict[str, slice]:
    """Where every joint's numbers stand in q."""
    starts = zip(robot.joints, robot.tree.kind.tolist(), robot.tree.qadr.tolist(), strict=True)
    return {joint: slice(first, first + Q_WIDTH[kind]) for joint, kind, first in starts}


def _quoted(name: str) -> str:
    """A TOML string, also good as a key: JSON's escapes are among TOML's."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")


def _unknown(what: str, name: str, known: Iterable[str]) -> TrajectoryError:
    hint = did_you_mean(name, known) or f"known: {', '.join(known) or 'none'}"
    return TrajectoryError(f"there is no {what} {name!r}", hint=hint)


# ------------------------------------------------------------------------------------------
# Poses made from others: with joints at other angles, with frames brought to positions.

_FEET = ("_foot", "_paw")  # frames whose names end so stand on the floor


def named_poses(robot: Robot, book: KeyPoses) -> dict[str, Array]:
    """(nq,) by name: those of the file, and the keyframes of the model that it does not have."""
    places = qpos_addresses(robot.model, robot.tree)
    keys = [robot.model.key(k) for k in range(robot.model.nkey)]
    return {**{key.name: np.array(key.qpos[places]) for key in keys}, **book.poses}


def with_joint(robot: Robot, q: Array, joint: str, value: float) -> Array:
    """The pose (nq,) with one joint at another value: degrees of a hinge, metres of a slide.

    Raises:
        UnknownJointError: No such joint.
        ValueError: It is neither, or the value is not finite.
    """
    if joint not in robot.joints:
        raise UnknownJointError(joint, robot.joints)
    k = robot.joints.index(joint)
    kind = int(robot.tree.kind[k])
    if kind not in (HINGE, SLIDE) or not np.isfinite(value):
        raise ValueError(f"{joint} is no hinge and no slide, or {value} is not finite")
    changed = np.array(q)
    changed[int(robot.tree.qadr[k])] = np.radians(value) if kind == HINGE else value
    return changed


def pose_reaching(robot: Robot, q: Array, positions: Mapping[str, Sequence[float]]) -> Array | None:
    """The pose near ``q`` that brings frames to positions while the other feet stay where they are.

    Args:
        robot: Whose.
        q: (nq,) where it starts.
        positions: Frame -> x, y, z in the world, m.

    Returns:
        (nq,), or None: out of reach.
    """
    goals: list[Goal] = [PositionGoal(frame, position) for frame, position in positions.items()]
    feet = [frame for frame in robot.file.tools if frame.endswith(_FEET) and frame not in positions]
    goals += [PoseGoal.at(frame, robot.forward(q, frame)) for frame in feet]
    found = solve(robot, [*goals, PostureGoal(q=q, soft=True)], solver="lm", start=q)
    return np.array(found.q) if found.converged else None
