"""``Tree``: a kinematic tree as flat arrays.  ``model.py`` makes one of an ``MjModel``.

Every active joint is a *node*.  With ``X_k`` the pose of node k in the world,

    X_k = X_parent(k) · C_k · J_k(q),      frame = X_node · L

where ``C_k`` is constant and ``J_k`` is a rotation about z (hinge), a shift along z (slide), a rotation
(ball) or the whole pose (free).  Poses are rows of twelve: position, then the rotation matrix row by row.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.block import Block, Layout

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

HINGE, SLIDE, BALL, FREE = 0, 1, 2, 3

Q_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 4, FREE: 7}
V_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 3, FREE: 6}


TREE = Layout(
    "Tree",
    kind="ints",  # (n,) HINGE, SLIDE, BALL, FREE
    parent="ints",  # (n,) node, -1 = world; parents come first
    qadr="ints",  # (n,) where the node's numbers start in q
    vadr="ints",  # (n,) … and in dq
    constant="table",  # (n, 12) C_k
    lower="floats",  # (nv,) -inf where unlimited
    upper="floats",  # (nv,) ball: cone angle in each of its three entries
    low="floats",  # (nv,) finite range for drawing random starts
    high="floats",  # (nv,)
    dof_node="ints",  # (nv,) node of each degree of freedom
    every="ints",  # (n,) 0, 1, …: the list of all nodes
    coupled="int_table",  # (c, 2) node that follows, node that leads (-1: it stands still); see ``couplings``
    law="table",  # (c, 7) q₀ of the two, a₀ … a₄
)
open_tree = TREE.open


@dataclass(frozen=True, eq=False, repr=False)
class Tree:
    """Arrays of a kinematic tree (``TREE``), read-only, and ``block``, the same for compiled code."""

    joint_ids: tuple[int, ...]  # (n,) MuJoCo joint of each node
    kind: Ints
    parent: Ints
    qadr: Ints
    vadr: Ints
    constant: Array
    lower: Array
    upper: Array
    low: Array
    high: Array
    nq: int
    nv: int
    coupled: Ints = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    law: Array = field(default_factory=lambda: np.zeros((0, 7)))
    dof_node: Ints = field(init=False)
    every: Ints = field(init=False)
    block: Block = field(init=False, repr=False)

    def __post_init__(self) -> None:
        widths = [V_WIDTH[int(kind)] for kind in self.kind]
        object.__setattr__(self, "dof_node", np.repeat(np.arange(len(widths)), widths))
        object.__setattr__(self, "every", np.arange(len(widths)))
        arrays: dict[str, NDArray[Any]] = {}
        for name, kind in TREE.kinds.items():
            array = np.array(getattr(self, name), np.int64 if kind.startswith("int") else float)
            array.flags.writeable = False
            arrays[name] = array
            object.__setattr__(self, name, array)
        object.__setattr__(self, "block", TREE.allocate(given=arrays))

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy has arrays of its own, and so needs a table of its own.
        return Tree, tuple(getattr(self, item.name) for item in fields(self) if item.init)

    def __repr__(self) -> str:
        return f"Tree({self.size} nodes, nq={self.nq}, nv={self.nv}, {len(self.coupled)} coupled)"

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

    def reach(self, node: int, local: Array) -> tuple[Array, float] | None:
        """A ball that a point (``local``, seen from ``node``) can never leave, as ``Robot.reach`` has it."""
        chain = self.ancestors(node)
        if not chain or self.kind[chain[0]] == FREE:
            return None
        radius = float(np.linalg.norm(local[:3]))
        for k in chain:
            if k != chain[0]:
                radius += float(np.linalg.norm(self.constant[k, :3]))
            if self.kind[k] == SLIDE:
                v = self.vadr[k]
                radius += float(np.max(np.abs([self.lower[v], self.upper[v]])))
        return (self.constant[chain[0], :3].copy(), radius) if np.isfinite(radius) else None

    def with_limits(self, lower: Array, upper: Array) -> Tree:
        """The same tree inside other limits (nv,)."""
        low = np.where(np.isfinite(lower), lower, self.low)
        high = np.where(np.isfinite(upper), upper, self.high)
        return replace(self, lower=lower, upper=upper, low=low, high=np.maximum(low, high))
