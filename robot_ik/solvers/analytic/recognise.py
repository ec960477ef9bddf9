"""Recognition of the arms that have a closed form, from a kinematic tree alone.

Only the joint axes as lines in space at q = 0 count. Names, link frames, base and tool do not.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose
from robot_ik.kernels.tree import BALL, HINGE, Tree

Array = NDArray[np.float64]

# Lines nearer than this share of the arm's size meet.
_MEETS = 1e-9
# Directions whose angle has a smaller sine are parallel.
_PARALLEL = 1e-9
# An elbow axis nearer to shoulder or wrist than this share of the arm's size is no elbow.
_ELBOW_OFFSET = 1e-4


class Family(enum.IntEnum):
    """Geometries with a closed form."""

    PLANAR_TWO_LINK = 0
    SPHERICAL_WRIST = 1
    THREE_PARALLEL = 2
    SPHERICAL_SHOULDER = 3
    FIVE_JOINT = 4
    CROSSED_WRIST = 5


# Names of the two solutions of each choice, for ``solve_all``. Row 4·first + 2·second + third.
BRANCH_NAMES: dict[Family, tuple[str, ...]] = {
    Family.PLANAR_TWO_LINK: ("elbow",),
    Family.SPHERICAL_WRIST: ("shoulder", "elbow", "wrist"),
    Family.THREE_PARALLEL: ("shoulder", "wrist", "elbow"),
    Family.SPHERICAL_SHOULDER: ("wrist", "elbow", "shoulder"),
    Family.CROSSED_WRIST: ("elbow", "wrist", "shoulder"),
}


@dataclass(frozen=True, eq=False)
class Form:
    """A closed form: the family and the numbers that its kernel needs.

    Attributes:
        family: Which geometry.
        nodes: Joints of the chain, root first; tool first for a spherical shoulder.
        axes: (n, 6) direction and a point of each joint axis at q = 0, world.
        extra: (5, 3) wrist centre in the world at q = 0, the same in the tool, rows of the
            tool's rotation at q = 0. A crossed wrist has a sixth row: the centre of the shoulder.
    """

    family: Family
    nodes: tuple[int, ...]
    axes: Array
    extra: Array


@dataclass(frozen=True, eq=False)
class LastJoint:
    """The last of seven hinges, before which six have the closed form of a crossed wrist.

    Attributes:
        node: Node of the last joint.
        form: Closed form of the six joints, with the last joint at 0.
        axis: (6,) direction and a point of the last axis at q = 0, world.
        tool: (12,) pose of the frame at q = 0, world.
    """

    node: int
    form: Form
    axis: Array
    tool: Array


@dataclass(frozen=True, eq=False)
class Limb:
    """Shoulder (three hinges that meet, or a ball), elbow hinge, and a wrist like the shoulder.

    Attributes:
        elbow_node: Node of the elbow.
        shoulder: (3,) centre of the shoulder at q = 0, world.
        elbow: (6,) direction and a point of the elbow axis at q = 0, world.
        wrist: (3,) centre of the wrist at q = 0, world.
        wrist_in_tool: (3,) the same in the tool.
    """

    elbow_node: int
    shoulder: Array
    elbow: Array
    wrist: Array
    wrist_in_tool: Array


def recognise(tree: Tree, node: int, local: Array, full_pose: bool) -> Form | None:
    """Return the closed form of a frame, or None if there is none.

    Args:
        tree: The kinematic tree.
        node: Node that carries the frame.
        local: (12,) pose of the frame in the node.
        full_pose: Whether the pose of the frame is the target, and not only its position.
    """
    chain = tree.ancestors(node)
    if not chain or any(int(tree.kind[k]) != HINGE for k in chain):
        return None
    axes, tool = axes_at_zero(tree, chain, local)
    if full_pose:
        return _six_axes(chain, axes, tool, _size(axes, tool)) if len(chain) == 6 else None
    if len(chain) == 2 and _parallel(axes, 0, 1):
        return _form(Family.PLANAR_TWO_LINK, chain, axes, tool, tool.position)
    return None


def recognise_before_last(tree: Tree, node: int, local: Array) -> LastJoint | None:
    """Return the last joint of an arm of seven hinges whose other six have a crossed wrist.

    Arguments as for ``recognise``; None for other arms.
    """
    chain = tree.ancestors(node)
    if len(chain) != 7 or any(int(tree.kind[k]) != HINGE for k in chain):
        return None
    axes, tool = axes_at_zero(tree, chain, local)
    form = _six_axes(chain[:6], axes[:6], tool, _size(axes, tool))
    if form is None or form.family is not Family.CROSSED_WRIST:
        return None
    return LastJoint(chain[6], form, axes[6].copy(), tool.row)


def is_five_joint(axes: Array) -> bool:
    """Return whether axes (5, 6) are pan, three parallel pitch axes across it, and roll."""
    if len(axes) != 5 or not (_parallel(axes, 1, 2) and _parallel(axes, 1, 3)):
        return False
    pitch = axes[1, :3]
    return all(abs(float(pitch @ axes[k, :3])) < _PARALLEL for k in (0, 4))


def recognise_limb(tree: Tree, node: int, local: Array, full_pose: bool) -> Limb | None:
    """Return the limb that ends in a frame, or None; arguments as for ``recognise``.

    For a position the frame must be at the wrist's centre, where the wrist does not move it.
    """
    chain = tree.ancestors(node)
    kinds = [int(tree.kind[k]) for k in chain]
    if not chain or any(kind not in (HINGE, BALL) for kind in kinds):
        return None
    axes, tool = axes_at_zero(tree, chain, local)
    size = _size(axes, tool)
    arm, shoulder = _joint_centre(kinds, axes, size)
    if shoulder is None or len(kinds) <= arm or kinds[arm] != HINGE:
        return None
    wrist_axes = axes[arm + 1 :]
    if full_pose:
        joints, wrist = _joint_centre(kinds[arm + 1 :], wrist_axes, size)
        if wrist is None or len(wrist_axes) != joints:
            return None
    else:
        wrist = tool.position
        if any(not _on_axis(axis, wrist, size) for axis in wrist_axes):
            return None
    elbow = axes[arm]
    if any(_on_axis(elbow, point, size, _ELBOW_OFFSET) for point in (shoulder, wrist)):
        return None  # the elbow does not change the distance of shoulder and wrist
    return Limb(chain[arm], shoulder, elbow, wrist, tool.inverse().apply(wrist))


def _size(axes: Array, tool: Pose) -> float:
    """Return the size of the arm in metres, for relative tolerances."""
    return float(np.abs(axes[:, 3:]).max() + np.abs(tool.position).max())


def _six_axes(chain: list[int], axes: Array, tool: Pose, scale: float) -> Form | None:
    if (wrist := _wrist_centre(axes, scale)) is not None:
        return _form(Family.SPHERICAL_WRIST, chain, axes, tool, wrist)
    # The same arm reversed: seen from its tool, the inverse pose is e₆(-q₆) … e₁(-q₁).
    back = tool.inverse()
    reversed_axes = np.hstack([-(axes[::-1, :3] @ back.rotation.T), back.apply(axes[::-1, 3:])])
    if (shoulder := _wrist_centre(reversed_axes, scale)) is not None:
        return _form(Family.SPHERICAL_SHOULDER, chain[::-1], reversed_axes, back, shoulder)
    centre = _meeting(axes[4], axes[5], scale)
    parallel = _parallel(axes, 1, 2) and _parallel(axes, 2, 3)
    if centre is not None and parallel and not _parallel(axes, 0, 1) and not _parallel(axes, 3, 4):
        return _form(Family.THREE_PARALLEL, chain, axes, tool, centre)
    shoulder = _centre(axes[:3], scale)
    if shoulder is None or centre is None:
        return None
    if any(_on_axis(axes[3], point, scale, _ELBOW_OFFSET) for point in (shoulder, centre)):
        return None  # the elbow does not change the distance of shoulder and wrist
    return _form(Family.CROSSED_WRIST, chain, axes, tool, centre, shoulder)


def _wrist_centre(axes: Array, scale: float) -> Array | None:
    """Return the point of the last three axes, if axes 2 and 3 are parallel and 1 is not."""
    if not _parallel(axes, 1, 2) or _parallel(axes, 0, 1):
        return None
    return _centre(axes[3:], scale)


def _joint_centre(kinds: list[int], axes: Array, scale: float) -> tuple[int, Array | None]:
    """Return the number of joints of a spherical joint at the root, and its centre (3,)."""
    if kinds and kinds[0] == BALL:
        return 1, axes[0, 3:]
    if kinds[:3] != [HINGE] * 3:
        return 3, None
    return 3, _centre(axes[:3], scale)


def _centre(axes: Array, scale: float) -> Array | None:
    """Return the point (3,) of three axes that meet and allow every rotation, or None."""
    if _parallel(axes, 0, 1) or _parallel(axes, 1, 2):
        return None
    centre = _meeting(axes[1], axes[2], scale)
    return centre if centre is not None and _on_axis(axes[0], centre, scale) else None


def axes_at_zero(tree: Tree, chain: list[int], local: Array) -> tuple[Array, Pose]:
    """Return the joint axes (n, 6) and the pose of the frame at q = 0, in the world."""
    pose = Pose()
    axes = []
    for k in chain:
        pose = pose.compose(Pose.from_row(tree.constant[k]))
        axes.append(np.concatenate([pose.rotation[:, 2], pose.position]))
    return np.array(axes), pose.compose(Pose.from_row(local))


def _form(
    family: Family, chain: list[int], axes: Array, tool: Pose, centre: Array, *more: Array
) -> Form:
    extra = np.vstack([centre, tool.inverse().apply(centre), tool.rotation, *more])
    return Form(family, tuple(chain), np.ascontiguousarray(axes), np.ascontiguousarray(extra))


def _parallel(axes: Array, i: int, j: int) -> bool:
    return float(np.linalg.norm(np.cross(axes[i, :3], axes[j, :3]))) < _PARALLEL


def _meeting(a: Array, b: Array, scale: float) -> Array | None:
    """Return the point (3,) where two lines meet, or None."""
    normal = np.cross(a[:3], b[:3])
    square = float(normal @ normal)
    if square < _PARALLEL**2:
        return None
    between = b[3:] - a[3:]
    if abs(float(between @ normal)) > _MEETS * scale * np.sqrt(square):
        return None
    along = float(np.cross(between, b[:3]) @ normal) / square
    return np.asarray(a[3:] + along * a[:3])


def _on_axis(axis: Array, point: Array, scale: float, slack: float = _MEETS) -> bool:
    """Return whether a point (3,) lies on the line ``axis`` (6,), to a share of the arm's size."""
    return float(np.linalg.norm(np.cross(axis[:3], point - axis[3:]))) < slack * scale
