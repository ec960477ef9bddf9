"""Joints as points and bones, for the geometric methods.

A *point* is the anchor of a joint or the origin of a goal's frame. A *bone* joins a point to the
next point of its chain. The anchor of a hinge may be anywhere on its axis. It is placed nearest to
the next point, so that an offset along the axis is not a bone. For a goal with an orientation it is
placed nearest to the previous axis, where the axes of a wrist meet.

A geometric method gives targets to the points. ``settle`` then makes the joints follow: it rotates
each joint about its axis to its optimum inside its limits, from the root to the tip. So q is
feasible at all times.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import so3
from robot_ik.kernels.alignment import (
    NO_VECTORS,
    add_axes,
    add_vector,
    best_angle,
    best_axis,
    rotation_terms,
)
from robot_ik.kernels.block import Layout
from robot_ik.kernels.frame_goals import ALL_AXES
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.kernels.kinematics import clip, forward, frame_pose, rotate_quat
from robot_ik.kernels.tree import FREE, HINGE, SLIDE

# A hinge whose axis makes a smaller angle with the axis of its parent is parallel to it: the
# square of the sine.
_PARALLEL = 1e-12
# A rotation does not move a point that is nearer to the axis than this, in metres.
_NO_LEVER = 1e-6
# The smallest sine between a line and the axis of a hinge that can leave the line.
_MIN_SINE = 1e-6
# Rotations that bring a ball with several points to its optimum, and the angle that ends them, rad.
_BALL_ROTATIONS = 12
_STILL = 1e-10
# The smallest divisor in ``twist_range``.
_SMALL = 1e-12

# With c points: the n nodes of the tree, then the g goals. -1 means no point.
BONES = Layout(
    "Bones",
    reduced="bool",  # ``search.reduced`` for which the shares were written
    hinge_pull="float",  # weight of the goals themselves beside the next points, for a hinge
    ball_pull="float",  # the same for a ball
    parent="ints c",  # the previous point of the chain
    child="ints c",  # the first point after it
    sibling="ints c",  # the next point after the same parent
    skips_point="ints c",  # 1 if the joint cannot move a child and aims at the points after it
    stack="ints c",
    path="ints c",  # points of one chain, from root to tip
    group="ints c",  # joints that aim at the same points, from tip to root
    carries="int_table c g",  # 1 if the node moves the goal
    point="table c 3",  # position, world, m
    target="table c 3",  # target position, world, m
    share="floats c",  # weight
    shift="floats c",  # from the node's origin to the point, along the axis of the hinge
    length="floats c",  # of the bone that ends in the point
    node="ints 1",  # list of nodes for the forward pass of one joint
)


# Points


@inlined
def has_orientation(goals, search, g):
    """Return whether the orientation of goal ``g`` counts."""
    return goals.orientation_part[g] == ALL_AXES and search.weight[g, 1] > 0.0


@inlined
def offset(table, c, bones, k):
    """Return the vector from point ``k`` to row ``c`` of a table of points."""
    return so3.subtract(so3.read_vector(table, c, 0), so3.read_vector(bones.point, k, 0))


@inlined
def distance(table, c, bones, k):
    """Return the distance of row ``c`` of a table of points from point ``k``."""
    return so3.norm(offset(table, c, bones, k))


@inlined
def joint_axis(world, k):
    """Return the world axis of hinge or slide ``k``."""
    return so3.z_axis(so3.read_rotation(world, k))


@outlined
def link_points(tree, goals, search, bones):
    """Write parents, shares and shifts of all points, for the goals that count now."""
    bones.reduced = search.reduced
    clear_links(goals, bones)
    nodes = tree.parent.shape[0]
    for g in range(goals.row.shape[0] - 1, -1, -1):
        if goals.node[g] >= 0:
            bones.share[nodes + g] = search.weight[g, 0] * search.weight[g, 0]
            attach(bones, nodes + g, goals.node[g])
    for index in range(goals.nodes.shape[0] - 1, -1, -1):
        k = goals.nodes[index]
        if tree.kind[k] == HINGE:
            bones.shift[k] = hinge_shift(tree, goals, search, bones, k)
        if tree.parent[k] >= 0:
            attach(bones, k, tree.parent[k])
    for g in range(goals.row.shape[0]):
        k = goals.node[g]
        while k >= 0:
            bones.carries[k, g] = 1
            k = bones.parent[k]


@inlined
def clear_links(goals, bones):
    """Remove the links between all points, and their shares, lengths and shifts."""
    for c in range(bones.parent.shape[0]):
        bones.parent[c] = -1
        bones.child[c] = -1
        bones.sibling[c] = -1
        bones.skips_point[c] = 0
        bones.length[c] = 0.0
        bones.share[c] = 0.0
        bones.shift[c] = 0.0
        for g in range(goals.row.shape[0]):
            bones.carries[c, g] = 0


@outlined
def attach(bones, c, k):
    """Make point ``c`` the first child of node ``k``."""
    bones.parent[c] = k
    bones.sibling[c] = bones.child[k]
    bones.child[k] = c
    bones.share[k] += bones.share[c]


@inlined
def hinge_shift(tree, goals, search, bones, k):
    """Return the shift of the point of hinge ``k`` along its axis, m."""
    nodes = tree.parent.shape[0]
    total = 0.0
    count = 0
    c = bones.child[k]
    while c >= 0:
        if c < nodes:
            total += tree.constant[c, 2] + bones.shift[c] * tree.constant[c, 11]
        elif has_orientation(goals, search, c - nodes):
            return nearest_to_parent(tree, k)
        else:
            total += goals.local[c - nodes, 2]
        count += 1
        c = bones.sibling[c]
    return total / count if count > 0 else 0.0


@inlined
def nearest_to_parent(tree, k):
    """Return the shift of hinge ``k`` to the point nearest to its parent's axis or anchor."""
    parent = tree.parent[k]
    if parent < 0:
        return 0.0
    origin = so3.read_vector(tree.constant, k, 0)
    axis = joint_axis(tree.constant, k)
    square = axis[0] * axis[0] + axis[1] * axis[1]
    if tree.kind[parent] == HINGE and square > _PARALLEL:
        return -(axis[0] * origin[0] + axis[1] * origin[1]) / square
    return -so3.dot(axis, origin)


@outlined
def locate(tree, goals, search, bones, c):
    """Write the pose and the position of point ``c``. The pose of its parent must be known."""
    nodes = tree.parent.shape[0]
    if c < nodes:
        bones.node[0] = c
        forward(tree, bones.node, search.q, search.world, search.scratch)
        shift = so3.scale(bones.shift[c], joint_axis(search.world, c))
        point = so3.add(so3.read_vector(search.world, c, 0), shift)
    else:
        g = c - nodes
        frame_pose(search.world, goals.node[g], goals.local, g, search.frames)
        point = so3.read_vector(search.frames, g, 0)
    so3.write_row(bones.point, c, point)


@outlined
def locate_all(tree, goals, search, bones):
    """Write the position of each point, and the length of each bone."""
    nodes = tree.parent.shape[0]
    joints = goals.nodes.shape[0]
    for index in range(joints + goals.row.shape[0]):
        c = goals.nodes[index] if index < joints else nodes + index - joints
        locate(tree, goals, search, bones, c)
        parent = bones.parent[c]
        bones.length[c] = distance(bones.point, c, bones, parent) if parent >= 0 else 0.0


@outlined
def find_path(tree, bones):
    """Write the points of the chain of a single goal to ``bones.path``; return their number."""
    tip = tree.parent.shape[0]
    count = 0
    c = tip
    while c >= 0:
        count += 1
        c = bones.parent[c]
    c = tip
    for i in range(count - 1, -1, -1):
        bones.path[i] = c
        c = bones.parent[c]
    return count


# Triangles of bones


@outlined
def inner_radius(bones, first, end):
    """Return the smallest distance between the ends of bones first … end − 1 of the path."""
    longest = 0.0
    total = 0.0
    for i in range(first, end):
        length = bones.length[bones.path[i]]
        longest = max(longest, length)
        total += length
    return max(0.0, 2.0 * longest - total)


@outlined
def triangle_angle(a, c, b):
    """Return the angle between the sides a and c of a triangle with the third side b.

    Returns 0 or π if the triangle cannot close. The formula is Kahan's for the tangent of half the
    angle. The arccosine would lose half of the digits of a flat triangle.
    """
    numerator = (b - (a - c)) * (b + (a - c))
    denominator = ((a + c) - b) * ((a + c) + b)
    half = math.atan2(math.sqrt(max(0.0, numerator)), math.sqrt(max(0.0, denominator)))
    return 2.0 * half


@outlined
def side_of_line(tree, world, p, c, line):
    """Return the direction in which the hinge at ``p``, or at ``c``, moves off its line."""
    for k in (p, c):
        if k < tree.parent.shape[0] and tree.kind[k] == HINGE:
            side = so3.cross(joint_axis(world, k), line)
            sine = so3.norm(side)
            if sine > _MIN_SINE:
                return so3.scale(1.0 / sine, side)
    return so3.perpendicular(line)


# What a joint aims at


@inlined
def distance_to_axis(world, bones, kind, k, c):
    """Return the distance of point ``c`` from the axis of hinge ``k``, or from ball ``k``."""
    lever = offset(bones.point, c, bones, k)
    along = so3.dot(lever, joint_axis(world, k)) if kind == HINGE else 0.0
    return math.sqrt(max(0.0, so3.dot(lever, lever) - along * along))


@outlined
def add_point(correlation, bones, k, c):
    """Return the correlation with point ``c`` and its target, as seen from point ``k``."""
    target = offset(bones.target, c, bones, k)
    return add_vector(correlation, bones.share[c], target, offset(bones.point, c, bones, k))


@inlined
def add_goal_axes(correlation, search, g, share):
    """Return the correlation with the axes of the frame of goal ``g``."""
    weight = share * search.weight[g, 1] * search.weight[g, 1]
    target_rotation = so3.read_matrix_rotation(search.target, g)
    return add_axes(correlation, weight, target_rotation, so3.read_rotation(search.frames, g))


@outlined
def next_points(tree, goals, search, bones, k):
    """Return the correlation of the next points that joint ``k`` moves, and their number.

    A joint cannot move a point on its axis, or a point that coincides with its own anchor. It skips
    such a point and aims at the points after it. Also writes ``bones.skips_point``.
    """
    nodes = tree.parent.shape[0]
    correlation = NO_VECTORS
    count = 0
    bones.skips_point[k] = 0
    depth = 0
    c = bones.child[k]
    while c >= 0 or depth > 0:
        if c < 0:
            depth -= 1
            c = bones.sibling[bones.stack[depth]]
            continue
        descends = False
        if bones.share[c] > 0.0:
            locate(tree, goals, search, bones, c)
            if c >= nodes and has_orientation(goals, search, c - nodes):
                correlation = add_goal_axes(correlation, search, c - nodes, 1.0)
                count += 3
            elif distance_to_axis(search.world, bones, tree.kind[k], k, c) > _NO_LEVER:
                correlation = add_point(correlation, bones, k, c)
                count += 1
            else:
                descends = c < nodes
        if descends:
            bones.skips_point[k] = 1
            bones.stack[depth] = c
            depth += 1
            c = bones.child[c]
        else:
            c = bones.sibling[c]
    return correlation, count


@outlined
def add_goals(tree, goals, search, bones, k, pull, correlation):
    """Return the correlation with the goals that joint ``k`` moves while later joints stay.

    The target of a point contains no error across its bone. A ball can remove such an error and a
    hinge cannot: without the goals, hinges whose axes are not parallel would not move.
    """
    nodes = tree.parent.shape[0]
    for g in range(goals.row.shape[0]):
        if bones.share[nodes + g] <= 0.0 or bones.carries[k, g] == 0:
            continue
        anchor = so3.read_vector(bones.point, k, 0)
        target = so3.subtract(so3.read_matrix_point(search.target, g), anchor)
        vector = so3.subtract(so3.read_vector(search.frames, g, 0), anchor)
        correlation = add_vector(correlation, pull * bones.share[nodes + g], target, vector)
        if has_orientation(goals, search, g):
            correlation = add_goal_axes(correlation, search, g, pull)
    return correlation


# The optimum of one joint


@outlined
def move_frame(search, k, point, rotation, g):
    """Move the frame of goal ``g`` with node ``k``, whose pose was ``point`` and ``rotation``.

    The joints between the node and the frame stay. So the cost of a rotation does not depend on the
    number of joints after it.
    """
    frames = search.frames
    moved_point = so3.read_vector(search.world, k, 0)
    moved_rotation = so3.read_rotation(search.world, k)

    local = so3.apply_inverse(rotation, so3.subtract(so3.read_vector(frames, g, 0), point))
    frame_point = so3.add(moved_point, so3.apply(moved_rotation, local))
    first, second, third = so3.transpose(so3.read_rotation(frames, g))
    frame_axes = (
        so3.apply(moved_rotation, so3.apply_inverse(rotation, first)),
        so3.apply(moved_rotation, so3.apply_inverse(rotation, second)),
        so3.apply(moved_rotation, so3.apply_inverse(rotation, third)),
    )
    so3.write_pose(frames, g, frame_point, so3.transpose(frame_axes))


@outlined
def relocate(tree, goals, search, bones, k):
    """Write the pose of joint ``k`` after a rotation, and of the goals' frames that it carries."""
    point = so3.read_vector(search.world, k, 0)
    rotation = so3.read_rotation(search.world, k)
    locate(tree, goals, search, bones, k)
    for g in range(goals.row.shape[0]):
        if bones.carries[k, g] == 1:
            move_frame(search, k, point, rotation, g)


@outlined
def rotate_ball(search, k, a, axis, angle):
    """Rotate the ball whose quaternion starts at q[a] by ``angle`` about a world axis."""
    rotation = so3.read_rotation(search.world, k)
    x, y, z = so3.apply_inverse(rotation, so3.scale(angle, axis))
    rotate_quat(search.q, a, x, y, z)


@outlined
def aim_ball(tree, goals, search, bones, k, a):
    """Rotate ball ``k`` to its optimum, without limits; return the sum of the angles."""
    total = 0.0
    for _ in range(_BALL_ROTATIONS):
        correlation, count = next_points(tree, goals, search, bones, k)
        if bones.ball_pull > 0.0:
            correlation = add_goals(tree, goals, search, bones, k, bones.ball_pull, correlation)
        axis = best_axis(correlation)
        length = so3.norm(axis)
        if length == 0.0:
            break
        axis = so3.scale(1.0 / length, axis)
        a_term, b_term = rotation_terms(correlation, axis)
        angle = best_angle(a_term, b_term, -math.pi, math.pi)
        rotate_ball(search, k, a, axis, angle)
        relocate(tree, goals, search, bones, k)
        total += abs(angle)
        if abs(angle) < _STILL or (count < 2 and bones.ball_pull == 0.0):
            break
    return total


@outlined
def twist_ball(tree, goals, search, bones, k, a, cone):
    """Twist ball ``k`` about its bone, inside its cone, so that the hinge after it can reach."""
    c = bones.child[k]
    if c < 0 or c >= tree.parent.shape[0] or bones.sibling[c] >= 0 or tree.kind[c] != HINGE:
        return
    locate(tree, goals, search, bones, c)
    bone = offset(bones.point, c, bones, k)
    length = so3.norm(bone)
    if length < _NO_LEVER:
        return
    bone = so3.scale(1.0 / length, bone)
    correlation = NO_VECTORS
    child = bones.child[c]
    while child >= 0:
        if bones.share[child] > 0.0:
            locate(tree, goals, search, bones, child)
            correlation = add_point(correlation, bones, k, child)
        child = bones.sibling[child]
    lower, upper = twist_range(search, k, a, bone, cone)
    a_term, b_term = rotation_terms(correlation, bone)
    rotate_ball(search, k, a, bone, best_angle(a_term, b_term, lower, upper))


@inlined
def twist_range(search, k, a, axis, cone):
    """Return the angles about a world axis by which ball ``k`` may rotate inside its cone.

    After a twist φ the scalar part of the quaternion is r cos(φ/2 + δ). The ball is inside the cone
    while that is large enough.
    """
    if cone >= math.pi:
        return -math.pi, math.pi
    q = search.q
    scalar = q[a]
    local = so3.apply_inverse(so3.read_rotation(search.world, k), axis)
    along = so3.dot(local, so3.read_vector_at(q, a + 1))
    if scalar < 0.0:
        scalar = -scalar
        along = -along
    r = math.sqrt(scalar * scalar + along * along)
    half = 2.0 * math.acos(min(1.0, math.cos(0.5 * cone) / max(r, _SMALL)))
    middle = -2.0 * math.atan2(along, scalar)
    return min(middle - half, 0.0), max(middle + half, 0.0)


@inlined
def clip_joint(tree, search, bones, k):
    """Put joint ``k`` inside its limits."""
    bones.node[0] = k
    clip(tree, bones.node, search.q)


@outlined
def fit_ball(tree, goals, search, bones, k):
    """Rotate ball or free joint ``k`` to its optimum inside its cone; return the angle."""
    q = search.q
    is_free = tree.kind[k] == FREE
    a = tree.qadr[k] + (3 if is_free else 0)
    cone = math.pi if is_free else min(tree.upper[tree.vadr[k]], math.pi)
    total = aim_ball(tree, goals, search, bones, k, a)
    if cone < math.pi and abs(q[a]) < math.cos(0.5 * cone):
        # The shortest rotation leaves the cone. The shortest rotation from the middle of the cone
        # stays in it for longest.
        q[a] = 1.0
        q[a + 1] = 0.0
        q[a + 2] = 0.0
        q[a + 3] = 0.0
        relocate(tree, goals, search, bones, k)
        aim_ball(tree, goals, search, bones, k, a)
        clip_joint(tree, search, bones, k)
        relocate(tree, goals, search, bones, k)
    twist_ball(tree, goals, search, bones, k, a, cone)
    if cone < math.pi:
        clip_joint(tree, search, bones, k)
    return total


@outlined
def fit_joint(tree, goals, search, bones, k):
    """Move joint ``k`` to its optimum inside its limits; return how far, in rad or m."""
    q = search.q
    a = tree.qadr[k]
    v = tree.vadr[k]
    kind = tree.kind[k]
    locate(tree, goals, search, bones, k)
    move = 0.0
    if kind == HINGE:
        correlation, _ = next_points(tree, goals, search, bones, k)
        if bones.hinge_pull > 0.0:
            correlation = add_goals(tree, goals, search, bones, k, bones.hinge_pull, correlation)
        a_term, b_term = rotation_terms(correlation, joint_axis(search.world, k))
        move = best_angle(a_term, b_term, tree.lower[v] - q[a], tree.upper[v] - q[a])
        q[a] = min(max(q[a] + move, tree.lower[v]), tree.upper[v])
    elif kind == SLIDE:
        bones.skips_point[k] = 0
        move = so3.dot(joint_axis(search.world, k), offset(bones.target, k, bones, k))
        q[a] = min(max(q[a] + move, tree.lower[v]), tree.upper[v])
    else:
        if kind == FREE:
            x, y, z = offset(bones.target, k, bones, k)
            q[a] += x
            q[a + 1] += y
            q[a + 2] += z
            relocate(tree, goals, search, bones, k)
        move = fit_ball(tree, goals, search, bones, k)
    relocate(tree, goals, search, bones, k)
    return abs(move)


# All joints


@outlined
def settle(tree, goals, search, bones, sweeps):
    """Bring the points towards their targets: each joint once, to its optimum, root to tip.

    Joints that aim at the same points, because their anchors coincide or their axes meet, can
    reach a target together that no single joint can reach. They are moved ``sweeps`` times.
    """
    for index in range(goals.nodes.shape[0]):
        k = goals.nodes[index]
        if bones.share[k] <= 0.0:
            continue
        fit_joint(tree, goals, search, bones, k)
        if bones.skips_point[k] != 0:
            continue
        size = find_group(bones, k)
        if size > 1:
            settle_group(tree, goals, search, bones, size, sweeps - 1)


@inlined
def find_group(bones, k):
    """Write ``k`` and the joints that skip it to ``bones.group``; return their number."""
    size = 1
    bones.group[0] = k
    parent = bones.parent[k]
    while parent >= 0 and bones.skips_point[parent] != 0:
        if bones.sibling[bones.child[parent]] >= 0:
            break
        bones.group[size] = parent
        size += 1
        parent = bones.parent[parent]
    return size


@inlined
def settle_group(tree, goals, search, bones, size, sweeps):
    """Move the joints of ``bones.group``, root to tip, until they move no more."""
    for _ in range(sweeps):
        total = 0.0
        for i in range(size - 1, -1, -1):
            total += fit_joint(tree, goals, search, bones, bones.group[i])
        if total < _STILL:
            break


@inlined
def clear_step(search):
    """Write zeros to search.step: these methods move q themselves, and ``advance`` must not."""
    for u in range(search.step.shape[0]):
        search.step[u] = 0.0
