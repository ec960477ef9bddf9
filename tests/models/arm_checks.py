"""Checks that the tests of several arms share, and MuJoCo's answers by name."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def posed(model: mujoco.MjModel, q: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return data


def site(data: mujoco.MjData, name: str) -> tuple[Array, Array]:
    site_data = data.site(name)
    return site_data.xpos.copy(), site_data.xmat.reshape(3, 3).copy()


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    pairs = data.contact.geom[: data.ncon]
    return [(model.geom(int(a)).name, model.geom(int(b)).name) for a, b in pairs]


def extent(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[float, float]:
    """Lowest and highest point of a geom, exactly."""
    up = data.geom_xmat[geom].reshape(3, 3)[2]
    size = model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        half = float(np.linalg.norm(up * size))
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half = float(size[0] + abs(up[2]) * size[1])
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        half = float(np.abs(up) @ size)
    else:
        assert kind == mujoco.mjtGeom.mjGEOM_SPHERE
        half = float(size[0])
    return data.geom_xpos[geom][2] - half, data.geom_xpos[geom][2] + half


def quarter(count: int) -> tuple[int, int]:
    """Return the exact cosine and sine of a number of right angles."""
    return ((1, 0), (0, 1), (-1, 0), (0, -1))[count % 4]


def solve(model: mujoco.MjModel, tool: str, position: Array, rotation: Array) -> Array | None:
    """Damped least squares from `ready`, independent of the library's solvers."""
    data = mujoco.MjData(model)
    q: Array = model.key("ready").qpos.copy()
    jacobian = np.zeros((6, model.nv))
    at = model.site(tool).id
    lower, upper = model.jnt_range.T
    for _ in range(200):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        have = data.site_xmat[at].reshape(3, 3)
        turn = 0.5 * sum(np.cross(have[:, k], rotation[:, k]) for k in range(3))
        error = np.concatenate([position - data.site_xpos[at], turn])
        if np.linalg.norm(error) < 1e-9 and np.trace(rotation.T @ have) > 2.9:
            return q
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], at)
        square = jacobian @ jacobian.T + 1e-5 * np.eye(6)
        q = np.clip(
            q + jacobian.T @ np.linalg.solve(square, np.clip(error, -0.2, 0.2)), lower, upper
        )
    return None


def check_way_from_ready(model: mujoco.MjModel, q: Array | None, body: str, above: float) -> None:
    """Check that a straight line in joint space is free, and the height of a body at its end."""
    assert q is not None
    lower, upper = model.jnt_range.T
    assert np.minimum(q - lower, upper - q).min() > math.radians(4)
    start = model.key("ready").qpos
    for t in np.linspace(0, 1, 21):
        assert touching(model, posed(model, start + t * (q - start))) == []
    assert posed(model, q).body(body).xpos[2] > above
