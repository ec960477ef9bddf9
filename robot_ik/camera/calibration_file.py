"""Camera calibration files: one format that OpenCV's FileStorage, ROS and plain YAML readers share.

Written: header ``%YAML 1.0`` (with a space), keys of ROS ``camera_info``, and ``dt: d`` inside each
matrix, which FileStorage needs and the others ignore. Read: that, FileStorage's own (``%YAML:1.0``
and ``!!opencv-matrix``, keys ``camera_matrix``, ``K`` or ``M1``), and plain ROS YAML.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from robot_ik.camera import lens
from robot_ik.config import LARGEST_NUMBER, parse, read_text, shown
from robot_ik.errors import CalibrationError, ConfigError
from robot_ik.ports import Array

if TYPE_CHECKING:
    from robot_ik.camera.intrinsics import CameraIntrinsics

_log = logging.getLogger("robot_ik.camera")

# Reprojection error above which a file is read with a warning, px. ``camera calibrate`` refuses it.
_POOR_RMS = 1.0
# Skew of a camera matrix that is rounding, part of the focal length.
_MAX_SKEW = 1e-9
# Keys that older versions wrote and that are no longer used.
_UNUSED_KEYS = ("edge_shift",)
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
#: What a camera file contains.
HINT = (
    "a camera file has image_width, image_height, camera_matrix and distortion_coefficients, "
    "as OpenCV or ROS camera calibration writes it"
)


class _Loader(yaml.SafeLoader):
    """Plain YAML plus OpenCV's tag for matrices, without aliases.

    No calibration program writes aliases. A few lines of them can expand to gigabytes.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node; an alias is an error."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not supported")
        return super().compose_node(parent, index)


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", partial(_Loader.construct_mapping, deep=True)
)


def read_calibration(path: Path) -> dict[str, Any]:
    """Return the fields of ``CameraIntrinsics`` in a calibration file.

    Raises:
        CalibrationError: The file is missing, not a camera file, or lacks a key.
    """
    try:
        text = read_text(path, "the camera calibration", errors="replace")
        # FileStorage writes "%YAML:1.0", which YAML readers refuse. The directive is not needed.
        text = re.sub(r"\A\ufeff?%YAML[^\n]*\n", "", text)
        content = parse(text, path, "YAML", _yaml)
    except ConfigError as error:
        raise CalibrationError(error.args[0], hint=HINT) from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} is not a camera calibration: it has no keys", hint=HINT)
    try:
        fields = _fields(content)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error.args[0]}", hint=error.hint or HINT) from None
    for key in _UNUSED_KEYS:
        if key in content:
            _log.info("%s: the key %s is no longer used and is ignored", path, key)
    rms = fields["rms"]
    if rms is not None and rms > _POOR_RMS:
        _log.warning(
            "%s: its reprojection error is %.2f px; a good calibration has less than %g px: "
            "calibrate again",
            path,
            rms,
            _POOR_RMS,
        )
    return fields


def calibration_text(camera: CameraIntrinsics) -> str:
    """Return the text of a calibration file."""
    distortion = np.atleast_2d(camera.coefficients if camera.distortion else np.zeros(5))
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    name = re.sub(r"[^\w .-]", "_", camera.name) or "camera"
    text = (
        f"%YAML 1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f'camera_name: "{name}"\n'
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
        # OpenCV writes the time of its samples under this key. Without quotes YAML reads a date.
        text += f'calibration_time: "{camera.date}"\n'
    return text


def _yaml(text: str) -> Any:
    return yaml.load(text, Loader=_Loader)


def _fields(content: Mapping[str, Any]) -> dict[str, Any]:
    width = _integer(content, "image_width")
    height = _integer(content, "image_height")
    matrix = _numbers(_first(content, _MATRIX_KEYS), "camera matrix")
    if matrix.size != 9:
        raise CalibrationError(f"the camera matrix has {matrix.size} numbers, not 9")
    k = matrix.reshape(3, 3)
    if abs(k[0, 1]) > _MAX_SKEW * abs(k[0, 0]) or not np.allclose(k[2], (0, 0, 1)):
        raise CalibrationError(
            f"the camera matrix is not of the form [fx 0 cx; 0 fy cy; 0 0 1]: {k.tolist()}",
            hint="a skewed pixel grid is not supported; calibrate without skew",
        )
    coefficients = _numbers(_first(content, _DISTORTION_KEYS), "distortion coefficients")
    model, distortion = _model(content, coefficients)
    views = [_integer(content, key) for key in ("views", "nframes") if key in content]
    date = content.get("calibration_time", content.get("calibration_date", ""))
    return {
        "width": width,
        "height": height,
        "fx": float(k[0, 0]),
        "fy": float(k[1, 1]),
        "cx": float(k[0, 2]),
        "cy": float(k[1, 2]),
        "distortion": distortion,
        "model": model,
        "rms": _optional(content, "avg_reprojection_error"),
        "std": tuple(_numbers(content.get("intrinsics_std_dev", []), "standard deviations")),
        "views": views[0] if views else None,
        "name": str(content.get("camera_name", "camera")),
        "date": str(date),
    }


def _first(content: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    for name in names:
        if name in content:
            return content[name]
    keys = ", ".join(map(str, content)) or "none"
    raise CalibrationError(f"it lacks the key {' or '.join(names[:3])}; its keys: {keys}")


def _numbers(value: Any, what: str) -> Array:
    data = value.get("data", []) if isinstance(value, dict) else value
    try:
        flat = np.array(data, dtype=float).ravel()
    except (TypeError, ValueError):
        raise CalibrationError(f"the {what} must be numbers, not {shown(data)}") from None
    # Words such as "nan" are numbers to YAML.
    if not (np.abs(flat) <= LARGEST_NUMBER).all():
        raise CalibrationError(f"the {what} must be finite, not {shown(flat.tolist())}")
    return flat


def _integer(content: Mapping[str, Any], key: str) -> int:
    value = _first(content, (key,))
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value):
        raise CalibrationError(f"{key} must be a whole number, not {shown(value)}")
    return int(value)


def _optional(content: Mapping[str, Any], key: str) -> float | None:
    if key not in content:
        return None
    numbers = _numbers(content[key], key)
    if numbers.size != 1:
        raise CalibrationError(f"{key} must be one number, not {shown(content[key])}")
    return float(numbers[0])


def _model(content: Mapping[str, Any], numbers: Array) -> tuple[str, tuple[float, ...]]:
    """Return model and coefficients. OpenCV pads with zeros and does not write the model."""
    given = str(content.get("distortion_model", "")).lower()
    if given in _MODEL_NAMES:
        model = _MODEL_NAMES[given]
    elif given:
        known = ", ".join(_MODEL_NAMES)
        raise CalibrationError(f"unknown distortion_model {given!r}; known: {known}")
    else:
        model = "plumb_bob" if not np.any(numbers[5:]) else "rational_polynomial"
    fits = lens.COEFFICIENTS[model]
    size = next((n for n in sorted(fits) if n >= len(numbers)), max(fits))
    if np.any(numbers[size:]):
        raise CalibrationError(
            f"{len(numbers)} distortion coefficients (thin prism or tilted sensor) are not "
            "supported",
            hint="calibrate with the plumb_bob (5) or rational (8) model",
        )
    padded = np.zeros(size)
    padded[: min(size, len(numbers))] = numbers[:size]
    return model, tuple(padded)


def _number(value: float) -> str:
    """Return the shortest text that reads back bit-equal.

    YAML 1.1 reads 1e-05 as a word, so the text has a point.
    """
    mantissa, mark, exponent = repr(float(value)).partition("e")
    if mark and "." not in mantissa:
        mantissa += ".0"
    return mantissa + mark + exponent


def _matrix(key: str, values: Array) -> str:
    rows, cols = values.shape
    data = ", ".join(_number(v) for v in values.ravel())
    return f"{key}:\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [{data}]\n"
