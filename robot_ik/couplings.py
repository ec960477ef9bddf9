"""Joints that follow another, from the model's joint equalities and from ``robot.toml``.

q = q₀ + a₀ + a₁ x + … + a₄ x⁴ with x = leader − leader₀: MuJoCo's joint equality (XML reference,
equality/joint).  Solvers move leaders only; ``kernels/kinematics.py`` lets the coupled joints follow.
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
from robot_ik.kernels.tree import Tree
from robot_ik.ports import Array
from robot_ik.robot_file import RobotFile

if TYPE_CHECKING:
    from robot_ik.robot import Robot

_log = logging.getLogger(__name__)

_DEGREE = 4
# Equalities that are more than a joint that follows another: closed loops, mostly.
_OTHERS = {
    int(mujoco.mjtEq.mjEQ_CONNECT): "connect",
    int(mujoco.mjtEq.mjEQ_WELD): "weld",
    int(mujoco.mjtEq.mjEQ_TENDON): "tendon",
}


@dataclass(frozen=True)
class Coupling:
    """``joint`` follows ``leader`` (MuJoCo ids; leader -1: it stands still): joint = law(leader)."""

    joint: int
    leader: int
    law: Polynomial


def declared_couplings(model: mujoco.MjModel, file: RobotFile, names: Sequence[str]) -> list[Coupling]:
    """What the model's active joint equalities and ``robot.toml`` say, chains of them resolved.

    Logs a warning where there are active equalities of other kinds, which no solver keeps.

    Raises:
        UnknownJointError: ``robot.toml`` names a joint that the model does not have.
        UnsupportedJointError: A joint coupled twice, in a circle, or by a law of more than four powers.
    """
    found: list[Coupling] = []
    kinds = [int(kind) for kind, active in zip(model.eq_type, model.eq_active0, strict=True) if active]
    if not_kept := sorted({_OTHERS[kind] for kind in kinds if kind in _OTHERS}):
        _log.warning(
            "%s: equalities of the kind %s are not kept: a solution need not satisfy them",
            file.name, " and ".join(not_kept),
        )  # fmt: skip
    for e in range(model.neq):
        if int(model.eq_type[e]) != int(mujoco.mjtEq.mjEQ_JOINT) or not model.eq_active0[e]:
            continue
        joint, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        law = Polynomial(model.eq_data[e, : _DEGREE + 1]) + _zero(model, joint)
        if leader >= 0:
            law = law(Polynomial([-_zero(model, leader), 1.0]))
        found.append(Coupling(joint, leader, Polynomial(law.coef[:1]) if leader < 0 else law))
    for name, coupling in file.couplings.items():
        require_joints((name, coupling.follows), names, f"couplings.{name} of {file.path}")
        law = Polynomial([coupling.offset, coupling.ratio])
        found.append(Coupling(names.index(name), names.index(coupling.follows), law))
    return _resolved(found, names)


def _zero(model: mujoco.MjModel, joint: int) -> float:
    return float(model.qpos0[model.jnt_qposadr[joint]])


def _resolved(found: list[Coupling], names: Sequence[str]) -> list[Coupling]:
    """Couplings whose leaders are free: a joint that follows a follower follows its leader."""
    by_joint: dict[int, Coupling] = {}
    for coupling in found:
        if coupling.joint in by_joint:
            twice = f"joint {names[coupling.joint]!r} is coupled twice"
            raise UnsupportedJointError(twice, hint="leave one of the couplings out")
        by_joint[coupling.joint] = coupling
    done = []
    for coupling in found:
        leader, law, seen = coupling.leader, coupling.law, {coupling.joint}
        while leader in by_joint:
            if leader in seen:
                raise UnsupportedJointError(
                    f"joint {names[leader]!r} follows itself in a circle of couplings"
                )
            seen.add(leader)
            law, leader = law(by_joint[leader].law), by_joint[leader].leader
        law = law.trim()
        if law.degree() > _DEGREE:
            raise UnsupportedJointError(
                f"joint {names[coupling.joint]!r} follows {names[leader]!r} "
                f"by a law of degree {law.degree()}",
                hint=f"up to {_DEGREE} is possible: couple it to {names[leader]!r} directly",
            )
        done.append(replace(coupling, leader=leader, law=law))
    return done


def with_couplings(
    tree: Tree, couplings: Sequence[Coupling], frozen: Array, addresses: Array, names: Sequence[str]
) -> Tree:
    """The tree with its coupled joints, limits of the leaders narrowed so that all stay inside theirs.

    A coupled joint whose leader is frozen stands still.  A frozen joint whose leader moves is not in the
    tree; ``Problem`` refuses to move such a leader.

    ``frozen`` (model.nq,) is where frozen joints stand, ``addresses`` (model.njnt,) where in it, ``names``
    are those of all joints.

    Raises:
        ModelError: A leader has no range left.
    """
    node_of = {joint: k for k, joint in enumerate(tree.joint_ids)}
    coupled, law = [], []
    for coupling in couplings:
        if coupling.joint not in node_of:
            continue
        leader = node_of.get(coupling.leader, -1)
        polynomial = coupling.law
        if leader < 0:
            at = float(frozen[addresses[coupling.leader]]) if coupling.leader >= 0 else 0.0
            polynomial = Polynomial([polynomial(at)])
        coupled.append((node_of[coupling.joint], leader))
        law.append([0.0, 0.0, *np.pad(polynomial.coef, (0, _DEGREE + 1 - len(polynomial.coef)))])
    if not coupled:
        return tree
    coupled_tree = replace(tree, coupled=np.array(coupled, dtype=np.int64), law=np.array(law))
    return narrowed(coupled_tree, [names[joint] for joint in tree.joint_ids])


def narrowed(tree: Tree, joints: Sequence[str]) -> Tree:
    """The tree with each leader's limits narrowed to where its followers are inside theirs.

    ``joints`` are the names of the tree's.

    Raises:
        ModelError: There is no such position.
    """
    lower, upper = tree.lower.copy(), tree.upper.copy()
    for (node, leader), law in zip(tree.coupled, tree.law, strict=True):
        v = int(tree.vadr[node])
        polynomial = Polynomial(law[2:])
        if leader < 0:
            value = float(polynomial(0.0))
            lower[v], upper[v] = min(lower[v], value), max(upper[v], value)
            continue
        w = int(tree.vadr[leader])
        interval = _admissible_interval(polynomial, (lower[v], upper[v]), (lower[w], upper[w]))
        if interval is None:
            raise ModelError(
                f"coupled joint {joints[node]!r} has no position inside its limits "
                f"{lower[v]:.4f} … {upper[v]:.4f} while its leader {joints[leader]!r} is inside "
                f"{lower[w]:.4f} … {upper[w]:.4f}",
                hint="check ratio and offset of the coupling, and both joints' limits",
            )
        lower[w], upper[w] = interval
    return tree.with_limits(lower, upper)


def _admissible_interval(
    law: Polynomial, wanted: tuple[float, float], given: tuple[float, float]
) -> tuple[float, float] | None:
    """The widest interval inside ``given`` on which the law stays inside ``wanted``."""
    low, high = (float(np.clip(edge, -1e3, 1e3)) for edge in given)
    edges = [low, high]
    for bound in wanted:
        if np.isfinite(bound):
            roots = np.atleast_1d((law - bound).roots())
            edges += [float(r.real) for r in roots if abs(r.imag) < 1e-9 and low < r.real < high]
    edges.sort()
    best: tuple[float, float] | None = None
    for a, b in itertools.pairwise(edges):
        if wanted[0] - 1e-9 <= law(0.5 * (a + b)) <= wanted[1] + 1e-9:
            if best is not None and abs(best[1] - a) < 1e-12:
                best = (best[0], b)
            elif best is None or b - a > best[1] - best[0]:
                best = (a, b)
    if best is None:
        return None
    return (given[0] if best[0] <= low else best[0]), (given[1] if best[1] >= high else best[1])


def refuse_broken(robot: Robot, leaders: set[int]) -> None:
    """Raises ``UnsupportedJointError`` if a joint that stands still should follow one that moves."""
    active = {joint: k for k, joint in enumerate(robot.tree.joint_ids)}
    for coupling in robot.couplings:
        if coupling.joint in active or active.get(coupling.leader) not in leaders:
            continue
        ids = (coupling.joint, coupling.leader)
        follower, leader = (robot.model.joint(j).name or f"joint_{j}" for j in ids)
        raise UnsupportedJointError(
            f"{robot.path.name} ties joint {follower!r}, which is frozen, to {leader!r}, which is to move",
            path=robot.path,
            hint="let both move or none: load_robot(…, joints=[…])",
        )
