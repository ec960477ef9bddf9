"""BVH, the text format of motion capture: read, write, and our robots' motions in it.

Facts of the format (Meredith & Maddock, Motion Capture File Formats Explained, Sheffield 2001): offsets are
bone vectors in the parent's axes; each joint lists its own channels in its own order, and its rotation is
their product in that order; angles are degrees, lengths whatever the studio had; y points up by custom; an
End Site has no channels; the frame time is rounded.  Numbers are kept as they stand in the file, so that
what is written again is the same.

``export_bvh`` writes a robot's motion: one BVH joint for each place at which hinges or a ball turn a body.
Where hinges stand along the axes, their angles are the channels themselves, in the order of the hinges, and
come back to rounding; a tilted hinge goes through a rotation matrix.  Motions of other skeletons are taken
over by ``robot_ik.motion.retarget``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from robot_ik.errors import ConfigError, TrajectoryError, UnsupportedJointError
from robot_ik.files import write_atomically
from robot_ik.kernels.tree import Q_WIDTH
from robot_ik.motion.keyframes import Keyframes, sign_continuous
from robot_ik.ports import Array
from robot_ik.reading import read_text, shown
from robot_ik.robot import Robot

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
# Our x (forward), y (left), z (up) in BVH's custom: X left, Y up, Z forward.
BVH_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
CENTIMETRES = 100.0
_EULER = ("Zrotation", "Xrotation", "Yrotation")
_POSITION = CHANNELS[:3]
# Of a unit vector: so far from an axis it still lies along it.
_ALONG = 1e-9
# Least-squares steps from a rotation to the angles of its hinges, and the angle that may be left, rad.
_HINGE_STEPS, _HINGE_LEFT = 30, 1e-6
# A frame time stands for the whole rate from which it differs by less than this part: 0.00833 means 120 Hz.
_RATE_ROUNDING = 2e-3
# Where the numbers begin; without it so much of a file is looked at for what is wrong.
_FRAME_TIME, _LONGEST_HEAD = re.compile(r"Frame\s+Time:\s*\S+", re.IGNORECASE), 1 << 20
_MOST_FRAMES = 10_000_000
# m: End Site of a body that carries no site.
_END = 0.05


@dataclass(frozen=True)
class BvhJoint:
    """One joint of a BVH file.

    Attributes:
        name: As in the file.
        parent: Its place in the file's order; -1: the root.
        offset: Bone vector from the parent, the file's units.
        channels: Words of ``CHANNELS``, in the file's order.
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
            raise TrajectoryError(f"{self._first[-1]} channels got values of shape {self.values.shape}")

    def __repr__(self) -> str:
        return f"Bvh({len(self.joints)} joints, {len(self.values)} frames at {self.rate:.6g} Hz)"

    @property
    def rate(self) -> float:
        """Frames a second: the whole number that the rounded frame time stands for, if there is one."""
        rate = 1.0 / self.frame_time
        return float(round(rate)) if abs(rate - round(rate)) < _RATE_ROUNDING * rate else rate

    def named(self, name: str) -> int:
        """The place of the joint of that name, in any case; -1: there is none."""
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
                total = total @ _turns("XYZ".index(name[0]), angle)
        return np.asarray(total)

    def poses(self) -> tuple[Array, Array]:
        """Positions (n, joints, 3), and rotations (n, joints, 3, 3), in the file's units and world."""
        count = len(self.values)
        places, turns = np.zeros((count, len(self.joints), 3)), np.zeros((count, len(self.joints), 3, 3))
        for j, joint in enumerate(self.joints):
            offset = np.tile(np.array(joint.offset), (count, 1))
            for axis, name in enumerate(_POSITION):
                moved = self.channel(j, name)
                if moved is not None:  # a position channel takes the place of the offset
                    offset[:, axis] = moved
            turn = self.rotation(j)
            if joint.parent < 0:
                places[:, j], turns[:, j] = offset, turn
                continue
            above = turns[:, joint.parent]
            places[:, j] = places[:, joint.parent] + np.einsum("nij,nj->ni", above, offset)
            turns[:, j] = above @ turn
        return places, turns

    def rest(self) -> Bvh:
        """One frame of the skeleton as its offsets draw it, all angles zero, the root at its offset."""
        values = np.zeros((1, self.values.shape[1]))
        for j, joint in enumerate(self.joints):
            for k, name in enumerate(joint.channels):
                if name in _POSITION:
                    values[0, self._first[j] + k] = joint.offset[_POSITION.index(name)]
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
            lines.append(f"{tab}  CHANNELS {len(joint.channels)} {' '.join(joint.channels)}".rstrip())
            if joint.end is not None:
                lines += [f"{tab}  End Site", f"{tab}  {{", f"{tab}    OFFSET {_numbers(joint.end)}"]
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
    """Reads a BVH text word by word; no recursion, so that no file is nested too deep."""

    def __init__(self, file: Path, text: str) -> None:
        self.file = file
        time = _FRAME_TIME.search(text)
        end = time.end() if time else _LONGEST_HEAD
        self.rest = text[end:]
        head = text[:end].splitlines()
        self.words = [(word, k) for k, line in enumerate(head, 1) for word in line.split()]
        self.next = 0

    def error(self, problem: str, allowed: str = "") -> ConfigError:
        line = self.words[min(max(self.next - 1, 0), len(self.words) - 1)][1] if self.words else 1
        return ConfigError(problem, file=self.file, key=f"line {line}", allowed=allowed)

    def word(self, *allowed: str) -> str:
        """The next word, one of ``allowed`` in any case if there are some."""
        self.next += 1
        if self.next > len(self.words):
            raise self.error("the file ends too early", " or ".join(allowed))
        word = self.words[self.next - 1][0]
        if allowed and word.upper() not in [other.upper() for other in allowed]:
            raise self.error(f"got {shown(word)}", " or ".join(allowed))
        return word

    def number(self) -> float:
        word = self.word()
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"got {shown(word)}", "a finite number")
        return value

    def count(self, most: int) -> int:
        value = self.number()
        if not (value == int(value) and 0 <= value <= most):
            raise self.error(f"got {value:g}", f"a whole number, 0 … {most}")
        return int(value)

    def vector(self) -> tuple[float, float, float]:
        return self.number(), self.number(), self.number()

    def read(self) -> Bvh:
        self.word("HIERARCHY")
        joints = self.hierarchy()
        self.word("MOTION")
        self.word("Frames:")
        frames = self.count(_MOST_FRAMES)
        self.word("Frame")
        self.word("Time:")
        frame_time = self.number()
        if not frame_time > 0.0:
            raise self.error(f"a frame time of {frame_time:g} s", "above zero")
        values, width = self.numbers(), sum(len(joint.channels) for joint in joints)
        if len(values) != frames * width:
            raise self.error(
                f"{len(values)} numbers for {frames} frames", f"{frames} times {width}, one for each channel"
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
        first = self.words[-1][1]
        for k, line in enumerate(self.rest.splitlines(), first):
            self.words, self.next = [(word, k) for word in line.split()], 0
            while self.next < len(self.words):
                self.number()
        raise self.error("a number that is not finite")

    def hierarchy(self) -> list[BvhJoint]:
        joints: list[BvhJoint] = []
        above: list[int] = []
        self.word("ROOT")
        while True:
            joints.append(self.joint(above[-1] if above else -1))
            above.append(len(joints) - 1)
            while (word := self.word("JOINT", "End", "}").upper()) != "JOINT":
                if word == "END":
                    self.word("Site")
                    self.word("{")
                    self.word("OFFSET")
                    last = joints[above[-1]]
                    joints[above[-1]] = BvhJoint(
                        last.name, last.parent, last.offset, last.channels, self.vector()
                    )
                    self.word("}")
                    continue
                above.pop()
                if not above:
                    return joints

    def joint(self, parent: int) -> BvhJoint:
        name = self.word()
        while self.next < len(self.words) and self.words[self.next][0] != "{":  # names may have blanks
            name += " " + self.word()
        self.word("{")
        self.word("OFFSET")
        offset = self.vector()
        channels: list[str] = []
        if self.next < len(self.words) and self.words[self.next][0].upper() == "CHANNELS":
            self.word("CHANNELS")
            for _ in range(self.count(len(CHANNELS))):
                word = self.word(*CHANNELS)
                channels.append(word[0].upper() + word[1:].lower())
        if len(set(channels)) < len(channels):
            raise self.error(f"joint {shown(name)} has a channel twice")
        return BvhJoint(name, parent, offset, tuple(channels))


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))


def _turns(axis: int, angle: Array) -> Array:
    """(n, 3, 3) rotations about X, Y or Z."""
    c, s = np.cos(angle), np.sin(angle)
    turns = np.zeros((len(angle), 3, 3))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turns[:, axis, axis] = 1.0
    turns[:, a, a] = turns[:, b, b] = c
    turns[:, a, b], turns[:, b, a] = -s, s
    return turns


# ------------------------------------------------------------------------------ our motions


@dataclass(frozen=True, eq=False)
class _Node:
    """Where a robot turns: joints of one body about one place.

    Attributes:
        name: Of the BVH joint.
        parent: Node above; -1: none.
        place: (3,) at qpos0, BVH axes, metres.
        joints: Ids of MuJoCo's joints, in order.
        axes: (k, 3) of hinges at qpos0, BVH axes.
        kind: Of its joints (MuJoCo's); -1: the still root of a robot that stands fast.
        body: MuJoCo's body.
    """

    name: str
    parent: int
    place: Array
    joints: tuple[int, ...]
    axes: Array
    kind: int
    body: int

    @property
    def along(self) -> tuple[str, ...] | None:
        """Channels that are the hinges themselves; None: some hinge is tilted, or no hinges."""
        if self.kind != mujoco.mjtJoint.mjJNT_HINGE or len(self.joints) > 3:
            return None
        most = np.abs(self.axes).argmax(axis=1)
        straight = (np.abs(self.axes).max(axis=1) > 1.0 - _ALONG).all() and len(set(most)) == len(most)
        return tuple(f"{'XYZ'[a]}rotation" for a in most) if straight else None

    @property
    def channels(self) -> tuple[str, ...]:
        """All three turns, for readers that expect them: behind those of the hinges come zeros."""
        places, turns = _POSITION if self.parent < 0 else (), self.along or ()
        return (*places, *turns, *(name for name in _EULER if name not in turns))


def _nodes(robot: Robot) -> list[_Node]:
    """Where the robot turns, parents first.

    Raises:
        UnsupportedJointError: A slide, or joints of several kinds about one place.
    """
    model = robot.model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    nodes: list[_Node] = []
    last: dict[int, int] = {0: -1}  # body -> the last node at or above it
    floats = model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    if not floats:
        nodes.append(_Node("base", -1, np.zeros(3), (), np.zeros((0, 3)), -1, 0))
        last[0] = 0
    for body in range(1, model.nbody):
        above = last[int(model.body_parentid[body])]
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        groups: list[list[int]] = []
        for j in range(first, first + count):
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                raise UnsupportedJointError(
                    f"joint {model.joint(j).name!r} slides, and BVH has turning joints only",
                    hint="write CSV: Keyframes.save_csv",
                )
            same = groups and np.abs(data.xanchor[j] - data.xanchor[groups[-1][0]]).max() < 1e-9
            if same and model.jnt_type[j] == model.jnt_type[groups[-1][0]]:
                groups[-1].append(j)
            else:
                groups.append([j])
        for k, group in enumerate(groups):
            name = model.body(body).name or f"body_{body}"
            nodes.append(
                _Node(
                    name if k == len(groups) - 1 else f"{name}_{k}", above, BVH_AXES @ data.xanchor[group[0]],
                    tuple(group), data.xaxis[group] @ BVH_AXES.T, int(model.jnt_type[group[0]]), body,
                )
            )  # fmt: skip
            above = len(nodes) - 1
        last[body] = above
    return nodes


def export_bvh(motion: Keyframes, rate: float = 60.0, *, scale: float = CENTIMETRES) -> Bvh:
    """A motion as BVH: y up, z forward, ``scale`` units a metre; our joints' names are the bodies'.

    Args:
        motion: Of any robot without slides.
        rate: Frames a second.
        scale: Units a metre; centimetres by custom.

    Raises:
        UnsupportedJointError: The robot has slides, which BVH does not know.
        TrajectoryError: ``rate`` is not above zero.
    """
    robot, nodes = motion.robot, _nodes(motion.robot)
    frames = motion.sampled(rate)
    qpos = np.array([robot.qpos(q) for q in frames.q])
    joints, columns = [], []
    for n, node in enumerate(nodes):
        above = nodes[node.parent].place if node.parent >= 0 else np.zeros(3)
        x, y, z = (scale * (node.place - above)).tolist() if node.parent >= 0 else (0.0, 0.0, 0.0)
        ends = None if any(other.parent == n for other in nodes) else _end_of(robot, node, scale)
        joints.append(BvhJoint(node.name, node.parent, (x, y, z), node.channels, ends))
        columns.append(_channels_of(robot, node, qpos, scale))
    return Bvh(tuple(joints), 1.0 / rate, np.hstack(columns))


def _end_of(robot: Robot, node: _Node, scale: float) -> tuple[float, float, float]:
    """End Site of a last body: the farthest of its sites."""
    model = robot.model
    offsets = [model.site_pos[s] for s in range(model.nsite) if model.site_bodyid[s] == node.body]
    far = max(offsets, key=lambda p: float(np.linalg.norm(p)), default=np.array([0.0, 0.0, -_END]))
    x, y, z = (scale * (BVH_AXES @ far)).tolist()
    return x, y, z


def _channels_of(robot: Robot, node: _Node, qpos: Array, scale: float) -> Array:
    """(n, channels) of one node."""
    model, count = robot.model, len(qpos)
    free = node.kind == mujoco.mjtJoint.mjJNT_FREE
    places = np.zeros((count, 3 if node.parent < 0 else 0))
    if not node.joints:
        return np.zeros((count, len(node.channels)))
    address = [int(model.jnt_qposadr[j]) for j in node.joints]
    if free:
        places = scale * qpos[:, address[0] : address[0] + 3] @ BVH_AXES.T
    if node.along:
        signs = np.sign(node.axes[np.arange(len(address)), np.abs(node.axes).argmax(axis=1)])
        start = np.array([model.qpos0[a] for a in address])
        spare = np.zeros((count, 3 - len(address)))
        return np.hstack([places, np.degrees((qpos[:, address] - start) * signs), spare])
    return np.hstack([places, _euler(_turn_of(model, node, qpos))])


def _turn_of(model: mujoco.MjModel, node: _Node, qpos: Array) -> Array:
    """(n, 3, 3) how far a node is turned from qpos0 against the one above, BVH axes."""
    total = np.broadcast_to(np.eye(3), (len(qpos), 3, 3))
    for axis, j in zip(node.axes, node.joints, strict=True):
        a = int(model.jnt_qposadr[j])
        if node.kind == mujoco.mjtJoint.mjJNT_HINGE:
            total = total @ _axis_turns(axis, qpos[:, a] - model.qpos0[a])
            continue
        a += 3 if node.kind == mujoco.mjtJoint.mjJNT_FREE else 0
        rest = BVH_AXES @ _rest_turn(model, node.body)
        matrices = _matrices(qpos[:, a : a + 4]) @ _matrices(model.qpos0[None, a : a + 4])[0].T
        # In the body's axes at rest, seen in BVH's: a ball turns about axes that the body carries.
        total = total @ (rest @ matrices @ rest.T if node.kind == mujoco.mjtJoint.mjJNT_BALL else
                         BVH_AXES @ matrices @ BVH_AXES.T)  # fmt: skip
    return np.asarray(total)


def _rest_turn(model: mujoco.MjModel, body: int) -> Array:
    """(3, 3) the axes at qpos0 in which a ball's quaternion is: the body's without its joint."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    parent = data.xmat[model.body_parentid[body]].reshape(3, 3)
    return np.asarray(parent @ _matrices(model.body_quat[None, body])[0])


def _matrices(wxyz: Array) -> Array:
    """(n, 3, 3) of quaternions (n, 4)."""
    out = np.zeros((len(wxyz), 9))
    for row, quaternion in zip(out, wxyz, strict=True):
        mujoco.mju_quat2Mat(row, np.ascontiguousarray(quaternion))
    return out.reshape(-1, 3, 3)


def _axis_turns(axis: Array, angle: Array) -> Array:
    """(n, 3, 3) rotations about one axis (Rodrigues)."""
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * cross + (1.0 - c) * (cross @ cross))


def _euler(turns: Array) -> Array:
    """(n, 3) degrees of Z, X, Y channels, each frame's the nearer of the two forms, without jumps of 360."""
    x = np.arcsin(np.clip(turns[:, 2, 1], -1.0, 1.0))
    z = np.arctan2(-turns[:, 0, 1], turns[:, 1, 1])
    y = np.arctan2(-turns[:, 2, 0], turns[:, 2, 2])
    angles = np.stack([z, x, y], axis=1)
    out = angles.copy()
    for k in range(1, len(out)):
        other = np.array([out[k, 0] + np.pi, np.pi - out[k, 1], out[k, 2] + np.pi])
        forms = [
            form - 2.0 * np.pi * np.rint((form - out[k - 1]) / (2.0 * np.pi)) for form in (out[k], other)
        ]
        out[k] = min(forms, key=lambda form: float(np.abs(form - out[k - 1]).max()))
    return np.degrees(out)


def own_motion(bvh: Bvh, robot: Robot, *, scale: float = CENTIMETRES) -> Keyframes:
    """The motion in a file of ``export_bvh``: the same skeleton, joint for joint.

    Args:
        bvh: Read from such a file.
        robot: The robot that was written.
        scale: Units a metre.

    Raises:
        TrajectoryError: Another skeleton, a turn that the hinges cannot make, a joint outside its limits.
    """
    nodes = _nodes(robot)
    if [node.name for node in nodes] != [joint.name for joint in bvh.joints]:
        missing = [node.name for node in nodes if bvh.named(node.name) < 0]
        raise TrajectoryError(
            f"the file's skeleton is not that of {robot.name!r}"
            + (f": it has no {missing[0]!r}" if missing else ""),
            hint="motions of other skeletons: robot_ik.motion.retarget",
        )
    model = robot.model
    qpos = np.tile(robot.qpos(robot.home), (len(bvh.values), 1))
    for n, node in enumerate(nodes):
        address = [int(model.jnt_qposadr[j]) for j in node.joints]
        if node.along and _only_turns(bvh, n, node.along):
            for a, axis, name in zip(address, node.axes, node.along, strict=True):
                angle = bvh.channel(n, name)
                assert angle is not None
                qpos[:, a] = model.qpos0[a] + np.radians(angle) * np.sign(axis[np.abs(axis).argmax()])
        elif node.kind == mujoco.mjtJoint.mjJNT_HINGE:
            qpos[:, address] = model.qpos0[address] + _hinge_angles(robot, node, bvh.rotation(n))
        elif node.joints:
            _put_quaternions(bvh, n, model, node, qpos, scale)
    rows = qpos[:, qpos_places(robot)]
    return Keyframes(robot, np.arange(len(rows)) / bvh.rate, sign_continuous(robot, rows))


def _only_turns(bvh: Bvh, joint: int, along: tuple[str, ...]) -> bool:
    """Whether a joint turns about its hinges in their order, and about nothing else."""
    turns = [name for name in bvh.joints[joint].channels if name.endswith("rotation")]
    spare = [bvh.channel(joint, name) for name in turns[len(along) :]]
    return tuple(turns[: len(along)]) == along and not any(np.any(values) for values in spare)


def qpos_places(robot: Robot) -> list[int]:
    """Where the numbers of q stand in MuJoCo's qpos."""
    joints = zip(robot.tree.joint_ids, robot.tree.kind, strict=True)
    return [int(robot.model.jnt_qposadr[j]) + i for j, kind in joints for i in range(Q_WIDTH[int(kind)])]


def _put_quaternions(bvh: Bvh, n: int, model: mujoco.MjModel, node: _Node, qpos: Array, scale: float) -> None:
    """The numbers of a ball or free joint, from the file's turns."""
    a, turns = int(model.jnt_qposadr[node.joints[0]]), bvh.rotation(n)
    if node.kind == mujoco.mjtJoint.mjJNT_FREE:
        for axis, name in enumerate(_POSITION):
            moved = bvh.channel(n, name)
            if moved is not None:
                qpos[:, a + int(np.argmax(BVH_AXES[axis]))] = moved / scale
        a, axes = a + 3, BVH_AXES
    else:
        axes = BVH_AXES @ _rest_turn(model, node.body)
    matrices = axes.T @ turns @ axes @ _matrices(model.qpos0[None, a : a + 4])[0]
    for k, matrix in enumerate(matrices):
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix.reshape(9)))
        qpos[k, a : a + 4] = quaternion


def _hinge_angles(robot: Robot, node: _Node, turns: Array) -> Array:
    """(n, k) angles of hinges with any axes whose product is ``turns`` (n, 3, 3), by Gauss-Newton.

    Raises:
        TrajectoryError: There are none.
    """
    angles = np.zeros((len(turns), len(node.axes)))
    error = np.zeros((len(turns), 3))
    for _ in range(_HINGE_STEPS):
        made = np.broadcast_to(np.eye(3), turns.shape)
        columns = []
        for k, axis in enumerate(node.axes):
            columns.append(made @ axis)
            made = made @ _axis_turns(axis, angles[:, k])
        left = turns @ made.transpose(0, 2, 1)
        error = _logs(left)
        if np.abs(error).max(initial=0.0) < 1e-15:
            break
        jacobian = np.stack(columns, axis=2)
        angles += np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), error)
    if np.abs(error).max(initial=0.0) > _HINGE_LEFT:
        k = int(np.abs(error).max(axis=1).argmax())
        raise TrajectoryError(
            f"frame {k}: {node.name!r} is turned as its hinges cannot turn it "
            f"({np.degrees(np.abs(error[k]).max()):.2g} degrees are left)",
            hint="motions of other skeletons: robot_ik.motion.retarget",
        )
    return angles


def _logs(turns: Array) -> Array:
    """(n, 3) rotation vectors of matrices."""
    out = np.zeros((len(turns), 3))
    quaternion = np.zeros(4)
    for row, matrix in zip(out, turns, strict=True):
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(matrix.reshape(9)))
        mujoco.mju_quat2Vel(row, quaternion, 1.0)
    return out
