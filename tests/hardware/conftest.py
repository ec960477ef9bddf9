"""Arms for the hardware tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_ik.hardware.config import ArmConfig

_HEAD = """schema = 1
name = "six X servos"
robot = "puma560"

[bus]
baud = 1_000_000
rate_hz = 100
watchdog_ms = 200
on_exit = "torque_off"
"""

_JOINT = """
[[joints]]
name = "joint{k}"
id = {k}
model = "{model}"
mode = "extended_position"
direction = {direction}
zero_ticks = {zero}
ratio = {ratio}
lower_deg = -160.0
upper_deg = 160.0
velocity_deg = 90.0
acceleration_deg = 360.0
"""


def arm_text() -> str:
    """Six joints that differ in model, direction, zero and ratio, so that a mix-up shows."""
    rows = [
        ("XM430-W350", 1, 2048, 1.0),
        ("XM430-W350", -1, 1024, 1.0),
        ("XM430-W350", 1, 2048, 2.0),
        ("XL430-W250", -1, 3000, 1.0),
        ("XL430-W250", 1, 2048, 1.0),
        ("XM430-W350", 1, 100, 1.5),
    ]
    joints = [
        _JOINT.format(k=k, model=m, direction=d, zero=z, ratio=r) for k, (m, d, z, r) in enumerate(rows, 1)
    ]
    return _HEAD + "".join(joints)


@pytest.fixture
def arm_toml() -> str:
    """Text of a correct arm file."""
    return arm_text()


@pytest.fixture
def arm_path(tmp_path: Path, arm_toml: str) -> Path:
    """A correct arm file."""
    path = tmp_path / "arm.toml"
    path.write_text(arm_toml, encoding="utf-8")
    return path


@pytest.fixture
def arm_config(arm_path: Path) -> ArmConfig:
    """Six joints that differ in model, direction, zero and ratio."""
    return ArmConfig.load(arm_path)
