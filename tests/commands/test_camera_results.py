"""Camera commands check their output paths first and replace files only with --overwrite."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.camera import sources
from robot_ik.camera.sheets import sheets
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA, render_markers
from robot_ik.errors import OutputError
from robot_ik.files import make_folder, write_atomically
from robot_ik.geometry import Pose
from robot_ik.testbed.ar import overlay
from robot_ik.workcell import locate
from robot_ik.workcell.arm_camera import handeye, verify
from robot_ik.workcell.results import claimed

LOCATE = ("locate", "photo.png", "--intrinsics", "lens.yaml", "--board", "marker:7:50")
SEEN = Pose((0.0, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0))
#: Command, option that names its result, the other files that it writes.
COMMANDS = [
    (("camera", "calibrate", "photo.png"), "--out", "mine.yaml", ()),
    (("camera", *LOCATE), "--out", "mine.toml", ()),
    (("camera", "print", "board"), "--out", "mine.pdf", ()),
    (("camera", "print", "board", "--out", "other.pdf"), "--body", "mine.toml", ()),
    (("camera", "handeye"), "--out", "mine.toml", ("mine.samples.json",)),
    (("camera", "verify"), "--out", "mine.json", ()),
    (("camera", "verify", "--out", "other.json"), "--plot", "mine.png", ()),
    (("ar",), "--video", "mine.png", ()),
]
RESULTS = [
    (words, option, name) for words, option, first, rest in COMMANDS for name in (first, *rest)
]


class Began(AssertionError):
    """Raised when the work begins."""


@pytest.fixture(autouse=True)
def _desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a photograph of marker 7 and its calibration into an empty folder."""
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("photo.png", picture())
    STANDARD_CAMERA.save("lens.yaml")


def picture() -> np.ndarray:
    return render_markers(
        STANDARD_CAMERA, {7: (0.05, SEEN)}, np.random.default_rng(0), dictionary="DICT_5X5_50"
    )


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    def began(*_: object, **__: object) -> None:
        raise Began

    for module, name in (
        (sources, "open_source"),
        (locate, "run_locate"),
        (handeye, "run_handeye"),
        (verify, "run_verify"),
        (overlay, "load_robot"),
        (sheets, "make_sheet_page"),
    ):
        monkeypatch.setattr(module, name, began)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(("words", "option", "name"), RESULTS, ids=lambda v: str(v)[-24:])
def test_a_result_that_is_there_is_refused_before_the_work_begins(
    robot_ik: Any, words: tuple[str, ...], option: str, name: str
) -> None:
    first = next(one[2] for one in COMMANDS if one[0] == words and one[1] == option)
    Path(name).write_bytes(b"older")
    before = sorted(os.listdir())
    run = robot_ik(*words, option, first)
    run.assert_one_screen_error()
    assert name in run.err and "it exists" in run.err and "--overwrite" in run.err, run
    assert Path(name).read_bytes() == b"older" and sorted(os.listdir()) == before
    begun = robot_ik(*words, option, first, "--overwrite")
    assert "Began" in begun.err, begun
    assert Path(name).read_bytes() == b"older" and sorted(os.listdir()) == before


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(("words", "option", "name", "rest"), COMMANDS, ids=lambda v: str(v)[-24:])
def test_a_place_that_cannot_be_written_is_refused_before_the_work_begins(
    robot_ik: Any, words: tuple[str, ...], option: str, name: str, rest: tuple[str, ...]
) -> None:
    Path("file").write_text("")
    run = robot_ik(*words, option, f"file/{name}")
    run.assert_one_screen_error()
    assert "cannot write" in run.err, run
    Path(name).mkdir()
    run = robot_ik(*words, option, name, "--overwrite")
    run.assert_one_screen_error()
    assert "it is a folder" in run.err, run
    assert not list(Path(name).iterdir())


def test_folders_are_made_before_the_work_and_what_stays_empty_is_taken_back(
    tmp_path: Path,
) -> None:
    place = tmp_path / "a" / "b" / "place.toml"
    with claimed(place):
        assert place.parent.is_dir()
    assert not (tmp_path / "a").exists()
    with claimed(place, place.with_name("beside.json")):
        write_atomically(place, "")
    assert [file.name for file in place.parent.iterdir()] == ["place.toml"]


def test_the_reason_of_a_write_error_is_reported(tmp_path: Path) -> None:
    (tmp_path / "photo.png").touch()
    file = tmp_path / "photo.png"
    missing = tmp_path / "no"
    for make, place, why in (
        (make_folder, file, f"{file} is a file, not a folder"),
        (make_folder, file / "in", f"{file} is a file, not a folder"),
        (lambda path: write_atomically(path, ""), file / "in", f"{file} is a file, not a folder"),
        (
            lambda path: write_atomically(path, ""),
            missing / "a",
            f"there is no folder {missing}(.|\n)*create the folder",
        ),
        (lambda path: claimed(path).__enter__(), tmp_path, "it is a folder(.|\n)*name of a file"),
    ):
        with pytest.raises(OutputError, match=why):
            make(place)


def test_two_runs_do_not_write_one_file(tmp_path: Path) -> None:
    place = tmp_path / "place.toml"
    with claimed(place, tmp_path / "beside.json"):
        with pytest.raises(OutputError, match="another run is writing"), claimed(place):
            pass
        with (
            pytest.raises(OutputError, match="another run is writing"),
            claimed(place, overwrite=True),
        ):
            pass
        assert not place.exists()
    with claimed(place):
        pass
    assert not list(tmp_path.glob(".*"))


def test_only_the_files_of_the_command_are_replaced(robot_ik: Any) -> None:
    Path("extrinsics.toml").write_text("older")
    Path("extrinsics.samples.json").write_text("mine")
    run = robot_ik("camera", *LOCATE, "--overwrite")
    assert run.code == 0 and "intrinsics" in Path("extrinsics.toml").read_text(), run
    assert Path("extrinsics.samples.json").read_text() == "mine"


def test_drawings_neither_replace_pictures_nor_each_other(robot_ik: Any) -> None:
    for folder in ("a", "b"):
        Path(folder).mkdir()
        cv2.imwrite(f"{folder}/1.png", picture())
    before = Path("a/1.png").read_bytes()
    for inside in ("a", "a/1.png"):
        run = robot_ik("camera", "detect", inside, "--draw", "a", "--overwrite")
        run.assert_one_screen_error()
        assert "names of the pictures in a" in run.err and Path("a/1.png").read_bytes() == before
    assert robot_ik("camera", "detect", "a", "b", "--draw", "drawn").code == 0
    assert sorted(os.listdir("drawn")) == ["1.png", "1_2.png"]
    Path("drawn/notes.txt").write_text("mine")
    run = robot_ik("camera", "detect", "photo.png", "--draw", "drawn")
    run.assert_one_screen_error()
    assert "it holds 1.png" in run.err and len(os.listdir("drawn")) == 3
    assert robot_ik("camera", "detect", "photo.png", "--draw", "drawn", "--overwrite").code == 0
    assert sorted(os.listdir("drawn")) == ["1.png", "1_2.png", "notes.txt", "photo.png"]
