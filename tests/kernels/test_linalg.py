"""The box-constrained step against an independent bounded least-squares solver."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from robot_ik.kernels.linalg import box_step


def solve(matrix, gradient, low, high):
    n = len(gradient)
    step, free = np.zeros(n), np.zeros(n, dtype=np.int64)
    pressed = box_step(np.tril(matrix), gradient, low, high, step, free, free.copy(), np.zeros((n, n)))
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
    return matrix, rng.normal(size=n), low, high


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
        stuck = (
            ((gradient <= 0) & (high >= 0) & (low == 0)) | ((gradient >= 0) & (high == 0)) | (gradient == 0)
        )
        assert stuck.all()


@settings(max_examples=300)
@given(problems())
def test_a_step_is_the_minimiser_inside_the_box(problem):
    matrix, gradient, low, high = problem
    _, step = solve(matrix, gradient, low, high)
    # Kuhn and Tucker's conditions, which for a convex problem hold at the minimum and nowhere else.
    slope = matrix @ step - gradient
    slack = 1e-9 * (1 + np.abs(matrix).max() * np.abs(step).max() + np.abs(gradient).max())
    assert (np.abs(slope[(step > low) & (step < high)]) <= slack).all()
    assert (slope[(step == low) & (low < high)] >= -slack).all()
    assert (slope[(step == high) & (low < high)] <= slack).all()
    # SciPy's own answer is never better; now and then it stops early, and is worse.
    some, found = best(matrix, gradient, low, high)
    other = np.zeros_like(step)
    other[some] = found
    assert value(matrix, gradient, step) <= value(matrix, gradient, other) + slack
    free = np.linalg.solve(matrix, gradient)
    if (free > low).all() and (free < high).all():
        np.testing.assert_allclose(step, free, rtol=1e-9)


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
