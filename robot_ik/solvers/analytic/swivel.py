"""Shoulder and wrist of a limb as functions of its swivel angle.

With the shoulder at p, the wrist's centre at w and n the unit vector between them, the elbow's angle is
known and what is left is a rotation about n: S(φ) = R(n, φ) S₀.  S₀ is the start's own rotation brought to
the goal by the smallest rotation, so that φ = 0 is the swivel of the start.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.kinematics import unit
from robot_ik.kernels.vectors import (
    apply,
    apply_back,
    cross,
    dot,
    from_frame,
    into_frame,
    length,
    minus,
    over,
    plus,
    rotate,
    scaled,
    three,
)  # fmt: skip
from robot_ik.solvers.analytic.recognise import BALL_JOINT, HINGES
from robot_ik.solvers.analytic.subproblems import angle_between, image, noinline, split_inside

# Rows of form.matrices: the start's shoulder, S₀, the goal's rotation of all joints, S₀ with the elbow's
# rotation, then the rotations of shoulder and wrist at the swivel angle of the moment.
START, ORIGIN, WHOLE, BENT, ROTATED = 0, 1, 2, 3, 4


@pure
def column(m, r, j):
    """Column j of the matrix in row r of m."""
    return m[r, j], m[r, 3 + j], m[r, 6 + j]


@pure
def put_column(m, r, j, v):
    """v in place of that column."""
    m[r, j], m[r, 3 + j], m[r, 6 + j] = v


@outlined
def start_rotation(form):
    """What the start makes of the shoulder, into matrices[START]."""
    noinline()
    m, axes, start = form.matrices, form.axes, form.start
    if form.groups[0, 0] == BALL_JOINT:
        # A ball joint rotates in its own frame; its axes stand in the table.
        w = start[0]
        x, y, z = from_frame(axes, 0, (start[1], start[2], start[3]))
        s = 2.0 / max(w * w + x * x + y * y + z * z, 1e-30)
        put_column(m, START, 0, (1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)))
        put_column(m, START, 1, (s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)))
        put_column(m, START, 2, (s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)))
        return
    for j in range(3):
        v = unit(j)
        for k in range(2, -1, -1):
            v = rotate(three(axes, k, 0), math.cos(start[k]), math.sin(start[k]), v)
        put_column(m, START, j, v)


@outlined
def make_parts(form, angle, v, n):
    """Rotations of shoulder and wrist as functions of the swivel angle, for an elbow at ``angle``.

    v and n are unit vectors from the shoulder to the wrist's centre: as the elbow makes it, and wanted.
    """
    noinline()
    m, parts, axes, spin = form.matrices, form.parts, form.axes, form.spin
    a = apply(m, START, 0, v)
    k, c, sine = cross(a, n), dot(a, n), 1.0
    if c < -1.0 + 1e-12:  # by π, about any axis across n
        k = (0.0, n[2], -n[1]) if abs(n[0]) < 0.6 else (-n[2], 0.0, n[0])
        c, sine, scale = -1.0, 0.0, 2.0 / dot(k, k)
    else:
        scale = 1.0 / (1.0 + c)
    u, ce, se = three(axes, 3, 0), math.cos(angle), math.sin(angle)
    for j in range(3):
        x = column(m, START, j)
        along = plus(scaled(c, x), scaled(sine, cross(k, x)))
        put_column(m, ORIGIN, j, plus(along, scaled(dot(k, x) * scale, k)))
    for j in range(3):
        x = column(m, ORIGIN, j)
        along = scaled(dot(n, x), n)
        put_column(parts, 0, j, along)
        put_column(parts, 0, 9 + j, minus(x, along))
        put_column(parts, 0, 18 + j, cross(n, x))
        put_column(m, BENT, j, apply(m, ORIGIN, 0, rotate(u, ce, se, unit(j))))
    # Wrist: W(φ) = BENTᵀ R(n, -φ) WHOLE.
    b = apply_back(m, BENT, 0, n)
    spin[0, 0], spin[0, 1], spin[0, 2] = n
    spin[1, 0], spin[1, 1], spin[1, 2] = scaled(-1.0, b)
    for j in range(3):
        x = column(m, WHOLE, j)
        along = scaled(dot(n, x), b)
        put_column(parts, 1, j, along)
        put_column(parts, 1, 9 + j, minus(apply_back(m, BENT, 0, x), along))
        put_column(parts, 1, 18 + j, scaled(-1.0, apply_back(m, BENT, 0, cross(n, x))))


@outlined
def swing(form, g, c, s):
    """The rotation of shoulder (g = 0) or wrist (1) at the swivel angle of this cosine and sine."""
    parts, m = form.parts, form.matrices
    row = ROTATED + g
    for i in range(9):
        m[row, i] = parts[g, i] + c * parts[g, 9 + i] + s * parts[g, 18 + i]


# Sine below which axes 1 and 3 are nearly in line, and the formulas take more care of digits.
_NEARLY = 1e-3
# Volume of three axes from which they count as lying in a plane: the joints' speeds are then without bound.
_FLAT = 1e-6
# Sine below which two axes count as one (a singular pose): the free angle then stays near the start.
ALIGNED = 1e-8


@outlined
def score(form, g, first_flip, last_flip, lower, upper):
    """Joint angles of the rotation made by ``swing``, into trial; their squared distances to the start.

    Flips are the two solutions of three hinges.  The distances go into scores[2 g + flip]; infinite where
    there is no solution inside the limits.  Returns the smallest.
    """
    scores, how = form.scores, form.groups[g, 0]
    for flip in range(first_flip, last_flip + 1):
        scores[2 * g + flip] = math.inf
    if how == HINGES:
        three_hinges(form, g, first_flip, last_flip, lower, upper)
    elif first_flip == 0:
        scores[2 * g] = ball(form, g, upper) if how == BALL_JOINT else 0.0
    return min(scores[2 * g + first_flip], scores[2 * g + last_flip])


@outlined
def three_hinges(form, g, first_flip, last_flip, lower, upper):
    """``score`` of three hinges that meet: R₁ R₂ R₃ = matrices[ROTATED + g]."""
    noinline()
    axes, m, start, trial, scores = form.axes, form.matrices, form.start, form.trial, form.scores
    k, row, j = 4 * g, ROTATED + g, form.groups[g, 1]
    h1, h2, h3 = three(axes, k, 0), three(axes, k + 1, 0), three(axes, k + 2, 0)
    wanted = apply(m, row, 0, h3)  # R₁ R₂ h₃
    amplitude, middle = form.middle_rotations[g, 1], form.middle_rotations[g, 2]
    rest = dot(h1, wanted) - form.middle_rotations[g, 0]
    if abs(rest) > amplitude + 1e-9:
        return
    # 1 - cos is exact only by way of the sine, and counts where axes 1 and 3 come in line.
    above, below, cosine = amplitude - rest, amplitude + rest, rest + form.middle_rotations[g, 0]
    sine = cross(h1, wanted)
    sine2 = dot(sine, sine)
    if cosine > 0.0 and abs(form.middle_rotations[g, 0] + amplitude - 1.0) < 1e-12:
        above = sine2 / (1.0 + cosine)
    elif cosine < 0.0 and abs(form.middle_rotations[g, 0] - amplitude + 1.0) < 1e-12:
        below = sine2 / (1.0 - cosine)
    side = math.sqrt(max(0.0, above * below))
    half = math.atan2(side, rest)
    held = apply_back(m, row, 0, h1)  # R₃ᵀ R₂ᵀ h₁
    for flip in range(first_flip, last_flip + 1):
        second = middle + (half if flip == 0 else -half)
        two, inside = image(second, start[j + 1], lower[j + 1], upper[j + 1])
        if not inside:
            continue
        c, s = math.cos(second), math.sin(second)
        a = rotate(h2, c, s, h3)  # R₂ h₃
        one, weight = angle_between(h1, a, wanted)
        if weight > ALIGNED * ALIGNED:
            one, inside = image(one, start[j], lower[j], upper[j])
            if not inside:
                continue
            last, _ = angle_between(h3, held, rotate(h2, c, -s, h1))  # R₂ᵀ h₁
            if weight < _NEARLY * _NEARLY:  # what q₁ lacks in digits q₃ must make up for
                p = cross(h3, h2)
                left = rotate(h1, math.cos(one), -math.sin(one), apply(m, row, 0, p))
                last, _ = angle_between(h3, p, rotate(h2, c, -s, left))
        else:  # axes 1 and 3 in line: only q₁ ± q₃ counts; the rotation of a vector across them gives it
            p = cross(h1, h2)
            total, _ = angle_between(h1, p, apply(m, row, 0, rotate(h2, c, -s, p)))
            one, last = split_inside(
                total, 1.0 if dot(a, h1) > 0.0 else -1.0, start[j], start[j + 2],
                lower[j], upper[j], lower[j + 2], upper[j + 2],
            )  # fmt: skip
            one, inside = image(one, start[j], lower[j], upper[j])
            if not inside:
                continue
        last, inside = image(last, start[j + 2], lower[j + 2], upper[j + 2])
        if not inside:
            continue
        trial[flip, j], trial[flip, j + 1], trial[flip, j + 2] = one, two, last
        off = one - start[j], two - start[j + 1], last - start[j + 2]
        scores[2 * g + flip] = dot(off, off)


@outlined
def ball(form, g, upper):
    """``score`` of a ball joint: its quaternion, of the two the one nearer to the start's."""
    noinline()
    m, start, trial = form.matrices, form.start, form.trial
    row, first, t = ROTATED + g, form.groups[g, 1], types.int64(0)
    trace = m[row, 0] + m[row, 4] + m[row, 8]
    xx, yy, zz = m[row, 0], m[row, 4], m[row, 8]
    wx, wy, wz = m[row, 7] - m[row, 5], m[row, 2] - m[row, 6], m[row, 3] - m[row, 1]
    xy, xz, yz = m[row, 1] + m[row, 3], m[row, 2] + m[row, 6], m[row, 5] + m[row, 7]
    # Of the four ways to the quaternion the one that divides by its largest number (Shepperd 1978).
    if trace >= max(xx, yy, zz):
        w, x, y, z = 1.0 + trace, wx, wy, wz
    elif xx >= yy and xx >= zz:
        w, x, y, z = wx, 1.0 + xx - yy - zz, xy, xz
    elif yy >= zz:
        w, x, y, z = wy, xy, 1.0 + yy - xx - zz, yz
    else:
        w, x, y, z = wz, xz, yz, 1.0 + zz - xx - yy
    x, y, z = into_frame(form.axes, 4 * g, (x, y, z))
    a, b, c, d = start[first], start[first + 1], start[first + 2], start[first + 3]
    size = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if a * w + b * x + c * y + d * z < 0.0:
        size = -size
    w, x, y, z = w * size, x * size, y * size, z * size
    angle = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
    if angle > upper[first] + 1e-9:
        return math.inf
    trial[t, first], trial[t, first + 1], trial[t, first + 2], trial[t, first + 3] = w, x, y, z
    # The rotation from the start to here, and how it grows with the swivel.
    p = a * x - b * w - d * y + c * z, a * y - c * w - b * z + d * x, a * z - d * w - c * x + b * y
    p = from_frame(form.axes, 4 * g, p)
    sine = length(p)
    between = 2.0 * math.atan2(sine, a * w + b * x + c * y + d * z)
    form.speeds[g] = dot(p, three(form.spin, g, 0)) / max(sine, 1e-30)
    return between * between


@outlined
def add_slope(form, g, flip):
    """Adds what ``score`` just found to scores[4] (half its slope by the swivel angle) and scores[5].

    Those are Σ (q - start) q' and Σ q'² of the joints' speeds q', from the axes a: Σ aᵢ q'ᵢ = the spin.
    Where the axes lie in a plane the second is infinite.
    """
    noinline()
    scores, axes, trial, start = form.scores, form.axes, form.trial, form.start
    how = form.groups[g, 0]
    if how == BALL_JOINT:
        scores[4] += math.sqrt(scores[2 * g + flip]) * form.speeds[g]
        scores[5] += 1.0
    if how != HINGES:
        return
    k, j = 4 * g, form.groups[g, 1]
    a, one = three(axes, k, 0), trial[flip, j]
    b = rotate(a, math.cos(one), math.sin(one), three(axes, k + 1, 0))
    c = apply(form.matrices, ROTATED + g, 0, three(axes, k + 2, 0))
    n, across = three(form.spin, g, 0), cross(b, c)
    volume = dot(a, across)
    if abs(volume) < _FLAT:
        scores[5] = math.inf
        return
    speeds = over((dot(n, across), dot(n, cross(c, a)), dot(n, cross(a, b))), volume)
    scores[4] += (one - start[j]) * speeds[0]
    scores[4] += (trial[flip, j + 1] - start[j + 1]) * speeds[1] + (
        trial[flip, j + 2] - start[j + 2]
    ) * speeds[2]
    scores[5] += dot(speeds, speeds)
