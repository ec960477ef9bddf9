"""BVH, the text format of motion capture: read and written.

Facts of the format (Meredith & Maddock, Motion Capture File Formats Explained, Sheffield 2001): offsets are
bone vectors in the parent's axes; each joint lists its own channels in its own order, and its rotation is
their product in that order; angles are degrees, lengths in any unit; y points up by custom; an
End Site has no channels; the frame time is rounded.  Numbers are kept as they stand in the file, so that
what is written again is the same.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_ik.errors import ConfigError, TrajectoryError
from robot_ik.files import write_atomically
from robot_ik.geometry import axis_rotations
from robot_ik.ports import Array
from robot_ik.reading import read_text, shown

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
            raise TrajectoryError(f"{self._first[-1]} channels got values of shape {self.values.shape}")

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
        positions, rotations = (
            np.zeros((count, len(self.joints), 3)),
            np.zeros((count, len(self.joints), 3, 3)),
        )
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
        line = self.tokens[min(max(self.next - 1, 0), len(self.tokens) - 1)][1] if self.tokens else 1
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
                    last = joints[above[-1]]
                    joints[above[-1]] = BvhJoint(
                        last.name, last.parent, last.offset, last.channels, self.vector()
                    )
                    self.token("}")
                    continue
                above.pop()
                if not above:
                    return joints

    def joint(self, parent: int) -> BvhJoint:
        name = self.token()
        while self.next < len(self.tokens) and self.tokens[self.next][0] != "{":  # names may have blanks
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
