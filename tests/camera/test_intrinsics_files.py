"""The calibration file against three other readers, and what is said of a wrong one."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.errors import CalibrationError, OutputError

CAMERA = CameraIntrinsics(
    640, 480, 612.0, 605.0, 322.3, 236.8, (-0.28, 0.09, 0.0007, -0.0004, -0.01)
)

ROS = """image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [600, 0, 320, 0, 601, 240, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{data}]
"""


def test_opencv_and_plain_yaml_read_the_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    CameraIntrinsics(
        640,
        480,
        800.0,
        801.5,
        319.5,
        239.5,
        (-1e-5, 0.01, 0.0, 0.0, 0.0),
        rms=0.15,
        std=(0.5,) * 9,
        views=24,
    ).save(path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("camera_matrix").mat().tolist() == [
        [800, 0, 319.5],
        [0, 801.5, 239.5],
        [0, 0, 1],
    ]
    assert storage.getNode("distortion_coefficients").mat().ravel()[0] == -1e-5
    assert storage.getNode("image_width").real() == 640
    storage.release()
    content = yaml.safe_load(path.read_text())
    assert content["camera_matrix"]["data"][4] == 801.5
    assert content["distortion_coefficients"]["data"][0] == -1e-5
    assert content["distortion_model"] == "plumb_bob"
    back = CameraIntrinsics.load(path)
    assert (back.rms, back.std, back.views) == (0.15, (0.5,) * 9, 24)


@pytest.mark.parametrize(
    "keys", [("camera_matrix", "distortion_coefficients"), ("K", "D"), ("M1", "D1")]
)
@pytest.mark.parametrize("count", [4, 5, 8, 14])
def test_files_of_opencv_are_read(tmp_path: Path, keys: tuple[str, str], count: int) -> None:
    path = tmp_path / "opencv.yml"
    distortion = np.zeros((count, 1))
    distortion[:5, 0] = (-0.26, 0.03, 0.001, -0.0002, 0.2)[:count]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write(keys[0], CAMERA.matrix)
    storage.write(keys[1], distortion)
    storage.release()
    assert "!!opencv-matrix" in path.read_text()
    camera = CameraIntrinsics.load(path)
    assert camera.matrix == pytest.approx(CAMERA.matrix)
    assert camera.distortion[:4] == pytest.approx((-0.26, 0.03, 0.001, -0.0002))
    assert camera.model == "plumb_bob"


def test_thin_prism_coefficients_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "prism.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", CAMERA.matrix)
    storage.write("distortion_coefficients", np.full((14, 1), 0.01))
    storage.release()
    with pytest.raises(CalibrationError, match="thin prism"):
        CameraIntrinsics.load(path)


@pytest.mark.parametrize(
    ("model", "data", "expected"),
    [
        ("plumb_bob", "0.1, -1e-05, 0, 0, 0", "plumb_bob"),
        ("rational_polynomial", "0.1, 0, 0, 0, 0, 0.1, 0.2, 0", "rational_polynomial"),
        ("equidistant", "0.1, 0.01, 0, 0", "equidistant"),
        ("fisheye", "0.1, 0.01, 0, 0", "equidistant"),
    ],
)
def test_plain_ros_files_are_read(tmp_path: Path, model: str, data: str, expected: str) -> None:
    path = tmp_path / "ros.yaml"
    path.write_text(ROS.format(model=model, data=data, count=data.count(",") + 1))
    camera = CameraIntrinsics.load(path)
    assert camera.model == expected
    assert camera.distortion == tuple(float(v) for v in data.split(","))
    assert (camera.name, camera.fy) == ("head_camera", 601.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width: 3\n", "lacks the key image_width; its keys: width"),
        ("just words", "it has no keys"),
        ("a: [1, 2\nb: }", "not valid YAML"),
        ("\x89PNG\x00\x01", "(not valid YAML|no keys)"),
        ("", "it has no keys"),
        (ROS.format(model="plumb_bob", data="a, b, c, d", count=4), "must be numbers"),
        (ROS.format(model="wide", data="0, 0, 0, 0", count=4), "unknown distortion_model 'wide'"),
        (
            ROS.format(model="plumb_bob", data="0, 0, 0, 0", count=4).replace("600", "6"),
            "implausible",
        ),
        (
            ROS.format(model="plumb_bob", data="0, 0, 0, 0", count=4).replace("[600, 0", "[600, 5"),
            "skew",
        ),
        (
            ROS.format(model="plumb_bob", data="0, 0, 0, 0", count=4).replace("640", "big"),
            "whole number",
        ),
        (
            ROS.format(model="plumb_bob", data="0, 0", count=2).replace("camera_matrix", "x"),
            "lacks",
        ),
    ],
)
def test_the_error_of_a_wrong_file_names_the_problem(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=rf"{path}(.|\n)*{message}"):
        CameraIntrinsics.load(path)


def test_a_poor_calibration_is_read_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for rms, warned in ((0.4, 0), (1.7, 1)):
        dataclasses.replace(CAMERA, rms=rms).save(tmp_path / "camera.yaml")
        assert CameraIntrinsics.load(tmp_path / "camera.yaml").rms == rms
        assert len(caplog.records) == warned
    assert "1.70 px" in caplog.text and "calibrate again" in caplog.text


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.yaml: .*No such file"):
        CameraIntrinsics.load(tmp_path / "none.yaml")


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "camera.yaml"
    CAMERA.save(path)
    before = path.read_text()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="No space left"):
        CameraIntrinsics(640, 480, 700.0, 700.0, 320.0, 240.0).save(path)
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["camera.yaml"]


def test_a_folder_that_does_not_exist_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"no/camera\.yaml"):
        CAMERA.save(tmp_path / "no" / "camera.yaml")


def test_a_file_with_an_unused_key_loads_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "old.yaml"
    CAMERA.save(path)
    path.write_text(path.read_text() + "edge_shift: 0.41\nedge_shift_std_dev: 0.1\n")
    with caplog.at_level("INFO", logger="robot_ik.camera"):
        assert CameraIntrinsics.load(path) == CameraIntrinsics.load(path)
    lines = [record.message for record in caplog.records]
    assert len(lines) == 2
    assert "the key edge_shift is no longer used" in lines[0]
    assert "edge_shift" not in _saved_again(path)


def _saved_again(path: Path) -> str:
    CameraIntrinsics.load(path).save(path)
    return path.read_text()
