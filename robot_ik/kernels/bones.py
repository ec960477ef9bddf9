"""Joints as points and bones, for the geometric methods.

A *point* is the anchor of a joint or the origin of a goal's frame; a *bone* joins a point to the next one
along the chain.  The anchor of a hinge is put nearest to the next point on its axis, so that offsets along
the axis are no bones; under a goal that asks for an orientation nearest to the axis before it, where a
wrist's axes meet.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, forward, frame_pose, perpendicular, rotate_quat, unit
from robot_ik.kernels.residuals import POSE
from robot_ik.kernels.tree import FREE, HINGE, SLIDE
from robot_ik.kernels.vectors import apply, apply_back, cross, dot, length, minus, over, plus, scaled, three

# Where the number of vectors stands in the sums of ``add_aim``, and how many sums there are.
_AIMS, AIM_SUMS = 9, 10

# Points c are the nodes, then the goals g; -1 means none.
BONES = Layout(
    "Bones",
    up="ints c",  # the point before it on its chain
    first="ints c",  # its first child, …
    next="ints c",  # … and the next child of its parent
    through="ints c",  # 1: it looked through a point that it cannot move (``gather_aims``)
    stack="ints c",
    path="ints c",  # points of one chain, root to tip
    hangs="int_table c g",  # 1 where the goal hangs on the node
    now="table c 3",  # where it is
    target="table c 3",  # where it should be
    share="floats c",  # its weight
    shift="floats c",  # how far along its hinge's axis it stands from the node's origin
    length="floats c",  # of the bone that ends in it
    sums=f"table 1 {AIM_SUMS}",  # what a joint aims at, see ``add_aim``: M row by row, number of vectors
    pull="floats 2",  # how much a hinge, and a ball, weighs the goals themselves beside the next points
    kept="table 1 12",  # the pose of a joint before it rotates
    one="ints 1",
)
open_bones = BONES.open


@pure
def has_orientation(goal, g):
    """Whether the goal asks for an orientation as well."""
    return goal.kind[g] == POSE and goal.weight[g, 1] > 0.0


@pure
def attach(bones, c, k):
    """Makes point ``c`` the first child of node ``k``."""
    bones.up[c] = k
    bones.next[c] = bones.first[k]
    bones.first[k] = c
    bones.share[k] += bones.share[c]


@pure
def nearest_to_parent(tree, k):
    """How far along the axis of hinge ``k`` the point nearest to its parent's axis (or anchor) stands."""
    constant, parent = tree.constant, tree.parent[k]
    x, y, z = constant[k, 0], constant[k, 1], constant[k, 2]
    u, v, w = constant[k, 5], constant[k, 8], constant[k, 11]
    if parent < 0:
        return 0.0
    across = u * u + v * v
    if tree.kind[parent] == HINGE and across > 1e-12:
        return -(u * x + v * y) / across
    return -(u * x + v * y + w * z)


@outlined
def link_points(tree, goal, nodes, bones):
    """Links, shares and shifts of all points: once for a goal set."""
    n, constant, local = tree.parent.shape[0], tree.constant, goal.local
    for c in range(bones.up.shape[0]):
        bones.length[c] = 0.0
        bones.up[c] = bones.first[c] = bones.next[c] = -1
        bones.through[c] = 0
        bones.share[c] = bones.shift[c] = 0.0
    for g in range(goal.kind.shape[0] - 1, -1, -1):
        if goal.node[g] >= 0:
            bones.share[n + g] = goal.weight[g, 0] * goal.weight[g, 0]
            attach(bones, n + g, goal.node[g])
    for index in range(nodes.shape[0] - 1, -1, -1):
        k = nodes[index]
        if tree.kind[k] == HINGE:
            along, count, posed = 0.0, 0, False
            c = bones.first[k]
            while c >= 0:
                if c >= n:
                    along += local[c - n, 2]
                    posed = posed or has_orientation(goal, c - n)
                else:
                    along += constant[c, 2] + bones.shift[c] * constant[c, 11]
                count += 1
                c = bones.next[c]
            if posed:
                bones.shift[k] = nearest_to_parent(tree, k)
            elif count > 0:
                bones.shift[k] = along / count
        if tree.parent[k] >= 0:
            attach(bones, k, tree.parent[k])
    for g in range(goal.kind.shape[0]):
        for c in range(bones.up.shape[0]):
            bones.hangs[c, g] = 0
        k = goal.node[g]
        while k >= 0:
            bones.hangs[k, g] = 1
            k = bones.up[k]


@pure
def distance(p, b, q, a):
    """Distance of the points p[b] and q[a]."""
    return length(minus(three(p, b, 0), three(q, a, 0)))


@outlined
def store_pose(world, k, old):
    """old (1, 12) = the pose of node ``k``, before it moves."""
    for i in range(12):
        old[0, i] = world[k, i]


@outlined
def move_with_node(world, k, old, frames, g):
    """Moves frames[g], which hangs on node ``k``, as the node has moved since ``old`` (1, 12).

    What lies between stays as it is: a joint's rotation costs the same however many joints come after it.
    """
    before = apply_back(old, 0, 3, minus(three(frames, g, 0), three(old, 0, 0)))
    frames[g, 0], frames[g, 1], frames[g, 2] = plus(three(world, k, 0), apply(world, k, 3, before))
    for c in range(3, 6):  # the three axes
        before = apply_back(old, 0, 3, (frames[g, c], frames[g, 3 + c], frames[g, 6 + c]))
        frames[g, c], frames[g, 3 + c], frames[g, 6 + c] = apply(world, k, 3, before)


@outlined
def locate(tree, goal, work, bones, c):
    """Pose of point ``c``'s node or frame, and where the point is now; its parent's pose must stand."""
    n, world = tree.parent.shape[0], work.world
    if c < n:
        bones.one[0] = c
        forward(tree, bones.one, work.q, world, work.scratch)
        for i in range(3):
            bones.now[c, i] = world[c, i] + bones.shift[c] * world[c, 5 + 3 * i]
    else:
        frame_pose(world, goal.node[c - n], goal.local, c - n, work.frames)
        for i in range(3):
            bones.now[c, i] = work.frames[c - n, i]


@outlined
def locate_all(tree, goal, work, bones):
    """Where all points are now, and how long the bones are."""
    n, nodes = tree.parent.shape[0], work.nodes
    for index in range(nodes.shape[0] + goal.kind.shape[0]):
        c = nodes[index] if index < nodes.shape[0] else n + index - nodes.shape[0]
        locate(tree, goal, work, bones, c)
        bones.length[c] = distance(bones.now, c, bones.now, bones.up[c]) if bones.up[c] >= 0 else 0.0


@outlined
def chain_path(tree, bones):
    """Points of the one chain that a single goal makes, root to tip, into bones.path[:]; how many.

    ``settle`` uses the column as well.
    """
    count, c = 0, tree.parent.shape[0]
    while c >= 0:
        count += 1
        c = bones.up[c]
    c = tree.parent.shape[0]
    for i in range(count - 1, -1, -1):
        bones.path[i] = c
        c = bones.up[c]
    return count


@pure
def inner_radius(bones, first, end):
    """Nearest that bones ``first`` … ``end`` - 1 of the path bring their two ends together."""
    longest, total = 0.0, 0.0
    for i in range(first, end):
        length = bones.length[bones.path[i]]
        longest = max(longest, length)
        total += length
    return max(0.0, 2.0 * longest - total)


@pure
def third_side_angle(a, c, b):
    """Angle between the sides a and c of the triangle whose third side is b; 0 or π when it cannot close.

    From the tangent of half of it (Kahan): the arccosine would lose half the digits of a flat triangle.
    """
    over = (b - (a - c)) * (b + (a - c))
    under = ((a + c) - b) * ((a + c) + b)
    return 2.0 * math.atan2(math.sqrt(max(0.0, over)), math.sqrt(max(0.0, under)))


# The rotation that brings vectors nearest to their targets, from their 3 x 3 correlation.
# With M = Σ w d pᵀ over vectors p with targets along d, a rotation by φ about a unit axis u gains
# A cos φ + B sin φ, where A = tr M − uᵀ M u and B = u · Σ w p × d (Wang & Chen, IEEE T-RA 7(4), 1991).


@pure
def add_aim(sums, weight, d, p):
    """One more vector p whose target is along d."""
    x, y, z = scaled(weight, d)
    sums[0, 0], sums[0, 1], sums[0, 2] = plus(three(sums, 0, 0), scaled(x, p))
    sums[0, 3], sums[0, 4], sums[0, 5] = plus(three(sums, 0, 3), scaled(y, p))
    sums[0, 6], sums[0, 7], sums[0, 8] = plus(three(sums, 0, 6), scaled(z, p))
    sums[0, _AIMS] += 1.0


@pure
def rotation_terms(sums, u):
    """A, B of the gain A cos φ + B sin φ of a rotation by φ about the unit axis u."""
    return trace_of(sums) - dot(u, apply(sums, 0, 0, u)), dot(u, free_axis(sums))


@pure
def trace_of(sums):
    """tr M."""
    return sums[0, 0] + sums[0, 4] + sums[0, 8]


@pure
def free_axis(sums):
    """Σ w p × d."""
    return sums[0, 7] - sums[0, 5], sums[0, 2] - sums[0, 6], sums[0, 3] - sums[0, 1]


@pure
def best_angle(a, b, low, high):
    """The φ in [low, high] that maximises A cos φ + B sin φ; 0 where nothing depends on it."""
    if a * a + b * b < 1e-24:
        return 0.0
    angle = math.atan2(b, a)
    for candidate in (angle, angle - 2.0 * math.pi, angle + 2.0 * math.pi):
        if low <= candidate <= high:
            return candidate
    at_low = a * math.cos(low) + b * math.sin(low)
    at_high = a * math.cos(high) + b * math.sin(high)
    return low if at_low > at_high else high


@outlined
def rotation_axis(sums):
    """The axis about which a free rotation helps most, not normalised: zero when nothing helps."""
    axis, trace = free_axis(sums), trace_of(sums)
    size = abs(sums[0, 0]) + abs(sums[0, 4]) + abs(sums[0, 8])
    if dot(axis, axis) > 1e-24 * size * size or size == 0.0:
        return axis
    # Aligned, or off by π: then any axis across will do, the coordinate axis most across first.
    gains = sums[0, 0] - trace, sums[0, 4] - trace, sums[0, 8] - trace
    gain = max(gains[0], gains[1], gains[2])
    if not gain > 1e-9 * size:
        return 0.0, 0.0, 0.0
    i = 0 if gains[0] == gain else (1 if gains[1] == gain else 2)
    return plus(over((-sums[0, i], -sums[0, 3 + i], -sums[0, 6 + i]), trace), unit(i))


# One joint's best rotation: how joints follow the targets that a geometric method gives to points.
# ``settle`` rotates the joints, root to tip, each about its real axis and inside its limits, to the exact
# optimum of its own: q is feasible at all times.

# A point nearer to the axis than this, metres, is not moved by a rotation about it.
_NO_LEVER = 1e-6
# Rotations of a ball with several points to serve, and where they end, rad.
_BALL_TURNS, _STILL = 12, 1e-10


@pure
def offset(place, c, bones, k):
    """Where ``place`` (now or target) has point ``c``, seen from where point ``k`` is now."""
    return minus(three(place, c, 0), three(bones.now, k, 0))


@outlined
def add_point(bones, k, c):
    """Point ``c`` and its target, seen from point ``k``."""
    add_aim(bones.sums, bones.share[c], offset(bones.target, c, bones, k), offset(bones.now, c, bones, k))


@pure
def add_columns(goal, frames, sums, share, g):
    """The axes of goal ``g``'s frame have those of its target for targets."""
    target, w = goal.target, share * goal.weight[g, 1] * goal.weight[g, 1]
    for i in range(3, 6):
        wanted = target[g, i], target[g, i + 3], target[g, i + 6]
        add_aim(sums, w, wanted, (frames[g, i], frames[g, i + 3], frames[g, i + 6]))


@pure
def hinge_axis(world, k):
    """World axis of hinge or slide ``k``."""
    return world[k, 5], world[k, 8], world[k, 11]


@pure
def lever(world, bones, kind, k, c):
    """Distance of point ``c`` from the axis of hinge ``k``, or from the centre of ball ``k``."""
    away = offset(bones.now, c, bones, k)
    along = dot(away, hinge_axis(world, k)) if kind == HINGE else 0.0
    return math.sqrt(max(0.0, dot(away, away) - along * along))


@outlined
def side_off_line(tree, world, p, c, line):
    """To which side a bone leaves the line it lies on: where the hinge at ``p``, or at ``c``, can go."""
    for k in (p, c):
        if k < tree.parent.shape[0] and tree.kind[k] == HINGE:
            off = cross(hinge_axis(world, k), line)
            norm = length(off)
            if norm > 1e-6:
                return over(off, norm)
    return perpendicular(line)


@outlined
def gather_aims(tree, goal, work, bones, k):
    """Into ``sums``, what joint ``k`` should aim at: the next points that it moves.

    A point that it cannot move, because their anchors coincide or it lies on the axis, is looked
    through to the ones behind it (bones.through[k]).
    """
    n = tree.parent.shape[0]
    bones.sums[:] = 0.0
    bones.through[k] = 0
    depth, c = 0, bones.first[k]
    while c >= 0 or depth > 0:
        if c < 0:
            depth -= 1
            c = bones.next[bones.stack[depth]]
            continue
        down = False
        if bones.share[c] > 0.0:
            locate(tree, goal, work, bones, c)
            if c >= n and has_orientation(goal, c - n):
                add_columns(goal, work.frames, bones.sums, 1.0, c - n)
            elif lever(work.world, bones, tree.kind[k], k, c) > _NO_LEVER:
                add_point(bones, k, c)
            else:
                down = c < n
        if down:
            bones.through[k] = 1
            bones.stack[depth] = c
            depth += 1
            c = bones.first[c]
        else:
            c = bones.next[c]


@outlined
def add_goals(tree, goal, work, bones, k, pull):
    """Adds to ``sums`` the goals that hang on joint ``k``, as they would be if later joints stayed.

    A bone's target contains no error across the bone, which a ball can take out and a hinge cannot:
    without this, hinges whose axes are not parallel wait for each other.
    """
    n = tree.parent.shape[0]
    for g in range(goal.kind.shape[0]):
        if bones.share[n + g] <= 0.0 or bones.hangs[k, g] == 0:
            continue
        count = bones.sums[0, _AIMS]
        wanted, here = offset(goal.target, g, bones, k), offset(work.frames, g, bones, k)
        add_aim(bones.sums, pull * bones.share[n + g], wanted, here)
        if has_orientation(goal, g):
            add_columns(goal, work.frames, bones.sums, pull, g)
        bones.sums[0, _AIMS] = count


@outlined
def relocate(tree, goal, work, bones, k):
    """Where joint ``k`` is after a rotation; the frames of all goals that hang on it come along."""
    store_pose(work.world, k, bones.kept)
    locate(tree, goal, work, bones, k)
    for g in range(goal.kind.shape[0]):
        if bones.hangs[k, g] == 1:
            move_with_node(work.world, k, bones.kept, work.frames, g)


@outlined
def rotate_ball(tree, work, k, a, axis, angle):
    """Rotates the ball whose quaternion starts at q[a] by ``angle`` about a world axis."""
    x, y, z = scaled(angle, apply_back(work.world, k, 3, axis))
    rotate_quat(work.q, a, x, y, z)


@outlined
def aim_ball(tree, goal, work, bones, k, a):
    """Rotates ball ``k`` freely to its optimum; returns the total angle."""
    total = 0.0
    for _ in range(_BALL_TURNS):
        gather_aims(tree, goal, work, bones, k)
        if bones.pull[1] > 0.0:
            add_goals(tree, goal, work, bones, k, bones.pull[1])
        axis = rotation_axis(bones.sums)
        norm = length(axis)
        if norm == 0.0:
            break
        axis = over(axis, norm)
        ta, tb = rotation_terms(bones.sums, axis)
        angle = best_angle(ta, tb, -math.pi, math.pi)
        rotate_ball(tree, work, k, a, axis, angle)
        relocate(tree, goal, work, bones, k)
        total += abs(angle)
        if abs(angle) < _STILL or (bones.sums[0, _AIMS] < 2.0 and bones.pull[1] == 0.0):
            break
    return total


@outlined
def twist_ball(tree, goal, work, bones, k, a, cone):
    """Twists ball ``k`` about its bone, inside its cone, so that a hinge at the other end can do its work."""
    c, q = bones.first[k], work.q
    if c < 0 or c >= tree.parent.shape[0] or bones.next[c] >= 0 or tree.kind[c] != HINGE:
        return
    locate(tree, goal, work, bones, c)
    bone = offset(bones.now, c, bones, k)
    norm = length(bone)
    if norm < _NO_LEVER:
        return
    bone = over(bone, norm)
    bones.sums[:] = 0.0
    child = bones.first[c]
    while child >= 0:
        if bones.share[child] > 0.0:
            locate(tree, goal, work, bones, child)
            add_point(bones, k, child)
        child = bones.next[child]
    low, high = -math.pi, math.pi
    if cone < math.pi:
        # After a twist φ the scalar part is r cos(φ/2 + δ): inside the cone while that is large enough.
        s = dot(apply_back(work.world, k, 3, bone), (q[a + 1], q[a + 2], q[a + 3]))
        sign = -1.0 if q[a] < 0.0 else 1.0
        r = math.sqrt(q[a] * q[a] + s * s)
        half = 2.0 * math.acos(min(1.0, math.cos(0.5 * cone) / max(r, 1e-12)))
        middle = -2.0 * math.atan2(sign * s, sign * q[a])
        low, high = min(middle - half, 0.0), max(middle + half, 0.0)
    ta, tb = rotation_terms(bones.sums, bone)
    rotate_ball(tree, work, k, a, bone, best_angle(ta, tb, low, high))


@outlined
def fit_ball(tree, goal, work, bones, k):
    """The best rotation of ball (or floating) joint ``k`` inside its cone; returns its angle."""
    q, free = work.q, tree.kind[k] == FREE
    a = tree.qadr[k] + (3 if free else 0)
    cone = math.pi if free else min(tree.upper[tree.vadr[k]], math.pi)
    limit = math.cos(0.5 * cone)
    total = aim_ball(tree, goal, work, bones, k, a)
    if cone < math.pi and abs(q[a]) < limit:
        # The shortest way from where it was leaves the cone; the shortest from the middle leaves it last.
        q[a], q[a + 1], q[a + 2], q[a + 3] = 1.0, 0.0, 0.0, 0.0
        relocate(tree, goal, work, bones, k)
        aim_ball(tree, goal, work, bones, k, a)
        bones.one[0] = k
        clip(tree, bones.one, q)
        relocate(tree, goal, work, bones, k)
    twist_ball(tree, goal, work, bones, k, a, cone)
    if cone < math.pi:
        bones.one[0] = k
        clip(tree, bones.one, q)
    return total


@outlined
def fit_joint(tree, goal, work, bones, k):
    """Rotates or shifts joint ``k`` to its optimum inside its limits; returns how far it went, rad or m."""
    q, world, a, v, kind = work.q, work.world, tree.qadr[k], tree.vadr[k], tree.kind[k]
    locate(tree, goal, work, bones, k)
    gone = 0.0
    if kind == HINGE:
        gather_aims(tree, goal, work, bones, k)
        if bones.pull[0] > 0.0:
            add_goals(tree, goal, work, bones, k, bones.pull[0])
        ta, tb = rotation_terms(bones.sums, hinge_axis(world, k))
        gone = best_angle(ta, tb, tree.lower[v] - q[a], tree.upper[v] - q[a])
        q[a] = min(max(q[a] + gone, tree.lower[v]), tree.upper[v])
    elif kind == SLIDE:
        bones.through[k] = 0
        gone = dot(hinge_axis(world, k), offset(bones.target, k, bones, k))
        q[a] = min(max(q[a] + gone, tree.lower[v]), tree.upper[v])
    else:
        if kind == FREE:
            for i in range(3):
                q[a + i] += bones.target[k, i] - bones.now[k, i]
            relocate(tree, goal, work, bones, k)
        gone = fit_ball(tree, goal, work, bones, k)
    relocate(tree, goal, work, bones, k)
    return abs(gone)


@outlined
def settle(tree, goal, work, bones, sweeps):
    """Brings the points towards their targets: every joint once, root to tip, to its own optimum.

    Joints that aim at the same point (anchors that coincide, or axes that meet) are gone over
    ``sweeps`` times, because together they do what none of them can do alone.
    """
    for index in range(work.nodes.shape[0]):
        k = work.nodes[index]
        if bones.share[k] <= 0.0:
            continue
        fit_joint(tree, goal, work, bones, k)
        if bones.through[k] != 0:
            continue
        size, head = 1, k
        bones.path[0] = k
        while bones.up[head] >= 0:
            above = bones.up[head]
            if bones.through[above] == 0 or bones.next[bones.first[above]] >= 0:
                break
            head = above
            bones.path[size] = head
            size += 1
        if size == 1:
            continue
        for _ in range(sweeps - 1):
            total = 0.0
            for back in range(size - 1, -1, -1):
                total += fit_joint(tree, goal, work, bones, bones.path[back])
            if total < _STILL:
                break
