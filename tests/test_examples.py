"""The examples, as a reader would start them: in a process of their own, from another folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from robot_ik.goals import PoseGoal
from robot_ik.solvers import SOLVERS

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *arguments],
        cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=110, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, f"no {pattern!r} in:\n{text}"
    return float(found[1])


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_and_says_what_it_prints(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    docstring = text.split('"""')[1]
    assert "Prints" in docstring
    assert "def test_" + path.stem.split("_", 1)[1] in Path(__file__).read_text(encoding="utf-8")


def test_solve(tmp_path: Path) -> None:
    out = run("01_solve.py", tmp_path)
    rows = re.findall(r"^(\w+) +([A-Z_]+) +([\d.]+) mm +([\d.]+) deg", out, re.MULTILINE)
    *near, far = rows
    assert [name for name, *_ in near] == [n for n in SOLVERS if PoseGoal in SOLVERS[n].goals]
    assert ("lm", "CONVERGED") in [row[:2] for row in near]
    for name, status, position, angle in near:
        within = float(position) <= 0.1 and float(angle) <= 0.0573
        assert within == (status == "CONVERGED"), name
    # What only a forward pass can know: where the gripper is, and how far off the far goal is.
    x, y, z = (float(v) for v in re.search(r"position=\(([^)]*)\)", out)[1].split(","))  # type: ignore[index]
    assert max(abs(x + 0.45), abs(y + 0.10), abs(z - 0.80)) < 1e-4
    assert far[1] == "UNREACHABLE" and 1500 < float(far[2]) < 3000
    assert "proven out of reach" in out


@pytest.mark.parametrize("bus", [(), ("pty",)], ids=["sim", "pty"])
def test_move_servos(tmp_path: Path, bus: tuple[str, ...]) -> None:
    out = run("02_move_servos.py", tmp_path, *bus)
    rows = re.findall(r"^(joint\d) +start +(\S+) +target +(\S+) +read back +(\S+) deg", out, re.MULTILINE)
    assert [name for name, *_ in rows] == [f"joint{k}" for k in range(1, 7)]
    for name, start, target, read in rows:
        assert abs(float(target) - float(start)) == pytest.approx(8.0, abs=0.02), name
        assert float(read) == pytest.approx(float(target), abs=0.2), name  # two ticks of the coarsest joint
    assert "left with torque_off, confirmed by 6 of 6 servos" in out
    assert 0.0 < number(r"largest lag ([\d.]+) deg", out) < 5.0


def test_see_and_reach(tmp_path: Path) -> None:
    out = run("03_see_and_reach.py", tmp_path)
    assert number(r"servos say: ([\d.]+) mm", out) < 2.5
    assert number(r"camera says: ([\d.]+) mm", out) < 5.0
    assert out.rstrip().endswith(": REACHED")


def test_see_and_reach_tells_a_hidden_fault(tmp_path: Path) -> None:
    out = run("03_see_and_reach.py", tmp_path, "2")
    assert number(r"servos say: ([\d.]+) mm", out) < 2.5
    # 2 degrees about joint 2 move the gripper, some 0.45 m away from its axis, by 15 mm.
    assert 10.0 < number(r"camera says: ([\d.]+) mm", out) < 20.0
    assert "NOT REACHED" in out
