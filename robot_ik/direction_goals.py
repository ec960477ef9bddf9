"""Goals along a direction: an axis that looks at a point; a point on a line, a plane, one side of a plane."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from numpy.typing import ArrayLike

from robot_ik.geometry import Pose, rotation_z_to, vector
from robot_ik.goals import Goal, Rows, WeightedGoal, axis_vector
from robot_ik.kernels import residuals as codes


@dataclass(frozen=True, eq=False, repr=False)
class AimGoal(WeightedGoal):
    """An axis of the frame, through its origin, points at ``point`` (3,), world: a gaze, a camera, a torch.

    Attributes:
        axis: The axis that looks, in the frame: "z", "-x" … or three numbers.
    """

    point: ArrayLike = ()
    axis: str | ArrayLike = field(default="z", kw_only=True)

    name: ClassVar[str] = "aim goal"
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        x, y, z = axis_vector(self.axis).tolist()
        rows = Rows(orientation=codes.AIMED, axis=(x, y, z))
        self._set(point=vector(self.point, 3, "point"), rows=rows)

    @property
    def target(self) -> Pose:
        return Pose(self.point)

    def moved_to(self, target: Pose) -> AimGoal:
        return replace(self, point=target.position)


@dataclass(frozen=True, eq=False, repr=False)
class _DirectionGoal(WeightedGoal):
    """The frame's origin, measured along and across a direction through ``point`` (3,), world."""

    point: ArrayLike = ()
    direction: ArrayLike | str = "z"

    has_position: ClassVar[bool] = True
    asked: ClassVar[Rows]

    def __post_init__(self) -> None:
        super().__post_init__()
        direction = axis_vector(self.direction, "direction")
        self._set(point=vector(self.point, 3, "point"), direction=direction, rows=self.asked)

    @property
    def target(self) -> Pose:
        """Its z axis is the direction."""
        return Pose.from_rotation(rotation_z_to(axis_vector(self.direction)), self.point)

    def moved_to(self, target: Pose) -> Goal:
        """Through the origin of ``target``, along its z axis."""
        return replace(self, point=target.position, direction=target.rotation[:, 2])


class LineGoal(_DirectionGoal):
    """The frame's origin anywhere on the line through ``point`` (3,) along ``direction`` (3,), world."""

    name: ClassVar[str] = "line goal"
    asked: ClassVar[Rows] = Rows(position=codes.SOME_AXES, mask=(1.0, 1.0, 0.0))


class PlaneGoal(_DirectionGoal):
    """The frame's origin anywhere on the plane through ``point`` (3,) with normal ``direction`` (3,)."""

    name: ClassVar[str] = "plane goal"
    asked: ClassVar[Rows] = Rows(position=codes.SOME_AXES, mask=(0.0, 0.0, 1.0))


class HalfSpaceGoal(_DirectionGoal):
    """The frame's origin on that side of the plane to which ``direction`` (3,) points: a one-sided wall.

    Nothing is asked while it is there; the plane goes through ``point`` (3,), world.
    """

    name: ClassVar[str] = "half-space goal"
    asked: ClassVar[Rows] = Rows(position=codes.ONE_SIDE, mask=(0.0, 0.0, 1.0))
