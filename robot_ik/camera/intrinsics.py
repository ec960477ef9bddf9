"""What is known of one camera's optics: focal lengths, principal point, lens distortion.

Conventions are OpenCV's: camera frame x right, y down, z forward; pixel (0, 0) is the *centre* of the
upper left pixel, so the image spans -0.5 .. width - 0.5.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from robot_ik.camera import lens
from robot_ik.errors import CalibrationError, ConfigError
from robot_ik.files import write_atomically
from robot_ik.ports import Array
from robot_ik.reading import LARGEST_NUMBER, NESTED, parse, read_text, shown

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

    @cached_property
    def extent(self) -> tuple[Array, Array]:
        """Least and greatest normalised coordinates (2,) on the rim of the picture."""
        x, y = np.linspace(-0.5, self.width - 0.5, 65), np.linspace(-0.5, self.height - 0.5, 65)
        sides = [(x, 0 * x + v) for v in y[[0, -1]]] + [(0 * y + v, y) for v in x[[0, -1]]]
        rim = self.undistort(np.concatenate([np.stack(side, axis=1) for side in sides]))
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
        """Largest ``|(X, Y)| / Z`` at which the lens model is still one to one; beyond it, it folds back."""
        return float(lens.lens_vector(self)[lens.LIMIT])

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
            normalized = flat[:, :2] / flat[:, 2:]
        normalized[~(flat[:, 2] > 0)] = np.nan
        return self.distort(normalized).reshape(*p.shape[:-1], 2)

    def distort(self, normalized: Array) -> Array:
        """Undistorted normalised coordinates (n, 2) -> distorted pixels (n, 2)."""
        return self._mapped(lens.distort_points, normalized, 2)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Distorted pixels (n, 2) -> undistorted normalised coordinates (n, 2), exact to 1e-9.

        NaN where the lens model has no inverse.
        """
        return self._mapped(lens.undistort_points, np.asarray(pixels, dtype=float).reshape(-1, 2), 2)

    def unproject(self, pixels: ArrayLike) -> Array:
        """Rays (n, 3) or (3,) with z = 1 in the camera frame, of pixels (n, 2) or (2,)."""
        p = np.asarray(pixels, dtype=float)
        normalized = self.undistort(p)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        return rays.reshape(*p.shape[:-1], 3)

    def pixel_jacobian(self, normalized: Array) -> Array:
        """Derivative (n, 2, 2) of pixels with respect to undistorted normalised coordinates (n, 2)."""
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
        """What a kernel of ``lens`` makes (n, *shape) of points (n, 2)."""
        result = np.empty((len(points), *shape))
        kernel(lens.lens_vector(self), np.ascontiguousarray(points, dtype=float), result)
        return result

    # ----------------------------------------------------------------------- size and sense

    def scaled(self, width: int, height: int) -> CameraIntrinsics:
        """The same camera delivering resized pictures.

        The half pixel between pixel centre and pixel edge is respected: c' = (c + 1/2) s - 1/2.

        Raises:
            CalibrationError: The aspect ratio is another one: a crop, whose place is unknown.
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
        return _load(Path(path))

    def save(self, path: Path | str) -> None:
        """Writes a file that OpenCV, ROS and any YAML reader understand; whole or not at all.

        Raises:
            OutputError: The file cannot be written.
        """
        write_atomically(Path(path), _text(self))


# ------------------------------------------------------------------------------------------
# Camera calibration files: one format that OpenCV's FileStorage, ROS and plain YAML readers share.
#
# Written: header ``%YAML 1.0`` (with a space), keys of ROS ``camera_info``, and ``dt: d`` inside each matrix,
# which FileStorage needs and the others ignore.  Read: that, FileStorage's own (``%YAML:1.0`` and
# ``!!opencv-matrix``, keys ``camera_matrix``, ``K`` or ``M1``), and plain ROS YAML.


logger = logging.getLogger("robot_ik.camera")


# Ours refuses to calibrate so badly; files of others are read, with a warning.
_POOR_RMS_PX = 1.0
_MATRIX_KEYS = ("camera_matrix", "K", "M1", "cameraMatrix", "intrinsic_matrix")
_DISTORTION_KEYS = ("distortion_coefficients", "D", "D1", "dist", "distCoeffs", "dist_coeffs")
_MODEL_NAMES = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}


class _Loader(yaml.SafeLoader):
    """Plain YAML plus OpenCV's tag for matrices."""


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", partial(_Loader.construct_mapping, deep=True))


_HINT = (
    "a camera file has image_width, image_height, camera_matrix and distortion_coefficients, "
    "as OpenCV or ROS camera calibration writes it"
)


def _yaml(text: str) -> Any:
    if NESTED.search(text):
        raise RecursionError  # PyYAML takes a second to find that out
    return yaml.load(text, Loader=_Loader)


def _load(path: Path) -> CameraIntrinsics:
    try:
        text = read_text(path, "the camera calibration", errors="replace")
        # FileStorage writes "%YAML:1.0", which no YAML reader accepts; the directive says nothing we need.
        text = re.sub(r"\A\ufeff?%YAML[^\n]*\n", "", text)
        content = parse(text, path, "YAML", _yaml)
    except ConfigError as error:
        raise CalibrationError(error.args[0], hint=_HINT) from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} is not a camera calibration: it has no keys", hint=_HINT)
    try:
        intrinsics = _intrinsics(content)
        intrinsics.require_plausible()
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error.args[0]}", hint=error.hint or _HINT) from None
    if "edge_shift" in content:
        logger.info("%s: the key edge_shift is not used any more and is ignored", path)
    if intrinsics.rms is not None and intrinsics.rms > _POOR_RMS_PX:
        logger.warning(
            "%s: its reprojection error is %.2f px; a good calibration has less than %g px: calibrate again",
            path, intrinsics.rms, _POOR_RMS_PX,
        )  # fmt: skip
    return intrinsics


def _intrinsics(content: Mapping[str, Any]) -> CameraIntrinsics:
    width, height = _whole(content, "image_width"), _whole(content, "image_height")
    matrix = _numbers(_first(content, _MATRIX_KEYS), "camera matrix")
    if matrix.size != 9:
        raise CalibrationError(f"the camera matrix has {matrix.size} numbers, not 9")
    k = matrix.reshape(3, 3)
    if abs(k[0, 1]) > 1e-9 * abs(k[0, 0]) or not np.allclose(k[2], (0, 0, 1)):
        raise CalibrationError(
            f"the camera matrix is not of the form [fx 0 cx; 0 fy cy; 0 0 1]: {k.tolist()}",
            hint="a skewed pixel grid is not supported; calibrate without skew",
        )
    coefficients = _numbers(_first(content, _DISTORTION_KEYS), "distortion coefficients")
    model, distortion = _model(content, coefficients)
    return CameraIntrinsics(
        width=width,
        height=height,
        fx=float(k[0, 0]),
        fy=float(k[1, 1]),
        cx=float(k[0, 2]),
        cy=float(k[1, 2]),
        distortion=distortion,
        model=model,
        rms=_optional(content, "avg_reprojection_error"),
        std=tuple(_numbers(content.get("intrinsics_std_dev", []), "standard deviations")),
        views=next((_whole(content, key) for key in ("views", "nframes") if key in content), None),
        name=str(content.get("camera_name", "camera")),
        date=str(content.get("calibration_time", content.get("calibration_date", ""))),
    )


def _first(content: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    for name in names:
        if name in content:
            return content[name]
    have = ", ".join(map(str, content)) or "nothing"
    raise CalibrationError(f"it lacks the key {' or '.join(names[:3])}; it has {have}")


def _numbers(value: Any, what: str) -> Array:
    data = value.get("data", []) if isinstance(value, dict) else value
    try:
        flat = np.array(data, dtype=float).ravel()
    except (TypeError, ValueError):
        raise CalibrationError(f"the {what} must be numbers, not {shown(data)}") from None
    if not (np.abs(flat) <= LARGEST_NUMBER).all():  # words such as "nan" are numbers to YAML
        raise CalibrationError(f"the {what} must be finite, not {shown(flat.tolist())}")
    return flat


def _whole(content: Mapping[str, Any], key: str) -> int:
    value = _first(content, (key,))
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value):
        raise CalibrationError(f"{key} must be a whole number, not {shown(value)}")
    return int(value)


def _optional(content: Mapping[str, Any], key: str) -> float | None:
    if key not in content:
        return None
    found = _numbers(content[key], key)
    if found.size != 1:
        raise CalibrationError(f"{key} must be one number, not {shown(content[key])}")
    return float(found[0])


def _model(content: Mapping[str, Any], numbers: Array) -> tuple[str, tuple[float, ...]]:
    """Model name and coefficients; OpenCV pads with zeros and does not say the model."""
    given = str(content.get("distortion_model", "")).lower()
    if given in _MODEL_NAMES:
        model = _MODEL_NAMES[given]
    elif given:
        raise CalibrationError(f"unknown distortion_model {given!r}; known: {', '.join(_MODEL_NAMES)}")
    else:
        model = "plumb_bob" if not np.any(numbers[5:]) else "rational_polynomial"
    fits = lens.COEFFICIENTS[model]
    size = next((n for n in sorted(fits) if n >= len(numbers)), max(fits))
    if np.any(numbers[size:]):
        raise CalibrationError(
            f"{len(numbers)} distortion coefficients (thin prism or tilted sensor) are not supported",
            hint="calibrate with the plumb_bob (5) or rational (8) model",
        )
    padded = np.zeros(size)
    padded[: min(size, len(numbers))] = numbers[:size]
    return model, tuple(padded)


# -------------------------------------------------------------------------------------- writing


def _number(value: float) -> str:
    """Shortest text that reads back bit-equal and that YAML 1.1 takes for a float (1e-05 would be a word)."""
    mantissa, mark, exponent = repr(float(value)).partition("e")
    if mark and "." not in mantissa:
        mantissa += ".0"
    return mantissa + mark + exponent


def _matrix(key: str, values: Array) -> str:
    rows, cols = values.shape
    data = ", ".join(_number(v) for v in values.ravel())
    return f"{key}:\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [{data}]\n"


def _text(camera: CameraIntrinsics) -> str:
    distortion = np.atleast_2d(camera.coefficients if camera.distortion else np.zeros(5))
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    name = re.sub(r"[^\w .-]", "_", camera.name) or "camera"
    text = (
        f'%YAML 1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: "{name}"\n'
        + _matrix("camera_matrix", camera.matrix)
        + f"distortion_model: {camera.model}\n"
        + _matrix("distortion_coefficients", distortion)
        + _matrix("rectification_matrix", np.eye(3))
        + _matrix("projection_matrix", projection)
    )
    if camera.rms is not None:
        text += f"avg_reprojection_error: {_number(camera.rms)}\n"
    if camera.std:
        text += _matrix("intrinsics_std_dev", np.atleast_2d(np.array(camera.std)))
    if camera.views is not None:
        text += f"views: {camera.views}\n"
    if camera.date:
        # OpenCV writes its samples' time under this key; quoted, or YAML would make a date of it.
        text += f'calibration_time: "{camera.date}"\n'
    return text
