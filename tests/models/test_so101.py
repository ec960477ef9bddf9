"""The SO-101 model against numbers of the official MJCF."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import robot_ik as rik

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

# Computed by MuJoCo from TheRobotStudio/SO-ARM100 (Apache-2.0),
# Simulation/SO101/so101_new_calib.xml: joint angles in rad; position of the site "gripperframe" and
# of the body of the moving jaw, m; z axis of that site.
OFFICIAL = (
    (
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.3913619, -1.1255e-05, 0.226468745),
        (0.3166345, 0.017616982, 0.255460884),
        (0.0, -0.048660291, 0.998815386),
    ),
    (
        (0.0454, 1.5724, -1.2027, 1.4878, -1.0023, 0.6382),
        (0.260520088, -0.003494297, -0.107040711),
        (0.310142789, -0.020705701, -0.043978532),
        (0.436565105, -0.888639092, -0.140468765),
    ),
    (
        (1.2583, -0.317, 0.1676, -1.5667, 1.4646, 0.8586),
        (0.071934104, -0.128523713, 0.415205219),
        (0.1088686, -0.142993033, 0.343358403),
        (0.893255074, 0.448994993, -0.022335382),
    ),
    (
        (-0.6538, 1.0068, -0.6652, -0.1542, -1.9952, 0.5994),
        (0.373092331, 0.264874215, 0.086502343),
        (0.335907848, 0.193954083, 0.104478226),
        (0.474025122, -0.758224577, -0.447655755),
    ),
    (
        (-1.1387, -0.8297, 0.8462, -0.7282, -0.034, 1.7083),
        (0.133643767, 0.206200883, 0.314245057),
        (0.086753497, 0.144239092, 0.287834411),
        (-0.197582195, -0.625652203, 0.754665885),
    ),
    (
        (1.7726, 0.7847, 0.1393, -0.7399, -1.8466, 1.6876),
        (-0.028529544, -0.36608696, 0.045074799),
        (-0.046170648, -0.289185633, 0.067668175),
        (-0.916883062, 0.247156251, -0.313431393),
    ),
    (
        (0.0617, -1.3409, 0.4174, 0.9175, 0.6798, 1.5866),
        (0.201849038, -0.015095598, 0.274969166),
        (0.129165654, 0.021390549, 0.28598597),
        (0.031548022, 0.589225696, 0.807352341),
    ),
    (
        (-1.7678, 0.0998, -0.1374, -1.4513, 0.838, 1.4624),
        (0.00110919, 0.219360469, 0.394338688),
        (-0.029164589, 0.200690703, 0.320376391),
        (-0.558746715, -0.827334481, 0.057617406),
    ),
)

OFFICIAL_LIMITS = (
    (-1.91986218, 1.91986218),
    (-1.74532925, 1.74532925),
    (-1.69, 1.69),
    (-1.65806285, 1.65806273),
    (-2.7438473, 2.84120631),
    (-0.17453298, 1.7453292),
)

TOLERANCE = 1e-6
"""m, and the same for a component of a unit vector."""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return rik.load_robot("so101").model


@pytest.mark.parametrize(("q", "tool", "jaw", "opening_axis"), OFFICIAL)
def test_kinematics_are_those_of_the_official_model(model, q, tool, jaw, opening_axis):
    data = mujoco.MjData(model)
    for name, angle in zip(JOINTS, q, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    site = data.site("gripper")
    assert site.xpos == pytest.approx(tool, abs=TOLERANCE)
    assert data.body("moving_jaw").xpos == pytest.approx(jaw, abs=TOLERANCE)
    # Our tool has its y axis where the official one has its z axis.
    assert site.xmat.reshape(3, 3)[:, 1] == pytest.approx(opening_axis, abs=TOLERANCE)


def test_limits_are_those_of_the_official_model(model):
    limits = [model.joint(name).range for name in JOINTS]
    assert np.array(limits) == pytest.approx(np.array(OFFICIAL_LIMITS), abs=1e-5)


def test_the_model_has_no_meshes(model):
    assert model.nmesh == 0


def test_the_scene_has_a_table_and_loads():
    robot = rik.load_robot("so101")
    scene = mujoco.MjModel.from_xml_path(str(robot.path.with_name("scene.xml")))
    assert scene.geom("table_top").id >= 0
