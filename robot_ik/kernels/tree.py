"""``Tree``: a kinematic tree as flat arrays. ``model.py`` builds it from an ``MjModel``.

Every active joint is a *node*. With ``X_k`` the pose of node k in the world,

    X_k = X_parent(k) · C_k · J_k(q),      frame = X_node · L

where ``C_k`` is constant. ``J_k`` is a rotation about z (hinge), a shift along z (slide), a
rotation (ball) or the whole pose (free). Poses are rows of twelve numbers: the position, then the
rotation matrix row by row.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.kernels.block import Block, Layout

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Kinds of joints.
HINGE = 0
SLIDE = 1
BALL = 2
FREE = 3

# Numbers of a joint in q and in dq.
Q_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 4, FREE: 7}
V_WIDTH = {HINGE: 1, SLIDE: 1, BALL: 3, FREE: 6}


TREE = Layout(
    "Tree",
    kind="ints",  # (n,) HINGE, SLIDE, BALL, FREE
    parent="ints",  # (n,) node, -1 for the world; parents come first
    qadr="ints",  # (n,) where the node's numbers start in q
    vadr="ints",  # (n,) where they start in dq
    constant="table",  # (n, 12) C_k
    lower="floats",  # (nv,) -inf where unlimited
    upper="floats",  # (nv,) inf where unlimited; a ball has its cone angle three times
    sample_lower="floats",  # (nv,) finite range of random starts
    sample_upper="floats",  # (nv,)
    dof_node="ints",  # (nv,) node of each degree of freedom
    every="ints",  # (n,) 0, 1, …: the list of all nodes
    coupled="int_table",  # (c, 2) follower and leader (-1: none); see ``couplings``
    law="table",  # (c, 7) q₀ of both, a₀ … a₄
)
open_tree = TREE.open


@dataclass(frozen=True, eq=False, repr=False)
class Tree:
    """Read-only arrays of a kinematic tree (``TREE``). ``block`` has them for compiled code."""

    joint_ids: tuple[int, ...]  # (n,) MuJoCo joint of each node
    kind: Ints
    parent: Ints
    qadr: Ints
    vadr: Ints
    constant: Array
    lower: Array
    upper: Array
    sample_lower: Array
    sample_upper: Array
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
        # A copy has other arrays and so needs another block.
        return Tree, tuple(getattr(self, item.name) for item in fields(self) if item.init)

    def __repr__(self) -> str:
        return f"Tree({self.size} nodes, nq={self.nq}, nv={self.nv}, {len(self.coupled)} coupled)"

    @property
    def size(self) -> int:
        """Number of nodes (active joints)."""
        return len(self.kind)

    def ancestors(self, node: int) -> list[int]:
        """Return the nodes that move ``node``, itself included, root first; none for the world."""
        nodes: list[int] = []
        while node >= 0:
            nodes.append(node)
            node = int(self.parent[node])
        return nodes[::-1]

    def reach(self, node: int, local: Array) -> tuple[Array, float] | None:
        """Return centre and radius of a ball that a frame ``local`` (12,) on ``node`` cannot leave.

        It is None if the base floats or a slide is unlimited.
        """
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
        """Return the same tree with other limits (nv,)."""
        sample_lower = np.where(np.isfinite(lower), lower, self.sample_lower)
        sample_upper = np.where(np.isfinite(upper), upper, self.sample_upper)
        return replace(
            self,
            lower=lower,
            upper=upper,
            sample_lower=sample_lower,
            sample_upper=np.maximum(sample_lower, sample_upper),
        )
