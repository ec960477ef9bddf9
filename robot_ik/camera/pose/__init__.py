"""Where a marker or a rigid body with markers is, from corners in one picture.

``estimate`` is what others call; ``marker`` does a single marker, ``branches`` the two poses that may fit
a flat one, ``corner_fit`` the least squares with its compiled ``kernel``; ``cells`` fits the whole print to
the pixels, with ``cells_kernel``; ``bodies`` describes boards, cubes and layouts and reads the files of them.
"""

from robot_ik.camera.pose.estimate import BodyBranches, BodyObservation, body_branches, estimate_body
from robot_ik.camera.pose.marker import MarkerObservation, estimate_marker, marker_points

__all__ = [
    "BodyBranches",
    "BodyObservation",
    "MarkerObservation",
    "body_branches",
    "estimate_body",
    "estimate_marker",
    "marker_points",
]
