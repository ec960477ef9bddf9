"""BVH, the text format of motion capture: read and written; motions of our robots as BVH, and back.

Facts of the format (Meredith & Maddock, Motion Capture File Formats Explained, Sheffield 2001): offsets are
bone vectors in the parent's axes; each joint lists its own channels in its own order, and its rotation is
their product in that order; angles are degrees, lengths in any unit; y points up by custom; an
End Site has no channels; the frame time is rounded.  Numbers are kept as they stand in the file, so that
what is written again is the same.

``export_bvh`` writes a robot's motion: a BVH joint for each point about which hinges or a ball rotate a body.
Where hinges stand along the axes, their angles are the channels themselves, in the order of the hinges, and
come back to rounding; a tilted hinge goes through a rotation matrix.  Motions of other skeletons are taken
over by ``robot_ik.figure.motion.retarget``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from robot_ik.config import read_text, shown
from robot_ik.errors import ConfigError, TrajectoryError, UnsupportedJointError
from robot_ik.files import write_atomically
from robot_ik.geometry import axis_rotations, matrix_to_quat, quat_to_matrix, rotation_log
from robot_ik.model import qpos_addresses
from robot_ik.motion.keyframes import Keyframes, sign_continuous
from robot_ik.ports import Array
from robot_ik.robot import Robot

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
POSITION = CHANNELS[:3]
# A frame time stands for the whole rate from which it differs by less than this part: 0.00833 means 120 Hz.
_RATE_ROUNDING = 2e-3
# Where the numbers begin; without it so much of a file is searched for what is wrong.
_FRAME_TIME, _LONGEST_HEAD = re.compile(r"Frame\s+Time:\s*\S+", re.IGNORECASE), 1 << 20
_MOST_FRAMES = 10_000_000


@dataclass(frozen=True)
class BvhJoint:
    """One joint of a BVH file.

    Attributes:
        name: As in the file.
        parent: Its index in the file's order; -1: the root.
        offset: Bone vector from the parent, the file's units.
        channels: Names of ``CHANNELS``, in the file's order.
        end: Offset of its End Site; None: it has none.
    """

    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...]
    end: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Bvh:
    """A BVH file.

    Attributes:
        joints: Each behind its parent and what hangs on earlier children of it, as the file nests them.
        frame_time: Seconds, as in the file.
        values: (n, channels) as in the file: degrees, the file's units.
    """

    joints: tuple[BvhJoint, ...]
    frame_time: float
    values: Array
    _first: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        counts = [len(joint.channels) for joint in self.joints]
        object.__setattr__(self, "_first", tuple(int(v) for v in np.append(0, np.cumsum(counts))))
        if self.values.ndim != 2 or self.values.shape[1] != self._first[-1]:
            raise TrajectoryError(
                f"{self._first[-1]} channels got values of shape {self.values.shape}"
            )

    def __repr__(self) -> str:
        return f"Bvh({len(self.joints)} joints, {len(self.values)} frames at {self.rate:.6g} Hz)"

    @property
    def rate(self) -> float:
        """Frames a second: the whole number that the rounded frame time stands for, if there is one."""
        rate = 1.0 / self.frame_time
        return float(round(rate)) if abs(rate - round(rate)) < _RATE_ROUNDING * rate else rate

    def named(self, name: str) -> int:
        """The index of the joint of that name, in any case; -1: there is none."""
        lower = name.lower()
        for j, joint in enumerate(self.joints):
            if joint.name.lower() in (lower, f"{self.prefix}{lower}"):
                return j
        return -1

    @property
    def prefix(self) -> str:
        """What all names begin with up to a colon ("mixamorig:"), in small letters."""
        found = {joint.name.lower().rpartition(":")[0] for joint in self.joints}
        return f"{found.pop()}:" if len(found) == 1 and "" not in found else ""

    def channel(self, joint: int, name: str) -> Array | None:
        """(n,) numbers of one channel of a joint; None: it has none."""
        try:
            return self.values[:, self._first[joint] + self.joints[joint].channels.index(name)]
        except ValueError:
            return None

    def rotation(self, joint: int) -> Array:
        """(n, 3, 3) rotation of a joint against its parent: the product of its channels in their order."""
        total = np.broadcast_to(np.eye(3), (len(self.values), 3, 3))
        for k, name in enumerate(self.joints[joint].channels):
            if name.endswith("rotation"):
                angle = np.radians(self.values[:, self._first[joint] + k])
                total = total @ axis_rotations(name[0].lower(), angle)
        return np.asarray(total)

    def poses(self) -> tuple[Array, Array]:
        """Positions (n, joints, 3), and rotations (n, joints, 3, 3), in the file's units and world."""
        count = len(self.values)
        positions = np.zeros((count, len(self.joints), 3))
        rotations = np.zeros((count, len(self.joints), 3, 3))
        for j, joint in enumerate(self.joints):
            offset = np.tile(np.array(joint.offset), (count, 1))
            for axis, name in enumerate(POSITION):
                moved = self.channel(j, name)
                if moved is not None:  # a position channel replaces the offset
                    offset[:, axis] = moved
            rotation = self.rotation(j)
            if joint.parent < 0:
                positions[:, j], rotations[:, j] = offset, rotation
                continue
            above = rotations[:, joint.parent]
            positions[:, j] = positions[:, joint.parent] + np.einsum("nij,nj->ni", above, offset)
            rotations[:, j] = above @ rotation
        return positions, rotations

    def rest(self) -> Bvh:
        """One frame of the skeleton as its offsets draw it, all angles zero, the root at its offset."""
        values = np.zeros((1, self.values.shape[1]))
        for j, joint in enumerate(self.joints):
            for k, name in enumerate(joint.channels):
                if name in POSITION:
                    values[0, self._first[j] + k] = joint.offset[POSITION.index(name)]
        return Bvh(self.joints, self.frame_time, values)

    def save(self, path: Path | str) -> None:
        """Writes the file, numbers in full precision.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        lines, open_joints = ["HIERARCHY"], list[int]()
        for j, joint in enumerate(self.joints):
            while open_joints and open_joints[-1] != joint.parent:
                open_joints.pop()
                lines.append("  " * len(open_joints) + "}")
            tab = "  " * len(open_joints)
            lines += [f"{tab}{'JOINT' if open_joints else 'ROOT'} {joint.name}", f"{tab}{{"]
            lines.append(f"{tab}  OFFSET {_numbers(joint.offset)}")
            lines.append(
                f"{tab}  CHANNELS {len(joint.channels)} {' '.join(joint.channels)}".rstrip()
            )
            if joint.end is not None:
                lines += [
                    f"{tab}  End Site",
                    f"{tab}  {{",
                    f"{tab}    OFFSET {_numbers(joint.end)}",
                ]
                lines.append(f"{tab}  }}")
            open_joints.append(j)
        lines += ["  " * depth + "}" for depth in reversed(range(len(open_joints)))]
        lines += ["MOTION", f"Frames: {len(self.values)}", f"Frame Time: {self.frame_time!r}"]
        lines += [_numbers(row) for row in self.values.tolist()]
        write_atomically(Path(path), "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: Path | str) -> Bvh:
        """Reads a BVH file.

        Raises:
            ConfigError: It is not there or no BVH; names the line and what should stand there.
        """
        file = Path(path)
        return _Reader(file, read_text(file, "the BVH file", errors="replace")).read()


class _Reader:
    """Reads a BVH text token by token; no recursion, so that no file is nested too deep."""

    def __init__(self, file: Path, text: str) -> None:
        self.file = file
        time = _FRAME_TIME.search(text)
        end = time.end() if time else _LONGEST_HEAD
        self.rest = text[end:]
        head = text[:end].splitlines()
        self.tokens = [(token, k) for k, line in enumerate(head, 1) for token in line.split()]
        self.next = 0

    def error(self, problem: str, allowed: str = "") -> ConfigError:
        line = (
            self.tokens[min(max(self.next - 1, 0), len(self.tokens) - 1)][1] if self.tokens else 1
        )
        return ConfigError(problem, file=self.file, key=f"line {line}", allowed=allowed)

    def token(self, *allowed: str) -> str:
        """The next token, one of ``allowed`` in any case if there are some."""
        self.next += 1
        if self.next > len(self.tokens):
            raise self.error("the file ends too early", " or ".join(allowed))
        token = self.tokens[self.next - 1][0]
        if allowed and token.upper() not in [other.upper() for other in allowed]:
            raise self.error(f"got {shown(token)}", " or ".join(allowed))
        return token

    def number(self) -> float:
        token = self.token()
        try:
            value = float(token)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"got {shown(token)}", "a finite number")
        return value

    def count(self, most: int) -> int:
        value = self.number()
        if not (value == int(value) and 0 <= value <= most):
            raise self.error(f"got {value:g}", f"a whole number, 0 … {most}")
        return int(value)

    def vector(self) -> tuple[float, float, float]:
        return self.number(), self.number(), self.number()

    def read(self) -> Bvh:
        self.token("HIERARCHY")
        joints = self.hierarchy()
        self.token("MOTION")
        self.token("Frames:")
        frames = self.count(_MOST_FRAMES)
        self.token("Frame")
        self.token("Time:")
        frame_time = self.number()
        if not frame_time > 0.0:
            raise self.error(f"a frame time of {frame_time:g} s", "above zero")
        values, width = self.numbers(), sum(len(joint.channels) for joint in joints)
        if len(values) != frames * width:
            raise self.error(
                f"{len(values)} numbers for {frames} frames",
                f"{frames} times {width}, one for each channel",
            )
        return Bvh(tuple(joints), frame_time, values.reshape(frames, width))

    def numbers(self) -> Array:
        """All that comes after the frame time, at once: takes may have millions of numbers."""
        try:
            values = np.array(self.rest.split(), dtype=float)
        except ValueError:
            values = np.array([np.nan])
        if np.isfinite(values).all():
            return values
        first = self.tokens[-1][1]
        for k, line in enumerate(self.rest.splitlines(), first):
            self.tokens, self.next = [(token, k) for token in line.split()], 0
            while self.next < len(self.tokens):
                self.number()
        raise self.error("a number that is not finite")

    def hierarchy(self) -> list[BvhJoint]:
        joints: list[BvhJoint] = []
        above: list[int] = []
        self.token("ROOT")
        while True:
            joints.append(self.joint(above[-1] if above else -1))
            above.append(len(joints) - 1)
            while (token := self.token("JOINT", "End", "}").upper()) != "JOINT":
                if token == "END":
                    self.token("Site")
                    self.token("{")
                    self.token("OFFSET")
                    joints[above[-1]] = replace(joints[above[-1]], end=self.vector())
                    self.token("}")
                    continue
                above.pop()
                if not above:
                    return joints

    def joint(self, parent: int) -> BvhJoint:
        name = self.token()
        while (
            self.next < len(self.tokens) and self.tokens[self.next][0] != "{"
        ):  # names may have blanks
            name += " " + self.token()
        self.token("{")
        self.token("OFFSET")
        offset = self.vector()
        channels: list[str] = []
        if self.next < len(self.tokens) and self.tokens[self.next][0].upper() == "CHANNELS":
            self.token("CHANNELS")
            for _ in range(self.count(len(CHANNELS))):
                token = self.token(*CHANNELS)
                channels.append(token[0].upper() + token[1:].lower())
        if len(set(channels)) < len(channels):
            raise self.error(f"joint {shown(name)} has a channel twice")
        return BvhJoint(name, parent, offset, tuple(channels))


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))


# ------------------------------------------------------------------------------------------
# Motions of our robots.


# Our x (forward), y (left), z (up) in BVH's custom: X left, Y up, Z forward.
BVH_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
CENTIMETRES = 100.0
_EULER = ("Zrotation", "Xrotation", "Yrotation")
# Of a unit vector: so far from an axis it still lies along it.
_ALONG = 1e-9
# Least-squares steps from a rotation to the angles of its hinges, and the angle that may be left, rad.
_HINGE_STEPS, _HINGE_LEFT = 30, 1e-6
# m: End Site of a body that carries no site.
_END = 0.05


@dataclass(frozen=True, eq=False)
class _Node:
    """Where a robot rotates: joints of one body about one point."""

    name: str
    parent: int  # -1: none
    position: Array  # (3,) at qpos0, BVH axes, metres
    joints: tuple[int, ...]  # ids of MuJoCo's, in order
    axes: Array  # (k, 3) of hinges at qpos0, BVH axes
    kind: int  # of its joints (MuJoCo's); -1: the still root of a robot that stands fast
    body: int

    @property
    def along(self) -> tuple[str, ...] | None:
        """Channels that are the hinges themselves; None: some hinge is tilted, or no hinges."""
        if self.kind != mujoco.mjtJoint.mjJNT_HINGE or len(self.joints) > 3:
            return None
        most = np.abs(self.axes).argmax(axis=1)
        straight = (np.abs(self.axes).max(axis=1) > 1.0 - _ALONG).all() and len(set(most)) == len(
            most
        )
        return tuple(f"{'XYZ'[a]}rotation" for a in most) if straight else None

    @property
    def channels(self) -> tuple[str, ...]:
        """All three rotations, for readers that expect them: behind those of the hinges come zeros."""
        position_channels, rotations = POSITION if self.parent < 0 else (), self.along or ()
        return (*position_channels, *rotations, *(name for name in _EULER if name not in rotations))


def data_at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    """MuJoCo's kinematics at qpos0."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _nodes(robot: Robot) -> list[_Node]:
    """Where the robot rotates, parents first.

    Raises:
        UnsupportedJointError: A slide, or joints of several kinds about one point.
    """
    model, data = robot.model, data_at_rest(robot.model)
    nodes: list[_Node] = []
    last: dict[int, int] = {0: -1}  # body -> the last node at or above it
    if not model.njnt or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        nodes.append(_Node("base", -1, np.zeros(3), (), np.zeros((0, 3)), -1, 0))
        last[0] = 0
    for body in range(1, model.nbody):
        above = last[int(model.body_parentid[body])]
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        groups: list[list[int]] = []
        for j in range(first, first + count):
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                raise UnsupportedJointError(
                    f"joint {model.joint(j).name!r} slides, and BVH has rotational joints only",
                    hint="write CSV: Keyframes.save_csv",
                )
            same = groups and np.abs(data.xanchor[j] - data.xanchor[groups[-1][0]]).max() < 1e-9
            if same and model.jnt_type[j] == model.jnt_type[groups[-1][0]]:
                groups[-1].append(j)
            else:
                groups.append([j])
        for k, group in enumerate(groups):
            name = model.body(body).name or f"body_{body}"
            name = name if k == len(groups) - 1 else f"{name}_{k}"
            at, axes = BVH_AXES @ data.xanchor[group[0]], data.xaxis[group] @ BVH_AXES.T
            nodes.append(
                _Node(name, above, at, tuple(group), axes, int(model.jnt_type[group[0]]), body)
            )
            above = len(nodes) - 1
        last[body] = above
    return nodes


def export_bvh(motion: Keyframes, rate: float = 60.0) -> Bvh:
    """A motion as BVH: y up, z forward, centimetres; our joints' names are the bodies'.

    Args:
        motion: Of any robot without slides.
        rate: Frames a second.

    Raises:
        UnsupportedJointError: The robot has slides, which BVH does not know.
        TrajectoryError: ``rate`` is not above zero.
    """
    robot, nodes = motion.robot, _nodes(motion.robot)
    frames = motion.sampled(rate)
    qpos = np.array([robot.qpos(q) for q in frames.q])
    joints, columns = [], []
    for n, node in enumerate(nodes):
        above = nodes[node.parent if node.parent >= 0 else n].position  # the root has no offset
        x, y, z = (CENTIMETRES * (node.position - above)).tolist()
        ends = None if any(other.parent == n for other in nodes) else _end_of(robot, node)
        joints.append(BvhJoint(node.name, node.parent, (x, y, z), node.channels, ends))
        columns.append(_channels_of(robot, node, qpos))
    return Bvh(tuple(joints), 1.0 / rate, np.hstack(columns))


def _end_of(robot: Robot, node: _Node) -> tuple[float, float, float]:
    """End Site of a last body: the farthest of its sites."""
    model = robot.model
    offsets = [model.site_pos[s] for s in range(model.nsite) if model.site_bodyid[s] == node.body]
    far = max(offsets, key=lambda p: float(np.linalg.norm(p)), default=np.array([0.0, 0.0, -_END]))
    x, y, z = (CENTIMETRES * (BVH_AXES @ far)).tolist()
    return x, y, z


def _channels_of(robot: Robot, node: _Node, qpos: Array) -> Array:
    """(n, channels) of one node."""
    model, count = robot.model, len(qpos)
    free = node.kind == mujoco.mjtJoint.mjJNT_FREE
    positions = np.zeros((count, 3 if node.parent < 0 else 0))
    if not node.joints:
        return np.zeros((count, len(node.channels)))
    address = [int(model.jnt_qposadr[j]) for j in node.joints]
    if free:
        positions = CENTIMETRES * qpos[:, address[0] : address[0] + 3] @ BVH_AXES.T
    if node.along:
        signs = np.sign(node.axes[np.arange(len(address)), np.abs(node.axes).argmax(axis=1)])
        start = np.array([model.qpos0[a] for a in address])
        spare = np.zeros((count, 3 - len(address)))
        return np.hstack([positions, np.degrees((qpos[:, address] - start) * signs), spare])
    return np.hstack([positions, _euler(_rotation_of(model, node, qpos))])


def _rotation_of(model: mujoco.MjModel, node: _Node, qpos: Array) -> Array:
    """(n, 3, 3) rotation of a node from qpos0 against the one above, BVH axes."""
    total = np.broadcast_to(np.eye(3), (len(qpos), 3, 3))
    for axis, j in zip(node.axes, node.joints, strict=True):
        a = int(model.jnt_qposadr[j])
        if node.kind == mujoco.mjtJoint.mjJNT_HINGE:
            total = total @ _rotations_about(axis, qpos[:, a] - model.qpos0[a])
            continue
        a += 3 if node.kind == mujoco.mjtJoint.mjJNT_FREE else 0
        rest = BVH_AXES @ _rest_rotation(model, node.body)
        matrices = _matrices(qpos[:, a : a + 4]) @ _matrices(model.qpos0[None, a : a + 4])[0].T
        # In the body's axes at rest, seen in BVH's: a ball rotates about axes that the body carries.
        total = total @ (rest @ matrices @ rest.T if node.kind == mujoco.mjtJoint.mjJNT_BALL else
                         BVH_AXES @ matrices @ BVH_AXES.T)  # fmt: skip
    return np.asarray(total)


def _rest_rotation(model: mujoco.MjModel, body: int) -> Array:
    """(3, 3) the axes at qpos0 in which a ball's quaternion is: the body's without its joint."""
    data = data_at_rest(model)
    parent = data.xmat[model.body_parentid[body]].reshape(3, 3)
    return np.asarray(parent @ _matrices(model.body_quat[None, body])[0])


def _matrices(wxyz: Array) -> Array:
    """(n, 3, 3) of quaternions (n, 4)."""
    return np.array([quat_to_matrix(one) for one in wxyz]).reshape(-1, 3, 3)


def _rotations_about(axis: Array, angle: Array) -> Array:
    """(n, 3, 3) rotations about one axis (Rodrigues)."""
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * cross + (1.0 - c) * (cross @ cross))


def _euler(rotations: Array) -> Array:
    """(n, 3) degrees of Z, X, Y channels, each frame's the nearer of the two forms, without jumps of 360."""
    x = np.arcsin(np.clip(rotations[:, 2, 1], -1.0, 1.0))
    z = np.arctan2(-rotations[:, 0, 1], rotations[:, 1, 1])
    y = np.arctan2(-rotations[:, 2, 0], rotations[:, 2, 2])
    angles = np.stack([z, x, y], axis=1)
    out = angles.copy()
    for k in range(1, len(out)):
        other = np.array([out[k, 0] + np.pi, np.pi - out[k, 1], out[k, 2] + np.pi])
        forms = [
            form - 2.0 * np.pi * np.rint((form - out[k - 1]) / (2.0 * np.pi))
            for form in (out[k], other)
        ]
        out[k] = min(forms, key=lambda form: float(np.abs(form - out[k - 1]).max()))
    return np.degrees(out)


def own_motion(bvh: Bvh, robot: Robot) -> Keyframes:
    """The motion in a file of ``export_bvh``: the same skeleton, joint for joint.

    Args:
        bvh: Read from such a file.
        robot: The robot that was written.

    Raises:
        TrajectoryError: Another skeleton, a rotation that the hinges cannot make, a joint outside its limits.
    """
    nodes = _nodes(robot)
    if [node.name for node in nodes] != [joint.name for joint in bvh.joints]:
        missing = [node.name for node in nodes if bvh.named(node.name) < 0]
        raise TrajectoryError(
            f"the file's skeleton is not that of {robot.name!r}"
            + (f": it has no {missing[0]!r}" if missing else ""),
            hint="motions of other skeletons: robot_ik.figure.motion.retarget",
        )
    model = robot.model
    qpos = np.tile(robot.qpos(robot.home), (len(bvh.values), 1))
    for n, node in enumerate(nodes):
        address = [int(model.jnt_qposadr[j]) for j in node.joints]
        if node.along and _only_rotations(bvh, n, node.along):
            for a, axis, name in zip(address, node.axes, node.along, strict=True):
                angle = bvh.channel(n, name)
                if angle is None:
                    raise RuntimeError(
                        "a joint of the file has no channel of the axis that it turns about"
                    )
                qpos[:, a] = model.qpos0[a] + np.radians(angle) * np.sign(
                    axis[np.abs(axis).argmax()]
                )
        elif node.kind == mujoco.mjtJoint.mjJNT_HINGE:
            qpos[:, address] = model.qpos0[address] + _hinge_angles(node, bvh.rotation(n))
        elif node.joints:
            _put_quaternions(bvh, n, model, node, qpos)
    rows = qpos[:, qpos_addresses(robot.model, robot.tree)]
    return Keyframes(robot, np.arange(len(rows)) / bvh.rate, sign_continuous(robot, rows))


def _only_rotations(bvh: Bvh, joint: int, along: tuple[str, ...]) -> bool:
    """Whether a joint rotates about its hinges in their order, and about nothing else."""
    rotations = [name for name in bvh.joints[joint].channels if name.endswith("rotation")]
    spare = [bvh.channel(joint, name) for name in rotations[len(along) :]]
    return tuple(rotations[: len(along)]) == along and not any(np.any(values) for values in spare)


def _put_quaternions(bvh: Bvh, n: int, model: mujoco.MjModel, node: _Node, qpos: Array) -> None:
    """The numbers of a ball or free joint, from the file's rotations."""
    a, rotations = int(model.jnt_qposadr[node.joints[0]]), bvh.rotation(n)
    if node.kind == mujoco.mjtJoint.mjJNT_FREE:
        for axis, name in enumerate(POSITION):
            moved = bvh.channel(n, name)
            if moved is not None:
                qpos[:, a + int(np.argmax(BVH_AXES[axis]))] = moved / CENTIMETRES
        a, axes = a + 3, BVH_AXES
    else:
        axes = BVH_AXES @ _rest_rotation(model, node.body)
    matrices = axes.T @ rotations @ axes @ _matrices(model.qpos0[None, a : a + 4])[0]
    qpos[:, a : a + 4] = np.array([matrix_to_quat(matrix) for matrix in matrices]).reshape(-1, 4)


def _hinge_angles(node: _Node, rotations: Array) -> Array:
    """(n, k) angles of hinges with any axes whose product is ``rotations`` (n, 3, 3), by Gauss-Newton.

    Raises:
        TrajectoryError: There are none.
    """
    angles = np.zeros((len(rotations), len(node.axes)))
    error = np.zeros((len(rotations), 3))
    for _ in range(_HINGE_STEPS):
        made = np.broadcast_to(np.eye(3), rotations.shape)
        columns = []
        for k, axis in enumerate(node.axes):
            columns.append(made @ axis)
            made = made @ _rotations_about(axis, angles[:, k])
        left = rotations @ made.transpose(0, 2, 1)
        error = np.array([rotation_log(matrix_to_quat(matrix)) for matrix in left]).reshape(-1, 3)
        if np.abs(error).max(initial=0.0) < 1e-15:
            break
        jacobian = np.stack(columns, axis=2)
        angles += np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), error)
    if np.abs(error).max(initial=0.0) > _HINGE_LEFT:
        k = int(np.abs(error).max(axis=1).argmax())
        raise TrajectoryError(
            f"frame {k}: {node.name!r} is rotated as its hinges cannot rotate it "
            f"({np.degrees(np.abs(error[k]).max()):.2g} degrees are left)",
            hint="motions of other skeletons: robot_ik.figure.motion.retarget",
        )
    return angles
