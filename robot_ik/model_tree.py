"""The one place where an ``MjModel`` becomes a ``Tree``.

Every active joint becomes a node; bodies without active joints, frozen joints, anchors, axes and
reference angles vanish into the constants between the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Pose, rotation_exp, turn_z_to
from robot_ik.kernels.tree import BALL, FREE, HINGE, Q_WIDTH, SLIDE, V_WIDTH, Tree

Array = NDArray[np.float64]

_KIND_OF = {
    int(mujoco.mjtJoint.mjJNT_HINGE): HINGE,
    int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE,
    int(mujoco.mjtJoint.mjJNT_BALL): BALL,
    int(mujoco.mjtJoint.mjJNT_FREE): FREE,
}


@dataclass(frozen=True)
class Attachment:
    """Where something rigid sits: ``X_node · local`` (node -1 = world)."""

    node: int
    local: Pose


def pose_row(pose: Pose) -> Array:
    """(12,): position, then the rotation matrix row by row."""
    row = np.empty(12)
    row[:3], row[3:] = pose.position, pose.rotation.ravel()
    return row


def row_pose(row: Array) -> Pose:
    """Inverse of ``pose_row``."""
    return Pose.from_rotation(row[3:].reshape(3, 3), row[:3])


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
            align = Pose.from_rotation(turn_z_to(axis / np.linalg.norm(axis)))
            back = Pose((0, 0, 0), rotation_exp([0.0, 0.0, -reference]))
            constant = constant.compose(Pose(anchor)).compose(align).compose(back)
            after = align.inverse().compose(Pose(-anchor))
        elif kind == SLIDE:
            align = Pose.from_rotation(turn_z_to(axis / np.linalg.norm(axis)))
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


def qpos_addresses(model: mujoco.MjModel, tree: Tree) -> NDArray[np.int64]:
    """(nq,): where the numbers of q stand in the model's whole qpos."""
    found: list[int] = []
    for joint, kind in zip(tree.joint_ids, tree.kind, strict=True):
        start = int(model.jnt_qposadr[joint])
        found += range(start, start + Q_WIDTH[int(kind)])
    return np.array(found, dtype=np.int64)


def build_tree(
    model: mujoco.MjModel, joints: list[int] | None = None, qpos: Array | None = None
) -> tuple[Tree, tuple[Attachment, ...]]:
    """Tree of a model in which only ``joints`` (MuJoCo ids; default all) move.

    Args:
        model: Any compiled model with hinge, slide, ball and free joints.
        joints: Active joints; the others are frozen.
        qpos: (model.nq,) where the frozen joints stand; default ``model.qpos0``.

    Returns:
        The tree, and the attachment of every body of the model, by MuJoCo id.
    """
    active = set(range(model.njnt)) if joints is None else set(joints)
    where = np.array(model.qpos0 if qpos is None else qpos, dtype=float)
    builder = _Builder(model, active, where)
    for body in range(1, model.nbody):
        builder.body(body)
    kind, parent, qadr, vadr = (
        np.array(a, dtype=np.int64) for a in (builder.kind, builder.parent, builder.qadr, builder.vadr)
    )
    tree = Tree(
        tuple(builder.joint_ids), kind, parent, qadr, vadr,
        np.array(builder.constant).reshape(-1, 12), *_limits(model, builder), builder.nq, builder.nv,
    )  # fmt: skip
    return tree, tuple(builder.bodies)


def mass_table(model: mujoco.MjModel, tree: Tree, bodies: tuple[Attachment, ...], root: int) -> Array:
    """(n + 1, 4) mass and its centre, seen from the node, of what each node carries; last: what never moves.

    Only the body ``root`` and all that hangs on it count.
    """
    table = np.zeros((tree.size + 1, 4))
    inside = {root}
    for body in range(root, model.nbody):
        if body != root and int(model.body_parentid[body]) not in inside:
            continue
        inside.add(body)
        mass, at = float(model.body_mass[body]), bodies[body]
        row = table[at.node]  # node -1, the world, is the last row
        row[0] += mass
        row[1:] += mass * at.local.compose(Pose(model.body_ipos[body])).position
    carried = table[:, 0] > 0.0
    table[carried, 1:] /= table[carried, :1]
    return table


def inertia_table(model: mujoco.MjModel, tree: Tree, bodies: tuple[Attachment, ...]) -> Array:
    """(n, 10) mass, its centre and the inertia xx yy zz xy xz yz about it, in its axes, of each node."""
    mass = mass_table(model, tree, bodies, 0)[: tree.size]
    whole = np.zeros((tree.size, 3, 3))
    for body in range(1, model.nbody):
        at = bodies[body]
        if at.node < 0:
            continue
        place = at.local.compose(Pose(model.body_ipos[body], model.body_iquat[body]))
        away = place.position - mass[at.node, 1:]
        turned = place.rotation @ np.diag(model.body_inertia[body]) @ place.rotation.T
        whole[at.node] += turned + model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    xx, yy, zz, xy, xz, yz = whole[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].T
    return np.column_stack([mass, xx, yy, zz, xy, xz, yz])


def random_q(tree: Tree, home: Array, rng: np.random.Generator) -> Array:
    """A random q (nq,) inside the limits; a floating base within 1 m of home."""
    q = home.copy()
    for k in range(tree.size):
        a, v = int(tree.qadr[k]), int(tree.vadr[k])
        if tree.kind[k] in (HINGE, SLIDE):
            q[a] = rng.uniform(tree.low[v], tree.high[v])
            continue
        if tree.kind[k] == FREE:
            q[a : a + 3] = home[a : a + 3] + rng.uniform(-1.0, 1.0, 3)
            a, v = a + 3, v + 3
        axis = rng.normal(size=3)
        half = 0.5 * rng.uniform(0.0, min(float(tree.high[v]), np.pi))
        q[a] = np.cos(half)
        q[a + 1 : a + 4] = axis / np.linalg.norm(axis) * np.sin(half)
    return q
