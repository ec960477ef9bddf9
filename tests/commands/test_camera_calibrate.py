"""``robot-ik camera calibrate``: pictures, a moving board, an interruption, useless input."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera import sources
from robot_ik.camera.calibration import intrinsic as calibrating
from robot_ik.camera.device import DeviceSource
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.synthetic.sources import open_moving
from robot_ik.errors import FrameTimeoutError


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with seven views of the default ChArUco board."""
    folder = tmp_path_factory.mktemp("views")
    for frame in open_moving("synthetic:charuco?frames=19&seed=7"):
        # Each pose is held for three pictures.
        if frame.sequence % 3 == 0:
            cv2.imwrite(str(folder / f"view{frame.sequence}.png"), frame.image)
    (folder / "view7.png").write_text("no picture")
    return folder


def test_a_folder_of_pictures_becomes_a_camera(
    robot_ik: Any, pictures: Path, tmp_path: Path
) -> None:
    out = tmp_path / "desk.yaml"
    run = robot_ik("camera", "calibrate", pictures, "--out", out, "--json")
    assert run.code == 0, run.err
    assert "left out:" in run.err and "view7.png is not a picture" in run.err
    facts = json.loads(run.out)
    camera = CameraIntrinsics.load(out)
    assert facts["digest"] == camera.digest and facts["f"] == [camera.fx, camera.fy]
    assert camera.fx == pytest.approx(STANDARD_CAMERA.fx, rel=0.005)
    assert (camera.name, camera.views) == ("desk", 7) and camera.date.startswith("20")
    assert [v["name"] for v in facts["views"]] == [f"view{3 * k}.png" for k in range(7)]
    assert facts["doubts"][0] == "only 7 views: take 15 or more" and facts["rms_px"] < 0.1


def test_a_chessboard_becomes_a_camera(robot_ik: Any, tmp_path: Path) -> None:
    arguments = (
        "--pattern",
        "chessboard",
        "--views",
        "6",
        "--out",
        tmp_path / "chess.yaml",
        "--json",
    )
    run = robot_ik("camera", "calibrate", "synthetic:chessboard?frames=22&seed=3", *arguments)
    assert run.code == 0, run.err
    assert json.loads(run.out)["rms_px"] < 0.2


class LiveBoard(DeviceSource):
    """A board in front of a camera. Ctrl-C ends the run."""

    live = True

    def __init__(self, ends_with: BaseException, frames: int = 22, seed: int = 3) -> None:
        self._board = open_moving(f"synthetic:charuco?frames={frames}&seed={seed}")
        self._ends_with = ends_with
        self.size = self._board.size

    def read(self) -> sources.Frame:
        if self._board.exhausted and isinstance(self._ends_with, KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5.0)
        if self._board.exhausted:
            raise self._ends_with
        return self._board.read()

    @property
    def exhausted(self) -> bool:
        return False

    def close(self) -> None:
        self._board.close()


def opened(text: str, end: BaseException) -> sources.FrameSource:
    return LiveBoard(end, frames=6, seed=5) if text == "0" else sources.FolderSource(text)


def test_ctrl_c_while_calibrating_names_the_folder_of_the_views(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*rest: Any, **more: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    monkeypatch.setattr(calibrating, "calibrate", interrupted)
    monkeypatch.setattr(sources, "open_source", lambda text, **_: opened(text, KeyboardInterrupt()))
    run = robot_ik("camera", "calibrate", "0", "--out", tmp_path / "camera.yaml")
    assert run.code == 130 and "Traceback" not in run.err
    assert f"robot-ik camera calibrate {tmp_path / 'camera-views'} 0" in " ".join(run.err.split())


def test_ctrl_c_keeps_the_views(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "open_source", lambda *_, **__: LiveBoard(KeyboardInterrupt()))
    out = tmp_path / "camera.yaml"
    run = robot_ik("camera", "calibrate", "0", "--out", out)
    assert run.code == 0, run.err
    assert "view 7 of 20: still to show" in run.err and "stopped; 7 views are kept" in run.err
    assert "usable, with doubts" in run.out and "only 7 views" in run.out
    assert CameraIntrinsics.load(out).views == 7
    kept = sorted(p.name for p in (tmp_path / "camera-views").iterdir())
    assert kept == [f"view{k:02d}.png" for k in range(1, 8)]


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        (KeyboardInterrupt(), "stopped"),
        (FrameTimeoutError("camera 0 stopped delivering"), "camera 0 stopped"),
    ],
)
def test_an_early_end_is_no_calibration_but_keeps_the_pictures(
    end: BaseException,
    expected: str,
    robot_ik: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sources, "open_source", lambda *_, **__: LiveBoard(end, frames=6))
    run = robot_ik("camera", "calibrate", "0", "--out", tmp_path / "camera.yaml")
    assert run.code == 2 and "2 usable views: too few" in run.err
    views = tmp_path / "camera-views"
    assert expected in run.err and f"2 views are kept in {views}" in run.err
    assert f"robot-ik camera calibrate {views} 0" in " ".join(run.err.split())
    assert not (tmp_path / "camera.yaml").exists()
    assert sorted(p.name for p in views.iterdir()) == ["view01.png", "view02.png"]


def test_views_are_added_to_those_that_are_given_and_to_no_others(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "open_source", lambda text, **_: opened(text, KeyboardInterrupt()))
    views = tmp_path / "camera-views"
    out = ("--out", tmp_path / "camera.yaml")
    views.mkdir()
    grey = np.full((480, 640), 128, np.uint8)
    for name in ("view01.png", "view04.png"):
        cv2.imwrite(str(views / name), grey)
    robot_ik("camera", "calibrate", views, "0", *out)
    assert sorted(p.name for p in views.iterdir()) == [f"view0{k}.png" for k in (1, 4, 5, 6)]
    assert (cv2.imread(str(views / "view04.png")) == 128).all()
    # A new run starts without the earlier views, since the focus may differ.
    robot_ik("camera", "calibrate", "0", *out)
    assert (
        len(list(views.iterdir())) == 4 and len(list((tmp_path / "camera-views-2").iterdir())) == 2
    )


def test_a_camera_that_gives_nothing_is_an_error(
    robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent = LiveBoard(
        FrameTimeoutError("no new picture from camera 0 for 2 s", hint="check the cable"), frames=0
    )
    monkeypatch.setattr(sources, "open_source", lambda *_, **__: silent)
    run = robot_ik("camera", "calibrate", "0")
    assert (
        run.code == 2 and "no new picture from camera 0" in run.err and "check the cable" in run.err
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing-here"], "there is no camera, file or folder 'nothing-here'"),
        (["nothing-here"], "folder or URL; this folder contains grey.png, small.png"),
        (["grey.png"], "there is no ChArUco board of 8x6 squares"),
        (["grey.png", "small.png"], "small.png has 320x240 px, the pictures before it 640x480 px"),
        (
            ["grey.png", "--square-mm", "0.03"],
            "of 0.03 mm is not possible give 1 to 1000 mm: is 30 mm meant?",
        ),
        (["grey.png", "--pattern", "chess"], "--pattern"),
        (
            ["grey.png", "--pattern", "chessboard", "--marker-mm", "20"],
            "a chessboard has no markers",
        ),
        ([], "there is nothing to calibrate from"),
    ],
)
def test_mistakes_are_reported(
    arguments: list[str], words: str, robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, size in (("grey.png", (480, 640, 3)), ("small.png", (240, 320, 3))):
        cv2.imwrite(name, np.full(size, 128, np.uint8))
    run = robot_ik("camera", "calibrate", *arguments)
    run.assert_one_screen_error()
    assert words in " ".join(run.err.replace("│", " ").split())
    assert not (tmp_path / "camera.yaml").exists()
