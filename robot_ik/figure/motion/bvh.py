"""BVH, the text format of motion capture: reading, writing, and conversion of robot motions.

Facts of the format (Meredith & Maddock, Motion Capture File Formats Explained, Sheffield 2001):

* Offsets are bone vectors in the axes of the parent joint.
* Each joint lists its channels in its own order. Its rotation is their product in that order.
* Angles are in degrees. Lengths have any unit. By convention y points up.
* An End Site has no channels.
* The frame time is rounded.

The reader keeps the numbers of the file unchanged, so a file that is read and written is the same.

``export_bvh`` writes the motion of a robot, with one BVH joint for each point about which hinges
or a ball rotate a body. Hinges along the axes are written as channels, in the order of the hinges,
and are read back up to rounding. Tilted hinges are converted through a rotation matrix.
``robot_ik.figure.motion.retarget`` converts motions of other skeletons.
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
# Largest relative difference between a rate and the integer that it stands for: a frame time
# of 0.00833 s means 120 Hz.
_RATE_ROUNDING = 2e-3
# The last line before the numbers.
_FRAME_TIME = re.compile(r"Frame\s+Time:\s*\S+", re.IGNORECASE)
# Characters that are searched for the error in a file without such a line.
_HEAD_SIZE = 1 << 20
# Largest number of frames that a file may announce.
_MAX_FRAMES = 10_000_000


@dataclass(frozen=True)
class BvhJoint:
    """One joint of a BVH file.

    Attributes:
        name: Name in the file.
        parent: Index of the parent in the order of the file; -1 for the root.
        offset: Bone vector from the parent, in the units of the file.
        channels: Names of ``CHANNELS``, in the order of the file.
        end: Offset of the End Site; None without one.
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
        joints: Joints in the order of the file: depth first, each parent before its children.
        frame_time: Seconds, as in the file.
        values: (n, channels) as in the file, in degrees and in the units of the file.
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
        """Frames a second. A rounded frame time gives the whole number that it stands for."""
        rate = 1.0 / self.frame_time
        return float(round(rate)) if abs(rate - round(rate)) < _RATE_ROUNDING * rate else rate

    def named(self, name: str) -> int:
        """Return the index of a joint, whatever the case of its name; -1 if there is none."""
        lower = name.lower()
        for j, joint in enumerate(self.joints):
            if joint.name.lower() in (lower, f"{self.prefix}{lower}"):
                return j
        return -1

    @property
    def prefix(self) -> str:
        """The common prefix of all names up to a colon ("mixamorig:"), in lower case."""
        prefixes = {joint.name.lower().rpartition(":")[0] for joint in self.joints}
        return f"{prefixes.pop()}:" if len(prefixes) == 1 and "" not in prefixes else ""

    def channel(self, joint: int, name: str) -> Array | None:
        """Return the numbers (n,) of one channel of a joint; None if the joint lacks it."""
        try:
            channel = self.joints[joint].channels.index(name)
        except ValueError:
            return None
        return self.values[:, self._first[joint] + channel]

    def rotation(self, joint: int) -> Array:
        """Return the rotations (n, 3, 3) of a joint in its parent: the product of its channels."""
        total = np.broadcast_to(np.eye(3), (len(self.values), 3, 3))
        for k, name in enumerate(self.joints[joint].channels):
            if name.endswith("rotation"):
                angle = np.radians(self.values[:, self._first[joint] + k])
                total = total @ axis_rotations(name[0].lower(), angle)
        return np.asarray(total)

    def poses(self) -> tuple[Array, Array]:
        """Return positions (n, joints, 3) and rotations (n, joints, 3, 3).

        Both are in the units and the world axes of the file.
        """
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
                positions[:, j] = offset
                rotations[:, j] = rotation
                continue
            parent = rotations[:, joint.parent]
            positions[:, j] = positions[:, joint.parent] + np.einsum("nij,nj->ni", parent, offset)
            rotations[:, j] = parent @ rotation
        return positions, rotations

    def rest(self) -> Bvh:
        """Return one frame with all angles zero, as the offsets define the skeleton."""
        values = np.zeros((1, self.values.shape[1]))
        for j, joint in enumerate(self.joints):
            for k, name in enumerate(joint.channels):
                if name in POSITION:
                    values[0, self._first[j] + k] = joint.offset[POSITION.index(name)]
        return Bvh(self.joints, self.frame_time, values)

    def save(self, path: Path | str) -> None:
        """Write the file, with numbers in full precision.

        Raises:
            OutputError: The folder is missing or not writable.
        """
        lines = ["HIERARCHY"]
        open_joints: list[int] = []
        for j, joint in enumerate(self.joints):
            while open_joints and open_joints[-1] != joint.parent:
                open_joints.pop()
                lines.append("  " * len(open_joints) + "}")
            tab = "  " * len(open_joints)
            lines += [f"{tab}{'JOINT' if open_joints else 'ROOT'} {joint.name}", f"{tab}{{"]
            lines.append(f"{tab}  OFFSET {_numbers(joint.offset)}")
            channels = " ".join(joint.channels)
            lines.append(f"{tab}  CHANNELS {len(joint.channels)} {channels}".rstrip())
            if joint.end is not None:
                lines += [f"{tab}  End Site", f"{tab}  {{"]
                lines += [f"{tab}    OFFSET {_numbers(joint.end)}", f"{tab}  }}"]
            open_joints.append(j)
        lines += ["  " * depth + "}" for depth in reversed(range(len(open_joints)))]
        lines += ["MOTION", f"Frames: {len(self.values)}", f"Frame Time: {self.frame_time!r}"]
        lines += [_numbers(row) for row in self.values.tolist()]
        write_atomically(Path(path), "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: Path | str) -> Bvh:
        """Read a BVH file.

        Raises:
            ConfigError: The file does not exist or is not BVH. The error names the line and what
                is allowed there.
        """
        file = Path(path)
        return _Reader(file, read_text(file, "the BVH file", errors="replace")).read()


class _Reader:
    """Reader of a BVH text, token by token. It does not recurse, so the nesting has no limit."""

    def __init__(self, file: Path, text: str) -> None:
        self.file = file
        time = _FRAME_TIME.search(text)
        end = time.end() if time else _HEAD_SIZE
        self.numbers_text = text[end:]
        head = text[:end].splitlines()
        self.tokens = [(token, k) for k, line in enumerate(head, 1) for token in line.split()]
        self.next = 0

    def error(self, problem: str, allowed: str = "") -> ConfigError:
        line = 1
        if self.tokens:
            line = self.tokens[min(max(self.next - 1, 0), len(self.tokens) - 1)][1]
        return ConfigError(problem, file=self.file, key=f"line {line}", allowed=allowed)

    def token(self, *allowed: str) -> str:
        """Return the next token, one of ``allowed`` in any case unless ``allowed`` is empty."""
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

    def count(self, limit: int) -> int:
        value = self.number()
        if not (value == int(value) and 0 <= value <= limit):
            raise self.error(f"got {value:g}", f"a whole number, 0 … {limit}")
        return int(value)

    def vector(self) -> tuple[float, float, float]:
        return self.number(), self.number(), self.number()

    def read(self) -> Bvh:
        self.token("HIERARCHY")
        joints = self.hierarchy()
        self.token("MOTION")
        self.token("Frames:")
        frames = self.count(_MAX_FRAMES)
        self.token("Frame")
        self.token("Time:")
        frame_time = self.number()
        if not frame_time > 0.0:
            raise self.error(f"a frame time of {frame_time:g} s", "above zero")
        values = self.numbers()
        width = sum(len(joint.channels) for joint in joints)
        if len(values) != frames * width:
            raise self.error(
                f"{len(values)} numbers for {frames} frames",
                f"{frames} times {width}, one for each channel",
            )
        return Bvh(tuple(joints), frame_time, values.reshape(frames, width))

    def numbers(self) -> Array:
        """Return the numbers after the frame time.

        They are parsed in one call, because a motion may have millions of numbers.
        """
        try:
            values = np.array(self.numbers_text.split(), dtype=float)
        except ValueError:
            values = np.array([np.nan])
        if np.isfinite(values).all():
            return values
        first = self.tokens[-1][1]
        for k, line in enumerate(self.numbers_text.splitlines(), first):
            self.tokens = [(token, k) for token in line.split()]
            self.next = 0
            while self.next < len(self.tokens):
                self.number()
        raise self.error("a number that is not finite")

    def hierarchy(self) -> list[BvhJoint]:
        joints: list[BvhJoint] = []
        open_joints: list[int] = []
        self.token("ROOT")
        while True:
            joints.append(self.joint(open_joints[-1] if open_joints else -1))
            open_joints.append(len(joints) - 1)
            while (token := self.token("JOINT", "End", "}").upper()) != "JOINT":
                if token == "END":
                    self.token("Site")
                    self.token("{")
                    self.token("OFFSET")
                    last = open_joints[-1]
                    joints[last] = replace(joints[last], end=self.vector())
                    self.token("}")
                    continue
                open_joints.pop()
                if not open_joints:
                    return joints

    def joint(self, parent: int) -> BvhJoint:
        name = self.token()
        # A name may contain blanks.
        while self.next < len(self.tokens) and self.tokens[self.next][0] != "{":
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


# From the robot's axes, x forward, y left, z up, to the custom of BVH: X left, Y up, Z forward.
BVH_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
CENTIMETRES = 100.0
_EULER = ("Zrotation", "Xrotation", "Yrotation")
# Largest deviation from 1 of the largest entry of a unit vector along an axis.
_AXIS_TOLERANCE = 1e-9
# Gauss-Newton steps from a rotation to the angles of its hinges.
_HINGE_STEPS = 30
# Largest rotation that these angles may leave, rad.
_HINGE_TOLERANCE = 1e-6
# Length of the End Site of a body without sites, m.
_END_LENGTH = 0.05


@dataclass(frozen=True, eq=False)
class _Node:
    """Joints of one body that rotate about one point."""

    name: str
    parent: int  # -1 for none
    position: Array  # (3,) at qpos0, BVH axes, metres
    joints: tuple[int, ...]  # MuJoCo ids, in order
    axes: Array  # (k, 3) of hinges at qpos0, BVH axes
    kind: int  # MuJoCo's type of the joints; -1 for the root of a fixed base
    body: int

    @property
    def along(self) -> tuple[str, ...] | None:
        """The channel of each hinge; None if a hinge is tilted or a joint is not a hinge."""
        if self.kind != mujoco.mjtJoint.mjJNT_HINGE or len(self.joints) > 3:
            return None
        axes = np.abs(self.axes).argmax(axis=1)
        aligned = (np.abs(self.axes).max(axis=1) > 1.0 - _AXIS_TOLERANCE).all()
        if not aligned or len(set(axes)) < len(axes):
            return None
        return tuple(f"{'XYZ'[axis]}rotation" for axis in axes)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the node.

        All three rotations are listed, because readers expect them. Those without a hinge are zero.
        """
        position_channels = POSITION if self.parent < 0 else ()
        rotations = self.along or ()
        unused = tuple(name for name in _EULER if name not in rotations)
        return (*position_channels, *rotations, *unused)


def data_at_rest(model: mujoco.MjModel) -> mujoco.MjData:
    """Return MuJoCo's data with the kinematics at qpos0."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _nodes(robot: Robot) -> list[_Node]:
    """Return the nodes of a robot, parents first.

    Raises:
        UnsupportedJointError: The robot has a slide.
    """
    model = robot.model
    data = data_at_rest(model)
    nodes: list[_Node] = []
    last: dict[int, int] = {0: -1}  # body -> the last node of the body or of its ancestors
    if not model.njnt or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        nodes.append(_Node("base", -1, np.zeros(3), (), np.zeros((0, 3)), -1, 0))
        last[0] = 0
    for body in range(1, model.nbody):
        parent = last[int(model.body_parentid[body])]
        first = int(model.body_jntadr[body])
        count = int(model.body_jntnum[body])
        groups: list[list[int]] = []
        for j in range(first, first + count):
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                raise UnsupportedJointError(
                    f"joint {model.joint(j).name!r} slides, and BVH has rotational joints only",
                    hint="write CSV: Keyframes.save_csv",
                )
            same_point = groups and np.allclose(
                data.xanchor[j], data.xanchor[groups[-1][0]], rtol=0.0, atol=1e-9
            )
            if same_point and model.jnt_type[j] == model.jnt_type[groups[-1][0]]:
                groups[-1].append(j)
            else:
                groups.append([j])
        for k, group in enumerate(groups):
            name = model.body(body).name or f"body_{body}"
            name = name if k == len(groups) - 1 else f"{name}_{k}"
            position = BVH_AXES @ data.xanchor[group[0]]
            axes = data.xaxis[group] @ BVH_AXES.T
            kind = int(model.jnt_type[group[0]])
            nodes.append(_Node(name, parent, position, tuple(group), axes, kind, body))
            parent = len(nodes) - 1
        last[body] = parent
    return nodes


def export_bvh(motion: Keyframes, rate: float = 60.0) -> Bvh:
    """Return a motion as BVH, with y up, z forward, lengths in centimetres, joints named by body.

    Args:
        motion: Motion of a robot without slides.
        rate: Frames a second.

    Raises:
        UnsupportedJointError: The robot has a slide, which BVH cannot describe.
        TrajectoryError: ``rate`` is not above zero.
    """
    robot = motion.robot
    nodes = _nodes(robot)
    frames = motion.sampled(rate)
    qpos = np.array([robot.qpos(q) for q in frames.q])
    joints = []
    columns = []
    for n, node in enumerate(nodes):
        origin = nodes[node.parent if node.parent >= 0 else n].position  # the root has no offset
        x, y, z = (CENTIMETRES * (node.position - origin)).tolist()
        ends = None if any(other.parent == n for other in nodes) else _end_of(robot, node)
        joints.append(BvhJoint(node.name, node.parent, (x, y, z), node.channels, ends))
        columns.append(_channels_of(robot, node, qpos))
    return Bvh(tuple(joints), 1.0 / rate, np.hstack(columns))


def _end_of(robot: Robot, node: _Node) -> tuple[float, float, float]:
    """Return the End Site of a body without children: the farthest of its sites, cm."""
    model = robot.model
    offsets = [model.site_pos[s] for s in range(model.nsite) if model.site_bodyid[s] == node.body]
    default = np.array([0.0, 0.0, -_END_LENGTH])
    end = max(offsets, key=lambda p: float(np.linalg.norm(p)), default=default)
    x, y, z = (CENTIMETRES * (BVH_AXES @ end)).tolist()
    return x, y, z


def _channels_of(robot: Robot, node: _Node, qpos: Array) -> Array:
    """Return the channels (n, channels) of one node."""
    model = robot.model
    count = len(qpos)
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
    """Return the rotations (n, 3, 3) of a node since qpos0, in its parent, in BVH axes."""
    total = np.broadcast_to(np.eye(3), (len(qpos), 3, 3))
    for axis, j in zip(node.axes, node.joints, strict=True):
        a = int(model.jnt_qposadr[j])
        if node.kind == mujoco.mjtJoint.mjJNT_HINGE:
            total = total @ _rotations_about(axis, qpos[:, a] - model.qpos0[a])
            continue
        a += 3 if node.kind == mujoco.mjtJoint.mjJNT_FREE else 0
        rest = BVH_AXES @ _rest_rotation(model, node.body)
        matrices = _matrices(qpos[:, a : a + 4]) @ _matrices(model.qpos0[None, a : a + 4])[0].T
        # A ball rotates about the axes of its body at rest, a free joint about those of the world.
        axes = rest if node.kind == mujoco.mjtJoint.mjJNT_BALL else BVH_AXES
        total = total @ (axes @ matrices @ axes.T)
    return np.asarray(total)


def _rest_rotation(model: mujoco.MjModel, body: int) -> Array:
    """Return the axes (3, 3) of a ball's quaternion: those of the body without its joint."""
    data = data_at_rest(model)
    parent = data.xmat[model.body_parentid[body]].reshape(3, 3)
    return np.asarray(parent @ _matrices(model.body_quat[None, body])[0])


def _matrices(wxyz: Array) -> Array:
    """Return the matrices (n, 3, 3) of quaternions (n, 4)."""
    return np.array([quat_to_matrix(row) for row in wxyz]).reshape(-1, 3, 3)


def _rotations_about(axis: Array, angle: Array) -> Array:
    """Return rotations (n, 3, 3) about one axis (Rodrigues)."""
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine = np.sin(angle)[:, None, None]
    versine = 1.0 - np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def _euler(rotations: Array) -> Array:
    """Return the Z, X, Y channels (n, 3) in degrees.

    Of the two triples for a rotation, each frame takes the one that is nearer to the frame before.
    Angles never jump by 360 degrees.
    """
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


def exported_motion(bvh: Bvh, robot: Robot) -> Keyframes:
    """Return the motion in a file of ``export_bvh``, which has the skeleton of the robot.

    Args:
        bvh: Read from such a file.
        robot: The robot whose motion was written.

    Raises:
        TrajectoryError: The file has another skeleton, a rotation that the hinges cannot produce,
            or a joint outside its limits.
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
                    raise RuntimeError(f"joint {node.name!r} of the file has no channel {name}")
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
    """Return whether a joint rotates only about its hinges, in their order."""
    rotations = [name for name in bvh.joints[joint].channels if name.endswith("rotation")]
    unused = [bvh.channel(joint, name) for name in rotations[len(along) :]]
    return tuple(rotations[: len(along)]) == along and not any(np.any(values) for values in unused)


def _put_quaternions(bvh: Bvh, n: int, model: mujoco.MjModel, node: _Node, qpos: Array) -> None:
    """Write the numbers of a ball or free joint to ``qpos`` (n, nq), from the file's rotations."""
    a = int(model.jnt_qposadr[node.joints[0]])
    rotations = bvh.rotation(n)
    if node.kind == mujoco.mjtJoint.mjJNT_FREE:
        for axis, name in enumerate(POSITION):
            moved = bvh.channel(n, name)
            if moved is not None:
                qpos[:, a + int(np.argmax(BVH_AXES[axis]))] = moved / CENTIMETRES
        a += 3
        axes = BVH_AXES
    else:
        axes = BVH_AXES @ _rest_rotation(model, node.body)
    matrices = axes.T @ rotations @ axes @ _matrices(model.qpos0[None, a : a + 4])[0]
    qpos[:, a : a + 4] = np.array([matrix_to_quat(matrix) for matrix in matrices]).reshape(-1, 4)


def _hinge_angles(node: _Node, rotations: Array) -> Array:
    """Return the angles (n, k) of hinges with any axes for ``rotations`` (n, 3, 3).

    Gauss-Newton solves for the product of the hinge rotations.

    Raises:
        TrajectoryError: The hinges cannot produce one of the rotations.
    """
    angles = np.zeros((len(rotations), len(node.axes)))
    error = np.zeros((len(rotations), 3))
    for _ in range(_HINGE_STEPS):
        product = np.broadcast_to(np.eye(3), rotations.shape)
        columns = []
        for k, axis in enumerate(node.axes):
            columns.append(product @ axis)
            product = product @ _rotations_about(axis, angles[:, k])
        remaining = rotations @ product.transpose(0, 2, 1)
        logs = [rotation_log(matrix_to_quat(matrix)) for matrix in remaining]
        error = np.array(logs).reshape(-1, 3)
        if np.abs(error).max(initial=0.0) < 1e-15:
            break
        jacobian = np.stack(columns, axis=2)
        angles += np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), error)
    if np.abs(error).max(initial=0.0) > _HINGE_TOLERANCE:
        k = int(np.abs(error).max(axis=1).argmax())
        raise TrajectoryError(
            f"frame {k}: the hinges of {node.name!r} cannot produce its rotation "
            f"({np.degrees(np.abs(error[k]).max()):.2g} degrees remain)",
            hint="motions of other skeletons: robot_ik.figure.motion.retarget",
        )
    return angles
