"""Coupled joints, from the joint equalities of a model and from ``robot.toml``.

MuJoCo's joint equality is q = q₀ + a₀ + a₁ x + … + a₄ x⁴ with x = leader − leader₀ (XML reference,
equality/joint). Solvers move leaders only; ``kernels/kinematics.py`` sets the coupled joints.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.polynomial import Polynomial

from robot_ik.errors import ModelError, UnsupportedJointError, require_joints
from robot_ik.geometry import Array
from robot_ik.kernels.tree import Tree
from robot_ik.robot_file import RobotFile

if TYPE_CHECKING:
    from robot_ik.robot import Robot

logger = logging.getLogger(__name__)

LARGEST_DEGREE = 4
"""Degree of MuJoCo's coupling polynomial."""

WIDEST_RANGE = 1e3
"""rad or m. Unlimited leaders are searched within ± this."""

LIMIT_SLACK = 1e-9
"""rad or m. A follower may be this far outside its limits."""

REAL_ROOT = 1e-9
"""A root with a smaller imaginary part is real."""

SAME_EDGE = 1e-12
"""rad or m. Two intervals whose edges are nearer than this are one interval."""

_OTHER_EQUALITIES = {
    int(mujoco.mjtEq.mjEQ_CONNECT): "connect",
    int(mujoco.mjtEq.mjEQ_WELD): "weld",
    int(mujoco.mjtEq.mjEQ_TENDON): "tendon",
}
"""Equalities that no solver satisfies. Most of them are closed loops."""


@dataclass(frozen=True)
class Coupling:
    """A joint that follows another joint: value = law(value of the leader).

    Attributes:
        joint: MuJoCo id of the joint.
        leader: MuJoCo id of the leader; -1 if the joint is constant.
        law: The polynomial.
    """

    joint: int
    leader: int
    law: Polynomial


def declared_couplings(
    model: mujoco.MjModel, file: RobotFile, names: Sequence[str]
) -> list[Coupling]:
    """Return the couplings of a model and its robot.toml, with chains of them resolved.

    Logs a warning for active equalities of other types, which no solver satisfies.

    Args:
        model: MuJoCo's model.
        file: robot.toml.
        names: Names of all joints.

    Raises:
        UnknownJointError: robot.toml names a joint that the model does not have.
        UnsupportedJointError: A joint is coupled twice or in a circle, or a law has a degree above
            ``LARGEST_DEGREE``.
    """
    _warn_of_equalities(model, file)
    couplings: list[Coupling] = []
    for e in range(model.neq):
        is_joint = int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT)
        if not is_joint or not model.eq_active0[e]:
            continue
        joint = int(model.eq_obj1id[e])
        leader = int(model.eq_obj2id[e])
        law = Polynomial(model.eq_data[e, : LARGEST_DEGREE + 1]) + _reference(model, joint)
        x = Polynomial([-_reference(model, leader), 1.0]) if leader >= 0 else Polynomial([0.0])
        couplings.append(Coupling(joint, leader, law(x)))
    for name, row in file.couplings.items():
        require_joints((name, row.follows), names, f"couplings.{name} of {file.path}")
        law = Polynomial([row.offset, row.ratio])
        couplings.append(Coupling(names.index(name), names.index(row.follows), law))
    return _resolved(couplings, names)


def _warn_of_equalities(model: mujoco.MjModel, file: RobotFile) -> None:
    """Log a warning for active equalities that no solver satisfies."""
    active = [int(kind) for kind in model.eq_type[model.eq_active0.astype(bool)]]
    ignored = sorted({_OTHER_EQUALITIES[kind] for kind in active if kind in _OTHER_EQUALITIES})
    if ignored:
        logger.warning(
            "%s: equalities of the kind %s are not kept: a solution need not satisfy them",
            file.name,
            " and ".join(ignored),
        )


def _reference(model: mujoco.MjModel, joint: int) -> float:
    """Return the value of a joint in the reference configuration."""
    return float(model.qpos0[model.jnt_qposadr[joint]])


def _resolved(couplings: Sequence[Coupling], names: Sequence[str]) -> list[Coupling]:
    """Return couplings whose leaders are not coupled: chains of couplings become single ones."""
    by_joint: dict[int, Coupling] = {}
    for coupling in couplings:
        if coupling.joint in by_joint:
            problem = f"joint {names[coupling.joint]!r} is coupled twice"
            raise UnsupportedJointError(problem, hint="remove one of the couplings")
        by_joint[coupling.joint] = coupling
    return [_resolve(coupling, by_joint, names) for coupling in couplings]


def _resolve(coupling: Coupling, by_joint: dict[int, Coupling], names: Sequence[str]) -> Coupling:
    """Replace the leader of a coupling by the leader of the leader, until it is not coupled."""
    leader = coupling.leader
    law = coupling.law
    visited = {coupling.joint}
    while leader in by_joint:
        if leader in visited:
            problem = f"joint {names[leader]!r} follows itself in a circle of couplings"
            raise UnsupportedJointError(problem, hint="remove one of the couplings")
        visited.add(leader)
        law = law(by_joint[leader].law)
        leader = by_joint[leader].leader
    law = law.trim()
    if law.degree() > LARGEST_DEGREE:
        raise UnsupportedJointError(
            f"joint {names[coupling.joint]!r} follows {names[leader]!r} "
            f"by a law of degree {law.degree()}",
            hint=f"up to {LARGEST_DEGREE} is possible: couple it to {names[leader]!r} directly",
        )
    return replace(coupling, leader=leader, law=law)


def with_couplings(
    tree: Tree,
    couplings: Sequence[Coupling],
    frozen_qpos: Array,
    addresses: Array,
    names: Sequence[str],
) -> Tree:
    """Return a tree with its coupled joints and with narrowed limits of the leaders.

    A coupled joint whose leader is frozen is constant. A frozen joint whose leader moves is not in
    the tree; ``refuse_broken`` refuses goals that move such a leader.

    Args:
        tree: The tree without couplings.
        couplings: Couplings of the model.
        frozen_qpos: Values (model.nq,) of the frozen joints.
        addresses: Addresses (model.njnt,) of the joints in qpos.
        names: Names of all joints.

    Raises:
        ModelError: A leader has no range left.
    """
    node_of = {joint: k for k, joint in enumerate(tree.joint_ids)}
    coupled = []
    laws = []
    for coupling in couplings:
        if coupling.joint not in node_of:
            continue
        leader = node_of.get(coupling.leader, -1)
        law = coupling.law
        if leader < 0:
            is_frozen = coupling.leader >= 0
            value = float(frozen_qpos[addresses[coupling.leader]]) if is_frozen else 0.0
            law = Polynomial([law(value)])
        coupled.append((node_of[coupling.joint], leader))
        missing = LARGEST_DEGREE + 1 - len(law.coef)
        laws.append([0.0, 0.0, *np.pad(law.coef, (0, missing))])
    if not coupled:
        return tree
    coupled_tree = replace(tree, coupled=np.array(coupled, dtype=np.int64), law=np.array(laws))
    return narrowed(coupled_tree, [names[joint] for joint in tree.joint_ids])


def narrowed(tree: Tree, joints: Sequence[str]) -> Tree:
    """Return a tree whose leaders are limited so that their followers are inside their limits.

    Args:
        tree: The tree with couplings.
        joints: Names of the joints of the tree.

    Raises:
        ModelError: A leader has no range left.
    """
    lower = tree.lower.copy()
    upper = tree.upper.copy()
    for (node, leader), row in zip(tree.coupled, tree.law, strict=True):
        v = int(tree.vadr[node])
        law = Polynomial(row[2:])
        if leader < 0:
            value = float(law(0.0))
            lower[v] = min(lower[v], value)
            upper[v] = max(upper[v], value)
            continue
        w = int(tree.vadr[leader])
        interval = _admissible_interval(law, (lower[v], upper[v]), (lower[w], upper[w]))
        if interval is None:
            raise ModelError(
                f"coupled joint {joints[node]!r} has no position inside its limits "
                f"{lower[v]:.4f} … {upper[v]:.4f} while its leader {joints[leader]!r} is inside "
                f"{lower[w]:.4f} … {upper[w]:.4f}",
                hint="check ratio and offset of the coupling, and the limits of both joints",
            )
        lower[w], upper[w] = interval
    return tree.with_limits(lower, upper)


def _admissible_interval(
    law: Polynomial,
    follower_range: tuple[float, float],
    leader_range: tuple[float, float],
) -> tuple[float, float] | None:
    """Return the widest interval of the leader on which the follower is inside its range."""
    lower, upper = (float(np.clip(end, -WIDEST_RANGE, WIDEST_RANGE)) for end in leader_range)
    edges = [lower, upper]
    for bound in follower_range:
        if np.isfinite(bound):
            roots = np.atleast_1d((law - bound).roots())
            real = [float(root.real) for root in roots if abs(root.imag) < REAL_ROOT]
            edges += [root for root in real if lower < root < upper]
    edges.sort()
    smallest = follower_range[0] - LIMIT_SLACK
    largest = follower_range[1] + LIMIT_SLACK
    best: tuple[float, float] | None = None
    for start, end in itertools.pairwise(edges):
        if not smallest <= law(0.5 * (start + end)) <= largest:
            continue
        if best is not None and abs(best[1] - start) < SAME_EDGE:
            best = (best[0], end)
        elif best is None or end - start > best[1] - best[0]:
            best = (start, end)
    if best is None:
        return None
    return (
        leader_range[0] if best[0] <= lower else best[0],
        leader_range[1] if best[1] >= upper else best[1],
    )


def refuse_broken(robot: Robot, leaders: set[int]) -> None:
    """Raise ``UnsupportedJointError`` if a frozen joint is coupled to a joint that moves.

    Args:
        robot: The robot.
        leaders: Nodes that a goal moves.
    """
    active = {joint: k for k, joint in enumerate(robot.tree.joint_ids)}
    for coupling in robot.couplings:
        if coupling.joint in active or active.get(coupling.leader) not in leaders:
            continue
        follower, leader = (
            robot.model.joint(joint).name or f"joint_{joint}"
            for joint in (coupling.joint, coupling.leader)
        )
        raise UnsupportedJointError(
            f"{robot.path.name} couples joint {follower!r}, which is frozen, to {leader!r}, "
            "which moves",
            path=robot.path,
            hint="let both move or none: load_robot(…, joints=[…])",
        )
