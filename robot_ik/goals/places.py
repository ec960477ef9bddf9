"""Goals for the frame's origin that leave some of its coordinates free: line, plane, half-space."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from numpy.typing import ArrayLike

from robot_ik.geometry import Pose, turn_z_to
from robot_ik.goals.base import Goal, Rows, axis_vector, positive_number, vector
from robot_ik.kernels.partial_rows import ONE_SIDE, SOME_AXES


@dataclass(frozen=True, eq=False, repr=False)
class _Place(Goal):
    """The frame's origin, measured along and across a direction through ``point`` (3,), world."""

    point: ArrayLike = ()
    direction: ArrayLike | str = "z"
    weight: float = field(default=1.0, kw_only=True)

    has_position: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(
            point=vector(self.point, 3, "point"),
            direction=axis_vector(self.direction, "direction"),
            weight=positive_number(self.weight, "weight"),
        )

    @property
    def target(self) -> Pose:
        """Its z axis is the direction."""
        return Pose.from_rotation(turn_z_to(axis_vector(self.direction)), self.point)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> Goal:
        """Through the origin of ``target``, along its z axis."""
        return replace(self, point=target.position, direction=target.rotation[:, 2])


class LineGoal(_Place):
    """The frame's origin anywhere on the line through ``point`` (3,) along ``direction`` (3,), world.

    Raises:
        InvalidGoalError: Not three finite numbers, a zero direction, a negative weight.
    """

    name: ClassVar[str] = "line goal"

    @property
    def rows(self) -> Rows:
        return Rows(place=SOME_AXES, mask=(1.0, 1.0, 0.0))


class PlaneGoal(_Place):
    """The frame's origin anywhere on the plane through ``point`` (3,) with normal ``direction`` (3,), world.

    Raises:
        InvalidGoalError: Not three finite numbers, a zero direction, a negative weight.
    """

    name: ClassVar[str] = "plane goal"

    @property
    def rows(self) -> Rows:
        return Rows(place=SOME_AXES, mask=(0.0, 0.0, 1.0))


class HalfSpaceGoal(_Place):
    """The frame's origin on that side of the plane to which ``direction`` (3,) points: a one-sided wall.

    Nothing is asked while it is there; the plane goes through ``point`` (3,), world.

    Raises:
        InvalidGoalError: Not three finite numbers, a zero direction, a negative weight.
    """

    name: ClassVar[str] = "half-space goal"

    @property
    def rows(self) -> Rows:
        return Rows(place=ONE_SIDE, mask=(0.0, 0.0, 1.0))
