"""What a camera does to the grey values of a chessboard's edges: tone curve, clipping, sharpening, blocks.

A saddle, where four squares meet, lies where it lies whatever the tone curve: black and white change places
round it.  So the line between two neighbouring saddles is the edge, and how far the picture's half level lies
beside it is the camera's doing.  Light and dark change sides from edge to edge, so a lens that bends the line
between two saddles cancels out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.ports import Array, Image

# Part of an edge that is looked at, so many lines across it, and steps of a line, px.
_ALONG, _LINES, _STEP = (0.3, 0.7), 9, 0.25
# Lines reach at most and at least so far to both sides, px.
_REACH = (2.5, 5.0)
# Parts of the contrast at one sigma to both sides of an edge.
_LOWER, _UPPER = 0.1587, 0.8413
_LEAST_CONTRAST, _FEWEST = 20.0, 6
# White at this grey level is clipped.  Beyond this overshoot beside an edge, in contrasts, a picture has been
# sharpened; beyond these steps at the borders of JPEG's blocks, over those elsewhere, it has been compressed.
_CLIPPED, _SHARPENED, _BLOCKY = 252.0, 0.06, 1.25
_BLOCK = 8


@dataclass(frozen=True)
class Tone:
    """The edges of one view.

    Attributes:
        edge_shift: How far they lie in the black, in sigmas of their blur (mean).
        pixels: The same in px.
        white: Grey level of white (median).
        overshoot: How much brighter than white it is beside the edges, in contrasts.
        blocks: Steps of grey at the borders of 8 x 8 blocks over those elsewhere.
    """

    edge_shift: float
    pixels: float
    white: float
    overshoot: float
    blocks: float

    @property
    def troubles(self) -> tuple[str, ...]:
        """What is wrong with the picture, and what to change at the camera."""
        found = []
        if self.white >= _CLIPPED:
            found.append("overexposed: less exposure, or less light")
        if self.overshoot > _SHARPENED:
            found.append("sharpened: turn the camera's sharpness down")
        if self.blocks > _BLOCKY:
            found.append("compressed: less compression, or a format without it (YUYV)")
        return tuple(found)


def measure_tone(
    gray: Image, pixels: Array, ids: NDArray[np.int64], columns: int, reach: float
) -> Tone | None:
    """Measures the edges between neighbouring saddles.

    Args:
        gray: (h, w), the whole picture.
        pixels: (n, 2) saddles.
        ids: (n,) their numbers: column + row * columns.
        columns: Saddles in a row.
        reach: How far from an edge there is only one tone, in squares.

    Returns:
        None where too few edges can be measured: small squares, blur, no contrast.
    """
    index = {int(i): k for k, i in enumerate(ids)}
    pairs = [
        (k, index[other])
        for i, k in index.items()
        # To the right, where that is the same row, and downwards.
        for other in ((i + 1, i + columns) if (i + 1) % columns else (i + columns,))
        if other in index
    ]
    if not pairs:
        return None
    ends = pixels[np.array(pairs)]
    profiles, inside = _profiles(gray, ends, reach)
    rows = [
        one for line, fine in zip(profiles, inside, strict=True) if fine and (one := _edge(line)) is not None
    ]
    if len(rows) < _FEWEST:
        return None
    shift, blur, white, overshoot = np.array(rows).T
    return Tone(
        float(np.mean(shift / blur)), float(np.mean(shift)), float(np.median(white)),
        float(np.median(overshoot)), _blockiness(gray),
    )  # fmt: skip


def _profiles(gray: Image, ends: Array, reach: float) -> tuple[list[Array], NDArray[np.bool_]]:
    """Mean grey values across each edge (m, 2, 2), and whether it lies in the picture with a margin."""
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    half = np.minimum(reach * length, _REACH[1])
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    share = np.linspace(*_ALONG, _LINES)
    profiles: list[Array] = []
    fine = half >= _REACH[0]
    height, width = gray.shape
    no_map: Any = None
    for k, wide in enumerate(half):
        d = np.arange(-wide, wide + 1e-9, _STEP)
        at = ends[k, 0] + share[:, None, None] * along[k] + d[None, :, None] * across[k]
        fine[k] &= bool((at > 0).all() and (at < (width - 1, height - 1)).all())
        seen = cv2.remap(gray, at.astype(np.float32), no_map, cv2.INTER_LINEAR).astype(float)
        profiles.append(np.stack([d, seen.mean(axis=0)]))
    return profiles, fine


def _edge(profile: Array) -> tuple[float, float, float, float] | None:
    """Of a line across an edge: shift into the black and sigma, px; white; overshoot in contrasts."""
    d, grey = profile
    quarter = max(len(d) // 5, 2)
    first, last = float(grey[:quarter].mean()), float(grey[-quarter:].mean())
    if first > last:  # from black to white
        d, grey, first, last = -d[::-1], grey[::-1], last, first
    contrast = last - first
    if contrast < _LEAST_CONTRAST:
        return None
    part = (grey - first) / contrast
    middle = int(np.argmax(part > 0.5))
    low, high = middle, middle
    while low > 0 and part[low - 1] > _LOWER:
        low -= 1
    while high < len(part) - 1 and part[high] < _UPPER:
        high += 1
    if low == 0 or middle == 0:
        return None
    half, lower, upper = (
        _crossing(d, part, k, value) for k, value in ((middle, 0.5), (low, _LOWER), (high, _UPPER))
    )
    sigma = 0.5 * (upper - lower)
    # The plateaus must be seen, or the level half way between them is unknown.
    if not 0.0 < 2.2 * sigma < d[-1]:
        return None
    return -half, sigma, last, float(part.max()) - 1.0


def _crossing(d: Array, part: Array, k: int, value: float) -> float:
    """Where a rising line goes through a value, between its points k - 1 and k."""
    rise = float(part[k] - part[k - 1])
    return float(d[k - 1] + (d[k] - d[k - 1]) * (value - part[k - 1]) / rise) if rise > 0.0 else float(d[k])


def _blockiness(gray: Image) -> float:
    """Steps between columns at the borders of 8 x 8 blocks over those elsewhere, in flat parts."""
    step = np.abs(np.diff(gray.astype(np.int16), axis=1))
    quiet = np.minimum(step, 8).astype(float).mean(axis=0)
    border = np.arange(len(quiet)) % _BLOCK == _BLOCK - 1
    return float(quiet[border].mean() / max(quiet[~border].mean(), 1e-6))
