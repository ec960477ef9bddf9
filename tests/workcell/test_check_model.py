"""Every command that opens an arm for a robot refuses the calibration of another model."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from robot_ik.commands.main import main
from robot_ik.hardware import open_arm
from robot_ik.hardware.calibration import CalibrationMismatchError
from robot_ik.hardware.calibration_file import Calibration, JointCalibration, calibration_beside
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.pty import PtyPort
from robot_ik.ports import RealClock
from robot_ik.robot import load_robot
from robot_ik.testbed.ar.motion import make_motion
from robot_ik.testbed.filming import arm_link
from robot_ik.workcell.robot_setup import ArmRequest, prepare_robot

ROBOT = "koch_v11"


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    """An arm file whose calibration is of a model with half the range in every joint."""
    config = replace(ArmConfig.load(ROBOT), uncalibrated=False)
    path = tmp_path / "mine.toml"
    config.save(path)
    rows = []
    for joint in config.joints:
        first, last = joint.ticks_range()
        row = JointCalibration(
            joint.name,
            joint.servo.id,
            joint.servo.model,
            drive_mode=0,
            homing_offset=0,
            range_min=first,
            range_max=last,
            direction=joint.servo.direction,
            zero_ticks=joint.servo.zero_ticks,
            urdf_lower=0.5 * math.degrees(joint.lower),
            urdf_upper=0.5 * math.degrees(joint.upper),
        )
        rows.append(row)
    Calibration(config.name, config.robot, "2026-11-27", tuple(rows)).save(calibration_beside(path))
    return path


@pytest.fixture
def port(arm_file: Path) -> Iterator[str]:
    """A serial port with simulated servos behind it, which the commands take for real ones."""
    with PtyPort(VirtualBus.from_config(ArmConfig.load(arm_file), RealClock())) as served:
        yield served.path


def test_view_refuses_the_calibration_of_another_model(arm_file: Path, port: str) -> None:
    with pytest.raises(CalibrationMismatchError):
        arm_link(ROBOT, arm_file, port).close()


def test_an_arm_without_a_robot_refuses_the_calibration_of_another_model(arm_file: Path) -> None:
    with pytest.raises(CalibrationMismatchError):
        open_arm(ArmConfig.load(arm_file), "sim")


def test_an_arm_whose_model_is_not_at_hand_is_opened_with_a_warning(
    arm_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = arm_file.read_text(encoding="utf-8")
    arm_file.write_text(text.replace(f'robot = "{ROBOT}"', 'robot = "unknown"'), encoding="utf-8")
    open_arm(ArmConfig.load(arm_file), "sim")
    assert any("unknown robot" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("bus", ["sim", "port"])
def test_jobs_refuse_the_calibration_of_another_model(arm_file: Path, port: str, bus: str) -> None:
    """``prepare_robot`` opens the arm of reach, run, camera handeye and camera verify."""
    with pytest.raises(CalibrationMismatchError):
        prepare_robot(ArmRequest(ROBOT, bus=port if bus == "port" else bus, arm_file=arm_file))


def test_ar_refuses_the_calibration_of_another_model(arm_file: Path, port: str) -> None:
    with contextlib.ExitStack() as stack, pytest.raises(CalibrationMismatchError):
        make_motion(f"{arm_file}@{port}", load_robot(ROBOT), None, stack)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "command",
    [
        "view --host 127.0.0.1:8741 --seconds 0.1 --arm ARM --bus PORT",
        "servo move shoulder_pan=5 --arm ARM --bus PORT",
        "servo torque on shoulder_pan --arm ARM --bus PORT",
        "servo record FILE --seconds 0.1 --arm ARM --bus PORT",
        f"teleop --leader ARM --leader-bus PORT --follower {ROBOT} --follower-bus sim "
        "--seconds 0.1",
        f"teleop --leader {ROBOT} --leader-bus sim --follower ARM --follower-bus PORT "
        "--seconds 0.1",
    ],
    ids=["view", "move", "torque", "teach", "teleop, leader", "teleop, follower"],
)
def test_commands_refuse_the_calibration_of_another_model(
    arm_file: Path, port: str, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    values = {"ARM": str(arm_file), "PORT": port, "FILE": str(arm_file.with_name("taught.csv"))}
    words = [values.get(word, word) for word in command.split()]
    assert main(words) in (1, 2)
    assert "the model is not the one of the calibration" in " ".join(
        capsys.readouterr().err.split()
    )
