"""Results are not lost: existing results are refused before the work, and runs do not mix."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import Any

import pytest

from robot_ik.errors import OutputError
from robot_ik.workcell.results import results_folder

OWN = ("reach.png", "summary.json")


def write(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)
        (folder / name).write_text("new")


def test_a_folder_that_holds_anything_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with (
        pytest.raises(OutputError, match=r"it holds notes\.txt(.|\n)*--overwrite"),
        results_folder(tmp_path, "reach", OWN, overwrite=False),
    ):
        pytest.fail("the work has begun")
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_overwrite_replaces_own_files_only(tmp_path: Path) -> None:
    for name in ("notes.txt", *OWN):
        (tmp_path / name).write_text("old")
    with results_folder(tmp_path, "reach", OWN, overwrite=True) as folder:
        assert sorted(p.name for p in folder.iterdir()) == ["notes.txt", *OWN]
        write(folder, "summary.json")  # this run has no picture: the old one would be taken for its
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {
        "notes.txt": "old",
        "summary.json": "new",
    }


def test_a_run_that_fails_before_it_writes_leaves_the_old_results(tmp_path: Path) -> None:
    write(tmp_path, *OWN)
    with contextlib.suppress(KeyError), results_folder(tmp_path, "reach", OWN, overwrite=True):
        raise KeyError
    with results_folder(tmp_path, "reach", OWN, overwrite=True):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == list(OWN)


def test_two_runs_at_once_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with results_folder("", "reach", OWN, overwrite=False) as one:
        with results_folder("", "reach", OWN, overwrite=False) as two:
            assert one != two and one.parent == two.parent == Path("runs")
            write(two, "summary.json")
        with (
            pytest.raises(OutputError, match="another run is writing"),
            results_folder(one, "reach", OWN, overwrite=True),
        ):
            pytest.fail("two runs in one folder")
    assert not one.exists() and two.is_dir()  # what stayed empty is taken back


@pytest.mark.parametrize(
    "words",
    [
        ["reach", "--bus", "none", "--out"],
        ["bench", "--out"],
        ["bench", "s12", "--out"],
    ],
)
def test_every_command_refuses_a_folder_with_results(
    words: list[str], tmp_path: Path, robot_ik: Any
) -> None:
    (tmp_path / "summary.json").write_text("precious")
    run = robot_ik(*words, tmp_path)
    run.assert_one_screen_error()
    assert "--overwrite" in run.err and (tmp_path / "summary.json").read_text() == "precious"


@pytest.mark.parametrize(
    "words",
    [
        ["run", "pick_and_place", "--junit"],
        ["servo", "record", "--bus", "sim", "--seconds", "1"],
        ["servo", "calibrate", "--bus", "sim"],
    ],
)
@pytest.mark.parametrize("trouble", ["exists", "in a file", "taken"])
def test_every_command_refuses_a_file_it_cannot_have(
    words: list[str], trouble: str, tmp_path: Path, robot_ik: Any
) -> None:
    from robot_ik.script import shipped

    words = [next(iter(shipped())) if word == "pick_and_place" else word for word in words]
    suffix = {"record": ".csv", "calibrate": ".toml"}.get(words[1], ".json")
    file = (tmp_path / "none" if trouble == "in a file" else tmp_path) / f"result{suffix}"
    with contextlib.ExitStack() as stack:
        if trouble == "exists":
            file.write_text("precious")
        elif trouble == "in a file":
            file.parent.touch()
        elif trouble == "taken":
            handle = os.open(file.with_name(f".{file.name}.lock"), os.O_CREAT | os.O_RDWR)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX)
        run = robot_ik(*words, file)
    run.assert_one_screen_error()
    assert file.name in run.err or "none is a file" in run.err
    assert not file.exists() or file.read_text() == "precious"


@pytest.mark.skipif(
    not Path("/proc/self").exists(), reason="needs a folder that takes no files from anybody"
)
@pytest.mark.parametrize("words", [["reach", "--out"], ["reach", "--record"]])
def test_a_folder_that_takes_no_files_is_not_said_to_be_missing(
    words: list[str], robot_ik: Any
) -> None:
    run = robot_ik(*words, "/proc/x.csv")
    run.assert_one_screen_error()
    assert "no file can be made in /proc" in run.err and "no folder" not in run.err
