"""Procedural surfaces: smooth noise, and a table top of wooden planks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# BGR reflectance of wood between its rings and on them.
_WOOD_LIGHT, _WOOD_DARK = np.array([0.46, 0.62, 0.77]), np.array([0.29, 0.43, 0.58])
# Planks are so wide, and the groove between them so narrow, metres.
_PLANK, _GROOVE = 0.115, 0.0011


def noise(x: Array, y: Array, seed: int) -> Array:
    """Smooth noise in -1..1 with unit cells at (x, y): value noise on a hashed lattice."""
    table = np.random.default_rng(seed).uniform(-1.0, 1.0, (64, 64))
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    a, b = table[j & 63, i & 63], table[j & 63, (i + 1) & 63]
    c, d = table[(j + 1) & 63, i & 63], table[(j + 1) & 63, (i + 1) & 63]
    return np.asarray((a + (b - a) * u) * (1 - v) + (c + (d - c) * u) * v)


def wood(x: Array, y: Array) -> Array:
    """BGR reflectance (n, 3) of planks along y at places (x, y) in metres."""
    plank = np.floor(x / _PLANK)
    across, along = x / _PLANK - plank, y + 0.37 * plank
    own = noise(plank * 7.3 + 0.5, plank * 0 + 0.5, 5)
    wave = noise(along * 2.2 + 13 * plank, across * 1.3 + 3 * plank, 1)
    rings = np.sin(2 * np.pi * (5.0 * across + 1.1 * wave + 0.5 * noise(along * 6, across * 5 + plank, 2)))
    fibre = noise(along * 14 + 31 * plank, x * 900, 3) + 0.6 * noise(along * 45, x * 1900, 4)
    dark = 0.42 + 0.17 * own + 0.16 * rings + 0.10 * fibre
    gap = np.minimum(across, 1 - across) * _PLANK
    tone = _WOOD_LIGHT + (_WOOD_DARK - _WOOD_LIGHT) * np.clip(dark, 0, 1)[:, None]
    return np.asarray(tone * (1 - 0.45 * np.exp(-((gap / _GROOVE) ** 2)))[:, None])
