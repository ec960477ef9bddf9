"""Intrinsics of a camera: focal lengths, principal point, lens distortion.

Conventions are OpenCV's: camera frame x right, y down, z forward. Pixel (0, 0) is the *centre* of
the upper left pixel, so the image spans -0.5 to width - 0.5.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera import lens
from robot_ik.camera.calibration_file import HINT, calibration_text, read_calibration
from robot_ik.errors import CalibrationError
from robot_ik.files import write_atomically
from robot_ik.ports import Array

# Plausible focal lengths, widths of the picture. 0.3 sees 118 degrees, 5 sees 11 degrees.
_MIN_FOCAL = 0.3
_MAX_FOCAL = 5.0
# Rounding a side to whole pixels changes the aspect ratio by up to half a pixel.
_MAX_ROUNDING = 0.51
# Number of points along each side of the picture for its extent.
_RIM_POINTS = 65


@dataclass(frozen=True)
class CameraIntrinsics:
    """Pinhole camera with lens distortion, for pictures of one size.

    Attributes:
        width: Width of the pictures, px.
        height: Height of the pictures, px.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px (integer pixel centres).
        cy: Row of the principal point, px.
        distortion: Coefficients in OpenCV's order, see ``robot_ik.camera.lens``.
        model: ``plumb_bob``, ``rational_polynomial`` or ``equidistant`` (fisheye).
        rms: Reprojection error of the calibration, px; None if unknown.
        std: Standard deviations of fx, fy, cx, cy, then of the coefficients; empty if unknown.
        views: Number of pictures in the calibration; None if unknown.
        name: Name of the camera.
        date: Date of the calibration (ISO 8601); empty if unknown.

    Raises:
        CalibrationError: A number is not finite, a size or focal length not positive, or the number
            of coefficients does not fit the model.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: str = "plumb_bob"
    rms: float | None = None
    std: tuple[float, ...] = ()
    views: int | None = None
    name: str = "camera"
    date: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(v) for v in self.distortion))
        if self.model not in lens.COEFFICIENTS:
            raise CalibrationError(
                f"unknown distortion model {self.model!r}; known: {', '.join(lens.COEFFICIENTS)}"
            )
        allowed = lens.COEFFICIENTS[self.model]
        if len(self.distortion) not in allowed:
            raise CalibrationError(
                f"{len(self.distortion)} distortion coefficients do not fit the model "
                f"{self.model!r}, which has {' or '.join(map(str, allowed))}",
                hint="order: k1 k2 p1 p2 k3 (plumb_bob), and k4 k5 k6 (rational_polynomial)",
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(numbers).all() or min(self.width, self.height, self.fx, self.fy) <= 0:
            raise CalibrationError(
                f"a camera of {self.width}x{self.height} px with f ({self.fx}, {self.fy}), "
                f"c ({self.cx}, {self.cy}), distortion {self.distortion} cannot exist; "
                "all numbers must be finite, sizes and focal lengths positive"
            )

    @cached_property
    def extent(self) -> tuple[Array, Array]:
        """Smallest and largest normalised coordinates (2,) on the rim of the picture."""
        x = np.linspace(-0.5, self.width - 0.5, _RIM_POINTS)
        y = np.linspace(-0.5, self.height - 0.5, _RIM_POINTS)
        sides = [np.stack([x, np.full_like(x, v)], axis=1) for v in y[[0, -1]]]
        sides += [np.stack([np.full_like(y, v), y], axis=1) for v in x[[0, -1]]]
        rim = self.undistort(np.concatenate(sides))
        return np.nanmin(rim, axis=0), np.nanmax(rim, axis=0)

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @cached_property
    def digest(self) -> str:
        """Hash (12 hexadecimal digits) of all numbers that map points to pixels.

        Other files name the camera by it.
        """
        # Zeros at the end are the same lens as no coefficients.
        kept = np.trim_zeros(np.array(self.distortion), "b").tolist()
        numbers = [float(v) for v in (self.fx, self.fy, self.cx, self.cy, *kept)]
        words = [self.model, str(int(self.width)), str(int(self.height)), *map(repr, numbers)]
        return hashlib.sha256(" ".join(words).encode()).hexdigest()[:12]

    @cached_property
    def coefficients(self) -> Array:
        """Distortion as an array (k,)."""
        return np.array(self.distortion, dtype=float)

    @cached_property
    def radius_limit(self) -> float:
        """Largest ``|(X, Y)| / Z`` at which the lens model is one to one. Beyond, it folds back."""
        return float(lens.lens_vector(self)[lens.LIMIT])

    def project(self, points: ArrayLike) -> Array:
        """Return the pixels of points in the camera frame.

        Args:
            points: (n, 3) or (3,), metres.

        Returns:
            (n, 2) or (2,) distorted pixels; NaN for points that are not in front of the camera
            (z <= 0). Points beyond ``radius_limit`` are projected as OpenCV does, although they are
            not visible there.
        """
        p = np.asarray(points, dtype=float)
        flat = p.reshape(-1, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            normalized = flat[:, :2] / flat[:, 2:]
        normalized[~(flat[:, 2] > 0)] = np.nan
        return self.distort(normalized).reshape(*p.shape[:-1], 2)

    def distort(self, normalized: Array) -> Array:
        """Return the distorted pixels (n, 2) of undistorted normalised coordinates (n, 2)."""
        return self._mapped(lens.distort_points, normalized, 2)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Return the undistorted normalised coordinates (n, 2) of distorted pixels (n, 2).

        They are exact to 1e-9. NaN where the lens model has no inverse.
        """
        flat = np.asarray(pixels, dtype=float).reshape(-1, 2)
        return self._mapped(lens.undistort_points, flat, 2)

    def unproject(self, pixels: ArrayLike) -> Array:
        """Return the rays (n, 3) or (3,) with z = 1, camera frame, of pixels (n, 2) or (2,)."""
        p = np.asarray(pixels, dtype=float)
        normalized = self.undistort(p)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        return rays.reshape(*p.shape[:-1], 3)

    def pixel_jacobian(self, normalized: Array) -> Array:
        """Return the derivative (n, 2, 2) of pixels by normalised coordinates (n, 2)."""
        return self._mapped(lens.pixel_jacobians, normalized, 2, 2)

    def point_jacobian(self, points: Array) -> Array:
        """Return the derivative (n, 2, 3) of pixels by points (n, 3) in front of the camera."""
        depth = points[:, 2]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = 1.0 / depth
        by_point[:, 1, 1] = 1.0 / depth
        by_point[:, :, 2] = -points[:, :2] / depth[:, None] ** 2
        return np.asarray(self.pixel_jacobian(points[:, :2] / depth[:, None]) @ by_point)

    def _mapped(self, kernel: Callable[..., None], points: Array, *shape: int) -> Array:
        """Return what a kernel of ``lens`` writes (n, *shape) for points (n, 2)."""
        result = np.empty((len(points), *shape))
        kernel(lens.lens_vector(self), np.ascontiguousarray(points, dtype=float), result)
        return result

    def scaled(self, width: int, height: int) -> CameraIntrinsics:
        """Return the intrinsics of resized pictures.

        The half pixel between pixel centre and pixel edge is respected: c' = (c + 1/2) s - 1/2.

        Raises:
            CalibrationError: The aspect ratio differs: the pictures are cropped somewhere.
        """
        sx = width / self.width
        sy = height / self.height
        is_crop = (
            abs(sx * self.height - height) > _MAX_ROUNDING
            and abs(sy * self.width - width) > _MAX_ROUNDING
        )
        if is_crop:
            raise CalibrationError(
                f"the calibration is for {self.width}x{self.height} px; pictures of "
                f"{width}x{height} px have another aspect ratio, so they are cropped in an unknown "
                "place",
                hint="set the camera to the calibrated size, or calibrate at this size",
            )
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            rms=None if self.rms is None else self.rms * sx,
            std=(),
        )

    def require_size(self, width: int, height: int) -> None:
        """Check that pictures have the calibrated size.

        Raises:
            CalibrationError: They have another one. The hint says whether scaling is possible.
        """
        if (width, height) == self.size:
            return
        try:
            self.scaled(width, height)
            hint = (
                f"same aspect ratio: set the camera to {self.width}x{self.height} px, or calibrate "
                "at this size; for pictures that were only resized, in Python: "
                f"intrinsics.scaled({width}, {height})"
            )
        except CalibrationError:
            hint = (
                "another aspect ratio: set the camera to the calibrated size, or calibrate at this "
                "size"
            )
        raise CalibrationError(
            f"the calibration is for {self.width}x{self.height} px, the picture has "
            f"{width}x{height} px",
            hint=hint,
        )

    def require_plausible(self) -> None:
        """Check that the numbers can belong to a camera that watches an arm.

        Raises:
            CalibrationError: Focal length outside 0.3 to 5 picture widths, or principal point
                outside the picture: usually a calibration of another size, or a failed one.
        """
        hint = "was the file made for another picture size? Calibrate again with tilted views"
        longer = max(self.width, self.height)
        lower = _MIN_FOCAL * longer
        upper = _MAX_FOCAL * longer
        for name, f in (("fx", self.fx), ("fy", self.fy)):
            if not lower <= f <= upper:
                raise CalibrationError(
                    f"{name} = {f:.6g} px is implausible for {self.width}x{self.height} px; "
                    f"expected {lower:.6g} to {upper:.6g} px",
                    hint=hint,
                )
        if not (0 <= self.cx <= self.width - 1 and 0 <= self.cy <= self.height - 1):
            raise CalibrationError(
                f"the principal point ({self.cx:.6g}, {self.cy:.6g}) px is outside the picture of "
                f"{self.width}x{self.height} px",
                hint=hint,
            )

    @classmethod
    def load(cls, path: Path | str) -> CameraIntrinsics:
        """Load a calibration file of this project, of OpenCV FileStorage or of ROS.

        Raises:
            CalibrationError: The file is missing, not a camera file, lacks a key, or is
                implausible.
        """
        fields = read_calibration(Path(path))
        try:
            intrinsics = cls(**fields)
            intrinsics.require_plausible()
        except CalibrationError as error:
            hint = error.hint or HINT
            raise CalibrationError(f"{path}: {error.args[0]}", hint=hint) from None
        return intrinsics

    def save(self, path: Path | str) -> None:
        """Write, atomically, a file that OpenCV, ROS and any YAML reader can read.

        Raises:
            OutputError: The file cannot be written.
        """
        write_atomically(Path(path), calibration_text(self))
