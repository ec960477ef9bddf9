"""Noise of a made-up sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Pixels by which the piece of noise is larger that pictures share: 257² parts.
_LARGER = 256


class Grain:
    """Normal noise of sigma 1 for one picture after the other.

    Args:
        size: (width, height) of the pictures.
        seed: Picture k of two with one seed is the same.
        shared: Each picture gets some part of one larger piece.  Drawing noise takes as long as a third of a
            fast picture.
    """

    def __init__(self, size: tuple[int, int], seed: int, shared: bool) -> None:
        self._shape, self._seed, self._shared = (size[1], size[0], 3), seed, shared
        self._piece: NDArray[np.float32] | None = None

    def of(self, picture: int) -> NDArray[np.float32]:
        """(h, w, 3) of one picture; not to be written to."""
        h, w, channels = self._shape
        rng = np.random.default_rng([self._seed, picture])
        if not self._shared:
            return rng.standard_normal(self._shape, dtype=np.float32)
        if self._piece is None:
            larger = (h + _LARGER, w + _LARGER, channels)
            self._piece = np.random.default_rng(self._seed).standard_normal(larger, dtype=np.float32)
        y, x = rng.integers(_LARGER + 1, size=2)
        return self._piece[y : y + h, x : x + w]
