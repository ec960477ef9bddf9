"""Rigid motions: one immutable ``Pose`` of position and unit quaternion (w, x, y, z).

Naming: ``pose_ab`` is the pose of b seen from a; it maps b's coordinates into a's:
``p_a = pose_ab @ p_b`` and ``pose_ac = pose_ab @ pose_bc``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError, InvalidPoseError, RobotIkError

Array = NDArray[np.float64]

# Below this angle the series of sin(x)/x is exact to double precision.
_SMALL_ANGLE = 1e-8
# How far a matrix may be from a rotation: what six written digits leave.
ROUNDING = 1e-5
# Squares of larger numbers, or of longer vectors, leave the range of floats.
LARGEST = 1e100
INTEGER = int | np.integer
REAL = int | float | np.integer | np.floating
"""Types of one whole and one real number: what a text, an array or a complex number is not."""


def is_real(value: object, low: float = -LARGEST, high: float = LARGEST) -> bool:
    """Whether a value is one real number between two bounds, themselves included."""
    return isinstance(value, REAL) and bool(low <= value <= high)


def numbers(
    values: ArrayLike, what: str, wanted: str = "numbers", error: type[RobotIkError] = InvalidGoalError
) -> Array:
    """A new array of floats; raises ``error`` with a clear message for text or uneven rows."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as reason:
        raise error(f"{what} must be {wanted}, not {values!r}") from reason


def vector(
    values: ArrayLike,
    size: int,
    what: str,
    error: type[RobotIkError] = InvalidGoalError,
    hint: str = "",
    largest: float = LARGEST,
) -> Array:
    """A new read-only finite array (size,); raises ``error`` with a message for anything else."""
    array = numbers(values, what, f"{size} numbers", error)
    if array.shape != (size,):
        found = array.size if array.size != size else f"an array of shape {array.shape}"
        raise error(f"{what} must be {size} numbers, not {found} ({values!r})", hint=hint)
    found = array.tolist()  # Python's own numbers are quicker for so few
    if not math.hypot(*found) <= largest:  # NaN too
        bound = f"below {largest:g}" if all(map(math.isfinite, found)) else "finite"
        raise error(f"{what} must be {bound}, not {found}")
    array.setflags(write=False)
    return array


def unit_quaternion(values: ArrayLike, error: type[RobotIkError] = InvalidGoalError) -> Array:
    """A new read-only unit quaternion (4,), w first; raises ``error`` for anything else."""
    array = vector(values, 4, "wxyz", error)
    w, x, y, z = array.tolist()
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm < 1e-9:
        hint = "quaternions are w, x, y, z; 1 0 0 0 is no rotation"
        raise error("wxyz is a zero quaternion, which is no orientation", hint=hint)
    if norm != 1.0:
        array = array / norm
        array.setflags(write=False)
    return array


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (4,), wxyz: first ``b``, then ``a``."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array((
        aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
    ))  # fmt: skip


def quat_to_matrix(wxyz: Array) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion (4,)."""
    return np.array(rotation_entries(*wxyz.tolist())).reshape(3, 3)


def rotation_entries(w: Any, x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """The nine entries of that matrix, row by row: of numbers (Python's own are quickest), or of arrays."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


def matrix_to_quat(rotation: ArrayLike) -> Array:
    """Unit quaternion (4,), w >= 0, of a rotation matrix (3, 3) (Shepperd 1978)."""
    r = np.asarray(rotation, dtype=float)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    pick = int(np.argmax([trace, r[0, 0], r[1, 1], r[2, 2]]))
    w, x, y, z = 1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    if pick == 1:
        w, x, y, z = x, 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif pick == 2:
        w, x, y, z = y, r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]
    elif pick == 3:
        w, x, y, z = z, r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]
    quat = np.array([w, x, y, z])
    quat /= np.linalg.norm(quat)
    return -quat if quat[0] < 0 else quat


def off_rotation(a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any, i: Any) -> Any:
    """How far a matrix, row by row, is from unit columns of which the third is the others' cross product."""
    off = abs(a * a + d * d + g * g - 1.0) + abs(b * b + e * e + h * h - 1.0)
    return off + abs(d * h - g * e - c) + abs(g * b - a * h - f) + abs(a * e - d * b - i)


def rotation_z_to(axis: ArrayLike) -> Array:
    """A rotation matrix (3, 3) whose z column is the unit vector ``axis``; the identity for z itself."""
    z = np.asarray(axis, dtype=float)
    # The coordinate axis least along z keeps the cross product well away from zero.
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = helper - z * (z @ helper)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def rotation_log(wxyz: Array) -> Array:
    """Rotation vector (3,), angle in [0, pi], of a unit quaternion (4,)."""
    w, vector = float(wxyz[0]), np.asarray(wxyz[1:], dtype=float)
    if w < 0:
        w, vector = -w, -vector
    norm = float(np.linalg.norm(vector))
    if norm < _SMALL_ANGLE:
        return vector * (2.0 / max(w, 0.5))
    return vector * (2.0 * np.arctan2(norm, w) / norm)


def rotation_exp(vector: ArrayLike) -> Array:
    """Unit quaternion (4,), wxyz, of a rotation vector (3,) in rad."""
    v = np.asarray(vector, dtype=float)
    half = 0.5 * float(np.linalg.norm(v))
    scale = 0.5 if half < _SMALL_ANGLE else np.sin(half) / (2.0 * half)
    return np.concatenate([[np.cos(half)], v * scale])


def axis_rotations(axis: str, angles: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) by ``angles`` (...), rad, about the axis x, y or z."""
    angle = np.asarray(angles, dtype=float)
    c, s, out = np.cos(angle), np.sin(angle), np.zeros((*angle.shape, 3, 3))
    i, j, k = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}[axis]
    out[..., i, i] = out[..., j, j] = c
    out[..., i, j], out[..., j, i], out[..., k, k] = -s, s, 1.0
    return out


@dataclass(frozen=True, eq=False)
class Pose:
    """Position (3,) in metres and unit quaternion (4,), wxyz.

    The quaternion is normalised on construction; both arrays are read-only copies.  Poses are equal when all
    their numbers are: q and -q are the same rotation, but not the same numbers (``distance`` asks for that).

    Raises:
        InvalidPoseError: Wrong shape, a number that is not finite or beyond ``LARGEST``, a zero quaternion.
    """

    position: Array
    wxyz: Array

    def __init__(self, position: ArrayLike = (0.0, 0.0, 0.0), wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> None:
        place = vector(position, 3, "a position", InvalidPoseError)
        self.__dict__.update(position=place, wxyz=unit_quaternion(wxyz, InvalidPoseError))

    @classmethod
    def of_checked(cls, position: Array, wxyz: Array) -> Pose:
        """From read-only arrays that are finite, and a unit quaternion: nothing is checked again."""
        pose = object.__new__(cls)
        pose.__dict__.update(position=position, wxyz=wxyz)
        return pose

    @classmethod
    def from_rotation(cls, rotation: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
        """From a rotation matrix (3, 3) and a position (3,)."""
        r = numbers(rotation, "a rotation matrix", "numbers (3, 3)", InvalidPoseError)
        if r.shape != (3, 3):
            raise InvalidPoseError(f"a rotation matrix is (3, 3), not {r.shape}")
        if off_rotation(*r.ravel().tolist()) > ROUNDING:  # of NaN, the pose complains
            raise InvalidPoseError(f"the matrix {r.tolist()} is no rotation: it scales or mirrors")
        return cls(position, matrix_to_quat(r))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """From a homogeneous matrix (4, 4)."""
        m = numbers(matrix, "a homogeneous matrix", "numbers (4, 4)", InvalidPoseError)
        if m.shape != (4, 4):
            raise InvalidPoseError(f"a homogeneous matrix is (4, 4), not {m.shape}")
        if not np.allclose(m[3], (0.0, 0.0, 0.0, 1.0)):
            raise InvalidPoseError(f"the last row of a homogeneous matrix is 0 0 0 1, not {m[3].tolist()}")
        return cls.from_rotation(m[:3, :3], m[:3, 3])

    @classmethod
    def from_row(cls, row: Array) -> Pose:
        """From what ``row`` gives."""
        return cls.from_rotation(row[3:].reshape(3, 3), row[:3])

    @property
    def row(self) -> Array:
        """(12,): position, then the rotation matrix row by row, as the kernels have poses."""
        return np.array((*self.position.tolist(), *rotation_entries(*self.wxyz.tolist())))

    @property
    def rotation(self) -> Array:
        """Rotation matrix (3, 3)."""
        return quat_to_matrix(self.wxyz)

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        x, y, z = self.position.tolist()
        r = rotation_entries(*self.wxyz.tolist())
        # One array from Python's numbers: a third of the time of filling parts of an array.
        entries = (*r[:3], x, *r[3:6], y, *r[6:], z, 0.0, 0.0, 0.0, 1.0)
        return np.array(entries).reshape(4, 4)

    def inverse(self) -> Pose:
        """``pose_ba`` of ``pose_ab``."""
        conjugate = self.wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        return Pose(-(quat_to_matrix(conjugate) @ self.position), conjugate)

    @overload
    def __matmul__(self, other: Pose) -> Pose: ...

    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...

    def __matmul__(self, other: Pose | ArrayLike) -> Pose | Array:
        return self.compose(other) if isinstance(other, Pose) else self.apply(other)

    def compose(self, other: Pose) -> Pose:
        """``pose_ac = pose_ab.compose(pose_bc)``; the same as ``@`` with the type known."""
        return Pose(self.position + self.rotation @ other.position, quat_multiply(self.wxyz, other.wxyz))

    def apply(self, points: ArrayLike) -> Array:
        """Points (3,) or (n, 3) of frame b in frame a."""
        array = numbers(points, "points", "numbers (3,) or (n, 3)", InvalidPoseError)
        if array.shape[-1:] != (3,):
            raise InvalidPoseError(f"points are (3,) or (n, 3), not {array.shape}")
        return np.asarray(array @ self.rotation.T + self.position)

    def distance(self, other: Pose) -> tuple[float, float]:
        """Distance to ``other``: metres between origins, radians of the rotation between axes."""
        rotation = rotation_log(quat_multiply(self.inverse().wxyz, other.wxyz))
        return float(np.linalg.norm(other.position - self.position)), float(np.linalg.norm(rotation))

    def moved(self, change: Sequence[float] | Array) -> Pose:
        """Shifted by ``change[:3]``, rotated about its origin by the vector ``change[3:]``; outer axes."""
        return Pose(self.position + change[:3], quat_multiply(rotation_exp(change[3:]), self.wxyz))

    def change_from(self, other: Pose) -> Array:
        """(6,) the change that ``moved`` brings ``other`` here with: shift, and rotation vector."""
        inverse = other.wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        rotation_vector = rotation_log(quat_multiply(self.wxyz, inverse))
        return np.concatenate([self.position - other.position, rotation_vector])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        return bool((self.position == other.position).all() and (self.wxyz == other.wxyz).all())

    def __hash__(self) -> int:
        return hash((*self.position.tolist(), *self.wxyz.tolist()))

    def __repr__(self) -> str:
        p = ", ".join(f"{v:.6g}" for v in self.position)
        q = ", ".join(f"{v:.6g}" for v in self.wxyz)
        return f"Pose(position=({p}), wxyz=({q}))"
