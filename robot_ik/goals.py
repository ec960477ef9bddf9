"""Goals: what is wanted of the robot.  One class a kind; ``body_goals.GOALS`` lists them all.

A goal knows its frame and its target; solvers see only the rows it makes (``kernels/residuals.py``).
Targets are in the world, metres and unit quaternions (w, x, y, z).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import INTEGER, Array, Pose, is_real, rotation_z_to, unit_quaternion, vector
from robot_ik.kernels import residuals as codes

if TYPE_CHECKING:
    from robot_ik.robot import Robot


@dataclass(frozen=True)
class Tolerance:
    """What counts as reached: every goal within ``position`` metres and ``angle`` radians."""

    position: float = 1e-4
    angle: float = 1e-3

    def __post_init__(self) -> None:
        both = self.position, self.angle
        if not all(is_real(value, 0.0, math.inf) and value > 0.0 for value in both):
            raise InvalidGoalError(f"a tolerance must be positive, not {self.position} m, {self.angle} rad")


def nonnegative_number(value: float, what: str) -> float:
    """A finite number, zero or more; raises ``InvalidGoalError`` for anything else."""
    if not is_real(value, 0.0, sys.float_info.max):
        raise InvalidGoalError(f"{what} must be zero or more and finite, not {value!r}")
    return float(value)


def axis_vector(axis: str | ArrayLike, what: str = "axis") -> Array:
    """A unit vector (3,) from "x", "-z" … or three numbers; raises ``InvalidGoalError`` for anything else."""
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
    """1 for each coordinate named in ``axes`` ("xy"), 0 for the others; else raises ``InvalidGoalError``."""
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
    """Which rows a goal makes: all that the kernels know of its kind (codes of ``kernels/residuals.py``).

    Attributes:
        position, orientation, of: What of the position and orientation is asked for, and of what.
        mask: (3,) which coordinates count, in the axes of the target.
        axis: (3,) the axis of the frame that is aligned with the target's, or aimed at it.
    """

    position: int = codes.NO_POSITION
    orientation: int = codes.NO_ORIENTATION
    of: int = codes.OF_FRAME
    mask: tuple[float, float, float] = (1.0, 1.0, 1.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def whole(self) -> bool:
        """A whole position, orientation or pose of a frame: what every method understands."""
        position, orientation = (codes.NO_POSITION, codes.WHOLE), (codes.NO_ORIENTATION, codes.ALL_AXES)
        return self.position in position and self.orientation in orientation and self.of == codes.OF_FRAME


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

    Raises:
        InvalidGoalError: A wrong shape, a number that is not finite, a zero quaternion or direction, no such
            axis, a negative weight.
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
        if not (isinstance(priority, INTEGER) and priority >= 0):
            raise InvalidGoalError(f"a priority is 0 (first), 1, 2 …, not {self.priority!r}")
        if self.tolerance is not None and not isinstance(self.tolerance, Tolerance):
            raise InvalidGoalError(f"a goal's tolerance is a Tolerance, not {self.tolerance!r}")
        if not isinstance(self.soft, bool | np.bool_):
            raise InvalidGoalError(f"soft is True or False, not {self.soft!r}")
        if self.length is not None and not (nonnegative_number(self.length, "length") > 0.0):
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
    def with_article(self) -> str:
        """Its kind, for messages: "a pose goal", "an aim goal"."""
        return f"{'an' if self.name[0] in 'aeiou' else 'a'} {self.name}"

    @cached_property
    def rows(self) -> Rows:
        """Which rows it makes; each kind sets it when it is made."""
        nothing = f"{self.with_article} says nothing of what is wanted"
        raise InvalidGoalError(nothing, hint="take one of robot_ik.body_goals.GOALS")

    @cached_property
    def weights(self) -> tuple[float, float]:
        """Importance of the metres and of the radians; a part that weighs 0 is not asked for."""
        return 1.0, 1.0

    @property
    def target(self) -> Pose:
        """The wanted pose; the part that is not asked for is the identity's."""
        return Pose()

    @property
    def signature(self) -> tuple[object, ...]:
        """What a problem is compiled for; goals of one frame that agree in it differ only in their target."""
        return type(self), self.weights, self.priority, self.soft, self.tolerance, self.length, self.rows

    @property
    def target_row(self) -> Array:
        """(12,) the wanted pose with the axis that counts along z, as the kernels have it."""
        row = self.target.row
        if not self.rows.whole:
            row[3:] = (row[3:].reshape(3, 3) @ rotation_z_to(self.rows.axis)).ravel()
        return row

    def at_row(self, row: Array) -> Goal:
        """The same goal with the target row (12,) that it has now; goals for parts are replaced to move."""
        if not self.rows.whole or np.array_equal(self.target_row, row):
            return self
        return self.moved_to(Pose.from_row(row))

    def moved_to(self, target: Pose) -> Goal:
        """The same goal with another target."""
        raise InvalidGoalError(f"{self.with_article} has no pose to move")

    def moved_nodes(self, robot: Robot) -> set[int]:
        """Joints (nodes of the tree) whose motion it feels."""
        return set(robot.tree.ancestors(robot.attachment(self.frame)[0]))

    def fill(self, arrays: dict[str, Any], g: int, robot: Robot) -> int:
        """Puts what it is asked of into the arrays (``residuals.GOALS``) of a problem whose goal ``g`` it is.

        Returns how many rows it makes beside those of a position and an orientation.
        """
        arrays["node"][g], local = robot.attachment(self.frame)
        if not self.rows.whole:
            local[3:] = (local[3:].reshape(3, 3) @ rotation_z_to(self.rows.axis)).ravel()
        arrays["local"][g] = local
        return 0

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        """Metres and radians off ``target`` at ``q``, by MuJoCo's own forward pass; no weight, no miss."""
        return self.off(robot.measure(q, self.frame), target)

    def off(self, here: Pose, target: Pose) -> tuple[float, float]:
        """Metres and radians that a frame at ``here`` is off ``target``, in what is asked for."""
        rows, asked = self.rows, self.weights
        metres = radians = 0.0
        if rows.position != codes.NO_POSITION and asked[0] > 0.0:
            off = (target.rotation.T @ (target.position - here.position)) * rows.mask
            metres = float(np.linalg.norm(np.maximum(off, 0.0) if rows.position == codes.ONE_SIDE else off))
        if rows.orientation == codes.ALL_AXES and asked[1] > 0.0:
            radians = here.distance(target)[1]
        elif rows.orientation in (codes.ONE_AXIS, codes.AIMED) and asked[1] > 0.0:
            aimed = rows.orientation == codes.AIMED
            axis = here.rotation @ rows.axis
            wanted = target.position - here.position if aimed else target.rotation @ rows.axis
            if np.linalg.norm(wanted) >= 1e-9:
                radians = math.atan2(np.linalg.norm(np.cross(axis, wanted)), axis @ wanted)
        return metres, radians


# Made once: goals are made in loops.
_WHOLE_ORIENTATION = {
    part: Rows(position=part, orientation=codes.ALL_AXES) for part in (codes.NO_POSITION, codes.WHOLE)
}
_WHOLE_POSITION = Rows(position=codes.WHOLE)


def _orientation_rows(position: int, free_axis: str | ArrayLike | None) -> Rows:
    """Rows of an orientation that may leave the rotation about one axis of the frame free."""
    if free_axis is None:
        return _WHOLE_ORIENTATION[position]
    x, y, z = axis_vector(free_axis, "free_axis").tolist()
    return Rows(position=position, orientation=codes.ONE_AXIS, axis=(x, y, z))


@dataclass(frozen=True, eq=False, repr=False)
class WeightedGoal(Goal):
    """A goal with one ``weight``, on all that it asks for."""

    weight: float = field(default=1.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        weight = nonnegative_number(self.weight, "weight")
        self._set(weight=weight, weights=(weight * self.has_position, weight * self.has_angle))


@dataclass(frozen=True, eq=False, repr=False)
class PointGoal(WeightedGoal):
    """A point at ``position`` (3,), world, metres, or at some of its coordinates."""

    position: ArrayLike = ()
    axes: str = field(default="xyz", kw_only=True)

    has_position: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(position=vector(self.position, 3, "position"), rows=self._rows_of(axes_mask(self.axes)))

    def _rows_of(self, mask: tuple[float, float, float]) -> Rows:
        return _WHOLE_POSITION if all(mask) else Rows(position=codes.SOME_AXES, mask=mask)

    @property
    def target(self) -> Pose:
        return Pose(self.position)

    def moved_to(self, target: Pose) -> Self:
        return replace(self, position=target.position)


class PositionGoal(PointGoal):
    """The frame's origin at ``position`` (3,), world, metres; its orientation is free.

    Attributes:
        axes: Which coordinates count; ``"z"`` asks for a height only.
    """

    name: ClassVar[str] = "position goal"


@dataclass(frozen=True, eq=False, repr=False)
class OrientationGoal(WeightedGoal):
    """The frame oriented as the unit quaternion ``wxyz`` (4,), world; its position is free.

    Attributes:
        free_axis: Axis of the frame about which it may rotate freely ("z", "-x" or three numbers):
            only where that axis points is then asked for.
    """

    wxyz: ArrayLike = ()
    free_axis: str | ArrayLike | None = field(default=None, kw_only=True)

    name: ClassVar[str] = "orientation goal"
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = _orientation_rows(codes.NO_POSITION, self.free_axis)
        self._set(wxyz=unit_quaternion(self.wxyz), rows=rows)

    @property
    def target(self) -> Pose:
        return Pose((0.0, 0.0, 0.0), self.wxyz)

    def moved_to(self, target: Pose) -> OrientationGoal:
        return replace(self, wxyz=target.wxyz)


@dataclass(frozen=True, eq=False, repr=False)
class PoseGoal(Goal):
    """The frame at ``position`` (3,) oriented as ``wxyz`` (4,), world.

    Attributes:
        free_axis: As in ``OrientationGoal``: a drill or a cup may rotate about its own axis.
    """

    position: ArrayLike = ()
    wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)
    position_weight: float = field(default=1.0, kw_only=True)
    angle_weight: float = field(default=1.0, kw_only=True)
    free_axis: str | ArrayLike | None = field(default=None, kw_only=True)

    name: ClassVar[str] = "pose goal"
    has_position: ClassVar[bool] = True
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        metres = nonnegative_number(self.position_weight, "position_weight")
        radians = nonnegative_number(self.angle_weight, "angle_weight")
        self._set(
            position=vector(self.position, 3, "position"),
            wxyz=unit_quaternion(self.wxyz),
            position_weight=metres,
            angle_weight=radians,
            weights=(metres, radians),
            rows=_orientation_rows(codes.WHOLE, self.free_axis),
        )

    @classmethod
    def at(cls, frame: str | None, pose: Pose) -> PoseGoal:
        """From a ``Pose``."""
        given: object = pose
        if not isinstance(given, Pose):
            raise InvalidGoalError(f"not a pose: {given!r}", hint="Pose(position, wxyz)")
        goal = cls(frame, pose.position, pose.wxyz)
        goal._set(wxyz=pose.wxyz)  # which is normalised: once more would change its last bits
        return goal

    @property
    def target(self) -> Pose:
        return Pose.of_checked(cast(Array, self.position), cast(Array, self.wxyz))

    def moved_to(self, target: Pose) -> PoseGoal:
        return replace(self, position=target.position, wxyz=target.wxyz)
