"""Recognises, from a kinematic tree alone, the arms that have a closed form.

Only the joint axes as lines in space at q = 0 count: names, link frames, base and tool do not.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose
from robot_ik.kernels.tree import HINGE, Tree
from robot_ik.model_tree import row_pose

Array = NDArray[np.float64]

# Lines nearer than this share of the arm's size meet; directions with a smaller sine are parallel.
_MEETS, _PARALLEL = 1e-9, 1e-9


class Family(enum.IntEnum):
    """Geometries with a closed form."""

    PLANAR_TWO_LINK = 0
    SPHERICAL_WRIST = 1
    THREE_PARALLEL = 2


# What the two solutions of each choice are called, for ``solve_all``; by row = 4·first + 2·second + third.
BRANCH_NAMES: dict[Family, tuple[str, ...]] = {
    Family.PLANAR_TWO_LINK: ("elbow",),
    Family.SPHERICAL_WRIST: ("shoulder", "elbow", "wrist"),
    Family.THREE_PARALLEL: ("shoulder", "wrist", "elbow"),
}


@dataclass(frozen=True, eq=False)
class Form:
    """A closed form: the family and the numbers that its kernel needs.

    Attributes:
        family: Which one.
        nodes: Joints of the chain, root first.
        axes: (n, 6) direction and a point of each joint axis at q = 0, world.
        extra: (5, 3) wrist centre in the world at q = 0, the same seen from the tool, rows of the tool's
            rotation at q = 0.
    """

    family: Family
    nodes: tuple[int, ...]
    axes: Array
    extra: Array


def recognise(tree: Tree, node: int, local: Array) -> Form | None:
    """The closed form of the frame at ``local`` (12,) of ``node``, or None when there is none."""
    chain = tree.ancestors(node)
    if not chain or any(int(tree.kind[k]) != HINGE for k in chain):
        return None
    axes, tool = _at_zero(tree, chain, local)
    if len(chain) == 2 and _parallel(axes, 0, 1):
        return _form(Family.PLANAR_TWO_LINK, chain, axes, tool, tool.position)
    if len(chain) != 6:
        return None
    scale = float(np.abs(axes[:, 3:]).max() + np.abs(tool.position).max())
    centre = _meeting(axes[4], axes[5], scale)
    if centre is None:
        return None
    spherical = _on_axis(axes[3], centre, scale) and not _parallel(axes, 3, 4) and not _parallel(axes, 4, 5)
    if spherical and _parallel(axes, 1, 2) and not _parallel(axes, 0, 1):
        return _form(Family.SPHERICAL_WRIST, chain, axes, tool, centre)
    if (
        _parallel(axes, 1, 2)
        and _parallel(axes, 2, 3)
        and not _parallel(axes, 0, 1)
        and not _parallel(axes, 3, 4)
    ):
        return _form(Family.THREE_PARALLEL, chain, axes, tool, centre)
    return None


def _at_zero(tree: Tree, chain: list[int], local: Array) -> tuple[Array, Pose]:
    pose, axes = Pose(), []
    for k in chain:
        pose = pose.compose(row_pose(tree.constant[k]))
        axes.append(np.concatenate([pose.rotation[:, 2], pose.position]))
    return np.array(axes), pose.compose(row_pose(local))


def _form(family: Family, chain: list[int], axes: Array, tool: Pose, centre: Array) -> Form:
    extra = np.vstack([centre, tool.inverse().apply(centre), tool.rotation])
    return Form(family, tuple(chain), np.ascontiguousarray(axes), np.ascontiguousarray(extra))


def _parallel(axes: Array, i: int, j: int) -> bool:
    return float(np.linalg.norm(np.cross(axes[i, :3], axes[j, :3]))) < _PARALLEL


def _meeting(a: Array, b: Array, scale: float) -> Array | None:
    """Where two lines meet, or None."""
    normal = np.cross(a[:3], b[:3])
    square = float(normal @ normal)
    if square < _PARALLEL**2:
        return None
    between = b[3:] - a[3:]
    if abs(float(between @ normal)) > _MEETS * scale * np.sqrt(square):
        return None
    along = float(np.cross(between, b[:3]) @ normal) / square
    return np.asarray(a[3:] + along * a[:3])


def _on_axis(axis: Array, point: Array, scale: float) -> bool:
    return float(np.linalg.norm(np.cross(axis[:3], point - axis[3:]))) < _MEETS * scale
