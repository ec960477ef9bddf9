"""``robot-ik bench`` on the command line: its table, its errors, and its files after Ctrl-C."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robot_ik.bench.methods import growth
from robot_ik.bench.methods.results import Results
from robot_ik.commands.main import main


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("--solver lmm", "did you mean 'lm'"),
        ("--robot puma56", "did you mean 'puma560'"),
        ("--problems warmer", "warm"),
        ("--count 0", "--count: 0 is out of range"),
        ("--count 999999999999", "at least 1, at most 100000"),
        ("--seconds 0", "--seconds"),
        ("--test 3", "with bench a00"),
    ],
)
def test_wrong_input_is_one_sentence(
    arguments: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "none"
    assert main(["bench", *arguments.split(), "--out", str(out)]) == 2
    reported = capsys.readouterr()
    assert (
        expected in " ".join((reported.out + reported.err).split())
        and "Traceback" not in reported.err
    )
    assert not out.exists()


def test_the_table_has_a_row_for_each_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = "bench --solver analytic lm --robot panda --problems cold --count 10"
    assert main([*arguments.split(), "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].strip() == "panda, cold"
    assert {"solver", "solved", "median", "p99", "steps", "restarts"} <= set(lines[1].split())
    (lm,) = [line.split() for line in lines if line.startswith("lm ")]
    assert lm[1] == "pose" and float(lm[2]) == 100.0
    (analytic,) = [line for line in lines if line.startswith("analytic ")]
    assert "no closed form" in analytic
    assert [file.name for file in tmp_path.iterdir()] == ["bench.json"]


def test_json_is_the_content_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = "bench --solver lm --robot panda --problems cold --count 10 --json --out"
    assert main([*arguments.split(), str(tmp_path)]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts.pop("schema") == 1
    assert facts == json.loads((tmp_path / "bench.json").read_text())


def test_kernels_and_batches(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(growth, "JOINTS", (4, 8))
    monkeypatch.setattr(growth, "FIGURE_FRAMES", growth.FIGURE_FRAMES[:2])
    arguments = "bench --solver lm analytic --robot panda puma560 --problems kernels batch"
    arguments += " --count 2"
    assert main([*arguments.split(), "--out", str(tmp_path)]) == 0
    reported = capsys.readouterr()
    results = Results.model_validate_json((tmp_path / "bench.json").read_bytes())
    assert not results.cells and [one.joints for one in results.lower_bounds] == [7, 6]
    points = {(point.solver, point.across, point.size): point for point in results.growth}
    lm = {
        ("lm", across, size)
        for across, size in (("joints", 4), ("joints", 8), ("goals", 1), ("goals", 2))
    }
    assert set(points) == lm  # a closed form takes no steps
    assert all(point.step_us > 0.0 for point in points.values())
    solved = {(one.solver, one.robot, one.threads): one for one in results.batches}
    assert {key[:2] for key in solved} == {
        ("lm", "panda"),
        ("lm", "puma560"),
        ("analytic", "puma560"),
    }
    assert all(
        one.poses == 1000 and one.success == 1.0 and one.per_second > 0 for one in solved.values()
    )
    assert "no batch" in reported.err and "panda" in reported.err
    assert "solves/s" in reported.out and "µs a step, by number of goals" in " ".join(
        reported.out.split()
    )


def test_problems_that_do_not_exist_take_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = "bench --solver lm ccd --robot humanoid --problems unreachable --count 5 --out"
    assert main([*arguments.split(), str(tmp_path)]) == 0
    (line, *_) = capsys.readouterr().out.splitlines()
    assert line.startswith("humanoid, unreachable: its reach is not bounded")


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a child there")
def test_ctrl_c_keeps_what_is_done(tmp_path: Path, real_time: None) -> None:
    arguments = "bench --solver lm ccd --robot puma560 --problems cold --count 2000 --seconds 999"
    arguments += " --out"
    child = subprocess.Popen(
        [sys.executable, "-m", "robot_ik", *arguments.split(), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    for line in child.stderr:
        if "kernels are ready" in line:
            break
    time.sleep(1.0)
    child.send_signal(signal.SIGINT)
    out, err = child.communicate()
    assert child.returncode == 130, err
    assert "interrupted" in err and "partial results in" in err and "Traceback" not in err
    results = Results.model_validate_json((tmp_path / "bench.json").read_bytes())
    assert not results.complete
    assert results.cells[0].count > 0 and sum(cell.count for cell in results.cells) < 4000
    for cell in results.cells:
        assert len(cell.success) == len(cell.status) == cell.count
    assert "puma560, cold" in out and "lm" in out
