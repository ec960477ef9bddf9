"""The singular values and vectors against LAPACK's, for every shape, rank and size."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.kernels import linalg
from robot_ik.kernels.jit import kernel


@kernel
def svd(matrix, left, sigma, right):
    linalg.svd(matrix, left, sigma, right)


def decompose(matrix):
    m, n = matrix.shape
    p = min(m, n)
    left = np.full((p, m), np.nan)
    sigma = np.full(p, np.nan)
    right = np.full((p, n), np.nan)
    before = matrix.copy()
    svd(matrix, left, sigma, right)
    assert np.array_equal(matrix, before, equal_nan=True)
    return left, sigma, right


@st.composite
def matrices(draw):
    m = draw(st.integers(1, 9))
    n = draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    matrix = rng.normal(size=(m, n))
    shape = draw(st.sampled_from(["any", "rank", "graded", "columns", "close"]))
    if shape == "rank":  # exactly singular, but for rounding
        r = draw(st.integers(0, min(m, n)))
        matrix = rng.normal(size=(m, r)) @ rng.normal(size=(r, n))
    elif shape == "graded":  # nearly singular
        u, _, v = np.linalg.svd(matrix, full_matrices=False)
        matrix = u @ np.diag(10.0 ** -np.arange(0, 2 * min(m, n), 2)) @ v
    elif shape == "columns":  # joints that move nothing
        matrix[:, rng.uniform(size=n) < 0.5] = 0.0
    elif shape == "close":  # all singular values alike
        u, _, v = np.linalg.svd(matrix, full_matrices=False)
        matrix = u @ v
    return np.ascontiguousarray(matrix * draw(st.sampled_from([1.0, 1e-170, 1e-9, 1e9, 1e170])))


@settings(max_examples=100)
@given(matrices())
def test_values_and_vectors(matrix):
    left, sigma, right = decompose(matrix)
    exact = np.linalg.svd(matrix, compute_uv=False)
    size = exact[0] if exact[0] > 0 else 1.0
    np.testing.assert_allclose(sigma / size, exact / size, atol=1e-14)
    assert (np.diff(sigma) <= 1e-15 * size).all()  # the largest first
    np.testing.assert_allclose((left.T * (sigma / size)) @ right, matrix / size, atol=2e-14)
    some = sigma > 1e-12 * size  # other singular vectors are arbitrary
    unit = np.eye(int(some.sum()))
    np.testing.assert_allclose(left[some] @ left[some].T, unit, atol=1e-12)
    np.testing.assert_allclose(right[some] @ right[some].T, unit, atol=1e-12)


@settings(max_examples=100)
@given(matrices())
def test_the_pseudoinverse_from_the_svd_equals_that_of_numpy(matrix):
    left, sigma, right = decompose(matrix)
    exact = np.linalg.svd(matrix, compute_uv=False)
    if exact[0] == 0.0 or ((exact / exact[0] > 1e-13) & (exact / exact[0] < 0.9e-4)).any():
        return  # ill-conditioned: the inverse consists of rounding errors
    used = sigma > 1e-5 * sigma[0]
    mine = (right[used].T / (sigma[used] / exact[0])) @ left[used]
    np.testing.assert_allclose(mine, np.linalg.pinv(matrix / exact[0], rcond=1e-5), atol=1e-6)


@pytest.mark.parametrize("shape", [(3, 3), (2, 5), (5, 2), (3, 0), (0, 0)])
def test_a_zero_matrix_has_zero_singular_values(shape):
    left, sigma, right = decompose(np.zeros(shape))
    assert not sigma.any() and np.isfinite(left).all() and np.isfinite(right).all()
    assert not ((left.T * sigma) @ right).any()


def test_numbers_that_are_not_finite_end():
    _, sigma, _ = decompose(np.full((3, 4), np.nan))
    assert not np.isfinite(sigma).all() or not sigma.any()
