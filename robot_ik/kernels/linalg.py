"""Small dense linear algebra. At 6 x 6 it is several times faster than LAPACK.

``solve_box`` minimises a damped quadratic inside bounds. Damped least squares and
Levenberg-Marquardt take their steps with it.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import inlined, kernel, outlined

# A joint nearer to its bound than this, rad or m, is at its bound.
AT_BOUND = 1e-12
# A slope that pulls a held joint off its bound counts beyond this share of the steepest slope.
_SLOPE_ROUNDING = 1e-14
# Exchanges of all wrong sides without a smaller number of them, before single exchanges.
_FAILED_EXCHANGES = 3

# The step d that minimises ½ ‖J d − r‖² + ½ λ ‖d‖² inside lower ≤ d ≤ upper.
# With m rows, u columns, k = max(m, u).
BOX_PROBLEM = Layout(
    "BoxProblem",
    jacobian="table m u",
    residual="floats m",
    gradient="floats u",  # Jᵀr
    matrix="table k k",  # JᵀJ or J Jᵀ, whichever is smaller; lower triangle
    lower="floats u",  # ≤ 0
    upper="floats u",  # ≥ 0
    side="ints u",  # -1, 1 for a joint that stops at its lower or upper bound, else 0
    next_side="ints u",
    slope="floats u",  # where the cost of a held joint falls; 0 for free joints
    factor="table k k",
    multipliers="floats k",
)


# Factorisation


@inlined
def row_dot(a, i, b, j):
    """Return row ``i`` of ``a`` times row ``j`` of ``b``."""
    s = 0.0
    for k in range(a.shape[1]):
        s += a[i, k] * b[j, k]
    return s


@inlined
def eliminate(matrix, x, n):
    """Solve M x = b in place by L D Lᵀ, M positive definite; return whether it is.

    ``x`` holds b before and x after. Overwrites the lower triangle of ``matrix``.
    If M is not positive definite to working precision, ``x`` has no meaning.
    """
    for k in range(n):
        pivot = matrix[k, k]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / pivot
        for i in range(k + 1, n):
            share = matrix[i, k] * inverse
            for j in range(k + 1, i + 1):
                matrix[i, j] -= share * matrix[j, k]
            x[i] -= share * x[k]
        matrix[k, k] = inverse
    for k in range(n - 1, -1, -1):
        s = x[k]
        for i in range(k + 1, n):
            s -= matrix[i, k] * x[i]
        x[k] = s * matrix[k, k]
    return True


@inlined
def solve_definite(matrix, x, n):
    """Call ``eliminate``. For n = 6 the compiler unrolls the loops, which halves the time."""
    if n == 6:
        return eliminate(matrix, x, types.int64(6))
    return eliminate(matrix, x, n)


@kernel
def solve_positive(matrix, right):
    """Return x (n,) with M x = b, M positive definite; infinity if it is not.

    For n = 6 to 17 this takes a quarter of the time of ``numpy.linalg.solve``.
    """
    factors = matrix.copy()
    x = right.copy()
    if not eliminate(factors, x, len(x)):
        x[:] = math.inf
    return x


# Factors that are used for several right-hand sides: M = L Lᵀ (Cholesky). Unsigned indices cannot
# count from the end. The compiler need not check that, and the loops take half the time.


@outlined
def factorise(matrix, first, n):
    """Write L over the lower triangle of a positive definite M, with 1/L on the diagonal.

    ``first`` (n,) is the first column of each row that may differ from zero, which is so in L too
    (a skyline). A pivot that is not positive gives a zero on the diagonal: its unknown is zero.
    """
    for i in range(n):
        start = types.uint64(first[i])
        square = 0.0
        for j in range(start, types.uint64(i)):
            s = matrix[i, j]
            for k in range(max(types.uint64(first[j]), start), j):
                s -= matrix[i, k] * matrix[j, k]
            s *= matrix[j, j]
            matrix[i, j] = s
            square += s * s
        pivot = matrix[i, i] - square
        matrix[i, i] = 1.0 / math.sqrt(pivot) if pivot > 0.0 else 0.0


@outlined
def solve_lower(factors, first, x, n):
    """Overwrite ``x`` with L⁻¹ x."""
    for i in range(n):
        s = x[i]
        for k in range(types.uint64(first[i]), types.uint64(i)):
            s -= factors[i, k] * x[k]
        x[i] = s * factors[i, i]


@outlined
def solve_upper(factors, first, x, n):
    """Overwrite ``x`` with L⁻ᵀ x."""
    for i in range(n - 1, -1, -1):
        s = x[i] * factors[i, i]
        x[i] = s
        for k in range(types.uint64(first[i]), types.uint64(i)):
            x[k] -= factors[i, k] * s


# Products


@outlined
def normal_equations(jacobian, residual, normal, gradient):
    """Write JᵀJ to the lower triangle of ``normal`` and Jᵀr to ``gradient``."""
    rows, n = jacobian.shape
    if rows == 6:  # one pose: no loop over the rows
        r0 = residual[0]
        r1 = residual[1]
        r2 = residual[2]
        r3 = residual[3]
        r4 = residual[4]
        r5 = residual[5]
        for i in range(n):
            a0 = jacobian[0, i]
            a1 = jacobian[1, i]
            a2 = jacobian[2, i]
            a3 = jacobian[3, i]
            a4 = jacobian[4, i]
            a5 = jacobian[5, i]
            gradient[i] = a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3 + a4 * r4 + a5 * r5
            for j in range(i + 1):
                normal[i, j] = (
                    a0 * jacobian[0, j]
                    + a1 * jacobian[1, j]
                    + a2 * jacobian[2, j]
                    + a3 * jacobian[3, j]
                    + a4 * jacobian[4, j]
                    + a5 * jacobian[5, j]
                )
        return
    for i in range(n):
        gradient[i] = 0.0
        for j in range(i + 1):
            normal[i, j] = 0.0
    for r in range(rows):
        for i in range(n):
            a = jacobian[r, i]
            if a != 0.0:  # in a tree most joints do not move most goals
                gradient[i] += a * residual[r]
                for j in range(i + 1):
                    normal[i, j] += a * jacobian[r, j]


@outlined
def row_products(jacobian, residual, hits, hit_count, gram, gradient):
    """Write J Jᵀ to the lower triangle of ``gram`` (m, m) and Jᵀr to ``gradient``.

    ``hits`` (n, m) lists the rows in which each column may differ from zero, first, and
    ``hit_count`` (n,) their number. In a tree most joints move few of the goals.
    """
    m, n = jacobian.shape
    for i in range(m):
        for j in range(i + 1):
            gram[i, j] = 0.0
    for u in range(n):
        s = 0.0
        if m == 6:  # one pose: the compiler unrolls the loops
            for i in range(6):
                s += jacobian[i, u] * residual[i]
                for j in range(i + 1):
                    gram[i, j] += jacobian[i, u] * jacobian[j, u]
        else:
            for a in range(hit_count[u]):
                i = hits[u, a]
                x = jacobian[i, u]
                s += x * residual[i]
                for b in range(a + 1):
                    gram[i, hits[u, b]] += x * jacobian[hits[u, b], u]
        gradient[u] = s


# The step inside bounds


@inlined
def pushed_out(lower, upper, direction):
    """Return -1 or 1 if a joint is at a bound and ``direction`` leads beyond the bound, else 0."""
    if direction < 0.0 and lower > -AT_BOUND:
        return -1
    return 1 if direction > 0.0 and upper < AT_BOUND else 0


@outlined
def square_up(box, hits, hit_count):
    """Write matrix and gradient of the smaller system; return whether it is the system of rows."""
    rows, columns = box.jacobian.shape
    if rows < columns:
        row_products(box.jacobian, box.residual, hits, hit_count, box.matrix, box.gradient)
        return True
    normal_equations(box.jacobian, box.residual, box.matrix, box.gradient)
    return False


@outlined
def solve_box_by_columns(box, matrix, damping, step):
    """Write the step that minimises ½ dᵀ (M + λ) d − gᵀ d inside the bounds to ``step``, exactly.

    Block principal pivoting (Júdice & Pires, Computers & Operations Research 21(5), 1994): guess
    which joints stop at a bound, solve for the others, then exchange all joints that are on the
    wrong side of the guess. If that does not lower their number, exchange one joint at a time,
    which always ends. Most steps need one solve.

    Args:
        box: Memory of ``BOX_PROBLEM``; reads gradient g, lower and upper.
        matrix: (u, u) symmetric M; the lower triangle is read.
        damping: λ. M + λ must be positive definite.
        step: (u,) written.

    Returns:
        Number of joints pressed against a bound at which they already were; -1 if M + λ is not
        positive definite.
    """
    columns = step.shape[0]
    steepest = guess_sides(box)
    fewest = columns + 1
    patience = _FAILED_EXCHANGES
    for _ in range(10 + 4 * columns):
        reduced_system(
            matrix, damping, box.gradient, box.lower, box.upper, box.side, box.factor, step
        )
        if not solve_definite(box.factor, step, columns):
            return -1
        for i in range(columns):
            box.slope[i] = 0.0
            if box.side[i] != 0:
                slope = box.gradient[i] - damping * step[i]
                for j in range(i + 1):
                    slope -= matrix[i, j] * step[j]
                for j in range(i + 1, columns):
                    slope -= matrix[j, i] * step[j]
                box.slope[i] = slope
        changes, last = revise_sides(box, step, steepest)
        if changes == 0:
            break
        patience = _FAILED_EXCHANGES if changes < fewest else patience - 1
        fewest = min(fewest, changes)
        exchange_sides(box, patience, last)
    return keep_to_box(box, step)


@outlined
def solve_box_by_rows(box, hits, hit_count, damping, step):
    """Write the step that ``solve_box_by_columns`` finds for M = JᵀJ, with fewer rows than columns.

    (JᵀJ + λ) d = Jᵀr is also d = Jᵀy with (J Jᵀ + λ) y = r, which is smaller and better
    conditioned. A joint that stops at a bound takes its column out of J Jᵀ and its motion out of
    r. For the other joints Jᵀy is the step.
    """
    rows, columns = box.jacobian.shape
    steepest = guess_sides(box)
    fewest = columns + 1
    patience = _FAILED_EXCHANGES
    for _ in range(10 + 4 * columns):
        for i in range(rows):
            for j in range(i):
                box.factor[i, j] = box.matrix[i, j]
            box.factor[i, i] = box.matrix[i, i] + damping
            box.multipliers[i] = box.residual[i]
        for u in range(columns):
            if box.side[u] != 0:
                remove_joint(
                    box, hits, hit_count, u, box.lower[u] if box.side[u] < 0 else box.upper[u]
                )
        if not solve_definite(box.factor, box.multipliers, rows):
            return -1
        for u in range(columns):
            free_step = 0.0
            for a in range(hit_count[u]):
                free_step += box.jacobian[hits[u, a], u] * box.multipliers[hits[u, a]]
            step[u] = free_step
            box.slope[u] = 0.0
            if box.side[u] != 0:
                step[u] = box.lower[u] if box.side[u] < 0 else box.upper[u]
                box.slope[u] = damping * (free_step - step[u])
        changes, last = revise_sides(box, step, steepest)
        if changes == 0:
            break
        patience = _FAILED_EXCHANGES if changes < fewest else patience - 1
        fewest = min(fewest, changes)
        exchange_sides(box, patience, last)
    return keep_to_box(box, step)


@inlined
def guess_sides(box):
    """Write to box.side that joints stop where they are pushed out; return the steepest slope."""
    steepest = 0.0
    for i in range(box.gradient.shape[0]):
        steepest = max(steepest, abs(box.gradient[i]))
        box.side[i] = pushed_out(box.lower[i], box.upper[i], box.gradient[i])
    return steepest


@inlined
def reduced_system(matrix, damping, gradient, lower, upper, side, factor, step):
    """Write the system of the free joints to ``factor`` and ``step``.

    The row of a joint at its bound keeps the joint at the bound.
    """
    n = gradient.shape[0]
    for i in range(n):
        for j in range(i):
            factor[i, j] = matrix[i, j]
        factor[i, i] = matrix[i, i] + damping
        step[i] = gradient[i]
    for p in range(n):
        if side[p] == 0:
            continue
        bound = lower[p] if side[p] < 0 else upper[p]
        for j in range(p):
            step[j] -= matrix[p, j] * bound
            factor[p, j] = 0.0
        for i in range(p + 1, n):
            step[i] -= matrix[i, p] * bound
            factor[i, p] = 0.0
        factor[p, p] = 1.0
    for p in range(n):
        if side[p] != 0:
            step[p] = lower[p] if side[p] < 0 else upper[p]


@inlined
def remove_joint(box, hits, hit_count, u, bound):
    """Remove joint ``u``, which stops at ``bound``, from the system of rows."""
    for a in range(hit_count[u]):
        i = hits[u, a]
        x = box.jacobian[i, u]
        box.multipliers[i] -= x * bound
        for b in range(a + 1):
            box.factor[i, hits[u, b]] -= x * box.jacobian[hits[u, b], u]


@inlined
def revise_sides(box, step, steepest):
    """Write better guesses to box.next_side; return how many differ, and the last that does."""
    changes = 0
    last = -1
    for i in range(step.shape[0]):
        side = box.side[i]
        box.next_side[i] = side
        if side == 0:
            if step[i] < box.lower[i] or step[i] > box.upper[i]:
                box.next_side[i] = -1 if step[i] < box.lower[i] else 1
        elif box.upper[i] > box.lower[i] and box.slope[i] * side < -_SLOPE_ROUNDING * steepest:
            box.next_side[i] = 0
        if box.next_side[i] != side:
            changes += 1
            last = i
    return changes, last


@inlined
def exchange_sides(box, patience, last):
    """Take all new guesses; without patience only the guess of joint ``last``."""
    for i in range(box.side.shape[0]):
        if patience >= 0 or i == last:
            box.side[i] = box.next_side[i]


@inlined
def keep_to_box(box, step):
    """Clip rounding errors beyond the bounds; return the number of joints that press on a bound."""
    pressed = 0
    for i in range(step.shape[0]):
        step[i] = min(max(step[i], box.lower[i]), box.upper[i])
        at_lower = box.side[i] < 0 and box.lower[i] > -AT_BOUND
        at_upper = box.side[i] > 0 and box.upper[i] < AT_BOUND
        if at_lower or at_upper:
            pressed += 1
    return pressed


# Singular values

# Largest number of sweeps. Six or seven are enough.
_SWEEPS = 40
# Relative size of rounding.
_ROUNDING = 1e-15


@outlined
def svd(matrix, left, sigma, right):
    """Write singular values and vectors: matrix = Σ sigma[i] · left[i] right[i]ᵀ, largest first.

    One-sided Jacobi on the shorter side: as accurate as LAPACK at these sizes.

    Args:
        matrix: (m, n), unchanged.
        left: (p, m) written, p = min(m, n); the rows are the vectors u.
        sigma: (p,) written; values that are rounding errors of the largest are zero.
        right: (p, n) written; the rows are the vectors v. A zero singular value has a unit vector
            on the shorter side and a zero vector on the longer side.
    """
    m, n = matrix.shape
    count = sigma.shape[0]
    size = 0.0
    for r in range(m):
        for i in range(n):
            size = max(size, abs(matrix[r, i]))
    scale = 1.0 / size if size > 0.0 else 0.0  # squares of very small entries would vanish
    wide = m <= n
    for a in range(count):
        for r in range(m):
            left[a, r] = (1.0 if r == a else 0.0) if wide else matrix[r, a] * scale
        for i in range(n):
            right[a, i] = matrix[a, i] * scale if wide else (1.0 if i == a else 0.0)
    if wide:
        orthogonalise(right, left, count)
        sort_by_length(right, left, sigma)
    else:
        orthogonalise(left, right, count)
        sort_by_length(left, right, sigma)
    for a in range(count):
        sigma[a] *= size


@outlined
def orthogonalise(vectors, rotations, count):
    """Rotate the rows of both arrays in place, in pairs, until those of ``vectors`` are orthogonal.

    One-sided Jacobi (Hestenes, J. SIAM 6(1), 1958): each rotation makes one pair orthogonal.
    """
    width = vectors.shape[1]
    for _ in range(_SWEEPS):
        rotated = False
        largest = 0.0
        for a in range(count):
            largest = max(largest, row_dot(vectors, a, vectors, a))
        for a in range(count - 1):
            for b in range(a + 1, count):
                aa = 0.0
                bb = 0.0
                ab = 0.0
                for i in range(width):
                    aa += vectors[a, i] * vectors[a, i]
                    bb += vectors[b, i] * vectors[b, i]
                    ab += vectors[a, i] * vectors[b, i]
                # Rows that are rounding errors of the largest row need no rotation.
                noise = min(aa, bb) <= _ROUNDING**2 * largest
                if noise or abs(ab) <= _ROUNDING * math.sqrt(aa * bb):
                    continue
                rotated = True
                half = 0.5 * (bb - aa)
                t = ab / (half + math.copysign(math.sqrt(half * half + ab * ab), half))
                c = 1.0 / math.sqrt(1.0 + t * t)
                rotate_rows(vectors, a, b, c, c * t)
                rotate_rows(rotations, a, b, c, c * t)
        if not rotated:
            return


@inlined
def rotate_rows(table, a, b, cosine, sine):
    """Rotate rows ``a`` and ``b`` in place in their plane."""
    for i in range(table.shape[1]):
        x = table[a, i]
        y = table[b, i]
        table[a, i] = cosine * x - sine * y
        table[b, i] = sine * x + cosine * y


@inlined
def swap_rows(table, a, b):
    """Swap two rows in place."""
    for i in range(table.shape[1]):
        x = table[a, i]
        table[a, i] = table[b, i]
        table[b, i] = x


@outlined
def sort_by_length(vectors, rotations, sigma):
    """Write the lengths of the rows to ``sigma``, longest first; make the rows unit vectors.

    A row that is a rounding error becomes zero.
    """
    count = sigma.shape[0]
    for a in range(count):
        sigma[a] = math.sqrt(row_dot(vectors, a, vectors, a))
    for a in range(count):
        best = a
        for b in range(a + 1, count):
            if sigma[b] > sigma[best]:
                best = b
        if best != a:
            length = sigma[a]
            sigma[a] = sigma[best]
            sigma[best] = length
            swap_rows(vectors, a, best)
            swap_rows(rotations, a, best)
        if not sigma[a] > _ROUNDING * sigma[0]:
            sigma[a] = 0.0
        inverse = 1.0 / sigma[a] if sigma[a] > 0.0 else 0.0
        for i in range(vectors.shape[1]):
            vectors[a, i] *= inverse
