"""Estimate the shadow that lies on a part of a print.

The print fit assumes that the brightness of paper and ink is linear over the print. The border of a
shadow is not. A shadow multiplies the grey values of paper and ink by the same factor. The factor
is therefore estimated from the ratio of the grey values to those of the fitted print. It is
bilinear between nodes at the borders of the cells.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array

# Prior standard deviation of the second differences of the factor between nodes. A smaller value
# smooths the border of a shadow. With a larger value the factor follows the noise.
_BEND_SIGMA = 0.1
# Prior standard deviation of the factor of a node. It keeps the system regular.
_FACTOR_SIGMA = 10.0
# Range of the factor.
_MIN_FACTOR = 0.05
_MAX_FACTOR = 20.0


def shade_factors(
    u: Array, v: Array, grey: Array, model: Array, weights: Array, cells: int
) -> Array:
    """Return the factor (k,) by which a shadow multiplies the grey values of k pixels.

    Args:
        u: (k,) position to the right, in marker sides from the centre.
        v: (k,) position down, likewise.
        grey: (k,) measured grey levels.
        model: (k,) grey levels of the fitted print without a shadow.
        weights: (k,) information of the pixels, 1 / variance. 0: a pixel is not used.
        cells: Number of cells along a side of the print. There is a margin of one cell around it.
    """
    side = cells + 3
    column, across = _nodes_before(u, cells)
    row, down = _nodes_before(v, cells)
    first = row * side + column
    nodes = np.stack([first, first + 1, first + side, first + side + 1])
    shares = np.stack(
        [
            (1.0 - across) * (1.0 - down),
            across * (1.0 - down),
            (1.0 - across) * down,
            across * down,
        ]
    )
    used = weights > 0.0
    jacobian = (shares * model)[:, used]
    weighted = jacobian * weights[used]
    places = nodes[:, None, used] * side**2 + nodes[None, :, used]
    products = jacobian[:, None] * weighted[None, :]
    matrix = np.bincount(places.ravel(), products.ravel(), side**4).reshape(side**2, side**2)
    right = np.bincount(nodes[:, used].ravel(), (weighted * grey[used]).ravel(), side**2)
    # The prior mean is a factor of 1 at each node.
    factors = np.linalg.solve(matrix + _prior_information(side), right + _FACTOR_SIGMA**-2)
    return np.clip((shares * factors[nodes]).sum(axis=0), _MIN_FACTOR, _MAX_FACTOR)


def _nodes_before(position: Array, cells: int) -> tuple[NDArray[np.intp], Array]:
    """Return the node before each position along an axis, and the share of the way to the next.

    The nodes are at the borders of the cells and of the margin.
    """
    # The last node has no next one, so positions end just before it.
    x = np.clip((position + 0.5) * cells + 1.0, 0.0, cells + 1.999)
    node = x.astype(np.intp)
    return node, x - node


@lru_cache(maxsize=8)
def _prior_information(side: int) -> Array:
    """Return the (cached) prior information (side^2, side^2) of the factors. Do not change it."""
    bends = np.diff(np.eye(side), n=2, axis=0) / _BEND_SIGMA
    along = bends.T @ bends
    information = np.kron(along, np.eye(side)) + np.kron(np.eye(side), along)
    return np.asarray(information + _FACTOR_SIGMA**-2 * np.eye(side**2))
