"""An arm of six servos of each servo family, for tests that must hold for every family."""

from __future__ import annotations

import numpy as np

from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.family import FAMILY_MODULES

FAMILIES = tuple(FAMILY_MODULES)
"""Names of all servo families."""

IDS = (1, 2, 3, 4, 5, 6)
"""Servo ids of every arm of this file."""

START = np.array([0.1, 0.2, 0.3, -0.4, 0.5, 0.6])
"""(6,) rad. Joint values at first."""

PERIOD = 0.01
"""s of one control cycle of every arm of this file."""

_HEAD = """schema = 1
name = "six servos"
robot = "puma560"

[bus]
baud = 1_000_000
rate_hz = 100
watchdog_ms = {watchdog_ms}
stale_ms = {stale_ms}
on_exit = "torque_off"
"""

_JOINT = """
[[joints]]
name = "joint{number}"
id = {number}
model = "{model}"
mode = "{mode}"
direction = {direction}
zero_ticks = {zero}
ratio = {ratio}
lower_deg = -160.0
upper_deg = 160.0
velocity_deg = 90.0
acceleration_deg = 360.0
"""

# model, direction, zero in ticks, ratio
_DYNAMIXEL_X = (
    ("XM430-W350", 1, 2048, 1.0),
    ("XM430-W350", -1, 1024, 1.0),
    ("XM430-W350", 1, 2048, 2.0),
    ("XL430-W250", -1, 3000, 1.0),
    ("XL430-W250", 1, 2048, 1.0),
    ("XM430-W350", 1, 100, 1.5),
)

# A range must lie within one revolution of an STS servo.
_FEETECH_STS = (
    ("STS3215", 1, 2048, 1.0),
    ("STS3215", -1, 2100, 1.0),
    ("STS3215", 1, 1950, 0.5),
    ("STS3215", -1, 2000, 1.0),
    ("STS3215", 1, 2048, 1.0),
    ("STS3215", 1, 2090, 1.0),
)


def arm_text(family: str) -> str:
    """Return an arm file of six joints that differ, so that a mix-up of joints shows."""
    if family == "dynamixel_x":
        rows = _DYNAMIXEL_X
        mode = "extended_position"
        head = _HEAD.format(watchdog_ms=200, stale_ms=100)
    else:
        rows = _FEETECH_STS
        mode = "position"
        head = _HEAD.format(watchdog_ms=0, stale_ms=100)
    joints = [
        _JOINT.format(
            number=number, model=model, mode=mode, direction=direction, zero=zero, ratio=ratio
        )
        for number, (model, direction, zero, ratio) in enumerate(rows, 1)
    ]
    return head + "".join(joints)


def family_config(family: str) -> ArmConfig:
    """Return the arm of ``arm_text``."""
    return ArmConfig.parse(arm_text(family))
