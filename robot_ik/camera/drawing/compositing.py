"""Compiled: samples (``scanline.py``) into pixels, and drawings over pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_ik.kernels.jit import kernel, pure

_ZERO, _HALF, _ONE, _WHITE = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)


@pure
def _shaded(plane: Any, base: Any, gloss: Any, x: Any, y: Any) -> Any:
    """Blue, green and red of a face at a pixel."""
    beyond = min(plane[6] + plane[7] * x + plane[8] * y, _ZERO)
    shade = plane[0] + plane[1] * x + plane[2] * y + plane[9] * beyond
    shine = plane[3] + plane[4] * x + plane[5] * y + plane[10] * beyond
    # a sample beside the pixel's middle may be on a face whose plane bends away there
    shade, shine = min(max(shade, _ZERO), _ONE), gloss * min(max(shine, _ZERO), _ONE)
    return (
        min(base[0] * shade + shine, _WHITE),
        min(base[1] * shade + shine, _WHITE),
        min(base[2] * shade + shine, _WHITE),
    )


@pure
def _put(pixel: Any, blue: Any, green: Any, red: Any) -> None:
    pixel[0], pixel[1], pixel[2] = (
        np.uint8(np.int32(blue)),
        np.uint8(np.int32(green)),
        np.uint8(np.int32(red)),
    )


@pure
def _mixed(
    marks: Any, places: Any, planes: Any, owner: Any, base: Any, gloss: Any, x: Any, y: Any, pixel: Any
) -> Any:
    """A pixel of several faces: the mean of its samples; returns how much is covered, 0..255."""
    blue = green = red = seen = _ZERO
    share = _ONE / np.float32(len(places))
    for k in range(len(places)):
        who = owner[marks[k]]
        weight = share if who >= 0 else _ZERO
        b, g, r = _shaded(planes[marks[k]], base[max(who, 0)], gloss, x, y)
        blue, green, red, seen = blue + weight * b, green + weight * g, red + weight * r, seen + weight
    _put(pixel, blue + _HALF, green + _HALF, red + _HALF)
    return np.uint8(np.int32(seen * _WHITE + _HALF))


@pure
def _resolve_row(
    row: int, whose: Any, tall: int, places: Any, planes: Any, extent: Any, owner: Any, base: Any, gloss: Any,
    colour: Any, coverage: Any,
) -> None:  # fmt: skip
    """One row of the pixels; see ``resolve``."""
    count, cell = len(places), row // tall
    start, stop, y = extent[cell, 0], extent[cell, 1], np.float32(row)
    if start >= stop:
        return
    marks = whose[cell, (start * tall + row % tall) * count :]
    line, cover = colour[row, start:], coverage[row, start:]
    for column in range(stop - start):
        at, x = column * tall * count, np.float32(start + column)
        mark, mixed = marks[at], 0
        for k in range(1, count):
            mixed |= marks[at + k] ^ mark
        if mixed != 0:
            cover[column] = _mixed(marks[at:], places, planes, owner, base, gloss, x, y, line[column])
        elif owner[mark] >= 0:
            b, g, r = _shaded(planes[mark], base[owner[mark]], gloss, x, y)
            _put(line[column], b + _HALF, g + _HALF, r + _HALF)
            cover[column] = 255


@kernel
def resolve(
    whose: Any, tall: int, places: Any, planes: Any, extent: Any, owner: Any, base: Any, gloss: Any,
    colour: Any, coverage: Any,
) -> None:  # fmt: skip
    """Samples into pixels.

    Args:
        whose: As filled, with ``planes`` and ``extent``; ``tall`` rows of pixels in a cell.
        tall: See ``whose``.
        places: Tuple with as many numbers as a pixel has samples, so that this is compiled for as many.
        planes: See ``whose``.
        extent: See ``whose``.
        owner: (f + 1,) row in ``base`` of each number in ``whose``; below 0 nothing or a phantom, not drawn.
        base: (m, 3) float32 colours 0..255; ``gloss`` of the highlights likewise.
        gloss: See ``base``.
        colour: (h, w, 3) uint8, 0 before: colour times coverage; ``coverage`` (h, w).
        coverage: See ``colour``.
    """
    for row in range(len(colour)):
        _resolve_row(row, whose, tall, places, planes, extent, owner, base, gloss, colour, coverage)


@kernel
def lay_over(image: Any, colour: Any, coverage: Any, alpha: float, left: int, top: int) -> None:
    """Blends a layer (see ``resolve``) into ``image`` (h, w, 3) uint8, in place."""
    share = round(alpha * 256)
    for row in range(coverage.shape[0]):
        for column in range(coverage.shape[1]):
            c = int(coverage[row, column])
            if c == 255 and share == 256:
                for k in range(3):
                    image[row + top, column + left, k] = colour[row, column, k]
            elif c > 0:
                keep = 65280 - c * share  # 255 * 256 is all of it
                for k in range(3):
                    old = int(image[row + top, column + left, k])
                    new = int(colour[row, column, k])
                    image[row + top, column + left, k] = np.uint8(
                        min((old * keep + new * share * 255 + 32640) // 65280, 255)
                    )
