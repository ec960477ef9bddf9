"""What is known of one camera's optics: focal lengths, principal point, lens distortion.

Conventions are OpenCV's: camera frame x right, y down, z forward; pixel (0, 0) is the *centre* of the
upper left pixel, so the image spans -0.5 .. width - 0.5.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera import lens
from robot_ik.errors import CalibrationError

Array = NDArray[np.float64]

# A focal length of 0.3 widths sees 118 degrees, one of 5 widths 11 degrees: what arms are watched with.
_FOCAL_RANGE = (0.3, 5.0)


@dataclass(frozen=True)
class CameraIntrinsics:
    """Pinhole camera with lens distortion, for pictures of one size.

    Attributes:
        width, height: Picture size in pixels that the numbers below are for.
        fx, fy: Focal lengths in pixels.
        cx, cy: Principal point in pixels (integer pixel centres).
        distortion: Coefficients in OpenCV's order, see ``robot_ik.camera.lens``.
        model: ``plumb_bob``, ``rational_polynomial`` or ``equidistant`` (fisheye).
        rms: Reprojection error of the calibration in pixels, when known.
        std: Standard deviations of fx, fy, cx, cy, then of the coefficients, when known.
        views: Number of pictures in the calibration, when known.
        name: Camera name, for people.
        date: When it was calibrated (ISO 8601), when known.

    Raises:
        CalibrationError: A number is not finite, a size or focal length not positive, or the number of
            coefficients does not fit the model.
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
                f"{len(self.distortion)} distortion coefficients do not fit the model {self.model!r}, "
                f"which has {' or '.join(map(str, allowed))}",
                hint="order: k1 k2 p1 p2 k3 (plumb_bob), and k4 k5 k6 (rational_polynomial)",
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(numbers).all() or min(self.width, self.height, self.fx, self.fy) <= 0:
            raise CalibrationError(
                f"a camera of {self.width}x{self.height} px with f ({self.fx}, {self.fy}), "
                f"c ({self.cx}, {self.cy}), distortion {self.distortion} cannot exist; "
                "all numbers must be finite, sizes and focal lengths positive"
            )

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
        """Twelve hexadecimal digits over all that maps points to pixels: how other files name this camera."""
        kept = np.trim_zeros(np.array(self.distortion), "b").tolist()  # no lens, or one of zeros: the same
        numbers = [float(v) for v in (self.fx, self.fy, self.cx, self.cy, *kept)]
        text = " ".join([self.model, str(int(self.width)), str(int(self.height)), *map(repr, numbers)])
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @cached_property
    def coefficients(self) -> Array:
        """Distortion as an array (k,)."""
        return np.array(self.distortion, dtype=float)

    @cached_property
    def radius_limit(self) -> float:
        """Largest |(X, Y)| / Z at which the lens model is still one to one; beyond it, it folds back."""
        return lens.radius_limit(self.model, self.coefficients)

    # ------------------------------------------------------------------------------ mapping

    def project(self, points: ArrayLike) -> Array:
        """Pixels of points in the camera frame.

        Args:
            points: (n, 3) or (3,), metres.

        Returns:
            (n, 2) or (2,) distorted pixels; NaN for points not in front of the camera (z <= 0).  Points
            beyond ``radius_limit`` are projected as OpenCV does, although they cannot be seen there.
        """
        p = np.asarray(points, dtype=float)
        flat = p.reshape(-1, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = flat[:, :2] / flat[:, 2:]
        ideal[~(flat[:, 2] > 0)] = np.nan
        return self.distort(ideal).reshape(*p.shape[:-1], 2)

    def distort(self, ideal: Array) -> Array:
        """Undistorted normalised coordinates (n, 2) -> distorted pixels (n, 2)."""
        bent = lens.bend(self.model, self.coefficients, ideal)
        return bent * (self.fx, self.fy) + (self.cx, self.cy)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Distorted pixels (n, 2) -> undistorted normalised coordinates (n, 2), exact to 1e-9.

        NaN where the lens model has no inverse.
        """
        p = np.asarray(pixels, dtype=float).reshape(-1, 2)
        bent = (p - (self.cx, self.cy)) / (self.fx, self.fy)
        return lens.unbend(self.model, self.coefficients, bent, self.radius_limit)

    def unproject(self, pixels: ArrayLike) -> Array:
        """Rays (n, 3) or (3,) with z = 1 in the camera frame, of pixels (n, 2) or (2,)."""
        p = np.asarray(pixels, dtype=float)
        ideal = self.undistort(p)
        rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
        return rays.reshape(*p.shape[:-1], 3)

    def pixel_jacobian(self, ideal: Array) -> Array:
        """Derivative (n, 2, 2) of pixels with respect to undistorted normalised coordinates (n, 2)."""
        bent = lens.bend_jacobian(self.model, self.coefficients, ideal)
        return bent * np.array([self.fx, self.fy])[:, None]

    # ----------------------------------------------------------------------- size and sense

    def scaled(self, width: int, height: int) -> CameraIntrinsics:
        """The same camera delivering resized pictures.

        The half pixel between pixel centre and pixel edge is respected: c' = (c + 1/2) s - 1/2.

        Raises:
            CalibrationError: The aspect ratio is another one: a crop, whose place nobody knows.
        """
        sx, sy = width / self.width, height / self.height
        # Rounding a side to whole pixels may bend the ratio by half a pixel, no more.
        if abs(sx * self.height - height) > 0.51 and abs(sy * self.width - width) > 0.51:
            raise CalibrationError(
                f"the calibration is for {self.width}x{self.height} px; pictures of {width}x{height} px "
                "have another aspect ratio, so they are cropped in an unknown place",
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
        """Checks that pictures of this size are the calibrated ones.

        Raises:
            CalibrationError: They are not; the hint says whether scaling would do.
        """
        if (width, height) == self.size:
            return
        try:
            self.scaled(width, height)
            hint = (
                f"same aspect ratio: set the camera to {self.width}x{self.height} px, or calibrate at this "
                f"size; for pictures that were only resized, in Python: intrinsics.scaled({width}, {height})"
            )
        except CalibrationError:
            hint = "another aspect ratio: set the camera to the calibrated size, or calibrate at this size"
        raise CalibrationError(
            f"the calibration is for {self.width}x{self.height} px, the picture has {width}x{height} px",
            hint=hint,
        )

    def require_plausible(self) -> None:
        """Checks that the numbers can belong to a camera that watches an arm.

        Raises:
            CalibrationError: Focal length outside 0.3 to 5 picture widths, or principal point outside
                the picture: usually a calibration of another size, or one that went wrong.
        """
        low, high = (f * max(self.width, self.height) for f in _FOCAL_RANGE)
        for name, f in (("fx", self.fx), ("fy", self.fy)):
            if not low <= f <= high:
                raise CalibrationError(
                    f"{name} = {f:.6g} px is implausible for {self.width}x{self.height} px; "
                    f"expected {low:.6g} to {high:.6g} px",
                    hint="was the file made for another picture size? Calibrate again with tilted views",
                )
        if not (0 <= self.cx <= self.width - 1 and 0 <= self.cy <= self.height - 1):
            raise CalibrationError(
                f"the principal point ({self.cx:.6g}, {self.cy:.6g}) px is outside the picture of "
                f"{self.width}x{self.height} px",
                hint="was the file made for another picture size? Calibrate again with tilted views",
            )

    # -------------------------------------------------------------------------------- files

    @classmethod
    def load(cls, path: Path | str) -> CameraIntrinsics:
        """Reads a calibration file (own format, OpenCV FileStorage YAML, ROS camera_info YAML).

        Raises:
            CalibrationError: The file is missing, no camera file, lacks a key, or is implausible.
        """
        from robot_ik.camera.calibration_file import load_intrinsics

        return load_intrinsics(path)

    def save(self, path: Path | str) -> None:
        """Writes a file that OpenCV, ROS and any YAML reader understand; whole or not at all.

        Raises:
            OutputError: The file cannot be written.
        """
        from robot_ik.camera.calibration_file import save_intrinsics

        save_intrinsics(self, path)
