"""Collision checks: filters from coarse to fine, then exact distances.

Each check looks at pairs of links first, then at pairs of geoms:

    capsule against capsule of two links         or against a fixed box or plane
    ball against ball of two geoms               or against the box or plane
    exact distance (``gjk.py``)

A filter removes only pairs that are farther apart than the reach. Each call of ``next_pair``
returns one of the remaining pairs. A pair is free if the *lower* bound of its distance exceeds the
margin. Within rounding of contact the bounds do not agree. The verdict is then UNDECIDED, and
MuJoCo decides.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels import so3
from robot_ik.kernels.block import Layout
from robot_ik.kernels.gjk import SIMPLEX, distance_bounds, smallest_overlap, witness
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import compose, forward, slope_of, velocity_of, width_of
from robot_ik.kernels.shapes import (
    BOX,
    PLANE,
    SHAPES,
    height_over_plane,
    point_to_box,
    segment_gap,
    support,
)
from robot_ik.kernels.tree import TREE

# Verdicts.
FREE, TOUCHING, UNDECIDED = range(3)

# Cores that seem to overlap by less than this, m, may be apart by rounding.
_SURE_OVERLAP = 1e-3
# A capsule is compared with a box by this many balls at most.
_MAX_BALLS = 4
# Distances are exact to this, m.
_ROUNDING = 1e-9

# With k pairs of links, p pairs of geoms.
PAIRS = Layout(
    "Pairs",
    links="int_table",  # (k, 2) if one of them is fixed, it is the second
    start="ints",  # (k + 1,) first pair of geoms of each pair of links
    geoms="int_table",  # (p, 2) in the order of the links
    below="int_table",  # (k, 2) of each link: its first node below the common ancestor, or -1
)

# With nq, nv, n nodes, g geoms, l links, k pairs of links, p pairs of geoms, r near pairs.
CHECK = Layout(
    "Check",
    now="int",  # number of the current check
    link_pair="int",  # the scan: pair of links, pair of geoms, end of the pairs of geoms
    pair="int",
    pair_end="int",
    last_hit="int",  # pair of geoms that touched last + 1; 0 for none
    last_nearest="int",  # pair of geoms that was the nearest last + 1; 0 for none
    near_count="int",
    nearest_distance="float",  # smallest distance of the near pairs
    q="floats nq",
    world="table n 12",
    scratch="table 2 12",
    ends="table l 6",  # ends of each link's capsule
    middle="table l 3",  # and its centre
    poses="table g 12",  # of the geoms that were needed
    placed="ints l",  # number of the check that placed the link's geoms
    hint="ints g",  # see ``shapes.support``
    axis="table p 3",  # last separating axis of each pair, in the frame of its first geom
    motion="floats k",  # distance that a pair of links may approach, beside the margin
    point_a="floats 3",  # nearest points of the last measured pair, world
    point_b="floats 3",
    normal="floats 3",  # from b to a
    near_pair="ints r",
    near_distance="floats r",
    near_rows="table r nv",  # change of each distance per unit of each degree of freedom
    simplex=SIMPLEX,
)

RUN = Layout("CollisionRun", tree=TREE, shapes=SHAPES, pairs=PAIRS, check=CHECK)
open_run = RUN.open


# Filters


@outlined
def begin_check(run, q):
    """Place all links at ``q`` (nq,), and begin a scan."""
    check = run.check
    shapes = run.shapes
    for i in range(q.shape[0]):
        check.q[i] = q[i]
    forward(run.tree, run.tree.every, q, check.world, check.scratch)
    for link in range(shapes.node.shape[0]):
        node = shapes.node[link]
        first = so3.read_vector(shapes.capsule, link, 0)
        last = so3.read_vector(shapes.capsule, link, 3)
        if node >= 0:
            rotation = so3.read_rotation(check.world, node)
            origin = so3.read_vector(check.world, node, 0)
            first = so3.add(origin, so3.apply(rotation, first))
            last = so3.add(origin, so3.apply(rotation, last))
        write_vector_at(check.ends, link, 0, first)
        write_vector_at(check.ends, link, 3, last)
        so3.write_row(check.middle, link, so3.scale(0.5, so3.add(first, last)))
    check.now += 1
    restart_scan(check, -1)


@inlined
def write_vector_at(table, row, column, a):
    """Write a vector to three numbers of a table row."""
    table[row, column] = a[0]
    table[row, column + 1] = a[1]
    table[row, column + 2] = a[2]


@inlined
def restart_scan(check, link_pair):
    """Begin a scan after a pair of links."""
    check.link_pair = link_pair
    check.pair = 0
    check.pair_end = 0


@outlined
def next_pair(run, bound):
    """Return the next pair of geoms that may be nearer than ``bound``, or -1 at the end.

    The bound of each pair of links is ``bound`` + check.motion.
    """
    check = run.check
    pairs = run.pairs
    while True:
        while check.pair < check.pair_end:
            pair = check.pair
            check.pair += 1
            if balls_are_near(run, pair, bound + check.motion[check.link_pair]):
                return pair
        if check.link_pair + 1 >= pairs.links.shape[0]:
            return -1
        check.link_pair += 1
        k = check.link_pair
        a = pairs.links[k, 0]
        b = pairs.links[k, 1]
        if links_are_near(run.shapes, check, a, b, bound + check.motion[k]):
            place_geoms(run.shapes, check, a)
            place_geoms(run.shapes, check, b)
            check.pair = pairs.start[k]
            check.pair_end = pairs.start[k + 1]


@inlined
def links_are_near(shapes, check, a, b, bound):
    """Return whether two links may be nearer than ``bound``."""
    offset = so3.subtract(so3.read_vector(check.middle, a, 0), so3.read_vector(check.middle, b, 0))
    reach = shapes.capsule[a, 7] + shapes.capsule[b, 7] + bound
    if so3.dot(offset, offset) >= reach * reach:
        return False
    first = so3.read_vector(check.ends, a, 0)
    last = so3.read_vector(check.ends, a, 3)
    reach = shapes.capsule[a, 6] + bound
    box = shapes.box[b]
    if box >= 0:
        if shapes.kind[box] == PLANE:
            height = min(
                height_over_plane(shapes.local, box, first),
                height_over_plane(shapes.local, box, last),
            )
            return height < reach
        return capsule_is_near_box(shapes, box, first, last, reach)
    reach += shapes.capsule[b, 6]
    other_first = so3.read_vector(check.ends, b, 0)
    other_last = so3.read_vector(check.ends, b, 3)
    return segment_gap(first, other_first, last, other_last) < reach * reach and reach > 0.0


@inlined
def capsule_is_near_box(shapes, box, first, last, reach):
    """Return whether a capsule may be nearer to a box than its radius + bound = ``reach``."""
    along = so3.subtract(last, first)
    length = so3.norm(along)
    count = min(int(length / max(reach, 1e-6)) + 1, _MAX_BALLS)
    radius = reach + 0.5 * length / count
    for i in range(count):
        center = so3.add(first, so3.scale((i + 0.5) / count, along))
        if point_to_box(shapes, shapes.local, box, center) < radius * radius:
            return True
    return False


@outlined
def place_geoms(shapes, check, link):
    """Write the world poses of the geoms of a link, once for each check."""
    if check.placed[link] == check.now:
        return
    check.placed[link] = check.now
    node = shapes.node[link]
    for g in range(shapes.geom_start[link], shapes.geom_start[link + 1]):
        if node >= 0:
            compose(check.world, node, shapes.local, g, check.poses, g)
        else:
            for i in range(12):
                check.poses[g, i] = shapes.local[g, i]


@inlined
def place_pair(run, pair):
    """Write the world poses of the links of two geoms."""
    for side in range(2):
        place_geoms(run.shapes, run.check, run.shapes.link[run.pairs.geoms[pair, side]])


@inlined
def balls_are_near(run, pair, bound):
    """Return whether two geoms may be nearer than ``bound``."""
    shapes = run.shapes
    poses = run.check.poses
    a = run.pairs.geoms[pair, 0]
    b = run.pairs.geoms[pair, 1]
    center = so3.read_vector(poses, a, 0)
    reach = shapes.ball[a] + bound
    kind = shapes.kind[b]
    if kind == PLANE:
        return height_over_plane(poses, b, center) < reach
    if kind == BOX:
        return point_to_box(shapes, poses, b, center) < reach * reach
    reach += shapes.ball[b]
    offset = so3.subtract(center, so3.read_vector(poses, b, 0))
    return so3.dot(offset, offset) < reach * reach


# Exact distances


@outlined
def pair_bounds(run, pair, stop_above, stop_below):
    """Return (lower, upper, overlap) of the distance of two placed geoms.

    Args:
        run: Block of ``RUN``.
        pair: Pair of geoms.
        stop_above: The search ends when the lower bound exceeds this distance.
        stop_below: The search ends when the upper bound is below this distance; -1: never.
    """
    shapes = run.shapes
    check = run.check
    poses = check.poses
    a = run.pairs.geoms[pair, 0]
    b = run.pairs.geoms[pair, 1]
    rotation_a = so3.read_rotation(poses, a)
    if shapes.kind[b] == PLANE:
        normal = so3.z_axis(so3.read_rotation(poses, b))
        below = support(
            shapes, check.hint, a, so3.apply_inverse(rotation_a, so3.scale(-1.0, normal))
        )
        point = so3.add(so3.apply(rotation_a, below), so3.read_vector(poses, a, 0))
        height = height_over_plane(poses, b, point)
        distance = height - shapes.rounding[a]
        so3.write_vector(check.normal, 0, normal)
        so3.write_vector(check.point_b, 0, so3.subtract(point, so3.scale(height, normal)))
        so3.write_vector(
            check.point_a, 0, so3.subtract(point, so3.scale(shapes.rounding[a], normal))
        )
        return distance, distance, False
    offset = so3.subtract(so3.read_vector(poses, b, 0), so3.read_vector(poses, a, 0))
    rotation = relative_rotation(rotation_a, so3.read_rotation(poses, b))
    rounding = shapes.rounding[a] + shapes.rounding[b]
    simplex = check.simplex
    so3.write_vector(simplex.axis, 0, so3.read_vector(check.axis, pair, 0))
    lower, upper, overlap = distance_bounds(
        shapes,
        check.hint,
        simplex,
        a,
        b,
        rotation,
        so3.apply_inverse(rotation_a, offset),
        stop_above + rounding,
        stop_below + rounding,
    )
    so3.write_row(check.axis, pair, so3.read_vector_at(simplex.axis, 0))
    return lower - rounding, upper - rounding, overlap


@inlined
def relative_rotation(first, second):
    """Return Rᵀ S of two rotations."""
    x, y, z = so3.transpose(second)
    columns = (
        so3.apply_inverse(first, x),
        so3.apply_inverse(first, y),
        so3.apply_inverse(first, z),
    )
    return so3.transpose(columns)


@outlined
def pair_verdict(run, pair, margin):
    """Return whether two placed geoms are FREE (farther apart than the margin) or not."""
    lower, upper, overlap = pair_bounds(run, pair, margin, margin)
    if lower > margin:
        return FREE
    if not overlap:
        return TOUCHING if upper <= margin else UNDECIDED
    geoms = run.pairs.geoms
    rounding = run.shapes.rounding[geoms[pair, 0]] + run.shapes.rounding[geoms[pair, 1]]
    sure = margin + rounding > _SURE_OVERLAP or lower + rounding < -_SURE_OVERLAP
    return TOUCHING if sure else UNDECIDED


@outlined
def verdict(run, q, margin):
    """Return FREE if all pairs are farther apart than ``margin`` at ``q``, else TOUCHING.

    UNDECIDED: no pair certainly touches, but one is within rounding of contact. In this case
    check.last_hit does not change.
    """
    check = run.check
    begin_check(run, q)
    if check.last_hit > 0:
        # In successive postures often the same pair touches.
        pair = check.last_hit - 1
        place_pair(run, pair)
        if balls_are_near(run, pair, margin) and pair_verdict(run, pair, margin) == TOUCHING:
            return TOUCHING
    undecided = False
    while True:
        pair = next_pair(run, margin)
        if pair < 0:
            return UNDECIDED if undecided else FREE
        state = pair_verdict(run, pair, margin)
        if state == TOUCHING:
            check.last_hit = pair + 1
            return TOUCHING
        undecided = undecided or state == UNDECIDED


@outlined
def smallest_distance(run, q, reach):
    """Return (distance, pair) of the nearest pair at ``q``; (reach, -1) if all are farther.

    The distance of a pair that touches is 0 or less. It is not the depth.
    """
    check = run.check
    begin_check(run, q)
    nearest_distance = reach
    nearest = -1
    if check.last_nearest > 0:
        # With a small first distance most other pairs need no exact distance.
        pair = check.last_nearest - 1
        place_pair(run, pair)
        if balls_are_near(run, pair, nearest_distance):
            distance = lower_distance(run, pair, nearest_distance)
            if distance < nearest_distance:
                nearest_distance = distance
                nearest = pair
    while True:
        pair = next_pair(run, nearest_distance)
        if pair < 0:
            check.last_nearest = nearest + 1
            return nearest_distance, nearest
        distance = lower_distance(run, pair, nearest_distance)
        if distance < nearest_distance:
            nearest_distance = distance
            nearest = pair


@inlined
def lower_distance(run, pair, stop_above):
    """Return a lower bound of a distance; 0 or less for a pair that touches.

    The bound is exact up to ``stop_above``.
    """
    lower, _, overlap = pair_bounds(run, pair, stop_above, -1.0)
    return min(lower, 0.0) if overlap else lower


# Near pairs with their gradients


@outlined
def list_near(run, q, reach):
    """Write all pairs nearer than ``reach`` at ``q`` to the arrays of near pairs in ``run.check``.

    Writes near_pair, near_distance, near_rows and nearest_distance.

    If there are too many, the nearest are kept.
    """
    check = run.check
    begin_check(run, q)
    check.near_count = 0
    check.nearest_distance = reach
    capacity = check.near_pair.shape[0]
    while True:
        pair = next_pair(run, reach)
        if pair < 0:
            return
        lower, upper, overlap = pair_bounds(run, pair, reach, -1.0)
        if lower > reach:
            continue
        distance = write_witness(run, pair, upper, overlap)
        check.nearest_distance = min(check.nearest_distance, distance)
        slot = check.near_count
        if slot == capacity:
            slot = 0
            for i in range(1, capacity):
                if check.near_distance[i] > check.near_distance[slot]:
                    slot = i
            if check.near_distance[slot] <= distance:
                continue
        else:
            check.near_count += 1
        check.near_pair[slot] = pair
        check.near_distance[slot] = distance
        write_gradient(run, pair, slot)


@outlined
def write_witness(run, pair, upper, overlap):
    """Write the nearest points and the normal of the pair measured last; return its distance."""
    shapes = run.shapes
    check = run.check
    simplex = check.simplex
    poses = check.poses
    a = run.pairs.geoms[pair, 0]
    b = run.pairs.geoms[pair, 1]
    if shapes.kind[b] == PLANE:
        return upper
    rotation_a = so3.read_rotation(poses, a)
    origin = so3.read_vector(poses, a, 0)
    distance = upper
    if overlap:
        offset = so3.subtract(so3.read_vector(poses, b, 0), origin)
        rotation = relative_rotation(rotation_a, so3.read_rotation(poses, b))
        offset = so3.apply_inverse(rotation_a, offset)
        separation, normal = smallest_overlap(shapes, check.hint, simplex, a, b, rotation, offset)
        distance = separation - shapes.rounding[a] - shapes.rounding[b]
        on_a = so3.read_vector(simplex.points, 0, 0)
        on_b = so3.read_vector(simplex.points, 1, 0)
    else:
        v = so3.read_vector_at(simplex.axis, 0)
        on_a = witness(simplex)
        on_b = so3.subtract(on_a, v)
        normal = so3.scale(1.0 / max(so3.norm(v), 1e-300), v)
    on_a = so3.subtract(on_a, so3.scale(shapes.rounding[a], normal))
    on_b = so3.add(on_b, so3.scale(shapes.rounding[b], normal))
    so3.write_vector(check.normal, 0, so3.apply(rotation_a, normal))
    so3.write_vector(check.point_a, 0, so3.add(origin, so3.apply(rotation_a, on_a)))
    so3.write_vector(check.point_b, 0, so3.add(origin, so3.apply(rotation_a, on_b)))
    return distance


@outlined
def write_gradient(run, pair, slot):
    """Write the change of a pair's distance per unit of each degree of freedom.

    A coupled joint has no column: its motion is added to the column of its leader.
    """
    tree = run.tree
    check = run.check
    row = check.near_rows
    for v in range(row.shape[1]):
        row[slot, v] = 0.0
    normal = so3.read_vector_at(check.normal, 0)
    for side in range(2):
        sign = 1.0 - 2.0 * side
        point = so3.read_vector_at(check.point_a if side == 0 else check.point_b, 0)
        node = run.shapes.node[run.shapes.link[run.pairs.geoms[pair, side]]]
        while node >= 0:
            first = tree.vadr[node]
            for v in range(first, first + width_of(tree.kind[node])):
                velocity, _ = velocity_of(tree, check.world, v, point)
                row[slot, v] += sign * so3.dot(normal, velocity)
            node = tree.parent[node]
    for c in range(tree.coupled.shape[0]):
        follower = tree.vadr[tree.coupled[c, 0]]
        if tree.coupled[c, 1] >= 0:
            leader = tree.vadr[tree.coupled[c, 1]]
            row[slot, leader] += slope_of(tree, c, check.q) * row[slot, follower]
        row[slot, follower] = 0.0


# Entry points


@kernel
def near_pairs(address, q, reach):
    """Run ``list_near``."""
    list_near(open_run(address), q, reach)


@kernel
def posture_verdict(address, q, margin):
    """Return the verdict of one posture ``q`` (nq,)."""
    return verdict(open_run(address), q, margin)


@kernel
def verdicts(address, q, margin, out):
    """Write the verdict of each row of ``q`` (n, nq) to ``out`` (n,)."""
    run = open_run(address)
    for row in range(q.shape[0]):
        out[row] = verdict(run, q[row], margin)


@kernel
def smallest_distances(address, q, reach, out, nearest):
    """Write the distance and pair of the nearest pair of each row of ``q`` (n, nq)."""
    run = open_run(address)
    for row in range(q.shape[0]):
        out[row], nearest[row] = smallest_distance(run, q[row], reach)


@kernel
def bounds_of_pair(address, q, pair, stop_above, out):
    """Write (lower, upper, overlap) of the distance of one pair at ``q`` to ``out`` (3,)."""
    run = open_run(address)
    begin_check(run, q)
    place_pair(run, pair)
    out[0], out[1], overlap = pair_bounds(run, pair, stop_above, -1.0)
    out[2] = 1.0 if overlap else 0.0
