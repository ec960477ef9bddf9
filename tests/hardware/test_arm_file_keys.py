"""Keys of a servo in the arm file: reverse, gains, profile, limits, thresholds, swing arms."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import Gains, StopAt, SwingArm

ALL = """
schema = 1
name = "one of everything"
robot = "wx250s"

[[joints]]
name = "shoulder"
id = 2
model = "XM430-W350"
mode = "position"
reverse = true
lower_deg = -100.0
upper_deg = 100.0
velocity_deg = 90.0
acceleration_deg = 300.0
profile_velocity_deg = 180.0
profile_acceleration_deg = 6000.0
current_limit_ma = 1000.0

[joints.twin]
id = 3
shadow = true
reverse = false

[joints.gains]
position_p = 900
position_i = 10
position_d = 20
velocity_p = 110
velocity_i = 1900
feedforward_1 = 30
feedforward_2 = 40

[joints.stop_at]
current_ma = 800.0
temperature_c = 70.0

[[joints]]
name = "finger"
id = 9
model = "XL430-W250"
mode = "position"
group = "gripper"
open_end = "lower"
horn_mm = 14.0
rod_mm = 24.0
lower_mm = 15.0
upper_mm = 37.0
velocity_mm = 50.0
acceleration_mm = 500.0
profile_velocity_mm = 60.0

[joints.gains]
position_p = 700

[joints.stop_at]
load_percent = 60.0
"""


def test_all_keys_are_read_and_written_back() -> None:
    arm = ArmConfig.parse(ALL)
    shoulder, finger = arm.joints
    assert shoulder.servo.reverse is True and finger.servo.reverse is False
    second = shoulder.servos[1]
    assert (second.id, second.primary_id, second.reverse) == (3, shoulder.servo.id, False)
    assert shoulder.servo.gains == Gains(900, 10, 20, 110, 1900, 30, 40)
    assert dict(shoulder.servo.gains.registers) == {
        "position_p_gain": 900,
        "position_i_gain": 10,
        "position_d_gain": 20,
        "velocity_p_gain": 110,
        "velocity_i_gain": 1900,
        "feedforward_1st_gain": 30,
        "feedforward_2nd_gain": 40,
    }
    assert dict(finger.servo.gains.registers) == {"position_p_gain": 700}
    assert shoulder.profile_velocity == pytest.approx(math.pi)
    assert shoulder.profile_acceleration == pytest.approx(math.radians(6000.0))
    assert finger.profile_velocity == pytest.approx(0.060) and finger.profile_acceleration is None
    assert shoulder.servo.current_limit == 1000.0 and finger.servo.current_limit is None
    assert shoulder.stop_at == StopAt(current_ma=800.0, temperature_c=70.0)
    assert finger.stop_at == StopAt(load_percent=60.0)
    assert finger.open_end == "lower"
    assert isinstance(finger.gear, SwingArm) and finger.unit == "mm"
    assert (finger.gear.horn, finger.gear.rod) == pytest.approx((0.014, 0.024))
    again = ArmConfig.parse(arm.to_toml())
    for written, read in zip(arm.joints, again.joints, strict=True):
        assert replace(read, lower=0, upper=1) == replace(written, lower=0, upper=1)
        assert read.limits == pytest.approx(written.limits, abs=1e-12)
    assert again.to_toml() == arm.to_toml()


def test_a_file_that_names_none_of_them_writes_none_of_them(arm_config: ArmConfig) -> None:
    text = arm_config.to_toml()
    for key in ("reverse", "gains", "profile", "current", "stop_at", "horn", "rod", "open_end"):
        assert key not in text


# old text, new text, key, words that must be in the message
WRONG = [
    ("reverse = true", "reverse = 1", "joints[0].reverse", "true or false"),
    ('open_end = "lower"', 'open_end = "left"', "joints[1].open_end", "lower"),
    ("reverse = true", 'open_end = "upper"', "joints[0].open_end", 'group = "gripper"'),
    ("position_p = 900", "position_p = 16384", "joints[0].gains.position_p", "0..16383"),
    ("position_p = 900", "position_p = 9.5", "joints[0].gains.position_p", "0..16383"),
    ("position_p = 900", "postion_p = 900", "joints[0].gains.postion_p", "did you mean position_p"),
    ("shadow = true", "shadwo = true", "joints[0].twin.shadwo", "did you mean shadow?"),
    (
        "temperature_c = 70.0",
        "temprature_c = 70.0",
        "joints[0].stop_at.temprature_c",
        "did you mean temp",
    ),
    ("temperature_c = 70.0", "temperature_c = 80.0", "joints[0].stop_at.temperature_c", "< 80"),
    ("current_ma = 800.0", "current_ma = 1100.0", "joints[0].stop_at.current_ma", "2.69 to 1000"),
    ("current_ma = 800.0", "load_percent = 80.0", "joints[0].stop_at.load_percent", "current_ma"),
    ("load_percent = 60.0", "load_percent = 160.0", "joints[1].stop_at.load_percent", "<= 100"),
    ("load_percent = 60.0", "current_ma = 600.0", "joints[1].stop_at.current_ma", "load_percent"),
    (
        "current_limit_ma = 1000.0",
        "current_limit_ma = 5000",
        "joints[0].current_limit_ma",
        "2.69 to 3209",
    ),
    ("current_limit_ma = 1000.0", "current_limit_ma = 0", "joints[0].current_limit_ma", "> 0"),
    (
        "_velocity_deg = 180.0",
        "_velocity_deg = 80.0",
        "joints[0].profile_velocity_deg",
        ">= velocity_deg",
    ),
    (
        "_acceleration_deg = 6000.0",
        "_acceleration_deg = 9.0",
        "joints[0].profile_acceleration_deg",
        "300",
    ),
    (
        "_velocity_mm = 60.0",
        "_velocity_mm = 40.0",
        "joints[1].profile_velocity_mm",
        ">= velocity_mm = 50",
    ),
    ("horn_mm = 14.0\n", "", "joints[1].horn_mm", "missing"),
    ("rod_mm = 24.0\n", "", "joints[1].rod_mm", "missing"),
    ("rod_mm = 24.0\n", "rod_mm = 12.0\n", "joints[1].rod_mm", ">= 14"),
    ("horn_mm = 14.0\nrod_mm = 24.0\n", "", "joints[1].pinion_mm", "horn_mm and rod_mm"),
    ("horn_mm = 14.0\n", "horn_mm = 14.0\npinion_mm = 8.0\n", "joints[1].pinion_mm", "two gears"),
    ("upper_mm = 37.0", "upper_mm = 38.0", "joints[1].upper_mm", "37.9"),
    ("lower_mm = 15.0", "lower_mm = 8.0", "joints[1].lower_mm", "10."),
    ("upper_mm = 37.0", "upper_mm = 15.005", "joints[1].lower_mm", "one tick"),
    ("upper_deg = 100.0", "upper_deg = -99.95", "joints[0].lower_deg", "one tick"),
]


@pytest.mark.parametrize(("old", "new", "key", "said"), WRONG)
def test_a_wrong_value_is_reported_with_its_key(old: str, new: str, key: str, said: str) -> None:
    assert ALL.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        ArmConfig.parse(ALL.replace(old, new))
    assert caught.value.key == key and said in str(caught.value)


def test_a_goal_current_above_the_limit_of_the_servo_is_refused() -> None:
    text = ALL.replace('mode = "position"\nreverse', 'mode = "current_based_position"\nreverse', 1)
    text = text.replace("current_limit_ma", "current_ma = 900.0\ncurrent_limit_ma")
    with pytest.raises(ConfigError, match="> 900") as caught:  # it would stop whenever it presses
        ArmConfig.parse(text)
    assert caught.value.key == "joints[0].stop_at.current_ma"
    text = text.replace("current_ma = 800.0", "current_ma = 950.0")
    assert ArmConfig.parse(text).joints[0].current == 900.0
    with pytest.raises(ConfigError, match="limited to 1000 mA") as caught:
        ArmConfig.parse(text.replace("current_ma = 900.0", "current_ma = 1001.0"))
    assert caught.value.key == "joints[0].current_ma"


def test_swing_arms_are_the_same_law_in_every_unit() -> None:
    finger = ArmConfig.parse(ALL).joint("finger")
    assert isinstance(finger.gear, SwingArm)
    # zero_ticks: the horn square to the slide
    assert finger.nearest_ticks(finger.gear.distance(0.0)) == 2048
