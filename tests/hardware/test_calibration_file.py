"""Zeros written into an arm file: these numbers and no others, or nothing at all."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.errors import ConfigError, OutputError, UnknownJointError
from robot_ik.hardware.calibration import calibrated
from robot_ik.hardware.calibration_file import (
    Calibration,
    JointCalibration,
    calibration_beside,
    write_zeros,
    zeros_moved,
)
from robot_ik.hardware.config import ArmConfig
from robot_ik.robot import load_robot

SHIPPED = load_robot("tabletop_puma").arm_file
TWINS = """schema = 1  # ours
name = "two at the shoulder"
robot = "tabletop_puma"

[[joints]]   # the base
name = "joint1"
id = 1
model = "XM430-W350"
lower_deg = -90.0
upper_deg = 90.0
velocity_deg = 100.0
acceleration_deg = 300.0

[[joints]]
name = "joint2"
id = 2
model = "XM430-W350"
direction = -1
zero_ticks=  2_000   # by hand
ratio = 1.5
lower_deg = -20.0
upper_deg = 100.0
velocity_deg = 100.0
acceleration_deg = 300.0

[joints.twin]
id = 3
direction = 1
zero_ticks = 1900
"""


@pytest.fixture
def twins(tmp_path: Path) -> Path:
    path = tmp_path / "arm.toml"
    path.write_text(TWINS)
    return path


@settings(max_examples=20)
@given(degrees=st.floats(-20, 20), ticks=st.integers(0, 4095))
def test_a_moved_zero_makes_the_same_ticks_mean_the_corrected_angle(
    degrees: float, ticks: int
) -> None:
    config = ArmConfig.parse(TWINS)
    offset = math.radians(degrees)
    for before, after in zip(
        config.drives, zeros_moved(config, {"joint2": offset}).drives, strict=True
    ):
        wanted = before.value(ticks) + (offset if before.name == "joint2" else 0.0)
        assert after.value(ticks) == pytest.approx(wanted, abs=0.5001 * before.joint.resolution)


def test_only_the_zeros_change_and_the_old_file_is_kept(twins: Path) -> None:
    used = ArmConfig.load(twins)
    offsets = {"joint1": math.radians(2.0), "joint2": math.radians(-1.0)}
    (kept,) = write_zeros(twins, used, offsets)
    assert kept.read_text() == TWINS
    now = ArmConfig.load(twins)
    assert now == zeros_moved(used, offsets) and now != used
    pairs = zip(used.drives, now.drives, strict=True)
    changed = [(a, b) for a, b in pairs if a.servo != b.servo]
    assert [(a.name, a.id, a.servo.zero_ticks, b.servo.zero_ticks) for a, b in changed] == [
        ("joint1", 1, 2048, 2025),
        ("joint2", 2, 2000, 1983),
        ("joint2", 3, 1900, 1917),
    ]
    # Line by line: two zeros are replaced with their comments left, one is added where there was
    # none.
    new = twins.read_text().splitlines()
    assert [line for line in new if line not in TWINS.splitlines()] == [
        "zero_ticks = 2025",
        "zero_ticks=  1983   # by hand",
        "zero_ticks = 1917",
    ]
    assert [line for line in TWINS.splitlines() if line not in new] == [
        "zero_ticks=  2_000   # by hand",
        "zero_ticks = 1900",
    ]
    # Again: another backup, the first one stays.
    (again,) = write_zeros(twins, now, {"joint1": math.radians(-2.0)})
    assert again != kept and kept.read_text() == TWINS
    assert ArmConfig.load(twins).joints[0].servo.zero_ticks == 2048


def test_a_shipped_arm_file_keeps_comments_line_ends_and_other_joints(tmp_path: Path) -> None:
    assert SHIPPED is not None
    path = tmp_path / "arm.toml"
    text = SHIPPED.read_text().replace("\n", "\r\n")
    path.write_bytes(text.encode())
    used = ArmConfig.load(path)
    some = replace(used, joints=used.joints[:3])  # a program that used three of the joints
    write_zeros(path, some, {"joint2": math.radians(1.5)})
    new = path.read_bytes().decode()
    assert new.count("\r\n") == text.count("\r\n") == new.count("\n")
    different = [(a, b) for a, b in zip(text.splitlines(), new.splitlines(), strict=True) if a != b]
    ((before, after),) = different
    assert before.startswith("zero_ticks = 3584") and after == before.replace("3584", "3610")


def test_the_calibration_beside_goes_along(twins: Path) -> None:
    used = ArmConfig.load(twins)
    rows = tuple(
        JointCalibration(
            one.name,
            one.id,
            one.servo.model,
            0,
            0,
            100,
            3000,
            one.servo.direction,
            one.servo.zero_ticks,
            -90.0,
            90.0,
        )
        for one in used.drives
    )
    found = Calibration(used.name, used.robot, "2026-01-01T00:00:00Z", rows[:2], rows[2:])
    found.save(calibration_beside(twins))
    assert len(write_zeros(twins, used, {"joint2": math.radians(3.0)})) == 2
    now = ArmConfig.load(twins)
    beside = Calibration.load(calibration_beside(twins))
    assert [row.zero_ticks for row in beside.rows] == [servo.zero_ticks for servo in now.servos]
    assert beside.rows[1].range_max == 3000


@pytest.mark.parametrize("case", ["changed", "folder"])
def test_what_cannot_be_written_leaves_everything_as_it_was(
    twins: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = ArmConfig.load(twins)
    if case == "changed":
        twins.write_text(TWINS.replace("ratio = 1.5", "ratio = 2.0"))
    else:
        monkeypatch.setattr("robot_ik.files.os.replace", _refused)
    before = twins.read_bytes()
    with pytest.raises(OutputError if case == "folder" else ConfigError):
        write_zeros(twins, used, {"joint2": 0.05})
    assert twins.read_bytes() == before
    assert [path.name for path in twins.parent.iterdir()] == ["arm.toml"]


def test_a_second_servo_written_in_one_line_gets_its_zero(twins: Path) -> None:
    head, _, twin = TWINS.partition("[joints.twin]\n")
    twins.write_text(head.rstrip() + "\ntwin = {" + ", ".join(twin.split("\n")[:-1]) + "}\n")
    used = ArmConfig.load(twins)
    write_zeros(twins, used, {"joint2": 0.05})
    assert ArmConfig.load(twins) == zeros_moved(used, {"joint2": 0.05})
    assert "twin = {" in twins.read_text()


def test_an_unknown_joint_is_reported(twins: Path) -> None:
    with pytest.raises(UnknownJointError, match="joint9"):
        zeros_moved(ArmConfig.load(twins), {"joint9": 0.1})


def _refused(*names: object) -> None:
    raise PermissionError(13, "Permission denied")


def test_a_calibrated_arm_keeps_the_open_end_of_its_gripper_in_its_file(tmp_path: Path) -> None:
    config = ArmConfig.load("koch_v11")
    rows = []
    for joint in config.joints:
        first, last = joint.ticks_range()
        lower, upper = (limit / joint.per_unit for limit in joint.limits)
        servo = joint.servo
        moved = (first + 10, last + 10, servo.direction, servo.zero_ticks + 10)
        rows.append(JointCalibration(joint.name, servo.id, servo.model, 0, 0, *moved, lower, upper))
    measured = Calibration(config.name, config.robot, "2026-11-27T12:00:00", tuple(rows))
    path = tmp_path / "mine.toml"
    calibrated(config, measured).save(path)
    gripper = ArmConfig.load(path).joint("gripper")
    assert gripper.servo.zero_ticks == config.joint("gripper").servo.zero_ticks + 10
    assert gripper.open_end == "lower"
    assert gripper.at_opening(1.0) == pytest.approx(gripper.lower, abs=0.002)
