"""``robot-ik poses``: record, list, play, export, import."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.figure.motion.bvh import Bvh, exported_motion
from robot_ik.motion import Keyframes, KeyPoses
from robot_ik.robot import load_robot


def test_the_poses_that_ship_are_listed(robot_ik: Any) -> None:
    run = robot_ik("poses", "list")
    assert run.code == 0 and "walk" in run.out and "stand" in run.out and "crouch" in run.out
    facts = json.loads(robot_ik("poses", "list", "--json").out)
    assert facts["robot"] == "humanoid" and len(facts["poses"]["stand"]) == load_robot("humanoid").nq
    assert facts["motions"]["jump"]["poses"][1] == "crouch"


def test_poses_are_recorded_by_joints_by_reaching_and_from_frames(robot_ik: Any, tmp_path: Path) -> None:
    file, robot = tmp_path / "my.toml", load_robot("humanoid")
    words = ("poses", "record", file)
    run = robot_ik(*words, "squat", "--begin", "squat")
    assert run.code == 0 and run.err.endswith("which has 1 pose\n")
    assert robot_ik(*words, "wave", "--set", "left_elbow_pitch=90", "head_yaw=-20").code == 0
    assert robot_ik(*words, "up", "--begin", "wave", "--reach", "right_hand", 0.3, -0.3, 1.6).code == 0
    book = KeyPoses.load(file, robot)
    elbow = robot.tree.qadr[robot.joints.index("left_elbow_pitch")]
    assert book["wave"][elbow] == pytest.approx(np.pi / 2)
    assert np.abs(robot.measure(book["up"], "right_hand").position - [0.3, -0.3, 1.6]).max() < 1e-4
    assert robot.measure(book["up"], "left_foot").distance(robot.measure(book["wave"], "left_foot"))[0] < 1e-4
    Keyframes(robot, [0.0, 1.0], [book["squat"], book["up"]]).save_csv(tmp_path / "clip.csv")
    assert robot_ik(*words, "later", "--frames", tmp_path / "clip.csv", "--at", "0.5").code == 0
    assert len(KeyPoses.load(file, robot).poses) == 4
    run = robot_ik(*words, "far", "--reach", "right_hand", 5, 0, 1)
    assert run.code == 1 and "out of reach" in run.err and "far" not in KeyPoses.load(file, robot).poses


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("record", "my.toml", "a", "--begin", "squad"), "did you mean squat"),
        (("record", "my.toml", "a", "--set", "left_elbow=90"), "left_elbow_pitch"),
        (("record", "my.toml", "a", "--set", "left_elbow_pitch=much"), "HINGE=DEGREES"),
        (
            ("record", "my.toml", "a", "--set", "left_elbow_pitch=300"),
            "pose: joint 'left_elbow_pitch' at 300 deg is outside its limits; allowed: 0 to 150 deg",
        ),
        (("record", "my.toml", "a", "--reach", "right_hand", "1"), "FRAME X Y Z"),
        (("export", "walk", "walk.txt"), ".csv or .bvh"),
        (("export", "wlak", "walk.csv"), "did you mean walk"),
        (("export", "walk", "walk.csv", "--robot", "puma560"), "no key poses ship with 'puma560'"),
        (("list", "none.toml"), "cannot be read"),
        (("import", "none.bvh", "clip.csv"), "cannot be read"),
        (("play", "walk", "--times", "0"), "1 or more"),
        (("play", "walk", "--rate", "nan"), "--rate: nan Hz; allowed: above 0"),
        (("export", "walk", "walk.csv", "--rate", "0"), "--rate: 0 Hz; allowed: above 0"),
        (("export", "walk", "walk.csv", "--rate=-3"), "--rate: -3 Hz; allowed: above 0"),
        (("export", "walk", "walk.csv", "--speed", "0"), "--speed: 0 is no share"),
        (("import", "none.bvh", "clip.csv", "--rate=-3"), "--rate: -3 Hz"),
    ],
)
def test_what_is_wrong_is_said(
    words: tuple[str, ...], says: str, robot_ik: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = robot_ik("poses", *words)
    run.assert_one_screen_error()
    assert says in " ".join(run.err.split()), run.err


def test_a_file_knows_whose_poses_it_holds(robot_ik: Any, tmp_path: Path) -> None:
    """Without --robot it is that of the file; a name that is taken is answered with the option that helps."""
    file, out = tmp_path / "my.toml", tmp_path / "up.csv"
    assert robot_ik("poses", "record", file, "up", "--robot", "puma560", "--set", "joint1=30").code == 0
    assert robot_ik("poses", "record", file, "down", "--set", "joint1=-30").code == 0
    assert json.loads(robot_ik("poses", "list", file, "--json").out)["robot"] == "puma560"
    assert robot_ik("poses", "export", "up", out, "--file", file).code == 0
    assert Keyframes.load_csv(out, load_robot("puma560")).q[0, 0] == pytest.approx(np.pi / 6)
    run = robot_ik("poses", "record", file, "up")
    run.assert_one_screen_error()
    assert "another name, or --replace" in run.err and "True" not in run.err
    file.write_text(file.read_text().replace("puma560", "my_arm"))
    run = robot_ik("poses", "list", file)
    run.assert_one_screen_error()
    assert "my.toml: robot: no robot of the catalogue is called 'my_arm'" in " ".join(run.err.split())
    assert "--robot PATH" in run.err


def test_a_motion_is_exported_and_imported(robot_ik: Any, tmp_path: Path) -> None:
    robot = load_robot("humanoid")
    out = tmp_path / "walk.bvh"
    assert robot_ik("poses", "export", "walk", out, "--rate", "20").code == 0
    assert robot_ik("poses", "export", "walk", tmp_path / "walk.csv", "--rate", "20").code == 0
    frames = Keyframes.load_csv(tmp_path / "walk.csv", robot)
    own = exported_motion(Bvh.load(out), robot)
    off = [np.abs(robot.difference(a, b)).max() for a, b in zip(frames.q, own.q, strict=True)]
    assert max(off) < 1e-10
    refused = robot_ik("poses", "export", "walk", out)
    refused.assert_one_screen_error()
    assert "--overwrite" in refused.err
    run = robot_ik("poses", "import", out, tmp_path / "taken.csv", "--rate", "10")
    assert run.code == 0 and "hands off" in run.err.replace("\n", " ")
    taken = Keyframes.load_csv(tmp_path / "taken.csv", robot)
    assert taken.duration == pytest.approx(frames.duration, abs=0.15)
    way = [motion.q[-1, 0] - motion.q[0, 0] for motion in (frames, taken)]
    assert way[1] == pytest.approx(way[0], rel=0.1)
