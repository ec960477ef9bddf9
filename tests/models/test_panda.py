"""The Panda against the maker's numbers: DH product, limits, hand; identified masses; markers and scene."""

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

FOLDER = Path(__file__).parents[2] / "models" / "panda"
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
# a, alpha / 90 deg, d of the maker's modified DH table; typed again here, the XML is not read.
DH = (
    (0.0, 0, 0.333),
    (0.0, -1, 0.0),
    (0.0, 1, 0.316),
    (0.0825, 1, 0.0),
    (-0.0825, -1, 0.384),
    (0.0, 1, 0.0),
    (0.088, 1, 0.0),
)
FLANGE = 0.107
# Gaz et al. 2019, in DH frame i: mass, centre of mass, inertia about it (xx, yy, zz, xy, xz, yz).
LINKS = (
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (
        3.228604,
        (0.027518, 0.039252, -0.066502),
        (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805),
    ),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (
        1.225946,
        (-0.011953, 0.041065, -0.038437),
        (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229),
    ),
    (
        1.666555,
        (0.060149, -0.014117, -0.010517),
        (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
    ),
    (
        0.735522,
        (0.010517, -0.004252, 0.061597),
        (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741),
    ),
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
    """DH frames 1 to 7, (4, 4) each, as Rx(alpha) Tx(a) Tz(d) Rz(q) products."""
    pose, frames = np.eye(4), []
    for angle, (a, turns, d) in zip(q, DH, strict=True):
        c, s = math.cos(angle), math.sin(angle)
        ca, sa = quarter(turns)
        pose = pose @ np.array(
            [[c, -s, 0, a], [s * ca, c * ca, -sa, -sa * d], [s * sa, c * sa, ca, ca * d], [0, 0, 0, 1.0]]
        )
        frames.append(pose)
    return frames


angles = st.tuples(*(st.floats(*pair) for pair in zip(LOWER, UPPER, strict=True))).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_8(q: Array) -> None:
    position, rotation = site(posed(load("panda.xml"), q), "flange")
    expected = dh_frames(q)[-1]
    assert np.abs(position - (expected[:3, 3] + FLANGE * expected[:3, 2])).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


@given(q=angles)
def test_masses_are_the_identified_ones(q: Array) -> None:
    model = load("panda.xml")
    data = posed(model, q)
    for link, (frame, (mass, centre, moments)) in enumerate(zip(dh_frames(q), LINKS, strict=True)):
        xx, yy, zz, xy, xz, yz = moments
        body, turn = model.jnt_bodyid[link], frame[:3, :3]
        assert model.body_mass[body] == mass
        assert np.abs(data.xipos[body] - (turn @ centre + frame[:3, 3])).max() < 1e-12, link
        axes = data.ximat[body].reshape(3, 3)
        have = axes @ np.diag(model.body_inertia[body]) @ axes.T
        wanted = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        assert np.abs(have - wanted).max() < 1e-9, link


def test_known_pose_of_the_zero_configuration() -> None:
    position, rotation = site(posed(load("panda.xml"), np.zeros(7)), "flange")
    assert position == pytest.approx([0.088, 0, 0.333 + 0.316 + 0.384 - 0.107], abs=1e-15)
    assert rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-15)


def test_joints_and_limits_equal_the_source() -> None:
    model = load("panda.xml")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.all(model.jnt_limited == 1)
    assert np.array_equal(model.jnt_range, np.stack([LOWER, UPPER], axis=1))


def test_hand_is_turned_by_minus_45_degrees_about_the_flange() -> None:
    data = posed(load("panda.xml"), load("panda.xml").key("ready").qpos)
    origin, rotation = site(data, "flange")
    h = math.sqrt(0.5)
    turned = np.array([[h, h, 0], [-h, h, 0], [0, 0, 1]])
    for name, offset in {"hand": 0.0, "hand_tcp": 0.1034}.items():
        position, axes = site(data, name)
        assert rotation.T @ (position - origin) == pytest.approx([0, 0, offset], abs=1e-14), name
        assert rotation.T @ axes == pytest.approx(turned, abs=1e-14), name
    axes = site(data, "hand_tcp")[1]
    # The maker's start holds the hand square to the base.
    assert axes == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-12)


def test_folding_the_hand_into_the_base_is_a_contact() -> None:
    model = load("panda.xml")
    assert touching(model, posed(model, np.array([0, 0.2, 0, -3.0, 0, 2.0, 0.8])))


@pytest.mark.parametrize("xml", ["panda.xml", "scene.xml"])
@pytest.mark.parametrize("key", ["home", "ready"])
def test_keyframes_are_inside_limits_free_and_regular(xml: str, key: str) -> None:
    model = load(xml)
    q = model.key(key).qpos
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(30)
    assert np.array_equal(model.key(key).ctrl, q)
    data = posed(model, q)
    assert touching(model, data) == []
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("flange").id)
    assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.05
    assert 0.999 < -site(data, "hand_tcp")[1][2, 2] <= 1.0 + 1e-12


def test_position_actuators_hold_the_ready_pose() -> None:
    model = load("scene.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("ready").id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - model.key("ready").qpos).max() < math.radians(1.5)
    assert model.actuator_forcerange[:, 1] == pytest.approx([87, 87, 87, 87, 12, 12, 12])


def test_masses_and_inertias_are_those_of_rigid_bodies() -> None:
    model = load("panda.xml")
    moving = model.body_mass > 0
    inertia = model.body_inertia[moving]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1) - 1e-9)
    assert model.body_mass.sum() == pytest.approx(sum(link[0] for link in LINKS) + 0.73 + 0.12)


def test_robot_toml_names_what_the_model_has() -> None:
    robot, model = load_robot("panda"), load("panda.xml")
    assert robot.joints == JOINTS and robot.tool == "hand_tcp"
    assert set(settings()["tools"]) <= set(robot.frames)
    assert robot.home == pytest.approx(model.key(settings()["home"]).qpos)
    assert all(joint in JOINTS for group in settings()["groups"].values() for joint in group)
    assert np.degrees(robot.velocity) == pytest.approx(settings()["motion"]["velocity_deg"])
    assert robot.file.sources


def test_markers_lie_on_the_cube_with_z_outwards() -> None:
    reach, model = settings()["reach"]["tool_marker"], load("panda.xml")
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
    jacobian, tool = np.zeros((6, model.nv)), model.site("hand_tcp").id
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


@pytest.mark.parametrize("yaw_deg", [-40.0, 0.0, 40.0])
@pytest.mark.parametrize("x", [0.42, 0.58])
@pytest.mark.parametrize("y", [-0.15, 0.0, 0.15])
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
    assert posed(model, q).body("panda_link4").xpos[2] > 0.4


def test_reach_is_reached_and_two_sides_of_the_cube_face_the_camera() -> None:
    """The whole job on the simulated bus: marker found, goal reached, and the camera agrees."""
    report = run_reach(ReachRequest(robot="panda", bus="sim"))
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
