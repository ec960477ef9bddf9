"""Frames of a whole body in motion: hard rows met, soft rows and a posture as well as they allow.

Each frame minimises, from where the frame before it ended,

    Σ w |A dq − a|² + Σ s (posture − q)²    subject to    J dq = e,  low <= q + dq <= high

in two to four steps.  ``low`` and ``high`` are the joint limits and what the speed limits leave of them
within one frame.  There are no levels of priority below the hard rows, no test of convergence on the soft
ones and no restarts: ``lm`` has all that and costs three times as much.  A step is solved by the Schur
complement of its hard rows (Nocedal & Wright, *Numerical Optimization*, section 16.2); joints that it would
take over a bound are held there and it is solved again.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import kinematics
from robot_ik.kernels.bundle import Layout
from robot_ik.kernels.jit import kernel, outlined, pure
from robot_ik.kernels.linalg import reduced_system, row_dot
from robot_ik.kernels.loop import copy
from robot_ik.kernels.residuals import rotation_error
from robot_ik.kernels.tree import FREE, HINGE, SLIDE, open_tree

POSITION, ROTATION, CENTER_OF_MASS, AIM, MOMENTUM = range(5)
"""Kinds of rows: a frame's origin, its rotation, the whole centre of mass, where its x axis points, and the
angular momentum about the centre of mass since the frame before (kg m² rad)."""
HARD = math.inf
"""The weight of a row that must hold."""

# A step longer than this, rad or m, is shortened: rows are linear near q only.
_LONGEST = 0.4
# What a step costs by itself, beside posture weights of 0.02 and more.
_DAMPING = 1e-4
# Slack of the hard rows, which keeps their system solvable where they depend on each other; and where they
# contradict each other, by what the bounds leave.
_SLACK, _YIELDING = 1e-10, 1e-2
# What a step costs by itself where it would be longer than ``_LONGEST``.
_CAUTIOUS = 10.0
# Angular momentum is scaled to count like metres: 10 kg m² of the body.
_MOMENTUM_SCALE = 0.1
# How often joints are held at their bounds within one step.
_HOLDS = 8

WHOLE_BODY = Layout(
    "WholeBody",
    kind="ints",  # (g,) of each group of three rows
    node="ints",  # (g,) node that carries the frame
    local="table",  # (g, 12) the frame seen from it
    axes="ints",  # (g,) bit k: the row of world axis k counts
    share="table",  # (g, nv) 1 where a degree of freedom may serve the group
    inertia="table",  # (n, 10) mass, centre and inertia xx yy zz xy xz yz about it, of what each node carries
    stiffness="floats",  # (nv,) weight of the posture
    lower="floats",  # (nv,)
    upper="floats",  # (nv,)
    stride="floats",  # (nv,) farthest a joint may go in one frame
    world="table n 12",  # from here on: work space, with m = n + 1 and h = 3 g
    scratch="table 2 12",
    pose="table g 12",
    carried="table m 10",  # mass, first moment, inertia of what hangs on a node
    center="floats 3",
    previous="floats nq",
    displacement="floats nv",  # from the frame before to here
    row="table 3 nv",
    miss="floats 3",
    hard="table h nv",
    wanted="floats h",
    matrix="table nv nv",
    factor="table nv nv",
    gradient="floats nv",
    step="floats nv",
    low="floats nv",
    high="floats nv",
    side="ints nv",  # -1 or 1 of a joint that is held at its lower or upper bound, else 0
    hard_solved="table h nv",  # ``hard`` times L⁻ᵀ of the factor
    schur="table h h",
    multiplier="floats h",
)
_open = WHOLE_BODY.open


@outlined
def carry(tree, body):
    """Mass, first moment and inertia about the centre of mass of what hangs on each node."""
    inertia, carried, world, center = body.inertia, body.carried, body.world, body.center
    n = inertia.shape[0]
    whole = center[0] = center[1] = center[2] = 0.0
    for k in range(n):
        m = inertia[k, 0]
        whole += m
        for i in range(3):
            r = 3 + 3 * i
            at = world[k, i]
            for j in range(3):
                at += world[k, r + j] * inertia[k, 1 + j]
            carried[k, 1 + i] = at
            center[i] += m * at
    for i in range(3):
        center[i] /= whole
    for k in range(n):
        m = inertia[k, 0]
        x, y, z = carried[k, 1] - center[0], carried[k, 2] - center[1], carried[k, 3] - center[2]
        carried[k, 0] = m
        carried[k, 1], carried[k, 2], carried[k, 3] = m * x, m * y, m * z
        carried[k, 4], carried[k, 5] = m * (y * y + z * z), m * (x * x + z * z)
        carried[k, 6] = m * (x * x + y * y)
        carried[k, 7], carried[k, 8], carried[k, 9] = -m * x * y, -m * x * z, -m * y * z
        xx, yy, zz = inertia[k, 4], inertia[k, 5], inertia[k, 6]
        xy, xz, yz = inertia[k, 7], inertia[k, 8], inertia[k, 9]
        for e in range(6):  # R I Rᵀ
            i = e if e < 3 else (0 if e < 5 else 1)
            j = e if e < 3 else (1 if e == 3 else 2)
            a0, a1, a2 = world[k, 3 + 3 * i], world[k, 4 + 3 * i], world[k, 5 + 3 * i]
            b0, b1, b2 = world[k, 3 + 3 * j], world[k, 4 + 3 * j], world[k, 5 + 3 * j]
            carried[k, 4 + e] += (
                a0 * (xx * b0 + xy * b1 + xz * b2)
                + a1 * (xy * b0 + yy * b1 + yz * b2)
                + a2 * (xz * b0 + yz * b1 + zz * b2)
            )
    for k in range(n - 1, 0, -1):
        p = tree.parent[k]
        if p >= 0:
            for i in range(10):
                carried[p, i] += carried[k, i]
    carried[n, 0] = whole


@pure
def mass_column(carried, center, world, k, ax, ay, az, rotational):
    """Velocity of the centre of mass and angular momentum about it, per unit of a freedom of node k."""
    m, sx, sy, sz = carried[k, 0], carried[k, 1], carried[k, 2], carried[k, 3]
    inverse = 1.0 / carried[carried.shape[0] - 1, 0]
    if not rotational:
        return (
            m * inverse * ax, m * inverse * ay, m * inverse * az,
            sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax,
        )  # fmt: skip
    px, py, pz = center[0] - world[k, 0], center[1] - world[k, 1], center[2] - world[k, 2]
    tx, ty, tz = sx + m * px, sy + m * py, sz + m * pz
    vx, vy, vz = ay * pz - az * py, az * px - ax * pz, ax * py - ay * px
    return (
        inverse * (ay * tz - az * ty), inverse * (az * tx - ax * tz), inverse * (ax * ty - ay * tx),
        carried[k, 4] * ax + carried[k, 7] * ay + carried[k, 8] * az + sy * vz - sz * vy,
        carried[k, 7] * ax + carried[k, 5] * ay + carried[k, 9] * az + sz * vx - sx * vz,
        carried[k, 8] * ax + carried[k, 9] * ay + carried[k, 6] * az + sx * vy - sy * vx,
    )  # fmt: skip


@outlined
def mass_rows(tree, body, momentum, target, t, g):
    """Rows and misses of the centre of mass, or of the angular momentum about it."""
    row, miss, share = body.row, body.miss, body.share
    row[:] = 0.0
    for k in range(tree.kind.shape[0]):
        for i in range(kinematics.width_of(tree.kind[k])):
            v = tree.vadr[k] + i
            ax, ay, az, rotational = kinematics.dof_axis(tree.kind, body.world, k, i)
            cx, cy, cz, lx, ly, lz = mass_column(
                body.carried, body.center, body.world, k, ax, ay, az, rotational
            )
            if momentum:
                cx, cy, cz = _MOMENTUM_SCALE * lx, _MOMENTUM_SCALE * ly, _MOMENTUM_SCALE * lz
            row[0, v], row[1, v], row[2, v] = cx * share[g, v], cy * share[g, v], cz * share[g, v]
    for i in range(3):
        if momentum:
            miss[i] = _MOMENTUM_SCALE * target[t, i]
            for v in range(row.shape[1]):
                miss[i] -= row[i, v] * body.displacement[v]
        else:
            miss[i] = target[t, i] - body.center[i]


@outlined
def frame_rows(tree, body, what, target, t, g):
    """Rows and misses of a frame's position, rotation or line of sight."""
    row, miss, share, world, pose = body.row, body.miss, body.share, body.world, body.pose
    row[:] = 0.0
    px, py, pz = pose[g, 0], pose[g, 1], pose[g, 2]
    k = body.node[g]
    while k >= 0:
        for i in range(kinematics.width_of(tree.kind[k])):
            v = tree.vadr[k] + i
            ax, ay, az, rotational = kinematics.dof_axis(tree.kind, world, k, i)
            if what == POSITION:
                ax, ay, az = kinematics.point_velocity(world, k, ax, ay, az, rotational, px, py, pz)
            elif not rotational:
                ax, ay, az = 0.0, 0.0, 0.0
            row[0, v], row[1, v], row[2, v] = ax * share[g, v], ay * share[g, v], az * share[g, v]
        k = tree.parent[k]
    if what == POSITION:
        for i in range(3):
            miss[i] = target[t, i] - pose[g, i]
    elif what == ROTATION:
        rotation_error(target, t, pose, g, miss, 0)
    else:
        ux, uy, uz = target[t, 0] - px, target[t, 1] - py, target[t, 2] - pz
        n = 1.0 / max(math.sqrt(ux * ux + uy * uy + uz * uz), 1e-9)
        ux, uy, uz = ux * n, uy * n, uz * n
        x, y, z = pose[g, 3], pose[g, 6], pose[g, 9]
        miss[0], miss[1], miss[2] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux


@outlined
def measure_displacement(tree, body, q):
    """What lies between the frame before and q, (nv,), and the bounds of every joint's next step."""
    previous = body.previous
    kinematics.difference(tree, previous, q, body.displacement)
    for k in range(tree.kind.shape[0]):
        a, v = tree.qadr[k], tree.vadr[k]
        if tree.kind[k] == FREE:
            for i in range(6):
                body.low[v + i], body.high[v + i] = -math.inf, math.inf
        else:
            body.low[v] = max(body.lower[v], previous[a] - body.stride[v]) - q[a]
            body.high[v] = min(body.upper[v], previous[a] + body.stride[v]) - q[a]


@outlined
def quadratic_form(tree, body, q, target, weight, t, posture):
    """The quadratic form, its gradient and the hard rows at q; returns the number of these and their miss."""
    matrix, gradient, row, miss = body.matrix, body.gradient, body.row, body.miss
    nv = gradient.shape[0]
    kinematics.forward(tree, tree.every, q, body.world, body.scratch)
    carry(tree, body)
    measure_displacement(tree, body, q)
    for i in range(nv):
        for j in range(i):
            matrix[i, j] = 0.0
        matrix[i, i], gradient[i] = _DAMPING, 0.0
    for k in range(tree.kind.shape[0]):
        v = tree.vadr[k]
        if tree.kind[k] != FREE:
            matrix[v, v] += body.stiffness[v]
            gradient[v] = body.stiffness[v] * (posture[t, tree.qadr[k]] - q[tree.qadr[k]])
    count, worst, groups = 0, 0.0, body.kind.shape[0]
    for g in range(groups):
        w = weight[t, g]
        if not w > 0.0:
            continue
        what, at = body.kind[g], t * groups + g
        if what in (CENTER_OF_MASS, MOMENTUM):
            mass_rows(tree, body, what == MOMENTUM, target, at, g)
        else:
            kinematics.frame_pose(body.world, body.node[g], body.local, g, body.pose)
            frame_rows(tree, body, what, target, at, g)
        for i in range(3):
            if not body.axes[g] >> i & 1:
                continue
            if w == HARD:
                for v in range(nv):
                    body.hard[count, v] = row[i, v]
                body.wanted[count] = miss[i]
                worst = max(worst, abs(miss[i]))
                count += 1
                continue
            for a in range(nv):
                x = w * row[i, a]
                if x != 0.0:
                    gradient[a] += x * miss[i]
                    for b in range(a + 1):
                        matrix[a, b] += x * row[i, b]
    return count, worst


@pure
def cholesky(matrix, n):
    """L of M = L Lᵀ into the lower triangle of M; the diagonal holds 1 / L[i, i]."""
    for i in range(n):
        for j in range(i):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = s * matrix[j, j]
        s = matrix[i, i]
        for k in range(i):
            s -= matrix[i, k] * matrix[i, k]
        matrix[i, i] = 1.0 / math.sqrt(max(s, 1e-300))


@pure
def substitute(matrix, x, n):
    """x = L⁻¹ x."""
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= matrix[i, k] * x[k]
        x[i] = s * matrix[i, i]


@pure
def substitute_back(matrix, x, n):
    """x = L⁻ᵀ x."""
    for i in range(n - 1, -1, -1):
        x[i] *= matrix[i, i]
        s = x[i]
        for k in range(i):
            x[k] -= matrix[i, k] * s


@outlined
def solve_held(body, count, slack):
    """The step with the held joints at their bounds: body.step."""
    factor, side, step, multiplier = body.factor, body.side, body.step, body.multiplier
    hard_solved, schur, n = body.hard_solved, body.schur, body.gradient.shape[0]
    reduced_system(body.matrix, body.gradient, body.low, body.high, side, factor, step)
    cholesky(factor, n)
    copy(body.wanted, multiplier)
    for r in range(count):
        for v in range(n):
            hard_solved[r, v] = body.hard[r, v]
            if side[v] != 0:
                multiplier[r] -= hard_solved[r, v] * step[v]
                hard_solved[r, v] = 0.0
        substitute(factor, hard_solved[r], n)
    substitute(factor, step, n)
    for r in range(count):
        for v in range(n):
            multiplier[r] -= hard_solved[r, v] * step[v]
        for c in range(r + 1):
            schur[r, c] = row_dot(hard_solved, r, hard_solved, c)
    for r in range(count):
        schur[r, r] += slack
    cholesky(schur, count)
    substitute(schur, multiplier, count)
    substitute_back(schur, multiplier, count)
    for r in range(count):
        for v in range(n):
            step[v] += hard_solved[r, v] * multiplier[r]
    substitute_back(factor, step, n)


@outlined
def hold_and_solve(body, count, slack):
    """body.step, with joints held at the bounds that it would cross; returns its longest part."""
    n = body.step.shape[0]
    for v in range(n):
        body.side[v] = 0
    for _ in range(_HOLDS):
        solve_held(body, count, slack)
        more = False
        for v in range(n):
            if body.side[v] == 0 and not (body.low[v] - 1e-12 <= body.step[v] <= body.high[v] + 1e-12):
                body.side[v] = -1 if body.step[v] < body.low[v] else 1
                more = True
        if not more:
            break
    longest = 0.0
    for v in range(n):
        longest = max(longest, abs(body.step[v]))
    return longest


@outlined
def bounded_step(tree, body, q, count):
    """One step from q, inside the bounds; returns its longest part."""
    longest = hold_and_solve(body, count, _SLACK)
    n = body.step.shape[0]
    if longest > _LONGEST:  # soft rows that cannot be met pull far: hard ones hold nevertheless
        for v in range(n):
            body.matrix[v, v] += _CAUTIOUS
        longest = hold_and_solve(body, count, _SLACK)
    if longest > _LONGEST:
        longest = hold_and_solve(body, count, _YIELDING)
    if longest > _LONGEST:
        for v in range(n):
            body.step[v] *= _LONGEST / longest
    for v in range(n):
        body.step[v] = min(max(body.step[v], body.low[v]), body.high[v])
    kinematics.integrate(tree, tree.every, q, body.step)
    return longest


@kernel
def solve_frames(tree, body, target, weight, posture, q, start, second, steps, rest, close, miss, used):
    """Solves one frame after the other.

    Args:
        tree: Table of a tree of hinges, slides and free joints.
        body: Table of ``WHOLE_BODY``.
        target: (frames · groups, 12) position, or rotation as a pose row, of every group in every frame.
        weight: (frames, groups) weights; ``HARD``; 0 leaves a group out.
        posture: (frames, nq).
        q: (frames, nq) result.
        start: (nq,) the frame before the first.
        second: (nq,) the frame before that, whose motion the first goes on with.
        steps: Most steps a frame.
        rest: A step shorter than this (rad, m) was the last …
        close: … if it leaves no hard row farther off than this.
        miss: (frames,) result: largest miss of a hard row (m, rad).
        used: (frames,) result: steps taken.
    """
    tree = open_tree(tree)
    body = _open(body)
    here = q[0]
    copy(second, body.previous)
    measure_displacement(tree, body, start)
    copy(start, body.previous)
    for t in range(q.shape[0]):
        here = q[t]
        copy(body.previous, here)
        for k in range(tree.kind.shape[0]):  # what moved goes on moving
            if tree.kind[k] in (HINGE, SLIDE):
                a, v = tree.qadr[k], tree.vadr[k]
                to = min(max(here[a] + body.displacement[v], body.lower[v]), body.upper[v])
                body.displacement[v] = min(max(to - here[a], -body.stride[v]), body.stride[v])
        kinematics.integrate(tree, tree.every, here, body.displacement)
        longest = math.inf
        for step in range(steps + 1):
            count, miss[t] = quadratic_form(tree, body, here, target, weight, t, posture)
            used[t] = step
            if step == steps or (longest < rest and miss[t] < close):
                break
            longest = bounded_step(tree, body, here, count)
        copy(here, body.previous)
