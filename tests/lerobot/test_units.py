"""LeRobot's numbers of joints and grippers."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

import robot_ik as rik
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import GRIPPER
from robot_ik.lerobot.units import Units

ARMS_WITH_GRIPPERS = ("so101", "koch_v11", "omx_f", "wx250s", "vx300s", "tabletop_puma")


@pytest.mark.parametrize("arm", ARMS_WITH_GRIPPERS)
def test_gripper_0_is_closed_and_100_is_open_in_mujoco(arm: str) -> None:
    """The finger of the servo is nearer to the tool frame, between the fingers, when closed."""
    model = rik.load_robot(arm).model
    units = Units(ArmConfig.load(arm))
    data = mujoco.MjData(model)
    (name,) = units.grippers
    joint = model.joint(name)
    distances = []
    for number in (0.0, 100.0):
        data.qpos[joint.qposadr[0]] = units.value(name, number)
        mujoco.mj_forward(model, data)
        tip = data.geom_xpos[model.geom_bodyid == joint.bodyid[0]][-1]
        distances.append(float(np.linalg.norm(tip - data.site("gripper").xpos)))
    assert distances[0] < distances[1] - 0.005


@pytest.mark.parametrize("arm", ARMS_WITH_GRIPPERS)
def test_every_gripper_of_a_bundled_arm_file_names_its_open_end(arm: str) -> None:
    config = ArmConfig.load(arm)
    assert config.file is not None
    grippers = config.group(GRIPPER)
    text = config.file.read_text(encoding="utf-8")
    assert text.count("open_end = ") == len(grippers) == 1
    (gripper,) = grippers
    lower, upper = gripper.limits
    ends = {"lower": lower, "upper": upper}
    assert gripper.at_opening(1.0) == ends[gripper.open_end]
    assert gripper.at_opening(0.5) == pytest.approx(0.5 * (lower + upper))


def test_rates_have_the_unit_of_the_numbers_a_second_and_the_sign_of_the_opening() -> None:
    units = Units(ArmConfig.load("koch_v11"))
    velocities = dict.fromkeys(units.joints, 0.0) | {units.joints[0]: math.pi, "gripper": -0.1}
    rates = units.rates(velocities)
    assert rates[f"{units.joints[0]}.vel"] == pytest.approx(180.0)
    step = units.number("gripper", -0.6) - units.number("gripper", -0.5)
    assert rates["gripper.vel"] == pytest.approx(step)
    assert step > 0.0
