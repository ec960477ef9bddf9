"""LeRobot's calibration procedure on simulated STS servos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware import open_bus, simulated_servos
from robot_ik.hardware.arm_registers import read_all
from robot_ik.hardware.calibration import CalibrationMismatchError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import Joint
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.lerobot.calibration import (
    FULL_TURN,
    calibrate_by_hand,
    check_offsets,
    homing_offset,
    nominal,
    save,
    with_calibration,
)
from robot_ik.ports import VirtualClock


@pytest.fixture
def config() -> ArmConfig:
    return ArmConfig.load("so101")


def _limits(config: ArmConfig) -> dict[str, tuple[float, float]]:
    return {joint.name: (joint.lower, joint.upper) for joint in config.joints}


class Person:
    """Moves the shafts: to the middle first, then to both ends of every joint."""

    def __init__(self, config: ArmConfig, servos: VirtualBus) -> None:
        self.config = config
        self.servos = servos
        self.texts: list[str] = []
        self.positions = {joint.name: joint.position(0.0) for joint in config.joints}

    def wait(self, text: str, meanwhile: Callable[[], None]) -> None:
        self.texts.append(text)
        for share in (0.5,) if len(self.texts) == 1 else (0.0, 1.0, 0.5):
            for joint in self.config.joints:
                value = joint.lower + share * (joint.upper - joint.lower)
                self._rotate(joint, joint.position(value))
            meanwhile()

    def _rotate(self, joint: Joint, position: float) -> None:
        change = position - self.positions[joint.name]
        self.servos.servo(joint.servo.id).rotate_by_hand(change)
        self.positions[joint.name] = position


def test_homing_offset_brings_the_present_position_to_the_middle() -> None:
    assert homing_offset(2047) == 0
    assert homing_offset(3000) == 953
    assert homing_offset(-9000) == -2047


def test_calibration_by_hand_is_written_and_used(config: ArmConfig, tmp_path: Path) -> None:
    home = {joint.name: 0.0 for joint in config.joints}
    servos = simulated_servos(config, VirtualClock(), home)
    bus = open_bus("sim", config, virtual_bus=servos)
    person = Person(config, servos)
    motors = calibrate_by_hand(bus, config, person.wait)
    assert "wrist_roll" in person.texts[1]
    assert (motors["wrist_roll"].range_min, motors["wrist_roll"].range_max) == FULL_TURN
    offsets = read_all(bus, config, "homing_offset")
    for joint in config.joints:
        assert offsets[joint.servo.id] == motors[joint.name].homing_offset
    check_offsets(bus, config, {name: motor.homing_offset for name, motor in motors.items()})
    with pytest.raises(CalibrationMismatchError, match="elbow_flex"):
        check_offsets(bus, config, {"elbow_flex": motors["elbow_flex"].homing_offset + 1})

    path = tmp_path / "arm.json"
    save(path, motors)
    calibrated = with_calibration(config, path, _limits(config))
    present = read_all(bus, config, "present_position")
    assert not calibrated.uncalibrated
    for joint in calibrated.joints:
        # A joint without end stops has q = 0 where the person held it.
        middle = 0.0 if joint.name == "wrist_roll" else 0.5 * (joint.lower + joint.upper)
        ticks = present[joint.servo.id]
        assert joint.value(ticks) == pytest.approx(middle, abs=0.02)


def test_procedure_is_refused_for_dynamixel_servos() -> None:
    config = ArmConfig.load("koch_v11")
    bus = open_bus("sim", config)
    with pytest.raises(ConfigError, match="Feetech"):
        calibrate_by_hand(bus, config, lambda text, meanwhile: None)


def test_nominal_ranges_are_those_of_the_arm_file(config: ArmConfig) -> None:
    motors = nominal(config)
    assert list(motors) == list(config.names)
    pan = config.joint("shoulder_pan")
    ends = sorted(pan.position(value) for value in pan.limits)
    assert motors["shoulder_pan"].range_min == pytest.approx(ends[0], abs=1.0)
    assert motors["shoulder_pan"].range_max == pytest.approx(ends[1], abs=1.0)
