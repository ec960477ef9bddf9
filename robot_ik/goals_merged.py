"""Goals: what the frames, the centre of mass or the joints of a robot should reach. ``GOALS`` lists them.

A goal is an immutable description: a frame, a target and weights. Targets are in the world, in metres and
unit quaternions (w, x, y, z). ``Goal.rows`` is what kernels need to know about a goal; it is the only method
that a new kind of goal must write besides ``target`` and ``moved_to``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError, ModelError, require_joints
from robot_ik.geometry import (
    INTEGER,
    Array,
    Pose,
    is_real,
    numbers,
    rotation_z_to,
    unit_quaternion,
    vector,
)
from robot_ik.kernels.frame_goals import (
    AIMED,
    ALL_AXES,
    ALL_COORDINATES,
    NO_ORIENTATION,
    NO_POSITION,
    ONE_AXIS,
    ONE_SIDE,
    SOME_COORDINATES,
)
from robot_ik.kernels.tree import FREE, SLIDE, V_WIDTH

if TYPE_CHECKING:
    from robot_ik.robot import Robot

# A direction shorter than this has no direction.
_MIN_DIRECTION = 1e-9
# kg; a robot with less mass was described without masses.
_MIN_MASS = 1e-6
_ALL = (1.0, 1.0, 1.0)
_ALONG_Z = (0.0, 0.0, 1.0)
_ACROSS_Z = (1.0, 1.0, 0.0)


@dataclass(frozen=True)
class Tolerance:
    """A goal is met within ``position`` metres and ``angle`` radians."""

    position: float = 1e-4
    angle: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("position", "angle"):
            value = getattr(self, name)
            if not (is_real(value, 0.0, math.inf) and value > 0.0):
                raise InvalidGoalError(f"the {name} of a tolerance must be positive, not {value!r}")


@dataclass(frozen=True)
class GoalRows:
    """What kernels need to know about a goal, in the codes of ``kernels/frame_goals.py``.

    Attributes:
        moving_nodes: Nodes of the tree whose motion changes the residual.
        position_part, orientation_part: Which coordinates and axes count.
        mask: 1 for each coordinate that counts, in the axes of the target.
        axis: Axis of the frame that counts; the kernels rotate it to z.
        masses: (n + 1, 4) of a centre of mass: mass and centre of each node, last of what never moves.
        joint_weights: (nv,) of a posture: weight of each degree of freedom.
    """

    moving_nodes: frozenset[int]
    position_part: int = NO_POSITION
    orientation_part: int = NO_ORIENTATION
    mask: tuple[float, float, float] = _ALL
    axis: tuple[float, float, float] = _ALONG_Z
    masses: Array | None = None
    joint_weights: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Goal:
    """A goal for a robot, usually for one of its frames.

    Attributes:
        frame: Name of the frame; None for the robot's tool.
        priority: Goals of priority 0 are met first. Those of priority 1 use the freedom that is left, and
            so on.
        tolerance: Tolerance of this goal; None for that of the problem.
        length: Metres that count as much as one radian; None for 0.15 of the robot's reach.
        soft: The goal uses the freedom that all other goals leave. It does not decide ``converged``.

    Raises:
        InvalidGoalError: A wrong shape, a number that is not finite, a zero quaternion or direction, an
            unknown axis, a negative weight.
    """

    frame: str | None = None
    priority: int = field(default=0, kw_only=True)
    tolerance: Tolerance | None = field(default=None, kw_only=True)
    length: float | None = field(default=None, kw_only=True)
    soft: bool = field(default=False, kw_only=True)

    name: ClassVar[str] = "goal"

    def __post_init__(self) -> None:
        if self.frame is not None and not isinstance(self.frame, str):
            raise InvalidGoalError(
                f"the frame must be a name, or None for the tool, not {self.frame!r}",
                hint='the frame comes first: PositionGoal("gripper", (x, y, z))',
            )
        if not (isinstance(self.priority, INTEGER) and self.priority >= 0):
            raise InvalidGoalError(f"a priority must be 0, 1, 2 and so on, not {self.priority!r}")
        if self.tolerance is not None and not isinstance(self.tolerance, Tolerance):
            raise InvalidGoalError(f"a goal's tolerance must be a Tolerance, not {self.tolerance!r}")
        if not isinstance(self.soft, bool | np.bool_):
            raise InvalidGoalError(f"soft must be True or False, not {self.soft!r}")
        if self.length is not None and not nonnegative(self.length, "length") > 0.0:
            raise InvalidGoalError(f"length must be positive, not {self.length!r}")

    # What each kind defines

    @property
    def target(self) -> Pose:
        """The wanted pose; identity in the parts that the goal does not ask for."""
        return Pose()

    @property
    def weights(self) -> tuple[float, float]:
        """Weight of the metres and of the radians; 0 for a part that the goal does not ask for."""
        raise NotImplementedError

    def moved_to(self, target: Pose) -> Goal:
        """Return the same goal with another target."""
        raise InvalidGoalError(f"a {self.name} has no pose to move")

    def rows(self, robot: Robot) -> GoalRows:
        """Return what kernels need to know."""
        raise NotImplementedError

    def miss(self, robot: Robot, q: Array) -> tuple[float, float]:
        """Return the metres and radians that are missing at ``q``, by MuJoCo's own forward pass."""
        return frame_miss(self.rows(robot), self.weights, robot.measure(q, self.frame), self.target)

    # Values

    @property
    def kind(self) -> tuple[object, ...]:
        """A key. Goals with equal keys differ only in their target."""
        # Written out: ``solve`` asks in each call, and a loop over the fields takes ten microseconds.
        common = (self.frame, self.priority, self.tolerance, self.length, self.soft)
        return type(self), common, self._options()

    def _options(self) -> tuple[object, ...]:
        """Return the fields of this kind that are not part of the target, as a key."""
        raise NotImplementedError

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Goal):
            return NotImplemented
        return type(self) is type(other) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash((type(self), self._values()))

    def __repr__(self) -> str:
        shown = [repr(self.frame)]
        for item, value in zip(fields(self), self._values(), strict=True):
            if item.name != "frame" and value != item.default:
                shown.append(f"{item.name}={value!r}")
        return f"{type(self).__name__}({', '.join(shown)})"

    def _values(self) -> tuple[object, ...]:
        return tuple(_hashable(getattr(self, item.name)) for item in fields(self))

    def _set(self, **values: object) -> None:
        """Put checked values into the frozen fields; for ``__post_init__``."""
        self.__dict__.update(values)

    def _frame_nodes(self, robot: Robot) -> frozenset[int]:
        node, _ = robot.attachment(self.frame)
        return frozenset(robot.tree.ancestors(node))


# Goals on the pose of a frame


@dataclass(frozen=True, eq=False, repr=False)
class PositionGoal(Goal):
    """The origin of the frame at ``position`` (3,), world, metres; its orientation is free.

    Attributes:
        axes: Coordinates that count; ``"z"`` asks for a height only.
        weight: Weight against other goals.
    """

    position: ArrayLike = ()
    axes: str = field(default="xyz", kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "position goal"

    def __post_init__(self) -> None:
        super().__post_init__()
        axes_mask(self.axes)
        self._set(
            position=vector(self.position, 3, "position"),
            weight=nonnegative(self.weight, "weight"),
        )

    @property
    def target(self) -> Pose:
        return Pose(self.position)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> Self:
        return replace(self, position=target.position)

    def _options(self) -> tuple[object, ...]:
        return self.axes, self.weight

    def rows(self, robot: Robot) -> GoalRows:
        mask = axes_mask(self.axes)
        return GoalRows(
            moving_nodes=self._frame_nodes(robot),
            position_part=ALL_COORDINATES if all(mask) else SOME_COORDINATES,
            mask=mask,
        )


@dataclass(frozen=True, eq=False, repr=False)
class OrientationGoal(Goal):
    """The frame oriented as the unit quaternion ``wxyz`` (4,), world; its position is free.

    Attributes:
        free_axis: Axis of the frame about which it may rotate freely: "z", "-x" or three numbers. The goal
            then asks only for the direction of this axis.
        weight: Weight against other goals.
    """

    wxyz: ArrayLike = ()
    free_axis: str | ArrayLike | None = field(default=None, kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "orientation goal"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.free_axis is not None:
            axis_vector(self.free_axis, "free_axis")
        self._set(
            wxyz=unit_quaternion(self.wxyz),
            weight=nonnegative(self.weight, "weight"),
        )

    @property
    def target(self) -> Pose:
        return Pose((0.0, 0.0, 0.0), self.wxyz)

    @property
    def weights(self) -> tuple[float, float]:
        return 0.0, self.weight

    def moved_to(self, target: Pose) -> OrientationGoal:
        return replace(self, wxyz=target.wxyz)

    def _options(self) -> tuple[object, ...]:
        return _hashable(self.free_axis), self.weight

    def rows(self, robot: Robot) -> GoalRows:
        part, axis = _orientation_part(self.free_axis)
        return GoalRows(self._frame_nodes(robot), orientation_part=part, axis=axis)


@dataclass(frozen=True, eq=False, repr=False)
class PoseGoal(Goal):
    """The frame at ``position`` (3,), oriented as ``wxyz`` (4,), world.

    Attributes:
        position_weight, angle_weight: Weights against other goals. A part with weight 0 is not asked for.
        free_axis: As for ``OrientationGoal``: a drill or a cup may rotate about its own axis.
    """

    position: ArrayLike = ()
    wxyz: ArrayLike = (1.0, 0.0, 0.0, 0.0)
    position_weight: float = field(default=1.0, kw_only=True)
    angle_weight: float = field(default=1.0, kw_only=True)
    free_axis: str | ArrayLike | None = field(default=None, kw_only=True)

    name: ClassVar[str] = "pose goal"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.free_axis is not None:
            axis_vector(self.free_axis, "free_axis")
        self._set(
            position=vector(self.position, 3, "position"),
            wxyz=unit_quaternion(self.wxyz),
            position_weight=nonnegative(self.position_weight, "position_weight"),
            angle_weight=nonnegative(self.angle_weight, "angle_weight"),
        )

    @classmethod
    def at(cls, frame: str | None, pose: Pose) -> PoseGoal:
        """Return a goal for a ``Pose``."""
        if not isinstance(pose, Pose):
            raise InvalidGoalError(f"not a pose: {pose!r}", hint="Pose(position, wxyz)")
        goal = cls(frame, pose.position, pose.wxyz)
        goal._set(wxyz=pose.wxyz)  # a pose is normalised; twice would change the last bits
        return goal

    @property
    def target(self) -> Pose:
        return Pose.of_checked(self.position, self.wxyz)

    @property
    def weights(self) -> tuple[float, float]:
        return self.position_weight, self.angle_weight

    def moved_to(self, target: Pose) -> PoseGoal:
        return replace(self, position=target.position, wxyz=target.wxyz)

    def _options(self) -> tuple[object, ...]:
        return self.position_weight, self.angle_weight, _hashable(self.free_axis)

    def rows(self, robot: Robot) -> GoalRows:
        part, axis = _orientation_part(self.free_axis)
        return GoalRows(self._frame_nodes(robot), ALL_COORDINATES, part, axis=axis)


# Goals along a direction


@dataclass(frozen=True, eq=False, repr=False)
class AimGoal(Goal):
    """An axis of the frame points at ``point`` (3,), world: a gaze, a camera, a torch.

    Attributes:
        axis: Axis of the frame, through its origin: "z", "-x" or three numbers.
        weight: Weight against other goals.
    """

    point: ArrayLike = ()
    axis: str | ArrayLike = field(default="z", kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "aim goal"

    def __post_init__(self) -> None:
        super().__post_init__()
        axis_vector(self.axis)
        self._set(
            point=vector(self.point, 3, "point"),
            weight=nonnegative(self.weight, "weight"),
        )

    @property
    def target(self) -> Pose:
        return Pose(self.point)

    @property
    def weights(self) -> tuple[float, float]:
        return 0.0, self.weight

    def moved_to(self, target: Pose) -> AimGoal:
        return replace(self, point=target.position)

    def _options(self) -> tuple[object, ...]:
        return _hashable(self.axis), self.weight

    def rows(self, robot: Robot) -> GoalRows:
        x, y, z = axis_vector(self.axis).tolist()
        return GoalRows(self._frame_nodes(robot), orientation_part=AIMED, axis=(x, y, z))


@dataclass(frozen=True, eq=False, repr=False)
class _DirectionGoal(Goal):
    """The origin of the frame, along or across a ``direction`` through ``point`` (3,), world."""

    point: ArrayLike = ()
    direction: ArrayLike | str = "z"
    weight: float = field(default=1.0, kw_only=True)

    _part: ClassVar[int] = SOME_COORDINATES
    _mask: ClassVar[tuple[float, float, float]] = _ALONG_Z

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set(
            point=vector(self.point, 3, "point"),
            direction=axis_vector(self.direction, "direction"),
            weight=nonnegative(self.weight, "weight"),
        )

    @property
    def target(self) -> Pose:
        """A pose at the point with its z axis along the direction."""
        return Pose.from_rotation(rotation_z_to(self.direction), self.point)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> Self:
        """Return the goal through the origin of ``target``, along its z axis."""
        return replace(self, point=target.position, direction=target.rotation[:, 2])

    def _options(self) -> tuple[object, ...]:
        return (self.weight,)

    def rows(self, robot: Robot) -> GoalRows:
        return GoalRows(self._frame_nodes(robot), self._part, mask=self._mask)


class LineGoal(_DirectionGoal):
    """The origin of the frame anywhere on the line through ``point`` (3,) along ``direction`` (3,)."""

    name: ClassVar[str] = "line goal"
    _mask: ClassVar[tuple[float, float, float]] = _ACROSS_Z


class PlaneGoal(_DirectionGoal):
    """The origin of the frame anywhere on the plane through ``point`` (3,) with normal ``direction`` (3,)."""

    name: ClassVar[str] = "plane goal"


class HalfSpaceGoal(_DirectionGoal):
    """The origin of the frame on the side of a plane to which ``direction`` (3,) points: a one-sided wall.

    The plane goes through ``point`` (3,), world. On the allowed side the goal is met.
    """

    name: ClassVar[str] = "half-space goal"
    _part: ClassVar[int] = ONE_SIDE


# Goals for the whole body


@dataclass(frozen=True, eq=False, repr=False)
class CenterOfMassGoal(PositionGoal):
    """The centre of mass at ``position`` (3,), world, metres; MuJoCo's ``subtree_com``.

    Attributes:
        frame: Name of a body: the centre of mass of this body and its descendants; None for the whole model.
        axes: Coordinates that count; ``"xy"`` balances over a point and leaves the height free.
    """

    name: ClassVar[str] = "centre-of-mass goal"

    def rows(self, robot: Robot) -> GoalRows:
        masses = mass_table(robot, self.frame)
        heavy = np.flatnonzero(masses[:-1, 0] > 0.0)
        nodes = {k for node in heavy for k in robot.tree.ancestors(int(node))}
        return GoalRows(
            frozenset(nodes), SOME_COORDINATES, mask=axes_mask(self.axes), masses=masses
        )

    def miss(self, robot: Robot, q: Array) -> tuple[float, float]:
        center = Pose(robot.center_of_mass(q, self.frame))
        return frame_miss(self.rows(robot), self.weights, center, self.target)


@dataclass(frozen=True, eq=False, repr=False)
class PostureGoal(Goal):
    """The joints near ``q`` (nq,): a rest pose, usually with a later priority or a small weight.

    The miss is the largest distance of a joint that counts: radians for hinges, metres for slides.

    Attributes:
        q: (nq,) wanted joint positions.
        joints: Weights of single joints by name. Other joints have weight 1, or 0 with ``only``.
        only: Leave out the joints that ``joints`` does not name.
        weight: Weight against other goals.
    """

    frame: str | None = field(default=None, init=False)
    q: ArrayLike = ()
    joints: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    only: bool = field(default=False, kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "posture goal"

    def __post_init__(self) -> None:
        super().__post_init__()
        count = numbers(self.q, "q").size
        if not count:
            raise InvalidGoalError("a posture goal needs joint positions q (nq,), such as robot.home")
        if not isinstance(self.joints, Mapping):
            raise InvalidGoalError(
                f"joints must map names to weights, not {self.joints!r}", hint='such as {"elbow": 2.0}'
            )
        self._set(
            q=vector(self.q, count, "q"),
            joints={name: nonnegative(w, f"weight of {name!r}") for name, w in self.joints.items()},
            weight=nonnegative(self.weight, "weight"),
        )

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, self.weight

    def _options(self) -> tuple[object, ...]:
        return tuple(self.joints.items()), self.only, self.weight

    def rows(self, robot: Robot) -> GoalRows:
        if np.shape(self.q) != (robot.nq,):
            raise InvalidGoalError(
                f"a posture of {robot.name} has {robot.nq} numbers, not {np.size(self.q)}",
                hint="start from robot.home",
            )
        weights = self.joint_weights(robot)
        nodes = frozenset(robot.tree.dof_node[weights > 0.0].tolist())
        return GoalRows(nodes, joint_weights=weights)

    def joint_weights(self, robot: Robot) -> Array:
        """Return the weight of each degree of freedom (nv,); raise ``UnknownJointError`` for other names."""
        require_joints(self.joints, robot.joints)
        others = 0.0 if self.only else 1.0
        weights = [self.joints.get(joint, others) for joint in robot.joints]
        return np.array(weights, dtype=float)[robot.tree.dof_node]

    def miss(self, robot: Robot, q: Array) -> tuple[float, float]:
        if not self.weight > 0.0:
            return 0.0, 0.0
        tree = robot.tree
        weights = self.joint_weights(robot)
        difference = robot.difference(q, np.asarray(self.q))
        metres = 0.0
        radians = 0.0
        for node in set(range(tree.size)) - set(tree.coupled[:, 0].tolist()):
            v = int(tree.vadr[node])
            kind = int(tree.kind[node])
            if not weights[v] > 0.0:
                continue
            part = difference[v : v + V_WIDTH[kind]]
            linear = {SLIDE: 1, FREE: 3}.get(kind, 0)
            metres = max(metres, float(np.abs(part[:linear]).max(initial=0.0)))
            radians = max(radians, float(np.linalg.norm(part[linear:])))
        return metres, radians


GOALS: tuple[type[Goal], ...] = (
    PositionGoal,
    OrientationGoal,
    PoseGoal,
    AimGoal,
    LineGoal,
    PlaneGoal,
    HalfSpaceGoal,
    CenterOfMassGoal,
    PostureGoal,
)


# Checks and conversions


def frame_miss(
    rows: GoalRows, weights: tuple[float, float], pose: Pose, target: Pose
) -> tuple[float, float]:
    """Return the metres and radians between ``pose`` and ``target``, in the parts that the goal asks for."""
    metres = 0.0
    radians = 0.0
    if rows.position_part != NO_POSITION and weights[0] > 0.0:
        error = (target.rotation.T @ (target.position - pose.position)) * rows.mask
        if rows.position_part == ONE_SIDE:
            error = np.maximum(error, 0.0)
        metres = float(np.linalg.norm(error))
    if rows.orientation_part == ALL_AXES and weights[1] > 0.0:
        _, radians = pose.distance(target)
    elif rows.orientation_part in (ONE_AXIS, AIMED) and weights[1] > 0.0:
        axis = pose.rotation @ rows.axis
        direction = target.rotation @ rows.axis
        if rows.orientation_part == AIMED:
            direction = target.position - pose.position
        if np.linalg.norm(direction) >= _MIN_DIRECTION:
            radians = math.atan2(np.linalg.norm(np.cross(axis, direction)), axis @ direction)
    return metres, radians


def nonnegative(value: float, name: str) -> float:
    """Return a finite number that is zero or more; raise ``InvalidGoalError`` for other values."""
    if not is_real(value, 0.0, sys.float_info.max):
        raise InvalidGoalError(f"{name} must be zero or more and finite, not {value!r}")
    return float(value)


def axis_vector(axis: str | ArrayLike, name: str = "axis") -> Array:
    """Return a unit vector (3,) from "x", "-z" or three numbers; raise ``InvalidGoalError`` otherwise."""
    if isinstance(axis, str):
        letter = axis.lstrip("+-")
        if letter not in ("x", "y", "z"):
            raise InvalidGoalError(f"{name} must be x, y, z, -x, -y, -z or three numbers, not {axis!r}")
        sign = -1.0 if axis.startswith("-") else 1.0
        return sign * np.eye(3)["xyz".index(letter)]
    array = vector(axis, 3, name)
    length = float(np.linalg.norm(array))
    if length < _MIN_DIRECTION:
        raise InvalidGoalError(f"{name} is a zero vector, which has no direction")
    return np.asarray(array / length)


def axes_mask(axes: object) -> tuple[float, float, float]:
    """Return 1 for each letter in ``axes`` ("xy"), else 0; raise ``InvalidGoalError`` for other letters."""
    if not isinstance(axes, str) or not axes or len(set(axes)) < len(axes) or set(axes) - set("xyz"):
        raise InvalidGoalError(f"axes must be some of the letters x, y and z, not {axes!r}")
    return float("x" in axes), float("y" in axes), float("z" in axes)


def _orientation_part(
    free_axis: str | ArrayLike | None,
) -> tuple[int, tuple[float, float, float]]:
    if free_axis is None:
        return ALL_AXES, _ALONG_Z
    x, y, z = axis_vector(free_axis, "free_axis").tolist()
    return ONE_AXIS, (x, y, z)


def _hashable(value: object) -> object:
    if isinstance(value, Mapping):
        return tuple(sorted(value.items()))
    if isinstance(value, str) or not hasattr(value, "__len__"):
        return value
    return tuple(np.asarray(value, dtype=float).ravel().tolist())


def mass_table(robot: Robot, body: str | None = None) -> Array:
    """Return mass and centre (n + 1, 4) of what each node carries, last of what never moves.

    Args:
        robot: The robot.
        body: Only this body and its descendants count; None for the whole model.

    Raises:
        UnknownFrameError: There is no such body.
        ModelError: It has no mass.
    """
    model = robot.model
    root = robot.body_id(body)
    table = np.zeros((robot.tree.size + 1, 4))
    inside: set[int] = set()
    for index in range(root, model.nbody):
        if index != root and int(model.body_parentid[index]) not in inside:
            continue
        inside.add(index)
        node, local = robot.attachment(index)  # node -1, the world, is the last row
        center = local[:3] + local[3:].reshape(3, 3) @ model.body_ipos[index]
        table[node] += float(model.body_mass[index]) * np.array((1.0, *center))
    if not table[:, 0].sum() > _MIN_MASS:
        raise ModelError(f"{body or robot.name!r} has no mass", hint="give it geoms or inertials")
    heavy = table[:, 0] > 0.0
    table[heavy, 1:] /= table[heavy, :1]
    return table
