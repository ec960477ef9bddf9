"""Recognises, from a kinematic tree alone, the arms that have a closed form.

Only the joint axes as lines in space at q = 0 count: names, link frames, base and tool do not.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose, quat_to_matrix, rotation_exp
from robot_ik.kernels.tree import BALL, HINGE, Tree

Array = NDArray[np.float64]

# Lines nearer than this share of the arm's size meet; directions with a smaller sine are parallel.
_MEETS, _PARALLEL = 1e-9, 1e-9


class Family(enum.IntEnum):
    """Geometries with a closed form."""

    PLANAR_TWO_LINK = 0
    SPHERICAL_WRIST = 1
    THREE_PARALLEL = 2
    SPHERICAL_SHOULDER = 3
    LIMB = 4


# What the two solutions of each choice are called, for ``solve_all``; by row = 4·first + 2·second + third.
BRANCH_NAMES: dict[Family, tuple[str, ...]] = {
    Family.PLANAR_TWO_LINK: ("elbow",),
    Family.SPHERICAL_WRIST: ("shoulder", "elbow", "wrist"),
    Family.THREE_PARALLEL: ("shoulder", "wrist", "elbow"),
    Family.SPHERICAL_SHOULDER: ("wrist", "elbow", "shoulder"),
    Family.LIMB: ("elbow", "shoulder", "wrist"),
}

# How a limb is joined at its shoulder and at its wrist; NO_JOINTS: its end is a point of the wrist's centre.
HINGES, BALL_JOINT, NO_JOINTS = range(3)


@dataclass(frozen=True, eq=False)
class Form:
    """A closed form: the family and the numbers that its kernel needs.

    Attributes:
        family: Which one.
        nodes: Joints of the chain in the order of the kernel: root first, of a spherical shoulder last.
        axes: (n, 6) direction and a point of each joint axis at q = 0, world.  A limb has seven rows
            (three, elbow, three), those of a ball joint the axes of its frame.
        extra: (5, 3) wrist centre in the world at q = 0, the same seen from the tool, rows of the tool's
            rotation at q = 0.
        groups: (2, 2) how a limb's shoulder and wrist are joined, and the column of their first number.
    """

    family: Family
    nodes: tuple[int, ...]
    axes: Array
    extra: Array
    groups: NDArray[np.int64] = field(default_factory=lambda: np.full((2, 2), NO_JOINTS, dtype=np.int64))


def recognise(tree: Tree, node: int, local: Array, whole: bool) -> Form | None:
    """The closed form of the frame at ``local`` (12,) of ``node``, or None when there is none.

    ``whole``: its pose is wanted, not only its position.
    """
    chain = tree.ancestors(node)
    kinds = [int(tree.kind[k]) for k in chain]
    if not chain or any(kind not in (HINGE, BALL) for kind in kinds):
        return None
    axes, frames, tool = axes_at_zero(tree, chain, local)
    scale = float(np.abs(axes[:, 3:]).max() + np.abs(tool.position).max())  # m: how large the arm is
    limb = _limb(kinds, chain, axes, frames, tool, scale, whole)
    if limb is not None or BALL in kinds:
        return limb
    if not whole:
        planar = len(chain) == 2 and _parallel(axes, 0, 1)
        return _form(Family.PLANAR_TWO_LINK, chain, axes, tool, tool.position) if planar else None
    return _six_axes(chain, axes, tool, scale) if len(chain) == 6 else None


def _six_axes(chain: list[int], axes: Array, tool: Pose, scale: float) -> Form | None:
    if (wrist := _wrist_centre(axes, scale)) is not None:
        return _form(Family.SPHERICAL_WRIST, chain, axes, tool, wrist)
    # The same arm held by its tool: the inverse pose is e₆(-q₆) … e₁(-q₁) seen from there.
    back = tool.inverse()
    seen = np.hstack([-(axes[::-1, :3] @ back.rotation.T), back.apply(axes[::-1, 3:])])
    if (shoulder := _wrist_centre(seen, scale)) is not None:
        return _form(Family.SPHERICAL_SHOULDER, chain[::-1], seen, back, shoulder)
    centre = _meeting(axes[4], axes[5], scale)
    parallel = _parallel(axes, 1, 2) and _parallel(axes, 2, 3)
    if centre is not None and parallel and not _parallel(axes, 0, 1) and not _parallel(axes, 3, 4):
        return _form(Family.THREE_PARALLEL, chain, axes, tool, centre)
    return None


def _wrist_centre(axes: Array, scale: float) -> Array | None:
    """Where the last three axes meet, if axes 2 and 3 are parallel and 1 is not; else None."""
    if not _parallel(axes, 1, 2) or _parallel(axes, 0, 1):
        return None
    return _centre(axes[3:], scale)


def _limb(
    kinds: list[int],
    chain: list[int],
    axes: Array,
    frames: list[Array],
    tool: Pose,
    scale: float,
    whole: bool,
) -> Form | None:
    """Shoulder (three hinges that meet, or a ball), elbow hinge, and the like wrist.

    For a position the frame must stand in the wrist's centre, where the wrist's joints do not move it.
    """
    arm, shoulder = joint_centre(kinds, axes, scale)
    if shoulder is None or len(kinds) <= arm or kinds[arm] != HINGE:
        return None
    wrist_kinds, wrist_axes = kinds[arm + 1 :], axes[arm + 1 :]
    hand, centre = joint_centre(wrist_kinds, wrist_axes, scale)
    joined = BALL_JOINT if hand == 1 else HINGES
    if not whole:
        centre, joined, chain = tool.position, NO_JOINTS, chain[: arm + 1]
        if any(not on_axis(axis, centre, scale) for axis in wrist_axes):
            return None
    elif centre is None or len(wrist_kinds) != hand:
        return None
    elbow = axes[arm]
    if any(on_axis(elbow, point, scale, 1e-4) for point in (shoulder, centre)):
        return None  # the elbow would not change the distance of shoulder and wrist
    table = np.zeros((7, 6))
    table[:3, 3:], table[4:, 3:] = shoulder, centre
    table[3] = elbow
    table[:3, :3] = axes[:3, :3] if arm == 3 else frames[0].T
    if joined != NO_JOINTS:
        table[4:, :3] = wrist_axes[:, :3] if joined == HINGES else frames[-1].T
    form = _form(Family.LIMB, chain, table, tool, centre)
    first = 4 if arm == 3 else 5
    form.groups[:] = (HINGES if arm == 3 else BALL_JOINT, 0), (joined, first)
    return form


def joint_centre(kinds: list[int], axes: Array, scale: float) -> tuple[int, Array | None]:
    """How many joints at the head of a chain turn about one point in every direction, and that point."""
    if kinds and kinds[0] == BALL:
        return 1, axes[0, 3:]
    if kinds[:3] != [HINGE] * 3:
        return 3, None
    return 3, _centre(axes[:3], scale)


def _centre(axes: Array, scale: float) -> Array | None:
    """Where three axes meet that can turn in every direction, or None."""
    if _parallel(axes, 0, 1) or _parallel(axes, 1, 2):
        return None
    centre = _meeting(axes[1], axes[2], scale)
    return centre if centre is not None and on_axis(axes[0], centre, scale) else None


def axes_at_zero(tree: Tree, chain: list[int], local: Array) -> tuple[Array, list[Array], Pose]:
    """At q = 0, in the world: axes (n, 6), rotations of the joints' frames, pose of the frame."""
    pose, axes, frames = Pose(), [], []
    for k in chain:
        pose = pose.compose(Pose.from_row(tree.constant[k]))
        frames.append(pose.rotation)
        axes.append(np.concatenate([pose.rotation[:, 2], pose.position]))
    return np.array(axes), frames, pose.compose(Pose.from_row(local))


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


def on_axis(axis: Array, point: Array, scale: float, slack: float = _MEETS) -> bool:
    """Whether a point (3,) lies on the line ``axis`` (6,), to a share of the arm's size."""
    return float(np.linalg.norm(np.cross(axis[:3], point - axis[3:]))) < slack * scale


# Where, on the circle of swivel angles, a limb's joints meet their limits: made once for a problem.
# The shoulder's rotation is S(φ) = R(n, φ) S₀, so that every number yᵀ S(φ) x is a + b cos φ + c sin φ, and
# so is yᵀ W(φ) x of the wrist's.  Each limit of a joint is such a number that takes one value d (after
# Tolani, Goswami & Badler, Graphical Models 62, 2000, section 4): with S = R₁ R₂ R₃ about axes h₁, h₂, h₃
#
#     q₁ = L:  (R₁(L) h₂)ᵀ S h₃ = h₂ᵀ h₃        q₃ = L:  h₁ᵀ S (R₃(-L) h₂) = h₁ᵀ h₂
#     q₂ = L:  h₁ᵀ S h₃ = h₁ᵀ R₂(L) h₃          ball:    tr S = 1 + 2 cos L


def middle_rotations(form: Form) -> Array:
    """(2, 3) for shoulder and wrist of hinges: h₁ᵀ R₂(q) h₃ = constant + amplitude · cos(q - middle)."""
    rows = np.zeros((2, 3))
    for g in range(2):
        if form.groups[g, 0] == HINGES:
            a, b, c = form.axes[4 * g : 4 * g + 3, :3]
            constant = float(a @ b) * float(b @ c)
            even, odd = float(a @ c) - constant, float(a @ np.cross(b, c))
            rows[g] = constant, np.hypot(even, odd), np.arctan2(odd, even)
    return rows


def limit_edges(form: Form, lower: Array, upper: Array) -> Array:
    """(m, 8) all limits ``lower``, ``upper`` (by column of the form) as equations of the swivel angle.

    Columns: which rotation (shoulder, wrist, then their traces), y (3), x (3), d.
    """
    rows: list[Array] = []
    rotations = middle_rotations(form)
    for g in range(2):
        first = int(form.groups[g, 1])
        if form.groups[g, 0] == BALL_JOINT and upper[first] < np.pi:
            rows.append(np.array([2 + g, *np.zeros(6), 1.0 + 2.0 * np.cos(upper[first])]))
        if form.groups[g, 0] != HINGES:
            continue
        a, b, c = form.axes[4 * g : 4 * g + 3, :3]
        constant, amplitude, _ = rotations[g]
        rows += [np.array([g, *a, *c, constant + sign * amplitude]) for sign in (-1.0, 1.0)]
        for j in range(3):
            if upper[first + j] - lower[first + j] >= 2.0 * np.pi:
                continue
            for limit in (lower[first + j], upper[first + j]):
                rows.append(_edge(g, j, a, b, c, float(limit)))
    return np.array(rows).reshape(-1, 8)


def _edge(g: int, joint: int, a: Array, b: Array, c: Array, limit: float) -> Array:
    rotated = quat_to_matrix(rotation_exp((a, b, c)[joint] * limit))
    if joint == 0:
        return np.array([g, *(rotated @ b), *c, b @ c])
    if joint == 1:
        return np.array([g, *a, *c, a @ rotated @ c])
    return np.array([g, *a, *(rotated.T @ b), a @ b])
