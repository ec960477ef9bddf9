"""The command line of the camera's benchmark: a fast row, its file, wrong names, and Ctrl-C."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.camera import rows
from benchmarks.camera.__main__ import main
from benchmarks.camera.rows import Effort, Row
from benchmarks.quantity import Quantity
from benchmarks.quantity_table import show_quantities
from robot_ik.errors import CameraError


def test_a_row_is_printed_with_its_limits_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "figures.json"
    assert main(["--quick", "--rows", "prediction", "--json", str(file)]) == 0
    out = capsys.readouterr().out
    (late,) = [line for line in out.splitlines() if "66 ms ago, predicted" in line]
    assert "≤ 6.5 mm" in late and "pass" in late and "3 of 3 within limits" in out
    facts = json.loads(file.read_text(encoding="utf-8"))
    assert (
        facts["complete"]
        and facts["quick"]
        and facts["seed"] == 1
        and facts["machine"]["cores"] > 0
    )
    rows = facts["rows"]["prediction"]["figures"]
    (predicted,) = [row for row in rows if row["quantity"].endswith("ago, predicted, RMS")]
    assert predicted["passed"] and 0.0 < predicted["value"] < 6.5 and predicted["unit"] == "mm"


def test_an_unknown_row_gives_a_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--rows", "predicton"]) == 2
    reported = capsys.readouterr().err
    assert "did you mean 'prediction'" in reported and "Traceback" not in reported


def test_the_row_of_real_pictures_requires_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--rows", "photographs"]) == 2
    assert "--photographs" in capsys.readouterr().err
    assert main(["--rows", "photographs", "--photographs", "not/there"]) == 2
    assert "not/there is not a folder" in capsys.readouterr().err


def failing(_: Effort) -> Iterator[Quantity]:
    yield Quantity("depth", 3.0, "mm", 2.0)


def empty(_: Effort) -> Iterator[Quantity]:
    yield from ()


def impossible(_: Effort) -> Iterator[Quantity]:
    yield Quantity("first", 1.0, "mm", 2.0)
    raise CameraError("no camera here")


@pytest.mark.parametrize("quick", [[], ["--quick"]])
@pytest.mark.parametrize(
    ("function", "words"),
    [("failing", "FAIL"), ("empty", "it gave no figure"), ("impossible", "no camera here")],
)
def test_failed_and_unmeasured_rows_are_reported_and_fail(
    function: str,
    words: str,
    quick: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    good = Row("good", "a row of this test", f"{__name__}:fine")
    row = Row("mine", "a row of this test", f"{__name__}:{function}")
    monkeypatch.setattr(rows, "ROWS", (row, good))
    file = tmp_path / "figures.json"
    assert main([*quick, "--json", str(file)]) == 1
    out = capsys.readouterr().out
    assert words in out and "fine" in out, "the other rows are measured"
    if function != "failing":
        assert "; not measured: mine" in out
        *_, last = json.loads(file.read_text(encoding="utf-8"))["rows"]["mine"]["figures"]
        assert last["missing"] == words and last["value"] is None
    assert main([*quick, "--skip", "mine"]) == 0


def fine(_: Effort) -> Iterator[Quantity]:
    yield Quantity("fine", 1.0, "mm", 2.0)


def test_missing_real_pictures_are_reported(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (row,) = [row for row in rows.ROWS if row.name == "photographs"]
    monkeypatch.setattr(rows, "ROWS", (row,))
    assert main([]) == 1
    assert "not measured: it needs photographs of yours" in capsys.readouterr().out
    assert main(["--skip", "photographs"]) == 2
    assert "no row is left" in capsys.readouterr().err


def interrupted(_: Effort) -> Iterator[Quantity]:
    yield Quantity("first", 1.0, "mm", 2.0)
    raise KeyboardInterrupt


@pytest.mark.parametrize(("function", "code"), [("failing", 1), ("interrupted", 130)])
def test_failed_and_interrupted_runs_are_reported(
    function: str,
    code: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    row = Row("mine", "a row of this test", f"{__name__}:{function}")
    monkeypatch.setattr(rows, "ROWS", (row,))
    file = tmp_path / "figures.json"
    assert main(["--json", str(file)]) == code
    out = capsys.readouterr().out
    if code == 1:
        assert "FAIL" in out and "0 of 1 within limits" in out
    else:
        assert "1 of 1 within limits; not all measured" in out
    assert json.loads(file.read_text(encoding="utf-8"))["complete"] is (code == 1)


def test_a_table_names_a_row_once(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        ("walk", Quantity("slip", 0.5, "mm", 0.1)),
        ("walk", Quantity("speed", 1.2, "m/s", least=1.1)),
        ("jump", Quantity("balls", 3)),
    ]
    show_quantities("motion", rows)
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in out[:4]] == [
        ["motion", "quantity"],
        ["walk", "slip"],
        ["speed", "1.2"],
        ["jump", "balls"],
    ]
    assert out[4] == "1 of 2 within limits"
