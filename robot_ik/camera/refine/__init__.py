"""Marker corners to hundredths of a pixel.

``corners`` is what others call; ``kernel`` is the whole of it compiled, made of ``sides`` (a marker's
sides as bent curves, and the pixels beside them) and ``edges`` (the fit of one straight edge).
"""

from robot_ik.camera.refine.corners import (
    DETECTOR_SIGMA,
    RefinedCorners,
    refine_corners,
    refine_markers,
    unrefined,
)

__all__ = [
    "DETECTOR_SIGMA",
    "RefinedCorners",
    "refine_corners",
    "refine_markers",
    "unrefined",
]
