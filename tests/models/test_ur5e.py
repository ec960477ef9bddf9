"""The UR5e against the maker's numbers: DH product, limits, masses; its tools, markers and scene."""

import math
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models.arm_checks import (
    check_keyframe,
    check_markers,
    check_reach,
    check_ready_is_held,
    check_rigid_bodies,
    check_settings,
    check_table,
    check_way_from_ready,
    posed,
    quarter,
    site,
    solve,
    touching,
)

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "ur5e"
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
LIMIT = np.array([2, 2, 1, 2, 2, 2]) * math.pi
# a, alpha / 90 deg, d of the maker's standard DH table; typed again here, the XML is not read.
DH = (
    (0.0, 1, 0.1625),
    (-0.425, 0, 0.0),
    (-0.3922, 0, 0.0),
    (0.0, 1, 0.1333),
    (0.0, -1, 0.0997),
    (0.0, 0, 0.0996),
)
# Mass and centre of mass in DH frame i, of the same page.
LINKS = (
    (3.761, (0.0, -0.02561, 0.00193)),
    (8.058, (0.2125, 0.0, 0.11336)),
    (2.846, (0.15, 0.0, 0.0265)),
    (1.37, (0.0, -0.0018, 0.01634)),
    (1.3, (0.0, 0.0018, 0.01634)),
    (0.365, (0.0, 0.0, -0.001159)),
)


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def settings() -> dict[str, Any]:
    return tomllib.loads((FOLDER / "robot.toml").read_text(encoding="utf-8"))


def dh_frames(q: Array) -> list[Array]:
    """DH frames 1 to 6, (4, 4) each, as Rz(q) Tz(d) Tx(a) Rx(alpha) products."""
    pose, frames = np.eye(4), []
    for angle, (a, turns, d) in zip(q, DH, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        ca, sa = quarter(turns)
        pose = pose @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1.0]]
        )
        frames.append(pose)
    return frames


angles = st.tuples(*(st.floats(-v, v) for v in LIMIT)).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_6(q: Array) -> None:
    position, rotation = site(posed(load("ur5e.xml"), q), "flange")
    expected = dh_frames(q)[-1]
    assert np.abs(position - expected[:3, 3]).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


@given(q=angles)
def test_masses_sit_where_the_maker_has_them(q: Array) -> None:
    model = load("ur5e.xml")
    data = posed(model, q)
    for link, (frame, (mass, centre)) in enumerate(zip(dh_frames(q), LINKS, strict=True)):
        body = model.jnt_bodyid[link]
        assert model.body_mass[body] == mass
        assert np.abs(data.xipos[body] - (frame[:3, :3] @ centre + frame[:3, 3])).max() < 1e-12, link


def test_known_pose_of_the_zero_configuration() -> None:
    position, rotation = site(posed(load("ur5e.xml"), np.zeros(6)), "flange")
    assert position == pytest.approx([-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], abs=1e-15)
    assert rotation == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), abs=1e-15)


def test_joints_and_limits_equal_the_source() -> None:
    model = load("ur5e.xml")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.all(model.jnt_limited == 1)
    assert np.abs(model.jnt_range - LIMIT[:, None] * [-1.0, 1.0]).max() < 1e-15


def test_gripper_is_rigid_to_the_flange() -> None:
    data = posed(load("ur5e.xml"), np.array([0.3, -1.2, 0.4, 2.0, 0.7, -1.1]))
    origin, rotation = site(data, "flange")
    for name, offset in {"gripper": 0.131, "marker_cube": 0.050}.items():
        position, axes = site(data, name)
        assert rotation.T @ (position - origin) == pytest.approx([0, 0, offset], abs=1e-14), name
        assert axes == pytest.approx(rotation, abs=1e-14), name


def test_folding_the_forearm_into_the_shoulder_is_a_contact() -> None:
    model = load("ur5e.xml")
    assert touching(model, posed(model, np.radians([0.0, -90.0, 172.0, 0, 0, 0])))


@pytest.mark.parametrize("xml", ["ur5e.xml", "scene.xml"])
@pytest.mark.parametrize("key", ["home", "ready"])
def test_keyframes_are_inside_limits_free_and_regular(xml: str, key: str) -> None:
    data = check_keyframe(load(xml), key, 50, 0.05)
    assert 0.999 < -site(data, "gripper")[1][2, 2] <= 1.0 + 1e-12


def test_position_actuators_hold_the_ready_pose() -> None:
    model = load("scene.xml")
    check_ready_is_held(model)
    assert model.actuator_forcerange[:, 1] == pytest.approx([150, 150, 150, 28, 28, 28])


def test_masses_and_inertias_are_those_of_rigid_bodies() -> None:
    model = load("ur5e.xml")
    check_rigid_bodies(model)
    assert model.body_mass.sum() == pytest.approx(sum(mass for mass, _ in LINKS) + 0.6)


def test_robot_toml_names_what_the_model_has() -> None:
    check_settings("ur5e", load("ur5e.xml"), settings(), JOINTS, "gripper")


def test_markers_lie_on_the_cube_with_z_outwards() -> None:
    reach, model = settings()["reach"]["tool_marker"], load("ur5e.xml")
    check_markers(model, posed(model, model.key("ready").qpos), reach)
    for number in reach["ids"]:  # the other robot's tests hold its pictures to OpenCV's
        printed = FOLDER / "assets" / f"marker_{number}.png"
        assert printed.read_bytes() == (FOLDER.parent / "puma560" / "assets" / printed.name).read_bytes()


@pytest.mark.parametrize("yaw_deg", [-90.0, 0.0, 60.0, 180.0])
@pytest.mark.parametrize("x", [-0.25, -0.1, 0.05])
@pytest.mark.parametrize("y", [0.36, 0.56])
def test_markers_on_the_table_are_reached_without_contact(x: float, y: float, yaw_deg: float) -> None:
    model, reach = load("scene.xml"), settings()["reach"]
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    rotation = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]])
    place = np.array([x, y, reach["table"]["height"] + reach["hover"]])
    check_way_from_ready(model, solve(model, "gripper", place, rotation), "forearm_link", above=0.4)


def test_reach_is_reached_and_two_sides_of_the_cube_face_the_camera() -> None:
    check_reach("ur5e", settings()["reach"])


def test_scene_table_is_that_of_robot_toml() -> None:
    model = load("scene.xml")
    check_table(model, model.key("ready").qpos, settings()["reach"]["table"])
