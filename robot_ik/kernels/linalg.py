"""Small dense algebra, written out: at 6 x 6 it beats a LAPACK call several times, and needs no SciPy."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from numba import types

from robot_ik.kernels.jit import inlined, outlined, pure

# A joint nearer to its bound than this, rad or m, stands at its bound.
AT_BOUND = 1e-12


@pure
def row_dot(a, i, b, j):
    """Row ``i`` of ``a`` times row ``j`` of ``b``."""
    s = 0.0
    for k in range(a.shape[1]):
        s += a[i, k] * b[j, k]
    return s


@pure
def eliminate(matrix, x, n):
    """Solves M x = b by L D Lᵀ in place, M positive definite: b comes in ``x``, M's lower triangle is lost.

    Returns False when M is not positive definite to working precision (``x`` is then garbage).
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


# Factors that are used for several right-hand sides: M = L D Lᵀ.


@outlined
def factorise(matrix, first, n):
    """Write the factors of a positive definite M over its lower triangle: L, with 1/D on the diagonal.

    ``first`` (n,) is the first column of each row that may differ from zero, which is so in L too
    (a skyline). A pivot that is not positive gives 1/D = 0: its unknown is zero.
    """
    for i in range(n):
        for j in range(first[i], i):
            s = matrix[i, j]
            for k in range(max(first[i], first[j]), j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = s
        d = matrix[i, i]
        for j in range(first[i], i):
            s = matrix[i, j] * matrix[j, j]
            d -= s * matrix[i, j]
            matrix[i, j] = s
        matrix[i, i] = 1.0 / d if d > 0.0 else 0.0


@outlined
def solve_lower(factors, first, x, n):
    """Overwrite ``x`` with L⁻¹ x."""
    for i in range(n):
        s = x[i]
        for k in range(first[i], i):
            s -= factors[i, k] * x[k]
        x[i] = s


@outlined
def solve_upper(factors, first, x, n):
    """Overwrite ``x`` with L⁻ᵀ x."""
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(first[i], i):
            x[k] -= factors[i, k] * s


@inlined
def scaled_dot(factors, a, b, n):
    """Return aᵀ D⁻¹ b."""
    s = 0.0
    for i in range(n):
        s += a[i] * factors[i, i] * b[i]
    return s


@inlined
def divide_by_pivots(factors, x, n):
    """Overwrite ``x`` with D⁻¹ x."""
    for i in range(n):
        x[i] *= factors[i, i]


@pure
def solve_definite(matrix, x, n):
    """``eliminate`` for any size; for six the compiler writes the loops out: half the time."""
    if n == 6:
        return eliminate(matrix, x, types.int64(6))
    return eliminate(matrix, x, n)


@outlined
def normal_equations(jacobian, residual, normal, gradient):
    """normal = JᵀJ (lower triangle), gradient = Jᵀr."""
    rows, n = jacobian.shape
    if rows == 6:  # one pose: no loop over the rows
        r0, r1, r2, r3, r4, r5 = residual[0], residual[1], residual[2], residual[3], residual[4], residual[5]
        for i in range(n):
            a0, a1, a2 = jacobian[0, i], jacobian[1, i], jacobian[2, i]
            a3, a4, a5 = jacobian[3, i], jacobian[4, i], jacobian[5, i]
            gradient[i] = a0 * r0 + a1 * r1 + a2 * r2 + a3 * r3 + a4 * r4 + a5 * r5
            for j in range(i + 1):
                normal[i, j] = (
                    a0 * jacobian[0, j] + a1 * jacobian[1, j] + a2 * jacobian[2, j]
                    + a3 * jacobian[3, j] + a4 * jacobian[4, j] + a5 * jacobian[5, j]
                )  # fmt: skip
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


@pure
def reduced_system(matrix, gradient, low, high, side, factor, step):
    """The system of the free joints, in ``factor`` and ``step``: one at its bound has a row of its own."""
    n = gradient.shape[0]
    for i in range(n):
        for j in range(i + 1):
            factor[i, j] = matrix[i, j]
        step[i] = gradient[i]
    for p in range(n):
        if side[p] == 0:
            continue
        bound = low[p] if side[p] < 0 else high[p]
        for j in range(p):
            step[j] -= matrix[p, j] * bound
            factor[p, j] = 0.0
        for i in range(p + 1, n):
            step[i] -= matrix[i, p] * bound
            factor[i, p] = 0.0
        factor[p, p] = 1.0
    for p in range(n):
        if side[p] != 0:
            step[p] = low[p] if side[p] < 0 else high[p]


@pure
def pushed_out(low, high, way):
    """Where a joint stands at a bound of its step and ``way`` leads out there: -1 or 1; else 0."""
    if way < 0.0 and low > -AT_BOUND:
        return -1
    return 1 if way > 0.0 and high < AT_BOUND else 0


@pure
def guess_sides(gradient, low, high, side):
    """Guesses that a joint stops where it stands when it is pushed out there; returns the steepest slope."""
    steepest = 0.0
    for i in range(gradient.shape[0]):
        steepest = max(steepest, abs(gradient[i]))
        side[i] = pushed_out(low[i], high[i], gradient[i])
    return steepest


@pure
def keep_to_box(low, high, side, step):
    """Cuts what rounding leads over a bound; returns how many joints are pressed where they already stood."""
    pressed = 0
    for i in range(step.shape[0]):
        step[i] = min(max(step[i], low[i]), high[i])
        if (side[i] < 0 and low[i] > -AT_BOUND) or (side[i] > 0 and high[i] < AT_BOUND):
            pressed += 1
    return pressed


@pure
def box_step(matrix, gradient, low, high, step, free, side, factor):
    """The step d that minimises ½ dᵀ M d − gᵀ d inside low <= d <= high, exactly.

    Block principal pivoting: guess which joints stop at a bound, solve for the others, then exchange all
    that are on the wrong side of the guess; when that does not lessen their number, one at a time, which
    always ends (Júdice & Pires, Computers & Operations Research 21(5), 1994).  Most steps need one solve.

    Args:
        matrix: (n, n) M, symmetric positive definite; lower triangle read.
        gradient: (n,) g, the direction of descent.
        low: (n,) lower bounds of the step, low <= 0.
        high: (n,) upper bounds, high >= 0.
        step: (n,) result.
        free: (n,) work space, int.
        side: (n,) work space, int: -1 at the lower bound, 1 at the upper, 0 free.
        factor: (n, n) work space.

    Returns:
        Joints pressed against a bound at which they already stood, or -1 when M is not positive definite.
    """
    n = gradient.shape[0]
    steepest = guess_sides(gradient, low, high, side)
    fewest, patience = n + 1, 3
    for _ in range(10 + 4 * n):
        reduced_system(matrix, gradient, low, high, side, factor, step)
        if not solve_definite(factor, step, n):
            return -1
        wrong, last = 0, -1
        for i in range(n):
            free[i] = side[i]
            if side[i] == 0:
                if step[i] < low[i] or step[i] > high[i]:
                    free[i] = -1 if step[i] < low[i] else 1
            elif high[i] > low[i]:
                slope = gradient[i]
                for j in range(i + 1):
                    slope -= matrix[i, j] * step[j]
                for j in range(i + 1, n):
                    slope -= matrix[j, i] * step[j]
                if slope * side[i] < -1e-14 * steepest:
                    free[i] = 0
            if free[i] != side[i]:
                wrong, last = wrong + 1, i
        if wrong == 0:
            break
        patience = 3 if wrong < fewest else patience - 1
        fewest = min(fewest, wrong)
        for i in range(n):
            if patience >= 0 or i == last:
                side[i] = free[i]
    return keep_to_box(low, high, side, step)


# The damped step inside a box among m rows of n > m joints: (JᵀJ + λ) d = Jᵀr is as well d = Jᵀy with (JJᵀ +
# λ) y = r, a smaller system and a better conditioned one.  A joint that stops at a bound takes its column out
# of JJᵀ and its share out of r; of the others Jᵀy says where they go.  ``hits`` (n, m) and ``counts`` (n,)
# list for every column the rows in which it may not be zero: in a tree most joints move few of the goals.


@outlined
def row_products(jacobian, residual, hits, counts, gram, gradient):
    """gram[:m, :m] = J Jᵀ (lower triangle), gradient = Jᵀr."""
    m, n = jacobian.shape
    for i in range(m):
        for j in range(i + 1):
            gram[i, j] = 0.0
    for u in range(n):
        s = 0.0
        if m == 6:  # one pose: the compiler writes the loops out
            for i in range(6):
                s += jacobian[i, u] * residual[i]
                for j in range(i + 1):
                    gram[i, j] += jacobian[i, u] * jacobian[j, u]
        else:
            for a in range(counts[u]):
                i = hits[u, a]
                x = jacobian[i, u]
                s += x * residual[i]
                for b in range(a + 1):
                    gram[i, hits[u, b]] += x * jacobian[hits[u, b], u]
        gradient[u] = s


@pure
def remove_joint(jacobian, hits, counts, u, bound, factor, push):
    """Takes joint ``u``, which stops at ``bound``, out of the system."""
    for a in range(counts[u]):
        i = hits[u, a]
        x = jacobian[i, u]
        push[i] -= x * bound
        for b in range(a + 1):
            factor[i, hits[u, b]] -= x * jacobian[hits[u, b], u]


@outlined
def row_step(
    jacobian, residual, gram, gradient, damping, low, high, hits, counts, step, free, side, factor, push
):
    """The step d that minimises ½ |J d − r|² + ½ λ |d|² inside low <= d <= high, exactly.

    As ``box_step``, for a ``jacobian`` (m, n) with m <= n, ``residual`` (m,) r and λ > 0; ``gram`` (m, m) and
    ``gradient`` (n,) are from ``row_products``, ``push`` (m,) is work space: y.
    """
    m, n = jacobian.shape
    steepest = guess_sides(gradient, low, high, side)
    fewest, patience = n + 1, 3
    for _ in range(10 + 4 * n):
        for i in range(m):
            for j in range(i):
                factor[i, j] = gram[i, j]
            factor[i, i] = gram[i, i] + damping
            push[i] = residual[i]
        for u in range(n):
            if side[u] != 0:
                remove_joint(jacobian, hits, counts, u, low[u] if side[u] < 0 else high[u], factor, push)
        if not solve_definite(factor, push, m):
            return -1
        wrong, last = 0, -1
        for u in range(n):
            goal_row = 0.0
            for a in range(counts[u]):
                goal_row += jacobian[hits[u, a], u] * push[hits[u, a]]
            free[u] = side[u]
            if side[u] == 0:
                step[u] = goal_row
                if goal_row < low[u] or goal_row > high[u]:
                    free[u] = -1 if goal_row < low[u] else 1
            else:
                step[u] = low[u] if side[u] < 0 else high[u]
                if high[u] > low[u] and damping * (goal_row - step[u]) * side[u] < -1e-14 * steepest:
                    free[u] = 0
            if free[u] != side[u]:
                wrong, last = wrong + 1, u
        if wrong == 0:
            break
        patience = 3 if wrong < fewest else patience - 1
        fewest = min(fewest, wrong)
        for u in range(n):
            if patience >= 0 or u == last:
                side[u] = free[u]
    return keep_to_box(low, high, side, step)
