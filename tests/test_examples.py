"""The examples run from another folder, the first in a separate process."""

from __future__ import annotations

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Protocol

import cv2
import mujoco
import numpy as np
import pytest

from robot_ik.goals import PoseGoal
from robot_ik.robot import load_robot
from robot_ik.solvers import SOLVERS

EXAMPLES = Path(__file__).parents[1] / "examples"


class Run(Protocol):
    def __call__(self, name: str, *arguments: str) -> str: ...


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs an example in this process and returns its output."""

    def run(name: str, *arguments: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(EXAMPLES / name), *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def table(out: str) -> list[tuple[int, str, float, float, str]]:
    """Rows (priority, goal, mm, deg, met) of the whole-body examples."""
    rows = re.findall(r"^ +(\d)  (.+?) +([\d.]+) mm +([\d.]+) deg  (yes|no)$", out, re.MULTILINE)
    return [(int(p), name, float(mm), float(deg), met) for p, name, mm, deg, met in rows]


def program(path: Path) -> ModuleType:
    """A file of examples/ or docs/, imported."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, f"no {pattern!r} in:\n{text}"
    return float(found[1])


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_every_example_has_a_docstring_and_a_test(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    docstring = text.split('"""')[1]
    assert re.search(r"[Pp]rints?\b", docstring)
    assert "def test_" + path.stem.split("_", 1)[1] in Path(__file__).read_text(encoding="utf-8")


def test_solve(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / "01_solve.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    out = done.stdout
    rows = re.findall(r"^(\w+) +([A-Z_]+) +([\d.]+) mm +([\d.]+) deg", out, re.MULTILINE)
    *near, far = rows
    assert [name for name, *_ in near] == [
        n for n in SOLVERS if issubclass(PoseGoal, SOLVERS[n].goals)
    ]
    assert ("lm", "CONVERGED") in [row[:2] for row in near]
    for name, status, position, angle in near:
        within = float(position) <= 0.1 and float(angle) <= 0.0573
        assert within == (status == "CONVERGED"), name
    # Values of a forward pass: the position of the gripper, and the error of the distant goal.
    x, y, z = (float(v) for v in re.search(r"position=\(([^)]*)\)", out)[1].split(","))  # type: ignore[index]
    assert max(abs(x + 0.45), abs(y + 0.10), abs(z - 0.80)) < 1e-4
    assert far[1] == "UNREACHABLE" and 1500 < float(far[2]) < 3000
    assert "proven out of reach" in out


@pytest.mark.parametrize("bus", [(), ("pty",)], ids=["sim", "pty"])
def test_move_servos(run: Run, bus: tuple[str, ...], real_time: None) -> None:
    out = run("02_move_servos.py", *bus)
    rows = re.findall(
        r"^(joint\d) +start +(\S+) +target +(\S+) +read back +(\S+) deg", out, re.MULTILINE
    )
    assert [name for name, *_ in rows] == [f"joint{k}" for k in range(1, 7)]
    for name, start, target, read in rows:
        assert abs(float(target) - float(start)) == pytest.approx(8.0, abs=0.02), name
        # Two ticks of the coarsest joint.
        assert float(read) == pytest.approx(float(target), abs=0.2), name
    assert "left with torque_off, confirmed by 6 of 6 joints" in out
    assert 0.0 < number(r"largest lag ([\d.]+) deg", out) < 5.0


def test_see_and_reach(run: Run) -> None:
    out = run("03_see_and_reach.py")
    assert number(r"by the servos: ([\d.]+) mm", out) < 2.5
    assert number(r"by the camera: ([\d.]+) mm", out) < 5.0
    assert out.rstrip().endswith(": REACHED")


def test_see_and_reach_detects_a_hidden_fault(run: Run) -> None:
    out = run("03_see_and_reach.py", "2")
    assert number(r"by the servos: ([\d.]+) mm", out) < 2.5
    # 2 degrees about joint 2 move the gripper, some 0.45 m away from its axis, by 15 mm.
    assert 10.0 < number(r"by the camera: ([\d.]+) mm", out) < 20.0
    assert "NOT REACHED" in out


def test_follow_a_marker(run: Run) -> None:
    out = run("06_follow_a_marker.py")
    assert number(r"p50 ([\d.]+) ms", out) == 50.0  # ten pictures a second: half a period
    # At 80 mm/s the marker goes 4 mm in that time, and 8 mm until the servos have followed.
    # The shadow of the gripper is on a part of the marker, and must not bias its pose.
    assert number(r"goal ([\d.]+) mm", out) < 1.5
    assert number(r"gripper ([\d.]+) mm", out) < 3.0


def test_whole_body(run: Run) -> None:
    near = table(run("04_whole_body.py"))
    assert [row[0] for row in near] == [0, 0, 1, 2, 3, 4]
    for _, name, mm, deg, met in near[:5]:
        assert mm <= 0.1 and deg <= 0.0573 and met == "yes", name
    # The posture uses only the freedom that the other goals leave.
    assert near[5][4] == "no"
    assert near[5][3] > 5.0


def test_whole_body_keeps_its_feet_if_the_hand_cannot_reach(
    capsys: pytest.CaptureFixture[str],
) -> None:
    program(EXAMPLES / "04_whole_body.py").main(1.3, -0.3, 1.2)
    far = table(capsys.readouterr().out)
    assert [row[4] for row in far[:4]] == ["yes", "yes", "yes", "no"]
    # The length of the arm and a leaning trunk are not enough.
    assert 100.0 < far[3][2] < 400.0


def test_lion(run: Run) -> None:
    rows = table(run("05_lion.py"))
    assert [row[0] for row in rows] == [0, 0, 0, 1, 2, 3, 4, 4, 4, 4]
    for _, name, mm, deg, met in rows[:6]:
        assert mm <= 0.1 and deg <= 0.0573 and met == "yes", name
    bends = {name: deg for _, name, _, deg, _ in rows[6:]}
    assert bends["tail at ease"] < 1.0 < bends["legs at ease"]


def test_poses(run: Run, tmp_path: Path) -> None:
    out = run("08_poses.py", str(tmp_path))
    assert number(r"in ([\d.]+) s", out) == pytest.approx(0.8 + 0.6 + 0.8 + 1.1 - 0.4, abs=0.3)
    assert number(r"and ([\d.]+) m high", out) == pytest.approx(1.6, abs=0.02)
    assert 1.0 < number(r"went ([\d.]+) m", out) < 2.0
    assert {path.name for path in tmp_path.iterdir()} == {"poses.toml", "motion.csv", "motion.bvh"}


def test_the_pictures_of_the_whole_body_show_what_the_examples_solve() -> None:
    pictures = program(EXAMPLES.parent / "docs" / "make" / "pictures.py")
    for name, scene in pictures.SCENES.items():
        path = EXAMPLES.parent / "docs" / "images" / f"{name}.png"
        assert path.is_file(), f"python -m docs.make.pictures {name}"
        assert cv2.imread(str(path)).shape[0] == pictures.SIZE[1]
        robot = load_robot(scene.robot)
        ball = pictures.example(scene.example).BALL
        model = pictures.with_ball(robot.path, ball)
        assert model.nq == robot.model.nq and model.ngeom == robot.model.ngeom + 1
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.geom("ball").xpos, ball)


def test_moving_figure(run: Run) -> None:
    out = run("07_moving_figure.py")
    actions = re.findall(r"^(reach|bend|jump|walk|nothing) ", out, re.MULTILINE)
    assert actions == ["reach", "bend", "walk", "reach"]
    errors = [float(mm) for mm in re.findall(r"hand is ([\d.]+) mm from the ball", out)]
    assert len(errors) == 3 and max(errors) <= 5.0


def test_learn_to_reach() -> None:
    """The training needs stable-baselines3, so this test measures a known policy."""
    import gymnasium

    example = program(EXAMPLES / "09_learn_to_reach.py")
    env = gymnasium.make("robot_ik/Reach-v0", robot="koch_v11")

    class Straight:
        def predict(self, observation, deterministic):
            offset = observation["desired_goal"] - observation["achieved_goal"]
            return np.clip(offset / 0.05, -1.0, 1.0).astype(np.float32), None

    class Still:
        def predict(self, observation, deterministic):
            return np.zeros(3, dtype=np.float32), None

    assert example.success_rate(Straight(), env, episodes=10) == 1.0
    assert example.success_rate(Still(), env, episodes=10) < 0.5
