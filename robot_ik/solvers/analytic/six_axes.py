"""Closed forms of six hinges: a spherical wrist on two parallel axes, and three parallel axes.

Both work on the product of exponentials T(q) = e₁(q₁) … e₆(q₆) M at the zero configuration: a table
``axes`` (6, 6) of unit direction and a point of each joint axis, world frame, and ``extra`` (5, 3):
the wrist centre in the world at q = 0, the same seen from the tool, and the rows of M's rotation.
Nothing else of the model counts, so names, link frames, base and tool are free.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels import so3
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.solvers.analytic.subproblems import (
    angle_between,
    angles_to_height,
    image,
    noinline,
    split_inside,
)

# Sine below which two axes count as parallel in a pose. Such a pose is singular, and the free angle
# keeps its start.
ALIGNED = 1e-7
# Values that are tried for a free angle: the start, places around the circle, and the limits.
_FREE_TRIES = 66


@inlined
def zero_rotation(extra):
    """Return R_M, the rotation of the tool at q = 0."""
    return so3.read_vector(extra, 2, 0), so3.read_vector(extra, 3, 0), so3.read_vector(extra, 4, 0)


@inlined
def relative_rotation(target, extra, v):
    """Return R_target · R_Mᵀ · v: the vector v at q = 0, rotated by the joints."""
    return so3.apply(so3.read_rotation(target, 0), so3.apply_inverse(zero_rotation(extra), v))


@inlined
def relative_back(target, extra, v):
    """Return R_M · R_targetᵀ · v: the inverse of ``relative_rotation``."""
    return so3.apply(zero_rotation(extra), so3.apply_inverse(so3.read_rotation(target, 0), v))


@inlined
def centre(target, extra):
    """Return the position of the wrist centre at the target, world."""
    return so3.add(
        so3.read_vector(target, 0, 0),
        so3.apply(so3.read_rotation(target, 0), so3.read_vector(extra, 1, 0)),
    )


@inlined
def rotate_back(axes, j, c, s, v):
    """Return v rotated about axis j by minus the angle with cosine c and sine s."""
    return so3.rotate(so3.read_vector(axes, j, 0), c, -s, v)


@inlined
def before_arm(axes, c, s, v):
    """Return v before the rotation by joints 1 to 3, of cosines c (3) and sines s (3)."""
    return rotate_back(
        axes, 2, c[2], s[2], rotate_back(axes, 1, c[1], s[1], rotate_back(axes, 0, c[0], s[0], v))
    )


@inlined
def after_arm(axes, c, s, v):
    """Return v rotated by joints 1 to 3: the inverse of ``before_arm``."""
    for_three = so3.rotate(so3.read_vector(axes, 2, 0), c[2], s[2], v)
    return so3.rotate(
        so3.read_vector(axes, 0, 0),
        c[0],
        s[0],
        so3.rotate(so3.read_vector(axes, 1, 0), c[1], s[1], for_three),
    )


@inlined
def axis_sign(u, axes, j):
    """Return 1 if axis j, parallel to u, has the same direction, else -1."""
    return 1.0 if so3.dot(u, so3.read_vector(axes, j, 0)) > 0.0 else -1.0


@inlined
def elbow_angles(u, f, e, g):
    """Return the angles a about u at which R(u, a) e − f is as far from the axis as g.

    The result has the form of ``angles_to_height``. Two links move perpendicular to u. f and e are
    the vectors from the elbow to the first axis and to the end at a = 0. g is the vector from the
    first axis to the target.
    """
    fu = so3.dot(f, u)
    eu = so3.dot(e, u)
    gu = so3.dot(g, u)
    reach = (so3.dot(e, e) - eu * eu) + (so3.dot(f, f) - fu * fu)
    wanted = so3.dot(g, g) - gu * gu
    # (R(u, a) e)·f across u = (|e|² + |f|² − wanted) / 2
    return angles_to_height(f, u, e, 0.5 * (reach - wanted) + fu * eu)


@inlined
def first_link(u, f, e, c, s, g, fallback):
    """Return the angle of the first link for the elbow (c, s); ``fallback`` if every angle fits."""
    angle, weight = angle_between(u, so3.subtract(so3.rotate(u, c, s, e), f), g)
    return fallback if weight < 1e-14 else angle


@inlined
def pick_angle(first, middle, half, amplitude, fallback):
    """Return middle + half or middle − half; ``fallback`` if the angle is free."""
    if amplitude < 1e-12:
        return fallback
    return middle + half if first else middle - half


@inlined
def free_place(k, start, lower, upper):
    """Return try k of a free angle: outwards from ``start`` on both sides, then the limits."""
    if k < _FREE_TRIES - 2:
        side = 1.0 if k % 2 == 1 else -1.0
        return start + side * ((k + 1) // 2) * (2.0 * math.pi / (_FREE_TRIES - 2))
    limit = lower if k == _FREE_TRIES - 2 else upper
    return limit if math.isfinite(limit) else start


@inlined
def keep_branch(form, row, angles, free):
    """Write six angles as a branch unless a better try exists; return whether to stop the tries.

    The best try is the first whose angles all have an image inside their limits, else the first.
    """
    branches = form.branches
    fits = True
    for j in range(6):
        fits = fits and (
            not free or image(angles[j], form.start[j], form.lower[j], form.upper[j])[1]
        )
    if fits or math.isnan(branches[row, 0]):
        for j in range(6):
            branches[row, j] = angles[j]
    return fits


@inlined
def wrist_angles(form, target, flip, c, s):
    """Return q4, q5, q6 for the rotation that remains after joints 1 to 3, and if they exist.

    R₄ R₅ R₆ = Q = (R₁ R₂ R₃)ᵀ R_target R_Mᵀ. Only Q h₆ and Qᵀ h₄ are needed.
    """
    axes = form.axes
    extra = form.extra
    start = form.start
    lower = form.lower
    upper = form.upper
    h4 = so3.read_vector(axes, 3, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    wanted = before_arm(axes, c, s, relative_rotation(target, extra, h6))  # Q h6
    middle, half, amplitude, possible = angles_to_height(h4, h5, h6, so3.dot(h4, wanted))
    if not possible or amplitude < 1e-12:
        return 0.0, 0.0, 0.0, False
    q5 = middle + half if flip == 0 else middle - half
    c5 = math.cos(q5)
    s5 = math.sin(q5)
    bent = so3.rotate(h5, c5, s5, h6)  # R5 h6
    q4, weight = angle_between(h4, bent, wanted)
    if weight > ALIGNED * ALIGNED:
        base_axis = relative_back(target, extra, after_arm(axes, c, s, h4))  # Qᵀ h4
        q6, _ = angle_between(h6, so3.rotate(h5, c5, -s5, h4), base_axis)  # R5ᵀ h4
        return q4, q5, -q6, True
    # Axes 4 and 6 are aligned, so only q4 ± q6 counts. The rotation of any perpendicular vector
    # gives it.
    sign = 1.0 if so3.dot(bent, h4) > 0.0 else -1.0
    p = so3.cross(h4, h5)
    turned = so3.rotate(h5, c5, -s5, p)  # R5ᵀ p: p before joint 5
    total, _ = angle_between(
        h4, p, before_arm(axes, c, s, relative_rotation(target, extra, turned))
    )
    q4, q6 = split_inside(total, sign, start[3], start[5], lower[3], upper[3], lower[5], upper[5])
    return q4, q5, q6, True


@outlined
def spherical_wrist(form, target):
    """Find all branches of an arm with parallel axes 2, 3 and three last axes that meet.

    Fills ``form.branches`` (8, 6), which is cleared, with the row 4·shoulder + 2·elbow + flip.
    """
    noinline()
    axes = form.axes
    extra = form.extra
    start = form.start
    h1 = so3.read_vector(axes, 0, 0)
    u = so3.read_vector(axes, 1, 0)
    end = so3.read_vector(extra, 0, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    p3 = so3.read_vector(axes, 2, 3)
    along3 = axis_sign(u, axes, 2)
    e = so3.subtract(end, p3)
    f = so3.subtract(p2, p3)
    height = so3.dot(u, so3.subtract(end, p2)) + so3.dot(u, so3.subtract(p2, p1))
    d = so3.subtract(centre(target, extra), p1)
    # h · R(h1, -q1) d = height: the sign of the axis makes it subproblem 4.
    middle1, half1, amplitude1, possible = angles_to_height(u, so3.scale(-1.0, h1), d, height)
    if not possible:
        return
    # If the centre of the wrist lies on axis 1, q1 is free. Each branch takes the value nearest to
    # the start for which all angles are inside their limits.
    free = amplitude1 < 1e-12
    settled = 0
    for k in range(_FREE_TRIES if free else 2):
        shoulder = 0 if free else k
        q1 = middle1 + half1 if shoulder == 0 else middle1 - half1
        if free:
            q1 = free_place(k, start[0], form.lower[0], form.upper[0])
        c1 = math.cos(q1)
        s1 = math.sin(q1)
        g = so3.subtract(so3.add(so3.rotate(h1, c1, -s1, d), p1), p2)  # p2 -> centre
        middle3, half3, amplitude3, possible = elbow_angles(u, f, e, g)
        if not possible:
            continue
        for elbow in range(2):
            a3 = pick_angle(elbow == 0, middle3, half3, amplitude3, along3 * start[2])
            c3 = math.cos(a3)
            s3 = math.sin(a3)
            q2 = first_link(u, f, e, c3, s3, g, start[1])
            c = (c1, math.cos(q2), c3)
            s = (s1, math.sin(q2), along3 * s3)
            for flip in range(2):
                row = 4 * shoulder + 2 * elbow + flip
                if settled >> row & 1:
                    continue
                q4, q5, q6, possible = wrist_angles(form, target, flip, c, s)
                if possible and keep_branch(form, row, (q1, q2, along3 * a3, q4, q5, q6), free):
                    settled |= 1 << row
        if free and settled == 15:
            break


@outlined
def three_parallel(form):
    """Find all branches of an arm with parallel axes 2, 3, 4 and intersecting axes 5, 6.

    Universal Robots builds such arms. Fills ``form.branches`` (8, 6), which is cleared, with the
    row 4·shoulder + 2·flip + elbow.
    """
    noinline()
    axes = form.axes
    extra = form.extra
    target = form.target
    start = form.start
    h1 = so3.read_vector(axes, 0, 0)
    u = so3.read_vector(axes, 1, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    p3 = so3.read_vector(axes, 2, 3)
    p4 = so3.read_vector(axes, 3, 3)
    along3 = axis_sign(u, axes, 2)
    along4 = axis_sign(u, axes, 3)
    end = so3.read_vector(extra, 0, 0)
    d = so3.subtract(centre(target, extra), p1)
    middle1, half1, amplitude1, possible = angles_to_height(
        u, so3.scale(-1.0, h1), d, so3.dot(u, so3.subtract(end, p1))
    )
    if not possible:
        return
    e = so3.subtract(p4, p3)
    f = so3.subtract(p2, p3)
    wanted = relative_rotation(target, extra, h6)
    for shoulder in range(2):
        q1 = pick_angle(shoulder == 0, middle1, half1, amplitude1, start[0])
        c1 = math.cos(q1)
        s1 = math.sin(q1)
        a = rotate_back(axes, 0, c1, s1, wanted)  # Q1 h6
        middle5, half5, amplitude5, possible = angles_to_height(u, h5, h6, so3.dot(u, a))
        if not possible or amplitude5 < 1e-12:
            continue
        g = so3.subtract(so3.add(so3.rotate(h1, c1, -s1, d), p1), p2)  # p2 -> centre
        base_axis = relative_back(target, extra, so3.rotate(h1, c1, s1, u))  # Q1ᵀ u
        for flip in range(2):
            q5 = middle5 + half5 if flip == 0 else middle5 - half5
            c5 = math.cos(q5)
            s5 = math.sin(q5)
            theta, weight = angle_between(u, so3.rotate(h5, c5, s5, h6), a)  # R5 h6
            q6, _ = angle_between(h6, so3.rotate(h5, c5, -s5, u), base_axis)  # R5ᵀ u
            q6 = -q6
            # If axis 6 is parallel to the three, only θ ± q6 matters. Each elbow takes the q6
            # nearest to the start for which the elbow reaches and all angles are inside limits.
            free = weight <= ALIGNED * ALIGNED
            settled = 0
            for k in range(_FREE_TRIES if free else 1):
                if free:
                    q6 = free_place(k, start[5], form.lower[5], form.upper[5])
                    # h5 is perpendicular to u. Its rotation by the joints before 6 gives θ.
                    m = relative_rotation(
                        target, extra, so3.rotate(h6, math.cos(q6), -math.sin(q6), h5)
                    )
                    theta, _ = angle_between(u, h5, rotate_back(axes, 0, c1, s1, m))
                v = so3.subtract(
                    g, so3.rotate(u, math.cos(theta), math.sin(theta), so3.subtract(end, p4))
                )  # p2 -> p4
                middle3, half3, amplitude3, possible = elbow_angles(u, f, e, v)
                if not possible:
                    continue
                for elbow in range(2):
                    if settled >> elbow & 1:
                        continue
                    row = 4 * shoulder + 2 * flip + elbow
                    a3 = pick_angle(elbow == 0, middle3, half3, amplitude3, along3 * start[2])
                    q2 = first_link(u, f, e, math.cos(a3), math.sin(a3), v, start[1])
                    angles = q1, q2, along3 * a3, along4 * (theta - q2 - a3), q5, q6
                    if keep_branch(form, row, angles, free):
                        settled |= 1 << elbow
                if settled == 3:
                    break


@outlined
def planar_two_link(form, slack):
    """Write both elbows of a two-link arm to rows 0 and 1 of ``form.branches``, which is cleared.

    Row 0 of ``form.extra`` is the tool at q = 0. ``slack`` is the allowed distance of the target
    from the plane of the tool's motion, m.
    """
    noinline()
    axes = form.axes
    extra = form.extra
    target = form.target
    start = form.start
    u = so3.read_vector(axes, 0, 0)
    p1 = so3.read_vector(axes, 0, 3)
    p2 = so3.read_vector(axes, 1, 3)
    along = axis_sign(u, axes, 1)
    g = so3.subtract(so3.read_vector(target, 0, 0), p1)
    e = so3.subtract(so3.read_vector(extra, 0, 0), p2)
    f = so3.subtract(p1, p2)
    if abs(so3.dot(g, u) - (so3.dot(e, u) - so3.dot(f, u))) > slack:
        return
    middle, half, amplitude, possible = elbow_angles(u, f, e, g)
    if not possible:
        return
    for elbow in range(2):
        a2 = pick_angle(elbow == 0, middle, half, amplitude, along * start[1])
        q1 = first_link(u, f, e, math.cos(a2), math.sin(a2), g, start[0])
        form.branches[elbow, 0] = q1
        form.branches[elbow, 1] = along * a2
