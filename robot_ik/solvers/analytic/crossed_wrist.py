"""Closed form of six hinges: a spherical shoulder, any elbow, and two last axes that meet.

A Franka Panda with a fixed last joint is such an arm (He & Liu, Analytical inverse kinematics for
Franka Emika Panda, 2021). This module derives the form for any arm of this class from its joint
axes alone. Axes 1 to 3 meet in the point S. Axes 5 and 6 meet in the point W.

    elbow     axis 4 alone changes the distance of S and W                      subproblem 3
    wrist     axes 5 and 6 bring S to its position, seen from the last link     subproblem 2
    shoulder  axes 1 to 3 produce the remaining rotation                        subproblems 4, 1

Each has up to two solutions. The tables ``axes`` and ``extra`` are those of ``six_axes.py``, with W
in place of the wrist's centre. ``extra`` has a sixth row, S.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from robot_ik.kernels import so3
from robot_ik.kernels.jit import inlined, outlined
from robot_ik.solvers.analytic.six_axes import (
    ALIGNED,
    centre,
    pick_angle,
    relative_back,
    relative_rotation,
)
from robot_ik.solvers.analytic.subproblems import (
    angle_between,
    angles_to_height,
    image,
    noinline,
    split_inside,
)

# A product of lengths, m², below which every angle of axis 5 is a solution.
_ON_AXIS = 1e-14


@inlined
def behind_wrist(axes, c, s, v):
    """Return R₄ R₅ R₆ v for the cosines c (3) and sines s (3) of joints 4 to 6."""
    v = so3.rotate(so3.read_vector(axes, 5, 0), c[2], s[2], v)
    v = so3.rotate(so3.read_vector(axes, 4, 0), c[1], s[1], v)
    return so3.rotate(so3.read_vector(axes, 3, 0), c[0], s[0], v)


@inlined
def before_wrist(axes, c, s, v):
    """Return (R₄ R₅ R₆)ᵀ v: the inverse of ``behind_wrist``."""
    v = so3.rotate(so3.read_vector(axes, 3, 0), c[0], -s[0], v)
    v = so3.rotate(so3.read_vector(axes, 4, 0), c[1], -s[1], v)
    return so3.rotate(so3.read_vector(axes, 5, 0), c[2], -s[2], v)


@inlined
def shoulder_angles(form, target, flip, c, s):
    """Return q1, q2, q3 for the rotation that remains before joints 4 to 6, and if they exist.

    R₁ R₂ R₃ = Q = R_target R_Mᵀ (R₄ R₅ R₆)ᵀ. Only Q h₃ and Qᵀ h₁ are needed.
    """
    axes = form.axes
    extra = form.extra
    start = form.start
    h1 = so3.read_vector(axes, 0, 0)
    h2 = so3.read_vector(axes, 1, 0)
    h3 = so3.read_vector(axes, 2, 0)
    wanted = relative_rotation(target, extra, before_wrist(axes, c, s, h3))  # Q h3
    middle, half, amplitude, possible = angles_to_height(h1, h2, h3, so3.dot(h1, wanted))
    if not possible or amplitude < 1e-12:
        return 0.0, 0.0, 0.0, False
    q2 = middle + half if flip == 0 else middle - half
    c2 = math.cos(q2)
    s2 = math.sin(q2)
    bent = so3.rotate(h2, c2, s2, h3)  # R2 h3
    q1, weight = angle_between(h1, bent, wanted)
    if weight > ALIGNED * ALIGNED:
        base_axis = behind_wrist(axes, c, s, relative_back(target, extra, h1))  # Qᵀ h1
        q3, _ = angle_between(h3, so3.rotate(h2, c2, -s2, h1), base_axis)  # R2ᵀ h1
        return q1, q2, -q3, True
    # Axes 1 and 3 are aligned, so only q1 ± q3 counts. The rotation of any perpendicular vector
    # gives it.
    sign = 1.0 if so3.dot(bent, h1) > 0.0 else -1.0
    across = so3.cross(h1, h2)
    turned = before_wrist(axes, c, s, so3.rotate(h2, c2, -s2, across))
    total, _ = angle_between(h1, across, relative_rotation(target, extra, turned))
    q1, q3 = split_inside(
        total,
        sign,
        start[0],
        start[2],
        form.lower[0],
        form.upper[0],
        form.lower[2],
        form.upper[2],
    )
    return q1, q2, q3, True


@inlined
def is_inside(form, j, angle):
    """Return whether an angle of a joint, up to multiples of 2π, is inside its limits."""
    return image(angle, form.start[j], form.lower[j], form.upper[j])[1]


@outlined
def crossed_wrist(form, inside_only):
    """Find all branches of an arm with a spherical shoulder and two last axes that meet.

    Fills ``form.branches`` (8, 6), which is cleared, with the row 4·elbow + 2·wrist + shoulder. If
    S lies on axis 5 or 6, one angle is free and keeps its start. With ``inside_only`` branches with
    joint 4, 5 or 6 outside its limits may be left out, which saves their shoulders.
    """
    noinline()
    axes = form.axes
    extra = form.extra
    target = form.target
    start = form.start
    branches = form.branches
    h4 = so3.read_vector(axes, 3, 0)
    h5 = so3.read_vector(axes, 4, 0)
    h6 = so3.read_vector(axes, 5, 0)
    p4 = so3.read_vector(axes, 3, 3)
    shoulder = so3.read_vector(extra, 5, 0)
    e = so3.subtract(so3.read_vector(extra, 0, 0), p4)  # elbow -> W at q = 0
    f = so3.subtract(shoulder, p4)  # elbow -> S
    between = so3.subtract(shoulder, centre(target, extra))  # W -> S
    # |R4 e - f| = |W - S|
    height = 0.5 * (so3.dot(e, e) + so3.dot(f, f) - so3.dot(between, between))
    middle4, half4, _, possible = angles_to_height(f, h4, e, height)
    if not possible:
        return
    b = relative_back(target, extra, between)  # W -> S, seen from the last link
    for elbow in range(2):
        q4 = middle4 + half4 if elbow == 0 else middle4 - half4
        if inside_only and not is_inside(form, 3, q4):
            continue
        c4 = math.cos(q4)
        s4 = math.sin(q4)
        a = so3.subtract(so3.rotate(h4, c4, -s4, f), e)  # W -> S, seen from the forearm
        # R(h5, -q5) a = R(h6, q6) b
        middle6, half6, amplitude6, possible = angles_to_height(h5, h6, b, so3.dot(h5, a))
        if not possible:
            continue
        for wrist in range(2):
            q6 = pick_angle(wrist == 0, middle6, half6, amplitude6, start[5])
            if inside_only and not is_inside(form, 5, q6):
                continue
            c6 = math.cos(q6)
            s6 = math.sin(q6)
            q5, weight = angle_between(h5, a, so3.rotate(h6, c6, s6, b))
            q5 = start[4] if weight < _ON_AXIS else -q5
            if inside_only and not is_inside(form, 4, q5):
                continue
            c = (c4, math.cos(q5), c6)
            s = (s4, math.sin(q5), s6)
            for flip in range(2):
                q1, q2, q3, possible = shoulder_angles(form, target, flip, c, s)
                if not possible:
                    continue
                row = 4 * elbow + 2 * wrist + flip
                branches[row, 0] = q1
                branches[row, 1] = q2
                branches[row, 2] = q3
                branches[row, 3] = q4
                branches[row, 4] = q5
                branches[row, 5] = q6
