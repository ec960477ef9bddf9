"""``Tree``: a kinematic tree as flat arrays, and the one place where an ``MjModel`` becomes one.

Every active joint is a *node*.  With ``X_k`` the pose of node k in the world,

    X_k = X_parent(k) · C_k · J_k(q),      frame = X_node · L

where ``C_k`` is constant and ``J_k`` is a turn about z (hinge), a shift along z (slide), a rotation
(ball) or the whole pose (free).  Bodies without active joints vanish into the constants; the
reference angle of a joint and its axis do as well.  Poses are rows of twelve numbers: position, then
the rotation matrix row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numba import types
from numba.experimental import structref
from numpy.typing import NDArray

from robot_ik.geometry import Pose, matrix_to_quat, rotation_exp
from robot_ik.kernels.jit import kernel

Array = NDArray[np.float64]

HINGE, SLIDE, BALL, FREE = 0, 1, 2, 3
# What a degree of freedom does: turn about, or shift along, an axis.
TURN, SHIFT = 0, 1

_KIND_OF = {
    int(mujoco.mjtJoint.mjJNT_HINGE): HINGE,
    int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE,
    int(mujoco.mjtJoint.mjJNT_BALL): BALL,
    int(mujoco.mjtJoint.mjJNT_FREE): FREE,
}
Q_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 4, FREE: 7}
V_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 3, FREE: 6}


def pose_row(pose: Pose) -> Array:
    """(12,): position, then the rotation matrix row by row."""
    return np.concatenate([pose.position, pose.rotation.ravel()])


def row_pose(row: Array) -> Pose:
    """Inverse of ``pose_row``."""
    return Pose.from_rotation(row[3:].reshape(3, 3), row[:3])


@structref.register
class _TreeType(types.StructRef):  # type: ignore[misc]
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class TreeProxy(structref.StructRefProxy):  # type: ignore[misc]
    """Handle of a compiled tree: hand it to kernels, do not look inside."""


structref.define_boxing(_TreeType, TreeProxy)
_INTS = types.Array(types.int64, 1, "C")
_FLOATS = types.Array(types.float64, 1, "C")
_TABLE = types.Array(types.float64, 2, "C")
TREE = _TreeType(
    (
        ("kind", _INTS),  # (n,) HINGE, SLIDE, BALL, FREE
        ("parent", _INTS),  # (n,) node, -1 = world; parents come first
        ("qadr", _INTS),  # (n,) where the node's numbers start in q
        ("vadr", _INTS),  # (n,) … and in dq
        ("constant", _TABLE),  # (n, 12) C_k
        ("lower", _FLOATS),  # (nv,) -inf where unlimited
        ("upper", _FLOATS),  # (nv,) ball: cone angle in each of its three entries
        ("low", _FLOATS),  # (nv,) finite range for drawing random starts
        ("high", _FLOATS),  # (nv,)
        ("dof_node", _INTS),  # (nv,)
        ("dof_kind", _INTS),  # (nv,) TURN or SHIFT
    )
)


@kernel
def _new_tree(kind, parent, qadr, vadr, constant, lower, upper, low, high, dof_node, dof_kind):  # type: ignore[no-untyped-def]
    tree = structref.new(TREE)
    tree.kind = kind
    tree.parent = parent
    tree.qadr = qadr
    tree.vadr = vadr
    tree.constant = constant
    tree.lower = lower
    tree.upper = upper
    tree.low = low
    tree.high = high
    tree.dof_node = dof_node
    tree.dof_kind = dof_kind
    return tree


@dataclass(frozen=True)
class Attachment:
    """Where something rigid sits: ``X_node · local`` (node -1 = world)."""

    node: int
    local: Pose


@dataclass(frozen=True, eq=False)
class Tree:
    """Arrays of a kinematic tree, and ``handle``, the same for compiled code.

    Attributes:
        joint_ids: (n,) MuJoCo joint of each node, in the order of the nodes.
        bodies: Attachment of every body of the model, by MuJoCo id.
    """

    joint_ids: tuple[int, ...]
    kind: NDArray[np.int64]
    parent: NDArray[np.int64]
    qadr: NDArray[np.int64]
    vadr: NDArray[np.int64]
    constant: Array
    lower: Array
    upper: Array
    low: Array
    high: Array
    bodies: tuple[Attachment, ...]
    nq: int
    nv: int
    handle: Any

    @property
    def size(self) -> int:
        """Number of nodes (active joints)."""
        return len(self.kind)

    def ancestors(self, node: int) -> list[int]:
        """Nodes that move ``node``, root first, itself included; empty for the world."""
        found: list[int] = []
        while node >= 0:
            found.append(node)
            node = int(self.parent[node])
        return found[::-1]

    def with_limits(self, lower: Array, upper: Array) -> Tree:
        """The same tree inside other limits (nv,)."""
        low = np.where(np.isfinite(lower), lower, self.low)
        high = np.where(np.isfinite(upper), upper, self.high)
        return _make(
            self.joint_ids, self.kind, self.parent, self.qadr, self.vadr, self.constant,
            np.array(lower, dtype=float), np.array(upper, dtype=float), low, np.maximum(low, high),
            self.bodies, self.nq, self.nv,
        )  # fmt: skip


def _make(
    joint_ids: Any, kind: Any, parent: Any, qadr: Any, vadr: Any, constant: Array, lower: Array, upper: Array,
    low: Array, high: Array, bodies: Any, nq: int, nv: int,
) -> Tree:  # fmt: skip
    ints = [np.ascontiguousarray(a, dtype=np.int64) for a in (kind, parent, qadr, vadr)]
    constant = np.ascontiguousarray(constant, dtype=float).reshape(-1, 12)
    dof_node, dof_kind = _degrees_of_freedom(ints[0], nv)
    handle = _new_tree(*ints, constant, lower, upper, low, high, dof_node, dof_kind)
    return Tree(
        tuple(joint_ids), *ints, constant, lower, upper, low, high, tuple(bodies), nq, nv, handle
    )  # fmt: skip


def _degrees_of_freedom(kind: Any, nv: int) -> tuple[Any, Any]:
    nodes, kinds = [], []
    for node, joint in enumerate(kind):
        joint = int(joint)
        nodes += [node] * V_WIDTH[joint]
        kinds += {HINGE: [TURN], SLIDE: [SHIFT], BALL: [TURN] * 3, FREE: [SHIFT] * 3 + [TURN] * 3}[joint]
    return np.array(nodes, dtype=np.int64).reshape(nv), np.array(kinds, dtype=np.int64).reshape(nv)


def _turn_z_to(axis: Array) -> Pose:
    """A rotation that takes the z axis to the unit vector ``axis``; exact for the coordinate axes."""
    z = axis / np.linalg.norm(axis)
    # The coordinate axis least along z keeps the cross product well away from zero.
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(z)))] = 1.0
    x = helper - z * (z @ helper)
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    return Pose((0, 0, 0), matrix_to_quat(rotation))


def _joint_motion(kind: int, axis: Array, anchor: Array, q: Array, reference: float) -> Pose:
    """Motion that a joint at ``q`` gives its body, in the body's frame before the joint."""
    if kind == FREE:
        return Pose(q[:3], q[3:])
    if kind == SLIDE:
        return Pose(axis * (q[0] - reference))
    turn = Pose((0, 0, 0), q if kind == BALL else rotation_exp(axis * (q[0] - reference)))
    return Pose(anchor).compose(turn).compose(Pose(-anchor))


class _Builder:
    """Walks the bodies of a model once, root first."""

    def __init__(self, model: mujoco.MjModel, active: set[int], qpos: Array) -> None:
        self.model, self.active, self.qpos = model, active, qpos
        self.joint_ids: list[int] = []
        self.kind: list[int] = []
        self.parent: list[int] = []
        self.qadr: list[int] = []
        self.vadr: list[int] = []
        self.constant: list[Array] = []
        self.bodies: list[Attachment] = [Attachment(-1, Pose())]
        self.nq = self.nv = 0

    def body(self, body: int) -> None:
        model = self.model
        base = self.bodies[int(model.body_parentid[body])]
        at = Attachment(base.node, base.local.compose(Pose(model.body_pos[body], model.body_quat[body])))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            at = self.joint(joint, at)
        self.bodies.append(at)

    def joint(self, joint: int, at: Attachment) -> Attachment:
        model = self.model
        kind = _KIND_OF[int(model.jnt_type[joint])]
        axis, anchor = np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
        start = int(model.jnt_qposadr[joint])
        reference = float(model.qpos0[start])
        if joint not in self.active:
            q = self.qpos[start : start + Q_WIDTH[kind]]
            motion = _joint_motion(kind, axis, anchor, q, reference)
            return Attachment(-1, motion) if kind == FREE else Attachment(at.node, at.local.compose(motion))
        after = Pose()
        constant = at.local
        if kind == HINGE:
            align = _turn_z_to(axis)
            back = Pose((0, 0, 0), rotation_exp([0.0, 0.0, -reference]))
            constant = constant.compose(Pose(anchor)).compose(align).compose(back)
            after = align.inverse().compose(Pose(-anchor))
        elif kind == SLIDE:
            align = _turn_z_to(axis)
            constant = constant.compose(align).compose(Pose((0.0, 0.0, -reference)))
            after = align.inverse()
        elif kind == BALL:
            constant = constant.compose(Pose(anchor))
            after = Pose(-anchor)
        node = len(self.kind)
        self.joint_ids.append(joint)
        self.kind.append(kind)
        self.parent.append(-1 if kind == FREE else at.node)
        self.qadr.append(self.nq)
        self.vadr.append(self.nv)
        self.constant.append(pose_row(Pose() if kind == FREE else constant))
        self.nq += Q_WIDTH[kind]
        self.nv += V_WIDTH[kind]
        return Attachment(node, after)


def _limits(model: mujoco.MjModel, builder: _Builder) -> tuple[Array, Array, Array, Array]:
    """Limits (nv,) as MuJoCo has them, and finite ranges (nv,) to draw random starts from."""
    lower, upper = np.full(builder.nv, -np.inf), np.full(builder.nv, np.inf)
    low, high = np.full(builder.nv, -np.pi), np.full(builder.nv, np.pi)
    for joint, kind, v in zip(builder.joint_ids, builder.kind, builder.vadr, strict=True):
        limited = bool(model.jnt_limited[joint])
        if kind in (HINGE, SLIDE):
            if kind == SLIDE:
                low[v], high[v] = -1.0, 1.0  # an unlimited slide: one metre either way
            if limited:
                lower[v], upper[v] = model.jnt_range[joint]
                low[v], high[v] = model.jnt_range[joint]
        elif kind == BALL and limited:
            lower[v : v + 3], upper[v : v + 3] = 0.0, model.jnt_range[joint, 1]
            high[v : v + 3] = model.jnt_range[joint, 1]
        elif kind == FREE:
            low[v : v + 3], high[v : v + 3] = -1.0, 1.0
    return lower, upper, low, high


def build_tree(model: mujoco.MjModel, joints: list[int] | None = None, qpos: Array | None = None) -> Tree:
    """Tree of a model in which only ``joints`` (MuJoCo ids; default all) move.

    Args:
        model: Any compiled model with hinge, slide, ball and free joints.
        joints: Active joints; the others are frozen.
        qpos: (model.nq,) where the frozen joints stand; default ``model.qpos0``.
    """
    active = set(range(model.njnt)) if joints is None else set(joints)
    where = np.array(model.qpos0 if qpos is None else qpos, dtype=float)
    builder = _Builder(model, active, where)
    for body in range(1, model.nbody):
        builder.body(body)
    return _make(
        builder.joint_ids, builder.kind, builder.parent, builder.qadr, builder.vadr,
        np.array(builder.constant).reshape(-1, 12), *_limits(model, builder), builder.bodies,
        builder.nq, builder.nv,
    )  # fmt: skip
