"""A drawn robot as a transparent sheet that is laid over pictures: over one, or over many, shifted."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.drawing import compositing

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Box = tuple[int, int, int, int]

EMPTY: Box = (0, 0, 0, 0)


@dataclass(frozen=True)
class Layer:
    """A drawing on the pixels of ``box``.

    Attributes:
        box: (x0, y0, x1, y1) pixels of the picture, half open.
        colour: (h, w, 3) BGR times coverage.
        coverage: (h, w) 255 where the drawing is all there is.
    """

    box: Box
    colour: Image
    coverage: Image

    @classmethod
    def empty(cls) -> Layer:
        """Nothing drawn."""
        return cls(EMPTY, np.zeros((0, 0, 3), dtype=np.uint8), np.zeros((0, 0), dtype=np.uint8))

    def over(self, image: Image, alpha: float = 1.0) -> None:
        """Lays the drawing over ``image`` (height, width, 3), in place; ``alpha`` 0 leaves it."""
        if self.coverage.size:
            compositing.lay_over(image, self.colour, self.coverage, float(alpha), self.box[0], self.box[1])

    def shifted(self, motion: Array, width: int, height: int) -> Layer:
        """The drawing moved in the picture: Azuma's image shifting.

        Args:
            motion: (2, 3) where pixels (x, y, 1) of this drawing go.
            width: Of the picture; what leaves it is cut off.
            height: See ``width``.
        """
        if not self.coverage.size:
            return self
        x0, y0, x1, y1 = self.box
        corners = np.array([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1]]) @ motion.T
        low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, (width, height))
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, (width, height))
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        if min(size) <= 0:
            return Layer.empty()
        own = motion.copy()
        own[:, 2] += motion[:, :2] @ (x0, y0) - low
        colour = cv2.warpAffine(self.colour, own, size, flags=cv2.INTER_LINEAR)
        coverage = cv2.warpAffine(self.coverage, own, size, flags=cv2.INTER_LINEAR)
        box = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
        return Layer(box, np.asarray(colour, dtype=np.uint8), np.asarray(coverage, dtype=np.uint8))

    def mask(self, width: int, height: int) -> Image:
        """Coverage (height, width) on the whole picture."""
        whole = np.zeros((height, width), dtype=np.uint8)
        x0, y0, x1, y1 = self.box
        whole[y0:y1, x0:x1] = self.coverage
        return whole
