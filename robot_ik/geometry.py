"""Rigid motions: one immutable ``Pose`` of a position and a unit quaternion (w, x, y, z).

``pose_ab`` is the pose of b seen from a. It maps coordinates of b to coordinates of a:
``p_a = pose_ab @ p_b`` and ``pose_ac = pose_ab @ pose_bc``.

Names follow Solà et al., A micro Lie theory for state estimation in robotics, 2018.
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

SMALL_ANGLE = 1e-8
"""rad. Below it the first term of the series of sin(x) / x is exact to double precision."""

SMALL_SCREW_ANGLE = 0.1
"""rad. Below it the series in the SE(3) exponential and logarithm are exact to 1e-14."""

ROTATION_TOLERANCE = 1e-5
"""Largest ``rotation_residual`` of a rotation matrix: the entries may be rounded to six digits."""

LAST_ROW_TOLERANCE = 1e-5
"""Largest error of the last row of a homogeneous matrix: it may be rounded to six digits."""

SHORTEST_QUATERNION = 1e-9
"""A quaternion shorter than this has no orientation."""

SHORTEST_VIEW = 1e-9
"""Metres between position and target of ``Pose.look_at``, and the sine between view and up."""

LARGEST = 1e100
"""Squares of larger numbers, or of longer vectors, leave the range of floats."""

INTEGER = int | np.integer
REAL = int | float | np.integer | np.floating
"""Types of one integer and of one real number. Texts, arrays and complex numbers are neither."""


def is_real(value: object, lower: float = -LARGEST, upper: float = LARGEST) -> bool:
    """Return whether a value is one real number from ``lower`` to ``upper``, both included."""
    return isinstance(value, REAL) and bool(lower <= value <= upper)


def numbers(
    values: ArrayLike,
    what: str,
    expected: str = "numbers",
    error: type[RobotIkError] = InvalidGoalError,
) -> Array:
    """Return values as a new array of floats.

    Args:
        values: The values.
        what: Name of the values, for the message.
        expected: What the values must be, for the message.
        error: The error to raise for text or rows of different lengths.
    """
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as reason:
        raise error(f"{what} must be {expected}, not {values!r}") from reason


def vector(
    values: ArrayLike,
    size: int,
    what: str,
    error: type[RobotIkError] = InvalidGoalError,
    hint: str = "",
    largest: float = LARGEST,
) -> Array:
    """Return a new read-only array (size,) of finite numbers.

    Args:
        values: The numbers.
        size: How many numbers are allowed.
        what: Name of the vector, for the message.
        error: The error to raise for other values.
        hint: What to try, for the message.
        largest: Largest allowed norm.
    """
    array = numbers(values, what, f"{size} numbers", error)
    if array.shape != (size,):
        given = array.size if array.size != size else f"an array of shape {array.shape}"
        raise error(f"{what} must be {size} numbers, not {given} ({values!r})", hint=hint)
    entries = array.tolist()  # Python's numbers are faster for short vectors
    if not math.hypot(*entries) <= largest:  # NaN too
        bound = f"below {largest:g}" if all(map(math.isfinite, entries)) else "finite"
        raise error(f"{what} must be {bound}, not {entries}")
    array.setflags(write=False)
    return array


def unit_quaternion(values: ArrayLike, error: type[RobotIkError] = InvalidGoalError) -> Array:
    """Return a new read-only unit quaternion (4,), wxyz. Raise ``error`` for other values."""
    array = vector(values, 4, "wxyz", error)
    w, x, y, z = array.tolist()
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm < SHORTEST_QUATERNION:
        hint = "quaternions are w, x, y, z; 1 0 0 0 is the identity"
        raise error("wxyz is a zero quaternion, which is not an orientation", hint=hint)
    if norm != 1.0:
        array = array / norm
        array.setflags(write=False)
    return array


def quat_multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product of two quaternions (4,), wxyz: first ``b``, then ``a``."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
    )


def quat_to_matrix(wxyz: Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,)."""
    return np.array(rotation_entries(*wxyz.tolist())).reshape(3, 3)


def rotation_entries(w: Any, x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """Return the nine entries of the rotation matrix of a unit quaternion, row by row.

    Takes numbers, for which Python's own are the fastest, or arrays of numbers.
    """
    # Products with the doubled vector part: a third fewer operations, and the same rounding.
    x2 = x + x
    y2 = y + y
    z2 = z + z
    xx = x * x2
    yy = y * y2
    zz = z * z2
    xy = x * y2
    xz = x * z2
    yz = y * z2
    wx = w * x2
    wy = w * y2
    wz = w * z2
    return (
        1.0 - (yy + zz),
        xy - wz,
        xz + wy,
        xy + wz,
        1.0 - (xx + zz),
        yz - wx,
        xz - wy,
        yz + wx,
        1.0 - (xx + yy),
    )


def matrix_to_quat(rotation: ArrayLike) -> Array:
    """Return the unit quaternion (4,), w >= 0, of a rotation matrix (3, 3) (Shepperd 1978)."""
    # Arithmetic with Python's numbers takes a third of the time of that with NumPy's scalars.
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=float).tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        quat = [1 + trace, h - f, c - g, d - b]
    elif largest == a:
        quat = [h - f, 1 + a - e - i, b + d, c + g]
    elif largest == e:
        quat = [c - g, b + d, 1 - a + e - i, f + h]
    else:
        quat = [d - b, c + g, f + h, 1 - a - e + i]
    wxyz = np.array(quat) / np.linalg.norm(quat)
    return -wxyz if wxyz[0] < 0 else wxyz


def rotation_residual(
    a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any, i: Any
) -> Any:
    """Return how far a matrix is from a rotation. Takes its entries, or arrays of them, row by row.

    The first two columns should be unit vectors. The third should be their cross product.
    """
    lengths = abs(a * a + d * d + g * g - 1.0) + abs(b * b + e * e + h * h - 1.0)
    return lengths + abs(d * h - g * e - c) + abs(g * b - a * h - f) + abs(a * e - d * b - i)


def rotation_z_to(axis: ArrayLike) -> Array:
    """Return a rotation matrix (3, 3) whose z column is the unit vector ``axis``.

    It is the identity for the z axis.
    """
    z = np.asarray(axis, dtype=float)
    # The coordinate axis with the smallest part along z keeps the cross product away from zero.
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = helper - z * (z @ helper)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def rotation_log(wxyz: Array) -> Array:
    """Return the rotation vector (3,), with an angle from 0 to pi, of a unit quaternion (4,)."""
    w = float(wxyz[0])
    v = np.asarray(wxyz[1:], dtype=float)
    if w < 0:
        w = -w
        v = -v
    norm = float(np.linalg.norm(v))
    if norm < SMALL_ANGLE:
        return v * (2.0 / max(w, 0.5))
    return v * (2.0 * np.arctan2(norm, w) / norm)


def rotation_exp(rotation_vector: ArrayLike) -> Array:
    """Return the unit quaternion (4,), wxyz, of a rotation vector (3,) in rad."""
    v = np.asarray(rotation_vector, dtype=float)
    half = 0.5 * float(np.linalg.norm(v))
    scale = 0.5 if half < SMALL_ANGLE else np.sin(half) / (2.0 * half)
    return np.concatenate([[np.cos(half)], v * scale])


def axis_rotations(axis: str, angles: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) by ``angles`` (...), rad, about the axis x, y or z."""
    angle = np.asarray(angles, dtype=float)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    i, j, k = {"x": (0, 1, 2), "y": (1, 2, 0), "z": (2, 0, 1)}[axis]
    rotations = np.zeros((*angle.shape, 3, 3))
    rotations[..., i, i] = 1.0
    rotations[..., j, j] = cosine
    rotations[..., k, k] = cosine
    rotations[..., j, k] = -sine
    rotations[..., k, j] = sine
    return rotations


def _skew(v: Array) -> Array:
    """Return the matrix (3, 3) of the cross product with ``v``."""
    x, y, z = v.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _left_jacobian(rotation_vector: Array) -> Array:
    """Return the left Jacobian (3, 3) of SO(3) (Solà et al., equation 145)."""
    angle = float(np.linalg.norm(rotation_vector))
    skew = _skew(rotation_vector)
    if angle < SMALL_SCREW_ANGLE:
        first = 1 / 2 - angle**2 / 24 + angle**4 / 720 - angle**6 / 40320
        second = 1 / 6 - angle**2 / 120 + angle**4 / 5040 - angle**6 / 362880
    else:
        first = (1.0 - math.cos(angle)) / angle**2
        second = (angle - math.sin(angle)) / angle**3
    return np.eye(3) + first * skew + second * skew @ skew


def _inverse_left_jacobian(rotation_vector: Array) -> Array:
    """Return the inverse (3, 3) of the left Jacobian of SO(3) (Solà et al., equation 146)."""
    angle = float(np.linalg.norm(rotation_vector))
    skew = _skew(rotation_vector)
    if angle < SMALL_SCREW_ANGLE:
        second = 1 / 12 + angle**2 / 720 + angle**4 / 30240 + angle**6 / 1209600
    else:
        second = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2
    return np.eye(3) - 0.5 * skew + second * skew @ skew


@dataclass(frozen=True, eq=False)
class Pose:
    """Position (3,) in metres and unit quaternion (4,), wxyz.

    The quaternion is normalised. Both arrays are read-only copies. Poses are equal if all their
    numbers are equal. The quaternions q and -q are the same rotation but not equal; ``distance``
    compares rotations.

    Raises:
        InvalidPoseError: Wrong shape, a number that is not finite or beyond ``LARGEST``, or a zero
            quaternion.
    """

    position: Array
    wxyz: Array

    def __init__(
        self,
        position: ArrayLike = (0.0, 0.0, 0.0),
        wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        checked_position = vector(position, 3, "a position", InvalidPoseError)
        checked_wxyz = unit_quaternion(wxyz, InvalidPoseError)
        self.__dict__.update(position=checked_position, wxyz=checked_wxyz)

    @classmethod
    def of_checked(cls, position: Array, wxyz: Array) -> Pose:
        """Return a pose from read-only finite arrays and a unit quaternion, without checks."""
        pose = object.__new__(cls)
        pose.__dict__.update(position=position, wxyz=wxyz)
        return pose

    @classmethod
    def identity(cls) -> Pose:
        """Return the pose that maps each point to itself."""
        return cls()

    @classmethod
    def from_rotation(cls, rotation: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
        """Return the pose of a rotation matrix (3, 3) and a position (3,).

        Raises:
            InvalidPoseError: The matrix scales or mirrors, or a shape is wrong.
        """
        r = numbers(rotation, "a rotation matrix", "numbers (3, 3)", InvalidPoseError)
        if r.shape != (3, 3):
            raise InvalidPoseError(f"a rotation matrix is (3, 3), not {r.shape}")
        if rotation_residual(*r.ravel().tolist()) > ROTATION_TOLERANCE:  # Pose() refuses NaN
            raise InvalidPoseError(
                f"the matrix {r.tolist()} is not a rotation: it scales or mirrors"
            )
        return cls(position, matrix_to_quat(r))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Return the pose of a homogeneous matrix (4, 4).

        Raises:
            InvalidPoseError: The matrix scales or mirrors, or it has another last row or shape.
        """
        m = numbers(matrix, "a homogeneous matrix", "numbers (4, 4)", InvalidPoseError)
        if m.shape != (4, 4):
            raise InvalidPoseError(f"a homogeneous matrix is (4, 4), not {m.shape}")
        x, y, z, w = m[3].tolist()
        # Written so that NaN is refused too.
        if not abs(x) + abs(y) + abs(z) + abs(w - 1.0) <= LAST_ROW_TOLERANCE:
            given = m[3].tolist()
            raise InvalidPoseError(f"the last row of a homogeneous matrix is 0 0 0 1, not {given}")
        return cls.from_rotation(m[:3, :3], m[:3, 3])

    @classmethod
    def from_row(cls, row: Array) -> Pose:
        """Return the pose of an array (12,) as ``row`` returns it."""
        return cls.from_rotation(row[3:].reshape(3, 3), row[:3])

    @classmethod
    def from_euler(
        cls,
        axes: str,
        angles: ArrayLike,
        position: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Pose:
        """Return the pose of Euler angles and a position (3,).

        Args:
            axes: Axes of the rotations in order. Lower case means fixed axes, as in ``"xyz"`` for
                the roll, pitch and yaw of URDF. Upper case means the axes of the rotated frame, as
                in ``"ZYX"``. These are SciPy's conventions.
            angles: One angle for each axis, rad.
            position: Position in metres.

        Raises:
            InvalidPoseError: Other axes, mixed case, or not one finite angle for each axis.
        """
        given: object = axes
        letters = set(given) if isinstance(given, str) else set()
        if not letters or not (letters <= set("xyz") or letters <= set("XYZ")):
            raise InvalidPoseError(
                f"Euler axes are letters of 'xyz' (fixed) or 'XYZ' (rotated), not {axes!r}",
                hint='roll, pitch and yaw of URDF: Pose.from_euler("xyz", (roll, pitch, yaw))',
            )
        values = vector(np.atleast_1d(angles), len(axes), "Euler angles", InvalidPoseError)
        rotation = np.eye(3)
        for axis, angle in zip(axes.lower(), values.tolist(), strict=True):
            step = axis_rotations(axis, angle)
            rotation = step @ rotation if axes.islower() else rotation @ step
        return cls.from_rotation(rotation, position)

    @classmethod
    def look_at(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> Pose:
        """Return the pose of a camera at ``position`` that looks at ``target``.

        The axes are those of OpenCV: x right, y down and z forward in the picture.

        Args:
            position: Position of the camera (3,), m.
            target: Point in the middle of the picture (3,), m.
            up: Direction (3,) that points up in the picture.

        Raises:
            InvalidPoseError: Position and target coincide, or ``up`` is parallel to the view.
        """
        origin = vector(position, 3, "a position", InvalidPoseError)
        forward = vector(target, 3, "a target", InvalidPoseError) - origin
        upward = vector(up, 3, "up", InvalidPoseError)
        right = np.cross(forward, upward)
        distance = float(np.linalg.norm(forward))
        sine = float(np.linalg.norm(right))
        if distance < SHORTEST_VIEW or sine < SHORTEST_VIEW * distance:
            raise InvalidPoseError(
                f"a camera at {position!r} cannot look at {target!r} with {up!r} upwards",
                hint="choose another target, or an up direction that is not parallel to the view",
            )
        forward = forward / distance
        right /= sine
        down = np.cross(forward, right)
        return cls.from_rotation(np.column_stack([right, down, forward]), origin)

    @classmethod
    def exp(cls, twist: ArrayLike) -> Pose:
        """Return the exponential of a twist (6,): linear (m) before angular (rad).

        The pose is the end of a motion of one second with this constant twist. ``plus`` shifts and
        rotates separately instead.
        """
        v = vector(twist, 6, "a twist", InvalidPoseError)
        return cls(_left_jacobian(v[3:]) @ v[:3], rotation_exp(v[3:]))

    def log(self) -> Array:
        """Return the twist (6,), linear before angular, whose ``exp`` is this pose.

        Its rotation angle is from 0 to pi.
        """
        rotation_vector = rotation_log(self.wxyz)
        linear = _inverse_left_jacobian(rotation_vector) @ self.position
        return np.concatenate([linear, rotation_vector])

    @property
    def row(self) -> Array:
        """Position and rotation matrix row by row (12,), the form of poses in kernels."""
        return np.array((*self.position.tolist(), *rotation_entries(*self.wxyz.tolist())))

    @property
    def rotation(self) -> Array:
        """Rotation matrix (3, 3)."""
        return quat_to_matrix(self.wxyz)

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        x, y, z = self.position.tolist()
        a, b, c, d, e, f, g, h, i = rotation_entries(*self.wxyz.tolist())
        # One array from Python's numbers takes a third of the time of filling parts of an array.
        entries = (a, b, c, x, d, e, f, y, g, h, i, z, 0.0, 0.0, 0.0, 1.0)
        return np.array(entries).reshape(4, 4)

    def inverse(self) -> Pose:
        """Return ``pose_ba`` of ``pose_ab``."""
        conjugate = _conjugate(self.wxyz)
        return Pose(-(quat_to_matrix(conjugate) @ self.position), conjugate)

    @overload
    def __matmul__(self, other: Pose) -> Pose: ...

    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...

    def __matmul__(self, other: Pose | ArrayLike) -> Pose | Array:
        return self.compose(other) if isinstance(other, Pose) else self.apply(other)

    def compose(self, other: Pose) -> Pose:
        """Return ``pose_ac = pose_ab.compose(pose_bc)``, as ``@`` does, with a known type."""
        position = self.position + self.rotation @ other.position
        return Pose(position, quat_multiply(self.wxyz, other.wxyz))

    def apply(self, points: ArrayLike) -> Array:
        """Return points (3,) or (n, 3) of frame b in frame a."""
        array = numbers(points, "points", "numbers (3,) or (n, 3)", InvalidPoseError)
        if array.shape[-1:] != (3,):
            raise InvalidPoseError(f"points are (3,) or (n, 3), not {array.shape}")
        return np.asarray(array @ self.rotation.T + self.position)

    def distance(self, other: Pose) -> tuple[float, float]:
        """Return metres between the origins and the angle of the rotation between the axes, rad."""
        rotation_vector = rotation_log(quat_multiply(_conjugate(self.wxyz), other.wxyz))
        metres = float(np.linalg.norm(other.position - self.position))
        return metres, float(np.linalg.norm(rotation_vector))

    def plus(self, change: Sequence[float] | Array) -> Pose:
        """Return the pose shifted by ``change[:3]`` and rotated by the vector ``change[3:]``.

        Both are seen from the outer frame. The rotation is about the origin of the pose.
        """
        rotation = rotation_exp(change[3:])
        return Pose(self.position + change[:3], quat_multiply(rotation, self.wxyz))

    def minus(self, other: Pose) -> Array:
        """Return the change (6,) with ``other.plus(change) == self``: shift and rotation vector."""
        rotation_vector = rotation_log(quat_multiply(self.wxyz, _conjugate(other.wxyz)))
        return np.concatenate([self.position - other.position, rotation_vector])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        same_position = (self.position == other.position).all()
        return bool(same_position and (self.wxyz == other.wxyz).all())

    def __hash__(self) -> int:
        return hash((*self.position.tolist(), *self.wxyz.tolist()))

    def __repr__(self) -> str:
        position = ", ".join(f"{v:.6g}" for v in self.position)
        wxyz = ", ".join(f"{v:.6g}" for v in self.wxyz)
        return f"Pose(position=({position}), wxyz=({wxyz}))"


def _conjugate(wxyz: Array) -> Array:
    """Return the inverse of a unit quaternion (4,)."""
    return wxyz * np.array([1.0, -1.0, -1.0, -1.0])
