"""Shapes of MuJoCo's geoms: support points, and distances that need no iteration.

A shape is a *core* that is swept by a ball. The core of a sphere is a point, that of a capsule is a
segment, and their ``rounding`` is the radius. Other shapes are their own core, without rounding. A
mesh is the convex hull of its vertices, as in MuJoCo.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined

# Kinds of shapes: the numbers of ``mujoco.mjtGeom``.
PLANE, HEIGHT_FIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, SDF = range(9)

# A direction shorter than this has no azimuth.
_ZERO_LENGTH = 1e-15
# Meshes with more vertices than this are searched along their edges.
_MAX_SCANNED_VERTICES = 24

# With g geoms, l links. A link is a set of geoms that move together.
SHAPES = Layout(
    "Shapes",
    kind="ints",  # (g,) PLANE … MESH
    size="table",  # (g, 3) MuJoCo's ``geom_size``
    rounding="floats",  # (g,) radius of the ball that sweeps the core
    ball="floats",  # (g,) radius of a ball about the origin that contains the geom; inf: a plane
    link="ints",  # (g,) link of each geom
    local="table",  # (g, 12) pose in the link's node, or in the world for a fixed geom
    node="ints",  # (l,) node that carries the link, -1: the world
    geom_start="ints",  # (l + 1,) first geom of each link; geoms are sorted by link
    capsule="table",  # (l, 8) a capsule that contains the link: ends, radius, radius of its ball
    box="ints",  # (l,) the geom of a link that is one fixed box or plane, else -1
    vertex_start="ints",  # (g,) first vertex of each mesh
    vertex_end="ints",  # (g,) end of its vertices; geoms of one mesh share them
    vertices="table",  # (v, 3) in the frame of the geom
    edge_start="ints",  # (v + 1,) first neighbour of each vertex
    edges="ints",  # neighbours: indices of vertices
)


@outlined
def support(shapes, hint, g, direction):
    """Return the point of the core of geom ``g`` that is farthest along ``direction``.

    Both are in the frame of the geom. For a mesh the vertex is written to ``hint`` (g,), where the
    next search begins.
    """
    kind = shapes.kind[g]
    x, y, z = direction
    a = shapes.size[g, 0]
    b = shapes.size[g, 1]
    c = shapes.size[g, 2]
    if kind == BOX:
        return math.copysign(a, x), math.copysign(b, y), math.copysign(c, z)
    if kind == CAPSULE:
        return 0.0, 0.0, math.copysign(b, z)
    if kind == CYLINDER:
        length = math.sqrt(x * x + y * y)
        if length < _ZERO_LENGTH:
            return a, 0.0, math.copysign(b, z)
        return a * x / length, a * y / length, math.copysign(b, z)
    if kind == ELLIPSOID:
        length = math.sqrt(a * a * x * x + b * b * y * y + c * c * z * z)
        if length < _ZERO_LENGTH:
            return a, 0.0, 0.0
        return a * a * x / length, b * b * y / length, c * c * z / length
    if kind == MESH:
        vertex = farthest_vertex(shapes, hint, g, direction)
        return so3.read_vector(shapes.vertices, vertex, 0)
    return 0.0, 0.0, 0.0


@outlined
def farthest_vertex(shapes, hint, g, direction):
    """Return the vertex of mesh ``g`` that is farthest along ``direction``; writes ``hint``."""
    first = shapes.vertex_start[g]
    end = shapes.vertex_end[g]
    best = first
    if end - first <= _MAX_SCANNED_VERTICES or shapes.edge_start[end] == shapes.edge_start[first]:
        height = so3.dot(direction, so3.read_vector(shapes.vertices, first, 0))
        for vertex in range(first + 1, end):
            other = so3.dot(direction, so3.read_vector(shapes.vertices, vertex, 0))
            if other > height:
                height = other
                best = vertex
        return best
    # The only local maximum of a convex hull is the highest vertex.
    best = hint[g]
    height = so3.dot(direction, so3.read_vector(shapes.vertices, best, 0))
    rising = True
    while rising:
        rising = False
        at = best
        for e in range(shapes.edge_start[at], shapes.edge_start[at + 1]):
            vertex = shapes.edges[e]
            other = so3.dot(direction, so3.read_vector(shapes.vertices, vertex, 0))
            if other > height:
                height = other
                best = vertex
                rising = True
    hint[g] = best
    return best


@inlined
def point_to_box(shapes, poses, g, point):
    """Return the squared distance of a world point from box ``g``; 0 inside."""
    offset = so3.subtract(point, so3.read_vector(poses, g, 0))
    x, y, z = so3.apply_inverse(so3.read_rotation(poses, g), offset)
    x = max(abs(x) - shapes.size[g, 0], 0.0)
    y = max(abs(y) - shapes.size[g, 1], 0.0)
    z = max(abs(z) - shapes.size[g, 2], 0.0)
    return x * x + y * y + z * z


@inlined
def height_over_plane(poses, g, point):
    """Return the signed distance of a world point from plane ``g``, negative below."""
    normal = so3.z_axis(so3.read_rotation(poses, g))
    return so3.dot(normal, so3.subtract(point, so3.read_vector(poses, g, 0)))


@inlined
def segment_gap(first, second, first_end, second_end):
    """Return the squared distance of the segments first–first_end and second–second_end."""
    u = so3.subtract(first_end, first)
    v = so3.subtract(second_end, second)
    r = so3.subtract(first, second)
    # Never zero, so that a point is a valid segment.
    a = so3.dot(u, u) + 1e-18
    e = so3.dot(v, v) + 1e-18
    b = so3.dot(u, v)
    c = so3.dot(u, r)
    f = so3.dot(v, r)
    s = min(max((b * f - c * e) / (a * e - b * b + 1e-15 * a * e), 0.0), 1.0)
    t = min(max((b * s + f) / e, 0.0), 1.0)
    s = min(max((b * t - c) / a, 0.0), 1.0)
    gap = so3.add(r, so3.subtract(so3.scale(s, u), so3.scale(t, v)))
    return so3.dot(gap, gap)
