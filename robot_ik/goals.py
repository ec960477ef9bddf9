"""Goals: what is wanted of a robot's frames.

A goal knows its frame and its target; solvers see only the rows it makes (``kernels/residuals.py``).
Targets are in the world, metres and unit quaternions (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import InvalidGoalError
from robot_ik.geometry import Pose

Array = NDArray[np.float64]


def _vector(values: ArrayLike, size: int, what: str) -> Array:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidGoalError(f"{what} must be {size} numbers, not {values!r}") from error
    if array.shape != (size,):
        raise InvalidGoalError(f"{what} must be {size} numbers, not {array.size} ({values!r})")
    if not np.isfinite(array).all():
        raise InvalidGoalError(f"{what} must be finite, not {array.tolist()}")
    array.flags.writeable = False
    return array


def _quaternion(values: ArrayLike, what: str) -> Array:
    array = _vector(values, 4, what)
    norm = float(np.linalg.norm(array))
    if norm < 1e-9:
        raise InvalidGoalError(
            f"{what} is a zero quaternion, which is no orientation",
            hint="quaternions are w, x, y, z; 1 0 0 0 turns nothing",
        )
    unit = array / norm
    unit.flags.writeable = False
    return unit


def _frame(name: object) -> str | None:
    if name is None or isinstance(name, str):
        return name
    raise InvalidGoalError(
        f"the frame must be a name (or None for the tool), not {name!r}",
        hint='the frame comes first: PositionGoal("gripper", (x, y, z))',
    )


def _weight(value: float, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = -1.0
    if not (np.isfinite(number) and number >= 0.0):
        raise InvalidGoalError(f"{what} must be zero or more and finite, not {value!r}")
    return number


@dataclass(frozen=True, eq=False)
class Goal:
    """Something wanted of one frame of the robot.

    Attributes:
        frame: Name of the frame; None means the robot's tool.
    """

    frame: str | None

    name: ClassVar[str] = "goal"
    # Whether the goal has a part in metres, and one in radians.
    has_position: ClassVar[bool] = False
    has_angle: ClassVar[bool] = False

    @property
    def target(self) -> Pose:
        """The wanted pose; the part that is not asked for is the identity's."""
        return Pose()

    @property
    def weights(self) -> tuple[float, float]:
        """Importance of the metres and of the radians; a part that weighs 0 is not asked for."""
        return 1.0, 1.0

    def moved_to(self, target: Pose) -> Goal:
        """The same goal with another target."""
        raise InvalidGoalError(f"a {self.name} has no pose to move")


@dataclass(frozen=True, eq=False)
class PositionGoal(Goal):
    """The frame's origin at ``position`` (3,), world, metres; its orientation is free.

    Raises:
        InvalidGoalError: Not three finite numbers, or a negative weight.
    """

    position: ArrayLike = (0.0, 0.0, 0.0)
    weight: float = 1.0

    name: ClassVar[str] = "position goal"
    has_position: ClassVar[bool] = True

    def __init__(self, frame: str | None = None, position: ArrayLike = (), *, weight: float = 1.0) -> None:
        object.__setattr__(self, "frame", _frame(frame))
        object.__setattr__(self, "position", _vector(position, 3, "position"))
        object.__setattr__(self, "weight", _weight(weight, "weight"))

    @property
    def target(self) -> Pose:
        return Pose(self.position)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> PositionGoal:
        return PositionGoal(self.frame, target.position, weight=self.weight)


@dataclass(frozen=True, eq=False)
class OrientationGoal(Goal):
    """The frame turned as the unit quaternion ``wxyz`` (4,), world; its position is free.

    Raises:
        InvalidGoalError: Not four finite numbers, a zero quaternion, or a negative weight.
    """

    wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)
    weight: float = 1.0

    name: ClassVar[str] = "orientation goal"
    has_angle: ClassVar[bool] = True

    def __init__(self, frame: str | None = None, wxyz: ArrayLike = (), *, weight: float = 1.0) -> None:
        object.__setattr__(self, "frame", _frame(frame))
        object.__setattr__(self, "wxyz", _quaternion(wxyz, "wxyz"))
        object.__setattr__(self, "weight", _weight(weight, "weight"))

    @property
    def target(self) -> Pose:
        return Pose((0.0, 0.0, 0.0), self.wxyz)

    @property
    def weights(self) -> tuple[float, float]:
        return 0.0, self.weight

    def moved_to(self, target: Pose) -> OrientationGoal:
        return OrientationGoal(self.frame, target.wxyz, weight=self.weight)


@dataclass(frozen=True, eq=False)
class PoseGoal(Goal):
    """The frame at ``position`` (3,) turned as ``wxyz`` (4,), world.

    Raises:
        InvalidGoalError: Wrong shapes, numbers that are not finite, a zero quaternion, a negative weight.
    """

    position: ArrayLike = (0.0, 0.0, 0.0)
    wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)
    position_weight: float = 1.0
    angle_weight: float = 1.0

    name: ClassVar[str] = "pose goal"
    has_position: ClassVar[bool] = True
    has_angle: ClassVar[bool] = True

    def __init__(
        self,
        frame: str | None = None,
        position: ArrayLike = (),
        wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        *,
        position_weight: float = 1.0,
        angle_weight: float = 1.0,
    ) -> None:
        object.__setattr__(self, "frame", _frame(frame))
        object.__setattr__(self, "position", _vector(position, 3, "position"))
        object.__setattr__(self, "wxyz", _quaternion(wxyz, "wxyz"))
        object.__setattr__(self, "position_weight", _weight(position_weight, "position_weight"))
        object.__setattr__(self, "angle_weight", _weight(angle_weight, "angle_weight"))

    @classmethod
    def at(cls, frame: str | None, pose: Pose) -> PoseGoal:
        """From a ``Pose``."""
        return cls(frame, pose.position, pose.wxyz)

    @property
    def target(self) -> Pose:
        return Pose(self.position, self.wxyz)

    @property
    def weights(self) -> tuple[float, float]:
        return self.position_weight, self.angle_weight

    def moved_to(self, target: Pose) -> PoseGoal:
        return PoseGoal(
            self.frame, target.position, target.wxyz,
            position_weight=self.position_weight, angle_weight=self.angle_weight,
        )  # fmt: skip


GOALS: tuple[type[Goal], ...] = (PositionGoal, OrientationGoal, PoseGoal)
