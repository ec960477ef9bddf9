"""Small dense algebra, written out: at 6 x 6 it beats a LAPACK call several times, and needs no SciPy."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

import math

from numba import types

from robot_ik.kernels.jit import outlined, pure


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


@outlined
def box_step(matrix, gradient, low, high, step, rhs, free, factor):
    """Step d that lessens ½ dᵀ M d − gᵀ d inside low <= d <= high (active set, binding bounds only grow).

    Joints that stand at a bound and are pushed against it stay; of the rest, those that the free
    minimiser takes over a bound are put there and the others solved again, until all are inside.

    Args:
        matrix: (n, n) M, symmetric positive definite; lower triangle read.
        gradient: (n,) g, the direction of descent.
        low: (n,) lower bounds of the step, low <= 0.
        high: (n,) upper bounds, high >= 0.
        step: (n,) result.
        rhs: (n,) work space.
        free: (n,) work space, int.
        factor: (n, n) work space.

    Returns:
        Joints pressed against a bound at which they already stood (the Kuhn-Tucker active set), or -1
        when M is not positive definite.
    """
    n = gradient.shape[0]
    size = types.int64(0)
    pressed = 0
    for i in range(n):
        if (low[i] > -1e-12 and gradient[i] < 0.0) or (high[i] < 1e-12 and gradient[i] > 0.0):
            step[i] = 0.0
            pressed += 1
        else:
            free[size] = i
            size += 1
            rhs[i] = gradient[i]
    while size > 0:
        if not cholesky_solve(matrix, rhs, free, size, factor, step):
            return -1
        kept = types.int64(0)
        for a in range(size):
            i = free[a]
            if step[i] < low[i]:
                step[i] = low[i]
            elif step[i] > high[i]:
                step[i] = high[i]
            else:
                free[kept] = i
                kept += 1
                continue
            # It stops at its bound; the others feel that through M.
            for j in range(n):
                rhs[j] -= (matrix[i, j] if i >= j else matrix[j, i]) * step[i]
        if kept == size:
            break
        size = kept
    return pressed
