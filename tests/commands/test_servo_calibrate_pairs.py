"""Calibration in process of joints that two servos turn, and of slides."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.errors import ConfigError, HardwareError
from robot_ik.hardware import open_arm
from robot_ik.hardware.calibration import (
    CalibrationMismatchError,
    calibrated,
    check_calibration,
    check_model,
)
from robot_ik.hardware.calibration_file import Calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import load_lerobot, save_lerobot
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct, Pinion
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from robot_ik.workcell.hand_calibration import calibrate_by_hand
from tests.hardware.joints import Twin, make_joint, with_servo, with_twin

MODE = OperatingMode.EXTENDED_POSITION
LIFT = make_joint("lift", 1, "XM430-W350", MODE, -1, 1500, -2.0, 2.0, 1.0, 4.0, gear=Direct(2.0))
RACK = make_joint("rack", 2, "XL330-M288", MODE, -1, 700, 0.0, 0.03, 0.05, 0.4, gear=Pinion(0.008))
OWN = Twin(3, direction=1, zero_ticks=2600)
SHADOW = Twin(3, shadow=True)
LIMITS = {"lift": (-2.0, 2.0), "rack": (0.0, 0.03)}
REACH = {"lift": (-1.5, 1.5), "rack": (0.0, 0.025)}


def true_arm(twin: Twin) -> ArmConfig:
    joints = (with_twin(LIFT, twin), RACK)
    return ArmConfig("pairs", "none", 1_000_000, 100.0, 200, "torque_off", joints, stale_ms=0)


def unknown_arm(true: ArmConfig) -> ArmConfig:
    """The same arm file before zeros and directions are measured."""
    joints = tuple(with_servo(joint, direction=1, zero_ticks=2048) for joint in true.joints)
    return dataclasses.replace(true, joints=joints)


class Hand:
    """Carries out each step, and samples meanwhile."""

    def __init__(self, true: ArmConfig, bus: VirtualBus, slip: float = 1.0) -> None:
        self.true = true
        self.bus = bus
        self.slip = slip
        self.q = {joint.name: 0.0 for joint in true.joints}

    def put(self, name: str, q: float, sample: Callable[[], object]) -> None:
        for part in np.linspace(self.q[name], q, 12):
            joint = self.true.joint(name)
            for servo in joint.servos:
                way = joint.position(part, servo) - joint.position(self.q[name], servo)
                self.bus.servo(servo.id).rotate_by_hand(way * (self.slip if servo.id == 3 else 1.0))
            self.q[name] = part
            sample()

    def step(self, text: str, sample: Callable[[], object]) -> None:
        for joint in self.true.joints:
            if text[0] == "1":
                for q in REACH[joint.name]:
                    self.put(joint.name, q, sample)
            elif text[0] == "2":
                self.put(joint.name, 0.0, sample)
            elif joint.name in text:
                self.put(joint.name, 0.2 * joint.lever, sample)

    def note(self, text: str) -> None:
        pass

    def again(self, error: Exception) -> bool:
        return False


def measured(
    twin: Twin, slip: float = 1.0, fault: Callable[[VirtualBus], object] = lambda bus: 0
) -> Any:
    true = true_arm(twin)
    bus = VirtualBus.from_config(true, VirtualClock())
    fault(bus)
    arm = open_arm(unknown_arm(true), "sim", virtual_bus=bus)
    with arm:
        found = calibrate_by_hand(arm, Hand(true, bus, slip), dict.fromkeys(REACH, 0.0), LIMITS)
        made = calibrated(arm.config, found)
        check_calibration(arm.bus, made, found)
    return true, bus, found, made


@pytest.mark.parametrize("twin", [OWN, SHADOW], ids=["two ids", "shadow id"])
def test_both_servos_of_a_joint_and_a_slide_are_found(twin: Twin, tmp_path: Path) -> None:
    true, bus, found, made = measured(twin)
    for mine, truth in zip(made.servos, true.servos, strict=True):
        assert (mine.id, mine.direction, mine.primary_id) == (
            truth.id,
            truth.direction,
            truth.primary_id,
        )
        assert mine.zero_ticks == pytest.approx(truth.zero_ticks, abs=2)
    for joint in made.joints:
        assert (joint.lower, joint.upper) == pytest.approx(
            REACH[joint.name], abs=3 * joint.resolution
        )
    path = tmp_path / "pairs.calibration.toml"
    found.save(path)
    assert dataclasses.replace(Calibration.load(path), file=None) == found
    assert [row.id for row in found.rows] == [1, 2, 3] and found.twins[0].name == "lift"
    assert found.joints[1].urdf_upper == pytest.approx(30.0)  # mm
    made.save(tmp_path / "pairs.toml")
    again = ArmConfig.load(tmp_path / "pairs.toml")
    with open_arm(again, "sim", virtual_bus=bus) as arm:  # both agree, or it would refuse
        arm.enable()
        arm.move_to({"lift": -0.5, "rack": 0.01})
    assert bus.true_angles(true) == pytest.approx([-0.5, 0.01], abs=0.005)


def test_two_servos_that_slip_are_refused() -> None:
    with pytest.raises(
        HardwareError, match=r"two servos of joint 'lift' do not turn together: id 1 by 17"
    ):
        measured(OWN, slip=0.8)


def test_a_shadow_that_counts_the_other_way_is_refused() -> None:
    def reverse(bus: VirtualBus) -> None:
        bus.servo(3).rotate_by_hand(300)

    with pytest.raises(
        HardwareError, match=r"shadow of joint 'lift' \(servo id 3\) stands 13\.2 deg beside"
    ):
        measured(SHADOW, fault=reverse)
    with pytest.raises(HardwareError, match="counts the other way round"):
        measured(SHADOW, slip=-1.0)


def test_a_swapped_second_servo_is_a_mismatch() -> None:
    _, bus, found, made = measured(OWN)
    other = with_twin(made.joints[0], dataclasses.replace(OWN, direction=-1))
    changed = dataclasses.replace(made, joints=(other, made.joints[1]))
    with (
        open_arm(made, "sim", virtual_bus=bus) as arm,
        pytest.raises(CalibrationMismatchError) as caught,
    ):
        check_calibration(arm.bus, changed, found)
    assert ("lift", "direction", "1", "-1") in caught.value.rows
    single = dataclasses.replace(made, joints=tuple(with_twin(j, None) for j in made.joints))
    with (
        open_arm(made, "sim", virtual_bus=bus) as arm,
        pytest.raises(ConfigError, match="lift, rack, lift"),
    ):
        check_calibration(arm.bus, single, found)


def test_an_offset_of_a_shadow_that_another_program_rewrote_is_no_mismatch() -> None:
    """Interbotix' driver computes it at each start from the position of the first servo."""
    _, bus, found, made = measured(SHADOW)
    bus.servo(3).memory.set("homing_offset", 25)
    with open_arm(made, "sim", virtual_bus=bus) as arm:
        check_calibration(arm.bus, made, found)
        arm.enable()
    bus.servo(3).memory.set("homing_offset", 0)
    bus.servo(1).memory.set("homing_offset", 25)  # of the first one it moves the zero of the joint
    with (
        open_arm(made, "sim", virtual_bus=bus) as arm,
        pytest.raises(CalibrationMismatchError) as caught,
    ):
        check_calibration(arm.bus, made, found)
    assert caught.value.rows == (("lift", "homing_offset", "0", "25"),)
    bus.servo(1).memory.set("homing_offset", 0)
    bus.servo(3).memory.set("homing_offset", 600)  # beside the first one it would fight it
    with (
        open_arm(made, "sim", virtual_bus=bus) as arm,
        pytest.raises(HardwareError, match="two servos of joint 'lift' read"),
    ):
        check_calibration(arm.bus, made, found)
        arm.enable()


def test_of_drive_mode_only_the_reverse_bit_counts() -> None:
    """Other programs leave a time-based profile (bit 2), which every connect takes back."""
    _, bus, found, made = measured(OWN)
    with open_arm(made, "sim", virtual_bus=bus) as arm:
        bus.servo(1).memory.set("drive_mode", 4)
        check_calibration(arm.bus, made, found)
        bus.servo(1).memory.set("drive_mode", 5)
        with pytest.raises(CalibrationMismatchError) as caught:
            check_calibration(arm.bus, made, found)
    assert ("lift", "drive_mode", "0", "5") in caught.value.rows


def test_the_model_of_a_slide_is_compared_in_millimetres(tmp_path: Path) -> None:
    _, _, found, made = measured(OWN)
    made.save(tmp_path / "pairs.toml")
    found.save(tmp_path / "pairs.calibration.toml")
    with pytest.raises(CalibrationMismatchError) as caught:
        check_model(ArmConfig.load(tmp_path / "pairs.toml"), LIMITS | {"rack": (0.0, 0.02)})
    assert caught.value.rows == (("rack", "limits of the model, mm", "0.0 .. 30.0", "0.0 .. 20.0"),)


def test_lerobot_has_one_servo_for_each_joint(tmp_path: Path) -> None:
    true, _, found, _ = measured(OWN)
    for save in (
        lambda: save_lerobot(tmp_path / "a.json", found),
        lambda: load_lerobot(tmp_path / "a.json", true, {}),
    ):
        with pytest.raises(ConfigError, match="two servos turn lift"):
            save()
    assert math.isfinite(found.joints[0].urdf_lower)
