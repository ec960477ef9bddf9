"""``robot-ik camera print``: files, output and wrong options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from robot_ik.camera.sheets.sheets import SheetKind, SheetRequest, make_sheet_page
from robot_ik.camera.target_files import load_bodies
from robot_ik.commands.camera_print import CameraPrint
from robot_ik.commands.main import parse_command


def test_a_sheet_is_written_and_named(robot_ik: Any, tmp_path: Path) -> None:
    out = tmp_path / "sheet.pdf"
    run = robot_ik("camera", "print", "marker", "--id", 7, 8, "--size-mm", 45, "--out", out)
    assert run.code == 0 and run.err == ""
    assert f"{out}: markers 7, 8 of DICT_5X5_50, 45 mm on a4" in run.out
    assert "measure both bars: 100.0 mm" in run.out
    assert out.read_bytes().startswith(b"%PDF-1.4")


def test_a_board_comes_with_its_body(robot_ik: Any, tmp_path: Path) -> None:
    out = tmp_path / "sheet.pdf"
    body = tmp_path / "table.toml"
    run = robot_ik("camera", "print", "board", "--out", out, "--body", body, "--id", 4)
    assert run.code == 0 and out.read_bytes().startswith(b"%PDF")
    assert list(load_bodies(body)["table"].markers) == [4, 5, 6, 7]


@pytest.mark.parametrize("kind", ["marker", "board", "cube", "charuco", "chessboard"])
def test_the_commands_on_the_sheet_are_commands(kind: SheetKind) -> None:
    page = make_sheet_page(
        SheetRequest(kind, size_mm=20.0, id=() if kind.startswith("ch") else (3,))
    )
    commands = [w.text.split() for w in page.labels if w.text.startswith("robot-ik ")]
    assert len(commands) == 2 and ["robot-ik", "camera", "print", kind] == commands[0][:4]
    for words in commands:
        _, command = parse_command(words[1:])
        assert command is not None
        if isinstance(command, CameraPrint):
            assert command.size_mm == 20.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["charuco", "--size-mm", "40"], ["needs 320x240 mm", "--size-mm 30 fits"]),
        (["marker", "--out", "sheet.svg"], ["a sheet is a .pdf"]),
        (["marker", "--id", "99"], ["marker id 99 is not in DICT_5X5_50", "0 to 49"]),
        (["marker", "--dictionary", "5X5_51"], ["unknown marker dictionary", "DICT_5X5_50"]),
        (["marker", "--body", "body.toml"], ["is not a body", "board or cube"]),
        (["poster"], ["poster"]),
    ],
)
def test_mistakes_are_reported(
    arguments: list[str],
    words: list[str],
    robot_ik: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    run = robot_ik("camera", "print", *arguments)
    run.assert_one_screen_error()
    flat = " ".join(run.err.replace("│", " ").split())
    assert all(word in flat for word in words), run.err
    assert not list(tmp_path.iterdir())
