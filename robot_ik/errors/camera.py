"""Errors between the lens and the goal."""

from __future__ import annotations

from robot_ik.errors.base import RobotIkError


class CameraError(RobotIkError):
    """Root of everything that can go wrong between the lens and the goal."""


class CameraNotFoundError(CameraError):
    """The camera, file or URL cannot be opened; the hint lists what exists."""


class FrameTimeoutError(CameraError):
    """The source stopped delivering pictures."""


class FrameSizeError(CameraError):
    """Pictures have another size than asked for, or than the calibration is made for."""


class MarkerNotFoundError(CameraError):
    """A picture was taken but the wanted marker is not in it."""


class CalibrationError(CameraError):
    """A calibration is missing, malformed, implausible or made for another camera."""
