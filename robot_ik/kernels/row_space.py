"""The damped step inside a box where a problem has fewer rows than joints: solved among the rows.

With m rows and n > m joints, (JᵀJ + λ) d = Jᵀr is as well d = Jᵀy with (JJᵀ + λ) y = r: a smaller system
and a better conditioned one.  A joint that stops at a bound takes its column out of JJᵀ and its share
out of r.  Since λy is what is left of the residual, Jᵀy says of every joint where it would like to go:
of those that are free, where they go.

``hits`` (n, m) and ``counts`` (n,) list for every column the rows in which it may not be zero: in a
tree most joints move few of the goals.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import outlined, pure
from robot_ik.kernels.linalg import guess_sides, keep_to_box, solve_definite


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
def take_out(jacobian, hits, counts, u, bound, factor, push):
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
    """The step d that minimises ½ |J d − r|² + ½ λ |d|² inside low <= d <= high, exactly; as ``box_step``.

    Args:
        jacobian: (m, n), m <= n.
        residual: (m,) r.
        gram: (m, m) or larger, from ``row_products``.
        gradient: (n,) from there.
        damping: λ > 0.
        low: (n,) lower bounds of the step, low <= 0.
        high: (n,) upper bounds, high >= 0.
        hits: (n, m) rows of each column, see above.
        counts: (n,) how many.
        step: (n,) result.
        free: (n,) work space, int.
        side: (n,) work space, int: -1 at the lower bound, 1 at the upper, 0 free.
        factor: (m, m) or larger, work space.
        push: (m,) or longer, work space: y.

    Returns:
        Joints pressed against a bound at which they already stood, or -1 when JJᵀ + λ is not positive
        definite to working precision.
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
                take_out(jacobian, hits, counts, u, low[u] if side[u] < 0 else high[u], factor, push)
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
