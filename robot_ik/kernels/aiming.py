"""One joint's best turn: how joints follow points that a geometric method wishes somewhere.

``settle`` turns the joints, root to tip, each about its real axis and inside its limits, to the exact
optimum of its own: q is feasible at all times.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels.bones import (
    FIRST,
    LINK_COLUMNS,
    NEXT,
    NOW,
    PATH,
    SHARE,
    STACK,
    THROUGH,
    UP,
    WISH,
    carry,
    keep_pose,
    locate,
    turned_goal,
)
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import clip, turn_quat
from robot_ik.kernels.tree import FREE, HINGE, SLIDE
from robot_ik.kernels.turns import AIMS, BALL_PULL, KEPT, PULL, add_aim, best_angle, turn_axis, turn_terms

# Columns of ``links`` after those of ``bones``, one for each goal: 1 where it hangs on the node.
HANGS = LINK_COLUMNS
# A point nearer to the axis than this, metres, is not moved by a turn about it.
_NO_LEVER = 1e-6
# Turns of a ball with several points to serve, and where they end, rad.
_BALL_TURNS, _STILL = 12, 1e-10


@outlined
def mark_hanging(goal, links):
    """Fills links[:, HANGS:]."""
    for g in range(goal.kind.shape[0]):
        for c in range(links.shape[0]):
            links[c, HANGS + g] = 0
        k = goal.node[g]
        while k >= 0:
            links[k, HANGS + g] = 1
            k = links[k, UP]


@outlined
def add_point(points, sums, k, c):
    """Point ``c`` is wished where it is wished, seen from point ``k``."""
    add_aim(
        sums, points[c, SHARE],
        points[c, WISH] - points[k, NOW], points[c, WISH + 1] - points[k, NOW + 1],
        points[c, WISH + 2] - points[k, NOW + 2],
        points[c, NOW] - points[k, NOW], points[c, NOW + 1] - points[k, NOW + 1],
        points[c, NOW + 2] - points[k, NOW + 2],
    )  # fmt: skip


@outlined
def add_columns(goal, work, sums, share, g):
    """The axes of goal ``g``'s frame are wished along those of its target."""
    w = share * goal.weight[g, 1] * goal.weight[g, 1]
    for i in range(3, 6):
        add_aim(
            sums, w, goal.target[g, i], goal.target[g, i + 3], goal.target[g, i + 6],
            work.frames[g, i], work.frames[g, i + 3], work.frames[g, i + 6],
        )  # fmt: skip


@pure
def lever(world, points, kind, k, c):
    """Distance of point ``c`` from the axis of hinge ``k``, or from the centre of ball ``k``."""
    x = points[c, NOW] - points[k, NOW]
    y = points[c, NOW + 1] - points[k, NOW + 1]
    z = points[c, NOW + 2] - points[k, NOW + 2]
    along = x * world[k, 5] + y * world[k, 8] + z * world[k, 11] if kind == HINGE else 0.0
    return math.sqrt(max(0.0, x * x + y * y + z * z - along * along))


@outlined
def gather(tree, goal, work, links, points, one, sums, k):
    """Into ``sums``, what joint ``k`` should aim at: the next points that it moves.

    A point that it cannot move, because their anchors coincide or it lies on the axis, is looked
    through to the ones behind it (links[k, THROUGH] tells).
    """
    n = tree.parent.shape[0]
    for i in range(AIMS + 1):
        sums[i] = 0.0
    links[k, THROUGH] = 0
    depth, c = 0, links[k, FIRST]
    while c >= 0 or depth > 0:
        if c < 0:
            depth -= 1
            c = links[links[depth, STACK], NEXT]
            continue
        down = False
        if points[c, SHARE] > 0.0:
            locate(tree, goal, work, points, one, c)
            if c >= n and turned_goal(goal, c - n):
                add_columns(goal, work, sums, 1.0, c - n)
            elif lever(work.world, points, tree.kind[k], k, c) > _NO_LEVER:
                add_point(points, sums, k, c)
            else:
                down = c < n
        if down:
            links[k, THROUGH] = 1
            links[depth, STACK] = c
            depth += 1
            c = links[c, FIRST]
        else:
            c = links[c, NEXT]


@outlined
def heed_goals(tree, goal, work, links, points, sums, k, pull):
    """Adds to ``sums`` the goals that hang on joint ``k``, as they would be if later joints stayed.

    A bone's wish says nothing of an error across the bone, which a ball can take out and a hinge cannot:
    without this, hinges whose axes are not parallel wait for each other.
    """
    n = tree.parent.shape[0]
    for g in range(goal.kind.shape[0]):
        if points[n + g, SHARE] <= 0.0 or links[k, HANGS + g] == 0:
            continue
        count = sums[AIMS]
        add_aim(
            sums, pull * points[n + g, SHARE],
            goal.target[g, 0] - points[k, NOW], goal.target[g, 1] - points[k, NOW + 1],
            goal.target[g, 2] - points[k, NOW + 2],
            work.frames[g, 0] - points[k, NOW], work.frames[g, 1] - points[k, NOW + 1],
            work.frames[g, 2] - points[k, NOW + 2],
        )  # fmt: skip
        if turned_goal(goal, g):
            add_columns(goal, work, sums, pull, g)
        sums[AIMS] = count


@outlined
def relocate(tree, goal, work, links, points, one, sums, k):
    """Where joint ``k`` is after a turn; the frames of all goals that hang on it come along."""
    keep_pose(work.world, k, sums, KEPT)
    locate(tree, goal, work, points, one, k)
    for g in range(goal.kind.shape[0]):
        if links[k, HANGS + g] == 1:
            carry(work.world, k, sums, KEPT, work.frames, g)


@outlined
def turn_ball(tree, work, k, a, x, y, z, angle):
    """Turns the ball whose quaternion starts at q[a] by ``angle`` about the world axis (x, y, z)."""
    world = work.world
    turn_quat(
        work.q, a,
        angle * (world[k, 3] * x + world[k, 6] * y + world[k, 9] * z),
        angle * (world[k, 4] * x + world[k, 7] * y + world[k, 10] * z),
        angle * (world[k, 5] * x + world[k, 8] * y + world[k, 11] * z),
    )  # fmt: skip


@outlined
def aim_ball(tree, goal, work, links, points, one, sums, k, a):
    """Turns ball ``k`` freely to its optimum; returns the angle turned in all."""
    total = 0.0
    for _ in range(_BALL_TURNS):
        gather(tree, goal, work, links, points, one, sums, k)
        if sums[BALL_PULL] > 0.0:
            heed_goals(tree, goal, work, links, points, sums, k, sums[BALL_PULL])
        x, y, z = turn_axis(sums)
        norm = math.sqrt(x * x + y * y + z * z)
        if norm == 0.0:
            break
        x, y, z = x / norm, y / norm, z / norm
        ta, tb = turn_terms(sums, x, y, z)
        angle = best_angle(ta, tb, -math.pi, math.pi)
        turn_ball(tree, work, k, a, x, y, z, angle)
        relocate(tree, goal, work, links, points, one, sums, k)
        total += abs(angle)
        if abs(angle) < _STILL or (sums[AIMS] < 2.0 and sums[BALL_PULL] == 0.0):
            break
    return total


@outlined
def twist_ball(tree, goal, work, links, points, one, sums, k, a, cone):
    """Twists ball ``k`` about its bone, inside its cone, so that a hinge at the other end can do its work."""
    c, q, world = links[k, FIRST], work.q, work.world
    if c < 0 or c >= tree.parent.shape[0] or links[c, NEXT] >= 0 or tree.kind[c] != HINGE:
        return
    locate(tree, goal, work, points, one, c)
    x, y, z = points[c, 0] - points[k, 0], points[c, 1] - points[k, 1], points[c, 2] - points[k, 2]
    norm = math.sqrt(x * x + y * y + z * z)
    if norm < _NO_LEVER:
        return
    x, y, z = x / norm, y / norm, z / norm
    for i in range(AIMS + 1):
        sums[i] = 0.0
    child = links[c, FIRST]
    while child >= 0:
        if points[child, SHARE] > 0.0:
            locate(tree, goal, work, points, one, child)
            add_point(points, sums, k, child)
        child = links[child, NEXT]
    low, high = -math.pi, math.pi
    if cone < math.pi:
        # After a twist φ the scalar part is r cos(φ/2 + δ): inside the cone while that is large enough.
        bx = world[k, 3] * x + world[k, 6] * y + world[k, 9] * z
        by = world[k, 4] * x + world[k, 7] * y + world[k, 10] * z
        bz = world[k, 5] * x + world[k, 8] * y + world[k, 11] * z
        s = bx * q[a + 1] + by * q[a + 2] + bz * q[a + 3]
        sign = -1.0 if q[a] < 0.0 else 1.0
        r = math.sqrt(q[a] * q[a] + s * s)
        half = 2.0 * math.acos(min(1.0, math.cos(0.5 * cone) / max(r, 1e-12)))
        middle = -2.0 * math.atan2(sign * s, sign * q[a])
        low, high = min(middle - half, 0.0), max(middle + half, 0.0)
    ta, tb = turn_terms(sums, x, y, z)
    turn_ball(tree, work, k, a, x, y, z, best_angle(ta, tb, low, high))


@outlined
def fit_ball(tree, goal, work, links, points, one, sums, k):
    """The best rotation of ball (or floating) joint ``k`` inside its cone; returns the angle turned."""
    q, free = work.q, tree.kind[k] == FREE
    a = tree.qadr[k] + (3 if free else 0)
    cone = math.pi if free else min(tree.upper[tree.vadr[k]], math.pi)
    limit = math.cos(0.5 * cone)
    total = aim_ball(tree, goal, work, links, points, one, sums, k, a)
    if cone < math.pi and abs(q[a]) < limit:
        # The shortest way from where it was leaves the cone; the shortest from the middle leaves it last.
        q[a], q[a + 1], q[a + 2], q[a + 3] = 1.0, 0.0, 0.0, 0.0
        relocate(tree, goal, work, links, points, one, sums, k)
        aim_ball(tree, goal, work, links, points, one, sums, k, a)
        one[0] = k
        clip(tree, one, q)
        relocate(tree, goal, work, links, points, one, sums, k)
    twist_ball(tree, goal, work, links, points, one, sums, k, a, cone)
    if cone < math.pi:
        one[0] = k
        clip(tree, one, q)
    return total


@outlined
def fit_joint(tree, goal, work, links, points, one, sums, k):
    """Turns or shifts joint ``k`` to its optimum inside its limits; returns how far it went, rad or m."""
    q, world, a, v, kind = work.q, work.world, tree.qadr[k], tree.vadr[k], tree.kind[k]
    locate(tree, goal, work, points, one, k)
    gone = 0.0
    if kind == HINGE:
        gather(tree, goal, work, links, points, one, sums, k)
        if sums[PULL] > 0.0:
            heed_goals(tree, goal, work, links, points, sums, k, sums[PULL])
        ta, tb = turn_terms(sums, world[k, 5], world[k, 8], world[k, 11])
        gone = best_angle(ta, tb, tree.lower[v] - q[a], tree.upper[v] - q[a])
        q[a] = min(max(q[a] + gone, tree.lower[v]), tree.upper[v])
    elif kind == SLIDE:
        links[k, THROUGH] = 0
        for i in range(3):
            gone += world[k, 5 + 3 * i] * (points[k, WISH + i] - points[k, NOW + i])
        q[a] = min(max(q[a] + gone, tree.lower[v]), tree.upper[v])
    else:
        if kind == FREE:
            for i in range(3):
                q[a + i] += points[k, WISH + i] - points[k, NOW + i]
            relocate(tree, goal, work, links, points, one, sums, k)
        gone = fit_ball(tree, goal, work, links, points, one, sums, k)
    relocate(tree, goal, work, links, points, one, sums, k)
    return abs(gone)


@outlined
def settle(tree, goal, work, links, points, one, sums, sweeps):
    """Brings the points towards their wishes: every joint once, root to tip, to its own optimum.

    Joints that aim at the same point (anchors that coincide, or axes that meet) are gone over
    ``sweeps`` times, because together they do what none of them can do alone.
    """
    for index in range(work.nodes.shape[0]):
        k = work.nodes[index]
        if points[k, SHARE] <= 0.0:
            continue
        fit_joint(tree, goal, work, links, points, one, sums, k)
        if links[k, THROUGH] != 0:
            continue
        size, head = 1, k
        links[0, PATH] = k
        while links[head, UP] >= 0:
            above = links[head, UP]
            if links[above, THROUGH] == 0 or links[links[above, FIRST], NEXT] >= 0:
                break
            head = above
            links[size, PATH] = head
            size += 1
        if size == 1:
            continue
        for _ in range(sweeps - 1):
            total = 0.0
            for back in range(size - 1, -1, -1):
                total += fit_joint(tree, goal, work, links, points, one, sums, links[back, PATH])
            if total < _STILL:
                break
