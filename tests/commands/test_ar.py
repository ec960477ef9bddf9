"""``robot-ik ar`` on the terminal."""

import json
import os
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from robot_ik.camera.registration import Registrar
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.commands.main import main
from robot_ik.geometry import Pose
from robot_ik.workcell import films


def test_a_photograph_with_one_marker(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pose = Pose((0.0, 0.05, 0.5), (0.17, 0.985, 0.0, 0.0))
    image = render_markers(STANDARD_CAMERA, {7: (0.05, pose)}, np.random.default_rng(0))
    cv2.imwrite(str(tmp_path / "photo.png"), image)
    STANDARD_CAMERA.save(tmp_path / "camera.yaml")
    words = [
        "ar",
        "--camera",
        str(tmp_path / "photo.png"),
        "--intrinsics",
        str(tmp_path / "camera.yaml"),
    ]
    words += ["--board", "marker:7:50", "--dictionary", "DICT_4X4_50", "--scale", "0.15", "--json"]
    assert main([*words, "--video", str(tmp_path / "a.png")]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["pictures"] == facts["drawn"] == 1
    assert facts["reprojection_px"] < 0.3
    assert cv2.imread(str(tmp_path / "a.png")).shape == (480, 640, 3)


def test_without_the_extra_video_it_runs_and_names_the_install_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    real = films.importlib.util.find_spec
    monkeypatch.setattr(
        films.importlib.util,
        "find_spec",
        lambda name, *more: None if name == "av" else real(name, *more),
    )
    assert main(["ar", "--seconds", "0.05", "--size", "640", "480"]) == 0
    assert 'pip install "robot-ik-testbed[video]"' in capsys.readouterr().err
    assert sorted(f.name for f in (tmp_path / "ar").iterdir()) == ["000000.png", "000001.png"]
    assert main(["ar", "--seconds", "0.05", "--size", "640", "480"]) == 2
    assert "it holds 000000.png" in capsys.readouterr().err
    assert main(["ar", "--seconds", "0", "--video", "b"]) == 2
    assert "--seconds: 0.0 is out of range" in capsys.readouterr().err
    assert main(["ar", "--video", "a.mp4", "--robot", "nowhere"]) == 2
    assert 'pip install "robot-ik-testbed[video]"' in capsys.readouterr().err


def test_ctrl_c_before_the_first_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*rest: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Registrar, "track", interrupted)
    assert main(["ar", "--size", "64", "48", "--video", "a.png"]) == 130
    output = capsys.readouterr()
    assert "nothing is written" in output.err and "None" not in output.out + output.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--robot-pose", "1", "2"], "--robot-pose"),
        (["--robot-pose", "nan", "0", "0"], "--robot-pose"),
        (["--size", "640"], "--size"),
        (["--size", "100000", "100000"], "at least 16, at most 16384"),
        (["--video", "a.webm"], ".mp4"),
        (["--alpha", "2"], "--alpha"),
        (["--scale", "-1"], "--scale"),
        (["--occluders", "a.toml", "b.toml"], "one file"),
        (["--occluders", "no_such_geom"], "--occluders"),
        (["--camera", "nowhere.png", "--intrinsics", "none.yaml"], "none.yaml"),
        (["--board", "plate:3"], "plate:3"),
        (["--occluders", "none.toml"], "none.toml"),
        (["--robot", "puma56"], "puma560"),
        (["--motion", "gone.toml"], "the script or arm file cannot be read"),
        (["--motion", "brownout"], "brown_out"),
    ],
)
def test_impossible_options_are_one_sentence_and_exit_code_2(
    words: list[str],
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    out = [] if "--video" in words else ["--video", "a.png"]
    assert main(["ar", *out, *words]) == 2
    errors = capsys.readouterr().err
    assert expected in errors
    assert "Traceback" not in errors
    assert not list(tmp_path.iterdir())
