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

from robot_ik.jobs.reach import ReachRequest, run_reach
from robot_ik.robot import load_robot

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


def posed(model: mujoco.MjModel, q: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data


def site(data: mujoco.MjData, name: str) -> tuple[Array, Array]:
    found = data.site(name)
    return found.xpos.copy(), found.xmat.reshape(3, 3).copy()


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    pairs = data.contact.geom[: data.ncon]
    return [(model.geom(int(a)).name, model.geom(int(b)).name) for a, b in pairs]


def quarter(count: int) -> tuple[int, int]:
    """Cosine and sine of so many right angles, exact."""
    return ((1, 0), (0, 1), (-1, 0), (0, -1))[count % 4]


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
    model = load(xml)
    q = model.key(key).qpos
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(50)
    assert np.array_equal(model.key(key).ctrl, q)
    data = posed(model, q)
    assert touching(model, data) == []
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("flange").id)
    assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.05
    assert 0.999 < -site(data, "gripper")[1][2, 2] <= 1.0 + 1e-12


def test_position_actuators_hold_the_ready_pose() -> None:
    model = load("scene.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("ready").id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - model.key("ready").qpos).max() < math.radians(1.5)
    assert model.actuator_forcerange[:, 1] == pytest.approx([150, 150, 150, 28, 28, 28])


def test_masses_and_inertias_are_those_of_rigid_bodies() -> None:
    model = load("ur5e.xml")
    moving = model.body_mass > 0
    inertia = model.body_inertia[moving]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1) - 1e-9)
    assert model.body_mass.sum() == pytest.approx(sum(mass for mass, _ in LINKS) + 0.6)


def test_robot_toml_names_what_the_model_has() -> None:
    robot, model = load_robot("ur5e"), load("ur5e.xml")
    assert robot.joints == JOINTS and robot.tool == "gripper"
    assert set(settings()["tools"]) <= set(robot.frames)
    assert robot.home == pytest.approx(model.key(settings()["home"]).qpos)
    assert all(joint in JOINTS for group in settings()["groups"].values() for joint in group)
    assert np.degrees(robot.velocity) == pytest.approx(settings()["motion"]["velocity_deg"])
    assert robot.file.sources


def test_markers_lie_on_the_cube_with_z_outwards() -> None:
    reach, model = settings()["reach"]["tool_marker"], load("ur5e.xml")
    data = posed(model, model.key("ready").qpos)
    centre, axes = site(data, reach["site"])
    assert model.geom("marker_cube").size == pytest.approx([reach["cube"] / 2] * 3)
    assert centre == pytest.approx(data.geom("marker_cube").xpos)
    for number, out in zip(reach["ids"], [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)], strict=True):
        position, rotation = site(data, f"marker_{number}")
        assert rotation[:, 2] == pytest.approx(axes @ out, abs=1e-14), number
        assert rotation[:, 1] == pytest.approx(-axes[:, 2], abs=1e-14), number
        assert position == pytest.approx(centre + reach["cube"] / 2 * rotation[:, 2], abs=1e-14), number
        printed = FOLDER / "assets" / f"marker_{number}.png"
        # The other robot's tests hold its pictures to OpenCV's.
        original = FOLDER.parent / "puma560" / "assets" / printed.name
        assert printed.read_bytes() == original.read_bytes()


def solve(model: mujoco.MjModel, position: Array, rotation: Array) -> Array | None:
    """Plain damped least squares from `ready`: a judge that shares nothing with the library's solvers."""
    data = mujoco.MjData(model)
    q: Array = model.key("ready").qpos.copy()
    jacobian, tool = np.zeros((6, model.nv)), model.site("gripper").id
    lower, upper = model.jnt_range.T
    for _ in range(200):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        have = data.site_xmat[tool].reshape(3, 3)
        turn = 0.5 * sum(np.cross(have[:, k], rotation[:, k]) for k in range(3))
        miss = np.concatenate([position - data.site_xpos[tool], turn])
        if np.linalg.norm(miss) < 1e-9 and np.trace(rotation.T @ have) > 2.9:
            return q
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], tool)
        square = jacobian @ jacobian.T + 1e-5 * np.eye(6)
        q = np.clip(q + jacobian.T @ np.linalg.solve(square, np.clip(miss, -0.2, 0.2)), lower, upper)
    return None


@pytest.mark.parametrize("yaw_deg", [-90.0, 0.0, 60.0, 180.0])
@pytest.mark.parametrize("x", [-0.25, -0.1, 0.05])
@pytest.mark.parametrize("y", [0.36, 0.56])
def test_markers_on_the_table_are_reached_without_contact(x: float, y: float, yaw_deg: float) -> None:
    model, reach = load("scene.xml"), settings()["reach"]
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    rotation = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]])
    q = solve(model, np.array([x, y, reach["table"]["height"] + reach["hover"]]), rotation)
    assert q is not None
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(4)
    start = model.key("ready").qpos
    for t in np.linspace(0, 1, 21):
        assert touching(model, posed(model, start + t * (q - start))) == []
    assert posed(model, q).body("forearm_link").xpos[2] > 0.4


def test_reach_is_reached_and_two_sides_of_the_cube_face_the_camera() -> None:
    """The whole job on the simulated bus: marker found, goal reached, and the camera agrees."""
    report = run_reach(ReachRequest(robot="ur5e", bus="sim"))
    assert report.reached and not report.blind
    assert report.by_camera is not None and report.q_end is not None
    assert report.by_camera.position < 0.002
    data = posed(report.robot.model, report.q_end)
    reach = settings()["reach"]
    facing = 0
    for number in reach["tool_marker"]["ids"]:
        position, axes = site(data, f"marker_{number}")
        away = np.array(reach["camera"]["position"]) - position
        facing += float(away @ axes[:, 2] / np.linalg.norm(away)) > math.cos(math.radians(60))
    assert facing == 2


def test_scene_table_is_that_of_robot_toml() -> None:
    model, table = load("scene.xml"), settings()["reach"]["table"]
    top = model.geom("table_top")
    centre = posed(model, model.key("ready").qpos).geom("table_top").xpos
    low, high = centre - top.size, centre + top.size
    assert [low[0], high[0]] == pytest.approx(table["x"])
    assert [low[1], high[1]] == pytest.approx(table["y"])
    assert high[2] == pytest.approx(table["height"], abs=1e-12)
