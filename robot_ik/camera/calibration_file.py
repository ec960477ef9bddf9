"""Camera calibration files: one format that OpenCV's FileStorage, ROS and plain YAML readers share.

Written: header ``%YAML 1.0`` (with a space), keys of ROS ``camera_info``, and ``dt: d`` inside each matrix,
which FileStorage needs and the others ignore.  Read: that, FileStorage's own (``%YAML:1.0`` and
``!!opencv-matrix``, keys ``camera_matrix``, ``K`` or ``M1``), and plain ROS YAML.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from robot_ik.camera import lens
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError, ConfigError
from robot_ik.files import LARGEST_NUMBER, NESTED, parse, read_text, shown, write_atomically

logger = logging.getLogger("robot_ik.camera")

Array = NDArray[np.float64]

# Ours refuses to calibrate so badly; files of others are read, with a word.
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


def _matrix_node(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix_node)


def load_intrinsics(path: Path | str) -> CameraIntrinsics:
    """Reads a calibration file; see ``CameraIntrinsics.load``."""
    path = Path(path)
    content = _read(path)
    size = (_whole(content, "image_width", path), _whole(content, "image_height", path))
    matrix = _numbers(_first(content, _MATRIX_KEYS, path), "camera matrix", path)
    if matrix.size != 9:
        raise CalibrationError(f"{path}: the camera matrix has {matrix.size} numbers, not 9", hint=_HINT)
    k = matrix.reshape(3, 3)
    if abs(k[0, 1]) > 1e-9 * abs(k[0, 0]) or not np.allclose(k[2], (0, 0, 1)):
        raise CalibrationError(
            f"{path}: the camera matrix is not of the form [fx 0 cx; 0 fy cy; 0 0 1]: {k.tolist()}",
            hint="a skewed pixel grid is not supported; calibrate without skew",
        )
    coefficients = _numbers(_first(content, _DISTORTION_KEYS, path), "distortion coefficients", path)
    model, distortion = _model(content, coefficients, path)
    try:
        intrinsics = CameraIntrinsics(
            width=size[0],
            height=size[1],
            fx=float(k[0, 0]),
            fy=float(k[1, 1]),
            cx=float(k[0, 2]),
            cy=float(k[1, 2]),
            distortion=distortion,
            model=model,
            rms=_optional(content, "avg_reprojection_error", path),
            std=tuple(_numbers(content.get("intrinsics_std_dev", []), "standard deviations", path)),
            views=_views(content, path),
            name=str(content.get("camera_name", "camera")),
            date=str(content.get("calibration_time", content.get("calibration_date", ""))),
        )
        intrinsics.require_plausible()
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error.args[0]}", hint=error.hint) from None
    if intrinsics.rms is not None and intrinsics.rms > _POOR_RMS_PX:
        logger.warning(
            "%s: its reprojection error is %.2f px; a good calibration has less than %g px: calibrate again",
            path, intrinsics.rms, _POOR_RMS_PX,
        )  # fmt: skip
    return intrinsics


_HINT = (
    "a camera file has image_width, image_height, camera_matrix and distortion_coefficients, "
    "as OpenCV or ROS camera calibration writes it"
)


def _yaml(text: str) -> Any:
    if NESTED.search(text):
        raise RecursionError  # PyYAML takes a second to find that out
    return yaml.load(text, Loader=_Loader)


def _read(path: Path) -> Mapping[str, Any]:
    try:
        text = read_text(path, "the camera calibration", errors="replace")
        # FileStorage writes "%YAML:1.0", which no YAML reader accepts; the directive says nothing we need.
        text = re.sub(r"\A\ufeff?%YAML[^\n]*\n", "", text)
        content = parse(text, path, "YAML", _yaml)
    except ConfigError as error:
        raise CalibrationError(error.args[0], hint=_HINT) from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} is not a camera calibration: it has no keys", hint=_HINT)
    return content


def _first(content: Mapping[str, Any], names: tuple[str, ...], path: Path) -> Any:
    for name in names:
        if name in content:
            return content[name]
    have = ", ".join(map(str, content)) or "nothing"
    raise CalibrationError(f"{path} lacks the key {' or '.join(names[:3])}; it has {have}", hint=_HINT)


def _numbers(value: Any, what: str, path: Path) -> Array:
    data = value.get("data", []) if isinstance(value, dict) else value
    try:
        flat = [float(v) for v in _flatten(data)]
    except (TypeError, ValueError):
        raise CalibrationError(f"{path}: the {what} must be numbers, not {shown(data)}", hint=_HINT) from None
    if not all(abs(value) <= LARGEST_NUMBER for value in flat):  # words such as "nan" are numbers to YAML
        raise CalibrationError(f"{path}: the {what} must be finite, not {shown(flat)}", hint=_HINT)
    return np.array(flat)


def _flatten(value: Any) -> Iterable[Any]:
    if isinstance(value, (list, tuple)):
        for item in value:
            yield from _flatten(item)
    else:
        yield value


def _whole(content: Mapping[str, Any], key: str, path: Path) -> int:
    value = _first(content, (key,), path)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value):
        given = shown(value)
        raise CalibrationError(f"{path}: {key} must be a whole number, not {given}", hint=_HINT)
    return int(value)


def _optional(content: Mapping[str, Any], key: str, path: Path) -> float | None:
    if key not in content:
        return None
    found = _numbers(content[key], key, path)
    if found.size != 1:
        raise CalibrationError(f"{path}: {key} must be one number, not {shown(content[key])}", hint=_HINT)
    return float(found[0])


def _views(content: Mapping[str, Any], path: Path) -> int | None:
    return next((_whole(content, key, path) for key in ("views", "nframes") if key in content), None)


def _model(content: Mapping[str, Any], numbers: Array, path: Path) -> tuple[str, tuple[float, ...]]:
    """Model name and coefficients; OpenCV pads with zeros and does not say the model."""
    given = str(content.get("distortion_model", "")).lower()
    if given in _MODEL_NAMES:
        model = _MODEL_NAMES[given]
    elif given:
        raise CalibrationError(
            f"{path}: unknown distortion_model {given!r}; known: {', '.join(_MODEL_NAMES)}", hint=_HINT
        )
    else:
        model = "plumb_bob" if not np.any(numbers[5:]) else "rational_polynomial"
    fits = lens.COEFFICIENTS[model]
    size = next((n for n in sorted(fits) if n >= len(numbers)), max(fits))
    if np.any(numbers[size:]):
        raise CalibrationError(
            f"{path}: {len(numbers)} distortion coefficients (thin prism or tilted sensor) are not supported",
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


def save_intrinsics(camera: CameraIntrinsics, path: Path | str) -> None:
    """Writes a calibration file; see ``CameraIntrinsics.save``.

    The file appears whole or not at all.

    Raises:
        OutputError: The folder is missing or not writable.
    """
    write_atomically(Path(path), _text(camera))
