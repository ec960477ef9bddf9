"""LeRobot's calibration of an SO-101, both ways, and a calibration by hand with homing."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware import open_arm
from robot_ik.hardware.calibration import calibrated, check_calibration
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.lerobot_calibration import load_lerobot, save_lerobot
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock
from robot_ik.workcell.hand_calibration import calibrate_by_hand

CONFIG = ArmConfig.load("so101")
LIMITS = {joint.name: (joint.lower, joint.upper) for joint in CONFIG.joints}
RANGES = {
    "shoulder_pan": (800, 3290),
    "shoulder_lift": (910, 3190),
    "elbow_flex": (950, 3150),
    "wrist_flex": (970, 3130),
    "wrist_roll": (0, 4095),
    "gripper": (1990, 3250),
}
CLOSED = math.radians(-10.0)
"""The closed gripper: the lower limit of the model, rad."""


def write_file(path: Path, **changes: dict[str, int]) -> Path:
    """Write a file as LeRobot does. ``changes``: joint -> keys that differ."""
    content = {}
    for id, (name, (lower, upper)) in enumerate(RANGES.items(), 1):
        row = {"id": id, "drive_mode": 0, "homing_offset": 300 * id - 2100}
        content[name] = row | {"range_min": lower, "range_max": upper} | changes.get(name, {})
    path.write_text(json.dumps(content))
    return path


def test_zeros_are_the_middles_and_the_closed_gripper_is_the_lower_limit(tmp_path):
    calibration = load_lerobot(write_file(tmp_path / "f.json"), CONFIG, LIMITS)
    arm = calibrated(CONFIG, calibration)
    for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex"):
        assert arm.joint(name).servo.zero_ticks == pytest.approx(sum(RANGES[name]) / 2, abs=1)
    assert arm.joint("wrist_roll").servo.zero_ticks == pytest.approx(2047.5, abs=1)
    gripper = arm.joint("gripper")
    assert gripper.value(1990) == pytest.approx(CLOSED, abs=math.radians(1.0))
    assert gripper.value(3250) == pytest.approx(math.radians(100.0), abs=math.radians(1.0))


def test_a_full_turn_keeps_the_range_of_the_arm_file(tmp_path):
    arm = calibrated(CONFIG, load_lerobot(write_file(tmp_path / "f.json"), CONFIG, LIMITS))
    roll = CONFIG.joint("wrist_roll")
    assert arm.joint("wrist_roll").limits == pytest.approx(roll.limits, abs=2e-3)


def test_the_file_comes_back(tmp_path):
    first = write_file(tmp_path / "f.json")
    save_lerobot(tmp_path / "back.json", load_lerobot(first, CONFIG, LIMITS))
    assert json.loads((tmp_path / "back.json").read_text()) == json.loads(first.read_text())


def test_a_gripper_that_was_not_swept_from_stop_to_stop_is_refused(tmp_path):
    path = write_file(tmp_path / "f.json", gripper={"range_max": 2400})
    with pytest.raises(ConfigError, match="zero is not known"):
        load_lerobot(path, CONFIG, LIMITS)


def test_a_homing_offset_beyond_a_quarter_turn_counts_on_feetech_servos(tmp_path):
    path = write_file(tmp_path / "f.json", elbow_flex={"homing_offset": -2040})
    assert load_lerobot(path, CONFIG, LIMITS).joints[2].homing_offset == -2040


class Hand:
    """A person who does what is asked, with virtual servos.

    Args:
        bus: Virtual servos.
        reach: Joint -> ticks from the middle to both ends of its range.
    """

    def __init__(self, bus: VirtualBus, reach: dict[str, tuple[int, int]]) -> None:
        self._bus = bus
        self._reach = reach
        self.texts: list[str] = []

    def step(self, text: str, sample) -> None:
        self.texts.append(text)
        if text.startswith("1."):
            self._sweep(sample)
        elif text.startswith("3."):
            name = text.split("move ")[1].split(" alone")[0]
            self._bus.servo(name).rotate_by_hand(120)
        sample()

    def _sweep(self, sample) -> None:
        for name, (down, up) in self._reach.items():
            servo = self._bus.servo(name)
            for ticks in (*[-down / 8] * 8, *[(down + up) / 16] * 16, *[-up / 8] * 8):
                servo.rotate_by_hand(ticks)
                sample()

    def note(self, text: str) -> None:
        pass

    def again(self, _error) -> bool:
        return False


def test_a_calibration_by_hand_homes_first_so_that_no_range_crosses_the_wrap():
    """The middle of every range lies near the end of its servo's revolution."""
    bus = VirtualBus.from_config(CONFIG, VirtualClock())
    reach = {}
    for joint in CONFIG.joints:
        servo = bus.servo(joint.name)
        middle = joint.position(sum(joint.limits) / 2)
        servo.rotate_by_hand(middle + 2000 - servo.encoder)
        half = (joint.position(joint.upper) - joint.position(joint.lower)) / 2
        reach[joint.name] = (half, half)
    pose = {joint.name: sum(joint.limits) / 2 for joint in CONFIG.joints}
    with open_arm(CONFIG, "sim", virtual_bus=bus) as arm:
        calibration = calibrate_by_hand(arm, Hand(bus, reach), pose, LIMITS)
        made = calibrated(CONFIG, calibration)
        check_calibration(arm.bus, made, calibration)
    for joint in made.joints:
        servo = bus.servo(joint.name)
        before = servo.values["homing_offset"]
        servo.power_cycle()
        assert servo.values["homing_offset"] == before != 0, "it was written while locked"
        middle = sum(joint.limits) / 2
        assert joint.position(middle) == pytest.approx(2048, abs=40)
    with open_arm(replace(made, file=None), "sim", virtual_bus=bus, on_exit="hold") as arm:
        arm.enable()
        goal = np.array([sum(joint.limits) / 2 for joint in made.joints])
        arm.move_to(goal)
        assert arm.read().q == pytest.approx(goal, abs=math.radians(1.0))
