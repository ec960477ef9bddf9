"""The arm file: what it accepts, its errors, and radians to ticks and back."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.errors import ConfigError, OutputError, UnknownJointError
from robot_ik.hardware import arm_file
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.registers import OperatingMode
from robot_ik.hardware.servo import Direct, Joint
from tests.hardware.joints import make_joint

POSITION = OperatingMode.POSITION
EXTENDED = OperatingMode.EXTENDED_POSITION


def _joint(
    mode: OperatingMode = EXTENDED,
    direction: int = 1,
    zero_ticks: int = 2048,
    ratio: float = 1.0,
    lower: float = -2.0,
    upper: float = 2.0,
) -> Joint:
    return make_joint(
        "j", 1, "XM430-W350", mode, direction, zero_ticks, lower, upper, gear=Direct(ratio)
    )


def test_a_correct_file(arm_config: ArmConfig, arm_path: Path) -> None:
    assert (arm_config.name, arm_config.robot) == ("six X servos", "puma560")
    assert (arm_config.baud, arm_config.rate_hz) == (1_000_000, 100.0)
    assert (arm_config.watchdog_ms, arm_config.on_exit) == (200, "torque_off")
    assert arm_config.file == arm_path
    assert arm_config.names == tuple(f"joint{k}" for k in range(1, 7))
    assert arm_config.servo_ids == (1, 2, 3, 4, 5, 6)
    assert arm_config.joints[3] == make_joint(
        "joint4",
        4,
        "XL430-W250",
        EXTENDED,
        -1,
        3000,
        -math.radians(160),
        math.radians(160),
        math.pi / 2,
        2 * math.pi,
    )
    assert arm_config.velocity == pytest.approx([math.pi / 2] * 6)
    assert arm_config.acceleration == pytest.approx([2 * math.pi] * 6)
    assert arm_config.resolution == pytest.approx(
        2 * math.pi / 4096 / np.array([1, 1, 2, 1, 1, 1.5])
    )


# old text, new text (first place only), key, words that must be in the message
WRONG = [
    ("direction = 1", "directon = 1", "joints[0].directon", "did you mean direction?"),
    ("[bus]", "[buss]", "buss", "did you mean bus?"),
    ("baud =", "bode =", "bus.bode", "baud"),
    ("schema = 1\n", "", "schema", "missing"),
    ("schema = 1", "schema = 2", "schema", "allowed: 1"),
    ("id = 2", "id = 1", "joints[1].id", "already joints[0]"),
    ('"joint2"', '"joint1"', "joints[1].name", "already joints[0]"),
    ("id = 2", "id = 253", "joints[1].id", "0..252"),
    ("id = 2", "id = -1", "joints[1].id", "0..252"),
    ("id = 2", 'id = "2"', "joints[1].id", "0..252"),
    ("id = 2", "id = true", "joints[1].id", "0..252"),
    ("XL430-W250", "XL430W250", "joints[3].model", "did you mean XL430-W250"),
    ('"extended_position"', '"velocity"', "joints[0].mode", "'position', 'extended_position' or"),
    ("direction = -1", "direction = 0", "joints[1].direction", "1 or -1"),
    ("ratio = 2.0", "ratio = 0.0", "joints[2].ratio", "> 0"),
    ("ratio = 2.0", "ratio = nan", "joints[2].ratio", "finite"),
    ("zero_ticks = 2048", "zero_ticks = 2048.5", "joints[0].zero_ticks", "-1048575..1048575"),
    ("lower_deg = -160.0", "lower_deg = 170.0", "joints[0].lower_deg", "lower_deg < upper_deg"),
    ("lower_deg = -160.0", "lower_deg = nan", "joints[0].lower_deg", "finite"),
    ("velocity_deg = 90.0", "velocity_deg = 0", "joints[0].velocity_deg", "> 0"),
    ("acceleration_deg = 360.0", "acceleration_deg = -1", "joints[0].acceleration_deg", "> 0"),
    ("velocity_deg = 90.0", "velocity_deg = 9e14", "joints[0].velocity_deg", "0.001 to 100000"),
    ("velocity_deg = 90.0", "velocity_deg = 1e-300", "joints[0].velocity_deg", "0.001 to 100000"),
    (
        "acceleration_deg = 360.0",
        "acceleration_deg = 1e-308",
        "joints[0].acceleration_deg",
        "0.001 to 1e+06",
    ),
    ('"joint2"', '"joint\\u001b[2J"', "joints[1].name", "cannot be printed"),
    ('"joint2"', '"joint\\n2"', "joints[1].name", "cannot be printed"),
    ('"joint2"', '"joint\\u202e2"', "joints[1].name", "cannot be printed"),
    ('"joint2"', f'"{"j" * 100_000}"', "joints[1].name", "up to 100"),
    ("1_000_000", "1_000_001", "bus.baud", "57600"),
    ("watchdog_ms = 200", "watchdog_ms = 210", "bus.watchdog_ms", "multiple of 20"),
    ("watchdog_ms = 200", "watchdog_ms = 2560", "bus.watchdog_ms", "0..2540"),
    ("rate_hz = 100", "rate_hz = 0.9", "bus.rate_hz", "1..1000"),
    ('"torque_off"', '"off"', "bus.on_exit", "'torque_off', 'hold' or 'park'"),
    ('robot = "puma560"', "robot = 560", "robot", "string"),
    ("[bus]", "[bus", "", "not valid TOML"),
]


@pytest.mark.parametrize("old,new,key,said", WRONG)
def test_a_wrong_file_names_file_key_and_what_is_allowed(
    arm_path: Path, arm_toml: str, old: str, new: str, key: str, said: str
) -> None:
    assert old in arm_toml
    arm_path.write_text(arm_toml.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        ArmConfig.load(arm_path)
    assert caught.value.file == arm_path
    assert caught.value.key == key
    text = str(caught.value)
    assert str(arm_path) in text and said in text
    assert len(text.splitlines()) <= 4


def test_a_file_that_is_much_too_long_is_not_even_parsed(arm_toml: str, monkeypatch) -> None:
    """100,000 joints: a parser takes a quarter of a minute for them."""
    head, joint = arm_toml.split("[[joints]]")[:2]
    monkeypatch.setattr(arm_file, "parse_toml", lambda text, file: pytest.fail("it was parsed"))
    with pytest.raises(ConfigError, match="characters are no arm file; allowed: up to 1,000,000"):
        ArmConfig.parse(head + 100_000 * ("[[joints]]" + joint))


def test_several_mistakes_are_counted(arm_toml: str) -> None:
    with pytest.raises(ConfigError, match="and 2 more"):
        ArmConfig.parse(
            arm_toml.replace("id = 2", "id = 300").replace("ratio = 2.0", "ratio = 0", 1) + "x = 1"
        )


def test_an_arm_without_joints(arm_toml: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ArmConfig.parse(arm_toml[: arm_toml.index("[[joints]]")])
    assert caught.value.key == "joints"
    with pytest.raises(ConfigError, match="5e-324 is not right; allowed: at least one") as caught:
        ArmConfig.parse("joints = 5e-324\n" + arm_toml[: arm_toml.index("[[joints]]")])
    assert caught.value.key == "joints"


def test_a_rate_that_one_model_lacks(arm_toml: str) -> None:
    fast = arm_toml.replace("1_000_000", "4_500_000")
    assert ArmConfig.parse(fast).baud == 4_500_000
    with pytest.raises(ConfigError, match="XL330-M288") as caught:
        ArmConfig.parse(fast.replace("XL430-W250", "XL330-M288", 1))
    assert caught.value.key == "bus.baud"


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"])
def test_a_file_that_cannot_be_read(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "arm.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"arm\.toml"):
        ArmConfig.load(path)


def test_saved_and_loaded_again(arm_config: ArmConfig, tmp_path: Path) -> None:
    path = tmp_path / "copy.toml"
    path.write_text("old")
    arm_config.save(path)
    loaded = ArmConfig.load(path)
    assert loaded.lower == pytest.approx(arm_config.lower, abs=1e-13)
    assert [
        (j.servo.id, j.servo.direction, j.servo.zero_ticks, j.gear.ratio) for j in loaded.joints
    ] == [
        (j.servo.id, j.servo.direction, j.servo.zero_ticks, j.gear.ratio) for j in arm_config.joints
    ]
    assert tomllib.loads(path.read_text())["joints"][0]["upper_deg"] == 160.0
    assert [p.name for p in tmp_path.glob("*copy*")] == ["copy.toml"]
    with pytest.raises(OutputError):
        arm_config.save(tmp_path / "missing" / "arm.toml")
    assert not (tmp_path / "missing").exists()


@pytest.mark.parametrize(
    "joint,q,ticks",
    [
        (_joint(), 0.0, 2048),
        (_joint(), math.pi / 2, 3072),
        (_joint(direction=-1), math.pi / 2, 1024),
        (_joint(ratio=2.0), math.pi / 2, 4096),
        (_joint(ratio=0.5, zero_ticks=100, direction=-1), -math.pi, 1124),
        (_joint(zero_ticks=0), -2 * math.pi, -4096),
    ],
)
def test_ticks_by_hand(joint: Joint, q: float, ticks: int) -> None:
    assert joint.nearest_ticks(q) == ticks
    assert joint.value(ticks) == pytest.approx(q, abs=1e-12)


@st.composite
def joints(draw: st.DrawFn) -> Joint:
    """Joints whose range meets that of their mode."""
    mode = draw(st.sampled_from([POSITION, EXTENDED]))
    zero = draw(st.integers(0, 4095))
    lower = draw(st.floats(-7.0, 6.0))
    joint = _joint(
        mode,
        draw(st.sampled_from([1, -1])),
        zero,
        draw(st.floats(0.05, 20.0)),
        lower,
        draw(st.floats(lower + 0.01, 7.5)),
    )
    low, high = joint.limits
    return joint if low < high else _joint(mode, 1, zero, 1.0, -7.0, 7.0)


@given(joints(), st.floats(-10, 10))
def test_there_and_back_is_half_a_tick(joint: Joint, q: float) -> None:
    assert abs(joint.value(joint.nearest_ticks(q)) - q) <= joint.resolution * (0.5 + 1e-9)
    assert joint.nearest_ticks(joint.value(joint.nearest_ticks(q))) == joint.nearest_ticks(q)


@given(joints())
def test_limits_are_cut_only_where_the_mode_ends(joint: Joint) -> None:
    """Just outside the limits lies outside the file's range, or outside the servo's."""
    ends = (0, 4095) if joint.servo.mode == POSITION else (-1_048_575, 1_048_575)
    low, high = joint.limits
    step = joint.resolution + 1e-9
    for q in (low - step, high + step):
        beyond_file = not joint.lower <= q <= joint.upper
        beyond_servo = not ends[0] <= joint.nearest_ticks(q) <= ends[1]
        assert beyond_file or beyond_servo


def test_one_turn_mode_cuts_the_range(arm_toml: str) -> None:
    """zero at 2048: 2048 ticks down, 2047 up."""
    wide = arm_toml.replace("lower_deg = -160.0", "lower_deg = -200.0", 1)
    wide = wide.replace("upper_deg = 160.0", "upper_deg = 200.0", 1)
    assert np.degrees(ArmConfig.parse(wide).upper[0]) == pytest.approx(200.0)
    config = ArmConfig.parse(wide.replace('"extended_position"', '"position"', 1))
    assert config.joints[0].ticks_range() == (0, 4095)
    assert np.degrees(config.lower[0]) == pytest.approx(-180.0)
    assert np.degrees(config.upper[0]) == pytest.approx(2047 / 4096 * 360.0)
    # the reversed joint 2 with its zero at 1024
    config = ArmConfig.parse(arm_toml.replace('"extended_position"', '"position"'))
    assert np.degrees(config.upper[1]) == pytest.approx(90.0)
    assert np.degrees(config.lower[1]) == pytest.approx(-160.0)


def test_a_range_that_the_mode_cannot_reach_at_all(arm_toml: str) -> None:
    text = arm_toml.replace('"extended_position"', '"position"', 1)
    text = text.replace("lower_deg = -160.0", "lower_deg = 190.0", 1)
    text = text.replace("upper_deg = 160.0", "upper_deg = 250.0", 1)
    with pytest.raises(ConfigError, match=r"-180\.0 to 179\.9 deg") as caught:
        ArmConfig.parse(text)
    assert caught.value.key == "joints[0].lower_deg"


def test_joints_by_name(arm_config: ArmConfig) -> None:
    assert arm_config.joint("joint3").servo.id == 3
    with pytest.raises(UnknownJointError, match="joint3"):
        arm_config.joint("jont3")


def test_a_robot_without_an_arm_file_has_none_to_load() -> None:
    with pytest.raises(
        ConfigError, match=r"no arm file to read\na robot without .* ArmConfig\.generic"
    ):
        ArmConfig.load(rik.load_robot("panda").arm_file)


def test_generic_arm_for_any_robot() -> None:
    config = ArmConfig.generic(
        "my arm", ["a", "b"], [-1.0, -math.inf], [1.0, math.inf], 2.0, [3.0, 4.0]
    )
    assert config.servo_ids == (1, 2) and config.names == ("a", "b")
    assert (config.lower[0], config.upper[0]) == (-1.0, 1.0)
    assert config.joints[1].ticks_range() == (-1_048_575, 1_048_575)
    assert np.isfinite(config.lower).all() and np.isfinite(config.upper).all()
    assert list(config.velocity) == [2.0, 2.0] and list(config.acceleration) == [3.0, 4.0]
    assert ArmConfig.parse(config.to_toml()).joints[1].ticks_range() == (-1_048_575, 1_048_575)


def test_generic_arms_have_a_largest_size() -> None:
    names = [f"j{k}" for k in range(253)]
    assert ArmConfig.generic("long", names[:252], [-1.0] * 252, [1.0] * 252).servo_ids[-1] == 252
    for count in (0, 253):
        with pytest.raises(ConfigError, match=r"1\.\.252"):
            ArmConfig.generic("long", names[:count], -1.0, 1.0)
    with pytest.raises(ConfigError, match="empty"):
        ArmConfig.generic("odd", ["a"], [1.0], [-1.0])
