"""What every goal has, and the checks of what it is made from.

A goal knows its frame and its target; solvers see only the rows it makes (``kernels/residuals.py``).
Targets are in the world, metres and unit quaternions (w, x, y, z).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose
from robot_ik.kernels.partial_rows import (
    AIMED,
    ALL_AXES,
    NO_PLACE,
    NO_TURN,
    OF_FRAME,
    OF_MASS,
    ONE_AXIS,
    ONE_SIDE,
    WHOLE,
)

if TYPE_CHECKING:
    from robot_ik.robot import Robot

Array = NDArray[np.float64]

# Squares of larger numbers, or of longer vectors, leave the range of floats.
LARGEST = 1e100
# Made once: goals are made in loops.
_WHOLE, _YES_OR_NO = int | np.integer, bool | np.bool_


@dataclass(frozen=True)
class Tolerance:
    """What counts as reached: every goal within ``position`` metres and ``angle`` radians."""

    position: float = 1e-4
    angle: float = 1e-3

    def __post_init__(self) -> None:
        try:
            positive = self.position > 0 and self.angle > 0
        except TypeError:
            positive = False
        if not positive:
            raise InvalidGoalError(f"a tolerance must be positive, not {self.position} m, {self.angle} rad")


def numbers(values: ArrayLike, what: str, wanted: str = "numbers") -> Array:
    """A new array of floats; raises ``InvalidGoalError`` in words for text or uneven rows."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidGoalError(f"{what} must be {wanted}, not {values!r}") from error


def vector(values: ArrayLike, size: int, what: str) -> Array:
    """A read-only finite array (size,); raises ``InvalidGoalError`` in words for anything else."""
    array = numbers(values, what, f"{size} numbers")
    if array.shape != (size,):
        found = array.size if array.size != size else f"an array of shape {array.shape}"
        raise InvalidGoalError(f"{what} must be {size} numbers, not {found} ({values!r})")
    found = array.tolist()  # Python's own numbers are quicker for so few
    if not math.hypot(*found) <= LARGEST:  # NaN too
        bound = f"below {LARGEST:g}" if all(map(math.isfinite, found)) else "finite"
        raise InvalidGoalError(f"{what} must be {bound}, not {found}")
    array.setflags(write=False)
    return array


def rotation_matrix(values: Array, what: str) -> Array:
    """``values`` (3, 3) if they turn and do nothing else; raises ``InvalidGoalError`` otherwise."""
    if not (np.abs(values.T @ values - np.eye(3)).max() < 1e-5 and np.linalg.det(values) > 0.0):
        raise InvalidGoalError(f"{what} has a matrix that does not turn: it scales or mirrors")
    return values


def unit_quaternion(values: ArrayLike, what: str) -> Array:
    """A read-only unit quaternion (4,), w first; raises ``InvalidGoalError`` for anything else."""
    array = vector(values, 4, what)
    w, x, y, z = array.tolist()
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if norm < 1e-9:
        raise InvalidGoalError(
            f"{what} is a zero quaternion, which is no orientation",
            hint="quaternions are w, x, y, z; 1 0 0 0 turns nothing",
        )
    if norm == 1.0:
        return array
    unit = array / norm
    unit.flags.writeable = False
    return unit


def positive_number(value: float, what: str) -> float:
    """A finite number, zero or more; raises ``InvalidGoalError`` for anything else."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = -1.0
    if not 0.0 <= number < math.inf:
        raise InvalidGoalError(f"{what} must be zero or more and finite, not {value!r}")
    return number


def axis_vector(axis: str | ArrayLike, what: str = "axis") -> Array:
    """A unit vector (3,) from "x", "-z" … or three numbers.

    Raises:
        InvalidGoalError: No such axis, or a zero vector.
    """
    if isinstance(axis, str):
        letter, sign = axis.lstrip("+-"), -1.0 if axis.startswith("-") else 1.0
        if letter not in ("x", "y", "z"):
            raise InvalidGoalError(f"{what} must be x, y, z, -x, -y, -z or three numbers, not {axis!r}")
        return sign * np.eye(3)["xyz".index(letter)]
    array = vector(axis, 3, what)
    norm = float(np.linalg.norm(array))
    if norm < 1e-9:
        raise InvalidGoalError(f"{what} is a zero vector, which has no direction")
    return np.asarray(array / norm)


def axes_mask(axes: object) -> tuple[float, float, float]:
    """1 for each coordinate named in ``axes`` ("xy"), 0 for the others.

    Raises:
        InvalidGoalError: No axis, an axis twice, or a letter that is none.
    """
    if not isinstance(axes, str) or not axes or len(set(axes)) < len(axes) or set(axes) - set("xyz"):
        raise InvalidGoalError(f"axes must be some of the letters x, y and z, not {axes!r}")
    return tuple(float(letter in axes) for letter in "xyz")  # type: ignore[return-value]


def _plain(value: object) -> object:
    """A field's value as something that can be compared and hashed."""
    if isinstance(value, Mapping):
        return tuple(sorted(value.items()))
    if isinstance(value, str) or not hasattr(value, "__len__"):
        return value
    return tuple(np.asarray(value, dtype=float).ravel().tolist())


def _short(value: object) -> str:
    """A field's value in few signs."""
    if not isinstance(value, tuple):
        return repr(value)
    some = ", ".join(f"{v:.6g}" if isinstance(v, float) else repr(v) for v in value[:8])
    return f"({some}{f', … {len(value) - 8} more' if len(value) > 8 else ''})"


@dataclass(frozen=True)
class Rows:
    """Which rows a goal makes: all that the kernels know of its kind (``kernels/partial_rows.py``).

    Attributes:
        place, turn, of: Codes: what of the position and of the orientation is asked for, and of what.
        mask: (3,) which coordinates count, in the axes of the target.
        axis: (3,) the axis of the frame that is turned to the target's, or aimed at it.
    """

    place: int = NO_PLACE
    turn: int = NO_TURN
    of: int = OF_FRAME
    mask: tuple[float, float, float] = (1.0, 1.0, 1.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def whole(self) -> bool:
        """A whole position, orientation or pose of a frame: what every method understands."""
        return self.place in (NO_PLACE, WHOLE) and self.turn in (NO_TURN, ALL_AXES) and self.of == OF_FRAME


@dataclass(frozen=True, eq=False, repr=False)
class Goal:
    """Something wanted of the robot, mostly of one of its frames.

    Attributes:
        frame: Name of the frame; None means the robot's tool.
        priority: Goals of 0 are served first; those of 1 get what freedom is left, and so on.
        tolerance: What counts as reached for this goal; None = as the problem says.
        soft: Wanted, not needed: it gets what freedom all other goals leave, never counts for ``converged``,
            and is not searched for.  Soft goals have priorities among themselves.
        length: Metres that count as much as one radian; None = 0.15 of the robot's reach.
            A00's scale c: one metre counts as much as d degrees for c = 360 / (2π d).
    """

    frame: str | None = None
    priority: int = field(default=0, kw_only=True)
    tolerance: Tolerance | None = field(default=None, kw_only=True)
    length: float | None = field(default=None, kw_only=True)
    soft: bool = field(default=False, kw_only=True)

    name: ClassVar[str] = "goal"
    # Whether the goal has a part in metres, and one in radians.
    has_position: ClassVar[bool] = False
    has_angle: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.frame is not None and not isinstance(self.frame, str):
            raise InvalidGoalError(
                f"the frame must be a name (or None for the tool), not {self.frame!r}",
                hint='the frame comes first: PositionGoal("gripper", (x, y, z))',
            )
        priority: object = self.priority
        if not (isinstance(priority, _WHOLE) and priority >= 0):
            raise InvalidGoalError(f"a priority is 0 (first), 1, 2 …, not {self.priority!r}")
        if self.tolerance is not None and not isinstance(self.tolerance, Tolerance):
            raise InvalidGoalError(f"a goal's tolerance is a Tolerance, not {self.tolerance!r}")
        if not isinstance(self.soft, _YES_OR_NO):
            raise InvalidGoalError(f"soft is True or False, not {self.soft!r}")
        if self.length is not None and not (positive_number(self.length, "length") > 0.0):
            raise InvalidGoalError(f"length must be positive, not {self.length!r}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Goal):
            return NotImplemented
        return type(self) is type(other) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash((type(self), self._values()))

    def __repr__(self) -> str:
        shown = [f"{self.frame!r}"] if any(f.name == "frame" and f.init for f in fields(self)) else []
        for item, value in zip(fields(self), self._values(), strict=True):
            if item.name != "frame" and value != item.default and value not in ((), (1.0, 0.0, 0.0, 0.0)):
                shown.append(f"{item.name}={_short(value)}")
        return f"{type(self).__name__}({', '.join(shown)})"

    def _values(self) -> tuple[object, ...]:
        """What it is made of, arrays as tuples of numbers."""
        return tuple(_plain(getattr(self, item.name)) for item in fields(self))

    def _set(self, **values: object) -> None:
        """Puts checked values into the frozen fields."""
        self.__dict__.update(values)

    @property
    def rows(self) -> Rows:
        """Which rows it makes."""
        raise InvalidGoalError(
            f"a {self.name} says nothing of what is wanted", hint="take one of rik.goals.GOALS"
        )

    @property
    def target(self) -> Pose:
        """The wanted pose; the part that is not asked for is the identity's."""
        return Pose()

    @property
    def weights(self) -> tuple[float, float]:
        """Importance of the metres and of the radians; a part that weighs 0 is not asked for."""
        return 1.0, 1.0

    @property
    def signature(self) -> tuple[object, ...]:
        """What a problem is compiled for; goals of one frame that agree in it differ only in their target."""
        return type(self), self.weights, self.priority, self.soft, self.tolerance, self.length, self.rows

    def moved_to(self, target: Pose) -> Goal:
        """The same goal with another target."""
        raise InvalidGoalError(f"a {self.name} has no pose to move")

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        """Metres and radians off ``target`` at ``q``, by MuJoCo's own forward pass; no weight, no miss."""
        if self.rows.of == OF_MASS:
            return self.off(Pose(robot.center_of_mass(q, self.frame)), target)
        return self.off(robot.measure(q, self.frame), target)

    def off(self, here: Pose, target: Pose) -> tuple[float, float]:
        """Metres and radians that a frame at ``here`` is off ``target``, in what is asked for."""
        rows, asked = self.rows, self.weights
        metres = radians = 0.0
        if rows.place != NO_PLACE and asked[0] > 0.0:
            off = (target.rotation.T @ (target.position - here.position)) * rows.mask
            metres = float(np.linalg.norm(np.maximum(off, 0.0) if rows.place == ONE_SIDE else off))
        if rows.turn == ALL_AXES and asked[1] > 0.0:
            radians = here.distance(target)[1]
        elif rows.turn in (ONE_AXIS, AIMED) and asked[1] > 0.0:
            axis, wanted = here.rotation @ rows.axis, target.rotation @ rows.axis
            if rows.turn == AIMED:
                wanted = target.position - here.position
                if np.linalg.norm(wanted) < 1e-9:
                    return metres, 0.0
            sine, cosine = float(np.linalg.norm(np.cross(axis, wanted))), float(axis @ wanted)
            radians = float(np.arctan2(sine, cosine))
        return metres, radians
