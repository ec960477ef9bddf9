"""``robot-ik camera verify``: output, files and errors. tests/workcell tests the job."""

from __future__ import annotations

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.camera.calibration.kinematic import KnownPose
from robot_ik.camera.synthetic.pictures import STANDARD_CAMERA
from robot_ik.camera.targets import Observation, marker_points
from robot_ik.files import plain
from robot_ik.geometry import Pose
from robot_ik.hardware.config import ArmConfig
from robot_ik.robot import load_robot
from robot_ik.workcell.arm_camera import verify
from robot_ik.workcell.arm_camera.samples import SampleSet, VerifySamples
from robot_ik.workcell.arm_camera.verify import VerifyReport, VerifyRequest

CAMERA = Pose((0.75, -0.5, 0.45), (0.50099, -0.74367, -0.36714, 0.24733))
POINTS = marker_points(0.08)
INTERRUPTED = 1000
"""A seed with which the job is interrupted after its number of views."""
LOOSE_BOARD = 1001
"""A seed with which the pose of the board is known to 1 mm and 3 degrees only."""
HIDDEN = np.deg2rad([2.0, -1.5, 1.0, -2.0, 2.5, -3.0])


@pytest.fixture
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file of an arm with wrong zeros. The job is replaced by one without pictures."""
    monkeypatch.chdir(tmp_path)
    robot = load_robot("tabletop_puma")
    assert robot.arm_file is not None
    path = tmp_path / "mine.toml"
    path.write_bytes(robot.arm_file.read_bytes())
    config = ArmConfig.load(path)
    rng = np.random.default_rng(0)
    names = [joint.name for joint in config.joints if joint.group == "arm"]
    robot = load_robot("tabletop_puma", joints=names)
    exact = KnownPose.within(Pose(), 1e-4, 1e-4)
    samples = VerifySamples(
        "tabletop_puma",
        robot.joints,
        "flange",
        "eye_to_hand",
        STANDARD_CAMERA,
        camera=KnownPose.within(CAMERA, 1e-4, 1e-4),
        board=exact,
        by_arm=False,
        true_offsets=HIDDEN,
    )
    for _ in range(8):
        q = robot.clip(robot.home + 0.4 * (robot.sample(rng) - robot.home))
        seen = CAMERA.inverse().compose(robot.forward(q + HIDDEN, "flange"))
        samples.add(q, Observation(POINTS, STANDARD_CAMERA.project(seen.apply(POINTS)), seen, 0.02))

    def run(request: VerifyRequest, *, keep: Any, progress: Any) -> VerifyReport:
        sigma = (1e-3, np.deg2rad(3.0)) if request.seed == LOOSE_BOARD else request.board_sigma
        all_views = replace(samples, board=KnownPose.within(Pose(), *sigma))
        if request.seed == INTERRUPTED:
            servos = tuple(plain(joint) for joint in config.joints)
            some = replace(all_views, q=[], views=[], servos=servos)
            for q, view in zip(samples.q, samples.views, strict=True):
                if len(some) == request.views:
                    os.kill(os.getpid(), signal.SIGINT)
                    time.sleep(5.0)
                some.add(q, view)
                keep(some)
        report = VerifyReport(
            robot=robot, config=config, samples=all_views, stations=tuple(samples.q), unseen=(3,)
        )
        if not request.dry_run:
            report.compare(fit=request.fit)
        return report

    monkeypatch.setattr(verify, "run_verify", run)
    return path


def test_ctrl_c_keeps_what_was_measured_and_it_is_judged_without_moving(
    robot_ik: Any, arm: Path
) -> None:
    interrupted = ("camera", "verify", "--fit", "--seed", INTERRUPTED, "--out", "some.json")
    run = robot_ik(*interrupted, "--views", "7")
    assert run.code == 130 and run.out == "", run
    assert (
        "after 7 views" in run.err and "robot-ik camera verify --fit --samples some.json" in run.err
    )
    kept = json.loads(Path("some.json").read_text())
    assert len(kept["samples"]) == 7 and kept["job"] == "verify"
    # The same fit, and the question whether to write. Nothing moves.
    again = ("camera", "verify", "--fit", "--samples", "some.json")
    run = robot_ik(*again, "--json")
    facts = json.loads(run.out)
    assert run.code == 1 and "give your arm file with --arm" in run.err
    assert len(facts["poses"]) == 7 and facts["written"] is False
    np.testing.assert_allclose(facts["fit"]["offsets_rad"], HIDDEN, atol=np.deg2rad(0.05))
    run = robot_ik(*again, "--arm", arm, "--yes")
    assert run.code == 0 and "zero_ticks: joint1 2048 -> 2025" in run.err, run
    # With the new zeros the joint angles of the samples have another meaning.
    run = robot_ik(*again, "--arm", arm, "--yes")
    run.assert_one_screen_error()
    assert "joint 'joint1' has been changed since the arm was measured" in run.err
    # The pose of the camera was found with these intrinsics.
    replace(STANDARD_CAMERA, fx=810.0).save("other.yaml")
    run = robot_ik(*again, "--intrinsics", "other.yaml")
    run.assert_one_screen_error()
    assert "found with another calibration" in run.err and "--extrinsics" in run.err


def test_samples_of_something_else_are_reported(robot_ik: Any, arm: Path) -> None:
    SampleSet("tabletop_puma", ("joint1",), "flange", "eye_to_hand", STANDARD_CAMERA).save(
        Path("hand.json")
    )
    run = robot_ik("camera", "verify", "--samples", "hand.json")
    run.assert_one_screen_error()
    assert "and have no pose of the camera" in run.err
    gone = robot_ik("camera", "verify", "--samples", "gone.json")
    assert "gone.json: the file of samples cannot be read: No such file" in gone.err


def test_an_arm_with_errors_fails_and_names_the_regions(robot_ik: Any, arm: Path) -> None:
    run = robot_ik("camera", "verify", "--tolerance-mm", "3")
    assert run.code == 1, run
    assert "with the new zeros" not in run.out
    for words in (
        "error: mm",
        "the arm with its current zeros",
        "x <",
        "RMS mm",
        "mm, beyond the tolerance of 3 mm",
        "not seen at 4",
    ):
        assert words in run.out
    assert "offset: deg" not in run.out
    poses = run.out.split("the arm with its current zeros")[0].splitlines()
    numbers = [
        int(line.split()[0]) for line in poses if line.split()[:1] and line.split()[0].isdigit()
    ]
    assert numbers == [1, 2, 3, 5, 6, 7, 8, 9], (
        "rows are numbered as the stations that were planned"
    )
    assert robot_ik("camera", "verify", "--tolerance-mm", "60").code == 0
    facts = json.loads(robot_ik("camera", "verify", "--json").out)
    assert facts["passed"] is False and "fit" not in facts
    assert facts["regions"][0]["poses"] == len(facts["poses"]) == 8
    assert facts["regions"][0]["largest_m"] == pytest.approx(
        max(np.linalg.norm(one["off_m"]) for one in facts["poses"])
    )


def test_zeros_are_written_after_a_yes_and_only_then(
    robot_ik: Any, arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = arm.read_bytes()
    # The arm file of a bundled robot is not the user's.
    for named in ((), ("--arm", "puma560")):
        run = robot_ik("camera", "verify", "--fit", *named)
        assert run.code == 1 and "give your arm file with --arm" in run.err
    for answer in ("n", "", None):
        monkeypatch.setattr("builtins.input", lambda answer=answer: _answer(answer))
        run = robot_ik("camera", "verify", "--fit", "--arm", arm)
        assert run.code == 1 and "is not changed" in run.err
        assert arm.read_bytes() == before and list(arm.parent.iterdir()) == [arm]
    monkeypatch.setattr("builtins.input", lambda: "y")
    run = robot_ik("camera", "verify", "--fit", "--arm", arm)
    assert run.code == 0, run
    assert "zero_ticks: joint1 2048 -> 2025" in run.err
    assert "joint zeros" in run.out and "with the new zeros" in run.out
    assert (arm.parent / "mine.toml.1.bak").read_bytes() == before
    old = ArmConfig.parse(before.decode())
    new = ArmConfig.load(arm)
    pairs = zip(old.joints, new.joints, strict=True)
    moved = [b.value(2000) - a.value(2000) for a, b in pairs if a.group == "arm"]
    np.testing.assert_allclose(moved, HIDDEN, atol=np.deg2rad(0.1))


def test_json_has_all_facts_and_yes_skips_the_confirmation(robot_ik: Any, arm: Path) -> None:
    run = robot_ik("camera", "verify", "--fit", "--arm", arm, "--yes", "--json")
    assert run.code == 0, run
    facts = json.loads(run.out)
    assert facts["written"] is True and facts["passed"] is True and facts["unseen"] == [3]
    np.testing.assert_allclose(facts["fit"]["offsets_rad"], HIDDEN, atol=np.deg2rad(0.05))
    assert facts["fit"]["held"] == [] and None not in facts["fit"]["sigma_rad"]
    assert facts["fit"]["regions"][0]["largest_m"] < 1e-3 < facts["regions"][0]["largest_m"]


def test_zeros_that_explain_nothing_new_are_not_written(
    robot_ik: Any, arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VerifyReport, "better", False)
    before = arm.read_bytes()
    run = robot_ik("camera", "verify", "--fit", "--arm", arm, "--yes")
    assert run.code == 1 and "no better: nothing is written" in run.err
    assert arm.read_bytes() == before


def test_held_joints_are_reported(robot_ik: Any, arm: Path) -> None:
    run = robot_ik("camera", "verify", "--fit", "--seed", LOOSE_BOARD)
    assert (
        "the offset of joint6 and the rotation of the board about z of flange look the same"
        in run.out
    )
    assert "joint6 is held" in run.out and "joint6" not in run.err


def test_a_plan_is_printed(robot_ik: Any, arm: Path) -> None:
    run = robot_ik("camera", "verify", "--dry-run")
    assert run.code == 0 and "planned, degrees" in run.out and len(run.out.splitlines()) == 10


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--views", "3"], "--views: 3 is out of range"),
        (["--speed", "2"], "--speed: 2.0 is out of range"),
        (["--tolerance-mm", "0"], "--tolerance-mm"),
        (["--bus", "none"], "has no zeros"),
        (["--yes"], "with --fit and --arm"),
        (["--board", "plank"], "is not a board"),
        (["--board-pose", "1", "2"], "--board-pose"),
        (["--fault", "joint2"], "zero-offset:JOINT=DEG"),
        (["--fault", "zero-offset:joint2"], "zero-offset:JOINT=DEG"),
        (["--camera", "0"], "robot-ik camera locate"),
        (["--arm", "nowhere.toml"], "nowhere.toml"),
        (["--plot", "errors.xyz"], "a name that ends in .png"),
    ],
)
def test_contradicting_options_are_reported(
    robot_ik: Any, arguments: list[str], words: str
) -> None:
    run = robot_ik("camera", "verify", *arguments)
    run.assert_one_screen_error()
    assert words in run.err


def _answer(text: str | None) -> str:
    if text is None:
        raise EOFError
    return text
