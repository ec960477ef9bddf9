"""Joints as points and bones, for the geometric methods.

A *point* is the anchor of a joint or the origin of a goal's frame; a *bone* joins a point to the next
one along the chain.  The anchor of a hinge may be put anywhere on its axis without changing what moves:
here it is put nearest to the next point, so that offsets along the axis, and rolls about the tip, are no
bones.  Under a goal that asks for an orientation it is put nearest to the axis before it, where a wrist's
axes meet.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import forward, frame_pose
from robot_ik.kernels.residuals import POSE
from robot_ik.kernels.tree import HINGE

# Columns of ``links`` (points, LINK_COLUMNS), int64.  Points are the nodes, then the goals.
UP, FIRST, NEXT, THROUGH, STACK, PATH, LINK_COLUMNS = range(7)
# Columns of ``points`` (points, POINT_COLUMNS): where it is, where it is wished, what it counts, how far
# along its hinge's axis it stands from the node's origin, and the length of the bone that ends in it.
NOW, WISH, SHARE, SHIFT, LENGTH, POINT_COLUMNS = 0, 3, 6, 7, 8, 9


@pure
def turned_goal(goal, g):
    """Whether the goal asks for an orientation as well."""
    return goal.kind[g] == POSE and goal.weight[g, 1] > 0.0


@pure
def hang(links, points, c, k):
    """Makes point ``c`` the first child of node ``k``."""
    links[c, UP] = k
    links[c, NEXT] = links[k, FIRST]
    links[k, FIRST] = c
    points[k, SHARE] += points[c, SHARE]


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
def link_points(tree, goal, nodes, links, points):
    """Fills ``links``, and the shares and shifts of ``points``: once for a goal set."""
    n, constant, local = tree.parent.shape[0], tree.constant, goal.local
    for c in range(links.shape[0]):
        points[c, LENGTH] = 0.0
        links[c, UP] = links[c, FIRST] = links[c, NEXT] = -1
        links[c, THROUGH] = 0
        points[c, SHARE] = points[c, SHIFT] = 0.0
    for g in range(goal.kind.shape[0] - 1, -1, -1):
        if goal.node[g] >= 0:
            points[n + g, SHARE] = goal.weight[g, 0] * goal.weight[g, 0]
            hang(links, points, n + g, goal.node[g])
    for index in range(nodes.shape[0] - 1, -1, -1):
        k = nodes[index]
        if tree.kind[k] == HINGE:
            along, count, posed = 0.0, 0, False
            c = links[k, FIRST]
            while c >= 0:
                if c >= n:
                    along += local[c - n, 2]
                    posed = posed or turned_goal(goal, c - n)
                else:
                    along += constant[c, 2] + points[c, SHIFT] * constant[c, 11]
                count += 1
                c = links[c, NEXT]
            if posed:
                points[k, SHIFT] = nearest_to_parent(tree, k)
            elif count > 0:
                points[k, SHIFT] = along / count
        if tree.parent[k] >= 0:
            hang(links, points, k, tree.parent[k])


@pure
def apart(points, b, at_b, a, at_a):
    """Distance of two points, each as it is (NOW) or as it is wished (WISH)."""
    x = points[b, at_b] - points[a, at_a]
    y = points[b, at_b + 1] - points[a, at_a + 1]
    z = points[b, at_b + 2] - points[a, at_a + 2]
    return math.sqrt(x * x + y * y + z * z)


@pure
def across(x, y, z):
    """A unit vector across the unit vector (x, y, z)."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        n = 1.0 / math.sqrt(y * y + z * z)
        return 0.0, n * z, -n * y
    if abs(y) <= abs(z):
        n = 1.0 / math.sqrt(x * x + z * z)
        return n * z, 0.0, -n * x
    n = 1.0 / math.sqrt(x * x + y * y)
    return n * y, -n * x, 0.0


@outlined
def keep_pose(world, k, old, first):
    """old[first:first + 12] = the pose of node ``k``, before it moves."""
    for i in range(12):
        old[first + i] = world[k, i]


@outlined
def carry(world, k, old, first, frames, g):
    """Moves frames[g], which hangs on node ``k``, as the node has moved from the pose kept in ``old``.

    What lies between stays as it is: a joint's turn costs the same however many joints come after it.
    """
    x = frames[g, 0] - old[first]
    y = frames[g, 1] - old[first + 1]
    z = frames[g, 2] - old[first + 2]
    for c in range(4):  # the origin, then the three axes
        if c > 0:
            x, y, z = frames[g, 2 + c], frames[g, 5 + c], frames[g, 8 + c]
        # In the node's old axes, then along its new ones.
        a = old[first + 3] * x + old[first + 6] * y + old[first + 9] * z
        b = old[first + 4] * x + old[first + 7] * y + old[first + 10] * z
        d = old[first + 5] * x + old[first + 8] * y + old[first + 11] * z
        for i in range(3):
            moved = world[k, 3 + 3 * i] * a + world[k, 4 + 3 * i] * b + world[k, 5 + 3 * i] * d
            if c == 0:
                frames[g, i] = world[k, i] + moved
            else:
                frames[g, 2 + c + 3 * i] = moved


@outlined
def locate(tree, goal, work, points, one, c):
    """Pose of point ``c``'s node or frame, and where the point is now; its parent's pose must stand."""
    n, world = tree.parent.shape[0], work.world
    if c < n:
        one[0] = c
        forward(tree, one, work.q, world, work.scratch)
        for i in range(3):
            points[c, NOW + i] = world[c, i] + points[c, SHIFT] * world[c, 5 + 3 * i]
    else:
        frame_pose(world, goal.node[c - n], goal.local, c - n, work.frames)
        for i in range(3):
            points[c, NOW + i] = work.frames[c - n, i]


@outlined
def locate_all(tree, goal, work, links, points, one):
    """Where all points are now, and how long the bones are."""
    n, nodes = tree.parent.shape[0], work.nodes
    for index in range(nodes.shape[0] + goal.kind.shape[0]):
        c = nodes[index] if index < nodes.shape[0] else n + index - nodes.shape[0]
        locate(tree, goal, work, points, one, c)
        points[c, LENGTH] = apart(points, c, NOW, links[c, UP], NOW) if links[c, UP] >= 0 else 0.0


@outlined
def chain_path(tree, links):
    """Points of the one chain that a single goal makes, root to tip, into links[:, PATH]; how many.

    ``settle`` uses the column as well.
    """
    count, c = 0, tree.parent.shape[0]
    while c >= 0:
        count += 1
        c = links[c, UP]
    c = tree.parent.shape[0]
    for i in range(count - 1, -1, -1):
        links[i, PATH] = c
        c = links[c, UP]
    return count


@pure
def inner_radius(points, links, first, end):
    """Nearest that bones ``first`` … ``end`` - 1 of the path bring their two ends together."""
    longest, total = 0.0, 0.0
    for i in range(first, end):
        length = points[links[i, PATH], LENGTH]
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
