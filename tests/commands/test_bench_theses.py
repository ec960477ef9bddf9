"""``robot-ik bench a00`` and ``robot-ik bench s12``: exit codes, tables that fit, files, Ctrl-C."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from robot_ik.bench.theses import a00
from robot_ik.commands.bench_theses import cell_text
from robot_ik.problem import Budget, Problem


def test_a00_passes_and_reports_its_options(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    asked = ("--test", 6, 8, 13, "--solver", "lm", "dls", "triangulation", "--count", 5)
    run = robot_ik("bench", "a00", *asked, "--out", tmp_path / "out")
    assert run.code == 0, run
    assert "PASSED" in run.out and "lm, dls met every frame" in run.out
    assert "0.1° steps" in run.out and "lost after some 20°" in run.out
    assert max(map(len, run.out.splitlines())) <= 80
    row = next(line.split() for line in run.out.splitlines() if line.startswith("triangulation"))
    assert row[1:] == ["100", "-", "-"]
    summary = json.loads((tmp_path / "out" / "a00.json").read_text())
    assert [test["test"] for test in summary["tests"]] == [6, 8, 13] and summary["passed"]
    assert len(summary["tracks"]) == 9


def test_a00_that_loses_a_goal_ends_with_1(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow_problem(*args: Any, **options: Any) -> Problem:
        return Problem(*args, **options, budget=Budget(restarts=0), max_step=1e-4)

    monkeypatch.setattr(a00, "Problem", slow_problem)
    run = robot_ik("bench", "a00", "--test", 6, "--solver", "dls", "--count", 3, "--out", tmp_path)
    assert run.code == 1
    assert "NOT PASSED" in run.out and "dls in test 6: lost at 0°" in run.out


def test_s12_prints_the_numbers_of_the_thesis_and_ours(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    run = robot_ik("bench", "s12", "--count", 3, "--out", tmp_path)
    assert run.code == 0 and "PASSED" in run.out
    assert "Case 4: random, ±45°, 3 frames" in run.out and "51.9  88  29" in run.out
    assert max(map(len, run.out.splitlines())) <= 80
    assert sorted(file.name for file in tmp_path.iterdir()) == ["s12.json"]


def test_ctrl_c_keeps_what_is_done(
    robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = a00.make_course

    def make_course(number: int, *rest: int | None) -> Any:
        if number == 5:
            raise KeyboardInterrupt
        return made(number, *rest)

    monkeypatch.setattr(a00, "make_course", make_course)
    asked = ("--test", 4, 5, "--solver", "lm", "--count", 3)
    run = robot_ik("bench", "a00", *asked, "--out", tmp_path)
    assert run.code == 130 and "interrupted" in run.err and "INTERRUPTED" in run.out
    summary = json.loads((tmp_path / "a00.json").read_text())
    assert not summary["complete"] and [track["test"] for track in summary["tracks"]] == [4]


@pytest.mark.parametrize("where", ["make_course", "track"])
def test_ctrl_c_at_any_moment(
    where: str, robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*arguments: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(a00, where, stop)
    run = robot_ik("bench", "a00", "--test", 9, "--out", tmp_path)
    assert run.code == 130 and "INTERRUPTED" in run.out and "Traceback" not in run.err
    assert not json.loads((tmp_path / "a00.json").read_text())["complete"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("a00", "--test", 14), "1 … 13"),
        (("a00", "--solver", "lmm"), "'lm'"),
        (("a00", "--count", 0), "at least 1, at most 100000"),
        (("s12", "--count", -3), "at least 1, at most 100000"),
        (("a00", "--seed", -1), "at least 0"),
        (("s12", "--test", 3), "with bench a00"),
        (("s12", "--solver", "lm"), "with bench methods and bench a00"),
        (("a00", "--plot"), "with bench methods and bench s12"),
        (("a00", "--count", 2, "--out", "/dev/null/x"), "cannot write"),
    ],
)
def test_wrong_input(words: tuple[Any, ...], expected: str, robot_ik: Any) -> None:
    run = robot_ik("bench", *words)
    run.assert_one_screen_error()
    assert expected in run.err


def test_json_is_the_content_of_the_file(robot_ik: Any, tmp_path: Path) -> None:
    run = robot_ik("bench", "s12", "--count", 2, "--json", "--out", tmp_path)
    assert run.code == 0
    assert json.loads(run.out) == json.loads((tmp_path / "s12.json").read_text())


def test_unknown_experiment(robot_ik: Any) -> None:
    assert robot_ik("bench", "a01").code == 2


def test_a_picture_without_matplotlib_is_refused_before_the_work(
    robot_ik: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name == "matplotlib" else found(name, *rest),
    )
    run = robot_ik("bench", "s12", "--plot")
    run.assert_one_screen_error()
    assert 'pip install "robot-ik-testbed[plots]"' in run.err


def test_a_whole_percentage_is_not_rounded_down() -> None:
    assert cell_text({"milliseconds": 5.0, "n": 40, "solved": 290 / 1000}).endswith(" 29")
    assert cell_text({"milliseconds": 5.0, "n": 40, "solved": 999 / 1000}).endswith(" 99")
