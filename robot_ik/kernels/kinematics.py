"""Forward kinematics, geometric Jacobian and integration on a ``Tree``, equal to MuJoCo's to 1e-12.

The tests compare them with ``mj_kinematics`` and ``mj_jac``. Poses are rows of twelve numbers: the
position, then the rotation matrix row by row. ``tree`` is the open block of a tree (``tree.py``).
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels import so3
from robot_ik.kernels.jit import inlined, kernel, literal, outlined
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE, open_tree

# ``sine_cosine`` takes a third of the time of the library's two calls. It has the reduction of Cody
# and Waite to [−π/4, π/4] and the polynomials of fdlibm's ``__kernel_sin`` and ``__kernel_cos``
# (Sun Microsystems, 1993). Its values are within 2.3e-16 of the exact ones.

# Beyond this angle, rad, multiples of the first part of π/2 are inexact, and the library is called.
_MAX_ANGLE = 1e6
_QUARTERS_PER_RADIAN = 2.0 / math.pi
# The first 33 bits of π/2, so that whole multiples are exact, and the rest.
_HALF_PI = 1.57079632673412561417
_HALF_PI_REST = 6.07710050650619224932e-11
# Coefficients of the polynomials.
_S1 = -1.66666666666666324348e-01
_S2 = 8.33333333332248946124e-03
_S3 = -1.98412698298579493134e-04
_S4 = 2.75573137070700676789e-06
_S5 = -2.50507602534068634195e-08
_S6 = 1.58969099521155010221e-10
_C1 = 4.16666666666666019037e-02
_C2 = -1.38888888888741095749e-03
_C3 = 2.48015872894767294178e-05
_C4 = -2.75573143513906633035e-07
_C5 = 2.08757232129817482790e-09
_C6 = -1.13596475577881948265e-11


@literal
def sine_cosine(angle):
    """Return (sin, cos) of an angle, rad; NaN of an angle that is not finite."""
    if not abs(angle) < _MAX_ANGLE:
        return math.sin(angle), math.cos(angle)
    quarter = math.floor(angle * _QUARTERS_PER_RADIAN + 0.5)
    x = (angle - quarter * _HALF_PI) - quarter * _HALF_PI_REST
    z = x * x
    w = z * z
    s = x + x * z * ((_S1 + z * _S2) + w * ((_S3 + z * _S4) + w * (_S5 + z * _S6)))
    c = 1.0 - (0.5 * z - w * ((_C1 + z * _C2) + w * ((_C3 + z * _C4) + w * (_C5 + z * _C6))))
    # Sums select the quarter of the revolution, because a processor cannot predict branches:
    # (even, odd) is (1, 0), (0, 1), (-1, 0), (0, -1).
    sign = 1 - (quarter & 2)
    even = float(((quarter & 1) ^ 1) * sign)
    odd = float((quarter & 1) * sign)
    return even * s + odd * c, even * c - odd * s


# Coupled joints obey MuJoCo's joint equality: q = q₀ + Σ aᵢ (leader − leader₀)ⁱ. Only hinges and
# slides can be coupled. ``couplings`` ensures that no leader follows another joint.


@outlined
def follow(tree, q):
    """Write the values of all coupled joints to q, from those of their leaders."""
    coupled = tree.coupled
    law = tree.law
    qadr = tree.qadr
    for c in range(coupled.shape[0]):
        value = 0.0
        if coupled[c, 1] >= 0:
            x = q[qadr[coupled[c, 1]]] - law[c, 1]
            value = x * (law[c, 3] + x * (law[c, 4] + x * (law[c, 5] + x * law[c, 6])))
        q[qadr[coupled[c, 0]]] = law[c, 0] + law[c, 2] + value


@inlined
def slope_of(tree, c, q):
    """Return the derivative of the joint of coupling ``c`` by its leader."""
    law = tree.law
    x = q[tree.qadr[tree.coupled[c, 1]]] - law[c, 1]
    return law[c, 3] + x * (2.0 * law[c, 4] + x * (3.0 * law[c, 5] + x * 4.0 * law[c, 6]))


@inlined
def steepest_slope(tree, c, first, last):
    """Return a bound of the slope of coupling ``c`` between two values of its leader."""
    law = tree.law
    x = max(abs(first - law[c, 1]), abs(last - law[c, 1]))
    return abs(law[c, 3]) + x * (
        2.0 * abs(law[c, 4]) + x * (3.0 * abs(law[c, 5]) + x * 4.0 * abs(law[c, 6]))
    )


@inlined
def write_quat_rotation(q, a, out, o):
    """Write the rotation matrix of the quaternion q[a : a + 4], of any length, to out[o, 3:12]."""
    rotation = so3.to_rotation((q[a], q[a + 1], q[a + 2], q[a + 3]))
    for i in range(3):
        out[o, 3 + i] = rotation[0][i]
        out[o, 6 + i] = rotation[1][i]
        out[o, 9 + i] = rotation[2][i]


@inlined
def compose(a, i, b, j, out, o):
    """Write the pose a[i] · b[j] to out[o], in tables (n, 12). The rows must be distinct."""
    point = (b[j, 0], b[j, 1], b[j, 2])
    x_axis = (b[j, 3], b[j, 6], b[j, 9])
    y_axis = (b[j, 4], b[j, 7], b[j, 10])
    z_axis = (b[j, 5], b[j, 8], b[j, 11])
    for k in range(3):
        row = (a[i, 3 + 3 * k], a[i, 4 + 3 * k], a[i, 5 + 3 * k])
        out[o, k] = a[i, k] + so3.dot(row, point)
        out[o, 3 + 3 * k] = so3.dot(row, x_axis)
        out[o, 4 + 3 * k] = so3.dot(row, y_axis)
        out[o, 5 + 3 * k] = so3.dot(row, z_axis)


@inlined
def hinge_pose(world, parent, constant, k, s, c):
    """Write world[parent] · constant[k] · (rotation about z with sine s, cosine c) to world[k]."""
    point = (constant[k, 0], constant[k, 1], constant[k, 2])
    x = (constant[k, 3], constant[k, 6], constant[k, 9])
    y = (constant[k, 4], constant[k, 7], constant[k, 10])
    z_axis = (constant[k, 5], constant[k, 8], constant[k, 11])
    # The rotation is first, because it does not wait for the pose of the parent.
    x_axis = so3.add(so3.scale(c, x), so3.scale(s, y))
    y_axis = so3.subtract(so3.scale(c, y), so3.scale(s, x))
    if parent < 0:
        for i in range(3):
            world[k, i] = point[i]
            world[k, 3 + 3 * i] = x_axis[i]
            world[k, 4 + 3 * i] = y_axis[i]
            world[k, 5 + 3 * i] = z_axis[i]
        return
    for i in range(3):
        row = (world[parent, 3 + 3 * i], world[parent, 4 + 3 * i], world[parent, 5 + 3 * i])
        world[k, i] = world[parent, i] + so3.dot(row, point)
        world[k, 3 + 3 * i] = so3.dot(row, x_axis)
        world[k, 4 + 3 * i] = so3.dot(row, y_axis)
        world[k, 5 + 3 * i] = so3.dot(row, z_axis)


@outlined
def forward(tree, nodes, q, world, scratch):
    """Write the poses of the listed nodes, parents before children, to ``world`` (n, 12).

    ``scratch`` (2, 12) is overwritten.
    """
    kind = tree.kind
    parent = tree.parent
    qadr = tree.qadr
    constant = tree.constant
    # Typed numbers, because numba would compile the callees again for the literal types of 0 and 1.
    before = types.int64(0)
    rotation = types.int64(1)
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a = qadr[k]
        p = parent[k]
        joint = kind[k]
        if joint == HINGE:
            s, c = sine_cosine(q[a])
            hinge_pose(world, p, constant, k, s, c)
            continue
        if joint == FREE:
            for i in range(3):
                world[k, i] = q[a + i]
            write_quat_rotation(q, a + 3, world, k)
            continue
        if p >= 0:
            compose(world, p, constant, k, world, k)
        else:
            for i in range(12):
                world[k, i] = constant[k, i]
        if joint == SLIDE:
            for i in range(3):
                world[k, i] += world[k, 5 + 3 * i] * q[a]
        else:
            for i in range(12):
                scratch[before, i] = world[k, i]
            for i in range(3):
                scratch[rotation, i] = 0.0
            write_quat_rotation(q, a, scratch, rotation)
            compose(scratch, before, scratch, rotation, world, k)


@inlined
def frame_pose(world, node, local, index, out):
    """Write the pose of the frame at local[index] on ``node`` (-1: the world) to out[index]."""
    if node >= 0:
        compose(world, node, local, index, out, index)
    else:
        for i in range(12):
            out[index, i] = local[index, i]


@inlined
def width_of(joint):
    """Return the degrees of freedom of a kind of joint."""
    if joint < BALL:
        return 1
    return 3 if joint == BALL else 6


@inlined
def unit(i):
    """Return the unit vector along coordinate ``i``; zero beyond the third."""
    return 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0


@inlined
def dof_axis(kind, world, node, index):
    """Return the world axis x, y, z of a degree of freedom of a node, and if it is rotational."""
    joint = kind[node]
    if joint == FREE and index < 3:
        x, y, z = unit(index)
        return x, y, z, False
    column = 2 if joint in (HINGE, SLIDE) else index % 3
    x = world[node, 3 + column]
    y = world[node, 6 + column]
    z = world[node, 9 + column]
    return x, y, z, joint != SLIDE


@inlined
def velocity_of(tree, world, v, point):
    """Return linear velocity of a point and angular velocity, per unit of degree of freedom v."""
    node = tree.dof_node[v]
    x, y, z, rotational = dof_axis(tree.kind, world, node, v - tree.vadr[node])
    axis = (x, y, z)
    if not rotational:
        return axis, (0.0, 0.0, 0.0)
    lever = so3.subtract(point, so3.read_vector(world, node, 0))
    return so3.cross(axis, lever), axis


@outlined
def rotate_quat(q, a, x, y, z):
    """Rotate the quaternion q[a : a + 4] in place by the rotation vector (x, y, z) in body axes."""
    w, i, j, k = so3.multiply((q[a], q[a + 1], q[a + 2], q[a + 3]), so3.exp((x, y, z)))
    q[a] = w
    q[a + 1] = i
    q[a + 2] = j
    q[a + 3] = k


@outlined
def integrate(tree, nodes, q, dq):
    """Add dq (nv,) to q (nq,) in place for the listed nodes, as ``mj_integratePos`` does."""
    kind = tree.kind
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a = tree.qadr[k]
        v = tree.vadr[k]
        joint = kind[k]
        if joint in (HINGE, SLIDE):
            q[a] += dq[v]
        elif joint == BALL:
            rotate_quat(q, a, dq[v], dq[v + 1], dq[v + 2])
        else:
            for i in range(3):
                q[a + i] += dq[v + i]
            rotate_quat(q, a + 3, dq[v + 3], dq[v + 4], dq[v + 5])


@inlined
def rotation_back(q, a, rw, rx, ry, rz):
    """Return the shorter rotation vector, body axes, from the quaternion q[a : a + 4] to another.

    The vector is (rw, rx, ry, rz) ⊖ q, as ``mj_differentiatePos`` has it.
    """
    w = q[a] * rw + q[a + 1] * rx + q[a + 2] * ry + q[a + 3] * rz
    x = q[a] * rx - q[a + 1] * rw - q[a + 2] * rz + q[a + 3] * ry
    y = q[a] * ry + q[a + 1] * rz - q[a + 2] * rw - q[a + 3] * rx
    z = q[a] * rz - q[a + 1] * ry + q[a + 2] * rx - q[a + 3] * rw
    if w < 0.0:
        w = -w
        x = -x
        y = -y
        z = -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@outlined
def difference(tree, q, target, dq):
    """Write the change from q to ``target`` (nq,) to dq (nv,), by ``mj_differentiatePos``'s rules.

    It is the inverse of ``integrate``.
    """
    kind = tree.kind
    for k in range(kind.shape[0]):
        a = tree.qadr[k]
        v = tree.vadr[k]
        if kind[k] < BALL:
            dq[v] = target[a] - q[a]
            continue
        if kind[k] == FREE:
            for i in range(3):
                dq[v + i] = target[a + i] - q[a + i]
            a += 3
            v += 3
        phi = rotation_back(q, a, target[a], target[a + 1], target[a + 2], target[a + 3])
        so3.write_vector(dq, v, phi)


@outlined
def clip(tree, nodes, q):
    """Clip q of the listed nodes to the limits, in place."""
    lower = tree.lower
    upper = tree.upper
    for index in range(nodes.shape[0]):
        k = nodes[index]
        a = tree.qadr[k]
        v = tree.vadr[k]
        joint = tree.kind[k]
        if joint in (HINGE, SLIDE):
            q[a] = min(max(q[a], lower[v]), upper[v])
        elif joint == BALL and upper[v] < math.pi:
            n = math.sqrt(q[a + 1] ** 2 + q[a + 2] ** 2 + q[a + 3] ** 2)
            angle = 2.0 * math.atan2(n, abs(q[a]))
            if angle > upper[v]:
                sign = 1.0 if q[a] >= 0.0 else -1.0
                s = sign * math.sin(0.5 * upper[v]) / n
                q[a] = math.cos(0.5 * upper[v])
                for i in range(1, 4):
                    q[a + i] *= s


@kernel
def tree_integrate(tree, nodes, q, dq):
    """Call ``integrate`` with the block of a tree."""
    integrate(open_tree(tree), nodes, q, dq)


@kernel
def tree_follow(tree, q):
    """Call ``follow`` with the block of a tree."""
    follow(open_tree(tree), q)


@kernel
def tree_clip(tree, nodes, q):
    """Call ``clip`` with the block of a tree."""
    clip(open_tree(tree), nodes, q)


@kernel
def tree_frame(tree, nodes, node, local, q, world, scratch, out):
    """Write the pose of the frame at ``local`` (1, 12) on ``node`` to ``out`` (1, 12)."""
    forward(open_tree(tree), nodes, q, world, scratch)
    frame_pose(world, node, local, types.int64(0), out)


@kernel
def tree_poses(tree, nodes, node, local, q, world, scratch, out, positions, wxyz):
    """Write the poses of a frame at ``q`` (n, nq) to ``positions`` (n, 3) and ``wxyz`` (n, 4).

    ``world``, ``scratch`` and ``out`` (1, 12) are overwritten.
    """
    opened = open_tree(tree)
    for row in range(q.shape[0]):
        forward(opened, nodes, q[row], world, scratch)
        frame_pose(world, node, local, types.int64(0), out)
        for i in range(3):
            positions[row, i] = out[0, i]
        quaternion = so3.from_rotation(so3.read_rotation(out, types.int64(0)))
        for i in range(4):
            wxyz[row, i] = quaternion[i]


@kernel
def tree_jacobian(tree, nodes, node, local, q, world, scratch, out, jacobian):
    """Call ``frame_jacobian`` with the block of a tree."""
    frame_jacobian(open_tree(tree), nodes, node, local, q, world, scratch, out, jacobian)


@inlined
def frame_jacobian(tree, nodes, node, local, q, world, scratch, out, jacobian):
    """Write the pose of a frame to ``out`` (1, 12), and its Jacobian to ``jacobian`` (6, nv).

    Rows 0 to 2 are the linear velocity of the origin, rows 3 to 5 the angular velocity, world axes.
    """
    kind = tree.kind
    forward(tree, nodes, q, world, scratch)
    frame_pose(world, node, local, types.int64(0), out)
    if nodes.shape[0] < kind.shape[0]:  # else every column is written
        for row in range(6):
            for v in range(jacobian.shape[1]):
                jacobian[row, v] = 0.0
    point = so3.read_vector(out, 0, 0)
    for index in range(nodes.shape[0]):
        k = nodes[index]
        first = tree.vadr[k]
        for i in range(width_of(kind[k])):
            linear, angular = velocity_of(tree, world, first + i, point)
            so3.write_column(jacobian, 0, first + i, linear)
            so3.write_column(jacobian, 3, first + i, angular)
