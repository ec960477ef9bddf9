"""A camera's intrinsics from views of a flat pattern.

``fit`` is the adjustment; ``views`` gathers the views from any source, ``coverage`` tells which part of
the picture and which tilts are still missing, ``verdict`` says in words what the result is worth.
"""

from robot_ik.camera.calibrate.fit import CalibrationResult, View, ViewReport, calibrate

__all__ = [
    "CalibrationResult",
    "View",
    "ViewReport",
    "calibrate",
]
