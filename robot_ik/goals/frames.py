"""Goals for where a frame is and how it is turned."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, cast

from numpy.typing import ArrayLike

from robot_ik.geometry import Pose
from robot_ik.goals.base import (
    Array,
    Goal,
    Rows,
    axes_mask,
    axis_vector,
    positive_number,
    unit_quaternion,
    vector,
)
from robot_ik.kernels.partial_rows import AIMED, ALL_AXES, NO_PLACE, ONE_AXIS, SOME_AXES, WHOLE

# Made once: the front door looks at them in every solve.
_WHOLE_TURN = {place: Rows(place=place, turn=ALL_AXES) for place in (NO_PLACE, WHOLE)}
_WHOLE_PLACE = Rows(place=WHOLE)


def _turn_rows(place: int, free_axis: str | ArrayLike | None) -> Rows:
    """Rows of an orientation that may leave the turn about one axis of the frame free."""
    if free_axis is None:
        return _WHOLE_TURN[place]
    x, y, z = axis_vector(free_axis, "free_axis").tolist()
    return Rows(place=place, turn=ONE_AXIS, axis=(x, y, z))


@dataclass(frozen=True, eq=False, repr=False)
class PositionGoal(Goal):
    """The frame's origin at ``position`` (3,), world, metres; its orientation is free.

    Attributes:
        axes: Which coordinates count; ``"z"`` asks for a height only.

    Raises:
        InvalidGoalError: Not three finite numbers, a negative weight, or no such axes.
    """

    position: ArrayLike = ()
    weight: float = field(default=1.0, kw_only=True)
    axes: str = field(default="xyz", kw_only=True)

    name: ClassVar[str] = "position goal"
    has_position: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        axes_mask(self.axes)
        self._set(
            position=vector(self.position, 3, "position"), weight=positive_number(self.weight, "weight")
        )

    @property
    def rows(self) -> Rows:
        mask = axes_mask(self.axes)
        return _WHOLE_PLACE if all(mask) else Rows(place=SOME_AXES, mask=mask)

    @property
    def target(self) -> Pose:
        return Pose(self.position)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> PositionGoal:
        return replace(self, position=target.position)


@dataclass(frozen=True, eq=False, repr=False)
class OrientationGoal(Goal):
    """The frame turned as the unit quaternion ``wxyz`` (4,), world; its position is free.

    Attributes:
        free_axis: Axis of the frame about which it may turn as it likes ("z", "-x" or three numbers):
            only where that axis points is then asked for.

    Raises:
        InvalidGoalError: Not four finite numbers, a zero quaternion, a negative weight, or no such axis.
    """

    wxyz: ArrayLike = ()
    weight: float = field(default=1.0, kw_only=True)
    free_axis: str | ArrayLike | None = field(default=None, kw_only=True)

    name: ClassVar[str] = "orientation goal"
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(wxyz=unit_quaternion(self.wxyz, "wxyz"), weight=positive_number(self.weight, "weight"))
        _turn_rows(NO_PLACE, self.free_axis)

    @property
    def rows(self) -> Rows:
        return _turn_rows(NO_PLACE, self.free_axis)

    @property
    def target(self) -> Pose:
        return Pose((0.0, 0.0, 0.0), self.wxyz)

    @property
    def weights(self) -> tuple[float, float]:
        return 0.0, self.weight

    def moved_to(self, target: Pose) -> OrientationGoal:
        return replace(self, wxyz=target.wxyz)


@dataclass(frozen=True, eq=False, repr=False)
class PoseGoal(Goal):
    """The frame at ``position`` (3,) turned as ``wxyz`` (4,), world.

    Attributes:
        free_axis: As in ``OrientationGoal``: a drill or a cup may turn about its own axis.

    Raises:
        InvalidGoalError: Wrong shapes, numbers that are not finite, a zero quaternion, a negative weight.
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
        self._set(
            position=vector(self.position, 3, "position"),
            wxyz=unit_quaternion(self.wxyz, "wxyz"),
            position_weight=positive_number(self.position_weight, "position_weight"),
            angle_weight=positive_number(self.angle_weight, "angle_weight"),
        )
        _turn_rows(WHOLE, self.free_axis)

    @classmethod
    def at(cls, frame: str | None, pose: Pose) -> PoseGoal:
        """From a ``Pose``."""
        return cls(frame, pose.position, pose.wxyz)

    @property
    def rows(self) -> Rows:
        return _turn_rows(WHOLE, self.free_axis)

    @property
    def target(self) -> Pose:
        return Pose.of_checked(cast(Array, self.position), cast(Array, self.wxyz))

    @property
    def weights(self) -> tuple[float, float]:
        return self.position_weight, self.angle_weight

    def moved_to(self, target: Pose) -> PoseGoal:
        return replace(self, position=target.position, wxyz=target.wxyz)


@dataclass(frozen=True, eq=False, repr=False)
class AimGoal(Goal):
    """An axis of the frame, through its origin, points at ``point`` (3,), world: a gaze, a camera, a torch.

    Attributes:
        axis: The axis that looks, in the frame: "z", "-x" … or three numbers.

    Raises:
        InvalidGoalError: Not three finite numbers, no such axis, a negative weight.
    """

    point: ArrayLike = ()
    axis: str | ArrayLike = field(default="z", kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "aim goal"
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        axis_vector(self.axis)
        self._set(point=vector(self.point, 3, "point"), weight=positive_number(self.weight, "weight"))

    @property
    def rows(self) -> Rows:
        x, y, z = axis_vector(self.axis).tolist()
        return Rows(turn=AIMED, axis=(x, y, z))

    @property
    def target(self) -> Pose:
        return Pose(self.point)

    @property
    def weights(self) -> tuple[float, float]:
        return 0.0, self.weight

    def moved_to(self, target: Pose) -> AimGoal:
        return replace(self, point=target.position)
