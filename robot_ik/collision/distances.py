"""Tables of shapes and pairs for the compiled checks, and the memory of a check."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.geometry import Array, Pose
from robot_ik.kernels import collision, jit, shapes
from robot_ik.kernels.block import Block
from robot_ik.kernels.tree import Tree

Ints = NDArray[np.int64]

MAX_NEAR_PAIRS = 64
"""Largest number of pairs that a check lists with their gradients. The nearest are kept."""

_RIM_POINTS = 24
"""Corners of the polygon around the rim of a cylinder."""

_SLACK = 1e-9
"""m. Added to radii of containers against rounding."""

_CONTAINER_STEPS = 8
"""Lengths of the capsule's axis that are tried, from a ball to the whole extent."""


class ShapeTables:
    """The geoms of a model, sorted by link, as compiled code reads them.

    A link is a set of geoms that move together, or the geoms of one fixed body.

    Attributes:
        block: Block of ``shapes.SHAPES``.
        geoms: (g,) MuJoCo's id of each geom in the tables.
        row: MuJoCo's id -> row of the tables.
    """

    def __init__(self, model: mujoco.MjModel, bodies: list[tuple[int, Pose]], geoms: Ints) -> None:
        """Build the tables.

        Args:
            model: MuJoCo's model.
            bodies: Node (-1: the world) and pose in the node of each body.
            geoms: MuJoCo's ids of the geoms that take part.
        """
        body_of = model.geom_bodyid[geoms]
        node_of = np.array([bodies[body][0] for body in body_of], dtype=np.int64)
        # Moving links come first, then fixed links: one link for the geoms of one body, but one
        # link for each plane and each geom of the world.
        alone = (body_of == 0) | (model.geom_type[geoms] == shapes.PLANE)
        still = np.where(alone, model.nbody + geoms, body_of)
        group = np.where(node_of < 0, len(bodies) + model.ngeom + still, node_of)
        order = np.lexsort([geoms, group])
        self.geoms = geoms[order]
        self.row = {int(g): k for k, g in enumerate(self.geoms)}
        nodes = node_of[order]
        starts = np.flatnonzero(np.diff(group[order], prepend=-2)).tolist()
        edges = np.array([*starts, len(nodes)], dtype=np.int64)
        hulls = _Hulls(model, self.geoms)
        tables: dict[str, NDArray[Any]] = {
            "kind": model.geom_type[self.geoms].astype(np.int64),
            "size": np.array(model.geom_size[self.geoms], dtype=float).reshape(-1, 3),
            "link": np.repeat(np.arange(len(starts)), np.diff(edges)),
            "node": nodes[starts],
            "geom_start": edges,
            **hulls.tables,
        }
        kinds = tables["kind"]
        swept = (kinds == shapes.SPHERE) | (kinds == shapes.CAPSULE)
        tables["rounding"] = np.where(swept, tables["size"][:, 0], 0.0)
        self._extents = [
            _extent(int(kind), size, hulls.vertices[mesh])
            for kind, size, mesh in zip(kinds, tables["size"], hulls.mesh.tolist(), strict=True)
        ]
        tables["ball"] = np.array(
            [
                math.inf if not len(points) else np.linalg.norm(points, axis=1).max() + r + _SLACK
                for points, r in self._extents
            ]
        )
        tables["local"] = np.array([self._pose(model, bodies, g).row for g in self.geoms])
        tables["local"] = tables["local"].reshape(-1, 12)
        stands_alone = (kinds == shapes.BOX) | (kinds == shapes.PLANE)
        is_box = (tables["node"] < 0) & stands_alone[starts] & (np.diff(edges) == 1)
        tables["box"] = np.where(is_box, np.array(starts, dtype=np.int64), -1)
        tables["capsule"] = np.zeros((len(starts), 8))
        tables["capsule"][:, 7] = np.inf  # planes
        self.block = shapes.SHAPES.allocate(given=tables)
        for link in range(len(starts)):
            self._fit_capsule(link)

    @staticmethod
    def _pose(model: mujoco.MjModel, bodies: list[tuple[int, Pose]], geom: int) -> Pose:
        local = Pose(model.geom_pos[geom], model.geom_quat[geom])
        return bodies[model.geom_bodyid[geom]][1].compose(local)

    def move(self, model: mujoco.MjModel, bodies: list[tuple[int, Pose]], body: int) -> None:
        """Move the geoms of a fixed body to its current pose in ``bodies``."""
        for geom in np.flatnonzero(model.geom_bodyid == body):
            row = self.row.get(int(geom))
            if row is not None:
                self.block.arrays["local"][row] = self._pose(model, bodies, int(geom)).row
                self._fit_capsule(int(self.block.arrays["link"][row]))

    def _fit_capsule(self, link: int) -> None:
        """Write a small capsule that contains a link."""
        tables = self.block.arrays
        first, end = tables["geom_start"][link : link + 2]
        points = []
        radii = []
        for g in range(first, end):
            extent, radius = self._extents[g]
            local = tables["local"][g]
            points.append(extent @ local[3:].reshape(3, 3).T + local[:3])
            radii.append(np.full(len(extent), radius))
        if sum(map(len, points)):
            capsule = capsule_around(np.concatenate(points), np.concatenate(radii))
            half = 0.5 * np.linalg.norm(capsule[3:6] - capsule[:3])
            tables["capsule"][link] = *capsule, half + capsule[6] + _SLACK


def capsule_around(points: Array, radii: Array) -> Array:
    """Return ends and radius (7,) of a capsule that contains balls (n, 3), (n,).

    Its axis is a principal axis of the points. Its length gives the smallest volume of a
    few that are tried.
    """
    center = points.mean(axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2]
    best = np.zeros(7)
    smallest = math.inf
    for axis in axes:
        along = (points - center) @ axis
        across = points - center - along[:, None] * axis
        # The centre line goes through the middle of the points' extent, not through their mean.
        middle = center + 0.5 * (across.min(axis=0) + across.max(axis=0))
        middle -= ((middle - center) @ axis) * axis
        for share in np.linspace(0.0, 1.0, _CONTAINER_STEPS):
            ends = np.array([along.min(), along.max()])
            ends = ends.mean() + share * (ends - ends.mean())
            nearest = middle + np.clip(along, *ends)[:, None] * axis
            radius = float((np.linalg.norm(points - nearest, axis=1) + radii).max()) + _SLACK
            volume = math.pi * radius**2 * (ends[1] - ends[0] + 4.0 / 3.0 * radius)
            if volume < smallest:
                smallest = volume
                best[:3] = middle + ends[0] * axis
                best[3:6] = middle + ends[1] * axis
                best[6] = radius
    return best


def _extent(kind: int, size: Array, vertices: Array) -> tuple[Array, float]:
    """Return points (n, 3) and a radius: the hull of balls about them contains the geom.

    The distance to a segment is convex. So a capsule that contains these balls contains the geom.
    """
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    if kind == shapes.SPHERE:
        return np.zeros((1, 3)), float(size[0])
    if kind == shapes.CAPSULE:
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), float(size[0])
    if kind == shapes.BOX:
        return signs * size, 0.0
    if kind in (shapes.CYLINDER, shapes.ELLIPSOID):
        return _rings(kind, size), 0.0
    if kind == shapes.MESH:
        return vertices, 0.0
    return np.zeros((0, 3)), 0.0


def _rings(kind: int, size: Array) -> Array:
    """Return corners of a polyhedron around a cylinder or an ellipsoid."""
    angles = 2.0 * math.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    widening = 1.0 / math.cos(math.pi / _RIM_POINTS)
    circle = widening * np.column_stack([np.cos(angles), np.sin(angles)])
    if kind == shapes.CYLINDER:
        heights = np.array([-size[1], size[1]])
        widths = np.full(2, size[0])
        scale = np.ones(3)
    else:
        # A stack of rings around the unit ball: tangents of its profile meet at these points.
        steps = np.arange(-_RIM_POINTS // 2, _RIM_POINTS // 2 + 1)
        latitude = math.pi * steps / _RIM_POINTS
        heights = widening * np.sin(latitude)
        widths = widening * np.cos(latitude)
        scale = size
    rings = [
        np.column_stack([width * circle, np.full(_RIM_POINTS, height)])
        for width, height in zip(widths, heights, strict=True)
    ]
    return np.concatenate(rings) * scale


class _Hulls:
    """Vertices of all meshes, numbered through. Geoms of one mesh share them.

    MuJoCo keeps the graph of each convex hull. Without it all vertices count, without neighbours.
    """

    def __init__(self, model: mujoco.MjModel, geoms: Ints) -> None:
        is_mesh = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_MESH
        self.mesh = np.where(is_mesh, model.geom_dataid[geoms], -1)
        self.vertices = {-1: np.zeros((0, 3))}
        start = {-1: 0}
        edge_counts = [np.zeros(0, dtype=np.int64)]
        edges = [np.zeros(0, dtype=np.int64)]
        total = 0
        for mesh in np.unique(self.mesh[is_mesh]).tolist():
            vertices, counts, ends = _hull(model, mesh)
            self.vertices[mesh] = vertices
            start[mesh] = total
            edge_counts.append(counts)
            edges.append(ends + total)
            total += len(vertices)
        first = np.array([start[mesh] for mesh in self.mesh.tolist()], dtype=np.int64)
        lengths = [len(self.vertices[mesh]) for mesh in self.mesh.tolist()]
        edge_start = np.concatenate([[0], np.cumsum(np.concatenate(edge_counts))])
        self.tables: dict[str, NDArray[Any]] = {
            "vertex_start": first,
            "vertex_end": first + np.array(lengths, dtype=np.int64),
            "vertices": np.concatenate(list(self.vertices.values())),
            "edge_start": edge_start.astype(np.int64),
            "edges": np.concatenate(edges),
        }


def _hull(model: mujoco.MjModel, mesh: int) -> tuple[Array, Ints, Ints]:
    """Return the vertices (n, 3) of a mesh that count, the number of neighbours, and these."""
    first = int(model.mesh_vertadr[mesh])
    end = first + int(model.mesh_vertnum[mesh])
    vertices = np.array(model.mesh_vert[first:end], dtype=float)
    begin = int(model.mesh_graphadr[mesh])
    if begin < 0:
        return vertices, np.zeros(len(vertices), dtype=np.int64), np.zeros(0, dtype=np.int64)
    # The layout is that of ``mesh_graph`` in mjmodel.h.
    graph = model.mesh_graph[begin:]
    count, faces = graph[:2].tolist()
    ids = graph[2 + count : 2 + 2 * count]
    edges = graph[2 + 2 * count : 2 + 3 * count + 3 * faces]
    starts = graph[2 : 2 + count]
    stops = np.flatnonzero(edges < 0)
    ends = stops[np.searchsorted(stops, starts)]
    lists = [edges[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
    counts = (ends - starts).astype(np.int64)
    return vertices[ids], counts, np.concatenate(lists).astype(np.int64)


@dataclass(frozen=True, eq=False)
class PairTables:
    """Pairs of geoms, sorted by the links that they are on.

    Attributes:
        block: Block of ``collision.PAIRS``.
        geoms: (p, 2) MuJoCo's ids of each pair in the tables.
    """

    block: Block
    geoms: Ints

    @classmethod
    def of(cls, tables: ShapeTables, pairs: Ints, tree: Tree) -> PairTables:
        """Return the tables of pairs (p, 2) of MuJoCo's geom ids."""
        link = tables.block.arrays["link"]
        node = tables.block.arrays["node"]
        kind = tables.block.arrays["kind"]
        rows = np.array([[tables.row[int(a)], tables.row[int(b)]] for a, b in pairs])
        rows = rows.reshape(-1, 2).astype(np.int64)
        # Fixed links have the highest numbers, so they are second in sorted pairs. Planes and boxes
        # are second too, because their filter removes more pairs.
        links = link[rows]
        rows = np.where((links[:, 0] > links[:, 1])[:, None], rows[:, ::-1], rows)
        simple = np.isin(kind[rows], (shapes.BOX,))
        swap = simple[:, 0] & ~simple[:, 1] & (node[link[rows]] >= 0).all(axis=1)
        links = link[rows]
        order = np.lexsort([links[:, 1], links[:, 0]])
        rows = rows[order]
        links = links[order]
        swap = swap[order]
        linked, start = np.unique(links, axis=0, return_index=True)
        geoms = np.where(swap[:, None], rows[:, ::-1], rows)
        block = collision.PAIRS.allocate(
            given={
                "links": linked.reshape(-1, 2),
                "start": np.append(start, len(rows)).astype(np.int64),
                "geoms": np.ascontiguousarray(geoms),
                "below": np.array(
                    [_below_ancestor(tree, int(node[a]), int(node[b])) for a, b in linked],
                    dtype=np.int64,
                ).reshape(-1, 2),
            }
        )
        return cls(block, tables.geoms[geoms].reshape(-1, 2))


def _below_ancestor(tree: Tree, a: int, b: int) -> tuple[int, int]:
    """Return the first node of each link below the last node that carries both, or -1."""
    chain_a = tree.ancestors(a)
    chain_b = tree.ancestors(b)
    common = 0
    while common < min(len(chain_a), len(chain_b)) and chain_a[common] == chain_b[common]:
        common += 1
    return (
        chain_a[common] if common < len(chain_a) else -1,
        chain_b[common] if common < len(chain_b) else -1,
    )


def check_memory(tree: Tree, tables: ShapeTables, pairs: PairTables) -> Block:
    """Return the memory of one check at a time: a block of ``collision.RUN``."""
    sizes = {
        "n": tree.size,
        "g": len(tables.geoms),
        "l": len(tables.block.arrays["node"]),
        "k": len(pairs.block.arrays["links"]),
        "p": len(pairs.geoms),
        "r": MAX_NEAR_PAIRS,
        "nq": tree.nq,
        "nv": tree.nv,
    }
    check = collision.CHECK.allocate(sizes)
    check.arrays["hint"][...] = tables.block.arrays["vertex_start"]
    return collision.RUN.allocate(
        given={
            "tree": tree.block,
            "shapes": tables.block,
            "pairs": pairs.block,
            "check": check,
        }
    )


def announce() -> None:
    """Log that the first check on a machine compiles."""
    jit.announce(collision.verdicts, "collision checks")
