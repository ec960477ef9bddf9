"""Distance of two convex cores by the algorithm of Gilbert, Johnson & Keerthi (1988).

The algorithm keeps a simplex of up to four points of A − B (the differences of points of A and B)
and v, the point of the simplex nearest to the origin. Each support point gives a *lower* bound: the
cores are on the two sides of a slab perpendicular to v. |v| is an *upper* bound. Where the gap is
below 0.1 mm, rounding affects |v| more than the lower bound. So only the lower bound decides that
cores are apart.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.shapes import support

# Iterations of one distance. Flat against flat takes 5 to 8, rounded shapes up to 30.
_MAX_ITERATIONS = 60
# Difference of the squared bounds, relative to the upper bound, at which both are the distance.
_ACCURACY = 1e-8
# Squared length, m², below which v is the origin.
_ZERO_SQUARE = 1e-18
# v must become shorter by this share.
_SMALLEST_PROGRESS = 1e-14
# Squared height of a tetrahedron over its face, as a share of the face, below which it is flat.
_FLAT = 1e-24

# A cross product shorter than this has parallel factors.
_SHORT_AXIS = 1e-6
# Largest number of directions of overlap that are tried after the first directions.
_MAX_TURNS = 8
# m, and share of the depth: the gap to which overlapping cores are moved apart.
_BEYOND = 1e-4
_BEYOND_SHARE = 0.1

# Memory of one distance.
SIMPLEX = Layout(
    "Simplex",
    count="int",  # points of the simplex
    points="table 4 3",  # of A − B
    on_first="table 4 3",  # the points of A in these differences
    share="floats 4",  # weights of v
    trial="floats 4",
    axis="floats 3",  # v: where the last call ended, and the next one may begin
)


@outlined
def distance_bounds(shapes, hint, simplex, a, b, rotation, offset, stop_above, stop_below):
    """Return (lower, upper, overlap) of the distance between the cores of geoms ``a`` and ``b``.

    It ends as soon as ``lower`` > ``stop_above``, with an infinite ``upper``, or ``upper`` <=
    ``stop_below``.
    Writes simplex.axis, v in the frame of ``a``, and the points and shares of which ``witness``
    makes the nearest points.

    Args:
        shapes: Block of ``SHAPES``.
        hint: (g,) first guesses for the vertices of meshes.
        simplex: Block of ``SIMPLEX``. Its axis is the first guess for v; zero for none.
        a: The first geom.
        b: The second geom.
        rotation: Rotation of ``b`` in the frame of ``a``.
        offset: Position of ``b`` in the frame of ``a``.
        stop_above: The search ends when the lower bound exceeds this distance.
        stop_below: The search ends when the upper bound is at most this distance; negative: never.
    """
    v = so3.read_vector_at(simplex.axis, 0)
    square = so3.dot(v, v)
    if square < _ZERO_SQUARE:
        v = so3.scale(-1.0, offset)
        square = so3.dot(v, v)
        if square < _ZERO_SQUARE:
            v = 1.0, 0.0, 0.0
            square = 1.0
    lower = -math.inf
    simplex.count = 0
    for _ in range(_MAX_ITERATIONS):
        on_a = support(shapes, hint, a, so3.scale(-1.0, v))
        on_b = support(shapes, hint, b, so3.apply_inverse(rotation, v))
        point = so3.subtract(on_a, so3.add(so3.apply(rotation, on_b), offset))
        along = so3.dot(v, point)
        lower = max(lower, along / math.sqrt(square))
        if lower > stop_above:
            so3.write_vector(simplex.axis, 0, v)
            return lower, math.inf, False
        known = simplex.count > 0
        if known and square - along <= _ACCURACY * square:
            break
        if is_known(simplex, point):
            break
        so3.write_row(simplex.points, simplex.count, point)
        so3.write_row(simplex.on_first, simplex.count, on_a)
        simplex.count += 1
        if not reduce_simplex(simplex):
            so3.write_vector(simplex.axis, 0, v)
            return lower, 0.0, True
        next_v = combine(simplex, simplex.points)
        next_square = so3.dot(next_v, next_v)
        if next_square < _ZERO_SQUARE:
            so3.write_vector(simplex.axis, 0, v)
            return lower, 0.0, True
        stalled = known and next_square >= square * (1.0 - _SMALLEST_PROGRESS)
        v = next_v
        square = next_square
        if stalled or square <= stop_below * abs(stop_below):
            break
    so3.write_vector(simplex.axis, 0, v)
    upper = math.sqrt(square)
    if simplex.count == 0:
        upper = math.inf
    return min(lower, upper), upper, False


@inlined
def combine(simplex, points):
    """Return the weighted sum of the points of the simplex."""
    v = 0.0, 0.0, 0.0
    for i in range(simplex.count):
        v = so3.add(v, so3.scale(simplex.share[i], so3.read_vector(points, i, 0)))
    return v


@inlined
def is_known(simplex, point):
    """Return whether a point is in the simplex already. Then no support point improves v."""
    known = False
    for i in range(simplex.count):
        x, y, z = so3.read_vector(simplex.points, i, 0)
        known = known or (x == point[0] and y == point[1] and z == point[2])
    return known


@outlined
def reduce_simplex(simplex):
    """Keep the points with a share of v; return False if the origin is inside the simplex."""
    count = simplex.count
    share = simplex.share
    if count == 1:
        share[0] = 1.0
        return True
    if count == 2:
        nearest_on_segment(simplex)
        keep_carriers(simplex, 0, 1, 2)
        return True
    if count == 3:
        nearest_on_triangle(simplex, 0, 1, 2)
        for i in range(3):
            share[i] = simplex.trial[i]
        keep_carriers(simplex, 0, 1, 2)
        return True
    best = math.inf
    first = 0
    second = 0
    third = 0
    for opposite in range(4):
        i = 1 if opposite == 0 else 0
        j = 1 if opposite > 1 else 2
        k = 2 if opposite == 3 else 3
        if is_outside(simplex, i, j, k, opposite):
            nearest_on_triangle(simplex, i, j, k)
            square = trial_square(simplex, i, j, k)
            if square < best:
                best = square
                first = i
                second = j
                third = k
                for n in range(3):
                    share[n] = simplex.trial[n]
    if best == math.inf:
        return False
    keep_carriers(simplex, first, second, third)
    return True


@inlined
def keep_carriers(simplex, first, second, third):
    """Move the points with a positive share to the front, and drop the others."""
    kept = 0
    for n in range(min(simplex.count, 3)):
        source = first if n == 0 else (second if n == 1 else third)
        share = simplex.share[n]
        if share > 0.0:
            for c in range(3):
                simplex.points[kept, c] = simplex.points[source, c]
                simplex.on_first[kept, c] = simplex.on_first[source, c]
            simplex.share[kept] = share
            kept += 1
    simplex.count = kept


@inlined
def nearest_on_segment(simplex):
    """Write the shares of the point of segment 0–1 that is nearest to the origin."""
    start = so3.read_vector(simplex.points, 0, 0)
    along = so3.subtract(so3.read_vector(simplex.points, 1, 0), start)
    square = so3.dot(along, along)
    share = -so3.dot(along, start) / square if square > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    simplex.share[0] = 1.0 - share
    simplex.share[1] = share


@outlined
def nearest_on_triangle(simplex, i, j, k):
    """Write the shares of the point of a triangle nearest to the origin to simplex.trial.

    By the Voronoi regions of corners, edges and face (Ericson, Real-Time Collision Detection, 2005,
    section 5.1.5).
    """
    trial = simplex.trial
    a = so3.read_vector(simplex.points, i, 0)
    b = so3.read_vector(simplex.points, j, 0)
    c = so3.read_vector(simplex.points, k, 0)
    ab = so3.subtract(b, a)
    ac = so3.subtract(c, a)
    trial[0] = 0.0
    trial[1] = 0.0
    trial[2] = 0.0
    d1 = -so3.dot(ab, a)
    d2 = -so3.dot(ac, a)
    if d1 <= 0.0 and d2 <= 0.0:
        trial[0] = 1.0
        return
    d3 = -so3.dot(ab, b)
    d4 = -so3.dot(ac, b)
    if d3 >= 0.0 and d4 <= d3:
        trial[1] = 1.0
        return
    over_ab = d1 * d4 - d3 * d2
    if over_ab <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        trial[1] = d1 / (d1 - d3) if d1 != d3 else 0.0
        trial[0] = 1.0 - trial[1]
        return
    d5 = -so3.dot(ab, c)
    d6 = -so3.dot(ac, c)
    if d6 >= 0.0 and d5 <= d6:
        trial[2] = 1.0
        return
    over_ac = d5 * d2 - d1 * d6
    if over_ac <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        trial[2] = d2 / (d2 - d6) if d2 != d6 else 0.0
        trial[0] = 1.0 - trial[2]
        return
    over_bc = d3 * d6 - d5 * d4
    if over_bc <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        length = (d4 - d3) + (d5 - d6)
        trial[2] = (d4 - d3) / length if length != 0.0 else 0.0
        trial[1] = 1.0 - trial[2]
        return
    total = over_ab + over_ac + over_bc
    trial[1] = over_ac / total
    trial[2] = over_ab / total
    trial[0] = 1.0 - trial[1] - trial[2]


@inlined
def trial_square(simplex, i, j, k):
    """Return the squared length of the point that ``nearest_on_triangle`` has found."""
    point = so3.scale(simplex.trial[0], so3.read_vector(simplex.points, i, 0))
    point = so3.add(point, so3.scale(simplex.trial[1], so3.read_vector(simplex.points, j, 0)))
    point = so3.add(point, so3.scale(simplex.trial[2], so3.read_vector(simplex.points, k, 0)))
    return so3.dot(point, point)


@inlined
def is_outside(simplex, i, j, k, opposite):
    """Return whether the origin is not on the side of face i, j, k where ``opposite`` is."""
    a = so3.read_vector(simplex.points, i, 0)
    normal = so3.cross(
        so3.subtract(so3.read_vector(simplex.points, j, 0), a),
        so3.subtract(so3.read_vector(simplex.points, k, 0), a),
    )
    of_origin = -so3.dot(a, normal)
    of_opposite = so3.dot(so3.subtract(so3.read_vector(simplex.points, opposite, 0), a), normal)
    if of_opposite * of_opposite < _FLAT * so3.dot(normal, normal):
        return True
    return of_origin * of_opposite <= 0.0


@inlined
def witness(simplex):
    """Return the point of A nearest to B, in the frame of A. The point of B is it minus v."""
    return combine(simplex, simplex.on_first)


# Overlap


@outlined
def smallest_overlap(shapes, hint, simplex, a, b, rotation, offset):
    """Return (distance, direction) of two overlapping cores: the distance is negative.

    The distance is the largest separation along any direction, a unit vector from ``b`` to ``a`` in
    the frame of ``a``. The first directions are the axes of both geoms, their products, and the
    line of centres, which is exact for boxes. For other shapes ``b`` is then moved out along the
    best direction, and the direction between the nearest points replaces it, until it improves no
    more. The depth is an upper bound close to the exact depth. Writes the nearest points to
    simplex.points: row 0 of ``a``, row 1 of ``b``.
    """
    best = -math.inf
    chosen = 1.0, 0.0, 0.0
    columns = so3.transpose(rotation)
    for candidate in range(16):
        if candidate < 3:
            axis = unit_vector(candidate)
        elif candidate < 6:
            axis = pick(columns, candidate - 3)
        elif candidate < 15:
            axis = so3.cross(unit_vector((candidate - 6) // 3), pick(columns, (candidate - 6) % 3))
        else:
            axis = offset
        length = so3.norm(axis)
        if length < _SHORT_AXIS:
            continue
        axis = so3.scale(1.0 / length, axis)
        for side in range(2):
            direction = so3.scale(1.0 - 2.0 * side, axis)
            separation = separation_along(shapes, hint, a, b, rotation, offset, direction)
            if separation > best:
                best = separation
                chosen = direction
    on_a = 0.0, 0.0, 0.0
    on_b = 0.0, 0.0, 0.0
    for _ in range(_MAX_TURNS):
        shift = so3.scale(best * (1.0 + _BEYOND_SHARE) - _BEYOND, chosen)
        so3.write_vector(simplex.axis, 0, chosen)
        moved = so3.add(offset, shift)
        distance_bounds(shapes, hint, simplex, a, b, rotation, moved, math.inf, -1.0)
        v = so3.read_vector_at(simplex.axis, 0)
        on_a = witness(simplex)
        on_b = so3.subtract(so3.subtract(on_a, v), shift)
        length = so3.norm(v)
        if length < _SHORT_AXIS * _BEYOND:
            break
        direction = so3.scale(1.0 / length, v)
        separation = separation_along(shapes, hint, a, b, rotation, offset, direction)
        if separation <= best + _SHORT_AXIS * _BEYOND:
            break
        best = separation
        chosen = direction
    so3.write_row(simplex.points, 0, on_a)
    so3.write_row(simplex.points, 1, on_b)
    return best, chosen


@outlined
def separation_along(shapes, hint, a, b, rotation, offset, direction):
    """Return the gap from ``b`` to ``a`` along ``direction``; negative if they overlap there."""
    on_a = support(shapes, hint, a, so3.scale(-1.0, direction))
    on_b = support(shapes, hint, b, so3.apply_inverse(rotation, direction))
    on_b = so3.add(so3.apply(rotation, on_b), offset)
    return so3.dot(direction, so3.subtract(on_a, on_b))


@inlined
def unit_vector(i):
    """Return the unit vector along coordinate ``i``."""
    return 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0


@inlined
def pick(columns, i):
    """Return vector ``i`` of three vectors."""
    return columns[0] if i == 0 else (columns[1] if i == 1 else columns[2])
