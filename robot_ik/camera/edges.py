"""Least-squares fit of straight edges to pixels, many edges at once.

Model of the grey value near one edge, for a pixel at signed distance d (px, positive on the light side) from
the current line and at the fraction t of the way along it:

    I(d, t) = middle(t) + contrast(t) * erf((d - offset(t)) / (sqrt(2) blur))

with ``middle``, ``contrast`` and ``offset`` linear in t: uneven light is part of the model.  Pixels are used
as they are, never resampled, so their noise is independent and the covariance is honest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Blur in px: the pixel's own width alone gives 0.29; beyond 4 px no cell of a marker could be read.
BLUR_START = 0.8
_BLUR_RANGE = (0.25, 4.0)
# How far ln(blur) is believed to be from its start when the picture does not say: a factor 1.8.
_BLUR_SPREAD = 0.6
# Residuals beyond this many standard deviations lose weight (Cauchy's function): dirt, glare, occlusion.
_CAUCHY = 2.4
# Keeps weights meaningful in pictures without noise: quantisation to whole grey levels.
_LEAST_NOISE = 0.3
_PARAMETERS = 7


@dataclass(frozen=True, eq=False)
class EdgePixels:
    """Pixels near s edges, n for each.

    Attributes:
        distance: (s, n) signed distance from the current line, px, positive on the light side.
        along: (s, n) fraction of the way from the edge's first to its second end.
        value: (s, n) grey levels.
        weight: (s, n) 1 for pixels that belong to the edge, 0 for padding.
    """

    distance: Array
    along: Array
    value: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Result for s edges.

    Attributes:
        offset: (s, 2) offset of the edge from the current line at its two ends, px.
        covariance: (s, 2, 2) of ``offset``, px^2.
        contrast: (s,) half the difference between light and dark, grey levels.
        blur: (s,) px.
        noise: (s,) standard deviation of the residual, grey levels.
    """

    offset: Array
    covariance: Array
    contrast: Array
    blur: Array
    noise: Array


def erf(x: Array) -> Array:
    """Error function to 1.5e-7 (Abramowitz and Stegun 7.1.26); numpy has none."""
    size = np.abs(x)
    t = 1.0 / (1.0 + 0.3275911 * size)
    series = t * (
        0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429)))
    )
    return np.asarray(np.copysign(1.0 - series * np.exp(-size * size), x))


def fit_edges(pixels: EdgePixels, start: Array, blur: Array, steps: int) -> EdgeFit:
    """Fits all edges by Gauss-Newton with Cauchy weights.

    Args:
        pixels: The data.
        start: (s, 2) offsets to start from, px.
        blur: (s,) blur to start from, px.
        steps: Number of Gauss-Newton steps.
    """
    s = len(start)
    t = pixels.along
    x = np.zeros((s, _PARAMETERS))  # offset at both ends, ln blur, middle at both ends, contrast at both ends
    x[:, :2] = start
    x[:, 2] = np.log(blur)
    prior = np.zeros((s, _PARAMETERS, _PARAMETERS))
    x[:, 3:] = _levels(pixels, x)
    noise = np.full(s, np.inf)
    normal = np.zeros((s, _PARAMETERS, _PARAMETERS))
    for step in range(steps + 1):
        residual, jacobian = _linearise(pixels, x)
        noise = _spread(residual, pixels.weight)
        weight = pixels.weight / (1.0 + (residual / (_CAUCHY * noise[:, None])) ** 2)
        weighted = jacobian * weight[:, :, None]
        normal = np.einsum("snp,snq->spq", weighted, jacobian)
        if step == steps:
            break
        prior[:, 2, 2] = (noise / _BLUR_SPREAD) ** 2
        right = np.einsum("snp,sn->sp", weighted, residual)
        right[:, 2] += prior[:, 2, 2] * (np.log(BLUR_START) - x[:, 2])
        # A trace of damping: an edge without contrast must not make the system singular.
        damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-9
        system = normal + prior + damping[:, None, None] * np.eye(_PARAMETERS)
        move = np.linalg.solve(system, right[:, :, None])[:, :, 0]
        move[:, :2] = np.clip(move[:, :2], -1.5, 1.5)
        move[:, 2] = np.clip(move[:, 2], -0.5, 0.5)
        x += move
        x[:, 2] = np.clip(x[:, 2], *np.log(_BLUR_RANGE))
    damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-9
    covariance = np.linalg.inv(normal + prior + damping[:, None, None] * np.eye(_PARAMETERS))
    del t
    return EdgeFit(
        offset=x[:, :2],
        covariance=covariance[:, :2, :2] * noise[:, None, None] ** 2,
        contrast=0.5 * (x[:, 5] + x[:, 6]),
        blur=np.exp(x[:, 2]),
        noise=noise,
    )


def _levels(pixels: EdgePixels, x: Array) -> Array:
    """(s, 4) middle and contrast at both ends, by linear least squares with offset and blur held."""
    _, jacobian = _linearise(pixels, np.concatenate([x[:, :3], np.zeros((len(x), 4))], axis=1))
    linear = jacobian[:, :, 3:]
    weighted = linear * pixels.weight[:, :, None]
    normal = np.einsum("snp,snq->spq", weighted, linear) + 1e-6 * np.eye(4)
    right = np.einsum("snp,sn->sp", weighted, pixels.value)
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])


def _linearise(pixels: EdgePixels, x: Array) -> tuple[Array, Array]:
    """Residual (s, n) = value - model, and the derivative (s, n, 7) of the model."""
    t = pixels.along
    u = 1.0 - t
    root = 1.0 / (np.sqrt(2.0) * np.exp(x[:, 2:3]))
    z = (pixels.distance - (x[:, 0:1] * u + x[:, 1:2] * t)) * root
    step = erf(z)
    contrast = x[:, 5:6] * u + x[:, 6:7] * t
    slope = contrast * (2.0 / np.sqrt(np.pi)) * np.exp(-z * z)
    jacobian = np.empty((*t.shape, _PARAMETERS))
    jacobian[:, :, 0] = -slope * root * u
    jacobian[:, :, 1] = -slope * root * t
    jacobian[:, :, 2] = -slope * z
    jacobian[:, :, 3] = u
    jacobian[:, :, 4] = t
    jacobian[:, :, 5] = step * u
    jacobian[:, :, 6] = step * t
    model = x[:, 3:4] * u + x[:, 4:5] * t + contrast * step
    return pixels.value - model, jacobian


def _spread(residual: Array, weight: Array) -> Array:
    """(s,) robust standard deviation: median of the sizes, corrected for the parameters used up."""
    used = weight > 0
    count = used.sum(axis=1)
    size = np.sort(np.where(used, np.abs(residual), np.inf), axis=1)
    middle = size[np.arange(len(size)), np.maximum(count // 2, 0)]
    freedom = np.maximum(count - _PARAMETERS, 1) / np.maximum(count, 1)
    spread = 1.4826 * np.where(np.isfinite(middle), middle, 0.0) / np.sqrt(freedom)
    return np.asarray(np.maximum(spread, _LEAST_NOISE))
