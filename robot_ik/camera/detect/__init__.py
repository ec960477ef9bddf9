"""Finds markers in a picture, to about a pixel.

``detector`` finds them; ``search_window`` says where to look in the next picture; ``dictionary_guess`` which
dictionary they are of when it is not the one that was said.
"""

from robot_ik.camera.detect.detector import Detection, Image, MarkerDetector, shortest_side, to_gray

__all__ = [
    "Detection",
    "Image",
    "MarkerDetector",
    "shortest_side",
    "to_gray",
]
