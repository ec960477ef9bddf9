"""Least-squares pose of known points seen in one picture, compiled: Levenberg-Marquardt (Nielsen's damping).

Residuals are differences of undistorted normalised coordinates, turned into standard deviations by one
matrix ("block") for each group of corners whose errors are correlated: the four of a marker.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math

import numpy as np

from robot_ik.camera.lens_kernels import FX, FY, bend_point
from robot_ik.kernels.jit import kernel, outlined

_STEPS = 30
# Relative gain below which the fit is finished.
_DONE = 1e-10
# Behind the camera there is no picture: a large residual turns the fit back.
_LEAST_DEPTH = 1e-6
_FREEDOMS = 6


@kernel
def whiten(ideal, covariance, lens, blocks, to_pixels):
    """Fills the blocks (m, 8, 8) of m markers, and ``to_pixels`` (4 m, 2, 2): pixels by ideal coordinates.

    A block is L^-1 times the derivative of the lens mapping, with L Lᵀ = ``covariance`` (m, 8, 8) in px^2.
    """
    lower = np.empty((8, 8))
    for m in range(len(blocks)):
        for i in range(8):
            for j in range(i + 1):
                total = covariance[m, i, j]
                for k in range(j):
                    total -= lower[i, k] * lower[j, k]
                lower[i, j] = total / lower[j, j] if i > j else math.sqrt(total)
        block = blocks[m]
        for k in range(4):
            _, _, xx, xy, yy = bend_point(lens, ideal[4 * m + k, 0], ideal[4 * m + k, 1])
            slope = to_pixels[4 * m + k]
            slope[0, 0], slope[0, 1] = lens[FX] * xx, lens[FX] * xy
            slope[1, 0], slope[1, 1] = lens[FY] * xy, lens[FY] * yy
            for column in range(2 * k, 2 * k + 2):
                for i in range(8):
                    total = slope[i - 2 * k, column - 2 * k] if 2 * k <= i < 2 * k + 2 else 0.0
                    for j in range(i):
                        total -= lower[i, j] * block[j, column]
                    block[i, column] = total / lower[i, i]


@kernel
def fit_poses(points, ideal, blocks, poses, costs):
    """Fits from several starts.

    Args:
        points: (n, 3) in the body's frame, metres.
        ideal: (n, 2) where they were seen.
        blocks: (m, b, b) with m b = 2 n.
        poses: (k, 7) position and quaternion wxyz: starts in, results out.
        costs: (k,) sums of squares out.
    """
    rows = 2 * len(points)
    residual, jacobian = np.empty(rows), np.empty((rows, _FREEDOMS))
    raw, slope = np.empty(rows), np.empty((rows, _FREEDOMS))
    normal, step, trial = np.empty((_FREEDOMS, _FREEDOMS)), np.empty(_FREEDOMS), np.empty(7)
    for k in range(len(poses)):
        pose = poses[k]
        cost = whitened(points, ideal, blocks, pose, raw, slope, residual, jacobian)
        damping, growth = 1e-4, 2.0
        for _ in range(_STEPS):
            if not lm_step(residual, jacobian, damping, normal, step):
                break
            moved(pose, step, trial)
            trial_cost = whitened(points, ideal, blocks, trial, raw, slope, residual, jacobian)
            if trial_cost < cost:
                done = cost - trial_cost < _DONE * (1.0 + cost)
                for i in range(7):
                    pose[i] = trial[i]
                cost, damping, growth = trial_cost, max(0.1 * damping, 1e-9), 2.0
                if done:
                    break
            else:
                damping, growth = damping * growth, 2.0 * growth
                largest = 0.0
                for i in range(_FREEDOMS):
                    largest = max(largest, abs(step[i]))
                if damping > 1e8 or not largest >= 1e-13:
                    break
                whitened(points, ideal, blocks, pose, raw, slope, residual, jacobian)
        costs[k] = cost


@kernel
def evaluate(points, ideal, to_pixels, blocks, pose, residual, jacobian, pixels, costs):
    """How well one pose (7,) fits.

    Args:
        points: (n, 3) in the body's frame, metres.
        ideal: (n, 2) where they were seen.
        to_pixels: (n, 2, 2) pixels by ideal coordinates.
        blocks: (m, b, b) with m b = 2 n.
        pose: (7,).
        residual: (2n,) out, standard deviations.
        jacobian: (2n, 6) out: its derivative by translation and rotation along the camera's axes.
        pixels: (m,) out: RMS distance in px of each block's corners.
        costs: (m,) out: sum of squares of each block.
    """
    raw, slope = np.empty(len(residual)), np.empty((len(residual), _FREEDOMS))
    whitened(points, ideal, blocks, pose, raw, slope, residual, jacobian)
    size = blocks.shape[1]
    for m in range(len(blocks)):
        square, cost = 0.0, 0.0
        for i in range(m * size, (m + 1) * size, 2):
            p = i // 2
            dx = to_pixels[p, 0, 0] * raw[i] + to_pixels[p, 0, 1] * raw[i + 1]
            dy = to_pixels[p, 1, 0] * raw[i] + to_pixels[p, 1, 1] * raw[i + 1]
            square += dx * dx + dy * dy
            cost += residual[i] * residual[i] + residual[i + 1] * residual[i + 1]
        pixels[m], costs[m] = math.sqrt(2.0 * square / size), cost


@outlined
def whitened(points, ideal, blocks, pose, raw, slope, residual, jacobian):
    """Residuals (2n,) and derivatives (2n, 6), as they are and in standard deviations; the sum of squares."""
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    for p in range(len(points)):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        tx = (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y - w * z) * b + 2.0 * (x * z + w * y) * c
        ty = 2.0 * (x * y + w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z - w * x) * c
        tz = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c
        depth = max(tz + pose[2], _LEAST_DEPTH)
        u, v, inverse = (tx + pose[0]) / depth, (ty + pose[1]) / depth, 1.0 / depth
        raw[2 * p], raw[2 * p + 1] = u - ideal[p, 0], v - ideal[p, 1]
        r, s = slope[2 * p], slope[2 * p + 1]
        # d(exp(w) r) / dw = -[r]x
        r[0], r[1], r[2] = inverse, 0.0, -u * inverse
        r[3], r[4], r[5] = -u * ty * inverse, (tz + u * tx) * inverse, -ty * inverse
        s[0], s[1], s[2] = 0.0, inverse, -v * inverse
        s[3], s[4], s[5] = -(tz + v * ty) * inverse, v * tx * inverse, tx * inverse
    size, cost = blocks.shape[1], 0.0
    for m in range(len(blocks)):
        for i in range(size):
            row = m * size + i
            residual[row] = 0.0
            for k in range(_FREEDOMS):
                jacobian[row, k] = 0.0
            for j in range(size):
                value = blocks[m, i, j]
                residual[row] += value * raw[m * size + j]
                for k in range(_FREEDOMS):
                    jacobian[row, k] += value * slope[m * size + j, k]
            cost += residual[row] * residual[row]
    return cost


@outlined
def lm_step(residual, jacobian, damping, normal, step):
    """The damped step, by L D Lᵀ; False when the system is singular."""
    for i in range(_FREEDOMS):
        for j in range(i + 1):
            total = 0.0
            for row in range(len(residual)):
                total += jacobian[row, i] * jacobian[row, j]
            normal[i, j] = total
        normal[i, i] += damping * (normal[i, i] + 1e-12)
        step[i] = 0.0
        for row in range(len(residual)):
            step[i] -= jacobian[row, i] * residual[row]
    for k in range(_FREEDOMS):
        if not normal[k, k] > 0.0:
            return False
        for i in range(k + 1, _FREEDOMS):
            share = normal[i, k] / normal[k, k]
            for j in range(k + 1, i + 1):
                normal[i, j] -= share * normal[j, k]
            step[i] -= share * step[k]
    for k in range(_FREEDOMS - 1, -1, -1):
        step[k] /= normal[k, k]
        for i in range(k):
            step[i] -= normal[k, i] * step[k]
    return True


@outlined
def moved(pose, step, result):
    """``result`` (7,): the pose after a translation and a rotation along the camera's axes."""
    angle = math.sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    scale = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    a, b, c, d = math.cos(0.5 * angle), scale * step[3], scale * step[4], scale * step[5]
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    for i in range(3):
        result[i] = pose[i] + step[i]
    result[3] = a * w - b * x - c * y - d * z
    result[4] = a * x + b * w + c * z - d * y
    result[5] = a * y - b * z + c * w + d * x
    result[6] = a * z + b * y - c * x + d * w
    size = math.sqrt(result[3] ** 2 + result[4] ** 2 + result[5] ** 2 + result[6] ** 2)
    for i in range(3, 7):
        result[i] /= size
