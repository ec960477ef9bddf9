"""Which pairs of geoms are compared: MuJoCo's rules, without pairs that cannot move.

Two geoms are a pair if ``mj_collision`` would compare them: by the bits of ``contype`` and
``conaffinity``, not within one body or with its parent, without the ``<exclude>`` elements, and
with the ``<pair>`` elements. Geoms that never move relative to each other are left out: no choice
of joint angles can bring them apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import OptionError, UnknownPartError, UnsupportedGeomError

Ints = NDArray[np.int64]

_UNSUPPORTED = {
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "signed distance function",
}
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


def part_name(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of the body of a geom; of the geom itself if it is fixed to the world."""
    body = int(model.geom_bodyid[geom])
    names = (model.body(body).name if body else "", model.geom(geom).name)
    return next(filter(None, names), f"geom {geom}")


def compared_pairs(model: mujoco.MjModel, node: Ints) -> Ints:
    """Return the pairs (p, 2) of geoms that MuJoCo compares and that can move apart.

    Args:
        model: MuJoCo's model.
        node: (nbody,) node of the tree that carries each body, -1 for the world.

    Raises:
        UnsupportedGeomError: A pair has a geom whose distances are not exact.
    """
    body = model.geom_bodyid
    weld = model.body_weldid[body]
    parent = model.body_weldid[model.body_parentid[weld]]
    contype = model.geom_contype
    affinity = model.geom_conaffinity
    a, b = np.triu_indices(model.ngeom, 1)
    compared = ((contype[a] & affinity[b]) | (contype[b] & affinity[a])) != 0
    compared &= weld[a] != weld[b]
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        family = (weld[a] == parent[b]) | (weld[b] == parent[a])
        compared &= ~(family & (weld[a] != 0) & (weld[b] != 0))
    signature = (np.minimum(body[a], body[b]) << 16) + np.maximum(body[a], body[b])
    excluded = model.exclude_signature
    swapped = ((excluded & 0xFFFF) << 16) + (excluded >> 16)
    compared &= ~np.isin(signature, np.concatenate([excluded, swapped]))
    compared &= ~((model.geom_type[a] == _PLANE) & (model.geom_type[b] == _PLANE))
    pairs = np.column_stack([a[compared], b[compared]])
    explicit = np.column_stack([model.pair_geom1, model.pair_geom2]).reshape(-1, 2)
    pairs = np.unique(np.sort(np.concatenate([pairs, explicit]), axis=1), axis=0)
    nodes = node[body[pairs]]
    pairs = pairs[nodes[:, 0] != nodes[:, 1]]
    for geom in np.unique(pairs):
        kind = int(model.geom_type[geom])
        if kind in _UNSUPPORTED:
            raise UnsupportedGeomError(part_name(model, int(geom)), _UNSUPPORTED[kind])
    return pairs.astype(np.int64)


def geoms_of(model: mujoco.MjModel, name: str) -> Ints:
    """Return the geoms of the body of this name, or the geom of this name.

    Raises:
        UnknownPartError: There is no such body or geom.
    """
    bodies = {model.body(b).name: b for b in range(1, model.nbody)}
    geoms = {model.geom(g).name: g for g in range(model.ngeom)}
    if name in bodies and name:
        return np.flatnonzero(model.geom_bodyid == bodies[name])
    if name in geoms and name:
        return np.array([geoms[name]])
    raise UnknownPartError(str(name), filter(None, [*bodies, *geoms]))


def chosen_pairs(
    model: mujoco.MjModel,
    pairs: Ints,
    names: Iterable[Sequence[str]] | None,
    ignore: Iterable[Sequence[str]],
) -> Ints:
    """Return the pairs (p, 2) that the names select, without the pairs to ignore.

    Args:
        model: MuJoCo's model.
        pairs: The pairs (p, 2) of MuJoCo's rules.
        names: Pairs of names of bodies or geoms. None for all pairs.
        ignore: Pairs of names to leave out.

    Raises:
        UnknownPartError: There is no such body or geom.
        OptionError: A pair is not two names.
    """
    kept = np.ones(len(pairs), dtype=bool)
    if names is not None:
        kept[:] = False
        for pair in names:
            kept |= _are_between(model, pairs, pair, "pairs")
    for pair in ignore:
        kept &= ~_are_between(model, pairs, pair, "ignore")
    return pairs[kept]


def _are_between(
    model: mujoco.MjModel, pairs: Ints, names: Sequence[str], option: str
) -> NDArray[np.bool_]:
    """Return for each pair (p, 2) whether it is between two named parts."""
    if isinstance(names, str) or len(names) != 2:
        raise OptionError(option, f"{names!r}", 'pairs of names, such as [("gripper", "crate")]')
    first, second = (np.isin(pairs, geoms_of(model, name)) for name in names)
    return (first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])
