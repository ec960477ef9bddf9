"""What the steps of the Jacobian methods share: clamped residual, joints at their bounds, capped changes.

A step is made as follows; the middle is what makes a method:

    prepare(tree, goal, work, clamp, alternative)
    fix_pushed_by_gradient(work)
    for _ in range(work.step.shape[0] + 1):
        ...                              # fills work.step from work.jacobian and work.wanted
        if not fix_pushed_by_step(work):
            break
    keep_inside(work)
    cap(work, gain, max_step)

A *fixed* joint stands at its bound and would be pushed out: its column is zero, so that the others do
its work and it holds no other joint back.  Joints inside their range are never fixed.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from robot_ik.kernels import workspace as ws
from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.linalg import AT_BOUND, pushed_out, row_dot
from robot_ik.kernels.loop import step_bounds
from robot_ik.kernels.residuals import clamp_residual, goal_jacobian

# Damping per length of the residual that a first failure brings in the last descent (``extra_damping``).
_EXTRA_DAMPING = 0.1
# A singular value below this share of the largest is one that can never be anything else: a planar arm's
# motion out of its plane, a joint that is fixed.
NEGLIGIBLE = 1e-9


@outlined
def prepare(tree, goal, work, clamp, alternative):
    """Fills work.jacobian, work.wanted, work.low and work.high at work.q.

    With ``alternative`` a position's rows are those of a point that now stands at the target and moves
    with the frame's body: t in place of s in v × (s − p) (Buss 2004, section 2; Šimunić 2012, eq. 3.9).
    The last descent does without it and clamps all goals alike: it is to end where the cost itself is least.
    """
    last = work.state[ws.POLISHING] > 0
    if alternative and not last:
        goal_jacobian(tree, goal, work, goal.target)
    else:
        goal_jacobian(tree, goal, work, work.frames)
    clamp_residual(goal, work.residual, work.wanted, clamp, last)
    step_bounds(tree, goal, work)


@pure
def fix_joint(work, u):
    """Takes joint ``u`` out of this step."""
    work.side[u] = 1
    for r in range(work.wanted.shape[0]):
        work.jacobian[r, u] = 0.0


@outlined
def fix_pushed_by_gradient(work):
    """Fixes the joints at a bound that the slope, Jᵀ wanted, pushes out: they cannot help (Kuhn-Tucker)."""
    pressed = 0
    for u in range(work.step.shape[0]):
        work.side[u] = 0
        along = 0.0
        for r in range(work.wanted.shape[0]):
            along += work.jacobian[r, u] * work.wanted[r]
        work.gradient[u] = along
        if pushed_out(work.low[u], work.high[u], work.gradient[u]) != 0:
            fix_joint(work, u)
            work.gradient[u] = 0.0
            pressed += 1
    work.state[ws.PRESSED] = pressed


@outlined
def fix_pushed_by_step(work):
    """Fixes the joint at a bound that work.step pushes out most; False when there is none.

    One at a time: the last one fixed was driven out by the others, so these still lead downhill.
    """
    worst, most = -1, AT_BOUND
    for u in range(work.step.shape[0]):
        out = 0.0
        if work.low[u] > -AT_BOUND:
            out = -work.step[u]
        if work.high[u] < AT_BOUND:
            out = max(out, work.step[u])
        if out > most:
            worst, most = u, out
    if worst < 0:
        return False
    fix_joint(work, worst)
    work.aim[worst] = 0.0
    work.state[ws.PRESSED] += 1
    return True


@outlined
def keep_inside(work):
    """Cuts work.step to the bounds of each joint; shortens it as a whole where cutting would lead uphill.

    Returns the share of the whole step that is left, 1 where single joints were cut.
    """
    step, low, high, wanted, jacobian = work.step, work.low, work.high, work.wanted, work.jacobian
    n = step.shape[0]
    share = 1.0
    for u in range(n):
        if work.side[u] != 0:
            step[u] = 0.0
        elif step[u] > high[u]:
            share = min(share, high[u] / step[u])
        elif step[u] < low[u]:
            share = min(share, low[u] / step[u])
    if share >= 1.0:
        return 1.0
    before, after = 0.0, 0.0
    for r in range(wanted.shape[0]):
        left = wanted[r]
        before += left * left
        for u in range(n):
            left -= jacobian[r, u] * min(max(step[u], low[u]), high[u])
        after += left * left
    if after < before:
        share = 1.0
    for u in range(n):
        step[u] = min(max(share * step[u], low[u]), high[u])
    return share


@pure
def shorten(work):
    """In the last descent, takes a share of work.step: less after each failure, more after each success."""
    if work.state[ws.POLISHING] > 0:
        for u in range(work.step.shape[0]):
            work.step[u] *= work.value[ws.SHARE]


@pure
def extra_damping(work):
    """λ² that a method can take in place of ``shorten``: it shortens the step and rotates it downhill.

    Near a stretched-out arm the undamped step all but leads along a level line of the cost: any share of it
    creeps.
    """
    if work.state[ws.POLISHING] == 0:
        return 0.0
    return _EXTRA_DAMPING * math.sqrt(2.0 * work.value[ws.COST]) * (1.0 / work.value[ws.SHARE] - 1.0)


@outlined
def cap(work, gain, max_step):
    """Takes the share ``gain`` of work.step, and no joint farther than ``max_step``: its direction stays.

    Returns the share that is taken.
    """
    step = work.step
    largest = 0.0
    for u in range(step.shape[0]):
        largest = max(largest, abs(gain * step[u]))
    share = gain * max_step / largest if largest > max_step else gain
    for u in range(step.shape[0]):
        step[u] *= share
    return share


@pure
def volume(sigma):
    """Yoshikawa's manipulability: the product of the singular values, √det(JJᵀ) at full row rank.

    (The International Journal of Robotics Research 4(2), 1985.)  Directions in which nothing can move
    are left out, or a planar arm would have none at all.
    """
    product = 1.0
    for i in range(sigma.shape[0]):
        if sigma[i] > NEGLIGIBLE * sigma[0]:
            product *= sigma[i]
    return product


@outlined
def filtered_step(work, cutoff, damping):
    """work.step = Σ σ/(σ² + λ²) (u·e) v over σ > cutoff σ₁, from the singular vectors of work.jacobian.

    λ = 0: the pseudoinverse; λ > 0: damped least squares in its SVD form (Buss 2004, sections 4 and 6).
    """
    left, sigma, right, wanted, step = work.left, work.sigma, work.right, work.wanted, work.step
    for u in range(step.shape[0]):
        step[u] = 0.0
    for i in range(sigma.shape[0]):
        s = sigma[i]
        if not s > cutoff * sigma[0]:
            continue
        part = 0.0
        for r in range(wanted.shape[0]):
            part += left[i, r] * wanted[r]
        part *= s / (s * s + damping * damping)
        for u in range(step.shape[0]):
            step[u] += part * right[i, u]
    work.value[ws.DAMPING] = damping


# Singular vectors: sweeps at most (six or seven are enough), and what counts as rounding.
_SWEEPS = 40
_ROUNDING = 1e-15


@outlined
def orthogonalise(vectors, rotations, count):
    """Rotates the rows of ``vectors`` in pairs until all are orthogonal, those of ``rotations`` with them.

    One-sided Jacobi (Hestenes, J. SIAM 6(1), 1958): each rotation makes one pair orthogonal; a few sweeps do.
    """
    width, other = vectors.shape[1], rotations.shape[1]
    for _ in range(_SWEEPS):
        rotated = False
        largest = 0.0
        for a in range(count):
            largest = max(largest, row_dot(vectors, a, vectors, a))
        for a in range(count - 1):
            for b in range(a + 1, count):
                aa, bb, ab = 0.0, 0.0, 0.0
                for i in range(width):
                    aa += vectors[a, i] * vectors[a, i]
                    bb += vectors[b, i] * vectors[b, i]
                    ab += vectors[a, i] * vectors[b, i]
                # Rows that are rounding noise beside the largest need no angle of their own.
                if abs(ab) <= _ROUNDING * math.sqrt(aa * bb) or min(aa, bb) <= _ROUNDING**2 * largest:
                    continue
                rotated = True
                half = 0.5 * (bb - aa)
                t = ab / (half + math.copysign(math.sqrt(half * half + ab * ab), half))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for i in range(width):
                    x, y = vectors[a, i], vectors[b, i]
                    vectors[a, i], vectors[b, i] = c * x - s * y, s * x + c * y
                for i in range(other):
                    x, y = rotations[a, i], rotations[b, i]
                    rotations[a, i], rotations[b, i] = c * x - s * y, s * x + c * y
        if not rotated:
            return


@outlined
def lengths_of(vectors, rotations, sigma):
    """Lengths of the rows into ``sigma``, longest first; rows become unit vectors, or zero where noise."""
    count, width, other = sigma.shape[0], vectors.shape[1], rotations.shape[1]
    for a in range(count):
        sigma[a] = math.sqrt(row_dot(vectors, a, vectors, a))
    for a in range(count):
        best = a
        for b in range(a + 1, count):
            if sigma[b] > sigma[best]:
                best = b
        if best != a:
            sigma[a], sigma[best] = sigma[best], sigma[a]
            for i in range(width):
                vectors[a, i], vectors[best, i] = vectors[best, i], vectors[a, i]
            for i in range(other):
                rotations[a, i], rotations[best, i] = rotations[best, i], rotations[a, i]
        if not sigma[a] > _ROUNDING * sigma[0]:
            sigma[a] = 0.0
        inverse = 1.0 / sigma[a] if sigma[a] > 0.0 else 0.0
        for i in range(width):
            vectors[a, i] *= inverse


@outlined
def svd(matrix, left, sigma, right):
    """Singular values and vectors: matrix = Σ sigma[i] · left[i] right[i]ᵀ, the largest first.

    One-sided Jacobi on the shorter side: as accurate as LAPACK at these sizes, and no call.

    Args:
        matrix: (m, n), unchanged.
        left: (p, m) result, p = min(m, n); rows are the vectors u.
        sigma: (p,) result; what is rounding noise beside the largest is zero.
        right: (p, n) result; rows are the vectors v.  A zero singular value has a unit vector on the
            shorter side and a zero vector on the longer one.
    """
    m, n = matrix.shape
    count = sigma.shape[0]
    size = 0.0
    for r in range(m):
        for i in range(n):
            size = max(size, abs(matrix[r, i]))
    scale = 1.0 / size if size > 0.0 else 0.0  # squares of very small or large entries would not fit
    wide = m <= n
    for a in range(count):
        for r in range(m):
            left[a, r] = (1.0 if r == a else 0.0) if wide else matrix[r, a] * scale
        for i in range(n):
            right[a, i] = matrix[a, i] * scale if wide else (1.0 if i == a else 0.0)
    if wide:
        orthogonalise(right, left, count)
        lengths_of(right, left, sigma)
    else:
        orthogonalise(left, right, count)
        lengths_of(left, right, sigma)
    for a in range(count):
        sigma[a] *= size
