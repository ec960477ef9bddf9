"""What the tests of several arms' models share: MuJoCo's answers by name, and the checks that are alike."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from robot_ik.jobs.reach import ReachRequest, run_reach
from robot_ik.robot import load_robot

Array = NDArray[np.float64]


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


def solve(model: mujoco.MjModel, tool: str, position: Array, rotation: Array) -> Array | None:
    """Plain damped least squares from `ready`: a judge that shares nothing with the library's solvers."""
    data = mujoco.MjData(model)
    q: Array = model.key("ready").qpos.copy()
    jacobian, at = np.zeros((6, model.nv)), model.site(tool).id
    lower, upper = model.jnt_range.T
    for _ in range(200):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        have = data.site_xmat[at].reshape(3, 3)
        turn = 0.5 * sum(np.cross(have[:, k], rotation[:, k]) for k in range(3))
        miss = np.concatenate([position - data.site_xpos[at], turn])
        if np.linalg.norm(miss) < 1e-9 and np.trace(rotation.T @ have) > 2.9:
            return q
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], at)
        square = jacobian @ jacobian.T + 1e-5 * np.eye(6)
        q = np.clip(q + jacobian.T @ np.linalg.solve(square, np.clip(miss, -0.2, 0.2)), lower, upper)
    return None


def check_keyframe(model: mujoco.MjModel, key: str, degrees: float, regular: float) -> mujoco.MjData:
    """So far inside the limits, touching nothing, so far from singular; its actuators hold it."""
    q = model.key(key).qpos
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(degrees)
    assert np.array_equal(model.key(key).ctrl, q)
    data = posed(model, q)
    assert touching(model, data) == []
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("flange").id)
    assert np.linalg.svd(jacobian, compute_uv=False).min() > regular
    return data


def check_ready_is_held(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("ready").id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - model.key("ready").qpos).max() < math.radians(1.5)


def check_rigid_bodies(model: mujoco.MjModel) -> None:
    inertia = model.body_inertia[model.body_mass > 0]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1) - 1e-9)


def check_settings(
    name: str, model: mujoco.MjModel, settings: dict[str, Any], joints: tuple[str, ...], tool: str
) -> None:
    robot = load_robot(name)
    assert robot.joints == joints and robot.tool == tool
    assert set(settings["tools"]) <= set(robot.frames)
    assert robot.home == pytest.approx(model.key(settings["home"]).qpos)
    assert all(joint in joints for group in settings["groups"].values() for joint in group)
    assert np.degrees(robot.velocity) == pytest.approx(settings["motion"]["velocity_deg"])
    assert robot.file.sources


def check_markers(model: mujoco.MjModel, data: mujoco.MjData, reach: dict[str, Any]) -> None:
    """They lie on the sides of the cube, z outwards, y along the cube's z."""
    centre, axes = site(data, reach["site"])
    assert model.geom("marker_cube").size == pytest.approx([reach["cube"] / 2] * 3)
    assert centre == pytest.approx(data.geom("marker_cube").xpos)
    for number, out in zip(reach["ids"], [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)], strict=True):
        position, rotation = site(data, f"marker_{number}")
        assert rotation[:, 2] == pytest.approx(axes @ out, abs=1e-14), number
        assert rotation[:, 1] == pytest.approx(-axes[:, 2], abs=1e-14), number
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert position == pytest.approx(centre + reach["cube"] / 2 * rotation[:, 2], abs=1e-14), number


def check_way_from_ready(model: mujoco.MjModel, q: Array | None, body: str, above: float) -> None:
    """Straight in joint space nothing touches; at the end that body is so high."""
    assert q is not None
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(4)
    start = model.key("ready").qpos
    for t in np.linspace(0, 1, 21):
        assert touching(model, posed(model, start + t * (q - start))) == []
    assert posed(model, q).body(body).xpos[2] > above


def check_reach(name: str, reach: dict[str, Any]) -> None:
    """The whole job on the simulated bus: goal reached, the camera agrees and sees two sides of the cube."""
    report = run_reach(ReachRequest(robot=name, bus="sim"))
    assert report.reached and not report.blind
    assert report.by_camera is not None and report.q_end is not None
    assert report.by_camera.position < 0.002
    data = posed(report.robot.model, report.q_end)
    facing = 0
    for number in reach["tool_marker"]["ids"]:
        position, axes = site(data, f"marker_{number}")
        away = np.array(reach["camera"]["position"]) - position
        facing += float(away @ axes[:, 2] / np.linalg.norm(away)) > math.cos(math.radians(60))
    assert facing == 2


def check_table(model: mujoco.MjModel, q: Array, table: dict[str, Any]) -> None:
    """The scene's table is that of robot.toml."""
    top = model.geom("table_top")
    centre = posed(model, q).geom("table_top").xpos
    low, high = centre - top.size, centre + top.size
    assert [low[0], high[0]] == pytest.approx(table["x"])
    assert [low[1], high[1]] == pytest.approx(table["y"])
    assert high[2] == pytest.approx(table["height"], abs=1e-12)
