"""Best rotations of weighted vectors, against a search and SciPy's solution."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot_ik.kernels import so3
from robot_ik.kernels.alignment import (
    NO_VECTORS,
    add_axes,
    add_vector,
    best_angle,
    best_axis,
    moment,
    rotation_terms,
)
from robot_ik.kernels.jit import kernel


@kernel
def correlate(weights, targets, vectors):
    """Correlation and moment of vectors (n, 3)."""
    correlation = NO_VECTORS
    for i in range(vectors.shape[0]):
        target = so3.read_vector(targets, i, 0)
        correlation = add_vector(correlation, weights[i], target, so3.read_vector(vectors, i, 0))
    return correlation, moment(correlation)


@kernel
def correlate_axes(weight, targets, poses):
    """Correlation of the axes of two frames, given as pose rows (1, 12)."""
    return add_axes(NO_VECTORS, weight, so3.read_rotation(targets, 0), so3.read_rotation(poses, 0))


@kernel
def angle_about(correlation, axis, lower, upper):
    """Best angle about an axis."""
    a, b = rotation_terms(correlation, axis)
    return best_angle(a, b, lower, upper)


@kernel
def free_axis(correlation):
    """Best axis."""
    return best_axis(correlation)


def random_pairs(rng, count=4):
    return rng.uniform(0.1, 2.0, count), rng.normal(size=(count, 3)), rng.normal(size=(count, 3))


def gain(weights, targets, vectors, rotation):
    return float(weights @ (targets * rotation.apply(vectors)).sum(axis=1))


def test_the_correlation_and_its_moment_are_the_sums_of_the_formula():
    weights, targets, vectors = random_pairs(np.random.default_rng(1))
    correlation, moments = correlate(weights, targets, vectors)
    np.testing.assert_allclose(correlation, np.einsum("n,ni,nj", weights, targets, vectors))
    np.testing.assert_allclose(moments, weights @ np.cross(vectors, targets), atol=1e-14)


def test_the_axes_of_a_frame_are_three_vectors():
    rng = np.random.default_rng(2)
    rotation, target = (Rotation.random(random_state=rng).as_matrix() for _ in range(2))
    rows = [np.concatenate([np.zeros(3), matrix.ravel()])[None] for matrix in (target, rotation)]
    expected, _ = correlate(np.full(3, 0.7), target.T.copy(), rotation.T.copy())
    np.testing.assert_allclose(correlate_axes(0.7, *rows), expected, atol=1e-14)


@pytest.mark.parametrize(("lower", "upper"), [(-math.pi, math.pi), (-0.4, 0.3), (2.0, 5.0)])
def test_the_best_angle_about_an_axis_is_that_of_a_search(lower, upper):
    rng = np.random.default_rng(3)
    angles = np.linspace(lower, upper, 20_001)
    for _ in range(20):
        weights, targets, vectors = random_pairs(rng)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        correlation, _ = correlate(weights, targets, vectors)
        angle = angle_about(correlation, tuple(axis.tolist()), lower, upper)
        rotations = Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()
        gains = np.einsum("n,ni,kij,nj->k", weights, targets, rotations, vectors, optimize=True)
        best = gains.max()
        assert lower <= angle <= upper
        value = gain(weights, targets, vectors, Rotation.from_rotvec(angle * axis))
        assert value >= best - 1e-12


def test_rotations_about_the_best_axis_end_at_the_best_rotation():
    rng = np.random.default_rng(4)
    for _ in range(20):
        weights, targets, vectors = random_pairs(rng)
        best, _ = Rotation.align_vectors(targets, vectors, weights=weights)
        turned = vectors.copy()
        for _ in range(200):
            correlation, _ = correlate(weights, targets, turned)
            axis = np.array(free_axis(correlation))
            length = np.linalg.norm(axis)
            if length == 0.0:
                break
            axis /= length
            angle = angle_about(correlation, tuple(axis.tolist()), -math.pi, math.pi)
            turned = Rotation.from_rotvec(angle * axis).apply(turned)
        np.testing.assert_allclose(turned, best.apply(vectors), atol=1e-6)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_opposite_vectors_have_an_axis_across_them_and_aligned_ones_have_none(direction):
    vector = np.array([direction])
    opposite, _ = correlate(np.ones(1), -vector, vector)
    axis = np.array(free_axis(opposite))
    assert np.linalg.norm(axis) > 0.5
    assert axis @ vector[0] == pytest.approx(0.0, abs=1e-12)
    aligned, _ = correlate(np.ones(1), vector, vector)
    assert np.linalg.norm(free_axis(aligned)) == 0.0
    assert angle_about(aligned, (0.0, 0.0, 1.0), -1.0, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(free_axis(NO_VECTORS)) == 0.0
