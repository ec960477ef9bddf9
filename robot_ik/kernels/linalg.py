"""Small dense algebra, written out: at 6 x 6 it beats a LAPACK call several times, and needs no SciPy."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure

# A joint with less room than this, rad or m, stands at its bound.
_AT_BOUND = 1e-12


@pure
def cholesky_solve(matrix, rhs, index, size, factor, x):
    """Solves M[I, I] x[I] = rhs[I], M symmetric positive definite, I the first ``size`` entries of ``index``.

    Only the lower triangle of ``matrix`` is read.  ``factor`` is work space.  Returns False when M[I, I]
    is not positive definite to working precision (``x`` is then garbage).
    """
    for a in range(size):
        i = index[a]
        for b in range(a + 1):
            j = index[b]
            s = matrix[i, j] if i >= j else matrix[j, i]
            for c in range(b):
                s -= factor[a, c] * factor[b, c]
            if a == b:
                if not s > 0.0:
                    return False
                factor[a, a] = 1.0 / math.sqrt(s)
            else:
                factor[a, b] = s * factor[b, b]
    for a in range(size):
        s = rhs[index[a]]
        for c in range(a):
            s -= factor[a, c] * x[index[c]]
        x[index[a]] = s * factor[a, a]
    for a in range(size - 1, -1, -1):
        s = x[index[a]]
        for c in range(a + 1, size):
            s -= factor[c, a] * x[index[c]]
        x[index[a]] = s * factor[a, a]
    return True


@pure
def normal_equations(jacobian, residual, normal, gradient):
    """normal = JᵀJ (lower triangle), gradient = Jᵀr."""
    rows, n = jacobian.shape
    for i in range(n):
        s = 0.0
        for r in range(rows):
            s += jacobian[r, i] * residual[r]
        gradient[i] = s
        for j in range(i + 1):
            s = 0.0
            for r in range(rows):
                s += jacobian[r, i] * jacobian[r, j]
            normal[i, j] = s


@pure
def downhill(matrix, gradient, low, high, side, i):
    """g[i] less what the joints at their bounds take of it through M."""
    s = gradient[i]
    for j in range(gradient.shape[0]):
        if side[j] != 0:
            s -= (matrix[i, j] if i >= j else matrix[j, i]) * (low[j] if side[j] < 0 else high[j])
    return s


@outlined
def box_step(matrix, gradient, low, high, step, rhs, free, side, factor):
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
        rhs: (n,) work space.
        free: (n,) work space, int.
        side: (n,) work space, int: -1 at the lower bound, 1 at the upper, 0 free.
        factor: (n, n) work space.

    Returns:
        Joints pressed against a bound at which they already stood, or -1 when M is not positive definite.
    """
    n = gradient.shape[0]
    steepest = 0.0
    for i in range(n):
        steepest = max(steepest, abs(gradient[i]))
        side[i] = 0
        if low[i] > -_AT_BOUND and gradient[i] < 0.0:
            side[i] = -1
        elif high[i] < _AT_BOUND and gradient[i] > 0.0:
            side[i] = 1
    fewest, patience = n + 1, 3
    for _ in range(10 + 4 * n):
        size = types.int64(0)
        for i in range(n):
            if side[i] == 0:
                rhs[i] = downhill(matrix, gradient, low, high, side, i)
                free[size] = i
                size += 1
        if not cholesky_solve(matrix, rhs, free, size, factor, step):
            return -1
        for i in range(n):
            if side[i] != 0:
                step[i] = low[i] if side[i] < 0 else high[i]
        wrong, last = 0, -1
        for i in range(n):
            free[i] = side[i]
            if side[i] == 0:
                if step[i] < low[i] or step[i] > high[i]:
                    free[i] = -1 if step[i] < low[i] else 1
            elif high[i] > low[i]:
                slope = gradient[i]
                for j in range(n):
                    slope -= (matrix[i, j] if i >= j else matrix[j, i]) * step[j]
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
    pressed = 0
    for i in range(n):
        step[i] = min(max(step[i], low[i]), high[i])
        if (side[i] < 0 and low[i] > -_AT_BOUND) or (side[i] > 0 and high[i] < _AT_BOUND):
            pressed += 1
    return pressed
