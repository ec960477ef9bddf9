"""The box-constrained step against an independent bounded least-squares solver."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from robot_ik.kernels.linalg import box_step


def solve(matrix, gradient, low, high):
    n = len(gradient)
    step, rhs, free = np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64)
    pressed = box_step(np.tril(matrix), gradient, low, high, step, rhs, free, np.zeros((n, n)))
    return pressed, step


def value(matrix, gradient, step):
    return 0.5 * step @ matrix @ step - gradient @ step


@st.composite
def problems(draw):
    n = draw(st.integers(1, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    factor = rng.normal(size=(n + draw(st.integers(0, 3)), n))
    matrix = factor.T @ factor + 1e-3 * np.eye(n)
    room = draw(st.sampled_from([0.01, 0.3, 3.0, np.inf]))
    low, high = -room * rng.uniform(size=n), room * rng.uniform(size=n)
    for i in range(n):  # some joints stand at a bound
        if draw(st.integers(0, 3)) == 0:
            (low if draw(st.booleans()) else high)[i] = 0.0
    return matrix, rng.normal(size=n), np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf)


def best(matrix, gradient, low, high):
    """The exact minimiser, by SciPy: min |R d - R^-T g|^2 with M = R^T R is the same problem."""
    upper = np.linalg.cholesky(matrix).T
    wanted = np.linalg.solve(upper.T, gradient)
    # lsq_linear wants an interior: a joint with no room at all is taken out.
    some = high > low
    return some, lsq_linear(upper[:, some], wanted, (low[some], high[some]), method="bvls", tol=1e-14).x


@settings(max_examples=300)
@given(problems())
def test_a_step_is_feasible_and_never_uphill(problem):
    matrix, gradient, low, high = problem
    pressed, step = solve(matrix, gradient, low, high)
    assert pressed >= 0
    assert (step >= low).all() and (step <= high).all()
    assert value(matrix, gradient, step) <= 1e-12
    # It stands still only where no step inside the box leads down (Kuhn-Tucker).
    if not step.any():
        stuck = ((gradient <= 0) & (high >= 0) & (low == 0)) | ((gradient >= 0) & (high == 0)) | (gradient == 0)
        assert stuck.all()


@settings(max_examples=300)
@given(problems())
def test_the_exact_minimiser_where_no_bound_is_met_and_never_below_it(problem):
    """Promised: the exact box minimum where the free minimiser is inside; otherwise a descent step, not the best.

    Binding bounds only grow within one call, so a joint once stopped is not let go again: the next step does that.
    """
    matrix, gradient, low, high = problem
    _, step = solve(matrix, gradient, low, high)
    some, exact_some = best(matrix, gradient, low, high)
    exact = np.zeros(len(step))
    exact[some] = exact_some
    least = value(matrix, gradient, exact)
    assert value(matrix, gradient, step) >= least - 1e-9 * (1 + abs(least))
    free = np.linalg.solve(matrix, gradient)
    if (free > low).all() and (free < high).all():
        np.testing.assert_allclose(step, free, atol=1e-9 * (1 + np.abs(free).max()))


@settings(max_examples=100)
@given(problems())
def test_repeated_steps_come_to_the_exact_minimum(problem):
    """What the solvers rely on: a joint stopped too early is let go in the next step."""
    matrix, gradient, low, high = problem
    total = np.zeros(len(gradient))
    for _ in range(60):
        room_low, room_high = np.minimum(low - total, 0), np.maximum(high - total, 0)
        _, step = solve(matrix, gradient - matrix @ total, room_low, room_high)
        total = np.clip(total + step, low, high)
    some, exact = best(matrix, gradient, low, high)
    np.testing.assert_allclose(total[some], exact, atol=1e-6 * (1 + np.abs(exact).max(initial=0)))


def test_joints_pressed_against_their_bounds_are_counted():
    matrix, gradient = np.eye(3), np.array([1.0, -1.0, 1.0])
    pressed, step = solve(matrix, gradient, np.array([-1.0, 0.0, -1.0]), np.array([1.0, 1.0, 0.0]))
    assert pressed == 2 and step.tolist() == [1.0, 0.0, 0.0]


def test_a_matrix_that_is_not_positive_definite_is_refused():
    wide = np.array([-9.0, -9.0]), np.array([9.0, 9.0])
    assert solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.ones(2), *wide)[0] == -1
    assert solve(np.full((2, 2), np.nan), np.ones(2), *wide)[0] == -1


def test_no_freedom_at_all_is_no_step():
    assert solve(np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0))[0] == 0
