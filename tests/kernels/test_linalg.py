"""The box-constrained step against SciPy's bounded least squares; the rest against NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.optimize import lsq_linear

from robot_ik.kernels import linalg
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.linalg import BOX_PROBLEM, normal_equations, solve_definite

open_box = BOX_PROBLEM.open


@kernel
def solve_by_columns(address, matrix, damping, step):
    return linalg.solve_box_by_columns(open_box(address), matrix, damping, step)


@kernel
def solve_by_rows(address, hits, hit_count, damping, step):
    box = open_box(address)
    linalg.row_products(box.jacobian, box.residual, hits, hit_count, box.matrix, box.gradient)
    return linalg.solve_box_by_rows(box, hits, hit_count, damping, step)


def solve(matrix, gradient, low_bounds, high_bounds, damping=0.0):
    n = len(gradient)
    box = BOX_PROBLEM.allocate({"m": 0, "u": n, "k": n})
    box.arrays["gradient"][:] = gradient
    box.arrays["lower"][:] = low_bounds
    box.arrays["upper"][:] = high_bounds
    step = np.zeros(n)
    pressed = solve_by_columns(box.address, np.tril(matrix), damping, step)
    return pressed, step


def value(matrix, gradient, step):
    return 0.5 * step @ matrix @ step - gradient @ step


@st.composite
def problems(draw):
    n = draw(st.integers(1, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    factor = rng.normal(size=(n + draw(st.integers(0, 3)), n))
    matrix = factor.T @ factor + 1e-3 * np.eye(n)
    bound = draw(st.sampled_from([0.01, 0.3, 3.0, np.inf]))
    low_bounds = -bound * rng.uniform(size=n)
    high_bounds = bound * rng.uniform(size=n)
    for i in range(n):  # some joints are at a bound
        if draw(st.integers(0, 3)) == 0:
            (low_bounds if draw(st.booleans()) else high_bounds)[i] = 0.0
    return matrix, rng.normal(size=n), low_bounds, high_bounds


def best(matrix, gradient, low_bounds, high_bounds):
    """The exact minimiser, by SciPy: min |R d - R^-T g|^2 with M = R^T R is the same problem."""
    upper = np.linalg.cholesky(matrix).T
    wanted = np.linalg.solve(upper.T, gradient)
    # lsq_linear needs an interior, so joints without a range are removed.
    some = high_bounds > low_bounds
    return some, lsq_linear(
        upper[:, some], wanted, (low_bounds[some], high_bounds[some]), method="bvls", tol=1e-14
    ).x


@settings(max_examples=100)
@given(problems())
def test_a_step_is_feasible_and_never_raises_the_cost(problem):
    matrix, gradient, low_bounds, high_bounds = problem
    pressed, step = solve(matrix, gradient, low_bounds, high_bounds)
    assert pressed >= 0
    assert (step >= low_bounds).all() and (step <= high_bounds).all()
    assert value(matrix, gradient, step) <= 1e-12
    # The step is zero only if no step inside the box reduces the cost (Kuhn-Tucker).
    if not step.any():
        stuck = (
            ((gradient <= 0) & (high_bounds >= 0) & (low_bounds == 0))
            | ((gradient >= 0) & (high_bounds == 0))
            | (gradient == 0)
        )
        assert stuck.all()


@settings(max_examples=100)
@given(problems())
def test_a_step_is_the_minimiser_inside_the_box(problem):
    matrix, gradient, low_bounds, high_bounds = problem
    _, step = solve(matrix, gradient, low_bounds, high_bounds)
    # The conditions of Kuhn and Tucker hold only at the minimum of a convex problem.
    slope = matrix @ step - gradient
    slack = 1e-9 * (1 + np.abs(matrix).max() * np.abs(step).max() + np.abs(gradient).max())
    assert (np.abs(slope[(step > low_bounds) & (step < high_bounds)]) <= slack).all()
    assert (slope[(step == low_bounds) & (low_bounds < high_bounds)] >= -slack).all()
    assert (slope[(step == high_bounds) & (low_bounds < high_bounds)] <= slack).all()
    # SciPy's solution is never better. It is sometimes worse, because SciPy stops early.
    some, free_step = best(matrix, gradient, low_bounds, high_bounds)
    other = np.zeros_like(step)
    other[some] = free_step
    assert value(matrix, gradient, step) <= value(matrix, gradient, other) + slack
    free = np.linalg.solve(matrix, gradient)
    if (free > low_bounds).all() and (free < high_bounds).all():
        np.testing.assert_allclose(step, free, rtol=1e-9)


def test_joints_pressed_against_their_bounds_are_counted():
    matrix = np.eye(3)
    gradient = np.array([1.0, -1.0, 1.0])
    pressed, step = solve(matrix, gradient, np.array([-1.0, 0.0, -1.0]), np.array([1.0, 1.0, 0.0]))
    assert pressed == 2 and step.tolist() == [1.0, 0.0, 0.0]


def test_a_matrix_that_is_not_positive_definite_is_refused():
    wide = np.array([-9.0, -9.0]), np.array([9.0, 9.0])
    assert solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.ones(2), *wide)[0] == -1
    assert solve(np.full((2, 2), np.nan), np.ones(2), *wide)[0] == -1


def test_without_degrees_of_freedom_the_step_is_zero():
    assert solve(np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))[0] == 0


@njit
def solve_many(matrix, rhs):
    return solve_definite(matrix, rhs, len(rhs))


@njit
def normal_of(jacobian, residual, normal, gradient):
    normal_equations(jacobian, residual, normal, gradient)


@pytest.mark.parametrize("n", range(1, 11))
def test_definite_systems_are_solved(n):
    rng = np.random.default_rng(n)
    for noise in (1.0, 1e-5):  # the second is nearly singular
        factor = rng.normal(size=(n, max(1, n - 1)))
        matrix = factor @ factor.T + noise * np.eye(n)
        wanted = rng.normal(size=n)
        x = matrix @ wanted
        assert solve_many(np.tril(matrix), x)  # only the lower triangle is read
        np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-14 * np.linalg.cond(matrix) * n)
        matrix[n - 1, n - 1] -= 1e3
        assert not solve_many(np.tril(matrix), wanted.copy())


@pytest.mark.parametrize("rows", [1, 3, 6, 12])
@pytest.mark.parametrize("n", [1, 6, 9])
def test_normal_equations_equal_those_of_numpy(rows, n):
    rng = np.random.default_rng(rows + n)
    jacobian = rng.normal(size=(rows, n))
    residual = rng.normal(size=rows)
    jacobian[:, 0] = 0.0  # a joint that moves nothing
    normal = np.full((n, n), 7.0)
    gradient = np.full(n, 7.0)
    normal_of(jacobian, residual, normal, gradient)
    np.testing.assert_allclose(np.tril(normal), np.tril(jacobian.T @ jacobian), atol=1e-13)
    np.testing.assert_allclose(gradient, jacobian.T @ residual, atol=1e-13)


@settings(max_examples=100)
@given(
    m=st.integers(1, 8),
    more=st.integers(0, 5),
    seed=st.integers(0, 2**32),
    size=st.floats(-6, 1),
    damping=st.floats(-6, 0),
    bound=st.sampled_from([0.01, 0.3, 3.0]),
)
def test_the_step_of_the_system_of_rows_is_the_same(m, more, seed, size, damping, bound):
    rng = np.random.default_rng(seed)
    n = m + more
    jacobian = rng.normal(size=(m, n))
    residual = rng.normal(size=m) * 10.0**size
    jacobian[rng.uniform(size=(m, n)) < 0.3] = 0.0
    low_bounds = -bound * rng.uniform(size=n)
    high_bounds = bound * rng.uniform(size=n)
    low_bounds[rng.uniform(size=n) < 0.2] = 0.0
    high_bounds[rng.uniform(size=n) < 0.2] = 0.0
    products = jacobian.T @ jacobian
    pressed, expected = solve(
        products, jacobian.T @ residual, low_bounds, high_bounds, 10.0**damping
    )
    hits = np.ascontiguousarray(np.argsort(jacobian == 0.0, axis=0, kind="stable").T)
    hit_count = (jacobian != 0.0).sum(axis=0)
    box = BOX_PROBLEM.allocate({"m": m, "u": n, "k": n})
    box.arrays["jacobian"][:] = jacobian
    box.arrays["residual"][:] = residual
    box.arrays["lower"][:] = low_bounds
    box.arrays["upper"][:] = high_bounds
    step = np.zeros(n)
    assert solve_by_rows(box.address, hits, hit_count, 10.0**damping, step) == pressed
    gradient = box.arrays["gradient"]
    np.testing.assert_allclose(gradient, jacobian.T @ residual, atol=1e-14 + 1e-13 * 10.0**size)
    np.testing.assert_allclose(
        step, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max(initial=1e-300)
    )


@njit
def solve_with_factors(matrix, first, x):
    n = len(x)
    linalg.factorise(matrix, first, n)
    linalg.solve_lower(matrix, first, x, n)
    linalg.solve_upper(matrix, first, x, n)


@pytest.mark.parametrize("n", range(1, 11))
def test_factors_solve_a_system_inside_its_skyline(n):
    rng = np.random.default_rng(n)
    lower = np.tril(rng.normal(size=(n, n))) + 3.0 * np.eye(n)
    first = np.array([rng.integers(0, i + 1) for i in range(n)])
    for i in range(n):
        lower[i, : first[i]] = 0.0
    matrix = lower @ lower.T
    x = rng.normal(size=n)
    wanted = np.linalg.solve(matrix, x)
    solve_with_factors(np.tril(matrix), first, x)
    np.testing.assert_allclose(x, wanted, rtol=1e-9, atol=1e-12)


def test_an_unknown_without_a_pivot_is_zero():
    matrix = np.array([[2.0, 0.0], [0.0, 0.0]])
    x = np.array([4.0, 1.0])
    solve_with_factors(matrix, np.zeros(2, dtype=np.int64), x)
    np.testing.assert_allclose(x, [2.0, 0.0], rtol=1e-15)
