"""``robot-ik camera list``: the cameras, or advice without cameras."""

from __future__ import annotations

import json
from typing import Any

import pytest

from robot_ik.camera import device
from robot_ik.camera.device import CameraDevice


def shows(monkeypatch: pytest.MonkeyPatch, *cameras: CameraDevice) -> None:
    monkeypatch.setattr(device, "find_cameras", lambda *_: cameras)


WEBCAM = CameraDevice(
    0, "/dev/video0", "HD Webcam [C920]", "/dev/v4l/by-id/usb-046d-index0", True, True
)
NODE = CameraDevice(1, "/dev/video1", "HD Webcam [C920]", "", True, False)
CLOSED = CameraDevice(2, "/dev/null", "Lab camera", "", False, True)


def test_cameras_are_listed_with_their_users_and_missing_permissions(
    monkeypatch: pytest.MonkeyPatch, robot_ik: Any
) -> None:
    shows(monkeypatch, WEBCAM, NODE, CLOSED)
    run = robot_ik("camera", "list")
    assert run.code == 0
    rows = run.out.splitlines()
    assert rows[1].startswith("0") and "HD Webcam [C920]" in rows[1] and WEBCAM.stable in rows[1]
    assert "free" in rows[1] and "no pictures" in rows[2]
    assert "no permission" in rows[3] and ("usermod" in rows[3] or "udev" in rows[3])


def test_json_has_the_same_facts(monkeypatch: pytest.MonkeyPatch, robot_ik: Any) -> None:
    shows(monkeypatch, WEBCAM, NODE)
    answer = json.loads(robot_ik("camera", "list", "--json").out)
    assert [c["index"] for c in answer["cameras"]] == [0, 1]
    assert answer["cameras"][0]["name"] == "HD Webcam [C920]" and answer["cameras"][0]["usable"]


def test_no_camera_is_reported_with_alternatives(
    monkeypatch: pytest.MonkeyPatch, robot_ik: Any
) -> None:
    monkeypatch.setattr(device, "CAN_LIST", True)
    shows(monkeypatch)
    run = robot_ik("camera", "list")
    run.assert_one_screen_error(1)
    assert "there is no camera" in run.err and "synthetic:orbit" in run.err


def test_other_systems_are_reported_as_unable_to_list(
    monkeypatch: pytest.MonkeyPatch, robot_ik: Any
) -> None:
    monkeypatch.setattr(device, "CAN_LIST", False)
    run = robot_ik("camera", "list")
    run.assert_one_screen_error(1)
    assert "cannot be listed on" in run.err and "there is no camera" not in run.err
