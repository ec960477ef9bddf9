"""``robot-ik reach`` as a user meets it: exit codes, errors, written files."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE
from typing import Any

import cv2
import numpy as np
import pytest

from robot_ik.commands.main import parse_command
from robot_ik.commands.reach import Reach
from robot_ik.motion import Trajectory
from robot_ik.ports import RealClock
from robot_ik.robot import load_robot
from tests.waiting import wait_for

GOAL = ("--goal", "-0.42", "-0.08", "0.80")
SIM = ("--bus", "sim")


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test in an empty folder."""
    monkeypatch.chdir(tmp_path)


def left(folder: Path) -> list[str]:
    """Every file and folder below."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_complete_reach_through_a_real_serial_line(
    robot_ik_child: Any, tmp_path: Path, real_time: None
) -> None:
    run = robot_ik_child("reach", "--out", tmp_path / "run")
    assert run.code == 0, run
    for text in (
        "marker 7",
        "analytic: converged",
        "tracking error",
        "cycles",
        "read back",
        "3 σ",
        "REACHED",
        "joint6",
    ):
        assert text in run.out, text
    assert "\x1b" not in run.out + run.err and "Traceback" not in run.err
    assert left(tmp_path) == ["run", "run/reach.png", "run/summary.json", "run/trajectory.csv"]
    facts = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert facts["reached"] and facts["bus"] == "pty" and facts["bus_counters"]["cycles"] > 100
    assert facts["bus_counters"]["bytes_received"] > 10_000
    picture = cv2.imread(str(tmp_path / "run" / "reach.png"))
    assert picture.shape[1] > 1000


def test_stdout_has_only_the_json_object(robot_ik: Any, tmp_path: Path) -> None:
    run = robot_ik("reach", *SIM, *GOAL, "--json")
    facts = json.loads(run.out)
    assert run.code == 0 and facts["reached"] and run.out.startswith("{")
    assert (tmp_path / facts["folder"] / "summary.json").is_file()
    assert facts["goal"]["position"] == [-0.42, -0.08, 0.80]


def test_no_line_is_wider_than_a_terminal(robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    run = robot_ik("reach", *SIM, *GOAL)
    lines = [line for line in run.out.splitlines() if not line.startswith("files")]
    assert run.code == 0 and max(map(len, lines)) <= 80


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--fault", "zero-offset:joint4=2"], "NOT REACHED"),
        (["--fault", "stuck:joint3"], "joint3"),
        (["--fault", "cover-gripper"], "unproven"),
    ],
)
def test_what_must_not_pass(arguments: list[str], expected: str, robot_ik: Any) -> None:
    run = robot_ik("reach", *SIM, *arguments)
    assert run.code == 1 and expected in run.out and "NOT REACHED" in run.out


def test_an_unreachable_goal(robot_ik: Any) -> None:
    run = robot_ik("reach", *SIM, "--goal", 9, 0, 0, "--json")
    facts = json.loads(run.out)
    assert (
        run.code == 1 and facts["solution"]["status"] == "unreachable" and facts["motion"] is None
    )
    assert facts["solution"]["miss_position_m"] > 7 and len(facts["solution"]["q"]) == 6
    assert "nearest" in run.err and "Traceback" not in run.err


def test_a_solution_within_the_uncertainty_of_the_marker_is_accepted(
    arms: dict[str, Path], robot_ik: Any
) -> None:
    """The marker is measured beside the plane of the arm, within its standard deviation."""
    run = robot_ik("reach", "--bus", "none", "--robot", arms["planar"], "--out", "planar")
    solver = next(line for line in run.out.splitlines() if line.startswith("solver"))
    error = next(line for line in run.out.splitlines() if line.startswith("error"))
    assert run.code == 0 and "result     REACHED" in run.out
    assert "exact goal not met (" in solver
    assert "; allowed " in error and "(3 σ of the marker)" in error


def test_a_missing_marker(robot_ik: Any) -> None:
    run = robot_ik("reach", *SIM, "--fault", "blank-marker")
    assert run.code == 1 and "marker 7" in run.err and "in view: 20, 23" in run.err


def arm_file(tmp_path: Path, old: str, new: str) -> Path:
    file = load_robot("puma560").arm_file
    assert file is not None
    (tmp_path / "arm.toml").write_text(file.read_text().replace(old, new, 1))
    return tmp_path / "arm.toml"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--robot", "pumma560"], ["'puma560'"]),
        (["--solver", "lmm"], ["'lm'"]),
        (["--frame", "griper"], ["'gripper'"]),
        (["--goal", "nan", "0", "0"], ["finite"]),
        (["--goal", "0", "0", "0", "0", "0", "0", "0"], ["zero quaternion"]),
        (["--goal", "1", "2"], ["2 numbers"]),
        (["--camera", "nowhere.png", "--marker-size", "0.1"], ["--intrinsics"]),
        (["--bus", "/dev/robot_ik_nowhere"], ["no such port"]),
        (["--bus", "/dev/null"], ["not a serial port"]),
        (["--bus", "plain.txt"], ["not a serial port"]),
        (["--arm", "nowhere.toml"], ["nowhere.toml"]),
        (["--arm", "nowhere"], ["unknown robot 'nowhere'", "the name of a robot that has one"]),
        (["--arm", "ur5e"], ["without an arm file"]),
        (["--out", "plain.txt"], ["plain.txt", "cannot write"]),
        (["--out", "plain.txt/deeper"], ["cannot write"]),
        (["--speed", "0"], ["--speed", "above 0"]),
        (["--speed", "1.01"], ["--speed"]),
        (["--speed", "nan"], ["--speed"]),
        (["--follow", "0"], ["--follow", "above 0"]),
        (["--follow", "1", *GOAL], ["--follow", "without --goal"]),
        (["--follow", "1", "--avoid"], ["--follow", "without --scene"]),
        (["--follow", "1", "--video", "a.mp4"], ["--video", "without --follow"]),
        (["--avoid", "--line"], ["--line", "without --avoid"]),
        (["--camera", "0", "--extrinsics", "a.toml"], ["--extrinsics", "--intrinsics FILE"]),
        (["--extrinsics", "a.toml"], ["--extrinsics", "synthetic camera", "a real --camera"]),
        (["--fault", "gone"], ["--fault", "stuck:JOINT"]),
        (["--intrinsics", "camera.yaml"], ["--intrinsics", "synthetic camera"]),
        ([*SIM, "--fault", "stuck:joint9"], ["joint9", "joint6"]),
        ([*SIM, "--fault", "zero-offset:joint2"], ["--fault", "zero-offset:JOINT=DEG"]),
        ([*SIM, "--fault", "zero-offset:joint2=nan"], ["--fault"]),
        ([*SIM, "--marker-at", "1", "2"], ["--marker-at", "X Y Z"]),
        ([*SIM, "--marker-at", "1", "2", "nan"], ["--marker-at"]),
        (["--bus", "none", "--fault", "stuck:joint1"], ["simulated"]),
        ([*SIM, "--dictionary", "DICT_9"], ["DICT_5X5_50"]),
        ([*SIM, "--marker", "99"], ["99", "0 to 49"]),
    ],
)
def test_wrong_input(arguments: list[str], named: list[str], robot_ik: Any, tmp_path: Path) -> None:
    (tmp_path / "plain.txt").write_text("no port, no folder")
    run = robot_ik("reach", *arguments)
    run.assert_one_screen_error()
    for text in named:
        assert text in run.err, run.err
    assert left(tmp_path) == ["plain.txt"]


def test_a_broken_model_names_file_and_reason(robot_ik: Any, tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text(
        '<mujoco><worldbody><body><joint type="hindge"/></body></worldbody></mujoco>'
    )
    run = robot_ik("reach", "--robot", "broken.xml")
    run.assert_one_screen_error()
    assert "broken.xml" in run.err and "hindge" in run.err


def test_an_arm_file_with_an_unknown_key(robot_ik: Any, tmp_path: Path) -> None:
    file = arm_file(tmp_path, "velocity_deg = 90.0", "velocty_deg = 90.0")
    run = robot_ik("reach", "--arm", file)
    run.assert_one_screen_error()
    assert "arm.toml" in run.err and "velocty_deg" in run.err and "velocity_deg" in run.err
    assert left(tmp_path) == ["arm.toml"]


def test_pictures_for_another_calibration(robot_ik: Any, tmp_path: Path) -> None:
    from robot_ik.camera.intrinsics import CameraIntrinsics

    CameraIntrinsics(640, 480, 600.0, 600.0, 319.5, 239.5).save(tmp_path / "camera.yaml")
    cv2.imwrite("small.png", np.full((120, 160, 3), 200, np.uint8))
    run = robot_ik(
        "reach",
        *SIM,
        "--camera",
        "small.png",
        "--intrinsics",
        "camera.yaml",
        "--marker-size",
        ".05",
    )
    run.assert_one_screen_error()
    assert "640x480" in run.err and "160x120" in run.err
    cv2.imwrite("right.png", np.full((480, 640, 3), 200, np.uint8))
    run = robot_ik(
        "reach",
        *SIM,
        "--camera",
        "right.png",
        "--intrinsics",
        "camera.yaml",
        "--marker-size",
        ".05",
    )
    assert run.code == 1 and "no marker of that dictionary" in run.err


def test_a_window_needs_a_display(
    robot_ik: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if sys.platform != "linux":
        pytest.skip("only X and Wayland tell beforehand")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    run = robot_ik("reach", *SIM, "--viewer")
    run.assert_one_screen_error()
    assert "DISPLAY" in run.err and left(tmp_path) == []


@pytest.mark.parametrize(
    ("bus", "old", "new", "by"),
    [
        ("sim", "upper_deg = 160.0", "upper_deg = 100.0", "the arm file"),
        ("none", "upper_deg = 160.0", "upper_deg = 100.0", "the arm file"),
        ("sim", "zero_ticks = 2048", "zero_ticks = 3000", "the servo's mode"),
    ],
)
def test_the_table_of_limits_names_the_narrowed_side_and_the_cause(
    bus: str, old: str, new: str, by: str, robot_ik: Any, tmp_path: Path
) -> None:
    file = arm_file(tmp_path, old, new)
    run = robot_ik("reach", "--bus", bus, *GOAL, "--arm", file)
    line = next(line for line in run.out.splitlines() if line.startswith("joint1"))
    assert run.code == 0 and f"upper end by {by} (model: 160.0°)" in line and "lower" not in line
    line = next(line for line in run.out.splitlines() if line.startswith("joint2"))
    assert "end" not in line


@pytest.mark.parametrize(
    ("number", "code", "expected"),
    [
        pytest.param(signal.SIGINT, 130, "interrupted", marks=pytest.mark.soak),
        (signal.SIGTERM, 143, "terminated"),
    ],
)
def test_a_signal_in_mid_motion_leaves_the_arm_without_torque(
    number: int, code: int, expected: str, tmp_path: Path, real_time: None
) -> None:
    """Asked of the servos themselves, which live in this process."""
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.hardware.virtual.pty import PtyPort

    file = load_robot("puma560").arm_file
    assert file is not None
    servos = VirtualBus.from_config(config := ArmConfig.load(file), RealClock())
    with PtyPort(servos) as port:
        begin = servos.true_angles(config)
        # The motion takes a minute at this speed.
        words = ["reach", "--robot", "puma560", *GOAL, "--speed", "0.01", "--bus", port.path]
        command = [sys.executable, "-m", "robot_ik", *words]
        with subprocess.Popen(command, stdout=PIPE, stderr=PIPE, text=True) as run:
            try:
                wait_for(
                    lambda: np.abs(servos.true_angles(config) - begin).max() > 0.02,
                    "it does not move",
                )
                assert [servo.torque for servo in servos.servos] == [True] * 6
                run.send_signal(number)
                out, err = run.communicate()
            finally:
                run.kill()
        assert run.returncode == code, err
        assert out == "" and err.replace("reach …\n", "").splitlines() == [
            "torque is off",
            expected,
        ]
        assert [servo.torque for servo in servos.servos] == [False] * 6
    assert not (tmp_path / "runs").exists()


def test_the_default_robot(tmp_path: Path) -> None:
    """A port selects the arm with real servos, an arm file its robot, all else the PUMA 560."""
    for bus in ("pty", "sim", "none"):
        assert Reach(bus=bus).robot_name == "puma560"
    assert Reach(bus="/dev/ttyUSB0").robot_name == "tabletop_puma"
    assert Reach(bus="/dev/ttyUSB0", robot="ur5e").robot_name == "ur5e"
    assert Reach(arm="omx_f").robot_name == "omx_f"
    other = arm_file(tmp_path, 'robot = "puma560"', 'robot = "panda"')
    for bus in ("sim", "/dev/ttyUSB0"):
        assert Reach(bus=bus, arm=str(other)).robot_name == "panda"


@pytest.mark.parametrize(
    "line", ["--fault stuck:joint3 cover-gripper", "--fault stuck:joint3 --fault cover-gripper"]
)
def test_several_faults_are_given_together_or_one_at_a_time(line: str) -> None:
    _, reach = parse_command(["reach", *line.split()])
    assert reach.fault == ("stuck:joint3", "cover-gripper")


def test_simulated_servos_and_a_reach_at_their_port_mean_the_same_arm(
    robot_ik: Any, tmp_path: Path, real_time: None
) -> None:
    port = tmp_path / "arm"
    program = [sys.executable, "-m", "robot_ik", "sim-bus", "--link", str(port)]
    servos = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(port.exists)
        run = robot_ik("reach", "--bus", port, "--json")
        facts = json.loads(run.out)
        assert (run.code, facts["robot"]["name"]) == (0, "tabletop_puma"), run.err
        assert facts["reached"] and facts["by_camera"] is None
    finally:
        servos.send_signal(signal.SIGINT)
        servos.communicate()


def test_joints_that_are_not_named_stay(robot_ik: Any, tmp_path: Path) -> None:
    out = tmp_path / "run"
    joints = ("--joints", "joint1", "joint2", "joint3")
    run = robot_ik("reach", *SIM, *GOAL, *joints, "--out", out)
    assert run.code == 0, run
    motion = Trajectory.load_csv(out / "trajectory.csv")
    moved = {name for name, q in zip(motion.joints, motion.q.T, strict=True) if np.ptp(q) > 1e-6}
    assert moved and moved <= {"joint1", "joint2", "joint3"}
    run = robot_ik("reach", *SIM, *GOAL, "--base", "link2", "--line")
    assert run.code == 2 and "--joints" in run.err
