"""Closed forms of six hinges: a spherical wrist on two parallel axes, and three parallel axes.

Both work on the product of exponentials T(q) = e₁(q₁) … e₆(q₆) M at the zero configuration: a table
``axes`` (6, 6) of unit direction and a point of each joint axis, world frame, and ``extra`` (5, 3):
the wrist centre in the world at q = 0, the same seen from the tool, and the rows of M's rotation.
Nothing else of the model counts, so names, link frames, base and tool are free.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.vectors import (
    apply,
    apply_back,
    cross,
    dot,
    from_frame,
    into_frame,
    minus,
    plus,
    rotate,
    scaled,
    three,
)  # fmt: skip
from robot_ik.solvers.analytic.subproblems import (
    angle_between,
    angles_to_height,
    image,
    noinline,
    split_inside,
)

# Sine below which two axes count as parallel in a pose (a singular one): the free angle is then kept.
ALIGNED = 1e-7
# Places at which a free angle is tried: the start, the joint's limits, and round the circle from the start.
_FREE_TRIES = 66


@pure
def relative_rotation(target, extra, v):
    """R_target · R_Mᵀ · v: what the joints' rotation makes of v (v as at q = 0)."""
    return apply(target, 0, 3, from_frame(extra, 2, v))


@pure
def relative_back(target, extra, v):
    """R_M · R_targetᵀ · v: the inverse of ``relative_rotation``."""
    return into_frame(extra, 2, apply_back(target, 0, 3, v))


@pure
def centre(target, extra):
    """Where the wrist centre must be, world."""
    return plus(three(target, 0, 0), apply(target, 0, 3, three(extra, 1, 0)))


@pure
def back(axes, j, c, s, v):
    """v rotated about axis j by minus the angle with cosine c and sine s."""
    return rotate(three(axes, j, 0), c, -s, v)


@pure
def before_arm(axes, c, s, v):
    """v before joints 1 to 3 rotated it, by angles of cosines c (3) and sines s (3)."""
    return back(axes, 2, c[2], s[2], back(axes, 1, c[1], s[1], back(axes, 0, c[0], s[0], v)))


@pure
def after_arm(axes, c, s, v):
    """What joints 1 to 3 make of v: the inverse of ``before_arm``."""
    for_three = rotate(three(axes, 2, 0), c[2], s[2], v)
    return rotate(three(axes, 0, 0), c[0], s[0], rotate(three(axes, 1, 0), c[1], s[1], for_three))


@pure
def same_way(u, axes, j):
    """1 where axis j, parallel to u, points the same way, else -1."""
    return 1.0 if dot(u, three(axes, j, 0)) > 0.0 else -1.0


@pure
def elbow_angles(u, f, e, g):
    """Angles a about u at which R(u, a) e − f is as far from the axis as g, as of ``angles_to_height``.

    Of two links that move across u: f and e lead from the elbow to the first axis and to the end, at a = 0;
    g leads from the first axis to where the end is wanted.
    """
    fu, eu, gu = dot(f, u), dot(e, u), dot(g, u)
    reach = (dot(e, e) - eu * eu) + (dot(f, f) - fu * fu)
    far = dot(g, g) - gu * gu
    # (R(u, a) e)·f across u = (|e|² + |f|² − far) / 2
    return angles_to_height(f, u, e, 0.5 * (reach - far) + fu * eu)


@pure
def first_link(u, f, e, c, s, g, kept):
    """The first link's angle for an elbow of cosine c and sine s; ``kept`` where every angle will do."""
    angle, weight = angle_between(u, minus(rotate(u, c, s, e), f), g)
    return kept if weight < 1e-14 else angle


@pure
def one_of(first, middle, half, amplitude, kept):
    """middle ± half; ``kept`` where the angle is free."""
    if amplitude < 1e-12:
        return kept
    return middle + half if first else middle - half


@pure
def free_place(k, start, lower, upper):
    """Where a free angle is tried: at ``start``, ever farther off on both sides, at last at its limits."""
    if k < _FREE_TRIES - 2:
        side = 1.0 if k % 2 == 1 else -1.0
        return start + side * ((k + 1) // 2) * (2.0 * math.pi / (_FREE_TRIES - 2))
    limit = lower if k == _FREE_TRIES - 2 else upper
    return limit if math.isfinite(limit) else start


@pure
def keep_branch(form, row, angles, free):
    """Six angles as a branch, where a free one has no better place yet; whether no other is to be tried.

    The first place counts from which all angles have an image inside their limits, else the first of all.
    """
    branches, fits = form.branches, True
    for j in range(6):
        fits = fits and (not free or image(angles[j], form.start[j], form.lower[j], form.upper[j])[1])
    if fits or math.isnan(branches[row, 0]):
        for j in range(6):
            branches[row, j] = angles[j]
    return fits


@pure
def wrist_angles(form, target, flip, c, s):
    """q4, q5, q6 of the rotation that is left after joints 1 to 3; and whether there are any.

    R₄ R₅ R₆ = Q = (R₁ R₂ R₃)ᵀ R_target R_Mᵀ.  What Q makes of h₆, and its inverse of h₄, is all
    that is needed.
    """
    axes, extra, start, lower, upper = form.axes, form.extra, form.start, form.lower, form.upper
    h4, h5, h6 = three(axes, 3, 0), three(axes, 4, 0), three(axes, 5, 0)
    wanted = before_arm(axes, c, s, relative_rotation(target, extra, h6))  # Q h6
    middle, half, amplitude, possible = angles_to_height(h4, h5, h6, dot(h4, wanted))
    if not possible or amplitude < 1e-12:
        return 0.0, 0.0, 0.0, False
    q5 = middle + half if flip == 0 else middle - half
    c5, s5 = math.cos(q5), math.sin(q5)
    bent = rotate(h5, c5, s5, h6)  # R5 h6
    q4, weight = angle_between(h4, bent, wanted)
    if weight > ALIGNED * ALIGNED:
        held = relative_back(target, extra, after_arm(axes, c, s, h4))  # Qᵀ h4
        q6, _ = angle_between(h6, rotate(h5, c5, -s5, h4), held)  # R5ᵀ h4
        return q4, q5, -q6, True
    # Axes 4 and 6 in line: only q4 ± q6 counts.  The rotation of any vector across them gives it.
    sign = 1.0 if dot(bent, h4) > 0.0 else -1.0
    p = cross(h4, h5)
    turned = rotate(h5, c5, -s5, p)  # R5ᵀ p: what p was before joint 5
    total, _ = angle_between(h4, p, before_arm(axes, c, s, relative_rotation(target, extra, turned)))
    q4, q6 = split_inside(total, sign, start[3], start[5], lower[3], upper[3], lower[5], upper[5])
    return q4, q5, q6, True


@outlined
def spherical_wrist(form, target):
    """All branches of an arm whose axes 2 and 3 are parallel and whose last three meet.

    Fills ``form.branches`` (8, 6; cleared), row = 4·shoulder + 2·elbow + flip.
    """
    noinline()
    axes, extra, start = form.axes, form.extra, form.start
    h1, u, end = three(axes, 0, 0), three(axes, 1, 0), three(extra, 0, 0)
    p1, p2, p3 = three(axes, 0, 3), three(axes, 1, 3), three(axes, 2, 3)
    along3 = same_way(u, axes, 2)
    e, f = minus(end, p3), minus(p2, p3)
    height = dot(u, minus(end, p2)) + dot(u, minus(p2, p1))
    d = minus(centre(target, extra), p1)
    # h · R(h1, -q1) d = height: the sign of the axis makes it subproblem 4.
    middle1, half1, amplitude1, possible = angles_to_height(u, scaled(-1.0, h1), d, height)
    if not possible:
        return
    # With the wrist's centre on axis 1 every q1 does: the place nearest to the start is taken from which all
    # angles are inside their limits, for each branch by itself.
    free, settled = amplitude1 < 1e-12, 0
    for k in range(_FREE_TRIES if free else 2):
        shoulder = 0 if free else k
        q1 = middle1 + half1 if shoulder == 0 else middle1 - half1
        if free:
            q1 = free_place(k, start[0], form.lower[0], form.upper[0])
        c1, s1 = math.cos(q1), math.sin(q1)
        g = minus(plus(rotate(h1, c1, -s1, d), p1), p2)  # p2 -> centre
        middle3, half3, amplitude3, possible = elbow_angles(u, f, e, g)
        if not possible:
            continue
        for elbow in range(2):
            a3 = one_of(elbow == 0, middle3, half3, amplitude3, along3 * start[2])
            c3, s3 = math.cos(a3), math.sin(a3)
            q2 = first_link(u, f, e, c3, s3, g, start[1])
            c, s = (c1, math.cos(q2), c3), (s1, math.sin(q2), along3 * s3)
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
    """All branches of an arm whose axes 2, 3 and 4 are parallel and whose last two meet (Universal Robots).

    Fills ``form.branches`` (8, 6; cleared), row = 4·shoulder + 2·flip + elbow.
    """
    noinline()
    axes, extra, target, start = form.axes, form.extra, form.target, form.start
    h1, u, h5, h6 = three(axes, 0, 0), three(axes, 1, 0), three(axes, 4, 0), three(axes, 5, 0)
    p1, p2, p3, p4 = three(axes, 0, 3), three(axes, 1, 3), three(axes, 2, 3), three(axes, 3, 3)
    along3, along4 = same_way(u, axes, 2), same_way(u, axes, 3)
    end = three(extra, 0, 0)
    d = minus(centre(target, extra), p1)
    middle1, half1, amplitude1, possible = angles_to_height(u, scaled(-1.0, h1), d, dot(u, minus(end, p1)))
    if not possible:
        return
    e, f = minus(p4, p3), minus(p2, p3)
    wanted = relative_rotation(target, extra, h6)
    for shoulder in range(2):
        q1 = one_of(shoulder == 0, middle1, half1, amplitude1, start[0])
        c1, s1 = math.cos(q1), math.sin(q1)
        a = back(axes, 0, c1, s1, wanted)  # Q1 h6
        middle5, half5, amplitude5, possible = angles_to_height(u, h5, h6, dot(u, a))
        if not possible or amplitude5 < 1e-12:
            continue
        g = minus(plus(rotate(h1, c1, -s1, d), p1), p2)  # p2 -> centre
        held = relative_back(target, extra, rotate(h1, c1, s1, u))  # Q1ᵀ u
        for flip in range(2):
            q5 = middle5 + half5 if flip == 0 else middle5 - half5
            c5, s5 = math.cos(q5), math.sin(q5)
            theta, weight = angle_between(u, rotate(h5, c5, s5, h6), a)  # R5 h6
            q6, _ = angle_between(h6, rotate(h5, c5, -s5, u), held)  # R5ᵀ u
            q6 = -q6
            # With axis 6 parallel to the three only θ ± q6 counts.  Taken is the place of q6 nearest to the
            # start from which the elbow reaches and all angles are inside their limits, for each elbow.
            free, settled = weight <= ALIGNED * ALIGNED, 0
            for k in range(_FREE_TRIES if free else 1):
                if free:
                    q6 = free_place(k, start[5], form.lower[5], form.upper[5])
                    # Across u lies h5; what the joints before 6 make of it gives θ.
                    m = relative_rotation(target, extra, rotate(h6, math.cos(q6), -math.sin(q6), h5))
                    theta, _ = angle_between(u, h5, back(axes, 0, c1, s1, m))
                v = minus(g, rotate(u, math.cos(theta), math.sin(theta), minus(end, p4)))  # p2 -> p4
                middle3, half3, amplitude3, possible = elbow_angles(u, f, e, v)
                if not possible:
                    continue
                for elbow in range(2):
                    if settled >> elbow & 1:
                        continue
                    row = 4 * shoulder + 2 * flip + elbow
                    a3 = one_of(elbow == 0, middle3, half3, amplitude3, along3 * start[2])
                    q2 = first_link(u, f, e, math.cos(a3), math.sin(a3), v, start[1])
                    angles = q1, q2, along3 * a3, along4 * (theta - q2 - a3), q5, q6
                    if keep_branch(form, row, angles, free):
                        settled |= 1 << elbow
                if settled == 3:
                    break


@outlined
def planar_two_link(form, slack):
    """Both elbows of a two-link arm for a position, into rows 0 and 1 of ``form.branches`` (cleared).

    Row 0 of ``form.extra`` is the tool at q = 0.  ``slack`` (m): how far the target may lie off the plane in
    which the tool moves.
    """
    noinline()
    axes, extra, target, start = form.axes, form.extra, form.target, form.start
    u, p1, p2 = three(axes, 0, 0), three(axes, 0, 3), three(axes, 1, 3)
    along = same_way(u, axes, 1)
    g, e, f = minus(three(target, 0, 0), p1), minus(three(extra, 0, 0), p2), minus(p1, p2)
    if abs(dot(g, u) - (dot(e, u) - dot(f, u))) > slack:
        return
    middle, half, amplitude, possible = elbow_angles(u, f, e, g)
    if not possible:
        return
    for elbow in range(2):
        a2 = one_of(elbow == 0, middle, half, amplitude, along * start[1])
        q1 = first_link(u, f, e, math.cos(a2), math.sin(a2), g, start[0])
        form.branches[elbow, 0], form.branches[elbow, 1] = q1, along * a2
