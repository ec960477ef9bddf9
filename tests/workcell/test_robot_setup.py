"""Robot setup: joint limits, joints with servos, faults, and torque after an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_ik.commands.main import main
from robot_ik.errors import ConfigError, OptionError, UnsupportedJointError
from robot_ik.hardware.config import ArmConfig
from robot_ik.ports import VirtualClock
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.workcell.jog import KeyboardJog
from robot_ik.workcell.robot_setup import ArmRequest, Rehearsal, joints_that_move, prepare_robot


def arm_text() -> str:
    file = load_robot("puma560").arm_file
    assert file is not None
    return file.read_text()


@pytest.mark.parametrize("bus", ["sim", "none"])
def test_the_narrower_limit_applies(bus: str, tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(arm_text().replace("upper_deg = 160.0", "upper_deg = 45.0", 1))
    setup = prepare_robot(ArmRequest(bus=bus, arm_file=file))
    first = setup.limits[0]
    others = setup.limits[1:]
    assert np.rad2deg(setup.robot.upper[0]) == pytest.approx(45.0, abs=0.1)
    assert first.used[1] == setup.robot.upper[0] < first.model[1]
    assert first.servo is not None
    for limit, low, high in zip(others, setup.robot.lower[1:], setup.robot.upper[1:], strict=True):
        assert limit.used == (low, high)
        assert limit.servo is not None
        assert low == max(limit.model[0], limit.servo[0])
        assert high == min(limit.model[1], limit.servo[1])


def test_without_a_bus_the_limits_of_the_model_apply() -> None:
    setup = prepare_robot(ArmRequest(bus="none"))
    assert all(limit.used == limit.model and limit.servo is None for limit in setup.limits)
    assert setup.arm is None
    assert isinstance(setup.clock, VirtualClock)
    assert not setup.resolution.any()


def test_fingers_get_no_servo_and_are_no_degrees_of_freedom(arms: dict[str, Path]) -> None:
    robot = load_robot(arms["desk"])
    arm_joints = ("waist", "shoulder", "elbow", "wrist")
    assert len(robot.joints) == 6
    assert joints_that_move(robot, "ee") == arm_joints
    assert joints_that_move(robot, "left") == (*arm_joints, "left_finger")
    assert joints_that_move(robot, "turn") == ("waist",)
    for bus in ("sim", "none"):
        setup = prepare_robot(ArmRequest(robot=str(arms["desk"]), bus=bus))
        assert setup.robot.joints == arm_joints
        assert setup.dof == 4


def test_a_slide_that_moves_the_tool_has_no_generic_servo(arms: dict[str, Path]) -> None:
    request = ArmRequest(robot=str(arms["desk"]), bus="sim", frame="left")
    with pytest.raises(UnsupportedJointError, match="left_finger"):
        prepare_robot(request)
    setup = prepare_robot(ArmRequest(robot=str(arms["desk"]), bus="none", frame="left"))
    assert [limit.unit for limit in setup.limits] == ["rad"] * 4 + ["m"]


def test_the_name_of_a_robot_selects_its_arm_file() -> None:
    request = ArmRequest(robot="tabletop_puma", bus="sim", arm_file=Path("tabletop_puma"))
    setup = prepare_robot(request)
    assert setup.config is not None
    assert setup.config.file == load_robot("tabletop_puma").arm_file


@pytest.mark.parametrize("robot", ["nowhere.xml", "puma56"])
@pytest.mark.parametrize(
    "command", ["reach --bus none --arm", "sim-bus --physics --arm", "ar --motion"]
)
def test_the_error_for_an_unknown_robot_names_the_arm_file(
    command: str,
    robot: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "mine.toml"
    text = (catalogue()["puma560"] / "arm.toml").read_text(encoding="utf-8")
    file.write_text(text.replace('robot = "puma560"', f'robot = "{robot}"'), encoding="utf-8")
    assert main([*command.split(), str(file)]) == 2
    message = capsys.readouterr().err
    assert f"{file}: robot: " in message
    assert robot in message
    with pytest.raises(ConfigError, match=r"mine\.toml: robot: "):
        KeyboardJog(ArmConfig.load(file), str)


def test_an_arm_file_may_omit_joints_but_not_name_unknown_joints(tmp_path: Path) -> None:
    blocks = arm_text().split("[[joints]]")
    file = tmp_path / "arm.toml"
    file.write_text("[[joints]]".join(blocks[:4]))  # joint1 to joint3
    setup = prepare_robot(ArmRequest(bus="sim", arm_file=file))
    assert setup.robot.joints == ("joint1", "joint2", "joint3")

    # The order of the joints in the file has no effect.
    file.write_text("[[joints]]".join([blocks[0], *reversed(blocks[1:])]))
    setup = prepare_robot(ArmRequest(bus="sim", arm_file=file))
    assert setup.config is not None
    assert setup.config.names == setup.robot.joints

    file.write_text(arm_text().replace('"joint6"', '"joint9"'))
    for bus in ("sim", "none"):
        with pytest.raises(ConfigError, match="joint9"):
            prepare_robot(ArmRequest(bus=bus, arm_file=file))


@pytest.mark.parametrize("bus", ["none", "/dev/ttyUSB9"])
def test_faults_are_rejected_without_simulated_servos(bus: str) -> None:
    with pytest.raises(OptionError, match="simulated"):
        prepare_robot(ArmRequest(bus=bus, rehearsal=Rehearsal(stuck=("joint1",))))


def test_torque_is_on_from_enable_torque_until_the_block_ends_with_an_error() -> None:
    setup = prepare_robot(ArmRequest(bus="sim"))
    assert setup.arm is not None
    assert setup.arm.bus.virtual_bus is not None
    servos = setup.arm.bus.virtual_bus.servos
    with pytest.raises(RuntimeError), setup.connected():
        assert not any(servo.torque for servo in servos)
        setup.enable_torque()
        assert all(servo.torque for servo in servos)
        raise RuntimeError
    assert not any(servo.torque for servo in servos)


def test_the_true_positions_include_a_zero_offset_of_the_servo() -> None:
    faults = Rehearsal(zero_offset_deg={"joint3": 2.0})
    setup = prepare_robot(ArmRequest(bus="sim", rehearsal=faults))
    with setup.connected():
        offset_deg = np.rad2deg(setup.true_q() - setup.q)
    assert abs(offset_deg[2]) == pytest.approx(2.0, abs=0.2)
    assert np.abs(np.delete(offset_deg, 2)).max() < 0.1
