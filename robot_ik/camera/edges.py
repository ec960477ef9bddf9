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

# Blur in px.  The pixel's own width alone gives 0.29, but a model sharper than a third has a minimum between
# any two pixels (sharpened pictures show it); beyond 4 px no cell of a marker could be read.
BLUR_START = 0.8
_BLUR_RANGE = (0.33, 4.0)
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


def _erf(x: Array) -> tuple[Array, Array]:
    """Error function to 1.5e-7 (Abramowitz and Stegun 7.1.26; numpy has none), and exp(-x^2)."""
    t = 1.0 / (1.0 + 0.3275911 * np.abs(x))
    bell = np.exp(-x * x)
    series = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    return np.copysign(1.0 - series * bell, x), bell


def fit_edges(pixels: EdgePixels, start: Array, blur: Array, blur_spread: float, steps: int) -> EdgeFit:
    """Fits all edges by Gauss-Newton with Cauchy weights.

    Args:
        pixels: The data.
        start: (s, 2) offsets to start from, px.
        blur: (s,) blur to start from and to believe in where the pixels do not say, px.
        blur_spread: How far ln(blur) is believed to be from that.
        steps: Number of Gauss-Newton steps.
    """
    s = len(start)
    # Parameters: offset at both ends, ln blur, middle at both ends, contrast at both ends.
    x = np.zeros((s, _PARAMETERS))
    x[:, :2] = start
    x[:, 2] = np.log(blur)
    x[:, 3:] = _levels(pixels, x)
    for step in range(steps + 1):
        residual, jacobian = _linearise(pixels, x)
        noise = _spread(residual, pixels.weight)
        weight = pixels.weight / (1.0 + (residual / (_CAUCHY * noise[:, None])) ** 2)
        weighted = jacobian * weight[:, None, :]
        system = weighted @ jacobian.transpose(0, 2, 1)
        prior = (noise / blur_spread) ** 2
        system[:, 2, 2] += prior
        # A trace of damping: an edge without contrast must not make the system singular.
        diagonal = np.einsum("spp->sp", system)
        diagonal += 1e-9 * diagonal.sum(axis=1, keepdims=True) + 1e-9
        if step == steps:
            break
        right = (weighted @ residual[:, :, None])[:, :, 0]
        right[:, 2] += prior * (np.log(blur) - x[:, 2])
        move = np.linalg.solve(system, right[:, :, None])[:, :, 0]
        # Far from the edge the model is flat and a step can be anything: keep it in sight.
        move[:, :2] = np.clip(move[:, :2], -1.5, 1.5)
        move[:, 2] = np.clip(move[:, 2], -0.5, 0.5)
        x += move
        x[:, 2] = np.clip(x[:, 2], *np.log(_BLUR_RANGE))
    covariance = np.linalg.inv(system)[:, :2, :2] * noise[:, None, None] ** 2
    contrast = 0.5 * (x[:, 5] + x[:, 6])
    return EdgeFit(x[:, :2], covariance, contrast, np.exp(x[:, 2]), noise)


def _levels(pixels: EdgePixels, x: Array) -> Array:
    """(s, 4) middle and contrast at both ends, by linear least squares with offset and blur held."""
    _, jacobian = _linearise(pixels, x)
    linear = jacobian[:, 3:]
    weighted = linear * pixels.weight[:, None, :]
    normal = weighted @ linear.transpose(0, 2, 1) + 1e-6 * np.eye(4)
    right = weighted @ pixels.value[:, :, None]
    return np.asarray(np.linalg.solve(normal, right)[:, :, 0])


def _linearise(pixels: EdgePixels, x: Array) -> tuple[Array, Array]:
    """Residual (s, n) = value - model, and the derivative (s, 7, n) of the model."""
    t = pixels.along
    u = 1.0 - t
    root = 1.0 / (np.sqrt(2.0) * np.exp(x[:, 2:3]))
    z = (pixels.distance - (x[:, 0:1] * u + x[:, 1:2] * t)) * root
    step, bell = _erf(z)
    contrast = x[:, 5:6] * u + x[:, 6:7] * t
    slope = contrast * bell * (-2.0 / np.sqrt(np.pi))
    moved = slope * root
    jacobian = np.empty((len(t), _PARAMETERS, t.shape[1]))
    np.multiply(moved, u, out=jacobian[:, 0])
    np.multiply(moved, t, out=jacobian[:, 1])
    np.multiply(slope, z, out=jacobian[:, 2])
    jacobian[:, 3] = u
    jacobian[:, 4] = t
    np.multiply(step, u, out=jacobian[:, 5])
    np.multiply(step, t, out=jacobian[:, 6])
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
