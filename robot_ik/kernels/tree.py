"""``Tree``: a kinematic tree as flat arrays.  ``model_tree.py`` makes one of an ``MjModel``.

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

import numpy as np
from numba import types
from numba.experimental import structref
from numpy.typing import NDArray

from robot_ik.kernels.jit import kernel

Array = NDArray[np.float64]

HINGE, SLIDE, BALL, FREE = 0, 1, 2, 3
# What a degree of freedom does: turn about, or shift along, an axis.
TURN, SHIFT = 0, 1

Q_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 4, FREE: 7}
V_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 3, FREE: 6}


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


@dataclass(frozen=True, eq=False)
class Tree:
    """Arrays of a kinematic tree, and ``handle``, the same for compiled code.

    Attributes:
        joint_ids: (n,) MuJoCo joint of each node, in the order of the nodes.
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
        return make_tree(
            self.joint_ids, self.kind, self.parent, self.qadr, self.vadr, self.constant,
            np.array(lower, dtype=float), np.array(upper, dtype=float), low, np.maximum(low, high),
            self.nq, self.nv,
        )  # fmt: skip


def make_tree(
    joint_ids: Any, kind: Any, parent: Any, qadr: Any, vadr: Any, constant: Array, lower: Array, upper: Array,
    low: Array, high: Array, nq: int, nv: int,
) -> Tree:  # fmt: skip
    """A tree from its arrays; fields as in ``Tree``."""
    ints = [np.ascontiguousarray(a, dtype=np.int64) for a in (kind, parent, qadr, vadr)]
    constant = np.ascontiguousarray(constant, dtype=float).reshape(-1, 12)
    dof_node, dof_kind = _degrees_of_freedom(ints[0], nv)
    handle = _new_tree(*ints, constant, lower, upper, low, high, dof_node, dof_kind)
    return Tree(
        tuple(joint_ids), *ints, constant, lower, upper, low, high, nq, nv, handle
    )  # fmt: skip


def _degrees_of_freedom(kind: Any, nv: int) -> tuple[Any, Any]:
    nodes, kinds = [], []
    for node, joint in enumerate(kind):
        joint = int(joint)
        nodes += [node] * V_WIDTH[joint]
        kinds += {HINGE: [TURN], SLIDE: [SHIFT], BALL: [TURN] * 3, FREE: [SHIFT] * 3 + [TURN] * 3}[joint]
    return np.array(nodes, dtype=np.int64).reshape(nv), np.array(kinds, dtype=np.int64).reshape(nv)
